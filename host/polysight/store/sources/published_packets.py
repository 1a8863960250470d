"""Read one board's row of the published data: lost packets, and the position of each burst.

The card numbers its packets, so lost ones are known. A position at which the radar did not start is only visible as a
longer pause: bursts are about 90 ms apart and arrive within some milliseconds. A burst ends with a frame, and the pause
falls within a packet of its end, so the frames of every burst can be counted.

Data of uncertain position is masked and counted, never guessed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

Gaps = list[tuple[int, int]]
PACKET_BYTES = 1456  # payload of a full packet, if there is no log
_UNEVEN = 0.25  # of the period between positions: largest deviation of a pause from a whole number of periods


class PacketLog(NamedTuple):
    """Packets that arrived, in order of their sequence number, without duplicates: payload bytes, unix seconds."""

    sequence: NDArray[np.int64]
    size: NDArray[np.int64]
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

    data: NDArray[np.uint8]  # [n], zero where lost
    lost: Gaps  # byte ranges that never arrived
    packets_lost: int
    start: NDArray[np.int64]  # offset of each packet that arrived; empty without a log
    at_s: NDArray[np.float64]  # its arrival time
    packet_bytes: int  # payload of a full packet


class Bursts(NamedTuple):
    """Bursts of a stream: byte ranges [burst, 2], and when each began to arrive (unix seconds)."""

    ranges: NDArray[np.int64]
    at_s: NDArray[np.float64]


def read_log(path: Path) -> PacketLog | None:
    """Read a row's packet log; None if there is none. A header line is skipped.

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
    if lines and not lines[0].lstrip()[0].isdigit():  # a header
        del lines[0]
    if not lines:
        return None
    try:
        table = np.loadtxt(lines, delimiter=",", usecols=(0, 1, 2), ndmin=2)
    except ValueError as e:
        raise DataError(f"{path}: not a packet log: {e}", "a damaged file", code=ErrorCode.FILE_DAMAGED) from None
    sequence, first = np.unique(table[:, 0].astype(np.int64), return_index=True)
    size, at_s = table[first, 1].astype(np.int64), table[first, 2]
    if size[-1] < size.max():
        at_s[-1] = at_s[-2]
    return PacketLog(sequence, size, at_s)


_MAX_ROWS = 16  # that a stream may span: what is missing is filled with zeros


