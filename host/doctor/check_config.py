"""The rig file: readable, and its numbers go together."""

from __future__ import annotations

from polysight.host.doctor.bench import Bench
from polysight.host.doctor.finding import Finding, ok
from polysight.host.radar.constraints import require
from polysight.shared.config import load_instrument
from polysight.shared.raster import check_burst_fits


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
