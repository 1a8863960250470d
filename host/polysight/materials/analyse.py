"""Find and name the patches of two images: segmentation, metal reference, joint inversion, classification.

`analyse` takes the images, the `Optics`, and known facts of the scene (`KnownScene`, the metal reference among them).
`level` corrects the images for the tilts of the plates, given as rises: slopes of their surface in x and y, radians.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.imaging import Image, Images, Rise, correct_tilt
from polysight.materials.classify import PAPER_MODEL, Classifier
from polysight.materials.common_change import CommonChange, estimate_common_change
from polysight.materials.inversion import EVEN_LIGHT, MOVED_PROBABILITY, UNEVEN_LIGHT, Inversion, RigPrior, invert
from polysight.materials.kinds import (
    Kinds,
    PatchDispersion,
    PatchMeasurement,
    RatioEvidence,
    inverse_ratio,
    list_literature_kinds,
    turn_covariance,
)
from polysight.materials.measure import (
    LEAST_STD,
    Scatter,
    background_mean,
    check_patches,
    compute_median_ratio,
    estimate_border_errors,
    estimate_patch_permittivity,
    find_usual_scatter,
    measure_background,
    measure_dispersions,
    measure_patch,
    measure_scatter,
    refuse_impossible,
    relative_errors,
)
from polysight.materials.metal import (
    NO_HALO,
    Halo,
    MetalReference,
    divide_by_reference,
    find_halo,
    find_metal_in_box,
    find_metals,
    fit_channel_ratio,
    make_missing_reference,
    measure_metal_unevenness,
    take_patch_as_metal,
    weigh_metal_evidence,
)
from polysight.materials.names import NamedPatch, PatchName, add_explanation, name_patch
from polysight.materials.phase_sign import join_signs, mirror_phases
from polysight.materials.result import LEVEL_TILTS, MaterialsResult, PatchResult, Tilts, pixel_features
from polysight.materials.segment import (
    Box,
    Patch,
    Segmentation,
    SegmentSettings,
    TruthPlate,
    align,
    match_truth,
    segment,
    whole_plane,
)
from polysight.polarimetry import (
    IncidenceChoice,
    PlaneReference,
    permittivity_from_ratio,
    ratio,
    remove_leakage,
    smooth,
)
from polysight_shared.config import Instrument
from polysight_shared.findings import Finding

LEAST_LEAKAGE_STD = 5e-4
"""Least standard deviation of the leakage, even if the rig file has less; chosen."""
MEASURED_RIG = RigPrior(theta_std_rad=1e-3, leakage_std=0.003, leakage_measured=True)
"""Prior of a rig whose leakage was measured and found to be zero; the standard deviations are chosen."""


@dataclass(frozen=True)
class Optics:
    """Quantities that turn images into permittivity.

    Attributes
    ----------
    theta_rad
        Incidence angle, a number or [ny, nx].
    prior
        Prior of the rig's errors; `analyse` replaces its `reference_std` by the measured one.
    smooth_px
        Width (standard deviation, pixels) of the filter against speckle before permittivity and classification,
        inside each patch.
    other_sign
        Probability a priori that all phases of the images have the other sign: 0 for scans of this program.
    phase_left_rad
        Standard deviation of a plate's phase by what may be left of removed jumps and drifts of a board's, radians.
    """

    theta_rad: npt.ArrayLike
    prior: RigPrior = MEASURED_RIG
    smooth_px: float = 2.0
    other_sign: float = 0.0
    phase_left_rad: float = 0.0

    @classmethod
    def from_rig(
        cls, rig: Instrument, angles: IncidenceChoice, theta_std_rad: float = 1e-3, channels_known: bool = False
    ) -> Optics:
        """Return the optics of a rig under the chosen incidence angles, with this standard deviation of the angle.

        Leakage without a `leakage_std` in the rig file was not measured: it is not subtracted, its mean is zero, and
        `leakage_prior` is the size of both its parts. The mount may have moved since a measurement
        (`MOVED_PROBABILITY`). `channels_known`: amplitudes are relative to the direct path.
        """
        polarimetry = rig.polarimetry
        leakage = (0j, 0j)
        leakage_std = float(polarimetry.leakage_prior / np.sqrt(2))
        if polarimetry.leakage_std is not None:
            leakage = (complex(*polarimetry.leakage_h), complex(*polarimetry.leakage_v))
            leakage_std = polarimetry.leakage_std
        prior = RigPrior(
            theta_std_rad=theta_std_rad,
            leakage=leakage,
            leakage_std=max(leakage_std, LEAST_LEAKAGE_STD),
            leakage_measured=polarimetry.leakage_std is not None,
            channels_known=channels_known,
            moved=0.0 if polarimetry.leakage_std is None else MOVED_PROBABILITY,
        )
        return cls(angles.used_rad, prior, polarimetry.smooth_px)


@dataclass(frozen=True)
class KnownScene:
    """Facts of the scene that are known before its analysis.

    Attributes
    ----------
    segmentation
        Patches, for example boxes drawn by hand; None: they are searched for.
    metal
        The metal reference: a box (x0, y0, x1, y1 in millimetres from the image centre), the number of one of the
        patches, or a plate over the whole plane that was scanned separately (pixels where it is invalid are ignored).
        None: it is searched for.
    names
        Patch number to the name of the box drawn by hand.
    plates
        The truth: copied to the results, never used for them.
    """

    segmentation: Segmentation | None = None
    metal: Box | int | PlaneReference | None = None
    names: Mapping[int, str] = field(default_factory=dict)
    plates: Sequence[TruthPlate] = ()

    @property
    def plane(self) -> PlaneReference | None:
        """The metal plate that was scanned separately; None without one."""
        return self.metal if isinstance(self.metal, PlaneReference) else None


def level(images: Images, segmentation: Segmentation, tilts: Tilts | None = None) -> tuple[Images, Tilts]:
    """Correct the illumination of each patch for its tilt; return the images and the tilts, as given or estimated.

    Without the illumination of the plane the images are returned unchanged, and no tilt is known.
    """
    if images.illumination is None:
        return images, LEVEL_TILTS
    if tilts is None:
        tilts = Tilts.estimate(images, images.illumination, segmentation)
    risen_patches = [p for p in segmentation.patches if p.label in tilts.rises]
    masks = [p.mask for p in risen_patches]
    rises = [tilts.rises[p.label] for p in risen_patches]
    return correct_tilt(images, masks, rises), tilts


BEHIND_PATCH = 0.6
"""Background in a plate divided by that next to the plates: of tables in scenes of the independent generator. It is
less than 1: changes of plates and metal alike cancel in their ratio, and a table is brightest at its own edges."""
UNEVEN_METAL_SHARE = 0.5
"""Error of each part of the metal's ln(V / H), as a share of the difference between its value by root mean squares and
by the median of pixels: where metal lies at the end of the scan neither is right (`benchmarks coverage`)."""
HALO_OF_METAL = 4.0
HALO_OF_PATCH = 3.0
"""Error of the metal's V / H, and of V on a plate, relative to the halo of V (light beside the patches) around them: in
scenes of an independent generator where 10 to 50 % of the largest amplitude were clipped."""
UNEVEN_AT_END = 0.01
"""Error of ln|V / H| near the aperture's end above which a plate's slopes are not used for the whole scan; chosen."""
ANGLE_BY_APART = 1.0
"""Error of the incidence angle, radians per metre between the images of H and V: boards 2 to 5 mm out of place change
it by 2 mrad and move the images 2 mm apart (rms; geometry of the published rig)."""
RAISED_RAD_PER_M = 1.1
"""Error of the phase of V / H per metre between the planes of a plate and of the metal: an error d of the difference
between the angles of both boards changes it by 2 k sin(theta) d; 0.4 mrad: places of boards are wrong by about half a
millimetre where the images of H and V lie on each other (chosen)."""
FILLED_LEVEL = 0.1
"""Least |H| relative to metal at which an image without edges counts as filled with one material; chosen."""
POSSIBLE_SIGN = 0.05
"""If the other sign of the phases is likelier than this (chosen), an undeclared metal must be metal with it, too."""


def analyse(
    images: Images, optics: Optics, given_scene: KnownScene | None = None, classifier: Classifier | None = None
) -> MaterialsResult:
    """Find the patches of the images, estimate their permittivities, and name them if there is a classifier.

    A scene without patches, metal or a valid pixel is not an error; see `metal` and each patch's `refused` in the
    result. Raises DataError if the given metal box or patch number does not exist.
    """
    known_scene = given_scene or KnownScene()
    plane = known_scene.plane
    if plane is not None:
        plane.check_axes(images.x_m, images.y_m)
        images = images.limit_to_area(plane.valid)
    images, apart_mm = align(images)
    segmentation = _select_patches(images, known_scene)
    images, tilts = level(images, segmentation)
    theta = np.asarray(optics.theta_rad, np.float64)
    kinds = _list_kinds(classifier, float(np.mean(theta)))
    scene = _Scene(
        images=images, segmentation=segmentation, tilts=tilts, apart_mm=apart_mm, plane=plane, optics=optics,
        kinds=kinds,
    )  # fmt: skip
    relative = find_most_like_metal(
        [scene.measure_relative_to(metal) for metal in _list_references(images, known_scene, segmentation)]
    )
    judged = relative.judged
    labels = [p.label for p in judged]
    inversion = relative.solution.inversion
    calibrated = remove_leakage(relative.raw, inversion.choose_leakage_to_remove(relative.prior))
    smoothed_h = smooth_inside(calibrated.h, segmentation, optics.smooth_px)
    smoothed_v = smooth_inside(calibrated.v, segmentation, optics.smooth_px)
    smoothed_p = ratio(smoothed_h, smoothed_v)
    estimates = dict(zip(labels, inversion.patches, strict=True))
    # ln of |H| over that of a half space of the same ratio; NaN where |H| was not used.
    brightness_off = dict(zip(labels, inversion.brightness_off.tolist(), strict=True))
    patches = {}
    for p in segmentation.patches:
        pixels = (smoothed_h[p.interior], smoothed_v[p.interior])
        patches[p.label] = estimate_patch_permittivity(*pixels, _mean_angle(theta, p), estimates.get(p.label))
    refused = relative.refused | refuse_impossible(patches, estimates, kinds)
    named = _name_patches(classifier, (smoothed_h, smoothed_v, smoothed_p), inversion, judged)
    truth = match_truth(segmentation.patches, known_scene.plates)
    results = tuple(
        PatchResult(p, patches[p.label], named.get(p.label), truth.get(p.label), refused.get(p.label))
        for p in segmentation.patches
    )
    return MaterialsResult(
        calibrated=calibrated, h=smoothed_h, v=smoothed_v, p=smoothed_p, metal=relative.metal,
        segmentation=segmentation, patches=results, theta_rad=theta, inversion=inversion, prior=relative.prior,
        tilts=tilts, boxes=dict(known_scene.names), library=() if classifier is None else classifier.names,
        brightness_off={label: ln for label, ln in brightness_off.items() if np.isfinite(ln)},
        evidence={label: e.evidence for label, e in estimates.items() if e.evidence is not None},
        apart_mm=apart_mm, drift=relative.scatter.change, halo=relative.scatter.halo.level,
        behind=relative.scatter.usual_background(relative.measured), ripple=relative.scatter.usual,
        disturbed=relative.scatter.disturbed, relief_rad=relative.scatter.relief_rad,
        other_sign=relative.solution.other_sign,
    )  # fmt: skip


@dataclass(frozen=True)
class _Solution:
    """Solution of a scene whose phases may have the other sign.

    Attributes
    ----------
    inversion
        The joint inversion; its errors hold both signs.
    other_sign
        Probability of the other sign.
    signs
        Patches, prior and inversion for the sign as given, and for the other one if it is possible.
    """

    inversion: Inversion
    other_sign: float
    signs: tuple[tuple[list[PatchMeasurement], RigPrior, Inversion], ...]


def _solve(measured: list[PatchMeasurement], prior: RigPrior, kinds: Kinds, other_sign: float) -> _Solution:
    """Solve for all patches together; `other_sign` is the probability a priori that phases have the other sign."""
    inversion = invert(measured, prior, kinds)
    as_given = (measured, prior, inversion)
    if other_sign <= 0:
        return _Solution(inversion, 0.0, (as_given,))
    mirrored, mirrored_prior = mirror_phases(measured, prior)
    mirrored_inversion = invert(mirrored, mirrored_prior, kinds)
    joined, probability = join_signs(inversion, mirrored_inversion, other_sign)
    if probability <= POSSIBLE_SIGN:
        return _Solution(joined, probability, (as_given,))
    return _Solution(joined, probability, (as_given, (mirrored, mirrored_prior, mirrored_inversion)))


@dataclass(frozen=True)
class SceneScatter:
    """Scatter of V / H over the plates of a scene, the metal among them, and what the scene shows of its own errors.

    Attributes
    ----------
    scatter
        Patch number to how it scatters; patches of too few pixels are missing.
    usual
        Usual scatter of ln|V / H| and of its phase in this scene.
    metal
        Scatter of the metal reference; None if it was scanned separately, or has too few pixels.
    change
        Drift of ln(V / H) over the scan at the plates of `scatter`, in their order, and at the metal; None without the
        scatter of the metal.
    metal_spread
        Relative spread of the pixels of metal that was scanned separately; None: it is in the scene.
    border
        Patch number to the errors of its ln|V / H| and of its phase by the end of the aperture.
    tilts
        Tilts of the plates.
    lit_evenly
        True if the illumination of tilted plates was corrected.
    metal_rise
        Rise of the metal along the plane of incidence and across it, radians.
    halo
        Halo of V around the metal.
    metal_std
        Error of each part of the metal's ln(V / H) by its uneven pixels and by the end of the aperture.
    behind
        Usual mean of H and of V over a place of a plate's size without a plate, relative to metal.
    raised_std
        Number of a patch that was imaged on a plane of its own to the error of the phase of its V / H by that.
    """

    scatter: Mapping[int, Scatter]
    usual: tuple[float, float]
    metal: Scatter | None
    change: CommonChange | None
    metal_spread: float | None
    border: Mapping[int, tuple[float, float]]
    tilts: Tilts
    lit_evenly: bool
    metal_rise: Rise
    halo: Halo = NO_HALO
    metal_std: float = 0.0
    behind: tuple[float, float] = (0.0, 0.0)
    raised_std: Mapping[int, float] = field(default_factory=dict)

    @classmethod
    def collect(
        cls,
        channels: tuple[Image, Image],
        raw: Images,
        judged: Sequence[Patch],
        segmentation: Segmentation,
        reference: MetalReference,
        plane: PlaneReference | None,
        images: Images,
        tilts: Tilts,
    ) -> SceneScatter:
        """Measure the scatter of the judged patches and of the metal, and the background.

        `channels` are relative to metal and smoothed inside patches, `raw` is relative to metal.
        """
        scatter_by_label = {p.label: measure_scatter(p.interior, *channels, images.x_m, images.y_m) for p in judged}
        scatter = {label: s for label, s in scatter_by_label.items() if s is not None}
        metal = None
        if plane is None and reference.mask.any():
            metal = measure_scatter(reference.mask, *channels, images.x_m, images.y_m)
        scatters = [*scatter.values(), *([] if metal is None else [metal])]
        spread = None if plane is None else plane.spread
        metal_rise = tilts.in_plane(reference.label or 0) if plane is None else plane.rise
        evenly = images.illumination is not None and images.illumination.known
        lit = images.usable if plane is None else images.usable & plane.valid
        border = {p.label: estimate_border_errors(p, lit, images.x_m) for p in segmentation.patches}
        # In the order of `scatters`; the metal, the last one, never counts as at the end: it is the origin.
        border_flags = [*(border[label][0] > UNEVEN_AT_END for label in scatter), False]
        change = None if metal is None else estimate_common_change(scatters, metal.centre_m, border_flags)
        halo = NO_HALO if metal is None else find_halo(reference.mask, segmentation.patches, images)
        metal_at_end = np.hypot(*border.get(reference.label or 0, (0.0, 0.0))) / np.sqrt(2)
        uneven = 0.0 if metal is None else UNEVEN_METAL_SHARE * measure_metal_unevenness(raw, reference.mask)
        return cls(
            scatter=scatter, usual=find_usual_scatter(scatters), metal=metal, change=change, metal_spread=spread,
            border=border, tilts=tilts, lit_evenly=evenly, metal_rise=metal_rise, halo=halo,
            metal_std=float(np.hypot(uneven, metal_at_end)),
            behind=background_mean(raw.h, raw.v, segmentation, images.usable),
            raised_std={} if plane is not None else _estimate_raised_std(images, judged, reference.mask),
        )  # fmt: skip

    @property
    def disturbed(self) -> dict[int, float]:
        """Patch number to the error of each part of its ln(V / H) by slopes that it has of its own."""
        if self.change is None:
            return {}
        # The metal's own slopes, last in `ripple`, are left out.
        return dict(zip(self.scatter, self.change.ripple.tolist(), strict=False))

    @property
    def relief_rad(self) -> float:
        """Usual standard deviation of the phase of H about a plane inside the plates; 0 without plates."""
        if self.scatter:
            return float(np.median([s.relief_rad for s in self.scatter.values()]))
        return 0.0

    def prior(self, prior: RigPrior, apart_mm: float) -> RigPrior:
        """Return the prior of the rig's errors with what the scene shows of metal, illumination and incidence angle.

        `apart_mm` is the distance of the images of H and V before they were laid on each other.
        """
        light = EVEN_LIGHT if self.lit_evenly else UNEVEN_LIGHT
        theta_std_rad = float(np.hypot(prior.theta_std_rad, ANGLE_BY_APART * apart_mm / 1e3))
        prior = replace(prior, metal_rise=self.metal_rise, lighting_std=light, theta_std_rad=theta_std_rad)
        if self.metal_spread is not None:
            return replace(prior, reference_std=LEAST_STD)
        amplitude, phase = relative_errors(self.metal, self.usual)
        std = float(np.hypot(np.hypot(amplitude, phase) / np.sqrt(2), LEAST_STD))
        halo_error = HALO_OF_METAL * self.halo.level
        return replace(prior, reference_std=float(np.sqrt(std**2 + halo_error**2 + self.metal_std**2)))

    def measure(
        self, patch: Patch, channels: tuple[Image, Image], theta_rad: float, dispersion: PatchDispersion | None
    ) -> PatchMeasurement:
        """Measure one patch relative to metal, with its errors by halo and background.

        `channels` are H and V relative to metal, smoothed inside patches; `theta_rad` is the patch's incidence angle.
        """
        border_error = self.border.get(patch.label, (0.0, 0.0))
        local_std = (
            float(np.hypot(self.metal_spread or 0.0, border_error[0])),
            float(np.hypot(np.hypot(self.metal_spread or 0.0, border_error[1]), self.raised_std.get(patch.label, 0.0))),
        )
        scatter = self.scatter.get(patch.label)
        rise = self.tilts.in_plane(patch.label)
        change = None
        if scatter is not None and self.change is not None:
            change = self.change.log_ratio(list(self.scatter).index(patch.label))
        ratio_measurement = measure_patch(
            patch, *channels, theta_rad, scatter, self.usual, change=change, local_std=local_std, rise=rise
        )
        patch_measurement = replace(ratio_measurement, dispersion=dispersion)
        if not patch_measurement.brightness:
            return patch_measurement
        halo_std = HALO_OF_PATCH * self.halo.around.get(patch.label, 0.0) / patch_measurement.brightness
        background_std = abs(patch_measurement.inverse_ratio) * self.background_in(patch_measurement)
        std = float(np.sqrt(patch_measurement.std**2 + halo_std**2 + background_std**2))
        return replace(patch_measurement, std=std)

    def background_in(self, measurement: PatchMeasurement) -> float:
        """Return the standard deviation of each part of a patch's ln(V / H) by what lies behind it."""
        if not measurement.brightness or not measurement.inverse_ratio:
            return 0.0
        behind_h, behind_v = self.behind
        # The background has any phase: half of its power is in each part.
        relative = np.hypot(behind_h, behind_v / abs(measurement.inverse_ratio)) / np.sqrt(2)
        return float(BEHIND_PATCH * relative / measurement.brightness)

    def usual_background(self, measured: Sequence[PatchMeasurement]) -> float:
        """Return the median of :meth:`background_in` over patches; 0 without any."""
        if measured:
            return float(np.median([self.background_in(m) for m in measured]))
        return 0.0


