"""What all figures share: colours of materials, axes in millimetres, titles, labels, PNG bytes.

Materials have the colour-blind safe palette of Paul Tol ("muted", then "light"). Matplotlib's object interface only: no
global state, no display.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.text import Text
from matplotlib.transforms import Bbox, BboxBase

from polysight.host.report.context import ReportContext
from polysight.host.report.fonts import figure_label, font_families
from polysight.host.report.tables import INK, MUTED, STAMP

PALETTE = (
    "#332288", "#88CCEE", "#44AA99", "#117733", "#999933", "#DDCC77", "#CC6677", "#882255", "#AA4499",
    "#77AADD", "#EE8866", "#EEDD88", "#FFAABB", "#99DDFF", "#44BB99", "#BBCC33", "#AAAA00",
)  # fmt: skip
UNKNOWN_COLOUR = "#BBBBBB"
METAL_COLOUR, REFUSED_COLOUR = "#C9D3DE", "#8d949e"  # the metal reference; patches that were not judged
HATCH = "////"
_GAP_PT = 8.0  # between names side by side
_LONGEST = 26  # characters of a name in a legend


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


def new_axes(width: float = 5.0, height: float = 4.6) -> tuple[Figure, Axes]:
    """A white figure of this size in inches, and its only axes."""
    fig = Figure(figsize=(width, height), dpi=160, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    ax = fig.add_subplot()
    return fig, ax


def dress(ax: Axes, title: str, simulated: bool) -> None:
    """Title, axes in millimetres, quiet ticks; the word SIMULATED where it is."""
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


def write_label(
    ax: Axes, x: float, y: float, text: str, size: float = 8.0, above: bool = False, on_dark: bool = False
) -> Text:
    """Write a name or number with a halo; `above` puts it on top of the point."""
    ink, halo = ("white", "#10141b") if on_dark else (INK, "white")
    return ax.text(
        x, y, text, ha="center", va="bottom" if above else "center", fontsize=size, color=ink, linespacing=1.2,
        path_effects=[withStroke(linewidth=2.4, foreground=halo)], family=list(font_families()), parse_math=False,
    )  # fmt: skip


def patch_label(row: dict[str, Any]) -> str:
    """What figures write beside a patch."""
    number = f"patch {row['label']}"
    if not row.get("name"):
        return "metal reference" if row.get("metal_reference") else number
    return figure_label(str(row["name"]), number)


def short_label(text: str) -> str:
    """A name as legends have it: cut to a line's length."""
    text = " ".join(text.split())
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


def patch_colour(row: dict[str, Any], colours: dict[str, str]) -> str:
    """Colour of a patch: of its name, or of what it is instead."""
    if row.get("refused"):
        return REFUSED_COLOUR
    if not row.get("name") and row.get("metal_reference"):
        return METAL_COLOUR
    return colours.get(str(row.get("name") or "unknown"), UNKNOWN_COLOUR)


def plate_label(plate: dict[str, Any], number: int) -> str:
    """What the truth's figure writes beside a plate; `number` counts plates from 1."""
    return figure_label(str(plate["name"]), f"plate {number}")


def outline_of(row: dict[str, Any], **style: Any) -> Polygon | Rectangle:
    """A patch's outline, or its box where there is none; `style` as matplotlib's patches take it."""
    if row.get("outline_mm"):
        return Polygon(row["outline_mm"], closed=True, **style)
    x0, y0, x1, y1 = row["box_mm"]
    return Rectangle((x0, y0), x1 - x0, y1 - y0, **style)


@dataclass(frozen=True)
class MapLabel:
    """A name on a map, and what stands for it where there is no room.

    Attributes
    ----------
    text
        As drawn.
    number, name, colour
        Its number on the map, and its line in the legend.
    below
        Second line that stays, such as the confidence; may be empty.
    """

    text: Text
    number: str
    name: str
    colour: str
    below: str = ""


def shorten_labels(fig: Figure, labels: Sequence[MapLabel]) -> list[MapLabel]:
    """Replace all labels by their numbers if two touch or one leaves the frame; returns those that were replaced."""
    if not labels:
        return []
    fig.draw_without_rendering()
    gap = _GAP_PT * fig.dpi / 72
    boxes = [one.text.get_window_extent() for one in labels]
    frames = [one.text.axes.bbox if one.text.axes else fig.bbox for one in labels]
    outside = any(b.x0 < f.x0 - 1 or b.x1 > f.x1 + 1 for b, f in zip(boxes, frames, strict=True))
    if not outside and not any(a.overlaps(b) for a, b in combinations([_widened(b, gap) for b in boxes], 2)):
        return []
    for one in labels:
        one.text.set_text(f"{one.number}: {one.below}" if one.below else one.number)
    return list(labels)


def _widened(box: BboxBase, gap: float) -> Bbox:
    return Bbox.from_extents(box.x0 - gap / 2, box.y0, box.x1 + gap / 2, box.y1)


def name_legend(fig: Figure, labels: Sequence[MapLabel]) -> None:
    """A legend below the axes: number and name of each label."""
    if labels:
        handles = [
            Patch(facecolor=one.colour, edgecolor=INK, linewidth=0.6, label=f"{one.number}  {short_label(one.name)}")
            for one in labels
        ]
        legend = fig.legend(
            handles=handles, loc="outside lower left", ncols=2, fontsize=7.5, frameon=False, handlelength=1.1,
        )  # fmt: skip
        for text in legend.get_texts():
            text.set(family=list(font_families()), parse_math=False, color=INK)


def png(fig: Figure) -> bytes:
    """A figure as PNG bytes; without a time stamp, so that the same data gives the same file."""
    buffer = io.BytesIO()
    fig.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
