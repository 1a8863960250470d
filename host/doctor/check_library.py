"""Whether the library that names materials by default was seen under this rig's angle of incidence."""

from __future__ import annotations

from polysight.host.doctor.bench import Bench
from polysight.host.doctor.finding import Finding, ok, warning
from polysight.host.materials import Library
from polysight.host.process.request import LIBRARY, Options
from polysight.shared.geometry import incidence_deg


def check_library(bench: Bench) -> Finding:
    """A scan can be made without it, but nothing of it would be named."""
    angle, known = incidence_deg(bench.rig, bench.rig.receivers[0]), Library.load(LIBRARY).angles_deg
    held = " and ".join(f"{a:g}" for a in known)
    facts = {"incidence_deg": angle, "library_deg": list(known)}
    if not Options().unnamed(bench.rig):
        return ok(f"{LIBRARY.name} holds {held} degrees of incidence, the rig looks at {angle:.1f}", **facts)
    return warning(
        f"the rig looks at {angle:.1f} degrees of incidence, {LIBRARY.name} holds {held} degrees only",
        "|P| changes by a tenth in a degree, so that nothing of its scans will be named",
        "train a library at this angle (docs/how-to/add-a-material.md) and scan with --library; or --model none",
        **facts,
    )
