"""The row executor's state machine: what may happen in which state, and how a row ends. The states are in states.py.

The first fault wins: its number and reason are kept until the next home (or, for a fault that ended only a row, until
the next row). Everything that waits has a limit. Used by the executor's thread alone.
"""

from __future__ import annotations

from polysight.pi_controller.burst import BurstSpec
from polysight.pi_controller.row_ending import Parts, RowEnding
from polysight.pi_controller.rows import RefusedError, row_duration_s, stage_row
from polysight.pi_controller.running_row import RunningRow
from polysight.pi_controller.stage_link import StageLostError, StageRefusedError
from polysight.pi_controller.states import MOVING
from polysight.pi_controller.supervision import RestWatch, TriggerWatch
from polysight.pi_controller.trigger_loop import BurstSent, LoopFault, RowJob
from polysight.shared import messages as m
from polysight.shared.errors import ProtocolError
from polysight.shared.faults import PiFault, StageError, explain
from polysight.shared.raster import Row
from polysight.shared.stage_line import HOMING_LIMIT_S, Immediate, Reply

END_LIMIT_S = 0.5  # from STOP to standstill when this program is told to end
LAST_EDGE_LIMIT_S = 1.0  # from the stage's `done` to the last burst
STATUS_EVENT_S = 0.24
NOT_ANY_MORE_HOMED = (
    StageError.NOT_HOMED,
    StageError.IN_ALARM,
    StageError.LIMIT_SWITCH,
    StageError.EMERGENCY_STOP,
    StageError.DISABLED,
)


