"""A fake Pi that only speaks the wire protocol, and fake capture cards, on a loopback network of their own.

When the host lets the Pi run a row, the Pi lets the cards send the row's data, and publishes the row's events.
"""

import threading
import time
from dataclasses import dataclass, field

import zmq

from polysight_shared import messages as m
from polysight_shared.config import Instrument
from polysight_shared.faults import PiFault
from polysight_shared.raster import Row
from polysight_simulators.loopback import move_to_free_subnet
from tests.support.acquisition.fake_cards import FakeCard
from tests.support.processes import HANG_S
from tests.support.rigs import make_rig_with

# The Pi's clock minus the host's
PI_AHEAD_NS = 77_000_000_000
# After these faults the Pi stays in the state `fault` until the next homing. Those of the second line do not concern
# the stage, so that its position is known and it counts as homed.
STAGE_FAULTS = (PiFault.STAGE_LOST, PiFault.STAGE_ALARM)
FAULTS_AT_A_KNOWN_POSITION = (PiFault.TRIGGER_LINE_LOST, PiFault.JOURNAL_FULL)
# Time between heartbeats
HEARTBEAT_MS = 50
# Events in one reply to Replay: fewer than the host requests, as in a reply of the Pi while a row runs.
MAX_REPLAYED_EVENTS = 3
# In rows that are sent frame by frame: the time between bursts, the time between the pulses of a burst, and the time
# from a pulse until its frame arrives.
BURST_PERIOD_NS = 60_000_000
PULSE_PERIOD_NS = 1_500_000
ARRIVAL_DELAY_NS = 100_000


