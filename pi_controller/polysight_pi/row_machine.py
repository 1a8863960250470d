"""The actions of the state machine (machine.py) on stage, trigger loop and the running row.

The first fault is kept until the next `Home` or row. All methods run in the executor's thread.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from polysight_pi.bursts import BurstSpec
from polysight_pi.journal import Journal
from polysight_pi.machine import END_TIMEOUT_S, Machine, RefusedError
from polysight_pi.stage import MAX_MM, StageDriver
from polysight_pi.stage_link import StageLostError, StageRefusedError
from polysight_pi.trigger import BurstSent, Counts, Job, LoopFault, TriggerLoop, TriggerWatch
from polysight_shared import messages as m
from polysight_shared.errors import ProtocolError
from polysight_shared.faults import PiFault, StageError, explain
from polysight_shared.raster import Row, Stage
from polysight_shared.stage_line import HOMING_TIMEOUT_S, Immediate, Reply

STATUS_EVENT_S = 0.24
RESTS = 3  # consecutive statuses at rest after which the reply to the end of a motion counts as lost
MOVING = ("homing", "running", "held", "stopping")
POSITION_LOST = (
    StageError.NOT_HOMED, StageError.IN_ALARM, StageError.LIMIT_SWITCH, StageError.EMERGENCY_STOP, StageError.DISABLED,
)  # fmt: skip


@dataclass
class RunningRow:
    """A row that the stage has started. `status` is set once the row's result is decided."""

    row: Row
    take: int
    job: Job
    sequence: int  # of the stage's ROW and its `done`
    status: m.RowStatus | None = None
    fault: int = 0
    reason: str = ""
    lasting: bool = False  # the next state is fault
    points: int = 0  # passed, counted by the stage
    bursts: int = 0  # reported to the host

    def judge(self, counts: Counts) -> None:
        """Set the result of a row that was not stopped: `done` if all counts agree, else `fault`."""
        n, pulses = self.row.points, self.row.points * self.job.spec.pulses
        if (self.points, *counts) == (n, n, n, pulses):
            self.status = "done"
            return
        self.status, self.fault = "fault", int(PiFault.POINTS_MISMATCH)
        self.reason = (
            f"{n} points requested, {self.points} passed by the stage, {counts.edges} edges received, "
            f"{counts.bursts} bursts and {counts.pulses} of {pulses} pulses sent"
        )


