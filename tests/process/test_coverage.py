"""Rows and frames are counted against the plan: a row that was never recorded is a loss, in file, text and report."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from polysight.host.store.scan_folder import MANIFEST
from tests.support.commands import content, told_by

METAL = "-40,10,30,30"  # inside the copper
COLUMNS, ROWS, PULSES = 15, 17, 2
FRAMES = 2 * COLUMNS * ROWS * PULSES


def processed(scan: Path, out: Path) -> tuple[str, dict[str, Any], str]:
    """What the command says, quality.json and the report."""
    told = told_by("process", scan, "--out", out, "--metal", METAL)
    return told, content(out / "quality.json"), (out / "report.html").read_text(encoding="utf-8")


def without_rows(scan: Path, to: Path, *rows: int) -> Path:
    """A copy of a scan whose manifest lacks the lines of these rows."""
    shutil.copytree(scan, to)
    lines = (to / MANIFEST).read_bytes().splitlines(keepends=True)
    gone = tuple(f'"row":{row},'.encode() for row in rows)
    (to / MANIFEST).write_bytes(b"".join(line for line in lines if not any(g in line for g in gone)))
    return to


def test_a_whole_scan_has_everything_that_was_planned(two_plates, tmp_path):
    told, quality, report = processed(shutil.copytree(two_plates, tmp_path / "scan"), tmp_path / "out")
    assert quality["coverage"] == {
        "rows_planned": ROWS, "rows_recorded": ROWS, "rows_absent": [], "positions_planned": COLUMNS * ROWS,
        "positions_absent": 0, "frames_planned": FRAMES, "frames_received": FRAMES, "manifest": [],
    }  # fmt: skip
    assert f"rows: {ROWS} of {ROWS} recorded; frames: 100 % of {FRAMES} planned\n" in told
    assert f"of {FRAMES} planned frames received" in report
    assert "<span>rows recorded</span>" not in report


@pytest.mark.parametrize("command", ["process", "image"])
def test_rows_never_recorded_are_absent_from_what_was_planned(two_plates, tmp_path, command):
    scan, out = without_rows(two_plates, tmp_path / "scan", 1, 15), tmp_path / "out"
    told = told_by(command, scan, "--out", out, *(["--metal", METAL] if command == "process" else []))
    coverage = content(out / "quality.json")["coverage"]
    assert (coverage["rows_planned"], coverage["rows_recorded"], coverage["rows_absent"]) == (ROWS, ROWS - 2, [1, 15])
    assert (coverage["positions_planned"], coverage["positions_absent"]) == (COLUMNS * ROWS, 2 * COLUMNS)
    assert (coverage["frames_planned"], coverage["frames_received"]) == (FRAMES, FRAMES * (ROWS - 2) // ROWS)
    assert [line.split(":")[0] for line in coverage["manifest"]] == ["manifest.jsonl line 3", "manifest.jsonl line 16"]
    line = f"rows: 15 of 17 recorded (11.8 % of positions absent); frames: 88.2 % of {FRAMES} planned\n"
    assert line in told
    assert "manifest.jsonl line 3" in told


def test_a_report_of_absent_rows_never_says_100_percent(two_plates, tmp_path):
    scan = without_rows(two_plates, tmp_path / "scan", 1, 15)
    _, _, report = processed(scan, tmp_path / "out")
    assert "100 %</b><span>of" not in report
    assert f"<b>88.24 %</b><span>of {FRAMES} planned frames received</span>" in report
    assert "<b>15 of 17</b><span>rows recorded</span>" in report
    assert "manifest.jsonl line 3" in report
