"""Measure patches: ratio, brightness and their errors, and the permittivity.

`measure_patch` gives the input of the joint inversion, `estimate_patch_permittivity` combines its result with the
percentiles of the pixels. `check_patches` refuses patches that are not flat plates.

The constants of errors were fitted to scenes of two generators, this project's simulator and an independent one with
other physics (package `polysight_worlds`), and to a picture that the authors of POLySIGHT published.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
import scipy

from polysight.imaging import Dispersion, Image, Images, Mask
from polysight.materials.kinds import Kinds, PatchDispersion, PatchEstimate, PatchMeasurement, find_permittivity_slope
from polysight.materials.names import may_be_thin
from polysight.materials.segment import Patch, Segmentation, touches_border
from polysight.materials.specimens import METAL_WITHOUT_PERMITTIVITY
from polysight.polarimetry import PlaneReference, inverse_spread, permittivity_from_ratio
from polysight_shared.findings import Finding

AMPLITUDE_OF_BLOCKS = 0.85
PHASE_OF_BLOCKS = 0.75
"""Error of a plate's ln|V / H|, and of its phase = this * scatter of its pixels / sqrt(number of independent places).

Speckle averages out. Edges, neighbours and ripple are correlated over 10 to 20 mm: one place is `BLOCK_M` wide.
Errors of 2,500 plates of the independent generator are described best by 0.8 and 0.6; a little more is kept (chosen).
"""
USUAL_BLOCKS = 2.0
"""Weight of the scene's usual scatter in the mean with a plate's own, which weighs as many as its places; chosen."""
BLOCK_M = 0.012
"""Length over which the errors of V / H within a plate are correlated."""
LEAST_STD = 0.6e-3
"""Least error of V / H, even with uniform pixels: H and V are illuminated from points some 15 mm apart.
Between 0.5e-3 and 0.8e-3 the scenes of the independent generator are described equally well."""
TILT_STD = 0.004
"""Error of V / H if the phase of H spreads over the patch by one radian.

A tilted plate is illuminated from other points, different for H and V; one degree of tilt spreads the phase by 0.3 rad.
Chosen."""
BORDER_M = 0.017
BORDER_STD = (0.05, 0.03)
BORDER_POWERS = (4.0, 1.5)
MOST_BORDER_STD = 0.2
"""A plate whose pixels lie at the distance d (median) inside the border of the lit area has the errors BORDER_STD *
(BORDER_M / d)^BORDER_POWERS of ln|V / H| and of its phase, at most MOST_BORDER_STD. In drawn scenes with small
apertures (own simulator, leakage known) 68 % of plates are within 0.156 and 0.055 at 13 mm, 0.03 and 0.025 at 19 mm,
0.013 and 0.018 at 26 mm, and within 0.013 and 0.009 far from the border."""
DISPERSION_STD = (0.006, 0.008)
DISPERSION_SHARE = 0.5
DISPERSION_BEHIND = 1.0
"""Error of a half space's change of ln |H|, and of ln(V / H), over the sweep: the root of the squares of a least error,
of a share of the scatter of its pixels and the metal's, and of a share of what lies behind it. Half spaces in scenes of
the independent generator with single nuisances have 0.002 rms in H, in the demo's scene 0.85 of the table behind."""
Real = npt.NDArray[np.float64]

