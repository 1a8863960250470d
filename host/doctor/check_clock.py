"""Wall clocks: this machine's, and the Pi's beside it. They name scans and date logs; nothing is timed by them."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from polysight.host.doctor.bench import Bench
from polysight.host.doctor.finding import Finding, error, not_checked, ok, warning

APART_S = 1.0
LOST_S = 60.0
_NTP = "`timedatectl set-ntp true`, or set it by hand; a Pi has no battery behind its clock"


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
