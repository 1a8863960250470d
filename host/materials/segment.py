"""Patches in the image, without being told their number.

Plates parallel to the stage are mirrors: bright where they are, dark where nothing is. Their levels differ by more than
10 dB (wood against metal), so one threshold on the amplitude finds them but not their edges: each region found is cut
again at half of its own amplitude, which is where the edge of a band-limited step lies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from skimage import filters, measure, morphology

from shared.errors import DataError

Mask = npt.NDArray[np.bool_]
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class SegmentSettings:
    """How patches are found.

    Attributes
    ----------
    smallest_mm
        Narrowest patch that counts; narrower features (ringing at edges, speckle) are opened away.
    margin_mm
        How far inside the outline the statistics start: about twice the resolution, beyond the edge's ringing.
    smooth_px
        Gaussian on the power before thresholding.
    floor_db
        Levels below this, relative to the brightest, count as equally dark.
    least_contrast_db
        Bright and dark must differ by this much, or the image holds no patches.
    """

    smallest_mm: float = 14.0
    margin_mm: float = 9.0
    smooth_px: float = 1.0
    floor_db: float = -32.0
    least_contrast_db: float = 7.0


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
    outline_mm: npt.NDArray[np.float64]
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
    """Label image int32 [ny, nx] (0 = nothing), its patches, and the level in dB that separated bright from dark."""

    labels: npt.NDArray[np.int32]
    patches: tuple[Patch, ...]
    threshold_db: float


def axis_mm(axis_m: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """An image axis in millimetres from the image centre."""
    a = np.asarray(axis_m, np.float64)
    return (a - (a[0] + a[-1]) / 2) * 1e3


def box_mask(box_mm: Box, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> Mask:
    """Pixels whose centres lie in a box (x0, y0, x1, y1), millimetres from the image centre; bool [ny, nx]."""
    x, y = axis_mm(x_m), axis_mm(y_m)
    x0, x1 = sorted((box_mm[0], box_mm[2]))
    y0, y1 = sorted((box_mm[1], box_mm[3]))
    return ((y >= y0) & (y <= y1))[:, None] & ((x >= x0) & (x <= x1))[None, :]


def make_patch(
    label: int, mask: Mask, x_m: npt.ArrayLike, y_m: npt.ArrayLike, margin_mm: float, usable: Mask | None = None
) -> Patch:
    """Box, outline and interior of a mask [ny, nx]; the margin shrinks when the patch is too small for it."""
    x, y = axis_mm(x_m), axis_mm(y_m)
    pixel = abs(float(x[1] - x[0]))
    padded = np.pad(mask, 1)
    depth = np.asarray(ndimage.distance_transform_edt(padded))[1:-1, 1:-1] * pixel
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
    contour = max(measure.find_contours(padded.astype(np.float64), 0.5), key=len) - 1
    outline = np.column_stack([np.interp(contour[:, 1], range(x.size), x), np.interp(contour[:, 0], range(y.size), y)])
    return Patch(label, box, measure.approximate_polygon(outline, pixel / 2), int(mask.sum()), mask, interior)


def level_db(h: npt.NDArray[np.complexfloating], v: npt.NDArray[np.complexfloating], usable: Mask, smooth_px: float):
    """Smoothed amplitude of both channels together in dB below the brightest, float64 [ny, nx].

    Each channel is first scaled by its own brightest part, so that an unknown gain between H and V has no influence.
    """
    power = np.zeros(h.shape)
    for channel in (h, v):
        p = np.where(usable, np.abs(channel).astype(np.float64) ** 2, 0.0)
        top = float(np.percentile(p[usable], 99.5))
        if top > 0:
            power += p / top
    power = ndimage.gaussian_filter(power, smooth_px)
    top = float(np.percentile(power[usable], 99.5))
    return 10 * np.log10(np.maximum(power / top, 1e-12)) if top > 0 else np.full(h.shape, -120.0)


def segment(
    h: npt.NDArray[np.complexfloating],
    v: npt.NDArray[np.complexfloating],
    x_m: npt.ArrayLike,
    y_m: npt.ArrayLike,
    valid: Mask | None = None,
    settings: SegmentSettings | None = None,
) -> Segmentation:
    """Find the patches of an image pair.

    Otsu's threshold on the level in dB, morphological opening, connected components (scikit-image), each cut again at
    half of its own amplitude; what is left of a component after that is looked at again, so that a dim plate that hangs
    on a bright one's skirt is found too.

    Parameters
    ----------
    h, v
        complex [ny, nx], footprint-flattened; their gains may differ.
    x_m, y_m
        Pixel centres in metres, evenly spaced.
    valid
        bool [ny, nx], pixels to look at (None: all that are finite).
    settings
        None: the defaults.

    Returns
    -------
    Segmentation
        without patches when bright and dark cannot be told apart.

    Raises
    ------
    DataError
        when shapes differ or nothing is valid.
    """
    cfg = settings or SegmentSettings()
    if h.shape != v.shape or h.shape != (np.size(y_m), np.size(x_m)):
        raise DataError(f"images {h.shape}, {v.shape} do not fit axes of {np.size(y_m)} x {np.size(x_m)}")
    usable = np.isfinite(h) & np.isfinite(v)
    if valid is not None:
        usable &= valid
    if not usable.any():
        raise DataError("the image has no valid pixel", "nothing was recorded there, or all of it was masked")
    level = np.maximum(level_db(h, v, usable, cfg.smooth_px), cfg.floor_db)
    labels = np.zeros(h.shape, np.int32)
    inside = level[usable]
    threshold = float(filters.threshold_otsu(inside)) if np.ptp(inside) > 0 else 0.0
    bright = inside > threshold
    if not bright.any() or bright.all() or not _separate(inside, bright, cfg.least_contrast_db):
        return Segmentation(labels, (), threshold)

    pixel_mm = abs(float(axis_mm(x_m)[1] - axis_mm(x_m)[0]))
    radius = max(1, round((cfg.smallest_mm / pixel_mm - 1) / 2))
    masks = _cut(10 ** (level / 20), (level > threshold) & usable, radius)
    y = axis_mm(y_m)
    row_pitch = max(2 * cfg.smallest_mm, 1.0)

    def reading_order(mask: Mask) -> tuple[float, float]:
        rows, cols = np.nonzero(mask)
        return -round(float(y[rows].mean()) / row_pitch), float(cols.mean())

    patches = []
    for mask in sorted(masks, key=reading_order):
        labels[mask] = len(patches) + 1
        patches.append(make_patch(len(patches) + 1, mask, x_m, y_m, cfg.margin_mm, usable))
    return Segmentation(labels, tuple(patches), threshold)


def _separate(level: npt.NDArray[np.float64], bright: Mask, least_contrast_db: float) -> bool:
    """Whether two classes are there: their distance, and the share of variance between them.

    Otsu also splits a single normal distribution, with 2/pi = 0.64 of the variance between the halves.
    """
    w = float(bright.mean())
    gap = float(level[bright].mean() - level[~bright].mean())
    return gap >= least_contrast_db and w * (1 - w) * gap**2 >= 0.70 * float(level.var())


def _cut(amplitude: npt.NDArray[np.float64], mask: Mask, radius: int) -> list[Mask]:
    """Connected regions of a mask, each bounded where the amplitude falls to half of its own level."""
    disk = np.asarray(morphology.disk(radius), bool)
    skirt = np.asarray(morphology.disk(radius + 1), bool)
    found: list[Mask] = []
    queue = _components(_opened(mask, disk))
    while queue:
        region = queue.pop()
        own = float(np.percentile(amplitude[region], 70))
        core = _opened(region & (amplitude > own / 2), disk)
        parts = _components(core)
        if not parts:
            continue
        near = np.asarray(ndimage.binary_dilation(core, skirt), bool)
        queue += _components(_opened(region & ~near, disk))
        if len(parts) == 1:
            found.append(_even(parts[0]))
        else:
            queue += parts
    return found


def _even(mask: Mask) -> Mask:
    """A region without holes, its outline evened: ringing along the edges makes it jagged."""
    filled = np.asarray(ndimage.binary_fill_holes(mask), float)
    return np.asarray(ndimage.gaussian_filter(filled, 1.0) > 0.5, bool)


def _opened(mask: Mask, element: npt.NDArray) -> Mask:
    return np.asarray(ndimage.binary_opening(mask, element), bool)


def _components(mask: Mask) -> list[Mask]:
    labels = np.asarray(measure.label(mask, connectivity=1))
    return [labels == i for i in range(1, int(labels.max()) + 1)]
