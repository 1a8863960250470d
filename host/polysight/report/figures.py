"""Figures of a report and of single commands: amplitude and phase of H, V and P, with axes in millimetres.

Amplitude has a perceptually uniform, colour-blind safe map (cividis), phase a cyclic one (twilight). `maps` and
`ellipses` draw the patches. `label_figure` shows the boxes of a label file, `focus_figure` a sweep over depth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from polysight.materials import Box, axis_mm
from polysight.products import SavedProducts
from polysight.report.context import ReportContext
from polysight.report.ellipses import permittivity_figure
from polysight.report.maps import coverage_figure, draw_materials, draw_truth, map_figure, permittivity_map
from polysight.report.style import (
    INK,
    MUTED,
    STAMP,
    MapLabel,
    colour_bar,
    dress,
    extent_mm,
    figure_label,
    fit_labels,
    new_axes,
    png,
    shorten_labels,
    write_label,
)
from polysight.report.tables import masked_positions

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
_LEAST_DEG, _MAX_DEG = 20.0, 300.0
_METAL, _OTHER = "#ff9e3d", "#ffffff"  # boxes drawn by hand
_FOCUS_RANGE_DB = 30.0
Limits = tuple[float, float]


def _shown(ctx: ReportContext, values: npt.NDArray) -> npt.NDArray:
    bad = ~np.isfinite(values)
    return np.ma.masked_array(values, bad if ctx.valid is None else bad | ~ctx.valid)


def _db(values: npt.NDArray) -> npt.NDArray[np.float64]:
    return 20 * np.log10(np.maximum(np.nan_to_num(np.abs(values), nan=0.0, posinf=0.0), 1e-9))


def phase_limits_deg(ctx: ReportContext) -> Limits | None:
    """Return the range of the phase of P inside the judged patches, degrees; None if it is nearly the whole circle.

    The metal reference, 0 degrees by definition, counts only if there is no other patch. The range is taken around the
    circular mean, so that values on both sides of 180 degrees lie side by side: limits may pass 180.
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
    return (low, high) if high - low < _MAX_DEG else None


def _decibels(ctx: ReportContext) -> str:
    if not ctx.metal_referenced:
        return "dB"
    return "dB (metal = 0)" if ctx.judged else "dB (reference = 0)"


def draw_channel(ax: Axes, ctx: ReportContext, key: str, phase_deg: Limits | None = None):
    """Draw one of FIGURES on an axes; return the image for a colour bar, and the bar's label.

    Phases span -180 to 180 degrees, or `phase_deg`, which may pass 180.
    """
    kind, _, channel = key.partition("_")
    data = {"h": ctx.h, "v": ctx.v, "p": ctx.p}[channel]
    unit, colours = _decibels(ctx), "cividis"
    fade = _fade(ctx) if kind == "phase" or channel == "p" else None
    if kind == "phase":
        unit, colours = "degrees", "cividis" if phase_deg else "twilight"
        low, high = phase_deg or (-180.0, 180.0)
        middle = (low + high) / 2
        values = np.degrees(np.angle(np.where(np.isfinite(data), data, 1)))
        values = (values - middle + 180) % 360 - 180 + middle
    elif channel == "p":
        values = _db(data)
        low, high = _ratio_range_db(ctx, values)
    else:
        values = _db(data)
        finite = values[np.isfinite(data)] if ctx.valid is None else values[np.isfinite(data) & ctx.valid]
        high = 0.0 if ctx.metal_referenced else float(np.percentile(finite, 99.8)) if finite.size else 0.0
        low = high - 35
    shown = ax.imshow(
        _shown(ctx, values), extent=extent_mm(ctx), origin="lower", cmap=colours, vmin=low, vmax=high, alpha=fade,
        interpolation="nearest",
    )  # fmt: skip
    return shown, unit


