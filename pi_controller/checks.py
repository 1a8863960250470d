"""`polysight-pi check`: every line, port, permission, clock, right, key and disk, named, with what to do."""

from __future__ import annotations

import ctypes
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import zmq

from polysight.pi_controller.bringup import bench_stage
from polysight.pi_controller.checks_lines import check_lines
from polysight.pi_controller.finding import Finding, attempt
from polysight.pi_controller.journal import JournalFolder
from polysight.pi_controller.lines_wires import WireLines
from polysight.pi_controller.wiring import read_model
from polysight.shared.config import Instrument
from polysight.shared.errors import DeviceError
from polysight.shared.raster import check_burst_fits
from polysight.shared.sockets import is_loopback, publisher, replier

JOURNAL_BYTES = 100 << 20  # a scan of 70,000 positions journals about 20 MB


def check_all(instrument: Instrument, wires: Path | None, stage_port: str, journal: Path) -> Iterator[Finding]:
    """Run every check, in the order in which a rig comes to life. Moves nothing and sends no pulse."""
    pi = instrument.pi
    yield attempt("plan", lambda: _plan(instrument))
    yield _clock()
    if wires is not None:
        yield Finding("real time", "ok", "simulated wires have their own time; no real-time rights are needed")
        yield attempt("simulated wires", lambda: _wires(instrument, wires))
    else:
        yield _schedule()
        yield _memory()
        yield from check_lines(instrument, read_model())
    yield attempt("stage port", lambda: _port(stage_port))
    yield attempt("stage", lambda: _stage(instrument, stage_port))
    yield attempt("journal", lambda: _journal(journal))
    yield attempt("disk", lambda: _disk(journal, min(instrument.limits.free_disk_bytes, JOURNAL_BYTES)))
    yield attempt("keys", lambda: _keys(Path(pi.key_dir), (pi.command_address, pi.event_address)))
    for name, address in (("command address", pi.command_address), ("event address", pi.event_address)):
        yield attempt(name, lambda name=name, address=address: _address(name, address, Path(pi.key_dir)))


def _plan(instrument: Instrument) -> str:
    check_burst_fits(instrument.grid, instrument.burst, instrument.stage)
    b = instrument.burst
    return f"burst of {b.pulses} x {b.period_us:g} us ends before the next point"


def _clock() -> Finding:
    resolution_ns = time.clock_getres(time.CLOCK_MONOTONIC) * 1e9
    if resolution_ns > 1000:
        return Finding(
            "clock", "fail", f"CLOCK_MONOTONIC steps by {resolution_ns:.0f} ns", "use a kernel with hrtimers"
        )
    return Finding("clock", "ok", f"CLOCK_MONOTONIC resolves {resolution_ns:.0f} ns")


def _schedule() -> Finding:
    old = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        os.sched_setscheduler(0, *old)
    except OSError as e:
        remedy = "LimitRTPRIO=99 in the service; without it other programs can delay a pulse"
        return Finding("schedule right", "warn", f"SCHED_FIFO is not permitted: {e.strerror}", remedy)
    return Finding("schedule right", "ok", "SCHED_FIFO is permitted")


def _memory() -> Finding:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(1) != 0:
        error = os.strerror(ctypes.get_errno())
        remedy = "LimitMEMLOCK=infinity in the service; without it a page fault can delay a pulse"
        return Finding("locked memory", "warn", f"not permitted: {error}", remedy)
    libc.munlockall()
    return Finding("locked memory", "ok", "memory may be locked")


def _wires(instrument: Instrument, wires: Path) -> str:
    WireLines(wires, instrument.pi, timeout_s=1.0).close()
    return f"{wires}: trigger {instrument.pi.trigger_in}, SYNC_IN {', '.join(map(str, instrument.pi.sync_out))}"


def _port(port: str) -> str:
    try:
        os.close(os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK))
    except OSError as e:
        remedy = {
            "PermissionError": "add the user to the group dialout",
            "FileNotFoundError": "plug it in, and correct stage.port: `ls -l /dev/ttyACM* /dev/ttyUSB*`",
        }.get(type(e).__name__, "end the other program, or unplug and plug in the board")
        raise DeviceError(f"{port}: {e.strerror}", "", remedy) from None
    return f"{port} can be opened"


def _stage(instrument: Instrument, port: str) -> str:
    with bench_stage(instrument.stage, port) as stage:
        here = stage.position()
        return f"{port} answers, firmware {stage.open() or '?'}, at {here.x_mm:.2f}, {here.y_mm:.2f} mm"


def _journal(path: Path) -> str:
    JournalFolder(path).close()
    return f"{path} can be written"


def _disk(path: Path, needed: int) -> str:
    try:
        free = shutil.disk_usage(path if path.exists() else path.parent).free
    except OSError as e:
        raise DeviceError(f"{path}: {e.strerror}", "", "correct pi.journal_dir") from None
    if free < needed:
        raise DeviceError(
            f"{path}: {free >> 20} MiB free, {needed >> 20} MiB wanted", "the disk fills", "remove old journals there"
        )
    return f"{free >> 20} MiB free for journals"


def _keys(folder: Path, addresses: tuple[str, ...]) -> str | Finding:
    if all(is_loopback(a) for a in addresses):
        return "not needed: both addresses are loopback"
    secret = folder / "pi.key_secret"
    if not secret.is_file():
        raise DeviceError(f"{secret} is not there", "keys were not made yet", "polysight-pi keys")
    if secret.stat().st_mode & 0o077:
        found = f"{secret} can be read by others than its owner"
        return Finding("keys", "warn", found, f"chmod 600 {secret}; new ones with `polysight-pi keys --replace`")
    return f"{secret}"


def _address(name: str, address: str, key_dir: Path) -> str:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    try:
        make = replier if name.startswith("command") else publisher
        make(context, address, key_dir).close()
    finally:
        context.destroy(linger=0)
    return f"{address} can be bound" + (" (loopback, no keys needed)" if is_loopback(address) else " with CURVE keys")
