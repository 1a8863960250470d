"""Maps of a processed scan: H, V and P as they are drawn, and the permittivity of each pixel with its errors.

Figures of reports and pictures of pages draw the same values. Amplitudes are in dB, phases in degrees. If a channel has
only noise at a pixel, its phase and the ratio mean nothing there, and the pixel is transparent.

For permittivities, the pixels of image.npz are relative to metal, and the leakage that was known before the scan is
removed from them. The scene determines more: the leakage and the incidence angle in the error budget apply to all
pixels; drift, tilt and the error of the metal reference are known only for patches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec import UnsetType

from polysight.imaging import Images
from polysight.materials import find_permittivity_slope, incidence_std_rad
from polysight.polarimetry import (
    correct_leakage,
    fresnel,
    incidence_choice,
    incidence_on_planes,
    permittivity_from_ratio,
    ratio,
    specular_incidence_rad,
)
from polysight.products.processed import ProcessedScan
from polysight.results import ErrorBudget, LeakageError, Pair

Real = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
# Values at the lower and the upper end of the colours.
Limits = tuple[float, float]

# A map shows one quantity of one channel.
CHANNELS = ("h", "v", "p")
QUANTITIES = ("amplitude", "phase")
# Range of the colours of amplitudes, below their upper end; chosen.
AMPLITUDE_RANGE_DB = 35.0
# Percentiles that stand for the brightest pixels: for the upper end of an amplitude's colours, and for the opacity of a
# phase. Both are chosen below 100, so that single bright pixels neither darken the others nor make them transparent.
BRIGHT_PERCENTILE = 99.8
REFERENCE_PERCENTILE = 99.5
# Levels relative to the brightest pixels: below the first one phases and ratios are transparent, above the second one
# they are opaque; chosen.
FAINT_DB = -26.0
CLEAR_DB = -18.0
# Range of |P| of an image without patches: percentiles of the opaque pixels, and a range if there are none; chosen.
RATIO_PERCENTILES = (5.0, 95.0)
NO_RATIOS_DB = (0.0, 20.0)
# Narrowest range of |P|; chosen. With a narrower one noise would look like a difference.
LEAST_RATIO_RANGE_DB = 6.0
# Smallest amplitude of which a level is computed: smaller ones, and zero, get its level.
LEAST_AMPLITUDE = 1e-12


@dataclass(frozen=True)
class MapValues:
    """Numbers and opacity (0 to 1), both [ny, nx], of a map, and the limits of its colours; amplitudes are in dB."""

    numbers: npt.NDArray[Any]
    opacity: npt.NDArray[Any]
    limits: Limits


def level_db(values: npt.NDArray[np.complexfloating]) -> Real:
    """Return 20 log10 |values|, shape of `values`; zero and non-finite values get the level of the least amplitude."""
    amplitude = np.nan_to_num(np.abs(values).astype(np.float64), nan=0.0, posinf=0.0)
    return 20 * np.log10(np.maximum(amplitude, LEAST_AMPLITUDE))


def percentile(values: Real, mask: Mask, percent: float, default: float = 0.0) -> float:
    """Return a percentile of the values under a mask of their shape; `default` if it is empty."""
    if mask.any():
        return float(np.percentile(values[mask], percent))
    return default


def level_below_brightest_db(images: Images, channel: str) -> Real:
    """Return the level relative to the brightest pixels of a channel, dB [ny, nx]; of P that of the fainter channel."""
    if channel == "p":
        return np.minimum(level_below_brightest_db(images, "h"), level_below_brightest_db(images, "v"))
    level = level_db(images.h if channel == "h" else images.v)
    return level - percentile(level, images.usable, REFERENCE_PERCENTILE)


def signal_opacity(images: Images, channel: str) -> Real:
    """Return the opacity of a channel's phase or of P, 0 to 1 [ny, nx]: pixels of only noise are transparent."""
    level = level_below_brightest_db(images, channel)
    return np.clip((level - FAINT_DB) / (CLEAR_DB - FAINT_DB), 0.0, 1.0) * images.usable


def map_images(
    images: Images, channel: str, quantity: str, top_db: float | None = None, patches_db: Sequence[float] = ()
) -> MapValues:
    """Return the values of one map of images.

    Parameters
    ----------
    images
        Images; P is their ratio, computed if they have none.
    channel, quantity
        The map: one of `CHANNELS`, one of `QUANTITIES`.
    top_db
        Upper end of |H| and |V|; None: that of the brightest pixels.
    patches_db
        |P| of patches, which the range of |P| includes. If it is empty, the range is that of the bright pixels.
    """
    if channel == "p":
        values = ratio(images.h, images.v) if images.p is None else images.p
    else:
        values = images.h if channel == "h" else images.v
    if quantity == "phase":
        angle_deg = np.degrees(np.angle(np.where(np.isfinite(values), values, 1)))
        return MapValues(angle_deg, signal_opacity(images, channel), (-180.0, 180.0))
    level = level_db(values)
    if channel == "p":
        opacity = signal_opacity(images, channel)
        return MapValues(level, opacity, _find_ratio_limits_db(level, opacity > 0.5, patches_db))
    if top_db is None:
        top_db = percentile(level, images.usable, BRIGHT_PERCENTILE)
    return MapValues(level, images.usable.astype(np.float64), (top_db - AMPLITUDE_RANGE_DB, top_db))


