"""Result of `analyse`: patches with permittivities and names, and their rows for materials.json."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import scipy
from msgspec import UNSET, structs

from polysight.imaging import MAX_RISE, Illumination, Image, Images, Rise
from polysight.materials.common_change import CommonChange
from polysight.materials.inversion import Inversion, RigPrior
from polysight.materials.kinds import RatioEvidence, find_permittivity_slope
from polysight.materials.labels import Labels
from polysight.materials.library import Real, make_features
from polysight.materials.measure import Permittivity, measure_background, ratio_sigma
from polysight.materials.metal import MetalReference
from polysight.materials.names import UNKNOWN, NamedPatch, PatchName
from polysight.materials.segment import Box, Patch, Segmentation, TruthPlate
from polysight.results import BandFigures, ComplexNumber, PatchFigures, PermittivityFigures, TruthFigures
from polysight_shared.findings import Finding

MAX_BEND = 3.5
"""Curvature above which a patch is not a flat plate, 1 / m. Flat plates that are uneven by 0.25 mm have up to 1.4 in
drawn scenes and ripple of the published picture up to 3; sheets bent to a radius of 150 mm have 5.6, spheres of 100 mm
6 to 10."""
STEEP_FINDING = Finding(
    "error",
    "tilted or curved beyond what is modelled",
    f"its phase rises by more than {np.degrees(MAX_RISE):.1f} degrees, or bends as that of a radius below "
    f"{1 / MAX_BEND:.1f} m: H and V show different places and turned polarisations",
    "lay it flat, or measure it as it is with `polysight surface`",
)
"""Why a steep patch gets no permittivity."""
SMEAR = Finding(
    "error",
    "a smear at the end of the scan",
    "positions without data or with a wrong phase spread plates along x or y, and the correction of the footprint "
    "amplifies the end of the illuminated area",
    "if an object lies there, scan again without gaps",
)
"""Why a steep patch that is a smear gets no permittivity."""
SMEAR_LEVEL = 0.1
END_PX = 3
"""Largest level of a smear, relative to the brightest patch, and its largest distance from pixels that are not
illuminated. Chosen: smears by one to five missing rows, or by a step of the phase, had levels below 0.03."""


@dataclass(frozen=True)
class Tilts:
    """Tilts of the plates: patch number to rise along x and y, radians; patches without an estimate are missing.

    `across` is the index of the axis across the plane of incidence; `steep` are the patches that are steeper than the
    model allows, `smears` those of them that are no objects, but smears at the end of the scan.
    """

    rises: dict[int, Rise]
    across: int
    steep: frozenset[int] = frozenset()
    smears: frozenset[int] = frozenset()

    @classmethod
    def estimate(cls, images: Images, illumination: Illumination, segmentation: Segmentation) -> Tilts:
        """Estimate the rise of each patch from its phase; patches that are steeper than the model allows are marked."""
        rises = {
            p.label: illumination.estimate_rise(images.h, images.v, p.interior, p.mask) for p in segmentation.patches
        }
        bends = {p.label: illumination.estimate_bend(images.h, images.v, p.interior) for p in segmentation.patches}
        steep = frozenset(
            label
            for label, rise in rises.items()
            if max(map(abs, rise)) > MAX_RISE or max(map(abs, bends[label])) > MAX_BEND
        )
        # A rise that is steeper than the model allows counts as none.
        usable_rises = {
            label: (x if abs(x) < MAX_RISE else 0.0, y if abs(y) < MAX_RISE else 0.0) for label, (x, y) in rises.items()
        }
        return cls(usable_rises, illumination.across, steep, find_smears(images, segmentation) & steep)

    def refusals(self) -> dict[int, Finding]:
        """Return patch number to why it has no permittivity, of the steep patches."""
        return {label: SMEAR if label in self.smears else STEEP_FINDING for label in self.steep}

    def in_plane(self, label: int) -> Rise:
        """Return the rise of a patch along the plane of incidence and across it, radians; 0 if it is not known."""
        rise = self.rises.get(label, (0.0, 0.0))
        return rise[1 - self.across], rise[self.across]

    def across_rad(self, label: int) -> float:
        """Return the rise of a patch across the plane of incidence, radians; 0 if it is not known."""
        return self.rises[label][self.across] if label in self.rises else 0.0


def find_smears(images: Images, segmentation: Segmentation) -> frozenset[int]:
    """Return the patches that are dim in both channels together, and lie at the end of the illuminated area."""
    near_end = scipy.ndimage.binary_dilation(~images.usable, iterations=END_PX)
    # A smear is often of one channel: with the other, which is dark there, it is dimmer than a plate.
    level = {
        p.label: float(np.sqrt(np.median(np.abs(images.h[p.mask])) * np.median(np.abs(images.v[p.mask]))))
        for p in segmentation.patches
    }
    brightest = max(level.values(), default=0.0)
    return frozenset(
        p.label for p in segmentation.patches if level[p.label] < SMEAR_LEVEL * brightest and (near_end & p.mask).any()
    )


LEVEL_TILTS = Tilts({}, 1)
"""No tilt is known."""
MEASURE_AGAINST = {
    "scatter": "even plates with nothing behind them; a larger plate, a finer grid, or more pulses a position",
    "metal reference": "a larger metal plate, or `polysight calibrate metal`",
    "leakage": "measure leakage with metal strips: `polysight leakage`",
    "tilt": "lay the plates flat",
    "incidence": "measure where the antennas are: `polysight calibrate direct-path`",
    "phase sign": "save `conjugate` (true or false) with the images",
}
"""By source of error: the measurement that reduces it."""


@dataclass(frozen=True)
class PatchResult:
    """One patch with its permittivity and name.

    Attributes
    ----------
    patch, permittivity
        Its geometry and its permittivity.
    named
        Names of the patch and of its pixels; None if it was not named (no classifier, no flat plate, or the metal
        reference).
    truth
        The true plate, if known.
    refused
        Reason for giving neither name nor permittivity; None if they are given.
    """

    patch: Patch
    permittivity: Permittivity
    named: NamedPatch | None = None
    truth: TruthPlate | None = None
    refused: Finding | None = None

    @property
    def patch_name(self) -> PatchName | None:
        """Name with confidence and votes; None if it was not named or is refused."""
        if self.named is None or self.refused is not None:
            return None
        return self.named.patch_name

    @property
    def pixel_names(self) -> npt.NDArray[np.str_] | None:
        """Names of the interior's pixels, str [n] in image order; None as for `patch_name`."""
        if self.named is None or self.refused is not None:
            return None
        return self.named.pixel_names


