"""Segmentation: find the patches of an image; their number is unknown.

Plates parallel to the stage are mirrors: the image is bright inside a plate and dark elsewhere. In dB, speckle is
additive noise and plates are constant with steps between them: total variation removes the former and keeps the latter.
Levels of plates differ by 25 dB (thin wood against metal), so a common threshold cannot give their edges. The threshold
falls from the brightest level instead, and each region that grows with it is cut at half of its own amplitude, which is
where a band-limited step has its edge. Its pixels, and those of its *skirt* (the margin around it in which its level
falls to the background), are then no longer searched. A region is a patch if it stands out from the background; bright
ones that do not are left out (`Segmentation.left_out`). Where the true plates are known, `match_truth` finds the patch
of each.

Constants that name a real picture were measured on one that the authors of POLySIGHT published.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy
import skimage

from polysight.imaging import Image, Images, Mask
from polysight_shared.errors import DataError, ErrorCode

Real = npt.NDArray[np.float64]
# Corners x0, y0, x1, y1.
Box = tuple[float, float, float, float]
# Smallest weight of the smoothing, dB: an image without speckle would get a weight of 0.
_LEAST_WEIGHT = 0.1
EDGE_DB = 6.0
"""A plate's edge is at half of its amplitude, -6 dB, as that of a band-limited step."""
OVERFLOW_GROWTH = 1.5
"""A region has run into its background if its area grows by more than this factor in one step of the threshold;
chosen."""
MOST_SCATTER_DB = 4.0
"""Largest scatter of a background's level: that of a real picture is 3.8 dB. With more, some of the pixels that count
as background show plates."""
PLAIN_DB = 14.0
"""Level above the background that noise hardly reaches over the width of the smallest patch. A region above it is a
patch, although plates and background are not separate. Of 200 images of noise alone 24 have a patch, 10 without this
rule; all those that it adds have speckle wider than 5.9 mm (standard deviation)."""
SMALLEST_SHARE = 0.75
"""Least area of a patch, relative to a square of the least width: a corner of a skirt has 0.6."""
BODY_SHARE = 0.65
"""Parts of a region narrower than this share of its width do not belong to it. Chosen: a larger share rounds corners.
"""
STEP_DB = 1.0
"""Step of the falling threshold; chosen."""
BACKGROUND_PERCENT = 20.0
"""Percentile of a channel's power that is its background: plates rarely fill more of an image."""
NOISY_BACKGROUND = 0.005
"""Background relative to the brightest part above which a channel hardly shows plates: that of a real picture is 4.6 dB
lower in H, 12 dB in V."""
LEAST_POWER = 1e-12
"""Power relative to the brightest that counts as none; chosen."""
LEAST_APART_MM = 0.4
MOST_APART_MM = 10.0
"""Distances between the images of H and V that are corrected: the error of a distance is 0.2 mm, and larger ones are
no displacement of the images."""
EDGE_FLOOR = 0.05
"""Level relative to the brightest below which edges do not count; chosen."""
LEAST_CORRELATION = 0.5
"""Least correlation of the edges in H and V after V was moved onto H: images of noise have less than 0.1."""


@dataclass(frozen=True)
class SegmentSettings:
    """Settings of the segmentation; the defaults are chosen.

    Attributes
    ----------
    smallest_mm
        Least width of a patch; narrower features (ringing at edges, speckle) are removed by opening.
    margin_mm
        Margin between outline and interior: about twice the resolution, beyond the ringing of the edge.
    smooth_px
        Gaussian filter of the power, before conversion to dB.
    speckle_db
        Largest weight of the total variation (Chambolle). The weight equals the speckle on the plates: a larger one
        would fill the narrow gaps between plates.
    floor_db
        Levels below this, relative to the brightest, count as equally dark.
    dimmest_db
        Regions below this level, relative to the brightest, count as sidelobes.
    least_contrast_db
        Least difference between a patch and its surroundings.
    least_scatter
        Least difference between a patch and the background, in standard deviations of the background's level.
    """

    smallest_mm: float = 14.0
    margin_mm: float = 9.0
    smooth_px: float = 1.0
    speckle_db: float = 3.0
    floor_db: float = -35.0
    dimmest_db: float = -26.0
    least_contrast_db: float = 5.0
    least_scatter: float = 2.5


