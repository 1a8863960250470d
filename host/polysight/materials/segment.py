"""Segmentation: find the patches of an image; their number is unknown.

Plates parallel to the stage are mirrors: the image is bright inside a plate and dark elsewhere. In dB, speckle is
additive noise and plates are constant with steps between them: total variation removes the former and keeps the latter.
Levels of plates differ by more than 10 dB (wood against metal), so one threshold finds the bright plates and another
one, on the remaining pixels, the dim ones. A common threshold cannot give the edges: each region is cut again at half
of its own amplitude, the position of the edge of a band-limited step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy
import skimage

from polysight.imaging import Image, Images, Mask
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

Real = npt.NDArray[np.float64]
Box = tuple[float, float, float, float]
_LEAST_WEIGHT = 0.1  # dB
_TURNS = 3  # thresholds: metal, dielectrics, the dimmest


@dataclass(frozen=True)
class SegmentSettings:
    """Settings of the segmentation.

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
        Pixels beside bright patches below this level, relative to the brightest, count as sidelobes.
    least_contrast_db
        Least difference of bright and dark; with less there are no (further) patches.
    """

    smallest_mm: float = 14.0
    margin_mm: float = 9.0
    smooth_px: float = 1.0
    speckle_db: float = 3.0
    floor_db: float = -32.0
    dimmest_db: float = -24.0
    least_contrast_db: float = 5.0


@dataclass(frozen=True)
class Patch:
    """One flat piece of material in the image.

    Boxes and outlines are in millimetres from the image centre: x as the rig frame's x, y upwards.

    Attributes
    ----------
    label
        Its number in the label image, from 1, in reading order (top row first).
    box_mm
        (x0, y0, x1, y1) around it.
    outline_mm
        float64 [n, 2] closed polygon (x, y).
    pixels
        Number of pixels inside the outline.
    mask, interior
        bool [ny, nx]: the patch, and its inside without the edges.
    """

    label: int
    box_mm: Box
    outline_mm: Real
    pixels: int
    mask: Mask
    interior: Mask

    @property
    def centre_mm(self) -> tuple[float, float]:
        """Middle of the box, millimetres from the image centre."""
        x0, y0, x1, y1 = self.box_mm
        return (x0 + x1) / 2, (y0 + y1) / 2


@dataclass(frozen=True)
class Segmentation:
    """Label image int32 [ny, nx] (0: no patch), and its patches."""

    labels: npt.NDArray[np.int32]
    patches: tuple[Patch, ...]


def axis_mm(axis_m: npt.ArrayLike) -> Real:
    """Convert an image axis to millimetres from the image centre."""
    a = np.asarray(axis_m, np.float64)
    return (a - (a[0] + a[-1]) / 2) * 1e3


def box_mask(box_mm: Box, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> Mask:
    """Return the pixels whose centres lie in a box (x0, y0, x1, y1), mm from the image centre; bool [ny, nx]."""
    x, y = axis_mm(x_m), axis_mm(y_m)
    x0, x1 = sorted((box_mm[0], box_mm[2]))
    y0, y1 = sorted((box_mm[1], box_mm[3]))
    return ((y >= y0) & (y <= y1))[:, None] & ((x >= x0) & (x <= x1))[None, :]


def make_patch(
    label: int, mask: Mask, x_m: npt.ArrayLike, y_m: npt.ArrayLike, margin_mm: float, usable: Mask | None = None
) -> Patch:
    """Make a patch of a mask [ny, nx]; the margin shrinks if the patch is too small for it."""
    x, y = axis_mm(x_m), axis_mm(y_m)
    pixel = abs(float(x[1] - x[0]))
    padded = np.pad(mask, 1)
    depth = np.asarray(scipy.ndimage.distance_transform_edt(padded))[1:-1, 1:-1] * pixel
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
    contour = max(skimage.measure.find_contours(padded.astype(np.float64), 0.5), key=len) - 1
    outline = np.column_stack([np.interp(contour[:, 1], range(x.size), x), np.interp(contour[:, 0], range(y.size), y)])
    return Patch(label, box, skimage.measure.approximate_polygon(outline, pixel / 2), int(mask.sum()), mask, interior)


def level_db(h: Image, v: Image, usable: Mask, smooth_px: float) -> Real:
    """Return the smoothed level of the stronger channel, dB below that channel's brightest, float64 [ny, nx].

    Each channel is scaled by its brightest part, so that an unknown gain between H and V has no effect. The larger of
    both is used instead of the sum, because V is only noise where it nearly vanishes.
    """
    power = np.zeros(h.shape)
    for channel in (h, v):
        p = scipy.ndimage.gaussian_filter(np.where(usable, np.abs(channel).astype(np.float64) ** 2, 0.0), smooth_px)
        top = float(np.percentile(p[usable], 99.5))
        if top > 0:
            power = np.maximum(power, p / top)
    return 10 * np.log10(np.maximum(power, 1e-12))


def segment(
    h: Image,
    v: Image,
    x_m: npt.ArrayLike,
    y_m: npt.ArrayLike,
    valid: Mask | None = None,
    settings: SegmentSettings | None = None,
) -> Segmentation:
    """Find the patches of an image pair.

    The steps are total variation against speckle, Otsu's threshold on the level in dB, morphological opening, connected
    components (scikit-image), each cut again at half of its own amplitude. The rest of a component is searched again,
    so that a dim plate touching the skirt of a bright one is found. All is repeated on the pixels away from the found
    patches until bright and dark cannot be separated.

    `h` and `v` complex [ny, nx] are flattened by the footprint; their gains may differ. `valid` bool [ny, nx] are the
    pixels to use, None all finite ones. The result has no patches if bright and dark cannot be separated.

    Raises DataError if shapes differ or no pixel is valid.
    """
    cfg = settings or SegmentSettings()
    if h.shape != v.shape or h.shape != (np.size(y_m), np.size(x_m)):
        raise DataError(
            f"images {h.shape}, {v.shape} do not fit axes of {np.size(y_m)} x {np.size(x_m)}", code=ErrorCode.MISMATCH
        )
    usable = np.isfinite(h) & np.isfinite(v)
    if valid is not None:
        usable &= valid
    if not usable.any():
        raise DataError(
            "the image has no valid pixel", "nothing was recorded, or all of it was masked", code=ErrorCode.NO_DATA
        )
    pixel_mm = abs(float(axis_mm(x_m)[1] - axis_mm(x_m)[0]))
    level = np.maximum(level_db(h, v, usable, cfg.smooth_px), cfg.floor_db)
    masks = _regions(_without_speckle(level, usable, cfg, pixel_mm), usable, cfg, pixel_mm)
    labels = np.zeros(h.shape, np.int32)
    patches = []
    for mask in sorted(masks, key=lambda mask: _reading_order(mask, axis_mm(y_m), max(2 * cfg.smallest_mm, 1.0))):
        labels[mask] = len(patches) + 1
        patches.append(make_patch(len(patches) + 1, mask, x_m, y_m, cfg.margin_mm, usable))
    return Segmentation(labels, tuple(patches))


def _reading_order(mask: Mask, y_mm: Real, row_pitch_mm: float) -> tuple[float, float]:
    """Sort key of a patch: top row first, then from left to right."""
    rows, cols = np.nonzero(mask)
    return -round(float(y_mm[rows].mean()) / row_pitch_mm), float(cols.mean())


def insides(images: Images) -> list[Mask]:
    """Return the interiors of the patches of an image pair, bool [ny, nx] each; none without valid pixels."""
    if not images.usable.any():
        return []
    return [p.interior for p in segment(images.h, images.v, images.x_m, images.y_m, images.valid).patches]


def whole_plane(usable: Mask, x_m: npt.ArrayLike, y_m: npt.ArrayLike, margin_mm: float) -> Segmentation:
    """Return all usable pixels as one patch, for a material that fills the image."""
    patch = make_patch(1, usable, x_m, y_m, margin_mm, usable)
    return Segmentation(usable.astype(np.int32), (patch,))


def _without_speckle(level: Real, usable: Mask, cfg: SegmentSettings, pixel_mm: float) -> tuple[Real, Real]:
    """Return the level after total variation, dB: with the weight for the bright plates' speckle, and a medium weight.

    The second is for the remaining dim plates: they have more speckle than bright ones, and no bright neighbour.
    """

    def even(weight: float) -> Real:
        return np.asarray(skimage.restoration.denoise_tv_chambolle(level, weight=weight, max_num_iter=100))

    strongest = even(cfg.speckle_db)
    inside = strongest[usable]
    if np.ptp(inside) == 0:
        return strongest, strongest
    bright = (strongest > skimage.filters.threshold_otsu(inside)) & usable
    middle = np.asarray(scipy.ndimage.distance_transform_edt(bright)) > cfg.margin_mm / pixel_mm
    if not middle.any():
        return strongest, strongest
    difference = (level - strongest)[middle]
    speckle = 1.4826 * float(np.median(np.abs(difference - np.median(difference))))
    return even(min(cfg.speckle_db, max(speckle, _LEAST_WEIGHT))), even(cfg.speckle_db / 2)


def _regions(levels: tuple[Real, Real], usable: Mask, cfg: SegmentSettings, pixel_mm: float) -> list[Mask]:
    """Return the masks of all patches, bright ones first."""
    radius = max(1, round((cfg.smallest_mm / pixel_mm - 1) / 2))
    around = np.asarray(skimage.morphology.disk(max(1, round(cfg.margin_mm / pixel_mm))), bool)
    found: list[Mask] = []
    rest = usable.copy()
    for turn in range(_TURNS):
        level = levels[0] if turn == 0 else np.maximum(levels[1], cfg.dimmest_db)
        inside = level[rest]
        if inside.size == 0 or np.ptp(inside) == 0:
            break
        threshold = float(skimage.filters.threshold_otsu(inside))
        bright = inside > threshold
        if not bright.any() or bright.all() or not _separate(inside, bright, cfg.least_contrast_db):
            break
        new = _cut(10 ** (level / 20), (level > threshold) & rest, radius)
        if not new:
            break
        found += new
        rest &= ~np.asarray(scipy.ndimage.binary_dilation(np.logical_or.reduce(new), around), bool)
    return found


def _separate(level: Real, bright: Mask, least_contrast_db: float) -> bool:
    """Return true if bright and dark are two classes, far enough apart, and not one class cut in two.

    Otsu also splits a single normal distribution, with 2/pi = 0.64 of the variance between the halves. One small patch
    has little of the variance, but lies far above the spread of the dark class.
    """
    w = float(bright.mean())
    gap = float(level[bright].mean() - level[~bright].mean())
    two = w * (1 - w) * gap**2 >= 0.70 * float(level.var()) or gap >= 4 * float(level[~bright].std())
    return gap >= least_contrast_db and two


def _cut(amplitude: Real, mask: Mask, radius: int) -> list[Mask]:
    """Return the connected regions of a mask, each cut at half of its own amplitude."""
    disk = np.asarray(skimage.morphology.disk(radius), bool)
    skirt = np.asarray(skimage.morphology.disk(radius + 1), bool)
    found: list[Mask] = []
    queue = _components(_opened(mask, disk))
    while queue:
        region = queue.pop()
        own = float(np.percentile(amplitude[region], 70))
        core = _opened(region & (amplitude > own / 2), disk)
        parts = _components(core)
        if not parts:
            continue
        near = np.asarray(scipy.ndimage.binary_dilation(core, skirt), bool)
        queue += _components(_opened(region & ~near, disk))
        if len(parts) == 1:
            found.append(_smooth_outline(parts[0]))
        else:
            queue += parts
    return found


def _smooth_outline(mask: Mask) -> Mask:
    """Fill the holes of a region and smooth its outline, which ringing along the edges makes jagged."""
    filled = np.asarray(scipy.ndimage.binary_fill_holes(mask), float)
    return np.asarray(scipy.ndimage.gaussian_filter(filled, 1.0) > 0.5, bool)


def _opened(mask: Mask, element: npt.NDArray) -> Mask:
    return np.asarray(scipy.ndimage.binary_opening(mask, element), bool)


def _components(mask: Mask) -> list[Mask]:
    labels = np.asarray(skimage.measure.label(mask, connectivity=1))
    return [labels == i for i in range(1, int(labels.max()) + 1)]
