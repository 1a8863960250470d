"""From the two images to named patches: segmentation, metal reference, permittivity, classification."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.host.imaging import ChannelImages
from polysight.host.materials.classify import Classifier, Verdict, features_of
from polysight.host.materials.metal import MetalReference, find_metal, metal_by_label, metal_in_box
from polysight.host.materials.permittivity import Permittivity, estimate_permittivity, inverse_spread
from polysight.host.materials.segment import Box, Patch, Segmentation, SegmentSettings, axis_mm, segment, whole_plane
from polysight.host.materials.truth import TruthPlate, match
from polysight.host.polarimetry import (
    Calibrated,
    IncidenceChoice,
    PlaneReference,
    calibrate,
    correct_leakage,
    permittivity_from_ratio,
    ratio,
    smooth,
)
from polysight.shared.config import Instrument

Image = npt.NDArray[np.complexfloating]
FILLED = 0.1
"""|H| relative to metal over an image without edges from which on one material fills it, rather than none."""


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
    bands
        Patch number to its ratios in sub-bands of the sweep (:mod:`polysight.host.materials.sub_bands`); empty when not asked for.
    boxes
        Patch number to the name of the box drawn by hand; empty when the patches were found.
    """

    calibrated: Calibrated
    h: Image
    v: Image
    p: Image
    metal: MetalReference
    segmentation: Segmentation
    patches: tuple[PatchResult, ...]
    theta_rad: npt.NDArray[np.float64]
    bands: dict[int, list[dict[str, Any]]] = field(default_factory=dict)
    boxes: dict[int, str] = field(default_factory=dict)

    def rows(self) -> list[dict[str, Any]]:
        """One plain dict a patch, ready for materials.json (no infinities, complex numbers as real and imaginary)."""
        return [self._row(r) for r in self.patches]

    def incidence_deg(self, patch: Patch) -> float:
        """Mean incidence angle over a patch's interior, degrees."""
        inside = self.theta_rad[patch.interior] if self.theta_rad.ndim and patch.interior.any() else self.theta_rad
        return float(np.degrees(np.mean(inside)))

    def _row(self, r: PatchResult) -> dict[str, Any]:
        row = _row(r, self.metal, self.incidence_deg(r.patch))
        level = np.abs(self.h[r.patch.interior])
        level = level[np.isfinite(level)]
        row["amplitude_h"] = round(float(np.median(level)), 6) if level.size else None
        if r.patch.label in self.bands:
            row["bands"] = self.bands[r.patch.label]
        if r.patch.label in self.boxes:
            row["box"] = self.boxes[r.patch.label]
        return row


@dataclass(frozen=True)
class ImagePair:
    """The two channel images that are analysed.

    Attributes
    ----------
    h, v
        complex [ny, nx], flattened by the footprint of a mirror, not yet metal-referenced.
    x_m, y_m
        Pixel centres, metres, [nx] and [ny].
    valid
        bool [ny, nx]; None: all of it.
    """

    h: Image
    v: Image
    x_m: npt.ArrayLike
    y_m: npt.ArrayLike
    valid: npt.NDArray[np.bool_] | None = None

    @classmethod
    def of(cls, images: ChannelImages) -> ImagePair:
        """The pair of channel images as imaging makes them."""
        return cls(images.h, images.v, images.x_m, images.y_m, images.valid)

    def within(self, area: npt.NDArray[np.bool_]) -> ImagePair:
        """The same, valid only inside `area`, bool [ny, nx]."""
        return replace(self, valid=area if self.valid is None else self.valid & area)


@dataclass(frozen=True)
class Optics:
    """What turns images into permittivity.

    Attributes
    ----------
    theta_rad
        Incidence angle, a number or [ny, nx].
    leakage
        Cross-polar leakage (p in H, s in V) to remove.
    smooth_px
        Width (standard deviation, pixels) of the filter against speckle before permittivity and classification,
        inside each patch.
    """

    theta_rad: npt.ArrayLike
    leakage: tuple[complex, complex] = (0.0, 0.0)
    smooth_px: float = 2.0

    @classmethod
    def of(cls, rig: Instrument, angles: IncidenceChoice) -> Optics:
        """A rig's leakage and filter, under the angles that were chosen."""
        p = rig.polarimetry
        return cls(angles.used_rad, (complex(*p.leakage_h), complex(*p.leakage_v)), p.smooth_px)


@dataclass(frozen=True)
class MetalChoice:
    """Which metal is the reference: a box, a known patch, a plate scanned on its own; none of them: the metal is found.

    Attributes
    ----------
    box_mm
        x0, y0, x1, y1 in millimetres from the image centre.
    label
        Number of one of the known patches.
    plane
        A metal plate over the whole plane, instead of metal in this scene; where it is not valid nothing is looked at.
    """

    box_mm: Box | None = None
    label: int | None = None
    plane: PlaneReference | None = None


@dataclass(frozen=True)
class KnownScene:
    """What is known of the scene.

    Attributes
    ----------
    segmentation
        Patches that are known (boxes drawn by hand); None: they are found.
    plates
        The truth, where known: only carried along to the results, never used for them.
    settings
        How to find patches.
    """

    segmentation: Segmentation | None = None
    plates: Sequence[TruthPlate] = ()
    settings: SegmentSettings | None = None


FOUND = MetalChoice()
"""The metal reference is found in the scene."""
UNKNOWN_SCENE = KnownScene()


