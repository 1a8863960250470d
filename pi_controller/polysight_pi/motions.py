"""Motions of the stage that are under way: a jog, or a row with its counts and result."""

from __future__ import annotations

from dataclasses import dataclass

from polysight_pi.edges import EdgeTimes, RowMotion
from polysight_pi.trigger import Counts, Job
from polysight_shared import messages as m
from polysight_shared.faults import PiFault
from polysight_shared.raster import Row, Stage
from polysight_shared.stage_line import END_OF_TIME_NS


@dataclass(kw_only=True)
class _Motion:
    """A motion that the stage has started. Its result is decided once, perhaps before it ends."""

    # Number of the line that started it; the stage's `done` line repeats it.
    sequence: int
    # The result: None until it is decided.
    status: m.RowStatus | None = None
    # Number of the `PiFault`; 0: none.
    fault: int = 0
    reason: str = ""

    def set_result(self, status: m.RowStatus, fault: int = 0, reason: str = "") -> bool:
        """Set the result; return False if it is set already."""
        if self.status is not None:
            return False
        self.status = status
        self.fault = int(fault)
        self.reason = reason
        return True


@dataclass(kw_only=True)
class RunningJog(_Motion):
    """A jog: a move of one axis by a distance, by hand. It belongs to no run."""

    # The command that started it.
    command: m.Jog
    # X and y at its end, stage coordinates in motor steps.
    target: tuple[int, int]
    # The jog is stopped this long after the latest heartbeat of the host that commanded it.
    timeout_s: float
    # Time of that heartbeat, on the monotonic clock.
    alive_s: float


@dataclass(kw_only=True)
class RunningRow(_Motion):
    """A row with its counts."""

    # Place of the row in the plan, millimetres.
    row: Row
    # Number of the attempt at this row: 1, and one more for each retake.
    take: int
    # The orders to the trigger loop: number of edges, and the burst for each. Bursts that it reports name their job.
    job: Job
    # The row in motor steps.
    motion: RowMotion
    # The edges so far, with the stage's reports.
    edges: EdgeTimes
    # True once the stage has accepted the row: statuses before that belong to the motion before.
    is_underway: bool = False
    # True if the state of the Pi after the row is `fault`, not `ready` or `homed`.
    lasting: bool = False
    # Points that the stage has passed, by its own count.
    points: int = 0
    # Pulses that the stage has given on its trigger pin, by its own count; known at the row's end.
    triggers: int = 0
    # Bursts that were given to the journal, which reports them to the host.
    bursts: int = 0
    # True if the stage reported a hold within the row.
    was_held: bool = False
    # Latest time at which the stage can have written the row's `done` line, on the clock of the edges.
    done_ns: int = END_OF_TIME_NS

    def judge(self, counts: Counts) -> None:
        """Set the result of a row that was not stopped: `done` if all counts and edge times agree, else `fault`."""
        points = self.row.points
        pulses = points * self.job.spec.pulses
        if self.points == self.triggers == points and counts == Counts(points, points, pulses):
            time_problem = self.edges.judge(self.was_held, self.done_ns)
            if time_problem:
                self.set_result("fault", PiFault.EDGE_TIME, time_problem)
            elif self.was_held:
                self.set_result("done", reason="held during the row: some positions were passed below full speed")
            else:
                self.set_result("done")
            return
        reason = (
            f"{points} points requested, {self.points} passed by the stage with {self.triggers} trigger pulses, "
            f"{counts.edges} edges received, {counts.bursts} bursts and {counts.pulses} of {pulses} pulses sent"
        )
        self.set_result("fault", PiFault.POINTS_MISMATCH, reason)


def estimate_row_duration_s(row: Row, stage: Stage, speed_mm_s: float) -> float:
    """Estimate the duration of a row at `speed_mm_s`, seconds, including the longest travel to its first point."""
    travel_s = (stage.travel_x_mm + stage.travel_y_mm) / stage.travel_speed_mm_s
    points_s = abs(row.step_mm) * row.points / speed_mm_s
    # Two ramps of the travel and two of the row, all as if at the row's speed (an estimate).
    ramps_s = 4 * speed_mm_s / stage.accel_mm_s2
    return travel_s + points_s + ramps_s
