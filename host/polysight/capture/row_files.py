"""The three files of a row of one board (docs/spec/scan-folder.md).

`Segment` writes the payload (`.bin`, `.part` before the commit), `write_index` the counts, gaps and arrivals (`.idx`),
`write_packets` the packets themselves (`.pkt`), from which the row can be placed again.
"""

from __future__ import annotations

import errno
import json
import os
import zlib
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight.capture.dca1000 import PacketLog
from polysight.capture.placement import Evidence, PlacedRecord
from polysight_shared.errors import DataError, DeviceError, ErrorCode, quote
from polysight_shared.files import open_to_write, read_bounded

Bytes = NDArray[np.uint8]
# Each arrival in an index is a pair of these.
_INDEX_PAIR = np.dtype("<i8")
# A pair takes 16 bytes: sixteen million arrivals, a thousand times those of a row of the published scan. A damaged file
# that is larger is refused before it fills the memory.
MAX_INDEX_BYTES = 256 << 20


def _find_scan(path: Path) -> Path:
    """Return the scan folder of a file `SCAN/raw/BOARD/ROW.*`; for a file elsewhere, the folder it lies in."""
    if path.parent.parent.name == "raw":
        return path.parents[2]
    return path.parent


def make_write_error(path: Path, action: str, e: OSError) -> DeviceError:
    """Return the error for a file of a scan that cannot be `action`: "written", "opened", "renamed"."""
    is_full = e.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    code = ErrorCode.DISK_FULL if is_full else ErrorCode.FILE_UNWRITABLE
    return DeviceError(
        f"{path}: cannot be {action}: {e.strerror}",
        "the disk is full, read-only or fails",
        f"free space, then `polysight resume {quote(_find_scan(path))}` continues after the last committed row",
        code=code,
    )


def _explain_damage(path: Path) -> tuple[str, str]:
    """Return cause and remedy for a row's file that cannot be read."""
    return (
        "the file is damaged or truncated",
        f"`polysight validate {quote(_find_scan(path))}` names every damaged file",
    )


class Segment:
    """A file of `size` bytes with reserved disk space, which :meth:`finish` writes in one piece; its folder is made.

    The row is written at its end, from memory: a file written during reception (a mapped one, too) could block the
    receiver while the kernel writes it back, and a receive buffer of 8 MiB holds only 0.2 s of a card that sends a
    packet every 25 us. A row that is not finished is taken again anyway.

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
            raise make_write_error(path, f"reserved ({size} bytes)", e) from None

    def finish(self, data: NDArray[np.uint8]) -> int:
        """Write uint8 [byte] durably, close the file, and return the CRC-32. Raises DeviceError if the disk fails."""
        remaining = np.ascontiguousarray(data).data
        crc = zlib.crc32(remaining)
        try:
            while remaining:
                remaining = remaining[self._file.write(remaining) :]
            os.fsync(self._file.fileno())
        except OSError as e:
            raise make_write_error(self.path, "made durable", e) from None
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
    raw = head.encode("ascii") + b"\n" + arrivals.astype(_INDEX_PAIR).tobytes()
    return write_durably(path, raw)


def write_durably(path: Path, raw: bytes) -> int:
    """Write a file durably and return its CRC-32. Raises DeviceError."""
    try:
        with open_to_write(path) as f:
            f.write(raw)
            f.flush()
            os.fsync(f.fileno())
    except OSError as e:
        raise make_write_error(path, "written", e) from None
    return zlib.crc32(raw)


def read_index(path: Path) -> tuple[dict[str, Any], NDArray[np.int64]]:
    """Read the facts and arrivals (int64 [n, 2]) of a row's index. Raises DataError if missing or damaged."""
    try:
        head, _, tail = read_bounded(path, MAX_INDEX_BYTES).partition(b"\n")
        facts = json.loads(head)
        pairs = np.frombuffer(tail, dtype=_INDEX_PAIR).reshape(-1, 2).astype(np.int64)
    except (OSError, ValueError, RecursionError) as e:
        problem = f"{path}: not a readable row index: {e}"
        raise DataError(problem, *_explain_damage(path), code=ErrorCode.FILE_DAMAGED) from None
    if not isinstance(facts, dict) or facts.get("arrivals") != len(pairs):
        raise DataError(f"{path}: the row index is incomplete", *_explain_damage(path), code=ErrorCode.FILE_DAMAGED)
    return facts, pairs


