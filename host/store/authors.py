"""The published data set read as scans: `unsynced/<scan>` (raw rows) and `raw/<scan>` (synchronised cubes).

Rows are files named by the grid index where they start, `<x>_<y>.bin`, with a log of their packets beside them. Lost
packets are zeros in the file or absent from it (`packet_zero_filling`); positions at which a radar did not start are
absent.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from host.store.scanfolder import MANIFEST, ScanFolder
from host.store.source import RowData
from shared.config import Board, Instrument, MountStep, decode
from shared.errors import DataError
from shared.raster import RasterPlan, plan_raster

_ROW_FILE = re.compile(r"(\d+)_(\d+)\.bin")
_COLLECTION, _DEVICES = "data_collection_cfg.json", "devices_comm_cfg.json"
_SYNCED = "_synced.npy"


class _ChirpConfig(msgspec.Struct, frozen=True):
    """One of `chirp_configs`, in SI or in the units of TI's tools (GHz, MHz/us, us, ksps)."""

    f0: float
    slope: float
    ramp_time: float
    adc_start_time: float
    num_adc: int
    Fs: float


class _Collection(msgspec.Struct, frozen=True):
    """`data_collection_cfg.json`, as far as it is needed. Lengths in mm, times in ms, `board_dist` in m."""

    dx: float
    dy: float
    total_x: int
    total_y: int
    num_trigger: int
    period_frame: float
    num_adc: int
    object_distance: float
    board_dist: float | None = None
    moving_direction: str = "row"
    num_chirp: int = 1
    packet_zero_filling: bool = True
    description: str = ""
    chirp_configs: tuple[_ChirpConfig, ...] = ()


class _Packets(NamedTuple):
    """A packet log: sequence number, payload bytes and arrival (unix seconds) of each packet that arrived."""

    sequence: NDArray[np.int64]
    size: NDArray[np.int64]
    at_s: NDArray[np.float64]


def open_scan(path: Path, base: Instrument | None = None) -> ScanFolder | AuthorsScan | AuthorsCube:
    """Open recorded data of any layout, recognised by what the folder holds.

    Parameters
    ----------
    path
        A scan folder, or the authors' `unsynced/<scan>` or `raw/<scan>`.
    base
        Rig file whose geometry, stage and limits an authors' scan takes over: their files do not tell them.

    Raises
    ------
    DataError
        when it is none of them, or an authors' scan is opened without `base`.
    """
    if (path / MANIFEST).exists():
        return ScanFolder.load(path)
    cube = any(path.glob("*" + _SYNCED))
    if not cube and not (path / _COLLECTION).exists():
        raise DataError(
            f"{path}: not a scan: neither {MANIFEST} nor {_COLLECTION} nor *{_SYNCED} is in it",
            "the path is wrong, or the download is not complete",
            "give a scan folder, or a folder unsynced/<scan> or raw/<scan> of the published data",
        )
    if base is None:
        raise DataError(
            f"{path}: the published data does not tell the rig's geometry",
            "no rig file was given",
            "give the instrument.toml of the published rig",
        )
    return AuthorsCube(path, base) if cube else AuthorsScan(path, base)


class _Published:
    """What both of the authors' folders tell."""

    def __init__(self, path: Path, base: Instrument) -> None:
        self.path = path
        settings = {**_json(path / _DEVICES, missing_ok=True), **_json(path / _COLLECTION)}
        self._settings = decode(settings, _Collection, str(path / _COLLECTION))
        self._instrument = _instrument(self._settings, base, path)
        self._plan = plan_raster(self._instrument.grid)

    @property
    def instrument(self) -> Instrument:
        """The base rig with this scan's grid, burst, chirp and distances."""
        return self._instrument

    @property
    def plan(self) -> RasterPlan:
        """Where every position is."""
        return self._plan

    @property
    def simulated(self) -> bool:
        """Whether the description says so."""
        return "simulated" in self._settings.description.lower()

    @property
    def scan_id(self) -> str:
        """The folder's name."""
        return self.path.name


