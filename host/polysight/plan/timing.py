"""Estimate the duration of a scan: rows with their ramps, turns, and the standstill between rows.

docs/spec/stage-line.md ("A row") has the stage's sequence; motion has trapezoidal speed with constant acceleration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from polysight_shared.config import CARD_TAIL_S, Instrument
from polysight_shared.raster import Grid, Stage, burst_duration_s

ROW_OVERHEAD_S = 0.3
"""Default standstill between rows, for storing the row, arming cards and radars, and commands.

Simulated: 0.14 and 0.29 s between rows of 350 points x 13 and 16 chirps on the simulated rig at real time, on a busy
machine. Not measured on hardware; `polysight plan --like SCAN` measures it in a scan.
"""


@dataclass(frozen=True)
class ScanTime:
    """Duration of a scan by cause, summed over its rows, without homing, which depends on the stage's position.

    Attributes
    ----------
    approach_s
        From the home corner to the start of the first row.
    measuring_s
        At constant speed from each row's first point to its last.
    ramps_s
        Acceleration, deceleration, and the run-up of one step (or the backlash) on either side.
    turns_s
        From each row's end to the next one's beginning.
    tail_s
        Waiting for the cards' short last packets.
    overhead_s
        Other standstill between rows.
    """

    approach_s: float
    measuring_s: float
    ramps_s: float
    turns_s: float
    tail_s: float
    overhead_s: float

    @property
    def total_s(self) -> float:
        """Sum of all parts, seconds."""
        return self.approach_s + self.measuring_s + self.ramps_s + self.turns_s + self.tail_s + self.overhead_s

    @property
    def minutes(self) -> float:
        """Sum of all parts, minutes."""
        return self.total_s / 60


def straight_move_s(distance_mm: float, speed_mm_s: float, accel_mm_s2: float) -> float:
    """Return the duration of a move from rest to rest: trapezoidal speed, or triangular for short distances."""
    if distance_mm <= 0:
        return 0.0
    if distance_mm < speed_mm_s**2 / accel_mm_s2:
        return 2 * math.sqrt(distance_mm / accel_mm_s2)
    return distance_mm / speed_mm_s + speed_mm_s / accel_mm_s2


def row_motion_s(grid: Grid, stage: Stage) -> float:
    """Return the duration of a row from rest to rest."""
    length = (grid.columns - 1) * grid.step_x_mm + 2 * stage.run_up_mm(grid.step_x_mm)
    return straight_move_s(length, stage.speed_mm_s, stage.accel_mm_s2)


def turn_s(grid: Grid, stage: Stage) -> float:
    """Return the duration from a row's end to the next one's beginning; only y moves, and takes up its backlash."""
    step, lost = grid.step_y_mm, stage.backlash_mm
    legs = (step,) if lost <= step else (lost - step, lost)
    return sum(straight_move_s(leg, stage.travel_speed_mm_s, stage.accel_mm_s2) for leg in legs)


def whole_packets(rig: Instrument, pulses: int | None = None) -> bool:
    """Return True if a row with `pulses` pulses a position fills whole packets, so that no short one is delayed."""
    return rig.row_bytes // rig.burst.pulses * (pulses or rig.burst.pulses) % rig.card.payload_bytes == 0


def tail_s(rig: Instrument) -> float:
    """Return the wait for the cards' last packet at the end of each row, after the stage has stopped, seconds."""
    if whole_packets(rig):
        return 0.0
    grid, stage = rig.grid, rig.stage
    run_out = (row_motion_s(grid, stage) - (grid.columns - 1) * grid.step_x_mm / stage.speed_mm_s) / 2
    return max(0.0, burst_duration_s(rig.burst) + CARD_TAIL_S - run_out)


def scan_time(rig: Instrument, row_overhead_s: float = ROW_OVERHEAD_S) -> ScanTime:
    """Estimate the duration of a scan without retakes.

    `row_overhead_s` is the standstill for each row apart from motion and the wait for the last packet, seconds.
    """
    grid, stage = rig.grid, rig.stage
    row = row_motion_s(grid, stage)
    measuring = (grid.columns - 1) * grid.step_x_mm / stage.speed_mm_s
    x = stage.centre_x_mm - (grid.columns - 1) / 2 * grid.step_x_mm - stage.run_up_mm(grid.step_x_mm)
    y = stage.centre_y_mm - (grid.rows - 1) / 2 * grid.step_y_mm
    return ScanTime(
        approach_s=straight_move_s(max(x, y), stage.travel_speed_mm_s, stage.accel_mm_s2),
        measuring_s=grid.rows * measuring,
        ramps_s=grid.rows * (row - measuring),
        turns_s=(grid.rows - 1) * turn_s(grid, stage),
        tail_s=grid.rows * tail_s(rig),
        overhead_s=grid.rows * row_overhead_s,
    )
