"""Which hop to a capture card is silent, from what the kernel knows: route, link, neighbour."""

from __future__ import annotations

import socket
import struct
from enum import Enum
from pathlib import Path

from polysight.host.capture.dca1000 import Status
from polysight.host.capture.receiver_words import RowCapture
from polysight.shared.config import Board
from polysight.shared.errors import DeviceError

_GATEWAY, _UP = 0x2, 0x1
_ARP_COMPLETE = 0x2
_ROOT = Path("/")


class Hop(Enum):
    """The first hop on the way to a silent card that does not work."""

    ROUTE = "no route"
    LINK = "no link"
    NEIGHBOUR = "no device at the address"
    CARD = "the card is mute"
    UNKNOWN = "unknown"


def silent_hop(card_address: str, root: Path = _ROOT) -> Hop:
    """The hop that keeps a card at this address from answering.

    Parameters
    ----------
    card_address
        IPv4 address of the card.
    root
        Where `proc/net/route`, `proc/net/arp` and `sys/class/net` are. What cannot be read is passed over.
    """
    if card_address.startswith("127."):
        return Hop.UNKNOWN  # loopback is in none of these tables
    interface = route_interface(card_address, root)
    if interface == "":
        return Hop.ROUTE
    if interface is not None and has_link(interface, root) is False:
        return Hop.LINK
    neighbour = neighbour_answers(card_address, root)
    if neighbour is None:
        return Hop.UNKNOWN
    return Hop.CARD if neighbour else Hop.NEIGHBOUR


def route_interface(address: str, root: Path = _ROOT) -> str | None:
    """The interface whose own subnet holds this address, "" when there is none, None when it cannot be told.

    A route over a gateway is none: a capture card is reached without a router, or not at all.
    """
    try:
        lines = (root / "proc/net/route").read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return None
    wanted = struct.unpack("=I", socket.inet_aton(address))[0]
    best, found = -1, ""
    for line in lines:
        words = line.split()
        if len(words) < 8:
            continue
        destination, flags, mask = int(words[1], 16), int(words[3], 16), int(words[7], 16)
        length = mask.bit_count()
        if flags & _UP and wanted & mask == destination and length > best:
            best, found = length, "" if flags & _GATEWAY else words[0]
    return found


def has_link(interface: str, root: Path = _ROOT) -> bool | None:
    """Whether the interface has a carrier; None when it cannot be told."""
    folder = root / "sys/class/net" / interface
    try:
        return (folder / "carrier").read_text(encoding="ascii").strip() == "1"
    except OSError:
        pass  # an interface that is down has no readable carrier
    try:
        return False if (folder / "operstate").read_text(encoding="ascii").strip() == "down" else None
    except OSError:
        return None


def neighbour_answers(address: str, root: Path = _ROOT) -> bool | None:
    """Whether a device answered for this address on the local network; None when the kernel does not know."""
    try:
        lines = (root / "proc/net/arp").read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return None
    for line in lines:
        words = line.split()
        if len(words) >= 3 and words[0] == address:
            return bool(int(words[2], 16) & _ARP_COMPLETE)
    return None


def silent_card(board: Board, what: str, root: Path = _ROOT) -> DeviceError:
    """The error for a card that does not answer: `what` happened, and which hop is silent as far as it can be told."""
    hop, interface = silent_hop(board.card_address, root), route_interface(board.card_address, root)
    if hop is Hop.ROUTE:
        return no_route(board, what)
    if hop is Hop.LINK:
        return DeviceError(
            what,
            f"no link: network interface {interface} has no carrier, the cable is out or the card has no power",
            f"check the card's power, the cable and the ethernet LEDs; `ip link show {interface}` must say LOWER_UP",
        )
    if hop is Hop.NEIGHBOUR:
        return DeviceError(
            what,
            f"the link is up, but no device has the address {board.card_address}: another card is on this cable, or its"
            " EEPROM holds another address",
            "check card_address in instrument.toml (a scan that was begun takes it with `polysight resume SCAN --config"
            " instrument.toml`); with the card's EEPROM switch off it has its default address",
        )
    return DeviceError(
        what,
        "the card is mute: a device is there, but its program does not answer; wrong command port, or its replies go to"
        " another host address"
        if hop is Hop.CARD
        else "the card is off, or listens at another address or port",
        f"the card answers to the host address and ports in its EEPROM: it must send to {board.host_address}"
        f" port {board.command_port}; `ss -ulnp` shows who else listens there",
    )


def no_route(board: Board, what: str) -> DeviceError:
    """The error for a card that lies in no subnet of this machine."""
    return DeviceError(
        what,
        f"no route: no network interface of this machine is in the subnet of {board.card_address}",
        f"`ip address add {board.host_address}/24 dev <interface>`; `ip route get {board.card_address}` shows the route"
        " in use",
    )


def silent_radar(board: Board, row: RowCapture | None = None) -> DeviceError:
    """The error for a card that answers commands but of which no data came, with the likeliest cause.

    `row` is what the receiver got; its strangers and its card status tell more.
    """
    what = f"no data from {board.name} (card {board.card_address} to {board.host_address}:{board.data_port})"
    if row is not None and row.strangers:
        return DeviceError(
            what,
            f"{row.strangers} packets came from another address than {board.card_address}",
            "two boards may have each other's ports; check card_address and data_port in instrument.toml, then"
            " `polysight resume SCAN --config instrument.toml`",
        )
    status = Status(row.card_status) if row is not None else Status(0)
    if Status.NO_LVDS_DATA in status:
        why = "the card answers, and reports that the radar sends nothing over LVDS: it is not streaming"
    elif Status.NO_HEADER in status:
        why = "the card answers, and reports LVDS data without the header it waits for: it is set to another mode"
    else:
        why = (
            "the card answers, but the radar is not streaming (not armed, or SYNC_IN does not reach it), or the card"
            " sends its data to another address or port"
        )
    return DeviceError(
        what,
        why,
        "arm the radar, check the SYNC_IN wire (`polysight doctor` sends pulses), and the data port in the card's"
        " EEPROM",
    )
