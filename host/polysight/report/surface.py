"""Picture of surfaces: their points from three sides, coloured by permittivity, with the error of each segment."""

from __future__ import annotations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from polysight.report.style import INK, MUTED, dress, png
from polysight.surfaces import Segment, Surface, describe_form, describe_material

# Axis numbers of a view (horizontal, vertical), its title, and the names of the axes.
VIEWS = (
    ((0, 1), "From the rig", ("x (mm)", "y (mm)")),
    ((2, 1), "From the side", ("z (mm), away from the rig", "y (mm)")),
    ((0, 2), "From above", ("x (mm)", "z (mm), away from the rig")),
)
NORMALS_SHOWN = 60
NORMAL_MM = 12.0
MAX_LINES = 8
NO_PERMITTIVITY = "#9aa3ad"


def surface_figure(surface: Surface) -> bytes:
    """Return a PNG of a surface from three sides."""
    fig = Figure(figsize=(11.5, 4.9), dpi=150, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    panels = fig.subplots(1, 3)
    points_mm = 1e3 * surface.points_m
    colour = surface_colours(surface)
    known_colour = np.isfinite(colour)
    low, high = colour_range(surface)
    coloured = None
    for ax, ((across, up), title, (label_x, label_y)) in zip(panels, VIEWS, strict=True):
        ax.scatter(points_mm[~known_colour, across], points_mm[~known_colour, up], s=5, color=NO_PERMITTIVITY)
        coloured = ax.scatter(
            points_mm[known_colour, across], points_mm[known_colour, up], s=6, c=colour[known_colour],
            cmap="viridis", vmin=low, vmax=high,
        )  # fmt: skip
        stride = max(1, len(points_mm) // NORMALS_SHOWN)
        start = points_mm[::stride]
        needle = NORMAL_MM * surface.normals[::stride]
        ends = start + needle
        ax.plot([start[:, across], ends[:, across]], [start[:, up], ends[:, up]], color=INK, linewidth=0.5, alpha=0.6)
        dress(ax, title, surface.simulated)
        ax.set_xlabel(label_x, fontsize=9, color=MUTED)
        ax.set_ylabel(label_y, fontsize=9, color=MUTED)
        ax.set_aspect("equal", adjustable="datalim")
    if known_colour.any() and coloured is not None:
        bar = fig.colorbar(coloured, ax=panels, shrink=0.85, pad=0.01)
        bar.set_label("permittivity, real part", fontsize=9, color=MUTED)
    lines = [segment_text(segment) for segment in surface.segments[:MAX_LINES]]
    fig.supxlabel("\n".join(lines), fontsize=9, color=INK, x=0.01, ha="left")
    return png(fig)


def surface_colours(surface: Surface) -> NDArray[np.float64]:
    """Real part of the permittivity of each point's segment, [n]; not a number without one."""
    colours = np.full(len(surface.segment), np.nan)
    for segment in surface.segments:
        if segment.permittivity is not None:
            colours[surface.segment == segment.number] = segment.permittivity.real
    return colours


def colour_range(surface: Surface) -> tuple[float, float]:
    """Range of the colour bar: the permittivities, at least 1 wide."""
    values = [s.permittivity.real for s in surface.segments if s.permittivity is not None] or [1.0]
    middle = (min(values) + max(values)) / 2
    half = max(0.5, 0.55 * (max(values) - min(values)))
    return middle - half, middle + half


def segment_text(segment: Segment) -> str:
    """One line about a segment: form, permittivity with standard errors, or why it has none."""
    head = f"{segment.number}: {segment.points} points, {describe_form(segment)}"
    return f"{head}, incidence {segment.incidence_deg:.0f}°: {describe_material(segment)}"