@dataclass(frozen=True)
class MaterialsResult:
    """Results of one scan's images.

    Attributes
    ----------
    calibrated
        Images with metal reference and leakage removed, not smoothed.
    h, v, p
        The same after the Gaussian filter inside each patch: the features of classification and permittivity. NaN
        outside the patches' interiors, to exclude edges and neighbours.
    metal
        The reference and how it was chosen.
    segmentation
        Patches and label image.
    patches
        Permittivity and name of each patch.
    theta_rad
        Incidence angle, a number or [ny, nx].
    inversion, prior
        The joint inversion of all patches, and its prior.
    bands
        Patch number to its ratios in sub-bands of the sweep (:mod:`polysight.materials.sub_bands`); may be empty.
    boxes
        Patch number to the name of the box drawn by hand; empty if the patches were found.
    library
        Names of the library's materials; empty if nothing was named.
    withheld
        True if the verdict is `no result`: rows have no name, no ratio and no permittivity then.
    tilts
        Tilts of the plates; `h` and `v` are already corrected for them.
    evidence
        Patch number to what its name rests on; not of refused patches and of the metal reference.
    brightness_off
        Patch number to ln of |H| over that of a half space of its ratio, relative to the scene's usual one; not for
        metal-like patches.
    apart_mm
        Where the image of V lay relative to that of H (x, y) before it was moved onto it.
    drift
        Change of V / H over the scan at the plates by drift and fringes, which is removed; None if it is not known.
    halo
        Amplitude of V around the metal beyond what H has there, relative to the metal.
    behind
        Usual error of each part of ln(V / H) by what lies behind the plates; it is in their error bars.
    ripple
        Usual scatter of ln|V / H| and of its phase inside the plates, where a flat plate has none.
    disturbed
        Patch number to the error of each part of its ln(V / H) by slopes that it has of its own.
    relief_rad
        Usual standard deviation of the phase of H about a plane inside the plates.
    other_sign
        Probability that all phases have the other sign; 0 of own scans.
    """

    calibrated: Images
    h: Image
    v: Image
    p: Image
    metal: MetalReference
    segmentation: Segmentation
    patches: tuple[PatchResult, ...]
    theta_rad: npt.NDArray[np.float64]
    inversion: Inversion
    prior: RigPrior
    bands: dict[int, list[BandFigures]] = field(default_factory=dict)
    boxes: dict[int, str] = field(default_factory=dict)
    library: tuple[str, ...] = ()
    withheld: bool = False
    tilts: Tilts = LEVEL_TILTS
    brightness_off: Mapping[int, float] = field(default_factory=dict)
    evidence: Mapping[int, RatioEvidence] = field(default_factory=dict)
    apart_mm: tuple[float, float] = (0.0, 0.0)
    drift: CommonChange | None = None
    halo: float = 0.0
    behind: float = 0.0
    ripple: tuple[float, float] = (0.0, 0.0)
    disturbed: Mapping[int, float] = field(default_factory=dict)
    relief_rad: float = 0.0
    other_sign: float = 0.0

    def usable_pixels(self, patch: Patch) -> npt.NDArray[np.bool_]:
        """Return a mask [ny, nx] of a patch's interior pixels whose P is known, and not zero."""
        return patch.interior & np.isfinite(self.p) & (self.p != 0)

    def rows(self) -> list[PatchFigures]:
        """Return the figures of each patch, for materials.json."""
        figures = [self._describe_patch(r) for r in self.patches]
        if self.withheld:
            return [patch.without_results() for patch in figures]
        return figures

    def without_result(self) -> MaterialsResult:
        """Return the patches without names, ratios, permittivities and metal reference."""
        patches = tuple(replace(r, permittivity=Permittivity.not_estimated(), named=None) for r in self.patches)
        metal = replace(self.metal, label=None, given=False, how=f"none ({self.metal.how})")
        return replace(self, patches=patches, metal=metal, bands={}, withheld=True)

    def p_sigma(self, usable: npt.NDArray[np.bool_]) -> npt.NDArray[np.float32]:
        """Return the standard deviation of each pixel's P, [ny, nx]; NaN without a result or if not `usable`."""
        h = self.calibrated.h
        v = self.calibrated.v
        if self.withheld:
            return np.full(h.shape, np.nan, np.float32)
        background_rms = measure_background(h, v, self.segmentation, usable)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = np.where(usable, v / h, np.nan)
        return ratio_sigma(h, v, background_rms, ratio_error(self.inversion, self.prior, inverse))

    def errors_by_disturbance(self) -> dict[int, float]:
        """Return patch number to the relative error of its permittivity by `disturbed`, at most that of V / H.

        Without a permittivity it is that of V / H. Refused patches are left out. Near the Brewster angle V nearly
        vanishes, and even a large relative error of V / H changes the permittivity little.
        """
        out = {}
        for patch_result in self.patches:
            if patch_result.refused is not None:
                continue
            error = self.disturbed.get(patch_result.patch.label, 0.0)
            estimate = patch_result.permittivity
            if estimate.value and estimate.ratio:
                slope = find_permittivity_slope(1 / estimate.ratio, np.radians(self.incidence_deg(patch_result.patch)))
                error *= min(1.0, float(abs(slope / estimate.ratio / estimate.value)))
            out[patch_result.patch.label] = error
        return out

    def incidence_deg(self, patch: Patch) -> float:
        """Return the mean incidence angle over a patch's interior, degrees."""
        if self.theta_rad.ndim and patch.interior.any():
            angles = self.theta_rad[patch.interior]
        else:
            angles = self.theta_rad
        return float(np.degrees(np.mean(angles)))

    def _describe_patch(self, patch_result: PatchResult) -> PatchFigures:
        """Return the figures of one patch for materials.json; lengths, the tilt and |H| are rounded."""
        label = patch_result.patch.label
        estimate = patch_result.permittivity
        x0, y0, x1, y1 = patch_result.patch.box_mm
        level = np.abs(self.h[patch_result.patch.interior])
        level = level[np.isfinite(level)]
        figures = PatchFigures(
            label=label,
            metal_reference=label == self.metal.label,
            metal_like=estimate.metal_like and patch_result.refused is None,
            box_mm=(round(x0, 3), round(y0, 3), round(x1, 3), round(y1, 3)),
            outline_mm=[(round(float(x), 2), round(float(y), 2)) for x, y in patch_result.patch.outline_mm],
            pixels=patch_result.patch.pixels,
            interior_pixels=estimate.pixels,
            incidence_deg=self.incidence_deg(patch_result.patch),
            ratio=ComplexNumber.from_complex(estimate.ratio),
            inverse_ratio_std=_replace_infinite(estimate.inverse_std),
            amplitude_h=round(float(np.median(level)), 6) if level.size else None,
            refused=patch_result.refused,
            bands=self.bands.get(label, UNSET),
            box=self.boxes.get(label, UNSET),
        )
        if patch_result.truth is not None:
            figures = structs.replace(figures, truth=_describe_truth(patch_result.truth, self.library))
        if patch_result.patch_name is not None:
            figures = _add_name(figures, patch_result.patch_name)
        if patch_result.refused is None:
            figures = structs.replace(figures, permittivity=_describe_permittivity(estimate))
            if label in self.tilts.rises:
                across_deg = round(float(np.degrees(self.tilts.across_rad(label))), 3)
                figures = structs.replace(figures, tilt_across_deg=across_deg)
        return figures


