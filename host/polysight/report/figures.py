"""Figures of a report and of single commands: amplitude and phase of H, V and P in millimetres, and permittivities.

Amplitude has a perceptually uniform, colour-blind safe map (cividis), phase a cyclic one (twilight). `label_figure`
shows the boxes of a label file, `focus_figure` a sweep over depth, `permittivity_figure` loss over real part:
estimates, error ellipses and the truth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.text import Text
from msgspec import UNSET

from polysight.materials import Box, axis_mm
from polysight.products import ProcessedScan
from polysight.report.style import (
    BAR_IN,
    HATCH,
    INK,
    METAL_COLOUR,
    MUTED,
    REFUSED_COLOUR,
    RIGHT_IN,
    STAMP,
    UNKNOWN_COLOUR,
    MapLabel,
    assign_colours,
    colour_bar,
    draw_outline,
    dress,
    extent_mm,
    figure_label,
    fit_labels,
    new_figure,
    patch_colour,
    patch_label,
    plate_label,
    png,
    set_margins,
    short_label,
    shorten_labels,
    style_legend,
    write_label,
)
from polysight.results import BoardQuality, PatchFigures, PermittivityFigures
from polysight_shared.raster import RasterPlan

SHARES = {0.68: 2.279, 0.95: 5.991}
"""Share of draws to the squared radius that holds it: quantiles of chi-squared with two degrees of freedom."""
_STYLES: dict[float, dict[str, Any]] = {
    0.68: {"linestyle": "-", "linewidth": 1.2},
    0.95: {"linestyle": "--", "linewidth": 0.8},
}
# Size of a patch's number and of its point in `permittivity_figure`, in points of 1/72 inch, measured on its PNG.
_LABEL_PT = (9.0, 9.0)
_POINT_PT = 5.0
# Places that `place_numbers` tries: rings around the point, and directions on each.
_RADII_PT = (11, 17, 25, 34, 45, 58)
_ANGLES = 16
Array = npt.NDArray[np.float64]
Point = tuple[float, float]
Estimate = tuple[PatchFigures, PermittivityFigures]

FIGURES: dict[str, str] = {
    "amplitude_h": "Amplitude H (s-polarised)",
    "amplitude_v": "Amplitude V (p-polarised)",
    "amplitude_p": "Amplitude of P = H / V",
    "phase_h": "Phase H",
    "phase_v": "Phase V",
    "phase_p": "Phase of P = H / V",
}
# Pixels further out than this share of a patch's box belong to its edge, where two materials mix.
_INSIDE = 0.6
# Range of the phase of P that the colours span: percentiles of the pixels, at least and at most this wide.
_PERCENTILES = (5.0, 95.0)
_LEAST_DEG = 20.0
_MAX_DEG = 300.0
# Outlines of boxes drawn by hand.
_METAL_BOX = "#ff9e3d"
_OTHER_BOX = "#ffffff"
_FOCUS_RANGE_DB = 30.0
Limits = tuple[float, float]
# Share of a map's height that a label needs.
_LABEL_HEIGHT = 0.05
# Share of a map's width between two maps: a colour bar's and an axis's numbers stand there.
_BETWEEN = 0.26
# Positions with data are light, masked ones dark, so that the map is readable without colour.
_POSITION_COLOURS = ("#dfe5ec", "#882255")


def fit_ellipse(matrix: Array, share: float) -> tuple[float, float, float]:
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
        best = point + candidates[0]
        least_cost = math.inf
        for place in point + candidates:
            labels = sum(bool((np.abs(place - other) < _LABEL_PT).all()) for other in taken)
            covered = (np.abs(solid - place) < np.array(_LABEL_PT) / 2 + _POINT_PT / 2).all(axis=1).sum()
            cost = 2.0 * labels + covered
            if cost < least_cost:
                best = place
                least_cost = cost
            if least_cost == 0:
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
    colours = assign_colours(scan)
    size_in = (7.8, max(4.4, 1.5 + 0.19 * len(estimates)))
    fig = new_figure(*size_in, RIGHT_IN)
    ax = fig.add_subplot()
    truths = [t for patch, _ in estimates if (t := _truth(patch))]
    title = "Permittivity"
    if truths:
        title += ", estimate and truth"
    dress(ax, title, scan.stamped)
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
    legend = _legend(fig, estimates, colours, bool(truths))
    set_margins(fig, legend.get_window_extent().width / fig.dpi + RIGHT_IN)
    _write_numbers(fig, ax, estimates, truths)
    return png(fig)


def _truth(patch: PatchFigures) -> Point | None:
    truth = patch.true_permittivity
    if truth is None:
        return None
    return truth.real, -truth.imag


def _draw_estimate(ax: Axes, e: PermittivityFigures, truth: Point | None, colour: str) -> None:
    centre = (e.real, e.loss)
    if e.spread is not None:
        for share, style in _STYLES.items():
            w, h, angle = fit_ellipse(e.spread.matrix, share)
            ax.add_patch(Ellipse(centre, w, h, angle=angle, facecolor="none", edgecolor=colour, zorder=2.5, **style))
            if share == min(_STYLES):
                ax.add_patch(Ellipse(centre, w, h, angle=angle, facecolor=colour, alpha=0.18, linewidth=0, zorder=2))
    elif e.real_p30_p70 and e.imag_p30_p70:
        r0, r1 = e.real_p30_p70
        i0, i1 = e.imag_p30_p70
        ax.errorbar(
            *centre, color=colour, linewidth=1.2, zorder=3,
            xerr=[[max(e.real - r0, 0)], [max(r1 - e.real, 0)]],
            yerr=[[max(e.loss + i1, 0)], [max(-i0 - e.loss, 0)]],
        )  # fmt: skip
    ax.plot(*centre, "o", color=colour, markersize=6, markeredgecolor=INK, markeredgewidth=0.6, zorder=3)
    if truth:
        ax.plot([centre[0], truth[0]], [centre[1], truth[1]], color=MUTED, linewidth=0.8, zorder=2)
        ax.plot(*truth, "x", color=INK, markersize=6, markeredgewidth=1.5, zorder=4)


def _set_limits(ax: Axes, estimates: Sequence[PermittivityFigures], truths: Sequence[Point]) -> None:
    """Set limits around estimates, truths and ellipses; one very uncertain patch must not shrink all others."""
    centres = np.array([(e.real, e.loss) for e in estimates])
    certain = np.concatenate([centres, np.array(truths, float).reshape(-1, 2)])
    half = np.array([_half_size(e) for e in estimates])
    low = certain.min(axis=0)
    high = certain.max(axis=0)
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


def _legend(fig: Figure, estimates: Sequence[Estimate], colours: dict[str, str], with_truth: bool) -> Legend:
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
    per_point = fig.dpi / 72
    values = np.array([(e.real, e.loss) for _, e in estimates])
    points = ax.transData.transform(values) / per_point
    crosses = ax.transData.transform(np.array(truths, float).reshape(-1, 2)) / per_point
    places = place_numbers(points, crosses)
    line = {"arrowstyle": "-", "color": MUTED, "linewidth": 0.6, "shrinkA": 3, "shrinkB": 3}
    for (patch, e), place, point in zip(estimates, places, points, strict=True):
        offset = place - point
        arrow = None
        if np.hypot(*offset) > _RADII_PT[0] + 1:
            arrow = line
        ax.annotate(
            str(patch.label), (e.real, e.loss), textcoords="offset points",
            xytext=(float(offset[0]), float(offset[1])), ha="center", va="center", fontsize=8, color=INK, zorder=5,
            fontweight="bold", path_effects=[withStroke(linewidth=2, foreground="white")],
            arrowprops=arrow,
        )  # fmt: skip


def _mask_invalid(scan: ProcessedScan, values: npt.NDArray) -> npt.NDArray:
    bad = ~np.isfinite(values)
    return np.ma.masked_array(values, bad | ~scan.valid)


def _db(values: npt.NDArray) -> npt.NDArray[np.float64]:
    return 20 * np.log10(np.maximum(np.nan_to_num(np.abs(values), nan=0.0, posinf=0.0), 1e-9))


def phase_limits_deg(scan: ProcessedScan) -> Limits | None:
    """Return the range of the phase of P inside the judged patches, degrees; None if it is nearly the whole circle.

    The metal reference, 0 degrees by definition, counts only if there is no other patch. The range is taken around the
    circular mean, so that values on both sides of 180 degrees lie side by side: limits may pass 180.
    """
    x = axis_mm(scan.x_m)
    y = axis_mm(scan.y_m)
    inside: list[npt.NDArray] = []
    judged_patches = [patch for patch in scan.segments if patch.refused is None and not patch.metal_reference]
    for patch in judged_patches or scan.segments:
        near_x = np.abs(x - patch.centre_x_mm) <= _INSIDE * patch.width_mm / 2
        near_y = np.abs(y - patch.centre_y_mm) <= _INSIDE * patch.height_mm / 2
        part = scan.p[np.ix_(near_y, near_x)]
        part = part[np.isfinite(part) & (part != 0)]
        if part.size:
            inside.append(part / np.abs(part))
    if not inside:
        return None
    middle = np.angle(sum(part.mean() for part in inside))
    turned = np.degrees(np.angle(np.concatenate(inside) * np.exp(-1j * middle)))
    low, high = np.percentile(turned, _PERCENTILES) + np.degrees(middle)
    margin = max(0.15 * (high - low), (_LEAST_DEG - (high - low)) / 2)
    low = float(np.floor((low - margin) / 5) * 5)
    high = float(np.ceil((high + margin) / 5) * 5)
    if high - low < _MAX_DEG:
        return low, high
    return None


def _decibels(scan: ProcessedScan) -> str:
    if not scan.metal_referenced:
        return "dB"
    return "dB (metal = 0)" if scan.judged else "dB (reference = 0)"


def draw_channel(ax: Axes, scan: ProcessedScan, key: str, phase_deg: Limits | None = None):
    """Draw one of FIGURES on an axes; return the image for a colour bar, and the bar's label.

    Phases span -180 to 180 degrees, or `phase_deg`, which may pass 180.
    """
    kind, _, channel = key.partition("_")
    data = {"h": scan.h, "v": scan.v, "p": scan.p}[channel]
    unit = _decibels(scan)
    colours = "cividis"
    fade = None
    if kind == "phase" or channel == "p":
        fade = _fade(scan)
    if kind == "phase":
        unit = "degrees"
        colours = "cividis" if phase_deg else "twilight"
        low, high = phase_deg or (-180.0, 180.0)
        middle = (low + high) / 2
        values = np.degrees(np.angle(np.where(np.isfinite(data), data, 1)))
        values = (values - middle + 180) % 360 - 180 + middle
    elif channel == "p":
        values = _db(data)
        low, high = _ratio_range_db(scan, values)
    else:
        values = _db(data)
        finite = values[np.isfinite(data) & scan.valid]
        if scan.metal_referenced:
            high = 0.0
        elif finite.size:
            high = float(np.percentile(finite, 99.8))
        else:
            high = 0.0
        low = high - 35
    image = ax.imshow(
        _mask_invalid(scan, values), extent=extent_mm(scan), origin="lower", cmap=colours, vmin=low, vmax=high,
        alpha=fade, interpolation="nearest",
    )  # fmt: skip
    return image, unit


def _ratio_range_db(scan: ProcessedScan, level: npt.NDArray) -> tuple[float, float]:
    """Return the range of |P| to show, dB: that of the patches' medians if there are any, else of the bright pixels."""
    levels = [patch.p_abs_db for patch in scan.segments]
    values = np.array([level for level in levels if level is not None])
    if values.size == 0:
        bright = level[(_fade(scan) > 0.5) & np.isfinite(level)]
        values = np.array([0.0, 20.0])
        if bright.size:
            values = np.percentile(bright, [5, 95])
    low = float(values.min())
    high = float(values.max())
    return np.floor(min(low, 0.0) - 1), max(np.ceil(high + 1), np.floor(low) + 6)


