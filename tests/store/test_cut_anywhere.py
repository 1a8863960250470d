"""Manifest, event log, journal and rows are cut at every byte of their last record, or one bit of it is flipped.

Each time `validate` names the damage, if there is any; after `resume`, with at most one row retaken, every row
and the image are those of the undisturbed scan.
"""

from pathlib import Path

import msgpack
import pytest
from tests.support.refusals import expect_refusal
from tests.support.store.facts import load_facts
from tests.support.store.small_scan import SmallScan

from polysight.store.logs import read_events
from polysight.store.scan_folder import ScanFolder
from polysight.store.validation import to_text, validate
from polysight_pi.journal import records
from polysight_shared.errors import ErrorCode
from polysight_shared.messages import RowStarted

# With --long each byte and bit is tried.
pytestmark = pytest.mark.timeout(3600)
# A page of the disk that was never written.
PAGE = bytes(4096)
# Bytes of a full packet's payload.
PACKET = 1456


def read_lines(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines(keepends=True)


def find_journal(scan: SmallScan) -> Path:
    return next(scan.journals.glob("*.journal"))


def list_faults(scan: SmallScan, severity: str = "error") -> list[str]:
    return [to_text(f) for f in validate(scan.path) if f.level == severity]


def resume(scan: SmallScan, undisturbed_scan, image: bool = False, damaged_lines: int = 0) -> set[int]:
    """Resume; check that the scan is like an undisturbed one. Returns the rows that were retaken."""
    assert scan.run().exit_status == "success"
    notes = list_faults(scan, "note")
    assert list_faults(scan) == []
    assert len(notes) == damaged_lines, notes
    assert scan.rows() == undisturbed_scan.digests
    if image:
        assert scan.image() == undisturbed_scan.final_image
    facts = load_facts(scan.path)
    since = max(i for i, f in enumerate(facts) if f["fact"] == "scan_resumed")
    resumed = [f["row"] for f in facts[since:] if f["fact"] == "row_committed"]
    assert len(resumed) == len(set(resumed))
    started = [(e.row.index, e.take) for e in read_events(scan.path / "events.msgpack").events if is_row(e)]
    assert len(set(started)) == len(started), "a take was used twice"
    return set(resumed)


def is_row(event: object) -> bool:
    return isinstance(event, RowStarted)


@pytest.mark.parametrize("tail", [b"", PAGE], ids=["cut", "cut and zeros behind"])
@pytest.mark.parametrize("record", [-2, -1], ids=["row_committed", "scan_ended"])
def test_manifest(undisturbed_scan, tmp_path, draw_cases, record, tail):
    whole_lines = read_lines(undisturbed_scan.path / "manifest.jsonl")
    lines_before = b"".join(whole_lines[: len(whole_lines) + record])
    last = whole_lines[record]
    for cut in draw_cases(range(len(last)), 8):
        scan = undisturbed_scan.copy(tmp_path / "s")
        (scan.path / "manifest.jsonl").write_bytes(lines_before + last[:cut] + tail)
        assert list_faults(scan) == []
        incomplete_lines = [n for n in list_faults(scan, "note") if "incomplete" in n]
        assert len(incomplete_lines) == bool(last[:cut] + tail)
        assert resume(scan, undisturbed_scan, image=not cut) == ({2} if record == -2 else set())


@pytest.mark.parametrize("record", [1, -2, -1], ids=["row 0", "row 2, the last", "scan_ended"])
def test_bit_of_the_manifest(undisturbed_scan, tmp_path, draw_cases, record):
    whole_lines = read_lines(undisturbed_scan.path / "manifest.jsonl")
    offset = len(b"".join(whole_lines[:record]))
    for bit in draw_cases(range(8 * len(whole_lines[record])), 8):
        scan = undisturbed_scan.copy(tmp_path / "s")
        turn(scan.path / "manifest.jsonl", 8 * offset + bit)
        # Without its line end this line and the next are one.
        end = bit // 8 == len(whole_lines[record]) - 1
        named = list_faults(scan) + [n for n in list_faults(scan, "note") if "incomplete" in n or "damaged" in n]
        assert len(named) == 1
        # A damaged last line is cut off; other damaged lines stay where they are.
        is_kept = record == -1 or (record == -2 and end)
        resumed = resume(scan, undisturbed_scan, damaged_lines=0 if is_kept else 1)
        assert resumed == {1: {0, 1} if end else {0}, -2: {2}, -1: set()}[record]


def turn(path: Path, bit: int) -> None:
    """Flip one bit of a file."""
    raw = bytearray(path.read_bytes())
    raw[bit // 8] ^= 1 << bit % 8
    path.write_bytes(raw)


def list_event_ends(raw: bytes) -> list[int]:
    """Return the places of the log where an event ends, with 0."""
    unpacker = msgpack.Unpacker()
    unpacker.feed(raw)
    return [0, *(unpacker.tell() for _ in unpacker)]


@pytest.mark.parametrize("tail", [b"", PAGE], ids=["cut", "cut and zeros behind"])
@pytest.mark.parametrize("record", [1, 9], ids=["last", "a row's"])
def test_an_event_log_that_was_cut_is_completed_from_the_journal(undisturbed_scan, tmp_path, draw_cases, record, tail):
    """Events that the host has lost come from the Pi's journal; no row is retaken."""
    raw = (undisturbed_scan.path / "events.msgpack").read_bytes()
    start = list_event_ends(raw)[-1 - record]
    stop = list_event_ends(raw)[-record]
    for cut in draw_cases(range(start, stop), 8):
        scan = undisturbed_scan.copy(tmp_path / "s")
        (scan.path / "events.msgpack").write_bytes(raw[:cut] + tail)
        if record == 1:
            assert list_faults(scan) == []
        else:
            assert "resume fetches" in list_faults(scan)[0]
        assert len([n for n in list_faults(scan, "note") if "incomplete" in n]) == (cut > start or bool(tail))
        assert resume(scan, undisturbed_scan) == set()
        assert (scan.path / "events.msgpack").read_bytes()[: len(raw)] == raw


def test_a_flipped_bit_of_the_event_log_is_reported(undisturbed_scan, tmp_path, draw_cases):
    """The digest shows it if the log can still be read; otherwise the events come from the journal again."""
    raw = (undisturbed_scan.path / "events.msgpack").read_bytes()
    committed = load_facts(undisturbed_scan.path, "row_committed")[-1]["events"]["bytes"]
    for bit in draw_cases(range(8 * committed), 16):
        scan = undisturbed_scan.copy(tmp_path / "s")
        turn(scan.path / "events.msgpack", bit)
        events = (scan.path / "events.msgpack").read_bytes()
        readable = not read_events(scan.path / "events.msgpack").damage
        assert any("events.msgpack" in f for f in list_faults(scan)), bit
        if readable:
            continue
        assert resume(scan, undisturbed_scan) == set()
        assert (scan.path / "events.msgpack").read_bytes()[: len(raw)] == raw
        damaged_log = (scan.path / "events.msgpack.damaged").read_bytes()
        assert raw[: -len(damaged_log)] + damaged_log == events


@pytest.mark.parametrize("tail", [b"", PAGE], ids=["cut", "cut and zeros behind"])
@pytest.mark.parametrize("record", [1, 9], ids=["last", "a row's"])
def test_after_a_cut_of_the_journal_the_sequence_continues_after_the_host_s_last_event(
    undisturbed_scan, tmp_path, draw_cases, record, tail
):
    path = find_journal(undisturbed_scan)
    with path.open("rb") as file:
        starts = [offset for offset, _, _ in records(file)]
    raw = path.read_bytes()
    start = starts[-record]
    stop = [*starts, len(raw)][len(starts) - record + 1]
    for cut in draw_cases(range(start, stop), 8):
        scan = undisturbed_scan.copy(tmp_path / "s")
        find_journal(scan).write_bytes(raw[:cut] + tail)
        check_resumed_journal(scan, undisturbed_scan, lost=record)


def test_after_a_flipped_bit_of_the_journal_the_events_before_it_are_kept(undisturbed_scan, tmp_path, draw_cases):
    path = find_journal(undisturbed_scan)
    with path.open("rb") as file:
        starts = [offset for offset, _, _ in records(file)]
    for bit in draw_cases(range(8 * starts[0], 8 * path.stat().st_size), 16):
        scan = undisturbed_scan.copy(tmp_path / "s")
        turn(find_journal(scan), bit)
        check_resumed_journal(scan, undisturbed_scan, lost=sum(s > bit // 8 for s in starts[1:]) + 1)


@pytest.mark.parametrize(
    "remaining_content", [b"", b"PSJR", PAGE, None], ids=["empty", "torn magic", "zeros", "removed"]
)
def test_a_scan_resumes_after_its_whole_journal_was_lost(undisturbed_scan, tmp_path, remaining_content):
    scan = undisturbed_scan.copy(tmp_path / "s")
    if remaining_content is None:
        find_journal(scan).unlink()
    else:
        find_journal(scan).write_bytes(remaining_content)
    manifest_path = scan.path / "manifest.jsonl"
    # The scan was interrupted before row 2 was committed.
    manifest_path.write_bytes(b"".join(read_lines(manifest_path)[:-2]))
    events = len(read_events(scan.path / "events.msgpack").events)
    check_resumed_journal(scan, undisturbed_scan, lost=events, rows={2})


def check_resumed_journal(scan: SmallScan, undisturbed_scan, lost: int, rows: set[int] = frozenset()) -> None:
    """Resume: the host gets the number of events that the journal lost, and keeps all it had."""
    log_before = (scan.path / "events.msgpack").read_bytes()
    assert resume(scan, undisturbed_scan) == rows
    assert any(f"ends {lost} events before" in text for text in scan.messages)
    log_after = (scan.path / "events.msgpack").read_bytes()
    assert log_after.startswith(log_before)
    assert len(log_after) > len(log_before)
    with find_journal(scan).open("rb") as file:
        seqs = [seq for _, seq, _ in records(file)]
    assert seqs[-1] == read_events(scan.path / "events.msgpack").events[-1].seq


@pytest.mark.parametrize("suffix", [".bin", ".idx"])
def test_a_committed_row_that_was_cut_is_refused_and_retaken(undisturbed_scan, tmp_path, draw_cases, suffix):
    """`validate` names its file, so that damaged rows are never imaged."""
    name = f"raw/RV/0001{suffix}"
    raw = (undisturbed_scan.path / name).read_bytes()
    for cut in draw_cases([*range(0, len(raw) - PACKET, 97), *range(max(0, len(raw) - PACKET), len(raw))], 6):
        scan = undisturbed_scan.copy(tmp_path / "s")
        (scan.path / name).write_bytes(raw[:cut])
        assert [name in f for f in list_faults(scan)] == [True]
        if suffix == ".bin":
            with expect_refusal(ErrorCode.FILE_DAMAGED):
                _ = ScanFolder.load(scan.path).read_row("RV", 1).payload
        # Row 1 was retaken, and no other row.
        assert resume(scan, undisturbed_scan, image=not cut) == {1}
        withdrawn = load_facts(scan.path, "row_withdrawn")
        assert [(f["row"], f["take"]) for f in withdrawn] == [(1, 1)]
        assert name in withdrawn[0]["reasons"][0]


@pytest.mark.parametrize("suffix", [".bin", ".idx"])
def test_a_committed_row_with_a_flipped_bit_is_retaken(undisturbed_scan, tmp_path, draw_cases, suffix):
    name = f"raw/RH/0002{suffix}"
    for bit in draw_cases(range(8 * (undisturbed_scan.path / name).stat().st_size), 4):
        scan = undisturbed_scan.copy(tmp_path / "s")
        turn(scan.path / name, bit)
        assert [name in f for f in list_faults(scan)] == [True]
        assert resume(scan, undisturbed_scan) == {2}


@pytest.mark.parametrize("suffix", [".part", ".bin", ".idx"])
def test_files_of_a_row_that_is_not_committed_are_replaced_whatever_they_have(
    undisturbed_scan, tmp_path, draw_cases, suffix
):
    whole_lines = read_lines(undisturbed_scan.path / "manifest.jsonl")
    raw = (undisturbed_scan.path / f"raw/RV/0002{suffix.replace('part', 'bin')}").read_bytes()
    for cut in draw_cases(range(len(raw)), 4):
        scan = undisturbed_scan.copy(tmp_path / "s")
        (scan.path / "manifest.jsonl").write_bytes(b"".join(whole_lines[:-2]))
        (scan.path / f"raw/RV/0002{suffix}").write_bytes(raw[:cut])
        assert list_faults(scan) == []
        assert resume(scan, undisturbed_scan) == {2}
