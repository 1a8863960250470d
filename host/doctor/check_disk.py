"""Room and speed of the disk, and how long a scan takes."""

from __future__ import annotations

import shutil
from pathlib import Path

from polysight.host.doctor.bench import Bench
from polysight.host.doctor.finding import Finding, error, ok, warning
from polysight.host.plan.timing import scan_time
from polysight.shared.config import Instrument
from polysight.shared.errors import ConfigError

SPARE = 2.0  # the disk should take so many times what comes


def row_s(rig: Instrument) -> float:
    """How long a row takes, from one row's first point to the next one's, as `polysight plan` has it: seconds."""
    return scan_time(rig).total_s / rig.grid.rows


def check_disk(bench: Bench) -> Finding:
    """Room for a whole scan and the reserve, and twice the speed at which data comes."""
    rig, folder = bench.rig, _existing(bench.wanted.out)
    need, reserve, free = rig.scan_bytes, rig.limits.free_disk_bytes, shutil.disk_usage(folder).free
    told = f"{folder}: {free / 1e9:.1f} GB free, a scan needs {need / 1e9:.2f} GB and {reserve / 1e9:.1f} GB reserve"
    if free < need + reserve:
        return error(
            told,
            "the disk is too full for a whole scan",
            "free space, or another --out",
            free_bytes=free,
            need_bytes=need,
        )
    speed, wanted = bench.system.write_speed(folder), need / (rig.grid.rows * row_s(rig))
    told += f"; it writes {speed / 1e6:.0f} MB/s durably, a scan brings {wanted / 1e6:.2f} MB/s"
    facts = {"free_bytes": free, "need_bytes": need, "write_bytes_s": speed, "scan_bytes_s": wanted}
    if speed < wanted:
        return error(
            told,
            "the disk is slower than the data comes: a network share, or a worn card",
            "scan to a local disk",
            **facts,
        )
    if speed < SPARE * wanted:
        return warning(told, "the disk has little to spare", "scan to a faster disk", **facts)
    return ok(told, **facts)


def _existing(folder: Path) -> Path:
    """The folder, or the nearest one above it that exists."""
    found = folder.resolve()
    while not found.exists():
        found = found.parent
    if not found.is_dir():
        raise ConfigError(f"--out {folder}: {found} is a file", "a scan needs a folder", "give another --out")
    return found


def check_time(bench: Bench) -> Finding:
    """How long a scan of the configured grid takes, from the plan."""
    rig = bench.rig
    seconds = rig.grid.rows * row_s(rig)
    hours, minutes = divmod(round(seconds / 60), 60)
    told = f"{hours} h {minutes:02d} min" if hours else f"{seconds / 60:.1f} min"
    return ok(
        f"a scan of {rig.grid.rows} rows takes about {told}: {row_s(rig):.1f} s a row, {rig.scan_bytes / 1e9:.2f} GB",
        seconds=seconds,
        bytes=rig.scan_bytes,
    )
