"""A scan from the first row that is not committed to the last: `run_scan` and `resume_scan`.

Every row is a transaction (docs/spec/scan-folder.md): taken, checked by count, made durable, and only then a line in
the manifest. Whatever ends the program at any time, `resume_scan` goes on from there.
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import zmq

from polysight.host.acquisition.capture_rig import CaptureRig
from polysight.host.acquisition.control import StopRequest, interrupts_wait
from polysight.host.acquisition.pi_client import PiClient
from polysight.host.acquisition.progress import OnProgress, OnRow, ScanProgress, ScanResult
from polysight.host.acquisition.ready import check_same_stage, differences, pi_fact
from polysight.host.acquisition.scan_loop import RunningScan
from polysight.host.calibration import copy_into_scan
from polysight.host.radar import RadarControl, radar_control
from polysight.host.store import (
    ManifestWriter,
    ScanFolder,
    check_same_scan,
    connection_of,
    damaged_rows,
    new_scan_id,
    utc_now,
)
from polysight.shared.config import Instrument
from polysight.shared.errors import ScanError
from polysight.shared.messages import HelloReply, is_simulated
from polysight.shared.raster import check_burst_fits, plan_raster

__all__ = ["OnRow", "ScanProgress", "ScanResult", "resume_scan", "run_scan"]


def run_scan(
    instrument: Instrument,
    folder: Path,
    *,
    on_row: OnRow | None = None,
    progress: OnProgress | None = None,
    keep_incomplete: bool = False,
    stop: StopRequest | None = None,
    radars: RadarControl | None = None,
) -> ScanResult:
    """Make a new scan folder and scan the rig into it.

    Parameters
    ----------
    instrument
        The rig, the grid and the limits.
    folder
        Scan folder to make.
    on_row
        Called with each committed row's index, in order, from one worker thread of low priority.
    progress
        Called from the calling thread.
    keep_incomplete
        Commit a row that stays incomplete after all retakes, masked, instead of failing.
    stop
        Asked to stop once: after this row; twice: now. Ctrl-C asks, where this runs in the main thread.
    radars
        What arms the radars for each row; that of the rig file when None. Closed at the end.

    Raises
    ------
    PolysightError
        naming the hop that failed and what to do; the manifest says the same, and all committed rows are safe.
    """
    plan = plan_raster(instrument.grid)
    check_burst_fits(instrument.grid, instrument.burst, instrument.stage)
    with ExitStack() as stack:
        pi, rig, hello = _connect(stack, instrument, progress)
        untold = check_same_stage(instrument.stage, hello, "this scan")
        simulated = is_simulated(hello.backend)
        scan = ScanFolder.create(
            folder,
            instrument,
            plan,
            simulated=simulated,
            scan_id=new_scan_id(),
            extra={
                "pi": pi_fact(hello),
                "calibration": copy_into_scan(instrument, folder, simulated),
            },
        )
        writer = stack.enter_context(scan.writer())
        radars = stack.enter_context(radars or radar_control(instrument))
        stop = stop or StopRequest()
        running = RunningScan(scan, writer, pi, rig, radars, on_row, progress, keep_incomplete, stop)
        running.result.warnings += untold
        return running.run()


def resume_scan(
    folder: Path,
    *,
    on_row: OnRow | None = None,
    progress: OnProgress | None = None,
    keep_incomplete: bool = False,
    stop: StopRequest | None = None,
    radars: RadarControl | None = None,
    rig_now: Instrument | None = None,
) -> ScanResult:
    """Go on with a scan at its first row that is not committed; committed rows are compared with their digests.

    A row that is not what was committed is taken again. `rig_now` says how the Pi and the boards are reached from now
    on, and the limits; in all else it has to be the rig that the scan was begun with
    (:func:`polysight.host.store.scan_folder.check_same_scan`).

    Parameters and errors as :func:`run_scan`. `on_row` is called for the rows committed earlier too.
    """
    scan = ScanFolder.load(folder)
    if rig_now is not None:
        check_same_scan(scan.instrument, rig_now, "the rig file given")
    with ExitStack() as stack:
        writer = stack.enter_context(scan.writer())
        scan.reload()
        withdrawn = _withdraw_damaged(scan, writer, progress)
        pi, rig, hello = _connect(stack, rig_now or scan.instrument, progress)
        if is_simulated(hello.backend) != scan.simulated:
            kind = "simulated" if scan.simulated else "of the real rig"
            raise ScanError(
                f"{folder} is a scan that is {kind}, and the Pi's backend is {hello.backend!r}",
                "simulated and measured rows must never be mixed in one scan",
                "start the Pi with the backend the scan was begun with, or make a new scan",
            )
        if not hello.stage or any(fact.get("pi", {}).get("stage") for fact in scan.facts("scan_started")):
            untold = check_same_stage(scan.instrument.stage, hello, f"{folder}")
        else:  # its rows lie where that Pi had them, whatever the host's rig file says
            untold = [f"when the scan began nobody compared: {d}" for d in differences(scan.instrument.stage, hello)]
        missing = scan.plan.rows - len(scan.committed())
        fact = {"fact": "scan_resumed", "resumed_utc": utc_now(), "rows_missing": missing, "pi": pi_fact(hello)}
        told = {} if rig_now is None else {"rig": connection_of(rig_now)}
        writer.append({**fact, **told})
        scan.reload()
        radars = stack.enter_context(radars or radar_control(scan.instrument))
        stop = stop or StopRequest()
        running = RunningScan(scan, writer, pi, rig, radars, on_row, progress, keep_incomplete, stop)
        running.result.warnings += withdrawn + untold
        return running.run()


def _withdraw_damaged(scan: ScanFolder, writer: ManifestWriter, progress: OnProgress | None) -> list[str]:
    """Take back the commit of every row whose files are not what was committed, so that it is taken again.

    Returns what to tell about it. Raises DeviceError.
    """
    rows = scan.committed()
    if progress is not None:
        progress(ScanProgress("check", f"comparing {len(rows)} committed rows with their digests", scan.plan.rows, 0))
    damaged = damaged_rows(scan)
    for row, reasons in damaged.items():
        fact = {"fact": "row_withdrawn", "row": row, "take": rows[row].take, "reasons": reasons}
        writer.append({**fact, "withdrawn_utc": utc_now()})
    scan.reload()
    return [f"row {row} is taken again: {'; '.join(reasons)}" for row, reasons in damaged.items()]


def _connect(
    stack: ExitStack, instrument: Instrument, progress: OnProgress | None
) -> tuple[PiClient, CaptureRig, HelloReply]:
    """Reach the Pi and every card, so that a scan folder is made only when everybody answers."""
    if progress is not None:
        progress(ScanProgress("connect", "reaching the Pi and the capture cards", instrument.grid.rows, 0))
    # A context's plain end waits for ever for a socket that nobody closed, such as one whose making was interrupted.
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    stack.callback(context.destroy, linger=0)
    with interrupts_wait():
        pi = stack.enter_context(PiClient(context, instrument))
    hello = pi.hello()
    rig = stack.enter_context(CaptureRig(instrument))
    rig.configure()
    return pi, rig, hello
