"""A row of which a board missed pulses: its frames found by arrival time, and its files written anew in their order."""

from __future__ import annotations

import os
import zlib
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight.host.acquisition.missed_pulses import PlacedFrames, earliest_pulse, place_frames, slipped_frames
from polysight.host.capture import PACKETS, RowCapture, read_index, read_packets, write_index, write_packets
from polysight.shared.config import Instrument
from polysight.shared.errors import DeviceError
from polysight.shared.messages import Capture
from polysight.shared.raster import Row

HEADERS_BYTES = 14  # of `card.packet_bytes`: what is not payload (docs/spec/dca1000.md)
_SHOWN = 4
Gap = tuple[int, int]


class ToldCapture(NamedTuple):
    """A capture event, and when the host read it (monotonic clock, ns)."""

    event: Capture
    told_ns: int


def find_frames(path: Path, row: Row, told: list[ToldCapture], rig: Instrument) -> PlacedFrames:
    """Where the frames of a row that lacks some belong.

    Parameters
    ----------
    path
        The row's file; its index is beside it.
    row
        The row, for its points.
    told
        Its capture events.
    rig
        For burst, frames and packets.

    Raises
    ------
    DataError
        when the index is not readable.
    """
    times = _times(path, row, told, rig)
    if times is None:
        nothing = np.full(0, -1, dtype=np.int64)
        return PlacedFrames(
            nothing, [], row.points * rig.burst.pulses, "the capture events of the row are not complete"
        )
    return place_frames(*times, rig.frame_bytes, rig.card.packet_bytes - HEADERS_BYTES)


def find_slip(path: Path, row: Row, told: list[ToldCapture], rig: Instrument) -> PlacedFrames | None:
    """Where the frames of a row that seems whole belong, when they are not at their pulses; else None.

    Parameters and errors as :func:`find_frames`.
    """
    times = _times(path, row, told, rig)
    return slipped_frames(*times, rig.frame_bytes, rig.card.packet_bytes - HEADERS_BYTES) if times else None


def first_pulse_ns(told: list[ToldCapture]) -> int | None:
    """A time before the row's first pulse, monotonic clock, by its capture events; None where they do not tell."""
    events = [t for t in sorted(told, key=lambda t: t.event.point) if t.event.pulses]
    if not events or events[0].event.point != 0:
        return None
    first, last = [t.event.first_pulse_ns for t in events], [t.event.last_pulse_ns for t in events]
    sent = np.linspace(first, last, events[0].event.pulses, axis=1, dtype=np.int64)
    return earliest_pulse(sent, np.array([t.told_ns for t in events], dtype=np.int64))


def _times(
    path: Path, row: Row, told: list[ToldCapture], rig: Instrument
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]] | None:
    """When each pulse was sent, when each event was told, and the row's arrivals; None without all of the events."""
    pulses = rig.burst.pulses
    events = [t for t in sorted(told, key=lambda t: t.event.point) if t.event.pulses == pulses]
    if [t.event.point for t in events] != list(range(row.points)):
        return None
    _, arrivals = read_index(path.with_suffix(".idx"))
    first, last = [t.event.first_pulse_ns for t in events], [t.event.last_pulse_ns for t in events]
    sent = np.linspace(first, last, pulses, axis=1, dtype=np.int64)
    return sent, np.array([t.told_ns for t in events], dtype=np.int64), arrivals


def describe(placed: PlacedFrames, pulses: int) -> str:
    """What was missed, for people; `pulses` in a burst."""
    count = placed.pulses - placed.slots.size
    if count == 0:
        return (
            f"frames are not at their pulses: it saw edges on SYNC_IN that were not sent; {placed.uncertain} are lost"
        )
    places = [f"position {s // pulses} pulse {s % pulses}" for s in placed.missed[:_SHOWN]]
    more = ["..."] if len(placed.missed) > _SHOWN else []
    found = f"missed {count} SYNC_IN pulses ({', '.join(places + more) or 'where is not certain'})"
    return found + (f", and {placed.uncertain} frames beside them cannot be placed" if placed.uncertain else "")


def write_in_place(path: Path, capture: RowCapture, placed: PlacedFrames, frame_bytes: int) -> RowCapture:
    """Write a slipped row anew, each frame in the place of its pulse and everything else masked; durable on return.

    The index keeps the arrivals as they were, and gains `pulses_missed` and `frames`: runs of frames as [number
    received, number of its pulse, how many].

    Raises
    ------
    DeviceError
        when the disk fails.
    DataError
        when the index is not readable.
    """
    facts, arrivals = read_index(path.with_suffix(".idx"))
    received = np.fromfile(path, dtype=np.uint8)
    packets_crc = _keep_payload(path.with_suffix(PACKETS), received)
    extent = int(arrivals[-1, 1])
    out, present, runs = np.zeros_like(received), [], _runs(placed.slots)
    for first, slot, count in runs:
        start, stop = first * frame_bytes, min((first + count) * frame_bytes, extent)
        move = (slot - first) * frame_bytes
        out[start + move : stop + move] = received[start:stop]
        present += [(a + move, b + move) for a, b in _outside(capture.holes, start, stop)]
    missing = _outside(present, 0, capture.expected)
    try:
        with path.open("r+b") as f:
            f.write(out.data)
            f.flush()
            os.fsync(f.fileno())
    except OSError as e:
        raise DeviceError(f"{path}: cannot be made durable: {e.strerror}", "the disk is full or fails") from None
    told = {"missing": missing, "located": True, "reason": "", "pulses_missed": placed.missed, "frames": runs}
    index_crc = write_index(path.with_suffix(".idx"), {**facts, **told}, arrivals)
    return msgspec.structs.replace(
        capture,
        missing=missing,
        bytes=capture.expected - sum(b - a for a, b in missing),
        located=True,
        reason="",
        crc32=zlib.crc32(out.data),
        index_crc32=index_crc,
        packets_crc32=packets_crc,
    )


def _keep_payload(path: Path, received: NDArray[np.uint8]) -> int:
    """Keep all payload with the row's packets, for the row's file will not hold it as it came; returns the CRC-32."""
    if not path.exists():
        return 0
    evidence, log = read_packets(path, received)
    return write_packets(path, log, evidence, None)


def _runs(slots: NDArray[np.int64]) -> list[tuple[int, int, int]]:
    """Runs of placed frames that follow each other: first received, its slot, how many."""
    kept = np.flatnonzero(slots >= 0)
    if not kept.size:
        return []
    starts = np.flatnonzero((np.diff(kept, prepend=-2) != 1) | (np.diff(slots[kept], prepend=-2) != 1))
    stops = np.append(starts[1:], kept.size)
    return [(int(kept[a]), int(slots[kept[a]]), int(b - a)) for a, b in zip(starts, stops, strict=True)]


def _outside(ranges: list[Gap], start: int, stop: int) -> list[Gap]:
    """What of [start, stop) lies in none of the ranges, which are sorted and may touch."""
    out = []
    for a, b in ranges:
        if b > start and a < stop:
            if a > start:
                out.append((start, a))
            start = b
    return [*out, (start, stop)] if start < stop else out
