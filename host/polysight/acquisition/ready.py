"""Checks before a row begins: homed stage, free disk space, and a Pi with the same `[stage]` as the rig file.

`make_begin_run` makes the command that begins a run, `make_ready` waits for the stage and homes it if that is safe.
`check_same_stage` compares the Pi's own `[stage]` with the rig file's. A *run* is what the Pi calls a scan: it has the
scan's id.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path

from polysight.acquisition.control import StopRequest
from polysight.acquisition.pi_client import MOVING, PiClient
from polysight.acquisition.row import ON_REQUEST
from polysight.store import PiDescription
from polysight_shared.config import Instrument
from polysight_shared.errors import ErrorCode, ScanError, quote
from polysight_shared.faults import PiFault, explain
from polysight_shared.messages import BeginRun, HelloReply, StatusReply
from polysight_shared.raster import RasterPlan, Stage
from polysight_shared.stage_line import HOMING_TIMEOUT_S

# Timeout of homing: longer than the Pi's own, so that the Pi reports the exact reason first.
_HOMING_TIMEOUT_S = HOMING_TIMEOUT_S + 30.0
# Faults after which a person must look at the stage and home it: `polysight-pi home`.
STAGE_FAULTS = (PiFault.STAGE_LOST, PiFault.STAGE_ALARM)
STAGE_NOT_REPORTED = (
    "the Pi does not report its [stage], so it cannot be compared with the rig file's: install this release on the Pi"
)


def make_begin_run(rig: Instrument, scan_id: str, plan: RasterPlan, last_seq: int = 0) -> BeginRun:
    """Return the command that begins or resumes a run; `last_seq` is the last event that this host has."""
    burst = rig.burst
    return BeginRun(
        scan_id=scan_id,
        plan=plan,
        pulses=burst.pulses,
        period_us=burst.period_us,
        width_us=burst.width_us,
        speed_mm_s=rig.stage.speed_mm_s,
        last_seq=last_seq,
        heartbeat_ms=rig.pi.host_heartbeat_ms,
    )


def make_ready(
    pi: PiClient, stop: StopRequest, notify: Callable[[str, str], None], scan_id: str = "", first: bool = True
) -> bool:
    """Wait until a row may begin, and home the stage if that is safe; return False if asked to stop now.

    The stage is homed only before the first row (`first`), when the operator expects motion, and never after
    `STAGE_FAULTS`: a person pressed the emergency stop, or has an arm in the way. The Pi must have begun the run
    `scan_id`; "" for any. `notify` gets phase and message.

    Raises ScanError if the stage is not ready and must not be homed, or homing fails.
    """
    status = pi.status()
    same_run = scan_id in ("", status.scan_id)
    if status.state == "ready" and status.homed and same_run:
        return not stop.now
    check_between_rows(status, scan_id, first)
    if status.state in MOVING:
        notify("wait", f"the stage is {status.state!r}; the row begins when it is ready")
    else:
        notify("home", "homing the stage")
        pi.home()
    return _wait_ready(pi, stop, scan_id)


def measure_lost_steps(
    pi: PiClient, stop: StopRequest, notify: Callable[[str, str], None]
) -> tuple[float, float] | None:
    """Home again after the last row; return the lost steps in x and y, millimetres.

    The count of steps since the last homing gives the place at which each switch is expected; the lost steps are the
    distance from there to the place at which it was reached.
    Returns None if the stage is not ready, or a stop was asked for. Raises ScanError if homing fails.
    """
    if stop.after_row or pi.status().state != "ready":
        return None
    notify("home", "homing the stage again, to measure lost steps")
    pi.home()
    if not _wait_ready(pi, stop, ""):
        return None
    status = pi.status()
    return status.lost_x_mm, status.lost_y_mm


def _wait_ready(pi: PiClient, stop: StopRequest, scan_id: str) -> bool:
    """Wait until the stage is ready; return False if asked to stop now. Raises ScanError."""
    deadline = time.monotonic() + _HOMING_TIMEOUT_S
    while True:
        status = pi.status()
        if status.state == "ready":
            return not stop.now
        if status.state not in MOVING:
            check_between_rows(status, scan_id, first=False)
        if stop.now:
            pi.abort(ON_REQUEST.text)
            return False
        if time.monotonic() > deadline:
            raise ScanError(
                f"the stage is {status.state!r} {_HOMING_TIMEOUT_S:.0f} s after homing began",
                "the stage does not move, or it does not reach its switches",
                "look at the stage; `journalctl -u polysight-pi -n 20` on the Pi",
                code=ErrorCode.STAGE_NOT_READY,
            )
        # Wait up to 0.1 s for an event of the Pi. `events` also records that the Pi is alive.
        pi.event_socket.poll(100)
        pi.events()


def check_between_rows(status: StatusReply, scan_id: str, first: bool) -> None:
    """Raise ScanError if the next row cannot begin without a person.

    That is so if the Pi restarted or has begun another run than `scan_id` ("" for any), after a fault, or if the stage
    must be homed. Before the `first` row of this program, the stage may need homing, and the Pi may report a fault that
    is not one of `STAGE_FAULTS`.
    """
    needs_homing = status.state in ("idle", "homed") or (status.state == "ready" and not status.homed)
    if scan_id and status.scan_id not in ("", scan_id):
        problem = f"the Pi has begun another run in the meantime: {status.scan_id}"
        cause = "another host uses it"
        remedy = "wait for its end"
    elif scan_id and not status.scan_id:
        problem = "the Pi's program restarted between two rows"
        cause = "power was lost there, or the program ended"
        remedy = "see `journalctl -u polysight-pi` on the Pi"
    elif status.state == "fault" and (not first or status.fault in STAGE_FAULTS):
        explained = explain(status.fault)
        problem = f"the stage is not ready: {explained.problem}: {status.reason}"
        cause = explained.cause
        remedy = explained.remedy
    elif not first and needs_homing:
        problem = f"the stage is {status.state!r} between two rows"
        if status.reason:
            problem += f": {status.reason}"
        cause = "its position was lost, homing was stopped, or somebody ended the run at the Pi"
        remedy = "check that nothing is in the way, then `polysight-pi home`"
    else:
        return
    raise ScanError(problem, cause, remedy, code=ErrorCode.STAGE_NOT_READY)


def check_disk(folder: Path, instrument: Instrument, rows: int) -> None:
    """Check that the disk has space for this number of rows and the reserve. Raises ScanError."""
    needed_bytes = rows * instrument.recorded_row_bytes
    reserved_bytes = instrument.limits.free_disk_bytes
    free_bytes = shutil.disk_usage(folder).free
    if free_bytes < needed_bytes + reserved_bytes:
        raise ScanError(
            f"{folder}: {free_bytes / 1e9:.2f} GB free, {needed_bytes / 1e9:.2f} GB needed for {rows} rows and"
            f" {reserved_bytes / 1e9:.2f} GB kept free",
            "the disk is too full for this scan",
            f"free space, then `polysight resume {quote(folder)}`; or lower limits.free_disk_bytes in instrument.toml,"
            " and add --config instrument.toml",
            code=ErrorCode.DISK_FULL,
        )


def describe_pi(hello: HelloReply) -> PiDescription:
    """Return the manifest's description of the Pi."""
    return PiDescription(hello.pi_release, hello.firmware, hello.backend, hello.stage)


def list_stage_differences(stage: Stage, hello: HelloReply) -> list[str]:
    """List the keys of `[stage]` that place rows and differ on the Pi, with both values; [] if it reports none."""
    settings = stage.placement_settings
    return [
        f"stage.{key} is {settings[key]:.10g} here and {hello.stage[key]:.10g} on the Pi"
        for key in settings
        if hello.stage.get(key, settings[key]) != settings[key]
    ]


def check_same_stage(stage: Stage, hello: HelloReply, source: str) -> list[str]:
    """Check that the Pi places rows where `stage` does; `source` names the origin of `stage`.

    Returns a warning if the Pi's release does not report its `[stage]`. Raises ScanError with both values of each key
    that differs.
    """
    if differing := list_stage_differences(stage, hello):
        raise ScanError(
            f"host and Pi place rows differently: {'; '.join(differing)}",
            f"the rig file of the Pi is not that of {source}; rows recorded with both would have different "
            "coordinates in one scan",
            "copy the right [stage] to the other machine and `sudo systemctl restart polysight-pi`; rows recorded "
            "with other values belong to another scan",
            code=ErrorCode.STAGE_DIFFERS,
        )
    if hello.stage:
        return []
    return [STAGE_NOT_REPORTED]
