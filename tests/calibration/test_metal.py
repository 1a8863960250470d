"""The metal reference as a file: what it says of a scanned plate is what processing with that scan would use."""

import json

import numpy as np
import pytest

from polysight.host.calibration.active import load_calibration
from polysight.host.cli.main import main
from polysight.host.jobs.calibrate import load_reference
from polysight.host.pipeline import Pipeline
from polysight.host.process.request import Options
from polysight.host.store.scan_folder import ScanFolder

TABLES = {
    "grid": {"columns": 14, "rows": 10, "step_x_mm": 12.0, "step_y_mm": 12.0},
    "image": {"columns": 40, "rows": 40, "pixel_mm": 3.0},
}
PLATE = {"name": "copper", "centre_mm": [0.0, 0.0], "size_mm": [500.0, 400.0], "metal": True}


def test_a_scanned_plate_becomes_the_reference_of_every_pixel(tmp_path, make_rig, scan_of, capsys):
    folder = scan_of(tmp_path / "plate", make_rig(**TABLES), plates=[PLATE])
    assert main(["calibrate", "metal", str(folder), "--out", str(tmp_path / "c")]) == 0
    told = capsys.readouterr().out
    path = next((tmp_path / "c").glob("*.toml"))
    expected, found = load_reference(folder), load_calibration({"metal": path}).reference()
    np.testing.assert_array_equal(found.h, expected.h)
    np.testing.assert_array_equal(found.valid, expected.valid)
    assert f"{100 * expected.valid.mean():.0f} % of the image" in told
    assert 'metal = "' in told


def test_metal_referenced_to_metal_is_one_in_every_pixel(tmp_path, make_rig, scan_of, request):
    """Across a power cycle: other gains, phases and noise."""
    if not request.config.getoption("--long"):
        pytest.skip("a whole processing; --long runs it")
    folder = scan_of(tmp_path / "plate", make_rig(**TABLES), plates=[PLATE])
    assert main(["calibrate", "metal", str(folder), "--out", str(tmp_path / "c")]) == 0
    path = next((tmp_path / "c").glob("*.toml"))
    rig = make_rig(**TABLES, calibration={"metal": str(path)})
    pipeline = Pipeline(ScanFolder.load(scan_of(tmp_path / "other", rig, plates=[PLATE], seed=9)))
    for row in pipeline.source.rows():
        pipeline.add_row(row)
    pipeline.finish(tmp_path / "products", Options(model="none"))
    with np.load(tmp_path / "products" / "image.npz") as image:
        p = image["p"][image["valid"]]
    assert p.size > 400
    assert np.median(np.abs(p - 1)) < 0.02
    quality = json.loads((tmp_path / "products" / "quality.json").read_text())
    assert quality["calibration"]["metal"]["file"] == str(path)
    assert quality["metal_reference"]["how"].endswith("of the image")


def test_a_scan_without_metal_is_refused(tmp_path, make_rig, scan_of, capsys):
    small = {"grid": {"columns": 4, "rows": 3}, "image": {"columns": 20, "rows": 20}}
    folder = scan_of(
        tmp_path / "air", make_rig(**small), points=[{"position_mm": [0.0, 0.0], "amplitude": [1e-3, 0.0]}]
    )
    assert main(["calibrate", "metal", str(folder), "--out", str(tmp_path / "c")]) == 3
    assert not (tmp_path / "c").exists()
    assert "metal" in capsys.readouterr().err
