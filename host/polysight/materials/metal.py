"""The metal reference: the region that everything is divided by, and the evidence that it is metal.

It is given as a box or a patch, or it is the patch that is brightest in both channels. Evidence is its own: V / H
against the direct path, which reaches both boards with equal strength. Metal reflects both polarisations fully, a
dielectric loses most of p at these angles. A declared metal is contradicted by nothing else.

The other patches give evidence on a metal that nobody declared. If the patch is metal, their ratios relative to it are
those of materials. If it is a dielectric of inverse ratio t0, their true ratios are q t0, and the density of the
measured q is that of materials at q t0, times |t0|^2: dielectrics would have to lie close together. In either case
their |H| has to be that of these materials (Eq. 2), as far as brightness in this scene says anything. The score is the
logarithm of the ratio of both evidences, the second integrated over every material that the patch may be.

Metal is the strongest echo of V by far, in H it is one of many. An overdriven receiver (clipping) loses part of it and
spreads the rest around the metal, in V more than in H (`find_halo`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import scipy

from polysight.imaging import Image, Images, Mask
from polysight.materials.inversion import BRIGHTNESS_RANGE, METAL_BRIGHTNESS_STD, PatchMeasurement, RigPrior
from polysight.materials.kinds import Kinds
from polysight.materials.segment import Box, Patch, Segmentation, box_mask
from polysight.materials.specimens import METAL_UNLIKE
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

Real = npt.NDArray[np.float64]

CHANNEL_RATIO_STD_DB = 2.5
"""Standard deviation of metal's V / H relative to the direct path's: the boards' patterns differ off their axis."""
DOUBTFUL_V_DB = -3.0
WEAK_V_DB = -7.0
"""V / H relative to the direct path below which a patch that nobody declared is no metal, and below which even a
declared one is none: half spaces of eps' up to 10 have -8 dB or less, bare water -4 dB, metal 0 dB, but for the
patterns of the antennas (-4 dB with those of an independent generator)."""
SURE_SCORE = 3.0
CONFLICT_SCORE = -3.0
"""Score below which the other patch that fits metal least is told."""
HALO_MM = (6.0, 36.0)
"""Distances from the metal's edge at which its halo is measured."""
AROUND_MM = (4.0, 14.0)
"""The same for the other plates."""
HALO_EXCESS = 1.6
"""Power of V beside the metal relative to H's, each relative to metal, above which it is a halo: 2 dB; undisturbed
scenes of an independent generator have -7 to 0 dB, clipped ones 2 to 8 dB."""
_CELLS = 128
_EDGE = 1.15
# Share of other patches that are nothing known, and their density of t
_ODD_PATCH = 0.1
_ODD_DENSITY = 0.5


@dataclass(frozen=True)
class MetalEvidence:
    """Evidence for and against a patch being metal.

    Attributes
    ----------
    score
        Logarithm of the ratio of the evidences of metal and of a dielectric; positive values support metal.
    others
        Number of other patches that differ from the judged one. Similar patches give no evidence: metal beside metal
        looks like water beside water.
    channel_ratio_db
        V / H of the patch relative to the direct path; None if not known.
    culprit
        Number of the other patch that fits metal least, if the score speaks against metal; None otherwise.
    """

    score: float
    others: int
    channel_ratio_db: float | None
    culprit: int | None = None

    @property
    def needed(self) -> float:
        """Least score to count as metal, from random scenes (tests/materials/test_metal_evidence.py)."""
        if self.others == 0:
            return np.inf
        # The verdict is never good without a direct path
        if self.channel_ratio_db is None:
            return 1.0 if self.others == 1 else 0.5
        return 0.4 if self.others == 1 else 0.75

    @property
    def sure(self) -> bool:
        """True if it is certainly metal: very lossy dielectrics (wet, conducting) come close to metal."""
        return self.enough and self.score >= SURE_SCORE

    @property
    def against(self) -> bool:
        """True if its own V / H contradicts metal, even if the user declares it."""
        return self.channel_ratio_db is not None and self.channel_ratio_db < WEAK_V_DB

    @property
    def enough(self) -> bool:
        """True if the patch is shown to be metal."""
        doubtful = self.channel_ratio_db is not None and self.channel_ratio_db < DOUBTFUL_V_DB
        return self.score >= self.needed and not doubtful


