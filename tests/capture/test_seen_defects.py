"""Rows that were once placed wrongly: a late packet, a full last packet, counters that restart."""

from __future__ import annotations

import numpy as np
import pytest
from tests.support.capture.records import FULL, Record, is_original_or_masked, log_of, place

from polysight.capture.placement import place_record
from polysight.capture.record_search import Past

FRAME = 4096
FULL_ENDS = 91 * 16 * FRAME  # 91 columns of 16 pulses: 4096 full packets
DEFAULT = 350 * 16 * FRAME


def records(size: int, count: int, first: int = 0, sequence: int = 1) -> list[Record]:
    """Records of one card, one after another."""
    made, at = [], first
    for seed in range(count):
        made.append(Record.make(size, at, sequence, seed))
        at, sequence = at + size, sequence + len(made[-1].packets)
    return made


@pytest.mark.parametrize("lost", [1, 3, 40])
@pytest.mark.parametrize("late", [1, 3])
def test_a_late_packet_before_a_row_without_its_last_moves_nothing(lost, late):
    """91 columns: row 0 loses its last packets, one of them comes with row 1, whose last packet is lost."""
    zero, one = records(FULL_ENDS, 2)
    placed, out = place(FULL_ENDS, zero.packets[:-lost], frame=FRAME)
    assert is_original_or_masked(zero, placed, out)
    placed, out = place(FULL_ENDS, [*zero.packets[-late:], *one.packets[:-1]], placed.past, FRAME)
    assert is_original_or_masked(one, placed, out)


@pytest.mark.parametrize("size", [FULL_ENDS, 160 * FRAME])
def test_after_one_bad_take_the_next_perfect_one_is_accepted(size):
    """The last three packets are lost; then takes arrive perfectly."""
    first, second, third = records(size, 3)
    before, _ = place(size, first.packets, None, FRAME)
    bad, _ = place(size, second.packets[:-3], before.past, FRAME)
    assert not bad.complete
    good, out = place(size, third.packets, bad.past, FRAME)
    assert good.complete
    assert out.tobytes() == third.data


def test_rows_that_lose_their_last_three_packets_each_are_masked_and_not_moved():
    """As with --keep-incomplete."""
    past = Past()
    for record in records(FULL_ENDS, 4):
        placed, out = place(FULL_ENDS, record.packets[:-3], past, FRAME)
        assert is_original_or_masked(record, placed, out)
        past = placed.past


@pytest.mark.parametrize("known", [True, False])
def test_a_full_and_a_short_late_packet_before_a_perfect_row_are_left_over(known):
    zero, one = records(DEFAULT, 2, first=70_000, sequence=9)
    before, _ = place(DEFAULT, zero.packets[:-2], None, FRAME, batch=256)
    late = [*zero.packets[-2:], *one.packets]
    placed, out = place(DEFAULT, late, before.past if known else None, FRAME, batch=256)
    assert placed.complete
    assert out.tobytes() == one.data
    assert placed.counts.leftover == 2


@pytest.mark.parametrize("size", [FULL_ENDS, DEFAULT])
@pytest.mark.parametrize("before", [1, 2, 5])
@pytest.mark.parametrize("lost", [0, 100, FULL, 2 * FULL])
def test_a_restart_in_the_first_packets_gives_no_wrong_byte(size, before, lost):
    zero, one = records(size, 2, first=70_000, sequence=9)
    past = place(size, zero.packets, None, FRAME, batch=256)[0].past
    rest = Record.make(size - before * FULL - lost, 0, 1)
    data = one.data[before * FULL + lost :]
    fresh = [packet[:10] + data[k * FULL : (k + 1) * FULL] for k, packet in enumerate(rest.packets)]
    placed, out = place(size, [*one.packets[:before], *fresh], past, FRAME, batch=256)
    assert is_original_or_masked(one, placed, out)
    assert placed.counts.placed + placed.counts.restarted + placed.counts.outside > 0


def test_overlapping_payload_is_compared():
    """A second network path brings one packet with other bytes: both are masked, and counted under their own name."""
    record = Record.make(20 * FULL + 100, 0, 1)
    other = bytearray(record.packets[7])
    other[500] ^= 1
    packets = [*record.packets, bytes(other), record.packets[9]]
    before = Record.make(5000, 2**48 - 5000, 2**32 - 3)
    past = place(5000, before.packets, None, 1000)[0].past
    placed, out = place_record(log_of(len(record.data), packets), FRAME, past)
    assert placed.missing == [(7 * FULL, 8 * FULL)]
    assert (placed.counts.conflicting, placed.counts.duplicates) == (1, 1)
    assert is_original_or_masked(record, placed, out)


def test_packets_before_the_first_pulse_are_left_over():
    """An earlier program's last packets, of which nothing is known: only the time tells."""
    zero, one = records(FULL_ENDS, 2)
    log = log_of(FULL_ENDS, [], t_ns=1)
    for k, packet in enumerate([*zero.packets[-2:], *one.packets[:-2]]):
        log.add(np.frombuffer(packet, dtype=np.uint8)[None, :], np.array([len(packet)]), 100 + k)
    placed, out = place_record(log, FRAME, not_before_ns=102)
    assert (placed.counts.before_pulses, placed.counts.leftover) == (2, 2)
    assert is_original_or_masked(one, placed, out)


def test_a_short_packet_before_the_last_one_proves_no_start():
    """The card begins anew behind three packets, and by chance they count on where the new counters end."""
    size, missed = 40 * FULL, FRAME
    row = Record.make(size - missed, 0, 1)
    behind = Record.make(size, 37 * FULL, 38)
    head = [packet[:10] + row.data[k * FULL : (k + 1) * FULL] for k, packet in enumerate(behind.packets[:3])]
    rest = Record.make(size - missed - 3 * FULL, 0, 1)
    anew = [p[:10] + row.data[(3 + k) * FULL : (4 + k) * FULL] for k, p in enumerate(rest.packets)]
    log = log_of(size, [*head, *anew])
    placed, _ = place_record(log, FRAME)
    assert not placed.located
    assert placed.missing == [(0, size)]


def test_one_short_packet_many_times_is_no_full_one():
    """Of a row of two packets the last one came, five times: its head is missing, no more."""
    zero, one = records(FULL + 80, 2, first=0, sequence=1)
    past = place(FULL + 80, zero.packets, None, 128)[0].past
    placed, out = place(FULL + 80, [one.packets[1]] * 5, past, 128)
    assert placed.located
    assert placed.missing == [(0, FULL)]
    assert is_original_or_masked(one, placed, out)


def test_a_late_head_and_a_lost_end_are_not_a_row():
    """Rows of full packets: the last packet of a row not located comes in the next one, which loses its own."""
    rows = records(FULL_ENDS, 4, first=70_000, sequence=9)
    past = place(FULL_ENDS, rows[0].packets, None, FRAME, batch=256)[0].past
    strange = Record.make(FULL_ENDS, 5_000_000, 40_000)
    past = place(FULL_ENDS, strange.packets[:-40], past, FRAME, batch=256)[0].past
    after = Record.make(FULL_ENDS, 5_000_000 + FULL_ENDS, 40_000 + FULL_ENDS // FULL)
    placed, out = place(FULL_ENDS, [strange.packets[-1], *after.packets[:-1]], past, FRAME, batch=256)
    assert is_original_or_masked(after, placed, out)
