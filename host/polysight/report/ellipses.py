"""Figure of the permittivities, loss over real part: estimates, error ellipses and the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse
from matplotlib.patheffects import withStroke

from polysight.products import ProcessedScan
from polysight.report.style import (
    INK,
    MUTED,
    colours_of,
    dress,
    patch_colour,
    patch_label,
    png,
    short_label,
    style_legend,
)
from polysight.results import PatchFigures, PermittivityFigures

SHARES = {0.68: 2.279, 0.95: 5.991}
"""Share of draws to the squared radius that holds it: quantiles of chi-squared with two degrees of freedom."""
_STYLES: dict[float, dict[str, Any]] = {
    0.68: {"linestyle": "-", "linewidth": 1.2},
    0.95: {"linestyle": "--", "linewidth": 0.8},
}
_LABEL_PT, _NEAR_PT = (9.0, 9.0), 5.0  # sizes of a number and of a point
_RADII_PT, _ANGLES = (11, 17, 25, 34, 45, 58), 16
Array = npt.NDArray[np.float64]
Point = tuple[float, float]
Estimate = tuple[PatchFigures, PermittivityFigures]


def ellipse_of(matrix: Array, share: float) -> tuple[float, float, float]:
    """Return width, height and angle in degrees of the ellipse that holds a share of draws with a covariance [2, 2]."""
    values, vectors = np.linalg.eigh(matrix)
    width, height = 2 * np.sqrt(np.maximum(values, 0.0) * SHARES[share])
    return float(width), float(height), math.degrees(math.atan2(vectors[1, 0], vectors[0, 0]))


def place_numbers(points: Array, obstacles: Array) -> Array:
    """Place a label beside each point so that labels cover neither one another nor a point.

    Parameters
    ----------
    points
        [n, 2], in points of 1/72 inch.
    obstacles
        [m, 2]: further points to keep clear of.

    Returns
    -------
    [n, 2]: the labels' middles: for each the nearest free place, else the one that covers least.
    """
    taken: list[Array] = []
    solid = np.concatenate([points, obstacles.reshape(-1, 2)])
    turns = np.radians(45 + np.arange(_ANGLES) * 360 / _ANGLES)
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    candidates = np.concatenate([radius * ring for radius in _RADII_PT])
    for point in points:
        best, least = point + candidates[0], math.inf
        for place in point + candidates:
            labels = sum(bool((np.abs(place - other) < _LABEL_PT).all()) for other in taken)
            covered = (np.abs(solid - place) < np.array(_LABEL_PT) / 2 + _NEAR_PT / 2).all(axis=1).sum()
            if (cost := 2.0 * labels + covered) < least:
                best, least = place, cost
            if least == 0:
                break
        taken.append(best)
    return np.array(taken).reshape(-1, 2)


def permittivity_figure(scan: ProcessedScan) -> bytes | None:
    """Return a PNG of the estimates with ellipses of 68 % and 95 %, and the truth as crosses; None without estimates.

    Patches are numbered; a legend names them. Without a covariance, bars show the spread of the pixels.
    """
    estimates = [(patch, patch.permittivity) for patch in scan.segments if patch.permittivity is not None]
    if not estimates:
        return None
    colours = colours_of(scan)
    size_in = (7.8, max(4.4, 1.5 + 0.19 * len(estimates)))
    fig = Figure(figsize=size_in, dpi=160, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    ax = fig.add_subplot()
    truths = [t for patch, _ in estimates if (t := _truth(patch))]
    dress(ax, "Permittivity, estimate and truth" if truths else "Permittivity", scan.stamped)
    ax.set_aspect("auto")
    ax.set_facecolor("white")
    ax.grid(color="#e6e9ee", linewidth=0.8)
    ax.set_axisbelow(True)
    ax.set_xlabel("real part ε′", fontsize=9, color=MUTED)
    ax.set_ylabel("loss ε″", fontsize=9, color=MUTED)
    for patch, e in estimates:
        _draw_estimate(ax, e, _truth(patch), patch_colour(patch, colours))
    _set_limits(ax, [e for _, e in estimates], truths)
    low = ax.get_ylim()[0]
    ax.axhspan(low, 0, color="#f0e7e6", zorder=0)
    ax.annotate(
        "ε″ < 0: gain", (0, 0), xycoords="axes fraction", xytext=(4, 3), textcoords="offset points", fontsize=7,
        color=MUTED, zorder=1,
    )  # fmt: skip
    _legend(fig, estimates, colours, bool(truths))
    fig.draw_without_rendering()
    _write_numbers(fig, ax, estimates, truths)
    return png(fig)


def _truth(patch: PatchFigures) -> Point | None:
    truth = patch.true_permittivity
    return None if truth is None else (truth.real, -truth.imag)


def _draw_estimate(ax: Axes, e: PermittivityFigures, truth: Point | None, colour: str) -> None:
    at = (e.real, e.loss)
    if e.spread is not None:
        for share, style in _STYLES.items():
            w, h, angle = ellipse_of(e.spread.matrix, share)
            ax.add_patch(Ellipse(at, w, h, angle=angle, facecolor="none", edgecolor=colour, zorder=2.5, **style))
            if share == min(_STYLES):
                ax.add_patch(Ellipse(at, w, h, angle=angle, facecolor=colour, alpha=0.18, linewidth=0, zorder=2))
    elif e.real_p30_p70 and e.imag_p30_p70:
        (r0, r1), (i0, i1) = e.real_p30_p70, e.imag_p30_p70
        ax.errorbar(
            *at, xerr=[[max(at[0] - r0, 0)], [max(r1 - at[0], 0)]], yerr=[[max(at[1] + i1, 0)], [max(-i0 - at[1], 0)]],
            color=colour, linewidth=1.2, zorder=3,
        )  # fmt: skip
    ax.plot(*at, "o", color=colour, markersize=6, markeredgecolor=INK, markeredgewidth=0.6, zorder=3)
    if truth:
        ax.plot([at[0], truth[0]], [at[1], truth[1]], color=MUTED, linewidth=0.8, zorder=2)
        ax.plot(*truth, "x", color=INK, markersize=6, markeredgewidth=1.5, zorder=4)


def _set_limits(ax: Axes, estimates: Sequence[PermittivityFigures], truths: Sequence[Point]) -> None:
    """Set limits around estimates, truths and ellipses; one very uncertain patch must not shrink all others."""
    centres = np.array([(e.real, e.loss) for e in estimates])
    certain = np.concatenate([centres, np.array(truths, float).reshape(-1, 2)])
    half = np.array([_half_size(e) for e in estimates])
    low, high = certain.min(axis=0), certain.max(axis=0)
    span = np.maximum(high - low, (0.5, 0.3))
    low = np.minimum(low, np.maximum((centres - half).min(axis=0), low - 0.75 * span)) - 0.08 * span
    high = np.maximum(high, np.minimum((centres + half).max(axis=0), high + 0.75 * span)) + 0.08 * span
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(min(low[1], -0.1), high[1])


def _half_size(e: PermittivityFigures) -> Point:
    """Return how far the drawing of an estimate reaches: its 95 % ellipse, or its bars."""
    if e.spread is not None:
        radius = math.sqrt(SHARES[0.95])
        return radius * e.spread.real_std, radius * e.spread.loss_std
    real = max(abs(end - e.real) for end in e.real_p30_p70 or (e.real,))
    return real, max(abs(end - e.imag) for end in e.imag_p30_p70 or (e.imag,))


def _legend(fig: Figure, estimates: Sequence[Estimate], colours: dict[str, str], with_truth: bool) -> None:
    dot: dict[str, Any] = {
        "marker": "o",
        "linestyle": "",
        "markersize": 6,
        "markeredgecolor": INK,
        "markeredgewidth": 0.6,
    }
    handles = []
    for patch, _ in estimates:
        label = f"{patch.label}  {short_label(patch_label(patch))}"
        handles.append(Line2D([], [], color=patch_colour(patch, colours), label=label, **dot))
    if any(e.spread for _, e in estimates):
        handles += [
            Line2D([], [], color=MUTED, **style, label=f"{100 * share:.0f} % region")
            for share, style in _STYLES.items()
        ]
    if with_truth:
        handles.append(Line2D([], [], color=INK, marker="x", linestyle="", markeredgewidth=1.5, label="truth"))
    style_legend(fig.legend(handles=handles, loc="outside right upper", fontsize=7.5, frameon=False))


def _write_numbers(fig: Figure, ax: Axes, estimates: Sequence[Estimate], truths: Sequence[Point]) -> None:
    """Write the patches' numbers beside their points, with a line to numbers that are further away."""
    per_point = fig.dpi / 72
    values = np.array([(e.real, e.loss) for _, e in estimates])
    points = ax.transData.transform(values) / per_point
    crosses = ax.transData.transform(np.array(truths, float).reshape(-1, 2)) / per_point
    places = place_numbers(points, crosses)
    line = {"arrowstyle": "-", "color": MUTED, "linewidth": 0.6, "shrinkA": 3, "shrinkB": 3}
    for (patch, e), place, point in zip(estimates, places, points, strict=True):
        offset = place - point
        far = float(np.hypot(*offset)) > _RADII_PT[0] + 1
        ax.annotate(
            str(patch.label), (e.real, e.loss), textcoords="offset points",
            xytext=(float(offset[0]), float(offset[1])), ha="center", va="center", fontsize=8, color=INK, zorder=5,
            fontweight="bold", path_effects=[withStroke(linewidth=2, foreground="white")],
            arrowprops=line if far else None,
        )  # fmt: skip
