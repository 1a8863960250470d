"""From the two images to named patches: segmentation, metal reference, permittivity, classification."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from host.materials.classify import Classifier, Verdict, vote
from host.materials.metal import MetalReference, find_metal, metal_by_label, metal_in_box
from host.materials.permittivity import Permittivity, estimate_permittivity, inverse_spread
from host.materials.segment import Box, Patch, Segmentation, SegmentSettings, axis_mm, segment
from host.materials.truth import TruthPlate, match
from host.polarimetry import Calibrated, calibrate, correct_leakage, ratio, smooth

Image = npt.NDArray[np.complexfloating]


@dataclass(frozen=True)
class PatchResult:
    """One patch with everything found about it; `names` are those of the interior's pixels, in image order."""

    patch: Patch
    permittivity: Permittivity
    verdict: Verdict | None
    names: npt.NDArray[np.str_] | None
    truth: TruthPlate | None


@dataclass(frozen=True)
class MaterialsResult:
    """Everything found in one image pair.

    Attributes
    ----------
    calibrated
        Metal-referenced, leakage-corrected channels [ny, nx], not smoothed.
    h, v, p
        The same after the Gaussian filter inside each patch: the features of classification and permittivity. Not a
        number outside the patches' interiors, so that no edge and no neighbour gets into a material's pixels.
    metal
        The reference and how it was chosen.
    segmentation
        Patches and label image.
    patches
        What each patch is.
    theta_rad
        Incidence angle, a number or [ny, nx].
    """

    calibrated: Calibrated
    h: Image
    v: Image
    p: Image
    metal: MetalReference
    segmentation: Segmentation
    patches: tuple[PatchResult, ...]
    theta_rad: npt.NDArray[np.float64]

    def rows(self) -> list[dict[str, Any]]:
        """One plain dict a patch, ready for materials.json (no infinities, complex numbers as real and imaginary)."""
        return [_row(r, self.metal, float(np.degrees(np.mean(self.theta_rad)))) for r in self.patches]


def analyse(
    h: Image,
    v: Image,
    x_m: npt.ArrayLike,
    y_m: npt.ArrayLike,
    valid: npt.NDArray[np.bool_] | None = None,
    *,
    theta_rad: npt.ArrayLike,
    classifier: Classifier | None = None,
    metal_box_mm: Box | None = None,
    metal_label: int | None = None,
    leakage: tuple[complex, complex] = (0.0, 0.0),
    smooth_px: float = 2.0,
    plates: Sequence[TruthPlate] = (),
    settings: SegmentSettings | None = None,
    segmentation: Segmentation | None = None,
) -> MaterialsResult:
    """Find the patches of an image pair and say what they are.

    Parameters
    ----------
    h, v
        complex [ny, nx], flattened by the footprint of a mirror, not yet metal-referenced.
    x_m, y_m
        Pixel centres, metres.
    valid
        bool [ny, nx].
    theta_rad
        Incidence angle, a number or [ny, nx].
    classifier
        None: patches are not named.
    metal_box_mm, metal_label
        The metal reference, when the user says where it is; else it is found (:func:`find_metal`).
    leakage
        Cross-polar leakage (p in H, s in V) to remove.
    smooth_px
        Gaussian filter against speckle before permittivity and classification, inside each patch.
    plates
        The truth, where known: only carried along to the results, never used for them.
    settings, segmentation
        How to segment; or patches that are already known (boxes drawn by hand).

    Raises
    ------
    DataError
        when there is no metal reference, or the image is empty.
    """
    found = segmentation if segmentation is not None else segment(h, v, x_m, y_m, valid, settings)
    if metal_box_mm is not None:
        metal = metal_in_box(metal_box_mm, found, x_m, y_m, valid)
    elif metal_label is not None:
        metal = metal_by_label(metal_label, found)
    else:
        metal = find_metal(h, v, found)
    raw = calibrate(h, v, metal.mask)
    ch, cv = correct_leakage(raw.h, raw.v, *leakage)
    calibrated = Calibrated(ch, cv, ratio(ch, cv), raw.metal_h, raw.metal_v)
    sh, sv = _smooth_inside(ch, found, smooth_px), _smooth_inside(cv, found, smooth_px)
    sp = ratio(sh, sv)
    theta = np.asarray(theta_rad, np.float64)
    truth = match(found.patches, plates)
    reference_std = inverse_spread(sh[metal.mask], sv[metal.mask])
    reference_std = reference_std if np.isfinite(reference_std) else 0.0
    results = []
    for patch in found.patches:
        at = patch.interior
        angle = theta[at] if theta.ndim else theta
        names = distance = None
        if classifier is not None:
            names, distance = classifier.pixels(np.abs(sh[at]), np.abs(sv[at]), sp[at])
        results.append(
            PatchResult(
                patch,
                estimate_permittivity(sh[at], sv[at], angle, reference_std),
                None if names is None or distance is None else vote(names, distance),
                names,
                truth.get(patch.label),
            )
        )
    return MaterialsResult(calibrated, sh, sv, sp, metal, found, tuple(results), theta)


