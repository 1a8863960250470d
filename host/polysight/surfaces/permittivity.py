"""Permittivity of surface segments from the voltages of H and V, referenced to metal of known shape.

A segment has one permittivity: least squares of b_H (M r)_V = b_V (M r)_H over its points (`fit_permittivity`), with r
the coefficients of a curved surface, M what the antennas' polarisations make of them, and b_H, b_V the voltages over
the gains (`Voltages.m` and `b`, `Gains`). Coefficients are arrays [n points, 2 receivers, 4], H before V: r_s, r_p,
s to p, p to s; the last two are 0 without a *twist*, a curvature whose axes lie askew to the plane of incidence. A
point is what one window of stage positions has measured. `wave_number` is that at the middle of the band, rad / m.

The covariance is derived, source by source (`add_common_errors`): the scatter of the points over blocks of windows;
leakage, axes and places of the antennas, each moved by one standard error for object and reference together; the
reference's own error; and the next order of the expansion in the curvature. A common error changes the misses of the
equations above; one Gauss-Newton step turns that into a change of the permittivity.

Two figures that the permittivity does not use tell whether one medium reflected at one surface (`judge_medium`): the
level of H over that of metal, and how both levels change over the band.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.polarimetry import permittivity_from_ratio
from polysight.surfaces.gains import (
    BLOCK_M,
    UNKNOWN_SLOPE,
    Gains,
    Voltages,
    expansion_parameter,
    find_voltages,
    number_blocks,
    receive,
    reflect_points,
)
from polysight.surfaces.measure import Seen
from polysight.surfaces.optics import ANGLE_STEP, Antenna, Optics, reflect_flat
from polysight.surfaces.paths import STRIDE_M

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
# A point whose ratio lies so many usual misses from the segment's does not belong to it; chosen.
OUTLIER = 4.0
# Ripples of edges and of other echoes change over such a distance: points within it have the same scatter; chosen.
RIPPLE_M = 0.04
# Side of the square that is as large as a Fresnel zone (40 x 70 mm): ripples that edges make are as long.
FRESNEL_ZONE_M = 0.053
# Length of the ripple of flat surfaces, whose misses have correlations of 0.6 and 0.3 at 8 and 16 mm (plates of random
# scenes, simulated).
RIPPLE_OF_PLATES_M = 0.024
# Ripple of V / H by which points are weighted, beside their noise; chosen.
USUAL_RIPPLE = 0.02
# The few blocks of a small segment say little of their own scatter. So the scatter of the single points, as if it were
# common to a block, is averaged with that of the blocks, and has the weight of so many blocks; chosen.
EXPECTED_BLOCKS = 2.0
# Error of the curvature, in proportion; chosen: those of 14 spheres and cylinders (50 to 190 mm, simulated) are 0.4 to
# 3 % too large, 1.6 % in the root mean square (windows are not small to them).
CURVATURE_ERROR = 0.02
# Second order of the reflection at a curved surface over the first, in K / (k cos^3 theta), K the curvature and k the
# wave number: 1.9 by the exact series of spheres (100 and 200 mm, permittivity 2.8 to 8). Orders alternate in phase.
SECOND_ORDER = 2.0
# At the border of the zone that a surface reflects to, ln of the level is 0.69 below that inside: half of that is
# allowed. Where no reference takes that out, patterns of antennas change the level over the directions by about as
# much: there 0.9 is allowed (chosen).
LEVEL_TOLERANCE = 0.35
LEVEL_TOLERANCE_WITHOUT_GAINS = 0.9
# Share of a segment's power at one level: what edges diffract falls off with the angle. Three segments of edges alone
# had 0.36 to 0.56, surfaces 0.91 and more (simulated).
MIN_SHARE_AT_LEVEL = 0.75
# Reflection over metal's below which no surface counts: a half space of permittivity 1.04 at 55 degrees. What the end
# of a cylinder diffracts had 0.02 (simulated).
MIN_REFLECTION = 0.03
# Less than 20 mm from the border of a zone that reflects, a disc of 50 mm radius is not filled to three quarters. There
# edges bend normals by degrees, and H / V of a plate with sharp edges is 10 % too large.
BORDER_DISC_M = 0.05
MIN_FILLING = 0.75
# What a point counts for a permittivity rises from this share to 1 with the share of such a disc that interior points
# fill: ripples of edges swing about zero, and a sum that begins and ends slowly averages them. The plates of 11 random
# scenes (simulated) were 2.2 % off in the root mean square where all points counted alike, and are 1.2 % off.
LEAST_SHARE = 0.01
# Offsets closer than this are of one column of windows: rows start a little apart, as the stage moves within a burst.
SAME_COLUMN_M = 1.5e-3
# Step of numerical derivatives by the permittivity; chosen.
EPS_STEP = 1e-4
# Range of permittivities to which iterations are limited, eps' and the imaginary part of eps' - j eps'': solids and
# water, and a little gain, which noise may give.
REAL_LIMITS = (1.2, 40)
IMAGINARY_LIMITS = (-20, 0.5)


@dataclass(frozen=True)
class PermittivityFit:
    """Permittivity of a segment, fitted.

    Attributes
    ----------
    eps
        The permittivity.
    covariance
        Of (real, imaginary), from the scatter of the points alone.
    share
        What each point counts beside its noise and ripple, [n]; 0 for outliers.
    excess2
        Squares of the points' misses over what their noise gives, [n]; 1 on average for noise alone.
    answer
        Complex [2, n]: the change of (real, imaginary) is the real part of `answer` times a change of the misses.
    """

    eps: complex
    covariance: Array
    share: Array
    excess2: Array
    answer: Complex


def point_ratio(v: Voltages, gains: Gains) -> Complex:
    """Return r_s / r_p of each point [n], as if no twist mixed both."""
    b = v.b.copy()
    b[:, 0] /= gains.ratio(v.arrival)
    return _unmix(v, b)


def _unmix(v: Voltages, b: Complex) -> Complex:
    """Ratio r_s / r_p [n] that voltages [n, 2] would mean at a surface without twist."""
    r = np.linalg.solve(v.m[..., :2], b[..., None])[..., 0]
    return r[:, 0] / np.where(r[:, 1] == 0, 1e-30, r[:, 1])


def point_permittivity(v: Voltages, gains: Gains, wave_number: float) -> Complex:
    """Return the permittivity of each point [n]: a half space's by its ratio, corrected for curvature and iterated."""
    ratio = point_ratio(v, gains)
    theta = v.theta[:, 0]
    eps = clip_permittivity(permittivity_from_ratio(ratio, theta))
    # A fixed number of iterations; chosen.
    for _ in range(4):
        r_s, r_p = reflect_flat(eps, theta)
        curved = _unmix(v, receive(v, reflect_points(eps, v, wave_number)))
        eps = clip_permittivity(permittivity_from_ratio(ratio * (r_s / r_p) / curved, theta))
    return eps


