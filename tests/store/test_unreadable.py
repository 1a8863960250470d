"""Read errors of the disk are errors, never a reason to retake a row; a disk without locks is not a scan in use."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from tests.support.refusals import refused

from polysight.store import logs as appending
from polysight.store import validation as validate
from polysight.store.manifest import ManifestWriter
from polysight.store.scan_folder import ScanFolder
from polysight_shared.error_codes import ErrorCode


def test_a_disk_without_locks_is_not_a_scan_in_use(tmp_path, monkeypatch):
    path = tmp_path / "manifest.jsonl"
    ManifestWriter(path, create=True).close()

    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(appending.fcntl, "flock", no_locks)
    with refused(ErrorCode.FILE_UNWRITABLE, os.strerror(errno.ENOLCK)):
        ManifestWriter(path, create=False)


@pytest.mark.parametrize("suffix", [".bin", ".idx"])
@pytest.mark.parametrize("number", [errno.EIO, errno.ESTALE])
def test_row_that_cannot_be_read_now_is_not_withdrawn(undisturbed, monkeypatch, suffix, number):
    scan = ScanFolder.load(undisturbed.path)
    bad = (undisturbed.path / next(iter(scan.committed()[0].boards.values())).file).with_suffix(suffix)

    def fails(path: Path) -> None:
        if path == bad:
            raise OSError(number, os.strerror(number))

    opened, read = Path.open, Path.read_bytes
    monkeypatch.setattr(Path, "open", lambda path, *how, **more: fails(path) or opened(path, *how, **more))
    monkeypatch.setattr(Path, "read_bytes", lambda path: fails(path) or read(path))
    with refused(ErrorCode.FILE_UNREADABLE, os.strerror(number)) as e:
        validate.damaged_rows(scan)
    assert f"polysight resume {undisturbed.path}" in e.value.remedy
    assert [f.where for f in validate.validate(undisturbed.path)] == [str(bad.relative_to(undisturbed.path))]


def test_row_whose_file_is_gone_is_taken_again(undisturbed, monkeypatch):
    scan = ScanFolder.load(undisturbed.path)
    gone = undisturbed.path / next(iter(scan.committed()[1].boards.values())).file
    opened = Path.open

    def absent(path: Path, *how, **more):
        if path == gone:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        return opened(path, *how, **more)

    monkeypatch.setattr(Path, "open", absent)
    assert list(validate.damaged_rows(scan)) == [1]
