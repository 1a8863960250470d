"""Recorded scans, as calibration looks at them: their rows, board by board."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polysight.host.calibration.files import SourceScan
from polysight.host.capture.decode import row_words
from polysight.host.store.source import RawSource, raw_source
from polysight.host.store.sources.open import open_source
from polysight.shared.config import Instrument
from polysight.shared.errors import DataError


def open_raw(folder: Path, rig: Instrument | None = None) -> RawSource:
    """A recorded scan whose chirps are there. Raises DataError.

    `rig` is for recordings that bring none of their own.
    """
    source = raw_source(open_source(folder, rig), folder)
    if next(iter(source.rows()), None) is None:
        raise DataError(
            f"{folder}: no row is recorded whole",
            "the scan was stopped in its first row, or files are missing",
            f"`polysight resume {folder}` takes the missing rows",
        )
    return source


def facts_of(source: RawSource, folder: Path) -> SourceScan:
    """Where a calibration comes from."""
    return SourceScan(source.scan_id, str(folder), source.simulated, len(list(source.rows())))


def board_rows(
    source: RawSource, board: str, at_most: int | None = None
) -> Iterator[tuple[int, NDArray[np.int16], NDArray[np.bool_]]]:
    """Index, words int16 [frame, sample, 2, rx] and valid bool [frame] of rows; `at_most` of them, evenly spread."""
    rows = list(source.rows())
    if at_most is not None and len(rows) > at_most:
        rows = [rows[i] for i in np.linspace(0, len(rows) - 1, at_most).round().astype(int)]
    for row in rows:
        recorded = source.read_row(board, row)
        samples, rx = source.instrument.chirp.samples, len(source.instrument.antennas.rx_mm)
        yield row, *row_words(recorded.payload, recorded.missing, recorded.frames_expected, samples, rx)
