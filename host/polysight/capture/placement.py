"""Place the payload of a row's packets when the row has ended, bit-exact, and count its packets.

`find_record` selects the row's packets and its start; `place_record` puts their payload in place, compares overlapping
packets and lists missing bytes. A row that cannot be located with certainty is masked as a whole: data is original or
masked, never guessed. The model: docs/spec/placement.md.

The three files of one row of one board (docs/spec/scan-folder.md).

`Segment` writes the payload (`.bin`, `.part` before the commit);
`write_index` the counts, gaps and arrivals (`.idx`); `write_packets` the packets themselves (`.pkt`), from which the
row can be placed again.
"""

from __future__ import annotations

import errno
import json
import os
import zlib
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight.capture.dca1000 import Counters
from polysight.capture.record_search import CounterView, Found, PacketLog, Past, find_record, line_of, past_after
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError, DeviceError
from polysight_shared.files import open_to_write, read_bounded

Flags = NDArray[np.bool_]

PAIR = np.dtype("<i8")
MAX_INDEX_BYTES = 256 << 20  # sixteen million batches of packets


@dataclass
class PacketCounts:
    """Packets of one row by result: every packet is in exactly one of the first eight; the others are subsets."""

    placed: int = 0
    duplicates: int = 0  # every byte was there already, and equal
    conflicting: int = 0  # other bytes than a packet with equal counters: masked where they overlap
    leftover: int = 0  # of an earlier record
    restarted: int = 0  # after the card restarted within the row and reset its counters
    outside: int = 0  # behind the record's last expected byte, or not kept for lack of memory
    disagreeing: int = 0  # byte count and sequence contradict each other
    malformed: int = 0  # no payload, or longer than the card's packets
    late: int = 0  # placed, after a packet that follows it
    late_by_bytes: int = 0  # largest delay of these, bytes
    short: int = 0  # placed, not full; normally only the last of a record
    before_pulses: int = 0  # leftover, identified by arrival before the row's first pulse
    clock_jumps: int = 0  # number of times the arrival clock went backwards


def count_packets(
    log: PacketLog, found: Found, past: Past, placed: Flags, duplicate: Flags, conflicting: Flags
) -> PacketCounts:
    """Count a row's packets. `placed`, `duplicate`, `conflicting`: bool [packet], disjoint.

    If the card restarted within the row, packets before the restart count as `placed` and later ones as `restarted`,
    whichever of them the search took for the record: such a row is masked, unless its start was known.
    """
    before, after = _restart(log, found, past, conflicting)
    placed, duplicate = (placed | before) & ~after, duplicate & ~after & ~before
    conflicting = conflicting & ~after & ~before
    left = (found.early | found.old) & ~(after | before)
    rest = ~(placed | duplicate | conflicting | left | after)
    beyond = (found.offsets >= log.expected) & (found.steps > 0) & (found.offsets < 2 * log.expected)
    outside = rest & (found.own | beyond)
    left |= rest & ~outside & (found.offsets < 0) & (found.steps < 0)
    return PacketCounts(
        placed=int(placed.sum()),
        duplicates=int(duplicate.sum()),
        conflicting=int(conflicting.sum()),
        leftover=int(left.sum()),
        restarted=int(after.sum()),
        outside=int(outside.sum()),
        disagreeing=int((rest & ~outside & ~left).sum()),
        malformed=log.malformed,
        before_pulses=int((found.early & left).sum()),
        clock_jumps=found.clock_jumps,
    )


