"""A row's file: reused memory, a full disk, a damaged index."""

import zlib

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.capture.dca1000 import PacketLog
from polysight.capture.row_files import Segment, read_index
from polysight_shared.errors import DataError, DeviceError, ErrorCode


def test_memory_is_taken_again_and_clean():
    first = PacketLog(9000)
    first.payload[:] = 7
    second = PacketLog(8000, first.payload)
    assert np.shares_memory(second.payload, first.payload)
    assert not second.payload[:8000].any()


def test_payload_stays_in_its_memory_until_that_is_full():
    log = PacketLog(1024)
    memory = log.payload
    count = memory.size // 1024
    assert count * 1024 == memory.size
    packets = np.random.default_rng(0).integers(0, 256, (count + 1, 10 + 1024), dtype=np.uint8)
    lengths = np.full(count + 1, 10 + 1024)
    assert log.last_arrival_ns == 0
    log.add(packets[:-2], lengths[:-2], 3)
    log.add(packets[-2:-1], lengths[-2:-1], 5)
    assert log.payload is memory
    assert log.last_arrival_ns == 5
    log.add(packets[-1:], lengths[-1:], 7)
    assert log.payload is not memory
    assert log.last_arrival_ns == 7
    assert (log.payload[: packets[:, 10:].size] == packets[:, 10:].ravel()).all()


def test_a_segment_holds_the_bytes_given(tmp_path):
    data = np.arange(8000, dtype=np.uint8)
    assert Segment(tmp_path / "b", 8000).finish(data) == zlib.crc32((tmp_path / "b").read_bytes())
    assert (tmp_path / "b").read_bytes() == data.tobytes()


def test_no_room_on_the_disk(tmp_path):
    with expect_refusal(ErrorCode.DISK_FULL):
        Segment(tmp_path / "huge.part", 1 << 60)


def test_damaged_index_is_refused(tmp_path):
    for raw in (b"", b"[]\n", b'{"arrivals":2}\n' + bytes(16), b'{"arrivals":1}\n' + bytes(15)):
        (tmp_path / "a.idx").write_bytes(raw)
        with pytest.raises(DataError):
            read_index(tmp_path / "a.idx")


def test_messages_name_the_scan_folder(tmp_path):
    index = tmp_path / "scan/raw/RH/0003.idx"
    index.parent.mkdir(parents=True)
    index.write_bytes(b"[]\n")
    with pytest.raises(DataError) as damaged:
        read_index(index)
    assert f"polysight validate {tmp_path / 'scan'}`" in damaged.value.remedy
    with pytest.raises(DeviceError) as full:
        Segment(index.with_suffix(".part"), 1 << 60)
    assert f"polysight resume {tmp_path / 'scan'}`" in full.value.remedy
