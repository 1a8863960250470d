"""Rows placed again from their packets: different results are committed, equal ones are not written."""

import gc
import json
import math
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pytest
from tests.support.capture.records import FULL, Record, make_log, make_mask
from tests.support.refusals import expect_refusal
from tests.support.rigs import make_rig_with
from tests.support.store.faulty_disk import FaultyDisk, Killed
from tests.support.store.plain_scan import list_errors

from polysight.capture import PACKETS_SUFFIX, Evidence, place_record, read_packets, write_index, write_packets
from polysight.capture.dca1000 import Counters
from polysight.capture.placement import EarlierRecords
from polysight.jobs.recordings import inspect_placement, replace_folder
from polysight.store import ManifestWriter, ScanFolder, describe_damage, replace_rows
from polysight.store.logs import crc32
from polysight_shared.errors import ErrorCode
from polysight_shared.raster import plan_raster


def scan_with(folder: Path, lost: int | Collection[int], has_wrong_packet: bool = False) -> tuple[ScanFolder, bytes]:
    """Write a scan of one row, with lost packets, a leftover and a duplicate; return it and the sent bytes.

    `has_wrong_packet`: the committed row is masked as a whole, as an earlier release would have done.
    """
    rig = make_rig_with(grid={"columns": 3, "rows": 1}, limits={"free_disk_bytes": 0})
    scan = ScanFolder.create(folder, rig, plan_raster(rig.grid))
    size = rig.row_bytes
    frame = rig.frame_bytes
    # The card's counters at the start of the record. The earlier record has 2000 bytes in two packets before it.
    start = Counters(byte_count=5000, sequence=7)
    record = Record.make(size, start.byte_count, start.sequence)
    earlier_record = Record.make(2000, count=3000, sequence=5)
    lost_packets = {lost} if isinstance(lost, int) else set(lost)
    received = [packet for k, packet in enumerate(record.packets) if k not in lost_packets]
    leftover = earlier_record.packets[1]
    duplicate = record.packets[4]
    packets = [leftover, *received, duplicate]
    boards = {}
    with scan.writer() as writer:
        for board in rig.recorded:
            path = scan.row_path(board.name, 0)
            log = make_log(size, packets)
            evidence = Evidence(size, frame, past=EarlierRecords(start))
            placed, out = place_record(log, frame, evidence.past)
            packets_crc = write_packets(path.with_suffix(PACKETS_SUFFIX), log, evidence, placed)
            path.write_bytes(out.tobytes())
            facts = {**placed.facts(), "missing": [(0, size)] if has_wrong_packet else placed.missing}
            boards[board.name] = {
                "file": str(path.relative_to(folder)), "bytes": size, "frames_expected": size // frame,
                "frames_received": 0, "missing_bytes": sum(b - a for a, b in facts["missing"]),
                "crc32": f"{crc32(out.tobytes()):08x}", "packets_crc32": f"{packets_crc:08x}",
                "index_crc32": f"{write_index(path.with_suffix('.idx'), facts, placed.arrivals):08x}",
            }  # fmt: skip
        commit(writer, boards, rig.grid.columns * rig.burst.pulses)
    scan.reload()
    return scan, record.data


def commit(writer: ManifestWriter, boards: dict, pulses: int) -> None:
    incomplete = {"kept_incomplete": ["a test"], "faults": []}
    row = {"fact": "row_committed", "row": 0, "take": 1, "direction": 1, "boards": boards, "pulses": pulses}
    writer.append({**row, **incomplete})


def check_rows(scan: ScanFolder, data: bytes, missing: list[tuple[int, int]]) -> None:
    """Check that the rows have these bytes, masked exactly in these ranges."""
    expected = np.frombuffer(data, dtype=np.uint8)
    for board in scan.instrument.recorded:
        row = scan.read_row(board.name, 0)
        assert row.mask is not None
        assert (row.mask == make_mask(expected.size, missing)).all()
        assert (row.payload[~row.mask] == expected[~row.mask]).all()


def test_rows_with_the_same_result_are_not_touched(tmp_path):
    scan, data = scan_with(tmp_path / "scan", lost=9)
    contents_before = {p: p.read_bytes() for p in scan.path.rglob("*") if p.is_file()}
    assert [(r.changed, r.why_unchanged) for r in replace_rows(scan)] == [(False, "")] * 2
    assert {p: p.read_bytes() for p in scan.path.rglob("*") if p.is_file()} == contents_before
    check_rows(scan, data, [(9 * FULL, 10 * FULL)])


def test_a_row_masked_without_reason_is_replaced(tmp_path, capsys):
    scan, data = scan_with(tmp_path / "scan", lost=9, has_wrong_packet=True)
    assert list_errors(scan.path) == []
    assert inspect_placement(scan.path / "raw/RH/0000.bin", as_json=False) == 1
    assert "committed  differently" in capsys.readouterr().out
    assert replace_folder(scan.path, as_json=False) == 0
    assert f"{len(data)} bytes missing before, {FULL} now" in capsys.readouterr().out
    scan.reload()
    assert list_errors(scan.path) == []
    check_rows(scan, data, [(9 * FULL, 10 * FULL)])
    board = scan.committed_rows()[0].boards["RH"]
    # The manifest has the counts of the new index: all packets but the lost one.
    assert board.packets == math.ceil(len(data) / FULL) - 1
    assert board.leftover == 1
    assert board.duplicates == 1
    names = {p.name for p in scan.path.rglob("raw/RH/*")}
    assert names == {"0000-1.bin", "0000-1.idx", f"0000-1{PACKETS_SUFFIX}"}
    assert inspect_placement(scan.path / "raw/RH/0000-1.idx", as_json=True) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["leftover"] == 1
    assert report["duplicates"] == 1
    assert report["missing"] == [[9 * FULL, 10 * FULL]]
    assert [r.changed for r in replace_rows(scan)] == [False, False]


