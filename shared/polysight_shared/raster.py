"""Grid, stage and burst of the rig file (`[grid]`, `[stage]`, `[burst]`), and the serpentine plan of rows.

Offsets are in the rig frame, in millimetres, zero = middle of the grid (docs/spec/scan-folder.md). Limits of SYNC_IN
are those of the AWR2243 (TI mmWave Radar Interface Control, frame configuration; data sheet).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal

import msgspec

from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.tables import Count, NonNegative, Positive, Section, require
from polysight_shared.units import us_to_ns

FIRST_PULSE_DELAY_S = 200e-6
"""Fixed delay from a trigger edge to its first SYNC_IN pulse, longer than the usual wake-up time of the Pi;
chosen."""
# Shortest period between rising edges: a shorter one causes a fatal fault of the RF core
# (docs/spec/mmwavelink.md).
MIN_PERIOD_US = 300.0
# Shortest and longest SYNC_IN pulse.
WIDTH_US = (0.025, 4.0)
# These two as text for messages, and the limits in nanoseconds.
WIDTH_TEXT = f"{WIDTH_US[0]:g}..{WIDTH_US[1]:g} us"
MIN_PERIOD_NS = us_to_ns(MIN_PERIOD_US)
MIN_WIDTH_NS, MAX_WIDTH_NS = map(us_to_ns, WIDTH_US)
# Types of fields. `_Points` counts columns or rows, `_Step` is the distance of two points in mm, `_Motion` is a speed,
# an acceleration or a number of steps per mm, `_Steps` an index or number of rows or points, `_Offset` a coordinate or
# signed distance in mm.
_Points = Annotated[int, msgspec.Meta(ge=1, lt=100_000)]
_Motion = Annotated[float, msgspec.Meta(ge=0.001, le=1e6)]
# A micrometre, a fifth of a motor step, is chosen: figures of a plan divide by the step.
_Step = Annotated[float, msgspec.Meta(ge=0.001, le=1e6)]
_Steps = Annotated[int, msgspec.Meta(ge=0, lt=100_000)]
# The limits also refuse NaN and infinities.
_Offset = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
INVERTIBLE = ("x_dir", "left_dir", "right_dir", "enable", "pul", "switches", "emergency_stop")
"""Pins of the stage whose level `stage.inverted` inverts against arduino_stage/board.h."""
_Invertible = Literal["x_dir", "left_dir", "right_dir", "enable", "pul", "switches", "emergency_stop"]
# Fields of `Stage.placement_settings`.
_PLACEMENT_KEYS = ("steps_per_mm", "centre_x_mm", "centre_y_mm", "backlash_mm", "accel_mm_s2")


class Burst(Section, frozen=True):
    """SYNC_IN pulses of one position; each starts one frame of `chirps` chirps, `chirp_us` from one to the next.

    One chirp a frame needs no `chirp_us`. One pulse with many chirps (`pulses = 1, chirps = 16`) is a shorter burst
    with a single trigger uncertainty; radars with `control = "native"` are configured for it, others must be configured
    by hand.
    """

    pulses: Annotated[int, msgspec.Meta(ge=1, le=65_536)]
    period_us: Positive
    width_us: Positive = 1.0
    chirps: Annotated[int, msgspec.Meta(ge=1, le=255)] = 1
    chirp_us: NonNegative = 0.0

    def __post_init__(self) -> None:
        require(
            self.period_us >= MIN_PERIOD_US,
            f"period_us must be at least {MIN_PERIOD_US:g} us (shortest frame period of the AWR2243)",
        )
        shortest, longest = WIDTH_US
        require(shortest <= self.width_us <= longest, f"width_us must be {WIDTH_TEXT} (SYNC_IN pulse of the AWR2243)")
        require(
            self.chirps == 1 or self.chirp_us > 0, "several chirps a frame need chirp_us, the time from one to the next"
        )
        frame_us = self.chirps * self.chirp_us + MIN_PERIOD_US
        require(
            self.chirps == 1 or frame_us <= self.period_us,
            f"period_us must be at least {frame_us:g} us: {self.chirps} chirps and a pause of {MIN_PERIOD_US:g} us",
        )

    def __str__(self) -> str:
        if self.chirps == 1:
            return f"{self.pulses} pulses, {self.period_us:g} us apart"
        return f"{self.pulses} pulses of {self.chirps} chirps, {self.chirp_us:g} us apart"

    @property
    def chirps_a_position(self) -> int:
        """Number of chirps of a position, over all its frames."""
        return self.pulses * self.chirps

    @property
    def chirp_times_s(self) -> tuple[float, ...]:
        """Start times of a position's chirps, seconds after the first pulse."""
        return tuple(
            1e-6 * (pulse * self.period_us + chirp * self.chirp_us)
            for pulse in range(self.pulses)
            for chirp in range(self.chirps)
        )


