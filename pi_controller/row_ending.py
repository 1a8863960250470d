"""How a row ends, whatever ends it, and the limits of all that is waited for. The part of the state machine below its
commands (machine.py).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from polysight.pi_controller.ledger import Ledger
from polysight.pi_controller.running_row import RunningRow
from polysight.pi_controller.stage_driver import STOP_LIMIT_S, StageDriver
from polysight.pi_controller.stage_link import StageLostError
from polysight.pi_controller.states import States
from polysight.pi_controller.supervision import HostWatch, Limit
from polysight.pi_controller.trigger_loop import TriggerLoop
from polysight.shared import messages as m
from polysight.shared.faults import PiFault, explain
from polysight.shared.stage_line import Immediate


class Parts(NamedTuple):
    """What the state machine works with.

    Attributes
    ----------
    stage, loop, ledger
        The stage, the trigger loop and the events.
    post
        Puts a call behind everything that waits in the executor's queue.
    row_ended
        Called when a row has ended, after its RowFinished.
    clock
        Seconds, monotonic.
    """

    stage: StageDriver
    loop: TriggerLoop
    ledger: Ledger
    post: Callable[[Callable[[], None]], None]
    row_ended: Callable[[RunningRow], None]
    clock: Callable[[], float] = time.monotonic


class RowEnding:
    """Stage, trigger loop and the row that runs."""

    def __init__(self, parts: Parts) -> None:
        self.stage, self._loop, self._ledger, self._post, self._row_ended, self._clock = parts
        self._states = States()
        self.host = HostWatch()
        self.homed = self.in_run = False
        self.row: RunningRow | None = None
        self._homing: int | None = None
        self._limit = Limit()

    @property
    def state(self) -> m.State:
        """The state."""
        return self._states.now

    @property
    def fault(self) -> int:
        """Number of the first fault; 0 when there is none."""
        return self._states.fault

    @property
    def reason(self) -> str:
        """Reason of the first fault."""
        return self._states.reason

    def hear_host(self) -> None:
        """The host of the run lives. From any thread."""
        self.host.heard(self._clock())

    @property
    def host_lives(self) -> bool:
        """Whether the host of the run has kept its promise to be heard until now."""
        return self.host.lives(self._clock())

    # --- ends -------------------------------------------------------------------------------------------------------

    def end_row(self, status: m.RowStatus, number: int, reason: str, wait: bool, latch: bool = False) -> None:
        """Decide how the row ends; with `wait`, stop the stage and wait until it stands. The first decision stays."""
        row = self.row
        if row is None:
            return
        row.latch |= latch
        if row.status is None:
            row.status, row.fault, row.reason = status, int(number), reason
            self._loop.disarm()
            if status == "fault":
                self._tell_fault(number, reason)
            if wait and not row.standing and self._stop_byte():
                row.stop_limit = self._clock() + STOP_LIMIT_S
                self._wait(STOP_LIMIT_S, lambda: self.fail(PiFault.STAGE_LOST, "the stage did not stop"))
                return
        elif wait and not row.standing:
            return  # being stopped already
        self._finish_soon(row)

    def _stop_byte(self) -> bool:
        try:
            self.stage.send(Immediate.STOP)
        except StageLostError:
            return False
        return True

    def _finish(self, row: RunningRow) -> None:
        if self.row is not row:
            return
        self._limit.clear()
        counts = self._loop.disarm()
        if row.status is None and not row.judge(counts):
            self._tell_fault(row.fault, row.reason)
        self.emit(m.RowFinished, **row.outcome(counts), timed_by=self._loop.timed_by(row.job.spec))
        self.row = None
        self._go("fault" if row.latch else "ready" if self.homed else "idle")  # a row has a run
        self._row_ended(row)

    def fail(self, number: int, reason: str, wait: bool = False) -> None:
        """A fault that only homing gets out of. With `wait` the stage still answers, and is stopped first."""
        if number in (PiFault.STAGE_LOST, PiFault.STAGE_ALARM):
            self.homed = False
            self.stage.at_rest()
        if self._homing is not None and wait:
            self._stop_byte()
        self._homing = None
        self._limit.clear()
        if self.row is not None:
            if self.row.status is not None:
                self._tell_fault(number, reason)
            self.end_row("fault", number, reason, wait, latch=True)
        elif self.state != "fault":
            self._tell_fault(number, reason)
            self._go("fault")

    def _tell_fault(self, number: int, reason: str) -> None:
        table = explain(number)
        self._states.note_fault(number, reason)
        self.emit(m.Fault, number=int(number), what=f"{table.what}: {reason}", why=table.why, remedy=table.remedy)

    # --- time -------------------------------------------------------------------------------------------------------

    def seconds_left(self) -> float | None:
        """Until something is due; None when nothing is."""
        at_s = min(self._limit.at_s, self.host.lost_at_s if self._host_matters else math.inf)
        return None if at_s == math.inf else max(0.0, at_s - self._clock())

    def check_limits(self) -> None:
        """Act on what is due."""
        now_s = self._clock()
        self._limit.check(now_s)
        if self._host_matters and now_s >= self.host.lost_at_s:
            silence = f"nothing was heard of the host for {self.host.limit_s * 1e3:.0f} ms"
            self.end_row("fault", PiFault.HOST_LOST, silence, wait=True)

    @property
    def _host_matters(self) -> bool:
        return self.row is not None and self.row.status is None and not self.row.standing

    def _wait(self, limit_s: float, expired: Callable[[], None]) -> None:
        self._limit.set(self._clock() + limit_s, expired)

    # --- small things -----------------------------------------------------------------------------------------------

    def _go(self, state: m.State) -> None:
        self._states.go(state)

    def emit(self, kind: Any, **fields: Any) -> None:
        """Add an event to the ledger; words are cut to what a reader takes."""
        fields = {k: v[: m.MOST_TEXT] if isinstance(v, str) else v for k, v in fields.items()}
        self._ledger.add(kind(scan_id="", seq=0, t_mono_ns=0, **fields))

    def _finish_when_complete(self, row: RunningRow) -> None:
        if row.status is None and row.standing and row.bursts >= row.row.points:
            self._finish_soon(row)

    def _finish_soon(self, row: RunningRow) -> None:
        """Behind whatever the trigger loop has put into the queue."""
        if not row.finishing:
            row.finishing = True
            self._limit.clear()
            self._post(lambda: self._finish(row))
