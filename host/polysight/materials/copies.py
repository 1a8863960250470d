"""Find weak copies of plates in the images, which are a sign of a second path besides the direct path.

Samples are divided by the direct path. A second path in addition to it makes fringes over the scan, and fringes add a
copy of the whole image: displaced, and weaker by the ratio of the second path to the direct path. The displacement
differs between H and V.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from polysight.imaging import Image, Mask
from polysight.materials.segment import Patch

WEAK_DB = -12.0
WEAKEST_DB = -30.0
"""Levels of copies relative to the brightest plate: shares of a quarter to a thirtieth; chosen."""
LEAST_OVERLAP = 0.6
"""Least share of a copy's pixels that shifted plates cover, and of the shifted plates' pixels that copies cover;
chosen."""
SAME_DB = 3.0
"""Largest deviation of a copy's level from the others', relative to its plate; chosen."""
VISIBLE_AMPLITUDE = 0.06
"""Amplitude relative to the brightest plate at which the other channel shows a patch: -24 dB; chosen."""
SKIRT_PX = 4
"""Pixels around the plates in which a copy cannot be distinguished from the plate's own edge; chosen."""


@dataclass(frozen=True)
class Copies:
    """Patch numbers that are copies, their shift in millimetres (x, y), and their level relative to their plates."""

    labels: tuple[int, ...]
    shift_mm: tuple[float, float]
    level_db: float


def find_copies(patches: Sequence[Patch], h: Image, v: Image, pixel_mm: float) -> Copies | None:
    """Find weak patches that repeat the brighter ones, all with one shift and one level; None without two of them.

    `h`, `v` complex [ny, nx] are the images that the patches were found in, `pixel_mm` the size of their pixels. Copies
    in either channel count; of both channels the one with more of them is returned.
    """
    amplitudes = [np.abs(h), np.abs(v)]
    copies_of_channels = []
    # Each channel once, paired with the other one.
    for amplitude, other in (amplitudes, amplitudes[::-1]):
        copies = _find_copies_in_channel(patches, amplitude, pixel_mm)
        if copies is not None and not _are_plates(copies, patches, other, pixel_mm):
            copies_of_channels.append(copies)
    if not copies_of_channels:
        return None
    return max(copies_of_channels, key=lambda copies: len(copies.labels))


def _are_plates(copies: Copies, patches: Sequence[Patch], other: np.ndarray, pixel_mm: float) -> bool:
    """Return true if the patches taken for copies in one channel are weak plates, by the evidence of the other channel.

    A plate is at the same place in both channels, a copy is not. So they are plates if `other`, float [ny, nx], the
    amplitude of the other channel, shows all of them, unless some of them are found to be copies there, too.
    """
    brightest = max(float(np.median(other[p.mask])) for p in patches)
    visible_patches = [
        p
        for p in patches
        if p.label in copies.labels and float(np.median(other[p.mask])) > VISIBLE_AMPLITUDE * brightest
    ]
    if len(visible_patches) < len(copies.labels):
        return False
    copy_in_other = _find_copies_in_channel(patches, other, pixel_mm)
    return copy_in_other is None or not set(copies.labels) & set(copy_in_other.labels)


def _find_copies_in_channel(patches: Sequence[Patch], amplitude: np.ndarray, pixel_mm: float) -> Copies | None:
    """Find the copies of one channel, of `amplitude` float [ny, nx], at the shift with most of them."""
    # Two copies and two plates at least.
    if len(patches) < 4:
        return None
    # Weak patches may be copies of bright ones.
    level_db = [20 * np.log10(max(float(np.median(amplitude[p.mask])), 1e-30)) for p in patches]
    below_db = np.array(level_db) - max(level_db)
    weak = [p for p, below in zip(patches, below_db, strict=True) if WEAKEST_DB < below < WEAK_DB]
    bright = [p for p, below in zip(patches, below_db, strict=True) if below >= WEAK_DB]
    if len(weak) < 2:
        return None
    plates = np.logical_or.reduce([p.mask for p in bright])
    hidden = np.asarray(scipy.ndimage.binary_dilation(plates, iterations=SKIRT_PX), bool)
    best: Copies | None = None
    # Each pair of a weak and a bright patch is a shift to try.
    for copy in weak:
        for plate in bright:
            dx, dy = ((a - b) for a, b in zip(copy.centre_mm, plate.centre_mm, strict=True))
            shift_px = (round(dy / pixel_mm), round(dx / pixel_mm))
            copies = _find_copies_at_shift(weak, plates, hidden, amplitude, shift_px, pixel_mm)
            if copies is not None and (best is None or len(copies.labels) > len(best.labels)):
                best = copies
    return best


def _find_copies_at_shift(
    weak: Sequence[Patch],
    plates: Mask,
    hidden: Mask,
    amplitude: np.ndarray,
    shift_px: tuple[int, int],
    pixel_mm: float,
) -> Copies | None:
    """Return the copies with this shift (rows, columns), None if fewer than two fit.

    `weak` are the patches that may be copies, `plates` the pixels of the bright ones, `hidden` those in which a copy
    cannot be distinguished from a plate's edge, bool [ny, nx].
    """
    expected = np.asarray(scipy.ndimage.shift(plates.astype(np.uint8), shift_px, order=0), bool) & ~hidden
    observed = np.logical_or.reduce([p.mask for p in weak])
    if not expected.any() or float((expected & observed).sum()) < LEAST_OVERLAP * float(expected.sum()):
        return None
    # The image shifted onto its copy gives the level of each patch relative to the plate of which it may be a copy.
    shifted = np.asarray(scipy.ndimage.shift(amplitude, shift_px, order=0))
    levels_db = {}
    for patch in weak:
        overlap = patch.mask & expected
        if float(overlap.sum()) >= LEAST_OVERLAP * float(patch.mask.sum()):
            levels_db[patch.label] = 20 * float(np.log10(np.median(amplitude[overlap]) / np.median(shifted[overlap])))
    middle_db = float(np.median(list(levels_db.values()))) if levels_db else 0.0
    labels = tuple(label for label, level in levels_db.items() if abs(level - middle_db) <= SAME_DB)
    if len(labels) < 2 or middle_db > WEAK_DB:
        return None
    return Copies(labels, (shift_px[1] * pixel_mm, shift_px[0] * pixel_mm), middle_db)
