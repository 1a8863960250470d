"""`polysight plan`: one plan in full, or the best within a time."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

from polysight.host.plan.changes import Changes, rig_lines
from polysight.host.plan.forecast import Noise, forecast
from polysight.host.plan.measured import noise_of, row_overhead_of
from polysight.host.plan.search import propose
from polysight.host.plan.text import describe, numbers, table
from polysight.host.plan.timing import ROW_OVERHEAD_S
from polysight.host.store.scan_folder import ScanFolder
from polysight.shared.config import Instrument, load_instrument

_SIMULATED = "the simulated rig's (no hardware has been measured; --like SCAN or --snr-db give another)"


@dataclass(frozen=True)
class Wanted:
    """What the user wants to know besides the plan's own numbers."""

    minutes: float | None = None
    count: int = 5
    like: Path | None = None
    snr_db: float | None = None
    row_overhead_s: float | None = None
    scene_mm: tuple[float, float] | None = None
    as_json: bool = False


def plan(config: Path, changes: Changes, wanted: Wanted) -> int:
    """Print the forecast, or the proposals; the exit status is 1 when the plan would be refused, or none fits.

    Raises
    ------
    PolysightError
        when the rig file, a number or the scan named by --like is wrong.
    """
    begun_with = load_instrument(config)
    rig = changes.apply(begun_with)
    noise, overhead = _assumed(wanted)
    if wanted.minutes is not None:
        plans = propose(rig, wanted.minutes, wanted.count, noise, overhead, wanted.scene_mm)
        if wanted.as_json:
            content = {"minutes": wanted.minutes, "plans": [numbers(p) for p in plans]}
            sys.stdout.write(json.dumps(content, indent=1) + "\n")
        elif plans:
            sys.stdout.write(
                f"Best plans within {wanted.minutes:g} minutes for this aperture, least noise in the image first"
                f" (dB: point over noise; motion: wavelengths within a burst)\n\n{table(plans)}\n"
                f"The first one in full:\n\n{describe(plans[0])}\n"
                f"{_lines(plans[0].rig, begun_with)}"
            )
        else:
            sys.stderr.write(
                f"polysight plan: no plan keeps {wanted.minutes:g} minutes with this aperture, stage and scene without"
                " aliases: give more time, a smaller --width-mm or --height-mm, a smaller --scene-mm, or a higher"
                " --accel-mm-s2\n"
            )
        return 0 if plans else 1
    told = forecast(rig, noise, overhead, wanted.scene_mm)
    sys.stdout.write(json.dumps(numbers(told), indent=1) + "\n" if wanted.as_json else describe(told))
    return 0 if told.possible else 1


def _lines(plan: Instrument, begun_with: Instrument) -> str:
    lines = rig_lines(plan, begun_with)
    return f"Its lines in the rig file, all that differ:\n\n{lines}" if lines else "The rig file says so already.\n"


def _assumed(wanted: Wanted) -> tuple[Noise, float]:
    """Noise and standstill: given, else of the scan named by --like, else the simulated rig's."""
    noise, overhead = Noise(source=_SIMULATED), None
    if wanted.like is not None:
        noise, overhead = noise_of(ScanFolder.load(wanted.like)), row_overhead_of(wanted.like)
    if wanted.snr_db is not None:
        noise = Noise(wanted.snr_db, "given")
    if wanted.row_overhead_s is not None:
        overhead = wanted.row_overhead_s
    return noise, ROW_OVERHEAD_S if overhead is None else overhead
