"""Plot of permittivities, loss over real part: estimates with error ellipses, and the truth as crosses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse
from matplotlib.patheffects import withStroke

from polysight.products import ProcessedScan
from polysight.report.style import (
    INK,
    MUTED,
    RIGHT_IN,
    assign_colours,
    encode_png,
    make_figure,
    patch_colour,
    patch_label,
    set_margins,
    short_label,
    style_axes,
    style_legend,
)
from polysight.results import PatchFigures, PermittivityFigures

_INNER_SHARE = 0.68
_OUTER_SHARE = 0.95
SHARES = {_INNER_SHARE: 2.279, _OUTER_SHARE: 5.991}
"""Keys: the share of a normal distribution inside an ellipse. Values: the squared Mahalanobis radius of this ellipse,
a quantile of chi-squared with two degrees of freedom.
"""
_STYLES: dict[float, dict[str, Any]] = {
    _INNER_SHARE: {"linestyle": "-", "linewidth": 1.2},
    _OUTER_SHARE: {"linestyle": "--", "linewidth": 0.8},
}
# Sizes in inches; chosen. The figure is higher if its legend needs it, which has a line for each patch, some more lines
# and a margin.
_WIDTH_IN = 7.8
_SMALLEST_HEIGHT_IN = 4.4
_LEGEND_LINE_IN = 0.19
_OTHER_LEGEND_IN = 1.5
# Sizes of a patch's number (width, height) and of a point that `place_numbers` assumes, in points of 1/72 inch; chosen.
# A number of two digits is drawn 12 wide and 8 high, a point 6.6 wide with its edge: where there is little room, they
# may touch.
_LABEL_PT = (9.0, 9.0)
_POINT_PT = 5.0
# Places that `place_numbers` tries: rings around the point, and directions on each; chosen.
_RADII_PT = (11, 17, 25, 34, 45, 58)
_ANGLES = 16
# A number further from its point than the nearest ring, with a little room, gets a line to it.
_LINE_FROM_PT = _RADII_PT[0] + 1
# Room for ellipses beyond estimates and truths, and an empty margin, as shares of the span of these; chosen.
_ELLIPSE_SHARE = 0.75
_MARGIN_SHARE = 0.08
# Smallest span of the axes, real part and loss: points that lie together are not drawn far apart; chosen.
_SMALLEST_SPAN = (0.5, 0.3)
Array = npt.NDArray[np.float64]
Point = tuple[float, float]
Estimate = tuple[PatchFigures, PermittivityFigures]


def compute_ellipse(matrix: Array, share: float) -> tuple[float, float, float]:
    """Return width, height and angle in degrees of the ellipse that holds a share (a key of `SHARES`).

    `matrix` is the covariance [2, 2] of a normal distribution.
    """
    values, vectors = np.linalg.eigh(matrix)
    width, height = 2 * np.sqrt(np.maximum(values, 0.0) * SHARES[share])
    return float(width), float(height), math.degrees(math.atan2(vectors[1, 0], vectors[0, 0]))


def region_matrix(estimate: PermittivityFigures, share: float) -> Array | None:
    """Return the covariance [2, 2] of (eps', eps'') whose :func:`compute_ellipse` holds a share.

    None if no error is known.

    The covariance of an estimate is scaled so that its 95 % ellipse holds the truth in 95 % of all cases. Errors have
    longer tails than a normal distribution, so that its 68 % ellipse would be too large: there the half widths of the
    68 % intervals, `half_widths_68`, take the place of the standard deviations.
    """
    if estimate.spread is None:
        return None
    matrix = estimate.spread.matrix
    if share == _INNER_SHARE and estimate.half_widths_68 is not None:
        # With s_i = half width / standard deviation, C_ij becomes s_i C_ij s_j.
        shrinkage = np.array(estimate.half_widths_68) / np.sqrt(np.diag(matrix))
        matrix = matrix * np.outer(shrinkage, shrinkage)
    return matrix


def place_numbers(points: Array, obstacles: Array) -> Array:
    """Place a label beside each point so that, if there is room, labels cover neither one another nor a point.

    Parameters
    ----------
    points
        [n, 2], in points of 1/72 inch.
    obstacles
        [m, 2]: further points to keep clear of.

    Returns
    -------
    [n, 2]: the labels' middles, in the same unit: for each the nearest free place, else the one that covers least.
    """
    taken_places: list[Array] = []
    keep_clear = np.concatenate([points, obstacles.reshape(-1, 2)])
    angles_rad = np.radians(45 + np.arange(_ANGLES) * 360 / _ANGLES)
    ring = np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=1)
    candidates = np.concatenate([radius * ring for radius in _RADII_PT])
    # A label covers a point if it is closer than this in x and in y.
    smallest_offset = np.array(_LABEL_PT) / 2 + _POINT_PT / 2
    for point in points:
        best = point + candidates[0]
        least_cost = math.inf
        for place in point + candidates:
            labels_covered = sum(bool((np.abs(place - taken_place) < _LABEL_PT).all()) for taken_place in taken_places)
            is_covered = (np.abs(keep_clear - place) < smallest_offset).all(axis=1)
            points_covered = is_covered.sum()
            # A number on another one cannot be read; one on a point can.
            cost = 2.0 * labels_covered + points_covered
            if cost < least_cost:
                best = place
                least_cost = cost
            if least_cost == 0:
                break
        taken_places.append(best)
    return np.array(taken_places).reshape(-1, 2)


def draw_permittivity_figure(scan: ProcessedScan) -> bytes | None:
    """Return a PNG of the estimates with ellipses of 68 % and 95 %, and the truth as crosses; None without estimates.

    Patches are numbered; a legend names them. Without a covariance, bars show the spread of the pixels.
    """
    estimates = [(patch, patch.permittivity) for patch in scan.segments if patch.permittivity is not None]
    if not estimates:
        return None
    colours = assign_colours(scan)
    legend_in = _OTHER_LEGEND_IN + _LEGEND_LINE_IN * len(estimates)
    fig = make_figure(_WIDTH_IN, max(_SMALLEST_HEIGHT_IN, legend_in), RIGHT_IN)
    ax = fig.add_subplot()
    truths = [t for patch, _ in estimates if (t := _find_truth(patch))]
    title = "Permittivity"
    if truths:
        title += ", estimate and truth"
    style_axes(ax, title, simulated=scan.stamped)
    ax.set_aspect("auto")
    ax.set_facecolor("white")
    ax.grid(color="#e6e9ee", linewidth=0.8)
    ax.set_axisbelow(True)
    ax.set_xlabel("real part ε′", fontsize=9, color=MUTED)
    ax.set_ylabel("loss ε″", fontsize=9, color=MUTED)
    for patch, estimate in estimates:
        _draw_estimate(ax, estimate, _find_truth(patch), patch_colour(patch, colours))
    _set_limits(ax, [estimate for _, estimate in estimates], truths)
    low = ax.get_ylim()[0]
    ax.axhspan(low, 0, color="#f0e7e6", zorder=0)
    ax.annotate(
        "ε″ < 0: gain", (0, 0), xycoords="axes fraction", xytext=(4, 3), textcoords="offset points", fontsize=7,
        color=MUTED, zorder=1,
    )  # fmt: skip
    legend = _draw_legend(fig, estimates, colours, bool(truths))
    set_margins(fig, legend.get_window_extent().width / fig.dpi + RIGHT_IN)
    _write_numbers(fig, ax, estimates, truths)
    return encode_png(fig)


def _find_truth(patch: PatchFigures) -> Point | None:
    """Return the true (eps', eps'') of a patch of a simulated scene; None without one."""
    truth = patch.true_permittivity
    if truth is None:
        return None
    return truth.real, -truth.imag


def _draw_estimate(ax: Axes, estimate: PermittivityFigures, truth: Point | None, colour: str) -> None:
    """Draw a permittivity with its confidence regions (old products: percentiles of pixels), and the truth."""
    centre = (estimate.real, estimate.loss)
    regions = {share: matrix for share in _STYLES if (matrix := region_matrix(estimate, share)) is not None}
    if regions:
        for share, matrix in regions.items():
            style = _STYLES[share]
            width, height, angle = compute_ellipse(matrix, share)
            outline = Ellipse(
                centre, width, height, angle=angle, facecolor="none", edgecolor=colour, zorder=2.5, **style
            )
            ax.add_patch(outline)
            if share == _INNER_SHARE:
                # Only the inner region is filled.
                area = Ellipse(centre, width, height, angle=angle, facecolor=colour, alpha=0.18, linewidth=0, zorder=2)
                ax.add_patch(area)
    elif estimate.real_p30_p70 and estimate.imag_p30_p70:
        real_p30, real_p70 = estimate.real_p30_p70
        imag_p30, imag_p70 = estimate.imag_p30_p70
        # The loss is minus the imaginary part: its lower end is at -imag_p70.
        ax.errorbar(
            *centre, color=colour, linewidth=1.2, zorder=3,
            xerr=[[max(estimate.real - real_p30, 0)], [max(real_p70 - estimate.real, 0)]],
            yerr=[[max(estimate.loss + imag_p70, 0)], [max(-imag_p30 - estimate.loss, 0)]],
        )  # fmt: skip
    ax.plot(*centre, "o", color=colour, markersize=6, markeredgecolor=INK, markeredgewidth=0.6, zorder=3)
    if truth:
        ax.plot([centre[0], truth[0]], [centre[1], truth[1]], color=MUTED, linewidth=0.8, zorder=2)
        ax.plot(*truth, "x", color=INK, markersize=6, markeredgewidth=1.5, zorder=4)


def _set_limits(ax: Axes, estimates: Sequence[PermittivityFigures], truths: Sequence[Point]) -> None:
    """Set limits around estimates, truths and ellipses; one very uncertain patch must not shrink all others."""
    centres = np.array([(e.real, e.loss) for e in estimates])
    always_shown = np.concatenate([centres, np.array(truths, float).reshape(-1, 2)])
    half_sizes = np.array([_measure_half_size(e) for e in estimates])
    low = always_shown.min(axis=0)
    high = always_shown.max(axis=0)
    span = np.maximum(high - low, _SMALLEST_SPAN)
    # Ellipses may widen the axes, up to a share of the span.
    lowest = np.maximum((centres - half_sizes).min(axis=0), low - _ELLIPSE_SHARE * span)
    highest = np.minimum((centres + half_sizes).max(axis=0), high + _ELLIPSE_SHARE * span)
    low = np.minimum(low, lowest) - _MARGIN_SHARE * span
    high = np.maximum(high, highest) + _MARGIN_SHARE * span
    ax.set_xlim(low[0], high[0])
    # A strip of negative losses always shows, as a reminder that they would be gain.
    ax.set_ylim(min(low[1], -0.1), high[1])


def _measure_half_size(estimate: PermittivityFigures) -> Point:
    """Return how far the drawing of an estimate reaches in (real part, loss): its 95 % ellipse, or its bars."""
    if estimate.spread is not None:
        radius = math.sqrt(SHARES[_OUTER_SHARE])
        return radius * estimate.spread.real_std, radius * estimate.spread.loss_std
    # Without percentiles there are no bars, and the half size is 0.
    real_ends = estimate.real_p30_p70 or (estimate.real,)
    imag_ends = estimate.imag_p30_p70 or (estimate.imag,)
    real_half_size = max(abs(end - estimate.real) for end in real_ends)
    imag_half_size = max(abs(end - estimate.imag) for end in imag_ends)
    return real_half_size, imag_half_size


def _draw_legend(fig: Figure, estimates: Sequence[Estimate], colours: dict[str, str], with_truth: bool) -> Legend:
    """Draw the legend: a line for each patch, the confidence regions, and the crosses of the truth."""
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
    legend = fig.legend(handles=handles, loc="upper right", fontsize=7.5, frameon=False)
    style_legend(legend)
    return legend


def _write_numbers(fig: Figure, ax: Axes, estimates: Sequence[Estimate], truths: Sequence[Point]) -> None:
    """Write the patches' numbers beside their points, with a line to numbers that are further away."""
    pixels_per_point = fig.dpi / 72
    values = np.array([(estimate.real, estimate.loss) for _, estimate in estimates])
    points = ax.transData.transform(values) / pixels_per_point
    crosses = ax.transData.transform(np.array(truths, float).reshape(-1, 2)) / pixels_per_point
    places = place_numbers(points, crosses)
    leader_line = {"arrowstyle": "-", "color": MUTED, "linewidth": 0.6, "shrinkA": 3, "shrinkB": 3}
    for (patch, estimate), place, point in zip(estimates, places, points, strict=True):
        offset = place - point
        arrow = None
        if np.hypot(*offset) > _LINE_FROM_PT:
            arrow = leader_line
        ax.annotate(
            str(patch.label), (estimate.real, estimate.loss), textcoords="offset points",
            xytext=(float(offset[0]), float(offset[1])), ha="center", va="center", fontsize=8, color=INK, zorder=5,
            fontweight="bold", path_effects=[withStroke(linewidth=2, foreground="white")],
            arrowprops=arrow,
        )  # fmt: skip