def _fade(scan: ProcessedScan) -> npt.NDArray[np.float64]:
    """Return the opacity of ratio and phase: pixels without signal are noise and fade into the background."""
    return np.clip((_strength_db(scan) + 26) / 8, 0.0, 1.0)


def _strength_db(scan: ProcessedScan) -> npt.NDArray[np.float64]:
    """Return the level of both channels together, dB, each relative to its own brightest."""
    power = np.zeros(scan.h.shape)
    for channel in (scan.h, scan.v):
        p = np.nan_to_num(np.abs(channel).astype(np.float64) ** 2, nan=0.0, posinf=0.0)
        top = float(np.percentile(p, 99.5))
        if top > 0:
            power += p / top
    return 10 * np.log10(np.maximum(power, 1e-12))


def channel_figure(scan: ProcessedScan, key: str) -> bytes:
    """Return a PNG of one of FIGURES with a colour bar. The phase of P spans the range of the patches."""
    fig = new_figure(5.0, 4.6, BAR_IN)
    ax = fig.add_subplot()
    limits = phase_limits_deg(scan) if key == "phase_p" else None
    image, unit = draw_channel(ax, scan, key, limits)
    dress(ax, FIGURES[key], scan.stamped)
    if key.endswith("_p"):
        _write_ratios(ax, scan, key)
    if limits is None:
        bar = colour_bar(fig, ax, image, unit)
        if unit == "degrees":
            bar.set_ticks([-180, -90, 0, 90, 180])
    else:
        bar = colour_bar(fig, ax, image, unit, extend="both")
        ticks = [t for t in bar.get_ticks() if limits[0] <= t <= limits[1]]
        bar.set_ticks(ticks, labels=[_wrap_degrees(t) for t in ticks])
    return png(fig)


