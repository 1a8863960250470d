"""Pulses that a board missed: find them by the arrival times of its frames, and move the frames to their pulses."""

from __future__ import annotations

import heapq
import os
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import scipy
from numpy.typing import NDArray

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

Times = NDArray[np.int64]
_EARLY = 0.1  # of the pulse period: how much faster than the fastest known frame another may arrive
_PUNCTUAL = 0.3  # of the pulse period: largest delay of a punctual frame
_LATE = 0.8  # of the pulse period: smallest delay of a late frame
_RARE = 0.02  # places with missed pulses per frame, up to which none is expected to coincide with a late frame
_CHANCE = 1e-6  # accepted probability that all frames that support a lower bound are late
_MAX_DRIFT = 500e-6  # crystals of 50 ppm and a clock that NTP slews
_AGREEING = 3  # complete bursts whose shortest delays must agree
_DRIFT_BURSTS = 8  # complete bursts needed to estimate the drift
_USUAL_DRIFT = 100e-6  # largest relative drift of two crystals
_RATES = 0.8, 1.25  # host clock over pulse clock; outside, the pulses are in simulated time


@dataclass(frozen=True)
class PlacedFrames:
    """Pulse numbers of the frames of a slipped row."""

    slots: Times  # int64 [frame]: the pulse number of each received frame; -1 if uncertain
    missed: list[int]  # numbers of the pulses that were certainly missed
    pulses: int  # in the row
    reason: str = ""  # why no frame could be placed; "" if some were

    @property
    def uncertain(self) -> int:
        """Number of received frames that cannot be placed."""
        return int((self.slots < 0).sum())


