"""Every packet of a row that is not as expected (an *anomaly*) is counted once, under its own name."""

import math

from hypothesis import assume, given, strategies as st
from tests.support.capture.records import FULL, HEADER_BYTES, Card, encode_packet, is_original_or_masked, place

from polysight.capture.dca1000 import Counters, decode_packet_header
from polysight.capture.placement import EarlierRecords, PacketCounts

# Bytes of a frame, and frames of a row. A packet has 1456 bytes.
GRIDS = [(4096, 62), (4096, 91), (64, 910), (512, 30), (1456, 7)]
# Byte count and sequence number of the first record; the last sequence number begins again at 0 within the row.
STARTS = [(145_600_000, 100_001), (50_000_000, 5), (2**47, 2**32 - 7)]
ANOMALIES = ("duplicates", "conflicting", "leftover", "restarted", "outside", "disagreeing", "malformed")


def list_other_anomalies(counts: PacketCounts, *names: str) -> dict[str, int]:
    """Return the anomalies that were counted, except those with these names."""
    other_counts = {name: getattr(counts, name) for name in ANOMALIES if name not in names}
    return {name: count for name, count in other_counts.items() if count}


@given(
    grid=st.sampled_from(GRIDS),
    start=st.sampled_from(STARTS),
    rows=st.integers(0, 6),
    cut=st.floats(0, 1),
    batch=st.sampled_from([1, 7, 64]),
)
def test_packets_after_a_reset_within_a_row_are_counted_as_restarted(grid, start, rows, cut, batch):
    frame, frames = grid
    size = frame * frames
    packets = math.ceil(size / FULL)
    assume(packets > 2)
    # Neither the first nor the last packet.
    restart_packet = 1 + int(cut * (packets - 2))
    card = Card(size, *start)
    past = EarlierRecords(Counters(*start))
    for _ in range(rows):
        placed, _ = place(size, card.record().packets, past, frame, batch)
        assert not list_other_anomalies(placed.counts)
        past = placed.past
    record = card.record(resets=(restart_packet,))
    placed, out = place(size, record.packets, past, frame, batch)
    assert is_original_or_masked(record, placed, out)
    assert placed.counts.placed == restart_packet, placed.reason
    assert placed.counts.restarted == packets - restart_packet, placed.reason
    assert not list_other_anomalies(placed.counts, "restarted")
    assert not placed.located


@given(at=st.integers(2, 85), lost=st.sampled_from([1, 2, 5]))
def test_frames_of_a_first_row_that_was_cut_by_a_reset_are_not_placed_by_their_arrival(at, lost):
    """The card is reset before packet `at`, and the last `lost` packets are lost.

    The counters started at 0 and 1 twice, so that nothing shows which bytes follow which.
    """
    size = 91 * 4096
    record = Card(size).record(resets=(at,))
    placed, _ = place(size, record.packets[:-lost], Counters(0, 1), frame=4096)
    assert not placed.located
    assert not placed.slipped


def test_frames_of_a_row_with_conflicts_are_not_moved():
    """A row is written again with its frames moved only if everything else about it is clear."""
    size = 62 * 4096
    frame = 4096
    start = Counters(70_000, 9)

    # The card has recorded a frame fewer than the row has. `slipped` means that frames may be moved.
    short_row, _ = place(size, Card(size - frame, 70_000, 9).record().packets, start, frame)
    assert short_row.slipped
    assert not short_row.holes

    # Packet 9 comes once more, with the bytes of packet 8.
    packets = Card(size - frame, 70_000, 9).record().packets
    conflicting_packet = packets[9][:HEADER_BYTES] + packets[8][HEADER_BYTES:]
    row_with_conflict, _ = place(size, [*packets, conflicting_packet], start, frame)
    assert not row_with_conflict.slipped
    assert row_with_conflict.holes == [(9 * FULL, 10 * FULL)]


def spoil_packet(packets: list[bytes], kind: str, k: int) -> list[bytes]:
    """Return the packets of a row with one anomaly after packet k."""
    head = packets[k][:HEADER_BYTES]
    sequence_number = packets[k][:4]
    byte_count = packets[k][4:HEADER_BYTES]
    payload = packets[k][HEADER_BYTES:]
    last_sequence, last_count = decode_packet_header(packets[-1])
    end_count = last_count + len(packets[-1]) - HEADER_BYTES
    extra_packets = {
        "duplicates": packets[k],
        "conflicting": head + payload[::-1],
        # A packet that follows the last one.
        "outside": encode_packet(last_sequence + 1, end_count, bytes(FULL)),
        # Every second bit of the byte count is inverted.
        "disagreeing": sequence_number + bytes(byte ^ 0x55 for byte in byte_count) + payload,
        # A header without payload.
        "malformed": head,
    }
    return [*packets[: k + 1], extra_packets[kind], *packets[k + 1 :]]


@given(
    grid=st.sampled_from(GRIDS),
    kind=st.sampled_from(["duplicates", "conflicting", "outside", "disagreeing", "malformed"]),
    where=st.floats(0, 1),
    batch=st.sampled_from([1, 7, 64]),
)
def test_an_anomaly_is_counted_once_and_under_its_name(grid, kind, where, batch):
    frame, frames = grid
    size = frame * frames
    start = Counters(145_600_123, 100_001)
    card = Card(size, start.byte_count, start.sequence)
    first_row, _ = place(size, card.record().packets, start, frame, batch)
    record = card.record()
    k = int(where * (len(record.packets) - 1))
    placed, out = place(size, spoil_packet(record.packets, kind, k), first_row.past, frame, batch)
    assert is_original_or_masked(record, placed, out)
    assert getattr(placed.counts, kind) == 1
    assert not list_other_anomalies(placed.counts, kind)
    assert placed.counts.placed == len(record.packets)


@given(grid=st.sampled_from(GRIDS), lost_packets=st.integers(1, 5), batch=st.sampled_from([1, 7, 64]))
def test_late_packets_of_the_record_before_are_left_over(grid, lost_packets, batch):
    frame, frames = grid
    size = frame * frames
    start = Counters(145_600_123, 100_001)
    card = Card(size, start.byte_count, start.sequence)
    first_row, _ = place(size, card.record().packets, start, frame, batch)
    earlier_record = card.record()
    late = min(lost_packets, len(earlier_record.packets) - 1)
    late_packets = earlier_record.packets[:late]
    earlier_row, _ = place(size, earlier_record.packets[late:], first_row.past, frame, batch)
    record = card.record()
    packets = [*record.packets[:2], *late_packets, *record.packets[2:]]
    placed, _ = place(size, packets, earlier_row.past, frame, batch)
    assert placed.complete
    assert placed.counts.leftover == len(late_packets)
    assert not list_other_anomalies(placed.counts, "leftover")
