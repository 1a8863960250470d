"""The executor: one thread that processes commands, replies of the stage and bursts from one queue, in order.

It executes the host's commands and manages the run; machine.py controls stage and row. It waits for no storage: a
command that has to be journalled or replayed is answered by the journal's thread, test pulses when they have ended, and
what comes while a run begins or ends when it has; all others immediately. docs/spec/wire.md describes each command.

`Machine.handle_event` applies a state's rule for an event, if there is one; `Machine.command` does the same for a
command, and refuses it without a rule. Both name their event by a string, a key of machine.py's table of rules. What
the host receives are *events*, too: entries of the journal.
"""

from __future__ import annotations

import queue
import secrets
import threading
import time
import traceback
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import msgspec

from polysight_pi.edges import MIN_FEED
from polysight_pi.journal import Journal, JournalFullError, JournalThread, NewEvent
from polysight_pi.machine import Machine, RefusedError
from polysight_pi.stage import StageDriver, StageLost, StageNews
from polysight_pi.trigger import BurstSent, BurstSpec, LoopFault, TriggerLoop
from polysight_shared import __version__, messages as m
from polysight_shared.errors import PolysightError, convert_os_error
from polysight_shared.faults import PiFault, explain
from polysight_shared.raster import (
    MAX_WIDTH_NS,
    MIN_PERIOD_NS,
    MIN_PERIOD_US,
    MIN_WIDTH_NS,
    WIDTH_TEXT,
    Burst,
    Stage,
    check_burst_fits,
)
from polysight_shared.stage_line import Reply
from polysight_shared.units import us_to_ns

# Longest time for which one turn takes items from the queue; the rest waits for the next turn, so that a queue that
# never empties does not hang the thread. Chosen.
TURN_TIMEOUT_S = 0.2
# Longest wait for work in one turn of the loop; chosen.
TURN_S = 0.25
# Silence of the executor, the journal or a socket after which motion stops and the watchdog is not fed. An answer of
# the stage takes up to 2 s; writing to an SD card that tidies up takes about 1 s.
LATE_S = 3.0
# Time without a turn after which the executor counts as hung; chosen.
HUNG_S = 10.0
# Commands that wait or are executed; further ones are refused. Chosen: a host has one at a time.
COMMANDS_WAITING = 64
# Commands `Replay` that wait or are executed: their reply is large and comes from the disk; chosen.
REPLAYS_WAITING = 4
# Lines of the stage that wait; further ones are dropped, so that an endless flood cannot fill the memory; chosen.
LINES_WAITING = 64
# Events per reply. Chosen: about half a second on a Pi (estimated), well below the host's timeout of a command.
REPLAYED_AT_REST = 1000
# Events per reply during a row (chosen): packing more would delay the trigger thread.
REPLAYED_IN_A_ROW = 20
# Commands that count as a heartbeat of the run's host.
OF_THE_RUN = (m.BeginRun, m.RunRow, m.EndRun)
# Commands that only the run's owner may send.
OWNER_COMMANDS = (m.RunRow, m.EndRun, m.Hold, m.Resume, m.Abort)
# Commands that are accepted once their event is on the disk.
JOURNALLED_COMMANDS = (m.BeginRun, m.EndRun, m.RunRow)


class Request(NamedTuple):
    """A command that has to be answered exactly once."""

    command: m.AnyCommand
    # Sends the reply to the client.
    answer: Callable[[m.AnyReply], None]


def make_refusal(number: int, summary: str, cause: str = "", remedy: str = "") -> m.Refused:
    """Return a refusal with a PiFault number; missing texts are those of faults.py, long ones are cut."""
    table = explain(number)
    return m.Refused(
        number=int(number),
        problem=summary[:1000],
        cause=(cause or table.cause)[:1000],
        remedy=(remedy or table.remedy)[:1000],
    )


def refuse(error: PolysightError | OSError) -> m.Refused:
    """Return the refusal of a command that raised this error."""
    if isinstance(error, OSError):
        cause = "the operating system refused it"
        return make_refusal(PiFault.BAD_REQUEST, convert_os_error(error).what, cause, "check the Pi's disk")
    return make_refusal(getattr(error, "number", PiFault.BAD_REQUEST), error.what, error.why, error.remedy)