def clip_permittivity(eps: NDArray) -> Complex:
    """Limit permittivities [any] to `REAL_LIMITS` and `IMAGINARY_LIMITS`, so that iterations go on; 4 if not finite."""
    finite = np.where(np.isfinite(eps), eps, 4.0)
    return np.clip(np.real(finite), *REAL_LIMITS) + 1j * np.clip(np.imag(finite), *IMAGINARY_LIMITS)


def find_misses(v: Voltages, gains: Gains, coefficients: Complex) -> Complex:
    """Misses b_H (M r)_V - b_V (M r)_H of each point, complex [n], for coefficients r [n, 2, 4].

    b are the voltages of both receivers, M r what the surface would give with gains of 1; b_H is divided by the gain of
    H over that of V. A miss is 0 where the coefficients explain H / V.
    """
    expected = receive(v, coefficients)
    return v.b[:, 0] / gains.ratio(v.arrival) * expected[:, 1] - v.b[:, 1] * expected[:, 0]


def _compute_noise_of_misses(v: Voltages, gains: Gains, coefficients: Complex) -> Array:
    """Standard deviation of each part of the misses by the noise of both voltages, [n]."""
    expected = np.abs(receive(v, coefficients))
    std_h = v.std[:, 0] / np.abs(gains.ratio(v.arrival))
    return np.hypot(std_h * expected[:, 1], v.std[:, 1] * expected[:, 0])