@dataclass(frozen=True)
class RelativeScene:
    """A scene relative to a metal reference. A reference within the scene holds the evidence that it is metal.

    Attributes
    ----------
    metal, raw
        The reference, and the images relative to it; leakage is not removed.
    refused, judged
        Patch number to why the patch is not a flat plate, and all other patches but the reference.
    scatter, prior
        What the plates show of the scene's errors, and the prior of the rig's errors with it.
    measured, solution
        The judged patches as the joint inversion takes them, in the same order, and its solution.
    """

    metal: MetalReference
    raw: Images
    refused: dict[int, Finding]
    judged: list[Patch]
    scatter: SceneScatter
    prior: RigPrior
    measured: list[PatchMeasurement]
    solution: _Solution


@dataclass(frozen=True)
class _Scene:
    """A scene before anything is divided by metal: images, patches, and what is known of the rig and of materials."""

    images: Images
    segmentation: Segmentation
    tilts: Tilts
    # Distance (x, y) of the images of H and V before they were laid on each other.
    apart_mm: tuple[float, float]
    plane: PlaneReference | None
    optics: Optics
    kinds: Kinds

    def measure_relative_to(self, reference: MetalReference) -> RelativeScene:
        """Measure and solve the scene relative to this reference, and weigh whether it is metal."""
        images = self.images
        segmentation = self.segmentation
        theta = np.asarray(self.optics.theta_rad, np.float64)
        raw = divide_by_reference(images, reference, self.plane)
        # H and V relative to metal, smoothed.
        relative_h = smooth_inside(raw.h, segmentation, self.optics.smooth_px)
        relative_v = smooth_inside(raw.v, segmentation, self.optics.smooth_px)
        background_rms = measure_background(raw.h, raw.v, segmentation, images.usable)
        refused = check_patches(segmentation, relative_h, relative_v, background_rms, reference.mask)
        refused |= self.tilts.refusals()
        judged = [p for p in segmentation.patches if p.label not in refused and p.label != reference.label]
        scatter = SceneScatter.collect(
            channels=(relative_h, relative_v), raw=raw, judged=judged, segmentation=segmentation, reference=reference,
            plane=self.plane, images=images, tilts=self.tilts,
        )  # fmt: skip
        prior = scatter.prior(self.optics.prior, float(np.hypot(*self.apart_mm)))
        dispersions = measure_dispersions(images, segmentation, judged, reference.mask, self.plane)
        left_rad = self.optics.phase_left_rad
        measured = [
            scatter.measure(p, (relative_h, relative_v), _mean_angle(theta, p), d).widen_phase(left_rad)
            for p, d in zip(judged, dispersions, strict=True)
        ]
        solution = _solve(measured, prior, self.kinds, self.optics.other_sign)
        if self.plane is None:
            labels = [p.label for p in judged]
            reference = _weigh_metal(images, reference, labels, solution, self.kinds)
        return RelativeScene(
            metal=reference, raw=raw, refused=refused, judged=judged, scatter=scatter, prior=prior, measured=measured,
            solution=solution,
        )  # fmt: skip


