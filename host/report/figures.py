"""All figures of a report, and its images: amplitude and phase of H, V and P, with axes in millimetres.

Amplitude in a perceptually uniform, colour-blind safe map (cividis), phase in a cyclic one (twilight). `maps` and
`ellipses` draw the patches.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from polysight.host.report.context import ReportContext
from polysight.host.report.ellipses import permittivity_figure
from polysight.host.report.maps import draw_materials, draw_truth, map_figure, permittivity_map
from polysight.host.report.style import axis_mm, dress, extent_mm, new_axes, png, shorten_labels, write_label
from polysight.host.report.tables import MUTED, coverage_figure, masked_positions

FIGURES: dict[str, str] = {
    "amplitude_h": "Amplitude H (s-polarised)",
    "amplitude_v": "Amplitude V (p-polarised)",
    "amplitude_p": "Amplitude of P = H / V",
    "phase_h": "Phase H",
    "phase_v": "Phase V",
    "phase_p": "Phase of P = H / V",
}
_INSIDE = 0.6  # of a patch's box: what lies further out is its edge
_PERCENTILES = (5.0, 95.0)
_LEAST_DEG, _MOST_DEG = 20.0, 300.0
Limits = tuple[float, float]


def _shown(ctx: ReportContext, values: npt.NDArray) -> npt.NDArray:
    bad = ~np.isfinite(values)
    return np.ma.masked_array(values, bad if ctx.valid is None else bad | ~ctx.valid)


def _db(values: npt.NDArray) -> npt.NDArray[np.float64]:
    return 20 * np.log10(np.maximum(np.nan_to_num(np.abs(values), nan=0.0, posinf=0.0), 1e-9))


def phase_limits_deg(ctx: ReportContext) -> Limits | None:
    """Range of the phase of P inside the judged patches, degrees; None where the whole circle is needed.

    The metal reference, which has 0 degrees by definition, counts only where there is no other patch.
    Around the circular mean, so that values on both sides of 180 degrees lie side by side: limits may pass it.
    """
    x, y = axis_mm(ctx.x_m), axis_mm(ctx.y_m)
    inside: list[npt.NDArray] = []
    others = [r for r in ctx.materials if not r.get("refused") and not r.get("metal_reference")]
    for row in others or ctx.materials:
        x0, y0, x1, y1 = row["box_mm"]
        near_x = np.abs(x - (x0 + x1) / 2) <= _INSIDE * (x1 - x0) / 2
        near_y = np.abs(y - (y0 + y1) / 2) <= _INSIDE * (y1 - y0) / 2
        part = ctx.p[np.ix_(near_y, near_x)]
        part = part[np.isfinite(part) & (part != 0)]
        if part.size:
            inside.append(part / np.abs(part))
    if not inside:
        return None
    middle = np.angle(sum(part.mean() for part in inside))
    turned = np.degrees(np.angle(np.concatenate(inside) * np.exp(-1j * middle)))
    low, high = np.percentile(turned, _PERCENTILES) + np.degrees(middle)
    margin = max(0.15 * (high - low), (_LEAST_DEG - (high - low)) / 2)
    low, high = float(np.floor((low - margin) / 5) * 5), float(np.ceil((high + margin) / 5) * 5)
    return (low, high) if high - low < _MOST_DEG else None


def _decibels(ctx: ReportContext) -> str:
    if not ctx.metal_referenced:
        return "dB"
    return "dB (metal = 0)" if ctx.judged else "dB (reference = 0)"


def draw_channel(ax: Axes, ctx: ReportContext, key: str, phase_deg: Limits | None = None):
    """Draw one of FIGURES on an axes; returns the image for a colour bar, and the bar's label.

    Phases are drawn from -180 to 180 degrees, or from and to `phase_deg`, which may pass 180.
    """
    kind, _, channel = key.partition("_")
    data = {"h": ctx.h, "v": ctx.v, "p": ctx.p}[channel]
    extent = extent_mm(ctx)
    if kind == "phase":
        angle = np.degrees(np.angle(np.where(np.isfinite(data), data, 1)))
        low, high = phase_deg or (-180.0, 180.0)
        middle = (low + high) / 2
        angle = (angle - middle + 180) % 360 - 180 + middle
        shown = ax.imshow(
            _shown(ctx, angle), extent=extent, origin="lower", cmap="cividis" if phase_deg else "twilight", vmin=low,
            vmax=high, alpha=_fade(ctx), interpolation="nearest",
        )  # fmt: skip
        return shown, "degrees"
    level = _db(data)
    finite = level[np.isfinite(data)] if ctx.valid is None else level[np.isfinite(data) & ctx.valid]
    if channel == "p":
        bottom, top = _ratio_range_db(ctx, level)
        shown = ax.imshow(
            _shown(ctx, level), extent=extent, origin="lower", cmap="cividis", vmin=bottom, vmax=top,
            alpha=_fade(ctx), interpolation="nearest",
        )  # fmt: skip
        return shown, _decibels(ctx)
    top = 0.0 if ctx.metal_referenced else float(np.percentile(finite, 99.8)) if finite.size else 0.0
    shown = ax.imshow(
        _shown(ctx, level), extent=extent, origin="lower", cmap="cividis", vmin=top - 35, vmax=top,
        interpolation="nearest",
    )  # fmt: skip
    return shown, _decibels(ctx)


def _ratio_range_db(ctx: ReportContext, level: npt.NDArray) -> tuple[float, float]:
    """Range of |P| in dB to show: that of the patches' medians where there are some, else of the bright pixels."""
    medians = [complex(r["ratio"]["real"], r["ratio"]["imag"]) for r in ctx.materials if r.get("ratio")]
    values = np.array([20 * np.log10(abs(m)) for m in medians if m != 0])
    if values.size == 0:
        values = level[(_fade(ctx) > 0.5) & np.isfinite(level)]
        values = np.percentile(values, [5, 95]) if values.size else np.array([0.0, 20.0])
    low, high = float(values.min()), float(values.max())
    return np.floor(min(low, 0.0) - 1), max(np.ceil(high + 1), np.floor(low) + 6)


