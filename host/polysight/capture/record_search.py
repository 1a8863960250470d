"""Find a row's record among its packets: its start, and the packets that belong to it.

The model and the errors of each decision: docs/spec/placement.md. Within a record all packets but the last are full, so
`byte count - full x sequence` is constant: the record's *line*. Packets of other records are on other lines, or on the
same line at other counts. The start is certain if the counters of earlier records leave one possibility, or if the
record's end proves it. Otherwise the record is not located.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from polysight.capture.dca1000 import Counters
from polysight.capture.earlier_records import CounterView, Past, full_payload, line_of
from polysight.capture.packet_log import PacketLog

Counts = NDArray[np.int64]
Flags = NDArray[np.bool_]
SMALL_RECORD = 16  # packets: a record of this size may be delayed as a whole
_NEAR = 64  # records
SWITCHED_ON = Counters(0, 1)  # of the first packet after a reset
_JOINS, _JOINS_SMALL = 1, 3  # consecutive doubtful records without a gap, after which the next one is trusted


@dataclass(frozen=True)
class Found:
    """The record among a row's packets; arrays are [packet]."""

    base: Counters | None  # of the record's first byte, a guess unless `certain`; None without any packet
    certain: bool  # the base is certain
    located: bool  # the place of every byte is certain
    reason: str  # why it is not located
    offsets: Counts  # int64, bytes from the base
    steps: Counts  # int64, packets from the base
    own: Flags  # on the record's line, from the base on, and of no earlier record
    early: Flags  # came before the row's first pulse
    old: Flags  # has counters of an earlier record
    full: int  # payload of a full packet
    excess: bool = False  # more came than the record has
    doubtful: bool = False  # complete, but possibly made of packets of an earlier record
    fresh: bool = False
    """It starts with the counters of a card just switched on, and nothing else came: the base is practically certain
    for a row with missed triggers, whose frames are placed by arrival times."""
    start_known: bool = False  # its start is known from earlier records
    clock_jumps: int = 0  # number of times the arrival clock went backwards; arrival times are then ignored
    restarted: bool = False  # the card may have restarted just before it, so its last packet is its end
    repeated: Flags | None = None  # has counters that came before and is not a known copy; None if no packet has


@dataclass(frozen=True)
class _Verdict:
    """Decision about the packets on one line; `base` relative to the reference, the rest as in `Found`."""

    base: int
    certain: bool
    located: bool
    reason: str = ""
    excess: bool = False
    doubtful: bool = False
    fresh: bool = False
    start_known: bool = False


def find_record(log: PacketLog, frame_bytes: int, past: Past, not_before_ns: int = 0) -> Found:
    """Find a row's record among its packets.

    Parameters
    ----------
    log
        The packets.
    frame_bytes
        Bytes of a frame; 1 if the record has none.
    past
        Knowledge from earlier records.
    not_before_ns
        Time before the first pulse of the row: packets that arrived earlier are left over.
    """
    full = full_payload(log)
    nothing = np.zeros(log.count, dtype=np.bool_)
    if log.count == 0:
        return Found(
            None, False, log.expected == 0, "no packet came", log.sizes, log.sizes, nothing, nothing, nothing, full
        )
    first = Counters(int(log.byte_counts[0]), int(log.sequences[0]))
    packets = CounterView(log, past.base or first, full)
    early, jumps = _before_pulses(log, not_before_ns)
    old = packets.inside(past.spans, sure=True)
    if past.base is not None and len(past.ends) == 1:
        old |= (packets.line == line_of(past.ends[0], full)) & (packets.ahead < past.ends[0])
    repeated = packets.came_before(past.spans) & ~early
    live = ~(early | old)
    sorted_out = Found(None, False, False, "", packets.ahead, packets.steps, nothing, early, old, full,
                       clock_jumps=jumps)  # fmt: skip
    found = _found(packets, live, log.expected, frame_bytes, past, sorted_out) if live.any() else None
    if repeated.any() and (found is None or not _ends_as_expected(found, log)):
        # Repeated counters in a row without its end: late copies, or the card has restarted.
        if found is not None and found.located:
            why = "packets repeat earlier counters, and the record's end is missing: the card may have restarted"
            return replace(found, located=False, certain=False, reason=why, restarted=True, repeated=repeated)
        unknown = Past(spans=past.spans, joint=past.joint, joined=past.joined, unseen=True, anew=past.anew)
        packets = CounterView(log, Counters(int(log.byte_counts[repeated][0]), int(log.sequences[repeated][0])), full)
        sorted_out = replace(sorted_out, old=old & ~repeated, repeated=repeated)
        found = _found(packets, live | repeated, log.expected, frame_bytes, unknown, sorted_out)
    if found is None:
        why = "every packet is of an earlier record, by its counters or by its arrival before the first pulse"
        return replace(sorted_out, reason=why)
    return found