class Executor:
    """Executes commands in a thread of its own; the methods in the section "for other threads" may be called by all.

    In each turn of its loop the thread empties its queue, checks deadlines and sends replies. `turned` is called after
    every turn while no part is late, at rest about four times a second: it feeds the watchdog. `find_late` names a part
    of the program that does not answer, "" for none.
    """

    def __init__(
        self,
        stage: StageDriver,
        loop: TriggerLoop,
        journal: JournalThread,
        on_turn: Callable[[], None] = lambda: None,
        find_late: Callable[[], str] = lambda: "",
    ) -> None:
        self._loop = loop
        self.journal = journal
        self._turned = on_turn
        self._find_late = find_late
        # Secret that is accepted as the owner of every run, for a person at the Pi.
        self.take_over_key = secrets.token_hex(16)
        # Time of the end of the last turn.
        self._turned_s = time.monotonic()
        # Items that `_handle` takes, in order.
        self._inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._command_slots = threading.Semaphore(COMMANDS_WAITING)
        self._replay_slots = threading.Semaphore(REPLAYS_WAITING)
        self._machine = Machine(stage, loop, self.journal, self._inbox.put)
        # The active run.
        self._run: m.BeginRun | None = None
        # Index and take of the row that ended last, so that its repeated command is accepted.
        self._last_row: tuple[int, int] | None = None
        # Newest take (attempt) of each row of this scan, by the row's index.
        self._takes: dict[int, int] = {}
        # True while a run begins or ends, which the journal must confirm.
        self._waits_for_journal = False
        # Commands that wait until then.
        self._deferred: list[Request] = []
        # A `BeginRun` that waits for the abort of a lost host's row.
        self._after_row: Request | None = None
        # Replies to be sent at the end of the turn.
        self._replies: list[tuple[Request, m.AnyReply]] = []
        # `Pulse` commands whose burst is being sent.
        self._pulsing: list[Request] = []
        # True once the program is to end; commands are refused from then on.
        self._ending = False
        # True once the thread is to end.
        self._ended = False
        # The exception that ended the thread.
        self.crash: BaseException | None = None
        self._thread = threading.Thread(target=self._run_turns, name="executor", daemon=True)
        self._refresh_replies()

    # --- for other threads ------------------------------------------------------------------------------------------

    def post(self, item: StageNews | BurstSent | m.Pulsed | LoopFault | Callable[[], object]) -> None:
        """Append an item to the queue; return immediately. Replies of the stage are dropped if too many wait."""
        if isinstance(item, Reply) and self._inbox.qsize() > LINES_WAITING:
            # The end of a motion among them is requested again (`Machine._on_status`).
            return
        self._inbox.put(item)

    def submit(self, command: m.AnyCommand, answer: Callable[[m.AnyReply], None]) -> bool:
        """Queue a command whose reply is passed to `answer`. Return False, without queueing, if too many wait."""
        slots = self._replay_slots if isinstance(command, m.Replay) else self._command_slots
        if not slots.acquire(blocking=False):
            return False

        def release_and_answer(reply: m.AnyReply) -> None:
            slots.release()
            answer(reply)

        self._inbox.put(lambda: self._execute(Request(command, release_and_answer)))
        return True

    @property
    def unresponsive_s(self) -> float:
        """Time since the last turn; below :data:`HUNG_S` unless the executor hangs."""
        return time.monotonic() - self._turned_s

    def host_alive(self, scan_id: str, owner: str) -> m.Accepted | m.Refused:
        """Answer `Alive`, a heartbeat of the run's host or of a jog's. From any thread; does not wait for the executor.

        `scan_id` is "" for a jog outside of a run.
        """
        run = self._run
        has_jog = self._machine.note_jog_alive(owner)
        if not scan_id and has_jog:
            return self._accept()
        if run is None or run.scan_id != scan_id:
            return make_refusal(PiFault.NOT_READY, f"run {scan_id} has not begun", remedy="BeginRun")
        if run.owner != owner:
            return make_refusal(PiFault.NOT_OWNER, f"run {scan_id} belongs to another program")
        self._machine.note_host_alive()
        return self._accept()

    @property
    def status(self) -> m.StatusReply:
        """The reply to `Status`. From any thread."""
        scan_id, last_seq = self.journal.position
        return self._make_status(scan_id=scan_id, last_seq=last_seq)

    @property
    def hello(self) -> m.HelloReply:
        """The reply to `Hello`. From any thread."""
        scan_id, last_seq = self.journal.position
        return self._make_hello(scan_id=scan_id, last_seq=last_seq, t_unix_ns=time.time_ns())

    def start(self) -> None:
        """Start this thread and the journal's. The stage has to be connected."""
        self._refresh_replies()
        self.journal.start()
        self._thread.start()

    def stop(self, timeout_s: float) -> None:
        """Stop the stage, end the row as aborted, end the thread."""
        self.post(self._end)
        self._thread.join(timeout_s)

    # --- the thread -------------------------------------------------------------------------------------------------

    def _run_turns(self) -> None:
        """Run the thread: turn after turn until it is to end. An exception that ends it is kept in `crash`."""
        try:
            while not self._ended:
                self._turn()
        except BaseException as e:
            self.crash = e
            raise

    def _turn(self) -> None:
        """Wait for work, do what is in the queue, check deadlines and late parts, send replies, feed the watchdog."""
        try:
            self._handle(self._inbox.get(timeout=min(self._machine.seconds_left(), TURN_S)))
            until_s = time.monotonic() + TURN_TIMEOUT_S
            while time.monotonic() < until_s:
                self._handle(self._inbox.get_nowait())
        except queue.Empty:
            pass
        self._machine.check_deadlines()
        late_part = self._find_late()
        if late_part and self.unresponsive_s > LATE_S:
            # After a pause of the whole program, the first thread to wake finds the others late.
            late_part += (
                f"; this program did not run for {self.unresponsive_s:.1f} s: the computer was too busy "
                "or was suspended"
            )
        if late_part:
            self._machine.stop_motion(PiFault.PROGRAM_LATE, late_part)
        self._refresh_replies()
        self._send_replies()
        self._turned_s = time.monotonic()
        if not late_part:
            self._turned()

    def _send_replies(self) -> None:
        """Send the replies of this turn; those of journalled commands follow when their events are on the disk."""
        replies = self._replies
        self._replies = []
        replies_after_journal: list[tuple[Request, m.AnyReply]] = []
        for request, reply in replies:
            self._count_as_heartbeat(request.command)
            if isinstance(request.command, JOURNALLED_COMMANDS) and isinstance(reply, m.Accepted):
                replies_after_journal.append((request, reply))
            else:
                request.answer(reply)

        self._commit(replies_after_journal)

    def _commit(self, behind_journal: list[tuple[Request, m.AnyReply]]) -> None:
        """Have the events so far written, then these replies sent; they wait for a later turn while too much waits."""

        def answer(error: PolysightError | OSError | None) -> None:
            if error is not None:
                self._inbox.put(lambda: self._machine.handle_event("lasting fault", PiFault.JOURNAL_FULL, str(error)))
            for request, reply in behind_journal:
                if error is not None:
                    reply = refuse(error)
                request.answer(reply)

        has_work = bool(behind_journal) or self.journal.has_batch
        if has_work and not self.journal.commit(answer):
            self._replies += behind_journal

    def _count_as_heartbeat(self, command: m.AnyCommand) -> None:
        """Count a command of the run's host as its heartbeat: it sends no `Alive` while it waits for the reply."""
        run = self._run
        if run and isinstance(command, OF_THE_RUN) and (command.scan_id, command.owner) == (run.scan_id, run.owner):
            self._machine.note_host_alive()

    def _handle(self, item: Any) -> None:
        """Handle an item of the queue: a result of the trigger loop, a reply of the stage, or a function to call."""
        machine = self._machine
        row = machine.row
        if isinstance(item, BurstSent):
            machine.on_burst(item)
        elif isinstance(item, m.Pulsed):
            self._answer_pulses(item)
        elif isinstance(item, LoopFault):
            machine.on_loop_fault(item)
            self._answer_pulses(make_refusal(item.number, item.detail))
        elif isinstance(item, Reply):
            machine.on_stage(item)
        elif isinstance(item, StageLost):
            machine.handle_event("stage lost", PiFault.STAGE_LOST, item.reason)
        else:
            item()
        if row is not None and machine.row is not row:
            self._end_row((row.row.index, row.take))

    def _answer_pulses(self, reply: m.AnyReply) -> None:
        """Give this reply to all waiting `Pulse` commands."""
        self._replies += [(request, reply) for request in self._pulsing]
        self._pulsing.clear()

    # --- commands ---------------------------------------------------------------------------------------------------

    def _execute(self, request: Request) -> None:
        """Execute a command. Every error becomes a refusal; no message can end the program."""
        try:
            reply = self._on_command(request)
        except (PolysightError, OSError) as e:
            reply = refuse(e)
        except Exception as e:  # noqa: BLE001 - reported to the client and in the log
            traceback.print_exc()
            reply = make_refusal(PiFault.PROGRAM, f"{type(request.command).__name__}: {e!r}")
        # The command may have taken long: count it as a heartbeat before the deadlines are checked.
        self._count_as_heartbeat(request.command)
        if reply is not None:
            self._replies.append((request, reply))

    def _on_command(self, request: Request) -> m.AnyReply | None:
        """Return the reply, or None if it follows later."""
        command = request.command
        run = self._run
        if isinstance(command, m.Replay):
            return self._replay(request, command)
        if self._ending:
            raise RefusedError(PiFault.NOT_READY, "polysight-pi is ending", "SIGTERM or SIGINT", "start it again")
        if self._waits_for_journal and isinstance(command, (*JOURNALLED_COMMANDS, m.Pulse)):
            self._deferred.append(request)
            return None
        owned = isinstance(command, OWNER_COMMANDS)
        if run and isinstance(command, m.Home):
            # A run whose host is lost does not prevent homing; a host of an older release sends no owner.
            owned = run.owns_home and self._machine.host_lives
        if run and isinstance(command, m.Jog):
            owned = self._machine.host_lives
        jog = self._machine.jog
        if jog is not None and isinstance(command, m.Abort) and command.owner == jog.command.owner:
            # The client that started a jog may stop it, also in the run of a lost host.
            owned = False
        if run and owned and getattr(command, "owner", "") not in (run.owner, self.take_over_key):
            raise RefusedError(PiFault.NOT_OWNER, f"run {run.scan_id} belongs to another program")
        match command:
            case m.BeginRun():
                if self._postpone(request, command):
                    return None
                return self._begin(request, command)
            case m.EndRun():
                return self._end_run(request, command)
            case m.RunRow():
                return self._run_row(command)
            case m.Abort():
                return self._accept("Abort", command.reason or "requested by the host")
            case m.Jog():
                return self._jog(command)
            case m.Pulse():
                return self._pulse(request, command)
            case _:
                # The other commands are Home, Hold and Resume.
                return self._accept(type(command).__name__)

    def _replay(self, request: Request, command: m.Replay) -> None:
        """Have the journal's thread read events and answer with them.

        Raises RefusedError for the events of another scan while a row runs.
        """
        limit = min(command.limit, REPLAYED_AT_REST)
        if self._machine.row is not None:
            scan_id = self.journal.position[0]
            # The whole file of another scan would be read.
            if command.scan_id != scan_id:
                raise RefusedError(
                    PiFault.NOT_READY,
                    f"a row of scan {scan_id} runs",
                    "reading another scan's journal would delay its pulses",
                    "retry when the row has ended",
                )
            limit = min(limit, REPLAYED_IN_A_ROW)

        def read(journal: Journal) -> m.ReplayReply:
            packed, last_seq = journal.read(command.scan_id, command.from_seq, limit)
            return m.ReplayReply(events=[m.unpack_event(raw) for raw in packed], last_seq=last_seq)

        def answer(result: m.ReplayReply | PolysightError | OSError) -> None:
            if isinstance(result, m.ReplayReply):
                request.answer(result)
            else:
                request.answer(refuse(result))

        self.journal.call(read, answer)

    def _accept(self, event: str = "", *args: Any) -> m.Accepted:
        """Apply a command to the state machine ("": none) and return the new state. Raises RefusedError."""
        if event:
            self._machine.command(event, *args)
        return m.Accepted(state=self._machine.wire_state)

    def _jog(self, command: m.Jog) -> m.Accepted:
        """Start a jog, or accept one that was sent again."""
        machine = self._machine
        if machine.jog is not None and machine.jog.command == command:
            return self._accept()
        machine.require("Jog")
        stage = machine.stage.config
        check_jog(command, stage)
        place_mm = machine.find_place_mm(command.axis)
        steps_away = abs(round(place_mm * stage.steps_per_mm) - round(command.from_mm * stage.steps_per_mm))
        # It was executed already, and has moved the axis away from its start.
        if steps_away and command == machine.last_jog:
            return self._accept()
        _require(not steps_away, f"{command.axis} is at {place_mm:.3f} mm, not at {command.from_mm:.3f} mm")
        return self._accept("Jog", command)

    def _pulse(self, request: Request, command: m.Pulse) -> None:
        """Pass a burst to the trigger loop; the reply follows when it has been sent."""
        if self._run is not None:
            summary = f"run {self._run.scan_id} has begun"
            raise RefusedError(PiFault.NOT_READY, summary, "pulses would belong to no point", "wait for the scan's end")
        self._machine.require("Pulse")
        if not self._loop.alive:
            raise RefusedError(PiFault.TRIGGER_LINE_LOST, self._machine.reason or "the trigger loop has ended")
        spec = read_burst(command)
        if spec.pulses * spec.period_ns > m.MAX_PULSES_AT_REST_S * 1e9:
            summary = (
                f"{spec.pulses} pulses every {command.period_us:g} us last longer than {m.MAX_PULSES_AT_REST_S:g} s"
            )
            raise RefusedError(
                PiFault.NOT_READY, summary, "the lines are busy during this time", "ask for fewer pulses"
            )
        self._pulsing.append(request)
        self._loop.send(spec)

    def _postpone(self, request: Request, run: m.BeginRun) -> bool:
        """Check a run; if a row runs, abort it, keep the request for its end and return True. Raises RefusedError."""
        check_run(run, self._machine.stage.config)
        self._loop.check(read_burst(run))
        active = self._run
        replaces = active is not None and (run.scan_id, run.owner) != (active.scan_id, active.owner)
        if active is not None and replaces and self._machine.host_lives:
            raise RefusedError(
                PiFault.NOT_READY,
                f"run {active.scan_id} is active, and its host is alive",
                "another program, perhaps on another machine, scans with this Pi",
                "wait for that scan's end, or stop it there",
            )
        if self._machine.row is not None:
            # The host that started the row is lost, or begins its run again: nothing of the row is committed. An abort
            # never ends a row immediately; when it has ended, `_end_row` executes the request.
            self._after_row = request
            self._machine.handle_event("Abort", f"run {run.scan_id} began again")
        return self._machine.row is not None

    def _begin(self, request: Request, run: m.BeginRun) -> None:
        """Open the journal of the scan and begin the run; the reply follows when `RunStarted` is on the disk."""
        takes: dict[int, int] = {}

        def write(journal: Journal) -> None:
            resumed, missing_events = journal.open(run.scan_id, run.plan, run.last_seq)
            started = NewEvent.now(m.RunStarted, plan=run.plan, resumed=resumed, lost_events=missing_events)
            journal.write([started])
            takes.update(journal.takes)

        def accept_begin() -> m.Accepted:
            self._forget_run()
            self._run = run
            self._takes = takes
            return self._accept("BeginRun", run.heartbeat_ms)

        self._write_synced(request, write, accept_begin)

    def _forget_run(self) -> None:
        """End the active run; nothing is written to the journal, and no event is sent to the host."""
        self._run = None
        self._last_row = None
        self._takes = {}
        self._machine.handle_event("EndRun")

    def _end_run(self, request: Request, command: m.EndRun) -> m.Accepted | None:
        """End the run; the reply follows when `RunStopped` is on the disk. Accept a repeated request immediately."""
        if self._run is None and command.scan_id == self.journal.position[0]:
            # The host repeats a request that was already executed.
            return self._accept()
        self._require_run(command.scan_id)
        self._machine.require("EndRun")

        def write(journal: Journal) -> None:
            # Try to write again: the full disk may have space now.
            journal.broken = False
            journal.write([NewEvent.now(m.RunStopped, exit_status=command.exit_status, reason=command.reason)])

        def accept_end() -> m.Accepted:
            self._run = None
            return self._accept("EndRun")

        return self._write_synced(request, write, accept_end)

    def _write_synced(
        self, request: Request, write: Callable[[Journal], None], written: Callable[[], m.Accepted]
    ) -> None:
        """Write an event that has to be on the disk before its command is accepted; `written` then accepts it.

        Other commands that need the journal wait until then.
        """
        self._commit([])
        self._waits_for_journal = True

        def finish(error: PolysightError | OSError | None) -> None:
            """Accept or refuse the command, in the executor's thread, and execute those that have waited."""
            self._waits_for_journal = False
            # Any other error means that the journal was not opened.
            if isinstance(error, JournalFullError) and self.journal.is_broken:
                if isinstance(request.command, m.BeginRun):
                    self._forget_run()
                self._machine.handle_event("lasting fault", error.number, str(error))
            try:
                reply = written() if error is None else refuse(error)
            except PolysightError as e:
                reply = refuse(e)
            self._replies.append((request, reply))
            deferred = self._deferred
            self._deferred = []
            for waiting in deferred:
                self._execute(waiting)

        self.journal.call(write, lambda error: self._inbox.put(partial(finish, error)))

    def _require_run(self, scan_id: str) -> m.BeginRun:
        """Return the active run. Raises RefusedError if it is not that of this scan."""
        if self._run is None or self._run.scan_id != scan_id:
            active = "no run"
            if self._run is not None:
                active = f"run {self._run.scan_id}"
            summary = f"{active} is active, not {scan_id}"
            raise RefusedError(PiFault.NOT_READY, summary, "the Pi was restarted", "BeginRun")
        return self._run

    def _run_row(self, command: m.RunRow) -> m.Accepted:
        """Start a row, or accept a command that was sent again. Raises RefusedError, also for an old take."""
        run = self._require_run(command.scan_id)
        running = self._machine.row
        index = command.row_index
        repeated = running is not None and (index, command.take) == (running.row.index, running.take)
        if repeated or (index, command.take) == self._last_row:
            return self._accept()
        self._machine.require("RunRow")
        _require(index < run.plan.rows, f"row {index} is not in the plan of {run.plan.rows}")
        # A late copy of an old command must not move the stage.
        newest = self._takes.get(index, 0)
        if command.take <= newest:
            raise RefusedError(
                PiFault.BAD_REQUEST,
                f"take {command.take} of row {index} is not newer than take {newest}",
                "a late copy of an old command, or a program that does not know the scan's events",
                "request the scan's events (Replay), and continue counting from them",
            )
        accepted = self._accept("RunRow", run.plan.row(index), command.take, read_burst(run), run.speed_mm_s)
        self._takes[index] = command.take
        return accepted

    def _end_row(self, row: tuple[int, int]) -> None:
        """Note the end of a row (index, take), and execute the command that has waited for it."""
        self._last_row = row
        if self._after_row is not None:
            request = self._after_row
            self._after_row = None
            self._execute(request)
        self._ended = self._ending

    def _end(self) -> None:
        """Stop all motion because the program ends; the thread ends now, or after the current row."""
        self._ending = True
        self._ended = not self._machine.terminate()

    def _refresh_replies(self) -> None:
        """Update the replies to Hello and Status; they are replaced as a whole, so other threads may read them.

        Their `scan_id` and `last_seq` are those of the journal when they are sent.
        """
        machine = self._machine
        stage = machine.stage
        row_fields = {"row_index": -1, "take": 0, "points": 0, "pulses": 0}
        if (row := machine.row) is not None:
            counts = self._loop.counts
            row_fields = {
                "row_index": row.row.index, "take": row.take, "points": counts.bursts, "pulses": counts.pulses,
            }  # fmt: skip
        self._make_status = partial(
            m.StatusReply, state=machine.wire_state, homed=machine.homed, x_mm=stage.x_mm, y_mm=stage.y_mm,
            fault=machine.fault, reason=machine.reason, lost_x_mm=machine.lost_mm[0], lost_y_mm=machine.lost_mm[1],
            **row_fields,
        )  # fmt: skip
        self._make_hello = partial(
            m.HelloReply, pi_release=__version__, firmware=stage.firmware, backend=self._loop.backend,
            state=machine.wire_state, in_run=self._run is not None, stage=stage.config.placement_settings,
        )  # fmt: skip


