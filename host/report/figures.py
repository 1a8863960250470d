"""Figures of a report as PNG: channel images, material maps, permittivities, the overview, and a focus sweep.

Amplitude in a perceptually uniform, colour-blind safe map (cividis), phase in a cyclic one (twilight), materials in the
colour-blind safe palette of Paul Tol ("muted", then "light"). Axes are millimetres from the image centre. Matplotlib's
object interface only: no global state, no display.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.patheffects import withStroke

from polysight.host.report.context import ReportContext
from polysight.host.report.fonts import figure_label, font_families
from polysight.host.report.tables import INK, MUTED, STAMP, coverage_figure, masked_positions

PALETTE = (
    "#332288", "#88CCEE", "#44AA99", "#117733", "#999933", "#DDCC77", "#CC6677", "#882255", "#AA4499",
    "#77AADD", "#EE8866", "#EEDD88", "#FFAABB", "#99DDFF", "#44BB99", "#BBCC33", "#AAAA00",
)  # fmt: skip
UNKNOWN_COLOUR = "#BBBBBB"
FIGURES: dict[str, str] = {
    "amplitude_h": "Amplitude H (s-polarised)",
    "amplitude_v": "Amplitude V (p-polarised)",
    "amplitude_p": "Amplitude of P = H / V",
    "phase_h": "Phase H",
    "phase_v": "Phase V",
    "phase_p": "Phase of P = H / V",
}
_RANGE_DB = 30.0  # of the images of a focus sweep


def colours_of(ctx: ReportContext) -> dict[str, str]:
    """Colour of each material that occurs in the results or the truth; the same name has one colour in all figures."""
    names = {str(r["name"]) for r in ctx.materials if r.get("name")}
    names |= {str(t["name"]) for t in ctx.truth or []}
    for pixels, _ in ctx.pixel_names.values():
        names |= set(np.unique(pixels).tolist())
    names.discard("unknown")
    table = {name: PALETTE[i % len(PALETTE)] for i, name in enumerate(sorted(names))}
    return {**table, "unknown": UNKNOWN_COLOUR}


def axis_mm(axis_m: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Millimetres from the middle of an image axis."""
    return (axis_m - (axis_m[0] + axis_m[-1]) / 2) * 1e3


def extent_mm(ctx: ReportContext) -> tuple[float, float, float, float]:
    """Left, right, bottom, top edge of the image in millimetres from its centre."""
    x, y = axis_mm(ctx.x_m), axis_mm(ctx.y_m)
    hx, hy = (x[1] - x[0]) / 2, (y[1] - y[0]) / 2
    return float(x[0] - hx), float(x[-1] + hx), float(y[0] - hy), float(y[-1] + hy)


