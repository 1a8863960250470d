"""Simulated DCA1000 capture cards: SYNC_IN edges in, UDP data packets out.

`sync_in` decides which pulses start a frame, and where the stage is then; `dca1000` is the card's state machine without
sockets; `card` adds sockets and a radar; `fault_draws` draws faults from a seed; `adversary` is a stand-alone card and
network with every kind of trouble. `server` runs the cards of one process (`python -m polysight_simulators.cards`).
Specification: docs/spec/simulated-rig.md.
"""

from polysight_simulators.cards.adversary import NETWORK_TROUBLES, RADAR_TROUBLES, Adversary, Arrival, SentRecord
from polysight_simulators.cards.card import MAC, CardEndpoint, bind_udp
from polysight_simulators.cards.dca1000 import SOURCE_PORT, Network
