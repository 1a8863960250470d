"""Synchronise the rows of a source: raw rows with `synchronise_row`, rows of cubes by converting their form."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.capture import row_words, valid_frames
from polysight.store import CubeRow, RowData, Source
from polysight.sync.chain import BoardSetup, SyncedRow, synchronise_pieces
from polysight.sync.cubes import CubeForm, detect_form
from polysight.sync.high_pass_filter import HighPass
from polysight_shared.config import Instrument

_CUBE_ROWS = 7  # rows used to detect the form of a cube
_POSITIONS = 32  # read at a time: 2 MB, which stay in the processor's cache


class RowSynchroniser:
    """Synchronises the rows of one scan.

    Parameters
    ----------
    source
        The scan.
    rig
        Its calibrated rig.
    filters
        Measured high-pass filter of each receiver, by board name; None: as the chirp profile programs it.
    """

    def __init__(self, source: Source, rig: Instrument, filters: Mapping[str, HighPass | None]) -> None:
        self._source = source
        self.setups = {b.name: BoardSetup.of(rig, b, model=filters.get(b.name)) for b in rig.receivers}
        self._forms: dict[str, CubeForm] = {}

    def synchronise(self, board: str, recorded: RowData | CubeRow) -> tuple[SyncedRow, int]:
        """Synchronise a row of a board; return it and the number of whole frames. Raises DataError."""
        rig = self._source.instrument
        if isinstance(recorded, CubeRow):
            synced = self._form(board).synced(recorded.cube, rig.burst.chirps_a_position)
            return synced, int(synced.valid.sum())
        valid = valid_frames(recorded.missing, recorded.frames_expected, rig.frame_bytes // rig.burst.chirps)
        return synchronise_pieces(self._words(recorded), valid, self.setups[board]), int(valid.sum())

    def _words(self, recorded: RowData) -> Iterator[NDArray[np.int16]]:
        """Iterate over the words of a row, [frame, sample, 2, rx], some positions at a time."""
        rig = self._source.instrument
        frame = rig.frame_bytes // rig.burst.chirps
        for piece in recorded.pieces(_POSITIONS * rig.burst.chirps_a_position * frame):
            yield row_words(piece, (), piece.size // frame, rig.chirp.samples)[0]

    @property
    def direct_path_known(self) -> bool:
        """True if amplitudes are relative to the direct path; False for cubes without it."""
        return not any(form.constant.any() for form in self._forms.values())

    def recording_facts(self) -> dict[str, Any]:
        """Return the entry on recording of quality.json, with the form of cubes."""
        facts = self._source.recording_facts()
        if self._forms:
            facts["recording"]["cubes"] = {name: form.how for name, form in self._forms.items()}
        return facts

    def _form(self, board: str) -> CubeForm:
        """Return the form of a board's cube, detected from a few of its rows."""
        if board not in self._forms:
            rig, rows = self._source.instrument, self._source.plan.rows
            some = sorted({int(r) for r in np.linspace(0, rows - 1, _CUBE_ROWS)})
            cubes = [row.cube for r in some if isinstance(row := self._source.read_row(board, r), CubeRow)]
            self._forms[board] = detect_form(cubes, rig, rig.by_name(board))
        return self._forms[board]