class FakePi:
    """A Pi that speaks only the wire protocol; a row makes every card send its data."""

    def __init__(self, rig: Instrument, cards: list[FakeCard]) -> None:
        self.rig = rig
        self.cards = cards
        # Events of every scan, by its name.
        self.journal: dict[str, list[m.AnyEvent]] = {}
        # The stage's settings in the reply to Hello; older releases of the Pi send {}.
        self.placement_settings = rig.stage.placement_settings
        self.homed = False
        self.run: m.BeginRun | None = None
        self.state: m.State = "idle"
        # Homings so far, and the numbers (from 1) of those that fail.
        self.homings = 0
        self.failing_homings: set[int] = set()
        # Steps that the motors lost since the last homing, as StatusReply reports them: x and y, mm.
        self.lost_steps_mm = (0.0, 0.0)
        # Number of events that PUB is still to lose.
        self.lose_events = 0
        # Number of replies still to be lost, and of those lost so far.
        self.lose_replies = 0
        self.replies_lost = 0
        # Fault with which a row ends, by (row, take).
        self.fail_rows: dict[tuple[int, int], int] = {}
        # The fault that StatusReply reports, 0: none, and its reason.
        self.fault = 0
        self.latched_reason = ""
        # Rows that hang: they send half of their data, and do not end.
        self.hang_at: set[int] = set()
        # A hanging row sends the events of its bursts first.
        self.hang_after_captures = False
        # The stage is held in a hanging row.
        self.hang_held = False
        # Set by tests: the hanging row is to end.
        self.end_hanging_row = False
        # Frames are sent one by one, and the times of their pulses are those of a real row.
        self.send_frame_by_frame = False
        # Reason in RowFinished of a completed row, by (row, take).
        self.notes: dict[tuple[int, int], str] = {}
        self.commands: list[m.AnyCommand] = []
        self.rows_run: list[tuple[int, int]] = []
        # Rows (row, take) that ran since the last BeginRun.
        self._ran: set[tuple[int, int]] = set()
        self.hanging: tuple[Row, int] | None = None
        self.context = zmq.Context()
        # Unlike a REP socket, a ROUTER socket may leave a request without a reply.
        self.rep = self.context.socket(zmq.ROUTER)
        self.rep.bind(rig.pi.command_address)
        self.pub = self.context.socket(zmq.PUB)
        self.pub.bind(rig.pi.event_address)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        """Answer commands, and send a heartbeat every `HEARTBEAT_MS`."""
        last_heartbeat_s = 0.0
        while not self._stop.is_set():
            if self.rep.poll(10):
                *envelope, raw = self.rep.recv_multipart()
                command = m.unpack_command(raw)
                reply = self._answer(command)
                if not isinstance(command, m.Alive):
                    self.commands.append(command)
                if self.lose_replies and not isinstance(command, m.Alive):
                    self.lose_replies -= 1
                    self.replies_lost += 1
                else:
                    self.rep.send_multipart([*envelope, m.pack(reply)])
                self._finish_command()
            if self.end_hanging_row and self.hanging is not None:
                self.end_hanging_row = False
                self._finish_hanging()
            if time.monotonic() - last_heartbeat_s > HEARTBEAT_MS / 1e3:
                last_heartbeat_s = time.monotonic()
                scan = self._scan_id()
                last_seq = len(self.journal.get(scan, []))
                beat = m.Heartbeat(scan_id=scan, seq=last_seq, t_mono_ns=1, state=self.state, period_ms=HEARTBEAT_MS)
                self.pub.send_multipart([b"event", m.pack(beat)])
        self.rep.close(linger=0)
        self.pub.close(linger=0)
        self.context.term()

    def _scan_id(self) -> str:
        # A test may set `self.run` to None between the two uses.
        run = self.run
        return run.scan_id if run else ""

    def _emit(self, kind: type, **content: object) -> None:
        """Journal an event of the current run and publish it, unless it is to be lost."""
        assert self.run is not None
        events = self.journal.setdefault(self.run.scan_id, [])
        event = kind(scan_id=self.run.scan_id, seq=len(events) + 1, t_mono_ns=time.monotonic_ns(), **content)
        events.append(event)
        if self.lose_events:
            self.lose_events -= 1
            return
        self.pub.send_multipart([b"event", m.pack(event)])

    def _answer(self, command: m.AnyCommand) -> m.AnyReply:
        """Return the reply to a command; a row that it starts is left to `_finish_command`."""
        self._todo = None
        scan = self._scan_id()
        last = len(self.journal.get(scan, []))
        if isinstance(command, m.Hello):
            return m.HelloReply(
                pi_release="t", firmware="t", backend="fake", state=self.state, scan_id=scan, last_seq=last,
                stage=self.placement_settings,
            )  # fmt: skip
        if isinstance(command, m.Status):
            return m.StatusReply(
                state=self.state, homed=self.homed, x_mm=0, y_mm=0, scan_id=scan, row_index=-1, take=0, points=0,
                pulses=0, last_seq=last, fault=self.fault, reason=self.latched_reason, lost_x_mm=self.lost_steps_mm[0],
                lost_y_mm=self.lost_steps_mm[1],
            )  # fmt: skip
        if isinstance(command, m.EndRun) and (self.hanging is not None or self.run is None):
            problem = "a row is running" if self.run else "no run is begun"
            return m.Refused(number=PiFault.NOT_READY, problem=problem)
        if isinstance(command, m.BeginRun):
            self.run = command
            self._ran = set()
            self._emit(m.RunStarted, plan=command.plan, resumed=bool(self.journal.get(command.scan_id)))
        elif isinstance(command, m.EndRun):
            self._emit(m.RunStopped, exit_status=command.exit_status, reason=command.reason)
        elif isinstance(command, m.Home):
            self.homed = True
            self.state = "ready"
            self.fault = 0
            self.latched_reason = ""
            self.homings += 1
            if self.homings in self.failing_homings:
                self.homed = False
                self.state = "fault"
                self.fault = PiFault.STAGE_ALARM
                self.latched_reason = "the switch was not found"
        elif isinstance(command, m.Replay):
            events = self.journal.get(command.scan_id, [])
            # Sequence numbers count from 1.
            first = command.from_seq - 1
            count = min(command.limit, MAX_REPLAYED_EVENTS)
            return m.ReplayReply(events=events[first : first + count], last_seq=len(events))
        elif isinstance(command, m.RunRow):
            # A repeated request runs no row again.
            if (command.row_index, command.take) not in self._ran:
                self._ran.add((command.row_index, command.take))
                self.rows_run.append((command.row_index, command.take))
                self._todo = command
        elif isinstance(command, m.Abort) and self.hanging is not None:
            row, take = self.hanging
            self.hanging = None
            self._emit(
                m.RowFinished, row_index=row.index, take=take, status="aborted", points=0, edges=0, bursts=0, pulses=0,
                fault=PiFault.ABORTED, reason=command.reason,
            )  # fmt: skip
        return m.Accepted(state=self.state)

    def _finish_command(self) -> None:
        """Run the row that the last command has started: its events, and the data of all cards."""
        command = self._todo
        if command is None or self.run is None:
            return
        row = self.run.plan.row(command.row_index)
        self._emit(m.RowStarted, row=row, take=command.take)
        if command.row_index in self.hang_at:
            if self.hang_held:
                self.state = "held"
            self.hanging = (row, command.take)
            for card in self.cards:
                card.missing_end_bytes[row.index, command.take] = card.row_bytes // 2
                card.send_row(row.index, command.take)
            if self.hang_after_captures:
                self._send_captures(row, command.take)
            return
        if self.send_frame_by_frame:
            self._send_frames(row, command.take)
        else:
            self._send_captures(row, command.take)
            for card in self.cards:
                card.send_row(row.index, command.take)
        fault = self.fail_rows.get((command.row_index, command.take), 0)
        if fault in STAGE_FAULTS or fault in FAULTS_AT_A_KNOWN_POSITION:
            self.fault = fault
            self.state = "fault"
            self.homed = fault in FAULTS_AT_A_KNOWN_POSITION
        n = row.points
        note = self.notes.get((command.row_index, command.take), "")
        self._emit(
            m.RowFinished, row_index=row.index, take=command.take, status="fault" if fault else "done", points=n,
            edges=n, bursts=n, pulses=n * self.run.pulses, fault=fault, reason=note,
        )  # fmt: skip

    def _send_captures(self, row: Row, take: int) -> None:
        """Send the events of all bursts of a row; times and widths in them are placeholders."""
        assert self.run is not None
        for i in range(row.points):
            self._emit(
                m.Capture, row_index=row.index, take=take, point=i, column=row.column(i), edge_ns=i, first_pulse_ns=i,
                last_pulse_ns=i, pulses=self.run.pulses, width_max_ns=1, jitter_ns=1,
            )  # fmt: skip

    def _send_frames(self, row: Row, take: int) -> None:
        """Send all frames at once, with the times of a row that ends now; events have the time of the Pi's clock."""
        assert self.run is not None
        n = self.run.pulses
        begin_ns = time.monotonic_ns() - row.points * BURST_PERIOD_NS
        for point in range(row.points):
            burst_ns = begin_ns + point * BURST_PERIOD_NS
            pulses = [burst_ns + k * PULSE_PERIOD_NS for k in range(n)]
            for k, pulse_ns in enumerate(pulses):
                for card in self.cards:
                    card.send_frame(
                        row=row.index,
                        take=take,
                        slot=point * n + k,
                        frame_bytes=self.rig.frame_bytes,
                        arrival_ns=pulse_ns + ARRIVAL_DELAY_NS,
                    )
            first = pulses[0] + PI_AHEAD_NS
            self._emit(
                m.Capture, row_index=row.index, take=take, point=point, column=row.column(point), edge_ns=first,
                first_pulse_ns=first, last_pulse_ns=pulses[-1] + PI_AHEAD_NS, pulses=n, width_max_ns=1, jitter_ns=1,
            )  # fmt: skip
        for card in self.cards:
            card.end_frames()

    def _finish_hanging(self) -> None:
        """End the hanging row as done; the stage is not held any more."""
        assert self.hanging is not None
        row, take = self.hanging
        n = row.points
        self._emit(
            m.RowFinished, row_index=row.index, take=take, status="done", points=n, edges=n, bursts=n,
            pulses=n * self.rig.burst.pulses,
        )  # fmt: skip
        self.state = "ready"
        self.hanging = None

    def close(self) -> None:
        self._stop.set()
        self._thread.join()


