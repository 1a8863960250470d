"""Which patch is the metal reference, and how it was chosen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from polysight.host.materials.permittivity import median_ratio
from polysight.host.materials.segment import Box, Mask, Patch, Segmentation, box_mask
from polysight.host.polarimetry import calibrate, correct_leakage, fresnel, permittivity_from_ratio
from polysight.shared.errors import DataError

CERTAIN_MARGIN = 1.8
"""Metal has |r_s r_p| = 1. The dielectrics of Table 2 stay below 0.22 at 55 degrees, bare water near 0.42."""
CERTAIN_MISMATCH = 0.035
"""How far |H| of the other patches may lie, in the median and relative, from what their ratio says (:func:`mismatch`).

With metal it is 0.01 on simulated scans. Random scenes of Table 2's materials, errors of 1 %: with this limit 2 % of
those without metal are called certain, and 95 % of those with it.
"""


@dataclass(frozen=True)
class MetalReference:
    """The metal region and where it came from.

    Attributes
    ----------
    mask
        bool [ny, nx], inside of the region.
    label
        Patch number, or None when a box was given.
    how
        One sentence for the report.
    certain
        False when the choice was automatic and what is seen does not show that it is metal.
    margin
        |H||V| of the chosen patch over that of the runner-up; infinite when there is none or it was given.
    """

    mask: Mask
    label: int | None
    how: str
    certain: bool = True
    margin: float = float("inf")


def metal_in_box(
    box_mm: Box, segmentation: Segmentation, x_m: npt.ArrayLike, y_m: npt.ArrayLike, valid: Mask | None = None
) -> MetalReference:
    """Metal where the user says: a box (x0, y0, x1, y1) in millimetres from the image centre.

    When the box touches one found patch, that patch's interior inside the box is used, so that a generous box does no
    harm. Raises DataError when the box holds no valid pixel.
    """
    mask = box_mask(box_mm, x_m, y_m)
    if valid is not None:
        mask &= valid
    overlaps = [(int((p.interior & mask).sum()), p) for p in segmentation.patches]
    count, patch = max(overlaps, key=lambda o: o[0], default=(0, None))
    label = None
    if patch is not None and count >= 9:
        mask, label = mask & patch.interior, patch.label
    if not mask.any():
        raise DataError(
            f"the metal box {tuple(round(b, 1) for b in box_mm)} mm holds no valid pixel",
            "it lies outside the image; boxes are in millimetres from the image centre",
            "give --metal x,y,w,h inside the image",
        )
    where = "" if label is None else f", inside patch {label}"
    return MetalReference(mask, label, f"given as a box around ({', '.join(f'{b:.0f}' for b in box_mm)}) mm{where}")


def metal_by_label(label: int, segmentation: Segmentation) -> MetalReference:
    """Metal is this patch. Raises DataError when there is no such patch."""
    for p in segmentation.patches:
        if p.label == label:
            return MetalReference(p.interior, label, f"given as patch {label}")
    raise DataError(f"there is no patch {label} to take as metal", f"{len(segmentation.patches)} patches were found")


def mismatch(
    h: npt.NDArray[np.complexfloating],
    v: npt.NDArray[np.complexfloating],
    segmentation: Segmentation,
    metal: Patch,
    theta_rad: float,
    leakage: tuple[complex, complex] = (0.0, 0.0),
) -> float:
    """How badly a patch does as metal: median over the others of |ln(|H| / |r_s|)|, r_s of the permittivity of H / V.

    Relative to metal a plate's ratio gives its permittivity (Eq. 3), and that gives |H| once more (Eq. 2): the two
    agree. Relative to a dielectric they do not, or the permittivity is none (below 1, or with gain). Thin layers do not
    obey Eq. 2 and 3 either, with whatever reference. Infinite without other patches.
    """
    relative = calibrate(h, v, metal.interior)
    ch, cv = correct_leakage(relative.h, relative.v, *leakage)
    found = []
    for p in segmentation.patches:
        if p is metal or not p.interior.any():
            continue
        eps = complex(permittivity_from_ratio(median_ratio(ch[p.interior], cv[p.interior]), theta_rad))
        physical = np.isfinite(eps) and eps.real >= 1 and eps.imag <= 0.3
        said = float(abs(fresnel(eps, theta_rad)[0])) if physical else 0.0
        level = float(np.median(np.abs(ch[p.interior])))
        found.append(abs(np.log(level / said)) if said > 0 and level > 0 else np.inf)
    return float(np.median(found)) if found else float("inf")


def find_metal(
    h: npt.NDArray[np.complexfloating],
    v: npt.NDArray[np.complexfloating],
    segmentation: Segmentation,
    theta_rad: float,
    leakage: tuple[complex, complex] = (0.0, 0.0),
) -> MetalReference:
    """Take as metal the patch that is brightest in both channels at once, and say whether what is seen bears it out.

    The measure is median |H||V| over the interior. Metal reflects both polarisations fully (|r_s| = |r_p| = 1), every
    dielectric loses most of p at these angles; the product does not depend on the unknown gains of H and V. The
    brightest patch of a scene without metal is a dielectric: it is called certain only when it is well ahead of the
    next, and when the others' brightness agrees with their ratio (:func:`mismatch`).

    Parameters
    ----------
    h, v
        complex [ny, nx], flattened by the footprint.
    segmentation
        Patches.
    theta_rad
        Incidence angle.
    leakage
        Of p into H and of s into V.

    Raises
    ------
    DataError
        when no patch was found.
    """
    scores = sorted(
        (
            (float(np.median(np.abs(h[p.interior]) * np.abs(v[p.interior]))), p)
            for p in segmentation.patches
            if p.interior.any()
        ),
        key=lambda s: -s[0],
    )
    if not scores:
        raise DataError(
            "no patch was found, so there is no metal reference",
            "the image shows nothing brighter than its background",
            "check the image (polysight image), or give a region with --metal x,y,w,h",
        )
    best, patch = scores[0]
    margin = best / scores[1][0] if len(scores) > 1 and scores[1][0] > 0 else float("inf")
    beside = "the only patch found" if len(scores) == 1 else f"|H||V| {margin:.1f} times the next"
    how = f"chosen as the patch that is brightest in both channels ({beside})"
    off = mismatch(h, v, segmentation, patch, theta_rad, leakage)
    why = ""
    if len(scores) == 1:
        why = "nothing is beside it to compare with"
    elif margin < CERTAIN_MARGIN:
        why = "another patch comes close"
    elif off > CERTAIN_MISMATCH:
        why = "relative to it the other patches' brightness and ratio do not agree: it is not metal, or they are thin"
    if why:
        how += f"; {why}, so this choice is uncertain: give --metal or --reference to be sure"
    return MetalReference(patch.interior, patch.label, how, not why, margin)