def find_most_like_metal(relatives: Sequence[RelativeScene]) -> RelativeScene:
    """Return the scene relative to the reference that the other patches show best to be bare metal.

    A reference that its own V / H contradicts, or that is not a flat plate, is taken only if none is better; of equals
    the first is taken.
    """

    def score_as_bare_metal(relative: RelativeScene) -> float:
        evidence = relative.metal.evidence
        if evidence is None or evidence.against or relative.metal.label in relative.refused:
            return -np.inf
        return evidence.bare

    return max(relatives, key=score_as_bare_metal)


def _list_kinds(classifier: Classifier | None, theta_rad: float) -> Kinds:
    """Return what the patches may be: kinds of the library if it has one angle, else those of the literature alone."""
    if classifier is None or len(classifier.kinds) != 1:
        return Kinds(list_literature_kinds(), theta_rad, with_sheets=True)
    return classifier.kinds[0]


def _name_patches(
    classifier: Classifier | None, channels: tuple[Image, Image, Image], inversion: Inversion, judged: list[Patch]
) -> dict[int, NamedPatch]:
    """Name the judged patches from the joint inversion; return patch number to name."""
    if classifier is None or not judged:
        return {}
    h, v, p = channels
    named = {}
    for patch, estimate in zip(judged, inversion.patches, strict=True):
        if estimate.evidence is None:
            continue
        interior = patch.interior
        if classifier.model == PAPER_MODEL:
            # The paper's classifier compares pixels: their V / H gets the correction of their patch.
            correction = estimate.evidence.inverse_ratio * compute_median_ratio(h[interior], v[interior])
            pixels_p = p[interior].astype(np.complex128) / correction
            pixels = pixel_features(np.abs(h[interior]), np.abs(v[interior]), pixels_p)
            (name,) = classifier.scan([pixels])
        else:
            inverse = 1 / p[interior].astype(np.complex128)
            name = name_patch(classifier.kinds, [estimate.evidence], inverse[:, None])
        named[patch.label] = add_explanation(
            name, estimate.permittivity, estimate.covariance, classifier.permittivities
        )
    return named


