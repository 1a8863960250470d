"""A truth.json of another program is ignored with a note; training, which needs the truth, refuses it."""

import json
import shutil

import pytest
from tests.support.paths import RIG_FILE

from polysight import open_scan
from polysight.cli.main import main
from polysight.jobs.process import find_plates
from polysight.materials import read_truth
from polysight_shared.errors import DataError
from polysight_shared.files import read_json

PLATE = {"name": "PET", "centre_mm": [0, 0], "size_mm": [30, 30], "permittivity": [3.0, 0.1]}
# Contents of truth.json by the name of the case
FOREIGN = {
    "other keys": b'{"answer": 42}',
    "not JSON": b"the plate is copper\n",
    "a list": b"[1, 2]",
    "a number": b"3",
    "null": b"null",
    "empty": b"",
    "not UTF-8": b'{"plates": "\xff\xfe"}',
    "plates that are text": b'{"plates": "copper"}',
    "plates of other form": b'{"plates": [{"name": "PET"}]}',
    "plates that are null": b'{"plates": [null]}',
    "infinite": json.dumps({"plates": [{**PLATE, "size_mm": [float("inf"), 3]}]}).encode(),
    "not a number": json.dumps({"plates": [{**PLATE, "centre_mm": [float("nan"), 3]}]}).encode(),
    "larger than any float": json.dumps({"plates": [{**PLATE, "thickness_mm": 10**400}]}).encode(),
    "nested deep": b"[" * 200_000,
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_foreign_truth_gives_one_note_and_no_plates(tmp_path, capsys, kind):
    (tmp_path / "truth.json").write_bytes(FOREIGN[kind])
    assert find_plates(tmp_path) == ()
    (note,) = capsys.readouterr().err.splitlines()
    assert str(tmp_path / "truth.json") in note
    with pytest.raises(DataError) as caught:
        read_truth(tmp_path / "truth.json")
    assert "truth.json" in str(caught.value)


def test_a_folder_named_truth_json_gives_a_note_and_a_missing_file_gives_none(tmp_path, capsys):
    assert find_plates(tmp_path) == ()
    assert capsys.readouterr().err == ""
    (tmp_path / "truth.json").mkdir()
    assert find_plates(tmp_path) == ()
    assert "truth.json" in capsys.readouterr().err


def test_a_scan_with_a_foreign_truth_is_processed_but_not_trained_on(two_plates, tmp_path, capsys):
    scan = shutil.copytree(two_plates, tmp_path / "scan")
    out = tmp_path / "out"
    (scan / "truth.json").write_bytes(FOREIGN["other keys"])
    assert main(["process", str(scan), "--out", str(out), "--metal", "-40,10,30,30"]) == 0
    assert "truth.json" in capsys.readouterr().err
    assert read_json(out / "materials.json")["segments"]
    assert main(["export", str(out), "--csv"]) == 0
    capsys.readouterr()
    status = main(["train", str(scan), "--config", str(RIG_FILE), "--out", str(tmp_path / "library.npz")])
    assert status != 0
    assert "truth.json" in capsys.readouterr().err
    with pytest.warns(UserWarning, match=r"truth\.json"):
        assert open_scan(scan, metal_box_mm=(-55, -5, -25, 25)).materials().sizes
