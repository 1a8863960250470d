"""A forecast in words, and as plain numbers."""

from __future__ import annotations

import math
import textwrap
from typing import Any

from polysight.host.plan.forecast import Forecast

_WIDTH = 118


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
        ("", f"{s.speed_mm_s:g} mm/s, {b.pulses} chirps a position, {b.period_us:g} us apart"),
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