def _restart(log: PacketLog, found: Found, past: Past, conflicting: Flags) -> tuple[Flags, Flags]:
    """Select the row's packets before and after a restart of the card, bool [packet] each; none without a restart.

    After a reset the first packet has sequence 1 and byte count 0. A row may also begin with these counters, so a
    restart needs other packets of the row before them, or packets with the same counters and other bytes.
    """
    nothing, index = np.zeros(log.count, dtype=np.bool_), np.arange(log.count)
    counts = log.byte_counts
    switched_on = (counts == found.full * (log.sequences - 1)) & (counts < log.expected) & ~found.early
    if not switched_on.any():
        return nothing, nothing
    if (conflicting & switched_on & (counts == 0)).any():
        first = int(np.argmax(conflicting & switched_on))
        return switched_on & (index < first) & ~found.old, switched_on & (index >= first)
    packets = CounterView(log, past.base or Counters(0, 0), found.full)
    repeated = found.repeated if found.repeated is not None else nothing
    switched_on &= repeated | ~packets.inside(past.spans, sure=True)  # otherwise left over from a known record
    if found.located:
        return nothing, switched_on & ~found.own & (index > np.argmax(found.own))
    before = _before_restart(packets, past, ~(found.early | found.old | repeated | switched_on), log.expected)
    after = (repeated | switched_on) & (index > np.argmax(before)) & before.any()
    return (before, after) if after.any() else (nothing, nothing)


def _before_restart(packets: CounterView, past: Past, live: Flags, expected: int) -> Flags:
    """Select the row's packets before a restart: at its expected start, or if that is unknown, the largest group."""
    if past.base is None:
        lines, many = np.unique(packets.line[live], return_counts=True)
        return live & np.isin(packets.line, lines[(many == many.max(initial=0)) & (many > 1)][:1])
    selected = np.zeros(live.size, dtype=np.bool_)
    for end in past.ends:
        inside = (packets.ahead >= end) & (packets.ahead < end + expected)
        selected |= live & inside & (packets.line == line_of(end, packets.full))
    return selected


Gap = tuple[int, int]
Bytes = NDArray[np.uint8]
Counts = NDArray[np.int64]
_RESTARTED = "the card restarted"


@dataclass(frozen=True)
class Losses:
    """Missing bytes: before the first packet, in gaps between packets, after the last one."""

    head_bytes: int = 0
    gaps: int = 0
    gap_bytes: int = 0
    tail_bytes: int = 0


@dataclass(frozen=True)
class Placed:
    """Result of placing one record."""

    expected: int  # bytes
    received: int  # bytes
    missing: list[Gap]  # byte ranges (start, stop) that are missing or uncertain: sorted, not touching
    located: bool  # the place of every byte is certain; if not, `missing` is the whole record
    reason: str  # why it is not located
    counts: PacketCounts
    losses: Losses  # missing bytes by kind; for a record that is not located, by its counters only
    past: Past  # knowledge for the next record
    at: Counts  # int64 [packet]: offset of its payload in the row, -1 outside the row
    arrivals: Counts  # int64 [n, 2]: time (monotonic, ns), bytes received by then; no growth: the socket was empty
    conflicts: list[Gap] = field(default_factory=list)  # byte ranges with different bytes in two packets; missing
    holes: list[Gap] = field(default_factory=list)  # missing ranges below the furthest byte, in the card's order
    slipped: bool = False  # not located only because frames may be missing (missed triggers)

    @property
    def complete(self) -> bool:
        """True if every byte is there and nothing more came."""
        return self.located and not self.missing

    def facts(self) -> dict[str, Any]:
        """Return the entries of the row's index (docs/spec/scan-folder.md)."""
        return {
            "expected": self.expected,
            "received": self.received,
            "located": self.located,
            "reason": self.reason,
            "missing": self.missing,
            "holes": self.holes,
            "clock": "CLOCK_MONOTONIC of the host, ns",
            **{name: int(value) for name, value in (vars(self.counts) | vars(self.losses)).items()},
        }


@dataclass(frozen=True)
class Preview:
    """Progress of a running row: bytes in place, all bytes in place, the furthest packet is a short one."""

    received: int
    complete: bool
    ended: bool


