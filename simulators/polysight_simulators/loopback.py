"""Addresses of a simulated rig: its own loopback subnet 127.x.y.0, so that rigs with equal ports can run together.

The last byte of every card and host address is kept (.180, .181, .182, .30), as in the real rig.
"""

import random
import socket
from contextlib import ExitStack
from typing import Any

from polysight_shared.config import Instrument
from polysight_shared.errors import DeviceError
from polysight_shared.tables import decode, to_builtins
from polysight_simulators.cards import SOURCE_PORT, bind_udp

# Subnets that are tried, because other programs may hold ports of some. Chosen.
_TRIES = 50
# Ports of the simulated Pi, and the last byte of its address.
_COMMAND_PORT = 5601
_EVENT_PORT = 5602
_PI_HOST_PART = "10"
# Port of the native connection of a simulated radar.
_RADAR_PORT = 5700


def move_to_subnet(rig: Instrument, subnet: str) -> Instrument:
    """Return the rig with its cards, host and Pi on `subnet` ("127.x.y"); the Pi gets .10, the others keep their byte.

    A board's control server keeps its port, and its native connection gets port 5700; both get its card's address.
    The simulated boards replace those that the rig file identifies by serial number, plug or die.
    """
    table: dict[str, Any] = to_builtins(rig)
    for board in table["boards"]:
        for key in ("card_address", "host_address"):
            board[key] = f"{subnet}.{board[key].rpartition('.')[2]}"
    cards = {board["name"]: board["card_address"] for board in table["boards"]}
    servers = {name: f"{cards[name]}:{port.rpartition(':')[2]}" for name, port in rig.radar.servers.items()}
    native = table["radar"].get("native", {})
    for name, board in native.items():
        address = f"tcp://{cards[name]}:{_RADAR_PORT}"
        # The acknowledgement of LDO bypass repeats the name of its board, which changes here.
        if board["usb_serial"] and board["ldo_bypass_acknowledged"] == board["usb_serial"]:
            board["ldo_bypass_acknowledged"] = address
        board |= {"usb_serial": address, "usb_path": "", "die_id": ""}
    table["radar"] = {**table["radar"], "servers": servers, "native": native}
    pi = f"tcp://{subnet}.{_PI_HOST_PART}"
    table["pi"] |= {"command_address": f"{pi}:{_COMMAND_PORT}", "event_address": f"{pi}:{_EVENT_PORT}"}
    return decode(table, Instrument, f"{rig.name} on {subnet}.0")


def is_free(rig: Instrument) -> bool:
    """Return True if every address of the rig is free; the rig is one of `move_to_subnet`."""
    udp = {(b.card_address, port) for b in rig.boards for port in (SOURCE_PORT, b.command_port)}
    udp |= {(b.host_address, port) for b in rig.boards for port in (b.command_port, b.data_port)}
    radars = (*rig.radar.servers.values(), *(b.usb_serial for b in rig.radar.native.values()))
    addresses = (rig.pi.command_address, rig.pi.event_address, *radars)
    tcp = [address.removeprefix("tcp://").split(":") for address in addresses]
    with ExitStack() as stack:
        try:
            for address, port in udp:
                stack.enter_context(bind_udp(address, port))
            for address, port in tcp:
                tcp_socket = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_STREAM))
                # Addresses of a rig that has just ended count as free.
                tcp_socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                tcp_socket.bind((address, int(port)))
        except (OSError, DeviceError):
            return False
    return True


def move_to_free_subnet(rig: Instrument) -> Instrument:
    """Return the rig on a random loopback subnet with free addresses.

    Raises DeviceError if no attempt finds one: this machine's loopback is not 127.0.0.0/8, or many rigs run.
    """
    generator = random.Random()
    for _ in range(_TRIES):
        moved_rig = move_to_subnet(rig, f"127.{generator.randint(1, 254)}.{generator.randint(0, 255)}")
        if is_free(moved_rig):
            return moved_rig
    raise DeviceError(
        f"no free loopback subnet in {_TRIES} tries",
        "only 127.0.0.1 exists on this machine (not Linux?), or too many simulated rigs run",
        "end other simulated rigs; on macOS add addresses with `ifconfig lo0 alias`",
    )