def _new(width: float = 5.0, height: float = 4.6) -> tuple[Figure, Axes]:
    fig = Figure(figsize=(width, height), dpi=160, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    ax = fig.add_subplot()
    return fig, ax


def _dress(ax: Axes, title: str, simulated: bool) -> None:
    ax.set_title(title, loc="left", fontsize=11, color=INK, fontweight="bold")
    if simulated:
        ax.text(
            1.0, 1.015, "SIMULATED", transform=ax.transAxes, ha="right", va="bottom",
            fontsize=8, color=STAMP, fontweight="bold",
        )  # fmt: skip
    ax.set_xlabel("x (mm)", fontsize=9, color=MUTED)
    ax.set_ylabel("y (mm)", fontsize=9, color=MUTED)
    ax.tick_params(labelsize=8, colors=MUTED, length=3)
    ax.set_aspect("equal")
    ax.set_facecolor("#d9dde3")
    for spine in ax.spines.values():
        spine.set_color("#c3c9d1")


def _shown(ctx: ReportContext, values: npt.NDArray) -> npt.NDArray:
    bad = ~np.isfinite(values)
    return np.ma.masked_array(values, bad if ctx.valid is None else bad | ~ctx.valid)


def _db(values: npt.NDArray) -> npt.NDArray[np.float64]:
    return 20 * np.log10(np.maximum(np.nan_to_num(np.abs(values), nan=0.0, posinf=0.0), 1e-9))


def draw_channel(ax: Axes, ctx: ReportContext, key: str):
    """Draw one of FIGURES on an axes; returns the image for a colour bar, and the bar's label."""
    kind, _, channel = key.partition("_")
    data = {"h": ctx.h, "v": ctx.v, "p": ctx.p}[channel]
    extent = extent_mm(ctx)
    if kind == "phase":
        angle = np.degrees(np.angle(np.where(np.isfinite(data), data, 1)))
        shown = ax.imshow(
            _shown(ctx, angle), extent=extent, origin="lower", cmap="twilight", vmin=-180, vmax=180, alpha=_fade(ctx),
            interpolation="nearest",
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
        return shown, "dB (metal = 0)" if ctx.metal_referenced else "dB"
    top = 0.0 if ctx.metal_referenced else float(np.percentile(finite, 99.8)) if finite.size else 0.0
    shown = ax.imshow(
        _shown(ctx, level), extent=extent, origin="lower", cmap="cividis", vmin=top - 35, vmax=top,
        interpolation="nearest",
    )  # fmt: skip
    return shown, "dB (metal = 0)" if ctx.metal_referenced else "dB"


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
    """PNG of one of FIGURES, with axes in mm and a colour bar."""
    fig, ax = _new()
    shown, unit = draw_channel(ax, ctx, key)
    _dress(ax, FIGURES[key], ctx.simulated)
    if key.endswith("_p"):
        _write_ratios(ax, ctx, key)
    bar = fig.colorbar(shown, ax=ax, fraction=0.046, pad=0.03)
    bar.set_label(unit, fontsize=8, color=MUTED)
    bar.ax.tick_params(labelsize=8, colors=MUTED, length=2)
    if bar.solids is not None:
        bar.solids.set_alpha(1)
    if unit == "degrees":
        bar.set_ticks([-180, -90, 0, 90, 180])
    return png(fig)


def _write_ratios(ax: Axes, ctx: ReportContext, key: str) -> None:
    """The median of each patch in figures: small differences do not show as colours."""
    for row in ctx.materials:
        ratio = row.get("ratio")
        if ratio:
            x0, y0, x1, y1 = row["box_mm"]
            p = complex(ratio["real"], ratio["imag"])
            number = f"{np.degrees(np.angle(p)) + 0.0:.0f}°" if key == "phase_p" else f"{20 * np.log10(abs(p)):.1f}"
            _label(ax, (x0 + x1) / 2, (y0 + y1) / 2, number.replace("-0°", "0°"), 9, on_dark=True)


def _label(
    ax: Axes, x: float, y: float, text: str, size: float = 8.0, above: bool = False, on_dark: bool = False
) -> None:
    ink, halo = ("white", "#10141b") if on_dark else (INK, "white")
    ax.text(
        x, y, text, ha="center", va="bottom" if above else "center", fontsize=size, color=ink, linespacing=1.1,
        path_effects=[withStroke(linewidth=2.4, foreground=halo)], family=list(font_families()), parse_math=False,
    )  # fmt: skip


def patch_label(row: dict[str, Any]) -> str:
    """What figures write beside a patch."""
    number = f"patch {row['label']}"
    return figure_label(str(row.get("name") or number), number)


def plate_label(plate: dict[str, Any], number: int) -> str:
    """What the truth's figure writes beside a plate; `number` counts plates from 1."""
    return figure_label(str(plate["name"]), f"plate {number}")


def draw_materials(ax: Axes, ctx: ReportContext, size: float = 7.5) -> None:
    """Material map: the majority's colour over each patch, each interior pixel in the colour of its own name."""
    colours = colours_of(ctx)
    rgb = np.ones((*ctx.h.shape, 3)) * np.array(to_rgb("#f3f5f8"))
    if ctx.segments is not None:
        for row in ctx.materials:
            name = str(row.get("name") or "unknown")
            tint = np.array(to_rgb(colours.get(name, UNKNOWN_COLOUR)))
            rgb[ctx.segments == row["label"]] = 0.55 + 0.45 * tint
    for names, interior in ctx.pixel_names.values():
        rgb[interior] = [to_rgb(colours.get(str(n), UNKNOWN_COLOUR)) for n in names]
    ax.imshow(rgb, extent=extent_mm(ctx), origin="lower", interpolation="nearest")
    for row in ctx.materials:
        x0, _, x1, y1 = row["box_mm"]
        if row.get("outline_mm"):
            ax.add_patch(Polygon(row["outline_mm"], closed=True, fill=False, edgecolor=INK, linewidth=0.9))
        text = patch_label(row)
        if row.get("confidence") is not None:
            text += f"\n{100 * row['confidence']:.0f} %"
        _label(ax, (x0 + x1) / 2, y1 + 0.5, text, size, above=True)
    _crop(ax, ctx)


def _crop(ax: Axes, ctx: ReportContext) -> None:
    """Limits around what lies on the plane, the same for the map and the truth, square, inside the image."""
    boxes = [r["box_mm"] for r in ctx.materials] + [t["box_mm"] for t in ctx.truth or []]
    left, right, bottom, top = extent_mm(ctx)
    if boxes:
        b = np.array(boxes)
        x0, y0, x1, y1 = b[:, 0].min() - 20, b[:, 1].min() - 12, b[:, 2].max() + 20, b[:, 3].max() + 24
        half = max(x1 - x0, y1 - y0) / 2
        cx, cy = (x0 + x1) / 2, (y0 + y1) / 2
        left, right, bottom, top = (
            max(left, cx - half),
            min(right, cx + half),
            max(bottom, cy - half),
            min(top, cy + half),
        )
    ax.set_xlim(left, right)
    ax.set_ylim(bottom, top)


def draw_truth(ax: Axes, ctx: ReportContext, size: float = 7.5) -> None:
    """The plates as they really lie."""
    colours = colours_of(ctx)
    _crop(ax, ctx)
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    for number, plate in enumerate(ctx.truth or [], 1):
        x0, y0, x1, y1 = plate["box_mm"]
        name = plate_label(plate, number)
        colour = colours[str(plate["name"])]
        ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, facecolor=colour, edgecolor=INK, linewidth=0.9))
        if y1 < top:
            _label(ax, (x0 + x1) / 2, y1 + 0.5, name, size, above=True)
        else:  # larger than the image: a name above it would be far outside the picture
            _label(ax, (max(x0, left) + min(x1, right)) / 2, (max(y0, bottom) + top) / 2, name, size)