def place_record(
    log: PacketLog, frame_bytes: int = 1, past: Past | None = None, not_before_ns: int = 0, dropped_by_card: str = ""
) -> tuple[Placed, Bytes]:
    """Place one row's packets; return the result and the row: uint8 [expected], zero where masked.

    Parameters
    ----------
    log
        The packets; the returned row may share its memory.
    frame_bytes
        Bytes of one frame, 1 if the record has no frames. A record that ends a whole number of frames early has missed
        triggers at unknown places.
    past
        Knowledge from earlier records.
    not_before_ns
        Time before the first pulse of the row (clock of the arrivals); 0 if unknown.
    dropped_by_card
        Names of the status bits by which the card reported data dropped before the packets were numbered: bytes are
        missing without a gap in the counters, so that no byte's place is certain.
    """
    past = past or Past()
    found = find_record(log, frame_bytes, past, not_before_ns)
    row = _Row(log, found, past)
    located, reason = found.located, found.reason
    if dropped_by_card:
        located, reason = False, f"the card dropped data before numbering it ({dropped_by_card})"
    row.put_in_place()
    if located and row.conflicts and not found.start_known:
        located, reason = False, "packets with the same counters have different bytes: the card may have restarted"
    if not located and row.counts.restarted and _RESTARTED not in reason:
        reason = f"{_RESTARTED} within it" + (f"; {reason}" if found.certain else "")
    holes = _merged([*_gaps(row.covered, row.extent), *row.conflicts])
    missing = _merged([*holes, *([(row.extent, log.expected)] if row.extent < log.expected else [])])
    out = row.bytes(missing if located else holes)
    placed = Placed(
        log.expected,
        row.received,
        missing if located else [(0, log.expected)] if log.expected else [],
        located,
        reason,
        row.counts,
        _losses(missing, row.extent, log.expected),
        past_after(past, found, log, located, frame_bytes),
        row.at,
        row.arrivals(),
        _merged(row.conflicts),
        holes,
        slipped=not located
        and (found.certain or (found.fresh and not row.counts.restarted))
        and row.extent > 0
        and not dropped_by_card,
    )
    return placed, out


def preview(log: PacketLog, frame_bytes: int, past: Past, not_before_ns: int) -> Preview:
    """Return the progress of a row from its packets so far, without comparing or copying payload."""
    found = find_record(log, frame_bytes, past, not_before_ns)
    own = found.own & (found.offsets < log.expected)
    if not own.any():
        return Preview(0, log.expected == 0, ended=False)
    starts, ends = found.offsets[own], np.minimum((found.offsets + log.sizes)[own], log.expected)
    order = np.lexsort((ends, starts))
    reached = np.maximum.accumulate(ends[order])
    fresh = reached - np.maximum(np.append(0, reached[:-1]), starts[order])
    received = int(np.maximum(fresh, 0).sum())
    ended = bool((log.sizes[own][ends == ends.max()] < found.full).all())
    return Preview(received, found.located and received == log.expected, ended)


