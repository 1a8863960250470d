"""From the two images to named patches: segmentation, metal reference, joint inversion, classification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.host.materials.classify import UNKNOWN, Classifier, NamedPatch, features_of
from polysight.host.materials.explain import add_explanation
from polysight.host.materials.inputs import FOUND, UNKNOWN_SCENE, Image, ImagePair, KnownScene, MetalChoice, Optics
from polysight.host.materials.inversion import Inversion, invert
from polysight.host.materials.measure import (
    AMPLIFIES,
    BELOW_AIR,
    LEAST_STD,
    Refused,
    background,
    check_patches,
    measure_patch,
    reference_std,
)
from polysight.host.materials.metal import MetalReference, find_metal, metal_by_label, metal_in_box, no_metal
from polysight.host.materials.metal_evidence import metal_evidence
from polysight.host.materials.permittivity import Permittivity, inverse_spread, permittivity_of_patch
from polysight.host.materials.result import MaterialsResult, PatchResult
from polysight.host.materials.samples import SceneErrors
from polysight.host.materials.scene_errors import scene_errors
from polysight.host.materials.segment import Patch, Segmentation, SegmentSettings, axis_mm, segment, whole_plane
from polysight.host.materials.tilts import level
from polysight.host.materials.truth import match_truth
from polysight.host.polarimetry import (
    Calibrated,
    IncidenceChoice,
    PlaneReference,
    calibrate,
    calibrate_by_reference,
    correct_leakage,
    fresnel,
    permittivity_from_ratio,
    ratio,
    smooth,
)
from polysight.shared.errors import DataError

FILLED = 0.1
"""|H| relative to metal over an image without edges from which on one material fills it, rather than none."""
ACTIVE = 2.0
"""Standard deviations of gain, or of a real part below 1, beyond which a permittivity is that of no material."""


def analyse(
    images: ImagePair,
    optics: Optics,
    metal: MetalChoice = FOUND,
    known: KnownScene = UNKNOWN_SCENE,
    classifier: Classifier | None = None,
) -> MaterialsResult:
    """Find the patches of an image pair and say what they are; without a classifier they are not named.

    A scene without patches or without metal is no error: its result has none, and says so (`metal`, `refused`).

    Raises
    ------
    DataError
        when the image has no valid pixel, or a box or number given for the metal is none.
    """
    plane = metal.plane
    if plane is not None:
        plane.check_axes(images.x_m, images.y_m)
        images = images.within(plane.valid)
    found = _patches(images, plane, known)
    images, tilts = level(images, found)
    reference = _reference(images, metal, found)
    raw = to_metal(images.h, images.v, reference, plane)
    rh, rv = (smooth_inside(c, found, optics.smooth_px) for c in (raw.h, raw.v))
    refused = check_patches(found, rh, rv, background(raw.h, raw.v, found, images.usable), reference.mask)
    std = reference_std(reference_spread(rh, rv, reference, plane))
    common, local = (std, 0.0) if plane is None else (LEAST_STD, std)
    prior = optics.prior(common)
    judged = [p for p in found.patches if p.label not in refused and p.label != reference.label]
    theta = np.asarray(optics.theta_rad, np.float64)
    measured = [measure_patch(p, rh, rv, _angle(theta, p), local) for p in judged]
    if plane is None:
        channel = _channel_ratio(images, reference) if optics.channel_ratio_known else None
        reference = replace(reference, evidence=metal_evidence(measured, prior, channel))
    inversion = invert(measured, prior)
    calibrated = without_leakage(raw, inversion.leakage)
    sh, sv = (smooth_inside(c, found, optics.smooth_px) for c in (calibrated.h, calibrated.v))
    sp = ratio(sh, sv)
    labels = [p.label for p in judged]
    estimates = dict(zip(labels, inversion.patches, strict=True))
    off = dict(zip(labels, (inversion.misfit * inversion.brightness_std).tolist(), strict=True))
    patches = {
        p.label: permittivity_of_patch(sh[p.interior], sv[p.interior], _angle(theta, p), estimates.get(p.label))
        for p in found.patches
    }
    refused |= {label: why for label, e in patches.items() if (why := _no_material(e)) is not None}
    errors = scene_errors(inversion, prior, measured) if judged else None
    named = _names(classifier, (sh, sv, sp), inversion, judged, errors, float(np.mean(theta)))
    truth = match_truth(found.patches, known.plates)
    results = tuple(
        PatchResult(p, patches[p.label], named.get(p.label), truth.get(p.label), refused.get(p.label))
        for p in found.patches
    )
    return MaterialsResult(
        calibrated, sh, sv, sp, reference, found, results, theta, inversion, prior, tilts=tilts,
        library=() if classifier is None else classifier.library.names,
        brightness_off={label: ln for label, ln in off.items() if np.isfinite(ln)},
        errors=None if errors is None else (tuple(labels), errors),
    )  # fmt: skip


def _names(
    classifier: Classifier | None,
    channels: tuple[Image, Image, Image],
    inversion: Inversion,
    judged: list[Patch],
    errors: SceneErrors | None,
    theta_rad: float,
) -> dict[int, NamedPatch]:
    """Patch number to its name, with the error budget's share in it; the metal reference is not named by itself."""
    if classifier is None or not judged:
        return {}
    h, v, p = channels
    features = []
    for patch, estimate in zip(judged, inversion.patches, strict=True):
        at = patch.interior
        by_h, by_q = _to_angle(estimate.permittivity, theta_rad + inversion.theta_error_rad, classifier.angles_deg)
        features.append(features_of(np.abs(h[at]) * by_h, np.abs(v[at]) * by_h * abs(by_q), p[at] / by_q))
    named = classifier.scan(features, errors)
    told = (
        add_explanation(n, e.permittivity, e.covariance, classifier)
        for n, e in zip(named, inversion.patches, strict=True)
    )
    return dict(zip((patch.label for patch in judged), told, strict=True))


