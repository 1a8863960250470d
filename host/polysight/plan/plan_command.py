"""`polysight plan`: print a forecast, or the best plans within a time, as text or JSON.

`measure_noise` and `measure_row_overhead` take noise and standstill from a recorded scan (`--like`).
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

from polysight.capture import row_words
from polysight.plan.forecast import Forecast, Noise, forecast
from polysight.plan.search import Changes, propose, rig_lines
from polysight.plan.timing import ROW_OVERHEAD_S, row_motion_s, tail_s, turn_s
from polysight.store import EVENTS, RawSource, ScanFolder, read_events
from polysight.sync import BoardSetup, synchronise_row
from polysight_shared.config import load_instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError
from polysight_shared.messages import Capture

_WIDTH = 118
_NOISE_ROWS = 5  # rows from which the noise is measured
_SIMULATED = "the simulated rig's (not measured on hardware; set it with --like SCAN or --snr-db)"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = seconds / 60
    return f"{minutes:.1f} min" if minutes < 100 else f"{minutes / 60:.2f} h"


def _size(count: float) -> str:
    return f"{count / 1e9:.2f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"


def _pair(values: tuple[float, float], digits: int = 1) -> str:
    return " x ".join("unlimited" if math.isinf(v) else f"{v:.{digits}f}" for v in values)


def describe(f: Forecast) -> str:
    """Return the text of one forecast."""
    g, b, s, t, r = f.rig.grid, f.rig.burst, f.rig.stage, f.time, f.response
    w, h = (g.columns - 1) * g.step_x_mm, (g.rows - 1) * g.step_y_mm
    lines = [
        ("scan", f"{g.columns} x {g.rows} positions, steps {g.step_x_mm:g} x {g.step_y_mm:g} mm, {w:g} x {h:g} mm"),
        ("", f"{s.speed_mm_s:g} mm/s, {b.chirps_a_position} chirps a position, {b.chirp_us or b.period_us:g} us apart"),
        ("time", f"{_duration(t.total_s)}, without homing and retakes: {_duration(t.measuring_s)} measuring,"),
        (
            "",
            f"{_duration(t.ramps_s)} ramps, {_duration(t.turns_s)} turns, {_duration(t.tail_s)} waiting for last"
            f" packets, {_duration(t.overhead_s)} between rows, {_duration(t.approach_s)} approach",
        ),
        ("raw data", f"{_size(f.raw_bytes)} of {len(f.rig.recorded)} boards"),
        (
            "resolution",
            f"{_pair(r.width_mm)} mm at half power (x by y), with the rig file's window and taper;"
            f" limit of the geometry {_pair(r.limit_mm)} mm",
        ),
        (
            "",
            f"the paper's r lambda / L: {_pair(r.paper_mm)} mm (docs/decisions/0002-imaging.md explains the"
            " difference)",
        ),
        ("field", f"without aliases over {_pair(f.field.alias_free_mm, 0)} mm"),
        ("", f"flat plates need {_pair(f.field.mirror_zone_mm, 0)} mm of aperture beyond them on every side"),
        (
            "motion",
            f"{f.burst.travel_mm:.2f} mm during a burst, {f.burst.travel_wavelengths:.2f} wavelengths;"
            f" a burst fills {f.burst.duty:.0%} of the time to the next position",
        ),
        (
            "noise",
            f"direct path {f.noise.position_db:.1f} dB above the noise in a position's average (one channel, one"
            f" sample), standard deviation of its phase {f.noise.direct_phase_rad:.4f} rad",
        ),
        ("", f"a point as strong as the direct path is {f.noise.image_db:.1f} dB above the noise in the image"),
        ("", f"source: {f.noise_source}"),
    ]
    out = [f"{name:11s}{text}" for name, text in lines]
    for warning in f.warnings:
        kind = "REFUSED" if warning.refused else "note"
        out += textwrap.wrap(f"{kind}, {warning.topic}: {warning.text}", _WIDTH, subsequent_indent="  ")
    return "\n".join(out) + "\n"


def _table(plans: list[Forecast]) -> str:
    lines = ["    time      mm/s  chirps  period us  steps mm     grid       image dB  motion  alias-free mm   raw"]
    for i, f in enumerate(plans, 1):
        g, b = f.rig.grid, f.rig.burst
        lines.append(
            f"{i:2d}  {_duration(f.time.total_s):9s} {f.rig.stage.speed_mm_s:4g}  {b.pulses:6d}  {b.period_us:9g}"
            f"  {f'{g.step_x_mm:g} x {g.step_y_mm:g}':11s}  {f'{g.columns} x {g.rows}':9s}  {f.noise.image_db:8.1f}"
            f"  {f.burst.travel_wavelengths:4.2f} w  {_pair(f.field.alias_free_mm, 0):13s}  {_size(f.raw_bytes)}"
        )
    return "\n".join(lines) + "\n"


def forecast_values(f: Forecast) -> dict[str, Any]:
    """Return a forecast as plain values for JSON; infinite ones as None."""
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


def measure_noise(source: RawSource) -> Noise:
    """Measure the direct path over noise of a scan's weaker receiver in a few of its rows.

    Raises DataError if the scan has no rows, or bursts of a single chirp.
    """
    from polysight.report import SyncReport  # here: importing matplotlib takes a second

    rig = source.instrument
    rows = list(source.rows())
    chosen = [rows[i] for i in sorted({*np.linspace(0, len(rows) - 1, _NOISE_ROWS).astype(int)})] if rows else []
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
            f"scan {source.scan_id}: its noise cannot be measured",
            "it has no rows, or bursts of a single chirp",
            "give another scan with --like, or the ratio with --snr-db",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    kind = "simulated scan" if source.simulated else "scan"
    return Noise(float(10 * np.log10(min(found))), f"measured on {kind} {source.scan_id}")


def measure_row_overhead(folder: Path) -> float | None:
    """Measure the standstill between a scan's rows, seconds, on the clock of the triggers.

    It is the median time from a row's last trigger to the next row's first, minus the motion. None if the Pi's events
    have no two consecutive rows, or the data was simulated without a Pi.
    """
    scan = ScanFolder.load(folder)
    if scan.started.pi is None:
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
class PlanOptions:
    """Options of the command besides `Changes`: time and number of proposals, assumptions, output."""

    minutes: float | None = None
    count: int = 5
    like: Path | None = None
    snr_db: float | None = None
    row_overhead_s: float | None = None
    scene_mm: tuple[float, float] | None = None
    as_json: bool = False


def run_plan(config: Path, changes: Changes, options: PlanOptions) -> int:
    """Print the forecast, or proposals if `minutes` is given; return 1 if the plan would be refused or none fits.

    Raises PolysightError if the rig file, a value or the scan of --like is invalid.
    """
    original = load_instrument(config)
    rig = changes.apply(original)
    noise, overhead = _assumptions(options)
    if options.minutes is None:
        f = forecast(rig, noise, overhead, options.scene_mm)
        sys.stdout.write(json.dumps(forecast_values(f), indent=1) + "\n" if options.as_json else describe(f))
        return 0 if f.possible else 1
    plans = propose(rig, options.minutes, options.count, noise, overhead, options.scene_mm)
    if options.as_json:
        content = {"minutes": options.minutes, "plans": [forecast_values(p) for p in plans]}
        sys.stdout.write(json.dumps(content, indent=1) + "\n")
    elif plans:
        lines = rig_lines(plans[0].rig, original)
        sys.stdout.write(
            f"Best plans within {options.minutes:g} minutes for this aperture, least noise in the image first"
            f" (dB: point over noise; motion: wavelengths during a burst)\n\n{_table(plans)}\n"
            f"The first plan in full:\n\n{describe(plans[0])}\n"
            + (f"Its lines in the rig file, all that differ:\n\n{lines}" if lines else "It is the rig file's plan.\n")
        )
    else:
        sys.stderr.write(
            f"polysight plan: no plan within {options.minutes:g} minutes without aliases for this aperture, stage and"
            " scene: give more time, a smaller --width-mm or --height-mm, a smaller --scene-mm, or a higher"
            " --accel-mm-s2\n"
        )
    return 0 if plans else 1


def _assumptions(options: PlanOptions) -> tuple[Noise, float]:
    """Noise and standstill: as given, else of the scan of --like, else the simulated rig's."""
    noise, overhead = Noise(source=_SIMULATED), None
    if options.like is not None:
        noise, overhead = measure_noise(ScanFolder.load(options.like)), measure_row_overhead(options.like)
    if options.snr_db is not None:
        noise = Noise(options.snr_db, "given")
    if options.row_overhead_s is not None:
        overhead = options.row_overhead_s
    return noise, ROW_OVERHEAD_S if overhead is None else overhead