LEAST_PIXELS = 12
"""Least number of interior pixels of a patch that is measured. Chosen: medians and scatter of fewer mean little."""
FLAT_CONTRAST = 0.4
"""Largest standard deviation of |H| over its mean in a patch: noise or speckle has 0.52, plates less than 0.25."""
LEAST_LEVEL = 2.0
"""Least |H| of a patch over the background's root mean square; chosen."""
ODD_SHARE = 0.15
ODD_RATIO = 0.15
"""A pixel is odd if it differs from the median V / H by more than ODD_RATIO. A patch with a larger share of odd pixels
than ODD_SHARE holds several materials; both chosen."""
RIPPLE_SHARE = 0.5
"""No pixel is odd that differs less than this share of the median: real metal ripples by 25 % and 13 degrees."""
HALVES_APART = 0.07
"""Difference of V / H between opposite halves of a dielectric (thrice for metal), above which two materials touch. A
real plate of one material (acrylic, published rig) has 0.06 after the factor for its V / H."""
ODD_NOISE = 2.0
"""Nor is a pixel odd that differs by less than this times the rms noise of V / H by V: 2 % of noise exceeds it."""
NOISE_OF_HALVES = 22.0
"""Largest difference of the halves' medians by noise = this * rms noise of V / H / sqrt(number of pixels): three
standard deviations, with one independent value in nine pixels and medians that scatter by 1.25 of means."""
DIM_V_RATIO = 0.12
"""|V| over |H| below which the phase between both is not judged; chosen."""
LEAST_COHERENCE = 0.7
"""Least coherence of H and V over the pixels of a plate; chosen."""
LEAST_V_OVER_NOISE = 2.0
"""|V| over its background below which V is mostly noise and its phase is not used. Chosen."""
# Margin around patches that does not count as background; chosen.
_AROUND_PX = 6
# A region that was left out is a table behind if it is larger than this many times the largest patch. In the demo it is
# 29 times as large; dim plates of drawn scenes are 0.1 to 1.3 times, or two that touch. Between them it is chosen.
LARGEST_DIM_PLATE = 6.0

AMPLIFIES_REASON = "it would amplify beyond its error bar"
BELOW_AIR_REASON = "its permittivity would be below that of air"
STRONGER_V_REASON = "V is stronger than H, relative to the metal"
POSSIBLE_LAYER = "possible layer"
NOT_PASSIVE = (AMPLIFIES_REASON, BELOW_AIR_REASON, STRONGER_V_REASON, POSSIBLE_LAYER)
"""Reasons for refusing plates that are not half spaces; they may be fitted as layers."""
LAYER_FINDING = Finding(
    "error",
    POSSIBLE_LAYER,
    "its V / H, or what it changes over the sweep, is that of a thin plate or a stack with a probability above 0.2",
    "fit it as a layer: `polysight process --bands 5`, then `polysight permittivity --layer NAME,?,?`",
)
"""Why a possible layer gets no permittivity."""
GAIN_STDS = 2.0
"""Chosen: standard deviations of gain, a real part below 1, or |V / H| above 1, beyond which no half space is so."""
ALLOWED_EXCESS = 0.02
"""Gain, real part below 1, or |V / H| above 1 that is allowed in addition, however small the error is. Chosen."""


def measure_background(h: Image, v: Image, segmentation: Segmentation, usable: Mask) -> tuple[float, float]:
    """Return the rms of |H| and |V| away from patches and dim plates (noise, sidelobes); NaN without such pixels."""
    background_mask = _select_background(h, v, segmentation, usable)
    if not background_mask.any():
        return float("nan"), float("nan")
    return _compute_rms(h[background_mask]), _compute_rms(v[background_mask])


def background_mean(h: Image, v: Image, segmentation: Segmentation, usable: Mask) -> tuple[float, float]:
    """Return the rms over places of the mean of H and of V, in squares of a plate's size away from all patches.

    What lies behind the plates, such as a table, adds to them as well, with an unknown phase. It changes
    little over a plate, so that neither averaging nor the scatter of the plate's pixels shows it: on the published
    picture the mean over a plate's size is only 6 dB below the background itself. 0 without such places.
    """
    background_mask = _select_background(h, v, segmentation, usable)
    widths = [np.sqrt(patch.interior.sum()) for patch in segmentation.patches if patch.interior.any()]
    if not widths:
        return 0.0, 0.0
    width_px = max(1, round(float(np.median(widths))))
    window_is_whole = _average_window(background_mask.astype(np.complex128), width_px).real > 1 - 1e-6
    if not window_is_whole.any():
        return 0.0, 0.0
    mean_h = _average_window(np.where(background_mask, h, 0), width_px)[window_is_whole]
    mean_v = _average_window(np.where(background_mask, v, 0), width_px)[window_is_whole]
    return _compute_rms(mean_h), _compute_rms(mean_v)


