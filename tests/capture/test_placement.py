"""Placement of packets in a row by the card's counters: bytes are as sent or masked, and only lost bytes are masked.

A *record* is what a card sends of one row. The counters in a packet are the number of bytes before it and the packet's
sequence number. A row is *located* if the place of every byte is certain; otherwise all of it is masked.
"""

import math
import random
import sys
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings, strategies as st
from tests.support.capture.records import (
    FULL,
    HEADER_BYTES,
    Card,
    Record,
    encode_packet,
    encode_packets,
    find_next_start,
    is_original_or_masked,
    make_log,
    make_mask,
    place,
)

from polysight.capture.dca1000 import Counters, PacketLog
from polysight.capture.placement import EarlierRecords, Evidence, Losses, PacketCounts, PlacedRecord, place_record
from polysight.capture.row_files import read_packets, write_packets

# Bytes of a frame
FRAME = 4096
# A busy machine is not a fault.
SLOW = [HealthCheck.too_slow]
# Numbers of values of a byte count (48 bits) and of a sequence number (32 bits); after the largest they begin at 0.
# The last branch of each strategy draws counters that begin again within some 30 full packets.
COUNT = 1 << 48
SEQUENCE = 1 << 32
near_wrap = st.one_of(st.just(0), st.integers(0, COUNT - 1), st.integers(COUNT - 40_000, COUNT - 1))
near_sequence_wrap = st.one_of(st.integers(0, SEQUENCE - 1), st.integers(SEQUENCE - 30, SEQUENCE - 1))


@settings(max_examples=150, deadline=None, suppress_health_check=SLOW)
@given(
    frame=st.sampled_from([128, 512, 4096, 65536]),
    frames=st.integers(1, 12),
    count=near_wrap,
    sequence=near_sequence_wrap,
    batch=st.integers(1, 40),
    rng=st.randoms(use_true_random=True),
    rate=st.sampled_from([0.0, 0.02, 0.05, 0.3]),
)
def test_of_disordered_packets_exactly_the_lost_are_masked(
    frame, frames, count, sequence, batch, rng: random.Random, rate
):
    """The start of the record is known. `rate` is the share of packets that are lost, doubled or displaced."""
    record = Record.make(frame * frames, count, sequence)
    sent = [(k, packet) for k, packet in enumerate(record.packets) if rng.random() >= rate]
    sent += [numbered for numbered in sent if rng.random() < rate]

    def draw_place(numbered: tuple[int, bytes]) -> int:
        """Draw when a packet comes: at its place, or up to three places before or after it."""
        number, _ = numbered
        if rng.random() < rate:
            return number + rng.randint(-3, 3)
        return number

    order = sorted(sent, key=draw_place)
    placed, out = place(len(record.data), [packet for _, packet in order], Counters(count, sequence), frame, batch)
    assert is_original_or_masked(record, placed, out)
    received = {k for k, _ in sent}
    lost = [k for k in range(len(record.packets)) if k not in received]
    lost_bytes = make_mask(out.size, [record.byte_range(k) for k in lost])
    assert placed.received == (~lost_bytes).sum()
    assert placed.counts.placed == len(received)
    assert placed.counts.duplicates == len(sent) - len(received)
    assert placed.counts.outside == 0
    assert placed.counts.disagreeing == 0
    assert placed.counts.malformed == 0
    mask = make_mask(out.size, placed.missing)
    assert mask[lost_bytes].all()
    # If the last packet came, the length of the record is known.
    last_packet = len(record.packets) - 1
    if last_packet in received:
        assert placed.located
    if placed.located:
        assert (mask == lost_bytes).all()
        assert not out[mask].any()
    else:
        assert mask.all()
    next_start = find_next_start(placed)
    if placed.located and next_start is not None:
        assert next_start.byte_count == (count + len(record.data)) % COUNT
        assert next_start.sequence == (sequence + len(record.packets)) % SEQUENCE


