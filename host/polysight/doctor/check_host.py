"""Checks of the host: rig file, clocks, calibration, library, receivers, disk, duration of a scan."""

from __future__ import annotations

import shutil
from datetime import UTC, datetime
from pathlib import Path

from polysight.calibration import checked_calibration
from polysight.capture import PRIORITY_REMEDY
from polysight.doctor.context import CheckContext, Finding, error, not_checked, ok, warning
from polysight.doctor.receiver_load import PACKET_TIME_US, card_rates
from polysight.materials import SIMULATED_LIBRARY, Library
from polysight.plan import scan_time
from polysight.process import why_unnamed
from polysight.radar import require
from polysight.settings import DEFAULT
from polysight_shared.config import load_instrument
from polysight_shared.errors import ConfigError
from polysight_shared.geometry import incidence_deg
from polysight_shared.messages import is_simulated
from polysight_shared.raster import check_burst_fits

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
    found = f"{datetime.fromtimestamp(now_s, UTC):%Y-%m-%d %H:%M:%S} UTC"
    if now_s < Path(__file__).stat().st_mtime - _CLOCK_LOST_S:
        return error(f"{found}: earlier than this program's installation", "the clock lost its time", _SET_CLOCK)
    if context.system.clock_is_synchronised() is False:
        return warning(f"{found}, not synchronised", "no time server is reachable", _SET_CLOCK)
    return ok(found)


def check_pi_clock(context: CheckContext) -> Finding:
    """Compare the clocks of Pi and host; the uncertainty is half the duration of the request."""
    if context.hello is None or context.hello.t_unix_ns == 0:
        return not_checked("the Pi does not report its time", "install the same release on both")
    offset_s = (context.hello.t_unix_ns - context.hello_at_ns) * 1e-9
    uncertainty_s = context.hello_took_ns * 0.5e-9
    found = f"the Pi's clock minus this machine's: {offset_s:+.3f} s (+- {uncertainty_s:.3f} s)"
    facts = {"offset_s": offset_s, "uncertainty_s": uncertainty_s}
    if abs(offset_s) - uncertainty_s > _CLOCK_LOST_S:
        return error(found, "one clock is wrong: times in logs and scans cannot be compared", _SET_CLOCK, **facts)
    if abs(offset_s) - uncertainty_s > _MAX_CLOCK_OFFSET_S:
        return warning(found, "one of the two clocks is not synchronised", _SET_CLOCK, **facts)
    return ok(found, **facts)


def check_calibration(context: CheckContext) -> Finding:
    """Check the calibration files that a scan would copy into its folder."""
    simulated = context.hello is not None and is_simulated(context.hello.backend)
    facts = checked_calibration(context.rig, simulated).facts()
    if not facts:
        return ok("no calibration file is configured: geometry, filters and metal as in the rig file and the scene")
    return ok("; ".join(f"{kind} of {fact['made_utc'][:10]}" for kind, fact in facts.items()), **facts)


def check_library(context: CheckContext) -> Finding:
    """Compare the rig's incidence angle with those of the default library; without a match no material is named."""
    angle, angles = incidence_deg(context.rig, context.rig.receivers[0]), Library.load(SIMULATED_LIBRARY).angles_deg
    known = " and ".join(f"{a:g}" for a in angles)
    facts = {"incidence_deg": angle, "library_deg": list(angles)}
    found = f"incidence angle of the rig {angle:.1f} degrees, of {SIMULATED_LIBRARY.name} {known} degrees"
    if not why_unnamed(DEFAULT, context.rig):
        return ok(found, **facts)
    return warning(
        found,
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
    found = f"receivers ({scheduling}) with all cores busy: {losses}"
    facts = {"held": [vars(r) for r in results], "scheduling": scheduling}
    needed = results[: rates.index(1e6 / (context.rig.card.packet_delay_us + PACKET_TIME_US)) + 1]
    if any(r.lost for r in needed):
        remedy = "use a faster machine" if "real-time" in scheduling else PRIORITY_REMEDY
        return warning(found, "other programs take processor time from the receivers", remedy, **facts)
    return ok(found, **facts)


def check_disk(context: CheckContext) -> Finding:
    """Check free space for a scan and the reserve, and for twice the scan's data rate."""
    rig, folder = context.rig, _nearest_existing(context.options.out)
    need, reserve, free = rig.scan_bytes, rig.limits.free_disk_bytes, shutil.disk_usage(folder).free
    found = f"{folder}: {free / 1e9:.1f} GB free, a scan needs {need / 1e9:.2f} GB and {reserve / 1e9:.1f} GB reserve"
    facts: dict[str, float] = {"free_bytes": free, "need_bytes": need}
    if free < need + reserve:
        return error(found, "the disk is too full for a scan", "free space, or give another --out", **facts)
    speed, rate = context.system.write_speed(folder), need / scan_time(rig).total_s
    found += f"; durable write speed {speed / 1e6:.0f} MB/s, data rate of a scan {rate / 1e6:.2f} MB/s"
    facts |= {"write_bytes_s": speed, "scan_bytes_s": rate}
    if speed < rate:
        return error(found, "the disk is too slow: a network share or a worn card", "scan to a local disk", **facts)
    if speed < _SPEED_MARGIN * rate:
        return warning(found, "the disk is hardly fast enough", "scan to a faster disk", **facts)
    return ok(found, **facts)


def _nearest_existing(folder: Path) -> Path:
    found = folder.resolve()
    while not found.exists():
        found = found.parent
    if not found.is_dir():
        raise ConfigError(f"--out {folder}: {found} is a file", "a scan needs a folder", "give another --out")
    return found


def check_time(context: CheckContext) -> Finding:
    """Estimate the duration of a scan of the configured grid."""
    rig, seconds = context.rig, scan_time(context.rig).total_s
    hours, minutes = divmod(round(seconds / 60), 60)
    duration = f"{hours} h {minutes:02d} min" if hours else f"{seconds / 60:.1f} min"
    return ok(
        f"a scan of {rig.grid.rows} rows takes about {duration}: {seconds / rig.grid.rows:.1f} s a row,"
        f" {rig.scan_bytes / 1e9:.2f} GB",
        seconds=seconds,
        bytes=rig.scan_bytes,
    )
