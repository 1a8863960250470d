"""Checks of the Pi and the stage: keys, connection and release, a scan in progress, state of the stage, trigger line.

The trigger line is checked with a short row in which every point must give an edge. Only this check moves the stage,
and only with `--move`.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

from polysight.acquisition import StopRequest, make_ready, stage_differences
from polysight.doctor.context import CheckContext, Finding, error, not_checked, ok, warning
from polysight.store import new_scan_id
from polysight_shared import __version__
from polysight_shared.errors import DeviceError
from polysight_shared.faults import explain
from polysight_shared.messages import BeginRun, RowFinished, is_simulated
from polysight_shared.raster import RasterPlan
from polysight_shared.sockets import HOST_KEYS, is_loopback

SIMULATED = "simulated wires: no hardware is driven"
_POINTS = 8  # of the row for the trigger line
_ROW_TIMEOUT_S = 120.0
_POLL_MS = 100


def check_keys(context: CheckContext) -> Finding:
    """Check that the CURVE keys are readable, and by this user only; loopback addresses need none."""
    pi = context.rig.pi
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
            "every user of this machine could drive the stage",
            f"`chmod 600 {secret}`",
        )
    return ok(f"the keys are in {folder}")


def check_pi(context: CheckContext) -> Finding:
    """Check that the Pi answers, has this release, and the same stage settings."""
    before = context.system.wall_ns()
    hello = context.pi.hello()
    after = context.system.wall_ns()
    context.hello, context.hello_at_ns, context.hello_took_ns = hello, (before + after) // 2, after - before
    backend = SIMULATED if is_simulated(hello.backend) else f"GPIO backend {hello.backend}"
    found = f"{context.rig.pi.command_address} answers: release {hello.pi_release}, {backend}, state {hello.state}"
    facts = {"release": hello.pi_release, "backend": hello.backend, "state": hello.state}
    if hello.pi_release != __version__:
        return error(
            found,
            f"this host has release {__version__}",
            "install the same release on both: `make pi-install HOST=...`",
            **facts,
        )
    if differing := stage_differences(context.rig.stage, hello):
        return error(
            f"{found}; {'; '.join(differing)}",
            "host and Pi have different rig files, so the Pi would refuse a scan",
            "copy the right [stage] to the other machine, `sudo systemctl restart polysight-pi`",
            **facts,
        )
    return ok(found, **facts)


def check_free(context: CheckContext) -> Finding:
    """Check that no scan is running; the doctor must not use its cards."""
    hello = context.hello
    if hello is not None and (hello.in_run or hello.state in ("ready", "running", "held", "done")):
        return error(
            f"scan {hello.scan_id} is in progress, state {hello.state}",
            "a scan is running, or the program that started it was terminated",
            "wait for its end, or continue it with `polysight resume`; a restart of polysight-pi discards it",
        )
    return ok("no scan is in progress")


def check_trigger(context: CheckContext) -> Finding:
    """Run a short row at the scan's speed, after homing if necessary; compare points, trigger edges and pulses."""
    if not context.options.move:
        return not_checked(
            "only a moving stage gives trigger edges",
            f"`polysight doctor --move` homes it and runs {_POINTS} points: keep clear of the stage",
        )
    context.hello = context.pi.hello()  # a scan may have started since then, and begin_run would end it
    if (busy := check_free(context)).verdict == "error":
        return busy
    row = _run_row(context)
    facts = {"points": row.points, "edges": row.edges, "pulses": row.pulses, "fault": row.fault}
    found = f"{row.points} points passed, {row.edges} edges detected, {row.pulses} pulses sent"
    expected = _POINTS * context.rig.burst.pulses
    if row.points and not row.edges:
        return error(
            found,
            "the trigger line is stuck: no edge reaches the Pi",
            f"check the wire and its ground from the stage's trigger pin to GPIO {context.rig.pi.trigger_in}, the level"
            " shifter, and pi.trigger_in; with the Pi's service stopped, `polysight-pi check` there reports which"
            " program uses the line",
            **facts,
        )
    if row.status != "done" or row.edges != _POINTS or row.pulses != expected:
        e = explain(row.fault)
        return error(f"{found}, {_POINTS} and {expected} expected: {row.reason or e.what}", e.why, e.remedy, **facts)
    if row.fault or row.reason:
        return warning(f"{found}; {row.reason}", "", "watch the stage during a row", **facts)
    return ok(found, **facts)


def _run_row(context: CheckContext) -> RowFinished:
    """Run one row of `_POINTS` points in a run of its own and return its end event."""
    rig, pi = context.rig, context.pi
    plan = RasterPlan(_POINTS, 1, rig.grid.step_x_mm, rig.grid.step_y_mm)
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
        return _row_end(context)
    finally:
        pi.come_to_rest("end of polysight doctor")
        pi.end_run(scan_id, "success", "polysight doctor --move")


def _row_end(context: CheckContext) -> RowFinished:
    deadline = time.monotonic() + _ROW_TIMEOUT_S
    while time.monotonic() < deadline:
        context.pi.event_socket.poll(_POLL_MS)
        for event in context.pi.events():
            if isinstance(event, RowFinished):
                return event
    raise DeviceError(
        f"timeout: a row of {_POINTS} points did not end within {_ROW_TIMEOUT_S:.0f} s",
        "the stage does not move",
        "look at the stage",
    )


def check_stage(context: CheckContext) -> Finding:
    """Check that no fault is latched and that the sketch has this release."""
    status = context.pi.status()
    if status.fault and status.state == "fault":
        e = explain(status.fault)
        return error(
            f"fault {status.fault}: {e.what}; {status.reason}",
            e.why,
            f"{e.remedy}; on the Pi, with its service stopped, run `polysight-pi check` for port and board",
            fault=status.fault,
        )
    firmware = context.hello.firmware if context.hello is not None else ""
    where = f"at {status.x_mm:.1f}, {status.y_mm:.1f} mm" if status.homed else "not homed yet"
    found, facts = f"answers, sketch {firmware or 'unknown'}, {where}", {"firmware": firmware, "homed": status.homed}
    if firmware != __version__:
        return error(
            found,
            f"this release needs sketch {__version__}; the board was flashed with another",
            "`make flash PORT=/dev/ttyACM0` with the board on this machine",
            **facts,
        )
    if status.fault:
        e = explain(status.fault)
        return warning(f"{found}; its last row ended with fault {status.fault}: {e.what}", e.why, e.remedy, **facts)
    return ok(found, **facts)
