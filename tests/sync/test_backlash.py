"""Backlash of the stage is recovered from simulated raw data, or not reported.

With backlash the rows of one direction of travel are shifted in x against those of the other.
"""

import numpy as np
import pytest

from polysight.sync import BoardSetup, synchronise_row
from polysight.sync.backlash import estimate_backlash, object_filter
from polysight_shared.raster import plan_raster
from polysight_simulators.scene import SimulatedRig, decode_scene, row_offsets_mm

# Three points, x and y in mm
POINTS = [{"position_mm": p, "amplitude": [0.8, 0.0]} for p in ([0.0, 0.0], [25.0, 10.0], [-30.0, -8.0])]


@pytest.fixture(scope="module")
def echoes(rig):
    """`echoes(backlash_mm)`: the object's echo at each position of board RH, by row of a small scan; and its rig."""

    def scan(backlash_mm, points=POINTS, rows=20):
        raw = {"name": "t", "points": points, "grid": {"columns": 64, "rows": rows, "step_x_mm": 2.0, "step_y_mm": 2.0}}
        radar = SimulatedRig(rig, decode_scene(raw, "t").with_disturbances(backlash_mm=backlash_mm))
        board = radar.rig.receivers[0]
        setup = BoardSetup.from_rig(radar.rig, board)
        weights = object_filter(radar.rig, board, setup.path.sweep_hz)
        echoes_by_row = {}
        for row in plan_raster(radar.rig.grid):
            x, y = row_offsets_mm(radar, row)
            first_position = row.index * len(x)
            words = radar.chirps(board.name, x, y, first_position).reshape(-1, 256, 2, 4)
            no_chirp_lost = np.ones(len(words), bool)
            echoes_by_row[row.index] = synchronise_row(words, no_chirp_lost, setup).through(weights)
        return echoes_by_row, radar.rig

    return scan


@pytest.mark.parametrize("backlash_mm", [0.3, -0.3])
def test_backlash_is_recovered_although_all_other_disturbances_are_simulated(echoes, backlash_mm):
    echoes_by_row, rig = echoes(backlash_mm)
    estimate = estimate_backlash(echoes_by_row, rig)
    assert estimate is not None
    # Four of the standard deviations that are estimated here, 0.0126 mm
    limit_mm = 0.05
    assert estimate.shift == pytest.approx(backlash_mm, abs=limit_mm)
    assert estimate.std < limit_mm


def test_an_empty_plane_gives_no_backlash(echoes):
    echoes_by_row, rig = echoes(0.3, points=[])
    estimate = estimate_backlash(echoes_by_row, rig)
    # An estimate with a standard deviation of a third of the backlash is of no use.
    assert estimate is None or estimate.std > 0.1


def test_too_few_rows_give_no_backlash(echoes):
    rows, rig = echoes(0.3, rows=20)
    first_eight = {index: rows[index] for index in range(8)}
    assert estimate_backlash(first_eight, rig) is None
