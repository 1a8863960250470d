"""What `polysight process` says at its end, and what it keeps of an earlier run: counted here by hand."""

from __future__ import annotations

import json
import shutil

from polysight.host.products.files import FINISHED
from polysight.host.store import manifest
from polysight.host.store.scan_folder import MANIFEST
from tests.support.commands import content, told_by

METAL = "-40,10,30,30"  # inside the copper


def rename_pet(scan, name: str) -> None:
    truth = content(scan / "truth.json")
    truth["plates"][1]["name"] = name
    (scan / "truth.json").write_text(json.dumps(truth))


def taken_again(scan) -> None:
    """Let the manifest say that two rows were taken again, and that one was kept though it is not whole."""
    facts = manifest.read(scan / MANIFEST).facts
    rejected = [{"fact": "row_rejected", "row": row, "take": 1, "reasons": ["test"]} for row in (2, 5)]
    (kept,) = (f for f in facts if f["fact"] == "row_committed" and f["row"] == 5)
    kept["kept_incomplete"] = True
    (scan / MANIFEST).write_bytes(b"".join(manifest.encode_line(f) for f in [facts[0], *rejected, *facts[1:]]))


def test_plates_named_right_are_counted_and_the_mark_of_an_earlier_run_is_removed(two_plates, tmp_path):
    scan, out = shutil.copytree(two_plates, tmp_path / "scan"), tmp_path / "out"
    rename_pet(scan, "no such material")
    told = told_by("process", scan, "--out", out, "--metal", METAL).splitlines()
    segments = content(out / "materials.json")["segments"]
    assert told[0] == "verdict:  usable with care"
    assert any(line.startswith(f"simulated scan small: {len(segments)} patches; metal ") for line in told)
    assert any(line.startswith("0 of 1 plates named right, ") for line in told)  # copper is the reference
    assert f"report:   {out / 'report.html'}" in told
    assert f"products: {out}/" in told
    quality = content(out / "quality.json")
    assert (quality["rows_retaken"], quality["rows_incomplete"]) == (0, [])

    (out / FINISHED).write_text("{}")
    (pet,) = (s for s in segments if s["truth"] and s["truth"]["name"] == "no such material")
    rename_pet(scan, pet["name"])
    taken_again(scan)
    told = told_by("process", scan, "--out", out, "--metal", METAL).splitlines()
    assert any(line.startswith("1 of 1 plates named right, ") for line in told)
    assert not (out / FINISHED).exists()
    quality = content(out / "quality.json")
    assert (quality["rows_retaken"], quality["rows_incomplete"]) == (2, [5])
