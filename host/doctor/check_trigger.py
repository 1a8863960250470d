"""The trigger line, from the stage's pin to the Pi's: a short row, every point of which must be an edge.

The only check that moves something; it runs with `--move` alone.
"""

from __future__ import annotations

import time

from polysight.host.acquisition.control import StopRequest
from polysight.host.acquisition.ready import make_ready
from polysight.host.doctor.bench import Bench
from polysight.host.doctor.check_pi import check_free
from polysight.host.doctor.finding import Finding, error, not_checked, ok, warning
from polysight.host.store.scan_folder import new_scan_id
from polysight.shared.errors import DeviceError
from polysight.shared.faults import explain
from polysight.shared.messages import BeginRun, RowFinished
from polysight.shared.raster import RasterPlan

POINTS = 8
_LIMIT_S = 120.0
_LOOK_MS = 100


def check_trigger(bench: Bench) -> Finding:
    """Home if need be, run one row of a few points at the scan's speed, and count edges and pulses."""
    if not bench.wanted.move:
        return not_checked(
            "edges come only from a moving stage",
            f"`polysight doctor --move` homes it and runs {POINTS} points: keep clear of the stage",
        )
    bench.hello = bench.pi.hello()  # a scan may have begun meanwhile, and beginning a run would end it
    if (busy := check_free(bench)).verdict == "error":
        return busy
    row = _run(bench)
    facts = {"points": row.points, "edges": row.edges, "pulses": row.pulses, "fault": row.fault}
    told = f"{row.points} points passed, {row.edges} edges seen, {row.pulses} pulses sent"
    wanted = POINTS * bench.rig.burst.pulses
    if row.points and not row.edges:
        return error(
            told,
            "the trigger line is stuck: no edge reaches the Pi",
            f"check the wire and its ground from the stage's trigger pin to GPIO {bench.rig.pi.trigger_in}, the level"
            " shifter, and pi.trigger_in; with the Pi's service stopped, `polysight-pi check` there tells who holds the"
            " line",
            **facts,
        )
    if row.status != "done" or row.edges != POINTS or row.pulses != wanted:
        e = explain(row.fault)
        return error(f"{told}, {POINTS} and {wanted} wanted: {row.reason or e.what}", e.why, e.remedy, **facts)
    if row.fault or row.reason:
        return warning(f"{told}; {row.reason}", "", "look at the stage while it runs", **facts)
    return ok(told, **facts)


def _run(bench: Bench) -> RowFinished:
    """The end of a row of its own, in a run of its own."""
    rig, pi = bench.rig, bench.pi
    plan = RasterPlan(POINTS, 1, rig.grid.step_x_mm, rig.grid.step_y_mm)
    scan_id = f"doctor-{new_scan_id()}"
    burst = rig.burst
    pi.follow(scan_id, 0, lambda _event: None)
    pi.begin_run(
        BeginRun(
            scan_id=scan_id,
            plan=plan,
            pulses=burst.pulses,
            period_us=burst.period_us,
            width_us=burst.width_us,
            speed_mm_s=rig.stage.speed_mm_s,
            heartbeat_ms=rig.pi.host_heartbeat_ms,
        )
    )
    try:
        make_ready(pi, StopRequest(), lambda _phase, _message: None)
        pi.run_row(scan_id, 0, 1)
        return _row_end(bench)
    finally:
        pi.come_to_rest("the doctor is done")
        pi.end_run(scan_id, "success", "polysight doctor --move")


def _row_end(bench: Bench) -> RowFinished:
    deadline = time.monotonic() + _LIMIT_S
    while time.monotonic() < deadline:
        bench.pi.event_socket.poll(_LOOK_MS)
        for event in bench.pi.events():
            if isinstance(event, RowFinished):
                return event
    raise DeviceError(
        f"a row of {POINTS} points has not ended within {_LIMIT_S:.0f} s", "the stage stands still", "look at the stage"
    )
