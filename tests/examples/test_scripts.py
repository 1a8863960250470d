"""The scripts in examples/ run unchanged, one after another, in an empty folder."""

import json
import runpy
import shutil

import numpy as np
import pytest
from tests.support.paths import REPO
from tests.support.rigs import load_rig_table, make_rig_with

from polysight.materials import Library
from polysight_simulators.scene import decode_scene, simulate

SCRIPTS = REPO / "examples" / "scripts"
# From raw data to the image, with imports.
MAX_CODE_LINES = 20


def run_script(name: str) -> dict:
    """Run a script; return its global variables."""
    return runpy.run_path(str(SCRIPTS / f"{name}.py"))


def list_code_lines(cells: str) -> list[str]:
    """Lines that are neither empty nor comments."""
    return [line for line in cells.splitlines() if line.strip() and not line.startswith("#")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    new_folder = tmp_path_factory.mktemp("examples")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(new_folder)
        yield new_folder


@pytest.mark.parametrize("antenna_count", [4, 2])
def test_raw_to_image_shows_a_point_where_it_is(folder, antenna_count):
    point_mm = (10.0, -6.0)
    pixel_mm = 2.0
    scene_table = {
        "name": "a point",
        "grid": {"columns": 21, "rows": 21, "step_x_mm": 8.0, "step_y_mm": 6.0},
        "burst": {"pulses": 2},
        "image": {"columns": 40, "rows": 40, "pixel_mm": pixel_mm},
        "points": [{"position_mm": list(point_mm)}],
    }
    scene = decode_scene(scene_table, "test")
    antennas = {"rx_mm": load_rig_table()["antennas"]["rx_mm"][:antenna_count]}
    shutil.rmtree(folder / "out" / "points", ignore_errors=True)
    simulate(make_rig_with(antennas=antennas), scene, folder / "out" / "points")
    images = run_script("raw_to_image")["images"]
    brightness = np.abs(images.h_raw)
    row, column = np.unravel_index(np.argmax(brightness), brightness.shape)
    x_mm = 1e3 * (images.x_m[column] - images.x_m.mean())
    y_mm = 1e3 * (images.y_m[row] - images.y_m.mean())
    assert (x_mm, y_mm) == pytest.approx(point_mm, abs=pixel_mm)
    assert (folder / "out" / "points-h.png").read_bytes().startswith(b"\x89PNG")


def test_raw_to_image_takes_twenty_lines():
    script = (SCRIPTS / "raw_to_image.py").read_text(encoding="utf-8")
    # The last cell draws the image.
    cells_to_the_image, _, _ = script.rpartition("# %%")
    assert len(list_code_lines(cells_to_the_image)) <= MAX_CODE_LINES


def test_own_material_is_learnt_from_the_scan_of_own_scene(folder, capsys):
    run_script("own_scene")
    assert (folder / "out" / "own-products" / "report.html").exists()
    segments = json.loads((folder / "out" / "own-products" / "materials.json").read_text())["segments"]
    (own_segment,) = [segment for segment in segments if segment["truth"] and segment["truth"]["name"] == "my material"]
    # The scene file has a permittivity of 6.
    assert own_segment["permittivity"]["real"] == pytest.approx(6.0, rel=0.1)
    capsys.readouterr()
    variables = run_script("own_material")
    measured_ratio = complex(own_segment["ratio"]["real"], own_segment["ratio"]["imag"])
    assert abs(variables["expected"]) == pytest.approx(abs(measured_ratio), rel=0.1)
    assert "expected: |P|" in capsys.readouterr().out
    assert "my material" in Library.load(folder / "out" / "own-library.npz").names


# The script for Bluesky defines a class, as Bluesky requires; all others are sequences of steps.
SEQUENTIAL_SCRIPTS = sorted(path for path in SCRIPTS.glob("*.py") if path.stem != "bluesky_scan")


@pytest.mark.parametrize("script", SEQUENTIAL_SCRIPTS, ids=lambda path: path.stem)
def test_examples_have_neither_functions_and_branches_nor_private_names(script):
    for line in list_code_lines(script.read_text(encoding="utf-8")):
        assert not line.lstrip().startswith(("def ", "class ", "if ", "while ", "try"))
        assert "import _" not in line
        assert "._" not in line
