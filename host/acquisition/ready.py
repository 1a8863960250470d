"""What has to be true before a row begins: a homed stage, room on the disk, and the Pi the scan was begun with.

`make_ready` waits for the first and homes where that is safe. `check_same_stage` compares the Pi's own `[stage]` with
the rig file's: a Pi that would place rows elsewhere is refused.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path

from polysight.host.acquisition.control import StopRequest
from polysight.host.acquisition.pi_client import AT_WORK, PiClient
from polysight.host.acquisition.take import ON_REQUEST
from polysight.host.store import Fact
from polysight.shared.config import Instrument, Stage
from polysight.shared.errors import ScanError
from polysight.shared.faults import PiFault, explain
from polysight.shared.messages import HelloReply, StatusReply
from polysight.shared.stage_line import HOMING_TIMEOUT_S

_HOMING_LIMIT_S = HOMING_TIMEOUT_S + 30.0  # longer than the Pi, whose reason is the exact one
STAGE_FAULTS = (PiFault.STAGE_LOST, PiFault.STAGE_ALARM)  # homed by hand, after a look: `polysight-pi home`
UNTOLD = "the Pi does not tell its [stage], so nobody compares it with this rig file's: install this release on the Pi"


def make_ready(
    pi: PiClient, stop: StopRequest, say: Callable[[str, str], None], scan_id: str = "", first: bool = True
) -> bool:
    """Wait until a row may begin, and home the stage for it where that is safe; False when asked to stop now meanwhile.

    The stage is homed before the first row only, when somebody has just asked for a scan and expects it to move, and
    never out of a stage that was lost or is in alarm: somebody pressed the emergency stop, or has an arm in the way.

    Parameters
    ----------
    pi, stop, say
        The Pi, what may ask to stop, and who is told of homing.
    scan_id
        The run that has to be begun; "" for any.
    first
        Whether nothing has moved for this program yet.

    Raises
    ------
    ScanError
        when the stage is not ready, and may not be homed or does not become ready by it.
    """
    status = pi.status()
    if status.state == "ready" and status.homed and status.scan_id == (scan_id or status.scan_id):
        return not stop.now
    check_may_move(status, scan_id, first)
    if status.state in AT_WORK:
        say("wait", f"the stage is {status.state!r}; the row begins when it is ready")
    else:
        say("home", "homing the stage")
        pi.home()
    return _await_ready(pi, stop, scan_id)


def count_lost_steps(pi: PiClient, stop: StopRequest, say: Callable[[str, str], None]) -> tuple[float, float] | None:
    """Home once more after the last row, against the switches; None where that was not possible, or not wanted.

    Returns how far in x and y, millimetres, the switches are from where they were by the count of steps: what the
    drives have lost since the homing before.

    Raises
    ------
    ScanError
        when the stage does not become ready by it.
    """
    if stop.after_row or pi.status().state != "ready":
        return None
    say("home", "homing the stage once more, to see whether steps were lost")
    pi.home()
    if not _await_ready(pi, stop, ""):
        return None
    status = pi.status()
    return status.lost_x_mm, status.lost_y_mm


def _await_ready(pi: PiClient, stop: StopRequest, scan_id: str) -> bool:
    """Wait until the stage is ready; False when asked to stop now meanwhile. Raises ScanError."""
    deadline = time.monotonic() + _HOMING_LIMIT_S
    while True:
        status = pi.status()
        if status.state == "ready":
            return not stop.now
        if status.state not in AT_WORK:
            check_may_move(status, scan_id, first=False)
        if stop.now:
            pi.abort(ON_REQUEST.text)
            return False
        if time.monotonic() > deadline:
            raise ScanError(
                f"the stage is {status.state!r} {_HOMING_LIMIT_S:.0f} s after homing began",
                "the stage stands still, or its switches are not reached",
                "look at the stage; `journalctl -u polysight-pi -n 20` on the Pi",
            )
        pi.event_socket.poll(100)
        pi.events()


def check_may_move(status: StatusReply, scan_id: str, first: bool) -> None:
    """Raise ScanError where a row could begin only after homing, and somebody has to have a look before that."""
    if scan_id and status.scan_id not in ("", scan_id):
        raise ScanError(
            f"the Pi has begun another run meanwhile: {status.scan_id}", "another host uses it", "wait for its end"
        )
    if scan_id and not status.scan_id:
        raise ScanError(
            "the Pi's program was started anew between two rows",
            "power was lost there, or the program ended",
            "why it ended: `journalctl -u polysight-pi` on the Pi",
        )
    if status.state == "fault" and (not first or status.fault in STAGE_FAULTS):
        e = explain(status.fault)
        raise ScanError(f"the stage is not ready: {e.what}: {status.reason}", e.why, e.remedy)
    if not first and (status.state in ("idle", "homed") or (status.state == "ready" and not status.homed)):
        raise ScanError(
            f"the stage is {status.state!r} between two rows" + (f": {status.reason}" if status.reason else ""),
            "its position was lost, homing was stopped, or somebody ended the run at the Pi",
            "see that nothing is in the way, then `polysight-pi home`",
        )


def check_disk(folder: Path, instrument: Instrument, rows: int) -> None:
    """Refuse to go on without space for so many rows and the reserve. Raises ScanError."""
    need = rows * instrument.recorded_row_bytes
    reserve = instrument.limits.free_disk_bytes
    free = shutil.disk_usage(folder).free
    if free < need + reserve:
        raise ScanError(
            f"{folder}: {free / 1e9:.2f} GB free, {need / 1e9:.2f} GB needed for {rows} rows and"
            f" {reserve / 1e9:.2f} GB kept free",
            "the disk is too full for this scan",
            f"free space, then `polysight resume {folder}`; or lower limits.free_disk_bytes in instrument.toml, and add"
            " --config instrument.toml",
        )


def pi_fact(hello: HelloReply) -> Fact:
    """What a manifest keeps of the Pi that drives a scan."""
    return {"release": hello.pi_release, "firmware": hello.firmware, "backend": hello.backend, "stage": hello.stage}


def differences(stage: Stage, hello: HelloReply) -> list[str]:
    """Each placing key of `[stage]` that the Pi has otherwise, with both values; [] for a Pi that does not tell."""
    own = stage.placement_settings
    return [
        f"stage.{key} is {own[key]:.10g} here and {hello.stage[key]:.10g} on the Pi"
        for key in own
        if hello.stage.get(key, own[key]) != own[key]
    ]


def check_same_stage(stage: Stage, hello: HelloReply, source: str) -> list[str]:
    """Refuse a Pi that would place the rows elsewhere; `source` is where `stage` is from.

    Returns
    -------
    list of str
        Warnings: that the Pi is of a release that does not tell.

    Raises
    ------
    ScanError
        naming each key with both values.
    """
    if differing := differences(stage, hello):
        raise ScanError(
            f"host and Pi place rows differently: {'; '.join(differing)}",
            f"the rig file of the Pi is not that of {source}; rows of both would be two coordinate systems in one scan",
            "copy the right [stage] to the other machine and `sudo systemctl restart polysight-pi`; rows taken with"
            " other values belong to another scan",
        )
    return [] if hello.stage else [UNTOLD]