class _Row:
    """Puts the packets of a record in place."""

    def __init__(self, log: PacketLog, found: Found, past: Past) -> None:
        self._log, self._found, self._past = log, found, past
        self._sizes, self._starts = log.sizes, np.cumsum(log.sizes) - log.sizes
        kept = np.arange(log.count) < log.kept
        self._own = found.own & (found.offsets < log.expected) & kept
        self.at: Counts = np.full(log.count, -1, dtype=np.int64)
        self.covered: list[Gap] = []  # sorted, joined
        self.conflicts: list[Gap] = []
        self.received = self.extent = 0
        self._stops = np.minimum(found.offsets + self._sizes, log.expected)
        self._placed, self._duplicate, self._conflicting = np.zeros((3, log.count), dtype=np.bool_)
        self.counts = PacketCounts()

    def put_in_place(self) -> None:
        """Select the packets to place, and compare those that overlap."""
        self._place()
        self.counts = count_packets(
            self._log, self._found, self._past, self._placed, self._duplicate, self._conflicting
        )
        mine = np.flatnonzero(self._placed)
        if not mine.size:
            return
        starts, stops = self._found.offsets[mine], self._stops[mine]
        order = np.argsort(starts, kind="stable")
        a, b = starts[order], np.maximum.accumulate(stops[order])
        new = np.flatnonzero(np.append(True, a[1:] > b[:-1]))
        self.covered = list(zip(a[new].tolist(), b[np.append(new[1:] - 1, len(b) - 1)].tolist(), strict=True))
        self.extent, self.received = int(b[-1]), sum(stop - start for start, stop in self.covered)
        reached = np.maximum.accumulate(np.append(0, stops))[:-1]
        behind = reached - starts
        self.counts.late = int((behind > 0).sum())
        self.counts.late_by_bytes = max(0, int(behind.max()))
        self.counts.short = int((self._sizes[mine] < self._found.full).sum())

    def _place(self) -> None:
        """Of packets at the same place, select the first and any with more bytes."""
        own = np.flatnonzero(self._own)
        offsets = self._found.offsets[own]
        order = np.argsort(offsets, kind="stable")
        sorted_offsets = offsets[order]
        new = np.append(True, np.diff(sorted_offsets) != 0)[: order.size]
        self._placed[own] = True
        self.at[own] = offsets
        if new.all():
            return
        firsts = np.flatnonzero(new)
        for i, j in zip(firsts.tolist(), [*firsts[1:].tolist(), order.size], strict=True):
            if j - i > 1:
                self._overlap(own[order[i:j]].tolist())

    def _overlap(self, packets: list[int]) -> None:
        """Compare packets of one place, in order of arrival, with the longest so far."""
        longest = packets[0]
        for k in packets[1:]:
            offset = int(self._found.offsets[k])
            both = min(int(self._stops[k]), int(self._stops[longest])) - offset
            if not np.array_equal(self._payload(k)[:both], self._payload(longest)[:both]):
                self.conflicts.append((offset, offset + both))
                self._placed[k], self._conflicting[k], self.at[k] = False, True, -1
                if self._stops[k] > self._stops[longest]:
                    self.conflicts.append((offset, int(self._stops[k])))
                    self.conflicts.append((offset, int(self._stops[longest])))
            elif self._stops[k] > self._stops[longest]:
                longest = k
            else:
                self._placed[k], self._duplicate[k] = False, True

    def _payload(self, k: int) -> Bytes:
        return self._log.payload[self._starts[k] : self._starts[k] + self._sizes[k]]

    def arrivals(self) -> Counts:
        """Return the arrival time of each batch and the bytes received by then, int64 [n, 2]."""
        batches = self._log.batches
        if not batches.size:
            return np.zeros((0, 2), dtype=np.int64)
        reached = np.append(0, np.maximum.accumulate(np.where(self._placed, self._stops, 0)))
        pairs = np.column_stack([batches[:, 0], reached[batches[:, 1]]])
        return np.ascontiguousarray(pairs[pairs[:, 1] > 0])

    def bytes(self, holes: list[Gap]) -> Bytes:
        """Return the row: the log's own memory if the packets came in order, otherwise a copy. Zero at the holes."""
        log, mine = self._log, np.flatnonzero(self._placed)
        out = log.payload[: log.expected]
        if (self.at[mine] != self._starts[mine]).any() or log.payload.size < log.expected:
            out = np.zeros(log.expected, dtype=np.uint8)
            self._copy(mine, out)
        out[self.extent :] = 0
        for start, stop in holes:
            out[start:stop] = 0
        return out

    def _copy(self, mine: Counts, out: Bytes) -> None:
        """Copy runs of packets that are consecutive in the log and in the row."""
        if not mine.size:
            return
        offsets, sizes, starts, stops = self.at[mine], self._sizes[mine], self._starts[mine], self._stops[mine]
        joined = (starts[1:] == starts[:-1] + sizes[:-1]) & (offsets[1:] == offsets[:-1] + sizes[:-1])
        firsts = np.flatnonzero(np.append(True, ~joined))
        lasts = np.append(firsts[1:] - 1, len(mine) - 1)
        for i, j in zip(firsts.tolist(), lasts.tolist(), strict=True):
            a, b = int(offsets[i]), int(stops[j])
            out[a:b] = self._log.payload[starts[i] : starts[i] + b - a]


