"""Result of `analyse`: patches with permittivities and names, their rows for materials.json, and `patches.npz`.

`patches.npz` holds the features of the pixels of all patches; `match_patches` finds the same patches in several scans,
to name them together.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy
from msgspec import UNSET, structs

from polysight.imaging import MAX_RISE, Illumination, Image, Images, Rise
from polysight.materials.common_change import CommonChange
from polysight.materials.inversion import Inversion, RigPrior
from polysight.materials.kinds import PatchDispersion, RatioCase, RatioEvidence, find_permittivity_slope, split_complex
from polysight.materials.labels import Labels
from polysight.materials.library import Real, make_features
from polysight.materials.measure import Permittivity, measure_background, ratio_sigma
from polysight.materials.metal import MetalReference
from polysight.materials.names import UNKNOWN, NamedPatch, PatchName
from polysight.materials.segment import Box, Patch, Segmentation, TruthPlate, axis_mm
from polysight.results import BandFigures, ComplexNumber, PatchFigures, PermittivityFigures, TruthFigures
from polysight.store import open_npz
from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.findings import Finding

MAX_BEND = 3.5
"""Curvature above which a patch is not a flat plate, 1 / m. Flat plates that are uneven by 0.25 mm have up to 1.4 in
drawn scenes and ripple of the published picture up to 3; sheets bent to a radius of 150 mm have 5.6, spheres of 100 mm
6 to 10."""
STEEP_FINDING = Finding(
    "error",
    "tilted or curved beyond what is modelled",
    f"its phase rises by more than {np.degrees(MAX_RISE):.1f} degrees, or bends as that of a radius below "
    f"{1 / MAX_BEND:.1f} m: H and V see other places, turned polarisations",
    "lay it flat, or measure it as it is with `polysight surface`",
)
"""Why a steep patch gets no permittivity."""
SMEAR = Finding(
    "error",
    "a smear at the end of the scan",
    "positions without data or with a wrong phase spread plates along x or y, and the correction of the footprint lifts"
    " what lies at the end of the illuminated area",
    "nothing needs to lie there; scan again without gaps if something does",
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


PATCHES_FILE = "patches.npz"
PATCHES_FORMAT = "polysight-patches-1"
"""Name of the file in a scan's products, and of its format: a file of another one is refused."""
SAME_PATCH_MM = 20.0
"""Largest distance between the centres of one patch in two scans. Chosen: less than half of a plate and its gap."""
NEAR_MM = 4.0
"""Largest distance between pixels of two scans that show the same spot: about the resolution."""


@dataclass(frozen=True)
class ScanPatch:
    """A patch in one scan: its centre (mm from the image centre), the positions and features of its pixels.

    `places_mm` float64 [n, 2] from the image centre, `features` float64 [n, 4] of its interior, after the Gaussian
    filter (`pixel_features`). `truth` is the true material, if known.
    """

    label: int
    centre_mm: tuple[float, float]
    truth: str | None
    places_mm: Real
    features: Real


@dataclass(frozen=True)
class ScanPatches:
    """The patches of one scan; `evidence`: patch number to what its name rests on (earlier releases wrote none).

    `angle_deg` is the mean incidence angle over the image; `simulated` is true if the scan was.
    """

    angle_deg: float
    simulated: bool
    patches: tuple[ScanPatch, ...]
    evidence: Mapping[int, RatioEvidence] = field(default_factory=dict)


@dataclass(frozen=True)
class MatchedPatch:
    """A patch that several scans show.

    Attributes
    ----------
    label, truth
        Number in the first scan, and true material, if known.
    features
        float64 [n, 4 * scans] of the spots that all of them show.
    evidence
        What each scan says of it; None if one of them does not say.
    """

    label: int
    truth: str | None
    features: Real
    evidence: tuple[RatioEvidence, ...] | None = None


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


