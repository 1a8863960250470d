"""What has to be there before a row begins: a homed stage, and room on the disk."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path

from host.scan.pi_client import PiClient
from host.scan.stop import StopRequest
from shared.config import Instrument
from shared.errors import ScanError
from shared.faults import explain

_HOMING_LIMIT_S = 300.0


def make_ready(pi: PiClient, stop: StopRequest, say: Callable[[str, str], None]) -> bool:
    """Home the stage when the Pi says that it must be. False when it was asked to stop now meanwhile.

    Raises
    ------
    ScanError
        when the stage does not become ready.
    """
    status = pi.status()
    if status.state == "ready" and status.homed:
        return not stop.now
    say("home", "homing the stage")
    if status.state != "homing":
        pi.home()
    deadline = time.monotonic() + _HOMING_LIMIT_S
    while True:
        status = pi.status()
        if status.state == "ready":
            return not stop.now
        if status.state == "fault":
            e = explain(status.fault)
            raise ScanError(f"the stage could not be homed: {e.what}; {status.reason}", e.why, e.remedy)
        if stop.now:
            pi.abort("asked for at the host")
            return False
        if time.monotonic() > deadline:
            raise ScanError(
                f"the stage is {status.state!r} {_HOMING_LIMIT_S:.0f} s after homing began",
                "the stage stands still, or its switches are not reached",
                "`polysight-pi check` on the Pi",
            )
        pi.event_socket.poll(100)
        pi.events()


def check_disk(folder: Path, instrument: Instrument, rows: int) -> None:
    """Refuse to go on without space for so many rows and the reserve. Raises ScanError."""
    need = rows * len(instrument.recorded) * instrument.row_bytes
    reserve = instrument.limits.free_disk_bytes
    free = shutil.disk_usage(folder).free
    if free < need + reserve:
        raise ScanError(
            f"{folder}: {free / 1e9:.2f} GB free, {need / 1e9:.2f} GB needed for {rows} rows and"
            f" {reserve / 1e9:.2f} GB kept free",
            "the disk is too full for this scan",
            f"free space, or lower limits.free_disk_bytes; `polysight resume {folder}` goes on behind its last row",
        )