def map_figure(ctx: ReportContext, draw: Callable[[Axes, ReportContext], None], title: str) -> bytes:
    """PNG of a material map or of the truth."""
    fig, ax = _new(4.6, 4.6)
    draw(ax, ctx)
    _dress(ax, title, ctx.simulated)
    ax.set_facecolor("#f3f5f8")
    return png(fig)


def permittivity_figure(ctx: ReportContext) -> bytes | None:
    """PNG of the estimates in the plane of real part and loss, with their spread and the truth; None without any."""
    rows = [r for r in ctx.materials if r.get("permittivity")]
    if not rows:
        return None
    colours = colours_of(ctx)
    fig, ax = _new(7.2, 4.2)
    _dress(ax, "Permittivity, estimate and truth" if ctx.truth else "Permittivity", ctx.simulated)
    ax.set_aspect("auto")
    ax.set_facecolor("white")
    ax.grid(color="#e6e9ee", linewidth=0.8)
    ax.set_axisbelow(True)
    ax.set_xlabel("real part ε′", fontsize=9, color=MUTED)
    ax.set_ylabel("loss ε″", fontsize=9, color=MUTED)
    for row in rows:
        e = row["permittivity"]
        colour = colours.get(str(row.get("name")), UNKNOWN_COLOUR)
        re, loss = e["real"], -e["imag"]
        (r0, r1), (i0, i1) = e["real_p30_p70"], e["imag_p30_p70"]
        ax.errorbar(
            re, loss, xerr=[[max(re - r0, 0)], [max(r1 - re, 0)]], yerr=[[max(loss + i1, 0)], [max(-i0 - loss, 0)]],
            fmt="o", color=colour, markersize=7, markeredgecolor=INK, markeredgewidth=0.6, linewidth=1.2, zorder=3,
        )  # fmt: skip
        truth = (row.get("truth") or {}).get("permittivity")
        if truth:
            ax.plot([re, truth["real"]], [loss, -truth["imag"]], color=MUTED, linewidth=0.8, zorder=2)
            ax.plot(truth["real"], -truth["imag"], "x", color=INK, markersize=7, markeredgewidth=1.5, zorder=4)
        ax.annotate(
            patch_label(row), (re, loss), textcoords="offset points", xytext=(7, 6), fontsize=7.5, color=INK, zorder=5,
            path_effects=[withStroke(linewidth=2, foreground="white")], family=list(font_families()), parse_math=False,
        )  # fmt: skip
    low, high = ax.get_ylim()
    ax.set_ylim(min(low, -0.1), high)
    ax.margins(x=0.12)
    return png(fig)


