"""Count a row's packets by result: placed, duplicate, left over and so on; every packet is counted once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polysight.capture.dca1000 import Counters
from polysight.capture.earlier_records import CounterView, Past, line_of
from polysight.capture.packet_log import PacketLog
from polysight.capture.record_search import Found

Flags = NDArray[np.bool_]


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