class RowMachine(Machine):
    """The state machine with its actions. `post` appends a call to the executor's queue."""

    def __init__(
        self,
        stage: StageDriver,
        loop: TriggerLoop,
        journal: Journal,
        post: Callable[[Callable[[], object]], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(post, clock)
        self.stage, self._loop, self._journal = stage, loop, journal
        self.row: RunningRow | None = None
        self.homed = self.in_run = False
        self.fault = 0  # the first one; its reason is in `reason`
        self.lost_mm = (0.0, 0.0)  # steps lost before the last homing, which found them
        self._homing, self._homing_underway = -1, False  # sequence of HOME; True once the stage has accepted it
        self._lines_dead = self._terminating = False
        self._rests, self._watch = 0, TriggerWatch()
        self._status_sent_s = 0.0

    # --- events of trigger loop and stage ---------------------------------------------------------------------------

    def on_burst(self, sent: BurstSent) -> None:
        """Journal a burst of the row."""
        row, r = self.row, sent.record
        if row is None or sent.job is not row.job or not r.pulses:
            return
        self._journal.add(
            m.Capture, row_index=row.row.index, take=row.take, point=sent.point, column=row.row.column(sent.point),
            edge_ns=sent.edge_ns, first_pulse_ns=r.first_ns, last_pulse_ns=r.last_ns, pulses=r.pulses,
            width_max_ns=r.width_max_ns, jitter_ns=r.jitter_ns,
        )  # fmt: skip
        row.bursts += 1
        if row.bursts >= row.row.points:
            self.happen("all sent")

    def on_loop_fault(self, fault: LoopFault) -> None:
        """Handle a fault of the trigger loop, which ends the row, or the loop itself."""
        if fault.job is None:
            self._lines_dead = True
            self.happen("lasting fault", fault.number, fault.detail)
        elif self.row is not None and fault.job is self.row.job:
            self.happen("row fault", fault.number, fault.detail)

    def on_stage(self, reply: Reply) -> None:
        """Handle an unsolicited reply of the stage."""
        homing, homed = self.state == "homing", reply.sequence == self._homing
        if reply.kind == "status":
            self._on_status(reply)
        elif reply.kind == "ok":
            self._homing_underway |= homing and homed
        elif homing and not self._homing_underway:
            pass  # sent before HOME was accepted
        elif reply.kind == "banner":
            self.happen("stage lost", PiFault.STAGE_LOST, "the stage was reset: it sent its banner")
        elif reply.kind == "alarm" and reply.number == StageError.STOPPED:
            self.happen("stopped")
        elif reply.kind == "alarm":
            e = explain(reply.number)
            what = f"stage alarm {reply.number}: {e.what} ({e.why}); {e.remedy}"
            self.happen("stage lost", PiFault.STAGE_ALARM, what)
        elif reply.kind == "done" and (homed if homing else self.row and reply.sequence == self.row.sequence):
            self.stage.note_position(reply)
            self.happen("homed" if homing else "passed", reply)

    def _on_status(self, reply: Reply) -> None:
        self.stage.note_position(reply)
        self._publish_status(reply)
        row, edges = self.row, self._loop.counts.edges
        if row is not None and self.state in MOVING:
            row.points = max(0, _number(reply, "points"))
            if self.state != "stopping" and self._watch.is_silent(row.points, edges):
                reason = f"the stage has passed {row.points} points, {edges} edges were received: wire off?"
                self.happen("lasting fault", PiFault.TRIGGER_LINE_LOST, reason)
        waits = self.state in MOVING and (row is not None or self._homing_underway)
        at_rest = reply.fields.get("state") in ("idle", "alarm")
        self._rests = self._rests + 1 if waits and at_rest else 0
        if self._rests >= RESTS:
            self._rests = 0
            try:
                self.stage.link.repeat()  # the stage repeats the end of its motion
            except StageLostError as e:
                self.happen("stage lost", e.number, str(e))

    def _publish_status(self, reply: Reply) -> None:
        now = self._clock()
        if now - self._status_sent_s < (STATUS_EVENT_S if self.state in MOVING else 1.0):
            return
        self._status_sent_s = now
        self._journal.add(
            m.StageStatus, state=reply.fields.get("state", ""), x_mm=self.stage.x_mm, y_mm=self.stage.y_mm,
            points=max(0, _number(reply, "points")), alarm=max(0, min(_number(reply, "alarm"), 999)),
        )  # fmt: skip

    # --- actions: homing and rows -----------------------------------------------------------------------------------

    def _home(self) -> None:
        if self._lines_dead:
            remedy = "find out why, then start polysight-pi again"
            raise RefusedError(PiFault.TRIGGER_LINE_LOST, self.reason, remedy=remedy)
        self.homed = self._homing_underway = self._journal.broken = False
        self.fault, self.reason = 0, ""
        self._post(self._home_now)

    def _home_now(self) -> None:
        if self.state != "homing":
            return
        try:
            self.stage.connect()
            self._homing = self.stage.home()
        except StageRefusedError as e:
            self.happen("stage lost", PiFault.STAGE_ALARM, str(e))
        except StageLostError as e:
            self.happen("stage lost", e.number, str(e))

    def _note_homed(self, reply: Reply) -> str:
        self.stage.at_rest()
        k = self.stage.config.steps_per_mm
        lost_x_mm, lost_y_mm = (_number(reply, key) / k for key in ("lostx", "losty"))
        self.lost_mm = (max(-MAX_MM, min(lost_x_mm, MAX_MM)), max(-MAX_MM, min(lost_y_mm, MAX_MM)))
        self.homed = True
        return "ready" if self.in_run else "homed"

    def _begin_run(self, heartbeat_ms: int) -> None:
        self.in_run = True
        self.watch_host(heartbeat_ms)

    def _end_run(self) -> None:
        self.in_run = False

    def _start_row(self, row: Row, take: int, spec: BurstSpec, speed_mm_s: float) -> None:
        job = self._loop.arm(row.points, spec)
        try:
            sequence = self.stage.row(row, speed_mm_s)
        except (StageRefusedError, StageLostError) as e:
            self._loop.disarm()
            if isinstance(e, StageLostError):
                self.happen("stage lost", e.number, str(e))
            elif e.number in POSITION_LOST:
                self.happen("not homed")
            raise
        self.row = RunningRow(row, take, job, sequence)
        self.row_timeout_s = 30.0 + 3 * row_duration_s(row, self.stage.config, speed_mm_s)
        self._rests, self._watch = 0, TriggerWatch()
        self.fault, self.reason = 0, ""
        self._journal.add(m.RowStarted, row=row, take=take)

    def _hold(self) -> None:
        self.stage.link.send_byte(Immediate.HOLD)

    def _resume(self) -> None:
        self.stage.link.send_byte(Immediate.RESUME)

    # --- actions: how a row ends ------------------------------------------------------------------------------------

    def _decide(self, status: m.RowStatus, number: int, reason: str, lasting: bool = False) -> None:
        """Set the row's result, unless it is set already, and disarm the trigger loop."""
        if self.row is not None:
            self.row.lasting |= lasting
            if self.row.status is None:
                self.row.status, self.row.fault, self.row.reason = status, int(number), reason
                self._loop.disarm()

    def _stop(self, *_: object) -> str | None:
        """Stop the stage if it moves. Returns `ending` for a row that cannot be stopped."""
        if self.state in ("homing", "running", "held"):
            try:
                self.stage.link.send_byte(Immediate.STOP)
            except StageLostError:
                return "ending" if self.row else None
        return None

    def _disarm(self) -> None:
        self._loop.disarm()

    def _abort(self, reason: str) -> str | None:
        self._decide("aborted", PiFault.ABORTED, reason)
        return self._stop()

    def terminate(self) -> bool:
        """Stop the stage because the program is being ended. Returns True if a row has to end first."""
        self._terminating = True
        self.happen("Abort", "polysight-pi was ended")
        if self.state == "stopping":
            self._deadline_s = self._clock() + END_TIMEOUT_S
        return self.row is not None

    def _fail_row(self, number: int, reason: str) -> str | None:
        self._report_fault(number, reason)
        self._decide("fault", number, reason)
        return self._stop()

    def _fail(self, number: int, reason: str) -> str | None:
        self._report_fault(number, reason)
        self._decide("fault", number, reason, lasting=True)
        return self._stop()

    def _lose_stage(self, number: int, reason: str) -> None:
        """Handle a stage that is lost, in alarm, or reset: it cannot be stopped any more."""
        self.homed = False
        self.stage.at_rest()
        if self.state != "fault":
            self._report_fault(number, reason)
        self._decide("fault", number, reason, lasting=True)

    def _lose_position(self) -> None:
        self.homed = False

    def _time_out(self) -> None:
        if not self._terminating:
            reasons = {
                "homing": f"not homed after {HOMING_TIMEOUT_S} s",
                "running": f"the row has not ended after {self.row_timeout_s:.0f} s",
                "stopping": "the stage did not stop",
            }
            self._lose_stage(PiFault.STAGE_LOST, reasons[self.state])

    def _note_passed(self, reply: Reply) -> str | None:
        row = self._current
        self.stage.at_rest()
        row.points = max(0, _number(reply, "points", row.row.points))
        if _number(reply, "held"):
            row.reason = "held during the row: some positions were passed below full speed"
        return "ending" if row.bursts >= row.row.points else None

    def _note_stopped(self, reply: Reply | None = None) -> None:
        """Handle the stage at rest after STOP; it may have reached the row's end before."""
        if reply is not None:
            self._current.points = max(0, _number(reply, "points", self._current.row.points))
        self._decide("aborted", PiFault.ABORTED, "the stage was stopped")
        self._clear_alarm()

    def _clear_alarm(self) -> None:
        """Clear the alarm that STOP latches; the stage keeps its position."""
        self.stage.at_rest()
        try:
            self.stage.clear()
        except StageRefusedError as e:
            self.homed = self.homed and e.number not in POSITION_LOST
        except StageLostError as e:
            self._post(partial(self.happen, "stage lost", e.number, str(e)))

    def _finish_row(self) -> str:
        row, counts = self._current, self._loop.disarm()
        if row.status is None:
            row.judge(counts)
            if row.fault:
                self._report_fault(row.fault, row.reason)
        self._journal.add(
            m.RowFinished, row_index=row.row.index, take=row.take, status=row.status, points=row.points,
            **counts._asdict(), fault=row.fault, reason=row.reason, timed_by=self._loop.timed_by,
        )  # fmt: skip
        self.row = None
        return "fault" if row.lasting else "ready" if self.homed else "idle"

    @property
    def _current(self) -> RunningRow:
        if self.row is None:
            raise RuntimeError(f"state {self.state} without a row")
        return self.row

    # --- events -----------------------------------------------------------------------------------------------------

    def _report_fault(self, number: int, reason: str) -> None:
        e = explain(number)
        if not self.fault:
            self.fault, self.reason = int(number), reason
        self._journal.add(m.Fault, number=int(number), what=f"{e.what}: {reason}", why=e.why, remedy=e.remedy)


def row_duration_s(row: Row, stage: Stage, speed_mm_s: float) -> float:
    """Estimate the duration of a row, including the longest travel to its first point."""
    travel_s = (stage.travel_x_mm + stage.travel_y_mm) / stage.travel_speed_mm_s
    return travel_s + abs(row.step_mm) * row.points / speed_mm_s + 4 * speed_mm_s / stage.accel_mm_s2


def _number(reply: Reply, key: str, absent: int = 0) -> int:
    try:
        return reply.integer(key)
    except ProtocolError:
        return absent