@dataclass(frozen=True)
class Patch:
    """One flat piece of material in the image.

    Boxes and outlines are in millimetres from the image centre: x as the rig frame's x, y upwards.

    Attributes
    ----------
    label
        Its number in the label image, from 1: found patches in reading order (top row first), drawn boxes in their own.
    box_mm
        (x0, y0, x1, y1) around it.
    outline_mm
        float64 [n, 2] closed polygon (x, y).
    pixels
        Number of pixels of `mask`.
    mask, interior
        bool [ny, nx]: the patch, and its inside without the edges.
    cut
        True if it was found and the border of the image cuts it.
    """

    label: int
    box_mm: Box
    outline_mm: Real
    pixels: int
    mask: Mask
    interior: Mask
    cut: bool = False

    @property
    def centre_mm(self) -> tuple[float, float]:
        """Middle of the box, millimetres from the image centre."""
        x0, y0, x1, y1 = self.box_mm
        return (x0 + x1) / 2, (y0 + y1) / 2


@dataclass(frozen=True)
class Segmentation:
    """Patches of an image.

    `labels` int32 [ny, nx]: patch number of each pixel, 0 for none. `left_out`: masks of bright regions, bool
    [ny, nx] each, that do not stand out enough to be patches, or that touch a larger patch.
    """

    labels: npt.NDArray[np.int32]
    patches: tuple[Patch, ...]
    left_out: tuple[Mask, ...] = ()


def axis_mm(axis_m: npt.ArrayLike) -> Real:
    """Convert an image axis [n] to millimetres from the image centre."""
    a = np.asarray(axis_m, np.float64)
    return (a - (a[0] + a[-1]) / 2) * 1e3


