"""The metal reference: the region by which both images are divided, and the evidence that it is metal.

The region is given as a box or as a patch. Otherwise it is chosen among the patches that are brightest in both channels
(`find_metals`).

First evidence: the region's own V / H relative to the direct path, which reaches both boards with equal strength. Metal
reflects both polarisations fully; a dielectric loses most of p at these angles (Eq. 2 of the POLySIGHT paper: Fresnel's
r_s and r_p).

Second evidence: the other patches. If the reference is metal, their inverse ratios V / H are those of materials. If it
is a dielectric with the inverse ratio t0 = r_p / r_s, they are those of materials divided by t0, far too large, and
their |H| is too large by 1 / |r_s|. The *score* is ln of the evidence for metal over that for a dielectric. Each is
integrated over all errors of the rig by the joint inversion, and the second over every permittivity of the reference.

A declared metal is contradicted only by its own V / H: by a very weak one alone, or by a weak one together with a very
low score. A low score alone makes it uncertain.

Metal is the strongest echo in V by far, in H it is one of many. An overdriven receiver (clipping) loses part of the
metal's echo and spreads the rest around the metal, in V more than in H (`find_halo`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import scipy

from polysight.imaging import Image, Images, Mask
from polysight.materials.inversion import PARTICLE_WIDTH, Inversion, RigPrior, SceneLikelihood, invert, sample_posterior
from polysight.materials.kinds import METAL_SHARE, METAL_SPREAD, HalfSpaces, Kinds, PatchMeasurement, inverse_ratio
from polysight.materials.measure import compute_median_ratio
from polysight.materials.segment import Box, Patch, Segmentation, box_mask
from polysight.materials.specimens import METAL_UNLIKE
from polysight.polarimetry import PlaneReference, divide_by_metal, measure_metal_gains
from polysight_shared.errors import DataError, ErrorCode

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

DOUBTFUL_V_DB = -2.5
WEAK_V_DB = -7.0
"""V / H relative to the direct path. Below the first value an undeclared patch is not metal; below the second
even a declared one is not. At 55 degrees half spaces of eps' up to 8 have -8 dB or less, of 10 -7 dB, bare water has
-4 dB, and metal 0 dB. The ratio of the antennas' patterns adds to this: -4 dB with those of an independent generator.
"""
LEAST_SCORE = 1.7
SURE_MARGIN = 1.5
"""Least score with which an undeclared patch counts as metal if there is one other patch, and how much more makes it
certain. The first is multiplied by the square root of the number of other patches, as each may be an odd one. With the
direct path, the reference counts as metal in none of 125 drawn scenes without metal (open water comes closest, and is
doubtful by its V / H), and in all of 75 with metal (tests/materials/test_metal_evidence.py)."""
REFERENCE_REAL = (1.5, 30.0)
REFERENCE_LOSS_TANGENT = (1e-3, 2.0)
"""Ranges of eps' and of the loss tangent of a reference that is not metal, uniform on logarithmic scales; they hold all
half spaces, water among them."""
CHANNEL_RATIO_STD_DB = 2.5
"""Standard deviation of metal's V / H relative to the direct path, because the boards' patterns differ off their axes;
chosen."""
CONFLICT_SCORE = 0.0
"""Score below which a declared metal is reported as doubtful, with the patch that fits it least: below 0 the other
patches fit a dielectric better. Metal has 1.3 or more in 52 scenes of an independent generator; dielectrics declared as
metal have -0.3 to -8 in eleven."""
CONTRADICTING_SCORE = -5.0
"""Score below which a declared metal is contradicted if its own V / H is below `DOUBTFUL_V_DB`, too. Chosen: eight half
spaces and a wafer declared as metal have scores of -7 to -27 and V / H of -3 to -8 dB; metal has scores of 7 to 31 and
V / H of -0.8 to 0.7 dB (scenes of another author's generator)."""
PAINT_SCORE = 7.0
"""Extra score that a reference needs if it counts as metal only with paint on it; chosen."""
ALIKE_DB = 2.5
LEAST_METAL_LEVEL = 0.15
MOST_METALS = 3
"""Another patch may be the metal instead of the brightest one if its |V / H| is at most `ALIKE_DB` below that of the
brightest patch, and its |H||V| at least `LEAST_METAL_LEVEL` of that patch's. `MOST_METALS` patches are compared, the
brightest included. Coated metal (sheets, boards with copper behind) may be the brightest: all disturbances together
have made bare metal darker than coated metal by a factor of four. Dielectrics reflect p by 8 dB less than metal."""
HALO_MM = (6.0, 36.0)
"""Smallest and largest distance from the metal's edge at which its halo is measured; chosen."""
AROUND_MM = (4.0, 14.0)
"""Smallest and largest distance from another plate's edge at which the halo around that plate is measured; chosen."""
HALO_EXCESS = 1.26
"""Smallest median of |V| / |H| beside a plate that is a halo, both relative to metal: 2 dB. Beside the metal
undisturbed scenes of an independent generator have -4 to 1.1 dB, clipped ones -0.3 to 8.7 dB (seven of eight above 2.4
dB)."""
OVERDRIVING_RATIO = 2.0
"""Smallest |V| of the metal over that of any other plate for a halo: only such an echo overdrives the receiver of V.
Without this limit, sidelobes of the neighbours of a dielectric that is declared as metal would count as its halo."""
USUAL_POWER_RATIO = 0.56
"""Usual power of V over that of H beside plates without a halo: -2.5 dB, the median of these undisturbed scenes. The
power there is sidelobes of dielectrics, which reflect s (H) better than p (V)."""


@dataclass(frozen=True)
class MetalEvidence:
    """Evidence for and against a patch being metal.

    Attributes
    ----------
    score
        ln of the evidence for metal, bare or painted, over that for a dielectric; positive values support metal.
    bare
        The score for bare metal. Of several patches like metal the one with the largest is the reference.
    others
        How many other patches differ from the judged one. Without any the scores are 0: metal beside metal looks like
        water beside water.
    channel_ratio_db
        V / H of the judged patch relative to the direct path, dB; None if not known.
    culprit
        Label of the other patch that fits metal least, if the score is below `CONFLICT_SCORE`; None otherwise.
    """

    score: float
    bare: float
    others: int
    channel_ratio_db: float | None
    culprit: int | None = None

    @property
    def needed_score(self) -> float:
        """Least `compared_score` with which an undeclared patch counts as metal; inf without other patches."""
        if self.others == 0:
            return np.inf
        return LEAST_SCORE * float(np.sqrt(self.others))

    @property
    def compared_score(self) -> float:
        """Score to compare with `needed_score`: of bare metal, or of metal that may be painted minus `PAINT_SCORE`."""
        return max(self.bare, self.score - PAINT_SCORE)

    @property
    def sure(self) -> bool:
        """True if the patch is certainly metal. The margin is for very lossy dielectrics (wet, conducting)."""
        return self.enough and self.compared_score >= self.needed_score + SURE_MARGIN

    @property
    def against(self) -> bool:
        """True if V / H of the patch contradicts metal, even one that the user declared.

        It does so below `WEAK_V_DB`, or below `DOUBTFUL_V_DB` if the score is below `CONTRADICTING_SCORE`.
        """
        if self.channel_ratio_db is None:
            return False
        is_odd = self.score < CONTRADICTING_SCORE
        return self.channel_ratio_db < WEAK_V_DB or (is_odd and self.channel_ratio_db < DOUBTFUL_V_DB)

    @property
    def enough(self) -> bool:
        """True if an undeclared patch counts as metal: enough score, and V / H not below `DOUBTFUL_V_DB`."""
        doubtful = self.channel_ratio_db is not None and self.channel_ratio_db < DOUBTFUL_V_DB
        return self.compared_score >= self.needed_score and not doubtful


def log_evidence_of_dielectric(
    measurements: Sequence[PatchMeasurement], prior: RigPrior, kinds: Kinds, channel_ratio_db: float | None = None
) -> float:
    """Return ln of the evidence if the reference is a dielectric, to compare with `Inversion.log_evidence` for metal.

    `channel_ratio_db` is V / H of the reference relative to the direct path; None if it is not known.
    """
    return sample_posterior(
        _DielectricReference(measurements, prior, kinds, channel_ratio_db), np.random.default_rng(0)
    )[1]


class _DielectricReference(SceneLikelihood):
    """Likelihood of a scene whose reference is a dielectric of unknown permittivity instead of metal.

    `z` [..., width] are particles: samples of all unknowns as standard normal variables. They have two columns more
    than in the base class, for eps' and for the loss tangent of the reference.
    """

    width = PARTICLE_WIDTH + 2

    def __init__(
        self, measurements: Sequence[PatchMeasurement], prior: RigPrior, kinds: Kinds, channel_ratio_db: float | None
    ) -> None:
        self.channel_ratio_db = channel_ratio_db
        super().__init__(measurements, prior, kinds)

    def _estimate_paint_probability(self) -> float:
        """Return 0: no paint is considered on a dielectric."""
        return 0.0

    def reference_permittivity(self, z: Real) -> Complex:
        """Return the permittivity of the reference, eps' - j eps'', [..., 1], within the ranges of `REFERENCE_REAL`."""
        real, tangent = (
            low * (high / low) ** scipy.special.ndtr(z[..., PARTICLE_WIDTH + i, None])
            for i, (low, high) in enumerate((REFERENCE_REAL, REFERENCE_LOSS_TANGENT))
        )
        return real * (1 - 1j * tangent)

    def reference_ratio(self, z: Real) -> Complex:
        """Return the inverse ratio t0 of the reference, [..., 1]."""
        return inverse_ratio(self.reference_permittivity(z), self._find_middle_angle())

    def log_reference_brightness(self, z: Real) -> Real:
        """Return ln |r_s| of the reference, [..., 1], by Eq. 2."""
        cosine = np.cos(self._find_middle_angle())
        root = np.sqrt(self.reference_permittivity(z) - (1 - cosine**2))
        return np.log(np.abs((cosine - root) / (cosine + root)))

    def _log_likelihoods(self, z: Real, half_spaces: HalfSpaces) -> Real:
        """Return log likelihoods [..., 1 + patch] as the base class does, of ratios measured relative to a dielectric.

        The measured ratio is t of the patch over t0 of the reference. The first element also holds the likelihood of
        the reference's V / H relative to the direct path, if that is known.
        """
        base_logs = super()._log_likelihoods(z, half_spaces)
        reference = self.reference_ratio(z)
        reference_amplitude = np.abs(reference)
        measured = half_spaces.t / reference
        # The measured ratio is t / t0, so its density is |t0|^2 that of t. A plate may also be of the material of the
        # reference, with the same prior probability as a second metal patch: its ratio is then 1, with this variance
        # of real and imaginary part each.
        variance = METAL_SPREAD**2 + self.own_variance
        log_same_material = -0.5 * np.abs(measured - 1) ** 2 / variance - np.log(2 * np.pi * variance)
        log_some_kind = base_logs[..., 1:] + 2 * np.log(reference_amplitude)
        patch_logs = np.logaddexp(np.log1p(-METAL_SHARE) + log_some_kind, np.log(METAL_SHARE) + log_same_material)
        brightness_log = base_logs[..., :1]
        if self.channel_ratio_db is not None:
            too_dark_db = 20 * np.log10(reference_amplitude) - self.channel_ratio_db
            brightness_log = brightness_log - 0.5 * (too_dark_db / CHANNEL_RATIO_STD_DB) ** 2
        return np.concatenate([brightness_log, patch_logs], axis=-1)

    def _find_middle_angle(self) -> float:
        """Return the patches' mean incidence angle, taken as that of the reference, radians; 0 without patches."""
        return float(self.theta.mean()) if self.theta.size else 0.0


def weigh_metal_evidence(
    patches: Mapping[int, PatchMeasurement],
    prior: RigPrior,
    channel_ratio: complex | None,
    kinds: Kinds,
    inversion: Inversion | None = None,
) -> MetalEvidence:
    """Weigh the evidence that a patch, the judged one, is metal against that for a dielectric.

    `patches`: label to measurement of each other patch, relative to the judged one. `channel_ratio`: V / H of the
    judged patch; None if the images are not referenced to the direct path. `kinds`: materials of which patches may be.
    `inversion`: joint inversion of `patches` with the judged one as metal; None: it is computed.
    """
    level_db = None
    if channel_ratio is not None and abs(channel_ratio) > 0:
        level_db = 20 * float(np.log10(abs(channel_ratio)))
    unlike = [label for label, patch in patches.items() if abs(patch.inverse_ratio - 1) > METAL_UNLIKE]
    if not unlike:
        return MetalEvidence(0.0, 0.0, 0, level_db)
    measurements = list(patches.values())
    if inversion is None:
        inversion = invert(measurements, prior, kinds)
    score = inversion.log_evidence - log_evidence_of_dielectric(measurements, prior, kinds, level_db)
    if level_db is not None:
        # The level of metal is 0 dB; the evidence for a dielectric has a term for the level, too.
        score -= 0.5 * (level_db / CHANNEL_RATIO_STD_DB) ** 2
    # The evidence for bare metal is that for metal, times the probability of bare after over that before.
    bare_score = score + inversion.log_bare - float(np.log1p(-prior.painted))
    culprit = None
    if score < CONFLICT_SCORE:
        fit = dict(zip(patches, inversion.fit.tolist(), strict=True))
        culprit = min(unlike, key=lambda label: fit[label])
    return MetalEvidence(score, bare_score, len(unlike), level_db, culprit)


@dataclass(frozen=True)
class MetalReference:
    """The metal region and its origin.

    Attributes
    ----------
    mask
        bool [ny, nx], interior of the region.
    label
        Label of the patch; None for a given box outside all patches, and in a scene without patches.
    how
        How the region was found, for the report.
    given
        True if the user or a calibration declares the region metal.
    evidence
        Evidence for and against metal; None if it was not computed.
    """

    mask: Mask
    label: int | None
    how: str
    given: bool = False
    evidence: MetalEvidence | None = None

    @property
    def certain(self) -> bool:
        """True if the evidence is sure, or if the metal was declared and no evidence speaks against it."""
        if self.evidence is None:
            return self.given
        is_declared = self.given and not self.evidence.against and self.evidence.culprit is None
        return is_declared or self.evidence.sure


def find_metal_in_box(
    box_mm: Box, segmentation: Segmentation, x_m: npt.ArrayLike, y_m: npt.ArrayLike, valid: Mask | None = None
) -> MetalReference:
    """Take the metal reference from a box (x0, y0, x1, y1), millimetres from the image centre.

    If the box holds 9 or more pixels of the interior of a patch, only these are used, so that the box may be too large.
    Of several such patches the one with the most pixels counts. `x_m`, `y_m` are the pixel centres, `valid` [ny, nx]
    the pixels that may be used; None: all. Raises DataError if the box has no such pixel.
    """
    mask = box_mask(box_mm, x_m, y_m)
    if valid is not None:
        mask &= valid
    overlaps = [(int((p.interior & mask).sum()), p) for p in segmentation.patches]
    count, patch = max(overlaps, key=lambda o: o[0], default=(0, None))
    label = None
    # Fewer pixels than 3 by 3 (chosen) are only the edge of a patch: then the whole box is taken.
    if patch is not None and count >= 9:
        mask = mask & patch.interior
        label = patch.label
    if not mask.any():
        raise DataError(
            f"the metal box {tuple(round(b, 1) for b in box_mm)} mm contains no valid pixel",
            "it lies outside the image; boxes are in millimetres from the image centre",
            "give --metal-box x0,y0,x1,y1 inside the image",
            code=ErrorCode.NO_DATA,
        )
    place_text = "" if label is None else f", inside patch {label}"
    return MetalReference(
        mask, label, f"given as a box around ({', '.join(f'{b:.0f}' for b in box_mm)}) mm{place_text}", given=True
    )


def take_patch_as_metal(label: int, segmentation: Segmentation) -> MetalReference:
    """Take the patch `label` as the metal reference. Raises DataError if there is no such patch."""
    for patch in segmentation.patches:
        if patch.label == label:
            return MetalReference(patch.interior, label, f"given as patch {label}", given=True)
    raise DataError(
        f"there is no patch {label} to use as metal",
        f"{len(segmentation.patches)} patches were found",
        "give the number of one of them",
        code=ErrorCode.NO_DATA,
    )


def make_missing_reference(usable: Mask) -> MetalReference:
    """Return the reference of a scene without patches: all `usable` pixels, as if all were metal."""
    return MetalReference(usable, None, "none: no patch was found")


def find_median_gains(images: Images, metal_mask: Mask) -> tuple[complex, complex]:
    """Return the gains of H and V: after division by them the median ratio of H and V over the metal is 1.

    Plates are measured by their median, too. The paper uses root mean squares over the metal
    (:func:`measure_metal_gains`); where the end of the scan lights the metal unevenly, their ratio differs from the
    median by up to 7 %. They are returned if the median is zero or not finite. Raises DataError as that function.
    """
    gain_h, gain_v = measure_metal_gains(images.h, images.v, metal_mask)
    metal_p = compute_median_ratio(images.h[metal_mask] / gain_h, images.v[metal_mask] / gain_v)
    if not np.isfinite(metal_p) or metal_p == 0:
        return gain_h, gain_v
    return gain_h * metal_p, gain_v


def divide_by_reference(images: Images, metal: MetalReference, reference: PlaneReference | None) -> Images:
    """Divide both channels by metal; leakage is not removed.

    The metal is `reference`, which was scanned separately, or without that the region `metal` of these images. If the
    region has no signal, the images are divided by 1; but DataError is raised if the metal was declared.
    """
    if reference is not None:
        return reference.apply(images)
    try:
        return divide_by_metal(images, *find_median_gains(images, metal.mask))
    except DataError:
        if metal.given:
            raise
        return divide_by_metal(images, 1.0 + 0j, 1.0 + 0j)


def fit_channel_ratio(images: Images, metal: MetalReference) -> complex | None:
    """Return V / H of the region `metal` in the images, by least squares over its pixels; None if H is zero there."""
    h = images.h[metal.mask]
    v = images.v[metal.mask]
    power = float(np.sum(np.abs(h.astype(np.complex128)) ** 2))
    if power > 0:
        return complex(np.vdot(h.astype(np.complex128), v)) / power
    return None


def measure_metal_unevenness(images: Images, metal_mask: Mask) -> float:
    """Return |ln(V / H)| of the root mean squares of H and V over the metal: 0 if it is lit evenly.

    The images are divided by `find_median_gains`, so that the median of V / H is 1 there.
    """
    rms_h, rms_v = measure_metal_gains(images.h, images.v, metal_mask)
    return float(abs(np.log(rms_v / rms_h)))


def find_metals(h: Image, v: Image, segmentation: Segmentation) -> tuple[MetalReference, ...]:
    """Return the patch that is brightest in both channels, then others that may be the metal; empty without patches.

    The brightness is the median of |H| times that of |V|. Metal reflects both polarisations fully (|r_s| = |r_p| = 1);
    every dielectric loses most of p at these angles. The unknown gains of H and V do not change the order of the
    products. In a scene without metal the brightest patch is a dielectric: :func:`weigh_metal_evidence` judges whether
    it is metal, and which of several metals is bare.
    """
    patches = [p for p in segmentation.patches if p.interior.any()]
    size_h = np.array([np.median(np.abs(h[p.interior])) for p in patches])
    size_v = np.array([np.median(np.abs(v[p.interior])) for p in patches])
    product = size_h * size_v
    order = np.argsort(-product, kind="stable")
    if not patches:
        return ()
    best = order[0]
    margin_text = "the only patch found"
    if len(patches) > 1:
        margin = np.inf if product[order[1]] == 0 else product[best] / product[order[1]]
        margin_text = f"|H||V| {margin:.1f} times the next"
    how = f"chosen as the patch that is brightest in both channels ({margin_text})"
    metals = [MetalReference(patches[best].interior, patches[best].label, how)]
    for i in order[1:MOST_METALS]:
        has_as_much_v = size_v[i] * size_h[best] > size_v[best] * size_h[i] * 10 ** (-ALIKE_DB / 20)
        if has_as_much_v and product[i] > LEAST_METAL_LEVEL * product[best]:
            level = product[i] / product[best]
            how = "chosen as the patch that the others show best to be bare metal "
            how += f"(|H||V| {level:.1f} times that of patch {patches[best].label}, which fits them less)"
            metals.append(MetalReference(patches[i].interior, patches[i].label, how))
    return tuple(metals)


@dataclass(frozen=True)
class Halo:
    """Halo around the metal in V.

    Attributes
    ----------
    level
        Amplitude of the halo beside the metal, relative to |V| of the metal; 0 if there is none.
    around
        Label of each patch to the amplitude of the halo around it, relative to |V| of the metal; empty if there is
        none.
    """

    level: float = 0.0
    around: Mapping[int, float] = field(default_factory=dict)


# No halo was found, or none could be seen.
NO_HALO = Halo()


def find_halo(metal: Mask, patches: Sequence[Patch], images: Images) -> Halo:
    """Find a halo in V around the metal, whose interior is `metal`, bool [ny, nx]; `NO_HALO` if there is none."""
    pixel_mm = abs(float(images.x_m[1] - images.x_m[0])) * 1e3
    levels = [float(np.median(np.abs(channel[metal]))) if metal.any() else 0.0 for channel in (images.h, images.v)]
    if min(levels) <= 0:
        return Halo()
    # |H| and |V| over those of the metal.
    relative = [np.abs(channel) / level for channel, level in zip((images.h, images.v), levels, strict=True)]
    metal_mask = next((p.mask for p in patches if (p.mask & metal).any()), metal)
    plates = np.logical_or.reduce([metal_mask, *(p.mask for p in patches)])
    other_plates = [patch for patch in patches if patch.interior.any() and not (patch.mask & metal).any()]
    strongest_v = max((float(np.median(relative[1][patch.interior])) for patch in other_plates), default=0.0)
    if OVERDRIVING_RATIO * strongest_v > 1:
        return Halo()
    is_free = images.usable & (_measure_distance_mm(plates, pixel_mm) > AROUND_MM[0])
    level = _measure_excess(relative, is_free, metal_mask, HALO_MM, pixel_mm)
    if level == 0:
        return Halo()
    distance_from_metal_mm = _measure_distance_mm(metal_mask, pixel_mm)
    halo_of_patch = {}
    for patch in patches:
        halo_of_patch[patch.label] = _measure_excess(relative, is_free, patch.mask, AROUND_MM, pixel_mm)
        # A plate near the metal lies in the halo, even if no pixel beside it is free to measure that.
        if patch.mask.any() and float(distance_from_metal_mm[patch.mask].min()) <= HALO_MM[1]:
            halo_of_patch[patch.label] = max(halo_of_patch[patch.label], level)
    return Halo(level, halo_of_patch)


def _measure_excess(
    relative: Sequence[np.ndarray], is_free: Mask, plate: Mask, reach_mm: tuple[float, float], pixel_mm: float
) -> float:
    """Return the amplitude of the halo in V beside a plate; 0 if there is none, or no pixel beside the plate is free.

    Its power is the median power of V minus `USUAL_POWER_RATIO` times that of H. `relative` are |H| and |V| over those
    of metal, float [ny, nx]; `is_free` [ny, nx] are the pixels away from all plates; `reach_mm` is the smallest and the
    largest distance from the plate.
    """
    distance = _measure_distance_mm(plate, pixel_mm)
    ring = is_free & (distance > reach_mm[0]) & (distance <= reach_mm[1])
    if not ring.any():
        return 0.0
    h, v = (channel[ring] for channel in relative)
    if float(np.median(v / np.maximum(h, 1e-30))) < HALO_EXCESS:
        return 0.0
    power_h = float(np.median(h)) ** 2
    power_v = float(np.median(v)) ** 2
    return float(np.sqrt(max(0.0, power_v - USUAL_POWER_RATIO * power_h)))


def _measure_distance_mm(mask: Mask, pixel_mm: float) -> np.ndarray:
    """Return the distance of each pixel from a mask, millimetres, float [ny, nx]; 0 inside."""
    return np.asarray(scipy.ndimage.distance_transform_edt(~mask)) * pixel_mm
