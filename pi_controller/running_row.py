"""The row in motion: what is known of it, and how it is judged at its end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from polysight.pi_controller.trigger_loop import Counts, RowJob
from polysight.shared import messages as m
from polysight.shared.faults import PiFault
from polysight.shared.raster import Row


@dataclass
class RunningRow:
    """A row the stage has taken. `status` is set when its end is decided before the stage has come to it."""

    row: Row
    take: int
    sequence: int  # of the stage's ROW, and of its `done`
    job: RowJob
    limit_s: float
    status: m.RowStatus | None = None
    fault: int = 0
    reason: str = ""
    latch: bool = False  # the state is fault afterwards
    standing: bool = False  # the stage has said `done`, or has stopped
    finishing: bool = False
    points: int = 0  # passed, by the stage's count
    bursts: int = 0  # told to the host
    stop_limit: float = 0.0

    def judge(self, counts: Counts) -> bool:
        """Set the status of a row that came to its end: `done` when every count agrees, else `fault`."""
        n, pulses = self.row.points, self.row.points * self.job.spec.pulses
        if (self.points, *counts) == (n, n, n, pulses):
            self.status = "done"
            return True
        self.status, self.fault = "fault", int(PiFault.POINTS_MISMATCH)
        self.reason = (
            f"{n} points asked for, {self.points} passed by the stage, {counts.edges} edges seen, "
            f"{counts.bursts} bursts and {counts.pulses} of {pulses} pulses sent"
        )
        return False

    def outcome(self, counts: Counts) -> dict[str, Any]:
        """Fields of RowFinished."""
        return {
            "row_index": self.row.index,
            "take": self.take,
            "status": self.status,
            "points": self.points,
            **counts._asdict(),
            "fault": self.fault,
            "reason": self.reason,
        }
