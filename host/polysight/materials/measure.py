"""Measure patches: ratio, brightness and their errors, the metal reference, and the permittivity.

`measure_patch` gives the input of the joint inversion, `permittivity_of_patch` combines its result with the percentiles
of the pixels. `check_patches` refuses patches that are no flat plates. `MetalReference` is the region that everything
is divided by: given as a box or a patch, or found.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import scipy

from polysight.imaging import Image, Mask
from polysight.materials.inversion import (
    MetalEvidence,
    PatchEstimate,
    PatchMeasurement,
    slope,
)
from polysight.materials.segment import Box, Patch, Segmentation, box_mask
from polysight.materials.specimens import METAL_WITHOUT_PERMITTIVITY
from polysight.polarimetry import inverse_spread, permittivity_from_ratio
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError
from polysight_shared.findings import Finding

SPREAD_SHARE = 0.40
"""Error of a patch's V / H over the spread of its pixels: speckle averages out, edges and neighbours do not.

This and the next two are fitted to simulated scenes (benchmarks/coverage).
"""
LEAST_STD = 1.4e-3
"""Least error of V / H, even with uniform pixels: H and V are illuminated from points some 15 mm apart."""
TILT_STD = 0.004
"""Error of V / H if the phase of H spreads over the patch by one radian.

A tilted plate is illuminated from other points, different for H and V; one degree of tilt spreads the phase by 0.3 rad.
"""
LEAST_PIXELS = 12
FLAT_CONTRAST = 0.4
"""Largest standard deviation of |H| over its mean in a patch: noise or speckle has 0.52, plates less than 0.25."""
LEAST_LEVEL = 2.0
"""Least |H| over the background's root mean square."""
ODD_SHARE, ODD_RATIO = 0.15, 0.15
"""Share of pixels, and their distance from the median V / H, that indicate several materials in one patch."""
HALVES_APART = 0.05
"""Difference of V / H between opposite halves of a dielectric (thrice for metal), above which two materials touch."""
_AROUND_PX = 6  # margin around patches that does not count as background

AMPLIFIES = "it would amplify beyond its error bar"
BELOW_AIR = "its permittivity would be below that of air"
NOT_PASSIVE = (AMPLIFIES, BELOW_AIR)
"""Reasons for refusing plates whose permittivity is impossible for a passive material."""


def background(h: Image, v: Image, found: Segmentation, usable: Mask) -> tuple[float, float]:
    """Return the rms of |H| and |V| away from all patches (noise and sidelobes); NaN without such pixels."""
    away = usable & np.isfinite(h) & np.isfinite(v)
    for patch in found.patches:
        away &= ~np.asarray(scipy.ndimage.binary_dilation(patch.mask, iterations=_AROUND_PX), bool)
    if not away.any():
        return float("nan"), float("nan")
    levels = [float(np.sqrt(np.mean(np.abs(c[away].astype(np.complex128)) ** 2))) for c in (h, v)]
    return levels[0], levels[1]


def check_patch(patch: Patch, h: Image, v: Image, dark: tuple[float, float], uneven: float) -> Finding | None:
    """Return why a patch is no flat plate; None if it may be one.

    Parameters
    ----------
    patch
        The patch.
    h, v
        complex [ny, nx], smoothed inside patches; any reference.
    dark
        Result of :func:`background`, in the same units.
    uneven
        Difference between halves of the metal reference: the scan's own effect on a single material.
    """
    at = patch.interior & np.isfinite(h) & np.isfinite(v)
    remedy = "check the image, the direct path and the range profile"
    if int(at.sum()) < LEAST_PIXELS:
        return Finding(
            "error", "too few pixels", f"{int(at.sum())} lie inside its edges", "scan a larger plate, or finer pixels"
        )
    level = np.abs(h[at]).astype(np.float64)
    if not level.mean() > 0:
        return Finding("error", "no signal", "H is zero there", remedy)
    if float(level.std() / level.mean()) > FLAT_CONTRAST:
        return Finding("error", "noise or speckle, not a flat plate", "its brightness varies like noise", remedy)
    if np.isfinite(dark[0]) and float(np.median(level)) < LEAST_LEVEL * dark[0]:
        return Finding("error", "as dark as the background", "it does not stand out from noise and sidelobes", remedy)
    cross = abs(np.vdot(h[at].astype(np.complex128), v[at]))
    power_h, power_v = (float(np.sum(np.abs(c[at].astype(np.complex128)) ** 2)) for c in (h, v))
    dim = float(np.median(np.abs(v[at]))) < 0.12 * float(np.median(level))
    if not dim and cross < 0.7 * np.sqrt(power_h * power_v):
        return Finding(
            "error", "H and V do not agree", "their phase difference varies from pixel to pixel, like noise", remedy
        )
    allowed = max(HALVES_APART, uneven) * (1 + 2 * float(np.median(np.abs(v[at])) / np.median(level)))
    several, apart = "several kinds together", "move the plates apart, or draw boxes"
    if halves_apart(h, v, at) > allowed:
        return Finding("error", several, "its halves have different ratios", apart)
    odd = np.abs(v[at] / h[at] - 1 / median_ratio(h[at], v[at])) > ODD_RATIO
    if float(odd.mean()) > ODD_SHARE:
        return Finding("error", several, f"{100 * odd.mean():.0f} % of its pixels have another ratio", apart)
    return None