def map_scan(scan: ProcessedScan, channel: str, quantity: str) -> MapValues:
    """Return the values of one map of a processed scan, with |P| in the range of the patches.

    The colours of |H| and |V| end at metal's 0 dB, or at the brightest pixels if the scan is not relative to metal.
    """
    top_db = 0.0 if scan.metal_referenced else None
    levels = [patch.p_abs_db for patch in scan.segments]
    patches_db = [level for level in levels if level is not None]
    return map_images(scan.images, channel, quantity, top_db, patches_db)


def _find_ratio_limits_db(level: Real, is_opaque: Mask, patches_db: Sequence[float]) -> Limits:
    """Return the range of |P| in whole dB: that of the patches if there are any, else of the opaque pixels.

    It is wider than the values by a decibel at both ends, and begins below the 0 dB of metal, because |P| of surfaces
    is above. If all values are far below 0 dB, the range ends below 0 dB.
    """
    if patches_db:
        low = min(patches_db)
        high = max(patches_db)
    else:
        low, high = (
            percentile(level, is_opaque, percent, default)
            for percent, default in zip(RATIO_PERCENTILES, NO_RATIOS_DB, strict=True)
        )
    low = float(np.floor(min(low, 0.0) - 1))
    return low, max(float(np.ceil(high + 1)), low + LEAST_RATIO_RANGE_DB)


# --- permittivity of each pixel ---

# Largest error, relative to its size, of a permittivity that is shown; chosen.
LARGEST_ERROR = 0.5
# Number of standard errors by which a permittivity may be outside of the values of a half space; chosen.
LARGEST_DEVIATION = 2.0
# Step for the derivative by the incidence angle; chosen.
_ANGLE_STEP_RAD = 1e-6

Complex = npt.NDArray[np.complex128]


@dataclass(frozen=True)
class PermittivityMap:
    """Permittivity of each pixel, [ny, nx].

    Attributes
    ----------
    value
        complex128, eps' - j eps''; not a number where the scan lights nothing.
    real_std, loss_std
        float64, standard errors.
    mask
        True where the permittivity is known and possible for a half space.
    """

    value: Complex
    real_std: Real
    loss_std: Real
    mask: npt.NDArray[np.bool_]


def map_permittivity(scan: ProcessedScan) -> PermittivityMap:
    """Return the permittivity of each pixel as a half space.

    The leakage and the incidence angle of the error budget are applied to every pixel. The pixels of a patch are moved
    together, in V / H, so that their median has the patch's permittivity, and none is more certain than the patch.

    The permittivity is analytic in 1 / P, so that the error of P adds the same variance to both parts; the error of the
    angle adds a variance to each part. `Images.p_sigma`, the standard deviation of P, includes noise, metal reference,
    and the remaining leakage. Without an incidence angle all values are not numbers.
    """
    budget = None
    if scan.materials is not None:
        budget = scan.materials.error_budget or None
    angle_rad = _estimate_angle(nominal_incidence_rad(scan), budget)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        measured = 1 / np.where(scan.valid, scan.p, np.nan).astype(np.complex128)
        inverse = measured
        if budget is not None and budget.leakage is not None:
            inverse = _remove_leakage(measured, budget.leakage)
        inverse, least_real_std, least_loss_std = _match_patches(scan, inverse, angle_rad)
        value = permittivity_from_ratio(1 / inverse, angle_rad)
        value = np.where(np.isfinite(value), value, complex(np.nan, np.nan))
        slope_of_ratio = np.abs(find_permittivity_slope(inverse, angle_rad))
        slope_of_angle = (permittivity_from_ratio(1 / inverse, angle_rad + _ANGLE_STEP_RAD) - value) / _ANGLE_STEP_RAD
        inverse_std = np.full(value.shape, np.nan)
        if scan.images.p_sigma is not None:
            # d (1 / P) = -dP / P^2.
            inverse_std = scan.images.p_sigma.astype(np.float64) * np.abs(measured) ** 2
        angle_std_rad = incidence_std_rad(scan.materials)
        real_std = np.fmax(np.hypot(slope_of_ratio * inverse_std, slope_of_angle.real * angle_std_rad), least_real_std)
        loss_std = np.fmax(np.hypot(slope_of_ratio * inverse_std, slope_of_angle.imag * angle_std_rad), least_loss_std)
        return PermittivityMap(value, real_std, loss_std, _is_known_half_space(value, real_std, loss_std))