# Suffix of the packet file, which lies next to the row's file.
PACKETS_SUFFIX = ".pkt"
FORMAT = 2
"""Files of format 1 are read, too, but not their entries on earlier records of the card: a row that is placed again
from such a file has an unknown start, and is masked as a whole."""
RUN = np.dtype([("sequence", "<u4"), ("byte_count", "<u8"), ("packets", "<u4"), ("size", "<u2"), ("place", "<i8")])
"""Run of consecutive packets of one size: counters of the first, number of packets, payload of each, and its place.

`place` is an offset in the row's file; or, below zero, `-1 - offset` in this file's own payload.
"""
# Pairs: time (CLOCK_MONOTONIC of the host, ns), packets received by then.
BATCH = np.dtype("<i8")
# Limit of the batches and runs of a packet file (chosen): a damaged length cannot fill the memory.
_MAX_RUN_BYTES = 256 << 20


def write_packets(path: Path, log: PacketLog, evidence: Evidence, placed: PlacedRecord | None) -> int:
    """Write a row's packets durably and return the file's CRC-32; without `placed`, with all of the payload.

    Of packets beyond the first `log.kept` only their arrival is written. Raises DeviceError if the disk fails.
    """
    sizes = log.sizes[: log.kept]
    # Payload that does not lie unchanged in the row's file is stored in this one.
    if placed is None:
        offsets_in_row = np.full(log.kept, -1, dtype=np.int64)
    else:
        offsets_in_row = _find_offsets_in_row(placed, sizes)
    is_stored_here = offsets_in_row < 0
    runs = _find_runs(log, offsets_in_row)
    starts = np.cumsum(log.sizes) - log.sizes
    stored_payload = [log.payload[starts[k] : starts[k] + sizes[k]] for k in np.flatnonzero(is_stored_here).tolist()]
    # Packets that were received by one call have one arrival time: a batch ends where the time changes.
    last_of_batch = np.flatnonzero(np.diff(log.arrivals_ns, append=log.arrivals_ns[-1:] + 1))
    batches = np.column_stack([log.arrivals_ns[last_of_batch], last_of_batch + 1])
    head = {
        "format": FORMAT,
        "batches": len(batches),
        "runs": len(runs),
        "packets": log.count,
        "kept": log.kept,
        "own_bytes": int(sizes[is_stored_here].sum()),
        "malformed": log.malformed,
        "evidence": msgspec.to_builtins(evidence),
    }
    line = json.dumps(head, sort_keys=True, separators=(",", ":")).encode("ascii") + b"\n"
    raw = b"".join(
        [line, batches.astype(BATCH).tobytes(), runs.tobytes(), *(part.tobytes() for part in stored_payload)]
    )
    return write_durably(path, raw)


