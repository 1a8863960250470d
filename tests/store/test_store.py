"""Manifest, scan folder and events are read as written; each kind of damage is found by `validate`.

A line of the manifest is a *fact*; the manifest, the rows and the log of the Pi's events make a scan folder.
"""

import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from tests.support.acquisition.fake_rig import make_small_instrument
from tests.support.refusals import expect_refusal
from tests.support.store.facts import load_facts, parse_fact
from tests.support.store.plain_scan import write_scan

from polysight.store import manifest
from polysight.store.logs import EventWriter, crc32, read_events
from polysight.store.manifest import ManifestWriter, RowCommitted, ScanResumed, encode_line, parse
from polysight.store.scan_folder import ScanFolder
from polysight.store.source import RawSource, allocate_pages, split_pieces
from polysight.store.validation import to_json, validate
from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.messages import Fault
from polysight_shared.raster import plan_raster

# Bytes for a log of events, which is a sequence of msgpack maps: a code that msgpack never uses, twice; an empty map;
# and the first two bytes of a map of four items, whose first key would be a text of four bytes.
NOT_MSGPACK = b"\xc1\xc1"
EMPTY_MAP = b"\x80"
TORN_EVENT = b"\x84\xa4"

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)
free_keys = st.text(max_size=6).filter(lambda key: key not in ("fact", "crc"))
facts = st.dictionaries(free_keys, json_values, max_size=4).map(lambda content: {**content, "fact": "row_committed"})


@given(st.lists(facts, max_size=4))
def test_a_manifest_has_the_facts_that_were_written(facts):
    raw = b"".join(map(encode_line, facts))
    content = parse(raw)
    assert content.facts == [parse_fact(fact) for fact in facts]
    assert content.length == len(raw)
    assert not content.torn
    assert content.faults == []