def pack_patches(result: MaterialsResult, x_m: npt.ArrayLike, y_m: npt.ArrayLike, simulated: bool) -> bytes:
    """Return the content of `patches.npz`; `x_m`, `y_m` are the image's axes."""
    x = axis_mm(x_m)
    y = axis_mm(y_m)
    rows = []
    places = [np.zeros((0, 2))]
    features = [np.zeros((0, 4))]
    for patch_result in result.patches:
        pixels = patch_result.patch.interior
        iy, ix = np.nonzero(pixels)
        places.append(np.stack([x[ix], y[iy]], axis=1))
        features.append(pixel_features(result.h[pixels], result.v[pixels], result.p[pixels]))
        truth = patch_result.truth.name if patch_result.truth else None
        rows.append(
            {
                "label": patch_result.patch.label,
                "centre_mm": patch_result.patch.centre_mm,
                "truth": truth,
                "pixels": int(ix.size),
            }
        )
    angle = float(np.degrees(np.mean(result.theta_rad)))
    judged = list(result.evidence)
    meta = {"format": PATCHES_FORMAT, "angle_deg": angle, "simulated": simulated, "patches": rows, "judged": judged}
    evidence = result.evidence.values()
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        meta=np.frombuffer(json.dumps(meta).encode("utf-8"), np.uint8),
        places_mm=np.concatenate(places).astype(np.float32),
        features=np.concatenate(features).astype(np.float32),
        evidence_theta_rad=np.array([e.theta_rad for e in evidence], np.float64),
        evidence_ratio=np.array([e.inverse_ratio for e in evidence], np.complex128),
        evidence_covariance=np.array([e.covariance for e in evidence], np.float64).reshape(-1, 2, 2),
        evidence_share=np.array([e.library_share for e in evidence], np.float64),
        evidence_brightness=np.reshape([[e.brightness_off, e.brightness_std] for e in evidence], (-1, 2)),
        evidence_dispersion=np.reshape([_pack_dispersion(e.dispersion) for e in evidence], (-1, 8)),
        evidence_cases=np.reshape([_pack_cases(e.cases) for e in evidence], (-1, 2, 7)),
    )
    return buffer.getvalue()


def _pack_dispersion(dispersion: PatchDispersion | None) -> Real:
    """Return change, standard deviations, and the band in Hz, float64 [8]; NaN if they are not known."""
    if dispersion is None:
        return np.full(8, np.nan)
    return np.concatenate([dispersion.change, dispersion.std, dispersion.band_hz])


def _unpack_dispersion(row: Real) -> PatchDispersion | None:
    """Return what :func:`_pack_dispersion` packed; None if it is not known."""
    if not np.isfinite(row).all():
        return None
    return PatchDispersion(row[:3], row[3:6], (float(row[6]), float(row[7])))


def _pack_cases(cases: Sequence[RatioCase]) -> Real:
    """Return probability, t and covariance of both cases, float64 [2, 7]; NaN if there is one."""
    rows = [[case.probability, *split_complex(case.inverse_ratio), *case.covariance.flat] for case in cases]
    return np.array(rows) if rows else np.full((2, 7), np.nan)


def _unpack_cases(rows: Real) -> tuple[RatioCase, ...]:
    """Return what :func:`_pack_cases` packed."""
    return tuple(RatioCase(row[0], complex(*row[1:3]), row[3:].reshape(2, 2)) for row in rows[np.isfinite(rows[:, 0])])


def read_patches(path: Path) -> ScanPatches:
    """Read `patches.npz` (no pickle). Raises DataError."""
    try:
        with open_npz(path) as z:
            meta = json.loads(z["meta"].tobytes().decode("utf-8"))
            places = z["places_mm"].astype(np.float64)
            features = z["features"].astype(np.float64)
            evidence = _read_evidence(z, meta["judged"]) if "evidence_ratio" in z else {}
        if meta["format"] != PATCHES_FORMAT:
            raise ValueError(f"its format is {meta['format']!r}, this program reads {PATCHES_FORMAT!r}")
        ends = np.cumsum([0, *(int(r["pixels"]) for r in meta["patches"])])
        if features.shape != (ends[-1], 4) or places.shape != (ends[-1], 2):
            raise ValueError(f"arrays {places.shape}, {features.shape} for {ends[-1]} pixels")
        patches = tuple(
            _read_patch(r, places[a:b], features[a:b]) for r, a, b in zip(meta["patches"], ends, ends[1:], strict=False)
        )
        return ScanPatches(float(meta["angle_deg"]), bool(meta["simulated"]), patches, evidence)
    except (OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, zipfile.BadZipFile) as e:
        raise DataError(
            f"{path}: the patches cannot be read: {type(e).__name__}: {e}",
            "it is damaged, or of another version", "process the scan again", code=ErrorCode.FILE_UNREADABLE,
        ) from None  # fmt: skip