def _found(packets: CounterView, live: Flags, expected: int, frame_bytes: int, past: Past, sorted_out: Found) -> Found:
    """Find the record among the `live` packets; `sorted_out` classifies the others."""
    line, v = _Search(packets, live, expected, frame_bytes, past).best()
    offsets, steps = packets.ahead - v.base, packets.steps - (v.base - line) // packets.full
    own = live & (packets.line == line) & (offsets >= 0)
    found = replace(
        sorted_out, base=packets.at(v.base, line), certain=v.certain, located=v.located, reason=v.reason,
        offsets=offsets, steps=steps, own=own, excess=v.excess, doubtful=v.doubtful, fresh=v.fresh,
        start_known=v.start_known,
    )  # fmt: skip
    if v.located and (why := _rival(packets, found, live & ~own, expected)):
        return replace(found, located=False, certain=False, reason=why)
    return found


def _rival(packets: CounterView, found: Found, rest: Flags, expected: int) -> str:
    """Return why other packets may be the row's record instead; "" if they may not.

    The host has started one record, so the card's last one is the row's, unless the card started another by itself.
    """
    if later_packets(found, rest, expected, expected).any():
        return "packets of two consecutive records came: it is unknown which is the row's"
    before = (found.offsets < 0) & (found.steps < 0)
    if _many(packets, rest & ~before, expected) or (not found.start_known and _many(packets, rest & before, expected)):
        return "half of another record came with it: it is unknown which is the row's"
    return ""


def _many(packets: CounterView, which: Flags | Counts, expected: int) -> bool:
    """True if these packets have half of a record's bytes: networks do not delay so many."""
    _, one = np.unique(packets.ahead[which], return_index=True)
    return 2 * int(packets.sizes[which][one].sum()) >= expected > 0


def later_packets(found: Found, rest: Flags, stop: int, expected: int) -> Flags:
    """Select the packets with counters not far behind a record that ended at `stop`."""
    behind = (found.offsets >= stop) & (found.offsets < stop + 2 * expected + found.full)
    counted = (found.steps > 0) & (found.steps * found.full < stop + 4 * expected + 4 * found.full)
    return rest & behind & counted


def _ends_as_expected(found: Found, log: PacketLog) -> bool:
    """True if the last byte came of a located record whose start was known from earlier records."""
    return found.located and found.start_known and int((found.offsets + log.sizes)[found.own].max()) == log.expected


