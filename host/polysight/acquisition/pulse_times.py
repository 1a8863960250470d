"""Find the pulse of each frame of a row, from the times at which its packets came (docs/spec/row.md).

A record says how many frames a radar sent, not at which pulses: a missed SYNC_IN pulse, a spurious edge and bytes that
the card dropped unnoticed leave no other trace. Arrival times do. The packets of one frame come together, as a *train*
between two silences. The *shift* of a train is the number of bytes that are missing before it: 0 in a perfect row, a
frame more after a missed pulse, a frame less after a spurious edge. Arrival times bound it:

* Upper bound: when the last byte of a train came, the pulse of its frame had been sent. It holds for any delay.
* Lower bound: the first packet of a train came as soon as it was full, unless something held it back. This bound is
  used only for a train of a single frame, as frames that were held back come together. If the train came at no pulse's
  time, the first pulse of its burst counts.

In a row with as many frames as pulses every train must allow a shift of 0. In a row with fewer frames the shift only
grows, from 0 to the number of bytes missing at the end; a frame is kept if its bounds are equal, and a whole number of
frames. In both kinds of rows only frames that came at the times of their pulses are kept.

A *burst* is the pulses of one position of the stage. Pulses are numbered through the row; a frame's *slot* is the
number of its pulse.
"""

from __future__ import annotations

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
    PACKETS_SUFFIX,
    PlacedRecord,
    RowCapture,
    make_write_error,
    read_index,
    read_packets,
    write_index,
    write_packets,
)
from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.messages import Capture
from polysight_shared.raster import Row
from polysight_shared.units import us_to_ns

Times = NDArray[np.int64]
Flags = NDArray[np.bool_]
# A gap is a range of bytes of the row: its first, and the one after its last.
Gap = tuple[int, int]

# Silence between packets that begins a new train (chosen). A radar needs 150 us between two frames (AWR2243, hardware
# trigger), and the first packet of a frame comes only when it is full.
SILENCE_NS = 200_000
# A train is at the time of a pulse if it comes between `early` before and `frame + late` after the predicted arrival of
# that pulse's data, where `frame` is the duration of a frame, early = min(_EARLY_SHARE * period, _EARLY_NS), and
# late = min(_LATE_SHARE * period, _LATE_NS), with the pulse period. Chosen: wide enough for the jitter of network and
# machine, far less than half a period.
_EARLY_SHARE = 0.1
_EARLY_NS = 200_000
_LATE_SHARE = 0.15
_LATE_NS = 200_000
# If more than this share of the trains is not of a single frame at the time of a pulse, the machine or the network is
# slow, and the arrival times of the row are not *sharp*; chosen.
_MAX_BLURRED_SHARE = 0.1
# This many successive trains at other pulses than their own contradict the placement of a row without missing frames,
# and so do this many trains, successive or not, that came before their pulses; if times are sharp, one of the latter is
# enough. Chosen.
_DISPLACED_TRAINS = 3
# Bytes of one sample of all four antennas: a card drops whole ones of these (inferred).
_SAMPLE_BYTES = 16
# If the time to the next train is less than this share of the pulse period, the train was delayed, and the next one was
# delayed less (chosen).
_CATCH_UP_SHARE = 0.8
# Smallest number of bursts whose delays from pulse to data must agree; chosen.
_MIN_AGREEING_BURSTS = 3
# Largest difference between agreeing delays: this share of the pulse period, but at most the time in ns (chosen).
_AGREEMENT_SHARE = 0.3
_AGREEMENT_NS = 500_000
# Largest relative drift between the clocks of Pi and host: that of a clock which NTP slews.
_MAX_DRIFT = 500e-6
# Usual drift: that of two crystals of 50 ppm each.
_USUAL_DRIFT = 100e-6
# The drift is estimated from at least this many bursts; with fewer it must be negligible. Chosen.
_DRIFT_BURSTS = 8
# Rate of the host's clock over that of the pulses; outside, the pulses are in simulated time (chosen).
_CLOCK_RATES = 0.8, 1.25
# Number of missed pulses that a message names; chosen.
_MAX_NAMED_PULSES = 4
# Stands for no bound: beyond every time in nanoseconds, and every number of bytes.
_NO_BOUND = 1 << 60


