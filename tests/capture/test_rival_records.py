"""More than one record among a row's packets, and cards that restart near their former start."""

from __future__ import annotations

import pytest
from tests.support.capture.records import FULL, Card, Record, is_original_or_masked, past_after, place

from polysight.capture.record_search import Past

FRAME = 4096
FULL_ENDS = 91 * FRAME
SHORT_END = 62 * FRAME
MAX_REFUSED = 8  # perfect records in a row, after anything that may have happened (docs/spec/placement.md)


def rows_until_accepted(card: Card, size: int, past: Past) -> int:
    """Perfect rows that are refused before one is accepted; none may be wrong."""
    for refused in range(MAX_REFUSED + 1):
        record = card.record()
        placed, out = place(size, record.packets, past, FRAME, batch=64)
        assert is_original_or_masked(record, placed, out)
        if placed.complete:
            return refused
        past = placed.past
    return MAX_REFUSED + 1


@pytest.mark.parametrize("size", [FULL_ENDS, SHORT_END])
@pytest.mark.parametrize("resets", [(0, 1), (0, 2), (0, 3), (-1,), (-2,), (0, -1)])
def test_a_card_that_restarts_soon_after_power_up_is_accepted_again(size, resets):
    """Its counters are those of records that came whole: they are no leftovers, and no perfect row is lost for ever."""
    card, many = Card(size), -(-size // FULL)
    past = past_after(card.record(), FRAME)
    disturbed = card.record(tuple(k % many for k in resets))
    placed, out = place(size, disturbed.packets, past, FRAME, batch=64)
    assert is_original_or_masked(disturbed, placed, out)
    assert rows_until_accepted(card, size, placed.past) <= MAX_REFUSED


@pytest.mark.parametrize("size", [FULL_ENDS, SHORT_END])
def test_a_card_that_restarts_with_every_record_is_accepted(size):
    card = Card(size)
    past = past_after(card.record(), FRAME)
    accepted = []
    for _ in range(8):
        card.reset()
        record = card.record()
        placed, out = place(size, record.packets, past, FRAME, batch=64)
        assert is_original_or_masked(record, placed, out)
        accepted.append(placed.complete)
        past = placed.past
    assert all(accepted[2:])


@pytest.mark.parametrize("lost", [(), (0,), (-1,)])
def test_two_whole_records_in_a_first_row_decide_nothing(lost):
    card = Card(SHORT_END, 5000, 5)
    own, other = card.record(), card.record()
    kept = [p for k, p in enumerate(own.packets) if k not in [i % len(own.packets) for i in lost]]
    placed, out = place(SHORT_END, [*kept, *other.packets], None, FRAME, batch=64)
    assert is_original_or_masked(own, placed, out)


@pytest.mark.parametrize("came", [0.5, 0.8])
def test_a_silent_row_that_comes_with_the_next_one_is_not_taken_for_it(came):
    card = Card(SHORT_END)
    past = past_after(card.record(), FRAME)
    late = card.record()
    past = place(SHORT_END, [], past, FRAME)[0].past
    own = card.record()
    kept = [p for k, p in enumerate(own.packets) if k % 10 < 10 * came]
    placed, out = place(SHORT_END, [*late.packets, *kept], past, FRAME, batch=64)
    assert is_original_or_masked(own, placed, out)


@pytest.mark.parametrize("tail", [4, 60, 175])
def test_the_end_of_an_unseen_record_is_not_taken_for_a_row(tail):
    card = Card(SHORT_END)
    past = past_after(card.record(), FRAME)
    unseen, own = card.record(), card.record()
    placed, out = place(SHORT_END, [*unseen.packets[-tail:], *own.packets], past, FRAME, batch=64)
    assert is_original_or_masked(own, placed, out)


def test_frames_too_many_before_a_small_row_decide_nothing():
    size = 7 * FRAME
    more = Record.make((7 + 91) * FRAME, 70_000, 9)
    placed, out = place(size, more.packets, None, FRAME, batch=64)
    assert is_original_or_masked(Record(more.data[:size], more.packets), placed, out)


def test_one_packet_longer_than_the_row():
    record = Record.make(1024, 0, 1)
    placed, _ = place(768, record.packets, None, 256)
    assert not placed.located


def test_a_record_does_not_begin_before_the_card_was_switched_on():
    """Counters from sequence 1 on, and an end that would put 23 packets before them: the card began anew in the row."""
    size = 30 * FRAME
    placed, _ = place(size, Record.make(size - 23 * FULL, 0, 1).packets, None, FRAME, batch=64)
    assert not placed.located
    later = Record.make(size - 23 * FULL, 50_000, 24)  # a card that ran before may have sent them
    assert place(size, later.packets, None, FRAME, batch=64)[0].losses.head_bytes == 23 * FULL


def test_two_resets_alike_are_not_one_record_in_another_order():
    """Full packets alone: the last counters, a reset, then the first ones look like one record to a host just begun."""
    card = Card(FULL_ENDS)
    card.record((4,))
    row = card.record((4,))
    placed, out = place(FULL_ENDS, row.packets, None, FRAME, batch=64)
    assert is_original_or_masked(row, placed, out)
