"""The packets of a row in memory (`PacketLog`), and the row's file: reused memory, a full disk, a damaged index."""

import zlib

import numpy as np
import pytest
from tests.support.capture.records import FULL, HEADER_BYTES
from tests.support.refusals import expect_refusal

from polysight.capture.dca1000 import PacketLog
from polysight.capture.row_files import Segment, read_index
from polysight_shared.errors import DataError, DeviceError, ErrorCode

# Bytes: 1 EiB.
MORE_THAN_ANY_DISK = 1 << 60


def test_the_memory_of_an_earlier_row_is_used_again_and_cleared():
    first = PacketLog(9000)
    first.payload[:] = 7
    for expected in (8000, 9000):
        second = PacketLog(expected, first.payload)
        assert np.shares_memory(second.payload, first.payload)
        assert not second.payload[:expected].any()
    # It is not enough for a longer row.
    assert not np.shares_memory(PacketLog(9001, first.payload).payload, first.payload)


def test_payload_stays_in_its_memory_until_that_is_full():
    log = PacketLog(1024)
    memory = log.payload
    payload_bytes = 1024
    packet_bytes = HEADER_BYTES + payload_bytes
    packets_that_fit = memory.size // payload_bytes
    assert packets_that_fit * payload_bytes == memory.size
    packets = np.random.default_rng(0).integers(0, 256, (packets_that_fit + 1, packet_bytes), dtype=np.uint8)
    lengths = np.full(len(packets), packet_bytes)
    assert log.last_arrival_ns == 0
    log.add(packets[:-2], lengths[:-2], 3)
    log.add(packets[-2:-1], lengths[-2:-1], 5)
    assert log.payload is memory
    assert log.last_arrival_ns == 5
    log.add(packets[-1:], lengths[-1:], 7)
    assert log.payload is not memory
    assert log.last_arrival_ns == 7
    payload = packets[:, HEADER_BYTES:].ravel()
    assert (log.payload[: payload.size] == payload).all()


def log_packets(*sizes: int, expected: int = 9000) -> PacketLog:
    """Return a log of packets whose payloads have these sizes; every byte of packet k, which comes at k ns, is k."""
    log = PacketLog(expected)
    for number, size in enumerate(sizes):
        packet = np.full((1, HEADER_BYTES + size), number % 256, np.uint8)
        log.add(packet, np.array([HEADER_BYTES + size]), number)
    return log


def test_a_packet_has_at_least_one_byte_and_at_most_1456():
    log = log_packets(0, 1, FULL, FULL + 1)
    assert log.malformed == 2
    assert log.sizes.tolist() == [1, FULL]
    assert log.payload_bytes == 1 + FULL
    assert log.arrivals_ns.tolist() == [1, 2]
    assert log.payload[: 1 + FULL].tolist() == [1] + FULL * [2]


def test_malformed_packets_of_a_batch_are_left_out_of_its_sizes_and_times():
    # A header alone, two bytes more, less than a header, and one byte more than a header.
    lengths = [HEADER_BYTES, HEADER_BYTES + 2, HEADER_BYTES - 1, HEADER_BYTES + 1]
    times_ns = [5, 6, 7, 8]
    log = PacketLog(9000)
    log.add(np.zeros((4, max(lengths)), np.uint8), np.array(lengths), np.array(times_ns))
    assert log.malformed == 2
    assert log.sizes.tolist() == [2, 1]
    assert log.arrivals_ns.tolist() == [6, 8]


@pytest.mark.parametrize(
    ("sizes", "is_short"),
    [((), False), ((5,), False), ((5, 5), False), ((5, 4), True), ((4, 5), False), ((5, 4, 4), False)],
)
def test_a_packet_smaller_than_the_one_before_may_end_a_record(sizes, is_short):
    assert log_packets(*sizes).last_is_short == is_short


def test_more_packets_than_a_row_has_are_still_counted():
    """Packets of one byte: 300 are more than the 256 that a row without bytes has room for."""
    log = log_packets(*(1 for _ in range(300)), expected=0)
    assert log.count == 300
    assert log.arrivals_ns.tolist() == list(range(300))
    assert log.payload[:300].tolist() == [number % 256 for number in range(300)]


