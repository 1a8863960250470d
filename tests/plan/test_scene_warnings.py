"""Warnings about the plates of a scene, before it is scanned or simulated."""

import json
import tomllib
import warnings
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from tests.support.rigs import load_published_rig, make_rig_with

import polysight
from polysight.cli.main import main
from polysight.data import find_packaged
from polysight.planning import find_scene_warnings, read_scene, warn_of_scene
from polysight.planning.plan_command import format_rig_lines

OWN_SCENE = Path(__file__).resolve().parents[2] / "examples" / "own-scene.toml"
# A scanned area of 360 x 360 mm with few positions.
GRID = {"columns": 61, "rows": 61, "step_x_mm": 6.0, "step_y_mm": 6.0}


def make_plate(x_mm: float, y_mm: float = 0.0, side_mm: float = 45.0, **material: Any) -> dict[str, Any]:
    values = {"permittivity": [4.0, 0.4]} | material
    return {"name": f"plate at {x_mm:g}, {y_mm:g}", "centre_mm": [x_mm, y_mm], "size_mm": [side_mm, side_mm], **values}


def list_topics(tmp_path: Path, *plates: dict[str, Any], grid: dict[str, Any] = GRID) -> list[str]:
    """Topics of the warnings about a scene with these plates."""
    path = tmp_path / "scene.toml"
    path.write_text(tomli_w.dumps({"name": "plates", "grid": grid, "plates": list(plates)}))
    return [warning.where for warning in warn_of_scene(*read_scene(path, load_published_rig()))]


def test_the_example_scene_needs_no_change():
    assert not list(warn_of_scene(*read_scene(OWN_SCENE, load_published_rig())))


@pytest.mark.parametrize(
    ("plates", "expected"),
    [
        # Plates of 45 mm: a gap of 15 mm is too narrow, one of 35 mm is not.
        ([make_plate(-30), make_plate(30)], ["gap"]),
        ([make_plate(-40), make_plate(40)], []),
        # Only 5 mm apart in x, but one above the other.
        ([make_plate(-25, -40), make_plate(25, 40)], []),
        ([make_plate(-60, background=True, side_mm=400.0), make_plate(0)], []),
        # Too narrow in x and in y.
        ([make_plate(0, side_mm=15.0)], ["size", "size"]),
        # Its reflection leaves the scanned area of 360 mm.
        ([make_plate(150)], ["aperture"]),
        ([make_plate(0, thickness_mm=1.2)], ["thickness"]),
        ([make_plate(0, thickness_mm=40.0)], []),
        # Thin sheets of air reflect nothing, so that there is no ratio that their thickness could change.
        ([make_plate(0, thickness_mm=3.0, permittivity=[1.0, 0.0])], []),
        ([make_plate(0, thickness_mm=0.0)], []),
    ],
)
def test_each_fault_of_a_scene_is_named(tmp_path, plates, expected):
    assert list_topics(tmp_path, *plates) == expected


@pytest.mark.parametrize("axis", ["columns", "rows"])
def test_one_row_or_column_is_too_small_an_aperture(tmp_path, axis):
    """A single row resolves nothing across it: no size and no gap is large enough."""
    topics = list_topics(tmp_path, make_plate(-30), make_plate(30), grid=GRID | {axis: 1})
    assert set(topics) == {"aperture"}


def test_plan_and_simulate_print_the_warning(tmp_path, capsys):
    path = tmp_path / "scene.toml"
    metal_plate = make_plate(-30, metal=True)
    del metal_plate["permittivity"]
    grid = {"columns": 9, "rows": 9, "step_x_mm": 40.0, "step_y_mm": 40.0}
    scene = {"name": "plates", "grid": grid, "burst": {"pulses": 2}, "plates": [metal_plate, make_plate(30)]}
    path.write_text(tomli_w.dumps(scene))
    assert main(["plan", "--scene", str(path)]) == 0
    assert "note, gap:" in capsys.readouterr().out
    assert main(["simulate", str(path), "--out", str(tmp_path / "scan")]) == 0
    assert "note, gap:" in capsys.readouterr().err
    assert any(text.startswith("gap: ") for text in polysight.plan(scene=path).warnings)
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always")
        polysight.simulate(path, tmp_path / "again")
    assert any(str(note.message).startswith("gap: ") for note in notes)


def test_proposals_are_for_the_scene_and_repeat_its_warnings(tmp_path, capsys):
    """Each proposed plan scans the area of the scene, and is checked with its plates."""
    path = tmp_path / "scene.toml"
    grid = {"columns": 41, "rows": 21, "step_x_mm": 4.0, "step_y_mm": 4.0}
    path.write_text(tomli_w.dumps({"name": "plates", "grid": grid, "plates": [make_plate(-30), make_plate(15)]}))
    assert main(["plan", "--minutes", "30", "--scene", str(path), "--json"]) == 0
    plans = json.loads(capsys.readouterr().out)["plans"]
    assert plans
    for plan in plans:
        # The width of the scene's grid, (41 - 1) steps of 4 mm, to within a step.
        width_mm = (plan["columns"] - 1) * plan["step_x_mm"]
        assert width_mm == pytest.approx((41 - 1) * 4.0, abs=plan["step_x_mm"])
        assert "gap" in [warning["topic"] for warning in plan["warnings"]]


def test_a_text_of_the_scene_stays_a_text_in_the_lines_of_the_rig_file():
    lines = format_rig_lines(make_rig_with(image={"apodisation": "taylor"}), load_published_rig())
    assert tomllib.loads(lines) == {"image": {"apodisation": "taylor"}}


@pytest.mark.parametrize(
    ("step_mm", "plates", "expected"),
    [
        (5.0, [make_plate(-60), make_plate(60)], set()),
        (12.0, [make_plate(-60), make_plate(60)], {"aliasing"}),
        # A plate that is larger than the image fills it without its ghosts, too.
        (12.0, [make_plate(0, side_mm=420.0)], set()),
    ],
)
def test_ghosts_by_wide_steps_are_reported_before_a_simulation(tmp_path, step_mm, plates, expected):
    path = tmp_path / "scene.toml"
    grid = {"columns": 31, "rows": 31, "step_x_mm": step_mm, "step_y_mm": step_mm}
    path.write_text(tomli_w.dumps({"name": "plates", "grid": grid, "plates": plates}))
    config = find_packaged(Path("instrument.toml"))
    assert {warning.where for warning in find_scene_warnings(path, config)} & {"aliasing"} == expected