class AuthorsScan(_Published):
    """An `unsynced/<scan>` folder as a `ScanSource`.

    Raises
    ------
    DataError
        when the files are not of that form, or the scan was not taken row by row.
    """

    def __init__(self, path: Path, base: Instrument) -> None:
        super().__init__(path, base)
        self._files: dict[str, dict[int, Path]] = {}
        for board in base.boards:
            found = {}
            for file in (path / board.name).glob("*.bin"):
                match = _ROW_FILE.fullmatch(file.name)
                if match and int(match[2]) < self._plan.rows:
                    self._check_start(file, int(match[1]), int(match[2]))
                    found[int(match[2])] = file
            self._files[board.name] = found

    def _check_start(self, file: Path, column: int, row: int) -> None:
        expected = self._plan.row(row).column(0)
        if column != expected:
            raise DataError(
                f"{file}: row {row} starts at column {column}, a serpentine from column 0 has it start at {expected}",
                "another order of rows than the published scans'",
                "this scan cannot be processed",
            )

    def rows(self) -> Iterator[int]:
        """Rows that both receiving boards hold, ascending."""
        h, v = (set(self._files[b.name]) for b in self._instrument.receivers)
        yield from sorted(h & v)

    def read_row(self, board_name: str, row: int) -> RowData:
        """One board's recording of one row, with what is missing placed by the packet log.

        Raises
        ------
        DataError
            when the row is absent, or file and log contradict each other.
        """
        file = self._files.get(board_name, {}).get(row)
        if file is None:
            raise DataError(f"{self.path}: no row {row} of board {board_name}", "the download is not complete")
        burst = self._instrument.burst.pulses * self._instrument.frame_bytes
        frames = self._plan.columns * self._instrument.burst.pulses
        log = _packet_log(file.with_name(file.stem + "_log.csv"))
        raw = np.fromfile(file, np.uint8)
        payload, there = np.zeros((2, self._plan.columns * burst), np.uint8)
        if log is not None:
            raw, arrived, at_s = _place_packets(raw, log, payload.size, self._settings.packet_zero_filling, file)
            bursts = _burst_positions(at_s, raw.size, burst, self._plan.columns)
        else:
            arrived, bursts = np.ones(raw.size, bool), np.arange(-(-raw.size // burst))
        for i, position in enumerate(bursts[: self._plan.columns]):
            if position < self._plan.columns:
                piece = slice(i * burst, min((i + 1) * burst, raw.size))
                goes = slice(position * burst, position * burst + piece.stop - piece.start)
                payload[goes], there[goes] = raw[piece], arrived[piece]
        return RowData(payload, _ranges(there == 0), frames)


class AuthorsCube(_Published):
    """A `raw/<scan>` folder: cubes that the authors synchronised themselves."""

    def rows(self) -> Iterator[int]:
        """All rows of the plan."""
        yield from range(self._plan.rows)

    def read_synced(self, board_name: str, row: int) -> NDArray[np.complex64]:
        """One board's row: complex64 [rx, column, sample], column 0 the smallest x, referenced as the authors left it.

        Raises
        ------
        DataError
            when the cube is absent or has another shape than the scan's settings.
        """
        file = self.path / f"{board_name}{_SYNCED}"
        try:
            cube = np.load(file, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError) as e:
            raise DataError(f"{file}: not a cube: {e}", "the download is not complete") from None
        rig = self._instrument
        shape = (len(rig.antennas.rx_mm), self._plan.rows, self._plan.columns, rig.chirp.samples)
        if cube.shape != shape:
            raise DataError(f"{file}: shape {cube.shape}, its settings say {shape}", "not the settings of this scan")
        return np.array(cube[:, row], np.complex64)


def _json(path: Path, missing_ok: bool = False) -> dict[str, Any]:
    if missing_ok and not path.exists():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as e:
        raise DataError(f"{path}: not JSON: {e}", "the download is not complete", "fetch the file again") from None
    if not isinstance(content, dict):
        raise DataError(f"{path}: not a JSON object", "the download is not complete", "fetch the file again")
    return content


def _instrument(s: _Collection, base: Instrument, path: Path) -> Instrument:
    """The base rig with a scan's own settings. Mount angles stay the base's."""
    if s.moving_direction != "row" or not s.chirp_configs or s.num_chirp != 1:
        raise DataError(
            f"{path}: moving_direction {s.moving_direction!r}, {len(s.chirp_configs)} chirp configs,"
            f" {s.num_chirp} chirps a frame",
            "only scans taken row by row with one chirp a frame are read",
            "this scan cannot be processed",
        )
    c = s.chirp_configs[0]
    grid = {"columns": s.total_x, "rows": s.total_y, "step_x_mm": s.dx, "step_y_mm": s.dy}
    travel = max(base.stage.travel_x_mm, s.total_x * s.dx), max(base.stage.travel_y_mm, s.total_y * s.dy)
    table = msgspec.to_builtins(base)
    table["grid"] = grid
    table["stage"] |= {"travel_x_mm": travel[0], "travel_y_mm": travel[1]}
    table["stage"] |= {"centre_x_mm": travel[0] / 2, "centre_y_mm": travel[1] / 2}
    table["burst"] |= {"pulses": s.num_trigger, "period_us": s.period_frame * 1e3}
    table["geometry"]["object_distance_mm"] = s.object_distance
    table["chirp"] |= {
        "start_hz": c.f0 if c.f0 > 1e6 else c.f0 * 1e9,
        "slope_hz_per_s": c.slope if c.slope > 1e6 else c.slope * 1e12,
        "ramp_end_us": c.ramp_time * 1e6 if c.ramp_time < 1 else c.ramp_time,
        "adc_start_us": c.adc_start_time * 1e6 if c.adc_start_time < 1e-2 else c.adc_start_time,
        "samples": c.num_adc,
        "sample_rate_hz": c.Fs if c.Fs > 1e5 else c.Fs * 1e3,
        "linear_samples": [min(n, c.num_adc) for n in base.chirp.linear_samples],
    }
    rig = decode(table, Instrument, str(path))
    return rig if s.board_dist is None else _apart(rig, s.board_dist * 1e3)


def _apart(rig: Instrument, distance_mm: float) -> Instrument:
    """The rig with its board origins moved along x to `distance_mm` from each other, as the mounts' last step."""

    def moved(board: Board) -> Board:
        side = -0.5 if board.role == "transmit" else 0.5
        last = board.mount[-1]
        if last.shift_mm is None:
            return board
        step = MountStep(shift_mm=(side * distance_mm, last.shift_mm[1], last.shift_mm[2]))
        return msgspec.structs.replace(board, mount=(*board.mount[:-1], step))

    return msgspec.structs.replace(rig, boards=tuple(moved(b) for b in rig.boards))


def _packet_log(path: Path) -> _Packets | None:
    """A row's packets in order of sequence, without duplicates; None when there is no log. A header line is skipped."""
    if not path.exists():
        return None
    rows = []
    for number, line in enumerate(path.read_text(encoding="ascii", errors="replace").splitlines()):
        words = line.replace(";", ",").split(",")
        try:
            rows.append((int(words[0]), int(words[1]), float(words[2])))
        except (ValueError, IndexError):
            if number and line.strip():
                raise DataError(f"{path}: line {number + 1} is not a packet: {line!r}", "a damaged file") from None
    if not rows:
        return None
    sequence, first = np.unique([r[0] for r in rows], return_index=True)
    size, at_s = (np.array([r[k] for r in rows])[first] for k in (1, 2))
    return _Packets(sequence.astype(np.int64), size.astype(np.int64), at_s.astype(float))


def _place_packets(
    raw: NDArray[np.uint8], log: _Packets, expected: int, zero_filled: bool, file: Path
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float64]]:
    """The stream the card sent: its bytes, which of them arrived, and when each did (by packet; nan where lost)."""
    full = int(log.size.max())
    places = (log.sequence - _first_sequence(log, expected, full)) * full
    size = int(places[-1] + log.size[-1])
    if zero_filled:
        size = max(size, raw.size)
        stream = np.zeros(size, np.uint8)
        stream[: raw.size] = raw
    elif raw.size != log.size.sum():
        raise DataError(
            f"{file}: {raw.size} bytes, its packet log says {log.size.sum()}",
            "file and log are not of one recording, or one of them was cut",
            "fetch both again",
        )
    else:
        stream = np.zeros(size, np.uint8)
    arrived, at_s = np.zeros(size, bool), np.full(-(-size // full), np.nan)
    at_s[places // full] = log.at_s
    source = 0
    for place, n in zip(places, log.size, strict=True):
        if not zero_filled:
            stream[place : place + n] = raw[source : source + n]
            source += n
        arrived[place : place + n] = True
    if zero_filled:
        arrived[raw.size :] = False
    return stream, arrived, np.repeat(at_s, full)[:size]


def _first_sequence(log: _Packets, expected: int, full: int) -> int:
    """Sequence number of the row's first packet, which may itself be lost.

    1 when the numbers fit a record that starts at 1 (the card's counters usually do); else counted back from a short
    last packet; else the first that arrived.
    """
    packets = -(-expected // full)
    if log.sequence[-1] <= packets:
        return 1
    if 0 < log.size[-1] < full:
        return int(min(log.sequence[0], log.sequence[-1] - packets + 1))
    return int(log.sequence[0])


def _burst_positions(at_s: NDArray[np.float64], size: int, burst: int, positions: int) -> NDArray[np.intp]:
    """Position of each burst of the stream. One that is short by whole bursts is spread by arrival times.

    Positions follow each other evenly, so a step of two periods between bursts is a position at which the radar did
    not start. A first position that is missing cannot be told from a last one.
    """
    bursts = -(-size // burst)
    order = np.arange(bursts)
    if bursts >= positions or bursts < 3:
        return order
    middle = at_s[np.minimum(order * burst + burst // 2, size - 1)]
    known = np.flatnonzero(~np.isnan(middle))
    if known.size < 3:
        return order
    middle = np.interp(order, known, middle[known])
    steps = np.diff(middle)
    period = np.quantile(steps, 0.25)  # most steps are one period, the others longer
    if period <= 0:
        return order
    return np.concatenate([[0], np.cumsum(np.maximum(1, np.round(steps / period).astype(int)))])


def _ranges(missing: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Runs of True as (start, stop)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], missing.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
