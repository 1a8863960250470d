"""From the plan's millimetres to the stage's steps, and the checks that a plan suits this rig."""

from __future__ import annotations

from typing import NamedTuple

from polysight.pi_controller.bursts import BurstSpec
from polysight.shared.config import Stage
from polysight.shared.errors import PolysightError
from polysight.shared.faults import PiFault, explain
from polysight.shared.messages import BeginRun
from polysight.shared.raster import (
    MAX_WIDTH_NS,
    MIN_PERIOD_NS,
    MIN_PERIOD_US,
    MIN_WIDTH_NS,
    WIDTH_TEXT,
    RasterPlan,
    Row,
)
from polysight.shared.units import us_to_ns


class RefusedError(PolysightError):
    """A command cannot be taken; `number` is of shared/faults.py."""

    def __init__(self, number: int, what: str, why: str = "", remedy: str = "") -> None:
        table = explain(number)
        super().__init__(what, why or table.why, remedy or table.remedy)
        self.number = int(number)


class StageRow(NamedTuple):
    """Arguments of the stage's ROW: first point, signed step, points, y (all in steps), speed in steps/s."""

    x0: int
    dx: int
    points: int
    y: int
    feed: int


def stage_row(row: Row, stage: Stage, speed_mm_s: float) -> StageRow:
    """A row in stage steps: (centre + offset) * steps_per_mm."""
    k = stage.steps_per_mm
    return StageRow(
        round((stage.centre_x_mm + row.x_start_mm) * k),
        round(row.step_mm * k),
        row.points,
        round((stage.centre_y_mm + row.y_mm) * k),
        round(speed_mm_s * k),
    )


def row_duration_s(row: Row, stage: Stage, speed_mm_s: float) -> float:
    """About how long a row takes, the longest way to its first point included."""
    travel_s = (stage.travel_x_mm + stage.travel_y_mm) / stage.travel_speed_mm_s
    return travel_s + abs(row.step_mm) * row.points / speed_mm_s + 4 * speed_mm_s / stage.accel_mm_s2


def check_run(run: BeginRun, stage: Stage) -> None:
    """Compare a run with this rig. Raises RefusedError with the values that do not go together."""
    plan, period_ns = run.plan, check_pulses(run.pulses, run.period_us, run.width_us).period_ns
    _require(plan.columns >= 1 and plan.rows >= 1, f"plan of {plan.columns} x {plan.rows} points is empty")
    _require(plan.step_x_mm > 0 and plan.step_y_mm > 0, "steps of the plan must be positive")
    fastest = max(stage.speed_mm_s, stage.travel_speed_mm_s)
    _require(
        0 < run.speed_mm_s <= fastest,
        f"speed of {run.speed_mm_s} mm/s is outside 0..{fastest} mm/s of this rig's [stage]",
    )
    steps = plan.step_x_mm * stage.steps_per_mm
    _require(
        abs(steps - round(steps)) < 1e-6 and round(steps) >= 1,
        f"step of {plan.step_x_mm} mm is {steps:g} motor steps: it must be a whole number",
    )
    between_s, burst_s = plan.step_x_mm / run.speed_mm_s, run.pulses * period_ns * 1e-9
    _require(
        burst_s <= between_s,
        f"burst of {run.pulses} x {run.period_us} us lasts {burst_s * 1e3:.2f} ms, a point passes every "
        f"{between_s * 1e3:.2f} ms at {run.speed_mm_s} mm/s",
    )
    misfit = stage.misfit(plan, run.speed_mm_s)
    _require(not misfit, misfit)


def check_pulses(pulses: int, period_us: float, width_us: float) -> BurstSpec:
    """The burst, where the radars take it. Raises RefusedError PERIOD_TOO_SHORT or PULSE_TOO_LONG."""
    period_ns, width_ns = us_to_ns(period_us), us_to_ns(width_us)
    if period_ns < MIN_PERIOD_NS:
        raise RefusedError(PiFault.PERIOD_TOO_SHORT, f"period of {period_us} us is below {MIN_PERIOD_US} us")
    if not MIN_WIDTH_NS <= width_ns <= MAX_WIDTH_NS:
        raise RefusedError(PiFault.PULSE_TOO_LONG, f"pulse width of {width_us} us is outside {WIDTH_TEXT}")
    return BurstSpec(pulses, period_ns, width_ns)


def row_of(plan: RasterPlan, index: int) -> Row:
    """A row of the plan. Raises RefusedError outside it."""
    if index >= plan.rows:
        raise RefusedError(PiFault.BAD_REQUEST, f"row {index} is outside the plan's {plan.rows} rows")
    return plan.row(index)


def _require(ok: bool, what: str) -> None:
    if not ok:
        raise RefusedError(PiFault.BAD_REQUEST, what)
