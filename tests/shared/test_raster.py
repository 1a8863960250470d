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
def test_every_position_is_met_exactly_once(grid: Grid):
    positions = {(row.column(i), row.index) for row in plan_raster(grid) for i in range(row.points)}
    assert positions == {(c, r) for c in range(grid.columns) for r in range(grid.rows)}


@given(grids)
def test_a_column_has_one_x_whatever_the_direction(grid: Grid):
    x = {}
    for row in plan_raster(grid):
        assert len(row.x_mm) == row.points
        for i, x_mm in enumerate(row.x_mm):
            assert x_mm == pytest.approx(x.setdefault(row.column(i), x_mm), abs=1e-9)


@given(grids)
def test_the_grid_is_centred_and_rows_alternate(grid: Grid):
    rows = list(plan_raster(grid))
    assert sum(row.y_mm for row in rows) == pytest.approx(0, abs=1e-6)
    assert all(row.direction == (1 if row.index % 2 == 0 else -1) for row in rows)
    assert all(row.x_mm[0] == pytest.approx(-row.x_mm[-1], abs=1e-9) for row in rows)


def test_a_burst_longer_than_the_step_is_refused():
    grid = Grid(10, 10, 2.0, 2.0)
    stage = Stage("x", speed_mm_s=100.0)
    with expect_refusal(ErrorCode.VALUES_CONFLICT, "24.00 ms", "20.00 ms"):
        check_burst_fits(grid, Burst(16, 1500.0), stage)
    check_burst_fits(grid, Burst(8, 1500.0), stage)
    # 20 pulses of 1 ms in 20 ms
    check_burst_fits(grid, Burst(20, 1000.0), stage)


def test_rows_of_a_plan_are_counted_from_zero():
    plan = plan_raster(Grid(3, 2, 2.0, 1.0))
    assert [plan.row(index).index for index in (0, 1)] == [0, 1]
    assert plan.positions == 6
    for index in (-1, 2):
        with pytest.raises(IndexError):
            plan.row(index)
    # A row whose points lie at one place runs backwards as far as its columns go.
    assert [Row(0, 0.0, 0.0, 0.0, 2).column(i) for i in (0, 1)] == [1, 0]


@pytest.mark.parametrize(
    ("stage", "fits"),
    [
        # 3 points 2 mm apart, run-up 2^2 / 2 x 1 + 2 = 4 mm: 6 mm to either side
        ({"centre_x_mm": 6.0, "travel_x_mm": 12.0}, True),
        ({"centre_x_mm": 5.9, "travel_x_mm": 12.0}, False),
        ({"centre_x_mm": 6.0, "travel_x_mm": 11.9}, False),
        # 2 rows 1 mm apart, and a backlash of 3 mm: 3.5 mm; the run-up is a millimetre longer
        ({"centre_x_mm": 20.0, "travel_x_mm": 40.0, "backlash_mm": 3.0, "centre_y_mm": 3.5, "travel_y_mm": 7.0}, True),
        ({"centre_x_mm": 20.0, "travel_x_mm": 40.0, "backlash_mm": 3.1, "centre_y_mm": 3.5, "travel_y_mm": 9.0}, False),
        ({"centre_x_mm": 7.0, "travel_x_mm": 14.0, "backlash_mm": 3.0}, True),
        ({"centre_x_mm": 7.0, "travel_x_mm": 14.0, "backlash_mm": 3.1}, False),
    ],
)
def test_a_grid_with_its_run_up_fits_the_travel_or_not(stage: dict[str, Any], fits: bool):
    misfit = Stage("x", speed_mm_s=2.0, accel_mm_s2=1.0, **stage).misfit(Grid(3, 2, 2.0, 1.0))
    assert (misfit == "") == fits


def test_published_burst_travel():
    assert mean_burst_travel_mm(Burst(16, 1500.0), Stage("x", speed_mm_s=20.0)) == pytest.approx(0.229)
