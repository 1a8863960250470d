"""What became of a row's packets, by name: every packet is counted once, and every anomaly under its own name."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polysight.host.capture.dca1000 import Counters
from polysight.host.capture.earlier_records import CounterView, Past, line_of
from polysight.host.capture.packet_log import PacketLog
from polysight.host.capture.record_search import Found

Flags = NDArray[np.bool_]


@dataclass
class PacketCounts:
    """Packets of one row by what became of them: every packet is in exactly one of the first eight.

    The others say more about some of them.
    """

    placed: int = 0
    duplicates: int = 0  # every byte was there already, and the same
    conflicting: int = 0  # other bytes than another packet of the same counters: both are masked where they overlap
    leftover: int = 0  # of a record before this one
    restarted: int = 0  # came after the card began anew within the row: its counters fell back to their beginning
    outside: int = 0  # after the record's last expected byte, or not kept for want of memory
    disagreeing: int = 0  # byte count and sequence contradict each other
    malformed: int = 0  # no payload, or longer than the card's packets
    late: int = 0  # placed, after a packet that follows it
    late_by_bytes: int = 0  # how far the latest of them was behind
    short: int = 0  # placed, not full; a healthy record has one at most, its last
    before_pulses: int = 0  # leftover, known by having come before the row's first pulse
    clock_jumps: int = 0  # times at which the clock of the arrivals went backwards


def count_packets(
    log: PacketLog, found: Found, past: Past, placed: Flags, duplicate: Flags, conflicting: Flags
) -> PacketCounts:
    """Count a row's packets by what became of them. `placed`, `duplicate`, `conflicting`: bool [packet], disjoint.

    Of a row in which the card began anew, those before are `placed` and those after `restarted`, whichever of them the
    search took for the record: nothing of such a row is believed, unless its start was foretold.
    """
    before, anew = _restart(log, found, past, conflicting)
    placed, duplicate = (placed | before) & ~anew, duplicate & ~anew & ~before
    conflicting = conflicting & ~anew & ~before
    left = (found.early | found.old) & ~(anew | before)
    rest = ~(placed | duplicate | conflicting | left | anew)
    beyond = (found.offsets >= log.expected) & (found.steps > 0) & (found.offsets < 2 * log.expected)
    outside = rest & (found.own | beyond)  # behind the row's last byte, or not kept
    left |= rest & ~outside & (found.offsets < 0) & (found.steps < 0)
    return PacketCounts(
        placed=int(placed.sum()),
        duplicates=int(duplicate.sum()),
        conflicting=int(conflicting.sum()),
        leftover=int(left.sum()),
        restarted=int(anew.sum()),
        outside=int(outside.sum()),
        disagreeing=int((rest & ~outside & ~left).sum()),
        malformed=log.malformed,
        before_pulses=int((found.early & left).sum()),
        clock_jumps=found.clock_jumps,
    )


def _restart(log: PacketLog, found: Found, past: Past, conflicting: Flags) -> tuple[Flags, Flags]:
    """Packets of the row before and after the card began anew within it, bool [packet] each; all false if it did not.

    After a reset the first packet has sequence 1 and byte count 0. Such counters say nothing of a row that begins with
    them, so they must come behind other packets of the row, or behind their likes with other bytes.
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
    again = found.again if found.again is not None else nothing
    switched_on &= again | ~packets.inside(past.spans, sure=True)  # else left over of a record that is remembered
    if found.located:
        return nothing, switched_on & ~found.own & (index > np.argmax(found.own))
    before = _before_restart(packets, past, ~(found.early | found.old | again | switched_on), log.expected)
    anew = (again | switched_on) & (index > np.argmax(before)) & before.any()
    return (before, anew) if anew.any() else (nothing, nothing)


def _before_restart(packets: CounterView, past: Past, live: Flags, expected: int) -> Flags:
    """Which packets are the row's by all that was known before: where it was to start, else most of them together."""
    if past.base is None:
        lines, many = np.unique(packets.line[live], return_counts=True)
        return live & np.isin(packets.line, lines[(many == many.max(initial=0)) & (many > 1)][:1])
    foretold = np.zeros(live.size, dtype=np.bool_)
    for end in past.ends:
        inside = (packets.ahead >= end) & (packets.ahead < end + expected)
        foretold |= live & inside & (packets.line == line_of(end, packets.full))
    return foretold
