"""The Pi half and the simulated stage, both as processes: the sketch's dialogue, wire time."""

from itertools import pairwise

import pytest

from polysight.shared import messages as m
from polysight.shared.faults import PiFault
from tests.support.rigs import at_stage_port
from tests.support.stage.processes import StageProcess


def test_rows_abort_hold_and_retake(hub, start, instrument, tmp_path, request):
    stage = StageProcess(tmp_path, "python", 30.0, hub)
    request.addfinalizer(stage.close)
    _, host = start(at_stage_port(instrument, str(stage.link)), "--wires", hub)
    host.accepted(host.begin())
    host.home()
    for row in range(2):
        done = host.row(row)
        assert (done.status, done.points, done.edges, done.pulses) == ("done", 8, 8, 32), done.reason
    step_ns = round(instrument.grid.step_x_mm / instrument.stage.speed_mm_s * 1e9)
    for a, b in pairwise(host.of(m.Capture)):
        if a.row_index == b.row_index:
            assert b.edge_ns - a.edge_ns == pytest.approx(step_ns, abs=1000)
    host.start_row(2)
    host.accepted(m.Abort(reason="enough"))
    done = host.wait(m.RowFinished)
    assert (done.status, done.fault) == ("aborted", PiFault.ABORTED)
    assert host.until_state("ready").homed
    host.start_row(2, take=2)
    host.accepted(m.Hold())
    host.accepted(m.Resume())
    assert host.wait(m.RowFinished, lambda e: e.take == 2).status == "done"