def _select_background(h: Image, v: Image, segmentation: Segmentation, usable: Mask) -> Mask:
    """Return the usable pixels with some distance to every patch, and to dim plates that are not patches.

    A region that was left out is taken for a dim plate if it is as small as one, else for the table behind, which is
    background.
    """
    is_in_plate = segmentation.labels > 0
    largest_px = max((int(patch.mask.sum()) for patch in segmentation.patches), default=0)
    for region in segmentation.left_out:
        if region.sum() <= LARGEST_DIM_PLATE * largest_px:
            is_in_plate |= region
    return usable & np.isfinite(h) & np.isfinite(v) & ~_is_near(is_in_plate)


def _is_near(mask: Mask) -> Mask:
    """Return the pixels of `mask` and those within the margin around them."""
    return np.asarray(scipy.ndimage.binary_dilation(mask, iterations=_AROUND_PX), bool)


def _average_window(values: Image, width_px: int) -> Image:
    """Return the mean over a square window around each pixel, with zeros beyond the image."""
    return np.asarray(scipy.ndimage.uniform_filter(values, width_px, mode="constant"), np.complex128)


def _compute_rms(values: Image) -> float:
    return float(np.sqrt(np.mean(np.abs(values.astype(np.complex128)) ** 2)))


def check_patch(patch: Patch, h: Image, v: Image, dark: tuple[float, float], uneven: float) -> Finding | None:
    """Return why a patch is not a flat plate; None if it may be one.

    Parameters
    ----------
    patch
        The patch.
    h, v
        complex [ny, nx], smoothed inside patches; any reference.
    dark
        Result of :func:`measure_background`, in the same units.
    uneven
        :func:`measure_difference_of_halves` of the metal reference: the scan's own effect on a single material.
    """
    pixels = patch.interior & np.isfinite(h) & np.isfinite(v)
    remedy = "check the image, the direct path and the range profile"
    if patch.cut:
        return Finding(
            "error", "cut by the border of the image", "the part outside of it is missing, and the rest is dimly lit",
            "move the plate towards the middle, or scan a larger grid",
        )  # fmt: skip
    if int(pixels.sum()) < LEAST_PIXELS:
        return Finding(
            "error",
            "too few pixels",
            f"{int(pixels.sum())} lie inside its edges",
            "scan a larger plate, or finer pixels",
        )
    level = np.abs(h[pixels]).astype(np.float64)
    if not level.mean() > 0:
        return Finding("error", "no signal", "H is zero there", remedy)
    if float(level.std() / level.mean()) > FLAT_CONTRAST:
        return Finding("error", "noise or speckle, not a flat plate", "its brightness varies like noise", remedy)
    if np.isfinite(dark[0]) and float(np.median(level)) < LEAST_LEVEL * dark[0]:
        return Finding("error", "as dark as the background", "it does not stand out from noise and sidelobes", remedy)
    cross = abs(np.vdot(h[pixels].astype(np.complex128), v[pixels]))
    power_h = float(np.sum(np.abs(h[pixels].astype(np.complex128)) ** 2))
    power_v = float(np.sum(np.abs(v[pixels].astype(np.complex128)) ** 2))
    level_v = float(np.median(np.abs(v[pixels])))
    is_dim = level_v < DIM_V_RATIO * float(np.median(level)) or level_v < LEAST_V_OVER_NOISE * dark[1]
    if not is_dim and cross < LEAST_COHERENCE * np.sqrt(power_h * power_v):
        return Finding(
            "error", "H and V do not agree", "their phase difference varies from pixel to pixel, like noise", remedy
        )
    # Where a sheet hardly reflects V, its V / H is noise.
    noise = dark[1] / float(np.median(level)) if np.isfinite(dark[1]) else 0.0
    allowed = max(HALVES_APART, uneven) * (1 + 2 * float(np.median(np.abs(v[pixels])) / np.median(level)))
    several = "several kinds together"
    separate_plates = "move the plates apart, or draw boxes"
    if measure_difference_of_halves(h, v, pixels) > np.hypot(allowed, NOISE_OF_HALVES * noise / np.sqrt(pixels.sum())):
        return Finding("error", several, "its halves have different ratios", separate_plates)
    middle = 1 / compute_median_ratio(h[pixels], v[pixels])
    odd = np.abs(v[pixels] / h[pixels] - middle) > np.hypot(
        max(ODD_RATIO, RIPPLE_SHARE * abs(middle)), ODD_NOISE * noise
    )
    if float(odd.mean()) > ODD_SHARE:
        return Finding("error", several, f"{100 * odd.mean():.0f} % of its pixels have another ratio", separate_plates)
    return None