def name_permittivity(permittivity: complex, covariance: npt.NDArray[np.float64], classifier: Classifier) -> PatchName:
    """Name a half space by its permittivity and the covariance [2, 2] of its (real, imaginary).

    A material of the library and one of none are as likely a priori: no other patches say how common they are.
    """
    kinds = classifier.kinds[0]
    inverse = complex(inverse_ratio(permittivity, kinds.theta_rad))
    step = 1e-4
    slope = (complex(inverse_ratio(permittivity + step, kinds.theta_rad)) - inverse) / step
    evidence = RatioEvidence(
        theta_rad=kinds.theta_rad,
        inverse_ratio=inverse,
        covariance=turn_covariance(slope, covariance),
        library_share=0.5,
    )
    return name_patch((kinds,), (evidence,), np.array([[inverse]])).patch_name


def _estimate_raised_std(images: Images, patches: Sequence[Patch], metal: npt.NDArray[np.bool_]) -> dict[int, float]:
    """Return patch number to the error of the phase of V / H, as the patch and the metal lie on different planes."""
    if images.raised_m is None or not metal.any():
        return {}
    metal_m = float(np.median(images.raised_m[metal]))
    inside_m = {p.label: images.raised_m[p.interior] for p in patches if p.interior.any()}
    return {label: RAISED_RAD_PER_M * abs(float(np.median(patch_m)) - metal_m) for label, patch_m in inside_m.items()}