@given(st.lists(facts, min_size=1, max_size=3), st.data())
def test_a_line_with_a_flipped_bit_is_never_read_as_another_fact(facts, data):
    """The line is refused, unless the bit does not change its meaning (such as E for e in 1e5)."""
    lines = [encode_line(f) for f in facts]
    line_number = data.draw(st.integers(0, len(lines) - 1))
    bad = bytearray(lines[line_number])
    bit = data.draw(st.integers(0, 8 * len(bad) - 1))
    bad[bit // 8] ^= 1 << bit % 8
    lines[line_number] = bytes(bad)
    content = parse(b"".join(lines))
    if content.torn or content.faults:
        assert len(content.facts) < len(facts)
    else:
        assert content.facts == [parse_fact(fact) for fact in facts]


def test_after_every_truncation_the_lines_before_it_are_valid_and_the_chain_continues(tmp_path):
    facts = [{"fact": "scan_paused"}, {"fact": "row_withdrawn", "row": 0}, {"fact": "scan_ended", "reason": "é"}]
    path = tmp_path / "manifest.jsonl"
    line_ends = []
    with ManifestWriter(path, create=True) as writer:
        for fact in facts:
            writer.append(fact)
            line_ends.append(path.stat().st_size)
    raw = path.read_bytes()
    for size in range(len(raw) + 1):
        whole_lines = sum(line_end <= size for line_end in line_ends)
        whole_facts = [parse_fact(fact) for fact in facts[:whole_lines]]
        is_within_line = size not in (0, *line_ends)
        content = parse(raw[:size])
        assert content.facts == whole_facts
        assert content.torn == is_within_line
        assert content.faults == []
        path.write_bytes(raw[:size])
        with ManifestWriter(path, create=False) as writer:
            writer.append({"fact": "scan_resumed"})
        restored = manifest.read(path)
        assert restored.facts == [*whole_facts, ScanResumed()]
        assert not restored.torn
        assert restored.faults == []


def test_two_writers_never_share_a_scan(tmp_path):
    path = tmp_path / "manifest.jsonl"
    with ManifestWriter(path, create=True):
        with expect_refusal(ErrorCode.BUSY):
            ManifestWriter(path, create=False)
        with expect_refusal(ErrorCode.FILE_EXISTS):
            ManifestWriter(path, create=True)
    ManifestWriter(path, create=False).close()


# Missing byte ranges (start, stop) of row 1 of board RV.
MISSING = [(100, 200), (5000, 6000)]


@pytest.fixture
def whole_scan(tmp_path) -> Path:
    """A scan folder of four rows; row 1 of board RV lacks some bytes."""
    return write_scan(tmp_path / "scan", {("RV", 1): MISSING})


def test_a_scan_without_damage_is_valid_and_read_with_its_missing_bytes(whole_scan):
    assert validate(whole_scan) == []
    scan: RawSource = ScanFolder.load(whole_scan)
    assert list(scan.rows()) == [0, 1, 2, 3]
    assert scan.simulated
    row = 1
    data = scan.read_row("RV", row)
    missing_bytes = sum(stop - start for start, stop in MISSING)
    assert data.missing == MISSING
    assert data.missing_bytes == missing_bytes
    assert data.mask is not None
    assert data.mask.sum() == missing_bytes
    # `write_scan` gives every byte of a row the number of the row, plus one.
    assert (data.payload[~data.mask] == row + 1).all()
    assert data.frames_expected == scan.instrument.burst.pulses * scan.instrument.grid.columns


def test_of_several_takes_of_a_row_the_last_is_read(whole_scan):
    scan = ScanFolder.load(whole_scan)
    fact = load_facts(scan, "row_committed")[2]
    with scan.writer() as writer:
        writer.append({**fact, "take": 7})
    scan.reload()
    assert scan.committed_rows()[2].take == 7
    assert len(scan.committed_rows()) == 4


class RowsThatGrow(dict):
    """Committed rows of a manifest to which another thread adds `line` just after they were first copied."""

    content: manifest.Manifest
    line: bytes

    def copy(self) -> dict:
        rows = dict(self)
        if self.line:
            line = self.line
            self.line = b""
            self.content.feed(line)
        return rows


def test_a_row_that_is_committed_while_rows_are_read_is_there_at_the_next_reading(whole_scan):
    lines = (whole_scan / "manifest.jsonl").read_bytes().splitlines(keepends=True)
    (number_of_last_row,) = [n for n, line in enumerate(lines) if b'"row_committed"' in line and b'"row":3,' in line]
    content = parse(b"".join(lines[:number_of_last_row]))
    scan = ScanFolder(whole_scan, content)
    content.rows = RowsThatGrow(content.rows)
    content.rows.content = content
    content.rows.line = lines[number_of_last_row]
    assert list(scan.committed_rows()) == [0, 1, 2]
    assert list(scan.committed_rows()) == [0, 1, 2, 3]


def flip(path: Path, offset: int = 50) -> None:
    """Flip one bit of the byte at `offset` from the start of the file; negative: from its end."""
    raw = bytearray(path.read_bytes())
    raw[offset] ^= 1
    path.write_bytes(raw)


# The last two lines of the manifest of `write_scan` are those of row 3 and of the scan's end, with 432 and 134 bytes.
# This is the offset from the end of the file to a byte in the line of row 3.
IN_LINE_OF_ROW_3 = -400
# The first line has more than 3,000 bytes. This is the offset of one of them from the start of the file.
IN_FIRST_LINE = 40
# A change of the scan folder, the place that the error names, and a word of the error's text.
DAMAGE = {
    "flipped bit in a row": (lambda p: flip(p / "raw/RH/0002.bin"), "raw/RH/0002.bin", "CRC"),
    "truncated row": (lambda p: (p / "raw/RV/0000.bin").write_bytes(b"x"), "raw/RV/0000.bin", "1 bytes"),
    "absent row": (lambda p: (p / "raw/RV/0003.bin").unlink(), "raw/RV/0003.bin", "cannot be read"),
    "flipped bit in an index": (lambda p: flip(p / "raw/RV/0001.idx", offset=5), "raw/RV/0001.idx", "CRC"),
    "absent index": (lambda p: (p / "raw/RV/0001.idx").unlink(), "raw/RV/0001.idx", "absent"),
    "flipped bit in the manifest": (
        lambda p: flip(p / "manifest.jsonl", IN_LINE_OF_ROW_3), "manifest.jsonl line", "damaged"
    ),
    "flipped bit in the first line": (
        lambda p: flip(p / "manifest.jsonl", IN_FIRST_LINE), "manifest.jsonl", "scan_started"
    ),
    "damaged events": (lambda p: (p / "events.msgpack").write_bytes(NOT_MSGPACK), "events.msgpack", "not msgpack"),
    "foreign events": (lambda p: (p / "events.msgpack").write_bytes(EMPTY_MAP), "events.msgpack", "damaged"),
}  # fmt: skip


@pytest.mark.parametrize("kind", DAMAGE)
def test_validate_names_each_damage(whole_scan, kind):
    damage, place, description = DAMAGE[kind]
    damage(whole_scan)
    errors = [finding for finding in validate(whole_scan) if finding.level == "error"]
    assert any(place in error.where and description in error.what for error in errors), to_json(errors)


def test_events_after_the_last_commit_may_be_damaged_by_a_power_cut(undisturbed_scan, tmp_path):
    """These events were not synced, and the Pi's journal has them. Damage of earlier events is an error."""
    scan = undisturbed_scan.copy(tmp_path / "scan")
    log = scan.path / "events.msgpack"
    last_commit = ScanFolder.load(scan.path).facts(RowCommitted)[-1]
    committed_bytes = last_commit.events.bytes
    assert log.stat().st_size > committed_bytes
    flip(log, committed_bytes + 1)
    assert {finding.level for finding in validate(scan.path)} == {"note"}
    flip(log, committed_bytes - 1)
    assert "error" in {finding.level for finding in validate(scan.path)}


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"row": 9}, "outside"),
        ({"direction": -1}, "direction"),
        ({"pulses": 1}, "pulses"),
        ({"boards": {}}, "boards"),
    ],
)
def test_validate_reports_rows_that_disagree_with_the_plan(whole_scan, change, word):
    scan = ScanFolder.load(whole_scan)
    fact = load_facts(scan, "row_committed")[0]
    with scan.writer() as writer:
        writer.append({**fact, **change})
    errors = [finding for finding in validate(whole_scan) if finding.level == "error"]
    assert any(word in error.what for error in errors)


