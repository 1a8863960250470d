"""SIGKILL of a scanning process at random times of the scan and of its resumes; the scan resumes.

The scan is that of tests/support/store: every file is written by the code of the instrument. 16 kills; `--long`: 1,000.
"""

from __future__ import annotations

import multiprocessing
import random
import shutil
import signal
import time
from pathlib import Path

import pytest

from polysight.host.store.scan_folder import ScanFolder
from polysight.host.store.validation import validate
from tests.support.store.small_scan import Samples, SmallScan

pytestmark = pytest.mark.timeout(3600)
FORK = multiprocessing.get_context("fork")
OFTEN = 4  # kills of one scan at most, then it is left in peace


def run_killed(samples: Samples, folder: Path, after_s: float) -> tuple[bool, float]:
    """Scan or go on in a process that is killed after a time. Whether it was, and how long it ran."""
    process = FORK.Process(target=lambda: SmallScan(samples, folder).run())
    began = time.monotonic()
    process.start()
    process.join(after_s)
    process.kill()
    process.join()
    return process.exitcode == -signal.SIGKILL, time.monotonic() - began


def committed(scan: SmallScan) -> dict[str, str]:
    """Digests of the committed rows; all of them as they were committed."""
    if not scan.begun:
        return {}
    assert [f for f in validate(scan.path) if f.severity == "error"] == []
    return scan.rows()


def test_committed_rows_are_those_of_the_undisturbed_scan(samples, undisturbed, tmp_path, request):
    wanted, kills, seen, chance = 1000 if request.config.getoption("--long") else 16, 0, set(), random.Random(15)
    (tmp_path / "whole").mkdir()
    _, whole_s = run_killed(samples, tmp_path / "whole", 60.0)
    number = 0
    while kills < wanted:
        folder, number = tmp_path / str(number), number + 1
        folder.mkdir()
        scan, before = SmallScan(samples, folder), {}
        for _ in range(chance.randint(1, OFTEN)):
            killed, _ = run_killed(samples, folder, chance.uniform(0, 1.2 * whole_s))
            kills += killed
            after = committed(scan)
            assert before.items() <= after.items() <= undisturbed.digests.items()
            before = after
            seen.add(len(after))
        assert scan.run().exit_status == "success"
        assert (committed(scan), validate(scan.path)) == (undisturbed.digests, [])
        assert ScanFolder.load(scan.path).complete
        shutil.rmtree(folder)
    assert len(seen) > 2  # kills fell before the first row, between rows and after them
