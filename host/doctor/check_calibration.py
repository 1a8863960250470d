"""The calibration files that the rig file names: there, whole, of these mounts, and not simulated on a real rig."""

from __future__ import annotations

from polysight.host.calibration.active import checked
from polysight.host.doctor.bench import Bench
from polysight.host.doctor.finding import Finding, ok
from polysight.shared.backends import is_simulated


def check_calibration(bench: Bench) -> Finding:
    """What a scan would copy into its folder."""
    simulated = bench.hello is not None and is_simulated(bench.hello.backend)
    facts = checked(bench.rig, simulated).facts()
    if not facts:
        return ok("none named: geometry, filters and metal as the rig file and the scene have them")
    return ok("; ".join(f"{kind} of {fact['made_utc'][:10]}" for kind, fact in facts.items()), **facts)