@dataclass(frozen=True)
class _Step:
    """Misses at one permittivity, their noise and weights [n], which points count, and `answer` as of the fit.

    The step is the real part of `influence` times the misses, complex [2, n]. `answer` differs from it by
    what a change of a miss does to its weight.
    """

    miss: Complex
    noise: Array
    weights: Array
    used: NDArray[np.bool_]
    influence: Complex
    answer: Complex


def _linearise(
    eps: complex, v: Voltages, gains: Gains, wave_number: float, *, ripple: Array, share: Array | float
) -> _Step:
    """Return the Gauss-Newton step at a permittivity; outliers lose their weight.

    `ripple` [n] is the standard deviation of the misses beside their noise, `share` [n] what a point counts.
    """
    coefficients = reflect_points(eps, v, wave_number)
    miss = find_misses(v, gains, coefficients)
    rates = []
    for step in (EPS_STEP, 1j * EPS_STEP):
        moved = reflect_points(eps + step, v, wave_number)
        rates.append((find_misses(v, gains, moved) - miss) / EPS_STEP)
    jacobian = np.stack(rates, axis=1)
    noise = _compute_noise_of_misses(v, gains, coefficients)
    scale = np.hypot(noise, ripple)
    size = np.abs(miss) / scale
    usual = float(np.median(size)) + 1e-12
    # Where points fit far better than their errors, good ones would else be outliers (0.3 is chosen).
    used = size < OUTLIER * max(usual, 0.3)
    falloff = 1 / (1 + (size / (2 * usual)) ** 2)
    weights = share * used / scale**2 * falloff
    # A miss that grows loses weight: what it counts changes by the square of the falloff, over all phases.
    rate_weights = weights * falloff
    information = np.einsum("np,nq,n->pq", jacobian.conj(), jacobian, rate_weights).real
    inverse = np.linalg.inv(information + 1e-15 * np.eye(2))
    influence = -np.einsum("pq,nq,n->pn", inverse, jacobian.conj(), weights)
    answer = -np.einsum("pq,nq,n->pn", inverse, jacobian.conj(), rate_weights)
    return _Step(miss, noise, weights, used, influence, answer)


def fit_permittivity(
    v: Voltages, gains: Gains, wave_number: float, share: Array | float = 1.0, ripple_m: float = FRESNEL_ZONE_M
) -> PermittivityFit:
    """Weighted least squares of one permittivity over points, by Gauss-Newton; robust by iterated weights.

    `share` [n]: what each point counts, beside its noise and ripple, which is `ripple_m` long.
    """
    of_points = point_permittivity(v, gains, wave_number)
    # The start has at least a small loss (chosen).
    eps = complex(np.median(of_points.real), min(np.median(of_points.imag), -0.01))
    # Level of H in the unit of a miss: b_H times what V receives of r_p = 1.
    level = np.abs(v.b[:, 0] / gains.ratio(v.arrival) * v.m[:, 1, 1])
    # What is common to a point's surroundings: no point counts for more than its ripple allows.
    ripple = USUAL_RIPPLE * level
    step = _linearise(eps, v, gains, wave_number, ripple=ripple, share=share)
    # Number of iterations and their end are chosen.
    for _ in range(12):
        move = (step.influence @ step.miss).real
        eps = complex(
            np.clip(eps.real + np.clip(move[0], -1, 1), *REAL_LIMITS),
            np.clip(eps.imag + np.clip(move[1], -1, 1), *IMAGINARY_LIMITS),
        )
        step = _linearise(eps, v, gains, wave_number, ripple=ripple, share=share)
        if np.abs(move).max() < 1e-5:
            break
    expected = measure_ripple(step, level)
    return PermittivityFit(
        eps=eps,
        covariance=_compute_covariance_of_scatter(step.influence, step.miss, expected, v.at_m, ripple_m),
        share=np.asarray(step.used * share, np.float64),
        excess2=(np.abs(step.miss) / np.maximum(step.noise, 1e-30)) ** 2 / 2,
        answer=step.answer,
    )


