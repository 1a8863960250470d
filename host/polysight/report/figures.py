"""Figures of a report and of single commands: amplitude and phase of H, V and P in millimetres, and permittivities.

The colour map of amplitudes is perceptually uniform and safe for colour-blind readers (cividis), that of phases is
cyclic (twilight). The phase of P has cividis if its colours span only a part of the circle. *Patches*
(`ProcessedScan.segments`) are the regions that the processing found, *plates* the true ones of a simulated scan.
`label_figure` shows the boxes of a label file, `draw_focus_figure` a sweep over depth, `surface_figure` surfaces from
three sides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.text import Text
from msgspec import UNSET

from polysight.materials import Box, axis_mm
from polysight.products import Limits, ProcessedScan, map_scan
from polysight.report import style
from polysight.report.permittivity_plot import draw_permittivity_figure
from polysight.results import BoardQuality
from polysight.surfaces import Segment, Surface, describe_form, describe_material
from polysight_shared.raster import RasterPlan

# Axis of the points along which the rig looks.
DEPTH_AXIS = 2
# Axis numbers of a view (horizontal, vertical), its title, and the names of the axes.
VIEWS = (
    ((0, 1), "From the rig", ("x (mm)", "y (mm)")),
    ((2, 1), "From the side", ("z (mm), away from the rig", "y (mm)")),
    ((0, 2), "From above", ("x (mm)", "z (mm), away from the rig")),
)
# Number of normals that are drawn in a view of a surface; chosen. There may be up to twice as many, because every k-th
# point has one; more would hide the points.
NORMALS_SHOWN = 60
# Length of a drawn normal; chosen.
NORMAL_MM = 12.0
# Largest number of segments that are described below a surface; chosen.
MAX_LINES = 8
# Colour of points without a permittivity.
NO_PERMITTIVITY = "#9aa3ad"

FIGURES: dict[str, str] = {
    "amplitude_h": "Amplitude H (s-polarised)",
    "amplitude_v": "Amplitude V (p-polarised)",
    "amplitude_p": "Amplitude of P = H / V",
    "phase_h": "Phase H",
    "phase_v": "Phase V",
    "phase_p": "Phase of P = H / V",
}
# The inner part of a patch's box, as a share of its width and of its height; chosen. Pixels further out are at its
# edge, where two materials mix.
_INSIDE_SHARE = 0.6
# The colours of the phase of P span these percentiles of the pixels' phases; chosen.
_PERCENTILES = (5.0, 95.0)
# The colours of the phase of P span at least this range; chosen.
_LEAST_DEG = 20.0
# A range of the phase of P that is wider than this counts as the whole circle; chosen.
_MAX_DEG = 300.0
# Outlines of boxes drawn by hand.
_METAL_BOX = "#ff9e3d"
_OTHER_BOX = "#ffffff"
# Range of levels below the peak that the images of `focus` show; chosen.
_FOCUS_RANGE_DB = 30.0
# Room on both sides of patches and plates, below them, and above them, where their names are written; chosen by eye.
_SIDE_ROOM_MM = 20
_LOWER_ROOM_MM = 12
_UPPER_ROOM_MM = 24
# Share of a map's height that a label needs; chosen by eye.
_LABEL_HEIGHT = 0.05
# Gap between two maps, as a share of a map's width: the numbers of a colour bar and of an axis are written there.
_GAP_SHARE = 0.26
# Positions with data are light, masked ones dark, so that the map is readable without colour.
_POSITION_COLOURS = ("#dfe5ec", "#882255")


def find_phase_limits_deg(scan: ProcessedScan) -> Limits | None:
    """Return the range of the phase of P inside the judged patches, degrees.

    None if it is nearly the whole circle, or if there are no pixels of patches. The metal reference, whose phase is 0
    by definition, is left out; if no other patch was judged, all patches are used. The range lies around the circular
    mean, so that values on both sides of 180 degrees are next to each other: a limit may be beyond 180.
    """
    inner_pixels: list[npt.NDArray] = []
    judged_patches = [patch for patch in scan.segments if patch.refused is None and not patch.metal_reference]
    for patch in judged_patches or scan.segments:
        near_x = np.abs(scan.x_mm - patch.centre_x_mm) <= _INSIDE_SHARE * patch.width_mm / 2
        near_y = np.abs(scan.y_mm - patch.centre_y_mm) <= _INSIDE_SHARE * patch.height_mm / 2
        patch_p = scan.p[np.ix_(near_y, near_x)]
        patch_p = patch_p[np.isfinite(patch_p) & (patch_p != 0)]
        if patch_p.size:
            inner_pixels.append(patch_p / np.abs(patch_p))
    if not inner_pixels:
        return None
    # Every patch has the same weight, whatever its size.
    middle = np.angle(sum(patch_p.mean() for patch_p in inner_pixels))
    deviations_deg = np.degrees(np.angle(np.concatenate(inner_pixels) * np.exp(-1j * middle)))
    low, high = np.percentile(deviations_deg, _PERCENTILES) + np.degrees(middle)
    # Room of 15 % on either side, and limits in steps of 5 degrees: chosen for readable numbers at the colour bar.
    margin = max(0.15 * (high - low), (_LEAST_DEG - (high - low)) / 2)
    low = float(np.floor((low - margin) / 5) * 5)
    high = float(np.ceil((high + margin) / 5) * 5)
    if high - low < _MAX_DEG:
        return low, high
    return None


def _name_amplitude_unit(scan: ProcessedScan) -> str:
    """Return the unit of amplitudes, which says what 0 dB is: the metal or, without a result, the reference.

    If the verdict is "no result" (`judged` is false), the reference may not be metal. Without a reference 0 dB means
    nothing.
    """
    if not scan.metal_referenced:
        return "dB"
    return "dB (metal = 0)" if scan.judged else "dB (reference = 0)"


def draw_channel(ax: Axes, scan: ProcessedScan, key: str, phase_deg: Limits | None = None):
    """Draw one of FIGURES on an axes; return the image for a colour bar, and the bar's label.

    Phases span -180 to 180 degrees, or `phase_deg`, which may pass 180.
    """
    quantity, _, channel = key.partition("_")
    values = map_scan(scan, channel, quantity)
    numbers = values.numbers
    limits = values.limits
    unit = _name_amplitude_unit(scan)
    colours = "cividis"
    if quantity == "phase":
        unit = "degrees"
        colours = "cividis" if phase_deg else "twilight"
    if quantity == "phase" and phase_deg is not None:
        limits = phase_deg
        # Add whole circles to each phase, so that it is within 180 degrees of the middle of the limits.
        middle = sum(phase_deg) / 2
        numbers = (numbers - middle + 180) % 360 - 180 + middle
    image = ax.imshow(
        numbers, extent=scan.extent_mm, origin="lower", cmap=colours, vmin=limits[0], vmax=limits[1],
        alpha=values.opacity, interpolation="nearest",
    )  # fmt: skip
    return image, unit


def draw_channel_figure(scan: ProcessedScan, key: str) -> bytes:
    """Return a PNG of one of FIGURES with a colour bar. The phase of P spans the range of the patches."""
    fig = style.make_figure(5.0, 4.6, style.BAR_IN)
    ax = fig.add_subplot()
    limits = find_phase_limits_deg(scan) if key == "phase_p" else None
    image, unit = draw_channel(ax, scan, key, limits)
    style.style_axes(ax, FIGURES[key], scan.stamped)
    if key.endswith("_p"):
        _write_ratios(ax, scan, key)
    if limits is None:
        bar = style.colour_bar(fig, ax, image, unit)
        if unit == "degrees":
            bar.set_ticks([-180, -90, 0, 90, 180])
    else:
        bar = style.colour_bar(fig, ax, image, unit, extend="both")
        ticks = [t for t in bar.get_ticks() if limits[0] <= t <= limits[1]]
        bar.set_ticks(ticks, labels=[_wrap_degrees(t) for t in ticks])
    return style.encode_png(fig)


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
            style.write_label(ax, patch.centre_x_mm, patch.centre_y_mm, number, 9, on_dark=True)


def draw_materials(ax: Axes, scan: ProcessedScan, size: float = 7.5) -> list[style.MapLabel]:
    """Draw the material map: each patch in the colour of its name, each interior pixel in that of its own name.

    Patches that were not judged are hatched grey. Return the labels.
    """
    colours = style.assign_colours(scan)
    rgb = np.ones((*scan.h.shape, 3)) * np.array(to_rgb("#f3f5f8"))
    for patch in scan.segments:
        # Pale, so that the interior's pixels stand out.
        rgb[scan.labels == patch.label] = 0.55 + 0.45 * np.array(to_rgb(style.patch_colour(patch, colours)))
    refused = {patch.label for patch in scan.segments if patch.refused is not None}
    for label, (names, interior) in scan.pixel_names.items():
        if label not in refused:
            rgb[interior] = [to_rgb(colours.get(str(n), style.UNKNOWN_COLOUR)) for n in names]
    ax.imshow(rgb, extent=scan.extent_mm, origin="lower", interpolation="nearest")
    _crop_to_plates(ax, scan)
    labels = []
    for patch in scan.segments:
        _, y0, _, y1 = patch.box_mm
        if patch.refused is not None:
            ax.add_patch(
                style.make_outline(patch, fill=False, edgecolor=style.REFUSED_COLOUR, hatch=style.HATCH, linewidth=0.0)
            )
        # Results may lack the outline. Then a judged patch is shown only by its pixels, and another one by its box.
        if patch.outline_mm or patch.refused is not None:
            ax.add_patch(style.make_outline(patch, fill=False, edgecolor=style.INK, linewidth=0.9))
        name = style.patch_label(patch)
        second_line = ""
        if patch.refused is not None:
            second_line = "not judged"
        elif patch.confidence is not None:
            second_line = f"{100 * patch.confidence:.0f} %"
        text = style.write_label(ax, patch.centre_x_mm, y1 + 0.5, name, size, above=True)
        _keep_inside(ax, text, y1)
        # The second line is written inside the patch: two lines above it would reach the next patch.
        style.write_label(ax, patch.centre_x_mm, y0 + 1.0, second_line, size, above=True)
        labels.append(style.MapLabel(text, str(patch.label), name, style.patch_colour(patch, colours)))
    return labels


def _keep_inside(ax: Axes, text: Text, top_mm: float) -> None:
    """Put a label below the upper edge of its patch if it would reach into the title."""
    bottom, top = ax.get_ylim()
    if top_mm > top - _LABEL_HEIGHT * (top - bottom):
        text.set(y=min(top_mm, top) - 1.0, verticalalignment="top")


def _crop_to_plates(ax: Axes, scan: ProcessedScan) -> None:
    """Set limits around patches and plates, the same for map and truth: a square if the image is large enough."""
    boxes = [patch.box_mm for patch in scan.segments] + [plate.box_mm for plate in scan.plates]
    left, right, bottom, top = scan.extent_mm
    if boxes:
        corners = np.array(boxes)
        x0 = corners[:, 0].min() - _SIDE_ROOM_MM
        y0 = corners[:, 1].min() - _LOWER_ROOM_MM
        x1 = corners[:, 2].max() + _SIDE_ROOM_MM
        y1 = corners[:, 3].max() + _UPPER_ROOM_MM
        half = max(x1 - x0, y1 - y0) / 2
        cx = (x0 + x1) / 2
        cy = (y0 + y1) / 2
        left = max(left, cx - half)
        right = min(right, cx + half)
        bottom = max(bottom, cy - half)
        top = min(top, cy + half)
    ax.set_xlim(left, right)
    ax.set_ylim(bottom, top)


def draw_truth(ax: Axes, scan: ProcessedScan, size: float = 7.5) -> list[style.MapLabel]:
    """Draw the true plates. Return the labels."""
    colours = style.assign_colours(scan)
    _crop_to_plates(ax, scan)
    left, right = ax.get_xlim()
    bottom, top = ax.get_ylim()
    labels = []
    for number, plate in enumerate(scan.plates, 1):
        x0, y0, x1, y1 = plate.box_mm
        name = style.plate_label(plate, number)
        colour = colours[plate.name]
        ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, facecolor=colour, edgecolor=style.INK, linewidth=0.9))
        if y1 < top:
            text = style.write_label(ax, (x0 + x1) / 2, y1 + 0.5, name, size, above=True)
            _keep_inside(ax, text, y1)
        else:
            # The plate reaches beyond the image's upper edge: a name above it would be far outside the picture.
            text = style.write_label(ax, (max(x0, left) + min(x1, right)) / 2, (max(y0, bottom) + top) / 2, name, size)
        labels.append(style.MapLabel(text, str(number), name, colour))
    return labels


def draw_map_figure(
    scan: ProcessedScan, draw: Callable[[Axes, ProcessedScan], list[style.MapLabel]], title: str
) -> bytes:
    """Return a PNG of a material map or of the truth.

    If names do not fit, all of them are replaced by numbers, with a legend below.
    """
    fig = style.make_figure(4.6, 4.6, style.RIGHT_IN)
    ax = fig.add_subplot()
    labels = draw(ax, scan)
    style.style_axes(ax, title, scan.stamped)
    ax.set_facecolor("#f3f5f8")
    style.fit_labels(fig, labels, style.RIGHT_IN)
    return style.encode_png(fig)


def draw_permittivity_map(scan: ProcessedScan) -> bytes | None:
    """Return a PNG of eps' with its standard error in each patch, and of the relative error; None without errors.

    The relative error is the root of the sum of both parts' variances, over |eps|, in percent.
    """
    real: dict[int, float] = {}
    errors: dict[int, float] = {}
    texts: dict[int, str] = {}
    for patch in scan.segments:
        estimate = patch.permittivity
        if estimate is not None and estimate.spread is not None:
            real[patch.label] = estimate.real
            size = abs(estimate.value)
            if size:
                errors[patch.label] = 100 * math.hypot(estimate.spread.real_std, estimate.spread.loss_std) / size
            else:
                errors[patch.label] = 0.0
            texts[patch.label] = f"{estimate.real:.2f}\n± {estimate.spread.real_std:.2f}"
    if not real:
        return None
    fig = style.make_figure(9.4, 4.6, style.BAR_IN)
    percents = {label: _format_percent(error) for label, error in errors.items()}
    low = min(real.values())
    high = max(real.values())
    margin = max(0.1 * (high - low), 0.25)
    value_axes, error_axes = fig.subplots(1, 2, gridspec_kw={"wspace": _GAP_SHARE})
    _fill_patches(fig, value_axes, scan, real, texts, ("viridis", low - margin, high + margin, "real part ε′"))
    _fill_patches(
        fig, error_axes, scan, errors, percents, ("YlOrBr", 0.0, max(*errors.values(), 5.0), "percent of |ε|")
    )
    # SIMULATED is written once, above the right map.
    style.style_axes(value_axes, "Permittivity ε′ ± standard error", simulated=False)
    style.style_axes(error_axes, "Relative error of ε", scan.stamped)
    for ax in (value_axes, error_axes):
        ax.set_facecolor("#f3f5f8")
    error_axes.set_ylabel("")
    return style.encode_png(fig)


def _format_percent(value: float) -> str:
    """Return a percentage with one digit after the point below 10."""
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
    """Fill patches in the colours of their values, and write their `texts` into them and their numbers at a corner.

    Without a value the metal reference has the colour of metal and other patches are grey, hatched if they were not
    judged; without a text "metal", "not judged" or a dash is written.

    `scale` is the colour map, the values at its ends, and the colour bar's label.
    """
    colour_map, low, high, bar_label = scale
    colours = ScalarMappable(Normalize(low, high), colour_map)
    for patch in scan.segments:
        fill: Any = style.METAL_COLOUR if patch.metal_reference else "#e4e7ec"
        if patch.label in values:
            fill = colours.to_rgba(np.array([values[patch.label]]))[0]
        ax.add_patch(style.make_outline(patch, facecolor=fill, edgecolor=style.INK, linewidth=0.9))
        text = "–"
        if patch.refused is not None:
            ax.add_patch(
                style.make_outline(patch, fill=False, edgecolor=style.REFUSED_COLOUR, hatch=style.HATCH, linewidth=0.0)
            )
            text = "not\njudged"
        if patch.metal_reference or patch.metal_like:
            text = "metal"
        style.write_label(ax, patch.centre_x_mm, patch.centre_y_mm, texts.get(patch.label, text), 8)
        ax.annotate(
            str(patch.label), (patch.box_mm[0], patch.box_mm[3]), textcoords="offset points", xytext=(2.5, -2),
            ha="left", va="top", fontsize=6.5, color=style.INK,
            path_effects=[withStroke(linewidth=2, foreground="white")],
        )  # fmt: skip
    _crop_to_plates(ax, scan)
    ax.set_aspect("equal")
    style.colour_bar(fig, ax, colours, bar_label)


def find_masked_positions(scan: ProcessedScan) -> dict[str, npt.NDArray[np.bool_]]:
    """Return for each board bool [row, column]: masked or never recorded. Empty if plan or boards are not known."""
    if scan.plan is None:
        return {}
    boards = scan.quality.boards
    return {name: _mask(board, scan.plan) for name, board in boards.items() if board.masked_columns is not UNSET}


def _mask(board: BoardQuality, plan: RasterPlan) -> npt.NDArray[np.bool_]:
    """Return the masked positions of a board, bool [row, column], including those of rows that were not recorded."""
    mask = np.zeros((plan.rows, plan.columns), np.bool_)
    for row, runs in (board.masked_columns or {}).items():
        for start, stop in runs:
            mask[row, start:stop] = True
    recorded = range(plan.rows) if board.rows_recorded is UNSET else board.rows_recorded
    absent = sorted(set(range(plan.rows)) - set(recorded))
    mask[absent] = True
    return mask


def draw_coverage_figure(scan: ProcessedScan, masks: dict[str, npt.NDArray[np.bool_]]) -> Figure:
    """Return a map of masked stage positions for each board, millimetres from the middle of the grid.

    `masks` as of :func:`find_masked_positions`; the scan's plan must be known.
    """
    plan = scan.plan
    if plan is None:
        raise ValueError("a map of positions needs the plan")
    width = plan.columns * plan.step_x_mm
    height = plan.rows * plan.step_y_mm
    extent = (-width / 2, width / 2, -height / 2, height / 2)
    size = (9.0, 0.9 + 4.2 * min(1.2, max(0.3, height / width)))
    fig = Figure(figsize=size, dpi=130, layout="constrained", facecolor="white")
    for ax, (name, mask) in zip(fig.subplots(1, len(masks), squeeze=False)[0], masks.items(), strict=True):
        colours = ListedColormap(_POSITION_COLOURS)
        ax.imshow(mask, origin="lower", extent=extent, cmap=colours, vmin=0, vmax=1, interpolation="nearest")
        style.style_axes(ax, f"{name}: {mask.mean():.2%} masked", scan.stamped)
        ax.set_xlabel("stage offset x (mm)", fontsize=9, color=style.MUTED)
        ax.set_ylabel("stage offset y (mm)", fontsize=9, color=style.MUTED)
    return fig


def draw_overview(fig: Figure, axes: Sequence[Axes], scan: ProcessedScan, bar_labels: bool = False) -> None:
    """Draw amplitude H, V, P with colour bars on the first three axes, and the materials on the fourth if given.

    With `bar_labels` the unit is written at the colour bars.
    """
    for ax, key, title in zip(
        axes[:3],
        ("amplitude_h", "amplitude_v", "amplitude_p"),
        ("H, s-polarised (dB)", "V, p-polarised (dB)", "P = H / V (dB)"),
        strict=True,
    ):
        image, unit = draw_channel(ax, scan, key)
        style.style_axes(ax, title, scan.stamped)
        style.colour_bar(fig, ax, image, unit if bar_labels else "")
    labels = []
    for ax in axes[3:]:
        labels += draw_materials(ax, scan, size=6.5)
        style.style_axes(ax, _map_title(scan), scan.stamped)
    style.shorten_labels(fig, labels)


def _map_title(scan: ProcessedScan) -> str:
    """Return "Materials", or "Patches" where nothing was named."""
    if scan.judged:
        return "Materials"
    return "Patches"


def draw_figures(scan: ProcessedScan) -> dict[str, bytes]:
    """Return all figures of a report as PNG, by file name without suffix."""
    out = {key: draw_channel_figure(scan, key) for key in FIGURES}
    if scan.segments:
        out["materials"] = draw_map_figure(scan, draw_materials, f"{_map_title(scan)} found")
        permittivities = {
            "permittivity": draw_permittivity_figure(scan),
            "permittivity_map": draw_permittivity_map(scan),
        }
        out |= {name: picture for name, picture in permittivities.items() if picture is not None}
    masks = find_masked_positions(scan)
    if any(m.any() for m in masks.values()):
        out["coverage"] = style.encode_png(draw_coverage_figure(scan, masks))
    if scan.plates:
        out["truth"] = draw_map_figure(scan, draw_truth, "Truth")
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
    fig = style.make_figure(5.4, 4.8, style.BAR_IN)
    ax = fig.add_subplot()
    image, unit = draw_channel(ax, scan, "amplitude_h")
    labels = []
    for number, (name, (x0, y0, x1, y1)) in enumerate(boxes_mm.items(), 1):
        text = style.figure_label(name, f"box {number}")
        written = text
        colour = _OTHER_BOX
        below = ""
        if name == metal:
            colour = _METAL_BOX
            below = "metal"
            written = f"{text}\nmetal"
        for edge, width in (("#10141b", 3.0), (colour, 1.5)):
            ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=edge, linewidth=width))
        middle = style.write_label(ax, (x0 + x1) / 2, (y0 + y1) / 2, written, 8.5, on_dark=True)
        labels.append(style.MapLabel(middle, str(number), text, colour, below))
    style.style_axes(ax, "Amplitude H, and the boxes", scan.stamped)
    style.colour_bar(fig, ax, image, unit)
    style.fit_labels(fig, labels, style.BAR_IN)
    return style.encode_png(fig)


def draw_focus_figure(
    sweep: dict[str, Any],
    before: npt.NDArray[np.complexfloating],
    after: npt.NDArray[np.complexfloating],
    x_m: npt.NDArray[np.float64],
    y_m: npt.NDArray[np.float64],
    simulated: bool,
) -> bytes:
    """Return a PNG of a sweep over depth, and of H [ny, nx] before and after focusing.

    `sweep` has the keys `depths_mm`, `sharpness` (largest is 1), `depth_mm`, `tilt_deg` (x, y) and `certain`. Depths
    are relative to the rig file's plane.
    """
    fig = Figure(figsize=(13.0, 4.2), dpi=140, layout="constrained", facecolor="white")
    curve, *pictures = fig.subplots(1, 3, width_ratios=[1.1, 1, 1])
    curve.plot(sweep["depths_mm"], sweep["sharpness"], "o-", color="#44AA99", markersize=4)
    curve.axvline(0, color=style.MUTED, linewidth=1, linestyle=":", label="rig file")
    curve.axvline(sweep["depth_mm"], color="#882255", linewidth=1.4, label=f"found: {sweep['depth_mm']:+z.2f} mm")
    curve.set_xlabel("plane, relative to the rig file (mm)", fontsize=9, color=style.MUTED)
    curve.set_ylabel("sharpness of the untilted plane", fontsize=9, color=style.MUTED)
    tilt = sweep["tilt_deg"]
    title = "No clear maximum"
    if sweep["certain"]:
        title = f"Tilt found: {tilt[0]:+z.2f}° in x, {tilt[1]:+z.2f}° in y"
    curve.set_title(title, loc="left", fontsize=10, color=style.INK)
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
        ax.set_title(title, loc="left", fontsize=10, color=style.INK)
        ax.set_aspect("equal")
        ax.set_xlabel("x (mm)", fontsize=9, color=style.MUTED)
        style.colour_bar(fig, ax, mesh, "dB")
    if simulated:
        fig.suptitle("SIMULATED", fontsize=9, color=style.STAMP_COLOUR, fontweight="bold", x=0.99, ha="right")
    return style.encode_png(fig)


def surface_figure(surface: Surface) -> bytes:
    """Return a PNG of a surface from three sides."""
    fig = Figure(figsize=(11.5, 4.9), dpi=150, layout="constrained", facecolor="white")
    panels = fig.subplots(1, 3)
    points_mm = 1e3 * surface.points_m
    colour = find_point_permittivities(surface)
    low, high = colour_range(surface)
    colours = colormaps["viridis"].with_extremes(bad=NO_PERMITTIVITY)
    coloured = None
    for ax, ((across, up), title, (label_x, label_y)) in zip(panels, VIEWS, strict=True):
        # Nearer points are drawn last. The rig looks along +z, the other two views look against x and y. The axes 0, 1
        # and 2 of a view add to 3: the depth is the one that is not drawn.
        depth_axis = 3 - across - up
        depth = points_mm[:, depth_axis]
        order = np.argsort(-depth if depth_axis == DEPTH_AXIS else depth, kind="stable")
        coloured = ax.scatter(
            points_mm[order, across], points_mm[order, up], s=6, c=colour[order],
            cmap=colours, vmin=low, vmax=high, plotnonfinite=True,
        )  # fmt: skip
        stride = max(1, len(points_mm) // NORMALS_SHOWN)
        start = points_mm[::stride]
        needle = NORMAL_MM * surface.normals[::stride]
        ends = start + needle
        ax.plot(
            [start[:, across], ends[:, across]], [start[:, up], ends[:, up]], color=style.INK, linewidth=0.5, alpha=0.6
        )
        style.style_axes(ax, title, surface.simulated)
        ax.set_xlabel(label_x, fontsize=9, color=style.MUTED)
        ax.set_ylabel(label_y, fontsize=9, color=style.MUTED)
        ax.set_aspect("equal", adjustable="datalim")
    if np.isfinite(colour).any() and coloured is not None:
        bar = fig.colorbar(coloured, ax=panels, shrink=0.85, pad=0.01)
        bar.set_label("permittivity, real part", fontsize=9, color=style.MUTED)
    lines = [segment_text(segment) for segment in surface.segments[:MAX_LINES]]
    fig.supxlabel("\n".join(lines), fontsize=9, color=style.INK, x=0.01, ha="left")
    return style.encode_png(fig)


def find_point_permittivities(surface: Surface) -> npt.NDArray[np.float64]:
    """Return the real part of the permittivity of each point's segment, [n]; not a number without one."""
    colours = np.full(len(surface.segment), np.nan)
    for segment in surface.segments:
        if segment.permittivity is not None:
            colours[surface.segment == segment.number] = segment.permittivity.real
    return colours


def colour_range(surface: Surface) -> tuple[float, float]:
    """Return the range of the colour bar: the permittivities, at least 1 wide."""
    values = [s.permittivity.real for s in surface.segments if s.permittivity is not None] or [1.0]
    middle = (min(values) + max(values)) / 2
    half = max(0.5, 0.55 * (max(values) - min(values)))
    return middle - half, middle + half


def segment_text(segment: Segment) -> str:
    """Describe a segment in one line: form, permittivity with standard errors, or why it has none."""
    head = f"{segment.number}: {segment.points} points, {describe_form(segment)}"
    return f"{head}, incidence {segment.incidence_deg:.0f}°: {describe_material(segment)}"
