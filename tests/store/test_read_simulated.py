"""The host reads the files of the simulators: two independent programs, one format."""

from pathlib import Path

import numpy as np
import pytest
from tests.support.rigs import load_published_rig

from polysight.store.open import open_source
from polysight.store.scan_folder import ScanFolder
from polysight.store.validation import validate
from polysight_simulators.scene import SimulatedRig, decode_scene, find_lost_bytes, simulate

RIG = load_published_rig()
RAW = {
    "name": "plate",
    "grid": {"columns": 4, "rows": 3, "step_x_mm": 10.0, "step_y_mm": 6.0},
    "plates": [{"name": "copper", "centre_mm": [0.0, 0.0], "size_mm": [30.0, 30.0], "metal": True}],
}


@pytest.mark.parametrize("loss", [0.0, 0.02])
def test_a_simulated_scan_folder_is_whole(tmp_path: Path, loss: float) -> None:
    scene = decode_scene(RAW, "t").with_disturbances(packet_loss=loss)
    simulate(RIG, scene, tmp_path / "scan")
    scan = ScanFolder.load(tmp_path / "scan")
    radar = SimulatedRig(RIG, scene)
    assert scan.simulated
    assert scan.complete
    assert scan.instrument == radar.rig
    assert not [f for f in validate(tmp_path / "scan") if f.level == "error"]
    for row in scan.plan:
        for board in ("RH", "RV"):
            data = scan.read_row(board, row.index)
            assert data.missing == find_lost_bytes(radar, board, row)
            assert data.payload.size == data.frames_expected * 4096


@pytest.mark.parametrize("loss", [0.0, 0.02])
@pytest.mark.parametrize("zero_filling", [True, False])
def test_both_layouts_read_alike(tmp_path: Path, loss: float, zero_filling: bool) -> None:
    scene = decode_scene(RAW, "t").with_disturbances(packet_loss=loss)
    own_source = open_source(simulate(RIG, scene, tmp_path / "own"))
    authors_source = open_source(simulate(RIG, scene, tmp_path / "a", layout="authors", zero_filling=zero_filling), RIG)
    assert isinstance(own_source, ScanFolder)
    assert authors_source.simulated
    assert authors_source.plan == own_source.plan
    assert authors_source.instrument.chirp == own_source.instrument.chirp
    for row in own_source.rows():
        for board in ("RH", "RV"):
            own_row = own_source.read_row(board, row)
            authors_row = authors_source.read_row(board, row)
            assert np.array_equal(own_row.payload, authors_row.payload)
            assert own_row.missing == authors_row.missing
