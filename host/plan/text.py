"""`polysight plan`: a forecast in words and as plain numbers, with what an earlier scan tells of noise and overhead.

`plan` prints the forecast or the proposals. `noise_of` and `row_overhead_of` measure what a recorded scan had.
"""

from __future__ import annotations

import json
import math
import sys
import textwrap
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from polysight.host.capture import row_words
from polysight.host.plan.forecast import Forecast, Noise, forecast
from polysight.host.plan.search import Changes, propose, rig_lines
from polysight.host.plan.timing import ROW_OVERHEAD_S, row_motion_s, tail_s, turn_s
from polysight.host.store import EVENTS, RawSource, ScanFolder, read_events
from polysight.host.sync import BoardSetup, synchronise_row
from polysight.shared.config import Instrument, load_instrument
from polysight.shared.errors import DataError
from polysight.shared.messages import Capture

_WIDTH = 118
_ROWS = 5  # that the noise is taken from
_SIMULATED = "the simulated rig's (no hardware has been measured; --like SCAN or --snr-db give another)"


def duration(seconds: float) -> str:
    """Hours and minutes, or minutes, or seconds, as a person says it."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.1f} min" if minutes < 100 else f"{minutes / 60:.2f} h"


def size(count: float) -> str:
    """Bytes in decimal units."""
    return f"{count / 1e9:.2f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"


def _pair(values: tuple[float, float], digits: int = 1) -> str:
    return " x ".join("unlimited" if math.isinf(v) else f"{v:.{digits}f}" for v in values)


def describe(f: Forecast) -> str:
    """One plan in full."""
    g, b, s, t, r = f.rig.grid, f.rig.burst, f.rig.stage, f.time, f.response
    w, h = (g.columns - 1) * g.step_x_mm, (g.rows - 1) * g.step_y_mm
    lines = [
        ("scan", f"{g.columns} x {g.rows} positions, steps {g.step_x_mm:g} x {g.step_y_mm:g} mm, {w:g} x {h:g} mm"),
        ("", f"{s.speed_mm_s:g} mm/s, {b.chirps_a_position} chirps a position, {b.chirp_us or b.period_us:g} us apart"),
        ("time", f"{duration(t.total_s)}, without homing and rows taken again: {duration(t.measuring_s)} measuring,"),
        (
            "",
            f"{duration(t.ramps_s)} ramps, {duration(t.turns_s)} turns, {duration(t.tail_s)} waiting for last packets,"
            f" {duration(t.overhead_s)} between rows, {duration(t.approach_s)} approach",
        ),
        ("raw data", f"{size(f.raw_bytes)} of {len(f.rig.recorded)} boards"),
        (
            "resolution",
            f"{_pair(r.width_mm)} mm at half power (x by y), window and taper as in the rig file;"
            f" the geometry's limit {_pair(r.limit_mm)} mm",
        ),
        ("", f"the paper's r lambda / L: {_pair(r.paper_mm)} mm (docs/decisions/0002-imaging.md says why it differs)"),
        ("field", f"free of aliases over {_pair(f.field.alias_free_mm, 0)} mm"),
        ("", f"flat plates want {_pair(f.field.mirror_zone_mm, 0)} mm of aperture beyond them on every side"),
        (
            "motion",
            f"{f.burst.travel_mm:.2f} mm within a burst, {f.burst.travel_wavelengths:.2f} wavelengths;"
            f" a burst fills {f.burst.duty:.0%} of the time to the next position",
        ),
        (
            "noise",
            f"direct path {f.noise.position_db:.1f} dB over it in a position's average (a channel, a sample), its phase"
            f" known to {f.noise.direct_phase_rad:.4f} rad",
        ),
        ("", f"a point as strong as the direct path stands {f.noise.image_db:.1f} dB over it in the image"),
        ("", f"from: {f.noise_source}"),
    ]
    out = [f"{name:11s}{text}" for name, text in lines]
    for caution in f.warnings:
        kind = "REFUSED" if caution.refused else "note"
        out += textwrap.wrap(f"{kind}, {caution.topic}: {caution.text}", _WIDTH, subsequent_indent="  ")
    return "\n".join(out) + "\n"


def table(plans: list[Forecast]) -> str:
    """Several plans, a line each."""
    head = "    time      mm/s  chirps  period us  steps mm     grid       image dB  motion  alias-free mm   raw"
    lines = [head]
    for i, f in enumerate(plans, 1):
        g, b = f.rig.grid, f.rig.burst
        lines.append(
            f"{i:2d}  {duration(f.time.total_s):9s} {f.rig.stage.speed_mm_s:4g}  {b.pulses:6d}  {b.period_us:9g}"
            f"  {f'{g.step_x_mm:g} x {g.step_y_mm:g}':11s}  {f'{g.columns} x {g.rows}':9s}  {f.noise.image_db:8.1f}"
            f"  {f.burst.travel_wavelengths:4.2f} w  {_pair(f.field.alias_free_mm, 0):13s}  {size(f.raw_bytes)}"
        )
    return "\n".join(lines) + "\n"


def numbers(f: Forecast) -> dict[str, Any]:
    """One plan as plain numbers, for JSON; what is infinite is None."""
    g, b, s, t, r = f.rig.grid, f.rig.burst, f.rig.stage, f.time, f.response

    def finite(values: tuple[float, float]) -> list[float | None]:
        return [float(v) if math.isfinite(v) else None for v in values]

    return {
        "possible": f.possible,
        "speed_mm_s": s.speed_mm_s,
        "accel_mm_s2": s.accel_mm_s2,
        "pulses": b.pulses,
        "chirps": b.chirps,
        "period_us": b.period_us,
        "columns": g.columns,
        "rows": g.rows,
        "step_x_mm": g.step_x_mm,
        "step_y_mm": g.step_y_mm,
        "time_s": {
            "total": t.total_s,
            "approach": t.approach_s,
            "measuring": t.measuring_s,
            "ramps": t.ramps_s,
            "turns": t.turns_s,
            "last_packets": t.tail_s,
            "standstill": t.overhead_s,
        },
        "raw_bytes": f.raw_bytes,
        "point_width_mm": finite(r.width_mm),
        "point_limit_mm": finite(r.limit_mm),
        "point_paper_mm": finite(r.paper_mm),
        "alias_free_mm": finite(f.field.alias_free_mm),
        "mirror_zone_mm": finite(f.field.mirror_zone_mm),
        "burst_ms": f.burst.duration_ms,
        "between_positions_ms": f.burst.between_ms,
        "burst_travel_mm": f.burst.travel_mm,
        "burst_travel_wavelengths": f.burst.travel_wavelengths,
        "burst_edge_loss_db": f.burst.edge_loss_db,
        "position_snr_db": f.noise.position_db,
        "direct_phase_rad": f.noise.direct_phase_rad,
        "image_snr_db": f.noise.image_db,
        "noise_source": f.noise_source,
        "warnings": [w._asdict() for w in f.warnings],
    }


def noise_of(source: RawSource) -> Noise:
    """Direct path over noise of a scan's weaker receiver, from a few of its rows.

    Raises
    ------
    DataError
        when no row tells: bursts of one chirp, or nothing recorded.
    """
    from polysight.host.report import SyncReport  # here: matplotlib loads for a second

    rig = source.instrument
    rows = list(source.rows())
    chosen = [rows[i] for i in sorted({*np.linspace(0, len(rows) - 1, _ROWS).astype(int)})] if rows else []
    found = []
    for board in rig.receivers:
        setup = BoardSetup.of(rig, board)
        report = SyncReport(rig.chirp.sample_rate_hz, rig.chirp.linear_samples, len(rig.antennas.rx_mm))
        for row in chosen:
            data = source.read_row(board.name, row)
            words, valid = row_words(data.payload, data.missing, data.frames_expected, rig.chirp.samples)
            report.add(synchronise_row(words, valid, setup))
        found.append(report.snr)
    if not np.isfinite(found).all():
        raise DataError(
            f"scan {source.scan_id}: its noise cannot be told",
            "it has no rows, or bursts of a single chirp",
            "give another scan to --like, or the ratio itself to --snr-db",
        )
    kind = "simulated scan" if source.simulated else "scan"
    return Noise(float(10 * np.log10(min(found))), f"measured on {kind} {source.scan_id}")


def row_overhead_of(folder: Path) -> float | None:
    """Standstill between rows, seconds: median time from a row's last trigger to the next one's first, less motion.

    On the clock of the triggers. None where the Pi's events do not tell: fewer than two rows in a sequence, or data
    that was made without a Pi.
    """
    scan = ScanFolder.load(folder)
    if not scan.facts("scan_started")[0].get("pi"):
        return None
    rig, ends = scan.instrument, {}
    for event in read_events(folder / EVENTS).events:
        if isinstance(event, Capture):
            first, _ = ends.setdefault((event.row_index, event.take), (event.edge_ns, event.edge_ns))
            ends[event.row_index, event.take] = (first, event.edge_ns)
    measuring = (rig.grid.columns - 1) * rig.grid.step_x_mm / rig.stage.speed_mm_s
    known = row_motion_s(rig.grid, rig.stage) - measuring + turn_s(rig.grid, rig.stage) + tail_s(rig)
    gaps = [
        (later[0] - earlier[1]) / 1e9
        for (row, earlier), (next_row, later) in pairwise((row, t) for (row, _), t in ends.items())
        if next_row == row + 1
    ]
    return max(0.0, float(np.median(gaps)) - known) if gaps else None


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