@dataclass
class Oracle:
    """Expected result for packets of a record whose start is known, byte by byte."""

    size: int
    placed: int = 0
    duplicates: int = 0
    # Packets that came after one from further back in the record.
    late: int = 0
    # End of the packet that is furthest back in the record.
    extent: int = 0

    def __post_init__(self) -> None:
        self.received = np.zeros(self.size, dtype=bool)

    def count_packet(self, start: int, stop: int) -> None:
        """Count a packet with these bytes of the record."""
        if self.received[start:stop].all():
            self.duplicates += 1
            return
        self.placed += 1
        self.late += start < self.extent
        self.received[start:stop] = True
        self.extent = max(self.extent, stop)


# What stands for the number of a packet that is not of the record: one of the record before, and a malformed one.
LEFTOVER = -1
MALFORMED = -2
# No byte at all, a header without payload, and more than a full packet: by one byte, and by many.
MALFORMED_PACKETS = [b"", b"0123456789", bytes(HEADER_BYTES + FULL + 1), bytes(1536)]


def sum_counts(c: PacketCounts) -> int:
    """Return the number of packets of a row whose card has not restarted, by the counts of their kinds."""
    return c.placed + c.duplicates + c.conflicting + c.leftover + c.outside + c.disagreeing + c.malformed


