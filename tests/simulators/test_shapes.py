"""Shapes of scene files: through an entry point, in the simulator's sign convention, up to recorded rows."""

import json

import numpy as np
import pytest
from tests.support.rigs import load_published_rig

from polysight.pipeline import Pipeline
from polysight.store.scan_folder import ScanFolder
from polysight.sync.decimate import flatten, fold
from polysight_shared.errors import ConfigError
from polysight_simulators.scene import Scene, decode_scene, reference_cube, simulate, synced_cube
from polysight_simulators.scene.shapes import ENTRY_POINT_GROUP

RIG = load_published_rig()
GRID = {"columns": 9, "rows": 5, "step_x_mm": 6.0, "step_y_mm": 6.0}
BALL = {"kind": "sphere", "centre_mm": [4.0, -6.0], "radius_mm": 110.0, "metal": True}


def make_scene(**content: object) -> Scene:
    return decode_scene({"name": "shapes", "grid": GRID, **content}, "test")


@pytest.fixture
def worlds_entry_point(tmp_path, monkeypatch):
    """Offer the shapes of `polysight_worlds` as its installation does, however this environment was installed."""
    package = tmp_path / "offers_shapes-1.dist-info"
    package.mkdir()
    (package / "METADATA").write_text("Name: offers-shapes\nVersion: 1\n", encoding="utf-8")
    entry = f"[{ENTRY_POINT_GROUP}]\naaa = polysight_worlds.scene_shapes:simulate_echoes\n"
    (package / "entry_points.txt").write_text(entry, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.usefixtures("worlds_entry_point")
@pytest.mark.parametrize(
    ("medium", "error"), [({"metal": True}, 0.05), ({"permittivity": [9.0, 1.0]}, 0.08)], ids=["metal", "dielectric"]
)
def test_a_level_plate_is_the_same_as_a_shape_and_as_a_plate(medium, error):
    place = {"centre_mm": [10.0, -4.0], "size_mm": [60.0, 50.0], **medium}
    of_shapes = reference_cube(RIG, make_scene(shapes=[{"kind": "plate", **place}]))
    of_plates = reference_cube(RIG, make_scene(plates=[{"name": "plate", **place}]))
    ratios = []
    for name in of_shapes:
        spectrum = of_shapes[name]
        expected = of_plates[name]
        ratio = np.vdot(expected, spectrum) / np.vdot(expected, expected)
        ratios.append(ratio)
        # Deviations of 0.002 to 0.044 are measured.
        assert np.linalg.norm(spectrum - ratio * expected) < 0.15 * np.linalg.norm(expected)
    # The two programs have different models of antennas and obliquity: amplitudes differ by up to 5 % (measured).
    assert ratios == pytest.approx([1, 1], abs=error)


@pytest.mark.usefixtures("worlds_entry_point")
def test_a_recorded_scan_of_a_sphere_is_processed_to_its_samples(tmp_path):
    ball = make_scene(shapes=[BALL]).with_disturbances(direct_snr_db="off")
    folder = simulate(RIG, ball, tmp_path / "scan")
    truth = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    assert truth["shapes"][0]["radius_mm"] == 110
    pipeline = Pipeline(ScanFolder.load(folder))
    first, last = RIG.chirp.linear_samples
    for name, row in pipeline.synchronise_row(2).items():
        assert row.valid.all()
        cube = synced_cube(RIG, ball, name)[:, 2, :, first:last]
        blocks = flatten(fold(np.ascontiguousarray(cube, np.complex64)))
        common = np.vdot(blocks, row.samples) / np.vdot(blocks, blocks)
        # 0.005 is measured: there is no noise.
        assert np.linalg.norm(row.samples / common - blocks) < 0.015 * np.linalg.norm(blocks)


def test_a_scene_with_shapes_names_the_missing_package(monkeypatch):
    monkeypatch.setattr("polysight_simulators.scene.shapes.entry_points", lambda **_: [])
    with pytest.raises(ConfigError, match="worlds"):
        reference_cube(RIG, make_scene(shapes=[BALL]))


@pytest.mark.parametrize(
    "impossible_shape",
    [
        {"radius_mm": 5.0},
        {"metal": False},
        {"size_mm": [10.0, 10.0]},
        {"axis": [0.0, 0.0, 1.0]},
        {"kind": "plate"},
        {"thickness_mm": 1.0},
        {"kind": "teapot"},
    ],
    ids=str,
)
def test_shapes_that_cannot_be_are_refused(impossible_shape):
    with pytest.raises(ConfigError):
        make_scene(shapes=[{**BALL, **impossible_shape}])
