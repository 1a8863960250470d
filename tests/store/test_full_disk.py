"""The disk fills up at everything the host's store and the Pi's journal do to it."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import pytest
from tests.support.refusals import refused
from tests.support.store.facts import facts_of
from tests.support.store.faulty_disk import GROWS, FaultyDisk
from tests.support.store.small_scan import Samples, SmallScan

from polysight.store.scan_folder import ScanFolder
from polysight.store.validation import validate
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import PolysightError


def needs_space(samples: Samples, folder: Path, whose: str) -> list[int]:
    """Numbers of the operations of a scan that need space."""
    folder.mkdir()
    disk = FaultyDisk(folder / whose)
    with disk():
        SmallScan(samples, folder).run()
    return [i for i, what in enumerate(disk.done, 1) if what.split()[0] in GROWS]


def failure(scan: SmallScan, disk: FaultyDisk) -> PolysightError | None:
    """How the scan fails on that disk; None when it does not."""
    try:
        with disk():
            scan.run()
    except PolysightError as e:
        return e
    return None


@pytest.mark.parametrize("fault", ["full", "short"])
@pytest.mark.parametrize("whose", ["scan", "journal"])
def test_full_disk_is_an_error_and_loses_nothing(samples, undisturbed, tmp_path, sample, fault, whose):
    seen = 0
    for at in sample(needs_space(samples, tmp_path / "count", whose), 10):
        folder = tmp_path / str(at)
        folder.mkdir()
        scan = SmallScan(samples, folder)
        error = failure(scan, FaultyDisk(folder / whose, fault, at))
        if error is not None:
            seen += 1
            assert os.strerror(errno.ENOSPC) in error.what
            assert error.remedy
        committed = set(ScanFolder.load(scan.path).committed()) if scan.begun else set()
        assert scan.acknowledged <= committed
        if scan.begun:
            assert [f for f in validate(scan.path) if f.level == "error"] == []
        before = scan.rows() if scan.begun else {}
        assert scan.run().exit_status == "success"  # there is space again
        assert validate(scan.path) == []
        assert scan.rows() == undisturbed.digests
        assert before.items() <= undisturbed.digests.items()
        shutil.rmtree(folder)
    assert seen > 5


def test_disk_that_has_space_again_while_the_program_still_runs(samples, tmp_path):
    """What one call has failed to write, no later call writes by surprise."""
    disk = FaultyDisk(tmp_path, "short", at=10**6)
    scan = SmallScan(samples, tmp_path)
    scan.run()
    folder = ScanFolder.load(scan.path)
    raw = (scan.path / "manifest.jsonl").read_bytes()
    with disk(), folder.writer() as writer:
        disk.at = len(disk.done) + 1
        with refused(ErrorCode.DISK_FULL):
            writer.append({"fact": "row_committed", "row": 0})
        assert (scan.path / "manifest.jsonl").read_bytes() == raw
        disk.free_space()
        writer.append({"fact": "scan_resumed"})
    folder.reload()
    assert facts_of(folder)[-1] == {"fact": "scan_resumed"}
    assert len(facts_of(folder)) == len(raw.splitlines()) + 1
