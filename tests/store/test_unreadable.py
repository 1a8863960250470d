"""Errors of the disk are reported as such, and no recorded row is lost.

A row that cannot be read now is not retaken, an error of a lock does not mean that the scan is in use, and a scan whose
disk was full can be resumed.
"""

import errno
import os
import shutil
from pathlib import Path

import pytest
from tests.support.refusals import expect_refusal
from tests.support.store.facts import load_facts
from tests.support.store.faulty_disk import NEED_SPACE, FaultyDisk
from tests.support.store.plain_scan import list_errors
from tests.support.store.small_scan import Samples, SmallScan

from polysight.store import manifest, validation
from polysight.store.manifest import ManifestWriter
from polysight.store.scan_folder import ScanFolder
from polysight.store.validation import validate
from polysight_shared.errors import ErrorCode, PolysightError


def test_an_error_of_a_lock_is_not_reported_as_a_scan_in_use(tmp_path, monkeypatch):
    path = tmp_path / "manifest.jsonl"
    ManifestWriter(path, create=True).close()

    def refuse_lock(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(manifest.fcntl, "flock", refuse_lock)
    with expect_refusal(ErrorCode.FILE_UNWRITABLE, os.strerror(errno.ENOLCK)):
        ManifestWriter(path, create=False)


@pytest.mark.parametrize("suffix", [".bin", ".idx"])
@pytest.mark.parametrize("error_number", [errno.EIO, errno.ESTALE])
def test_a_row_that_cannot_be_read_now_is_not_withdrawn(undisturbed_scan, monkeypatch, suffix, error_number):
    scan = ScanFolder.load(undisturbed_scan.path)
    board = next(iter(scan.committed_rows()[0].boards.values()))
    unreadable_file = (undisturbed_scan.path / board.file).with_suffix(suffix)
    path_open = Path.open
    path_read = Path.read_bytes

    def raise_if_unreadable(path: Path) -> None:
        if path == unreadable_file:
            raise OSError(error_number, os.strerror(error_number))

    def open_or_raise(path: Path, *arguments, **options):
        raise_if_unreadable(path)
        return path_open(path, *arguments, **options)

    def read_or_raise(path: Path) -> bytes:
        raise_if_unreadable(path)
        return path_read(path)

    monkeypatch.setattr(Path, "open", open_or_raise)
    monkeypatch.setattr(Path, "read_bytes", read_or_raise)
    with expect_refusal(ErrorCode.FILE_UNREADABLE, os.strerror(error_number)) as e:
        validation.find_damaged_rows(scan)
    assert f"polysight resume {undisturbed_scan.path}" in e.value.remedy
    unreadable_name = str(unreadable_file.relative_to(undisturbed_scan.path))
    assert [f.where for f in validation.validate(undisturbed_scan.path)] == [unreadable_name]


def test_a_row_without_its_file_is_taken_again(undisturbed_scan, monkeypatch):
    scan = ScanFolder.load(undisturbed_scan.path)
    missing_file = undisturbed_scan.path / next(iter(scan.committed_rows()[1].boards.values())).file
    path_open = Path.open

    def open_unless_missing(path: Path, *arguments, **options):
        if path == missing_file:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        return path_open(path, *arguments, **options)

    monkeypatch.setattr(Path, "open", open_unless_missing)
    assert list(validation.find_damaged_rows(scan)) == [1]


def list_operations_that_need_space(samples: Samples, folder: Path, subfolder: str) -> list[int]:
    """Return the numbers of those disk operations of a scan in this subfolder that need space."""
    folder.mkdir()
    disk = FaultyDisk(folder / subfolder)
    with disk():
        SmallScan(samples, folder).run()
    return [i for i, description in enumerate(disk.done, 1) if description.split()[0] in NEED_SPACE]


def run_on_disk(scan: SmallScan, disk: FaultyDisk) -> PolysightError | None:
    """Run the scan on a faulty disk; return its error, None if it has none."""
    try:
        with disk():
            scan.run()
    except PolysightError as e:
        return e
    return None


# From the drawn operation on, the disk is full. With "short", half of its bytes are still written.
@pytest.mark.parametrize("fault", ["full", "short"])
@pytest.mark.parametrize("full_subfolder", ["scan", "journal"])
def test_a_full_disk_is_an_error_and_no_committed_row_is_lost(
    samples, undisturbed_scan, tmp_path, draw_cases, fault, full_subfolder
):
    failures = 0
    operations = list_operations_that_need_space(samples, tmp_path / "count", full_subfolder)
    for operation in draw_cases(operations, 10):
        folder = tmp_path / str(operation)
        folder.mkdir()
        scan = SmallScan(samples, folder)
        error = run_on_disk(scan, FaultyDisk(folder / full_subfolder, fault, at=operation))
        if error is not None:
            failures += 1
            assert os.strerror(errno.ENOSPC) in error.what
            assert error.remedy
        committed = set(ScanFolder.load(scan.path).committed_rows()) if scan.begun else set()
        assert scan.acknowledged <= committed
        if scan.begun:
            assert list_errors(scan.path) == []
        committed_rows = scan.rows() if scan.begun else {}
        # There is space again: the scan resumes.
        assert scan.run().exit_status == "success"
        assert validate(scan.path) == []
        assert scan.rows() == undisturbed_scan.digests
        assert committed_rows.items() <= undisturbed_scan.digests.items()
        shutil.rmtree(folder)
    # Most of the ten scans end with an error. The others finish, although one of their operations found no space.
    assert failures > 5


def test_a_line_that_the_full_disk_did_not_take_is_not_written_when_there_is_space_again(samples, tmp_path):
    """Bytes that one call could not write are not written by a later call."""
    # More operations than the test has: the disk is not full until `at` is changed.
    never = 10**6
    disk = FaultyDisk(tmp_path, "short", at=never)
    scan = SmallScan(samples, tmp_path)
    scan.run()
    folder = ScanFolder.load(scan.path)
    raw = (scan.path / "manifest.jsonl").read_bytes()
    with disk(), folder.writer() as writer:
        disk.at = len(disk.done) + 1
        with expect_refusal(ErrorCode.DISK_FULL):
            writer.append({"fact": "row_committed", "row": 0})
        assert (scan.path / "manifest.jsonl").read_bytes() == raw
        disk.free_space()
        writer.append({"fact": "scan_resumed"})
    folder.reload()
    assert load_facts(folder)[-1] == {"fact": "scan_resumed"}
    assert len(load_facts(folder)) == len(raw.splitlines()) + 1