def measure_difference_of_halves(h: Image, v: Image, mask: Mask) -> float:
    """Return the largest difference of the median V / H between opposite halves of a patch; 0 with too few pixels."""
    rows, columns = np.nonzero(mask & np.isfinite(h) & np.isfinite(v) & (h != 0))
    values = v[rows, columns] / h[rows, columns]
    largest = 0.0
    for coordinate in (rows, columns):
        if coordinate.size == 0:
            break
        low = values[coordinate < np.median(coordinate)]
        high = values[coordinate > np.median(coordinate)]
        if min(low.size, high.size) >= LEAST_PIXELS // 2:
            real = float(np.median(low.real) - np.median(high.real))
            imag = float(np.median(low.imag) - np.median(high.imag))
            largest = max(largest, float(np.hypot(real, imag)))
    return largest


@dataclass(frozen=True)
class Scatter:
    """Variation of ln(V / H) over a plate.

    Attributes
    ----------
    amplitude, phase
        Standard deviations of ln|V / H| and of its phase over the pixels (1.48 times the median deviation).
    blocks
        Number of independent places on the plate.
    slope, slope_std
        Its change per metre along x and y, complex [2]; real and imaginary part of the second are the standard
        deviations of those of the first.
    centre_m
        Centre of the pixels, x and y.
    relief_rad
        Standard deviation of the phase of H about a plane: the plate's surface is rough, wavy or bent.
    level
        Median |V / H|, relative to metal if the images are.
    """

    amplitude: float
    phase: float
    blocks: float
    slope: npt.NDArray[np.complex128]
    slope_std: npt.NDArray[np.complex128]
    centre_m: tuple[float, float]
    relief_rad: float = 0.0
    level: float = 1.0


def measure_scatter(mask: Mask, h: Image, v: Image, x_m: Real, y_m: Real) -> Scatter | None:
    """Return how V / H scatters over the pixels of a mask [ny, nx].

    None with fewer than `LEAST_PIXELS` usable ones, or if the median V / H is zero.
    """
    pixels = mask & np.isfinite(h) & np.isfinite(v) & (h != 0) & (v != 0)
    rows, columns = np.nonzero(pixels)
    if rows.size < LEAST_PIXELS:
        return None
    inverse = np.asarray(v[pixels].astype(np.complex128) / h[pixels], np.complex128)
    middle = complex(np.median(inverse.real), np.median(inverse.imag))
    if middle == 0:
        return None
    log_ratio = np.asarray(np.log(inverse / middle), np.complex128)
    # 1.4826 turns the median of normal deviations into their standard deviation.
    amplitude = 1.4826 * float(np.median(np.abs(log_ratio.real - np.median(log_ratio.real))))
    phase = 1.4826 * float(np.median(np.abs(log_ratio.imag - np.median(log_ratio.imag))))
    places = np.stack([x_m[columns], y_m[rows]], axis=1)
    centred = places - places.mean(axis=0)
    pixel_m2 = abs((x_m[1] - x_m[0]) * (y_m[1] - y_m[0]))
    blocks = max(1.0, rows.size * pixel_m2 / BLOCK_M**2)
    information = centred.T @ centred + 1e-12 * np.eye(2)
    # Robust against bright strips at edges: deviations beyond three standard deviations are cut.
    cut = np.clip(log_ratio.real, -3 * amplitude, 3 * amplitude) + 1j * np.clip(log_ratio.imag, -3 * phase, 3 * phase)
    slope_of = np.linalg.solve(information, centred.T @ cut)
    rest = np.asarray(log_ratio - centred @ slope_of, np.complex128)
    rest_std = complex(*(1.4826 * float(np.median(np.abs(part - np.median(part)))) for part in (rest.real, rest.imag)))
    # The errors of a slope from as many independent values as there are blocks, not pixels.
    unit = np.sqrt(np.diag(np.linalg.inv(information)) * rows.size / blocks)
    x, y = places.mean(axis=0).tolist()
    return Scatter(
        amplitude=amplitude,
        phase=phase,
        blocks=blocks,
        slope=slope_of,
        slope_std=unit * rest_std,
        centre_m=(x, y),
        relief_rad=_measure_relief(h[pixels], centred),
        level=abs(middle),
    )


