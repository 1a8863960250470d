"""The stage, as the Pi sees it: it answers, in good order, with this release's sketch."""

from __future__ import annotations

from polysight.host.doctor.bench import Bench
from polysight.host.doctor.finding import Finding, error, ok, warning
from polysight.shared import __version__
from polysight.shared.faults import explain


def check_stage(bench: Bench) -> Finding:
    """No fault is latched, and the sketch is of this release."""
    status = bench.pi.status()
    if status.fault and status.state == "fault":
        e = explain(status.fault)
        return error(
            f"fault {status.fault}: {e.what}; {status.reason}",
            e.why,
            f"{e.remedy}; on the Pi, with its service stopped, `polysight-pi check` looks at port and board",
            fault=status.fault,
        )
    firmware = bench.hello.firmware if bench.hello is not None else ""
    where = f"at {status.x_mm:.1f}, {status.y_mm:.1f} mm" if status.homed else "not homed yet"
    told, facts = f"answers, sketch {firmware or 'unknown'}, {where}", {"firmware": firmware, "homed": status.homed}
    if firmware != __version__:
        return error(
            told,
            f"this release's sketch is {__version__}: the board was not flashed with it",
            "`make flash PORT=/dev/ttyACM0` with the board on this machine",
            **facts,
        )
    if status.fault:
        e = explain(status.fault)
        return warning(f"{told}; its last row ended with fault {status.fault}: {e.what}", e.why, e.remedy, **facts)
    return ok(told, **facts)