def _find_runs(log: PacketLog, offsets_in_row: NDArray[np.int64]) -> NDArray[Any]:
    """Return the runs (`RUN`) of the kept packets; those with an offset below zero are stored in the packet file."""
    if log.kept == 0:
        return np.zeros(0, dtype=RUN)
    sizes = log.sizes[: log.kept]
    sequences = log.sequences[: log.kept]
    counts = log.byte_counts[: log.kept]
    is_stored_here = offsets_in_row < 0
    # Places in the packet file are negative and fall from packet to packet, see `RUN`.
    bytes_before = np.cumsum(np.where(is_stored_here, sizes, 0)) - np.where(is_stored_here, sizes, 0)
    places = np.where(is_stored_here, -1 - bytes_before, offsets_in_row)
    expected_steps = np.where(is_stored_here[:-1], -sizes[:-1], sizes[:-1])
    continues_run = (
        (np.diff(sizes) == 0)
        & (np.diff(sequences) == 1)
        & (np.diff(counts) == sizes[:-1])
        & (np.diff(places) == expected_steps)
        & (is_stored_here[1:] == is_stored_here[:-1])
    )
    first = np.flatnonzero(np.append(True, ~continues_run))
    runs = np.zeros(first.size, dtype=RUN)
    runs["sequence"] = sequences[first]
    runs["byte_count"] = counts[first]
    runs["size"] = sizes[first]
    runs["packets"] = np.diff(np.append(first, log.kept))
    runs["place"] = places[first]
    return runs


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
        stored_payload = np.frombuffer(tail[size + runs.nbytes :], dtype=np.uint8)
        if (np.diff(batches[:, 1], prepend=0) < 0).any():
            raise ValueError("the number of packets decreases between two batches")
        log = _restore_log(evidence.expected, runs, batches, row, stored_payload)
        packets = 0
        if len(batches):
            packets = int(batches[-1, 1])
        is_whole = (head["packets"], head["own_bytes"]) == (packets, stored_payload.size)
        if not is_whole or log.count != head["kept"] or head["format"] not in (1, FORMAT):
            raise ValueError("its counts are wrong")
        log.malformed = int(head["malformed"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError, msgspec.ValidationError) as e:
        problem = f"{path}: not a readable packet log: {e}"
        raise DataError(problem, *_explain_damage(path), code=ErrorCode.FILE_DAMAGED) from None
    return evidence, log


def _find_offsets_in_row(placed: PlacedRecord, sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the offset of each packet's unchanged payload in the row's file, int64 [packet]; -1 if it is not there."""
    offsets = placed.offsets[: sizes.size].copy()
    offsets[offsets + sizes > placed.expected] = -1
    for start, stop in placed.holes:
        offsets[(offsets < stop) & (offsets + sizes > start)] = -1
    return offsets


def _restore_log(
    expected: int, runs: NDArray[Any], batches: NDArray[np.int64], row: Bytes, stored_payload: Bytes
) -> PacketLog:
    """Restore the packet log from runs, batches, the row's bytes and the payload stored in the packet file.

    Raises ValueError if payload is missing.
    """
    packets = runs["packets"].astype(np.int64)
    sizes = runs["size"].astype(np.int64)
    # A product has 48 bits at most, but the sum of many may exceed 64 bits: it is a sum of Python's integers.
    payload_bytes = sum((packets * sizes).tolist())
    if expected != row.size or payload_bytes > PacketLog.max_kept_bytes(expected) or (sizes == 0).any():
        raise ValueError("it belongs to another row, or has more payload than a receiver keeps")
    index_in_run = np.arange(packets.sum()) - np.repeat(np.cumsum(packets) - packets, packets)
    size_of_each = np.repeat(sizes, packets)
    parts = []
    for n, size, offset in zip(packets.tolist(), sizes.tolist(), runs["place"].tolist(), strict=True):
        if offset >= 0:
            source = row
            start = offset
        else:
            source = stored_payload
            start = -1 - offset
        parts.append(source[start : start + n * size])
        if parts[-1].size != n * size:
            raise ValueError("payload is missing")
    if parts:
        payload = np.concatenate(parts)
    else:
        payload = np.zeros(0, dtype=np.uint8)
    sequences = np.repeat(runs["sequence"].astype(np.int64), packets) + index_in_run
    counts = np.repeat(runs["byte_count"].astype(np.int64), packets) + index_in_run * size_of_each
    times = np.repeat(batches[:, 0], np.diff(batches[:, 1], prepend=0))[: packets.sum()]
    if times.size < packets.sum():
        raise ValueError("times are missing")
    return PacketLog.restore(expected, sequences, counts, size_of_each, times, payload)
