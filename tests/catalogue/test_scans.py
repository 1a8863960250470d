"""The list of scans has their states; what has not changed is not read again."""

import json
import os
import shutil
import tracemalloc
from collections import deque
from pathlib import Path
from types import SimpleNamespace

import pytest
from msgspec import structs
from tests.support.page.live_view import open_control
from tests.support.products import write_judged_products
from tests.support.store.facts import load_facts

from polysight.catalogue import NOTES_FILE, PROGRAM_FOLDER, Notes, Scans, find_program, read_notes, scans, write_notes
from polysight.catalogue.scans import Program, explain_failure, is_scan
from polysight.results import NoResult
from polysight.store import MANIFEST, ScanFolder, manifest
from polysight_shared import files
from polysight_shared.errors import ConfigError, DataError


@pytest.fixture
def root(processed_scans: Path, tmp_path: Path) -> Path:
    """A folder with a finished scan, one that was stopped, one whose program died, and products without a scan."""
    for name in ("done", "week/stopped", "week/lost"):
        shutil.copytree(
            processed_scans / "one", tmp_path / name, ignore=shutil.ignore_patterns("raw", "samples", "figures")
        )
    facts = load_facts(tmp_path / "done")
    ended = {"fact": "scan_ended", "exit_status": "abort", "reason": "asked to", "rows_committed": 3}
    for name, kept_facts in (("week/stopped", [*facts[:4], ended]), ("week/lost", facts[:6])):
        (tmp_path / name / MANIFEST).write_bytes(b"".join(manifest.encode_line(f) for f in kept_facts))
        os.utime(tmp_path / name / MANIFEST, (1e9, 1e9))
    write_judged_products(tmp_path / "out" / "one", "none")
    (tmp_path / "empty").mkdir()
    return tmp_path


def test_a_folder_that_cannot_be_looked_into_holds_no_scan(tmp_path, monkeypatch):
    def refuse(path: Path) -> bool:
        raise PermissionError(path)

    monkeypatch.setattr(Path, "exists", refuse)
    assert not is_scan(tmp_path)


def test_every_scan_is_listed_with_its_state(root):
    summaries = {s.name: s for s in Scans(root).list()}
    # State, recorded rows, and rows of the plan
    assert {n: (s.state, s.committed, s.rows) for n, s in summaries.items()} == {
        "done": ("finished", 17, 17), "week/stopped": ("stopped", 3, 17), "week/lost": ("lost", 5, 17),
        "out/one": ("products", 0, 0),
    }  # fmt: skip
    assert summaries["done"].simulated
    assert summaries["done"].processed
    assert summaries["out/one"].verdict == "none"


def test_images_without_materials_are_not_a_result(root):
    """Such folders are left by a killed `process`, or made by `polysight image`."""
    (root / "done" / "products" / "materials.json").unlink()
    summary = Scans(root).summary("done")
    assert not summary.processed
    assert summary.images_only
    assert summary.verdict == ""
    assert summary.materials == ()


def test_a_scan_that_has_not_ended_runs_or_pauses_while_its_program_lives(root):
    scan = root / "week/lost"
    listed = Scans(root)
    with open_control(scan):
        assert listed.summary("week/lost").state == "running"
        with (scan / MANIFEST).open("ab") as f:
            f.write(manifest.encode_line({"fact": "scan_paused", "paused_utc": "2026-01-01T00:00:00Z"}))
        assert listed.summary("week/lost").state == "paused"
    os.utime(scan / MANIFEST, (1e9, 1e9))
    assert listed.summary("week/lost").state == "lost"


def test_rows_are_counted_as_the_scan_folder_counts_them(root):
    """The manifest has a row taken again, a withdrawn row, a damaged line, and a last line without its end."""
    path = root / "done" / MANIFEST
    facts = load_facts(path)
    facts_of_retake = [
        facts[5] | {"take": 2},
        {"fact": "row_withdrawn", "row": facts[2]["row"], "take": 1, "reasons": ["x"]},
    ]
    lines = [manifest.encode_line(f) for f in [*facts, *facts_of_retake]]
    lines[7] = lines[7].replace(b'"row":', b'"rov":')
    path.write_bytes(b"".join(lines) + b'{"fact":"row_committed","pulses":3,"row":999')
    summary = Scans(root).summary("done")
    assert summary.committed >= len(ScanFolder.load(root / "done").committed_rows())
    assert summary.committed <= summary.rows


def test_what_has_not_changed_is_not_read_again(root, monkeypatch):
    listed = Scans(root)
    first = listed.list()
    opened: list[str] = []
    monkeypatch.setattr(scans, "summarise", lambda _, name: opened.append(name))
    assert listed.list() == first
    assert opened == []


def backdate_files(root: Path) -> None:
    """Set all files' times to long ago, because files that were written a moment ago are read again."""
    for path in root.rglob("*"):
        os.utime(path, (1e9, 1e9))


