"""A scan that is interrupted, or whose Pi has a full disk, resumes, and its committed rows are not changed.

Kills are in test_killed_processes.py.
"""

import hashlib

import pytest

from polysight.store.logs import read_events
from polysight.store.scan_folder import ScanFolder
from polysight_shared.messages import RowStarted


@pytest.fixture
def rig(tmp_path, running_rig):
    """Slow enough to be interrupted in the middle of a row on a busy machine."""
    with running_rig(tmp_path, time_scale=15.0) as new_rig:
        yield new_rig


def compute_digests(path):
    """SHA-256 of every file of every committed row."""
    files = [path / b.file for row in ScanFolder.load(path).committed_rows().values() for b in row.boards.values()]
    return {f: hashlib.sha256(f.read_bytes()).hexdigest() for name in files for f in (name, name.with_suffix(".idx"))}


def check_whole(rig, before):
    """The scan is finished and valid, and rows that were committed before have not changed."""
    path = rig.folder / "scan"
    digests_after = compute_digests(path)
    assert {file: digests_after[file] for file in before} == before
    assert len(ScanFolder.load(path).committed_rows()) == 6
    validated = rig.run_here("validate", path)
    assert (validated.status, validated.out, validated.err) == (0, f"{path}: whole\n", "")
    started = [(e.row.index, e.take) for e in read_events(path / "events.msgpack").events if isinstance(e, RowStarted)]
    assert len(set(started)) == len(started), "a take was used twice"


@pytest.mark.parametrize("times", [1, 2])
def test_interrupted(rig, times):
    """After one request the running row is recorded to its end; after two it is aborted. In both cases it resumes."""
    scan = rig.scan("--no-process")
    rig.wait_mid_row(scan, 1)
    for _ in range(times):
        scan.interrupt()
    ended = scan.wait(30)
    path = rig.folder / "scan"
    rows_to_come = 6 - rig.count_committed_rows()
    assert ended.status == 6
    assert f"{rows_to_come} of 6 rows are missing" in ended.message
    assert f"polysight resume {path}" in ended.message
    assert 3 - times <= 6 - rows_to_come < 6
    assert times == 2 or not list(path.glob("raw/*/*.part")), "the running row was ended, not cut"
    digests_before = compute_digests(path)
    assert rig.run_polysight("resume", path, "--no-process").status == 0
    check_whole(rig, digests_before)