def _losses(missing: list[Gap], extent: int, expected: int) -> Losses:
    if not extent:
        return Losses(tail_bytes=expected)
    head = sum(b - a for a, b in missing if a == 0)
    inner = [min(b, extent) - a for a, b in missing if 0 < a < extent]
    return Losses(head, len(inner), sum(inner), expected - extent)


def _gaps(covered: list[Gap], extent: int) -> list[Gap]:
    """Return the ranges of [0, extent) that are not covered."""
    edges = [0, *(edge for gap in covered for edge in gap), extent]
    return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a]


def _merged(gaps: list[Gap]) -> list[Gap]:
    """Return the same bytes as sorted ranges that do not touch."""
    out: list[Gap] = []
    for start, stop in sorted(gaps):
        if out and start <= out[-1][1]:
            out[-1] = (out[-1][0], max(out[-1][1], stop))
        else:
            out.append((start, stop))
    return out


def _scan_of(path: Path) -> Path:
    """The scan folder of `SCAN/raw/BOARD/ROW.*`; of a file elsewhere, its own folder."""
    return path.parents[2] if path.parent.parent.name == "raw" else path.parent


def write_error(path: Path, done: str, e: OSError) -> DeviceError:
    """Return the error for a file of a scan that cannot be `done`: written, opened, renamed..."""
    full = e.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    return DeviceError(
        f"{path}: cannot be {done}: {e.strerror}",
        "the disk is full, read-only or fails",
        f"free space, then `polysight resume {_scan_of(path)}` continues after the last committed row",
        code=ErrorCode.DISK_FULL if full else ErrorCode.FILE_UNWRITABLE,
    )


def damaged(path: Path) -> tuple[str, str]:
    """Return cause and remedy for a row's file that cannot be read."""
    return "the file is damaged or truncated", f"`polysight validate {_scan_of(path)}` names every damaged file"


class Segment:
    """A file of `size` bytes with reserved disk space, which :meth:`finish` writes at once; its folder is made.

    A mapped file could block the receiver while the kernel writes it back, and the receive buffer holds only a quarter
    of a second. A row that is not finished is taken again anyway.

    Raises
    ------
    DeviceError
        if the disk is full or cannot be written.
    """

    def __init__(self, path: Path, size: int) -> None:
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with ExitStack() as stack:
                self._file = stack.enter_context(open_to_write(path, "w+b", 0))
                stack.callback(path.unlink, missing_ok=True)
                if size:
                    # Reserve the space now: a full disk must be an error here, not after the row.
                    os.posix_fallocate(self._file.fileno(), 0, size)
                stack.pop_all()
        except OSError as e:
            raise write_error(path, f"reserved ({size} bytes)", e) from None

    def finish(self, data: NDArray[np.uint8]) -> int:
        """Write the bytes durably, close the file, and return their CRC-32. Raises DeviceError if the disk fails."""
        left = np.ascontiguousarray(data).data
        crc = zlib.crc32(left)
        try:
            while left:
                left = left[self._file.write(left) :]
            os.fsync(self._file.fileno())
        except OSError as e:
            raise write_error(self.path, "made durable", e) from None
        finally:
            self.close()
        return crc

    def close(self) -> None:
        """Close the file. Safe to repeat."""
        self._file.close()

    def discard(self) -> None:
        """Close and remove the file."""
        self.close()
        self.path.unlink(missing_ok=True)


def write_index(path: Path, facts: dict[str, Any], arrivals: NDArray[np.int64]) -> int:
    """Write a row's index durably and return its CRC-32. `arrivals` is int64 [n, 2]. Raises DeviceError."""
    head = json.dumps({**facts, "arrivals": len(arrivals)}, sort_keys=True, separators=(",", ":"))
    raw = head.encode("ascii") + b"\n" + arrivals.astype(PAIR).tobytes()
    return write_durably(path, raw)


