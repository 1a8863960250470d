"""The serpentine raster plan: which rows, in which order and direction, and where every position is.

Offsets are in the rig frame, in millimetres, zero = middle of the grid (docs/spec/scan-folder.md).
"""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from polysight.shared.config import Burst, Grid, Stage
from polysight.shared.errors import ConfigError

FIRST_PULSE_DELAY_S = 200e-6
"""From a trigger edge to its first SYNC_IN pulse: the Pi's fixed delay, longer than its usual wake-up."""


class Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One row of the grid: `points` trigger positions from `x_start_mm`, `step_mm` apart (signed), at `y_mm`.

    `index` counts rows from the smallest y; even rows run towards +x, odd rows towards -x.
    """

    index: int
    y_mm: float
    x_start_mm: float
    step_mm: float
    points: int

    @property
    def direction(self) -> int:
        """+1 when the stage moves towards +x, else -1."""
        return 1 if self.step_mm > 0 else -1

    def column(self, i: int) -> int:
        """Grid column (0 = smallest x) of the i-th point met in this row."""
        return i if self.direction > 0 else self.points - 1 - i

    @property
    def x_mm(self) -> tuple[float, ...]:
        """Nominal x offset of every point, in the order they are met (plain numbers: the Pi has no NumPy)."""
        return tuple(self.x_start_mm + i * self.step_mm for i in range(self.points))


class RasterPlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A grid walked row by row. Build with :func:`plan_raster`."""

    columns: int
    rows: int
    step_x_mm: float
    step_y_mm: float

    def row(self, index: int) -> Row:
        """Row `index` (0-based from the smallest y). Raises IndexError outside the plan."""
        if not 0 <= index < self.rows:
            raise IndexError(f"row {index} is outside the plan's {self.rows} rows")
        half_width = (self.columns - 1) / 2 * self.step_x_mm
        sign = 1 if index % 2 == 0 else -1
        y_mm = (index - (self.rows - 1) / 2) * self.step_y_mm
        return Row(index, y_mm, -sign * half_width, sign * self.step_x_mm, self.columns)

    def __iter__(self) -> Iterator[Row]:
        return (self.row(i) for i in range(self.rows))

    @property
    def positions(self) -> int:
        """Number of grid positions."""
        return self.columns * self.rows


def plan_raster(grid: Grid) -> RasterPlan:
    """The plan of a configured grid."""
    return RasterPlan(grid.columns, grid.rows, grid.step_x_mm, grid.step_y_mm)


def burst_duration_s(burst: Burst) -> float:
    """Time from the first to the last SYNC_IN pulse of a position, in seconds."""
    return (burst.pulses - 1) * burst.period_us * 1e-6


def burst_middle_s(burst: Burst) -> float:
    """Time from a trigger edge to the middle of its burst, in seconds."""
    return FIRST_PULSE_DELAY_S + burst_duration_s(burst) / 2


def check_burst_fits(grid: Grid, burst: Burst, stage: Stage) -> None:
    """Refuse a plan whose burst does not end before the next trigger point.

    Raises
    ------
    ConfigError
        naming both times.
    """
    between_s = grid.step_x_mm / stage.speed_mm_s
    burst_s = burst.pulses * burst.period_us * 1e-6
    if burst_s > between_s:
        raise ConfigError(
            f"burst of {burst.pulses} pulses x {burst.period_us} us lasts {burst_s * 1e3:.2f} ms, but the stage passes"
            f" a point every {between_s * 1e3:.2f} ms",
            "stage.speed_mm_s, grid.step_x_mm and burst do not go together",
            "slow the stage, widen the step, or send fewer or faster pulses",
        )


def mean_burst_travel_mm(burst: Burst, stage: Stage) -> float:
    """Distance from a trigger point to the mean position of its burst, along the direction of motion.

    The stage does not stop: 16 pulses 1.5 ms apart at 20 mm/s, the first 0.2 ms after the edge, are centred 0.229 mm
    after the point.
    """
    return stage.speed_mm_s * burst_middle_s(burst)