def _measure_relief(h: Image, centred: Real) -> float:
    """Return the standard deviation of the phase of pixels [n] about a plane over their places [n, 2], radians."""
    mean = complex(h.astype(np.complex128).sum())
    phase = np.angle(h * np.conj(mean)).astype(np.float64)
    design = np.column_stack([np.ones(len(centred)), centred])
    fit = np.linalg.lstsq(design, phase, rcond=None)[0]
    return float(np.std(phase - design @ fit))


def find_usual_scatter(all_plates: Sequence[Scatter]) -> tuple[float, float]:
    """Return the usual scatter of ln|V / H| and of its phase in a scene: the medians over its plates."""
    if not all_plates:
        return 0.0, 0.0
    return float(np.median([s.amplitude for s in all_plates])), float(np.median([s.phase for s in all_plates]))


def relative_errors(plate_scatter: Scatter | None, usual: tuple[float, float]) -> tuple[float, float]:
    """Return the standard errors of a plate's mean ln|V / H| and phase, from its own scatter and the scene's usual one.

    Without its own the usual scatter is the error: the plate counts as one place.
    """
    amplitude, phase = usual
    blocks = 1.0
    if plate_scatter is not None:
        blocks = plate_scatter.blocks
        weight = USUAL_BLOCKS + blocks
        amplitude = float(np.sqrt((USUAL_BLOCKS * amplitude**2 + blocks * plate_scatter.amplitude**2) / weight))
        phase = float(np.sqrt((USUAL_BLOCKS * phase**2 + blocks * plate_scatter.phase**2) / weight))
    return AMPLITUDE_OF_BLOCKS * amplitude / np.sqrt(blocks), PHASE_OF_BLOCKS * phase / np.sqrt(blocks)


def measure_patch(
    patch: Patch,
    h: Image,
    v: Image,
    theta_rad: float,
    scatter: Scatter | None = None,
    usual: tuple[float, float] = (0.0, 0.0),
    change: tuple[complex, tuple[float, float]] | None = None,
    local_std: tuple[float, float] = (0.0, 0.0),
    rise: tuple[float, float] = (0.0, 0.0),
) -> PatchMeasurement:
    """Measure a patch's ratio with its errors, and its brightness.

    Parameters
    ----------
    patch
        The patch.
    h, v
        complex [ny, nx], relative to metal, smoothed inside patches.
    theta_rad
        Its angle of incidence.
    scatter, usual
        The patch's :func:`measure_scatter`, and the scene's :func:`find_usual_scatter`.
    change
        Change of ln(V / H) from the metal to the patch by drift and fringes, which is removed, and its standard
        deviations (:meth:`CommonChange.log_ratio`); None if it is not known, or the reference covers the plane.
    local_std
        Errors of ln|V / H| and of its phase by the place: metal reference that varies over the plane, end of aperture.
    rise
        Its rise along the plane of incidence and across it, radians.
    """
    pixels = patch.interior
    ratio = compute_median_ratio(h[pixels], v[pixels])
    inverse = 1 / ratio if ratio else complex(np.inf, 0.0)
    level = np.abs(h[pixels])
    level = level[np.isfinite(level)]
    std = float(np.hypot(LEAST_STD, TILT_STD * _measure_phase_spread(h[pixels])))
    amplitude, phase = relative_errors(scatter, usual)
    if change is not None:
        common, (more_amplitude, more_phase) = change
        inverse *= complex(np.exp(-common))
        amplitude = float(np.hypot(amplitude, more_amplitude))
        phase = float(np.hypot(phase, more_phase))
    relative = float(np.hypot(amplitude, local_std[0])), float(np.hypot(phase, local_std[1]))
    brightness = float(np.median(level)) if level.size else None
    return PatchMeasurement(inverse, std, theta_rad, brightness, relative, rise)