def _fade(ctx: ReportContext) -> npt.NDArray[np.float64]:
    """Opacity of ratio and phase: where nothing reflects they are noise, and fade into the background."""
    return np.clip((_strength_db(ctx) + 26) / 8, 0.0, 1.0)


def _strength_db(ctx: ReportContext) -> npt.NDArray[np.float64]:
    """Level of both channels together, each relative to its own brightest, for fading what holds no signal."""
    power = np.zeros(ctx.h.shape)
    for channel in (ctx.h, ctx.v):
        p = np.nan_to_num(np.abs(channel).astype(np.float64) ** 2, nan=0.0, posinf=0.0)
        top = float(np.percentile(p, 99.5))
        power += p / top if top > 0 else 0.0
    return 10 * np.log10(np.maximum(power, 1e-12))


def channel_figure(ctx: ReportContext, key: str) -> bytes:
    """PNG of one of FIGURES, with axes in mm and a colour bar. The phase of P has the range that the patches have."""
    fig, ax = new_axes()
    limits = phase_limits_deg(ctx) if key == "phase_p" else None
    shown, unit = draw_channel(ax, ctx, key, limits)
    dress(ax, FIGURES[key], ctx.simulated)
    if key.endswith("_p"):
        _write_ratios(ax, ctx, key)
    bar = fig.colorbar(shown, ax=ax, fraction=0.046, pad=0.03, extend="both" if limits else "neither")
    bar.set_label(unit, fontsize=8, color=MUTED)
    bar.ax.tick_params(labelsize=8, colors=MUTED, length=2)
    if bar.solids is not None:
        bar.solids.set_alpha(1)
    if unit == "degrees" and limits is None:
        bar.set_ticks([-180, -90, 0, 90, 180])
    elif limits is not None:  # beyond 180 the circle begins again
        ticks = [t for t in bar.get_ticks() if limits[0] <= t <= limits[1]]
        bar.set_ticks(ticks, labels=[f"{(t + 180) % 360 - 180:g}" if abs(t) != 180 else "180" for t in ticks])
    return png(fig)


def _write_ratios(ax: Axes, ctx: ReportContext, key: str) -> None:
    """The median of each patch in figures: small differences do not show as colours."""
    for row in ctx.materials:
        ratio = row.get("ratio")
        if ratio:
            x0, y0, x1, y1 = row["box_mm"]
            p = complex(ratio["real"], ratio["imag"])
            number = f"{np.degrees(np.angle(p)) + 0.0:.0f}°" if key == "phase_p" else f"{20 * np.log10(abs(p)):.1f}"
            write_label(ax, (x0 + x1) / 2, (y0 + y1) / 2, number.replace("-0°", "0°"), 9, on_dark=True)


def draw_overview(fig: Figure, axes: Sequence[Axes], ctx: ReportContext, bar_labels: bool = False) -> None:
    """Draw amplitude H, V, P with colour bars on the first three axes, and the materials on a fourth one."""
    for ax, key, title in zip(
        axes[:3],
        ("amplitude_h", "amplitude_v", "amplitude_p"),
        ("H, s-polarised (dB)", "V, p-polarised (dB)", "P = H / V (dB)"),
        strict=True,
    ):
        shown, unit = draw_channel(ax, ctx, key)
        dress(ax, title, ctx.simulated)
        bar = fig.colorbar(shown, ax=ax, fraction=0.046, pad=0.03)
        if bar_labels:
            bar.set_label(unit, fontsize=8, color=MUTED)
        bar.ax.tick_params(labelsize=8, colors=MUTED, length=2)
        if bar.solids is not None:
            bar.solids.set_alpha(1)
    labels = []
    for ax in axes[3:]:
        labels += draw_materials(ax, ctx, size=6.5)
        dress(ax, "Materials" if ctx.judged else "Patches", ctx.simulated)
    shorten_labels(fig, labels)


def banner_png(path: Path, ctx: ReportContext) -> None:
    """One wide picture: amplitude H, V, P and the material map side by side, written to `path`."""
    fig = Figure(figsize=(15.0, 3.7), dpi=120, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    axes = list(fig.subplots(1, 4))
    draw_overview(fig, axes, ctx)
    for ax in axes[1:]:
        ax.set_ylabel("")
    path.write_bytes(png(fig))


def figures(ctx: ReportContext) -> dict[str, bytes]:
    """All figures of a report by file name (without suffix)."""
    out = {key: channel_figure(ctx, key) for key in FIGURES}
    if ctx.materials:
        out["materials"] = map_figure(ctx, draw_materials, "Materials found" if ctx.judged else "Patches found")
        made = {"permittivity": permittivity_figure(ctx), "permittivity_map": permittivity_map(ctx)}
        out |= {name: picture for name, picture in made.items() if picture is not None}
    masks = masked_positions(ctx)
    if any(m.any() for m in masks.values()):
        out["coverage"] = png(coverage_figure(ctx, masks))
    if ctx.truth:
        out["truth"] = map_figure(ctx, draw_truth, "Truth")
    return out
