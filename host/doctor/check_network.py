"""The network interface a card hangs on: frame size, speed, descriptors, and packets it has lost."""

from __future__ import annotations

from polysight.host.capture.network import route_interface
from polysight.host.doctor.bench import Bench
from polysight.host.doctor.finding import Finding, ok, warning
from polysight.host.doctor.kernel import nic
from polysight.shared.config import Board

MTU = 1500
SPEED_MBIT = 1000
RING = 512


def check_network(bench: Bench, board: Board) -> Finding:
    """A gigabit link that carries whole packets. What the kernel does not tell is left out."""
    if board.card_address.startswith("127."):
        return ok("loopback: no network card is involved")
    name = route_interface(board.card_address, bench.system.root)
    if not name:
        return warning(
            f"no interface is in the subnet of {board.card_address}",
            "it has no address there, or this system does not tell",
            f"`ip address add {board.host_address}/24 dev <interface>`",
        )
    found = nic(name, bench.system.root)
    told = [f"{name}: MTU {found.mtu or 'unknown'}", f"{found.speed_mbit or 'unknown'} Mbit/s"]
    told += [f"ring {found.ring} of {found.ring_max}"] if found.ring is not None else []
    facts, text = vars(found), ", ".join(told)
    if found.mtu is not None and found.mtu < MTU:
        return warning(
            text, f"packets of a card fill frames of {MTU} bytes", f"`ip link set {name} mtu {MTU}`", **facts
        )
    if found.speed_mbit is not None and found.speed_mbit < SPEED_MBIT:
        return warning(
            text,
            "a DCA1000 sends at gigabit speed: a slower link drops packets of each burst",
            "a cable of category 5e or better, and a gigabit port; no 100 Mbit switch between",
            **facts,
        )
    if found.ring is not None and found.ring < min(RING, found.ring_max or RING):
        return warning(
            text,
            "few receive descriptors: a pause of this machine loses packets before the socket's buffer",
            f"`ethtool -G {name} rx {found.ring_max}`",
            **facts,
        )
    if found.lost:
        return warning(
            f"{text}; {found.lost} packets lost since it came up",
            "the interface or the kernel dropped them before any program could take them",
            f"`ethtool -S {name}`; does the number grow during a scan?",
            **facts,
        )
    return ok(text, **facts)