def _mean_angle(theta: npt.NDArray[np.float64], patch: Patch) -> float:
    """Return the mean incidence angle over a patch, radians."""
    inside = theta[patch.interior] if theta.ndim and patch.interior.any() else theta
    return float(np.mean(inside))


def _weigh_metal(
    images: Images, metal: MetalReference, labels: Sequence[int], solution: _Solution, kinds: Kinds
) -> MetalReference:
    """Return the metal reference with the evidence for metal and against.

    If the metal was not declared, it is weighed with each possible sign of the phases, and the sign with the least
    evidence for metal counts.
    """
    evidence = []
    for measured, prior, inversion in solution.signs[:1] if metal.given else solution.signs:
        channel_ratio = fit_channel_ratio(images, metal) if prior.channels_known else None
        patches = dict(zip(labels, measured, strict=True))
        evidence.append(weigh_metal_evidence(patches, prior, channel_ratio, kinds, inversion))
    return replace(metal, evidence=min(evidence, key=lambda of_sign: of_sign.score))


def _select_patches(images: Images, known_scene: KnownScene) -> Segmentation:
    """Return the known patches, cut to the valid pixels, or else find them."""
    if known_scene.segmentation is not None:
        valid_patches = tuple(replace(p, interior=p.interior & images.valid) for p in known_scene.segmentation.patches)
        return replace(known_scene.segmentation, patches=valid_patches)
    if not images.usable.any():
        # A scan without a direct path in any position has no signal: there is nothing to search, the verdict says why.
        return Segmentation(np.zeros(images.h.shape, np.int32), ())
    relative_images = images if known_scene.plane is None else known_scene.plane.apply(images)
    segmentation = segment(relative_images.h, relative_images.v, images.x_m, images.y_m, images.valid)
    is_filled = (
        known_scene.plane is not None and float(np.median(np.abs(relative_images.h[images.valid]))) > FILLED_LEVEL
    )
    if not segmentation.patches and is_filled:
        return whole_plane(images.valid, images.x_m, images.y_m, SegmentSettings().margin_mm)
    return segmentation