def metal_evidence(
    patches: Mapping[int, PatchMeasurement], prior: RigPrior, channel_ratio: complex | None, kinds: Kinds
) -> MetalEvidence:
    """Weigh the explanations of a patch as metal and as a dielectric.

    `patches` are the other patches by their number, relative to the judged one; `channel_ratio` is V / H of the patch
    itself in images referenced to the direct path, None for others; `kinds` are the materials that patches may be.
    """
    if channel_ratio is None or not abs(channel_ratio) > 0:
        level = None
    else:
        level = 20 * float(np.log10(abs(channel_ratio)))
    unlike = [label for label, measurements in patches.items() if abs(measurements.inverse_ratio - 1) > METAL_UNLIKE]
    measurements = [patches[label] for label in unlike]
    if not unlike:
        return MetalEvidence(0.0, 0, level)
    q = np.array([s.inverse_ratio for s in measurements], np.complex128)
    variance = np.median([np.trace(s.covariance) / 2 for s in measurements])
    blur = float(variance + 2 * prior.leakage_std**2 + prior.reference_std**2 * np.median(np.abs(q)) ** 2)
    corner = complex(_EDGE, _EDGE)
    density = kinds.density_map(-corner, corner, blur * np.eye(2), _CELLS)
    axis = np.linspace(-_EDGE, _EDGE, _CELLS)
    t0 = axis[None, :] + 1j * axis[:, None]

    def other_patches(own_t: npt.NDArray[np.complex128]) -> npt.NDArray[np.float64]:
        """Return log densities of the measured q if the judged patch has t [...], [..., patch]."""
        usual = np.exp(density.log_densities(own_t[..., None] * q)[1]) * np.abs(own_t[..., None]) ** 2
        return np.log((1 - _ODD_PATCH) * usual + _ODD_PATCH * _ODD_DENSITY)

    theta = np.array([s.theta_rad for s in measurements])
    dull = float(np.hypot(BRIGHTNESS_RANGE[0], 1.5 * prior.leakage_std))
    level_of = [s.brightness for s in measurements]
    brightness = np.array([np.nan if value is None else value for value in level_of], np.float64)
    as_metal = other_patches(np.asarray(1.0 + 0j))
    dielectric = density.log_density[1] + other_patches(t0).sum(axis=-1) + _brightness(t0, q, brightness, theta, dull)
    metal = float(as_metal.sum()) + float(_brightness(np.asarray(1.0 + 0j), q, brightness, theta, dull))
    if level is not None:
        metal += -0.5 * (level / CHANNEL_RATIO_STD_DB) ** 2
        level_of_t0 = 20 * np.log10(np.maximum(np.abs(t0), 1e-3))
        dielectric = dielectric - 0.5 * ((level_of_t0 - level) / CHANNEL_RATIO_STD_DB) ** 2
    dielectric = np.where((np.abs(t0 - 1) < METAL_UNLIKE) | (np.abs(t0) > 1), -np.inf, dielectric)
    top = float(dielectric.max())
    cell = (axis[1] - axis[0]) ** 2
    score = metal - (top + float(np.log(np.exp(dielectric - top).sum() * cell)))
    culprit = unlike[int(np.argmin(as_metal))] if score < CONFLICT_SCORE else None
    return MetalEvidence(score, len(unlike), level, culprit)