def ratio_slopes(estimate: Inversion, prior: RigPrior, t: npt.ArrayLike) -> Real:
    """Return the errors of 1 / P at t [...] by leakage and metal reference after the inversion, float64 [..., 2, 6].

    The product with its transpose is the covariance, for several t also between them. To first order
    d t = -(1 - t) (b + a t) - t rho, with the errors a, b of the leakages and rho of the reference. The rows are the
    real and the imaginary part of t, the columns six independent errors made of both parts of a, b and rho.
    """
    t = np.asarray(t, np.complex128)
    scale = np.array([prior.leakage_std, prior.leakage_std, prior.reference_std])
    # Pixels without a ratio have no error either.
    with np.errstate(invalid="ignore"):
        slope_of_real_part = np.stack([-(1 - t) * t, -(1 - t), -t], axis=-1) * scale
    slope_of_error = np.stack([slope_of_real_part, 1j * slope_of_real_part], axis=-1).reshape(*t.shape, 6)
    # The square root of the covariance, of which rounding can make an eigenvalue negative.
    values, vectors = np.linalg.eigh(estimate.nuisance_covariance)
    return np.stack([slope_of_error.real, slope_of_error.imag], axis=-2) @ (vectors * np.sqrt(np.maximum(values, 0.0)))


def ratio_error(estimate: Inversion, prior: RigPrior, t: npt.ArrayLike) -> Real:
    """Return the standard deviation of 1 / P by leakage and reference, as `t`: root mean variance of both parts."""
    return np.sqrt(np.sum(ratio_slopes(estimate, prior, t) ** 2, axis=(-2, -1)) / 2)