def halves_apart(h: Image, v: Image, at: Mask) -> float:
    """Return the largest difference of the median V / H between opposite halves of a patch; 0 with too few pixels."""
    rows, columns = np.nonzero(at & np.isfinite(h) & np.isfinite(v) & (h != 0))
    values, largest = v[rows, columns] / h[rows, columns], 0.0
    for place in (rows, columns):
        if place.size == 0:
            break
        low, high = values[place < np.median(place)], values[place > np.median(place)]
        if min(low.size, high.size) >= LEAST_PIXELS // 2:
            real = float(np.median(low.real) - np.median(high.real))
            imag = float(np.median(low.imag) - np.median(high.imag))
            largest = max(largest, float(np.hypot(real, imag)))
    return largest


def measure_patch(patch: Patch, h: Image, v: Image, theta_rad: float, local_std: float = 0.0) -> PatchMeasurement:
    """Measure a patch's ratio with its standard deviation, and its brightness.

    `local_std` is the relative error of a metal reference that varies over the plane; 0 if it is a single number.
    """
    at = patch.interior
    ratio = median_ratio(h[at], v[at])
    inverse = 1 / ratio if ratio else complex(np.inf, 0.0)
    spread = inverse_spread(h[at], v[at])
    level = np.abs(h[at])
    level = level[np.isfinite(level)]
    parts = (SPREAD_SHARE * spread, LEAST_STD, TILT_STD * _phase_spread(h[at]), local_std * abs(inverse))
    std = float(np.sqrt(np.sum(np.square(parts)))) if np.isfinite(spread) else float("inf")
    return PatchMeasurement(inverse, std, theta_rad, float(np.median(level)) if level.size else None)


def _phase_spread(h: Image) -> float:
    """Return the circular standard deviation of the phase of H over a patch, radians; a tilt increases it."""
    h = h[np.isfinite(h)].astype(np.complex128)
    coherent = abs(h.sum()) / max(float(np.abs(h).sum()), 1e-300)
    return float(np.sqrt(-2 * np.log(min(max(coherent, 1e-3), 1.0))))


def reference_std(spread: float) -> float:
    """Return the relative standard deviation of metal's V / H from the spread of its pixels."""
    return float(np.hypot(SPREAD_SHARE * spread, LEAST_STD)) if np.isfinite(spread) else LEAST_STD


def check_patches(
    found: Segmentation, h: Image, v: Image, dark: tuple[float, float], metal: Mask
) -> dict[int, Finding]:
    """Return patch number to reason for all patches that are no plates; `metal` is the metal reference's interior."""
    uneven = halves_apart(h, v, metal)
    why = ((p.label, check_patch(p, h, v, dark, uneven)) for p in found.patches)
    return {label: reason for label, reason in why if reason is not None}


