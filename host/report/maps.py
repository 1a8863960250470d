"""Maps of patches: what they were named, what lies there in truth, and their permittivity with its error."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.text import Text

from polysight.host.products import permittivity_spread
from polysight.host.report.context import ReportContext
from polysight.host.report.style import (
    HATCH,
    METAL_COLOUR,
    REFUSED_COLOUR,
    UNKNOWN_COLOUR,
    MapLabel,
    colours_of,
    dress,
    extent_mm,
    name_legend,
    new_axes,
    outline_of,
    patch_colour,
    patch_label,
    plate_label,
    png,
    shorten_labels,
    write_label,
)
from polysight.host.report.tables import INK, MUTED

_ROOM = 0.09  # of a map's height: what a label of two lines needs


def draw_materials(ax: Axes, ctx: ReportContext, size: float = 7.5) -> list[MapLabel]:
    """Material map: the majority's colour over each patch, each interior pixel in the colour of its own name.

    Patches that were not judged are hatched grey. Returns the labels.
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
        x0, _, x1, y1 = row["box_mm"]
        if row.get("refused"):
            ax.add_patch(outline_of(row, fill=False, edgecolor=REFUSED_COLOUR, hatch=HATCH, linewidth=0.0))
        if row.get("outline_mm") or row.get("refused"):
            ax.add_patch(outline_of(row, fill=False, edgecolor=INK, linewidth=0.9))
        name = patch_label(row)
        below = "" if row.get("confidence") is None else f"{100 * row['confidence']:.0f} %"
        below = "not judged" if row.get("refused") else below
        text = write_label(ax, (x0 + x1) / 2, y1 + 0.5, f"{name}\n{below}" if below else name, size, above=True)
        _keep_inside(ax, text, y1)
        labels.append(MapLabel(text, str(row["label"]), name, patch_colour(row, colours), below))
    return labels


def _keep_inside(ax: Axes, text: Text, top_mm: float) -> None:
    """Put a label below the upper edge of its patch where there is no room above: it would reach into the title."""
    bottom, top = ax.get_ylim()
    if top_mm > top - _ROOM * (top - bottom):
        text.set(y=min(top_mm, top) - 1.0, verticalalignment="top")


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


def draw_truth(ax: Axes, ctx: ReportContext, size: float = 7.5) -> list[MapLabel]:
    """The plates as they really lie. Returns the labels."""
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
    """PNG of a material map or of the truth. Where names lack room all become numbers, with a legend below."""
    fig, ax = new_axes(4.6, 4.6)
    labels = draw(ax, ctx)
    dress(ax, title, ctx.simulated)
    ax.set_facecolor("#f3f5f8")
    replaced = shorten_labels(fig, labels)
    if replaced:
        fig.set_figheight(4.7 + 0.17 * ((len(replaced) + 1) // 2))
        name_legend(fig, replaced)
    return png(fig)


def relative_error(permittivity: Mapping[str, Any]) -> float | None:
    """Standard error of a complex permittivity relative to its size; None where it is not known."""
    spread = permittivity_spread(permittivity)
    size = math.hypot(permittivity["real"], permittivity["imag"])
    return None if spread is None or size == 0 else math.hypot(spread.real_std, spread.loss_std) / size


def permittivity_map(ctx: ReportContext) -> bytes | None:
    """PNG of the patches filled by eps' with its standard error, and of the relative error; None without any error."""
    known = {r["label"]: e for r in ctx.materials if (e := r.get("permittivity")) and permittivity_spread(e)}
    if not known:
        return None
    fig = Figure(figsize=(9.4, 4.6), dpi=160, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    real = {label: e["real"] for label, e in known.items()}
    errors = {label: 100 * (relative_error(e) or 0.0) for label, e in known.items()}
    middle = {label: f"{e['real']:.2f}\n± {_std(e):.2f}" for label, e in known.items()}
    percent = {label: f"{v:.0f} %" if v >= 10 else f"{v:.1f} %" for label, v in errors.items()}
    low, high = min(real.values()), max(real.values())
    margin = max(0.1 * (high - low), 0.25)
    left, right = fig.subplots(1, 2)
    _fill_patches(left, ctx, real, middle, ("viridis", low - margin, high + margin, "real part ε′"))
    _fill_patches(right, ctx, errors, percent, ("YlOrBr", 0.0, max(*errors.values(), 5.0), "percent of |ε|"))
    dress(left, "Permittivity ε′ ± standard error", simulated=False)
    dress(right, "Relative error of ε", ctx.simulated)
    for ax in (left, right):
        ax.set_facecolor("#f3f5f8")
    right.set_ylabel("")
    return png(fig)


def _std(permittivity: Mapping[str, Any]) -> float:
    spread = permittivity_spread(permittivity)
    return math.nan if spread is None else spread.real_std


def _fill_patches(
    ax: Axes,
    ctx: ReportContext,
    values: dict[int, float],
    texts: dict[int, str],
    scale: tuple[str, float, float, str],
) -> None:
    """Patches in the colours of their values; those without one are grey, and hatched where they were not judged.

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
    bar = ax.figure.colorbar(colours, ax=ax, fraction=0.046, pad=0.03)
    bar.set_label(scale[3], fontsize=8, color=MUTED)
    bar.ax.tick_params(labelsize=8, colors=MUTED, length=2)
