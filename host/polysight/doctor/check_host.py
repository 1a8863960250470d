"""Checks of host, Pi and stage: rig file, clocks, keys, calibration, library, receivers, disk, trigger line.

The trigger line is checked with a short row in which every point must give an edge. Only this check moves the stage,
and only with `--move`.
"""

from __future__ import annotations

import os
import shutil
import time
from datetime import UTC, datetime
from pathlib import Path

from polysight.acquisition import StopRequest, make_ready, stage_differences
from polysight.calibration import checked_calibration
from polysight.capture import PRIORITY_REMEDY
from polysight.doctor.context import CheckContext, error, not_checked, ok, warning
from polysight.doctor.machine import PACKET_TIME_US, card_rates
from polysight.materials import SIMULATED_LIBRARY, Library
from polysight.plan import scan_time
from polysight.process import why_unnamed
from polysight.radar import require
from polysight.settings import DEFAULT
from polysight.store import new_scan_id
from polysight_shared import __version__
from polysight_shared.config import load_instrument
from polysight_shared.errors import ConfigError, DeviceError
from polysight_shared.faults import explain
from polysight_shared.findings import Finding
from polysight_shared.geometry import incidence_deg
from polysight_shared.messages import BeginRun, RowFinished, is_simulated
from polysight_shared.raster import RasterPlan, check_burst_fits
from polysight_shared.sockets import HOST_KEYS, is_loopback

_SPEED_MARGIN = 2.0  # disk speed relative to the data rate
_MAX_CLOCK_OFFSET_S = 1.0  # between host and Pi
_CLOCK_LOST_S = 60.0
_SET_CLOCK = "`timedatectl set-ntp true`, or set it by hand; a Pi has no battery for its clock"


def check_config(context: CheckContext) -> Finding:
    """Load the rig file; check that a burst fits between two points, and the settings of natively controlled radars."""
    options = context.options
    rig = load_instrument(options.config)
    check_burst_fits(rig.grid, rig.burst, rig.stage)
    if rig.radar.control == "native":
        require(rig, rig.grid.columns * rig.burst.pulses)
    context.loaded_rig = rig
    boards = ", ".join(b.name for b in rig.recorded)
    return ok(
        f"{options.config}: {rig.name}, {rig.grid.columns} x {rig.grid.rows} positions, records {boards},"
        f" radar control {rig.radar.control!r}"
    )


def check_host_clock(context: CheckContext) -> Finding:
    """Check that the clock is later than this program's files, and synchronised."""
    now_s = context.system.wall_ns() * 1e-9
    observed = f"{datetime.fromtimestamp(now_s, UTC):%Y-%m-%d %H:%M:%S} UTC"
    if now_s < Path(__file__).stat().st_mtime - _CLOCK_LOST_S:
        return error(f"{observed}: earlier than this program's installation", "the clock lost its time", _SET_CLOCK)
    if context.system.clock_is_synchronised() is False:
        return warning(f"{observed}, not synchronised", "no time server is reachable", _SET_CLOCK)
    return ok(observed)


def check_pi_clock(context: CheckContext) -> Finding:
    """Compare the clocks of Pi and host; the uncertainty is half the duration of the request."""
    if context.hello is None or context.hello.t_unix_ns == 0:
        return not_checked("the Pi does not report its time", "install the same release on both")
    offset_s = (context.hello.t_unix_ns - context.hello_at_ns) * 1e-9
    uncertainty_s = context.hello_took_ns * 0.5e-9
    observed = f"the Pi's clock minus this machine's: {offset_s:+.3f} s (+- {uncertainty_s:.3f} s)"
    facts = {"offset_s": offset_s, "uncertainty_s": uncertainty_s}
    if abs(offset_s) - uncertainty_s > _CLOCK_LOST_S:
        return error(observed, "one clock is wrong: times in logs and scans cannot be compared", _SET_CLOCK, **facts)
    if abs(offset_s) - uncertainty_s > _MAX_CLOCK_OFFSET_S:
        return warning(observed, "one of the two clocks is not synchronised", _SET_CLOCK, **facts)
    return ok(observed, **facts)


def check_calibration(context: CheckContext) -> Finding:
    """Check the calibration files that a scan would copy into its folder."""
    simulated = context.hello is not None and is_simulated(context.hello.backend)
    facts = checked_calibration(context.rig, simulated).facts()
    if not facts:
        return ok("no calibration file is configured: geometry, filters and metal as in the rig file and the scene")
    return ok("; ".join(f"{kind} of {fact['made_utc'][:10]}" for kind, fact in facts.items()), **facts)


def check_library(context: CheckContext) -> Finding:
    """Compare the rig's incidence angle with those of the default library; without a match no material is named."""
    angle = incidence_deg(context.rig, context.rig.receivers[0])
    angles = Library.load(SIMULATED_LIBRARY).angles_deg
    library_angles = " and ".join(f"{a:g}" for a in angles)
    facts = {"incidence_deg": angle, "library_deg": list(angles)}
    observed = f"incidence angle of the rig {angle:.1f} degrees, of {SIMULATED_LIBRARY.name} {library_angles} degrees"
    if not why_unnamed(DEFAULT, context.rig):
        return ok(observed, **facts)
    return warning(
        observed,
        "|P| changes by about 10 % per degree, so no material of this rig's scans will be named",
        "train a library at this angle (docs/how-to/add-a-material.md) and scan with --library; or --model none",
        **facts,
    )