def test_files_that_an_interrupted_program_leaves_are_only_notes(whole_scan):
    """There are four notes: torn last line, file of a row that was being written, torn event, scan without its end."""
    raw = (whole_scan / "manifest.jsonl").read_bytes()
    without_end_of_last_line = raw[:-5]
    (whole_scan / "manifest.jsonl").write_bytes(without_end_of_last_line)
    (whole_scan / "raw/RH/0009.part").write_bytes(b"half")
    with (whole_scan / "events.msgpack").open("ab") as f:
        f.write(TORN_EVENT)
    notes = validate(whole_scan)
    assert {note.level for note in notes} == {"note"}
    assert len(notes) == 4
    assert "0009.part" in str(notes)


def test_a_scan_that_is_being_recorded_has_not_ended(whole_scan):
    """Future rows, the row that is recorded now and a half-written line are not faults; a damaged row is one."""
    first_line, line_of_row_0, line_of_row_1, line_of_row_2, *_ = (
        (whole_scan / "manifest.jsonl").read_bytes().splitlines(keepends=True)
    )
    (whole_scan / "manifest.jsonl").write_bytes(first_line + line_of_row_0 + line_of_row_1)
    (whole_scan / "raw/RH/0002.part").write_bytes(b"half")
    with ScanFolder.load(whole_scan).writer():
        with (whole_scan / "manifest.jsonl").open("ab") as f:
            f.write(line_of_row_2[:20])
        with (whole_scan / "events.msgpack").open("ab") as f:
            f.write(TORN_EVENT)
        (note,) = validate(whole_scan)
        assert note.level == "note"
        assert "2 of 4 rows" in note.what
        flip(whole_scan / "raw/RH/0001.bin")
        assert [finding.level for finding in validate(whole_scan)] == ["error", "note"]
    # The program has ended, so that the missing rows are a fault now.
    remedies = [finding.do for finding in validate(whole_scan)]
    assert any("resume" in remedy for remedy in remedies)


def test_a_damaged_row_and_one_that_does_not_exist_are_not_read(whole_scan):
    flip(whole_scan / "raw/RH/0002.bin")
    scan = ScanFolder.load(whole_scan)
    with expect_refusal(ErrorCode.FILE_DAMAGED, "0002.bin"):
        _ = scan.read_row("RH", 2).payload
    with expect_refusal(ErrorCode.FILE_DAMAGED, "0002.bin"):
        for _ in scan.read_row("RH", 2).pieces(100):
            pass
    with expect_refusal(ErrorCode.NO_DATA):
        scan.read_row("LS", 2)
    with expect_refusal(ErrorCode.NO_DATA):
        scan.read_row("RH", 17)


