"""Which patch is the metal reference, and how it was chosen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from polysight.host.materials.metal_evidence import MetalEvidence
from polysight.host.materials.segment import Box, Mask, Segmentation, box_mask
from polysight.shared.errors import DataError


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
    given
        Whether a person or a calibration says that it is metal.
    evidence
        What the rest of the scene says of it; None where nothing was asked.
    """

    mask: Mask
    label: int | None
    how: str
    given: bool = False
    evidence: MetalEvidence | None = None

    @property
    def certain(self) -> bool:
        """Whether it is taken for metal with reason: the rest of the scene shows it, or it is given, unopposed."""
        if self.evidence is None:
            return self.given
        return self.evidence.enough or (self.given and not self.evidence.against)


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
    return MetalReference(
        mask, label, f"given as a box around ({', '.join(f'{b:.0f}' for b in box_mm)}) mm{where}", given=True
    )


def metal_by_label(label: int, segmentation: Segmentation) -> MetalReference:
    """Metal is this patch. Raises DataError when there is no such patch."""
    for p in segmentation.patches:
        if p.label == label:
            return MetalReference(p.interior, label, f"given as patch {label}", given=True)
    raise DataError(f"there is no patch {label} to take as metal", f"{len(segmentation.patches)} patches were found")


def no_metal(usable: Mask) -> MetalReference:
    """No patch was found, so nothing is metal; images are scaled by their own mean brightness."""
    return MetalReference(usable, None, "none: no patch was found")


def find_metal(
    h: npt.NDArray[np.complexfloating], v: npt.NDArray[np.complexfloating], segmentation: Segmentation
) -> MetalReference | None:
    """The patch that is brightest in both channels at once; None without patches.

    The measure is median |H||V| over the interior. Metal reflects both polarisations fully (|r_s| = |r_p| = 1), every
    dielectric loses most of p at these angles; the product does not depend on the unknown gains of H and V. The
    brightest patch of a scene without metal is a dielectric: whether it is metal is another question
    (:func:`polysight.host.materials.metal_evidence.metal_evidence`).

    Parameters
    ----------
    h, v
        complex [ny, nx], flattened by the footprint.
    segmentation
        Patches.
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
        return None
    best, patch = scores[0]
    margin = best / scores[1][0] if len(scores) > 1 and scores[1][0] > 0 else float("inf")
    beside = "the only patch found" if len(scores) == 1 else f"|H||V| {margin:.1f} times the next"
    how = f"chosen as the patch that is brightest in both channels ({beside})"
    return MetalReference(patch.interior, patch.label, how)