def draw_overview(fig: Figure, axes: Sequence[Axes], ctx: ReportContext, bar_labels: bool = False) -> None:
    """Draw amplitude H, V, P with colour bars on the first three axes, and the materials on a fourth one."""
    for ax, key, title in zip(
        axes[:3],
        ("amplitude_h", "amplitude_v", "amplitude_p"),
        ("H, s-polarised (dB)", "V, p-polarised (dB)", "P = H / V (dB)"),
        strict=True,
    ):
        shown, unit = draw_channel(ax, ctx, key)
        _dress(ax, title, ctx.simulated)
        bar = fig.colorbar(shown, ax=ax, fraction=0.046, pad=0.03)
        if bar_labels:
            bar.set_label(unit, fontsize=8, color=MUTED)
        bar.ax.tick_params(labelsize=8, colors=MUTED, length=2)
        if bar.solids is not None:
            bar.solids.set_alpha(1)
    for ax in axes[3:]:
        draw_materials(ax, ctx, size=6.5)
        _dress(ax, "Materials", ctx.simulated)


def banner_png(path: Path, ctx: ReportContext) -> None:
    """One wide picture: amplitude H, V, P and the material map side by side, written to `path`."""
    fig = Figure(figsize=(15.0, 3.7), dpi=120, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    axes = list(fig.subplots(1, 4))
    draw_overview(fig, axes, ctx)
    for ax in axes[1:]:
        ax.set_ylabel("")
    path.write_bytes(png(fig))


def png(fig: Figure) -> bytes:
    """A figure as PNG bytes; without a time stamp, so that the same data gives the same file."""
    buffer = io.BytesIO()
    fig.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def figures(ctx: ReportContext) -> dict[str, bytes]:
    """All figures of a report by file name (without suffix)."""
    out = {key: channel_figure(ctx, key) for key in FIGURES}
    if ctx.materials:
        out["materials"] = map_figure(ctx, draw_materials, "Materials found")
        found = permittivity_figure(ctx)
        if found is not None:
            out["permittivity"] = found
    masks = masked_positions(ctx)
    if any(m.any() for m in masks.values()):
        out["coverage"] = png(coverage_figure(ctx, masks))
    if ctx.truth:
        out["truth"] = map_figure(ctx, draw_truth, "Truth")
    return out


def focus_figure(
    sweep: dict[str, Any],
    before: npt.NDArray[np.complexfloating],
    after: npt.NDArray[np.complexfloating],
    x_m: npt.NDArray[np.float64],
    y_m: npt.NDArray[np.float64],
    simulated: bool,
) -> bytes:
    """PNG of a sweep (`depths_mm`, `sharpness`, `depth_mm`, `tilt_deg`, `certain`) and of H before and after."""
    fig = Figure(figsize=(13.0, 4.2), dpi=140, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    curve, *pictures = fig.subplots(1, 3, width_ratios=[1.1, 1, 1])
    curve.plot(sweep["depths_mm"], sweep["sharpness"], "o-", color="#44AA99", markersize=4)
    curve.axvline(0, color=MUTED, linewidth=1, linestyle=":", label="rig file")
    curve.axvline(sweep["depth_mm"], color="#882255", linewidth=1.4, label=f"found: {sweep['depth_mm']:+.2f} mm")
    curve.set_xlabel("plane, relative to the rig file (mm)", fontsize=9, color=MUTED)
    curve.set_ylabel("sharpness of the untilted plane", fontsize=9, color=MUTED)
    tilt = sweep["tilt_deg"]
    told = f"Tilt found: {tilt[0]:+.2f}° in x, {tilt[1]:+.2f}° in y" if sweep["certain"] else "Too flat to tell"
    curve.set_title(told, loc="left", fontsize=10, color=INK)
    curve.legend(fontsize=8, frameon=False)
    top = max(float(np.abs(before).max()), float(np.abs(after).max()), 1e-30)
    x, y = axis_mm(x_m), axis_mm(y_m)
    for ax, image, title in zip(
        pictures, (before, after), ("H on the rig file's plane", "H on the found plane"), strict=True
    ):
        level = 20 * np.log10(np.maximum(np.abs(image) / top, 1e-6))
        shown = ax.pcolormesh(x, y, level, cmap="cividis", vmin=-_RANGE_DB, vmax=0, shading="nearest", rasterized=True)
        ax.set_title(title, loc="left", fontsize=10, color=INK)
        ax.set_aspect("equal")
        ax.set_xlabel("x (mm)", fontsize=9, color=MUTED)
        fig.colorbar(shown, ax=ax, fraction=0.046, pad=0.03).set_label("dB", fontsize=8, color=MUTED)
    if simulated:
        fig.suptitle("SIMULATED", fontsize=9, color=STAMP, fontweight="bold", x=0.99, ha="right")
    return png(fig)