def estimate_border_errors(patch: Patch, lit: Mask, x_m: Real) -> tuple[float, float]:
    """Return the errors of a patch's ln|V / H| and of its phase near the border of the lit area (`BORDER_STD`).

    `lit`, bool [ny, nx]: illuminated pixels, in the images of a separate metal plate, too; `x_m` [nx]: the image's
    axis. A patch that fills them has no such errors, as the metal was lit in the same way. For patches that reach the
    border of the image, this is a border of the lit area, too.
    """
    if not patch.interior.any() or not (lit & ~patch.mask).any():
        return 0.0, 0.0
    is_lit = np.pad(lit, 1, constant_values=not touches_border(patch.mask))
    if is_lit.all():
        return 0.0, 0.0
    distance_to_end_px = np.asarray(scipy.ndimage.distance_transform_edt(is_lit))[1:-1, 1:-1]
    # Half a pixel: a box drawn by hand may lie over dark pixels, 0 from them.
    middle_m = max(float(np.median(distance_to_end_px[patch.interior])), 0.5) * abs(float(x_m[1] - x_m[0]))
    amplitude, phase = (
        min(std * (BORDER_M / middle_m) ** power, MOST_BORDER_STD)
        for std, power in zip(BORDER_STD, BORDER_POWERS, strict=True)
    )
    return amplitude, phase


def measure_dispersions(
    images: Images,
    segmentation: Segmentation,
    judged: Sequence[Patch],
    metal: Mask,
    plane: PlaneReference | None,
) -> list[PatchDispersion | None]:
    """Measure the change of patches over the sweep relative to metal; None where it or the metal's is not known.

    `metal`, bool [ny, nx], is the metal's interior in the scene; `plane`, metal scanned separately, is used instead.

    What lies behind the plates adds to each channel's change its own first moment over the sweep, relative to the
    plate's level: 0.8 for a table 100 mm behind, 20 dB below a plate.
    """
    dispersion = images.dispersion
    metal_measurement = None
    if dispersion is not None and plane is None:
        metal_measurement = _measure_median_change(dispersion, metal)
    elif plane is not None and plane.dispersion is not None:
        h, v = plane.dispersion
        metal_measurement = np.array([h.real, (v - h).real, (v - h).imag]), np.zeros(3)
    if dispersion is None or metal_measurement is None:
        return [None] * len(judged)
    metal_change, metal_spread = metal_measurement
    background = background_mean(images.h * dispersion.h, images.v * dispersion.v, segmentation, images.usable)
    floor = np.array([DISPERSION_STD[0], DISPERSION_STD[1], DISPERSION_STD[1]])
    out: list[PatchDispersion | None] = []
    for patch in judged:
        patch_change = _measure_median_change(dispersion, patch.interior)
        level_h = np.median(np.abs(images.h[patch.interior]))
        level_v = np.median(np.abs(images.v[patch.interior]))
        if patch_change is None or not min(level_h, level_v) > 0:
            out.append(None)
            continue
        change, spread = patch_change
        std_h = DISPERSION_BEHIND * background[0] / level_h
        std_v = DISPERSION_BEHIND * background[1] / level_v
        background_std = np.array([std_h, np.hypot(std_h, std_v), np.hypot(std_h, std_v)])
        variance = floor**2 + DISPERSION_SHARE**2 * (spread**2 + metal_spread**2) + background_std**2
        out.append(PatchDispersion(change - metal_change, np.sqrt(variance), dispersion.band_hz))
    return out