def _ratio_range_db(ctx: ReportContext, level: npt.NDArray) -> tuple[float, float]:
    """Return the range of |P| to show, dB: that of the patches' medians if there are any, else of the bright pixels."""
    medians = [complex(r["ratio"]["real"], r["ratio"]["imag"]) for r in ctx.materials if r.get("ratio")]
    values = np.array([20 * np.log10(abs(m)) for m in medians if m != 0])
    if values.size == 0:
        values = level[(_fade(ctx) > 0.5) & np.isfinite(level)]
        values = np.percentile(values, [5, 95]) if values.size else np.array([0.0, 20.0])
    low, high = float(values.min()), float(values.max())
    return np.floor(min(low, 0.0) - 1), max(np.ceil(high + 1), np.floor(low) + 6)


def _fade(ctx: ReportContext) -> npt.NDArray[np.float64]:
    """Return the opacity of ratio and phase: pixels without signal are noise and fade into the background."""
    return np.clip((_strength_db(ctx) + 26) / 8, 0.0, 1.0)


def _strength_db(ctx: ReportContext) -> npt.NDArray[np.float64]:
    """Return the level of both channels together, dB, each relative to its own brightest."""
    power = np.zeros(ctx.h.shape)
    for channel in (ctx.h, ctx.v):
        p = np.nan_to_num(np.abs(channel).astype(np.float64) ** 2, nan=0.0, posinf=0.0)
        top = float(np.percentile(p, 99.5))
        power += p / top if top > 0 else 0.0
    return 10 * np.log10(np.maximum(power, 1e-12))


def channel_figure(ctx: ReportContext, key: str) -> bytes:
    """Return a PNG of one of FIGURES with a colour bar. The phase of P spans the range of the patches."""
    fig, ax = new_axes()
    limits = phase_limits_deg(ctx) if key == "phase_p" else None
    shown, unit = draw_channel(ax, ctx, key, limits)
    dress(ax, FIGURES[key], ctx.simulated)
    if key.endswith("_p"):
        _write_ratios(ax, ctx, key)
    bar = colour_bar(fig, ax, shown, unit, "both" if limits else "neither")
    if unit == "degrees" and limits is None:
        bar.set_ticks([-180, -90, 0, 90, 180])
    elif limits is not None:  # beyond 180 the circle begins again
        ticks = [t for t in bar.get_ticks() if limits[0] <= t <= limits[1]]
        bar.set_ticks(ticks, labels=[f"{(t + 180) % 360 - 180:g}" if abs(t) != 180 else "180" for t in ticks])
    return png(fig)


def _write_ratios(ax: Axes, ctx: ReportContext, key: str) -> None:
    """Write each patch's median as a number: small differences do not show as colours."""
    for row in ctx.materials:
        ratio = row.get("ratio")
        if ratio:
            x0, y0, x1, y1 = row["box_mm"]
            p = complex(ratio["real"], ratio["imag"])
            degrees, level = round(float(np.degrees(np.angle(p)))), round(20 * float(np.log10(abs(p))), 1) + 0.0
            number = f"{degrees}°" if key == "phase_p" else f"{level:.1f}"
            write_label(ax, (x0 + x1) / 2, (y0 + y1) / 2, number, 9, on_dark=True)


def draw_overview(fig: Figure, axes: Sequence[Axes], ctx: ReportContext, bar_labels: bool = False) -> None:
    """Draw amplitude H, V, P with colour bars on the first three axes, and the materials on the fourth if given."""
    for ax, key, title in zip(
        axes[:3],
        ("amplitude_h", "amplitude_v", "amplitude_p"),
        ("H, s-polarised (dB)", "V, p-polarised (dB)", "P = H / V (dB)"),
        strict=True,
    ):
        shown, unit = draw_channel(ax, ctx, key)
        dress(ax, title, ctx.simulated)
        colour_bar(fig, ax, shown, unit if bar_labels else "")
    labels = []
    for ax in axes[3:]:
        labels += draw_materials(ax, ctx, size=6.5)
        dress(ax, "Materials" if ctx.judged else "Patches", ctx.simulated)
    shorten_labels(fig, labels)


