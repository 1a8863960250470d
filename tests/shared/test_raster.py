"""The serpentine plan has every position once, alternating rows, and its centre at offset zero."""

import pytest
from hypothesis import given, strategies as st
from tests.support.refusals import expect_refusal

from polysight_shared.config import Burst, Grid, Stage
from polysight_shared.errors import ErrorCode
from polysight_shared.raster import check_burst_fits, mean_burst_travel_mm, plan_raster

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


def test_published_burst_travel():
    assert mean_burst_travel_mm(Burst(16, 1500.0), Stage("x", speed_mm_s=20.0)) == pytest.approx(0.229)