def write_durably(path: Path, raw: bytes) -> int:
    """Write a file durably and return its CRC-32. Raises DeviceError."""
    try:
        with open_to_write(path) as f:
            f.write(raw)
            f.flush()
            os.fsync(f.fileno())
    except OSError as e:
        raise write_error(path, "written", e) from None
    return zlib.crc32(raw)


def read_index(path: Path) -> tuple[dict[str, Any], NDArray[np.int64]]:
    """Read the facts and arrivals (int64 [n, 2]) of a row's index. Raises DataError if missing or damaged."""
    try:
        head, _, tail = read_bounded(path, MAX_INDEX_BYTES).partition(b"\n")
        facts = json.loads(head)
        pairs = np.frombuffer(tail, dtype=PAIR).reshape(-1, 2).astype(np.int64)
    except (OSError, ValueError, RecursionError) as e:
        what = f"{path}: not a readable row index: {e}"
        raise DataError(what, *damaged(path), code=ErrorCode.FILE_DAMAGED) from None
    if not isinstance(facts, dict) or facts.get("arrivals") != len(pairs):
        raise DataError(f"{path}: the row index is incomplete", *damaged(path), code=ErrorCode.FILE_DAMAGED)
    return facts, pairs


PACKETS = ".pkt"  # suffix, beside the row's file
FORMAT = 1
RUN = np.dtype([("sequence", "<u4"), ("byte_count", "<u8"), ("packets", "<u4"), ("size", "<u2"), ("place", "<i8")])
"""Run of consecutive packets of one size: counters of the first, number of packets, payload of each, and its place.

`place` is an offset in the row's file; or, below zero, `-1 - offset` in this file's own payload.
"""
BATCH = np.dtype("<i8")  # pairs: time (CLOCK_MONOTONIC of the host, ns), packets received by then
_MAX_RUN_BYTES = 256 << 20  # of batches and runs


class Evidence(msgspec.Struct, frozen=True):
    """Inputs for placing a row, beside its packets; as of :func:`polysight.capture.placement.place_record`."""

    expected: int
    frame_bytes: int
    not_before_ns: int = 0
    dropped_by_card: str = ""
    past: Past = Past()


def write_packets(path: Path, log: PacketLog, evidence: Evidence, placed: Placed | None) -> int:
    """Write a row's packets durably and return the file's CRC-32; without `placed`, with all of the payload.

    Raises DeviceError if the disk fails.
    """
    kept = log.kept
    sizes, sequences, counts = log.sizes[:kept], log.sequences[:kept], log.byte_counts[:kept]
    at = np.full(kept, -1, dtype=np.int64) if placed is None else _in_the_row(placed, sizes)
    here = at < 0
    rest = np.concatenate([[0], np.cumsum(np.where(here, sizes, 0))])[:-1]
    place = np.where(here, -1 - rest, at)
    ahead = np.where(here[:-1], -sizes[:-1], sizes[:-1])
    joined = (
        (np.diff(sizes) == 0) & (np.diff(sequences) == 1) & (np.diff(counts) == sizes[:-1])
        & (np.diff(place) == ahead) & (here[1:] == here[:-1])
    )  # fmt: skip
    first = np.flatnonzero(np.append(True, ~joined))[: kept and None]
    runs = np.zeros(first.size, dtype=RUN)
    runs["sequence"], runs["byte_count"], runs["size"] = sequences[first], counts[first], sizes[first]
    runs["packets"], runs["place"] = np.diff(np.append(first, kept)), place[first]
    starts = np.cumsum(log.sizes) - log.sizes
    own = [log.payload[starts[k] : starts[k] + sizes[k]] for k in np.flatnonzero(here).tolist()]
    head = {
        "format": FORMAT,
        "batches": len(log.batches),
        "runs": len(runs),
        "packets": log.count,
        "kept": kept,
        "own_bytes": int(sizes[here].sum()),
        "malformed": log.malformed,
        "evidence": msgspec.to_builtins(evidence),
    }
    line = json.dumps(head, sort_keys=True, separators=(",", ":")).encode("ascii") + b"\n"
    raw = b"".join([line, log.batches.astype(BATCH).tobytes(), runs.tobytes(), *(part.tobytes() for part in own)])
    return write_durably(path, raw)


