"""The Pi half as a process against the simulated stage and wires as processes: the sketch's dialogue, wire time."""

import subprocess
import sys
import threading
from itertools import pairwise

import pytest

from polysight.pi_controller.service import Service
from polysight.shared import messages as m
from polysight.shared.faults import PiFault
from tests.support.paths import REPO
from tests.support.pi.host_side import HostSide
from tests.support.rigs import at_stage_port

pytest.importorskip("polysight.simulators.stage", reason="the simulated stage is not installed")


@pytest.fixture
def simulated(tmp_path):
    """Wires and stage; gives (hub, port)."""
    hub, port = tmp_path / "w", tmp_path / "tty"
    wires = ["polysight.simulators.wires", "--socket", hub]
    stage = ["polysight.simulators.stage", "--config", "instrument.toml", "--wires", hub, "--link", port]
    stage += ["--time-scale", "30", "--python"]
    processes = []
    for command in (wires, stage):
        process = subprocess.Popen(
            [sys.executable, "-m", *map(str, command)], cwd=REPO, stdout=subprocess.PIPE, text=True
        )
        processes.append(process)
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready")
    yield hub, port
    for process in reversed(processes):
        process.terminate()
        process.communicate(timeout=10)


def test_rows_abort_hold_and_retake(simulated, instrument):
    hub, port = simulated
    service = Service(at_stage_port(instrument, str(port)), hub)
    thread = threading.Thread(target=service.serve)
    thread.start()
    host = HostSide(service.server.command_address, service.server.event_address, instrument)
    try:
        host.accepted(host.begin())
        host.home()
        for row in range(2):
            done = host.row(row)
            assert (done.status, done.points, done.edges, done.pulses) == ("done", 8, 8, 32), done.reason
        captures = [e for e in host.events if isinstance(e, m.Capture)]
        step_ns = round(instrument.grid.step_x_mm / instrument.stage.speed_mm_s * 1e9)
        for a, b in pairwise(captures):
            if a.row_index == b.row_index:
                assert b.edge_ns - a.edge_ns == pytest.approx(step_ns, abs=1000)
        host.accepted(m.RunRow(scan_id="scan", row_index=2, take=1))
        host.accepted(m.Abort(reason="enough"))
        done = host.wait(m.RowFinished)
        assert (done.status, done.fault) == ("aborted", PiFault.ABORTED)
        assert host.until_state("ready").homed
        host.accepted(m.RunRow(scan_id="scan", row_index=2, take=2))
        host.accepted(m.Hold())
        host.accepted(m.Resume())
        assert host.wait(m.RowFinished, lambda e: e.take == 2).status == "done"
    finally:
        host.close()
        service.stop()
        thread.join(5)
        service.close()
