"""The state machine of stage, run, row and jog; rules.py lists the events of each state and their actions.

The actions are methods of `Machine`, which control stage, trigger loop and the motion under way. The first fault is
kept until the next `Home`, row or jog.

At each point of a row the stage gives a trigger edge, and the trigger loop answers it with a burst of pulses to the
radars. A row that has reached its end is `done` while its last burst is awaited, and `ending` while the bursts in the
queue are still to be journalled.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any, cast

from polysight_pi.edges import EdgeTimes, RowMotion
from polysight_pi.journal import JournalThread
from polysight_pi.motions import RunningJog, RunningRow, estimate_row_duration_s
from polysight_pi.rules import END_TIMEOUT_S, MOVING, RULES, TIMEOUTS_S, WIRE_STATE, State
from polysight_pi.stage import MAX_MM, StageDriver, StageLostError, StageRefusedError
from polysight_pi.trigger import BurstSent, BurstSpec, LoopFault, TriggerLoop, TriggerWatch
from polysight_shared import messages as m
from polysight_shared.errors import DeviceError, ErrorCode, PolysightError, ProtocolError
from polysight_shared.faults import PiFault, StageError, explain
from polysight_shared.raster import Row
from polysight_shared.stage_line import HOMING_TIMEOUT_S, Immediate, Reply

# Least time between two published statuses of a moving stage: about four a second are enough to draw it. Chosen.
STATUS_EVENT_S = 0.24
# The same for a stage at rest; chosen.
REST_STATUS_EVENT_S = 1.0
# Consecutive statuses at rest after which the stage's report of a motion's end counts as lost; chosen.
RESTING_STATUSES = 3
# Number of requests to repeat that report; a stage that was reset, and whose banner was lost, never answers them.
MAX_REPEAT_REQUESTS = 3
# Errors of the stage after which its position is not known.
POSITION_LOST_ERRORS = (
    StageError.NOT_HOMED, StageError.IN_ALARM, StageError.LIMIT_SWITCH, StageError.EMERGENCY_STOP, StageError.DISABLED,
)  # fmt: skip


class RefusedError(PolysightError):
    """A command is refused; `number` is a PiFault, whose default texts are in polysight_shared/faults.py."""

    def __init__(self, number: int, summary: str, cause: str = "", remedy: str = "") -> None:
        super().__init__(summary, cause, remedy, code=ErrorCode.REFUSED_BY_PEER)
        self.number = int(number)


# Missing heartbeats after which the host is lost; chosen.
HOST_MISSES = 4


class Machine:
    """Applies RULES, checks the time limit of the state and, during a motion, the host's heartbeat.

    `post` appends a call to the executor's queue, `clock` gives seconds. Used by the executor's thread only, except
    `note_host_alive` and `note_jog_alive`. A method whose name is an action of RULES with a leading underscore may
    return the next state; None means the rule's default.
    """

    def __init__(
        self,
        stage: StageDriver,
        loop: TriggerLoop,
        journal: JournalThread,
        post: Callable[[Callable[[], object]], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.stage = stage
        self._loop = loop
        self._journal = journal
        self._post = post
        self._clock = clock
        self.state: State = "idle"
        self.row: RunningRow | None = None
        self.jog: RunningJog | None = None
        # Command of the newest jog; it stays after the jog's end.
        self.last_jog: m.Jog | None = None
        # True if the known position is that of the stage at rest, not of an earlier status.
        self._is_placed = False
        self.homed = False
        self.in_run = False
        # Number of the first fault; 0: none.
        self.fault = 0
        # Reason of the fault.
        self.reason = ""
        # Steps in x and y that were lost before the last homing, which measured them, millimetres.
        self.lost_mm = (0.0, 0.0)
        # Longest duration of the current row.
        self.row_timeout_s = math.inf
        # End of the current state's time limit, by `clock`.
        self._deadline_s = math.inf
        # Sequence number of the HOME line.
        self._homing = -1
        # True once the stage has accepted the homing.
        self._homing_underway = False
        # True while the host of a homing sends heartbeats.
        self._homing_is_watched = False
        # True if the stage rests in a hold.
        self._rests_in_hold = False
        # True if the row is to be resumed once the stage rests.
        self._resumes_at_rest = False
        # True once the lines to trigger and radar have failed.
        self._lines_dead = False
        # True while the program is being ended.
        self._terminating = False
        # Consecutive statuses at rest while the end of a motion is awaited.
        self._rests = 0
        self._watch = TriggerWatch()
        self._status_sent_s = 0.0
        self.watch_host(0)
        # The next states and the method of each pair of state and event.
        self._rules: dict[tuple[str, str], tuple[list[Any], Callable[..., str | None]]] = {
            (state, rule.event): (rule.leads_to.split(), getattr(self, f"_{rule.action}"))
            for rule in RULES
            for state in rule.states.split()
        }

    def handle_event(self, event: str, *args: Any) -> bool:
        """Apply the rule of this event in the current state; `args` are its action's. Return False without a rule.

        Raises RuntimeError if the action leads to a state that the rule does not name, and what the action raises.
        """
        if (self.state, event) not in self._rules:
            return False
        state_before = self.state
        next_states, action = self._rules[state_before, event]
        state: Any = action(*args) or next_states[0]
        if state not in next_states:
            raise RuntimeError(f"{event} in state {state_before} does not lead to {state}")
        if state != "same":
            self._enter(state)
        return True

    def _enter(self, state: State) -> None:
        """Set the state and its time limit."""
        timeout_s = TIMEOUTS_S.get(state, math.inf)
        if state == "running":
            timeout_s = self.row_timeout_s
        self.state = state
        self._deadline_s = self._clock() + timeout_s
        # The row is judged after the bursts that are still in the queue.
        if state == "ending":
            self._post(partial(self.handle_event, "settled"))

    def require(self, event: str) -> None:
        """Raise RefusedError if this command has no rule in the current state."""
        if (self.state, event) not in self._rules:
            summary = f"no {event} in state {self.wire_state}"
            if self.reason:
                summary += f": {self.reason}"
            remedy = "begin a run, home the stage, start a row"
            if self.row is not None:
                remedy = "wait for the row's end, or abort it"
            raise RefusedError(PiFault.NOT_READY, summary, f"the state is {self.wire_state}", remedy)

    def command(self, event: str, *args: Any) -> None:
        """Execute a command. Raises RefusedError."""
        self.require(event)
        self.handle_event(event, *args)

    @property
    def wire_state(self) -> m.State:
        """The name of the state in messages."""
        return cast(m.State, WIRE_STATE.get(self.state, self.state))

    def _do_nothing(self, *_: object) -> None:
        pass

    # --- time -------------------------------------------------------------------------------------------------------

    def watch_host(self, heartbeat_ms: int) -> None:
        """Expect the host's heartbeat at this interval; 0 disables the check."""
        self._host_timeout_s = HOST_MISSES * heartbeat_ms / 1e3 or math.inf
        self._host_alive_s = self._clock()

    def note_jog_alive(self, owner: str) -> bool:
        """Note a heartbeat of the jog's host; return False if there is no jog of this owner. From any thread."""
        jog = self.jog
        if jog is None or jog.command.owner != owner:
            return False
        # Never to an earlier time: the calls of several threads may come out of order.
        jog.alive_s = max(jog.alive_s, self._clock())
        return True

    def note_host_alive(self) -> None:
        """Note a heartbeat of the run's host. From any thread."""
        self._host_alive_s = max(self._host_alive_s, self._clock())

    @property
    def host_lives(self) -> bool:
        """True while the newest heartbeat of the run's host is younger than the timeout; False if none is expected."""
        return self._host_timeout_s < math.inf and self._clock() < self._host_alive_s + self._host_timeout_s

    @property
    def _host_lost_s(self) -> float:
        """Time, by `clock`, at which the host counts as lost; infinity while nothing moves for a host."""
        if self.state in ("running", "held") or (self.state == "homing" and self._homing_is_watched):
            return self._host_alive_s + self._host_timeout_s
        if self.jog is not None and self.jog.status is None:
            return self.jog.alive_s + self.jog.timeout_s
        return math.inf

    def seconds_left(self) -> float:
        """Return the time until the next deadline; infinity if there is none."""
        return max(0.0, min(self._deadline_s, self._host_lost_s) - self._clock())

    def check_deadlines(self) -> None:
        """Handle deadlines that have passed."""
        if self._clock() >= self._deadline_s:
            self.handle_event("timeout")
        if self._clock() >= self._host_lost_s:
            timeout_s = self._host_timeout_s if self.jog is None else self.jog.timeout_s
            reason = f"no heartbeat of the host for {timeout_s * 1e3:.0f} ms"
            self.stop_motion(PiFault.HOST_LOST, reason)

    def stop_motion(self, number: int, reason: str) -> None:
        """Stop a row, jog or homing, if there is one, with this fault."""
        if self.jog is not None and self.jog.status is not None:
            # The stage has already been sent a stop.
            return
        if self.state in ("running", "held", "jogging"):
            self.handle_event("row fault", number, reason)
        elif self.state == "homing":
            self.handle_event("lasting fault", number, reason)

    # --- events of trigger loop and stage ---------------------------------------------------------------------------

    def on_burst(self, sent: BurstSent) -> None:
        """Journal a burst of the current row, and check the time of its edge; ignore bursts of earlier rows."""
        row = self.row
        record = sent.record
        if row is None or sent.job is not row.job:
            return
        time_problem = row.edges.note_edge(sent.edge_ns)
        if time_problem:
            self.handle_event("row fault", PiFault.EDGE_TIME, time_problem)
        # Without a pulse there is nothing to journal: the trigger loop reports its fault next.
        if not record.pulses:
            return
        self._journal.add(
            m.Capture, row_index=row.row.index, take=row.take, point=sent.point, column=row.row.column(sent.point),
            edge_ns=sent.edge_ns, first_pulse_ns=record.first_ns, last_pulse_ns=record.last_ns, pulses=record.pulses,
            width_max_ns=record.width_max_ns, jitter_ns=record.jitter_ns, pulses_seen=self._loop.sees_pulses,
        )  # fmt: skip
        row.bursts += 1
        if row.bursts >= row.row.points:
            self.handle_event("all sent")

    def on_loop_fault(self, fault: LoopFault) -> None:
        """Handle a fault of the trigger loop, which ends the row; one without a job has ended the loop itself."""
        if fault.job is None:
            self._lines_dead = True
            self.handle_event("lasting fault", fault.number, fault.detail)
        elif self.row is not None and fault.job is self.row.job:
            self.handle_event("row fault", fault.number, fault.detail)

    def on_stage(self, reply: Reply) -> None:
        """Handle a line of the stage: a status, the `ok` of a command, an alarm, a banner or the end of a motion."""
        homing = self.state == "homing"
        answers_home = reply.sequence == self._homing
        if reply.kind == "status":
            self._on_status(reply)
        elif reply.kind == "ok":
            self._homing_underway |= homing and answers_home
            if self.row is not None and reply.sequence == self.row.sequence:
                self.row.is_underway = True
        elif homing and not self._homing_underway:
            # Sent before HOME was accepted, so it says nothing about the homing.
            pass
        elif reply.kind == "banner":
            self.handle_event("stage lost", PiFault.STAGE_LOST, "the stage was reset: it sent its banner")
        elif reply.kind == "alarm" and reply.number == StageError.STOPPED:
            self.handle_event("stopped")
        elif reply.kind == "alarm":
            explanation = explain(reply.number)
            summary = f"stage alarm {reply.number}: {explanation.problem} ({explanation.cause}); {explanation.remedy}"
            self.handle_event("stage lost", PiFault.STAGE_ALARM, summary)
        elif reply.kind == "done" and homing and answers_home:
            self.stage.note_position(reply)
            self.handle_event("homed", reply)
        elif reply.kind == "done" and self.jog is not None and reply.sequence == self.jog.sequence:
            self.stage.note_position(reply)
            self.handle_event("moved", reply)
        elif reply.kind == "done" and not homing and self.row and reply.sequence == self.row.sequence:
            self.stage.note_position(reply)
            self.handle_event("passed", reply)

    def _on_status(self, reply: Reply) -> None:
        """Handle a status; request the end of a motion again if the stage rests without having reported it."""
        self.stage.note_position(reply)
        self._is_placed |= self.state in ("homed", "ready") and reply.fields.get("state") == "idle"
        self._publish_status(reply)
        row = self.row
        if row is not None and row.is_underway and self.state in MOVING:
            self._note_row_status(row, reply)
        waits_for_end = self.state in MOVING and (row is not None or self.jog is not None or self._homing_underway)
        if waits_for_end and reply.fields.get("state") in ("idle", "alarm"):
            self._rests += 1
        else:
            self._rests = 0
        if self._rests > RESTING_STATUSES * MAX_REPEAT_REQUESTS:
            self._rests = 0
            reason = "it is at rest, and does not report how its motion ended: it was reset"
            self.handle_event("stage lost", PiFault.STAGE_LOST, reason)
        elif self._rests and self._rests % RESTING_STATUSES == 0:
            # Ask the stage to repeat the end of its motion. The lambda reads `link` inside `_tell_stage`, which handles
            # a link that is lost.
            self._tell_stage(lambda: self.stage.link.repeat())

    def _note_row_status(self, row: RunningRow, reply: Reply) -> None:
        """Compare a status with the trigger edges of the row, and resume a held row once the stage rests."""
        row.points = max(0, _read_integer(reply, "points"))
        if time_problem := row.edges.note_status(row.points, reply.asked_ns, reply.written_ns):
            self.handle_event("row fault", PiFault.EDGE_TIME, time_problem)
        edges = self._loop.counts.edges
        if self.state != "stopping" and self._watch.is_silent(row.points, edges):
            reason = f"the stage has passed {row.points} points, {edges} edges were received: is the wire loose?"
            self.handle_event("lasting fault", PiFault.TRIGGER_LINE_LOST, reason)
        if self.state in ("running", "held") and reply.fields.get("state") == "hold":
            row.edges.note_stop(_read_integer(reply, "x"), row.points)
            self._rests_in_hold = True
            if self._resumes_at_rest:
                self._tell_stage(self._send_resume)

    def _tell_stage(self, send: Callable[[], object]) -> None:
        """Send something to the stage; a lost stage becomes an event, after the one that is being handled."""
        try:
            send()
        except StageLostError as e:
            self._post(partial(self.handle_event, "stage lost", e.number, str(e)))

    def _publish_status(self, reply: Reply) -> None:
        """Publish a status of the stage, but not more often than a page needs it."""
        now_s = self._clock()
        interval_s = STATUS_EVENT_S if self.state in MOVING else REST_STATUS_EVENT_S
        if now_s - self._status_sent_s < interval_s:
            return
        self._status_sent_s = now_s
        self._journal.add(
            m.StageStatus, state=reply.fields.get("state", ""), x_mm=self.stage.x_mm, y_mm=self.stage.y_mm,
            points=max(0, _read_integer(reply, "points")), alarm=max(0, min(_read_integer(reply, "alarm"), 999)),
        )  # fmt: skip

    # --- actions: homing and rows -----------------------------------------------------------------------------------

    def _home(self) -> None:
        """Prepare homing; :meth:`_home_now` starts it after the state has changed.

        Raises RefusedError if the trigger line is lost.
        """
        if self._lines_dead:
            remedy = "find out why, then start polysight-pi again"
            raise RefusedError(PiFault.TRIGGER_LINE_LOST, self.reason, remedy=remedy)
        self.homed = False
        self._homing_underway = False
        self._is_placed = False
        self._homing_is_watched = self.host_lives
        # Lets a journal that could not be written try again.
        self._journal.retry()
        self._forget_fault()
        self._post(self._home_now)

    def _home_now(self) -> None:
        """Open the port if necessary and start homing, unless the state has changed meanwhile."""
        if self.state != "homing":
            return
        try:
            self.stage.connect()
            self._homing = self.stage.home()
        except StageRefusedError as e:
            self.handle_event("stage lost", PiFault.STAGE_ALARM, str(e))
        except StageLostError as e:
            self.handle_event("stage lost", e.number, str(e))

    def _note_homed(self, reply: Reply) -> str:
        """Store the lost steps and return the next state; `fault` if homing did not end at the origin."""
        self.stage.slow_down_polling()
        end = (_read_integer(reply, "x"), _read_integer(reply, "y"))
        if end != (0, 0):
            self._report_fault(PiFault.POSITION, f"homing ended at {end}, not at (0, 0) (x, y in steps)")
            return "fault"
        # Limited to what a message may hold.
        limit = MAX_MM * self.stage.config.steps_per_mm
        lost_x = max(-limit, min(_read_integer(reply, "lostx"), limit))
        lost_y = max(-limit, min(_read_integer(reply, "losty"), limit))
        self.lost_mm = (lost_x / self.stage.config.steps_per_mm, lost_y / self.stage.config.steps_per_mm)
        self.homed = True
        self._is_placed = True
        return self._at_rest_state

    @property
    def _at_rest_state(self) -> str:
        """The state of a stage that has ended a motion without a lasting fault."""
        if not self.homed:
            return "idle"
        if self.in_run:
            return "ready"
        return "homed"

    # --- actions: jog -----------------------------------------------------------------------------------------------

    def find_place_mm(self, axis: m.Axis) -> float:
        """Return the position of an axis of the stage at rest. Raises RefusedError while it is not known."""
        if not self._is_placed:
            remedy = "ask again in a second"
            raise RefusedError(
                PiFault.NOT_READY, "the stage has not reported where it rests", "it has just stopped", remedy
            )
        return self.stage.x_mm if axis == "x" else self.stage.y_mm

    def _jog(self, command: m.Jog) -> None:
        """Start a jog. Raises StageRefusedError or StageLostError."""
        x_mm = self.stage.x_mm
        y_mm = self.stage.y_mm
        if command.axis == "x":
            x_mm = command.from_mm + command.distance_mm
        else:
            y_mm = command.from_mm + command.distance_mm
        sequence = self._start_motion(partial(self.stage.move, x_mm, y_mm, command.speed_mm_s))
        steps_per_mm = self.stage.config.steps_per_mm
        target = (round(x_mm * steps_per_mm), round(y_mm * steps_per_mm))
        timeout_s = HOST_MISSES * command.heartbeat_ms / 1e3
        self.jog = RunningJog(
            sequence=sequence, command=command, target=target, timeout_s=timeout_s, alive_s=self._clock()
        )
        self.last_jog = command

    def _start_motion(self, start: Callable[[], int]) -> int:
        """Start a motion of a homed stage; return its sequence number. Raises StageRefusedError or StageLostError."""
        try:
            sequence = start()
        except StageLostError as e:
            self.handle_event("stage lost", e.number, str(e))
            raise
        except StageRefusedError as e:
            if e.number in POSITION_LOST_ERRORS:
                self.handle_event("not homed")
            raise
        self._is_placed = False
        self._rests = 0
        self._forget_fault()
        return sequence

    def _note_moved(self, reply: Reply) -> str:
        """Finish a jog and return the next state; `fault` if it did not end at its target."""
        self.stage.slow_down_polling()
        end = (_read_integer(reply, "x", -1), _read_integer(reply, "y", -1))
        if self.jog is not None and end != self.jog.target:
            self.homed = False
            reason = f"the jog ended at {end}, not at {self.jog.target} (x, y in steps)"
            self._report_fault(PiFault.POSITION, reason)
            self._finish_jog("fault", PiFault.POSITION, reason)
            return "fault"
        self._is_placed = True
        self._finish_jog()
        return self._at_rest_state

    def _note_jog_stopped(self) -> str:
        self._clear_alarm()
        self._finish_jog("aborted", reason="the stage was stopped")
        return self._at_rest_state

    def _stop_jog(self, status: m.RowStatus, number: int, reason: str) -> None:
        """Send STOP; the jog ends with the stage's alarm, or the stage counts as lost if that does not come."""
        if self.jog is None or not self.jog.set_result(status, number, reason):
            return
        self._deadline_s = min(self._deadline_s, self._clock() + TIMEOUTS_S["stopping"])
        self._tell_stage(lambda: self.stage.link.send_byte(Immediate.STOP))

    def _abort_jog(self, reason: str) -> None:
        self._stop_jog("aborted", PiFault.ABORTED, reason)

    def _fail_jog(self, number: int, reason: str) -> None:
        self._report_fault(number, reason)
        self._stop_jog("fault", number, reason)

    def _finish_jog(self, status: m.RowStatus = "done", number: int = 0, reason: str = "") -> None:
        """Journal the end of the jog, if there is one; a result that was decided before is kept."""
        jog = self.jog
        if jog is None:
            return
        jog.set_result(status, number, reason)
        command = jog.command
        self._journal.add(
            m.Jogged, axis=command.axis, from_mm=command.from_mm, distance_mm=command.distance_mm,
            end_mm=self.stage.x_mm if command.axis == "x" else self.stage.y_mm,
            status=jog.status or status, fault=jog.fault, reason=jog.reason,
        )  # fmt: skip
        self.jog = None

    def _begin_run(self, heartbeat_ms: int) -> None:
        self.in_run = True
        self.watch_host(heartbeat_ms)

    def _end_run(self) -> None:
        self.in_run = False

    def _start_row(self, row: Row, take: int, spec: BurstSpec, speed_mm_s: float) -> None:
        """Arm the trigger loop, start the row and journal its start. Raises StageRefusedError or StageLostError."""
        job = self._loop.arm(row.points, spec)
        motion = RowMotion.plan(row, self.stage.config, speed_mm_s)
        try:
            sequence = self._start_motion(partial(self.stage.row, motion))
        except DeviceError:
            self._loop.disarm()
            raise
        edges = EdgeTimes(motion)
        self.row = RunningRow(sequence=sequence, row=row, take=take, job=job, motion=motion, edges=edges)
        # Chosen: far above the estimate, so that only a stage that hangs is timed out.
        self.row_timeout_s = 30.0 + 3 * estimate_row_duration_s(row, self.stage.config, speed_mm_s)
        self._watch = TriggerWatch()
        self._journal.add(m.RowStarted, row=row, take=take)

    def _hold(self) -> None:
        """Have the stage brake in its row; it rests some time later."""
        self._current.edges.note_hold()
        self._rests_in_hold = False
        self._resumes_at_rest = False
        self.stage.link.send_byte(Immediate.HOLD)

    def _resume(self) -> None:
        # Resume only when the stage rests: the times of the edges before and after are computed from its position.
        self._resumes_at_rest = True
        if self._rests_in_hold:
            self._send_resume()

    def _send_resume(self) -> None:
        self._resumes_at_rest = False
        self.stage.link.send_byte(Immediate.RESUME)

    # --- actions: how a row ends ------------------------------------------------------------------------------------

    def _set_result(self, status: m.RowStatus, number: int, reason: str, lasting: bool = False) -> None:
        """Set the row's result and disarm the trigger loop, unless there is no row or its result is set already.

        `lasting`: the state after the row is `fault`, not `ready` or `homed`; noted in either case.
        """
        if self.row is not None:
            self.row.lasting |= lasting
            if self.row.set_result(status, number, reason):
                self._loop.disarm()

    def _stop(self, *_: object) -> str | None:
        """Stop the stage if it moves. Return `ending` for a row that cannot be stopped because the link is lost.

        Else return None: the rule says the next state.
        """
        if self.state in ("homing", "jogging", "running", "held"):
            try:
                self.stage.link.send_byte(Immediate.STOP)
            except StageLostError:
                return "ending" if self.row else None
        return None

    def _disarm(self) -> None:
        self._loop.disarm()

    def _abort(self, reason: str) -> str | None:
        # STOP first: `_set_result` disarms the loop, which waits for the burst under way, and the call that sets the
        # line of that burst may hang.
        next_state = self._stop()
        self._set_result("aborted", PiFault.ABORTED, reason)
        return next_state

    def terminate(self) -> bool:
        """Stop the stage because the program is being ended. Returns True if a row has to end first."""
        self._terminating = True
        self.handle_event("Abort", "polysight-pi was ended")
        # No client waits for the end of a jog: the stage ends it without a command.
        self._finish_jog()
        if self.state == "stopping":
            self._deadline_s = self._clock() + END_TIMEOUT_S
        return self.row is not None

    def _fail_row(self, number: int, reason: str, lasting: bool = False) -> str | None:
        """Stop the stage and end row or jog with a fault; return as `_stop`."""
        next_state = self._stop()
        self._report_fault(number, reason)
        self._finish_jog("fault", number, reason)
        self._set_result("fault", number, reason, lasting)
        return next_state

    def _fail(self, number: int, reason: str) -> str | None:
        """Do as `_fail_row`, with a lasting fault."""
        return self._fail_row(number, reason, lasting=True)

    def _lose_stage(self, number: int, reason: str) -> None:
        """Handle a stage that is lost, in alarm, or reset: it cannot be stopped any more."""
        self.homed = False
        self.stage.slow_down_polling()
        if self.state != "fault":
            self._report_fault(number, reason)
        self._finish_jog("fault", number, reason)
        self._set_result("fault", number, reason, lasting=True)

    def _lose_position(self) -> None:
        self.homed = False

    def _time_out(self) -> None:
        """Handle a motion that has not ended in time: the stage counts as lost, unless the program is being ended."""
        if not self._terminating:
            reasons = {
                "homing": f"not homed after {HOMING_TIMEOUT_S} s",
                "jogging": "the jog has not ended, or the stage did not stop",
                "running": f"the row has not ended after {self.row_timeout_s:.0f} s",
                "stopping": "the stage did not stop",
            }
            self._lose_stage(PiFault.STAGE_LOST, reasons[self.state])

    def _note_passed(self, reply: Reply) -> str | None:
        """Note that the stage has reached the row's end; return `ending` if every burst was sent, else None."""
        row = self._current
        self.stage.slow_down_polling()
        row.points = max(0, _read_integer(reply, "points", row.row.points))
        row.triggers = _read_integer(reply, "pulses", row.points)
        row.done_ns = reply.written_ns
        row.was_held = bool(_read_integer(reply, "held"))
        end = (_read_integer(reply, "x", -1), _read_integer(reply, "y", -1))
        if end != row.motion.end and row.status is None:
            self.homed = False
            self._fail_row(PiFault.POSITION, f"the row ended at {end}, not at {row.motion.end} (x, y in steps)")
        if row.bursts >= row.row.points:
            return "ending"
        return None

    def _note_stopped(self, reply: Reply | None = None) -> None:
        """Handle the stage at rest after STOP; it may have reached the row's end before."""
        if reply is not None:
            self._current.points = max(0, _read_integer(reply, "points", self._current.row.points))
        self._set_result("aborted", PiFault.ABORTED, "the stage was stopped")
        self._clear_alarm()

    def _clear_alarm(self) -> None:
        """Clear the alarm that STOP latches; the stage keeps its position."""
        self.stage.slow_down_polling()
        try:
            self._tell_stage(self.stage.clear)
        except StageRefusedError as e:
            self.homed = self.homed and e.number not in POSITION_LOST_ERRORS

    def _finish_row(self) -> str:
        """Judge and journal the row; return the next state."""
        row = self._current
        counts = self._loop.disarm()
        if row.status is None:
            row.judge(counts)
            if row.fault:
                self._report_fault(row.fault, row.reason)
        self._journal.add(
            m.RowFinished, row_index=row.row.index, take=row.take, status=row.status, points=row.points,
            **counts._asdict(), fault=row.fault, reason=row.reason, timed_by=self._loop.timed_by,
            pulses_seen=self._loop.sees_pulses,
        )  # fmt: skip
        self.row = None
        if row.lasting:
            return "fault"
        return self._at_rest_state

    @property
    def _current(self) -> RunningRow:
        """The row of a state that has one. Raises RuntimeError in any other."""
        if self.row is None:
            raise RuntimeError(f"state {self.state} without a row")
        return self.row

    def _forget_fault(self) -> None:
        self.fault = 0
        self.reason = ""

    def _report_fault(self, number: int, reason: str) -> None:
        """Journal a fault, and keep it for Status if it is the first one."""
        explanation = explain(number)
        if not self.fault:
            self.fault = int(number)
            self.reason = reason
        self._journal.add(
            m.Fault,
            number=int(number),
            problem=f"{explanation.problem}: {reason}",
            cause=explanation.cause,
            remedy=explanation.remedy,
        )


def _read_integer(reply: Reply, key: str, absent: int = 0) -> int:
    """Return an integer field of a reply; `absent` if the reply does not have it."""
    try:
        return reply.integer(key)
    except ProtocolError:
        return absent
