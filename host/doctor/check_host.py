"""Checks of the host: rig file, calibration and library; the disk, the scan's duration, the clocks."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime
from pathlib import Path

from polysight.host.calibration import checked_calibration
from polysight.host.capture import PRIORITY_REMEDY
from polysight.host.doctor.bench import Bench, Finding, error, not_checked, ok, warning
from polysight.host.doctor.receiver_load import SEND_US, rates
from polysight.host.materials import SIMULATED_LIBRARY, Library
from polysight.host.plan import scan_time
from polysight.host.process import Options
from polysight.host.radar import require
from polysight.shared.config import Instrument, load_instrument
from polysight.shared.errors import ConfigError
from polysight.shared.geometry import incidence_deg
from polysight.shared.messages import is_simulated
from polysight.shared.raster import check_burst_fits

SPARE = 2.0  # the disk should take so many times what comes
APART_S = 1.0  # the clocks of host and Pi, at most
LOST_S = 60.0  # a clock that is earlier than this file by more has lost its time
_NTP = "`timedatectl set-ntp true`, or set it by hand; a Pi has no battery behind its clock"


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


def check_config(bench: Bench) -> Finding:
    """Read it; a burst must end before the next point, and radars under native control must take their settings."""
    rig = load_instrument(bench.wanted.config)
    check_burst_fits(rig.grid, rig.burst, rig.stage)
    if rig.radar.control == "native":
        require(rig, rig.grid.columns * rig.burst.pulses)
    bench.given = rig
    boards = ", ".join(b.name for b in rig.recorded)
    return ok(
        f"{bench.wanted.config}: {rig.name}, {rig.grid.columns} x {rig.grid.rows} positions, records {boards},"
        f" radars under control {rig.radar.control!r}"
    )


def check_calibration(bench: Bench) -> Finding:
    """What a scan would copy into its folder."""
    simulated = bench.hello is not None and is_simulated(bench.hello.backend)
    facts = checked_calibration(bench.rig, simulated).facts()
    if not facts:
        return ok("none named: geometry, filters and metal as the rig file and the scene have them")
    return ok("; ".join(f"{kind} of {fact['made_utc'][:10]}" for kind, fact in facts.items()), **facts)


def check_library(bench: Bench) -> Finding:
    """A scan can be made without it, but nothing of it would be named."""
    angle, known = incidence_deg(bench.rig, bench.rig.receivers[0]), Library.load(SIMULATED_LIBRARY).angles_deg
    held = " and ".join(f"{a:g}" for a in known)
    facts = {"incidence_deg": angle, "library_deg": list(known)}
    if not Options().unnamed(bench.rig):
        return ok(f"{SIMULATED_LIBRARY.name} holds {held} degrees of incidence, the rig looks at {angle:.1f}", **facts)
    return warning(
        f"the rig looks at {angle:.1f} degrees of incidence, {SIMULATED_LIBRARY.name} holds {held} degrees only",
        "|P| changes by a tenth in a degree, so that nothing of its scans will be named",
        "train a library at this angle (docs/how-to/add-a-material.md) and scan with --library; or --model none",
        **facts,
    )


def check_host_clock(bench: Bench) -> Finding:
    """The clock is later than this program's own files, and the kernel calls it synchronised."""
    now_s = bench.system.wall_ns() * 1e-9
    told = f"{datetime.fromtimestamp(now_s, UTC):%Y-%m-%d %H:%M:%S} UTC"
    if now_s < Path(__file__).stat().st_mtime - LOST_S:
        return error(f"{told}: earlier than this program was installed", "the clock was lost", _NTP)
    if bench.system.clock_is_synchronised() is False:
        return warning(f"{told}, not synchronised", "no time server is reached", _NTP)
    return ok(told)


def check_pi_clock(bench: Bench) -> Finding:
    """How far the Pi's clock is from this one's: to half the time that its answer took."""
    if bench.hello is None or bench.hello.t_unix_ns == 0:
        return not_checked("the Pi does not tell its time", "install the same release on both")
    offset_s = (bench.hello.t_unix_ns - bench.hello_at_ns) * 1e-9
    unsure_s = bench.hello_took_ns * 0.5e-9
    told = f"the Pi's clock is {offset_s:+.3f} s off this one's (to {unsure_s:.3f} s)"
    facts = {"offset_s": offset_s, "uncertainty_s": unsure_s}
    if abs(offset_s) - unsure_s > LOST_S:
        return error(
            told, "one of the two does not know the time: logs and scans cannot be laid side by side", _NTP, **facts
        )
    if abs(offset_s) - unsure_s > APART_S:
        return warning(told, "one of the two is not synchronised", _NTP, **facts)
    return ok(told, **facts)


def check_receivers(bench: Bench) -> Finding:
    """What the receivers hold under load, and whether a scan needs more."""
    some = rates(bench.rig)
    held, scheduling = bench.system.held(bench.rig, some)
    told = "; ".join(
        f"{h.mbit_s:.0f} Mbit/s a card: {'nothing lost' if not h.lost else f'{100 * h.lost / h.sent:.1f} % lost'}"
        for h in held
    )
    told = f"receivers ({scheduling}) beside a busy machine: {told}"
    facts = {"held": [vars(h) for h in held], "scheduling": scheduling}
    needed = held[: some.index(1e6 / (bench.rig.card.packet_delay_us + SEND_US)) + 1]
    if any(h.lost for h in needed):
        why = "other programs take the processor from the receivers"
        return warning(told, why, PRIORITY_REMEDY if "real-time" not in scheduling else "a faster machine", **facts)
    return ok(told, **facts)