def analyse(
    images: ImagePair,
    optics: Optics,
    metal: MetalChoice = FOUND,
    known: KnownScene = UNKNOWN_SCENE,
    classifier: Classifier | None = None,
) -> MaterialsResult:
    """Find the patches of an image pair and say what they are; without a classifier they are not named.

    Raises
    ------
    DataError
        when there is no metal reference, or the image is empty.
    """
    plane = metal.plane
    if plane is not None:
        plane.check_axes(images.x_m, images.y_m)
        images = images.within(plane.valid)
    found = _patches(images, plane, known)
    reference = _reference(images, optics, metal, found)
    calibrated = to_metal(images.h, images.v, reference, optics.leakage, plane)
    sh, sv = (smooth_inside(c, found, optics.smooth_px) for c in (calibrated.h, calibrated.v))
    sp = ratio(sh, sv)
    theta = np.asarray(optics.theta_rad, np.float64)
    truth = match(found.patches, known.plates)
    reference_std = reference_error(sh, sv, reference, plane)
    inside = [patch.interior for patch in found.patches]
    named = classifier.scan([features_of(sh[at], sv[at], sp[at]) for at in inside]) if classifier else None
    results = []
    for i, patch in enumerate(found.patches):
        at = patch.interior
        angle = theta[at] if theta.ndim else theta
        results.append(
            PatchResult(
                patch,
                estimate_permittivity(sh[at], sv[at], angle, reference_std),
                named[i].verdict if named else None,
                named[i].names if named else None,
                truth.get(patch.label),
            )
        )
    return MaterialsResult(calibrated, sh, sv, sp, reference, found, tuple(results), theta)


def _patches(images: ImagePair, plane: PlaneReference | None, known: KnownScene) -> Segmentation:
    """The known patches, as far as the image reaches, or those that are found."""
    given = _within(known.segmentation, images.valid)
    if given:
        return given
    if plane is None:
        return segment(images.h, images.v, images.x_m, images.y_m, images.valid, known.settings)
    even = plane.apply(images.h, images.v)
    found = segment(even.h, even.v, images.x_m, images.y_m, images.valid, known.settings)
    if not found.patches and float(np.median(np.abs(even.h[images.valid]))) > FILLED:
        margin_mm = (known.settings or SegmentSettings()).margin_mm
        return whole_plane(plane.valid if images.valid is None else images.valid, images.x_m, images.y_m, margin_mm)
    return found


def _reference(images: ImagePair, optics: Optics, metal: MetalChoice, found: Segmentation) -> MetalReference:
    """The metal that was chosen, or the patch that must be metal. Raises DataError when there is none."""
    if metal.plane is not None:
        return MetalReference(metal.plane.valid, None, metal.plane.how)
    if metal.box_mm is not None:
        return metal_in_box(metal.box_mm, found, images.x_m, images.y_m, images.valid)
    if metal.label is not None:
        return metal_by_label(metal.label, found)
    return find_metal(images.h, images.v, found, float(np.mean(np.asarray(optics.theta_rad))), optics.leakage)


def to_metal(
    h: Image, v: Image, metal: MetalReference, leakage: tuple[complex, complex], reference: PlaneReference | None
) -> Calibrated:
    """Both channels relative to metal, in the scene or scanned on its own, with leakage removed."""
    raw = calibrate(h, v, metal.mask) if reference is None else reference.apply(h, v)
    ch, cv = correct_leakage(raw.h, raw.v, *leakage)
    return Calibrated(ch, cv, ratio(ch, cv), raw.metal_h, raw.metal_v)


def reference_error(h: Image, v: Image, metal: MetalReference, reference: PlaneReference | None) -> float:
    """Relative standard error of the metal reference: how far its own pixels lie from it."""
    spread = inverse_spread(h[metal.mask], v[metal.mask]) if reference is None else reference.spread
    return spread if np.isfinite(spread) else 0.0


def _within(found: Segmentation | None, valid: npt.NDArray[np.bool_] | None) -> Segmentation | None:
    """The same patches, if any, their interiors cut to the pixels that are valid."""
    if found is None or valid is None:
        return found
    return replace(found, patches=tuple(replace(p, interior=p.interior & valid) for p in found.patches))


def smooth_inside(image: Image, found: Segmentation, sigma_px: float) -> Image:
    """Gaussian filter over each patch's interior by itself, however close the next one; not a number elsewhere."""
    out = np.full(image.shape, complex(np.nan, np.nan), image.dtype)
    reach = int(np.ceil(4 * sigma_px))
    for patch in found.patches:
        if patch.interior.any():
            lines, columns = (np.flatnonzero(patch.interior.any(axis=axis)) for axis in (1, 0))
            near = tuple(slice(max(0, at[0] - reach), at[-1] + reach + 1) for at in (lines, columns))
            inside = patch.interior[near]
            one = smooth(np.where(inside, image[near], complex(np.nan, np.nan)).astype(image.dtype), sigma_px)
            out[near] = np.where(inside, one, out[near])
    return out


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
        "metal_like": not e.determinable and bool(np.isfinite(e.ratio)),  # a box without a valid pixel is nothing
        "truth": truth,
    }


def permittivity_change(found: MaterialsResult, angles: IncidenceChoice) -> dict[str, Any]:
    """Largest relative change of a patch's permittivity (Eq. 3) if the other angle were used; for quality.json.

    `largest_permittivity_change` is |eps_other / eps - 1|, `of_patch` its number; empty without any permittivity.
    """
    changes = []
    for r in found.patches:
        at = r.patch.interior
        if r.permittivity.value is not None and at.any():
            used, other = (float(np.mean(a[at])) for a in (angles.used_rad, angles.other_rad))
            eps = permittivity_from_ratio(r.permittivity.ratio, np.array([used, other]))
            changes.append((float(abs(eps[1] / eps[0] - 1)), r.patch.label))
    if not changes:
        return {}
    largest, label = max(changes)
    return {"largest_permittivity_change": round(largest, 5), "of_patch": label}
