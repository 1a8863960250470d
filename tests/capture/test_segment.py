"""A row's file: reused memory, a full disk, a damaged index."""

import zlib

import numpy as np
import pytest
from tests.support.refusals import refused

from polysight.capture.dca1000 import PacketLog
from polysight.capture.row_files import Segment, read_index
from polysight_shared.errors import DataError, DeviceError, ErrorCode


def test_memory_is_taken_again_and_clean():
    first = PacketLog(9000)
    first.payload[:] = 7
    second = PacketLog(8000, first.payload)
    assert np.shares_memory(second.payload, first.payload)
    assert not second.payload[:8000].any()


def test_a_segment_holds_the_bytes_given(tmp_path):
    data = np.arange(8000, dtype=np.uint8)
    assert Segment(tmp_path / "b", 8000).finish(data) == zlib.crc32((tmp_path / "b").read_bytes())
    assert (tmp_path / "b").read_bytes() == data.tobytes()


def test_no_room_on_the_disk(tmp_path):
    with refused(ErrorCode.DISK_FULL):
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
