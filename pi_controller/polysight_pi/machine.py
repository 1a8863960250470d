"""The state machine of stage, run and row: RULES lists the events of each state, their actions and the next states.

The actions are methods of `RowMachine` (row_machine.py). docs/spec/wire.md, "State machine", has the same tables.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, Literal, NamedTuple

from polysight_shared import messages as m
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import PolysightError
from polysight_shared.faults import PiFault
from polysight_shared.stage_line import HOMING_TIMEOUT_S


class RefusedError(PolysightError):
    """A command is refused with a PiFault number; polysight_shared/faults.py has the default texts of each number."""

    def __init__(self, number: int, what: str, why: str = "", remedy: str = "") -> None:
        super().__init__(what, why, remedy, code=ErrorCode.REFUSED_BY_PEER)
        self.number = int(number)


State = Literal["idle", "homing", "homed", "ready", "running", "held", "stopping", "done", "ending", "fault"]


class Rule(NamedTuple):
    """Action (name of a method) and next state of an event in the listed states.

    `leads_to` has the possible next states, the default first; the action may return one of the others.
    """

    event: str
    states: str
    leads_to: str
    action: str = "nothing"


RULES = (
    # Commands; refused in all other states.
    Rule("Home", "idle homed ready fault", "homing", "home"),
    Rule("Home", "homing", "same"),
    Rule("BeginRun", "homed", "ready", "begin_run"),
    Rule("BeginRun", "idle homing ready fault", "same", "begin_run"),
    Rule("EndRun", "ready", "homed", "end_run"),
    Rule("EndRun", "idle homing homed fault", "same", "end_run"),
    Rule("RunRow", "ready", "running", "start_row"),
    Rule("Hold", "running", "held", "hold"),
    Rule("Hold", "held", "same"),
    Rule("Resume", "held", "running", "resume"),
    Rule("Resume", "running", "same"),
    Rule("Abort", "running held", "stopping ending", "abort"),
    Rule("Abort", "done", "ending", "abort"),
    Rule("Abort", "homing", "same", "stop"),
    Rule("Abort", "idle homed ready stopping ending fault", "same"),
    Rule("Pulse", "idle homed fault", "same"),
    # Replies of the stage; ignored in all other states.
    Rule("homed", "homing", "homed ready", "note_homed"),
    Rule("passed", "running held", "done ending", "note_passed"),
    Rule("passed", "stopping", "ending", "note_stopped"),
    Rule("stopped", "running held stopping done", "ending", "note_stopped"),
    Rule("stopped", "homing", "idle", "clear_alarm"),
    Rule("stopped", "idle homed ready ending fault", "same", "clear_alarm"),
    Rule("not homed", "ready", "idle", "lose_position"),
    Rule("stage lost", "idle homing homed ready", "fault", "lose_stage"),
    Rule("stage lost", "running held stopping done", "ending", "lose_stage"),
    Rule("stage lost", "ending fault", "same", "lose_stage"),
    # Trigger line, host, journal, time.
    Rule("row fault", "running held", "stopping ending", "fail_row"),
    Rule("row fault", "done", "ending", "fail_row"),
    Rule("lasting fault", "idle homing homed ready", "fault", "fail"),
    Rule("lasting fault", "running held", "stopping ending", "fail"),
    Rule("lasting fault", "done", "ending", "fail"),
    Rule("lasting fault", "stopping ending", "same", "fail"),
    Rule("all sent", "done", "ending"),
    Rule("timeout", "homing", "fault", "time_out"),
    Rule("timeout", "running stopping", "ending", "time_out"),
    Rule("timeout", "done", "ending", "disarm"),
    Rule("settled", "ending", "ready idle fault", "finish_row"),
)
TIMEOUTS_S: dict[State, float] = {
    "homing": HOMING_TIMEOUT_S,
    "stopping": 3.0,  # from STOP to standstill
    "done": 1.0,  # from the stage's `done` to the last burst
}  # running: set for each row; all others: no limit
END_TIMEOUT_S = 0.5  # from STOP to standstill when the program is being ended
HOST_MISSES = 4  # missing heartbeats after which the host is lost
WIRE_STATE: dict[State, m.State] = {"stopping": "running", "ending": "done"}  # the others have the same name


class Machine:
    """Applies RULES, checks the time limit of the state and, during a row, the host's heartbeat.

    Used by the executor's thread only, except `note_host_alive`.
    """

    def __init__(self, post: Callable[[Callable[[], object]], None], clock: Callable[[], float]) -> None:
        self._post, self._clock = post, clock
        self.state: State = "idle"
        self.reason = ""  # of the first fault
        self.row_timeout_s = math.inf
        self._deadline_s = math.inf
        self.watch_host(0)
        self._rules: dict[tuple[str, str], tuple[list[Any], Callable[..., str | None]]] = {
            (state, rule.event): (rule.leads_to.split(), getattr(self, f"_{rule.action}"))
            for rule in RULES
            for state in rule.states.split()
        }

    def happen(self, event: str, *args: Any) -> bool:
        """Apply the rule of this event in the current state; return False if there is none."""
        if (self.state, event) not in self._rules:
            return False
        possible, action = self._rules[self.state, event]
        before = self.state
        state: Any = action(*args) or possible[0]
        if state not in possible:
            raise RuntimeError(f"{event} in state {before} does not lead to {state}")
        if state != "same":
            self._enter(state)
        return True

    def _enter(self, state: State) -> None:
        timeout_s = self.row_timeout_s if state == "running" else TIMEOUTS_S.get(state, math.inf)
        self.state, self._deadline_s = state, self._clock() + timeout_s
        if state == "ending":  # after the bursts that are still in the queue
            self._post(partial(self.happen, "settled"))

    def require(self, event: str) -> None:
        """Raise RefusedError if this command has no rule in the current state."""
        if (self.state, event) not in self._rules:
            row = self.state in ("running", "held", "stopping", "done", "ending")
            raise RefusedError(
                PiFault.NOT_READY,
                f"no {event} in state {self.wire_state}" + (f": {self.reason}" if self.reason else ""),
                f"the state is {self.wire_state}",
                "wait for the row's end, or abort it" if row else "begin a run, home the stage, start a row",
            )

    def command(self, event: str, *args: Any) -> None:
        """Execute a command. Raises RefusedError."""
        self.require(event)
        self.happen(event, *args)

    @property
    def wire_state(self) -> m.State:
        """The name of the state in messages."""
        return WIRE_STATE.get(self.state) or self.state  # pyright: ignore[reportReturnType]

    def _nothing(self, *_: object) -> None:
        pass

    # --- time -------------------------------------------------------------------------------------------------------

    def watch_host(self, heartbeat_ms: int) -> None:
        """Expect the host's heartbeat at this interval; 0 disables the check."""
        self._host_timeout_s = HOST_MISSES * heartbeat_ms / 1e3 if heartbeat_ms else math.inf
        self._host_alive_s = self._clock()

    def note_host_alive(self) -> None:
        """Note a heartbeat of the run's host. From any thread."""
        self._host_alive_s = max(self._host_alive_s, self._clock())

    @property
    def host_lives(self) -> bool:
        """True if every heartbeat so far arrived on time; False if none is expected."""
        return self._host_timeout_s < math.inf and self._clock() < self._host_alive_s + self._host_timeout_s

    @property
    def _host_lost_s(self) -> float:
        return self._host_alive_s + self._host_timeout_s if self.state in ("running", "held") else math.inf

    def seconds_left(self) -> float | None:
        """Return the time until the next deadline, or None."""
        at_s = min(self._deadline_s, self._host_lost_s)
        return None if at_s == math.inf else max(0.0, at_s - self._clock())

    def check_deadlines(self) -> None:
        """Handle deadlines that have passed."""
        if self._clock() >= self._deadline_s:
            self.happen("timeout")
        if self._clock() >= self._host_lost_s:
            reason = f"no heartbeat of the host for {self._host_timeout_s * 1e3:.0f} ms"
            self.happen("row fault", PiFault.HOST_LOST, reason)
