"""Packet file of a row (`<row>.pkt`): header and arrival of every packet, so that the row can be placed again.

Payload that is in the row's file is not stored twice; other payload (left over, conflicting, more than the row has) is
at the end of the packet file. Format: docs/spec/scan-folder.md.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight.capture.earlier_records import Past
from polysight.capture.packet_log import PacketLog
from polysight.capture.placement import Placed
from polysight.capture.segment import damaged, write_durably
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError
from polysight_shared.files import read_bounded

PACKETS = ".pkt"  # suffix, beside the row's file
FORMAT = 1
RUN = np.dtype([("sequence", "<u4"), ("byte_count", "<u8"), ("packets", "<u4"), ("size", "<u2"), ("place", "<i8")])
"""Run of consecutive packets of one size: counters of the first, number of packets, payload of each, and its place.

`place` is an offset in the row's file; or, below zero, `-1 - offset` in this file's own payload.
"""
BATCH = np.dtype("<i8")  # pairs: time (CLOCK_MONOTONIC of the host, ns), packets received by then
_MAX_RUN_BYTES = 256 << 20  # of batches and runs
Bytes = NDArray[np.uint8]


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
