"""Read recorded scans for calibration: open a scan, and iterate over the rows of a board."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polysight.calibration.files import SourceScan
from polysight.capture import row_words
from polysight.store import RawSource, open_source, raw_source
from polysight_shared.config import Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError


def open_raw(folder: Path, rig: Instrument | None = None) -> RawSource:
    """Open a recorded scan with raw data; `rig` is for recordings without a rig file. Raises DataError."""
    source = raw_source(open_source(folder, rig), folder)
    if next(iter(source.rows()), None) is None:
        raise DataError(
            f"{folder}: no complete row",
            "the scan was stopped in its first row, or files are missing",
            f"`polysight resume {folder}` records the missing rows",
            code=ErrorCode.NO_DATA,
        )
    return source


def source_scan(source: RawSource, folder: Path) -> SourceScan:
    """Return the entry of a scan in the `sources` of a calibration file."""
    return SourceScan(source.scan_id, str(folder), source.simulated, len(list(source.rows())))


def board_rows(
    source: RawSource, board: str, limit: int | None = None
) -> Iterator[tuple[int, NDArray[np.int16], NDArray[np.bool_]]]:
    """Yield index, words int16 [frame, sample, 2, rx] and valid bool [frame] of rows; `limit` evenly spaced rows."""
    rows = list(source.rows())
    if limit is not None and len(rows) > limit:
        rows = [rows[i] for i in np.linspace(0, len(rows) - 1, limit).round().astype(int)]
    for row in rows:
        recorded = source.read_row(board, row)
        samples, rx = source.instrument.chirp.samples, len(source.instrument.antennas.rx_mm)
        yield row, *row_words(recorded.payload, recorded.missing, recorded.frames_expected, samples, rx)
