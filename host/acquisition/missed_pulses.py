"""Which SYNC_IN pulses a board missed, found from when its data came.

A missed pulse leaves no trace in the data: the board is one frame short, and everything after it slips. But every frame
comes some 0.2 ms after its pulse, and the Pi's capture events tell when each pulse was sent. Only the offset between
the two clocks is unknown; the bursts from which every frame came give it, and what the clocks drift apart in a row.

Then each batch of packets bounds the pulse of its last frame from both sides:

* from above, always: data does not come before its pulse;
* from below, when frames are punctual: the socket was empty a moment before, so this frame is not older than that.

The number of pulses missed so far only grows along the row, so the bounds hold for all frames before and after. A frame
whose bounds meet is placed; any other is masked. A delayed frame looks like one of a later pulse, so the bounds from
below need witnesses: one frame in a row in which nothing was late, and the more, the more of its frames were late. What
this assumes: the quickest capture events reach the host within half of the pause between two bursts, and no frame is
delayed alone, in an otherwise punctual row, by one whole pulse period right where a pulse was missed.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

Times = NDArray[np.int64]
_EARLY = 0.1  # of the pulse period: how much sooner than the quickest known frame another may come
_PUNCTUAL = 0.3  # of the pulse period: the delay of a punctual frame
_LATE = 0.8  # of the pulse period: a frame with more delay counts as late
_RARE = 0.02  # places with missed pulses, a frame: up to here none is expected to fall together with a late frame
_CHANCE = 1e-6  # that all witnesses of a bound are late frames
_MAX_DRIFT = 500e-6  # crystals of 50 ppm, and a clock that NTP is slewing
_AGREEING = 3  # whole bursts whose shortest delays have to agree
_DRIFT_BURSTS = 8  # whole bursts that it takes to find the drift
_USUAL_DRIFT = 100e-6  # what two crystals drift apart at most
_RATES = 0.8, 1.25  # host clock over pulse clock: otherwise the pulses are in simulated time


@dataclass(frozen=True)
class PlacedFrames:
    """Where the frames of a slipped row belong.

    Attributes
    ----------
    slots
        int64 [frame]: for each frame received, the number of its pulse in the row, or -1 where that is not certain.
    missed
        Numbers of the pulses that were missed for certain.
    pulses
        Pulses of the row.
    reason
        Why no frame could be placed; "" when some could.
    """

    slots: Times
    missed: list[int]
    pulses: int
    reason: str = ""

    @property
    def uncertain(self) -> int:
        """Frames that were received but cannot be placed."""
        return int((self.slots < 0).sum())


def place_frames(
    pulses_ns: Times, told_ns: Times, arrivals: Times, frame_bytes: int, payload_bytes: int
) -> PlacedFrames:
    """Find the pulse of every frame of a row of which some pulses were missed.

    Parameters
    ----------
    pulses_ns
        int64 [burst, pulse]: when each SYNC_IN pulse of the row was sent, on the Pi's clock.
    told_ns
        int64 [burst]: when the host read each burst's capture event, on the host's clock.
    arrivals
        int64 [n, 2]: what the row's index holds: time on the host's clock, and bytes up to which data had come by then,
        in the order in which the card sent them. Where the bytes do not grow, nothing more waited at that time.
    frame_bytes, payload_bytes
        Bytes of one frame, and of the payload of one full packet.

    Returns
    -------
    PlacedFrames
        strictly increasing slots; -1 where the bounds leave more than one pulse.
    """
    n = pulses_ns.size
    received = -(-int(arrivals[-1, 1]) // frame_bytes) if len(arrivals) else 0
    try:
        low, high = _bounds(pulses_ns, told_ns, arrivals, received, frame_bytes, payload_bytes)
    except _UndecidedError as e:
        return PlacedFrames(np.full(received, -1, dtype=np.int64), [], n, str(e))
    slots = np.where(low == high, low, -1)
    possible = np.zeros(n + 1, dtype=np.int64)  # how many frames may be of each pulse
    np.add.at(possible, low, 1)
    np.add.at(possible, high + 1, -1)
    missed = np.flatnonzero(np.cumsum(possible)[:n] == 0).tolist()
    reason = "" if (slots >= 0).any() else "the delays in this row are as long as the pauses between its bursts"
    return PlacedFrames(slots, missed, n, reason)


def slipped_frames(
    pulses_ns: Times, told_ns: Times, arrivals: Times, frame_bytes: int, payload_bytes: int
) -> PlacedFrames | None:
    """Where the frames belong of a row with a frame for every pulse, when they are not all at their pulses' times.

    A radar that counts its frames takes an edge on SYNC_IN that nobody sent for a pulse, and has none left for the last
    one: the count is right, and every frame between them is one place off. So is what lies between a missed pulse and
    such an edge. Then more frames have come by the begin of a burst than pulses were sent before it, or as many fewer
    at three bursts in a row, which late data do not make. Frames of bursts that came whole are placed.

    Parameters and slots as :func:`place_frames`; None where every frame is at its pulse, or the times do not tell.
    """
    count = pulses_ns.shape[1]
    try:
        starts = _starts(pulses_ns, told_ns, arrivals, frame_bytes)
    except _UndecidedError:
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


class _UndecidedError(Exception):
    """The arrival times do not tell; the message says why."""


def _bounds(
    pulses_ns: Times, told_ns: Times, arrivals: Times, received: int, frame_bytes: int, payload_bytes: int
) -> tuple[Times, Times]:
    """First and last pulse, int64 [frame] each, that each received frame may be of."""
    pulses, slack = pulses_ns.reshape(-1), pulses_ns.size - received
    if frame_bytes < payload_bytes:
        raise _UndecidedError("a packet holds several frames, so that its arrival tells of none of them")
    if received == 0 or slack < 0:
        raise _UndecidedError("no frame came" if received == 0 else "more frames came than pulses were sent")
    period_ns = int(np.diff(pulses_ns, axis=1).min()) if pulses_ns.shape[1] > 1 else int(np.diff(pulses).min())
    grown = np.flatnonzero(np.diff(arrivals[:, 1], prepend=0) > 0)
    frame = (arrivals[grown, 1] - 1) // frame_bytes  # of the last byte of each batch
    came = arrivals[grown, 0]
    starts = _starts(pulses_ns, told_ns, arrivals, frame_bytes)
    earliest, expected = _expected_arrivals(pulses_ns, starts, frame, came)

    # From above: the last pulse that had been sent when the batch came.
    ahead = np.searchsorted(earliest, came + _EARLY * period_ns, "right") - 1 - frame
    most = np.full(received, slack)
    np.minimum.at(most, frame, ahead)
    most = np.minimum.accumulate(most[::-1])[::-1]
    if most[0] < 0:
        raise _UndecidedError("the arrival times contradict the pulses")
    # From below: the first pulse that is not too long ago, seen from when the socket was last found empty.
    full = arrivals[grown, 1] % payload_bytes == 0  # the short last packet waits for the end of the record
    seen, frame, empty = frame, frame[full], _found_empty(arrivals)[grown][full]
    behind = np.searchsorted(expected, empty - _PUNCTUAL * period_ns, "left") - frame
    punctual = behind <= most[frame]  # else the frame is late, and tells nothing
    told = np.zeros(received, dtype=np.int64)
    np.maximum.at(told, frame[punctual], behind[punctual])
    late = came - expected[np.minimum(seen + most[seen], pulses.size - 1)] > _LATE * period_ns
    late_frames = int((late & (np.diff(seen, prepend=-1) > 0)).sum())
    places = int((np.diff(_largest_so_far(told, 1), prepend=0) > 0).sum())  # at which pulses seem to be missed
    index = np.arange(received)
    return index + _largest_so_far(told, _witnesses(late_frames, places, received)), index + most


def _witnesses(late: int, places: int, frames: int) -> int:
    """How many frames it takes to believe a bound: so many are not all late by chance. One, where all is punctual."""
    if late == 0 and places <= _RARE * frames:
        return 1
    return int(np.ceil(np.log(_CHANCE) / np.log(min(0.5, (late + 1) / frames))))


def _largest_so_far(values: Times, rank: int) -> Times:
    """For each entry, the `rank`-th largest of the values up to it; 0 while there are fewer."""
    out, best = np.zeros_like(values), [0] * rank
    for i, value in enumerate(values.tolist()):
        if value > best[0]:
            heapq.heapreplace(best, value)
        out[i] = best[0]
    return out


def _found_empty(arrivals: Times) -> Times:
    """For each entry, a time at which its packets were not there yet; the far past for the first.

    The entry before says so when it is a look that found nothing. Otherwise the batches followed each other without
    one: then only the look for the batch before is known to be earlier, and it came after the entry before that.
    """
    n = len(arrivals)
    looked = np.diff(arrivals[:, 1], prepend=0) == 0
    out = np.full(n, np.iinfo(np.int64).min // 4)
    out[2:] = arrivals[:-2, 0]
    out[1:] = np.where(looked[:-1], arrivals[:-1, 0], out[1:])
    return out


def earliest_pulse(pulses_ns: Times, told_ns: Times) -> int | None:
    """A time on the host's clock in the pause before a row's first pulse; None where the events do not tell.

    Parameters as :func:`place_frames`; of each burst the first and the last pulse are enough.
    """
    try:
        return int(_pauses(pulses_ns, told_ns)[0])
    except _UndecidedError:
        return None


def _pauses(pulses_ns: Times, told_ns: Times) -> Times:
    """A time on the host's clock in the pause before each burst, int64 [burst]."""
    last = pulses_ns[:, -1]
    if len(last) < 2:
        raise _UndecidedError("a single burst does not tell the offset between the clocks")
    pause_ns = int((pulses_ns[1:, 0] - last[:-1]).min())
    if pause_ns < 2 * int(np.diff(pulses_ns[:, :2]).max(initial=0)):
        raise _UndecidedError("the bursts follow each other without a pause")
    rate = (told_ns[-1] - told_ns[0]) / (last[-1] - last[0])
    if not _RATES[0] < rate < _RATES[1]:
        raise _UndecidedError(
            f"the pulses are in simulated time, {1 / max(rate, 1e-9):.3g} times as fast as the host's"
        )
    delay = told_ns - last
    offset_ns = int(delay.min())  # too large by what the quickest event took
    if (delay < offset_ns + pause_ns // 4).sum() < 2:
        raise _UndecidedError("the capture events came too late to tell one burst from the next")
    return pulses_ns[:, 0] + offset_ns - pause_ns // 2


def _starts(pulses_ns: Times, told_ns: Times, arrivals: Times, frame_bytes: int) -> Times:
    """Frames that had come when each burst began, int64 [burst + 1], counted in the pauses between the bursts."""
    begins = _pauses(pulses_ns, told_ns)
    at = np.searchsorted(arrivals[:, 0], begins, "right")
    extent = np.where(at > 0, arrivals[np.maximum(at - 1, 0), 1], 0)
    if extent[0]:
        raise _UndecidedError("data came before the row's first pulse was sent")
    return np.append(-(-extent // frame_bytes), -(-arrivals[-1, 1] // frame_bytes))


def _expected_arrivals(
    pulses_ns: Times, starts: Times, frame: Times, came: Times
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """When a frame of each pulse comes at the earliest, and when it is expected: host's clock, float64 [pulse] each.

    From the bursts that came whole: the shortest time from pulse to data, and how it changes along the row. The two
    differ as the bursts do; and one that only seems whole, because a delayed frame made up for a missed one, is a
    period off.
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
        raise _UndecidedError(f"{len(sent)} bursts came whole: too few to tell the offset between the clocks")
    pulses = pulses_ns.reshape(-1)
    period_ns = float(np.diff(pulses[: max(2, count)]).min())
    base, zero = int(delay[0]), int(pulses_ns[0, 0])
    x, y = np.array(sent, dtype=np.float64) - zero, np.array(delay, dtype=np.float64) - base
    drift = 0.0
    if len(x) >= _DRIFT_BURSTS:
        slopes = np.asarray(scipy.stats.theilslopes(y, x), dtype=np.float64)
        low, high = slopes[2:]  # of the slopes that fit, the smallest
        drift = float(np.clip(np.clip(0.0, low, high), -_MAX_DRIFT, _MAX_DRIFT))
    elif _USUAL_DRIFT * float(np.ptp(pulses_ns)) > _EARLY * period_ns:
        raise _UndecidedError(f"{len(x)} bursts came whole: too few to tell how the clocks drift apart")
    rest = y - drift * x
    agreeing = np.abs(rest - np.median(rest)) < period_ns / 2
    quickest = rest < rest.min() + _PUNCTUAL * period_ns
    if 2 * agreeing.sum() < len(rest) or quickest.sum() < max(_AGREEING, len(rest) / 4):
        raise _UndecidedError("the delays of the bursts differ by more than a pulse period")
    common = pulses + float(base) + drift * (pulses - zero)
    spread = float(np.ptp(rest[agreeing]))  # by so much may the quickest frame of one burst beat that of another
    return common + rest.min() - spread, common + rest[agreeing].min()