def test_of_more_than_eight_missing_ranges_the_first_are_printed(tmp_path, capsys):
    for count in (1, 8, 9):
        scan, _ = scan_with(tmp_path / str(count), lost=range(9, 9 + 2 * count, 2))
        assert inspect_placement(scan.path / "raw/RH/0000.bin", as_json=False) == 0
        (line,) = [text for text in capsys.readouterr().out.splitlines() if text.startswith("missing ")]
        expected = [f"{k * FULL}..{(k + 1) * FULL}" for k in range(9, 9 + 2 * count, 2)]
        if count > 8:
            expected = [*expected[:8], "..."]
        printed = line.removeprefix("missing ").strip().split(", ")
        assert printed == expected


# A killed program does not close its files.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("fault", ["killed within", "power cut", "worst power cut"])
def test_a_kill_or_power_cut_while_rows_are_replaced_loses_nothing(tmp_path, fault):
    scan, data = scan_with(tmp_path / "count" / "scan", lost=9, has_wrong_packet=True)
    counting = FaultyDisk(tmp_path / "count")
    with counting():
        replace_rows(scan)
    for position in range(1, len(counting.done) + 1):
        folder = tmp_path / str(position)
        scan, data = scan_with(folder / "scan", lost=9, has_wrong_packet=True)
        with pytest.raises(Killed), FaultyDisk(folder, fault, position, seed=position)():
            replace_rows(scan)
        scan = ScanFolder.load(scan.path)
        assert list_errors(scan.path) == [], counting.done[position - 1]
        replace_rows(scan)
        check_rows(scan, data, [(9 * FULL, 10 * FULL)])
    # Files that were not closed are to be reported in this test, not in the next one.
    gc.collect()


@pytest.mark.parametrize("suffix", [".bin", ".idx", PACKETS_SUFFIX])
@pytest.mark.parametrize("other", [False, True])
def test_a_damaged_file_is_reported_and_never_placed(tmp_path, suffix, other):
    """One bit of the packet file is flipped, or it is replaced by that of another board."""
    scan, _ = scan_with(tmp_path / "scan", lost=9)
    path = scan.path / f"raw/RH/0000{suffix}"
    raw = bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 1
    path.write_bytes(raw)
    if other:
        (scan.path / "raw/RH").rename(scan.path / "raw/x")
        (scan.path / "raw/RV").rename(scan.path / "raw/RH")
        (scan.path / "raw/x").rename(scan.path / "raw/RV")
    board = "RV" if other else "RH"
    with expect_refusal(ErrorCode.FILE_DAMAGED):
        inspect_placement(scan.path / f"raw/{board}/0000.bin", as_json=False)
    remaining = {r.board: r.damaged for r in replace_rows(scan)}
    assert remaining == {"RH": not other, "RV": other}


def test_damage_of_a_row_is_that_of_its_own_file(tmp_path):
    scan, _ = scan_with(tmp_path / "scan", lost=9)
    damaged = scan.path / "raw/RH/0000.bin"
    damaged.write_bytes(bytes(damaged.stat().st_size))
    for path, text in (
        (damaged, "crc"),
        (scan.path / "raw/RV/0000.bin", ""),
        (scan.path / "raw/RV/0001.bin", "no such committed row"),
    ):
        damage = describe_damage(scan, path)
        assert text in damage.lower()
        assert bool(damage) == bool(text)


def test_batches_that_take_packets_back_are_damage(tmp_path):
    scan, _ = scan_with(tmp_path / "scan", lost=9)
    path = scan.path / f"raw/RH/0000{PACKETS_SUFFIX}"
    line, _, tail = path.read_bytes().partition(b"\n")
    # The file begins with batches of packets, each a time and the number of packets so far: the first one has so many
    # that the second one's number is smaller.
    batches = np.frombuffer(tail, dtype="<i8", count=4).copy()
    batches[1] += 1 << 40
    path.write_bytes(line + b"\n" + batches.tobytes() + tail[32:])
    with expect_refusal(ErrorCode.FILE_DAMAGED, path):
        read_packets(path, np.zeros(10**6, np.uint8))


def test_a_row_without_its_packet_file_is_not_changed(tmp_path):
    scan, _ = scan_with(tmp_path / "scan", lost=9)
    (scan.path / f"raw/RH/0000{PACKETS_SUFFIX}").unlink()
    (scan.path / f"raw/RV/0000{PACKETS_SUFFIX}").write_bytes(b"no")
    assert [bool(r.why_unchanged) for r in replace_rows(scan)] == [True, True]
    assert len(list_errors(scan.path)) == 2
