"""A scan that is interrupted with Ctrl-C resumes, and its committed rows are not changed.

A row is committed when its data are on the disk and its line is in the manifest. Tests of killed programs are in
test_killed_processes.py.
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
    data_files = []
    for row in rows:
        data_files += [path / board.file for board in row.boards.values()]
    index_files = [file.with_suffix(".idx") for file in data_files]
    return {file: hashlib.sha256(file.read_bytes()).hexdigest() for file in data_files + index_files}


def check_finished(rig, digests_before):
    """Check that the scan is finished and valid, and that rows that were committed before have not changed."""
    path = rig.folder / "scan"
    digests_after = compute_digests(path)
    assert digests_before.items() <= digests_after.items()
    assert len(ScanFolder.load(path).committed_rows()) == ROWS
    validated = rig.run_here("validate", path)
    assert validated.status == 0
    assert validated.out == f"{path}: whole\n"
    assert validated.err == ""
    starts = [event for event in read_events(path / "events.msgpack").events if isinstance(event, RowStarted)]
    takes = [(event.row.index, event.take) for event in starts]
    assert len(set(takes)) == len(takes), "each attempt to scan a row has a number of its own"


@pytest.mark.parametrize("interrupts", [1, 2])
def test_an_interrupted_scan_ends_or_aborts_its_row_and_resumes(rig, interrupts):
    """After one Ctrl-C the running row is recorded to its end; after two it is aborted. In both cases it resumes."""
    scan = rig.scan("--no-process")
    rig.wait_mid_row(scan, 1)
    for _ in range(interrupts):
        scan.interrupt()
    # The limit counts seconds in which the machine is idle.
    ended = scan.wait(limit_s=30)
    path = rig.folder / "scan"
    rows_committed = rig.count_committed_rows()
    assert ended.status == ScanError.exit_status
    assert f"{ROWS - rows_committed} of {ROWS} rows are missing" in ended.message
    assert f"polysight resume {path}" in ended.message
    # A row was committed before the interrupt. After a single one the row that ran then is committed, too.
    if interrupts == 1:
        assert 2 <= rows_committed < ROWS
        assert not list(path.glob("raw/*/*.part")), "the running row was recorded to its end"
    else:
        assert 1 <= rows_committed < ROWS
    digests_before = compute_digests(path)
    assert rig.run_polysight("resume", path, "--no-process").status == 0
    check_finished(rig, digests_before)
