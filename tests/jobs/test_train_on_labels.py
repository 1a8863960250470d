"""A user's own material, end to end: scans without a truth are labelled, and the trained library names it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.paths import RIG_FILE
from tests.support.rigs import load_published_rig
from tests.support.scenes import make_scene

from polysight.cli.main import main
from polysight.jobs.train import load_training_scan
from polysight.materials import Library
from polysight.materials.train import make_entries
from polysight.products import IMAGE
from polysight_shared.errors import DataError
from polysight_simulators.scene import decode_scene, simulate

pytestmark = pytest.mark.slow
# Name of the user's material, with letters outside of ASCII ("hard oak", in German and Chinese).
MINE = "h\u00e4rtes \u6a61\u6728"
# Centres of the two plates, mm. Each is 50 mm wide and high.
COPPER_CENTRE = (-40.0, 10.0)
BOARD_CENTRE = (40.0, -10.0)
# Boxes 5 mm inside the plates, on each side.
BOXES = ("copper=-60,-10,-20,30", f"{MINE}=20,-30,60,10")


def draw_scene(seed: int) -> dict[str, Any]:
    copper = {"name": "copper", "centre_mm": COPPER_CENTRE, "size_mm": [50.0, 50.0], "metal": True}
    board = {"name": "board", "centre_mm": BOARD_CENTRE, "size_mm": [50.0, 50.0], "permittivity": [3.2, 0.4]}
    return make_scene(copper, board, columns=15, rows=17, seed=seed, disturbances={"leakage_measured": 0.003})


@pytest.fixture(scope="session")
def scans(tmp_path_factory) -> list[Path]:
    """Three scans of copper and a board without truth.json, as of a real rig. All have the same name."""
    folder = tmp_path_factory.mktemp("own")
    simulated_scans = [
        simulate(load_published_rig(), decode_scene(draw_scene(s), "test"), folder / f"s{s}") for s in (1, 2, 3)
    ]
    for scan in simulated_scans:
        (scan / "truth.json").unlink()
    return simulated_scans


def list_box_options() -> list[str]:
    return [word for box in BOXES for word in ("--box", box)]


def test_a_material_is_labelled_taught_and_named_in_another_scan(scans, tmp_path, capsys):
    first, second, third = scans
    elsewhere = tmp_path / "second"
    out = tmp_path / "out"
    library = tmp_path / "own.npz"
    assert main(["train", str(first), str(second), "--out", str(library)]) == DataError.exit_status
    assert f"do: polysight label {first}" in capsys.readouterr().err
    for scan, images in ((first, first / "products"), (second, elsewhere)):
        assert main(["image", str(scan), "--out", str(images)]) == 0
    # The first is a scan folder, the second has products without their rows.
    for folder in (first, elsewhere):
        assert main(["label", str(folder), *list_box_options(), "--specimen", f"{MINE}=board 7"]) == 0
    assert main(["train", str(first), str(elsewhere), "--out", str(library)]) == 0
    output = capsys.readouterr().out
    assert f"  {MINE}: 2 patches in 2 scans" in output
    # The question for the specimens of a material whose boxes do not name them.
    assert "which piece" not in output
    trained_library = Library.load(library)
    assert trained_library.names == ("copper", MINE)
    assert trained_library.scans == ("small", "small (2)")
    assert {e.specimen for e in trained_library.entries if e.name == MINE} == {"board 7"}
    assert {e.specimen for e in trained_library.entries if e.name == "copper"} == {None}
    # Also without their truth the scans count as simulated.
    assert trained_library.simulated
    assert main(["train", str(first), str(first / "products"), "--out", str(library)]) == DataError.exit_status
    assert "is given twice" in capsys.readouterr().err

    assert main(["process", str(third), "--out", str(out), "--library", str(library)]) == 0
    segments = json.loads((out / "materials.json").read_text(encoding="utf-8"))["segments"]
    # One patch has the name; its middle is less than 10 mm from that of the plate.
    (patch,) = [s for s in segments if s["name"] == MINE]
    middle_mm = np.reshape(patch["box_mm"], (2, 2)).mean(axis=0)
    assert np.linalg.norm(middle_mm - BOARD_CENTRE) < 10
    assert {s["name"] for s in segments} <= {MINE, "unknown", None}
    assert MINE in (out / "report.html").read_text(encoding="utf-8")
    capsys.readouterr()
    assert main(["materials", str(out)]) == 0
    assert MINE in capsys.readouterr().out
    assert main(["export", str(out), "--csv", "--out", str(tmp_path / "csv")]) == 0
    assert MINE in (tmp_path / "csv" / "materials.csv").read_text(encoding="utf-8")


def test_training_on_rows_and_on_saved_images_gives_the_same_entries(scans, tmp_path):
    scan = scans[2]
    out = tmp_path / "out"
    labels = tmp_path / "labels.json"
    boxes = {"reference": [-60, -10, -20, 30], MINE: [20, -30, 60, 10]}
    labels.write_text(json.dumps({"unit": "mm", "labels": boxes, "metal": "reference"}), encoding="utf-8")
    assert main(["process", str(scan), "--out", str(out), "--labels", str(labels)]) == 0
    assert f"drawn as {MINE}" in (out / "report.html").read_text(encoding="utf-8")
    assert main(["label", str(out), *list_box_options()]) == 0
    (scan / "labels.json").write_bytes((out / "labels.json").read_bytes())
    rows = make_entries(load_training_scan(scan, RIG_FILE))
    images = make_entries(load_training_scan(out, RIG_FILE))
    assert [e.name for e in rows] == [e.name for e in images] == ["copper", MINE]
    # Differences of 0.02 degrees and 1.5e-4 are measured.
    for of_rows, of_images in zip(rows, images, strict=True):
        assert of_rows.incidence_deg == pytest.approx(of_images.incidence_deg, abs=0.05)
        assert np.median(of_rows.h) == pytest.approx(np.median(of_images.h), rel=0.02)
        assert abs(np.median(of_rows.p) / np.median(of_images.p) - 1) < 0.02


def test_labels_override_the_truth_and_drawn_specimens_are_distinguished(tmp_path):
    spread = {**draw_scene(4), "specimen_spread": [0.02, 0.1]}
    scan = simulate(load_published_rig(), decode_scene(spread, "test"), tmp_path / "scan")
    entries = make_entries(load_training_scan(scan, RIG_FILE))
    assert [(e.name, e.permittivity is None) for e in entries] == [("copper", True), ("board", False)]
    specimens = {e.specimen for e in entries}
    assert len(specimens) == 2

    # Another simulation of the scene draws other specimens.
    second_scan = simulate(load_published_rig(), decode_scene({**spread, "seed": 1004}, "test"), tmp_path / "again")
    redrawn = {e.specimen for e in make_entries(load_training_scan(second_scan, RIG_FILE))}
    assert not redrawn & specimens

    boxes = {"tin": [-60, -10, -20, 30], f"{MINE}#left": [20, -30, 60, 10]}
    (scan / "labels.json").write_text(json.dumps({"unit": "mm", "labels": boxes, "metal": "tin"}), encoding="utf-8")
    entries = make_entries(load_training_scan(scan, RIG_FILE))
    assert [(e.name, e.specimen) for e in entries] == [("tin", None), (MINE, "left")]

    # Boxes that overlap.
    boxes = {"tin": [-60, -10, 30, 30], MINE: [20, -30, 60, 10]}
    (scan / "labels.json").write_text(json.dumps({"unit": "mm", "labels": boxes, "metal": "tin"}), encoding="utf-8")
    with pytest.raises(DataError) as caught:
        load_training_scan(scan, RIG_FILE)
    assert all(value in str(caught.value) for value in ("labels.json", "tin", MINE, "10.0 x 20.0 mm"))


def test_a_box_without_a_finite_ratio_is_noted(scans, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["image", str(scans[0]), "--out", str(out)]) == 0
    assert main(["label", str(out), *list_box_options()]) == 0
    with np.load(out / IMAGE) as saved:
        arrays = dict(saved)
    # The board's half of both images is not a number.
    for channel in ("h", "v"):
        arrays[channel][:, arrays["x_m"] > arrays["x_m"].mean()] = np.nan
    np.savez(out / IMAGE, **arrays)
    capsys.readouterr()
    scan = load_training_scan(out, RIG_FILE)
    assert [e.name for e in make_entries(scan)] == ["copper"]
    assert f"the box of {MINE} contains no pixel that can be used" in capsys.readouterr().err
