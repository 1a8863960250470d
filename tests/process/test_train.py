"""`polysight train`: scans with known plates, and scenes that the command simulates, give the same library."""

import numpy as np
import pytest
import tomli_w
from tests.support.processes import read_output
from tests.support.rigs import load_published_rig
from tests.support.scenes import COPPER, PET, make_scene

from polysight.cli.main import main
from polysight.materials import Library
from polysight_shared.tables import to_builtins

MORE = {"name": "rubber", "centre_mm": [-40.0, -50.0], "size_mm": [50.0, 50.0], "permittivity": [5.06, 1.11]}
NAMES = ("PET", "copper", "rubber")


def make_scene_named(name: str):
    """A scene with the same power cycle under another name."""
    return make_scene(COPPER, PET, MORE, columns=15, rows=21, pulses=1, seed=7) | {"name": name}


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
    assert (library.names, library.scans) == (NAMES, ("first", "second"))
    assert library.fit
    first, second = ([e for e in library.entries if e.scan == name] for name in library.scans)
    for first_item, second_item in zip(first, second, strict=True):
        assert first_item.simulated
        assert first_item.h.size >= 10
        for key in ("h", "v", "p"):
            np.testing.assert_array_equal(getattr(first_item, key), getattr(second_item, key))
        assert (first_item.name, first_item.permittivity) == (second_item.name, second_item.permittivity)
    # Relative to the copper of the same scan.
    level = {name: np.median([np.median(e.h) for e in library.entries if e.name == name]) for name in NAMES}
    assert level["copper"] == pytest.approx(1.0, abs=0.1)
    assert 0.2 < level["PET"] < level["rubber"] < 0.9


def test_a_scan_without_metal_cannot_be_trained_on(make_scan, rig_file, tmp_path):
    scan = make_scan(tmp_path / "scan", make_scene(PET, columns=6, rows=4))
    assert main(["train", str(scan), "--config", str(rig_file), "--out", str(tmp_path / "l.npz")]) == 3
    assert not (tmp_path / "l.npz").exists()
