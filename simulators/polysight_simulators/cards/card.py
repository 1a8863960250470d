"""One board of a simulated rig: its radar's SYNC_IN, its DCA1000 on the network, and their faults.

:class:`CardEndpoint` is the card alone: state machine, sockets, and the faults between card and host.
:class:`SimulatedCard` connects it to a radar that turns SYNC_IN pulses into frames.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

from polysight_shared.config import Board, Instrument
from polysight_shared.errors import PolysightError
from polysight_simulators.cards.dca1000 import (
    SOURCE_PORT,
    TAIL_S,
    Card,
    Code,
    Message,
    Network,
    Output,
    Packets,
    message,
    parse_request,
)
from polysight_simulators.cards.fault_draws import (
    CommandFaults,
    EventKind,
    NetworkFaults,
    OverflowFaults,
    PulseEvents,
    PulseFaults,
)
from polysight_simulators.cards.sender import CardSender, Pace, bound_udp
from polysight_simulators.cards.sync_in import RECOVERY_US, Pulse, StageTrack, SyncInput
from polysight_simulators.faults import Faults
from polysight_simulators.radars import RadarBoard

NO_DATA_FLOOR_S = 10.0  # wall time: with a large time scale the card's 30 s would end before the stage has moved
if TYPE_CHECKING:
    from polysight_simulators.scene import SignalSource

FRAMES_PER_CALL = 64  # bounds memory
MAC = b"\x12\x34\x56\x78\x90\x12"
Clock = Callable[[], float]


class CardEndpoint:
    """One card with its sockets.

    Parameters
    ----------
    name
        Name of the board, which also seeds the faults' random numbers.
    network
        Addresses in its EEPROM.
    time_scale
        Wire time over wall time.
    clock_s
        Wall clock.
    lanes
        LVDS lanes of the radar; None fits every configuration.

    Raises
    ------
    DeviceError
        if the card's addresses cannot be bound.
    """

    def __init__(
        self,
        name: str,
        network: Network,
        faults: Faults,
        seed: int,
        time_scale: float,
        clock_s: Clock,
        pace: Pace,
        lanes: int | None = 4,
    ) -> None:
        self.name = name
        self.counts: Counter[str] = Counter()
        self.card = Card(
            network,
            faults.first_sequence,
            faults.first_byte_count,
            no_data_floor_s=NO_DATA_FLOOR_S * time_scale,
            stop_discards=faults.stop_discards,
            lanes=lanes,
        )
        self._faults = faults
        self._time_scale = time_scale
        self._clock_s = clock_s
        self._pace = pace
        self._network_faults = NetworkFaults(faults, seed, name, self.counts)
        self._command_faults = CommandFaults(faults, seed, name, self.counts)
        self._deaf_until_s = self._link_up_s = float("-inf")
        self.bindings = 0
        self._bind(network)

    def _bind(self, network: Network) -> None:
        self._commands = bound_udp(network.card_address, network.command_port)
        self._commands.setblocking(False)
        try:
            self.sender = CardSender(
                (network.card_address, SOURCE_PORT),
                (network.host_address, network.command_port),
                (network.host_address, network.data_port),
                self._pace,
            )
        except PolysightError:
            self._commands.close()
            raise
        self.bindings += 1

    def fileno(self) -> int:
        """Return the command socket, for select; it changes when `bindings` grows."""
        return self._commands.fileno()

    def wire_s(self) -> float:
        """Return the present wire time."""
        return self._clock_s() * self._time_scale

    def power_cycle(self) -> None:
        """Switch the card off and on, which activates the addresses in its EEPROM.

        Raises DeviceError if those are not addresses of this machine.
        """
        before = self.card.network
        self.card.power_cycle()
        self.counts["power_cycles"] += 1
        self._deaf_until_s = self._clock_s() + self._faults.boot_s / self._time_scale
        if self.card.network != before:
            self.sender.send_now()
            self._keep_sender_counts()
            self.close()
            self._bind(self.card.network)

    def reset(self) -> None:
        """Reset the FPGA, as command 0x01 does, without a command."""
        self.counts["resets"] += 1
        self.card.reset_fpga()

    def take_link_down(self, seconds: float) -> None:
        """Neither receive nor send for this time (wire time)."""
        self.counts["link_downs"] += 1
        self._link_up_s = self._clock_s() + seconds / self._time_scale

    @property
    def link_is_down(self) -> bool:
        """True if requests cannot reach the card now."""
        return self._clock_s() < self._link_up_s

    def serve_commands(self) -> None:
        """Answer pending requests."""
        while True:
            try:
                datagram = self._commands.recv(2048)
            except BlockingIOError:
                return
            self._serve(datagram)

    def _serve(self, datagram: bytes) -> None:
        request = parse_request(datagram)
        if request is None:
            self.counts["not_requests"] += 1
            return
        self.counts["requests"] += 1
        if self._clock_s() < self._deaf_until_s or self.link_is_down:
            self.counts["requests_unheard"] += 1
            return
        if not self._command_faults.heard():
            return
        code = request[0]
        refused = self._command_faults.refused(code)
        reply, *more = [message(code, 1)] if refused else self.card.command(datagram, self.wire_s())
        if code == Code.CONFIGURE_FPGA:
            self._deaf_until_s = self._clock_s() + self._faults.deaf_ms * 1e-3
        if bits := self._command_faults.status_after(code):
            more.append(message(Code.STATUS, bits))
        if isinstance(reply, Message) and self._command_faults.reply_arrives():
            self.counts["replies"] += 1
            delay_s = self._faults.reply_delay_ms * 1e-3
            self.sender.reply(reply.payload, self._clock_s() + delay_s if delay_s else None)
        self.emit(more)

    def emit(self, outputs: Sequence[Output], link_is_up: bool = True) -> None:
        """Send the card's output through the faults of the network."""
        for output in outputs:
            if isinstance(output, Message):
                if not self.card.recording:
                    for rows in self._network_faults.drain():
                        self.sender.put_packets(rows)
                if link_is_up:
                    self.counts["statuses"] += 1
                    self.sender.put_status(output.payload)
                else:
                    self.counts["link_down_statuses"] += 1
            else:
                self._emit_packets(output, link_is_up)

    def _emit_packets(self, packets: Packets, link_is_up: bool) -> None:
        n, payload_bytes = len(packets.rows), packets.payload_bytes
        self.counts["packets_made"] += n
        self.counts["bytes_made"] += payload_bytes
        if link_is_up:
            for rows in self._network_faults.carry(packets.rows):
                self.sender.put_packets(rows)
        else:
            self._network_faults.skip(packets.rows)
            self.counts["link_down_packets"] += n
            self.counts["link_down_bytes"] += payload_bytes

    @property
    def due(self) -> bool:
        """True if the record's deadline has passed, unless more data is pending."""
        deadline_s = self.card.deadline_s
        return deadline_s is not None and self.wire_s() >= deadline_s

    def tick(self, link_is_up: bool = True) -> None:
        """End the record if its deadline has passed."""
        self.emit(self.card.tick(self.wire_s()), link_is_up)

    def flush(self) -> float | None:
        """Send data that is due; return the seconds until more is due, None if all is sent."""
        return self.sender.flush(self._clock_s, self.card.packet_delay_s / self._time_scale)

    def _keep_sender_counts(self) -> None:
        for key, value in self.sender.counts().items():
            self.counts[key] += value

    def report(self) -> dict[str, int | None]:
        """Return all counts."""
        report: dict[str, int | None] = dict(self.counts)
        for key, value in self.sender.counts().items():
            report[key] = self.counts[key] + value
        report["records"] = self.card.records
        report["dropped_by_receiver"] = self.sender.dropped_by_receiver()
        return report

    def close(self) -> None:
        """Close the sockets."""
        self._commands.close()
        self.sender.close()


