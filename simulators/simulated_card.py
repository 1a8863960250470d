"""One board of a simulated rig: its radar's SYNC_IN and its DCA1000, with what goes wrong in them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby

from polysight.shared.config import Board, Instrument
from polysight.simulators.card_endpoint import CardEndpoint, Clock
from polysight.simulators.card_faults import Faults
from polysight.simulators.card_sender import Pace
from polysight.simulators.dca1000 import TAIL_S, Card, Code, Network, message
from polysight.simulators.fault_draws import EventKind, OverflowFaults, PulseEvents, PulseFaults
from polysight.simulators.pattern import SignalSource
from polysight.simulators.radar_board import RadarBoard
from polysight.simulators.sync_in import RECOVERY_US, Pulse, StageTrack, SyncInput, sync_line

FRAMES_PER_CALL = 64  # bounds memory
MAC = b"\x12\x34\x56\x78\x90\x12"


def _runs(pulses: list[Pulse]) -> Iterator[list[Pulse]]:
    """Runs of consecutive numbers, of at most FRAMES_PER_CALL."""
    first = 0
    for i in range(1, len(pulses) + 1):
        if i == len(pulses) or i - first == FRAMES_PER_CALL or pulses[i].number != pulses[i - 1].number + 1:
            yield pulses[first:i]
            first = i


class SimulatedCard:
    """One board: its radar, its DCA1000.

    Raises
    ------
    DeviceError
        when the card's addresses cannot be taken.
    """

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
        self.line = sync_line(rig, board)
        self._source = source
        self._clock_s = clock_s
        network = Network(board.host_address, board.card_address, MAC, board.command_port, board.data_port)
        self.endpoint = CardEndpoint(board.name, network, faults, seed, time_scale, clock_s, pace)
        dead_s = (rig.chirp.ramp_end_us + RECOVERY_US) * 1e-6  # pulses at a time scale are less regular than real ones
        native = rig.radar.control == "native"
        self.radar = RadarBoard(clock_s, dead_s=dead_s, fault_pulses=faults.radar_fault_pulses) if native else None
        self._sync = SyncInput(rig, self.radar)
        self._events = PulseEvents(faults)
        self._pulse_faults = PulseFaults(faults, seed, board.name)
        self._overflow = OverflowFaults(faults, seed, board.name)
        self._down_ns = (0, 0)  # the link is down from .. to, in the wire time of the pulses
        self._last_pulse_ns = 0
        self._pulses = 0
        self.last_data_wall_s = 0.0

    def rearm(self) -> None:
        """Its control server has told the radar to wait for the pulses of a row."""
        self._sync.arm()

    @property
    def card(self) -> Card:
        """Its DCA1000."""
        return self.endpoint.card

    def pulses(self, rising_ns: list[int], track: StageTrack) -> None:
        """SYNC_IN rose at these wire times."""
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
        x_mm, y_mm = track.offsets_mm([p.t_ns for p in run])
        frames = self._source.chirps(self.board.name, x_mm, y_mm, run[0].number)
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
        """Everything counted so far: what really happened, for comparison with what a host found out."""
        radar = {"pulses": self._pulses, "too_soon": self._sync.too_soon, "missed": self._pulse_faults.missed}
        radar |= {"rearmed": self._sync.rearmed, "unarmed": self._sync.unarmed}
        return {"frames": 0, **radar, **self.endpoint.report()}

    def close(self) -> None:
        """Close the sockets."""
        self.endpoint.close()