def _wrap_degrees(angle: float) -> str:
    """Format a phase between -180 and 180 degrees; both ends of the circle are 180."""
    if abs(angle) == 180:
        return "180"
    return f"{(angle + 180) % 360 - 180:g}"


def _write_ratios(ax: Axes, scan: ProcessedScan, key: str) -> None:
    """Write each patch's median as a number: small differences do not show as colours."""
    for patch in scan.segments:
        if patch.p_phase_deg is not None and patch.p_abs_db is not None:
            if key == "phase_p":
                number = f"{round(patch.p_phase_deg)}°"
            else:
                # Adding zero after rounding removes the sign of a negative zero.
                number = f"{round(patch.p_abs_db, 1) + 0.0:.1f}"
            write_label(ax, patch.centre_x_mm, patch.centre_y_mm, number, 9, on_dark=True)


def draw_materials(ax: Axes, scan: ProcessedScan, size: float = 7.5) -> list[MapLabel]:
    """Draw the material map: each patch in the colour of its name, each interior pixel in that of its own name.

    Patches that were not judged are hatched grey. Return the labels.
    """
    colours = assign_colours(scan)
    rgb = np.ones((*scan.h.shape, 3)) * np.array(to_rgb("#f3f5f8"))
    for patch in scan.segments:
        rgb[scan.labels == patch.label] = 0.55 + 0.45 * np.array(to_rgb(patch_colour(patch, colours)))
    refused = {patch.label for patch in scan.segments if patch.refused is not None}
    for label, (names, interior) in scan.pixel_names.items():
        if label not in refused:
            rgb[interior] = [to_rgb(colours.get(str(n), UNKNOWN_COLOUR)) for n in names]
    ax.imshow(rgb, extent=extent_mm(scan), origin="lower", interpolation="nearest")
    _crop(ax, scan)
    labels = []
    for patch in scan.segments:
        _, y0, _, y1 = patch.box_mm
        if patch.refused is not None:
            ax.add_patch(draw_outline(patch, fill=False, edgecolor=REFUSED_COLOUR, hatch=HATCH, linewidth=0.0))
        if patch.outline_mm or patch.refused is not None:
            ax.add_patch(draw_outline(patch, fill=False, edgecolor=INK, linewidth=0.9))
        name = patch_label(patch)
        within = ""
        if patch.refused is not None:
            within = "not judged"
        elif patch.confidence is not None:
            within = f"{100 * patch.confidence:.0f} %"
        text = write_label(ax, patch.centre_x_mm, y1 + 0.5, name, size, above=True)
        _keep_inside(ax, text, y1)
        # Two lines above the patch would reach the next one.
        write_label(ax, patch.centre_x_mm, y0 + 1.0, within, size, above=True)
        labels.append(MapLabel(text, str(patch.label), name, patch_colour(patch, colours)))
    return labels