class Grid(Section, frozen=True):
    """Serpentine raster of stage positions: even rows run towards +x, odd rows towards -x."""

    columns: _Points
    rows: _Points
    step_x_mm: _Step
    step_y_mm: _Step


class Stage(Section, frozen=True):
    """Motion stage and its serial link.

    Stage coordinates are zero where homing ends and reach to `travel_x_mm`, `travel_y_mm`; `centre_x_mm`, `centre_y_mm`
    are those of the middle of the grid. `speed_mm_s` is the speed in a row, `travel_speed_mm_s` that between rows.
    `heartbeat_ms`: silence of the Pi after which a moving stage stops. `backlash_mm`: play of the drive, which is taken
    up before the first point of a row.
    """

    port: str
    baud: Count = 115200
    steps_per_mm: _Motion = 200.0
    speed_mm_s: _Motion = 20.0
    travel_speed_mm_s: _Motion = 40.0
    accel_mm_s2: _Motion = 200.0
    heartbeat_ms: Count = 500
    trigger_width_us: Count = 20
    travel_x_mm: Positive = 800.0
    travel_y_mm: Positive = 500.0
    centre_x_mm: NonNegative = 400.0
    centre_y_mm: NonNegative = 250.0
    backlash_mm: NonNegative = 0.0
    # Home after the last row to measure lost steps; needs limit switches.
    home_after_scan: bool = False
    # Pins with the other level than in board.h, sent before the first motion.
    inverted: tuple[_Invertible, ...] = ()

    def __post_init__(self) -> None:
        require(self.centre_x_mm <= self.travel_x_mm, "centre_x_mm must lie within travel_x_mm")
        require(self.centre_y_mm <= self.travel_y_mm, "centre_y_mm must lie within travel_y_mm")

    @property
    def placement_settings(self) -> dict[str, float]:
        """Settings that determine the position of rows; they must be equal in the rig files of Pi and host."""
        return {key: float(getattr(self, key)) for key in _PLACEMENT_KEYS}

    def run_up_mm(self, step_mm: float, speed_mm_s: float | None = None) -> float:
        """Return the distance from rest to a row's first point: v^2 / 2a, plus a step or the backlash if that is more.

        `step_mm`: distance of two points; `speed_mm_s`: speed of the row, default the stage's. See
        docs/spec/stage-line.md, "A row".
        """
        speed = speed_mm_s or self.speed_mm_s
        return speed**2 / (2 * self.accel_mm_s2) + max(step_mm, self.backlash_mm)

    def misfit(self, raster: Grid | RasterPlan) -> str:
        """Explain why a raster with its run-up exceeds the travel around the centre; return "" if it fits."""
        run_up_mm = self.run_up_mm(raster.step_x_mm)
        for axis, key, points, step, margin, centre, travel in (
            ("x", "columns", raster.columns, raster.step_x_mm, run_up_mm, self.centre_x_mm, self.travel_x_mm),
            ("y", "rows", raster.rows, raster.step_y_mm, self.backlash_mm, self.centre_y_mm, self.travel_y_mm),
        ):
            half = (points - 1) / 2 * step + margin
            if half > centre or centre + half > travel:
                remedy = "plan fewer or closer points"
                speed_keys = ""
                if axis == "x":
                    remedy += ", or a lower speed"
                    speed_keys = ", stage.speed_mm_s, stage.accel_mm_s2"
                return (
                    f"the grid does not fit the stage: {points} points {step:g} mm apart with {margin:g} mm of run-up"
                    f" reach {half:g} mm to either side of {axis} = {centre:g} mm, and the stage travels {travel:g} mm:"
                    f" {remedy}"
                    f" (grid.{key}, grid.step_{axis}_mm{speed_keys}, stage.centre_{axis}_mm, stage.travel_{axis}_mm)"
                )
        return ""


class Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One row of the grid: `points` trigger positions from `x_start_mm`, `step_mm` apart (signed), at `y_mm`.

    `index` counts rows from the smallest y; even rows run towards +x, odd rows towards -x.
    """

    index: _Steps
    y_mm: _Offset
    x_start_mm: _Offset
    step_mm: _Offset
    points: _Steps

    @property
    def direction(self) -> int:
        """+1 if the stage moves towards +x, otherwise -1."""
        if self.step_mm > 0:
            return 1
        return -1

    def column(self, i: int) -> int:
        """Return the grid column (0 = smallest x) of the i-th point in the order of the scan."""
        if self.direction > 0:
            return i
        return self.points - 1 - i

    @property
    def x_mm(self) -> tuple[float, ...]:
        """Nominal x offset of every point in the order of the scan, as plain numbers because the Pi has no NumPy."""
        return tuple(self.x_start_mm + i * self.step_mm for i in range(self.points))


class RasterPlan(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A grid as a sequence of rows. Build it with `plan_raster`."""

    columns: _Steps
    rows: _Steps
    step_x_mm: _Offset
    step_y_mm: _Offset

    def row(self, index: int) -> Row:
        """Return row `index` (0-based from the smallest y). Raises IndexError outside the plan."""
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
    """Return the plan of a grid."""
    return RasterPlan(grid.columns, grid.rows, grid.step_x_mm, grid.step_y_mm)


def burst_duration_s(burst: Burst) -> float:
    """Return the time from the first to the last chirp of a position, seconds."""
    return burst.chirp_times_s[-1]


def burst_middle_s(burst: Burst) -> float:
    """Return the time from a trigger edge to the middle of its burst, seconds."""
    return FIRST_PULSE_DELAY_S + burst_duration_s(burst) / 2


def check_burst_fits(grid: Grid | RasterPlan, burst: Burst, stage: Stage) -> None:
    """Raise ConfigError if a burst, with a whole period after its last pulse, does not end before the next point."""
    between_s = grid.step_x_mm / stage.speed_mm_s
    burst_s = burst.pulses * burst.period_us * 1e-6
    if burst_s > between_s:
        raise ConfigError(
            f"burst of {burst.pulses} pulses x {burst.period_us} us lasts {burst_s * 1e3:.2f} ms, but the stage passes"
            f" a point every {between_s * 1e3:.2f} ms",
            "stage.speed_mm_s, grid.step_x_mm and burst contradict each other",
            "slow the stage, widen the step, or send fewer or faster pulses",
            code=ErrorCode.VALUES_CONFLICT,
        )


def mean_burst_travel_mm(burst: Burst, stage: Stage) -> float:
    """Return the distance from a trigger point to the mean position of its burst, in the direction of motion.

    The stage moves during a burst: 16 pulses every 1.5 ms at 20 mm/s, the first 0.2 ms after the edge, have their
    centre 0.229 mm after the point.
    """
    return stage.speed_mm_s * burst_middle_s(burst)