def check_receivers(context: CheckContext) -> Finding:
    """Measure the receivers' packet loss under load; loss at a rate that this rig's cards reach is a warning."""
    rates = card_rates(context.rig)
    results, scheduling = context.system.measure_receivers(context.rig, rates)
    losses = "; ".join(
        f"{r.mbit_s:.0f} Mbit/s a card: {'no loss' if not r.lost else f'{100 * r.lost / r.sent:.1f} % lost'}"
        for r in results
    )
    observed = f"receivers ({scheduling}) with all cores busy: {losses}"
    facts = {"held": [vars(r) for r in results], "scheduling": scheduling}
    needed = results[: rates.index(1e6 / (context.rig.card.packet_delay_us + PACKET_TIME_US)) + 1]
    if any(r.lost for r in needed):
        remedy = "use a faster machine" if "real-time" in scheduling else PRIORITY_REMEDY
        return warning(observed, "other programs take processor time from the receivers", remedy, **facts)
    return ok(observed, **facts)


def check_disk(context: CheckContext) -> Finding:
    """Check free space for a scan and the reserve, and for twice the scan's data rate."""
    rig = context.rig
    folder = _nearest_existing(context.options.out)
    need = rig.scan_bytes
    reserve = rig.limits.free_disk_bytes
    free = shutil.disk_usage(folder).free
    observed = (
        f"{folder}: {free / 1e9:.1f} GB free, a scan needs {need / 1e9:.2f} GB and {reserve / 1e9:.1f} GB reserve"
    )
    facts: dict[str, float] = {"free_bytes": free, "need_bytes": need}
    if free < need + reserve:
        return error(observed, "the disk is too full for a scan", "free space, or give another --out", **facts)
    speed = context.system.write_speed(folder)
    rate = need / scan_time(rig).total_s
    observed += f"; durable write speed {speed / 1e6:.0f} MB/s, data rate of a scan {rate / 1e6:.2f} MB/s"
    facts |= {"write_bytes_s": speed, "scan_bytes_s": rate}
    if speed < rate:
        return error(observed, "the disk is too slow: a network share or a worn card", "scan to a local disk", **facts)
    if speed < _SPEED_MARGIN * rate:
        return warning(observed, "the disk is hardly fast enough", "scan to a faster disk", **facts)
    return ok(observed, **facts)


def _nearest_existing(folder: Path) -> Path:
    observed = folder.resolve()
    while not observed.exists():
        observed = observed.parent
    if not observed.is_dir():
        raise ConfigError(f"--out {folder}: {observed} is a file", "a scan needs a folder", "give another --out")
    return observed


def check_time(context: CheckContext) -> Finding:
    """Estimate the duration of a scan of the configured grid."""
    rig = context.rig
    seconds = scan_time(context.rig).total_s
    hours, minutes = divmod(round(seconds / 60), 60)
    duration = f"{hours} h {minutes:02d} min" if hours else f"{seconds / 60:.1f} min"
    return ok(
        f"a scan of {rig.grid.rows} rows takes about {duration}: {seconds / rig.grid.rows:.1f} s a row,"
        f" {rig.scan_bytes / 1e9:.2f} GB",
        seconds=seconds,
        bytes=rig.scan_bytes,
    )


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
    context.hello = hello
    context.hello_at_ns = (before + after) // 2
    context.hello_took_ns = after - before
    backend = SIMULATED if is_simulated(hello.backend) else f"GPIO backend {hello.backend}"
    observed = f"{context.rig.pi.command_address} answers: release {hello.pi_release}, {backend}, state {hello.state}"
    facts = {"release": hello.pi_release, "backend": hello.backend, "state": hello.state}
    if hello.pi_release != __version__:
        return error(
            observed,
            f"this host has release {__version__}",
            "install the same release on both: `make pi-install HOST=...`",
            **facts,
        )
    if differing := stage_differences(context.rig.stage, hello):
        return error(
            f"{observed}; {'; '.join(differing)}",
            "host and Pi have different rig files, so the Pi would refuse a scan",
            "copy the right [stage] to the other machine, `sudo systemctl restart polysight-pi`",
            **facts,
        )
    return ok(observed, **facts)


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
    if (busy := check_free(context)).level == "error":
        return busy
    row = _run_row(context)
    facts = {"points": row.points, "edges": row.edges, "pulses": row.pulses, "fault": row.fault}
    observed = f"{row.points} points passed, {row.edges} edges detected, {row.pulses} pulses sent"
    expected = _POINTS * context.rig.burst.pulses
    if row.points and not row.edges:
        return error(
            observed,
            "the trigger line is stuck: no edge reaches the Pi",
            f"check the wire and its ground from the stage's trigger pin to GPIO {context.rig.pi.trigger_in}, the level"
            " shifter, and pi.trigger_in; with the Pi's service stopped, `polysight-pi check` there reports which"
            " program uses the line",
            **facts,
        )
    if row.status != "done" or row.edges != _POINTS or row.pulses != expected:
        e = explain(row.fault)
        return error(f"{observed}, {_POINTS} and {expected} expected: {row.reason or e.what}", e.why, e.remedy, **facts)
    if row.fault or row.reason:
        return warning(f"{observed}; {row.reason}", "", "watch the stage during a row", **facts)
    return ok(observed, **facts)


def _run_row(context: CheckContext) -> RowFinished:
    """Run one row of `_POINTS` points in a run of its own and return its end event."""
    rig = context.rig
    pi = context.pi
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
    observed = f"answers, sketch {firmware or 'unknown'}, {where}"
    facts = {"firmware": firmware, "homed": status.homed}
    if firmware != __version__:
        return error(
            observed,
            f"this release needs sketch {__version__}; the board was flashed with another",
            "`make flash PORT=/dev/ttyACM0` with the board on this machine",
            **facts,
        )
    if status.fault:
        e = explain(status.fault)
        return warning(f"{observed}; its last row ended with fault {status.fault}: {e.what}", e.why, e.remedy, **facts)
    return ok(observed, **facts)