# --- limits of this rig and the radars --------------------------------------------------------------------------------


def read_burst(command: m.BeginRun | m.Pulse) -> BurstSpec:
    """Return the requested burst. Raises RefusedError (PERIOD_TOO_SHORT, PULSE_TOO_LONG) if radars cannot accept it."""
    spec = BurstSpec(command.pulses, us_to_ns(command.period_us), us_to_ns(command.width_us))
    if spec.period_ns < MIN_PERIOD_NS:
        raise RefusedError(PiFault.PERIOD_TOO_SHORT, f"period of {command.period_us} us is below {MIN_PERIOD_US} us")
    if not MIN_WIDTH_NS <= spec.width_ns <= MAX_WIDTH_NS:
        raise RefusedError(PiFault.PULSE_TOO_LONG, f"pulse width of {command.width_us} us is outside {WIDTH_TEXT}")
    return spec


def check_run(run: m.BeginRun, stage: Stage) -> None:
    """Check that the radars accept a run's burst, and the stage its plan.

    Raises RefusedError or ConfigError with the conflicting values.
    """
    plan = run.plan
    read_burst(run)
    _require(plan.columns >= 1 and plan.rows >= 1, f"plan of {plan.columns} x {plan.rows} points is empty")
    _require(plan.step_x_mm > 0 and plan.step_y_mm > 0, "steps of the plan must be positive")
    fastest = max(stage.speed_mm_s, stage.travel_speed_mm_s)
    # MIN_FEED is in motor steps per second.
    slowest = MIN_FEED / stage.steps_per_mm
    _require(
        slowest <= run.speed_mm_s <= fastest,
        f"speed of {run.speed_mm_s} mm/s is outside {slowest:g}..{fastest} mm/s of this rig's [stage]",
    )
    steps = plan.step_x_mm * stage.steps_per_mm
    _require(
        abs(steps - round(steps)) < 1e-6 and round(steps) >= 1,
        f"step of {plan.step_x_mm} mm is {steps:g} motor steps: it must be a whole number",
    )
    stage_in_run = msgspec.structs.replace(stage, speed_mm_s=run.speed_mm_s)
    check_burst_fits(plan, Burst(run.pulses, run.period_us, run.width_us), stage_in_run)
    misfit = stage_in_run.misfit(plan)
    _require(not misfit, misfit)


