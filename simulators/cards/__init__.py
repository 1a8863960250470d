"""The DCA1000 capture cards of a simulated rig: SYNC_IN edges in, UDP data packets out.

`sync_in` tells which pulse starts a frame and where the stage is then; `dca1000` is the card's state machine, bytes and
times only; `card` gives it sockets and a radar; `sender` sends many packets a call; `fault_draws` decides what goes
wrong and when; `adversary` is a card and a network at their worst, by itself. `server` runs the cards of one process,
and `python -m polysight.simulators.cards` is that process.
Specification: docs/spec/simulated-rig.md.
"""

from polysight.simulators.cards.adversary import KINDS, Adversary, Arrival, Sent
from polysight.simulators.cards.card import MAC, CardEndpoint, Clock, SimulatedCard
from polysight.simulators.cards.dca1000 import SOURCE_PORT, Network
from polysight.simulators.cards.fault_draws import EventKind
from polysight.simulators.cards.sender import CardSender, Pace, bound_udp
from polysight.simulators.cards.sync_in import StageTrack

__all__ = [
    "KINDS",
    "MAC",
    "SOURCE_PORT",
    "Adversary",
    "Arrival",
    "CardEndpoint",
    "CardSender",
    "Clock",
    "EventKind",
    "Network",
    "Pace",
    "Sent",
    "SimulatedCard",
    "StageTrack",
    "bound_udp",
]