@dataclass(frozen=True)
class PlacedFrames:
    """Pulse numbers of the frames of a row."""

    # int64 [frame]: the pulse number of each received frame; -1 if it was not seen at its pulse. Empty if no frame
    # came, or the row's capture events are missing
    slots: Times
    # Numbers of the pulses that were certainly missed
    missed: list[int]
    # Number of pulses in the row.
    pulses: int
    # True if the times contradict the row's length or each other: the pulse of no frame is certain
    contradicted: bool = False
    # Why the times cannot be used; "" if they can. If `contradicted`: how they contradict each other, or "" if single
    # trains contradict the row's length or each other
    reason: str = ""

    @property
    def is_timed(self) -> bool:
        """True if there are times to compare the frames with; False: pulses follow from the frames' numbers alone."""
        return self.contradicted or not self.reason

    @property
    def uncertain(self) -> int:
        """Number of received frames whose pulse is not certain."""
        return int((self.slots < 0).sum())


def place_frames(
    pulses_ns: Times,
    received_ns: Times,
    arrivals: Times,
    frame_bytes: int,
    payload_bytes: int,
    frame_ns: int,
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
        had arrived by then.
    frame_bytes, payload_bytes
        Bytes of one frame and of the payload of a full packet.
    frame_ns
        Duration of a frame, from the start of its first chirp to the end of its last.

    Returns
    -------
    PlacedFrames
        Slots of placed frames increase along the row. A slot is -1 where the bounds allow more than one pulse, or the
        frame was not seen at its pulse.
    """
    pulses = pulses_ns.size
    received = 0
    if len(arrivals):
        # The last frame may be cut.
        received = -(-int(arrivals[-1, 1]) // frame_bytes)
    try:
        if received == 0:
            raise _UndeterminedError("no frame came")
        if received > pulses:
            raise _UndeterminedError("more frames came than pulses were sent")
        if frame_bytes < payload_bytes:
            raise _UndeterminedError("a packet contains several frames: only the frame that fills it has a time")
        trains = _find_trains(pulses_ns, received_ns, arrivals, frame_bytes, payload_bytes, frame_ns)
    except _UndeterminedError as e:
        no_frame = np.full(received, -1, dtype=np.int64)
        is_contradiction = isinstance(e, _DisturbedError)
        return PlacedFrames(no_frame, missed=[], pulses=pulses, contradicted=is_contradiction, reason=str(e))
    if received < pulses:
        return _place_short_row(trains, received, pulses, frame_bytes)
    return _check_whole_row(trains, pulses, frame_bytes)


class _UndeterminedError(Exception):
    """The arrival times are not sufficient; the message gives the reason."""


class _DisturbedError(_UndeterminedError):
    """The arrival times contradict each other."""


class _Trains(NamedTuple):
    """Packets that came between two silences, as a rule those of one frame; arrays are [train]."""

    # int64, bytes of the record up to the end of its first packet
    first_stop: Times
    # int64, up to the end of its last packet
    last_stop: Times
    # int64, lower bound of the shift at its first packet, bytes
    low: Times
    # int64, upper bound of the shift at its last packet, bytes
    high: Times
    # True for trains of one frame at the time of a pulse.
    punctual: Flags
    # True for trains of one frame that came at no pulse's time, or that were delayed, as the next one follows too soon.
    # In a whole row also for those at another pulse's time. Trains of several frames are neither punctual nor astray.
    astray: Flags


def _find_trains(
    pulses_ns: Times, received_ns: Times, arrivals: Times, frame_bytes: int, payload_bytes: int, frame_ns: int
) -> _Trains:
    """Divide the packets into trains, and bound the shift of each; parameters as of :func:`place_frames`."""
    # Arrivals of full packets that added bytes: the short last packet waits for the end of the record.
    new_bytes = np.diff(arrivals[:, 1], prepend=0) > 0
    entries = arrivals[new_bytes & (arrivals[:, 1] % payload_bytes == 0)]
    came_ns = entries[:, 0]
    stop = entries[:, 1]
    is_whole = int(arrivals[-1, 1]) == pulses_ns.size * frame_bytes
    expected = _predict_arrivals(pulses_ns, received_ns, entries, frame_bytes, is_whole)

    # A silence begins a train; the first packet follows one, too.
    period_ns = _find_period_ns(pulses_ns)
    silence_ns = min(SILENCE_NS, period_ns // 2)
    heads = np.flatnonzero(np.diff(came_ns, prepend=came_ns[:1] - 2 * silence_ns) > silence_ns)
    tails = np.append(heads[1:], came_ns.size) - 1
    first_stop = stop[heads]

    # Number of the latest pulse whose data was due when a train began and when it ended; -1 before the first.
    early_ns = min(_EARLY_SHARE * period_ns, _EARLY_NS)
    pulse_of_head = np.searchsorted(expected, came_ns[heads] + early_ns, "right") - 1
    pulse_of_tail = np.searchsorted(expected, came_ns[tails] + early_ns, "right") - 1
    late_ns = came_ns[heads] - expected[np.maximum(pulse_of_head, 0)]
    is_single = stop[tails] - first_stop < frame_bytes
    is_in_time = (pulse_of_head >= 0) & (late_ns <= frame_ns + min(_LATE_SHARE * period_ns, _LATE_NS))
    # A train that is late for every pulse of its burst is not of an earlier burst: no delay is as long as a pause. So
    # the first pulse of the burst is its bound.
    count = pulses_ns.shape[1]
    first_pulse = np.where(is_in_time, pulse_of_head, pulse_of_head // count * count)
    # When its first packet was full, the radar had sent all frames of the pulses before `first_pulse`, and at least one
    # sample of that pulse's frame. Of these bytes, the record has `first_stop`; the others are missing.
    low = np.where(is_single, frame_bytes * first_pulse + _SAMPLE_BYTES - first_stop, -_NO_BOUND)
    # Frames that come faster than pulses are sent make up for a delay of any length.
    to_next_ns = np.diff(came_ns[heads], append=_NO_BOUND)
    catches_up = (low > 0) & (to_next_ns < _CATCH_UP_SHARE * period_ns)
    low[catches_up] = -_NO_BOUND
    is_in_time &= ~catches_up
    return _Trains(
        first_stop=first_stop,
        last_stop=stop[tails],
        low=low,
        high=frame_bytes * (pulse_of_tail + 1) - stop[tails],
        punctual=is_single & is_in_time,
        astray=is_single & ~is_in_time,
    )


def _check_whole_row(trains: _Trains, pulses: int, frame_bytes: int) -> PlacedFrames:
    """Compare the trains of a row that has as many frames as pulses with the pulses: every shift must be 0."""
    is_sharp = (~trains.punctual).sum() <= _MAX_BLURRED_SHARE * trains.punctual.size
    is_early = (trains.high < 0) & trains.punctual
    is_displaced = is_early | (trains.low > 0)
    is_in_place = trains.punctual & ~is_displaced
    max_early = 0 if is_sharp else _DISPLACED_TRAINS - 1
    # One or two trains in sequence at later pulses contradict nothing: their packets came out of order, or the machine
    # stalled.
    contradicted = is_early.sum() > max_early or _measure_longest_run(is_displaced) >= _DISPLACED_TRAINS
    trains = trains._replace(punctual=is_in_place, astray=trains.astray | is_displaced)
    slots = np.where(_select_seen(trains, frame_bytes, pulses), np.arange(pulses), -1)
    reason = ""
    # No frame came at its pulse, though the row's length is right: delays are as long as a pause, which
    # `_find_trains` excludes.
    if not contradicted and (slots < 0).all():
        reason = "the delays in this row are as long as the pauses between its bursts"
    if contradicted or reason:
        no_slot = np.full(pulses, -1, dtype=np.int64)
        return PlacedFrames(no_slot, missed=[], pulses=pulses, contradicted=True, reason=reason)
    return PlacedFrames(slots, missed=[], pulses=pulses)


def _measure_longest_run(flags: Flags) -> int:
    """Return the length of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def _place_short_row(trains: _Trains, received: int, pulses: int, frame_bytes: int) -> PlacedFrames:
    """Find the pulses of the frames of a row with fewer frames than pulses."""
    # The shift never falls along the row: lower bounds hold for all later trains, upper bounds for all earlier ones.
    # `low[k]` is the lower bound after the first k trains, `high[k]` the upper bound before the last packet of train k
    # (of the row, for the last one), both in bytes.
    missing_end_bytes = (pulses - received) * frame_bytes
    low = np.maximum.accumulate(np.append(0, trains.low))
    high = np.minimum.accumulate(np.append(trains.high, missing_end_bytes)[::-1])[::-1]
    slots = np.full(received, -1, dtype=np.int64)
    # The bounds contradict each other where a lower bound is above the upper bound of the same or a later train.
    if (low[1:] > high[:-1]).any():
        return PlacedFrames(slots, missed=[], pulses=pulses, contradicted=True)
    # Bounds of each frame: the lower one of the last train whose first packet lies before it, the upper one of the
    # first train that reaches its end.
    begins = np.arange(received) * frame_bytes
    least_bytes = low[np.searchsorted(trains.first_stop, begins, "right")]
    most_bytes = high[np.searchsorted(trains.last_stop, begins + frame_bytes, "left")]
    is_certain = (
        (least_bytes == most_bytes) & (least_bytes % frame_bytes == 0) & _select_seen(trains, frame_bytes, received)
    )
    slots[is_certain] = (np.arange(received) + least_bytes // frame_bytes)[is_certain]
    return PlacedFrames(slots, _find_missed(slots, pulses), pulses)


def _select_seen(trains: _Trains, frame_bytes: int, frames: int) -> Flags:
    """Select the frames that came at a pulse's time, bool [frame]."""
    punctual = _select_frames(trains, trains.punctual, frame_bytes, frames)
    return punctual & ~_select_frames(trains, trains.astray, frame_bytes, frames)


def _select_frames(trains: _Trains, selected: Flags, frame_bytes: int, frames: int) -> Flags:
    """Select the frames in which the first or the last packet of a selected train ends, bool [frame]."""
    is_selected = np.zeros(frames, dtype=np.bool_)
    is_selected[(trains.first_stop[selected] - 1) // frame_bytes] = True
    is_selected[(trains.last_stop[selected] - 1) // frame_bytes] = True
    return is_selected


def _find_missed(slots: Times, pulses: int) -> list[int]:
    """Return the numbers of the pulses between those of two successive frames whose pulses are certain."""
    # The beginning and the end of the row count as frames with certain pulses, -1 and `pulses`.
    slots_and_ends = np.concatenate([[-1], slots, [pulses]])
    is_certain = slots_and_ends >= 0
    is_certain[0] = True
    missed: list[int] = []
    for k in np.flatnonzero(is_certain[:-1] & is_certain[1:]).tolist():
        missed += range(int(slots_and_ends[k]) + 1, int(slots_and_ends[k + 1]))
    return missed


def _find_period_ns(pulses_ns: Times) -> int:
    """Return the shortest time between two pulses."""
    return int(np.diff(pulses_ns.reshape(-1)).min(initial=_NO_BOUND))


def _find_pauses(pulses_ns: Times, received_ns: Times) -> Times:
    """Return a time (host's clock) in the pause before each burst, int64 [burst]; parameters as of `place_frames`.

    The quickest of the capture events gives the offset between the clocks. Raises _UndeterminedError if there are
    fewer than two bursts, if they have no pause, if the pulses are in simulated time, or if no second event was as
    quick within a quarter of the pause.
    """
    last = pulses_ns[:, -1]
    if len(last) < 2:
        raise _UndeterminedError("the offset between the clocks cannot be measured with fewer than two bursts")
    pause_ns = int((pulses_ns[1:, 0] - last[:-1]).min())
    if pause_ns < 2 * int(np.diff(pulses_ns[:, :2]).max(initial=0)):
        raise _UndeterminedError("the bursts follow each other without a pause")
    rate = (received_ns[-1] - received_ns[0]) / (last[-1] - last[0])
    if not _CLOCK_RATES[0] < rate < _CLOCK_RATES[1]:
        raise _UndeterminedError(
            f"the pulses are in simulated time, {1 / max(rate, 1e-9):.3g} times as fast as the host's"
        )
    delay = received_ns - last
    # Too large by the delay of the fastest event.
    offset_ns = int(delay.min())
    if (delay < offset_ns + pause_ns // 4).sum() < 2:
        raise _UndeterminedError("the capture events came too late to separate one burst from the next")
    return pulses_ns[:, 0] + offset_ns - pause_ns // 2


def _predict_arrivals(
    pulses_ns: Times, received_ns: Times, entries: Times, frame_bytes: int, is_whole: bool
) -> NDArray[np.float64]:
    """Return the expected arrival of each pulse's first packet: host's clock, float64 [pulse].

    `entries` are the full packets, as `arrivals` of :func:`place_frames`. The delay of a burst is its shortest time
    from a pulse to the data of that pulse. The estimate is the delay that half of the bursts share, with its drift
    along the row. A burst with a missed pulse or a spurious edge differs from the others and is left out. In a row with
    missed pulses only bursts with all of their frames count, because a radar may miss the first pulse of many bursts.

    If the row is whole and every frame came in the burst that its number says, frames are counted from the row's first:
    the first frames of many bursts may have come out of order. Otherwise they are counted from the first of their
    burst.

    Raises _DisturbedError if too few bursts agree, _UndeterminedError if the clocks cannot be compared.
    """
    bursts, count = pulses_ns.shape
    if bursts < _MIN_AGREEING_BURSTS:
        raise _UndeterminedError(
            f"the offset between the clocks cannot be measured with fewer than {_MIN_AGREEING_BURSTS} bursts"
        )
    pauses = _find_pauses(pulses_ns, received_ns)
    came_ns = entries[:, 0]
    frame = (entries[:, 1] - 1) // frame_bytes
    edges = np.append(np.searchsorted(came_ns, pauses, "right"), came_ns.size)
    points_sent: list[int] = []
    delays: list[int] = []
    burst_of_packet = np.searchsorted(pauses, came_ns, "left") - 1
    is_in_its_burst = is_whole and bool((burst_of_packet == frame // count).all())
    for burst in range(bursts):
        packets = slice(int(edges[burst]), int(edges[burst + 1]))
        # For a burst without packets all of these arrays are empty.
        first_frame = burst * count if is_in_its_burst else frame[packets][:1]
        pulse = frame[packets] - first_frame
        is_of_burst = (pulse >= 0) & (pulse < count)
        if is_of_burst.any() and (is_whole or pulse.max() == count - 1):
            points_sent.append(int(pulses_ns[burst, 0]))
            sent_ns = pulses_ns[burst][pulse[is_of_burst]]
            delays.append(int((came_ns[packets][is_of_burst] - sent_ns).min()))
    if len(points_sent) < _MIN_AGREEING_BURSTS:
        raise _DisturbedError(
            f"data of {len(points_sent)} bursts came in time: too few for the offset between the clocks"
        )

    # Delays relative to the first one, over the time since the first pulse.
    start_ns = int(pulses_ns[0, 0])
    sent_at = np.array(points_sent, dtype=np.float64) - start_ns
    delay = np.array(delays, dtype=np.float64) - delays[0]
    drift = _estimate_drift(sent_at, delay, pulses_ns)
    residual = np.sort(delay - drift * sent_at)
    # The shortest range of delays that half of the bursts share: others are delayed, or have a spurious edge.
    sharing = max(_MIN_AGREEING_BURSTS, (residual.size + 1) // 2)
    widths = residual[sharing - 1 :] - residual[: residual.size - sharing + 1]
    narrowest = int(np.argmin(widths))
    if widths[narrowest] > min(_AGREEMENT_SHARE * _find_period_ns(pulses_ns), _AGREEMENT_NS):
        raise _DisturbedError("the delays of the bursts differ too much to distinguish their pulses")
    # The quickest of the bursts that agree counts: slower ones were delayed.
    pulses = pulses_ns.reshape(-1)
    return pulses + float(delays[0]) + drift * (pulses - start_ns) + residual[narrowest]


def _estimate_drift(times: NDArray[np.float64], delay: NDArray[np.float64], pulses_ns: Times) -> float:
    """Return the relative drift of the clocks by the delays (ns) of bursts at `times` (ns).

    It is the drift nearest to 0 within the 95 % interval of the slope; 0 with fewer bursts than `_DRIFT_BURSTS`. Raises
    _UndeterminedError if there are so few and the row is too long to neglect the drift.
    """
    if times.size >= _DRIFT_BURSTS:
        # The ends of the 95 % interval.
        low, high = scipy.stats.theilslopes(delay, times)[2:]
        nearest_to_zero = np.clip(0.0, low, high)
        return float(np.clip(nearest_to_zero, -_MAX_DRIFT, _MAX_DRIFT))
    if _USUAL_DRIFT * float(np.ptp(pulses_ns)) > _EARLY_SHARE * _find_period_ns(pulses_ns):
        raise _UndeterminedError(f"{times.size} bursts came in time: too few for the drift between the clocks")
    return 0.0


def check_frame_fills_packet(rig: Instrument) -> None:
    """Raise ConfigError if a frame is smaller than a packet: of the frames in a packet only one has an arrival time."""
    if rig.frame_bytes < rig.card.payload_bytes:
        raise ConfigError(
            f"a frame of {rig.frame_bytes} bytes is smaller than a packet of {rig.card.payload_bytes}",
            "a missed and a spurious edge within a packet cannot be seen",
            "use more samples or chirps a frame",
            code=ErrorCode.VALUE_INVALID,
        )


class ReceivedCapture(NamedTuple):
    """A capture event and the time at which the host read it (monotonic clock, ns)."""

    event: Capture
    received_ns: int


def find_frames(path: Path, row: Row, events: list[ReceivedCapture], rig: Instrument) -> PlacedFrames:
    """Place the frames of a row.

    `path` is the row's file; its index is in the same folder. `events` are the row's capture events. Raises DataError
    if the index is not readable.
    """
    events = sorted((e for e in events if e.event.pulses == rig.burst.pulses), key=lambda e: e.event.point)
    if [e.event.point for e in events] != list(range(row.points)):
        no_slots = np.full(0, -1, dtype=np.int64)
        pulses = row.points * rig.burst.pulses
        return PlacedFrames(no_slots, missed=[], pulses=pulses, reason="capture events of the row are missing")
    arrivals = read_index(path.with_suffix(".idx"))[1]
    frame_us = (rig.burst.chirps - 1) * rig.burst.chirp_us + rig.chirp.ramp_end_us
    return place_frames(
        *_collect_pulse_times(events),
        arrivals,
        frame_bytes=rig.frame_bytes,
        payload_bytes=rig.card.payload_bytes,
        frame_ns=us_to_ns(frame_us),
    )


def time_before_first_pulse_ns(events: list[ReceivedCapture]) -> int | None:
    """Return a time shortly before the row's first pulse: in the pause before its first burst.

    The time is on the host's monotonic clock. It is computed from the row's capture events; None if it cannot be.
    """
    events = sorted((e for e in events if e.event.pulses), key=lambda e: e.event.point)
    if not events or events[0].event.point != 0:
        return None
    try:
        return int(_find_pauses(*_collect_pulse_times(events))[0])
    except _UndeterminedError:
        return None


def _collect_pulse_times(events: list[ReceivedCapture]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the time of each pulse (Pi's clock), int64 [burst, pulse], and of each event's receipt, int64 [burst].

    Between the first and the last pulse of a burst, whose times its event has, pulses are taken as evenly spaced.
    """
    first = [e.event.first_pulse_ns for e in events]
    last = [e.event.last_pulse_ns for e in events]
    sent_ns = np.linspace(first, last, events[0].event.pulses, axis=1, dtype=np.int64)
    return sent_ns, np.array([e.received_ns for e in events], dtype=np.int64)


def describe(placed: PlacedFrames, pulses: int) -> str:
    """Describe missed pulses and lost frames in a sentence; `pulses` is the number in a burst."""
    count = placed.pulses - placed.slots.size
    if placed.reason:
        return f"{placed.reason}: the pulses of {placed.uncertain} frames are unknown"
    if count == 0:
        return f"frames are not at their pulses: spurious edges on SYNC_IN; {placed.uncertain} frames are lost"
    places = [f"position {s // pulses} pulse {s % pulses}" for s in placed.missed[:_MAX_NAMED_PULSES]]
    if len(placed.missed) > _MAX_NAMED_PULSES:
        places.append("...")
    text = f"missed {count} SYNC_IN pulses ({', '.join(places) or 'positions uncertain'})"
    if placed.uncertain:
        text += f", and {placed.uncertain} frames near them cannot be placed"
    return text


def rewrite_row(path: Path, capture: RowCapture, placed: PlacedFrames, frame_bytes: int) -> RowCapture:
    """Rewrite a row with each frame at its pulse and everything else masked; durable on return.

    The index keeps its arrivals and gains `pulses_missed` and `frames`: runs of frames as [number of the first frame
    received, number of its pulse, length]. Raises DeviceError if the disk fails, DataError if the index is unreadable.
    """
    facts, arrivals = read_index(path.with_suffix(".idx"))
    received = np.fromfile(path, dtype=np.uint8)
    packets_crc = _keep_payload(path.with_suffix(PACKETS_SUFFIX), received)
    payload, missing = move_frames(received, capture.holes, int(arrivals[-1, 1]), placed.slots, frame_bytes)
    try:
        with path.open("r+b") as f:
            f.write(payload.data)
            f.flush()
            os.fsync(f.fileno())
    except OSError as e:
        raise make_write_error(path, "made durable", e) from None
    # Each frame is at its pulse now: the row is located, with no reason against it.
    new_fields = {
        "missing": missing,
        "located": True,
        "reason": "",
        "pulses_missed": placed.missed,
        "frames": _find_runs(placed.slots),
    }
    index_crc = write_index(path.with_suffix(".idx"), {**facts, **new_fields}, arrivals)
    return msgspec.structs.replace(
        capture,
        missing=missing,
        bytes=capture.expected - sum(b - a for a, b in missing),
        located=True,
        reason="",
        crc32=zlib.crc32(payload.data),
        index_crc32=index_crc,
        packets_crc32=packets_crc,
    )


def move_frames(
    received: NDArray[np.uint8], holes: list[Gap], extent: int, slots: Times, frame_bytes: int
) -> tuple[NDArray[np.uint8], list[Gap]]:
    """Return the row with each frame at its slot, uint8 [byte], and the ranges that are masked.

    `received` has the size of a complete row; its first `extent` bytes are the record in the card's order, in which
    those in `holes` never came.
    """
    moved_frames = np.zeros_like(received)
    present: list[Gap] = []
    for first, slot, count in _find_runs(slots):
        start = first * frame_bytes
        stop = min((first + count) * frame_bytes, extent)
        move = (slot - first) * frame_bytes
        moved_frames[start + move : stop + move] = received[start:stop]
        present += [(a + move, b + move) for a, b in _subtract_ranges(holes, start, stop)]
    missing = _subtract_ranges(present, 0, received.size)
    for start, stop in missing:
        moved_frames[start:stop] = 0
    return moved_frames, missing


def find_frames_to_move(capture: RowCapture | PlacedRecord, frames: PlacedFrames | None) -> PlacedFrames | None:
    """Return the frames with which a row is rewritten; None to keep the placement by its packets' counters.

    Without times a row is not changed, and the manifest says so. If the times contradict the row, no frame is kept.
    Otherwise the row is rewritten if it has slipped, or if the pulse of some frame is uncertain.
    A row has slipped if its packets cannot be located only because whole frames are missing.
    """
    if frames is None or not frames.is_timed:
        return None
    if frames.contradicted:
        return replace(frames, slots=np.full_like(frames.slots, -1), missed=[])
    if capture.slipped or frames.uncertain:
        return frames
    return None


def _keep_payload(path: Path, received: NDArray[np.uint8]) -> int:
    """Store the payload as received in the row's packet file, before the row's file is rewritten.

    Returns the file's CRC-32; 0 if the packets were not kept.
    """
    if not path.exists():
        return 0
    # The packet file's other entries on the row stay unchanged. None: the packet file gets all of the payload, because
    # the row's file, which held it, is rewritten.
    evidence, log = read_packets(path, received)
    return write_packets(path, log, evidence, None)


def _find_runs(slots: NDArray[np.int64]) -> list[tuple[int, int, int]]:
    """Return runs of consecutive placed frames: first frame, its slot, length."""
    placed = np.flatnonzero(slots >= 0)
    if not placed.size:
        return []
    # A run begins where frame or slot jumps; -2 makes the first one begin.
    starts = np.flatnonzero((np.diff(placed, prepend=-2) != 1) | (np.diff(slots[placed], prepend=-2) != 1))
    stops = np.append(starts[1:], placed.size)
    runs = []
    for start, stop in zip(starts, stops, strict=True):
        first_frame = int(placed[start])
        runs.append((first_frame, int(slots[first_frame]), int(stop - start)))
    return runs


def _subtract_ranges(ranges: list[Gap], start: int, stop: int) -> list[Gap]:
    """Return the parts of [start, stop) outside the ranges, which are sorted and may touch."""
    gaps = []
    for a, b in ranges:
        if b > start and a < stop:
            if a > start:
                gaps.append((start, a))
            start = b
    if start < stop:
        return [*gaps, (start, stop)]
    return gaps
