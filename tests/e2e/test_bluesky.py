"""A lab with Bluesky scans with the rig: its documents are valid, and hold what the scan folder holds."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import event_model
import pytest
import tomli_w
from bluesky import RunEngine
from bluesky.utils import FailedStatus, RunEngineInterrupted
from tests.support.processes import wait_for
from tests.support.simulated_rig import Rig
from tests.support.store.facts import facts_of

from polysight import RadarScan, radar_scan
from polysight.cli.main import main
from polysight.store import ScanFolder
from polysight_shared.tables import to_builtins

pytestmark = pytest.mark.slow
Documents = list[tuple[str, dict[str, Any]]]


@pytest.fixture
def engine() -> RunEngine:
    return RunEngine({}, context_managers=[])


def run(engine: RunEngine, plan: Any) -> Documents:
    seen: Documents = []
    try:
        engine(plan, lambda name, document: seen.append((name, document)))
    finally:
        for name, document in seen:
            event_model.schema_validators[event_model.DocumentNames[name]].validate(document)
    return seen


def test_a_plan_scans_the_rig_and_tells_of_each_row(rig: Rig, engine: RunEngine) -> None:
    folder = rig.folder / "scan"
    documents = run(engine, radar_scan(RadarScan(rig.config), folder, md={"operator": "a person"}))
    scan = ScanFolder.load(folder)
    assert scan.complete
    start = next(d for name, d in documents if name == "start")
    assert (start["scan_folder"], start["operator"]) == (str(folder), "a person")
    streams = {d["uid"]: d["name"] for name, d in documents if name == "descriptor"}
    events = [
        event
        for name, d in documents
        if name in ("event", "event_page")
        for event in (event_model.unpack_event_page(d) if name == "event_page" else [d])
    ]
    rows = [e["data"] for e in events if streams[e["descriptor"]] == "rows"]
    committed = scan.committed().values()
    assert [(r["radar_scan-row"], r["radar_scan-pulses"]) for r in rows] == [(c.row, c.pulses) for c in committed]
    assert [r["radar_scan-missing_bytes"] for r in rows] == [
        sum(b.missing_bytes for b in c.boards.values()) for c in committed
    ]
    last = next(e["data"] for e in events if streams[e["descriptor"]] == "primary")
    assert (last["radar_scan-scan_id"], last["radar_scan-rows_committed"]) == (scan.scan_id, len(rows))
    assert documents[-1][0] == "stop"
    assert documents[-1][1]["exit_status"] == "success"


def test_a_plan_that_is_stopped_leaves_a_scan_to_be_resumed(rig: Rig, engine: RunEngine) -> None:
    folder, device = rig.folder / "scan", RadarScan(rig.config)

    def interrupt() -> None:
        wait_for(lambda: rig.committed() >= 1, "a committed row")
        engine.request_pause()  # rows cannot be replayed: the engine ends the run

    thread = threading.Thread(target=interrupt)
    thread.start()
    documents: Documents = []
    with pytest.raises((RunEngineInterrupted, FailedStatus)):
        engine(radar_scan(device, folder), lambda name, document: documents.append((name, document)))
    thread.join()
    assert documents[-1][1]["exit_status"] in ("abort", "fail")
    scan = ScanFolder.load(folder)
    assert scan.committed()
    assert not scan.complete
    assert facts_of(scan, "scan_ended")
    assert main(["resume", str(folder), "--no-process"]) == 0
    assert ScanFolder.load(folder).complete


def test_a_rig_that_is_not_there_fails_the_run_with_what_to_do(lonely_instrument: Any, tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(tomli_w.dumps(to_builtins(lonely_instrument)))
    engine, documents = RunEngine({}, context_managers=[]), []
    with pytest.raises(FailedStatus) as failed:
        engine(radar_scan(RadarScan(tmp_path / "rig.toml"), tmp_path / "scan"), lambda *d: documents.append(d))
    assert "do:" in str(failed.value.__cause__)
    assert documents[-1][1]["exit_status"] == "fail"
