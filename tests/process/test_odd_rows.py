"""Odd rows are taken from right to left: what is missing there is told by its column, as in even rows."""

from __future__ import annotations

import numpy as np
import pytest

from polysight.host.pipeline import Pipeline
from polysight.host.report.context import ReportContext
from polysight.host.report.tables import masked_positions
from polysight.host.store.scan_folder import ScanFolder
from polysight.host.store.source import RowData
from tests.support.scenes import EVERYWHERE, scene_of

COLUMNS, ROWS, PULSES = 7, 4, 2
GONE = {0: [0, 1, 4], 1: [0, 1, 4], 3: [6]}  # row to points, in the order they were met
"""Rows 1 and 3 run towards -x: point 0 is their last column."""


class Cut:
    """A scan of which some positions are lost."""

    mirrored = synchronised = False
    manifest_faults = ()

    def __init__(self, scan: ScanFolder) -> None:
        self._scan = scan
        self.instrument, self.plan, self.path = scan.instrument, scan.plan, scan.path
        self.simulated, self.scan_id, self.rows = scan.simulated, scan.scan_id, scan.rows
        self.recording_facts = scan.recording_facts

    def read_row(self, board: str, row: int) -> RowData:
        whole, size = self._scan.read_row(board, row), self.instrument.burst.pulses * self.instrument.frame_bytes
        missing = [(point * size, (point + 1) * size) for point in GONE.get(row, ())]
        return RowData(whole.payload, missing, whole.frames_expected)


@pytest.fixture(scope="module")
def quality(scan_of, tmp_path_factory):
    scene = scene_of(EVERYWHERE, columns=COLUMNS, rows=ROWS, pulses=PULSES)
    source = Cut(ScanFolder.load(scan_of(tmp_path_factory.mktemp("odd") / "scan", scene)))
    pipeline = Pipeline(source)
    for row in source.rows():
        pipeline.add_row(row)
    return source, pipeline.quality.to_dict()


def test_lost_positions_of_odd_rows_are_told_by_column(quality):
    _, told = quality
    for board in told["boards"].values():
        assert board["masked_columns"] == {0: [[0, 2], [4, 5]], 1: [[2, 3], [5, 7]], 3: [[0, 1]]}
        assert board["positions_masked"] == 7
        assert board["frames_masked"] == 7 * PULSES


def test_the_report_s_map_has_them_where_the_plan_was(quality):
    source, told = quality
    there = np.zeros((ROWS, COLUMNS), bool)
    for index, points in GONE.items():
        row = source.plan.row(index)
        columns = np.round((np.array(row.x_mm)[points] - min(row.x_mm)) / source.plan.step_x_mm).astype(int)
        there[index, columns] = True
    nothing, axis = np.zeros((1, 1), np.complex64), np.zeros(1)
    context = ReportContext("", True, axis, axis, nothing, nothing, nothing, quality=told, plan=source.plan)
    for found in masked_positions(context).values():
        np.testing.assert_array_equal(found, there)