def _runs(pulses: list[Pulse]) -> Iterator[list[Pulse]]:
    """Yield runs of consecutive pulse numbers, at most FRAMES_PER_CALL long."""
    first = 0
    for i in range(1, len(pulses) + 1):
        if i == len(pulses) or i - first == FRAMES_PER_CALL or pulses[i].number != pulses[i - 1].number + 1:
            yield pulses[first:i]
            first = i


class SimulatedCard:
    """One board with its radar and its DCA1000. Raises DeviceError if the card's addresses cannot be bound."""

    def __init__(
        self,
        rig: Instrument,
        board: Board,
        source: SignalSource,
        faults: Faults,
        seed: int,
        time_scale: float,
        clock_s: Clock,
        pace: Pace = Pace(),  # noqa: B008 - immutable
    ) -> None:
        self.board = board
        self.line = rig.pi.sync_out[0]
        self._source = source
        self._clock_s = clock_s
        network = Network(board.host_address, board.card_address, MAC, board.command_port, board.data_port)
        self.endpoint = CardEndpoint(board.name, network, faults, seed, time_scale, clock_s, pace)
        self._burst = rig.burst
        later_us = (rig.burst.chirps - 1) * rig.burst.chirp_us
        dead_s = (later_us + rig.chirp.ramp_end_us + RECOVERY_US) * 1e-6
        native = rig.radar.control == "native"
        die = 1 + [b.name for b in rig.boards].index(board.name)
        self.radar = (
            RadarBoard(clock_s, dead_s=dead_s, fault_pulses=faults.radar_fault_pulses, die=die) if native else None
        )
        self._sync = SyncInput(rig, self.radar)
        self._events = PulseEvents(faults)
        self._pulse_faults = PulseFaults(faults, seed, board.name)
        self._overflow = OverflowFaults(faults, seed, board.name)
        self._down_ns = (0, 0)  # start and end of the link's outage, wire time
        self._last_pulse_ns = 0
        self._pulses = 0
        self.last_data_wall_s = 0.0

    def rearm(self) -> None:
        """Arm the radar for the pulses of a row, as its control server does."""
        self._sync.arm()

    @property
    def card(self) -> Card:
        """Its DCA1000."""
        return self.endpoint.card

    def pulses(self, rising_ns: list[int], track: StageTrack) -> None:
        """Process rising edges of SYNC_IN at these wire times."""
        pulses = [Pulse(self._pulses + i, t) for i, t in enumerate(rising_ns)]
        self._pulses += len(pulses)
        for part in self._events.parts(pulses):
            for kind, value in self._events.before(part[0]):
                self._happen(kind, value, part[0])
            self._frames(self._sync.frames(self._pulse_faults.seen(part)), track)
            self._last_pulse_ns = part[-1].t_ns
        self.last_data_wall_s = self._clock_s()

    def _happen(self, kind: EventKind, value: float, pulse: Pulse) -> None:
        if kind is EventKind.LINK_DOWN:
            self._down_ns = (pulse.t_ns, pulse.t_ns + round(value * 1e9))
            self.endpoint.take_link_down(value)
        elif kind is EventKind.STATUS:
            self.endpoint.emit([message(Code.STATUS, 1 << int(value))], self._link_is_up(pulse.t_ns))
        elif kind is EventKind.END:
            outputs = self.card.end_record()
            self.endpoint.counts["records_ended_early"] += bool(outputs)
            self.endpoint.emit(outputs, self._link_is_up(pulse.t_ns))
        elif kind is EventKind.RESET:
            self.endpoint.reset()
        else:
            self.endpoint.power_cycle()

    def _link_is_up(self, t_ns: int) -> bool:
        return not self._down_ns[0] <= t_ns < self._down_ns[1]

    def _frames(self, started: list[Pulse], track: StageTrack) -> None:
        if not self.card.recording:
            self.endpoint.counts["frames_not_recorded"] += len(started)
            return
        for link_is_up, group in groupby(started, key=lambda p: self._link_is_up(p.t_ns)):
            for run in _runs(track.places(list(group))):
                self._run(run, track, link_is_up)

    def _run(self, run: list[Pulse], track: StageTrack, link_is_up: bool) -> None:
        counts = self.endpoint.counts
        burst = self._burst
        x_mm, y_mm = track.offsets_mm(
            [p.t_ns + round(n * burst.chirp_us * 1e3) for p in run for n in range(burst.chirps)]
        )
        chirps = self._source.chirps(self.board.name, x_mm, y_mm, run[0].number * burst.chirps)
        frames = chirps.reshape(len(run), -1, *chirps.shape[2:])
        counts["frames"] += len(frames)
        for lvds in self._overflow.split(frames):
            self.endpoint.emit(self.card.lvds(lvds.data, self.endpoint.wire_s()), link_is_up)
            if lvds.status is not None:
                counts["overflows"] += 1
                counts["overflow_bytes"] += lvds.lost_bytes
                self.endpoint.emit(self.card.overflow(lvds.status), link_is_up)

    def tick(self, more_expected: bool) -> None:
        """End the record when its time has come.

        At many times real time 2 s are over in an instant, and a process that gets no CPU for that instant must not end
        the record: while the stage moves, or has raised triggers that no pulse has followed yet, 2 s of wall time are
        waited for. In real time both are the same.
        """
        if more_expected and self._clock_s() - self.last_data_wall_s < TAIL_S:
            return
        self.endpoint.tick(self._link_is_up(self._last_pulse_ns + round(TAIL_S * 1e9)))

    def report(self) -> dict[str, int | None]:
        """Return all counts, for comparison with those of a host."""
        radar = {"pulses": self._pulses, "too_soon": self._sync.too_soon, "missed": self._pulse_faults.missed}
        radar |= {"rearmed": self._sync.rearmed, "unarmed": self._sync.unarmed}
        return {"frames": 0, **radar, **self.endpoint.report()}

    def close(self) -> None:
        """Close the sockets."""
        self.endpoint.close()
