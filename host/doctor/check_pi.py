"""Checks of the Pi and the stage: keys, the Pi's answer and release, the stage's state, and the trigger line.

The trigger line, from the stage's pin to the Pi's, is checked with a short row, every point of which must be an edge.
That is the only check that moves something; it runs with `--move` alone.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

from polysight.host.acquisition import StopRequest, make_ready, stage_differences
from polysight.host.doctor.bench import Bench, Finding, error, not_checked, ok, warning
from polysight.host.store import new_scan_id
from polysight.shared import __version__
from polysight.shared.errors import DeviceError
from polysight.shared.faults import explain
from polysight.shared.messages import BeginRun, RowFinished, is_simulated
from polysight.shared.raster import RasterPlan
from polysight.shared.sockets import HOST_KEYS, is_loopback

SIMULATED = "simulated wires: no hardware is driven"
POINTS = 8  # of the row that is run
_LIMIT_S = 120.0
_LOOK_MS = 100


def check_keys(bench: Bench) -> Finding:
    """CURVE keys are there and secret, where the addresses need them."""
    pi = bench.rig.pi
    if is_loopback(pi.command_address) and is_loopback(pi.event_address):
        return ok("not needed: both addresses are loopback")
    folder = Path(pi.key_dir)
    if missing := [name for name in HOST_KEYS if not os.access(folder / name, os.R_OK)]:
        return error(
            f"{folder}: {', '.join(missing)} cannot be read",
            "the Pi's keys were not copied here, or belong to another user",
            f"copy the Pi's {' and '.join(HOST_KEYS)} here (docs/how-to/install.md); pi.key_dir is {folder}",
        )
    secret = folder / HOST_KEYS[-1]
    mode = secret.stat().st_mode
    if mode & 0o077:
        return warning(
            f"{secret} can be read by others ({mode & 0o777:o})",
            "whoever reads it may drive the stage",
            f"`chmod 600 {secret}`",
        )
    return ok(f"{folder} holds them")


def check_pi(bench: Bench) -> Finding:
    """It answers, and is of this release."""
    before = bench.system.wall_ns()
    hello = bench.pi.hello()
    after = bench.system.wall_ns()
    bench.hello, bench.hello_at_ns, bench.hello_took_ns = hello, (before + after) // 2, after - before
    lines = SIMULATED if is_simulated(hello.backend) else f"lines by {hello.backend}"
    told = f"{bench.rig.pi.command_address} answers: release {hello.pi_release}, {lines}, state {hello.state}"
    facts = {"release": hello.pi_release, "backend": hello.backend, "state": hello.state}
    if hello.pi_release != __version__:
        return error(
            told,
            f"this host is of release {__version__}",
            "install the same release on both: `make pi-install HOST=...`",
            **facts,
        )
    if differing := stage_differences(bench.rig.stage, hello):
        return error(
            f"{told}; {'; '.join(differing)}",
            "host and Pi have different rig files: a scan is refused",
            "copy the right [stage] to the other machine, `sudo systemctl restart polysight-pi`",
            **facts,
        )
    return ok(told, **facts)


def check_free(bench: Bench) -> Finding:
    """No scan is running: the doctor must not take its cards away."""
    if bench.hello is not None and (bench.hello.in_run or bench.hello.state in ("ready", "running", "held", "done")):
        return error(
            f"scan {bench.hello.scan_id} is begun, the state is {bench.hello.state}",
            "a scan runs, or the host that began it died",
            "wait for its end, or end it with `polysight resume`; restarting polysight-pi forgets it",
        )
    return ok("no scan is begun")


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


def check_stage(bench: Bench) -> Finding:
    """No fault is latched, and the sketch is of this release."""
    status = bench.pi.status()
    if status.fault and status.state == "fault":
        e = explain(status.fault)
        return error(
            f"fault {status.fault}: {e.what}; {status.reason}",
            e.why,
            f"{e.remedy}; on the Pi, with its service stopped, `polysight-pi check` looks at port and board",
            fault=status.fault,
        )
    firmware = bench.hello.firmware if bench.hello is not None else ""
    where = f"at {status.x_mm:.1f}, {status.y_mm:.1f} mm" if status.homed else "not homed yet"
    told, facts = f"answers, sketch {firmware or 'unknown'}, {where}", {"firmware": firmware, "homed": status.homed}
    if firmware != __version__:
        return error(
            told,
            f"this release's sketch is {__version__}: the board was not flashed with it",
            "`make flash PORT=/dev/ttyACM0` with the board on this machine",
            **facts,
        )
    if status.fault:
        e = explain(status.fault)
        return warning(f"{told}; its last row ended with fault {status.fault}: {e.what}", e.why, e.remedy, **facts)
    return ok(told, **facts)