def read_packets(path: Path, row: Bytes) -> tuple[Evidence, PacketLog]:
    """Read a row's packet file `path`; `row` (uint8) are the bytes of the row's file, with most of the payload.

    Raises
    ------
    DataError
        if the file is missing or damaged, or does not belong to the row.
    """
    try:
        line, _, tail = read_bounded(path, PacketLog.max_kept_bytes(row.size) + _MAX_RUN_BYTES).partition(b"\n")
        head: dict[str, Any] = json.loads(line)
        evidence = msgspec.convert(head["evidence"], Evidence)
        size = 2 * BATCH.itemsize * head["batches"]
        batches = np.frombuffer(tail[:size], dtype=BATCH).reshape(-1, 2).astype(np.int64)
        runs = np.frombuffer(tail[size : size + RUN.itemsize * head["runs"]], dtype=RUN)
        own = np.frombuffer(tail[size + runs.nbytes :], dtype=np.uint8)
        if (np.diff(batches[:, 1], prepend=0) < 0).any():
            raise ValueError("the number of packets decreases between two batches")
        log = _restored(evidence.expected, runs, batches, row, own)
        whole = (head["packets"], head["own_bytes"]) == (int(batches[-1, 1]) if len(batches) else 0, own.size)
        if not whole or log.count != head["kept"] or head["format"] != FORMAT:
            raise ValueError("its counts are wrong")
        log.malformed = int(head["malformed"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError, msgspec.ValidationError) as e:
        what = f"{path}: not a readable packet log: {e}"
        raise DataError(what, *damaged(path), code=ErrorCode.FILE_DAMAGED) from None
    return evidence, log


def _in_the_row(placed: Placed, sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the offset of each packet's unchanged payload in the row's file, int64 [packet]; -1 if it is not there."""
    at = placed.at[: sizes.size].copy()
    at[at + sizes > placed.expected] = -1
    for start, stop in placed.conflicts:
        at[(at < stop) & (at + sizes > start)] = -1
    return at


def _restored(expected: int, runs: NDArray[Any], batches: NDArray[np.int64], row: Bytes, own: Bytes) -> PacketLog:
    """Restore the packet log. Raises ValueError if payload is missing."""
    many, sizes = runs["packets"].astype(np.int64), runs["size"].astype(np.int64)
    payload_bytes = sum((many * sizes).tolist())  # each product fits 48 bits; their sum need not fit 64
    if expected != row.size or payload_bytes > PacketLog.max_kept_bytes(expected) or (sizes == 0).any():
        raise ValueError("it is of another row, or has more payload than a receiver keeps")
    nth = np.arange(many.sum()) - np.repeat(np.cumsum(many) - many, many)
    each = np.repeat(sizes, many)
    parts = []
    for n, size, place in zip(many.tolist(), sizes.tolist(), runs["place"].tolist(), strict=True):
        source, start = (row, place) if place >= 0 else (own, -1 - place)
        parts.append(source[start : start + n * size])
        if parts[-1].size != n * size:
            raise ValueError("payload is missing")
    payload = np.concatenate(parts) if parts else np.zeros(0, dtype=np.uint8)
    sequences = np.repeat(runs["sequence"].astype(np.int64), many) + nth
    counts = np.repeat(runs["byte_count"].astype(np.int64), many) + nth * each
    kept = batches[batches[:, 1] <= many.sum()] if len(batches) else batches
    if len(kept) < len(batches) and (not len(kept) or kept[-1, 1] < many.sum()):
        kept = np.concatenate([kept, [[batches[len(kept), 0], many.sum()]]])
    return PacketLog.restore(expected, sequences, counts, each, kept, payload)