def place_frames(
    pulses_ns: Times, received_ns: Times, arrivals: Times, frame_bytes: int, payload_bytes: int
) -> PlacedFrames:
    """Find the pulse of every received frame of a row with missed pulses.

    Parameters
    ----------
    pulses_ns
        int64 [burst, pulse]: send time of each SYNC_IN pulse of the row, Pi's clock.
    received_ns
        int64 [burst]: time at which the host read each burst's capture event, host's clock.
    arrivals
        int64 [n, 2]: arrivals of the row's index: time (host's clock) and number of bytes, in the card's order, that
        had arrived by then. An entry without new bytes is a read that found the socket empty.
    frame_bytes, payload_bytes
        Bytes of one frame and of the payload of a full packet.

    Returns
    -------
    PlacedFrames
        with strictly increasing slots; -1 where the bounds allow more than one pulse.
    """
    n = pulses_ns.size
    received = -(-int(arrivals[-1, 1]) // frame_bytes) if len(arrivals) else 0
    try:
        low, high = _bounds(pulses_ns, received_ns, arrivals, received, frame_bytes, payload_bytes)
    except _UndeterminedError as e:
        return PlacedFrames(np.full(received, -1, dtype=np.int64), [], n, str(e))
    slots = np.where(low == high, low, -1)
    possible = np.zeros(n + 1, dtype=np.int64)  # number of frames that may be of each pulse
    np.add.at(possible, low, 1)
    np.add.at(possible, high + 1, -1)
    missed = np.flatnonzero(np.cumsum(possible)[:n] == 0).tolist()
    reason = "" if (slots >= 0).any() else "the delays in this row are as long as the pauses between its bursts"
    return PlacedFrames(slots, missed, n, reason)


def slipped_frames(
    pulses_ns: Times, received_ns: Times, arrivals: Times, frame_bytes: int, payload_bytes: int
) -> PlacedFrames | None:
    """Find slipped frames in a row whose number of frames is right.

    A radar that counts frames takes a spurious edge on SYNC_IN for a pulse and has no frame left for the last pulse:
    the count is right, but all frames behind the edge are off by one. The same happens between a missed pulse and a
    spurious edge. Then, at the beginning of a burst, more frames have arrived than pulses were sent; or the same
    number is missing at three bursts in a row, which late data do not cause. Frames of complete bursts are placed.

    Parameters and slots as :func:`place_frames`; None if every frame is at its pulse, or if that is undetermined.
    """
    count = pulses_ns.shape[1]
    try:
        starts = _frames_at_bursts(pulses_ns, received_ns, arrivals, frame_bytes)
    except _UndeterminedError:
        return None
    if frame_bytes < payload_bytes or starts[-1] != pulses_ns.size:
        return None
    ahead = starts - count * np.arange(len(starts))
    behind = (ahead[:-2] < 0) & (ahead[:-2] > -count) & (ahead[1:-1] == ahead[:-2]) & (ahead[2:] == ahead[:-2])
    if not (ahead > 0).any() and not behind.any():
        return None
    slots = np.full(pulses_ns.size, -1, dtype=np.int64)
    for burst in np.flatnonzero(np.diff(starts) == count):
        slots[starts[burst] : starts[burst] + count] = burst * count + np.arange(count)
    return PlacedFrames(slots, [], pulses_ns.size)


class _UndeterminedError(Exception):
    """The arrival times are not sufficient; the message gives the reason."""


def _bounds(
    pulses_ns: Times, received_ns: Times, arrivals: Times, received: int, frame_bytes: int, payload_bytes: int
) -> tuple[Times, Times]:
    """Return the first and the last possible pulse number of each received frame, int64 [frame] each."""
    pulses, slack = pulses_ns.reshape(-1), pulses_ns.size - received
    if frame_bytes < payload_bytes:
        raise _UndeterminedError("a packet holds several frames, so its arrival time is that of none of them")
    if received == 0 or slack < 0:
        raise _UndeterminedError("no frame came" if received == 0 else "more frames came than pulses were sent")
    period_ns = int(np.diff(pulses_ns, axis=1).min()) if pulses_ns.shape[1] > 1 else int(np.diff(pulses).min())
    grown = np.flatnonzero(np.diff(arrivals[:, 1], prepend=0) > 0)
    frame = (arrivals[grown, 1] - 1) // frame_bytes  # of the last byte of each batch
    came = arrivals[grown, 0]
    starts = _frames_at_bursts(pulses_ns, received_ns, arrivals, frame_bytes)
    earliest, expected = _expected_arrivals(pulses_ns, starts, frame, came)

    # Upper bound: the last pulse that had been sent when the batch arrived.
    ahead = np.searchsorted(earliest, came + _EARLY * period_ns, "right") - 1 - frame
    most = np.full(received, slack)
    np.minimum.at(most, frame, ahead)
    most = np.minimum.accumulate(most[::-1])[::-1]
    if most[0] < 0:
        raise _UndeterminedError("the arrival times contradict the pulses")
    # Lower bound: the first pulse that is not too old, counted from the last time the socket was empty.
    full = arrivals[grown, 1] % payload_bytes == 0  # the short last packet waits for the end of the record
    seen, frame, empty = frame, frame[full], _last_empty(arrivals)[grown][full]
    behind = np.searchsorted(expected, empty - _PUNCTUAL * period_ns, "left") - frame
    punctual = behind <= most[frame]  # otherwise the frame is late and bounds nothing
    bound = np.zeros(received, dtype=np.int64)
    np.maximum.at(bound, frame[punctual], behind[punctual])
    late = came - expected[np.minimum(seen + most[seen], pulses.size - 1)] > _LATE * period_ns
    late_frames = int((late & (np.diff(seen, prepend=-1) > 0)).sum())
    places = int((np.diff(_running_rank(bound, 1), prepend=0) > 0).sum())  # with apparently missed pulses
    index = np.arange(received)
    return index + _running_rank(bound, _supporters(late_frames, places, received)), index + most


def _supporters(late: int, places: int, frames: int) -> int:
    """Number of frames that must support a lower bound, so that they are not all late by chance; 1 if none is late."""
    if late == 0 and places <= _RARE * frames:
        return 1
    return int(np.ceil(np.log(_CHANCE) / np.log(min(0.5, (late + 1) / frames))))


def _running_rank(values: Times, rank: int) -> Times:
    """For each entry, the `rank`-th largest value so far; 0 while there are fewer."""
    out, best = np.zeros_like(values), [0] * rank
    for i, value in enumerate(values.tolist()):
        if value > best[0]:
            heapq.heapreplace(best, value)
        out[i] = best[0]
    return out


def _last_empty(arrivals: Times) -> Times:
    """For each entry, a time at which its packets had not arrived; far in the past for the first entry.

    This is the previous entry's time if that read found the socket empty. If batches followed each other directly,
    it is the time of the entry before the previous one: the read of the previous batch began after that.
    """
    n = len(arrivals)
    empty = np.diff(arrivals[:, 1], prepend=0) == 0
    out = np.full(n, np.iinfo(np.int64).min // 4)
    out[2:] = arrivals[:-2, 0]
    out[1:] = np.where(empty[:-1], arrivals[:-1, 0], out[1:])
    return out


def time_before_first_pulse(pulses_ns: Times, received_ns: Times) -> int | None:
    """Return a time (host's clock) in the pause before a row's first pulse; None if the events are not sufficient.

    Parameters as :func:`place_frames`; the first and the last pulse of each burst suffice.
    """
    try:
        return int(_pauses(pulses_ns, received_ns)[0])
    except _UndeterminedError:
        return None


def _pauses(pulses_ns: Times, received_ns: Times) -> Times:
    """Return a time (host's clock) in the pause before each burst, int64 [burst]."""
    last = pulses_ns[:, -1]
    if len(last) < 2:
        raise _UndeterminedError("the offset between the clocks needs two bursts")
    pause_ns = int((pulses_ns[1:, 0] - last[:-1]).min())
    if pause_ns < 2 * int(np.diff(pulses_ns[:, :2]).max(initial=0)):
        raise _UndeterminedError("the bursts follow each other without a pause")
    rate = (received_ns[-1] - received_ns[0]) / (last[-1] - last[0])
    if not _RATES[0] < rate < _RATES[1]:
        raise _UndeterminedError(
            f"the pulses are in simulated time, {1 / max(rate, 1e-9):.3g} times as fast as the host's"
        )
    delay = received_ns - last
    offset_ns = int(delay.min())  # too large by the delay of the fastest event
    if (delay < offset_ns + pause_ns // 4).sum() < 2:
        raise _UndeterminedError("the capture events came too late to separate one burst from the next")
    return pulses_ns[:, 0] + offset_ns - pause_ns // 2


def _frames_at_bursts(pulses_ns: Times, received_ns: Times, arrivals: Times, frame_bytes: int) -> Times:
    """Count the frames that had arrived when each burst began, int64 [burst + 1], in the pauses between bursts."""
    begins = _pauses(pulses_ns, received_ns)
    at = np.searchsorted(arrivals[:, 0], begins, "right")
    extent = np.where(at > 0, arrivals[np.maximum(at - 1, 0), 1], 0)
    if extent[0]:
        raise _UndeterminedError("data arrived before the row's first pulse was sent")
    return np.append(-(-extent // frame_bytes), -(-arrivals[-1, 1] // frame_bytes))


def _expected_arrivals(
    pulses_ns: Times, starts: Times, frame: Times, came: Times
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the earliest and the expected arrival of each pulse's frame: host's clock, float64 [pulse] each.

    Estimated from the complete bursts: the shortest time from pulse to data and its drift along the row; the two
    results differ by the spread among bursts. A burst that only seems complete (a delayed frame replaced a missed one)
    is off by a period and rejected.
    """
    count = pulses_ns.shape[1]
    whole = np.flatnonzero(np.diff(starts) == count)
    sent, delay = [], []
    for b in whole:
        own = (frame >= starts[b]) & (frame < starts[b] + count)
        if own.any():
            sent.append(pulses_ns[b, 0])
            delay.append((came[own] - pulses_ns[b][frame[own] - starts[b]]).min())
    if len(sent) < _AGREEING:
        raise _UndeterminedError(f"{len(sent)} bursts are complete: too few for the offset between the clocks")
    pulses = pulses_ns.reshape(-1)
    period_ns = float(np.diff(pulses[: max(2, count)]).min())
    base, zero = int(delay[0]), int(pulses_ns[0, 0])
    x, y = np.array(sent, dtype=np.float64) - zero, np.array(delay, dtype=np.float64) - base
    drift = 0.0
    if len(x) >= _DRIFT_BURSTS:
        slopes = np.asarray(scipy.stats.theilslopes(y, x), dtype=np.float64)
        low, high = slopes[2:]  # take the smallest slope of the confidence interval
        drift = float(np.clip(np.clip(0.0, low, high), -_MAX_DRIFT, _MAX_DRIFT))
    elif _USUAL_DRIFT * float(np.ptp(pulses_ns)) > _EARLY * period_ns:
        raise _UndeterminedError(f"{len(x)} bursts are complete: too few for the drift between the clocks")
    rest = y - drift * x
    agreeing = np.abs(rest - np.median(rest)) < period_ns / 2
    quickest = rest < rest.min() + _PUNCTUAL * period_ns
    if 2 * agreeing.sum() < len(rest) or quickest.sum() < max(_AGREEING, len(rest) / 4):
        raise _UndeterminedError("the delays of the bursts differ by more than a pulse period")
    common = pulses + float(base) + drift * (pulses - zero)
    spread = float(np.ptp(rest[agreeing]))  # of the fastest frames of the bursts
    return common + rest.min() - spread, common + rest[agreeing].min()


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