def figures(ctx: ReportContext) -> dict[str, bytes]:
    """Return all figures of a report as PNG, by file name without suffix."""
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


def label_figure(products: SavedProducts, boxes_mm: Mapping[str, Box], metal: str | None) -> bytes:
    """Return a PNG of |H| with boxes and their names; the metal reference has another colour.

    Parameters
    ----------
    products
        The processed scan.
    boxes_mm
        Name to (x0, y0, x1, y1), millimetres from the image centre.
    metal
        Name of the metal reference; None without one.
    """
    context = ReportContext.of_products(products)
    fig, ax = new_axes(5.4, 4.8)
    shown, unit = draw_channel(ax, context, "amplitude_h")
    labels = []
    for number, (name, (x0, y0, x1, y1)) in enumerate(boxes_mm.items(), 1):
        colour = _METAL if name == metal else _OTHER
        for edge, width in (("#10141b", 3.0), (colour, 1.5)):
            ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=edge, linewidth=width))
        text, below = figure_label(name, f"box {number}"), "metal" if name == metal else ""
        written = f"{text}\n{below}" if below else text
        middle = write_label(ax, (x0 + x1) / 2, (y0 + y1) / 2, written, 8.5, on_dark=True)
        labels.append(MapLabel(middle, str(number), text, colour, below))
    dress(ax, "Amplitude H, and the boxes", context.simulated)
    colour_bar(fig, ax, shown, unit)
    fit_labels(fig, labels, 4.9)
    return png(fig)


def focus_figure(
    sweep: dict[str, Any],
    before: npt.NDArray[np.complexfloating],
    after: npt.NDArray[np.complexfloating],
    x_m: npt.NDArray[np.float64],
    y_m: npt.NDArray[np.float64],
    simulated: bool,
) -> bytes:
    """Return a PNG of a sweep over depth, and of H before and after focusing.

    `sweep` has the keys `depths_mm`, `sharpness`, `depth_mm`, `tilt_deg` and `certain`.
    """
    fig = Figure(figsize=(13.0, 4.2), dpi=140, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    curve, *pictures = fig.subplots(1, 3, width_ratios=[1.1, 1, 1])
    curve.plot(sweep["depths_mm"], sweep["sharpness"], "o-", color="#44AA99", markersize=4)
    curve.axvline(0, color=MUTED, linewidth=1, linestyle=":", label="rig file")
    curve.axvline(sweep["depth_mm"], color="#882255", linewidth=1.4, label=f"found: {sweep['depth_mm']:+.2f} mm")
    curve.set_xlabel("plane, relative to the rig file (mm)", fontsize=9, color=MUTED)
    curve.set_ylabel("sharpness of the untilted plane", fontsize=9, color=MUTED)
    tilt = sweep["tilt_deg"]
    title = f"Tilt found: {tilt[0]:+.2f}° in x, {tilt[1]:+.2f}° in y" if sweep["certain"] else "No clear maximum"
    curve.set_title(title, loc="left", fontsize=10, color=INK)
    curve.legend(fontsize=8, frameon=False)
    top = max(float(np.abs(before).max()), float(np.abs(after).max()), 1e-30)
    x, y = axis_mm(x_m), axis_mm(y_m)
    for ax, image, title in zip(
        pictures, (before, after), ("H on the rig file's plane", "H on the found plane"), strict=True
    ):
        level = 20 * np.log10(np.maximum(np.abs(image) / top, 1e-6))
        shown = ax.pcolormesh(
            x, y, level, cmap="cividis", vmin=-_FOCUS_RANGE_DB, vmax=0, shading="nearest", rasterized=True
        )
        ax.set_title(title, loc="left", fontsize=10, color=INK)
        ax.set_aspect("equal")
        ax.set_xlabel("x (mm)", fontsize=9, color=MUTED)
        colour_bar(fig, ax, shown, "dB")
    if simulated:
        fig.suptitle("SIMULATED", fontsize=9, color=STAMP, fontweight="bold", x=0.99, ha="right")
    return png(fig)
