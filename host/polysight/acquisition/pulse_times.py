"""At which pulse each frame of a row was taken, by the times at which its packets came (docs/spec/placement.md).

A record says how many frames a radar sent, not at which pulses: a missed SYNC_IN pulse and a spurious edge leave no
other trace. The host's arrival times do. Every packet bounds the pulse of its frame from both sides: it cannot come
before its pulse (hard), and had it been taken at an earlier pulse, it would have come before a time at which the socket
was still empty (soft: a card or a switch may hold it back). *Shift* is the pulse number of a frame minus its own
number: 0 in a perfect row, one more behind a missed pulse, one less behind a spurious edge. The pauses between bursts
give the shift of whole bursts, safe from delays up to the length of a pause; the frames of a burst confirm it.
"""

from __future__ import annotations

import itertools
import os
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.capture import (
    PACKETS,
    Placed,
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
Gap = tuple[int, int]
# How much faster than the fastest known frame another may arrive: of the pulse period, and at most.
_EARLY = 0.1
_EARLY_NS = 200_000
# Largest delay of a punctual frame: of the pulse period, and at most.
_PUNCTUAL = 0.3
_PUNCTUAL_NS = 500_000
# Consecutive frames that all seem to be of later pulses are displaced, not delayed: delayed ones come in one go.
_DISPLACED = 3
# Share of late frames of a row, up to which a run of them is displaced.
_RARE = 0.02
_MAX_DRIFT = 500e-6  # crystals of 50 ppm and a clock that NTP slews
_AGREEING = 3  # bursts whose delays must agree
_DRIFT_BURSTS = 8  # bursts needed to estimate the drift
_USUAL_DRIFT = 100e-6  # largest relative drift of two crystals
_RATES = 0.8, 1.25  # host clock over pulse clock; outside, the pulses are in simulated time
_GUARD_NS = 5_000_000  # before a burst, at which the frames of earlier ones are counted
_SHOWN = 4


@dataclass(frozen=True)
class PlacedFrames:
    """Pulse numbers of the frames of a row."""

    slots: Times  # int64 [frame]: the pulse number of each received frame; -1 if uncertain
    missed: list[int]  # numbers of the pulses that were certainly missed
    pulses: int  # in the row
    reason: str = ""  # why the times say nothing; "" if they do
    contradicted: bool = False  # frames are not at the pulses that their number in the record says
    disturbed: bool = False  # `reason` is that the times contradict each other, not that they are missing

    @property
    def uncertain(self) -> int:
        """Number of received frames that cannot be placed."""
        return int((self.slots < 0).sum())


def place_frames(
    pulses_ns: Times,
    received_ns: Times,
    arrivals: Times,
    frame_bytes: int,
    payload_bytes: int,
    holes: list[Gap] | None = None,
) -> PlacedFrames:
    """Find the pulse of every received frame of a row.

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
    holes
        Ranges of bytes that never came, in the card's order.

    Returns
    -------
    PlacedFrames
        with strictly increasing slots; -1 where the evidence allows more than one pulse.
    """
    pulses = pulses_ns.size
    received = -(-int(arrivals[-1, 1]) // frame_bytes) if len(arrivals) else 0
    try:
        if received == 0 or received > pulses:
            raise _UndeterminedError("no frame came" if received == 0 else "more frames came than pulses were sent")
        if frame_bytes < payload_bytes and received < pulses:
            raise _UndeterminedError("a packet holds several frames: those that are missing cannot be told")
        if (np.diff(arrivals[:, 0]) < 0).any():
            raise _UndeterminedError("the clock of the arrivals went backwards")
        evidence = _observe(pulses_ns, received_ns, arrivals, received, frame_bytes, payload_bytes)
        counted = _count_at_bursts(evidence, arrivals, received, frame_bytes, payload_bytes, holes or [])
    except _UndeterminedError as e:
        none = np.full(received, -1, dtype=np.int64)
        return PlacedFrames(none, [], pulses, str(e), disturbed=isinstance(e, _DisturbedError))
    slots, contradicted = _decide(evidence, counted, pulses_ns.shape[1], pulses)
    if frame_bytes < payload_bytes:
        # A missed pulse and a spurious edge within a packet do not show: only the frame that fills it is seen. Which
        # bursts are punctual beside a spurious edge does not show either: frames are counted from the row's first.
        slots[(evidence.low == _UNKNOWN) | contradicted] = -1
    missed = _missed(slots, pulses) if received < pulses else []
    if contradicted or received < pulses:
        slots = _without_mixed(slots, pulses)
    told = contradicted or bool((slots >= 0).any())
    reason = "" if told else "the delays in this row are as long as the pauses between its bursts"
    return PlacedFrames(slots, missed, pulses, reason, contradicted and received == pulses, disturbed=bool(reason))


class _UndeterminedError(Exception):
    """The arrival times are not sufficient; the message gives the reason."""


class _DisturbedError(_UndeterminedError):
    """The arrival times contradict each other."""


class _Evidence(NamedTuple):
    """Bounds of the shift of each frame, int64 [frame], and the time before each burst at which to count."""

    low: Times  # soft; far below zero for a frame without any
    high: Times  # hard
    counted_ns: NDArray[np.float64]  # [burst]


_UNKNOWN = -(1 << 40)


def _observe(
    pulses_ns: Times, received_ns: Times, arrivals: Times, received: int, frame_bytes: int, payload_bytes: int
) -> _Evidence:
    """Bound the shift of each frame by the arrivals of its packets."""
    pulses, count = pulses_ns.reshape(-1), pulses_ns.shape[1]
    period_ns = int(np.diff(pulses_ns, axis=1).min()) if count > 1 else int(np.diff(pulses).min(initial=1 << 60))
    grown = np.flatnonzero(np.diff(arrivals[:, 1], prepend=0) > 0)
    came = arrivals[grown, 0]
    stop = arrivals[grown, 1]
    before = np.append(0, stop[:-1])
    empty = _last_empty(arrivals)[grown]
    frame = (stop - 1) // frame_bytes
    # The short last packet waits for the end of the record.
    full = stop % payload_bytes == 0
    pauses = _pauses(pulses_ns, received_ns)
    earliest, expected = _expected_arrivals(
        pulses_ns, pauses, came[full], frame[full], frame_bytes >= payload_bytes, received < pulses.size
    )

    first_batch = np.searchsorted(stop, np.arange(received) * frame_bytes, "right")
    sent_by_then = np.searchsorted(earliest, came + min(_EARLY * period_ns, _EARLY_NS), "right") - 1
    high = sent_by_then[first_batch] - np.arange(received)
    low = np.full(received, _UNKNOWN)
    # Only the first packet of a frame: its later ones come while the frame lasts.
    begins = full & (before <= frame * frame_bytes)
    not_before = np.searchsorted(expected, empty - min(_PUNCTUAL * period_ns, _PUNCTUAL_NS), "left")
    low[frame[begins]] = (not_before - frame)[begins]
    pause_ns = int((pulses_ns[1:, 0] - pulses_ns[:-1, -1]).min())
    return _Evidence(low, high, earliest[::count] - min(pause_ns / 4, _GUARD_NS))


def _count_at_bursts(
    evidence: _Evidence, arrivals: Times, received: int, frame_bytes: int, payload_bytes: int, holes: list[Gap]
) -> tuple[list[int], Times, Times]:
    """Count the frames that had come when each burst began: bursts with a certain count, that count, and all."""
    times = evidence.counted_ns
    empty = _last_empty(arrivals)
    surely = np.searchsorted(arrivals[:, 0], times, "right")
    perhaps = np.maximum(surely, np.searchsorted(np.maximum.accumulate(empty), times, "left"))
    extent = np.append(0, arrivals[:, 1])
    least, most = extent[surely], extent[perhaps]
    for start, end in holes:
        most = np.where(most == start, end, most)
    if least[0]:
        raise _DisturbedError("data arrived before the row's first pulse was sent")
    # A card holds back what does not fill a packet.
    low = -(-least // frame_bytes)
    high = np.minimum((most + payload_bytes - 1) // frame_bytes, received)
    low[0] = high[0] = 0
    certain = np.flatnonzero(low == high).tolist()
    return certain, low, high


def _decide(
    evidence: _Evidence, counted: tuple[list[int], Times, Times], count: int, pulses: int
) -> tuple[Times, bool]:
    """Decide the pulse of each frame, part by part between the counts that are certain; True if any is displaced."""
    low, high, _ = evidence
    received = low.size
    slots = np.full(received, -1, dtype=np.int64)
    certain, frames, most = counted
    edges = [(int(frames[b]), b * count - int(frames[b])) for b in certain]
    # Every pulse has a frame or was missed, whatever happened before: that gives the shift at the end.
    edges.append((received, pulses - received))
    planned = np.minimum(np.arange(most.size) * count, received)
    # Also bounds of a count tell: of frames below a packet few counts are certain, and all may be a pulse off.
    off = received == pulses and bool(((frames > planned) | (most < planned)).any())
    contradicted = off or any(shift != 0 for _, shift in edges)
    parts = list(itertools.pairwise(edges))
    late = sum(int((low[i:j] > before).sum()) for (i, before), (j, after) in parts if before == after)
    for k, ((start, before), (stop, after)) in enumerate(parts):
        own = slice(start, stop)
        index = np.arange(start, stop)
        is_last = k == len(parts) - 1
        # Late, and when a frame of a later pulse comes; others are only late.
        displaced = _longest_run((low[own] > before) & (high[own] >= low[own]))
        is_displaced = displaced >= _DISPLACED and late <= displaced + _RARE * received
        if (high[own] < before).any() or after < before or (after == before and is_displaced):
            contradicted = True
            continue
        seen = np.flatnonzero((high[own] == before) & (low[own] == before))
        proven = int(seen[-1]) + 1 if seen.size else 0
        if after == before and not is_last:
            # Between two equal counts.
            proven = len(index)
        part = np.where(_beside_late(low[own], high[own], before), -1, index + before)
        part[proven:] = -1
        persists = is_last or edges[k + 2][1] >= after
        if after > before and persists:
            behind = proven + _first_displaced(
                low[own][proven:], high[own][proven:], after, 1 if late == 0 else _DISPLACED
            )
            unclear = _beside_late(low[own][behind:], high[own][behind:], after)
            part[behind:] = np.where(unclear, -1, index[behind:] + after)
        slots[own] = part
    return slots, contradicted


def _beside_late(low: Times, high: Times, shift: int) -> NDArray[np.bool_]:
    """Select the frames that came too late for this shift, and those beside them: perhaps a pulse was missed.

    The frame behind them, at its time again, may be that of a spurious edge; frames without evidence are as the ones
    beside them.
    """
    late = low > shift
    seen = (high == shift) & (low == shift)
    told = np.flatnonzero(late | seen)
    if not told.size:
        return late
    suspect = late.copy()
    suspect[told[1:]] |= late[told[:-1]]
    index = np.arange(low.size)
    left = told[np.maximum(np.searchsorted(told, index, "right") - 1, 0)]
    right = told[np.minimum(np.searchsorted(told, index, "left"), told.size - 1)]
    return suspect[left] | suspect[right]


def _first_displaced(low: Times, high: Times, shift: int, needed: int) -> int:
    """Return the first frame with this shift, behind a missed pulse: so many came when such frames have to."""
    at_shift = np.flatnonzero((low == shift) & (high == shift))
    if at_shift.size < needed:
        return low.size
    return int(at_shift[needed - 1])


def _longest_run(flags: NDArray[np.bool_]) -> int:
    """Length of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def _missed(slots: Times, pulses: int) -> list[int]:
    """Numbers of the pulses between two neighbours that are certain."""
    number = np.concatenate([[-1], np.arange(slots.size), [slots.size]])
    slot = np.concatenate([[-1], slots, [pulses]])
    sure = np.flatnonzero((slot >= 0) | (number < 0))
    out: list[int] = []
    for a, b in zip(sure[:-1].tolist(), sure[1:].tolist(), strict=True):
        if b == a + 1:
            out += range(int(slot[a]) + 1, int(slot[b]))
    return out


def _without_mixed(slots: Times, pulses: int) -> Times:
    """Mask the frames beside every missed pulse and every frame that is uncertain.

    A card that drops exactly a frame's bytes within two frames, unnoticed, leaves one frame made of both.
    """
    sure = np.flatnonzero(slots >= 0)
    number = np.concatenate([[-1], sure, [slots.size]])
    shift = np.concatenate([[0], slots[sure] - sure, [pulses - slots.size]])
    changes = np.flatnonzero((np.diff(shift) != 0) | (np.diff(number) > 1))
    out = slots.copy()
    beside = np.concatenate([changes - 1, changes])
    out[sure[beside[(beside >= 0) & (beside < sure.size)]]] = -1
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


def _expected_arrivals(
    pulses_ns: Times, pauses: Times, came: Times, frame: Times, is_first: bool, only_whole: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the earliest and the expected arrival of each pulse's frame: host's clock, float64 [pulse] each.

    Estimated from the packets of each burst: the shortest time from pulse to data, and its drift along the row. A burst
    with a missed pulse or a spurious edge differs from the others and is left out. `is_first`: a burst's first packet
    is of its first frame; otherwise (frames below a packet) frames are counted from the row's first. `only_whole`: of a
    row with missed pulses only bursts with all of their frames count, as a radar may miss the first pulse of many.
    """
    count = pulses_ns.shape[1]
    sent, delay = [], []
    edges = np.append(np.searchsorted(came, pauses, "right"), came.size)
    for b in range(len(pauses)):
        own = slice(int(edges[b]), int(edges[b + 1]))
        pulse = frame[own] - (frame[own][:1] if is_first else b * count)
        of_burst = (pulse >= 0) & (pulse < count)
        if of_burst.any() and (pulse.max() == count - 1 or not only_whole):
            sent.append(pulses_ns[b, 0])
            delay.append((came[own][of_burst] - pulses_ns[b][pulse[of_burst]]).min())
    if len(sent) < _AGREEING:
        raise _DisturbedError(f"data of {len(sent)} bursts came in time: too few for the offset between the clocks")
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
        raise _UndeterminedError(f"{len(x)} bursts came in time: too few for the drift between the clocks")
    rest = y - drift * x
    # The least delay that half of the bursts share: delayed ones lie above it, one with a spurious edge below.
    tolerance_ns = min(_PUNCTUAL * period_ns, _PUNCTUAL_NS)
    ordered = np.sort(rest)
    sharing = np.searchsorted(ordered, ordered + tolerance_ns, "right") - np.arange(len(ordered))
    shared = np.flatnonzero(sharing >= max(_AGREEING, len(rest) / 2))
    if not shared.size:
        raise _DisturbedError("the delays of the bursts differ by more than a pulse period")
    usual = float(ordered[shared[0]])
    quickest = float(ordered[ordered >= usual - tolerance_ns].min())
    common = pulses + float(base) + drift * (pulses - zero)
    return common + quickest, common + usual


class ReceivedCapture(NamedTuple):
    """A capture event and the time at which the host read it (monotonic clock, ns)."""

    event: Capture
    received_ns: int


def find_frames(path: Path, row: Row, events: list[ReceivedCapture], rig: Instrument, holes: list[Gap]) -> PlacedFrames:
    """Place the frames of a row.

    `path` is the row's file, with its index beside it; `events` are the row's capture events; `holes` the ranges of
    bytes that never came. Raises DataError if the index is not readable.
    """
    events = sorted((e for e in events if e.event.pulses == rig.burst.pulses), key=lambda e: e.event.point)
    if [e.event.point for e in events] != list(range(row.points)):
        none = np.full(0, -1, dtype=np.int64)
        return PlacedFrames(none, [], row.points * rig.burst.pulses, "capture events of the row are missing")
    arrivals = read_index(path.with_suffix(".idx"))[1]
    return place_frames(*_event_times(events), arrivals, rig.frame_bytes, rig.card.payload_bytes, holes)


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
    """Rewrite a row with each frame at its pulse and everything else masked; durable on return.

    The index keeps its arrivals and gains `pulses_missed` and `frames`: runs of frames as [number of the first frame
    received, number of its pulse, length]. Raises DeviceError if the disk fails, DataError if the index is unreadable.
    """
    facts, arrivals = read_index(path.with_suffix(".idx"))
    received = np.fromfile(path, dtype=np.uint8)
    packets_crc = _keep_payload(path.with_suffix(PACKETS), received)
    out, missing = move_frames(received, capture.holes, int(arrivals[-1, 1]), placed.slots, frame_bytes)
    try:
        with path.open("r+b") as f:
            f.write(out.data)
            f.flush()
            os.fsync(f.fileno())
    except OSError as e:
        raise write_error(path, "made durable", e) from None
    changed = {
        "missing": missing,
        "located": True,
        "reason": "",
        "pulses_missed": placed.missed,
        "frames": _runs(placed.slots),
    }
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


def move_frames(
    received: NDArray[np.uint8], holes: list[Gap], extent: int, slots: Times, frame_bytes: int
) -> tuple[NDArray[np.uint8], list[Gap]]:
    """Return the row with each frame at its slot, uint8 [expected], and the ranges that are masked.

    `received` has `extent` bytes in the card's order, without those in `holes`.
    """
    out = np.zeros_like(received)
    present: list[Gap] = []
    for first, slot, count in _runs(slots):
        start, stop = first * frame_bytes, min((first + count) * frame_bytes, extent)
        move = (slot - first) * frame_bytes
        out[start + move : stop + move] = received[start:stop]
        present += [(a + move, b + move) for a, b in _outside(holes, start, stop)]
    missing = _outside(present, 0, received.size)
    for start, stop in missing:
        out[start:stop] = 0
    return out, missing


def frames_to_move(capture: RowCapture | Placed, late: int, frames: PlacedFrames | None) -> PlacedFrames | None:
    """Return the frames with which a row is rewritten; None if it stays as its packets' counters say.

    Rewritten is a row whose frames are not at the pulses that their number says. Of a row with holes only frames are
    kept that were seen at their pulses. No frame is kept if the times contradict each other, or if frames are
    displaced and packets came out of their order (`late` of them).
    """
    if frames is None:
        return None
    has_holes = capture.located and bool(capture.missing)
    is_displaced = capture.slipped or frames.contradicted
    none_is_certain = (frames.disturbed and has_holes) or (is_displaced and not frames.reason and late > 0)
    if none_is_certain:
        return replace(frames, slots=np.full_like(frames.slots, -1), missed=[])
    if not frames.reason and (is_displaced or (has_holes and frames.uncertain)):
        return frames
    return None


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
