"""`polysight train`: scans with known plates, and scenes that the command simulates, give the same library."""

import numpy as np
import pytest
import tomli_w
from tests.support.processes import read_output
from tests.support.rigs import load_published_rig
from tests.support.scenes import COPPER, PET, make_scene

from polysight.cli.main import main
from polysight.materials import Library
from polysight_shared.errors import DataError
from polysight_shared.tables import to_builtins

RUBBER = {"name": "rubber", "centre_mm": [-40.0, -50.0], "size_mm": [50.0, 50.0], "permittivity": [5.06, 1.11]}
NAMES = ("PET", "copper", "rubber")


def make_scene_named(name: str):
    """Return a scene of three plates under this name; all have the same seed, and so the same random numbers."""
    return make_scene(COPPER, PET, RUBBER, columns=15, rows=21, pulses=1, seed=7) | {"name": name}


@pytest.fixture
def rig_file(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_bytes(tomli_w.dumps(to_builtins(load_published_rig())).encode())
    return path


def test_scans_and_their_scenes_give_the_same_library(make_scan, rig_file, tmp_path):
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "second.toml").write_bytes(tomli_w.dumps(make_scene_named("second")).encode())
    scan = make_scan(tmp_path / "first", make_scene_named("first"))
    out = tmp_path / "library.npz"
    options = ("--simulate", tmp_path / "scenes", "--config", rig_file, "--out", out)
    output = read_output("train", scan, *options)
    assert "6 patches of 3 materials from 2 scans" in output
    library = Library.load(out)
    assert library.names == NAMES
    assert library.scans == ("first", "second")
    assert library.fit
    entries_of_scan = [entry for entry in library.entries if entry.scan == "first"]
    entries_of_scene = [entry for entry in library.entries if entry.scan == "second"]
    for of_scan, of_scene in zip(entries_of_scan, entries_of_scene, strict=True):
        assert of_scan.simulated
        # Pixels of a patch
        assert of_scan.h.size >= 10
        for key in ("h", "v", "p"):
            np.testing.assert_array_equal(getattr(of_scan, key), getattr(of_scene, key))
        assert of_scan.name == of_scene.name
        assert of_scan.permittivity == of_scene.permittivity
    # |H| is relative to the copper of the same scan.
    level = {name: np.median([np.median(e.h) for e in library.entries if e.name == name]) for name in NAMES}
    assert level["copper"] == pytest.approx(1.0, abs=0.1)
    # PET has 0.50 and rubber 0.52 (measured): both are darker than metal, and rubber has the larger permittivity.
    assert 0.2 < level["PET"] < level["rubber"] < 0.9


def test_a_scan_without_metal_cannot_be_trained_on(make_scan, rig_file, tmp_path):
    scan = make_scan(tmp_path / "scan", make_scene(PET, columns=6, rows=4))
    status = main(["train", str(scan), "--config", str(rig_file), "--out", str(tmp_path / "l.npz")])
    assert status == DataError.exit_status
    assert not (tmp_path / "l.npz").exists()