def image_centre_mm(x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> tuple[float, float]:
    """Return the image centre in the rig frame, millimetres: the origin of boxes and outlines."""
    x = np.asarray(x_m, np.float64)
    y = np.asarray(y_m, np.float64)
    return float(x[0] * 1e3 - axis_mm(x)[0]), float(y[0] * 1e3 - axis_mm(y)[0])


def box_mask(box_mm: Box, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> Mask:
    """Return the pixels whose centres lie in a box (x0, y0, x1, y1), mm from the image centre; bool [ny, nx]."""
    x = axis_mm(x_m)
    y = axis_mm(y_m)
    x0, x1 = sorted((box_mm[0], box_mm[2]))
    y0, y1 = sorted((box_mm[1], box_mm[3]))
    return ((y >= y0) & (y <= y1))[:, None] & ((x >= x0) & (x <= x1))[None, :]


def make_patch(
    label: int, mask: Mask, x_m: npt.ArrayLike, y_m: npt.ArrayLike, margin_mm: float, usable: Mask | None = None
) -> Patch:
    """Make a patch of a mask [ny, nx]; the interior begins a margin inside, or less if the patch is too small for it.

    `x_m` and `y_m` are the image's axes; only `usable` pixels, bool [ny, nx], are in the interior (None: all).
    """
    x = axis_mm(x_m)
    y = axis_mm(y_m)
    pixel = abs(float(x[1] - x[0]))
    padded = np.pad(mask, 1)
    depth = np.asarray(scipy.ndimage.distance_transform_edt(padded))[1:-1, 1:-1] * pixel
    # A narrow patch keeps the inner two fifths of its depth (chosen).
    interior = mask & (depth > min(margin_mm, 0.6 * float(depth.max())))
    if usable is not None:
        interior &= usable
    rows, cols = np.nonzero(mask)
    half = pixel / 2
    box = (
        float(x[cols].min() - half),
        float(y[rows].min() - half),
        float(x[cols].max() + half),
        float(y[rows].max() + half),
    )
    # The longest contour is the outer one; 1 is the padding.
    contour = max(skimage.measure.find_contours(padded.astype(np.float64), 0.5), key=len) - 1
    outline = np.column_stack([np.interp(contour[:, 1], range(x.size), x), np.interp(contour[:, 0], range(y.size), y)])
    return Patch(label, box, drop_corners(outline, pixel / 2), int(mask.sum()), mask, interior)


def level_db(h: Image, v: Image, usable: Mask, smooth_px: float, plate_px: float) -> Real:
    """Return the smoothed level of the stronger channel, dB below that channel's brightest, float64 [ny, nx].

    Each channel is scaled by its brightest part of half a plate's width, `plate_px` (bright strips at edges do not
    count), so that an unknown gain between H and V has no effect. The larger of both is used instead of the sum,
    because V is only noise where it nearly vanishes. A channel with hardly anything above its background is lowered
    until its background is that of the other: else the noise of V would hide a sheet that only H shows.
    """
    channels = []
    backgrounds = []
    for channel in (h, v):
        p = scipy.ndimage.gaussian_filter(np.where(usable, np.abs(channel).astype(np.float64) ** 2, 0.0), smooth_px)
        top = float(scipy.ndimage.gaussian_filter(p, plate_px)[usable].max())
        if top > 0:
            channels.append(p / top)
            backgrounds.append(max(float(np.percentile(p[usable], BACKGROUND_PERCENT)) / top, LEAST_POWER))
    power = np.zeros(h.shape)
    for scaled, background in zip(channels, backgrounds, strict=True):
        is_noisy = background > NOISY_BACKGROUND
        weight = min(backgrounds) / background if is_noisy else 1.0
        power = np.maximum(power, weight * scaled)
    return 10 * np.log10(np.maximum(power, LEAST_POWER))


def segment(
    h: Image,
    v: Image,
    x_m: npt.ArrayLike,
    y_m: npt.ArrayLike,
    valid: Mask | None = None,
    settings: SegmentSettings | None = None,
) -> Segmentation:
    """Find the patches of an image pair.

    The steps are total variation against speckle, a falling threshold on the level in dB, morphological opening,
    connected components (scikit-image), each cut at half of its own amplitude. Otsu's threshold gives the background.

    `h` and `v` complex [ny, nx] are divided by the antennas' footprint (equal brightness everywhere); their gains may
    differ. `valid` bool [ny, nx] are the pixels to use, None all finite ones. The result has no patches if bright and
    dark cannot be separated.

    Raises DataError if shapes differ or no pixel is valid.
    """
    cfg = settings or SegmentSettings()
    if h.shape != v.shape or h.shape != (np.size(y_m), np.size(x_m)):
        raise DataError(
            f"images {h.shape}, {v.shape} do not fit axes of {np.size(y_m)} x {np.size(x_m)}",
            "they are not of one scan", "give arrays of one scan", code=ErrorCode.MISMATCH,
        )  # fmt: skip
    usable = np.isfinite(h) & np.isfinite(v)
    if valid is not None:
        usable &= valid
    if not usable.any():
        raise DataError(
            "the image has no valid pixel", "nothing was recorded, or all of it was masked", "look at quality.json",
            code=ErrorCode.NO_DATA,
        )  # fmt: skip
    pixel_mm = abs(float(axis_mm(x_m)[1] - axis_mm(x_m)[0]))
    level = level_db(h, v, usable, cfg.smooth_px, cfg.smallest_mm / pixel_mm / 2)
    smooth_level = _remove_speckle(np.maximum(level, cfg.floor_db), usable, cfg, pixel_mm)
    # Smoothing the outline may have left too little of a region.
    least_pixels = SMALLEST_SHARE * cfg.smallest_mm**2 / pixel_mm**2
    found_regions = _find_regions(smooth_level, usable, cfg, pixel_mm)
    regions = [(mask, parts) for mask, parts in found_regions if mask.sum() >= least_pixels]
    least_db = _find_least_level_db(smooth_level, usable, cfg, pixel_mm)
    if np.isfinite(least_db):
        # If plates fill a small image, dim ones are among the dark pixels beside metal: the gaps are the background.
        gaps = level[_select_gaps(usable, [mask for mask, _ in regions], cfg.margin_mm / pixel_mm)]
        if gaps.size >= least_pixels:
            least_db = min(least_db, max(float(np.median(gaps)) + PLAIN_DB, cfg.dimmest_db))
    masks: list[Mask] = []
    left_out: list[Mask] = []
    for mask, cut_off in regions:
        region_db = float(np.median(smooth_level[mask]))
        if region_db >= least_db:
            masks.append(mask)
            left_out += [cut_part for cut_part in cut_off if float(np.median(smooth_level[cut_part])) >= cfg.dimmest_db]
        elif region_db >= cfg.dimmest_db:
            left_out.append(mask)
    labels = np.zeros(h.shape, np.int32)
    patches = []
    # Plates of one row lie within two widths of the smallest patch; 1 mm keeps a setting of 0 from dividing by it.
    for mask in sorted(masks, key=lambda mask: _find_reading_place(mask, axis_mm(y_m), max(2 * cfg.smallest_mm, 1.0))):
        labels[mask] = len(patches) + 1
        patch = make_patch(len(patches) + 1, mask, x_m, y_m, cfg.margin_mm, usable)
        patches.append(replace(patch, cut=_is_cut(mask, cfg.smallest_mm / pixel_mm)))
    return Segmentation(labels, tuple(patches), tuple(left_out))


def touches_border(mask: Mask) -> bool:
    """Return true if a mask reaches the first or the last row or column of the image."""
    return bool(mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any())


def _is_cut(mask: Mask, smallest_px: float) -> bool:
    """Return true if more than the smallest patch's width lies at the border of the image.

    An end of the scan within the image cuts none: there the footprint falls slowly, and interiors end before it.
    """
    border_mask = mask.copy()
    border_mask[1:-1, 1:-1] = False
    return float(border_mask.sum()) > smallest_px


def _find_least_level_db(image: Real, usable: Mask, cfg: SegmentSettings, pixel_mm: float) -> float:
    """Return the least level of a patch in an image [ny, nx] of levels, dB: above the background by its scatter.

    It is infinite if all is background.
    """
    level = image[usable]
    if np.ptp(level) == 0:
        return float("inf")
    bright = level > skimage.filters.threshold_otsu(level)
    background = float(np.median(level[~bright]))
    # Plates over a noisy background: the classes overlap, but noise is rarely as bright over a plate's width.
    plate_mask = _open_mask((image > background + PLAIN_DB) & usable, cfg.smallest_mm / pixel_mm / 2)
    if not plate_mask.any() and not _are_separate(level, bright, cfg.least_contrast_db):
        return float("inf")
    # Here and below 1.4826 turns the median of normal deviations into their standard deviation.
    scatter = min(1.4826 * float(np.median(np.abs(level[~bright] - background))), MOST_SCATTER_DB)
    return max(background + max(cfg.least_contrast_db, cfg.least_scatter * scatter), cfg.dimmest_db)


def _select_gaps(usable: Mask, regions: Sequence[Mask], margin_px: float) -> Mask:
    """Return the usable pixels that are farther than the margin from every region."""
    is_in_no_region = np.ones(usable.shape, bool)
    for mask in regions:
        is_in_no_region &= ~mask
    return usable & (np.asarray(scipy.ndimage.distance_transform_edt(is_in_no_region)) > margin_px)


def _find_reading_place(mask: Mask, y_mm: Real, row_pitch_mm: float) -> tuple[float, float]:
    """Return the sort key of a patch: top row first, then from left to right; rows are `row_pitch_mm` high."""
    rows, cols = np.nonzero(mask)
    return -round(float(y_mm[rows].mean()) / row_pitch_mm), float(cols.mean())


def find_interiors(images: Images) -> list[Mask]:
    """Return the interiors of the patches of an image pair, bool [ny, nx] each; none without valid pixels."""
    if not images.usable.any():
        return []
    return [p.interior for p in segment(images.h, images.v, images.x_m, images.y_m, images.valid).patches]


def whole_plane(usable: Mask, x_m: npt.ArrayLike, y_m: npt.ArrayLike, margin_mm: float) -> Segmentation:
    """Return all usable pixels as one patch, for a material that fills the image."""
    patch = make_patch(1, usable, x_m, y_m, margin_mm, usable)
    return Segmentation(usable.astype(np.int32), (patch,))


def _remove_speckle(level: Real, usable: Mask, cfg: SegmentSettings, pixel_mm: float) -> Real:
    """Return the level after total variation, dB, with the weight for the speckle of the bright plates."""
    strongest = reduce_variation(level, cfg.speckle_db)
    levels = strongest[usable]
    if np.ptp(levels) == 0:
        return strongest
    bright = (strongest > skimage.filters.threshold_otsu(levels)) & usable
    middle = np.asarray(scipy.ndimage.distance_transform_edt(bright)) > cfg.margin_mm / pixel_mm
    if not middle.any():
        return strongest
    difference = (level - strongest)[middle]
    speckle = 1.4826 * float(np.median(np.abs(difference - np.median(difference))))
    return reduce_variation(level, min(cfg.speckle_db, max(speckle, _LEAST_WEIGHT)))


def _are_separate(level: Real, bright: Mask, least_contrast_db: float) -> bool:
    """Return true if bright and dark are two classes, far enough apart, and not one class cut in two.

    Otsu also splits a single normal distribution, with 2/pi = 0.64 of the variance between the halves, so that 0.70 is
    required. One small patch has little of the variance, but lies far above the spread of the dark class: by four of
    its standard deviations (chosen).
    """
    bright_share = float(bright.mean())
    gap = float(level[bright].mean() - level[~bright].mean())
    is_bimodal = bright_share * (1 - bright_share) * gap**2 >= 0.70 * float(level.var()) or gap >= 4 * float(
        level[~bright].std()
    )
    return gap >= least_contrast_db and is_bimodal


@dataclass(frozen=True, eq=False)
class _GrowingRegion:
    """A region that grows while the threshold falls: its mask at each threshold, and its median level, dB."""

    masks: tuple[tuple[float, Mask], ...]
    level_db: float

    @property
    def mask(self) -> Mask:
        """The mask at the last threshold."""
        return self.masks[-1][1]

    def cut(self, around_db: float) -> Mask:
        """Return the mask at the mean of its own amplitude and that of its surroundings."""
        edge_db = 20 * float(np.log10((10 ** (self.level_db / 20) + 10 ** (around_db / 20)) / 2))
        return min(self.masks, key=lambda step: abs(step[0] - edge_db))[1]


def _find_regions(level: Real, usable: Mask, cfg: SegmentSettings, pixel_mm: float) -> list[tuple[Mask, list[Mask]]]:
    """Return all regions that stand out from what surrounds them, bright ones first: mask, and parts cut off from it.

    A part that is cut off touches the region and is narrower, but has the size of a plate.

    The threshold falls from the brightest level, and connected regions grow with it. A region is complete when its
    median lies `EDGE_DB` above the threshold (half of its own amplitude), or before it runs into another region or into
    a background that is not that far below. Its pixels and its skirt are removed, and the threshold falls further for
    the rest.
    """
    opening_px = (cfg.smallest_mm / pixel_mm - 1) / 2
    skirt_px = max(1.0, cfg.margin_mm / pixel_mm)
    remaining = usable.copy()
    regions: list[tuple[Mask, list[Mask]]] = []
    growing: list[_GrowingRegion] = []

    def take_region(mask: Mask) -> None:
        """Add a region, and remove its pixels and its skirt from the remaining ones."""
        outline = _smooth_outline(mask)
        regions.append((outline, _find_components(_open_mask(mask & ~outline, opening_px))))
        window = _find_window(mask, int(skirt_px) + 1)
        remaining[window][np.asarray(scipy.ndimage.distance_transform_edt(~mask[window])) <= skirt_px] = False

    for threshold in np.arange(float(level[usable].max()), cfg.floor_db, -STEP_DB) - STEP_DB:
        grown: list[_GrowingRegion] = []
        for region in _find_components(_open_mask((level > threshold) & remaining, opening_px)):
            # `parts`: regions of the previous threshold that have grown into this one. Those that stand out enough to
            # be patches are cut back to an earlier threshold if two of them meet, or one runs into its background.
            parts = [node for node in growing if (node.mask & region).any()]
            standing_out = [node for node in parts if node.level_db - threshold >= cfg.least_contrast_db]
            overflows = any(region.sum() > OVERFLOW_GROWTH * node.mask.sum() for node in standing_out)
            region_db = float(np.median(level[region]))
            if len(standing_out) > 1 or overflows:
                for node in standing_out:
                    take_region(node.cut(float(threshold)))
                grown += [node for node in parts if node not in standing_out]
            elif region_db - threshold >= EDGE_DB:
                take_region(region)
            else:
                earlier_masks = max(parts, key=lambda node: int(node.mask.sum())).masks if parts else ()
                grown.append(_GrowingRegion((*earlier_masks, (float(threshold), region)), region_db))
        growing = grown
    return regions


def _smooth_outline(mask: Mask) -> Mask:
    """Return a region without holes, and without parts narrower than `BODY_SHARE` of its width (speckle, bridges).

    Of what is left the largest part is returned, with a smooth outline.
    """
    # The Gaussian below ends after 4 pixels.
    window = _find_window(mask, 5)
    filled = np.asarray(scipy.ndimage.binary_fill_holes(mask[window]), bool)
    half_width = float(np.asarray(scipy.ndimage.distance_transform_edt(np.pad(filled, 1))).max())
    body = max(
        _find_components(_open_mask(filled, BODY_SHARE * half_width)), key=lambda part: int(part.sum()), default=filled
    )
    smooth = np.zeros_like(mask)
    smooth[window] = np.asarray(scipy.ndimage.gaussian_filter(body.astype(float), 1.0)) > 0.5
    return smooth


def _open_mask(mask: Mask, radius_px: float) -> Mask:
    """Remove parts that are narrower than a disk of this radius (morphological opening, by distances)."""
    window = _find_window(mask)
    window_mask = mask[window]
    opened = np.zeros_like(mask)
    depth = np.asarray(scipy.ndimage.distance_transform_edt(np.pad(window_mask, 1)))[1:-1, 1:-1]
    core = depth > radius_px
    if core.any():
        opened[window] = window_mask & (np.asarray(scipy.ndimage.distance_transform_edt(~core)) <= radius_px)
    return opened


def _find_window(mask: Mask, margin: int = 0) -> tuple[slice, slice]:
    """Return the rows and columns that hold a mask, and `margin` more around it within the image."""
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask.any(axis=0))
    if not rows.size:
        return slice(0, 0), slice(0, 0)
    return (
        slice(max(0, int(rows[0]) - margin), int(rows[-1]) + margin + 1),
        slice(max(0, int(columns[0]) - margin), int(columns[-1]) + margin + 1),
    )


def _find_components(mask: Mask) -> list[Mask]:
    """Return the connected regions of a mask, bool [ny, nx] each."""
    labels = np.asarray(skimage.measure.label(mask, connectivity=1))
    return [labels == i for i in range(1, int(labels.max()) + 1)]


def align(images: Images) -> tuple[Images, tuple[float, float]]:
    """Move V onto H; return the images, and where V lay relative to H, millimetres (x, y).

    The images are returned unchanged if they lie on each other, or if their edges cannot be compared: there are none,
    they are farther apart than `MOST_APART_MM`, or not alike (`LEAST_CORRELATION`).
    """
    edges_h = _measure_edges(images.h, images.usable)
    edges_v = _measure_edges(images.v, images.usable)
    if not edges_h.any() or not edges_v.any():
        return images, (0.0, 0.0)
    # To a twentieth of a pixel (chosen). The type stub knows only the default's type, but None is documented.
    options: dict[str, Any] = {"upsample_factor": 20, "normalization": None}
    registration = skimage.registration.phase_cross_correlation(edges_h, edges_v, **options)
    # The shift that moves V onto H: rows, columns.
    back_px = np.asarray(registration[0], np.float64)
    pixel_mm = abs(float(images.x_m[1] - images.x_m[0])) * 1e3
    apart_mm = -back_px[::-1] * pixel_mm
    moved_edges = np.asarray(scipy.ndimage.shift(edges_v, back_px, order=1))
    correlation = float(np.corrcoef(edges_h.ravel(), moved_edges.ravel())[0, 1])
    if not LEAST_APART_MM <= float(np.hypot(*apart_mm)) <= MOST_APART_MM or correlation < LEAST_CORRELATION:
        return images, (0.0, 0.0)
    usable_v = np.where(images.usable, images.v, 0).astype(np.complex128)
    v = np.asarray(scipy.ndimage.shift(usable_v, back_px, order=3, mode="nearest"))
    return replace(images, v=v.astype(images.v.dtype)), (float(apart_mm[0]), float(apart_mm[1]))


def _measure_edges(channel: Image, usable: Mask) -> np.ndarray:
    """Return how steeply the level of one channel changes, float [ny, nx]; 0 far below its brightest part."""
    amplitude = np.where(usable, np.abs(channel), 0.0)
    level = np.log(amplitude + EDGE_FLOOR * max(float(amplitude.max()), 1e-30))
    rows, columns = np.gradient(scipy.ndimage.gaussian_filter(level, 1.0))
    return np.hypot(rows, columns)


# --- total variation and corners: as `denoise_tv_chambolle` and `approximate_polygon` of scikit-image, whose modules
# take a second to import (scipy.stats and scipy.signal) ---

# Largest number of iterations.
_ITERATIONS = 100
_LEAST_CHANGE = 2e-4
"""Change of the cost, relative to its first value, at which the iteration ends."""
_STEP = 0.25
"""Largest step for which the iteration in two dimensions converges (Chambolle 2004)."""


def reduce_variation(level: Real, weight: float) -> Real:
    """Return an image [ny, nx] with less total variation, by Chambolle's dual projection (2004).

    It minimises half the squared distance from `level` plus `weight` times the sum of the gradient's magnitude.
    """
    # Dual field, one plane for each direction of the gradient, and what is added to the image.
    field = np.zeros((2, *level.shape))
    gradient = np.zeros_like(field)
    change = np.zeros_like(level)
    first_cost = np.inf
    last_cost = np.inf
    smooth = level
    for _ in range(_ITERATIONS):
        smooth = level + change
        np.subtract(smooth[1:], smooth[:-1], out=gradient[0, :-1])
        np.subtract(smooth[:, 1:], smooth[:, :-1], out=gradient[1, :, :-1])
        steepness = np.sqrt(gradient[0] ** 2 + gradient[1] ** 2)
        cost = float(np.vdot(change, change)) + weight * float(steepness.sum())
        if first_cost == np.inf:
            first_cost = cost
        elif abs(last_cost - cost) < _LEAST_CHANGE * first_cost:
            break
        last_cost = cost
        field -= _STEP * gradient
        field /= 1 + (_STEP / weight) * steepness
        # `change` becomes the negative divergence of the field.
        np.negative(field[0] + field[1], out=change)
        change[1:] += field[0, :-1]
        change[:, 1:] += field[1, :, :-1]
    return smooth


def drop_corners(outline: Real, tolerance: float) -> Real:
    """Return the corners of an outline [n, 2] that keep it within a tolerance (Douglas and Peucker 1973)."""
    last = len(outline) - 1
    kept_indices = {0, last}
    parts = [(0, last)]
    while parts:
        start, end = parts.pop()
        between = outline[start + 1 : end] - outline[start]
        side = outline[end] - outline[start]
        length = float(side @ side)
        position_along = np.zeros(len(between))
        if length > 0:
            position_along = np.clip(between @ side / length, 0.0, 1.0)
        distances = np.hypot(*(between - position_along[:, None] * side).T)
        if distances.size and distances.max() > tolerance:
            corner = start + 1 + int(distances.argmax())
            kept_indices.add(corner)
            parts += [(start, corner), (corner, end)]
    return outline[sorted(kept_indices)]


@dataclass(frozen=True)
class TruthPlate:
    """A rectangular plate of the true scene.

    Box in millimetres from the image centre; permittivity eps' - j eps'', None for metal, metal strips (they measure
    leakage) and stacks of layers; thickness, None if it is not given; `metal`: the plate is metal.
    """

    name: str
    box_mm: Box
    permittivity: complex | None
    thickness_mm: float | None = None
    metal: bool = False

    @property
    def centre_mm(self) -> tuple[float, float]:
        """Middle of the box."""
        return (self.box_mm[0] + self.box_mm[2]) / 2, (self.box_mm[1] + self.box_mm[3]) / 2


def match_truth(patches: Iterable[Patch], plates: Iterable[TruthPlate]) -> dict[int, TruthPlate]:
    """Return patch label to plate: the patch's centre lies in the plate; of several patches the nearest gets it."""
    pairs = []
    for plate in plates:
        x0, y0, x1, y1 = plate.box_mm
        for patch in patches:
            x, y = patch.centre_mm
            if x0 <= x <= x1 and y0 <= y <= y1:
                distance = float(np.hypot(x - plate.centre_mm[0], y - plate.centre_mm[1]))
                pairs.append((distance, patch.label, plate))
    plate_of_patch: dict[int, TruthPlate] = {}
    for _, label, plate in sorted(pairs, key=lambda p: p[0]):
        if label not in plate_of_patch and all(p is not plate for p in plate_of_patch.values()):
            plate_of_patch[label] = plate
    return plate_of_patch