def test_what_has_not_changed_is_not_read_again_after_a_restart(root, monkeypatch):
    index = root / ".polysight" / "list.json"
    backdate_files(root)
    scans_before = Scans(root, index=index).list()
    write_notes(root / "done", Notes("new"))
    read: list[str] = []
    summarise = scans.summarise
    monkeypatch.setattr(scans, "summarise", lambda folder, name: read.append(name) or summarise(folder, name))
    scans_after = Scans(root, index=index).list()
    assert read == ["done"]
    assert scans_after == Scans(root).list() != scans_before


def test_what_was_written_a_moment_ago_is_read_again_after_a_restart(root):
    """A file that is written twice within one step of its drive's clock keeps its time, and may keep its size."""
    index = root / ".polysight" / "list.json"
    backdate_files(root)
    write_notes(root / "done", Notes("cat"))
    written = (root / "done" / NOTES_FILE).stat()
    Scans(root, index=index).list()
    (root / "done" / NOTES_FILE).write_text((root / "done" / NOTES_FILE).read_text().replace("cat", "dog"))
    os.utime(root / "done" / NOTES_FILE, ns=(written.st_atime_ns, written.st_mtime_ns))
    assert Scans(root, index=index).summary("done").notes == "dog"


def test_a_list_cut_off_by_its_time_limit_continues_at_the_next_request(root):
    """The last name is read first, and entries are kept; the index is written only for complete lists."""
    complete_list = Scans(root).list()
    last = max(path.name for path in root.iterdir() if path.is_dir() and not path.name.startswith("."))
    index = root.parent / "index.json"
    scans = Scans(root, index=index)
    lists = [scans.list(within_s=0.0)]
    assert {s.name.partition("/")[0] for s in lists[0]} <= {last}
    while scans.unread:
        assert not index.exists()
        unread_before = scans.unread
        lists.append(scans.list(within_s=0.0))
        assert scans.unread < unread_before
        assert {s.name for s in lists[-2]} <= {s.name for s in lists[-1]}
    # Each request reads at least one folder.
    assert len(lists) > 2
    assert lists[-1] == complete_list
    assert index.exists()
    in_parts = Scans(root)
    in_parts.read_in_parts()
    assert in_parts.unread == 0
    assert in_parts.list() == complete_list


@pytest.mark.parametrize(("stuck", "threads"), [("", 1), ("out", 2), ("done", 1)])
def test_another_thread_continues_only_where_one_makes_no_progress(root, monkeypatch, stuck, threads):
    """A drive that does not answer stops one thread; a second one reads the folders that are left.

    `done` is the last folder that is read: after it no other one waits, and no second thread is begun.
    """
    all_names = {s.name for s in Scans(root).list()}
    begun = []

    class Worker:
        """A thread that reads one folder while it is waited for, and stays at the one named `stuck`."""

        def __init__(self, target, args, **_) -> None:
            self._read = target
            self._waiting, self._until_s = args
            self._is_stuck = False

        def start(self) -> None:
            begun.append(self)

        def is_alive(self) -> bool:
            return self._is_stuck or bool(self._waiting)

        def join(self, _) -> None:
            if self._is_stuck or not self._waiting:
                return
            entry = self._waiting.popleft()
            self._is_stuck = entry == stuck
            if not self._is_stuck:
                self._read(deque([entry]), self._until_s)

    listed = Scans(root)
    monkeypatch.setattr(scans, "threading", SimpleNamespace(Thread=Worker))
    assert {s.name for s in listed.list()} == {name for name in all_names if name.partition("/")[0] != stuck}
    assert len(begun) == threads


# The share of the index file that is left; with 1, its version is changed.
@pytest.mark.parametrize("kept_share", [0, 1, 0.5, 0.999])
def test_a_damaged_or_foreign_index_changes_no_list(root, kept_share):
    index = root / ".polysight" / "list.json"
    backdate_files(root)
    listed = Scans(root, index=index).list()
    content = index.read_bytes()
    assert Scans(root, index=index).list() == listed
    if kept_share == 1:
        index.write_bytes(content.replace(b'"version":1', b'"version":0').replace(b"finished", b"stopped"))
    else:
        index.write_bytes(content[: int(kept_share * len(content))])
    second_list = Scans(root, index=index).list()
    assert second_list == listed
    assert index.read_bytes() == content