def _to_angle(permittivity: complex | None, theta_rad: float, angles_deg: Sequence[float]) -> tuple[float, complex]:
    """Factors of |H| and of V / H that bring a half space from one angle to the library's."""
    if permittivity is None or len(angles_deg) != 1 or permittivity.real < 1:
        return 1.0, 1.0 + 0j
    (s, p), (own_s, own_p) = (fresnel(permittivity, angle) for angle in (np.radians(angles_deg[0]), theta_rad))
    return float(abs(s / own_s)), complex((p / s) / (own_p / own_s))


def _no_material(e: Permittivity) -> Refused | None:
    """Why a permittivity is that of no passive material beyond its error; None when it may be one."""
    if e.value is None or e.real_std is None or e.loss_std is None:
        return None
    move = "measure leakage (`polysight leakage`); fit a thin plate as a layer (`polysight permittivity --layer`)"
    points = "it points to leakage, a layered plate, a wrong metal reference, or H and V not on the same place"
    if e.value.imag > ACTIVE * e.loss_std + 0.02:
        return Refused(AMPLIFIES, points, move)
    if e.value.real < 1 - ACTIVE * e.real_std - 0.02:
        return Refused(BELOW_AIR, points, move)
    return None


def _angle(theta: npt.NDArray[np.float64], patch: Patch) -> float:
    """Mean incidence angle over a patch, radians."""
    inside = theta[patch.interior] if theta.ndim and patch.interior.any() else theta
    return float(np.mean(inside))


def _channel_ratio(images: ImagePair, metal: MetalReference) -> complex | None:
    """V / H of the metal reference in the images themselves."""
    h, v = images.h[metal.mask], images.v[metal.mask]
    power = float(np.sum(np.abs(h.astype(np.complex128)) ** 2))
    return complex(np.vdot(h.astype(np.complex128), v)) / power if power > 0 else None


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


def _reference(images: ImagePair, metal: MetalChoice, found: Segmentation) -> MetalReference:
    """The metal that was chosen, or the patch that must be metal; none without patches."""
    if metal.plane is not None:
        return MetalReference(metal.plane.valid, None, metal.plane.how, given=True)
    if metal.box_mm is not None:
        return metal_in_box(metal.box_mm, found, images.x_m, images.y_m, images.valid)
    if metal.label is not None:
        return metal_by_label(metal.label, found)
    return find_metal(images.h, images.v, found) or no_metal(images.usable)


def to_metal(h: Image, v: Image, metal: MetalReference, reference: PlaneReference | None) -> Calibrated:
    """Both channels relative to metal, in the scene or scanned on its own; leakage is still in them.

    Where there is no signal to divide by, the images stay as they are.
    """
    if reference is not None:
        return reference.apply(h, v)
    try:
        return calibrate(h, v, metal.mask)
    except DataError:
        if metal.given:
            raise
        return calibrate_by_reference(h, v, 1.0 + 0j, 1.0 + 0j)


def without_leakage(c: Calibrated, leakage: tuple[complex, complex]) -> Calibrated:
    """Metal-referenced channels with leakage removed."""
    h, v = correct_leakage(c.h, c.v, *leakage)
    return Calibrated(h, v, ratio(h, v), c.metal_h, c.metal_v)


def reference_spread(h: Image, v: Image, metal: MetalReference, reference: PlaneReference | None) -> float:
    """Spread of the metal's own pixels about it, relative."""
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
    """Share of interior pixels named right over all patches of known truth; None where there are none.

    Patches rightly called unknown, because the library does not hold their material, do not count.
    """
    right = [n.names == truth for n, truth in _pixels_with_truth(result)]
    return float(np.concatenate(right).mean()) if right else None


def expected_pixel_accuracy(result: MaterialsResult) -> float | None:
    """Share of the pixels of :func:`pixel_accuracy` that the best classifier is expected to name right.

    It is the mean probability of each pixel's likeliest material, so that no choice of names is expected to do better
    on these data. None without known truth, or if the classifier gives no probabilities.
    """
    shares = [n.confidence for n, _ in _pixels_with_truth(result)]
    known = [s for s in shares if s is not None]
    return float(np.concatenate(known).mean()) if known and len(known) == len(shares) else None


def _pixels_with_truth(result: MaterialsResult) -> list[tuple[NamedPatch, str]]:
    """Named patches whose truth is known, with the truth's name; without those rightly called unknown."""
    judged = [(r.named, r.verdict.name, r.truth.name) for r in result.patches if r.named and r.verdict and r.truth]
    return [(n, truth) for n, name, truth in judged if n.names.size and (name != UNKNOWN or truth in result.library)]


def image_centre_mm(x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> tuple[float, float]:
    """Rig-frame position, in millimetres, of the image centre from which boxes and outlines count."""
    x, y = np.asarray(x_m, np.float64), np.asarray(y_m, np.float64)
    return float(x[0] * 1e3 - axis_mm(x)[0]), float(y[0] * 1e3 - axis_mm(y)[0])


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
