"""Limits of the list of scans: names, depth of folders, age of files in the index, lengths of logs and notes."""

from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest
from tests.support.refusals import expect_refusal

from polysight.catalogue import NOTES_FILE, Notes, Scans, read_notes, scans as scans_module, write_notes
from polysight.catalogue.scans import (
    Program,
    Summary,
    add_signs_of_life,
    explain_failure,
    folder_bytes,
    read_index,
    read_log_tail,
    write_index,
)
from polysight_shared.errors import ConfigError, ErrorCode


def make_scan(root: Path, name: str) -> Path:
    """A folder in which a page has started a program: it is listed, though nothing was recorded."""
    (root / name / "program").mkdir(parents=True)
    return root / name


def test_scans_are_found_four_levels_deep(tmp_path):
    names = ["a", "b/b", "c/c/c", "d/d/d/d", "e/e/e/e/e"]
    for name in names:
        make_scan(tmp_path, name)
    assert sorted(summary.name for summary in Scans(tmp_path).list()) == names[:4]
    for name in names[:4]:
        assert Scans(tmp_path).folder(name) == tmp_path / name
    with expect_refusal(ErrorCode.PATH_OUTSIDE):
        Scans(tmp_path).folder(names[4])


@pytest.mark.parametrize(
    ("name", "is_listed"),
    [
        ("x" * 200, True), ("x" * 201, False), ("with space", True), ("ä", True), (".hidden", False),
        ("back\\slash", False), ("tab\tinside", False), ("turned\u202earound", False),
    ],
)  # fmt: skip
def test_a_name_that_a_page_can_show_is_listed(tmp_path, name, is_listed):
    make_scan(tmp_path, name)
    assert [summary.name for summary in Scans(tmp_path).list()] == ([name] if is_listed else [])
    if is_listed:
        assert Scans(tmp_path).folder(name) == tmp_path / name
    else:
        with expect_refusal(ErrorCode.PATH_OUTSIDE):
            Scans(tmp_path).folder(name)


@pytest.mark.parametrize("name", ["", "/", "a/", "/a", "a//a", "..", "a/../a", "a/.", "."])
def test_a_name_has_only_parts_that_are_names(tmp_path, name):
    make_scan(tmp_path, "a")
    with expect_refusal(ErrorCode.PATH_OUTSIDE):
        Scans(tmp_path).folder(name, new=True)


def test_the_folder_of_a_new_scan_need_not_exist(tmp_path):
    make_scan(tmp_path, "a")
    assert Scans(tmp_path).folder("new", new=True) == tmp_path / "new"
    with expect_refusal(ErrorCode.FILE_MISSING, "does not exist"):
        Scans(tmp_path).folder("new")
    (tmp_path / "empty").mkdir()
    with expect_refusal(ErrorCode.FILE_MISSING, "nothing was recorded"):
        Scans(tmp_path).folder("empty")
    # No scan is made inside of another one.
    with expect_refusal(ErrorCode.FILE_MISSING, "inside the scan a"):
        Scans(tmp_path).folder("a/new", new=True)
    one_scan = Scans(tmp_path, only="later")
    assert one_scan.folder("later") == tmp_path / "later"
    with expect_refusal(ErrorCode.PATH_OUTSIDE):
        one_scan.folder("a")


@pytest.mark.parametrize(
    ("ages_s", "is_kept"), [((10.0, 10.0), True), ((2.5, 10.0), True), ((10.0, 1.5), False), ((-100.0, 10.0), False)]
)
def test_an_index_keeps_what_was_written_more_than_two_seconds_ago(tmp_path, monkeypatch, ages_s, is_kept):
    """A scan has two files here. A younger file, or one from the future, may change without a new time stamp."""
    # Any time of this century.
    now_ns = 1_800_000_000_000_000_000
    monkeypatch.setattr(scans_module, "time", SimpleNamespace(time=lambda: now_ns / 1e9))
    stamp = tuple((now_ns - int(age_s * 1e9), 1) for age_s in ages_s)
    write_index(tmp_path / "list.json", {"a": (stamp, Summary("a", "begun"))})
    assert (read_index(tmp_path / "list.json") != {}) == is_kept


@pytest.mark.parametrize("step", [1, -1])
def test_an_index_of_another_version_is_not_read(tmp_path, step):
    path = tmp_path / "list.json"
    write_index(path, {"a": (((1, 1),), Summary("a", "begun"))})
    assert list(read_index(path)) == ["a"]
    content = msgspec.json.decode(path.read_bytes())
    path.write_bytes(msgspec.json.encode(content | {"version": content["version"] + step}))
    assert read_index(path) == {}


def test_the_size_of_a_folder_is_that_of_all_its_files(tmp_path):
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "one").write_bytes(bytes(1000))
    (tmp_path / "a" / "b" / "two").write_bytes(bytes(24))
    assert folder_bytes(tmp_path / "a") == 1024
    assert folder_bytes(tmp_path / "missing") == 0


def make_program(log: str, status: int | None = 1, running: bool = False) -> Program:
    return Program("process", running, status, ("polysight", "process"), "2026-01-01T00:00:00", log)