def _list_references(images: Images, known_scene: KnownScene, segmentation: Segmentation) -> tuple[MetalReference, ...]:
    """Return the given metal reference, or those of :func:`find_metals`, or that of :func:`make_missing_reference`."""
    if isinstance(known_scene.metal, PlaneReference):
        return (MetalReference(known_scene.metal.valid, None, known_scene.metal.how, given=True),)
    if isinstance(known_scene.metal, int):
        return (take_patch_as_metal(known_scene.metal, segmentation),)
    if known_scene.metal is not None:
        return (find_metal_in_box(known_scene.metal, segmentation, images.x_m, images.y_m, images.valid),)
    return find_metals(images.h, images.v, segmentation) or (make_missing_reference(images.usable),)


def smooth_inside(image: Image, segmentation: Segmentation, sigma_px: float) -> Image:
    """Apply a Gaussian filter inside each patch separately; NaN elsewhere."""
    out = np.full(image.shape, complex(np.nan, np.nan), image.dtype)
    reach = int(np.ceil(4 * sigma_px))
    for patch in segmentation.patches:
        if patch.interior.any():
            lines = np.flatnonzero(patch.interior.any(axis=1))
            columns = np.flatnonzero(patch.interior.any(axis=0))
            near = tuple(slice(max(0, indices[0] - reach), indices[-1] + reach + 1) for indices in (lines, columns))
            inside = patch.interior[near]
            smoothed = smooth(np.where(inside, image[near], complex(np.nan, np.nan)).astype(image.dtype), sigma_px)
            out[near] = np.where(inside, smoothed, out[near])
    return out


def permittivity_change(result: MaterialsResult, angles: IncidenceChoice) -> dict[str, Any]:
    """Return the largest relative change of a patch's permittivity (Eq. 3) with the other angle, for quality.json.

    `largest_permittivity_change` is |eps_other / eps - 1|, `of_patch` its number; empty without any permittivity.
    """
    changes = []
    for patch_result in result.patches:
        pixels = patch_result.patch.interior
        if patch_result.permittivity.value is not None and pixels.any():
            mean_angles_rad = np.array([np.mean(angles.used_rad[pixels]), np.mean(angles.other_rad[pixels])])
            permittivity_by_angle = permittivity_from_ratio(patch_result.permittivity.ratio, mean_angles_rad)
            changes.append(
                (float(abs(permittivity_by_angle[1] / permittivity_by_angle[0] - 1)), patch_result.patch.label)
            )
    if not changes:
        return {}
    largest, label = max(changes)
    return {"largest_permittivity_change": round(largest, 5), "of_patch": label}