def _add_name(figures: PatchFigures, name: PatchName) -> PatchFigures:
    """Add the name to a patch's figures."""
    return structs.replace(
        figures,
        name=name.name,
        name_source=name.source,
        confidence=name.confidence,
        votes=name.votes,
        probabilities=name.probabilities,
        literature=name.literature,
        why=name.why,
        distance=_replace_infinite(name.distance),
    )


def _replace_infinite(value: float) -> float | None:
    """Return a number for a file; None for infinity and NaN."""
    return value if math.isfinite(value) else None


def _describe_permittivity(estimate: Permittivity) -> PermittivityFigures | None:
    """Return value and errors for materials.json; None if it is not known."""
    if estimate.value is None or estimate.real_range is None or estimate.imag_range is None:
        return None
    return PermittivityFigures(
        real=estimate.value.real,
        imag=estimate.value.imag,
        real_p30_p70=estimate.real_range,
        imag_p30_p70=estimate.imag_range,
        real_std=estimate.real_std,
        imag_std=estimate.loss_std,
        covariance=None if estimate.covariance is None else estimate.covariance.tolist(),
        half_widths_68=estimate.half_widths_68,
        shares=dict(estimate.shares),
        dominated_by=estimate.dominated_by,
        do=MEASURE_AGAINST.get(estimate.dominated_by or "", ""),
    )


