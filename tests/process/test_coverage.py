"""Coverage of a scan: missing rows and positions are counted, with the right columns in rows of either direction."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from tests.support.pipelines import make_pipeline
from tests.support.processes import read_output
from tests.support.scenes import EVERYWHERE, make_scene

from polysight.imaging import Images
from polysight.products import ProcessedScan
from polysight.report.figures import find_masked_positions
from polysight.results import ScanFacts
from polysight.store import RowData, ScanFolder
from polysight.store.scan_folder import MANIFEST
from polysight_shared.files import read_json

# A box inside the copper: centre and size in millimetres
METAL = "-40,10,30,30"
COLUMNS = 15
ROWS = 17
PULSES = 2
# Frames of both receivers together
FRAMES = 2 * COLUMNS * ROWS * PULSES


def copy_without_rows(scan: Path, to: Path, *rows: int) -> Path:
    """Return a copy of a scan without the lines of these rows in its manifest."""
    shutil.copytree(scan, to)
    lines = (to / MANIFEST).read_bytes().splitlines(keepends=True)
    # A line is one JSON object. The lines of a row have its number under the key `row`.
    kept_lines = [line for line in lines if json.loads(line).get("row") not in rows]
    (to / MANIFEST).write_bytes(b"".join(kept_lines))
    return to


@pytest.mark.parametrize("command", ["process", "image"])
def test_missing_rows_are_counted_as_absent(two_plates, tmp_path, command):
    scan = copy_without_rows(two_plates, tmp_path / "scan", 1, 15)
    out = tmp_path / "out"
    options = ["--metal", METAL] if command == "process" else []
    output = read_output(command, scan, "--out", out, *options)
    coverage = read_json(out / "quality.json")["coverage"]
    assert coverage["rows_planned"] == ROWS
    assert coverage["rows_recorded"] == ROWS - 2
    assert coverage["rows_absent"] == [1, 15]
    assert coverage["positions_planned"] == COLUMNS * ROWS
    assert coverage["positions_absent"] == 2 * COLUMNS
    assert coverage["frames_planned"] == FRAMES
    assert coverage["frames_received"] == FRAMES * (ROWS - 2) // ROWS
    # The first line describes the scan, and each row has one more. Row 2 is line 3, because row 0 precedes it. Row 16
    # comes after the 14 rows that are left of rows 0 to 15.
    lines_after_gaps = ["manifest.jsonl line 3", f"manifest.jsonl line {1 + 14 + 1}"]
    assert [line.split(":")[0] for line in coverage["manifest"]] == lines_after_gaps
    # 2 of 17 rows are 11.8 %.
    for value in ("15 of 17", "11.8 %", f"88.2 % of {FRAMES}", lines_after_gaps[0]):
        assert value in output
    if command == "process":
        report = (out / "report.html").read_text(encoding="utf-8")
        # A tile of the report has a share in bold, and below it of what: no tile may say that all was received.
        assert "100 %</b><span>of" not in report
        for value in ("88.24 %", "15 of 17", lines_after_gaps[0]):
            assert value in report


# Row to lost positions, in the order of recording, of seven in a row. Rows 1 and 3 are recorded towards -x: position n
# is in column 6 - n there. So row 1 loses columns 6, 5 and 2, and row 3 loses column 0.
LOST = {0: [0, 1, 4], 1: [0, 1, 4], 3: [6]}


class Lossy:
    """A scan with some lost positions."""

    mirrored = synchronised = False
    manifest_faults = ()

    def __init__(self, scan: ScanFolder) -> None:
        self._scan = scan
        self.instrument = scan.instrument
        self.plan = scan.plan
        self.path = scan.path
        self.simulated = scan.simulated
        self.scan_id = scan.scan_id
        self.rows = scan.rows
        self.recording_facts = scan.recording_facts

    def read_row(self, board: str, row: int) -> RowData:
        row_data = self._scan.read_row(board, row)
        size = self.instrument.burst.pulses * self.instrument.frame_bytes
        missing = [(point * size, (point + 1) * size) for point in LOST.get(row, ())]
        return RowData(row_data.pieces, missing, row_data.frames_expected)


def test_lost_positions_of_odd_rows_are_counted_by_column(make_scan, tmp_path):
    scene = make_scene(EVERYWHERE, columns=7, rows=4, pulses=PULSES)
    source = Lossy(ScanFolder.load(make_scan(tmp_path / "scan", scene)))
    quality = make_pipeline(source).quality.result()
    for board in quality.boards.values():
        # Ranges of columns: first one, and the one after the last
        assert board.masked_columns == {0: [(0, 2), (4, 5)], 1: [(2, 3), (5, 7)], 3: [(0, 1)]}
        assert board.positions_masked == 7
        assert board.frames_masked == 7 * PULSES
    expected = np.zeros((4, 7), bool)
    for index, points in LOST.items():
        row = source.plan.row(index)
        columns = np.round((np.array(row.x_mm)[points] - min(row.x_mm)) / source.plan.step_x_mm).astype(int)
        expected[index, columns] = True
    empty_image = np.zeros((1, 1), np.complex64)
    axis = np.zeros(1)
    images = Images(h=empty_image, v=empty_image, x_m=axis, y_m=axis, valid=empty_image.astype(bool), p=empty_image)
    scan = ProcessedScan.from_results(Path(), images=images, quality=quality, facts=ScanFacts(), plan=source.plan)
    for masked in find_masked_positions(scan).values():
        np.testing.assert_array_equal(masked, expected)