def _measure_median_change(dispersion: Dispersion, pixels: Mask) -> tuple[Real, Real] | None:
    """Return medians over pixels of the change of ln |H|, ln |V / H| and its phase, and robust deviations, [3] each."""
    h = dispersion.h[pixels]
    ratio = dispersion.v[pixels] - h
    values = np.stack([h.real, ratio.real, ratio.imag]).astype(np.float64)
    values = values[:, np.isfinite(values).all(axis=0)]
    if values.shape[1] < LEAST_PIXELS:
        return None
    low, middle, high = np.percentile(values, (25, 50, 75), axis=1)
    # The distance of the quartiles of a normal distribution is 1 / 0.7413 standard deviations.
    return middle, 0.7413 * (high - low)


def _measure_phase_spread(h: Image) -> float:
    """Return the circular standard deviation of the phase of H over a patch, radians; a tilt increases it."""
    h = h[np.isfinite(h)].astype(np.complex128)
    coherent = abs(h.sum()) / max(float(np.abs(h).sum()), 1e-300)
    return float(np.sqrt(-2 * np.log(min(max(coherent, 1e-3), 1.0))))


def check_patches(
    segmentation: Segmentation, h: Image, v: Image, dark: tuple[float, float], metal: Mask
) -> dict[int, Finding]:
    """Return patch number to reason for all patches that are not plates; parameters as of :func:`check_patch`.

    `metal`, bool [ny, nx], is the metal reference's interior.
    """
    uneven = measure_difference_of_halves(h, v, metal)
    reasons = ((p.label, check_patch(p, h, v, dark, uneven)) for p in segmentation.patches)
    return {label: reason for label, reason in reasons if reason is not None}


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
        Standard error of eps' and of eps'': by the scene's error budget, or without one by the scatter of the pixels
        alone. None if metal-like.
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
    half_widths_68
        Half widths of the intervals about the real and the imaginary part that hold 68 %; None without that budget.
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
    half_widths_68: tuple[float, float] | None = None
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
        """The source with the largest share of the error; None without shares."""
        return max(self.shares, key=lambda s: self.shares[s], default=None)

    @property
    def metal_like(self) -> bool:
        """True if P is known and too close to 1 for a permittivity."""
        return bool(np.isfinite(self.ratio)) and not self.metal_distance >= METAL_WITHOUT_PERMITTIVITY