def _keep_inside(ax: Axes, text: Text, top_mm: float) -> None:
    """Put a label below the upper edge of its patch if it would reach into the title."""
    bottom, top = ax.get_ylim()
    if top_mm > top - _LABEL_HEIGHT * (top - bottom):
        text.set(y=min(top_mm, top) - 1.0, verticalalignment="top")


def _crop(ax: Axes, scan: ProcessedScan) -> None:
    """Set limits around patches and plates: square, inside the image, the same for map and truth."""
    boxes = [patch.box_mm for patch in scan.segments] + [plate.box_mm for plate in scan.plates]
    left, right, bottom, top = extent_mm(scan)
    if boxes:
        b = np.array(boxes)
        x0 = b[:, 0].min() - 20
        y0 = b[:, 1].min() - 12
        x1 = b[:, 2].max() + 20
        y1 = b[:, 3].max() + 24
        half = max(x1 - x0, y1 - y0) / 2
        cx = (x0 + x1) / 2
        cy = (y0 + y1) / 2
        left = max(left, cx - half)
        right = min(right, cx + half)
        bottom = max(bottom, cy - half)
        top = min(top, cy + half)
    ax.set_xlim(left, right)
    ax.set_ylim(bottom, top)


def draw_truth(ax: Axes, scan: ProcessedScan, size: float = 7.5) -> list[MapLabel]:
    """Draw the true plates. Return the labels."""
    colours = assign_colours(scan)
    _crop(ax, scan)
    left, right = ax.get_xlim()
    bottom, top = ax.get_ylim()
    labels = []
    for number, plate in enumerate(scan.plates, 1):
        x0, y0, x1, y1 = plate.box_mm
        name = plate_label(plate, number)
        colour = colours[plate.name]
        ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, facecolor=colour, edgecolor=INK, linewidth=0.9))
        if y1 < top:
            text = write_label(ax, (x0 + x1) / 2, y1 + 0.5, name, size, above=True)
            _keep_inside(ax, text, y1)
        else:
            # The plate is larger than the image: a name above it would be far outside the picture.
            text = write_label(ax, (max(x0, left) + min(x1, right)) / 2, (max(y0, bottom) + top) / 2, name, size)
        labels.append(MapLabel(text, str(number), name, colour))
    return labels


