"""Start frequencies of the receivers that put their direct paths in the middle of the band, from a measured scan.

IF = K tau + start offset (and crystals, triggers): whatever moved the direct path away from where geometry and rig
file put it, the offset undoes. Where it lies beyond the band, what is seen is an alias, whole sample rates away; the
geometry tells how many.
"""

from __future__ import annotations

import numpy as np

from polysight.host.calibration.direct_signal import band_hz, find_direct, unwrapped
from polysight.host.calibration.files import BoardStart
from polysight.host.calibration.rows import board_rows
from polysight.host.radar.constraints import direct_if_hz
from polysight.host.store.sources.source import ScanSource
from polysight.host.sync import BoardSetup
from polysight.shared.config import Board, Instrument
from polysight.shared.errors import DataError

ROWS = 4
FOUND = 0.25  # part of the chirps in which a direct path must be found to be believed


def fit_start(source: ScanSource, board_name: str) -> BoardStart:
    """The start offset of a board, from where its direct path was.

    Raises
    ------
    DataError
        when it was hardly ever found; the error names the offset by geometry alone.
    """
    rig = source.instrument
    board = rig.by_name(board_name)
    setup = BoardSetup.of(rig, board)
    heard = [find_direct(rig, board, words, ok, setup) for _, words, ok in board_rows(source, board_name, ROWS)]
    if_hz, chirps = np.concatenate([s.if_hz for s in heard]), sum(s.chirps for s in heard)
    expected = direct_if_hz(rig, board)
    if if_hz.size < max(2, FOUND * chirps):
        raise DataError(
            f"{source.scan_id}: a direct path of {board_name} in {if_hz.size} of {chirps} chirps only",
            "it lies outside the band and is filtered away, or something stands in it",
            f"by geometry alone start_offset_hz = {by_geometry(rig, board):.0f} for {board_name}; scan again with it",
        )
    if_hz = unwrapped(if_hz, rig)
    return start_of(rig, board, expected, float(if_hz.mean()), float(if_hz.std() / np.sqrt(if_hz.size)), if_hz.size)


def start_of(
    rig: Instrument, board: Board, expected_hz: float, seen_hz: float, error_hz: float, chirps: int
) -> BoardStart:
    """The offset that moves a direct path seen at `seen_hz`, whatever sample rates away it really is, to the middle."""
    rate, middle = rig.chirp.sample_rate_hz, sum(band_hz(rig)) / 2
    alias = round((expected_hz - seen_hz) / rate)
    offset = board.start_offset_hz + middle - (seen_hz + alias * rate)
    return BoardStart(
        float(round(offset)), board.start_offset_hz, seen_hz, error_hz, expected_hz, middle, alias, chirps
    )


def by_geometry(rig: Instrument, board: Board) -> float:
    """The offset by the rig file alone, hertz."""
    return board.start_offset_hz + sum(band_hz(rig)) / 2 - direct_if_hz(rig, board)
