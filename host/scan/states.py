"""The states of one take of a row, and which follows which. docs/spec/row.md holds the same table, for people."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum

from polysight.shared.errors import ScanError


class RowState(StrEnum):
    """Where one take of a row is."""

    WAITING = "waiting"
    ARMING = "arming"
    RUNNING = "running"
    ABORTING = "aborting"
    COLLECTING = "collecting"
    WRITING = "writing"
    CHECKING = "checking"
    COMMITTED = "committed"
    KEPT = "kept"
    REJECTED = "rejected"
    STOPPED = "stopped"
    FAILED = "failed"


S = RowState
TRANSITIONS: dict[RowState, frozenset[RowState]] = {
    S.WAITING: frozenset({S.ARMING, S.STOPPED, S.FAILED}),
    S.ARMING: frozenset({S.RUNNING, S.WRITING, S.FAILED}),
    S.RUNNING: frozenset({S.COLLECTING, S.ABORTING, S.WRITING, S.FAILED}),
    S.ABORTING: frozenset({S.COLLECTING, S.WRITING, S.FAILED}),
    S.COLLECTING: frozenset({S.WRITING, S.FAILED}),
    S.WRITING: frozenset({S.CHECKING, S.FAILED}),
    S.CHECKING: frozenset({S.COMMITTED, S.KEPT, S.REJECTED, S.FAILED}),
    S.COMMITTED: frozenset(),
    S.KEPT: frozenset(),
    S.REJECTED: frozenset(),
    S.STOPPED: frozenset(),
    S.FAILED: frozenset(),
}


class RowTransaction:
    """One take on its way through the states; `tell` hears of each one, the first included."""

    def __init__(self, tell: Callable[[RowState], None]) -> None:
        self._tell = tell
        self.state = RowState.WAITING
        tell(self.state)

    def to(self, state: RowState) -> None:
        """Go on to a state. Raises ScanError when it does not follow from the one before: a fault of this program."""
        if state not in TRANSITIONS[self.state]:
            raise ScanError(f"a row went from {self.state} to {state}", "a fault of this program", "report it")
        self.state = state
        self._tell(state)

    def fail(self) -> None:
        """End as failed, unless it has ended already."""
        if TRANSITIONS[self.state]:
            self.to(RowState.FAILED)
