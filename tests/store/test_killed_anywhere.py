"""The host and the Pi are killed, or lose power, at every disk operation; the scan resumes.

All runs in one process, with the code that writes files in the instrument; tests/e2e kills real processes.
"""

import shutil
from pathlib import Path

import pytest
from tests.support.store.facts import load_facts
from tests.support.store.faulty_disk import FaultyDisk, Killed
from tests.support.store.plain_scan import list_errors
from tests.support.store.small_scan import Samples, SmallScan

from polysight.store.scan_folder import ScanFolder
from polysight.store.validation import validate

# Draws for each operation: after a power cut a random part of the unsynced data is on the disk.
POWER_CUTS = 12
pytestmark = [
    # A killed program closes no file.
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    # Needed with --long.
    pytest.mark.timeout(3600),
]


def list_retaken_rows(path: Path) -> set[int]:
    """Return the rows that were retaken since the last resume, by the manifest."""
    facts = load_facts(path)
    since = max((i for i, f in enumerate(facts) if f["fact"] == "scan_resumed"), default=len(facts))
    return {f["row"] for f in facts[since:] if f["fact"] == "row_committed" and f["take"] > 1}


def run_until_fault(scan: SmallScan, disk: FaultyDisk) -> bool:
    """Run or resume until the disk's fault; rows committed by then must be safe. True if the fault came."""
    try:
        with disk():
            scan.run()
    except Killed:
        if scan.begun:
            assert list_errors(scan.path) == []
            assert scan.acknowledged <= set(ScanFolder.load(scan.path).committed_rows())
        return True
    return False


def assert_that_it_resumes(scan: SmallScan, undisturbed_scan, where: str) -> None:
    """Resume the scan: it must end like an undisturbed one, with at most one row retaken."""
    committed_rows = scan.rows() if scan.begun else {}
    assert scan.run().exit_status == "success", where
    assert validate(scan.path) == [], where
    assert scan.rows() == undisturbed_scan.digests, where
    assert {name: undisturbed_scan.digests[name] for name in committed_rows} == committed_rows, where
    assert len(list_retaken_rows(scan.path)) <= 1, where


def list_disk_operations(samples: Samples, folder: Path) -> list[str]:
    """Return the operations of an undisturbed scan on the disk, in order."""
    folder.mkdir()
    disk = FaultyDisk(folder)
    with disk():
        SmallScan(samples, folder).run()
    return disk.done


@pytest.mark.parametrize("fault", ["killed", "killed within", "power cut"])
def test_a_scan_that_was_killed_at_any_operation_resumes(samples, undisturbed_scan, tmp_path, fault, draw_cases):
    operations = list_disk_operations(samples, tmp_path / "count")
    # The operations were recorded.
    assert len(operations) > 100
    draws = POWER_CUTS if fault == "power cut" else 1
    for step, seed in draw_cases([(step, seed) for step in range(1, len(operations) + 1) for seed in range(draws)], 12):
        folder = tmp_path / f"{step}-{seed}"
        scan = SmallScan(samples, folder)
        folder.mkdir()
        assert run_until_fault(scan, FaultyDisk(folder, fault, step, seed))
        assert_that_it_resumes(scan, undisturbed_scan, f"{fault} at {step} ({operations[step - 1]}), seed {seed}")
        shutil.rmtree(folder)


def test_a_scan_that_lost_all_unsynced_data_resumes(samples, undisturbed_scan, tmp_path):
    """Power is cut at and after every sync of a folder and operation on the manifest; all unsynced data is lost."""
    folder = tmp_path / "count"
    operations = list_disk_operations(samples, folder)
    folders = {f"fsync {path.name}" for path in (folder, *folder.rglob("*")) if path.is_dir()}
    steps = [
        position
        for position, description in enumerate(operations, 1)
        if description in folders or description.endswith(" manifest.jsonl")
    ]
    # The operations were found.
    assert len(steps) > 16
    for position in sorted({*steps, *(position + 1 for position in steps if position < len(operations))}):
        folder = tmp_path / str(position)
        scan = SmallScan(samples, folder)
        folder.mkdir()
        assert run_until_fault(scan, FaultyDisk(folder, "worst power cut", position))
        assert_that_it_resumes(scan, undisturbed_scan, f"power cut at {position} ({operations[position - 1]})")
        shutil.rmtree(folder)


@pytest.mark.parametrize("fault", ["killed within", "power cut"])
def test_a_resumed_scan_that_is_killed_at_any_operation_resumes_again(
    samples, undisturbed_scan, tmp_path, fault, draw_cases
):
    operations = list_disk_operations(samples, tmp_path / "count")
    # The first kill is within row 1.
    first = next(i for i, description in enumerate(operations, 1) if description == "write 0001.idx")
    killed = 0
    for position in draw_cases(range(1, len(operations)), 12):
        folder = tmp_path / str(position)
        folder.mkdir()
        scan = SmallScan(samples, folder)
        assert run_until_fault(scan, FaultyDisk(folder, "killed within", first))
        killed += run_until_fault(scan, FaultyDisk(folder, fault, position, seed=position))
        assert_that_it_resumes(scan, undisturbed_scan, f"{fault} at {position} of the resume")
        shutil.rmtree(folder)
    # The resumed scan has fewer operations than a whole one, so that some positions are beyond its end.
    assert killed > 4