def _read_evidence(arrays: Mapping[str, npt.NDArray], judged: Sequence[int]) -> dict[int, RatioEvidence]:
    """Return what the names of the judged patches rest on. Raises ValueError if the arrays do not fit."""
    # Products of earlier states hold neither brightness nor dispersion nor cases.
    brightness = arrays.get("evidence_brightness", np.full((len(judged), 2), np.nan))
    dispersions = arrays.get("evidence_dispersion", np.full((len(judged), 8), np.nan))
    cases = arrays.get("evidence_cases", np.full((len(judged), 2, 7), np.nan))
    numbers = [arrays[f"evidence_{name}"] for name in ("theta_rad", "ratio", "covariance", "share")]
    columns = zip(*numbers, brightness, map(_unpack_dispersion, dispersions), map(_unpack_cases, cases), strict=True)
    rows = [
        RatioEvidence(
            theta_rad=float(angle), inverse_ratio=complex(ratio), covariance=covariance, library_share=float(share),
            brightness_off=float(off), brightness_std=float(std), dispersion=dispersion, cases=both_cases,
        )
        for angle, ratio, covariance, share, (off, std), dispersion, both_cases in columns
    ]  # fmt: skip
    if any(row.covariance.shape != (2, 2) for row in rows):
        raise ValueError("covariances are not [patch, 2, 2]")
    return dict(zip(map(int, judged), rows, strict=True))


def _read_patch(row: Mapping[str, Any], places: Real, features: Real) -> ScanPatch:
    x, y = row["centre_mm"]
    return ScanPatch(int(str(row["label"])), (float(x), float(y)), row["truth"], places, features)


def match_patches(scans: Sequence[ScanPatches]) -> list[MatchedPatch]:
    """Return the patches that all scans show at the same place, pixel by pixel.

    Two patches match if their centres are each other's nearest and at most `SAME_PATCH_MM` apart. Pixels match by their
    position in the patch, so that the scans' image centres may differ by up to half a patch.
    """
    matched = []
    for patch in scans[0].patches:
        partners = [p for other_scan in scans[1:] if (p := _find_partner(patch, scans[0], other_scan)) is not None]
        if len(partners) < len(scans) - 1:
            continue
        pairs = zip(scans, (patch, *partners), strict=True)
        evidence = tuple(scan.evidence[p.label] for scan, p in pairs if p.label in scan.evidence)
        places = patch.places_mm - patch.centre_mm
        columns = [patch.features]
        near_enough = np.ones(len(places), bool)
        for partner in partners:
            partner_places = partner.places_mm - partner.centre_mm
            if not len(partner_places):
                near_enough[:] = False
                columns.append(columns[0])
                continue
            distance_mm, nearest_index = scipy.spatial.KDTree(partner_places).query(places)
            near_enough &= distance_mm <= NEAR_MM
            columns.append(partner.features[np.minimum(nearest_index, len(partner_places) - 1)])
        complete = evidence if len(evidence) == len(scans) else None
        matched.append(MatchedPatch(patch.label, patch.truth, np.hstack(columns)[near_enough], complete))
    return matched


def _find_partner(patch: ScanPatch, own_scan: ScanPatches, other_scan: ScanPatches) -> ScanPatch | None:
    """Return the other scan's patch nearest to this one, if this one is also the nearest to it."""

    def nearest(patch: ScanPatch, among: ScanPatches) -> ScanPatch | None:
        def distance_mm(candidate: ScanPatch) -> float:
            return float(
                np.hypot(candidate.centre_mm[0] - patch.centre_mm[0], candidate.centre_mm[1] - patch.centre_mm[1])
            )

        best = min(among.patches, key=distance_mm, default=None)
        return best if best is not None and distance_mm(best) <= SAME_PATCH_MM else None

    partner = nearest(patch, other_scan)
    if partner is not None and nearest(partner, own_scan) is patch:
        return partner
    return None


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
