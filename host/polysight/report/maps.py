"""Maps: names of the patches, the true plates, permittivities with their errors, and masked stage positions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.text import Text

from polysight.products import permittivity_spread
from polysight.report.context import ReportContext
from polysight.report.style import (
    HATCH,
    INK,
    METAL_COLOUR,
    MUTED,
    REFUSED_COLOUR,
    UNKNOWN_COLOUR,
    MapLabel,
    colour_bar,
    colours_of,
    dress,
    extent_mm,
    fit_labels,
    new_axes,
    outline_of,
    patch_colour,
    patch_label,
    plate_label,
    png,
    write_label,
)

_ROOM = 0.05  # of a map's height, for a label
_POSITION_COLOURS = ("#dfe5ec", "#882255")  # with data light, masked dark: readable without colour


def draw_materials(ax: Axes, ctx: ReportContext, size: float = 7.5) -> list[MapLabel]:
    """Draw the material map: each patch in the colour of its name, each interior pixel in that of its own name.

    Patches that were not judged are hatched grey. Return the labels.
    """
    colours = colours_of(ctx)
    rgb = np.ones((*ctx.h.shape, 3)) * np.array(to_rgb("#f3f5f8"))
    if ctx.segments is not None:
        for row in ctx.materials:
            rgb[ctx.segments == row["label"]] = 0.55 + 0.45 * np.array(to_rgb(patch_colour(row, colours)))
    refused = {row["label"] for row in ctx.materials if row.get("refused")}
    for label, (names, interior) in ctx.pixel_names.items():
        if label not in refused:
            rgb[interior] = [to_rgb(colours.get(str(n), UNKNOWN_COLOUR)) for n in names]
    ax.imshow(rgb, extent=extent_mm(ctx), origin="lower", interpolation="nearest")
    _crop(ax, ctx)
    labels = []
    for row in ctx.materials:
        x0, y0, x1, y1 = row["box_mm"]
        if row.get("refused"):
            ax.add_patch(outline_of(row, fill=False, edgecolor=REFUSED_COLOUR, hatch=HATCH, linewidth=0.0))
        if row.get("outline_mm") or row.get("refused"):
            ax.add_patch(outline_of(row, fill=False, edgecolor=INK, linewidth=0.9))
        name = patch_label(row)
        within = "" if row.get("confidence") is None else f"{100 * row['confidence']:.0f} %"
        within = "not judged" if row.get("refused") else within
        text = write_label(ax, (x0 + x1) / 2, y1 + 0.5, name, size, above=True)
        _keep_inside(ax, text, y1)
        write_label(ax, (x0 + x1) / 2, y0 + 1.0, within, size, above=True)  # two lines above would reach the next patch
        labels.append(MapLabel(text, str(row["label"]), name, patch_colour(row, colours)))
    return labels


def _keep_inside(ax: Axes, text: Text, top_mm: float) -> None:
    """Put a label below the upper edge of its patch if it would reach into the title."""
    bottom, top = ax.get_ylim()
    if top_mm > top - _ROOM * (top - bottom):
        text.set(y=min(top_mm, top) - 1.0, verticalalignment="top")


def _crop(ax: Axes, ctx: ReportContext) -> None:
    """Set limits around patches and plates: square, inside the image, the same for map and truth."""
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


def draw_truth(ax: Axes, ctx: ReportContext, size: float = 7.5) -> list[MapLabel]:
    """Draw the true plates. Return the labels."""
    colours = colours_of(ctx)
    _crop(ax, ctx)
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    labels = []
    for number, plate in enumerate(ctx.truth or [], 1):
        x0, y0, x1, y1 = plate["box_mm"]
        name = plate_label(plate, number)
        colour = colours[str(plate["name"])]
        ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, facecolor=colour, edgecolor=INK, linewidth=0.9))
        if y1 < top:
            text = write_label(ax, (x0 + x1) / 2, y1 + 0.5, name, size, above=True)
            _keep_inside(ax, text, y1)
        else:  # larger than the image: a name above it would be far outside the picture
            text = write_label(ax, (max(x0, left) + min(x1, right)) / 2, (max(y0, bottom) + top) / 2, name, size)
        labels.append(MapLabel(text, str(number), name, colour))
    return labels


def map_figure(ctx: ReportContext, draw: Callable[[Axes, ReportContext], list[MapLabel]], title: str) -> bytes:
    """Return a PNG of a material map or of the truth. If names lack room all become numbers, with a legend below."""
    fig, ax = new_axes(4.6, 4.6)
    labels = draw(ax, ctx)
    dress(ax, title, ctx.simulated)
    ax.set_facecolor("#f3f5f8")
    fit_labels(fig, labels, 4.7)
    return png(fig)


def relative_error(permittivity: Mapping[str, Any]) -> float | None:
    """Return the standard error of a permittivity relative to its size; None if it is not known."""
    spread = permittivity_spread(permittivity)
    size = math.hypot(permittivity["real"], permittivity["imag"])
    return None if spread is None or size == 0 else math.hypot(spread.real_std, spread.loss_std) / size


def permittivity_map(ctx: ReportContext) -> bytes | None:
    """Return a PNG of eps' with its standard error in each patch, and of the relative error; None without errors."""
    known = {r["label"]: e for r in ctx.materials if (e := r.get("permittivity")) and permittivity_spread(e)}
    if not known:
        return None
    fig = Figure(figsize=(9.4, 4.6), dpi=160, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    real = {label: e["real"] for label, e in known.items()}
    errors = {label: 100 * (relative_error(e) or 0.0) for label, e in known.items()}
    stds = {label: spread.real_std for label, e in known.items() if (spread := permittivity_spread(e))}
    middle = {label: f"{e['real']:.2f}\n± {stds[label]:.2f}" for label, e in known.items()}
    percent = {label: f"{v:.0f} %" if v >= 10 else f"{v:.1f} %" for label, v in errors.items()}
    low, high = min(real.values()), max(real.values())
    margin = max(0.1 * (high - low), 0.25)
    left, right = fig.subplots(1, 2)
    _fill_patches(fig, left, ctx, real, middle, ("viridis", low - margin, high + margin, "real part ε′"))
    _fill_patches(fig, right, ctx, errors, percent, ("YlOrBr", 0.0, max(*errors.values(), 5.0), "percent of |ε|"))
    dress(left, "Permittivity ε′ ± standard error", simulated=False)
    dress(right, "Relative error of ε", ctx.simulated)
    for ax in (left, right):
        ax.set_facecolor("#f3f5f8")
    right.set_ylabel("")
    return png(fig)


def _fill_patches(
    fig: Figure,
    ax: Axes,
    ctx: ReportContext,
    values: dict[int, float],
    texts: dict[int, str],
    scale: tuple[str, float, float, str],
) -> None:
    """Fill patches in the colours of their values; others are grey, hatched if they were not judged.

    `scale` is the colour map, the values at its ends, and the colour bar's label.
    """
    colours = ScalarMappable(Normalize(scale[1], scale[2]), scale[0])
    for row in ctx.materials:
        x0, y0, x1, y1 = row["box_mm"]
        fill: Any = METAL_COLOUR if row.get("metal_reference") else "#e4e7ec"
        if row["label"] in values:
            fill = colours.to_rgba(np.array([values[row["label"]]]))[0]
        ax.add_patch(outline_of(row, facecolor=fill, edgecolor=INK, linewidth=0.9))
        if row.get("refused"):
            ax.add_patch(outline_of(row, fill=False, edgecolor=REFUSED_COLOUR, hatch=HATCH, linewidth=0.0))
        is_metal = row.get("metal_reference") or row.get("metal_like")
        text = texts.get(row["label"], "metal" if is_metal else "not\njudged" if row.get("refused") else "–")
        write_label(ax, (x0 + x1) / 2, (y0 + y1) / 2, text, 8)
        ax.annotate(
            str(row["label"]), (x0, y1), textcoords="offset points", xytext=(2.5, -2), ha="left", va="top",
            fontsize=6.5, color=INK, path_effects=[withStroke(linewidth=2, foreground="white")],
        )  # fmt: skip
    _crop(ax, ctx)
    ax.set_aspect("equal")
    colour_bar(fig, ax, colours, scale[3])


def coverage_figure(ctx: ReportContext, masks: dict[str, npt.NDArray[np.bool_]]) -> Figure:
    """Return a map of masked stage positions for each board, millimetres from the middle of the grid.

    `masks` as of :func:`polysight.report.tables.masked_positions`; the context must hold the plan.
    """
    plan = ctx.plan
    if plan is None:
        raise ValueError("a map of positions needs the plan")
    width, height = plan.columns * plan.step_x_mm, plan.rows * plan.step_y_mm
    extent = (-width / 2, width / 2, -height / 2, height / 2)
    size = (9.0, 0.9 + 4.2 * min(1.2, max(0.3, height / width)))
    fig = Figure(figsize=size, dpi=130, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    for ax, (name, mask) in zip(fig.subplots(1, len(masks), squeeze=False)[0], masks.items(), strict=True):
        colours = ListedColormap(_POSITION_COLOURS)
        ax.imshow(mask, origin="lower", extent=extent, cmap=colours, vmin=0, vmax=1, interpolation="nearest")
        dress(ax, f"{name}: {mask.mean():.2%} masked", ctx.simulated)
        ax.set_xlabel("stage offset x (mm)", fontsize=9, color=MUTED)
        ax.set_ylabel("stage offset y (mm)", fontsize=9, color=MUTED)
    return fig