def measure_ripple(step: _Step, level: Array) -> Array:
    """Ripple of the misses [n], what noise does not explain of them, in proportion to `level` [n], as in the fit.

    It may be as long as a small segment, whose few blocks do not show how far it moves their mean. Points count as in
    the fit.
    """
    excess = step.weights @ (np.abs(step.miss) ** 2 - 2 * step.noise**2) / (step.weights @ level**2)
    return level * np.sqrt(max(0.0, float(excess)))


def _compute_covariance_of_scatter(
    influence: Complex, miss: Complex, ripple: Array, at_m: Array, ripple_m: float
) -> Array:
    """Covariance of (real, imaginary) from the sums of the misses over blocks, with the expected ripple.

    Ripple is expected to be `ripple_m` long; longer ones the blocks show. (Misses of bent surfaces have correlations of
    0.7, 0.45, 0.2 and 0 at 8 to 32 mm, as windows overlap; simulated.)
    The 95 % region of few blocks is wider than that of a known covariance, by Fisher's distribution.
    """
    measured_terms = (influence * miss).real.T
    # Ripple may have any phase: its real and its imaginary part are separate errors.
    expected_terms = np.concatenate([influence.real * ripple, -influence.imag * ripple]).T / np.sqrt(2)
    measured, blocks = _sum_over_blocks(measured_terms, influence, at_m, BLOCK_M)
    parts = np.split(expected_terms, 2, axis=1)
    expected = np.sum([_sum_over_blocks(part, influence, at_m, ripple_m)[0] for part in parts], axis=0)
    # Each block gives two numbers, and two were fitted.
    freedom = max(0.0, 2 * blocks - 2)
    unbiased = measured * blocks / max(blocks - 1, 0.5)
    total = freedom + 2 * EXPECTED_BLOCKS
    mixed = (freedom * unbiased + 2 * EXPECTED_BLOCKS * expected) / total
    # Quantiles of F and chi-square; scipy.stats takes a second to load.
    wider = 2 * scipy.special.fdtri(2, total, 0.95) / scipy.special.chdtri(2, 0.05)
    return mixed * float(wider)


def _sum_over_blocks(terms: Array, influence: Complex, at_m: Array, block_m: float) -> tuple[Array, float]:
    """Covariance [2, 2] of the sum of `terms` [n, 2] that are common to a block, and how many blocks count.

    The mean over shifted blocks weights pairs of points, on average, by 1 - s on either axis, with s their distance
    over the side of a block.
    """
    covariance = np.zeros((2, 2))
    blocks = 0.0
    shifts = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5))
    for shift in shifts:
        block = number_blocks(at_m, shift, block_m)
        sums = np.stack([np.bincount(block, term) for term in terms.T], axis=1)
        covariance += sums.T @ sums / len(shifts)
        weight = np.bincount(block, np.sum(np.abs(influence) ** 2, axis=0))
        blocks += weight.sum() ** 2 / np.sum(weight**2) / len(shifts)
    return covariance, blocks


@dataclass(frozen=True)
class Uncertainty:
    """Standard errors common to a scan: leakage (each part), axes of polarisation, antennas' places (each coordinate).

    By default the leakage is that of a mount that was not measured, 0.058 in the root mean square; the other errors are
    chosen.
    """

    leakage: float = 0.041
    axis_rad: float = 0.01
    place_m: float = 0.0005


def disturb_optics(optics: Optics, uncertainty: Uncertainty) -> list[tuple[str, Optics]]:
    """Return (source's name, rig) for rigs that differ by one standard error in one property."""

    def replace_antenna(name: str, antenna: Antenna) -> Optics:
        change: dict[str, Any] = {name: antenna}
        return replace(optics, **change)

    rigs = []
    for name in ("tx", "h", "v"):
        antenna: Antenna = getattr(optics, name)
        for axis in np.eye(3):
            moved = replace(antenna, at_m=antenna.at_m + uncertainty.place_m * axis)
            rigs.append(("places", replace_antenna(name, moved)))
        rigs.append(("axes", replace_antenna(name, antenna.turn(uncertainty.axis_rad))))
    for name in ("h", "v"):
        antenna = getattr(optics, name)
        for part in (1, 1j):
            leaking = replace(antenna, leakage=antenna.leakage + uncertainty.leakage * part)
            rigs.append(("leakage", replace_antenna(name, leaking)))
    return rigs