def test_an_index_writes_through_no_link(root, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    (root / ".polysight").symlink_to(elsewhere)
    assert Scans(root, index=root / ".polysight" / "list.json").list()
    assert not list(elsewhere.iterdir())


def test_a_list_reads_no_rows(root, monkeypatch):
    opened: list[str] = []
    real = files.open_regular
    monkeypatch.setattr(files, "open_regular", lambda p: opened.append(str(p)) or real(p))
    Scans(root).list()
    assert opened
    assert not [p for p in opened if "raw" in p or "samples" in p or p.endswith(".npz")]


def test_damaged_scans_are_listed_and_break_nothing(root):
    for k, content in enumerate((b"", b"\0" * 500, b"{}\n", b'{"fact":"scan_started"}\n', os.urandom(3000))):
        (root / f"bad{k}").mkdir()
        (root / f"bad{k}" / MANIFEST).write_bytes(content)
    (root / "done" / "products" / "materials.json").write_text("[")
    (root / "done" / NOTES_FILE).write_text("{")
    summaries = {s.name: s for s in Scans(root).list()}
    assert {summaries[f"bad{k}"].state for k in range(5)} == {"damaged"}
    assert (summaries["done"].state, summaries["done"].verdict) == ("finished", "damaged")


def test_links_hidden_folders_and_unprintable_names_are_not_followed(root, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    shutil.copytree(root / "done", elsewhere / "secret")
    (root / "link").symlink_to(elsewhere / "secret")
    (root / ".hidden").mkdir()
    shutil.copytree(root / "done", root / ".hidden" / "one")
    shutil.copytree(root / "done", root / "a\u202eb")
    names = {s.name for s in Scans(root).list()}
    assert not names & {"link", ".hidden/one", "a\u202eb"}
    assert Scans(root).list_left_out() == ["a\\u202eb", "link"]
    for name in ("link", ".hidden/one", "../elsewhere", "", "done/", "done/products/..", "week"):
        with pytest.raises(DataError):
            Scans(root).folder(name)


def test_a_list_that_is_limited_to_one_scan_has_no_other(root):
    only_done = Scans(root, "done")
    assert [s.name for s in only_done.list()] == ["done"]
    with pytest.raises(DataError):
        only_done.folder("week/stopped")
    assert Scans(root, "not-yet").folder("not-yet") == root / "not-yet"


def test_notes_come_back_as_they_were_written(root):
    written = write_notes(root / "done", Notes("two\nlines, Eichenholz 木", ("oak", " oak ", "", "b")))
    assert written == read_notes(root / "done") == Notes("two\nlines, Eichenholz 木", ("oak", "b"))
    assert json.loads((root / "done" / NOTES_FILE).read_text(encoding="utf-8"))["tags"] == ["oak", "b"]
    assert Scans(root).summary("done").tags == ("oak", "b")
    assert "\u202e" not in write_notes(root / "done", Notes("a\u202eb\x00c", ("\x1b[31m",))).notes


@pytest.mark.parametrize("notes", [Notes("x" * 10_001), Notes("", ("y" * 41,)), Notes("", tuple(map(str, range(21))))])
def test_too_long_notes_are_refused(root, notes):
    with pytest.raises(ConfigError):
        write_notes(root / "done", notes)
    assert not (root / "done" / NOTES_FILE).exists()


def test_pipes_and_links_in_a_folder_keep_no_list_waiting(root, tmp_path_factory):
    victim = tmp_path_factory.mktemp("elsewhere") / "file"
    victim.write_text("as it was")
    for k, name in enumerate((MANIFEST, NOTES_FILE)):
        shutil.copytree(root / "done", root / f"odd{k}")
        (root / f"odd{k}" / name).unlink(missing_ok=True)
        os.mkfifo(root / f"odd{k}" / name)
    (root / "done" / f".{NOTES_FILE}.part").symlink_to(victim)
    summaries = {s.name: s for s in Scans(root).list()}
    assert (summaries["odd0"].state, summaries["odd1"].notes) == ("products", "")
    write_notes(root / "done", Notes("mine"))
    assert victim.read_text() == "as it was"
    assert read_notes(root / "done").notes == "mine"


def test_a_failure_is_reported_by_the_last_error_in_the_log_or_as_killed():
    program = Program("process", running=False, status=None, words=(), started_utc="", log="")
    killed = explain_failure(program)
    assert killed is not None
    assert killed.what == "polysight process was killed"
    log = "polysight process: an earlier one\n  why: old\npolysight process: no rows\n  why: none whole\n  do: scan\n"
    failed = explain_failure(structs.replace(program, status=1, log=log))
    assert failed is not None
    assert (failed.what, failed.why, failed.do) == ("no rows", "none whole", "scan")
    for status, running in ((0, False), (NoResult.exit_status, False), (None, True)):
        assert explain_failure(structs.replace(program, status=status, running=running, log=log)) is None


def test_of_a_huge_record_and_status_only_the_beginning_is_read(tmp_path):
    """Damaged files are replaced by sparse files of 64 MiB."""
    record = {"pid": 0, "ticks": 0, "words": [], "started_utc": ""}
    for name, content in (("scan.json", json.dumps(record)), ("scan.status", "7\n")):
        path = tmp_path / PROGRAM_FOLDER / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(content)
        os.truncate(path, 64 * 1024**2)
    tracemalloc.start()
    try:
        find_program(tmp_path, "scan")
        scans._read_status(tmp_path / PROGRAM_FOLDER / "scan.status")
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # A hundredth of the files
    assert peak_bytes < 1024**2
