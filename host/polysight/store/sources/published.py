"""Read the published data set as scans: `unsynced/<scan>` (raw rows) and `raw/<scan>` (synchronised cubes).

Rows are files named by the grid index of their start, `<x>_<y>.bin`, each with a log of its packets. Lost packets are
zeros in the file or missing from it (`packet_zero_filling`); positions at which a radar did not start are missing.
A scan recorded column by column is read as a row scan of the rig mirrored in x = y (`mirrored`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.store.source import CubeRow, RowData, pieces_of
from polysight.store.sources.published_packets import (
    Bursts,
    RowShape,
    Stream,
    find_bursts,
    period_s,
    positions_of,
    read_log,
    read_stream,
)
from polysight.store.sources.published_settings import mirrored, read_settings, rig_of
from polysight_shared.config import Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError
from polysight_shared.findings import Finding
from polysight_shared.raster import RasterPlan, plan_raster

_ROW_FILE = re.compile(r"(\d+)_(\d+)\.bin")
SYNCED = "_synced.npy"


@dataclass(frozen=True)
class RowLosses:
    """Losses of one board's recording of one row."""

    packets_lost: int = 0  # sent by the card and not received
    positions_missing: int = 0  # at which the radar did not start
    positions_short: int = 0  # with fewer frames than pulses; masked, because the missed pulse is unknown
    rows_not_placed: int = 0  # 1 if unknown positions are missing: the whole row is masked


class _Published:
    """Common properties of both kinds of the authors' folders."""

    synchronised = False
    manifest_faults: tuple[Finding, ...] = ()

    def __init__(self, path: Path, base: Instrument) -> None:
        self.path = path
        self._settings = read_settings(path)
        rig, self.notices = rig_of(self._settings, base, path)
        self.mirrored = self._settings.by_columns
        self._instrument = mirrored(rig) if self.mirrored else rig
        self._plan = plan_raster(self._instrument.grid)

    @property
    def instrument(self) -> Instrument:
        """The base rig with this scan's grid, burst, chirp, distances and angles; mirrored for a scan by columns."""
        return self._instrument

    @property
    def plan(self) -> RasterPlan:
        """The plan of positions; the rows of a scan by columns are its columns."""
        return self._plan

    @property
    def simulated(self) -> bool:
        """True if the description contains "simulated"."""
        return "simulated" in self._settings.description.lower()

    @property
    def scan_id(self) -> str:
        """The folder's name."""
        return self.path.name


