"""The serpentine plan has every position once, alternating rows, and its centre at offset zero."""

from typing import Any

import pytest
from hypothesis import given, strategies as st
from tests.support.refusals import expect_refusal

from polysight_shared.config import Burst, Grid, Stage
from polysight_shared.errors import ErrorCode
from polysight_shared.raster import Row, check_burst_fits, mean_burst_travel_mm, plan_raster

grids = st.builds(
    Grid,
    columns=st.integers(1, 40),
    rows=st.integers(1, 40),
    step_x_mm=st.floats(0.5, 10),
    step_y_mm=st.floats(0.5, 10),
)


@given(grids)
def test_a_plan_has_every_position_exactly_once(grid: Grid):
    positions = [(row.column(i), row.index) for row in plan_raster(grid) for i in range(row.points)]
    expected = [(column, row) for column in range(grid.columns) for row in range(grid.rows)]
    assert sorted(positions) == sorted(expected)


@given(grids)
def test_a_column_has_one_x_whatever_the_direction(grid: Grid):
    x_of_column = {}
    for row in plan_raster(grid):
        assert len(row.x_mm) == row.points
        for i, x_mm in enumerate(row.x_mm):
            x_in_first_row = x_of_column.setdefault(row.column(i), x_mm)
            assert x_mm == pytest.approx(x_in_first_row, abs=1e-9)


@given(grids)
def test_the_grid_is_centred_and_rows_alternate(grid: Grid):
    rows = list(plan_raster(grid))
    assert sum(row.y_mm for row in rows) == pytest.approx(0, abs=1e-6)
    assert all(row.direction == (1 if row.index % 2 == 0 else -1) for row in rows)
    assert all(row.x_mm[0] == pytest.approx(-row.x_mm[-1], abs=1e-9) for row in rows)


def test_a_burst_longer_than_the_step_is_refused():
    grid = Grid(columns=10, rows=10, step_x_mm=2.0, step_y_mm=2.0)
    # At 100 mm/s a step of 2 mm takes 20 ms.
    stage = Stage("x", speed_mm_s=100.0)
    with expect_refusal(ErrorCode.VALUES_CONFLICT, "24.00 ms", "20.00 ms"):
        check_burst_fits(grid, Burst(pulses=16, period_us=1500.0), stage)
    check_burst_fits(grid, Burst(pulses=8, period_us=1500.0), stage)
    # A burst of exactly 20 ms fits.
    check_burst_fits(grid, Burst(pulses=20, period_us=1000.0), stage)


def test_rows_of_a_plan_are_counted_from_zero():
    plan = plan_raster(Grid(columns=3, rows=2, step_x_mm=2.0, step_y_mm=1.0))
    assert [plan.row(index).index for index in (0, 1)] == [0, 1]
    assert plan.positions == 6
    for index in (-1, 2):
        with pytest.raises(IndexError):
            plan.row(index)


def test_a_row_whose_points_lie_at_one_place_counts_its_columns_backwards():
    row = Row(index=0, y_mm=0.0, x_start_mm=0.0, step_mm=0.0, points=2)
    assert [row.column(i) for i in (0, 1)] == [1, 0]


@pytest.mark.parametrize(
    ("stage", "fits"),
    [
        # In x a row of 3 points 2 mm apart reaches 2 mm to either side of its middle. The run-up adds the way to
        # 2 mm/s at 1 mm/s^2, which is 2^2 / (2 x 1) = 2 mm, and a step of 2 mm: 6 mm to either side.
        ({"centre_x_mm": 6.0, "travel_x_mm": 12.0}, True),
        ({"centre_x_mm": 5.9, "travel_x_mm": 12.0}, False),
        ({"centre_x_mm": 6.0, "travel_x_mm": 11.9}, False),
        # In y, 2 rows 1 mm apart reach 0.5 mm to either side, and the stage comes from 3 mm (the backlash) below:
        # 3.5 mm. In x the run-up adds the backlash instead of a step, as it is more: 7 mm to either side.
        ({"centre_x_mm": 20.0, "travel_x_mm": 40.0, "backlash_mm": 3.0, "centre_y_mm": 3.5, "travel_y_mm": 7.0}, True),
        ({"centre_x_mm": 20.0, "travel_x_mm": 40.0, "backlash_mm": 3.1, "centre_y_mm": 3.5, "travel_y_mm": 9.0}, False),
        ({"centre_x_mm": 7.0, "travel_x_mm": 14.0, "backlash_mm": 3.0}, True),
        ({"centre_x_mm": 7.0, "travel_x_mm": 14.0, "backlash_mm": 3.1}, False),
    ],
)
def test_a_grid_with_its_run_up_fits_the_travel_or_not(stage: dict[str, Any], fits: bool):
    grid = Grid(columns=3, rows=2, step_x_mm=2.0, step_y_mm=1.0)
    misfit = Stage("x", speed_mm_s=2.0, accel_mm_s2=1.0, **stage).misfit(grid)
    assert (misfit == "") == fits


def test_the_stage_travels_as_far_during_a_burst_as_published():
    burst = Burst(pulses=16, period_us=1500.0)
    # The middle of the burst is 0.2 ms (to its first pulse) and 7.5 periods of 1.5 ms after the trigger: 11.45 ms.
    assert mean_burst_travel_mm(burst, Stage("x", speed_mm_s=20.0)) == pytest.approx(0.229)