def compute_median_ratio(h: Image, v: Image) -> complex:
    """Return a robust mean of P = H / V over pixels: the reciprocal of the median of V / H; NaN without usable pixels.

    Dielectrics reflect s more strongly than p. With the strong channel in the denominator the noise of the ratio is
    additive and symmetric even where V nearly vanishes; H / V itself has no mean there. Medians are taken of real and
    imaginary part separately.
    """
    usable = np.isfinite(h) & np.isfinite(v) & (h != 0)
    if not usable.any():
        return complex(np.nan, np.nan)
    inverse = v[usable].astype(np.complex128) / h[usable]
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
    over the whole plane removes them. Eq. 3 is holomorphic and takes P and 1 / P alike, so both parts of the
    permittivity have the standard error |d eps / d q| times that of q = V / H.

    On simulated scans (eight placements of eight materials, all disturbances) the error is half of what is claimed,
    rms, and 94 % of the values lie within one standard error.

    `h` and `v` complex [n] are the pixels of the interior, metal-referenced and leakage-corrected; `theta_rad` is the
    incidence angle, one number or [n].
    """
    ratio = compute_median_ratio(h, v)
    usable = np.isfinite(h) & np.isfinite(v) & (h != 0)
    distance = min(abs(ratio - 1), abs(1 / ratio - 1) if ratio != 0 else np.inf)
    n = int(usable.sum())
    inverse = 1 / ratio if ratio != 0 else complex(np.inf, 0.0)
    inverse_std = inverse_spread(h, v)
    # Written with `not`, so that a distance that is not a number gets no permittivity either.
    if not distance >= METAL_WITHOUT_PERMITTIVITY:
        return Permittivity.not_estimated(ratio, inverse_std, float(distance), n)
    theta = np.broadcast_to(np.asarray(theta_rad, np.float64), h.shape)[usable]
    value = complex(permittivity_from_ratio(ratio, float(theta.mean())))
    pixel_values = permittivity_from_ratio(v[usable].astype(np.complex128) / h[usable], theta)
    pixel_values = pixel_values[np.isfinite(pixel_values)]
    re = np.percentile(pixel_values.real, [30, 70])
    im = np.percentile(pixel_values.imag, [30, 70])
    std = float(abs(find_permittivity_slope(inverse, float(theta.mean()))) * inverse_std)
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


def estimate_patch_permittivity(
    h: Image,
    v: Image,
    theta_rad: float,
    estimate: PatchEstimate | None,
) -> Permittivity:
    """Return the permittivity of one patch as the joint inversion found it; the percentiles are those of its pixels.

    The pixels `h` and `v` [n] of the interior are as for :func:`estimate_permittivity`. `estimate` is the result of the
    inversion; None for a patch that it did not include, which gets no permittivity.
    """
    # Pixels get the corrections of their patch, so that their median ratio is the inversion's.
    single = estimate_permittivity(h, v, theta_rad)
    if estimate is not None and single.ratio and np.isfinite(single.ratio):
        single = estimate_permittivity(h, v * complex(estimate.inverse_ratio * single.ratio), theta_rad)
    if estimate is None or estimate.permittivity is None or estimate.covariance is None:
        return Permittivity.not_estimated(single.ratio, single.inverse_std, single.metal_distance, single.pixels)
    ratio = 1 / estimate.inverse_ratio if estimate.inverse_ratio else complex(np.inf, 0.0)
    real_std, loss_std = (float(s) for s in np.sqrt(np.diag(estimate.covariance)))
    covariance = estimate.inverse_ratio_covariance
    ranges = single.real_range or (np.nan, np.nan), single.imag_range or (np.nan, np.nan)
    return replace(
        single,
        value=estimate.permittivity,
        real_range=ranges[0],
        imag_range=ranges[1],
        real_std=real_std,
        loss_std=loss_std,
        ratio=ratio,
        inverse_std=float(np.sqrt(np.trace(covariance) / 2)),
        covariance=estimate.covariance,
        half_widths_68=estimate.half_widths_68,
        shares=estimate.shares,
    )


def _find_impossibility(estimate: Permittivity) -> Finding | None:
    """Return why a permittivity is impossible for a passive material, beyond its error; None if it is possible."""
    remedy = "measure leakage (`polysight leakage`); fit a thin plate as a layer (`polysight permittivity --layer`)"
    causes = "likely causes: leakage, a layered plate, a wrong metal reference, or H and V of different places"
    # Eq. 3 does not distinguish P from 1 / P, but no half space reflects more of p than of s.
    largest_inverse = 1 + GAIN_STDS * estimate.inverse_std + ALLOWED_EXCESS
    if estimate.ratio and not estimate.metal_like and abs(1 / estimate.ratio) > largest_inverse:
        return Finding("error", STRONGER_V_REASON, causes, remedy)
    if estimate.value is None or estimate.real_std is None or estimate.loss_std is None:
        return None
    if estimate.value.imag > GAIN_STDS * estimate.loss_std + ALLOWED_EXCESS:
        return Finding("error", AMPLIFIES_REASON, causes, remedy)
    if estimate.value.real < 1 - GAIN_STDS * estimate.real_std - ALLOWED_EXCESS:
        return Finding("error", BELOW_AIR_REASON, causes, remedy)
    return None


def refuse_impossible(
    patches: Mapping[int, Permittivity], estimates: Mapping[int, PatchEstimate], kinds: Kinds
) -> dict[int, Finding]:
    """Return patch number to why it is not a half space: an impossible permittivity, or possibly a thin plate."""
    thin = {
        label: LAYER_FINDING
        for label, e in estimates.items()
        if e.evidence is not None and may_be_thin(e.evidence, kinds)
    }
    return thin | {label: reason for label, e in patches.items() if (reason := _find_impossibility(e)) is not None}
