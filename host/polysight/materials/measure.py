"""Measure each patch (ratio, brightness, standard deviations) and refuse patches that are no flat plates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials.inversion import PatchMeasurement
from polysight.materials.permittivity import inverse_spread, median_ratio
from polysight.materials.segment import Mask, Patch, Segmentation

Image = npt.NDArray[np.complexfloating]

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


@dataclass(frozen=True)
class Refused:
    """Reason why a patch gets no name and no permittivity."""

    what: str
    why: str
    do: str

    def to_dict(self) -> dict[str, str]:
        """Return plain values for JSON."""
        return {"what": self.what, "why": self.why, "do": self.do}


def background(h: Image, v: Image, found: Segmentation, usable: Mask) -> tuple[float, float]:
    """Return the rms of |H| and |V| away from all patches (noise and sidelobes); NaN without such pixels."""
    away = usable & np.isfinite(h) & np.isfinite(v)
    for patch in found.patches:
        away &= ~np.asarray(scipy.ndimage.binary_dilation(patch.mask, iterations=_AROUND_PX), bool)
    if not away.any():
        return float("nan"), float("nan")
    levels = [float(np.sqrt(np.mean(np.abs(c[away].astype(np.complex128)) ** 2))) for c in (h, v)]
    return levels[0], levels[1]


def check_patch(patch: Patch, h: Image, v: Image, dark: tuple[float, float], uneven: float) -> Refused | None:
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
        return Refused(
            "too few pixels", f"{int(at.sum())} lie inside its edges", "scan a larger plate, or finer pixels"
        )
    level = np.abs(h[at]).astype(np.float64)
    if not level.mean() > 0:
        return Refused("no signal", "H is zero there", remedy)
    if float(level.std() / level.mean()) > FLAT_CONTRAST:
        return Refused("noise or speckle, not a flat plate", "its brightness varies like noise", remedy)
    if np.isfinite(dark[0]) and float(np.median(level)) < LEAST_LEVEL * dark[0]:
        return Refused("as dark as the background", "it does not stand out from noise and sidelobes", remedy)
    cross = abs(np.vdot(h[at].astype(np.complex128), v[at]))
    power_h, power_v = (float(np.sum(np.abs(c[at].astype(np.complex128)) ** 2)) for c in (h, v))
    dim = float(np.median(np.abs(v[at]))) < 0.12 * float(np.median(level))
    if not dim and cross < 0.7 * np.sqrt(power_h * power_v):
        return Refused("H and V do not agree", "their phase difference varies from pixel to pixel, like noise", remedy)
    allowed = max(HALVES_APART, uneven) * (1 + 2 * float(np.median(np.abs(v[at])) / np.median(level)))
    several, apart = "several kinds together", "move the plates apart, or draw boxes"
    if halves_apart(h, v, at) > allowed:
        return Refused(several, "its halves have different ratios", apart)
    odd = np.abs(v[at] / h[at] - 1 / median_ratio(h[at], v[at])) > ODD_RATIO
    if float(odd.mean()) > ODD_SHARE:
        return Refused(several, f"{100 * odd.mean():.0f} % of its pixels have another ratio", apart)
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
) -> dict[int, Refused]:
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
