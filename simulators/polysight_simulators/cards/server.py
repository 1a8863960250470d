"""Run all cards and radars of one process on one set of wires: SYNC_IN edges in, frames out as UDP."""

import selectors
from collections.abc import Sequence
from threading import Event

from polysight_shared.config import Instrument
from polysight_shared.wires import WireClient, WireEdge, WireMotion
from polysight_simulators.cards.card import Clock, SimulatedCard
from polysight_simulators.cards.dca1000 import TAIL_S
from polysight_simulators.cards.sync_in import StageTrack
from polysight_simulators.radars import LineServer, RadarSocket

# Edges that are taken from the wires before the cards send again; chosen.
EDGES_PER_TURN = 2048
# Shortest time between two reads of pulses from the wires. Computing many frames in one call takes less time than
# computing a few in each of several calls.
GATHER_S = 0.01
# Longest wait for something to do, and shortest time between two looks whether a record has ended; chosen.
IDLE_S = 0.1
SHORTEST_LOOK_S = 0.001


class CardServer:
    """All cards of one process, on one set of wires.

    Parameters
    ----------
    time_scale
        Speed of the simulated signals: their time over wall time.
    clock_s
        Wall clock.
    track
        Position of the stage; it gets the motion lines and triggers.
    power_cycle
        Event that switches every card off and on.
    control, chips
        Control servers of the radars, or the radars' simulated USB chips if the rig file has native control.
    """

    def __init__(
        self,
        rig: Instrument,
        cards: list[SimulatedCard],
        wires: WireClient,
        time_scale: float,
        clock_s: Clock,
        track: StageTrack,
        power_cycle: Event | None = None,
        control: Sequence[LineServer] = (),
        chips: Sequence[RadarSocket] = (),
    ) -> None:
        self._cards = cards
        self._control = control
        self._chips = chips
        self._power_cycle = power_cycle or Event()
        self._wires = wires
        self._trigger = rig.pi.trigger_in
        self._time_scale = time_scale
        self._clock_s = clock_s
        self._track = track
        self._trigger_ns = 0
        self._pulse_ns = 0
        self._selector = selectors.DefaultSelector()
        # By card: the number of its binding (`CardEndpoint.bindings`), and the descriptor of its socket at that time.
        self._bound: dict[SimulatedCard, tuple[int, int]] = {}
        self._select_cards()
        self._selector.register(wires, selectors.EVENT_READ)
        for server in (*control, *chips):
            self._selector.register(server, selectors.EVENT_READ)
        # True while the wires are watched.
        self._listening = True
        # True while the client of the wires may have unread lines.
        self._unread = False
        # Time of the next read, by `clock_s`.
        self._next_read_s = 0.0

    @property
    def more_expected(self) -> bool:
        """True if the stage is in a row, or pulses of its last trigger are pending."""
        return self._track.moving or self._trigger_ns > self._pulse_ns

    def serve(self, stop: Event) -> None:
        """Run until `stop` is set; switch every card off and on if `power_cycle` is set.

        Raises DeviceError if the wires break, or a card's new address cannot be bound.
        """
        timeout: float = 0.0
        while not stop.is_set():
            ready = self._selector.select(0.0 if self._unread and self._listening else timeout)
            # Radars are armed before the row's first pulse is sent, so control comes before the wires.
            for server in self._control:
                server.serve()
            # A pulse was sent before the command that comes after it, so that the wires are read before commands.
            has_commands = any(key.fileobj is not self._wires for key, _ in ready)
            wires_are_ready = self._listening and (self._unread or len(ready) > 0)
            if has_commands or wires_are_ready:
                self._take_edges()
            for chip in self._chips:
                chip.serve()
            if self._power_cycle.is_set():
                self._power_cycle.clear()
                for card in self._cards:
                    card.endpoint.power_cycle()
            for card in self._cards:
                card.endpoint.serve_commands()
            self._select_cards()
            timeout = min(self._send_data(card) for card in self._cards)
            gather_s = self._next_read_s - self._clock_s()
            # Let pulses gather at the wires for a moment, and leave them there while a card cannot send what it has.
            has_full_card = any(card.endpoint.sender.full for card in self._cards)
            self._listen(is_needed=gather_s <= 0 and not has_full_card)
            if gather_s > 0:
                timeout = min(timeout, gather_s)

    def _select_cards(self) -> None:
        """Register the cards' sockets, which change at a power cycle."""
        changed_cards = []
        for card in self._cards:
            is_registered = card in self._bound and self._bound[card][0] == card.endpoint.bindings
            if not is_registered:
                changed_cards.append(card)
        for card in changed_cards:
            if card in self._bound:
                self._selector.unregister(self._bound[card][1])
        for card in changed_cards:
            descriptor = card.endpoint.fileno()
            self._selector.register(descriptor, selectors.EVENT_READ)
            self._bound[card] = (card.endpoint.bindings, descriptor)

    def _take_edges(self) -> bool:
        """Read the wires; return True if there were pulses."""
        rising: dict[int, list[int]] = {card.line: [] for card in self._cards}
        # The client may have buffered lines that were not read.
        self._unread = True
        for _ in range(EDGES_PER_TURN):
            message = self._wires.receive(0.0)
            if message is None:
                self._unread = False
                break
            if isinstance(message, WireMotion):
                self._track.add(message)
            elif message.value:
                self._take_edge(message, rising)
        for card in self._cards:
            if rising[card.line]:
                card.process_pulses(rising[card.line], self._track)
                self._next_read_s = self._clock_s() + GATHER_S
        return any(rising.values())

    def _take_edge(self, edge: WireEdge, rising: dict[int, list[int]]) -> None:
        """Note a rising edge: of the stage's trigger, or of a SYNC_IN line in `rising`."""
        if edge.line == self._trigger:
            self._trigger_ns = edge.t_ns
            self._track.trigger(edge.t_ns)
        elif edge.line in rising:
            self._pulse_ns = edge.t_ns
            rising[edge.line].append(edge.t_ns)

    def _send_data(self, card: SimulatedCard) -> float:
        """Send data and end the record in time; return the seconds until this card has more to do."""
        endpoint = card.endpoint
        # Seconds until more data may be sent; None: all is sent.
        wait = endpoint.flush()
        # Pulses that wait at the wires keep the record from ending.
        if wait is None and endpoint.due and not self._take_edges():
            card.tick(self.more_expected)
            wait = endpoint.flush()
        if wait is not None:
            return min(wait, IDLE_S)
        if card.card.deadline_s is None:
            return IDLE_S
        # A record's last packet is due `TAIL_S` of wire time after its data: look ten times in this time (chosen).
        look_s = 0.1 * TAIL_S / self._time_scale
        return min(IDLE_S, max(SHORTEST_LOOK_S, look_s))

    def _listen(self, is_needed: bool) -> None:
        """Start or stop reading the wires; unread edges stay in the socket and the hub."""
        if is_needed is not self._listening:
            self._listening = is_needed
            if is_needed:
                self._selector.register(self._wires, selectors.EVENT_READ)
            else:
                self._selector.unregister(self._wires)

    def close(self) -> None:
        """Close the selector, not the sockets."""
        self._selector.close()
