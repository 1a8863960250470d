"""The examples run unchanged, one after another, in a folder of their own."""

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
# Lines from raw data to the image, imports included
LIMIT = 20


def run(name: str) -> dict:
    return runpy.run_path(str(SCRIPTS / f"{name}.py"))


def list_code_lines(cells: str) -> list[str]:
    return [line for line in cells.splitlines() if line.strip() and not line.startswith("#")]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    new_folder = tmp_path_factory.mktemp("examples")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(new_folder)
        yield new_folder


@pytest.mark.parametrize("rx", [4, 2])
def test_raw_to_image(folder, rx):
    grid = {"columns": 21, "rows": 21, "step_x_mm": 8.0, "step_y_mm": 6.0}
    image = {"columns": 40, "rows": 40, "pixel_mm": 2.0}
    raw = {"name": "a point", "grid": grid, "burst": {"pulses": 2}, "image": image}
    scene = decode_scene({**raw, "points": [{"position_mm": [10.0, -6.0]}]}, "test")
    antennas = {"rx_mm": load_rig_table()["antennas"]["rx_mm"][:rx]}
    shutil.rmtree(folder / "out" / "points", ignore_errors=True)
    simulate(make_rig_with(antennas=antennas), scene, folder / "out" / "points")
    images = run("raw_to_image")["images"]
    row, column = np.unravel_index(np.argmax(np.abs(images.h_raw)), images.h_raw.shape)
    centre = (images.x_m.mean(), images.y_m.mean())
    brightest_mm = 1e3 * (images.x_m[column] - centre[0]), 1e3 * (images.y_m[row] - centre[1])
    assert brightest_mm == pytest.approx((10.0, -6.0), abs=2.0)
    assert (folder / "out" / "points-h.png").read_bytes().startswith(b"\x89PNG")


def test_raw_to_image_takes_twenty_lines():
    to_the_image, _, _ = (SCRIPTS / "raw_to_image.py").read_text(encoding="utf-8").rpartition("# %%")
    assert len(list_code_lines(to_the_image)) <= LIMIT


def test_own_scene_then_own_material(folder, capsys):
    run("own_scene")
    assert (folder / "out" / "own-products" / "report.html").exists()
    segments = json.loads((folder / "out" / "own-products" / "materials.json").read_text())["segments"]
    own_segment = next(s for s in segments if s["truth"] and s["truth"]["name"] == "my material")
    assert own_segment["permittivity"]["real"] == pytest.approx(6.0, rel=0.1)
    capsys.readouterr()
    answer = run("own_material")
    assert abs(answer["expected"]) == pytest.approx(
        np.hypot(own_segment["ratio"]["real"], own_segment["ratio"]["imag"]), rel=0.1
    )
    assert "expected: |P|" in capsys.readouterr().out
    assert "my material" in Library.load(folder / "out" / "own-library.npz").names


# A device for Bluesky is a class; the others are steps in a row.
STEPS = sorted(path for path in SCRIPTS.glob("*.py") if path.stem != "bluesky_scan")


@pytest.mark.parametrize("script", STEPS, ids=lambda p: p.stem)
def test_examples_hold_no_logic_and_no_private_names(script):
    code = list_code_lines(script.read_text(encoding="utf-8"))
    assert not [line for line in code if line.lstrip().startswith(("def ", "class ", "if ", "while ", "try"))]
    assert not [line for line in code if "import _" in line or "._" in line]