def read_stream(file: Path, log: PacketLog | None, shape: RowShape, zero_filled: bool) -> Stream:
    """Read a row's stream from its file and its log.

    In a zero-filled file every packet of zeros is a lost one, regardless of the log: real samples have noise.

    Raises
    ------
    DataError
        if file and log are not of one recording.
    """
    raw = np.fromfile(file, np.uint8)
    none = np.zeros(0, np.int64)
    if log is None:
        silent = _silent(raw, PACKET_BYTES) if zero_filled else np.zeros(0, bool)
        return Stream(raw, _ranges(silent, PACKET_BYTES, raw.size), int(silent.sum()), none, np.zeros(0), PACKET_BYTES)
    full = int(log.size.max())
    first = _first_sequence(log, shape, full, raw if zero_filled else None)
    start = (log.sequence - first) * full
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
            "file and log are not of one recording, or one of them was cut",
            "fetch both again",
            code=ErrorCode.MISMATCH,
        )
    if zero_filled:
        end = max(end, raw.size)
        data = raw if end == raw.size else np.concatenate([raw, np.zeros(end - raw.size, np.uint8)])
    else:
        data = raw if end == raw.size else _spread(raw, start, log.size, end)
    count = -(-end // full)
    there = np.zeros(count, bool)
    there[start // full] = True
    if zero_filled:
        there &= ~_silent(data, full)
        there[-(-raw.size // full) :] = False
    arrived = there[start // full]
    lost = _ranges(~there, full, end)
    return Stream(data, lost, int(count - there.sum()), start[arrived], log.at_s[arrived], full)


def _spread(raw: NDArray[np.uint8], start: NDArray[np.int64], size: NDArray[np.int64], end: int) -> NDArray[np.uint8]:
    """Move the packets of a file without the lost ones to their offsets."""
    data = np.zeros(end, np.uint8)
    source = np.concatenate([[0], np.cumsum(size)])
    breaks = np.flatnonzero(start[1:] != start[:-1] + size[:-1]) + 1  # runs of packets without a loss
    for a, b in zip([0, *breaks], [*breaks, start.size], strict=True):
        data[start[a] : start[b - 1] + size[b - 1]] = raw[source[a] : source[b]]
    return data


def _silent(data: NDArray[np.uint8], packet: int) -> NDArray[np.bool_]:
    """Packets that are all zero, bool [packet]."""
    whole = data.size // packet
    rows = data[: whole * packet].reshape(whole, packet)
    wide = rows.view(np.uint64) if packet % 8 == 0 and data.ctypes.data % 8 == 0 else rows
    tail = [not data[whole * packet :].any()] if data.size % packet else []
    return np.append(~np.any(wide, axis=1), np.array(tail, bool))


def _first_sequence(log: PacketLog, shape: RowShape, full: int, zero_filled: NDArray[np.uint8] | None) -> int:
    """Return the sequence number of the row's first packet, which may be lost.

    With zero filling: the first packet that arrived, minus the packets of zeros at the file's beginning. Without:
    counted back from a short last packet if no position is missing, otherwise the first packet that arrived. If the
    result is neither 0 nor 1 but the numbers fit a record from 1, return 1: cards count from 1, a log may from 0.
    """
    expected, first, last = -(-shape.bytes // full), int(log.sequence[0]), int(log.sequence[-1])
    begin = first
    if zero_filled is not None:
        begin -= int(np.argmin(np.append(_silent(zero_filled, full), False)))
    elif log.size[-1] < full and _pauses(log.at_s, shape.positions - 1).size == shape.positions - 1:
        begin = min(first, last - expected + 1)
    return begin if last > expected or begin in (0, 1) else 1


def _pauses(at_s: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Return the indices of the packets behind a pause between bursts, of which about `count` are expected.

    Most of the `count` longest pauses are those between neighbouring positions; the threshold is half of their first
    quartile.
    """
    steps = np.diff(at_s)
    if count < 1 or steps.size < count:
        return np.zeros(0, np.int64)
    typical = np.sort(steps)[-count:][count // 4]
    return np.flatnonzero(steps > typical / 2) + 1


def find_bursts(stream: Stream, shape: RowShape) -> Bursts | None:
    """Find the bursts of a stream; None without a log."""
    if not stream.at_s.size:
        return None
    frame, end = shape.frame_bytes, stream.data.size
    after = _pauses(stream.at_s, -(-end // shape.burst_bytes) - 1)
    ends = np.zeros(after.size, np.int64)
    before_end = np.minimum(stream.start[after - 1] + stream.packet_bytes, end)
    for i, (low, high) in enumerate(zip(before_end, stream.start[after] + stream.packet_bytes, strict=True)):
        # The burst ends in the packet that straddles the pause: a whole number of bursts if one fits, else of frames.
        begun = ends[i - 1] if i else 0
        whole = begun + -(-(low - begun) // shape.burst_bytes) * shape.burst_bytes
        ends[i] = whole if whole < high else -(-low // frame) * frame
    edges = np.concatenate([[0], ends, [-(-end // frame) * frame]])
    return Bursts(np.stack([edges[:-1], edges[1:]], axis=1), stream.at_s[np.concatenate([[0], after])])


def period_s(bursts: Bursts) -> float | None:
    """Return the time between positions (most must follow one another); None for fewer than two bursts."""
    return float(np.quantile(np.diff(bursts.at_s), 0.25)) if bursts.at_s.size > 1 else None


def positions_of(own: Bursts, others: list[Bursts], positions: int, period: float | None) -> NDArray[np.int64] | None:
    """Return the position of each burst; None if undetermined.

    Positions are evenly spaced in time, so a step of two periods is a position at which no radar started. The boards
    share triggers and clock: the first position is known only if all boards together span the row.
    """
    times = np.sort(np.concatenate([b.at_s for b in (own, *others)]))
    if period is None or period <= 0 or positions < 2:
        return None
    events = times[np.concatenate([[True], np.diff(times) > period / 2])]
    steps = np.diff(events) / period
    if np.any(np.abs(steps - np.round(steps)) > _UNEVEN):
        return None
    index = np.concatenate([[0], np.cumsum(np.round(steps).astype(np.int64))])
    at = index[np.searchsorted(events, own.at_s, side="right") - 1]
    return at if index[-1] == positions - 1 and np.all(np.diff(at) > 0) else None


def _ranges(missing: NDArray[np.bool_], unit: int, end: int) -> Gaps:
    """Runs of True, each `unit` bytes, as (start, stop) up to `end`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], missing.astype(np.int8), [0]])))
    return [(int(a) * unit, min(int(b) * unit, end)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
