"""`[stage]` and `[grid]` of the rig file: the motion stage, and the raster that must fit its travel."""

from __future__ import annotations

from typing import TYPE_CHECKING

from polysight.shared.section import Count, NonNegative, Positive, Section, require

if TYPE_CHECKING:
    from polysight.shared.raster import RasterPlan

_PLACING = ("steps_per_mm", "centre_x_mm", "centre_y_mm", "backlash_mm", "accel_mm_s2")


class Grid(Section, frozen=True):
    """Serpentine raster of stage positions."""

    columns: Count
    rows: Count
    step_x_mm: Positive
    step_y_mm: Positive


class Stage(Section, frozen=True):
    """Motion stage and its serial link."""

    port: str
    baud: Count = 115200
    steps_per_mm: Positive = 200.0
    speed_mm_s: Positive = 20.0
    travel_speed_mm_s: Positive = 40.0
    accel_mm_s2: Positive = 200.0
    heartbeat_ms: Count = 500
    trigger_width_us: Count = 20
    travel_x_mm: Positive = 800.0
    travel_y_mm: Positive = 500.0
    centre_x_mm: NonNegative = 400.0
    centre_y_mm: NonNegative = 250.0
    backlash_mm: NonNegative = 0.0

    def __post_init__(self) -> None:
        require(self.centre_x_mm <= self.travel_x_mm, "centre_x_mm must lie within travel_x_mm")
        require(self.centre_y_mm <= self.travel_y_mm, "centre_y_mm must lie within travel_y_mm")

    @property
    def placing(self) -> dict[str, float]:
        """The values by which rows are placed: they come from the Pi's rig file, and must be those of the host's."""
        return {key: float(getattr(self, key)) for key in _PLACING}

    def run_up_mm(self, step_mm: float, speed_mm_s: float | None = None) -> float:
        """From rest to a row's first point: the ramp v^2 / 2a, and a step (or the backlash) at constant speed.

        `speed_mm_s`: of the row; `[stage]`'s own when None. docs/spec/stage-line.md, "A row".
        """
        speed = self.speed_mm_s if speed_mm_s is None else speed_mm_s
        return speed**2 / (2 * self.accel_mm_s2) + max(step_mm, self.backlash_mm)

    def misfit(self, raster: Grid | RasterPlan, speed_mm_s: float | None = None) -> str:
        """Why a raster with its run-up does not fit the travel around the centre; "" when it does."""
        for axis, n, step, margin, centre, travel in (
            ("x", raster.columns, raster.step_x_mm, self.run_up_mm(raster.step_x_mm, speed_mm_s),
             self.centre_x_mm, self.travel_x_mm),
            ("y", raster.rows, raster.step_y_mm, self.backlash_mm, self.centre_y_mm, self.travel_y_mm),
        ):  # fmt: skip
            half = (n - 1) / 2 * step + margin
            if half > centre or centre + half > travel:
                return (
                    f"grid of {n} x {step} mm in {axis} with {margin:g} mm of run-up on either side does not fit the"
                    f" travel 0..{travel} mm around centre {centre} mm: narrow the grid, slow down, or raise"
                    " accel_mm_s2"
                )
        return ""