def test_the_last_error_of_a_log_has_its_cause_and_remedy():
    log = (
        "polysight process: first\n  why: one\n  do: two\n  10 % done\n"
        "polysight process: second: with a colon\n  why: three: four\n  do: five\n  also: six\n"
    )
    finding = explain_failure(make_program(log))
    assert finding is not None
    assert (finding.what, finding.why, finding.do) == ("second: with a colon", "three: four", "five")
    finding = explain_failure(make_program("polysight process: alone"))
    assert finding is not None
    assert (finding.what, finding.why, finding.do) == ("alone", "", "")
    finding = explain_failure(make_program("working\nsegmentation fault\n"))
    assert finding is not None
    assert finding.what == "segmentation fault"
    finding = explain_failure(make_program(""))
    assert finding is not None
    assert "without a message" in finding.what


def test_a_long_error_is_cut():
    log = f"polysight process: {'a' * 400}\n  why: {'b' * 600}\n  do: {'c' * 600}"
    finding = explain_failure(make_program(log))
    assert finding is not None
    # The page shows texts of these lengths in a few lines.
    assert (len(finding.what), len(finding.why), len(finding.do)) == (300, 500, 500)
    finding = explain_failure(make_program("d" * 400))
    assert finding is not None
    assert len(finding.what) == 300


@pytest.mark.parametrize(
    ("status", "running", "failed"), [(1, False, True), (2, False, True), (0, False, False), (1, True, False)]
)
def test_only_a_program_that_ended_with_an_error_has_failed(status, running, failed):
    program = make_program("polysight process: wrong", status, running)
    assert (explain_failure(program) is not None) == failed
    assert explain_failure(None) is None


def test_of_a_log_the_last_16_kib_since_the_last_start_are_read(tmp_path):
    """Colours of a terminal, other control characters and carriage returns are removed from it."""
    log = tmp_path / "scan.log"
    log.write_bytes(b"old\n--- started 1\nolder\n--- started 2\nfirst\r\n\x1b[1;31mred\x1b[0m\x07\n\tindented\n")
    assert read_log_tail(log) == "first\nred\n\tindented"
    limit_bytes = 16 * 1024
    log.write_bytes(b"first" + b"." * 20_000 + b"last")
    assert len(read_log_tail(log)) == limit_bytes
    assert read_log_tail(log).endswith("..last")
    log.write_bytes(b"a" * limit_bytes)
    assert read_log_tail(log) == "a" * limit_bytes
    assert read_log_tail(tmp_path / "none") == ""


@pytest.mark.parametrize("state", ["finished", "stopped", "products", "damaged", "failed"])
def test_a_scan_that_has_ended_needs_no_sign_of_life(tmp_path, state):
    summary = Summary("a", state)
    assert add_signs_of_life(tmp_path, summary) == summary


def test_a_scan_whose_program_failed_has_the_reason(tmp_path):
    folder = make_scan(tmp_path, "a")
    assert add_signs_of_life(folder, Summary("a", "begun")).state == "begun"
    # Linux numbers processes up to 2^22 - 1: no process has this number.
    record = {"pid": 1 << 22, "ticks": 1, "words": ["x", "-m", "polysight", "scan"], "started_utc": "2026-01-01"}
    (folder / "program" / "scan.json").write_bytes(msgspec.json.encode(record))
    (folder / "program" / "scan.status").write_text("1\n")
    (folder / "program" / "scan.log").write_text("polysight scan: no Pi\n")
    summary = add_signs_of_life(folder, Summary("a", "begun"))
    assert (summary.state, summary.reason) == ("failed", "no Pi")
    (folder / "program" / "scan.status").write_text("0\n")
    assert add_signs_of_life(folder, Summary("a", "begun")).state == "begun"


@pytest.mark.parametrize(
    ("notes", "is_taken"),
    [
        (Notes("x" * 10_000), True), (Notes("x" * 10_001), False), (Notes("", ("x" * 40,)), True),
        (Notes("", ("x" * 41,)), False), (Notes("", tuple(map(str, range(20)))), True),
        (Notes("", tuple(map(str, range(21)))), False),
    ],
)  # fmt: skip
def test_notes_and_tags_have_a_length_that_a_list_can_show(tmp_path, notes, is_taken):
    if is_taken:
        assert write_notes(tmp_path, notes) == read_notes(tmp_path) == notes
        return
    with pytest.raises(ConfigError):
        write_notes(tmp_path, notes)
    assert not (tmp_path / NOTES_FILE).exists()


def test_a_file_of_notes_that_is_too_long_to_be_ours_is_ignored(tmp_path):
    """The longest notes that are accepted take 44 kB; the limit is 128 KiB."""
    limit_bytes = 128 * 1024
    text = '{"notes": "a"}'
    (tmp_path / NOTES_FILE).write_text(text.ljust(limit_bytes))
    assert read_notes(tmp_path).notes == "a"
    (tmp_path / NOTES_FILE).write_text(text.ljust(limit_bytes + 1))
    assert read_notes(tmp_path) == Notes()


def test_tags_are_cleaned_and_written_once(tmp_path):
    written = write_notes(tmp_path, Notes("line\none\x07", (" wet ", "dry", "wet", "", "\x1b")))
    assert written == Notes("line\none", ("wet", "dry"))
