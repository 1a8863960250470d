"""A user's own material, end to end: scans without a truth are labelled, taught, and the name comes back."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from polysight.host.cli.main import main
from polysight.host.materials import Library
from polysight.simulators.scene import decode_scene, simulate
from tests.support.rigs import published_rig
from tests.support.scenes import scene_of

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("labelled")]
MINE = "h\u00e4rtes \u6a61\u6728"
PLACES = (-40.0, 10.0), (40.0, -10.0)
BOXES = ("copper=-60,-10,-20,30", f"{MINE}=20,-30,60,10")  # 5 mm inside the plates


def scene(seed: int, **more) -> dict:
    copper = {"name": "copper", "centre_mm": PLACES[0], "size_mm": [50.0, 50.0], "metal": True}
    board = {"name": "board", "centre_mm": PLACES[1], "size_mm": [50.0, 50.0], "permittivity": [3.2, 0.4]}
    return scene_of(copper, board, columns=15, rows=17, seed=seed, disturbances={"leakage_measured": 0.003}, **more)


@pytest.fixture(scope="session")
def scans(tmp_path_factory) -> list[Path]:
    """Three scans of copper and a board, without truth.json: what a real rig would leave."""
    folder = tmp_path_factory.mktemp("own")
    made = [simulate(published_rig(), decode_scene(scene(s), "test"), folder / f"s{s}") for s in (1, 2, 3)]
    for scan in made:
        (scan / "truth.json").unlink()
    return made


def test_a_material_is_labelled_taught_and_named_in_another_scan(scans, tmp_path, capsys):
    first, second, third = scans
    library = tmp_path / "own.npz"
    assert main(["train", str(first), str(second), "--out", str(library)]) == 3
    told = capsys.readouterr().err
    assert f"do: polysight label {first}" in told
    for scan in (first, second):
        assert main(["process", str(scan), "--out", str(scan / "products"), "--model", "none"]) == 0
        drawn = [word for box in BOXES for word in ("--box", box)]
        assert main(["label", str(scan), *drawn, "--specimen", f"{MINE}=board 7"]) == 0
    # the first by its scan folder, the second by the folder of its products
    assert main(["train", str(first), str(second / "products"), "--out", str(library)]) == 0
    assert f"  {MINE}: 2 patches in 2 scans" in capsys.readouterr().out
    known = Library.load(library)
    assert known.names == ("copper", MINE)
    assert {e.specimen for e in known.entries if e.name == MINE} == {"board 7"}
    assert {e.specimen for e in known.entries if e.name == "copper"} == {None}
    assert known.simulated  # without a truth it is simulated all the same, and says so

    out = tmp_path / "out"
    assert main(["process", str(third), "--out", str(out), "--library", str(library)]) == 0
    segments = json.loads((out / "materials.json").read_text(encoding="utf-8"))["segments"]
    assert [s["name"] for s in segments if not s["metal_reference"]] == [MINE]
    capsys.readouterr()
    assert main(["materials", str(out)]) == 0
    assert MINE in capsys.readouterr().out
    assert MINE in (out / "report.html").read_text(encoding="utf-8")
    assert main(["export", str(out), "--csv", "--out", str(tmp_path / "csv")]) == 0
    assert MINE in (tmp_path / "csv" / "materials.csv").read_text(encoding="utf-8")


def test_a_box_of_a_label_file_is_called_as_it_was_drawn(scans, tmp_path, capsys):
    labels, out = tmp_path / "labels.json", tmp_path / "out"
    boxes = {"reference": [-60, -10, -20, 30], MINE: [20, -30, 60, 10]}
    labels.write_text(json.dumps({"unit": "mm", "labels": boxes, "metal": "reference"}), encoding="utf-8")
    assert main(["process", str(scans[2]), "--out", str(out), "--labels", str(labels)]) == 0
    capsys.readouterr()
    assert main(["materials", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any("metal reference" in line and "drawn as reference" in line for line in lines)
    assert f"drawn as {MINE}" in (out / "report.html").read_text(encoding="utf-8")
