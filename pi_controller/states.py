"""The states of stage and row, which may follow which, and the fault that came first."""

from __future__ import annotations

from polysight.shared.messages import State

#   idle --home--> homing --> homed --run begun--> ready --row--> running <--> held
#     ^______________|__________|____________________|               | stage at the row's end
#   any --fault--> fault --home--> homing            |____counted___ done
MOVES: dict[State, tuple[State, ...]] = {
    "idle": ("homing", "fault"),
    "homing": ("homed", "ready", "idle", "fault"),
    "homed": ("ready", "homing", "idle", "fault"),
    "ready": ("running", "homed", "homing", "idle", "fault"),
    "running": ("held", "done", "ready", "idle", "fault"),
    "held": ("running", "done", "ready", "idle", "fault"),
    "done": ("ready", "idle", "fault"),
    "fault": ("homing",),
}
MOVING: tuple[State, ...] = ("homing", "running", "held")


class States:
    """The state, and the number and reason of the first fault since it was last cleared."""

    def __init__(self) -> None:
        self.now: State = "idle"
        self.fault, self.reason = 0, ""

    def go(self, state: State) -> None:
        """Change to a state. Raises RuntimeError for a move that is none of the machine's."""
        if state != self.now and state not in MOVES[self.now]:
            raise RuntimeError(f"{self.now} -> {state} is not a move of the state machine")
        self.now = state

    def note_fault(self, number: int, reason: str) -> None:
        """The first fault wins."""
        if not self.fault:
            self.fault, self.reason = int(number), reason

    def clear_fault(self) -> None:
        """Homing, or the next row, begins."""
        self.fault, self.reason = 0, ""