Reference = Callable[[Optics], Gains]
"""Gains that a reference gives, if the rig is as stated."""


@dataclass(frozen=True)
class DisturbedScan:
    """Voltages of all points and gains, if the rig differs by one standard error in one property, the `source`."""

    source: str
    voltages: Voltages
    gains: Gains


def disturb_scan(seen: Seen, optics: Optics, reference: Reference, uncertainty: Uncertainty) -> list[DisturbedScan]:
    """Return the scan as it would be understood with each disturbed rig; reference and object move together."""
    rigs = disturb_optics(optics, uncertainty)
    return [DisturbedScan(source, find_voltages(seen, rig), reference(rig)) for source, rig in rigs]


def add_common_errors(
    fit: PermittivityFit, v: Voltages, gains: Gains, disturbed: Sequence[DisturbedScan], wave_number: float
) -> dict[str, Array]:
    """Return the covariances [2, 2] of a segment's permittivity by source, all points of the segment together.

    `disturbed` holds the same points as `v`.
    """
    coefficients = reflect_points(fit.eps, v, wave_number)
    miss = find_misses(v, gains, coefficients)
    sources = {"scatter": fit.covariance}

    def add(source: str, d: Array) -> None:
        sources[source] = sources.get(source, 0.0) + np.outer(d, d)

    for scan in disturbed:
        add(scan.source, find_common_error(fit, miss, scan, wave_number))

    # An error of ln(H / V) of the reference turns and scales b_H; `list_errors` are real, [errors, n].
    of_h = miss + v.b[:, 1] * receive(v, coefficients)[:, 0]
    reference_changes = (fit.answer * of_h) @ gains.list_errors(v.arrival).T
    flat_s, flat_p = reflect_flat(fit.eps, v.theta)
    flat = np.stack([flat_s, flat_p, 0 * flat_s, 0 * flat_s], axis=2)
    first_order = find_misses(v, gains, flat) - miss
    second_order = 1j * SECOND_ORDER * expansion_parameter(v, wave_number) * first_order
    for change in (CURVATURE_ERROR * first_order, second_order):
        add("model", (fit.answer @ change).real)
    for change in find_pattern_changes(fit.eps, v, wave_number):
        add("model", (fit.answer @ (find_misses(v, gains, coefficients + change) - miss)).real)
    # The phases of the reference's errors are not known: both parts of each count.
    sources["reference"] = (reference_changes @ reference_changes.conj().T).real
    return sources


def find_pattern_changes(eps: complex, v: Voltages, wave_number: float) -> Complex:
    """Changes [2, n, 2, 4] of the coefficients by the slope of H's pattern, and of V's, over a finite path's angles.

    At a finite path L an echo is a sum over directions, which a pattern weights: r gets j / (k L) r' times the
    pattern's slope, r' the derivative by the angle. Metal does not show it: its r is the same at all angles.
    """
    above = reflect_flat(eps, v.theta + ANGLE_STEP)
    below = reflect_flat(eps, v.theta - ANGLE_STEP)
    slope_s, slope_p = ((up - down) / (2 * ANGLE_STEP) for up, down in zip(above, below, strict=True))
    slopes = np.stack([slope_s, slope_p, 0 * slope_s, 0 * slope_s], axis=2)
    change = 1j * UNKNOWN_SLOPE / (wave_number * v.path_m)[..., None] * slopes
    return np.eye(2)[:, None, :, None] * change


def find_common_error(fit: PermittivityFit, miss: Complex, scan: DisturbedScan, wave_number: float) -> Array:
    """Return the change of a segment's permittivity, (real, imaginary) [2], if its scan is understood as `scan`."""
    coefficients = reflect_points(fit.eps, scan.voltages, wave_number)
    change = find_misses(scan.voltages, scan.gains, coefficients) - miss
    return (fit.answer @ change).real


