"""Read the published data set as scans: `unsynced/<scan>` (raw rows) and `raw/<scan>` (synchronised cubes).

Rows are files named by the grid index of their start, `<x>_<y>.bin`, each with a log of its packets. Lost packets are
zeros in the file or missing from it (`packet_zero_filling`); positions at which a radar did not start are missing. A
scan recorded column by column is read as a row scan of the rig mirrored in x = y (`mirrored`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polysight.store.published_rig import COLLECTION, build_rig, mirror_rig, read_settings
from polysight.store.source import HEADER_LOCK, CubeRow, RowData, split_pieces
from polysight_shared.config import Instrument
from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.findings import Finding
from polysight_shared.raster import RasterPlan, plan_raster

Gaps = list[tuple[int, int]]
# Payload of a full packet in bytes, where no log of the packets gives it.
PACKET_BYTES = 1456
# Largest deviation of a pause from a whole number of periods between positions, as a share of a period (chosen).
_MAX_UNEVENNESS = 0.25


class PacketLog(NamedTuple):
    """Packets that arrived, in order of their sequence number, without duplicates; arrays are [packet]."""

    sequence: NDArray[np.int64]
    # Bytes of payload.
    size: NDArray[np.int64]
    # Time of arrival, seconds since 1970.
    at_s: NDArray[np.float64]


@dataclass(frozen=True)
class RowShape:
    """Size of a complete row of one board: positions, pulses of a burst, bytes of a frame."""

    positions: int
    pulses: int
    frame_bytes: int

    @property
    def burst_bytes(self) -> int:
        """Bytes of one position."""
        return self.pulses * self.frame_bytes

    @property
    def bytes(self) -> int:
        """Bytes of the row."""
        return self.positions * self.burst_bytes


@dataclass(frozen=True)
class Stream:
    """Data that the card sent in one row."""

    # uint8 [n]: the payload, zero where bytes were lost.
    data: NDArray[np.uint8]
    # Byte ranges that never arrived, and the number of packets in them.
    lost: Gaps
    packets_lost: int
    # Offset of each packet that arrived, bytes; empty without a log.
    start: NDArray[np.int64]
    # Time of arrival of each of these, seconds since 1970.
    at_s: NDArray[np.float64]
    # Payload of a full packet, bytes.
    packet_bytes: int


class Bursts(NamedTuple):
    """Bursts of a stream: byte ranges (start, stop), [burst, 2], and when each began to arrive, seconds since 1970."""

    ranges: NDArray[np.int64]
    at_s: NDArray[np.float64]


def read_log(path: Path) -> PacketLog | None:
    """Read a row's packet log; None if there is none, or none with a packet. A header line is skipped.

    The first three columns are sequence number, bytes of payload, and time of arrival.
    A last packet that is not full gets the arrival time of the one before it: the card delays it by 2 s, and it would
    look like another position.

    Raises
    ------
    DataError
        with the first value that is not a number.
    """
    if not path.exists():
        return None
    lines = [line for line in path.read_text("ascii", "replace").replace(";", ",").split("\n") if line.strip()]
    # The first line is a header if it does not begin with a digit.
    if lines and not lines[0].lstrip()[0].isdigit():
        del lines[0]
    if not lines:
        return None
    try:
        table = np.loadtxt(lines, delimiter=",", usecols=(0, 1, 2), ndmin=2)
    except ValueError as e:
        problem = f"{path}: not a packet log: {e}"
        raise DataError(problem, "a damaged file", "download it again", code=ErrorCode.FILE_DAMAGED) from None
    sequence, first = np.unique(table[:, 0].astype(np.int64), return_index=True)
    size = table[first, 1].astype(np.int64)
    at_s = table[first, 2]
    if size[-1] < size.max():
        at_s[-1] = at_s[-2]
    return PacketLog(sequence, size, at_s)


# A stream may span at most this many times the bytes of a row and its file together (chosen): what is missing is filled
# with zeros, so that one damaged packet number could fill the memory.
_MAX_ROWS = 16


def read_stream(file: Path, log: PacketLog | None, shape: RowShape, zero_filled: bool) -> Stream:
    """Read a row's stream from its file and its log.

    In a zero-filled file every packet of zeros is a lost one, regardless of the log: real samples have noise.

    Raises
    ------
    DataError
        if file and log are not of one recording, or the log's sequence numbers jump.
    """
    raw = np.fromfile(file, np.uint8)
    no_packets = np.zeros(0, np.int64)
    if log is None:
        silent = np.zeros(0, bool)
        if zero_filled:
            silent = _find_silent(raw, PACKET_BYTES)
        return Stream(
            raw, _find_ranges(silent, PACKET_BYTES, raw.size), int(silent.sum()), no_packets, np.zeros(0), PACKET_BYTES
        )
    full_size = int(log.size.max())
    row_begin = _find_first_sequence(log, shape, full_size, raw if zero_filled else None)
    start = (log.sequence - row_begin) * full_size
    end = int(start[-1] + log.size[-1])
    if end > _MAX_ROWS * (shape.bytes + raw.size):
        raise DataError(
            f"{file}: its packet log spans {end} bytes, a row has {shape.bytes}",
            "the numbers of its packets jump: a damaged log, or one of several rows",
            "fetch both again",
            code=ErrorCode.FILE_DAMAGED,
        )
    if not zero_filled and raw.size != log.size.sum():
        raise DataError(
            f"{file}: {raw.size} bytes, its packet log says {log.size.sum()}",
            "file and log do not belong to one recording, or one of them is incomplete",
            "fetch both again",
            code=ErrorCode.MISMATCH,
        )
    if zero_filled:
        end = max(end, raw.size)
    if end == raw.size:
        data = raw
    elif zero_filled:
        data = np.concatenate([raw, np.zeros(end - raw.size, np.uint8)])
    else:
        data = _spread(raw, start, log.size, end)
    count = -(-end // full_size)
    arrived_packets = np.zeros(count, bool)
    arrived_packets[start // full_size] = True
    if zero_filled:
        arrived_packets &= ~_find_silent(data, full_size)
        # Packets that the log lists beyond the file's end are missing.
        packets_in_file = -(-raw.size // full_size)
        arrived_packets[packets_in_file:] = False
    arrived = arrived_packets[start // full_size]
    lost_ranges = _find_ranges(~arrived_packets, full_size, end)
    return Stream(data, lost_ranges, int(count - arrived_packets.sum()), start[arrived], log.at_s[arrived], full_size)


def _spread(raw: NDArray[np.uint8], start: NDArray[np.int64], size: NDArray[np.int64], end: int) -> NDArray[np.uint8]:
    """Move the packets of a file without the lost ones to their offsets, [byte]."""
    data = np.zeros(end, np.uint8)
    stop = start + size
    start_in_file = np.concatenate([[0], np.cumsum(size)])
    # Packets between which nothing was lost, from `first` to before `end_of_run`, are moved together.
    breaks = np.flatnonzero(start[1:] != stop[:-1]) + 1
    for first, end_of_run in zip([0, *breaks], [*breaks, start.size], strict=True):
        run = raw[start_in_file[first] : start_in_file[end_of_run]]
        data[start[first] : stop[end_of_run - 1]] = run
    return data


def _find_silent(data: NDArray[np.uint8], packet: int) -> NDArray[np.bool_]:
    """Return which packets of `packet` bytes are all zero, bool [packet]; the last one may be shorter."""
    # Words of eight bytes are compared faster than bytes.
    whole_packets = data.size // packet
    rows = data[: whole_packets * packet].reshape(whole_packets, packet)
    if packet % 8 == 0 and data.ctypes.data % 8 == 0:
        words = rows.view(np.uint64)
    else:
        words = rows
    tail = []
    if data.size % packet:
        tail = [not data[whole_packets * packet :].any()]
    return np.append(~np.any(words, axis=1), np.array(tail, bool))


def _find_first_sequence(log: PacketLog, shape: RowShape, full_bytes: int, zeroed_raw: NDArray[np.uint8] | None) -> int:
    """Return the sequence number of the row's first packet, which may be lost.

    `full_bytes` is the payload of a full packet, bytes, `zeroed_raw` the file's bytes if it is zero-filled, otherwise
    None.

    In a zero-filled file the packets of zeros at its beginning were lost: their number is subtracted from the sequence
    number of the first packet that arrived. In another file the number is counted back from the last packet, if that is
    as short as the last one of a complete row (a row that lacks a frame ends elsewhere) and no position is missing.
    Otherwise it is that of the first packet that arrived. If the result is neither 0 nor 1, but the last number fits a
    row that was counted from 1, the result is 1, or 0 if packet 0 arrived: cards count from 1, a log may count from 0.
    """
    expected = -(-shape.bytes // full_bytes)
    first_arrived = int(log.sequence[0])
    last = int(log.sequence[-1])
    begin = first_arrived
    last_size = int(log.size[-1])
    ends_complete = last_size < full_bytes and last_size == shape.bytes - (expected - 1) * full_bytes
    if zeroed_raw is not None:
        silent_packets = _find_silent(zeroed_raw, full_bytes)
        # The index of the first packet that is not silent is the number of packets before it.
        begin -= int(np.argmin(np.append(silent_packets, False)))
    elif ends_complete and _find_pauses(log.at_s, shape.positions - 1).size == shape.positions - 1:
        begin = min(first_arrived, last - expected + 1)
    fits_from_1 = last <= expected
    if begin not in (0, 1) and fits_from_1:
        return min(first_arrived, 1)
    return begin


def _find_pauses(at_s: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Return the indices of the packets after a pause between bursts, of which about `count` are expected.

    Most of the `count` longest pauses are those between neighbouring positions; the threshold is half of their first
    quartile.
    """
    steps = np.diff(at_s)
    if count < 1 or steps.size < count:
        return np.zeros(0, np.int64)
    longest_steps = np.sort(steps)[-count:]
    typical = longest_steps[count // 4]
    return np.flatnonzero(steps > typical / 2) + 1


def find_bursts(stream: Stream, shape: RowShape) -> Bursts | None:
    """Find the bursts of a stream; None if there are no arrival times: without a log, or if no packet arrived."""
    if not stream.at_s.size:
        return None
    frame = shape.frame_bytes
    end = stream.data.size
    first_packets = _find_pauses(stream.at_s, -(-end // shape.burst_bytes) - 1)
    ends = np.zeros(first_packets.size, np.int64)
    # A burst ends between the ends of the packets before and after the pause, for the latter holds its last bytes.
    ends_before = np.minimum(stream.start[first_packets - 1] + stream.packet_bytes, end)
    ends_behind = stream.start[first_packets] + stream.packet_bytes
    for i, (low, high) in enumerate(zip(ends_before, ends_behind, strict=True)):
        # It ends after a whole number of bursts from its beginning, if such an end lies there, otherwise after a whole
        # number of frames.
        begun = 0
        if i:
            begun = ends[i - 1]
        whole_bursts_end = begun + -(-(low - begun) // shape.burst_bytes) * shape.burst_bytes
        if whole_bursts_end < high:
            ends[i] = whole_bursts_end
        else:
            ends[i] = -(-low // frame) * frame
    edges = np.concatenate([[0], ends, [-(-end // frame) * frame]])
    return Bursts(np.stack([edges[:-1], edges[1:]], axis=1), stream.at_s[np.concatenate([[0], first_packets])])


def period_s(bursts: Bursts) -> float | None:
    """Return the time between neighbouring positions, seconds; None for fewer than two bursts.

    At least a quarter of the bursts must be followed by that of the next position.
    """
    if bursts.at_s.size > 1:
        # A quartile, not the median: missing positions make gaps longer, and nothing makes them shorter.
        return float(np.quantile(np.diff(bursts.at_s), 0.25))
    return None


def find_positions(
    bursts: Bursts, other_boards: list[Bursts], positions: int, period: float | None
) -> NDArray[np.int64] | None:
    """Return the position of each burst in the row, int64 [burst]; None if undetermined. `period` in seconds.

    Positions are evenly spaced in time, so a step of two periods is a position at which no radar started. The boards
    share triggers and clock: the first position is known only if all boards together span the row.
    """
    times = np.sort(np.concatenate([b.at_s for b in (bursts, *other_boards)]))
    if period is None or period <= 0 or positions < 2:
        return None
    # Bursts of several boards at one time are one event: a position.
    events = times[np.concatenate([[True], np.diff(times) > period / 2])]
    steps = np.diff(events) / period
    if np.any(np.abs(steps - np.round(steps)) > _MAX_UNEVENNESS):
        return None
    index = np.concatenate([[0], np.cumsum(np.round(steps).astype(np.int64))])
    position = index[np.searchsorted(events, bursts.at_s, side="right") - 1]
    if index[-1] == positions - 1 and np.all(np.diff(position) > 0):
        return position
    return None


def _find_ranges(missing: NDArray[np.bool_], unit: int, end: int) -> Gaps:
    """Return the runs of True, each `unit` bytes, as (start, stop) up to `end`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], missing.astype(np.int8), [0]])))
    return [(int(a) * unit, min(int(b) * unit, end)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


# Name of a row's file: column and row of its start.
_ROW_FILE = re.compile(r"(\d+)_(\d+)\.bin")
# End of the name of a file with a board's cube.
SYNCED = "_synced.npy"


@dataclass(frozen=True)
class RowLosses:
    """Losses of one board's recording of one row."""

    # Packets that the card sent and that were not received.
    packets_lost: int = 0
    # Positions at which the radar did not start.
    positions_missing: int = 0
    # Positions with another number of frames than pulses: they are masked, because the missed pulse is unknown.
    positions_short: int = 0
    # 1 if the row is too short and it is not known which positions are missing (no log, or no times that fit): the
    # whole row is masked.
    rows_not_placed: int = 0


class _Published:
    """Common properties of both kinds of the authors' folders."""

    synchronised = False
    manifest_faults: tuple[Finding, ...] = ()

    def __init__(self, path: Path, base: Instrument) -> None:
        self.path = path
        self._settings = read_settings(path)
        rig, self.notices = build_rig(self._settings, base, path)
        self.mirrored = self._settings.by_columns
        if self.mirrored:
            self._instrument = mirror_rig(rig)
        else:
            self._instrument = rig
        self._plan = plan_raster(self._instrument.grid)

    @property
    def instrument(self) -> Instrument:
        """The base rig with this scan's grid, burst, chirp, distances and angles; mirrored for a scan by columns."""
        return self._instrument

    @property
    def plan(self) -> RasterPlan:
        """The plan of positions; a row of the plan is a column of the stage if the scan was recorded by columns."""
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
        self._files: dict[str, dict[int, Path]] = {b.name: self._list_row_files(b.name) for b in base.boards}
        self._check_pulses()

    def _check_pulses(self) -> None:
        """Raise DataError if every row has the same whole number of chirps a position, but another than the settings.

        Files that are short by lost data differ from each other.
        """
        boards = {board.name for board in self._instrument.receivers}
        files = [file for name, of_board in self._files.items() if name in boards for file in of_board.values()]
        sizes = {file.stat().st_size for file in files}
        if len(files) < 2 or len(sizes) != 1:
            return
        pulses, rest = divmod(sizes.pop(), self._plan.columns * self._shape.frame_bytes)
        if pulses > 0 and rest == 0 and pulses != self._shape.pulses:
            raise DataError(
                f"{self.path / COLLECTION}: num_trigger = {self._settings.num_trigger}, but every row has"
                f" {pulses} chirps at each position",
                "the settings are those of another scan",
                f"correct num_trigger, or fetch {COLLECTION} again",
                code=ErrorCode.MISMATCH,
            )

    def _list_row_files(self, board_name: str) -> dict[int, Path]:
        """Return the files of a board by row; files with other names and rows outside the plan are left out.

        Raises DataError if one starts at another column than the plan.
        """
        files = {}
        beyond = 0
        for file in (self.path / board_name).glob("*.bin"):
            match = _ROW_FILE.fullmatch(file.name)
            if match is None:
                continue
            start = int(match[1])
            row = int(match[2])
            if self.mirrored:
                start, row = row, start
            if row < self._plan.rows:
                self._check_start(file, start, row)
                files[row] = file
            else:
                beyond += 1
        if beyond:
            told = f"{beyond} files of rows beyond the {self._plan.rows} of {COLLECTION} are left out"
            self.notices += (f"{self.path / board_name}: {told}",)
        return files

    def _check_start(self, file: Path, start: int, row: int) -> None:
        """Raise DataError unless the row starts at the column at which the plan's serpentine does."""
        expected = self._plan.row(row).column(0)
        if start != expected:
            if self.mirrored:
                row_name = "column"
                column_name = "row"
            else:
                row_name = "row"
                column_name = "column"
            raise DataError(
                f"{file}: {row_name} {row} starts at {column_name} {start}; in a serpentine from {column_name} 0 it"
                f" starts at {expected}",
                "another order than the published scans'",
                "this scan cannot be processed",
                code=ErrorCode.FILE_FOREIGN,
            )

    def rows(self) -> Iterator[int]:
        """Return the rows of which both receiving boards have data, ascending."""
        h, v = (set(self._files[b.name]) for b in self._instrument.receivers)
        yield from sorted(h & v)

    def read_row(self, board_name: str, row: int) -> RowData:
        """Read one board's recording of one row, with its gaps located by the packet logs.

        Raises
        ------
        DataError
            if the row is missing, or file and log contradict each other.
        """
        stream = self._open_stream(board_name, row)
        if stream is None:
            problem = f"{self.path}: no row {row} of board {board_name}"
            raise DataError(problem, "the download is not complete", "download it again", code=ErrorCode.NO_DATA)
        shape = self._shape
        frames = self._shape.positions * self._shape.pulses
        packets_lost = stream.packets_lost
        # All bytes are there, so none was shifted by a loss.
        if stream.data.size >= shape.bytes:
            self._note(board_name, row, RowLosses(packets_lost))
            gaps = [(a, min(b, shape.bytes)) for a, b in stream.lost if a < shape.bytes]
            return RowData(split_pieces(stream.data[: shape.bytes]), gaps, frames)
        bursts = find_bursts(stream, shape)
        positions = None
        if bursts is not None:
            other_bursts = self._list_other_bursts(board_name, row)
            # Missing positions make a measured period longer, never shorter: the smallest one counts.
            periods = [p for p in (self._period_s, *map(period_s, (bursts, *other_bursts))) if p]
            positions = find_positions(bursts, other_bursts, shape.positions, min(periods, default=None))
        if bursts is None or positions is None:
            self._note(board_name, row, RowLosses(packets_lost, rows_not_placed=1))
            return RowData(split_pieces(np.zeros(shape.bytes, np.uint8)), [(0, shape.bytes)], frames)
        payload, arrived, positions_short = _place(stream, bursts, positions, shape)
        self._note(board_name, row, RowLosses(packets_lost, shape.positions - positions.size, positions_short))
        gaps = _find_ranges(~arrived, 1, arrived.size)
        return RowData(split_pieces(payload), gaps, frames)

    def _open_stream(self, board_name: str, row: int) -> Stream | None:
        """Read the data that a board's card sent in a row; None if there is no file of it."""
        file = self._files.get(board_name, {}).get(row)
        if file is None:
            return None
        log = read_log(file.with_name(file.stem + "_log.csv"))
        return read_stream(file, log, self._shape, self._settings.packet_zero_filling)

    def _list_other_bursts(self, board_name: str, row: int) -> list[Bursts]:
        """Return the bursts of the same row from the other boards."""
        streams = [self._open_stream(name, row) for name in self._files if name != board_name]
        return [b for s in streams if s is not None and (b := find_bursts(s, self._shape)) is not None]

    @cached_property
    def _period_s(self) -> float | None:
        """Time from one position to the next in the first complete row; None if there is none."""
        for board in self._instrument.receivers:
            for row in sorted(self._files[board.name]):
                stream = self._open_stream(board.name, row)
                if stream is not None and stream.data.size >= self._shape.bytes and stream.at_s.size:
                    bursts = find_bursts(stream, self._shape)
                    if bursts is None:
                        return None
                    return period_s(bursts)
        return None

    def _note(self, board_name: str, row: int, losses: RowLosses) -> None:
        self._losses.setdefault(board_name, {})[row] = losses

    def recording_facts(self) -> dict[str, Any]:
        """Return the losses of the rows read so far and the number of missing rows, by board."""
        # Imported here: a program that only records scans does not load the results.
        from polysight.results import Recording

        boards = {}
        for board in self._instrument.receivers:
            rows = [asdict(r) for r in self._losses[board.name].values()]
            total = {key: sum(r[key] for r in rows) for key in asdict(RowLosses())}
            boards[board.name] = {**total, "rows_absent": self._plan.rows - len(self._files[board.name])}
        direction = self._settings.moving_direction
        return {"recording": Recording(direction=direction, boards=boards, notices=list(self.notices))}


def _place(
    stream: Stream, bursts: Bursts, positions: NDArray[np.int64], shape: RowShape
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], int]:
    """Put each burst at its position, `positions` int64 [burst].

    Returns the row's payload, uint8 [byte], a mask of its bytes that arrived, bool [byte], and the number of positions
    with a wrong number of frames, which are left out.
    """
    size = stream.data.size
    burst = shape.burst_bytes
    positions_short = 0
    payload = np.zeros(shape.bytes, np.uint8)
    is_received = np.zeros(shape.bytes, bool)
    arrived = np.ones(size, bool)
    for start, stop in stream.lost:
        arrived[start:stop] = False
    for (start, end), target in zip(bursts.ranges, positions * burst, strict=True):
        if end - start != burst:
            positions_short += 1
            continue
        # The last burst may be cut.
        stop = min(end, size)
        place = slice(target, target + stop - start)
        payload[place] = stream.data[start:stop]
        is_received[place] = arrived[start:stop]
    payload[~is_received] = 0
    return payload, is_received, positions_short


class PublishedCubes(_Published):
    """A `raw/<scan>` folder with cubes that the authors have synchronised."""

    synchronised = True

    def rows(self) -> Iterator[int]:
        """Return all rows of the plan."""
        yield from range(self._plan.rows)

    def read_row(self, board_name: str, row: int) -> CubeRow:
        """Read one board's row as the authors synchronised it, complex64 [rx, position, sample], in order of recording.

        Raises DataError if the cube is missing or of a wrong shape.
        """
        file = self.path / f"{board_name}{SYNCED}"
        try:
            # Two threads must not parse heads of files at the same time.
            with HEADER_LOCK:
                cube = np.load(file, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError) as e:
            problem = f"{file}: not a cube: {e}"
            cause = "the download is not complete"
            raise DataError(problem, cause, "download it again", code=ErrorCode.FILE_DAMAGED) from None
        rig = self._instrument
        settings = self._settings
        shape = (len(rig.antennas.rx_mm), settings.total_y, settings.total_x, rig.chirp.samples)
        if cube.shape != shape:
            problem = f"{file}: shape {cube.shape}, {shape} in its settings"
            raise DataError(problem, "not the settings of this scan", "download both again", code=ErrorCode.MISMATCH)
        # Ascending x (y of a scan by columns); the order of recording follows.
        if self.mirrored:
            ascending = cube[:, :, row]
        else:
            ascending = cube[:, row]
        return CubeRow(np.array(ascending[:, :: self._plan.row(row).direction], np.complex64))

    def recording_facts(self) -> dict[str, Any]:
        """Return the direction and the notices."""
        from polysight.results import Recording

        return {"recording": Recording(direction=self._settings.moving_direction, notices=list(self.notices))}