def ratio_sigma(
    h: Image, v: Image, dark: tuple[float, float], systematic: npt.NDArray[np.float64]
) -> npt.NDArray[np.float32]:
    """Return the standard deviation of each pixel's P = H / V, root mean variance of both parts, float32 [ny, nx].

    The error of 1 / P = V / H combines the background (noise and sidelobes) over |H|, and `systematic` [ny, nx] of
    leakage and metal reference; dP = -P^2 d(1/P). NaN where P is NaN.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = v.astype(np.complex128) / h
        noise = np.hypot(dark[1], np.abs(inverse) * dark[0]) / np.abs(h) / np.sqrt(2)
        sigma = np.hypot(np.nan_to_num(noise), systematic) / np.abs(inverse) ** 2
    return np.where(np.isfinite(sigma) & np.isfinite(h) & np.isfinite(v), sigma, np.nan).astype(np.float32)


@dataclass(frozen=True)
class Permittivity:
    """Permittivity of one patch.

    Attributes
    ----------
    value
        eps' - j eps'' of the median ratio; None if the patch is metal-like.
    real_range, imag_range
        30th to 70th percentile of the real part and of the imaginary part over the pixels (the paper's choice); None if
        metal-like.
    real_std, loss_std
        Standard error of eps' and of eps'', including the effect of the plate's place on the plane. None if metal-like.
    ratio
        Median polarisation ratio P.
    inverse_std
        Standard error of V / H, of its real part and of its imaginary part.
    metal_distance
        The smaller of |P - 1| and |1/P - 1|.
    pixels
        Pixels used.
    covariance
        float64 [2, 2] of the real and the imaginary part by the scene's error budget; None without one.
    shares
        Source of error to its share of that covariance's trace.
    """

    value: complex | None = None
    real_range: tuple[float, float] | None = None
    imag_range: tuple[float, float] | None = None
    real_std: float | None = None
    loss_std: float | None = None
    ratio: complex = complex(np.nan, np.nan)
    inverse_std: float = float("nan")
    metal_distance: float = float("nan")
    pixels: int = 0
    covariance: npt.NDArray[np.float64] | None = None
    shares: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def not_estimated(
        cls,
        ratio: complex = complex(np.nan, np.nan),
        inverse_std: float = float("nan"),
        metal_distance: float = float("nan"),
        pixels: int = 0,
    ) -> Permittivity:
        """Return the entry of a patch without a permittivity: metal-like, or without a result."""
        return cls(ratio=ratio, inverse_std=inverse_std, metal_distance=metal_distance, pixels=pixels)

    @property
    def dominated_by(self) -> str | None:
        """The source with the largest share of the error."""
        return max(self.shares, key=lambda s: self.shares[s]) if self.shares else None

    @property
    def metal_like(self) -> bool:
        """True if P is known and too close to 1 for a permittivity."""
        return bool(np.isfinite(self.ratio)) and not self.metal_distance >= METAL_WITHOUT_PERMITTIVITY


def format_permittivity(value: complex, digits: int = 2, width: int = 0) -> str:
    """Format a permittivity: `2.89 - j0.43` for a lossy medium, `2.89 + j27.30` for one with gain.

    `digits` stand behind the point; `width` is the least width of the real part, for aligned columns.
    """
    real, imag = (round(float(part), digits) + 0.0 for part in (value.real, value.imag))  # + 0.0: no -0.00
    return f"{real:{width}.{digits}f} {'+' if imag > 0 else '-'} j{abs(imag):.{digits}f}"


def median_ratio(h: Image, v: Image) -> complex:
    """Return a robust mean of P = H / V over pixels: the reciprocal of the median of V / H; NaN without usable pixels.

    Dielectrics reflect s more strongly than p. With the strong channel in the denominator the noise of the ratio is
    additive and symmetric even where V nearly vanishes; H / V itself has no mean there. Medians are taken of real and
    imaginary part separately.
    """
    good = np.isfinite(h) & np.isfinite(v) & (h != 0)
    if not good.any():
        return complex(np.nan, np.nan)
    inverse = v[good].astype(np.complex128) / h[good]
    middle = complex(np.median(inverse.real), np.median(inverse.imag))
    return 1 / middle if middle != 0 else complex(np.inf, 0.0)


def estimate_permittivity(
    h: Image,
    v: Image,
    theta_rad: npt.ArrayLike,
) -> Permittivity:
    """Estimate the permittivity of one patch from its metal-referenced pixels, with its error by the delta method.

    The error of V / H is the spread of the pixels, **not** divided by the root of their number: the main errors inside
    a patch, diffraction at its edges and the neighbours' sidelobes, are as wide as the patch and do not average out.
    Differences between the illumination of H and V that vary more slowly than a patch are not included; a reference
    over the whole plane removes them. Eq. 3 is holomorphic, so both parts of the permittivity have the standard error
    |d eps / d q| times that of q = V / H.

    On simulated scans (eight placements of eight materials, all disturbances) the error is half of what is claimed,
    rms, and 94 % of the values lie within one standard error.

    `h` and `v` complex [n] are the pixels of the interior, metal-referenced and leakage-corrected; `theta_rad` is the
    incidence angle, one number or [n].
    """
    ratio = median_ratio(h, v)
    good = np.isfinite(h) & np.isfinite(v) & (h != 0)
    distance = min(abs(ratio - 1), abs(1 / ratio - 1) if ratio != 0 else np.inf)
    n = int(good.sum())
    inverse = 1 / ratio if ratio != 0 else complex(np.inf, 0.0)
    inverse_std = inverse_spread(h, v)
    if not distance >= METAL_WITHOUT_PERMITTIVITY:  # also when it is not a number
        return Permittivity.not_estimated(ratio, inverse_std, float(distance), n)
    theta = np.broadcast_to(np.asarray(theta_rad, np.float64), h.shape)[good]
    value = complex(permittivity_from_ratio(ratio, float(theta.mean())))
    pixels = permittivity_from_ratio(v[good].astype(np.complex128) / h[good], theta)
    pixels = pixels[np.isfinite(pixels)]
    re, im = (np.percentile(part, [30, 70]) for part in (pixels.real, pixels.imag))
    std = float(abs(slope(inverse, float(theta.mean()))) * inverse_std)
    return Permittivity(
        value=value,
        real_range=(float(re[0]), float(re[1])),
        imag_range=(float(im[0]), float(im[1])),
        real_std=std,
        loss_std=std,
        ratio=ratio,
        inverse_std=inverse_std,
        metal_distance=float(distance),
        pixels=n,
    )


def permittivity_of_patch(
    h: Image,
    v: Image,
    theta_rad: float,
    estimate: PatchEstimate | None,
) -> Permittivity:
    """Return the permittivity of one patch with the error budget of the joint inversion.

    The pixels `h` and `v` [n] of the interior are as for :func:`estimate_permittivity`. `estimate` is the result of the
    inversion; None for a patch that it did not include, which gets no permittivity.
    """
    alone = estimate_permittivity(h, v, theta_rad)
    if estimate is None or estimate.permittivity is None or estimate.covariance is None:
        return Permittivity.not_estimated(alone.ratio, alone.inverse_std, alone.metal_distance, alone.pixels)
    ratio = 1 / estimate.inverse_ratio if estimate.inverse_ratio else complex(np.inf, 0.0)
    real_std, loss_std = (float(s) for s in np.sqrt(np.diag(estimate.covariance)))
    own = estimate.inverse_ratio_covariance
    ranges = alone.real_range or (np.nan, np.nan), alone.imag_range or (np.nan, np.nan)
    return replace(
        alone,
        value=estimate.permittivity,
        real_range=ranges[0],
        imag_range=ranges[1],
        real_std=real_std,
        loss_std=loss_std,
        ratio=ratio,
        inverse_std=float(np.sqrt(np.trace(own) / 2)),
        covariance=estimate.covariance,
        shares=estimate.shares,
    )


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
        mask, label = mask & patch.interior, patch.label
    if not mask.any():
        raise DataError(
            f"the metal box {tuple(round(b, 1) for b in box_mm)} mm holds no valid pixel",
            "it lies outside the image; boxes are in millimetres from the image centre",
            "give --metal x,y,w,h inside the image",
            code=ErrorCode.NO_DATA,
        )
    where = "" if label is None else f", inside patch {label}"
    return MetalReference(
        mask, label, f"given as a box around ({', '.join(f'{b:.0f}' for b in box_mm)}) mm{where}", given=True
    )


def metal_by_label(label: int, segmentation: Segmentation) -> MetalReference:
    """Take this patch as the metal reference. Raises DataError if there is no such patch."""
    for p in segmentation.patches:
        if p.label == label:
            return MetalReference(p.interior, label, f"given as patch {label}", given=True)
    raise DataError(
        f"there is no patch {label} to take as metal",
        f"{len(segmentation.patches)} patches were found",
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
    beside = "the only patch found" if len(scores) == 1 else f"|H||V| {margin:.1f} times the next"
    how = f"chosen as the patch that is brightest in both channels ({beside})"
    return MetalReference(patch.interior, patch.label, how)