def _brightness(
    own_t: npt.NDArray[np.complex128], q: npt.NDArray[np.complex128], level: Real, theta: Real, least_std: float
) -> Real:
    """Return the log evidence of the other patches' |H| [patch] if the judged patch has t [...], [...].

    Their ln |H| scatters about Eq. 2's by an unknown amount, `least_std` or more; the judged patch has its own error.
    """
    positive = np.isfinite(level) & (level > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = _log_r_s(own_t[..., None] * q[positive], theta[positive]) - _log_r_s(own_t, theta.mean())[..., None]
        difference = np.log(level[positive]) - expected
    difference = np.clip(np.nan_to_num(difference, nan=5.0, posinf=5.0, neginf=-5.0), -5, 5)
    n = int(positive.sum())
    size2 = np.geomspace(least_std, BRIGHTNESS_RANGE[1], 8) ** 2
    total = (difference.sum(axis=-1) ** 2)[..., None]
    squares = (difference**2).sum(axis=-1)[..., None]
    common2 = METAL_BRIGHTNESS_STD**2
    # Patches share the judged patch's own error: the covariance is size^2 I + common^2 1 1'.
    distance2 = (squares - common2 * total / (size2 + n * common2)) / size2
    evidence = -0.5 * (distance2 + (n - 1) * np.log(size2) + np.log(size2 + n * common2))
    return np.asarray(scipy.special.logsumexp(evidence, axis=-1) - np.log(size2.size), np.float64)


def _log_r_s(t: npt.NDArray[np.complex128], theta: npt.ArrayLike) -> Real:
    """Return ln|r_s| of half spaces with t = r_p / r_s [...]; 0 of metal."""
    cosine = np.cos(theta)
    q = (1 + t) / (1 - t) * np.sin(theta) ** 2 / cosine
    return np.where(np.abs(1 - t) < 1e-9, 0.0, np.log(np.abs((cosine - q) / (cosine + q))))


@dataclass(frozen=True)
class MetalReference:
    """The metal region and its origin.

    Attributes
    ----------
    mask
        bool [ny, nx], interior of the region.
    label
        Patch number; None for a given box outside all patches.
    how
        One sentence for the report.
    given
        True if the user or a calibration declares it metal.
    evidence
        Evidence of the rest of the scene; None if it was not computed.
    """

    mask: Mask
    label: int | None
    how: str
    given: bool = False
    evidence: MetalEvidence | None = None

    @property
    def certain(self) -> bool:
        """True if the rest of the scene shows that it is metal, or it is given and nothing contradicts it."""
        if self.evidence is None:
            return self.given
        return self.evidence.enough or (self.given and not self.evidence.against)


def metal_in_box(
    box_mm: Box, segmentation: Segmentation, x_m: npt.ArrayLike, y_m: npt.ArrayLike, valid: Mask | None = None
) -> MetalReference:
    """Take the metal reference from a box (x0, y0, x1, y1), millimetres from the image centre.

    If the box overlaps a found patch, only that patch's interior inside the box is used, so that the box may be too
    large. Raises DataError if the box has no valid pixel.
    """
    mask = box_mask(box_mm, x_m, y_m)
    if valid is not None:
        mask &= valid
    overlaps = [(int((p.interior & mask).sum()), p) for p in segmentation.patches]
    count, patch = max(overlaps, key=lambda o: o[0], default=(0, None))
    label = None
    if patch is not None and count >= 9:
        mask = mask & patch.interior
        label = patch.label
    if not mask.any():
        raise DataError(
            f"the metal box {tuple(round(b, 1) for b in box_mm)} mm holds no valid pixel",
            "it lies outside the image; boxes are in millimetres from the image centre",
            "give --metal x,y,w,h inside the image",
            code=ErrorCode.NO_DATA,
        )
    place = "" if label is None else f", inside patch {label}"
    return MetalReference(
        mask, label, f"given as a box around ({', '.join(f'{b:.0f}' for b in box_mm)}) mm{place}", given=True
    )


def metal_by_label(label: int, segmentation: Segmentation) -> MetalReference:
    """Take this patch as the metal reference. Raises DataError if there is no such patch."""
    for p in segmentation.patches:
        if p.label == label:
            return MetalReference(p.interior, label, f"given as patch {label}", given=True)
    raise DataError(
        f"there is no patch {label} to take as metal",
        f"{len(segmentation.patches)} patches were found",
        "give the number of one of them",
        code=ErrorCode.NO_DATA,
    )


def no_metal(usable: Mask) -> MetalReference:
    """Return the reference of a scene without patches: images are scaled by their own mean brightness."""
    return MetalReference(usable, None, "none: no patch was found")


def find_metal(h: Image, v: Image, segmentation: Segmentation) -> MetalReference | None:
    """Return the patch that is brightest in both channels; None without patches.

    The measure is median |H||V| over the interior. Metal reflects both polarisations fully (|r_s| = |r_p| = 1), every
    dielectric loses most of p at these angles; the product does not depend on the unknown gains of H and V. The
    brightest patch of a scene without metal is a dielectric: whether it is metal is another question
    (:func:`metal_evidence`).
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
    if len(scores) == 1:
        beside = "the only patch found"
    else:
        beside = f"|H||V| {margin:.1f} times the next"
    description = f"chosen as the patch that is brightest in both channels ({beside})"
    return MetalReference(patch.interior, patch.label, description)


@dataclass(frozen=True)
class Halo:
    """Halo of V around the metal.

    Attributes
    ----------
    level
        Its amplitude relative to the metal; 0 without one.
    around
        Patch number to its amplitude around that patch, relative to the metal; empty without one.
    """

    level: float = 0.0
    around: Mapping[int, float] = field(default_factory=dict)


NO_HALO = Halo()


def find_halo(metal: Mask, patches: Sequence[Patch], images: Images) -> Halo:
    """Find a halo of V around the metal, which is given by its interior."""
    pixel_mm = abs(float(images.x_m[1] - images.x_m[0])) * 1e3
    levels = [float(np.median(np.abs(channel[metal]))) if metal.any() else 0.0 for channel in (images.h, images.v)]
    if min(levels) <= 0:
        return Halo()
    relative = [np.abs(channel) / level for channel, level in zip((images.h, images.v), levels, strict=True)]
    metal_mask = next((p.mask for p in patches if (p.mask & metal).any()), metal)
    plates = np.logical_or.reduce([metal_mask, *(p.mask for p in patches)])
    free = images.usable & (_distance_mm(plates, pixel_mm) > AROUND_MM[0])
    level = _excess(relative, free, metal_mask, HALO_MM, pixel_mm)
    if level == 0:
        return Halo()
    from_metal_mm = _distance_mm(metal_mask, pixel_mm)
    around = {}
    for patch in patches:
        around[patch.label] = _excess(relative, free, patch.mask, AROUND_MM, pixel_mm)
        # The halo reaches under a plate beside the metal, where nothing is free to measure it.
        if patch.mask.any() and float(from_metal_mm[patch.mask].min()) <= HALO_MM[1]:
            around[patch.label] = max(around[patch.label], level)
    return Halo(level, around)


def _excess(
    relative: Sequence[np.ndarray], free: Mask, plate: Mask, reach_mm: tuple[float, float], pixel_mm: float
) -> float:
    """Return the amplitude of V beside a plate beyond what H has there; 0 if it is no larger, or nothing is free."""
    distance = _distance_mm(plate, pixel_mm)
    ring = free & (distance > reach_mm[0]) & (distance <= reach_mm[1])
    if not ring.any():
        return 0.0
    power_h, power_v = (float(np.median(channel[ring])) ** 2 for channel in relative)
    return float(np.sqrt(max(0.0, power_v - HALO_EXCESS * power_h)))


def _distance_mm(mask: Mask, pixel_mm: float) -> np.ndarray:
    return np.asarray(scipy.ndimage.distance_transform_edt(~mask)) * pixel_mm