def check_jog(jog: m.Jog, stage: Stage) -> None:
    """Check distance, speed and soft limits of a jog. Raises RefusedError with the conflicting values."""
    travel_mm = stage.travel_x_mm if jog.axis == "x" else stage.travel_y_mm
    end_mm = jog.from_mm + jog.distance_mm
    # In motor steps: 0.3 mm - 3 * 0.1 mm is not exactly 0.
    end_steps = round(end_mm * stage.steps_per_mm)
    is_inside = 0 <= end_steps <= round(travel_mm * stage.steps_per_mm)
    _require(round(jog.distance_mm * stage.steps_per_mm) != 0, f"{jog.distance_mm} mm is less than one motor step")
    _require(is_inside, f"{jog.axis} would end at {end_mm:g} mm, outside 0..{travel_mm:g} mm")
    slowest = MIN_FEED / stage.steps_per_mm
    _require(
        slowest <= jog.speed_mm_s <= stage.travel_speed_mm_s,
        f"speed of {jog.speed_mm_s} mm/s is outside {slowest:g}..{stage.travel_speed_mm_s} mm/s",
    )
    seconds = abs(jog.distance_mm) / jog.speed_mm_s
    _require(seconds <= m.MAX_JOG_S, f"the jog would last {seconds:.0f} s, longer than {m.MAX_JOG_S:g} s")


def _require(ok: bool, summary: str) -> None:
    if not ok:
        raise RefusedError(PiFault.BAD_REQUEST, summary)