def nominal_incidence_rad(scan: ProcessedScan) -> Real:
    """Return the incidence angle of the rig, radians: one number or, if pixels have different ones, [ny, nx].

    Not a number if neither rig nor angle are known.
    """
    incidence = scan.quality.incidence
    if scan.rig is None:
        return np.radians(np.float64(incidence.one_deg if incidence else np.nan))
    if incidence and incidence.used == "by pixel":
        return incidence_choice(scan.rig, scan.x_m, scan.y_m, "pixel", scan.images.raised_m).used_rad
    return incidence_on_planes(np.asarray(specular_incidence_rad(scan.rig)), scan.images.raised_m, scan.rig)


def _estimate_angle(theta_rad: Real, budget: ErrorBudget | None) -> Real:
    """Return the incidence angle that the scene determines, radians; the nominal one if the budget has no estimate."""
    if budget is None or budget.incidence is None or budget.incidence.deg is None:
        return theta_rad
    return theta_rad + (np.radians(budget.incidence.deg) - np.median(theta_rad))


def _remove_leakage(inverse: Complex, leakage: LeakageError) -> Complex:
    """Return V / H with the estimated leakage removed, in place of the known one that was removed from the pixels.

    `inverse` is V / H of the pixels, complex [ny, nx]; it is not changed if the products do not give the removed
    leakage.
    """
    removed_h = _join_parts(leakage.removed_h)
    removed_v = _join_parts(leakage.removed_v)
    estimated_h = _join_parts(leakage.h)
    estimated_v = _join_parts(leakage.v)
    if removed_h is None or removed_v is None or estimated_h is None or estimated_v is None:
        return inverse
    # The channels as received, see `correct_leakage`: those of H = 1 and V = `inverse` with leakage, over metal's.
    h = (1 + removed_h * inverse) / (1 + removed_h)
    v = (inverse + removed_v) / (1 + removed_v)
    h, v = correct_leakage(h, v, estimated_h, estimated_v)
    return v / h


def _join_parts(pair: Pair | UnsetType | None) -> complex | None:
    """Return real and imaginary part as a complex number; None if one of them is not known."""
    if not pair or pair[0] is None or pair[1] is None:
        return None
    return complex(pair[0], pair[1])


def _match_patches(scan: ProcessedScan, inverse: Complex, angle_rad: Real) -> tuple[Complex, Real, Real]:
    """Move V / H of the pixels of each patch, so that their median has the patch's permittivity.

    `inverse` complex [ny, nx] is V / H, `angle_rad` a number or [ny, nx]. Return it with the standard errors of the
    patch in each pixel, real part and loss; not a number outside of patches.
    """
    matched = inverse.copy()
    real_std = np.full(inverse.shape, np.nan)
    loss_std = np.full(inverse.shape, np.nan)
    for patch in scan.segments:
        value = patch.permittivity_value
        if value is None:
            continue
        is_of_patch = scan.labels == patch.label
        pixels = is_of_patch & np.isfinite(inverse)
        # If the interiors of patches are known, only they are used: pixels at the edges contain echoes of neighbours.
        if scan.interior is not None:
            pixels &= scan.interior
        if not pixels.any():
            continue
        patch_angle = float(np.broadcast_to(angle_rad, inverse.shape)[pixels].mean())
        r_s, r_p = fresnel(value, patch_angle)
        median = complex(np.median(inverse[pixels].real), np.median(inverse[pixels].imag))
        matched[is_of_patch] += complex(r_p / r_s) - median
        real_std[is_of_patch] = np.nan if patch.permittivity_real_std is None else patch.permittivity_real_std
        loss_std[is_of_patch] = np.nan if patch.permittivity_loss_std is None else patch.permittivity_loss_std
    return matched, real_std, loss_std


def _is_known_half_space(value: Complex, real_std: Real, loss_std: Real) -> npt.NDArray[np.bool_]:
    """Return where the errors are below half of the value and a half space can have it within twice its errors."""
    is_known = np.hypot(real_std, loss_std) < LARGEST_ERROR * np.abs(value)
    # Edges of metal have ratios near 1, which mean large permittivities of either sign.
    has_real_part = np.real(value) + LARGEST_DEVIATION * real_std >= 1.0
    has_loss = -np.imag(value) + LARGEST_DEVIATION * loss_std >= 0.0
    return is_known & has_real_part & has_loss
