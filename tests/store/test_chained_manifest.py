"""The chain of a manifest: a line has its number and the digest of the line before, which shows missing lines.

Lines count from 1 in messages. Line 1 is `scan_started`; the line of row k is line k + 2.
"""

import hashlib
import itertools
import json
from pathlib import Path

import pytest
from hypothesis import given, strategies as st
from tests.support.store.facts import load_facts, parse_fact
from tests.support.store.plain_scan import list_errors, write_scan

from polysight.store import manifest
from polysight.store.manifest import ManifestWriter, encode_line, parse
from polysight.store.scan_folder import MANIFEST, ScanFolder
from polysight.store.validation import to_text, validate

# Lines of a manifest.
FACTS = [{"fact": "scan_started"}, *({"fact": "row_committed", "row": k} for k in range(5)), {"fact": "scan_ended"}]


def make_chain_lines(path: Path, facts=FACTS) -> list[bytes]:
    """Write facts to a manifest; return its lines."""
    with ManifestWriter(path / MANIFEST, create=True) as writer:
        for fact in facts:
            writer.append(fact)
    return (path / MANIFEST).read_bytes().splitlines(keepends=True)


@pytest.fixture(scope="module")
def lines(tmp_path_factory) -> list[bytes]:
    return make_chain_lines(tmp_path_factory.mktemp("chain"))


def test_a_line_has_the_first_16_digits_of_the_sha_256_of_the_line_before(lines):
    """docs/spec/scan-folder.md describes the chain of lines for programs that check it themselves."""
    for before, line in itertools.pairwise(lines):
        assert json.loads(line)["previous"] == hashlib.sha256(before.rstrip(b"\n")).hexdigest()[:16]


@given(st.integers(0, len(FACTS) - 2), st.integers(1, 3))
def test_missing_lines_are_reported_and_the_others_are_valid(lines, first, count):
    # The last line stays, since only a later line can show that one is missing.
    remaining = [*lines[:first], *lines[min(first + count, len(FACTS) - 1) :]]
    content = parse(b"".join(remaining))
    assert len(content.facts) == len(remaining)
    (fault,) = content.faults
    assert fault.facts["line"] == first + 1
    assert fault.facts["lost"] == len(lines) - len(remaining)


def test_a_line_that_was_replaced_is_reported_at_the_next_line(lines):
    """The other line is valid in itself; the next one has the digest of the original line."""
    changed_fact = json.loads(lines[3])
    changed_fact["row"] = 77
    del changed_fact["crc"]
    content = parse(b"".join([*lines[:3], encode_line(changed_fact), *lines[4:]]))
    assert [f.facts["line"] for f in content.faults] == [5]
    assert "line before" in content.faults[0].what


def test_repeated_lines_are_reported(lines):
    # Lines 3 and 4 come again, as lines 5 and 6.
    content = parse(b"".join([*lines[:4], *lines[2:]]))
    assert [fault.facts["line"] for fault in content.faults] == [5]


@pytest.mark.parametrize("damage", [b"{}\n", b"\x00\xff\n", b""])
def test_a_damaged_line_is_one_fault_and_the_chain_continues_after_it(tmp_path, damage):
    lines = make_chain_lines(tmp_path)
    remaining = [*lines[:3], damage, *lines[4:]]
    (tmp_path / MANIFEST).write_bytes(b"".join(remaining))
    with ManifestWriter(tmp_path / MANIFEST, create=False) as writer:
        writer.append({"fact": "scan_resumed"})
    content = manifest.read(tmp_path / MANIFEST)
    assert content.facts[-1] == parse_fact({"fact": "scan_resumed"})
    assert [f.facts["line"] for f in content.faults] == [4]


def test_a_manifest_of_an_older_release_without_a_chain_is_read_and_continued_with_one(tmp_path):
    path = tmp_path / MANIFEST
    path.write_bytes(b"".join(map(encode_line, FACTS)))
    assert load_facts(path) == FACTS
    assert manifest.read(path).faults == []
    with ManifestWriter(path, create=False) as writer:
        writer.append({"fact": "scan_resumed"})
        writer.append({"fact": "scan_ended"})
    lines = path.read_bytes().splitlines(keepends=True)
    assert manifest.read(path).faults == []
    assert json.loads(lines[-1])["count"] == len(FACTS) + 1
    assert parse(b"".join([*lines[:2], *lines[3:]])).faults != []


# --- a scan folder --------------------------------------------------------------------------------------------------


LINE_OF_ROW_2 = 4


@pytest.fixture
def scan(tmp_path) -> Path:
    return write_scan(tmp_path / "scan")


def remove_line(folder: Path, *numbers: int) -> None:
    """Take lines (from 1) out of a manifest."""
    lines = (folder / MANIFEST).read_bytes().splitlines(keepends=True)
    (folder / MANIFEST).write_bytes(b"".join(line for n, line in enumerate(lines, 1) if n not in numbers))


def test_a_missing_line_of_a_row_is_an_error_that_names_line_and_row(scan):
    assert validate(scan) == []
    remove_line(scan, LINE_OF_ROW_2)
    error_text = "\n".join(list_errors(scan))
    assert f"manifest.jsonl line {LINE_OF_ROW_2}" in error_text
    assert "row 2 " in error_text
    folder = ScanFolder.load(scan)
    assert list(folder.rows()) == [0, 1, 3]
    assert {fault.facts["line"] for fault in folder.manifest_faults} == {LINE_OF_ROW_2}


def test_a_missing_line_of_the_last_row_is_detected_by_the_count_in_the_last_line(scan):
    lines = (scan / MANIFEST).read_bytes().splitlines()
    facts = [json.loads(line) for line in lines]
    # Without the chain, as an older release wrote it.
    unchained_facts = [{k: v for k, v in f.items() if k not in ("crc", "count", "previous")} for f in facts]
    (scan / MANIFEST).write_bytes(b"".join(encode_line(f) for f in unchained_facts if f.get("row") != 3))
    error_text = "\n".join(list_errors(scan))
    assert "scan_ended counts 4 rows" in error_text
    assert "row 3 " in error_text


def test_a_missing_line_whose_row_was_retaken_is_only_a_note(scan):
    lost_row = load_facts(scan, "row_committed")[2]
    remove_line(scan, LINE_OF_ROW_2)
    with ScanFolder.load(scan).writer() as writer:
        writer.append({"fact": "scan_resumed", "rows_missing": 1})
        writer.append({**lost_row, "take": 2})
        writer.append({"fact": "scan_ended", "exit_status": "success", "reason": "", "rows_committed": 4})
    assert list_errors(scan) == []
    assert f"line {LINE_OF_ROW_2}" in "\n".join(map(to_text, validate(scan)))


def test_a_row_withdrawn_after_the_end_is_not_a_fault_of_the_manifest(scan):
    with ScanFolder.load(scan).writer() as writer:
        writer.append({"fact": "row_withdrawn", "row": 1, "take": 1, "reasons": ["its file changed"]})
    assert ScanFolder.load(scan).manifest_faults == ()
