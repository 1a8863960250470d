"""Repair a row in which a board missed pulses: place frames by arrival time and rewrite the row's files."""

from __future__ import annotations

import os
import zlib
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight.acquisition.missed_pulses import PlacedFrames, place_frames, slipped_frames, time_before_first_pulse
from polysight.capture import (
    PACKETS,
    RowCapture,
    read_index,
    read_packets,
    write_error,
    write_index,
    write_packets,
)
from polysight_shared.config import Instrument
from polysight_shared.messages import Capture
from polysight_shared.raster import Row

_SHOWN = 4
Gap = tuple[int, int]


class ReceivedCapture(NamedTuple):
    """A capture event and the time at which the host read it (monotonic clock, ns)."""

    event: Capture
    received_ns: int


def find_frames(path: Path, row: Row, events: list[ReceivedCapture], rig: Instrument) -> PlacedFrames:
    """Place the frames of a row that has fewer frames than pulses.

    `path` is the row's file, with its index beside it; `events` are the row's capture events. Raises DataError if the
    index is not readable.
    """
    times = _times(path, row, events, rig)
    if times is None:
        none = np.full(0, -1, dtype=np.int64)
        return PlacedFrames(none, [], row.points * rig.burst.pulses, "capture events of the row are missing")
    return place_frames(*times, rig.frame_bytes, rig.card.payload_bytes)


def find_slip(path: Path, row: Row, events: list[ReceivedCapture], rig: Instrument) -> PlacedFrames | None:
    """Place the frames of a row with a frame for every pulse; None if no frame is found to have slipped.

    Parameters and errors as :func:`find_frames`.
    """
    times = _times(path, row, events, rig)
    return slipped_frames(*times, rig.frame_bytes, rig.card.payload_bytes) if times else None


def first_pulse_ns(events: list[ReceivedCapture]) -> int | None:
    """Return a time before the row's first pulse (monotonic clock) from its capture events; None if undetermined."""
    events = sorted((e for e in events if e.event.pulses), key=lambda e: e.event.point)
    if not events or events[0].event.point != 0:
        return None
    return time_before_first_pulse(*_event_times(events))


def _event_times(events: list[ReceivedCapture]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the time of each pulse (Pi's clock), int64 [burst, pulse], and of each event's receipt, int64 [burst]."""
    first, last = [e.event.first_pulse_ns for e in events], [e.event.last_pulse_ns for e in events]
    sent = np.linspace(first, last, events[0].event.pulses, axis=1, dtype=np.int64)
    return sent, np.array([e.received_ns for e in events], dtype=np.int64)


def _times(
    path: Path, row: Row, events: list[ReceivedCapture], rig: Instrument
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]] | None:
    """Return pulse times, event times and the row's arrivals; None if an event is missing."""
    events = sorted((e for e in events if e.event.pulses == rig.burst.pulses), key=lambda e: e.event.point)
    if [e.event.point for e in events] != list(range(row.points)):
        return None
    return *_event_times(events), read_index(path.with_suffix(".idx"))[1]


def describe(placed: PlacedFrames, pulses: int) -> str:
    """Describe missed pulses and lost frames in a sentence; `pulses` is the number in a burst."""
    count = placed.pulses - placed.slots.size
    if count == 0:
        return f"frames are not at their pulses: spurious edges on SYNC_IN; {placed.uncertain} frames are lost"
    places = [f"position {s // pulses} pulse {s % pulses}" for s in placed.missed[:_SHOWN]]
    more = ["..."] if len(placed.missed) > _SHOWN else []
    found = f"missed {count} SYNC_IN pulses ({', '.join(places + more) or 'positions uncertain'})"
    return found + (f", and {placed.uncertain} frames near them cannot be placed" if placed.uncertain else "")


def rewrite_row(path: Path, capture: RowCapture, placed: PlacedFrames, frame_bytes: int) -> RowCapture:
    """Rewrite a slipped row with each frame at its pulse and everything else masked; durable on return.

    The index keeps its arrivals and gains `pulses_missed` and `frames`: runs of frames as [number of the first frame
    received, number of its pulse, length]. Raises DeviceError if the disk fails, DataError if the index is unreadable.
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
        raise write_error(path, "made durable", e) from None
    changed = {"missing": missing, "located": True, "reason": "", "pulses_missed": placed.missed, "frames": runs}
    index_crc = write_index(path.with_suffix(".idx"), {**facts, **changed}, arrivals)
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
    """Store the payload as received in the row's packet file, before the row's file is rewritten; return its CRC-32."""
    if not path.exists():
        return 0
    evidence, log = read_packets(path, received)
    return write_packets(path, log, evidence, None)


def _runs(slots: NDArray[np.int64]) -> list[tuple[int, int, int]]:
    """Return runs of consecutive placed frames: first frame, its slot, length."""
    kept = np.flatnonzero(slots >= 0)
    if not kept.size:
        return []
    starts = np.flatnonzero((np.diff(kept, prepend=-2) != 1) | (np.diff(slots[kept], prepend=-2) != 1))
    stops = np.append(starts[1:], kept.size)
    return [(int(kept[a]), int(slots[kept[a]]), int(b - a)) for a, b in zip(starts, stops, strict=True)]


def _outside(ranges: list[Gap], start: int, stop: int) -> list[Gap]:
    """Return the parts of [start, stop) outside the ranges, which are sorted and may touch."""
    out = []
    for a, b in ranges:
        if b > start and a < stop:
            if a > start:
                out.append((start, a))
            start = b
    return [*out, (start, stop)] if start < stop else out