class Machine(RowEnding):
    """What may happen in which state."""

    def __init__(self, parts: Parts) -> None:
        super().__init__(parts)
        self._homing_underway = False
        self._resting, self._trigger = RestWatch(), TriggerWatch()
        self._dead_lines = False
        self.lost_mm = (0.0, 0.0)
        self._status_told = 0.0

    # --- commands ---------------------------------------------------------------------------------------------------

    def begin_run(self, host_heartbeat_ms: int) -> None:
        """A run is begun by a host that promises to be heard so often (0: it does not)."""
        self.in_run = True
        self.host.promise(host_heartbeat_ms, self._clock())
        if self.state == "homed":
            self._go("ready")

    def end_run(self) -> None:
        """The run is over."""
        self.in_run = False
        if self.state == "ready":
            self._go("homed")

    def home(self) -> None:
        """Home the stage, out of any fault it can get out of. Raises RefusedError."""
        if self.state in ("running", "held", "done"):
            raise RefusedError(PiFault.NOT_READY, f"the state is {self.state}", "", "abort the row first")
        if self._dead_lines:
            raise RefusedError(
                PiFault.TRIGGER_LINE_LOST, self.reason, remedy="find out why, then start polysight-pi again"
            )
        if self.state != "homing":
            self._go("homing")
            self.homed, self._homing, self._homing_underway = False, None, False
            self._states.clear_fault()
            self._ledger.broken = False
            self._post(self._home_now)

    def _home_now(self) -> None:
        if self.state != "homing":
            return
        try:
            self.stage.connect()
            self._homing = self.stage.home()
        except StageRefusedError as e:
            return self.fail(PiFault.STAGE_ALARM, str(e))
        except StageLostError as e:
            return self.fail(PiFault.STAGE_LOST, str(e))
        self._wait(HOMING_LIMIT_S, lambda: self.fail(PiFault.STAGE_LOST, f"not homed after {HOMING_LIMIT_S} s"))

    def start_row(self, row: Row, take: int, spec: BurstSpec, speed_mm_s: float) -> None:
        """Start a row. Raises RefusedError when the stage does not take it."""
        job = self._loop.arm(RowJob(row.index, take, row.points, spec))
        try:
            sequence = self.stage.row(stage_row(row, self.stage.config, speed_mm_s))
        except StageRefusedError as e:
            self._loop.disarm()
            if e.number in NOT_ANY_MORE_HOMED:
                self.homed = False
                self._go("idle")
            raise RefusedError(e.number, e.what, e.why, e.remedy) from None
        except StageLostError as e:
            self._loop.disarm()
            self.fail(PiFault.STAGE_LOST, str(e))
            raise RefusedError(PiFault.STAGE_LOST, e.what, e.why, e.remedy) from None
        limit_s = 30.0 + 3 * row_duration_s(row, self.stage.config, speed_mm_s)
        self.row = RunningRow(row, take, sequence, job, limit_s)
        self._trigger = TriggerWatch()
        self._states.clear_fault()
        self.emit(m.RowStarted, row=row, take=take)
        self._go("running")
        self._watch_row()

    def _watch_row(self) -> None:
        if self.row:
            limit = self.row.limit_s
            self._wait(limit, lambda: self.fail(PiFault.STAGE_LOST, f"the row has not ended after {limit:.0f} s"))

    def hold(self, hold: bool) -> None:
        """Hold or resume the row. Raises RefusedError."""
        target: m.State = "held" if hold else "running"
        if self.row is None or self.row.status is not None or self.row.standing:
            raise RefusedError(PiFault.NOT_READY, f"no row is running: the state is {self.state}", "", "nothing to do")
        if self.state != target:
            try:
                self.stage.send(Immediate.HOLD if hold else Immediate.RESUME)
            except StageLostError as e:
                raise RefusedError(PiFault.STAGE_LOST, e.what, e.why, e.remedy) from None
            self._go(target)
            if hold:
                self._limit.clear()
            else:
                self._watch_row()

    def abort(self, reason: str) -> None:
        """Stop whatever moves."""
        if self.row is not None:
            self.end_row("aborted", PiFault.ABORTED, reason, wait=True)
        elif self.state == "homing":
            self._stop_byte()

    def end(self) -> bool:
        """The program is told to end: stop whatever moves. Returns whether a row has to end first."""
        row = self.row
        if row is None:
            if self.state == "homing":
                self._stop_byte()
            return False
        self.end_row("aborted", PiFault.ABORTED, "polysight-pi was told to end", wait=True)
        if not row.finishing:
            self._wait(END_LIMIT_S, lambda: self._finish(row))
        return True

    # --- what happens by itself -------------------------------------------------------------------------------------

    def take_burst(self, sent: BurstSent) -> None:
        """A burst has ended."""
        row = self.row
        if row is None or sent.job != row.job or not sent.record.pulses:
            return
        r = sent.record
        self.emit(
            m.Capture,
            row_index=row.row.index,
            take=row.take,
            point=sent.point,
            column=row.row.column(sent.point),
            edge_ns=sent.edge_ns,
            first_pulse_ns=r.first_ns,
            last_pulse_ns=r.last_ns,
            pulses=r.pulses,
            width_max_ns=r.width_max_ns,
            jitter_ns=r.jitter_ns,
        )
        row.bursts += 1
        self._finish_when_complete(row)

    def take_loop_fault(self, fault: LoopFault) -> None:
        """The trigger loop has given up."""
        if fault.job is None:
            self._dead_lines = True
            self.fail(fault.number, fault.detail, wait=True)
        elif self.row is not None and fault.job == self.row.job:
            self.end_row("fault", fault.number, fault.detail, wait=True)

    def take_stage(self, reply: Reply) -> None:
        """What the stage tells by itself."""
        row = self.row
        if reply.kind == "status":
            self._on_status(reply)
        elif reply.kind == "ok":
            self._homing_underway |= reply.sequence == self._homing
        elif self.state == "homing" and not self._homing_underway:
            pass  # from before homing: it began with clearing
        elif reply.kind == "banner":
            self.homed = False
            self.fail(PiFault.STAGE_LOST, "the stage was reset: its banner came")
        elif reply.kind == "alarm" and reply.number == StageError.STOPPED:
            self._on_stopped()
        elif reply.kind == "alarm":
            e = explain(reply.number)
            self.fail(PiFault.STAGE_ALARM, f"stage alarm {reply.number}: {e.what} ({e.why}); {e.remedy}")
        elif reply.kind == "done" and self._homing is not None and reply.sequence == self._homing:
            self.stage.note_position(reply)
            k = self.stage.config.steps_per_mm
            self.lost_mm = (_number(reply, "lostx") / k, _number(reply, "losty") / k)
            self._homing, self.homed = None, True
            self._limit.clear()
            self.stage.at_rest()
            self._go("ready" if self.in_run else "homed")
        elif reply.kind == "done" and row is not None and reply.sequence == row.sequence:
            self.stage.note_position(reply)
            self._on_row_done(row, reply)

    def _on_status(self, reply: Reply) -> None:
        self.stage.note_position(reply)
        self._tell_status(reply)
        row = self.row
        if row is not None and not row.standing:
            row.points = max(0, _number(reply, "points"))
            if row.status is None and self._trigger.is_silent(row.points, self._loop.counts.edges):
                self.fail(
                    PiFault.TRIGGER_LINE_LOST,
                    f"the stage has passed {row.points} points, {self._loop.counts.edges} edges were seen: wire off?",
                    wait=True,
                )
        waits = (self._homing is not None and self._homing_underway) or (row is not None and not row.standing)
        if self._resting.is_overdue(waits, reply.fields.get("state") in ("idle", "alarm")):
            try:
                self.stage.ask_how_it_ended()
            except StageLostError as e:
                self.fail(PiFault.STAGE_LOST, str(e))

    def _on_row_done(self, row: RunningRow, reply: Reply) -> None:
        self.stage.at_rest()
        row.standing, row.points = True, max(0, _number(reply, "points", row.row.points))
        if _number(reply, "held"):
            row.reason = "held on the way: some positions were passed below full speed"
        if row.status is not None:
            return self._on_stopped()
        self._go("done")
        self._wait(LAST_EDGE_LIMIT_S, lambda: self._finish(row))
        self._finish_when_complete(row)

    def _on_stopped(self) -> None:
        """The stage has come to rest after STOP: clear the latched alarm, end the row."""
        row = self.row
        self._limit.clear()
        self.stage.at_rest()
        try:
            self.stage.clear()
        except StageRefusedError as e:
            if e.number == StageError.BUSY and row is not None and self._clock() < row.stop_limit:
                return self._wait(0.02, self._on_stopped)
            self.homed = self.homed and e.number not in NOT_ANY_MORE_HOMED
        except StageLostError as e:
            return self.fail(PiFault.STAGE_LOST, str(e))
        if row is not None:
            if row.status is None:
                row.status, row.fault, row.reason = "aborted", int(PiFault.ABORTED), "the stage was stopped"
            row.standing = True
            self._finish_soon(row)
        elif self.state == "homing":
            self._homing = None
            self._go("idle")

    def _tell_status(self, reply: Reply) -> None:
        now = self._clock()
        if now - self._status_told < (STATUS_EVENT_S if self.state in MOVING else 1.0):
            return
        self._status_told = now
        self.emit(
            m.StageStatus,
            state=reply.fields.get("state", ""),
            x_mm=self.stage.x_mm,
            y_mm=self.stage.y_mm,
            points=max(0, _number(reply, "points")),
            alarm=_number(reply, "alarm"),
        )


def _number(reply: Reply, key: str, absent: int = 0) -> int:
    try:
        return reply.integer(key)
    except ProtocolError:
        return absent