def _smooth_inside(image: Image, found: Segmentation, sigma_px: float) -> Image:
    """Gaussian filter over the patches' interiors only; not a number elsewhere."""
    inside = np.zeros(image.shape, bool)
    for patch in found.patches:
        inside |= patch.interior
    return smooth(np.where(inside, image, complex(np.nan, np.nan)).astype(image.dtype), sigma_px)


def pixel_accuracy(result: MaterialsResult) -> float | None:
    """Share of interior pixels named right over all patches of known truth; None where there are none."""
    pairs = [(r.names, r.truth.name) for r in result.patches if r.names is not None and r.truth is not None]
    total = sum(names.size for names, _ in pairs)
    return sum(int((names == name).sum()) for names, name in pairs) / total if total else None


def image_centre_mm(x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> tuple[float, float]:
    """Rig-frame position, in millimetres, of the image centre from which boxes and outlines count."""
    x, y = np.asarray(x_m, np.float64), np.asarray(y_m, np.float64)
    return float(x[0] * 1e3 - axis_mm(x)[0]), float(y[0] * 1e3 - axis_mm(y)[0])


def _complex(z: complex | None) -> dict[str, float] | None:
    if z is None or not (math.isfinite(z.real) and math.isfinite(z.imag)):
        return None
    return {"real": z.real, "imag": z.imag}


def _row(r: PatchResult, metal: MetalReference, incidence_deg: float) -> dict[str, Any]:
    e, v = r.permittivity, r.verdict
    permittivity = None
    if e.value is not None and e.real_range is not None and e.imag_range is not None:
        permittivity = {
            "real": e.value.real,
            "imag": e.value.imag,
            "real_p30_p70": list(e.real_range),
            "imag_p30_p70": list(e.imag_range),
            "real_std": e.real_std,
            "imag_std": e.loss_std,
        }
    truth = None
    if r.truth is not None:
        truth = {
            "name": r.truth.name,
            "metal": r.truth.metal,
            "permittivity": _complex(r.truth.permittivity),
            "thickness_mm": r.truth.thickness_mm,
        }
    return {
        "label": r.patch.label,
        "name": v.name if v else None,
        "confidence": v.confidence if v else None,
        "votes": v.votes if v else {},
        "distance": v.distance if v and math.isfinite(v.distance) else None,
        "metal_reference": r.patch.label == metal.label,
        "box_mm": [round(b, 3) for b in r.patch.box_mm],
        "outline_mm": [[round(float(x), 2), round(float(y), 2)] for x, y in r.patch.outline_mm],
        "pixels": r.patch.pixels,
        "interior_pixels": e.pixels,
        "incidence_deg": incidence_deg,
        "ratio": _complex(e.ratio),
        "inverse_ratio_std": e.inverse_std if math.isfinite(e.inverse_std) else None,
        "permittivity": permittivity,
        "metal_like": not e.determinable,
        "truth": truth,
    }