def find_reflection(v: Voltages, gains: Gains) -> Array:
    """Level of H over that of flat metal, [n]."""
    metal = np.array([-1.0, -1.0, 0.0, 0.0])
    return np.abs(v.b[:, 0]) / np.exp(gains.level(v)) / np.maximum(np.abs(receive(v, metal)[:, 0]), 1e-30)


def find_reflecting(voltages: Voltages, amplitude: Array, segment: NDArray[np.int_], gains: Gains | None) -> NDArray:
    """True for points [n] at which a surface reflects, False for those that only its edge diffracts to.

    Without path and spreading, a surface of one medium is equally strong everywhere. At the border of the zone that
    reflects half of that is left, and what an edge diffracts falls on from there. The usual level is the median
    weighted by power (`amplitude` [n] of H), for edges are seen from many more places than a small plate reflects to.
    A segment without a level of its own, or with one that no medium has, is that of an edge alone. Without `gains`
    levels are not relative to metal, and the tolerance is larger.
    """
    level = np.log(np.maximum(np.abs(voltages.b[:, 0]), 1e-30))
    tolerance = LEVEL_TOLERANCE_WITHOUT_GAINS
    reflection = np.ones(len(level))
    if gains is not None:
        level = level - gains.level(voltages)
        tolerance = LEVEL_TOLERANCE
        reflection = find_reflection(voltages, gains)
    reflecting = np.zeros(len(level), bool)
    for number in np.unique(segment):
        members = np.flatnonzero(segment == number)
        order = members[np.argsort(level[members])]
        power = np.cumsum(amplitude[order] ** 2)
        usual = level[order[np.searchsorted(power, power[-1] / 2)]]
        at_level = np.abs(level[members] - usual) < tolerance
        share = np.sum(amplitude[members[at_level]] ** 2) / power[-1]
        is_surface = share > MIN_SHARE_AT_LEVEL and np.median(reflection[members[at_level]]) > MIN_REFLECTION
        reflecting[members] = at_level & is_surface
    return reflecting


def find_filling(at_m: Array, segment: NDArray[np.int_], extent_m: tuple[Array, Array]) -> Array:
    """Return the share [n] of a disc about each point that its segment fills, in stage offsets `at_m` [n, 2].

    `extent_m`: smallest and largest offset of the scan, [2] each. Only what was scanned of a disc counts: the end of
    the scan is no border of a surface.
    """
    filling = np.zeros(len(at_m))
    stride_m = np.array([_find_stride(column) for column in at_m.T])
    # Offsets of all windows of a disc.
    reach = np.ceil(BORDER_DISC_M / stride_m).astype(int)
    grid_x, grid_y = np.meshgrid(np.arange(-reach[0], reach[0] + 1), np.arange(-reach[1], reach[1] + 1))
    disc = np.stack([grid_x.ravel(), grid_y.ravel()], axis=1) * stride_m
    disc = disc[np.hypot(*disc.T) < BORDER_DISC_M]
    low, high = extent_m
    slack_m = 0.1 * stride_m
    places = at_m[:, None] + disc
    scanned = np.all((places > low - slack_m) & (places < high + slack_m), axis=2).sum(axis=1)
    for number in np.unique(segment):
        members = np.flatnonzero(segment == number)
        tree = scipy.spatial.KDTree(at_m[members])
        filled = tree.query_ball_point(at_m[members], BORDER_DISC_M, return_length=True)
        filling[members] = filled / scanned[members]
    return filling


def find_interior(at_m: Array, segment: NDArray[np.int_], extent_m: tuple[Array, Array]) -> NDArray[np.bool_]:
    """True for points [n] that are not near the border of their segment; arguments as of `find_filling`."""
    return find_filling(at_m, segment, extent_m) > MIN_FILLING