def test_payload_of_far_more_than_a_row_is_counted_and_not_kept():
    """At most four rows, each with a spare of 1 MiB, are kept."""
    log = PacketLog(0)
    largest_bytes = PacketLog.max_kept_bytes(0)
    assert largest_bytes == 4 << 20
    payload_bytes = 1024
    packets = np.zeros((1024, HEADER_BYTES + payload_bytes), np.uint8)
    lengths = np.full(1024, HEADER_BYTES + payload_bytes)
    # Four batches of 1024 packets are 4 MiB.
    packets_that_fit = 4 * 1024
    for _ in range(4):
        log.add(packets, lengths, 0)
    assert log.kept == packets_that_fit
    assert log.count == packets_that_fit
    assert log.payload.size <= largest_bytes
    log.add(packets[:1], lengths[:1], 0)
    assert log.kept == packets_that_fit
    assert log.count == packets_that_fit + 1
    assert log.payload_bytes == largest_bytes + payload_bytes
    # A packet after one that was not kept is not kept either, however small.
    smallest_packet_bytes = HEADER_BYTES + 1
    log.add(packets[:1, :smallest_packet_bytes], np.array([smallest_packet_bytes]), 0)
    assert log.kept == packets_that_fit
    assert log.count == packets_that_fit + 2


def test_a_log_is_restored_from_its_arrays():
    log = log_packets(7, 5, 3)
    log._heads[:3] = [[1, 2, 3, 4, 5, 6, 7, 8, 9, 10], [255] * 10, [0] * 10]
    assert log.sequences.tolist() == [0x04030201, 2**32 - 1, 0]
    assert log.byte_counts.tolist() == [0x0A0908070605, 2**48 - 1, 0]
    restored = PacketLog.restore(
        expected=9000, sequences=log.sequences, byte_counts=log.byte_counts, sizes=log.sizes,
        times_ns=log.arrivals_ns, payload=log.payload,
    )  # fmt: skip
    for name in ("expected", "count", "kept", "payload_bytes", "last_is_short", "last_arrival_ns"):
        assert getattr(restored, name) == getattr(log, name)
    for name in ("sequences", "byte_counts", "sizes", "arrivals_ns"):
        assert getattr(restored, name).tolist() == getattr(log, name).tolist()


def test_a_segment_holds_the_bytes_given(tmp_path):
    data = np.arange(8000, dtype=np.uint8)
    assert Segment(tmp_path / "b", 8000).finish(data) == zlib.crc32((tmp_path / "b").read_bytes())
    assert (tmp_path / "b").read_bytes() == data.tobytes()


def test_a_row_for_which_the_disk_has_no_space_is_refused(tmp_path):
    with expect_refusal(ErrorCode.DISK_FULL):
        Segment(tmp_path / "huge.part", MORE_THAN_ANY_DISK)


def test_damaged_index_is_refused(tmp_path):
    # An arrival has 16 bytes. The last two contents have one arrival too few, and one that was cut.
    for raw in (b"", b"[]\n", b'{"arrivals":2}\n' + bytes(16), b'{"arrivals":1}\n' + bytes(15)):
        (tmp_path / "a.idx").write_bytes(raw)
        with pytest.raises(DataError):
            read_index(tmp_path / "a.idx")


def test_the_commands_advised_for_a_damaged_or_unwritten_row_have_the_scan_folder(tmp_path):
    index = tmp_path / "scan/raw/RH/0003.idx"
    index.parent.mkdir(parents=True)
    index.write_bytes(b"[]\n")
    with pytest.raises(DataError) as damaged:
        read_index(index)
    assert f"polysight validate {tmp_path / 'scan'}`" in damaged.value.remedy
    with pytest.raises(DeviceError) as full:
        Segment(index.with_suffix(".part"), MORE_THAN_ANY_DISK)
    assert f"polysight resume {tmp_path / 'scan'}`" in full.value.remedy
