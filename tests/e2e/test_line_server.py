"""A scan of the simulated rig whose radars are re-armed for each row by their control servers."""

from __future__ import annotations

from polysight.host.acquisition.scan import run_scan
from polysight.host.store.scan_folder import ScanFolder
from polysight.host.store.validation import validate
from polysight.shared.config import Instrument
from polysight.shared.error_codes import ErrorCode
from polysight.shared.tables import decode, to_builtins
from tests.support.pattern_rig import counts, small_table, start_rig
from tests.support.refusals import refused

PORTS = {"LS": 5000, "RH": 5001, "RV": 5002}


def small_rig(bench, *faults: str):
    """The simulated rig, running, with control servers; its rig file."""
    table = small_table(command_timeout_s=5.0)
    table["radar"] = {"control": "line_server", "servers": {b: f"127.0.0.1:{p}" for b, p in PORTS.items()}}
    return start_rig(bench, table, *faults)


def test_each_row_is_armed_once_and_comes_whole(bench):
    rig, instrument = small_rig(bench)
    result = run_scan(instrument, bench.folder / "scan")
    assert result.exit_status == "success"
    assert validate(bench.folder / "scan") == []
    for board in counts(bench, rig).values():
        assert board["rearmed"] == 3 + result.retakes
        if result.retakes == 0:
            assert board.get("unarmed", 0) == 0


def test_scan_that_forgets_to_rearm_gets_no_data(bench):
    rig, instrument = small_rig(bench)
    forgetful = decode({**to_builtins(instrument), "radar": {"control": "endless"}}, Instrument, "test")
    with refused(ErrorCode.ROW_INCOMPLETE):
        run_scan(forgetful, bench.folder / "scan")
    assert list(ScanFolder.load(bench.folder / "scan").committed()) == []
    assert all(board["unarmed"] > 0 and board.get("frames", 0) == 0 for board in counts(bench, rig).values())


def test_rearming_that_failed_silently_is_a_missed_row_and_is_taken_again(bench):
    rig, instrument = small_rig(bench, "RH.retrigger_fails=[1]")
    result = run_scan(instrument, bench.folder / "scan")
    assert result.exit_status == "success"
    assert result.retakes >= 1
    first = result.folder.facts("row_rejected")[0]
    assert first["row"] == 1
    assert {"kind": "no_data", "board": "RH"} in first["faults"]
    assert validate(bench.folder / "scan") == []
    assert counts(bench, rig)["RH"]["unarmed"] > 0