def find_shares(at_m: Array, segment: NDArray[np.int_], extent_m: tuple[Array, Array]) -> Array:
    """Return what each interior point counts for the permittivity of its segment, [n]: 1 far from the border."""
    filling = find_filling(at_m, segment, extent_m)
    return LEAST_SHARE + (1 - LEAST_SHARE) * np.clip((filling - MIN_FILLING) / (1 - MIN_FILLING), 0, 1)


def _find_stride(places_m: Array) -> float:
    """Return the usual distance of neighbouring windows on one axis, metres."""
    steps = np.diff(np.unique(np.round(places_m, 3)))
    steps = steps[steps > SAME_COLUMN_M]
    return float(np.median(steps)) if steps.size else STRIDE_M


def judge_medium(
    fit: PermittivityFit, v: Voltages, gains: Gains, disturbed: Sequence[DisturbedScan], wave_number: float
) -> tuple[float, float]:
    """Return what one medium does not explain: ln of H's level over the expected, and the rise over the band (ln, too).

    A wall or a coating reflects twice: its level is that of no half space, or it changes over the band. The rise is
    that of H or of V, whichever is larger, less two standard deviations of its own. The level's square is given less
    that of two standard deviations, as a root: what errors of the rig explain is left out, but does not hide what is
    larger. `fit`, `v` and `disturbed` hold the same points.
    """
    used = fit.share > 0
    blocks = int(number_blocks(v.at_m[used], (0.0, 0.0)).max()) + 1

    def find_levels(eps: complex, voltages: Voltages, gains: Gains) -> Array:
        expected = receive(voltages, reflect_points(eps, voltages, wave_number))
        levels = np.log(np.abs(voltages.b[:, 0])) - gains.level(voltages) - np.log(np.abs(expected[:, 0]))
        return levels[used]

    levels = find_levels(fit.eps, v, gains)
    # Ripples of a plate's edges change levels by 10 %: they average in the mean by shares, and not in the median.
    level = float(np.average(levels, weights=fit.share[used]))
    # Where the reference does not tell the ratio of the gains, it does not tell their level either.
    unknown_std = float(np.median(gains.estimate_level_std(v)))
    variance = _spread(levels) ** 2 / blocks + unknown_std**2
    # A rig that is known badly gives a wrong permittivity, and with it a wrong level.
    miss = find_misses(v, gains, reflect_points(fit.eps, v, wave_number))
    for scan in disturbed:
        real, imaginary = find_common_error(fit, miss, scan, wave_number)
        moved = find_levels(fit.eps + complex(real, imaginary), scan.voltages, scan.gains)
        variance += (float(np.average(moved, weights=fit.share[used])) - level) ** 2

    rises = v.band_rise[used] - gains.band_rise
    rise = np.abs(np.median(rises, axis=0)) - 2 * np.array([_spread(column) for column in rises.T]) / np.sqrt(blocks)
    return float(np.sqrt(max(0.0, level**2 - 4 * variance))), float(np.max(rise))


def _spread(values: Array) -> float:
    """Standard deviation of normally distributed values by the median of their distances from the median."""
    return 1.48 * float(np.median(np.abs(values - np.median(values))))


def point_covariance(v: Voltages, gains: Gains, fit: PermittivityFit, wave_number: float) -> Array:
    """Covariance of (real, imaginary) of each point's permittivity by the scatter around it, [n, 2, 2].

    What edges and other echoes do to a point is no part of its noise, and differs over a segment: the misses of all
    points around it tell, those too that do not count for the segment.
    """
    around = scipy.spatial.KDTree(v.at_m).query_ball_point(v.at_m, RIPPLE_M)
    excess2 = np.array([fit.excess2[near].mean() for near in around])
    noise2 = np.sum((v.std / np.maximum(np.abs(v.b), 1e-30)) ** 2, axis=1)
    # Change of b_H for a numerical derivative, in proportion; chosen.
    step = 1e-3
    changed = replace(v, b=v.b * np.array([1 + step, 1.0]))
    rate = (point_permittivity(changed, gains, wave_number) - point_permittivity(v, gains, wave_number)) / step
    # The permittivity is an analytic function of the ratio: the same error in both parts.
    variance = np.abs(rate) ** 2 * noise2 * excess2
    return variance[:, None, None] * np.eye(2)
