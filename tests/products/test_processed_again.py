"""A scan is processed again: inputs are checked before anything is changed, and a failure leaves the old products."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import tomli_w
from tests.support.rigs import load_published_rig
from tests.support.scenes import make_scene
from tests.support.store.facts import load_facts

from polysight.cli.main import main
from polysight.materials import Library
from polysight.materials.library import SIMULATED_LIBRARY
from polysight.store import manifest
from polysight.store.scan_folder import MANIFEST, ScanFolder
from polysight_shared.errors import ConfigError, DataError, DeviceError
from polysight_shared.tables import to_builtins
from polysight_simulators.scene import decode_scene, simulate

SCENE = make_scene(
    {"name": "copper", "centre_mm": [-34.0, 0.0], "size_mm": [46.0, 60.0], "metal": True},
    {"name": "mine", "centre_mm": [34.0, 0.0], "size_mm": [46.0, 60.0], "permittivity": [4.0, 0.4]},
    columns=14,
    rows=10,
    step_mm=(14.0, 12.0),
    image={"columns": 40, "rows": 30, "pixel_mm": 4.0},
)
# The box on the copper plate: its middle and its size, mm. A value may begin with a minus sign.
METAL = ["--metal", "-36,0,30,40"]
# A box where nothing is.
NO_METAL = ["--metal", "900,900,10,10"]


@pytest.fixture(scope="module")
def recorded_scan(tmp_path_factory) -> Path:
    """A simulated scan, and its products."""
    folder = tmp_path_factory.mktemp("recorded")
    simulate(load_published_rig(), decode_scene(SCENE, "test"), folder / "scan")
    assert main(["process", str(folder / "scan"), "--out", str(folder / "out"), *METAL]) == 0
    return folder


@pytest.fixture
def made_folder(recorded_scan, tmp_path) -> Path:
    """A copy of the scan and of its products, in `scan` and `out`."""
    return Path(shutil.copytree(recorded_scan, tmp_path / "lab"))


def read_contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def process(made_folder: Path, *more: object) -> int:
    return main(["process", str(made_folder / "scan"), "--out", str(made_folder / "out"), *map(str, more)])


def write_boxes(made_folder: Path, labels: dict[str, list[float]]) -> Path:
    (made_folder / "mine.json").write_text(json.dumps({"labels": labels}))
    return made_folder / "mine.json"


def test_a_label_file_may_lie_among_the_products_that_are_replaced(made_folder):
    """The file is read before its folder is replaced; its two boxes become the patches of the new products."""
    labels = made_folder / "out" / "labels.json"
    labels.write_text(json.dumps({"labels": {"metal": [7, 10, 12, 20], "drawn": [27, 10, 32, 20]}}))
    assert process(made_folder, "--labels", labels, "--model", "none") == 0
    assert set(json.loads(labels.read_text())["labels"]) == {"metal", "drawn"}
    assert (made_folder / "out" / "report.html").exists()


@pytest.mark.parametrize(
    ("option", "path", "value"),
    [
        ("--labels", "no.json", "no.json"),
        ("--labels", "scan/manifest.jsonl", "manifest.jsonl"),
        ("--labels", "mine.json", "far"),
        ("--library", "no.npz", "no.npz"),
        ("--reference", "nowhere", "nowhere"),
    ],
)
def test_an_invalid_input_changes_nothing(made_folder, option, path, value, capsys):
    write_boxes(made_folder, {"far": [4000, 0, 4010, 10]})
    contents_before = read_contents(made_folder)
    assert process(made_folder, option, made_folder / path) == DataError.exit_status
    assert value in capsys.readouterr().err
    assert read_contents(made_folder) == contents_before


def test_a_report_is_not_replaced_by_images_without_one(made_folder, capsys):
    contents_before = read_contents(made_folder / "out")
    assert process(made_folder, *NO_METAL) == DataError.exit_status
    assert read_contents(made_folder / "out") == contents_before
    # Without older products the images are kept, and the message names them.
    shutil.rmtree(made_folder / "out")
    assert process(made_folder, *NO_METAL) == DataError.exit_status
    assert str(made_folder / "out" / "image.npz") in capsys.readouterr().err.splitlines()[-1]
    assert (made_folder / "out" / "image.npz").exists()


def test_products_whose_raw_rows_were_dropped_stay(made_folder, capsys):
    assert main(["drop-raw", str(made_folder / "scan"), "--products", str(made_folder / "out"), "--yes"]) == 0
    contents_before = read_contents(made_folder / "out")
    other_scan = simulate(
        load_published_rig(), decode_scene({**SCENE, "name": "another"}, "test"), made_folder / "other"
    )
    for command in ("process", "image"):
        assert main([command, str(other_scan), "--out", str(made_folder / "out")]) == ConfigError.exit_status
        assert ScanFolder.load(made_folder / "scan").scan_id in capsys.readouterr().err
    assert read_contents(made_folder / "out") == contents_before


@pytest.fixture
def other_angle(made_folder) -> Path:
    """The simulated library, shifted by two degrees of incidence."""
    library = Library.load(SIMULATED_LIBRARY)
    moved = (replace(e, incidence_deg=e.incidence_deg + 2) for e in library.entries)
    Library(tuple(moved), library.fit, library.note).save(made_folder / "other.npz")
    return made_folder / "other.npz"


def test_at_another_angle_than_the_librarys_nothing_is_named(made_folder, other_angle, capsys):
    assert process(made_folder, *METAL, "--library", other_angle) == 0
    output = capsys.readouterr()
    assert "other.npz" in output.err
    assert "other.npz" in output.out
    materials = json.loads((made_folder / "out" / "materials.json").read_text())
    assert materials["model"] is None
    other_patch = next(s for s in materials["segments"] if not s["metal_reference"])
    assert other_patch["name"] is None
    # Such a coarse scan may give no permittivity; then the patch has the reason.
    has_permittivity = other_patch["permittivity"] is not None
    is_refused = other_patch["refused"] is not None
    assert has_permittivity != is_refused
    assert "other.npz" in (made_folder / "out" / "report.html").read_text()


@pytest.fixture
def no_pi(made_folder) -> Path:
    """A rig file with an address at which no Pi answers."""
    table = to_builtins(load_published_rig())
    table["pi"] |= {"command_address": "tcp://127.0.0.1:1", "event_address": "tcp://127.0.0.1:2"}
    table["limits"] |= {"command_timeout_s": 0.2}
    (made_folder / "rig.toml").write_text(tomli_w.dumps(table))
    return made_folder / "rig.toml"


def test_a_library_of_another_angle_is_reported_before_the_rig_is_used(made_folder, other_angle, no_pi, capsys):
    scan = ["scan", "--config", str(no_pi), "--out", str(made_folder / "new")]
    assert main([*scan, "--library", str(other_angle)]) == DeviceError.exit_status
    message = capsys.readouterr().err
    assert 0 < message.index("other.npz") < message.index("127.0.0.1:1")
    far_box = write_boxes(made_folder, {"far": [4000, 0, 4010, 10]})
    for option in (["--labels", made_folder / "no.json"], ["--labels", far_box],
                   ["--library", made_folder / "no.npz"], ["--truth", no_pi]):  # fmt: skip
        assert main([*scan, *map(str, option)]) == DataError.exit_status
        assert "127.0.0.1" not in capsys.readouterr().err
    assert not (made_folder / "new").exists()


def test_retaken_and_incomplete_rows_of_every_run_are_counted(made_folder):
    """They come from the manifest, however often the scan was resumed.

    Here takes 1 and 2 of row 2 and take 1 of row 5 were rejected: three retakes. Row 2 is incomplete; of row 7 the
    incomplete take was withdrawn and another one has replaced it.
    """
    scan = ScanFolder.load(made_folder / "scan")
    rows = {f["row"]: f for f in load_facts(scan, "row_committed")}
    with scan.writer() as writer:
        for row, take in ((2, 1), (2, 2), (5, 1)):
            writer.append({"fact": "row_rejected", "row": row, "take": take, "reasons": ["x"], "boards": {}})
        writer.append({**rows[2], "take": 3, "kept_incomplete": ["RH: a gap"]})
        writer.append({**rows[7], "take": 1, "kept_incomplete": ["RH: a gap"]})
        writer.append({"fact": "row_withdrawn", "row": 7, "take": 1, "reasons": ["short"]})
        writer.append({**rows[7], "take": 2})
    assert manifest.read(made_folder / "scan" / MANIFEST).length
    assert process(made_folder, *METAL, "--model", "none") == 0
    quality = json.loads((made_folder / "out" / "quality.json").read_text())
    assert (quality["rows_retaken"], quality["rows_incomplete"]) == (3, [2])