def map_figure(scan: ProcessedScan, draw: Callable[[Axes, ProcessedScan], list[MapLabel]], title: str) -> bytes:
    """Return a PNG of a material map or of the truth. If names lack room all become numbers, with a legend below."""
    fig = new_figure(4.6, 4.6, RIGHT_IN)
    ax = fig.add_subplot()
    labels = draw(ax, scan)
    dress(ax, title, scan.stamped)
    ax.set_facecolor("#f3f5f8")
    fit_labels(fig, labels, RIGHT_IN)
    return png(fig)


def permittivity_map(scan: ProcessedScan) -> bytes | None:
    """Return a PNG of eps' with its standard error in each patch, and of the relative error; None without errors."""
    real: dict[int, float] = {}
    errors: dict[int, float] = {}
    middle: dict[int, str] = {}
    for patch in scan.segments:
        e = patch.permittivity
        if e is not None and e.spread is not None:
            real[patch.label] = e.real
            size = abs(e.value)
            if size:
                errors[patch.label] = 100 * math.hypot(e.spread.real_std, e.spread.loss_std) / size
            else:
                errors[patch.label] = 0.0
            middle[patch.label] = f"{e.real:.2f}\n± {e.spread.real_std:.2f}"
    if not real:
        return None
    fig = new_figure(9.4, 4.6, BAR_IN)
    percents = {label: _format_percent(error) for label, error in errors.items()}
    low = min(real.values())
    high = max(real.values())
    margin = max(0.1 * (high - low), 0.25)
    value_axes, error_axes = fig.subplots(1, 2, gridspec_kw={"wspace": _BETWEEN})
    _fill_patches(fig, value_axes, scan, real, middle, ("viridis", low - margin, high + margin, "real part ε′"))
    _fill_patches(
        fig, error_axes, scan, errors, percents, ("YlOrBr", 0.0, max(*errors.values(), 5.0), "percent of |ε|")
    )
    dress(value_axes, "Permittivity ε′ ± standard error", simulated=False)
    dress(error_axes, "Relative error of ε", scan.stamped)
    for ax in (value_axes, error_axes):
        ax.set_facecolor("#f3f5f8")
    error_axes.set_ylabel("")
    return png(fig)