@settings(max_examples=200, deadline=None, suppress_health_check=SLOW)
@given(
    frame=st.integers(32, 16384).map(lambda words: 4 * words),
    packets=st.integers(8, 120),
    count=near_wrap,
    sequence=near_sequence_wrap,
    batch=st.integers(1, 64),
    rng=st.randoms(use_true_random=True),
    loss=st.floats(0, 0.05),
    double=st.floats(0, 0.05),
    shuffle=st.floats(0, 0.05),
    lateness=st.integers(1, 60),
    cut=st.floats(0, 0.05),
    strange=st.floats(0, 0.05),
)
def test_unmasked_bytes_are_right_with_every_disorder_together(
    frame, packets, count, sequence, batch, rng: random.Random, loss, double, shuffle, lateness, cut, strange
):
    """Loss, duplicates, reordering, late and truncated packets, leftovers and nonsense, each up to 5 %."""
    size = max(1, packets * FULL // frame) * frame
    record = Record.make(size, count, sequence)

    # Time of arrival, number, and bytes of each packet.
    sent: list[tuple[float, int, bytes]] = []
    for k, packet in enumerate(record.packets):
        if rng.random() < loss:
            continue
        copies = 2 if rng.random() < double else 1
        for copy in range(copies):
            is_cut = rng.random() < cut and len(packet) > 20
            delay = rng.uniform(0, lateness) if rng.random() < shuffle else 0
            sent_packet = packet[: rng.randint(HEADER_BYTES + 1, len(packet))] if is_cut else packet
            sent.append((k + delay + copy / 2, k, sent_packet))
    sent.sort(key=lambda s: s[0])
    arriving = [(k, packet) for _, k, packet in sent]

    # Other packets come anywhere but at the begin.
    for position in range(len(arriving), 1, -1):
        if rng.random() < strange:
            distance = rng.randint(1, 5)
            leftover = encode_packet(sequence - distance, count - distance * FULL, bytes([0xEE]) * FULL)
            arriving.insert(position, (LEFTOVER, leftover))
        if rng.random() < strange:
            arriving.insert(position, (MALFORMED, rng.choice(MALFORMED_PACKETS)))
    numbers = [number for number, _ in arriving]

    oracle = Oracle(size)
    for k, packet in arriving:
        if k >= 0:
            oracle.count_packet(k * FULL, k * FULL + len(packet) - HEADER_BYTES)
    placed, out = place(size, [p for _, p in arriving], Counters(count, sequence), frame, batch)
    counts = placed.counts
    assert is_original_or_masked(record, placed, out)
    assert sum_counts(counts) == len(arriving)
    assert counts.malformed == numbers.count(MALFORMED)
    # The expectation holds if the first packet is the record's first or a full one: a shorter one may be the last of
    # the record before.
    first_is_of_the_record = False
    if arriving:
        first_number, first_packet = arriving[0]
        first_is_of_the_record = first_number == 0 or len(first_packet) == HEADER_BYTES + FULL
    if first_is_of_the_record and not counts.disagreeing:
        assert (counts.placed, counts.duplicates, counts.late) == (oracle.placed, oracle.duplicates, oracle.late)
        assert counts.leftover == numbers.count(LEFTOVER)
        assert counts.outside == 0
        assert placed.received == oracle.received.sum()
        losses = placed.losses
        assert losses.head_bytes + losses.gap_bytes + losses.tail_bytes == size - placed.received
        assert losses.tail_bytes == size - oracle.extent
        if placed.located:
            assert (make_mask(size, placed.missing) == ~oracle.received).all()
            assert not out[~oracle.received].any()


@settings(max_examples=60, deadline=None, suppress_health_check=SLOW)
@given(
    frames=st.integers(1, 8),
    frame=st.sampled_from([128, 4096, 65536]),
    records=st.integers(2, 5),
    count=near_wrap,
    sequence=near_sequence_wrap,
    skip=st.integers(0, 3),
    rng=st.randoms(use_true_random=True),
)
def test_records_are_found_although_sequence_and_byte_count_drift_apart(
    frames, frame, records, count, sequence, skip, rng: random.Random
):
    """Each record ends with a short packet, so that the byte count is not a multiple of the sequence number.

    Up to `skip` packets at the beginning of a record are lost, but less than half of it.
    """
    start = EarlierRecords(Counters(count, sequence))
    for n in range(records):
        record = Record.make(frames * frame, count, sequence, seed=n)
        lost_packets = 0
        if len(record.packets) > 2 * skip + 2:
            lost_packets = rng.randint(0, skip)
        placed, out = place(len(record.data), record.packets[lost_packets:], start, frame)
        assert placed.located
        assert placed.missing == list_head_gap(lost_packets * FULL)
        assert placed.losses.head_bytes == lost_packets * FULL
        assert is_original_or_masked(record, placed, out)
        count = count + len(record.data)
        sequence = sequence + len(record.packets)
        start = placed.past


def list_head_gap(gap_bytes: int) -> list[tuple[int, int]]:
    """Return the gaps of a row that lacks only its first `gap_bytes`; none if that is 0."""
    if gap_bytes == 0:
        return []
    return [(0, gap_bytes)]


def test_losses_are_counted_by_their_place_at_the_head_between_and_at_the_tail():
    record = Record.make(30 * FULL, count=0, sequence=1)
    lost_at_head = (0, 1)
    lost_between = (7, 12, 13)
    lost_at_tail = (29,)
    lost = (*lost_at_head, *lost_between, *lost_at_tail)
    received = [packet for k, packet in enumerate(record.packets) if k not in lost]
    # Packet 2 comes after packet 3, whose end is two packets after the beginning of packet 2.
    exchanged = [received[1], received[0], *received[2:]]
    placed, _ = place(len(record.data), exchanged, Counters(0, 1), frame=65536)
    assert placed.losses == Losses(head_bytes=2 * FULL, gaps=2, gap_bytes=3 * FULL, tail_bytes=FULL)
    assert placed.counts.late == 1
    assert placed.counts.late_by_bytes == 2 * FULL


def test_logging_allocates_nothing_that_stays():
    """Packets create no Python objects: a thousand batches use as many blocks of memory as ten."""
    batch = 256
    batches = 1000
    size = batch * FULL
    record = Record.make(size, count=0, sequence=1)
    block = np.frombuffer(b"".join(record.packets), dtype=np.uint8).reshape(batch, HEADER_BYTES + FULL).copy()
    lengths = np.full(batch, HEADER_BYTES + FULL, dtype=np.uint32)
    log = PacketLog(size * batches)
    blocks_after_10_batches = 0
    for n in range(batches):
        numbers = np.arange(n * batch, (n + 1) * batch)
        # Four bytes of sequence number and six of byte count.
        block[:, 0:4] = (numbers + 1).astype("<u4")[:, None].view(np.uint8)
        block[:, 4:10] = (numbers * FULL).astype("<u8")[:, None].view(np.uint8)[:, :6]
        log.add(block, lengths, n)
        if n == 9:
            blocks_after_10_batches = sys.getallocatedblocks()
    new_blocks = sys.getallocatedblocks() - blocks_after_10_batches
    assert log.count == batches * batch
    # One object for each of the 990 batches would be more; 3 are measured.
    assert new_blocks < 200


@settings(max_examples=100, deadline=None, suppress_health_check=SLOW)
@given(
    head=st.integers(0, 5),
    tail=st.sampled_from([1, 1000, 1455]),
    count=near_wrap,
    sequence=near_sequence_wrap,
)
def test_a_lost_beginning_is_masked_if_the_start_of_the_record_is_known(head, tail, count, sequence):
    record = Record.make(20 * FULL + tail, count, sequence)
    placed, out = place(len(record.data), record.packets[head:], Counters(count, sequence), FRAME)
    assert placed.located
    assert placed.missing == list_head_gap(head * FULL)
    assert is_original_or_masked(record, placed, out)


@settings(max_examples=100, deadline=None, suppress_health_check=SLOW)
@given(
    cut=st.integers(0, FULL - 1),
    which=st.integers(0, 20),
    count=near_wrap,
)
def test_the_lost_bytes_of_a_truncated_packet_are_masked(cut, which, count):
    """If the end of the row is no longer certain, the whole row is masked."""
    record = Record.make(20 * FULL + 700, count, 77)
    packets = list(record.packets)
    packets[which] = packets[which][: max(0, len(packets[which]) - cut)]
    placed, out = place(len(record.data), packets, Counters(count, 77), FRAME)
    assert is_original_or_masked(record, placed, out)
    is_last_packet = which == 20
    if placed.located and not is_last_packet:
        _, end_of_packet = record.byte_range(which)
        if cut:
            assert placed.missing == [(end_of_packet - cut, end_of_packet)]
        else:
            assert placed.missing == []


@settings(max_examples=60, deadline=None, suppress_health_check=SLOW)
@given(missed=st.integers(1, 5), count=near_wrap, at=st.integers(0, 14))
def test_missed_frames_are_never_placed_as_if_nothing_was_missing(missed, count, at):
    """The radar misses `missed` frames from frame `at` on."""
    whole_record = Record.make(20 * FRAME, count, sequence=9)
    data = whole_record.data[: at * FRAME] + whole_record.data[(at + missed) * FRAME :]
    packets = encode_packets(data, sequence=9, byte_count=count)
    placed, _ = place(len(whole_record.data), packets, Counters(count, 9), FRAME)
    assert not placed.located
    assert placed.missing == [(0, len(whole_record.data))]


@settings(max_examples=60, deadline=None, suppress_health_check=SLOW)
@given(flip=st.integers(0, 79), which=st.integers(1, 20), count=near_wrap)
# A position beyond the end of the row.
@example(flip=46, which=10, count=0)
def test_a_packet_with_a_wrong_header_is_masked_and_damages_no_other_byte(flip, which, count):
    """One flipped bit anywhere in one packet's counters: only its bytes are masked."""
    record = Record.make(21 * FULL + 100, count, 500)
    packets = list(record.packets)
    bad = bytearray(packets[which])
    bad[flip // 8] ^= 1 << flip % 8
    packets[which] = bytes(bad)
    placed, out = place(len(record.data), packets, Counters(count, 500), FRAME)
    assert placed.counts.disagreeing + placed.counts.outside == 1
    assert placed.missing == [record.byte_range(which)]
    assert is_original_or_masked(record, placed, out)


@pytest.mark.parametrize(("packets_ahead", "is_later"), [(84, True), (85, False)])
@pytest.mark.parametrize("sequence", [1, SEQUENCE - 30])
def test_a_packet_far_ahead_is_damaged_and_a_near_one_may_be_of_a_later_record(sequence, packets_ahead, is_later):
    """The limit is four rows and four packets. A row has 20.07 packets here, so that the limit is 84.3 packets."""
    record = Record.make(20 * FULL + 100, 0, sequence)
    other_packet = encode_packet(sequence + packets_ahead, len(record.data), b"x" * FULL)
    placed, out = place(len(record.data), [*record.packets, other_packet], Counters(0, sequence), FRAME)
    assert placed.located
    assert out.tobytes() == record.data
    # After a later record the start of the next one is unknown.
    assert (find_next_start(placed) is None) == is_later


def test_a_record_longer_than_a_row_is_not_placed():
    record = Record.make(6 * FRAME, count=0, sequence=1)
    placed, _ = place(5 * FRAME, record.packets, Counters(0, 1), FRAME)
    assert not placed.located
    assert "more" in placed.reason
    assert placed.counts.outside > 0


def test_without_a_valid_packet_the_whole_row_is_missing():
    placed, out = place(5000, [], Counters(0, 1))
    assert placed.missing == [(0, 5000)]
    assert find_next_start(placed) is None
    header_alone = b"0123456789"
    placed, out = place(5000, [b"", b"short", header_alone], Counters(0, 1))
    assert placed.counts.malformed == 3
    assert not out.any()


@settings(max_examples=60, deadline=None, suppress_health_check=SLOW)
@given(
    rest=st.integers(1, FULL - 1),
    count=near_wrap,
    sequence=near_sequence_wrap,
    batch=st.sampled_from([1, 2, 7]),
)
def test_last_packet_of_the_previous_record_is_not_the_first_of_this_one(rest, count, sequence, batch):
    """The previous record was stopped early; packets that its card still held come during this one."""
    late = Record.make(rest, count, sequence, seed=1)
    start = Counters((count + rest) % COUNT, (sequence + 1) % SEQUENCE)
    record = Record.make(20 * FULL + 100, start.byte_count, start.sequence)
    placed, out = place(len(record.data), late.packets + record.packets, start, frame=FRAME, batch=batch)
    assert placed.located
    assert placed.missing == []
    assert out.tobytes() == record.data
    assert placed.counts.leftover == 1
    assert placed.counts.placed == len(record.packets)
    next_start = find_next_start(placed)
    assert next_start is not None
    assert next_start.byte_count == (start.byte_count + out.size) % COUNT
    assert next_start.sequence == (start.sequence + len(record.packets)) % SEQUENCE


def test_truncated_first_packet_is_not_the_last_of_the_record_before():
    record = Record.make(20 * FULL, 5000, 7)
    packets = [record.packets[0][:-400], *record.packets[1:]]
    placed, out = place(len(record.data), packets, Counters(5000, 7))
    assert placed.located
    assert placed.missing == [(FULL - 400, FULL)]
    assert is_original_or_masked(record, placed, out)
    assert out.size == len(record.data)


# Bytes of rows whose last packet is full, and shorter: 91 x 4096 = 256 x 1456, and 62 x 4096 = 174 x 1456 + 608.
FULL_ENDS = 91 * FRAME
SHORT_END = 62 * FRAME


@pytest.mark.parametrize("lost", [1, 3])
@pytest.mark.parametrize("dropped", [0, 16, 1440])
def test_a_record_without_its_end_is_not_placed(lost, dropped):
    """The card drops `dropped` bytes before it numbers them, which shows only in the record's length.

    Without the last `lost` packets the length is unknown.
    """
    row = Record.make(SHORT_END, 70_000, 9)
    sent = encode_packets(row.data[:5000] + row.data[5000 + dropped :], sequence=9, byte_count=70_000)
    without_end, out = place(SHORT_END, sent[:-lost], Counters(70_000, 9), FRAME)
    assert is_original_or_masked(row, without_end, out)
    assert not without_end.slipped
    with_end, out = place(SHORT_END, sent, Counters(70_000, 9), FRAME)
    assert is_original_or_masked(row, with_end, out)
    assert not with_end.slipped
    assert with_end.located == (dropped == 0)


@pytest.mark.parametrize("size", [FULL_ENDS, SHORT_END])
def test_a_lost_start_is_known_again_after_a_reset(size):
    card = Card(size, 70_000, 9)
    without_end, _ = place(size, card.record().packets[:-3], EarlierRecords(Counters(70_000, 9)), FRAME)
    assert without_end.past.lost
    after_lost_start, _ = place(size, card.record().packets, without_end.past, FRAME)
    assert not after_lost_start.located
    card.reset()
    record_after_reset = card.record()
    placed, out = place(size, record_after_reset.packets, EarlierRecords.after_reset(), FRAME)
    assert placed.complete
    assert out.tobytes() == record_after_reset.data


@pytest.mark.parametrize("size", [FULL_ENDS, SHORT_END])
def test_every_second_take_of_a_card_that_restarts_its_counters_in_each_record_is_kept(size):
    """After a record with unexpected counters the start of the next one is not known, and the host resets the card."""
    card = Card(size)
    past = EarlierRecords.after_reset()
    accepted = []
    for _ in range(6):
        card.reset()
        record = card.record()
        placed, out = place(size, record.packets, past, FRAME)
        assert is_original_or_masked(record, placed, out)
        accepted.append(placed.complete)
        past = EarlierRecords.after_reset() if placed.past.lost else placed.past
    assert accepted == [True, False] * 3


@pytest.mark.parametrize("size", [FULL_ENDS, SHORT_END])
@pytest.mark.parametrize("before", [1, 2, 5])
@pytest.mark.parametrize("start", [Counters(0, 1), Counters(70_000, 9)])
def test_a_restart_within_a_row_gives_no_wrong_byte(size, before, start):
    """The card restarts before packet `before`, and the last packets may be lost."""
    card = Card(size, start.byte_count, start.sequence)
    row = card.record(resets=(before,))
    for lost_packets in (0, 1, 4):
        placed, out = place(size, row.packets[: len(row.packets) - lost_packets], start, FRAME)
        assert is_original_or_masked(row, placed, out)
        assert not placed.slipped


@pytest.mark.parametrize("size", [FULL_ENDS, SHORT_END])
def test_a_late_packet_of_the_first_record_is_not_a_restart(size):
    """A card that restarts within a row does not reach the row's end. This row does, after five earlier ones.

    Without the last packet the row may also be one in which the card has restarted.
    """
    packets_of_row = math.ceil(size / FULL)
    start = Counters(5 * size, 5 * packets_of_row + 1)
    record = Record.make(size, start.byte_count, start.sequence)
    late_packet = Record.make(size, 0, 1, seed=1).packets[7]
    packets = [*record.packets[:9], late_packet, *record.packets[9:]]
    placed, out = place(size, packets, start, FRAME)
    assert placed.complete
    assert placed.counts.restarted == 1
    assert not placed.past.lost
    assert out.tobytes() == record.data
    without_end, _ = place(size, packets[:-1], start, FRAME)
    assert not without_end.located


def test_a_packet_that_comes_twice_with_different_bytes_is_masked():
    """A second network path may bring it with other bytes. One that comes twice with the same bytes is a duplicate."""
    record = Record.make(20 * FULL + 100, 5000, 7)
    conflicting_packet = bytearray(record.packets[7])
    conflicting_packet[500] ^= 1
    packets = [*record.packets, bytes(conflicting_packet), record.packets[9]]
    placed, out = place(len(record.data), packets, Counters(5000, 7), FRAME)
    assert placed.missing == [record.byte_range(7)]
    assert placed.counts.conflicting == 1
    assert placed.counts.duplicates == 1
    assert is_original_or_masked(record, placed, out)


def test_a_second_card_with_equal_counters_fills_no_gap():
    """Two cards with one address that were reset together: if a packet is lost, only the other card's comes."""
    record = Record.make(40 * FULL + 100, 70_000, 9)
    twin = Record.make(40 * FULL + 100, 70_000, 9, seed=1)
    packets = []
    for k, (packet, twin_packet) in enumerate(zip(record.packets, twin.packets, strict=True)):
        is_lost = k % 20 == 7
        if not is_lost:
            packets.append(packet)
        packets.append(twin_packet)
    placed, out = place(len(record.data), packets, Counters(70_000, 9), FRAME)
    assert is_original_or_masked(record, placed, out)
    assert not placed.located
    assert not placed.slipped
    assert placed.past.lost
    assert "second card" in placed.reason


@pytest.mark.parametrize("trouble", ["conflict", "short", "conflict and short"])
def test_placing_does_not_change_the_logged_payload(trouble, tmp_path):
    """The row's packet file is written from it afterwards, and gives the same result again."""
    record = Record.make(20 * FULL + 100, 0, 1)
    packets = list(record.packets)
    if "conflict" in trouble:
        # Packet 7 once more, with other bytes.
        inverted_payload = bytes(255 - byte for byte in record.packets[7][HEADER_BYTES:])
        packets.append(encode_packet(sequence=8, byte_count=7 * FULL, payload=inverted_payload))
    # The record may be a packet shorter than the row.
    size = len(record.data)
    if "short" in trouble:
        size += FULL
    # A packet far outside of the row.
    packets.append(encode_packet(sequence=99, byte_count=5 * size, payload=bytes([9] * 99)))
    log = make_log(size, packets)
    past = EarlierRecords.after_reset()
    payload_before = log.payload[: log.payload_bytes].copy()
    placed, out = place_record(log, FRAME, past)
    assert (log.payload[: payload_before.size] == payload_before).all()
    write_packets(tmp_path / "0000.pkt", log, Evidence(size, FRAME, past=past), placed)
    _, log_from_file = read_packets(tmp_path / "0000.pkt", out)
    second_placement, second_out = place_record(log_from_file, FRAME, past)
    assert second_placement.counts == placed.counts
    assert second_placement.missing == placed.missing
    assert (second_out == out).all()


def place_around_first_pulse(early: list[bytes], later: list[bytes]) -> tuple[PlacedRecord, np.ndarray]:
    """Place a row whose first pulse is at 50 ns: the early packets come at 1 ns, the later ones from 100 ns on."""
    log = make_log(SHORT_END, early, t_ns=1)
    for k, packet in enumerate(later):
        log.add(np.frombuffer(packet, dtype=np.uint8)[None, :], np.array([len(packet)]), 100 + k)
    return place_record(log, FRAME, EarlierRecords(Counters(70_000, 9)), not_before_ns=50)


def test_packets_of_an_earlier_record_before_the_first_pulse_are_left_over():
    earlier_record = Record.make(2 * FULL, 70_000 - 2 * FULL, 7)
    record = Record.make(SHORT_END, 70_000, 9)
    placed, out = place_around_first_pulse(earlier_record.packets, record.packets)
    assert placed.located
    assert is_original_or_masked(record, placed, out)


def test_a_row_with_packets_of_its_own_before_the_first_pulse_is_not_located():
    """Frames came without a pulse."""
    record = Record.make(SHORT_END, 70_000, 9)
    placed, out = place_around_first_pulse(record.packets[:2], record.packets[2:])
    assert not placed.located
    assert is_original_or_masked(record, placed, out)


def test_a_complete_record_with_the_counters_of_another_card_is_not_the_row():
    """A second card with the same address sends one whole row, and the packets of the right card are lost."""
    twin = Card(SHORT_END, 5_000_000, 40_000)
    placed, _ = place(SHORT_END, twin.record().packets, EarlierRecords(Counters(70_000, 9)), FRAME)
    assert not placed.located
    earlier_record = Record.make(SHORT_END, 0, 1)
    mixed = []
    for packet, twin_packet in zip(earlier_record.packets, twin.record().packets, strict=True):
        mixed += [packet, twin_packet]
    placed, out = place(SHORT_END, mixed, EarlierRecords.after_reset(), FRAME)
    assert is_original_or_masked(earlier_record, placed, out)