def _describe_truth(truth: TruthPlate, library: tuple[str, ...]) -> TruthFigures:
    """Return the true plate for materials.json; `library` are the names that the classifier could give."""
    return TruthFigures(
        name=truth.name,
        metal=truth.metal,
        permittivity=ComplexNumber.from_complex(truth.permittivity),
        thickness_mm=truth.thickness_mm,
        in_library=truth.name in library,
    )


def pixel_features(h: npt.ArrayLike, v: npt.ArrayLike, p: npt.ArrayLike) -> Real:
    """Return features [n, 4] of pixels (`library.make_features`); not finite for unusable pixels."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return make_features(np.ravel(h), np.ravel(v), np.ravel(p))


def make_labels(result: MaterialsResult, description: str = "") -> Labels:
    """Return boxes around the interiors of a result's patches, in pixels, with unique names as drawn or classified.

    Patches without a name of the library are called "patch", a metal reference that is one of them "metal".
    """
    boxes: dict[str, Box] = {}
    for patch_result in result.patches:
        name = "patch"
        if result.boxes.get(patch_result.patch.label):
            name = result.boxes[patch_result.patch.label]
        elif patch_result.patch.label == result.metal.label:
            name = "metal"
        elif patch_result.patch_name is not None and patch_result.patch_name.source == "library":
            name = patch_result.patch_name.name
        interior = patch_result.patch.interior if patch_result.patch.interior.any() else patch_result.patch.mask
        rows = np.flatnonzero(interior.any(axis=1))
        columns = np.flatnonzero(interior.any(axis=0))
        key = name if name not in boxes else f"{name} ({patch_result.patch.label})"
        boxes[key] = (float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1))
    return Labels(boxes, description=description)


def pixel_accuracy(result: MaterialsResult) -> float | None:
    """Return the share of interior pixels named right over all patches of known truth; None without such patches.

    None also if metal is the only material: it is the reference, and there was nothing to name. Patches rightly called
    unknown, because the library does not hold their material, do not count.
    """
    right = [n.pixel_names == truth for n, truth in _select_true_patches(result)]
    return float(np.concatenate(right).mean()) if right else None


def predict_pixel_accuracy(result: MaterialsResult) -> float | None:
    """Return the share of the pixels of :func:`pixel_accuracy` that the best classifier is expected to name right.

    It is the mean probability of each pixel's likeliest material, so that no choice of names is expected to do better
    on these data. None without known truth, or if the classifier gives no probabilities.
    """
    shares = [n.confidence for n, _ in _select_true_patches(result)]
    known_shares = [s for s in shares if s is not None]
    if known_shares and len(known_shares) == len(shares):
        return float(np.concatenate(known_shares).mean())
    return None


def _select_true_patches(result: MaterialsResult) -> list[tuple[NamedPatch, str]]:
    """Return the named patches of known truth, each with the true name; without those rightly called unknown.

    Empty if no patch is of a material with a permittivity.
    """
    if not any(r.truth and r.truth.permittivity is not None for r in result.patches):
        return []
    judged = [
        (r.named, r.patch_name.name, r.truth.name) for r in result.patches if r.named and r.patch_name and r.truth
    ]
    return [
        (n, truth) for n, name, truth in judged if n.pixel_names.size and (name != UNKNOWN or truth in result.library)
    ]