def _format_percent(value: float) -> str:
    if value >= 10:
        return f"{value:.0f} %"
    return f"{value:.1f} %"


def _fill_patches(
    fig: Figure,
    ax: Axes,
    scan: ProcessedScan,
    values: dict[int, float],
    texts: dict[int, str],
    scale: tuple[str, float, float, str],
) -> None:
    """Fill patches in the colours of their values; others are grey, hatched if they were not judged.

    `scale` is the colour map, the values at its ends, and the colour bar's label.
    """
    colours = ScalarMappable(Normalize(scale[1], scale[2]), scale[0])
    for patch in scan.segments:
        fill: Any = METAL_COLOUR if patch.metal_reference else "#e4e7ec"
        if patch.label in values:
            fill = colours.to_rgba(np.array([values[patch.label]]))[0]
        ax.add_patch(draw_outline(patch, facecolor=fill, edgecolor=INK, linewidth=0.9))
        text = "–"
        if patch.refused is not None:
            ax.add_patch(draw_outline(patch, fill=False, edgecolor=REFUSED_COLOUR, hatch=HATCH, linewidth=0.0))
            text = "not\njudged"
        if patch.metal_reference or patch.metal_like:
            text = "metal"
        write_label(ax, patch.centre_x_mm, patch.centre_y_mm, texts.get(patch.label, text), 8)
        ax.annotate(
            str(patch.label), (patch.box_mm[0], patch.box_mm[3]), textcoords="offset points", xytext=(2.5, -2),
            ha="left", va="top", fontsize=6.5, color=INK, path_effects=[withStroke(linewidth=2, foreground="white")],
        )  # fmt: skip
    _crop(ax, scan)
    ax.set_aspect("equal")
    colour_bar(fig, ax, colours, scale[3])


def masked_positions(scan: ProcessedScan) -> dict[str, npt.NDArray[np.bool_]]:
    """Return for each board bool [row, column]: masked or never recorded. Empty if plan or boards are not known."""
    if scan.plan is None:
        return {}
    boards = scan.quality.boards
    return {name: _mask(board, scan.plan) for name, board in boards.items() if board.masked_columns is not UNSET}


def _mask(board: BoardQuality, plan: RasterPlan) -> npt.NDArray[np.bool_]:
    mask = np.zeros((plan.rows, plan.columns), np.bool_)
    for row, runs in (board.masked_columns or {}).items():
        for start, stop in runs:
            mask[row, start:stop] = True
    if board.rows_recorded is UNSET:
        recorded = range(plan.rows)
    else:
        recorded = board.rows_recorded
    absent = sorted(set(range(plan.rows)) - set(recorded))
    mask[absent] = True
    return mask