@dataclass
class FakeRig:
    """The fake Pi and a fake card of each recorded board, once started."""

    instrument: Instrument
    cards: dict[str, FakeCard] = field(default_factory=dict)
    pi: FakePi | None = None

    def start(self) -> None:
        for board in self.instrument.recorded:
            self.cards[board.name] = FakeCard(board, self.instrument.row_bytes)
        self.start_pi()

    def start_pi(self) -> None:
        """Start the Pi, or a new one with the journal of the one before."""
        journal = self.pi.journal if self.pi else {}
        self.pi = FakePi(self.instrument, list(self.cards.values()))
        self.pi.journal = journal

    def close(self) -> None:
        for card in self.cards.values():
            card.close()
        if self.pi is not None:
            self.pi.close()


def make_small_instrument(columns: int = 3, rows: int = 4, pulses: int = 3, **limits: float) -> Instrument:
    """The published rig with a small grid and few pulses, on a free loopback subnet.

    Each of the three attempts of a command waits for its reply as long as `HANG_S`. Other limits are short, the receive
    buffer is small, and no free space is needed on the disk.
    """
    limits = {"end_of_record_s": 0.25, "command_timeout_s": 3 * HANG_S, "free_disk_bytes": 0, **limits}
    card = {"receive_buffer_bytes": 1 << 20}
    grid = {"columns": columns, "rows": rows}
    return move_to_free_subnet(make_rig_with(grid=grid, burst={"pulses": pulses}, limits=limits, card=card))