class PublishedScan(_Published):
    """An `unsynced/<scan>` folder as a source. Raises DataError if the files are not of that form."""

    def __init__(self, path: Path, base: Instrument) -> None:
        super().__init__(path, base)
        burst = self._instrument.burst
        self._shape = RowShape(self._plan.columns, burst.pulses, self._instrument.frame_bytes)
        self._losses: dict[str, dict[int, RowLosses]] = {b.name: {} for b in base.receivers}
        self._files: dict[str, dict[int, Path]] = {b.name: self._row_files(b.name) for b in base.boards}

    def _row_files(self, board_name: str) -> dict[int, Path]:
        found = {}
        for file in (self.path / board_name).glob("*.bin"):
            match = _ROW_FILE.fullmatch(file.name)
            if match is None:
                continue
            start, row = (int(match[2 if self.mirrored else 1]), int(match[1 if self.mirrored else 2]))
            if row < self._plan.rows:
                self._check_start(file, start, row)
                found[row] = file
        return found

    def _check_start(self, file: Path, start: int, row: int) -> None:
        expected = self._plan.row(row).column(0)
        if start != expected:
            row_name, column_name = ("column", "row") if self.mirrored else ("row", "column")
            raise DataError(
                f"{file}: {row_name} {row} starts at {column_name} {start}; in a serpentine from {column_name} 0 it"
                f" starts at {expected}",
                "another order than the published scans'",
                "this scan cannot be processed",
                code=ErrorCode.FILE_FOREIGN,
            )

    def rows(self) -> Iterator[int]:
        """Rows of which both receiving boards have data, ascending."""
        h, v = (set(self._files[b.name]) for b in self._instrument.receivers)
        yield from sorted(h & v)

    def read_row(self, board_name: str, row: int) -> RowData:
        """Read one board's recording of one row, with its gaps located by the packet logs.

        Raises
        ------
        DataError
            if the row is missing, or file and log contradict each other.
        """
        stream = self._stream(board_name, row)
        if stream is None:
            what = f"{self.path}: no row {row} of board {board_name}"
            raise DataError(what, "the download is not complete", code=ErrorCode.NO_DATA)
        shape, frames = self._shape, self._shape.positions * self._shape.pulses
        lost = stream.packets_lost
        if stream.data.size >= shape.bytes:  # nothing slipped
            self._note(board_name, row, RowLosses(lost))
            gaps = [(a, min(b, shape.bytes)) for a, b in stream.lost if a < shape.bytes]
            return RowData(pieces_of(stream.data[: shape.bytes]), gaps, frames)
        bursts = find_bursts(stream, shape)
        at = None
        if bursts is not None:
            others = self._others(board_name, row)
            periods = [p for p in (self._period_s, *map(period_s, (bursts, *others))) if p]
            at = positions_of(bursts, others, shape.positions, min(periods, default=None))
        if bursts is None or at is None:
            self._note(board_name, row, RowLosses(lost, rows_not_placed=1))
            return RowData(pieces_of(np.zeros(shape.bytes, np.uint8)), [(0, shape.bytes)], frames)
        payload, there, short = _place(stream, bursts, at, shape)
        self._note(board_name, row, RowLosses(lost, shape.positions - at.size, short))
        edges = np.flatnonzero(np.diff(np.concatenate([[1], there, [1]]).astype(np.int8)))
        gaps = [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
        return RowData(pieces_of(payload), gaps, frames)

    def _stream(self, board_name: str, row: int) -> Stream | None:
        file = self._files.get(board_name, {}).get(row)
        if file is None:
            return None
        log = read_log(file.with_name(file.stem + "_log.csv"))
        return read_stream(file, log, self._shape, self._settings.packet_zero_filling)

    def _others(self, board_name: str, row: int) -> list[Bursts]:
        """Return the bursts of the same row from the other boards."""
        streams = [self._stream(name, row) for name in self._files if name != board_name]
        return [b for s in streams if s is not None and (b := find_bursts(s, self._shape)) is not None]

    @cached_property
    def _period_s(self) -> float | None:
        """Time from one position to the next in the first complete row; None if there is none."""
        for board in self._instrument.receivers:
            for row in sorted(self._files[board.name]):
                stream = self._stream(board.name, row)
                if stream is not None and stream.data.size >= self._shape.bytes and stream.at_s.size:
                    bursts = find_bursts(stream, self._shape)
                    return None if bursts is None else period_s(bursts)
        return None

    def _note(self, board_name: str, row: int, losses: RowLosses) -> None:
        self._losses.setdefault(board_name, {})[row] = losses

    def recording_facts(self) -> dict[str, Any]:
        """Return the losses of the rows read so far and the number of missing rows, by board."""
        boards = {}
        for board in self._instrument.receivers:
            rows = [asdict(r) for r in self._losses[board.name].values()]
            total = {key: sum(r[key] for r in rows) for key in asdict(RowLosses())}
            boards[board.name] = {**total, "rows_absent": self._plan.rows - len(self._files[board.name])}
        how = {"direction": self._settings.moving_direction, "boards": boards, "notices": list(self.notices)}
        return {"recording": how}


def _place(
    stream: Stream, bursts: Bursts, positions: NDArray[np.int64], shape: RowShape
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], int]:
    """Return the row's payload, a mask of bytes that arrived, and the number of positions with a wrong frame count."""
    size, burst, short = stream.data.size, shape.burst_bytes, 0
    payload, there = np.zeros(shape.bytes, np.uint8), np.zeros(shape.bytes, bool)
    arrived = np.ones(size, bool)
    for a, b in stream.lost:
        arrived[a:b] = False
    for (a, b), at in zip(bursts.ranges, positions * burst, strict=True):
        if b - a != burst:
            short += 1
            continue
        stop = min(b, size)
        payload[at : at + stop - a] = stream.data[a:stop]
        there[at : at + stop - a] = arrived[a:stop]
    payload[~there] = 0
    return payload, there, short


class PublishedCubes(_Published):
    """A `raw/<scan>` folder with cubes that the authors have synchronised."""

    synchronised = True

    def rows(self) -> Iterator[int]:
        """All rows of the plan."""
        yield from range(self._plan.rows)

    def read_row(self, board_name: str, row: int) -> CubeRow:
        """Read one board's row with the authors' reference. Raises DataError if it is missing or of a wrong shape."""
        file = self.path / f"{board_name}{SYNCED}"
        try:
            cube = np.load(file, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError) as e:
            what = f"{file}: not a cube: {e}"
            raise DataError(what, "the download is not complete", code=ErrorCode.FILE_DAMAGED) from None
        rig, s = self._instrument, self._settings
        shape = (len(rig.antennas.rx_mm), s.total_y, s.total_x, rig.chirp.samples)
        if cube.shape != shape:
            what = f"{file}: shape {cube.shape}, {shape} in its settings"
            raise DataError(what, "not the settings of this scan", code=ErrorCode.MISMATCH)
        ascending = cube[:, :, row] if self.mirrored else cube[:, row]  # from the smallest x (y) on
        return CubeRow(np.array(ascending[:, :: self._plan.row(row).direction], np.complex64))

    def recording_facts(self) -> dict[str, Any]:
        """Return the direction and the notices."""
        return {"recording": {"direction": self._settings.moving_direction, "notices": list(self.notices)}}