@pytest.mark.parametrize("size", [1, 4096, 2 << 20])
def test_memory_to_read_a_file_into_starts_at_a_page(size):
    page_bytes = 4096
    memory = allocate_pages(size)
    assert memory.size == size
    assert memory.ctypes.data % page_bytes == 0
    # All of the memory can be written.
    memory[:] = 255


# 0 stands for the whole payload in one piece.
@pytest.mark.parametrize("size", [1, 7, 100, 1 << 20, 0])
def test_pieces_of_any_size_are_the_payload(whole_scan, size):
    row = ScanFolder.load(whole_scan).read_row("RH", 1)
    payload = (whole_scan / "raw/RH/0001.bin").read_bytes()
    assert row.payload.tobytes() == payload
    pieces_of_file = row.pieces(size)
    assert b"".join(piece.tobytes() for piece in pieces_of_file) == payload
    split_into = split_pieces(row.payload)
    pieces_of_memory = split_into(size)
    assert b"".join(piece.tobytes() for piece in pieces_of_memory) == payload


def test_folders_without_a_valid_first_line_of_a_manifest_are_refused(whole_scan, tmp_path):
    with expect_refusal(ErrorCode.FILE_MISSING):
        validate(tmp_path / "nothing")
    (whole_scan / "manifest.jsonl").write_bytes(b"")
    with expect_refusal(ErrorCode.FILE_DAMAGED, "scan_started"):
        ScanFolder.load(whole_scan)
    (whole_scan / "manifest.jsonl").write_bytes(encode_line({"fact": "scan_started", "instrument": {}, "plan": {}}))
    with pytest.raises(ConfigError):
        ScanFolder.load(whole_scan)
    assert validate(whole_scan)[0].level == "error"


@settings(deadline=None, max_examples=30)
@given(st.data())
def test_truncated_events_continue_after_the_last_whole_one(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("e") / "events.msgpack"
    writer = EventWriter(path)
    events = [Fault(scan_id="s", seq=k, t_mono_ns=k, number=1, problem="x" * k) for k in range(1, 5)]
    for event in events:
        writer.append(event)
    writer.sync()
    writer.close()
    raw = path.read_bytes()
    cut = data.draw(st.integers(0, len(raw)))
    path.write_bytes(raw[:cut])
    log = read_events(path)
    whole_events = len(log.events)
    assert log.events == events[:whole_events]
    has_bytes_after_whole_events = log.length < path.stat().st_size
    assert log.torn == has_bytes_after_whole_events
    writer = EventWriter(path)
    assert writer.last_seq == whole_events
    for event in events[whole_events:]:
        writer.append(event)
    writer.sync()
    writer.close()
    assert path.read_bytes() == raw


def test_damaged_events_that_are_cut_off_are_kept_in_a_file_of_their_own(tmp_path):
    path = tmp_path / "events.msgpack"
    writer = EventWriter(path)
    writer.append(Fault(scan_id="s", seq=1, t_mono_ns=1, number=1, problem="x"))
    writer.sync()
    writer.close()
    for cut_off in (TORN_EVENT, NOT_MSGPACK, b""):
        with path.open("ab") as file:
            file.write(cut_off)
        EventWriter(path).close()
    assert (tmp_path / "events.msgpack.damaged").read_bytes() == TORN_EVENT + NOT_MSGPACK


def test_a_scan_can_begin_in_a_folder_whose_first_line_was_never_completed(tmp_path):
    instrument = make_small_instrument()
    for torn in (b"", b'{"fact":"scan_star'):
        (tmp_path / "manifest.jsonl").write_bytes(torn)
        assert ScanFolder.create(tmp_path, instrument, plan_raster(instrument.grid)).committed_rows() == {}
        (tmp_path / "manifest.jsonl").unlink()


@given(st.binary(max_size=3000))
def test_the_crc_is_that_of_zlib(data):
    assert crc32(data) == zlib.crc32(data)
    assert crc32(np.frombuffer(data, np.uint8).data) == zlib.crc32(data)
