"""A scan that is interrupted, or whose Pi has a full disk, resumes, and its committed rows are not changed.

Kills are in test_killed_processes.py.
"""

import hashlib

import pytest

from polysight.store.logs import read_events
from polysight.store.scan_folder import ScanFolder
from polysight_shared.errors import ScanError
from polysight_shared.messages import RowStarted

# Rows of the simulated rig's scene.
ROWS = 6


@pytest.fixture
def rig(tmp_path, running_rig):
    """A simulated rig, slow enough to be interrupted in the middle of a row on a busy machine."""
    with running_rig(tmp_path, time_scale=15.0) as new_rig:
        yield new_rig


def compute_digests(path):
    """SHA-256 of every file of every committed row: its samples and its index."""
    rows = ScanFolder.load(path).committed_rows().values()
    data_files = [path / board.file for row in rows for board in row.boards.values()]
    index_files = [file.with_suffix(".idx") for file in data_files]
    return {file: hashlib.sha256(file.read_bytes()).hexdigest() for file in data_files + index_files}


def check_whole(rig, digests_before):
    """Check that the scan is finished and valid, and that rows that were committed before have not changed."""
    path = rig.folder / "scan"
    digests_after = compute_digests(path)
    assert {file: digests_after[file] for file in digests_before} == digests_before
    assert len(ScanFolder.load(path).committed_rows()) == ROWS
    validated = rig.run_here("validate", path)
    assert (validated.status, validated.out, validated.err) == (0, f"{path}: whole\n", "")
    started = [(e.row.index, e.take) for e in read_events(path / "events.msgpack").events if isinstance(e, RowStarted)]
    assert len(set(started)) == len(started), "a take was used twice"


@pytest.mark.parametrize("interrupts", [1, 2])
def test_an_interrupted_scan_ends_or_aborts_its_row_and_resumes(rig, interrupts):
    """After one Ctrl-C the running row is recorded to its end; after two it is aborted. In both cases it resumes."""
    scan = rig.scan("--no-process")
    rig.wait_mid_row(scan, 1)
    for _ in range(interrupts):
        scan.interrupt()
    # Idle seconds; chosen.
    ended = scan.wait(30)
    path = rig.folder / "scan"
    rows_committed = rig.count_committed_rows()
    assert ended.status == ScanError.exit_status
    assert f"{ROWS - rows_committed} of {ROWS} rows are missing" in ended.message
    assert f"polysight resume {path}" in ended.message
    # One row was committed before; after a single request the one that ran then is, too.
    least_rows = {1: 2, 2: 1}[interrupts]
    assert least_rows <= rows_committed < ROWS
    if interrupts == 1:
        assert not list(path.glob("raw/*/*.part")), "the running row was ended, not cut"
    digests_before = compute_digests(path)
    assert rig.run_polysight("resume", path, "--no-process").status == 0
    check_whole(rig, digests_before)