def coverage_figure(scan: ProcessedScan, masks: dict[str, npt.NDArray[np.bool_]]) -> Figure:
    """Return a map of masked stage positions for each board, millimetres from the middle of the grid.

    `masks` as of :func:`masked_positions`; the scan's plan must be known.
    """
    plan = scan.plan
    if plan is None:
        raise ValueError("a map of positions needs the plan")
    width = plan.columns * plan.step_x_mm
    height = plan.rows * plan.step_y_mm
    extent = (-width / 2, width / 2, -height / 2, height / 2)
    size = (9.0, 0.9 + 4.2 * min(1.2, max(0.3, height / width)))
    fig = Figure(figsize=size, dpi=130, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    for ax, (name, mask) in zip(fig.subplots(1, len(masks), squeeze=False)[0], masks.items(), strict=True):
        colours = ListedColormap(_POSITION_COLOURS)
        ax.imshow(mask, origin="lower", extent=extent, cmap=colours, vmin=0, vmax=1, interpolation="nearest")
        dress(ax, f"{name}: {mask.mean():.2%} masked", scan.stamped)
        ax.set_xlabel("stage offset x (mm)", fontsize=9, color=MUTED)
        ax.set_ylabel("stage offset y (mm)", fontsize=9, color=MUTED)
    return fig


def draw_overview(fig: Figure, axes: Sequence[Axes], scan: ProcessedScan, bar_labels: bool = False) -> None:
    """Draw amplitude H, V, P with colour bars on the first three axes, and the materials on the fourth if given."""
    for ax, key, title in zip(
        axes[:3],
        ("amplitude_h", "amplitude_v", "amplitude_p"),
        ("H, s-polarised (dB)", "V, p-polarised (dB)", "P = H / V (dB)"),
        strict=True,
    ):
        image, unit = draw_channel(ax, scan, key)
        dress(ax, title, scan.stamped)
        label = ""
        if bar_labels:
            label = unit
        colour_bar(fig, ax, image, label)
    labels = []
    for ax in axes[3:]:
        labels += draw_materials(ax, scan, size=6.5)
        dress(ax, _map_title(scan), scan.stamped)
    shorten_labels(fig, labels)


def _map_title(scan: ProcessedScan) -> str:
    """Return "Materials", or "Patches" where nothing was named."""
    if scan.judged:
        return "Materials"
    return "Patches"


def figures(scan: ProcessedScan) -> dict[str, bytes]:
    """Return all figures of a report as PNG, by file name without suffix."""
    out = {key: channel_figure(scan, key) for key in FIGURES}
    if scan.segments:
        out["materials"] = map_figure(scan, draw_materials, f"{_map_title(scan)} found")
        permittivities = {"permittivity": permittivity_figure(scan), "permittivity_map": permittivity_map(scan)}
        out |= {name: picture for name, picture in permittivities.items() if picture is not None}
    masks = masked_positions(scan)
    if any(m.any() for m in masks.values()):
        out["coverage"] = png(coverage_figure(scan, masks))
    if scan.plates:
        out["truth"] = map_figure(scan, draw_truth, "Truth")
    return out


def label_figure(scan: ProcessedScan, boxes_mm: Mapping[str, Box], metal: str | None) -> bytes:
    """Return a PNG of |H| with boxes and their names; the metal reference has another colour.

    Parameters
    ----------
    scan
        The processed scan.
    boxes_mm
        Name to (x0, y0, x1, y1), millimetres from the image centre.
    metal
        Name of the metal reference; None without one.
    """
    fig = new_figure(5.4, 4.8, BAR_IN)
    ax = fig.add_subplot()
    image, unit = draw_channel(ax, scan, "amplitude_h")
    labels = []
    for number, (name, (x0, y0, x1, y1)) in enumerate(boxes_mm.items(), 1):
        text = figure_label(name, f"box {number}")
        written = text
        colour = _OTHER_BOX
        below = ""
        if name == metal:
            colour = _METAL_BOX
            below = "metal"
            written = f"{text}\nmetal"
        for edge, width in (("#10141b", 3.0), (colour, 1.5)):
            ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=edge, linewidth=width))
        middle = write_label(ax, (x0 + x1) / 2, (y0 + y1) / 2, written, 8.5, on_dark=True)
        labels.append(MapLabel(middle, str(number), text, colour, below))
    dress(ax, "Amplitude H, and the boxes", scan.stamped)
    colour_bar(fig, ax, image, unit)
    fit_labels(fig, labels, BAR_IN)
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
    title = "No clear maximum"
    if sweep["certain"]:
        title = f"Tilt found: {tilt[0]:+.2f}° in x, {tilt[1]:+.2f}° in y"
    curve.set_title(title, loc="left", fontsize=10, color=INK)
    curve.legend(fontsize=8, frameon=False)
    top = max(float(np.abs(before).max()), float(np.abs(after).max()), 1e-30)
    x = axis_mm(x_m)
    y = axis_mm(y_m)
    for ax, image, title in zip(
        pictures, (before, after), ("H on the rig file's plane", "H on the found plane"), strict=True
    ):
        level = 20 * np.log10(np.maximum(np.abs(image) / top, 1e-6))
        mesh = ax.pcolormesh(
            x, y, level, cmap="cividis", vmin=-_FOCUS_RANGE_DB, vmax=0, shading="nearest", rasterized=True
        )
        ax.set_title(title, loc="left", fontsize=10, color=INK)
        ax.set_aspect("equal")
        ax.set_xlabel("x (mm)", fontsize=9, color=MUTED)
        colour_bar(fig, ax, mesh, "dB")
    if simulated:
        fig.suptitle("SIMULATED", fontsize=9, color=STAMP, fontweight="bold", x=0.99, ha="right")
    return png(fig)