class _Search:
    """Decides about each line of a row's packets, and chooses the record's."""

    def __init__(self, packets: CounterView, live: Flags, expected: int, frame_bytes: int, past: Past) -> None:
        self._p, self._live, self._expected, self._frame, self._past = packets, live, expected, frame_bytes, past
        self._unsure = live & packets.inside(past.spans, sure=False) if past.spans else np.zeros_like(live)
        ends = np.array(past.ends if past.base is not None else (), dtype=np.int64)
        self._ends, self._end_lines = ends, ends - packets.full * -(-ends // packets.full)

    def best(self) -> tuple[int, _Verdict]:
        """Return the record's line and the decision about it.

        Preferred is a line on which the record is expected to start, if it is located; otherwise that with most bytes.
        """
        p, live = self._p, np.flatnonzero(self._live)
        lines, group = np.unique(p.line[live], return_inverse=True)
        order = np.lexsort((p.ahead[live], group))
        new = np.ones(len(order), dtype=np.bool_)
        new[1:] = (np.diff(group[order]) != 0) | (np.diff(p.ahead[live][order]) != 0)
        weight = np.bincount(group[order], weights=p.sizes[live][order] * new, minlength=len(lines))
        furthest = np.full(len(lines), -(1 << 62), dtype=np.int64)
        np.maximum.at(furthest, group, p.ahead[live])
        by_weight = np.lexsort((furthest, weight))[::-1]
        start_known = [int(k) for k in by_weight if np.isin(lines[k], self._end_lines)]
        for k in start_known:
            verdict = self._judge(live[group == k], int(lines[k]))
            if verdict.located:
                return int(lines[k]), verdict
        k = int(by_weight[0])
        return int(lines[k]), self._judge(live[group == k], int(lines[k]))

    def _judge(self, which: Counts, line: int) -> _Verdict:
        """Decide about the packets on one line."""
        p, bases = self._p, self._ends[self._end_lines == line]
        first, last = int(p.ahead[which].min()), int(p.ahead[which].max())
        last_size = int(p.sizes[which][p.ahead[which] == last].max())
        stop, short = last + last_size, last_size < p.full
        if bases.size:
            verdict = replace(self._from_past(bases, first, stop, short), start_known=True)
        else:
            inside = p.ahead[which] >= stop - self._expected  # none if a packet is longer than the row
            verdict = self._from_itself(int(p.ahead[which][inside].min(initial=last)), first, stop, last_size)
            if verdict.located and self._ended_within(which, stop):
                why = "a record ended within it: the card may have restarted"
                verdict = replace(verdict, located=False, certain=False, reason=why)
            if verdict.located and self._before_switched_on(verdict.base, first, line):
                why = "its first bytes would be older than the card's counters: the card restarted within it"
                verdict = replace(verdict, located=False, certain=False, reason=why)
            if verdict.located and p.at(first, line) == SWITCHED_ON and self._ends_first(which):
                why = "its end came before its beginning, which has a card's first counters: it restarted within it"
                verdict = replace(verdict, located=False, certain=False, reason=why)
            if verdict.located and not self._much(which):
                why = "too little of it came to distinguish it from the end of an earlier record"
                verdict = replace(verdict, located=False, certain=False, reason=why)
            alone = which.size == self._live.sum() and not self._past.spans and p.at(first, line) == Counters(0, 1)
            if alone and not verdict.located and not verdict.excess:
                why = self._too_short(first, stop, short).reason or "its last bytes are missing"
                verdict = replace(verdict, reason=f"{why}; the card's counters had just begun", fresh=True)
        start = p.at(verdict.base, line)
        unsure = not bases.size or self._past.guessed
        strange = (unsure and self._past.unseen) or (not bases.size and self._is_behind(verdict.base))
        # With full packets only, a late packet at the head and a lost one at the end add up to the row's length.
        by_length = not bases.size and not short and bool(self._past.spans)
        unclear = self._unclear(which, strange) or self._unclear(which[self._unsure[which]], True)
        if verdict.located and (by_length or unclear):
            verdict = replace(verdict, doubtful=True)
        if verdict.doubtful:
            enough = _JOINS if self._expected >= SMALL_RECORD * p.full else _JOINS_SMALL
            joins = self._past.joint == start and self._past.joined >= enough
            if not joins and not (start == SWITCHED_ON and self._past.anew >= enough):
                why = "its packets may be late packets of an earlier record"
                return replace(verdict, located=False, certain=False, reason=why)
        return verdict

    def _ended_within(self, which: Counts, stop: int) -> bool:
        """True if a short packet is before the last: only the last of a record is short."""
        sizes = self._p.sizes[which]
        return bool(((sizes < self._p.full) & (self._p.ahead[which] + sizes < stop)).any())

    def _ends_first(self, which: Counts) -> bool:
        """True if the packets that came first belong behind all later ones."""
        ahead = self._p.ahead[which]
        first = int(np.argmin(ahead))
        return first > 0 and int(ahead[first:].max()) < int(ahead[:first].min())

    def _before_switched_on(self, base: int, first: int, line: int) -> bool:
        """True if a record from `base` on would begin before sequence 1 and byte 0, where counters start."""
        at, lost = self._p.at(first, line), first - base
        return at.byte_count < lost and at.sequence <= lost // self._p.full

    def _unclear(self, which: Counts, suspect: bool) -> bool:
        """True if suspect packets may be an earlier record's; half of a record that is not small cannot."""
        big = self._expected >= SMALL_RECORD * self._p.full
        return suspect and which.size > 0 and not (big and self._much(which))

    def _is_behind(self, base: int) -> bool:
        """True if a record with this base was sent not long before the expected start of this one."""
        near = -_NEAR * (self._expected + self._p.full)
        return bool(self._ends.size) and near < base < int(self._ends.min())

    def _much(self, which: Counts) -> bool:
        return _many(self._p, which, self._expected)

    def _from_past(self, bases: Counts, first: int, stop: int, short: bool) -> _Verdict:
        """Decide for a record that starts at one of these bases."""
        e = self._expected
        possible = bases[(stop <= bases + e) & (bases <= first)]
        if not possible.size:
            base = int(bases[bases <= first].max(initial=-1)) if (bases <= first).any() else int(bases.min())
            more = stop - base - e
            if more > 0:
                why = f"{more} bytes more than the row has: the radar saw spurious triggers"
                return _Verdict(base, False, False, why, excess=True)
            return _Verdict(first, False, False, "packets precede the expected start of the record")
        if possible.size > 1:
            base = int(possible.max())
            if not (short and stop in possible + e):
                return _Verdict(base, False, False, "the record has more than one possible start")
            possible = possible[possible + e == stop]
        if int(possible[0]) + e == stop:
            return _Verdict(int(possible[0]), True, True)
        return self._too_short(int(possible[0]), stop, short)

    def _too_short(self, base: int, stop: int, short: bool) -> _Verdict:
        """Decide for a record with a certain start whose last bytes are missing."""
        missing = base + self._expected - stop
        frames = f" ({missing // self._frame} frames)" if missing % self._frame == 0 and self._frame > 1 else ""
        if short:
            why = (
                f"the record ended {missing} bytes{frames} early: missed SYNC_IN pulses, or the card dropped data"
                " before numbering it"
            )
            return _Verdict(base, True, False, why)
        if missing >= self._frame > 1:
            why = f"the last {missing} bytes are missing, and perhaps frames before them"
            return _Verdict(base, True, False, why)
        return _Verdict(base, True, True)

    def _from_itself(self, first_inside: int, first: int, stop: int, last_size: int) -> _Verdict:
        """Decide for a record with an unknown start, which only its end can prove."""
        e, full = self._expected, self._p.full
        base = stop - e
        lost = first_inside - base
        if last_size < full and (e - last_size) % full == 0:
            if lost % self._frame or self._frame == 1 or lost == 0:
                return _Verdict(base, True, True)
        elif last_size == full and e % full == 0 and stop - first == e:
            return _Verdict(base, True, True)
        if stop - first > e:
            return _Verdict(
                first, False, False, f"{stop - first - e} bytes more than the row has, and its start is unknown",
                excess=True,
            )  # fmt: skip
        why = f"{e - (stop - first)} bytes short, and the start of the record is unknown"
        return _Verdict(first, False, False, why)


def _before_pulses(log: PacketLog, not_before_ns: int) -> tuple[Flags, int]:
    """Select packets that arrived before the first pulse, and count backward jumps of the arrival clock.

    If the clock jumps, no packet is selected.
    """
    jumps = int((np.diff(log.batches[:, 0]) < 0).sum())
    early = log.arrivals_ns < not_before_ns
    return (np.zeros_like(early) if jumps else early), jumps
