"""Permittivity of surface segments from the voltages of H and V, referenced to metal of known shape.

A *point* is one echo, measured in one window of stage positions (34 mm wide, `window.WINDOW_M`). A *segment* is a
connected surface with many points, numbered n in the shapes below. Each segment gets one permittivity eps, by least
squares over its points (`fit_permittivity`) of the equation

    b_H (M r)_V = b_V (M r)_H

* r: reflection coefficients of the curved surface at the point, which depend on eps; [n, 2 receivers, 4].
* M: effect of the antennas' polarisations on r (`Voltages.response`); (M r)_H and (M r)_V are the voltages for gains of
  1.
* b_H, b_V: measured voltages of H and V (`Voltages.voltage`), divided by the receivers' gains (`Gains`). The gains
  depend on the direction in which V sees the point (`Voltages.arrival`).

Receivers are in the order H, V. The four coefficients are r_s, r_p, r_sp (s to p) and r_ps. The last two are 0 without
a *twist*, a curvature whose axes lie askew to the plane of incidence. The difference of both sides of the equation is
the *miss* of the point. *Ripple* is the error of points by edges and by other echoes; it is similar for neighbouring
points. `wave_number` is that at the middle of the band, rad / m. Permittivities are eps' - j eps''.

The covariance of (real, imaginary) of eps is the sum over these sources (`add_common_errors`):
* the scatter of the misses, summed over blocks of stage positions;
* leakage, polarisation axes and places of the antennas: each is moved by one standard error, for the object and for the
  metal reference together;
* the error of the metal reference itself;
* the model: error of the curvature, next order of the expansion in it, and slopes of the antennas' patterns.
An error that all points share changes their misses; one Gauss-Newton step turns that into a change of eps.

Two quantities that the fit does not use show whether a single medium reflected at a single surface (`judge_medium`):
the level of H relative to metal, and the change of the levels of H and V over the band.
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
    compute_expansion_parameter,
    find_voltages,
    number_blocks,
    predict_voltages,
    reflect_points,
)
from polysight.surfaces.measure import SeenEchoes
from polysight.surfaces.optics import ANGLE_STEP, Antenna, Optics, reflect_flat
from polysight.surfaces.paths import STRIDE_M

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
# A point is left out of the fit if its |miss| over its standard deviation is more than this times the median of the
# segment; chosen.
OUTLIER_RATIO = 4.0
# The covariance of a single point is that of the scatter of the points within this radius; chosen: ripples change over
# such a distance.
RIPPLE_M = 0.04
# Side of the square with the area of a Fresnel zone (40 x 70 mm): ripples that edges make are as long.
FRESNEL_ZONE_M = 0.053
# Length of the ripple of flat surfaces: their misses at points 8 mm apart have a correlation of 0.6, at 16 mm 0.3
# (plates of random scenes, simulated).
RIPPLE_OF_PLATES_M = 0.024
# Relative standard deviation of V / H of a point by ripple. It is added to the noise in the weights of points; chosen.
USUAL_RIPPLE = 0.02
# A small segment has few blocks, so that their scatter alone is an uncertain estimate. It is averaged with a second
# one: the ripple of the single points, taken as equal within squares of `ripple_m`. The second estimate has the weight
# of this number of blocks; chosen.
EXPECTED_BLOCKS = 2.0
# Relative error of the curvature; chosen: the curvatures of 14 spheres and cylinders (50 to 190 mm, simulated) were
# measured 0.4 to 3 % too large, 1.6 % in the root mean square, because a window is not small compared with such bodies.
CURVATURE_ERROR = 0.02
# The reflection at a curved surface is a series in x = K / (k cos^3(theta)), with K the curvature, k the wave number,
# theta the angle of incidence. The second-order term is taken as j SECOND_ORDER x times the first-order one. The exact
# series of spheres (100 and 200 mm, permittivity 2.8 to 8) gives 1.9.
SECOND_ORDER = 2.0
# Largest difference of ln |H| of a point from its segment's usual value. At the border of the zone that a surface
# reflects to, the amplitude is half of that inside, 0.69 less in ln: about half of that is allowed. Without a metal
# reference, the levels also change with the antennas' patterns over the directions, by about as much: then 0.9 is
# allowed. Both are chosen.
LEVEL_TOLERANCE = 0.35
LEVEL_TOLERANCE_WITHOUT_GAINS = 0.9
# A segment is not a surface if a smaller share of its power is in points at its usual level. The echo that an edge
# diffracts falls off with the angle, so it has no usual level: three segments of edges alone had 0.36 to 0.56, surfaces
# 0.91 and more (simulated).
MIN_SHARE_AT_LEVEL = 0.75
# A segment is not a surface if its amplitude of H relative to metal is smaller. A half space of permittivity 1.04 has
# this value at 55 degrees. The echo that the end of a cylinder diffracts had 0.02 (simulated).
MIN_REFLECTION = 0.03
# A point is near the border of its segment if its segment fills less than three quarters of a disc of 50 mm radius
# about it. At a straight border that is nearer than 20 mm. There edges turn normals by degrees, and H / V of a plate
# with sharp edges is 10 % too large.
BORDER_DISC_M = 0.05
MIN_FILLING = 0.75
# Weight of a point next to the border in the fit of its segment. The weight rises to 1 as interior points fill the disc
# of `BORDER_DISC_M` about the point. Ripples of edges oscillate about zero, and a sum averages them if its weights rise
# and fall slowly. The permittivities of the plates of 11 random scenes (simulated) had errors of 2.2 % in the root mean
# square with equal weights, and have 1.2 % with these.
LEAST_SHARE = 0.01
# Stage offsets closer than this belong to one column of windows: rows start a little apart, as the stage moves within a
# burst.
SAME_COLUMN_M = 1.5e-3
# Step of numerical derivatives with respect to the permittivity; chosen.
EPS_STEP = 1e-4
# Limits of the permittivity during iterations, of eps' and of the imaginary part -eps''. Solids and water are within
# them, and a little gain (a positive imaginary part), which noise may give.
REAL_LIMITS = (1.2, 40)
IMAGINARY_LIMITS = (-20, 0.5)


@dataclass(frozen=True)
class PermittivityFit:
    """Permittivity of a segment, fitted to its n points.

    Attributes
    ----------
    eps
        The permittivity, eps' - j eps''.
    covariance
        Covariance [2, 2] of the real and imaginary part of `eps`, from the scatter of the points alone.
    share
        Factor of each point's weight in addition to its noise and ripple, [n]; 0 for outliers.
    excess2
        |miss|^2 of each point over its expectation from noise alone, [n]; 1 on average if there is only noise.
    answer
        Complex [2, n]: if the misses change by d [n], (real, imaginary) of `eps` change by the real part of
        `answer @ d`.
    """

    eps: complex
    covariance: Array
    share: Array
    excess2: Array
    answer: Complex


def point_ratio(points: Voltages, gains: Gains) -> Complex:
    """Return the measured r_s / r_p of each point, complex [n], neglecting the twist that mixes s and p."""
    b = points.voltage.copy()
    b[:, 0] /= gains.ratio(points.arrival)
    return _unmix(points, b)


def _unmix(points: Voltages, voltage: Complex) -> Complex:
    """Return r_s / r_p [n] of a surface without twist that gives the voltages `voltage` [n, 2]."""
    r = np.linalg.solve(points.response[..., :2], voltage[..., None])[..., 0]
    return r[:, 0] / np.where(r[:, 1] == 0, 1e-30, r[:, 1])


def point_permittivity(v: Voltages, gains: Gains, wave_number: float) -> Complex:
    """Return the permittivity of each point alone, complex [n].

    It starts from that of a flat half space with the point's r_s / r_p. Each iteration divides the ratio by the effect
    of the curvature (`curved` over flat) at the last permittivity.
    """
    ratio = point_ratio(v, gains)
    # Incidence at H; that at V differs by some 0.1 degrees, which `predict_voltages` accounts for.
    theta = v.theta[:, 0]
    eps = clip_permittivity(permittivity_from_ratio(ratio, theta))
    # A fixed number of iterations; chosen.
    for _ in range(4):
        r_s, r_p = reflect_flat(eps, theta)
        curved = _unmix(v, predict_voltages(v, reflect_points(eps, v, wave_number)))
        eps = clip_permittivity(permittivity_from_ratio(ratio * (r_s / r_p) / curved, theta))
    return eps


def clip_permittivity(eps: NDArray) -> Complex:
    """Return permittivities limited to `REAL_LIMITS` and `IMAGINARY_LIMITS`, and 4 where they are not finite.

    An iteration that left the range can then continue.
    """
    finite = np.where(np.isfinite(eps), eps, 4.0)
    return np.clip(np.real(finite), *REAL_LIMITS) + 1j * np.clip(np.imag(finite), *IMAGINARY_LIMITS)


def find_misses(v: Voltages, gains: Gains, coefficients: Complex) -> Complex:
    """Return the miss b_H (M r)_V - b_V (M r)_H of each point, complex [n], for coefficients r [n, 2, 4].

    Symbols are those of the module's docstring, except that only the ratio of the gains matters: b_H is divided by the
    gain of H over that of V, b_V by nothing. A miss is 0 where the coefficients explain H / V.
    """
    expected = predict_voltages(v, coefficients)
    return v.voltage[:, 0] / gains.ratio(v.arrival) * expected[:, 1] - v.voltage[:, 1] * expected[:, 0]


def _compute_noise_of_misses(v: Voltages, gains: Gains, coefficients: Complex) -> Array:
    """Return the standard deviation by noise alone of each miss's real part, and of its imaginary part, [n]."""
    expected = np.abs(predict_voltages(v, coefficients))
    std_h = v.std[:, 0] / np.abs(gains.ratio(v.arrival))
    return np.hypot(std_h * expected[:, 1], v.std[:, 1] * expected[:, 0])


@dataclass(frozen=True)
class _Step:
    """One Gauss-Newton step from a permittivity, for n points.

    `miss` [n], `noise` [n] (standard deviation of either part) and `weights` [n] are those at this permittivity; `used`
    [n] is False for outliers. The step of (real, imaginary) is the real part of `influence @ miss`, `influence` complex
    [2, n]. `answer` is that of `PermittivityFit`. It differs from `influence` because a change of a miss also changes
    its weight.
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
    """Return the Gauss-Newton step at the permittivity `eps`; outliers have a weight of 0.

    `ripple` [n] is the standard deviation of the misses in addition to their noise. `share` [n] is a factor of the
    weights.
    """
    coefficients = reflect_points(eps, v, wave_number)
    miss = find_misses(v, gains, coefficients)
    rates = []
    for step in (EPS_STEP, 1j * EPS_STEP):
        stepped_coefficients = reflect_points(eps + step, v, wave_number)
        rates.append((find_misses(v, gains, stepped_coefficients) - miss) / EPS_STEP)
    jacobian = np.stack(rates, axis=1)
    noise = _compute_noise_of_misses(v, gains, coefficients)
    scale = np.hypot(noise, ripple)
    size = np.abs(miss) / scale
    median_size = float(np.median(size)) + 1e-12
    # If all points fit far better than their errors, points with a usual miss must not become outliers (0.3 is chosen).
    is_used = size < OUTLIER_RATIO * max(median_size, 0.3)
    # Misses of twice the median size lose half of their weight, larger ones more (chosen).
    falloff = 1 / (1 + (size / (2 * median_size)) ** 2)
    weights = share * is_used / scale**2 * falloff
    # A miss that grows loses weight. On average over the phases of its change, it counts by the square of the falloff.
    rate_weights = weights * falloff
    # J' W J, [2, 2], with the real and the imaginary part of eps as unknowns.
    information = np.einsum("np,nq,n->pq", jacobian.conj(), jacobian, rate_weights).real
    inverse = np.linalg.inv(information + 1e-15 * np.eye(2))
    influence = -np.einsum("pq,nq,n->pn", inverse, jacobian.conj(), weights)
    answer = -np.einsum("pq,nq,n->pn", inverse, jacobian.conj(), rate_weights)
    return _Step(miss, noise, weights, is_used, influence, answer)


def fit_permittivity(
    v: Voltages, gains: Gains, wave_number: float, share: Array | float = 1.0, ripple_m: float = FRESNEL_ZONE_M
) -> PermittivityFit:
    """Fit one permittivity to points: weighted least squares by Gauss-Newton, with weights that fall for large misses.

    `share` [n] is a factor of each point's weight, in addition to noise and ripple; see `find_shares`. `ripple_m` is
    the length over which the ripple of the misses is similar, metres; a longer one gives a larger covariance.
    """
    point_values = point_permittivity(v, gains, wave_number)
    # The iteration starts with at least a small loss: an imaginary part of -0.01 or below (chosen).
    eps = complex(np.median(point_values.real), min(np.median(point_values.imag), -0.01))
    # Level of H in the unit of a miss: |b_H M_V|, with M_V the factor of r_p in V.
    level = np.abs(v.voltage[:, 0] / gains.ratio(v.arrival) * v.response[:, 1, 1])
    # Without ripple, points of little noise would outweigh all others.
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
    """Return the root mean square of the misses without noise, `ripple` [n], taken as proportional to `level` [n].

    Points have the weights w of the fit: ripple^2 = level^2 sum(w (|miss|^2 - 2 noise^2)) / sum(w level^2). Unlike the
    scatter of blocks, this also includes a ripple that is as long as the segment, which changes all of its blocks
    together.
    """
    excess = step.weights @ (np.abs(step.miss) ** 2 - 2 * step.noise**2) / (step.weights @ level**2)
    return level * np.sqrt(max(0.0, float(excess)))


def _compute_covariance_of_scatter(
    influence: Complex, miss: Complex, ripple: Array, at_m: Array, ripple_m: float
) -> Array:
    """Return the covariance [2, 2] of (real, imaginary) of the permittivity from the scatter of the points.

    Two estimates are averaged (see `EXPECTED_BLOCKS`): the measured one, from the sums of the misses over blocks of
    `BLOCK_M`; and the expected one, from `ripple` [n] that is common to squares of `ripple_m`. `at_m` [n, 2] are the
    stage offsets. (Misses of bent surfaces have correlations of 0.7, 0.45, 0.2 and 0 at 8, 16, 24 and 32 mm, as windows
    overlap; simulated.)
    The covariance is scaled up, because its estimate from few blocks is uncertain: the 95 % region then follows
    Fisher's F distribution, which is wider than chi-square.
    """
    measured_terms = (influence * miss).real.T
    # Ripple may have any phase: its real part and its imaginary part are independent errors of half the variance each.
    expected_terms = [part.T * ripple[:, None] / np.sqrt(2) for part in (influence.real, -influence.imag)]
    measured, blocks = _sum_over_blocks(measured_terms, influence, at_m, BLOCK_M)
    expected = np.sum([_sum_over_blocks(part, influence, at_m, ripple_m)[0] for part in expected_terms], axis=0)
    # Each block gives two numbers, and two were fitted.
    freedom = max(0.0, 2 * blocks - 2)
    unbiased = measured * blocks / max(blocks - 1, 0.5)
    total = freedom + 2 * EXPECTED_BLOCKS
    mixed = (freedom * unbiased + 2 * EXPECTED_BLOCKS * expected) / total
    # Quantiles of F and chi-square from scipy.special, because scipy.stats takes a second to load.
    wider = 2 * scipy.special.fdtri(2, total, 0.95) / scipy.special.chdtri(2, 0.05)
    return mixed * float(wider)


def _sum_over_blocks(terms: Array, influence: Complex, at_m: Array, block_m: float) -> tuple[Array, float]:
    """Return the covariance [2, 2] of the sum of `terms` [n, 2], and the effective number of blocks.

    Terms of one block are taken as fully correlated, those of different blocks as independent. The effective number of
    blocks is (sum w)^2 / sum w^2, with w the sum of |`influence`|^2 in a block.
    Both results are means over four grids of blocks, shifted by half a block. On average, the errors of two points then
    have a correlation of about 1 - s along either axis, with s their distance along the axis over `block_m` (0 for s
    above 1).
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
    """Standard errors of the rig, which all points of a scan share.

    `leakage` is that of the real part, and of the imaginary part, of either receiver's leakage. By default it is that
    of a mount that was not measured, 0.058 in the root mean square of the complex number. `axis_rad` is the error of
    each antenna's polarisation axis, radians. `place_m` is that of each coordinate of each antenna, metres. The last
    two are chosen.
    """

    leakage: float = 0.041
    axis_rad: float = 0.01
    place_m: float = 0.0005


def disturb_optics(optics: Optics, uncertainty: Uncertainty) -> list[tuple[str, Optics]]:
    """Return pairs (source, rig): each rig has one property changed by one standard error.

    Sources are "places" (three coordinates of each of three antennas), "axes" (each antenna) and "leakage" (both parts
    of either receiver).
    """

    def replace_antenna(name: str, antenna: Antenna) -> Optics:
        change: dict[str, Any] = {name: antenna}
        return replace(optics, **change)

    rigs = []
    for name in ("tx", "h", "v"):
        antenna: Antenna = getattr(optics, name)
        for axis in np.eye(3):
            moved_antenna = replace(antenna, at_m=antenna.at_m + uncertainty.place_m * axis)
            rigs.append(("places", replace_antenna(name, moved_antenna)))
        rigs.append(("axes", replace_antenna(name, antenna.turn(uncertainty.axis_rad))))
    for name in ("h", "v"):
        antenna = getattr(optics, name)
        for part in (1, 1j):
            leaking = replace(antenna, leakage=antenna.leakage + uncertainty.leakage * part)
            rigs.append(("leakage", replace_antenna(name, leaking)))
    return rigs


Reference = Callable[[Optics], Gains]
"""Function that returns the gains by the metal reference, given the rig's antennas."""


@dataclass(frozen=True)
class DisturbedScan:
    """Voltages of all points, and gains, computed with a rig that has one property changed by one standard error.

    `source` names the property, as in `disturb_optics`.
    """

    source: str
    voltages: Voltages
    gains: Gains


def disturb_scan(
    seen: SeenEchoes, optics: Optics, reference: Reference, uncertainty: Uncertainty
) -> list[DisturbedScan]:
    """Return the measured scan evaluated with each rig of `disturb_optics`.

    Voltages and gains use the same rig, so that an error of the rig that object and reference share cancels.
    """
    rigs = disturb_optics(optics, uncertainty)
    return [DisturbedScan(source, find_voltages(seen, rig), reference(rig)) for source, rig in rigs]


def add_common_errors(
    fit: PermittivityFit, v: Voltages, gains: Gains, disturbed: Sequence[DisturbedScan], wave_number: float
) -> dict[str, Array]:
    """Return the covariance [2, 2] of (real, imaginary) of a segment's permittivity, by source; their sum is the total.

    Sources are "scatter", "places", "axes", "leakage", "reference" and "model". `v` and the voltages of `disturbed`
    hold the same points, those of the segment that were fitted.
    """
    coefficients = reflect_points(fit.eps, v, wave_number)
    miss = find_misses(v, gains, coefficients)
    sources = {"scatter": fit.covariance}

    def add(source: str, d: Array) -> None:
        sources[source] = sources.get(source, 0.0) + np.outer(d, d)

    for scan in disturbed:
        add(scan.source, find_common_error(fit, miss, scan, wave_number))

    # An error of ln(H / V) of the reference changes b_H in proportion, and with it the first term of the miss,
    # b_H (M r)_V. `list_errors` are real, [errors, n]: one standard deviation of either part of ln(H / V).
    first_term = miss + v.voltage[:, 1] * predict_voltages(v, coefficients)[:, 0]
    reference_changes = (fit.answer * first_term) @ gains.list_errors(v.arrival).T
    flat_s, flat_p = reflect_flat(fit.eps, v.theta)
    flat = np.stack([flat_s, flat_p, 0 * flat_s, 0 * flat_s], axis=2)
    first_order = find_misses(v, gains, flat) - miss
    second_order = 1j * SECOND_ORDER * compute_expansion_parameter(v, wave_number) * first_order
    for change in (CURVATURE_ERROR * first_order, second_order):
        add("model", (fit.answer @ change).real)
    for change in find_pattern_changes(fit.eps, v, wave_number):
        add("model", (fit.answer @ (find_misses(v, gains, coefficients + change) - miss)).real)
    # The real and the imaginary part of ln(H / V) of the reference have the same, independent errors: both are added.
    sources["reference"] = (reference_changes @ reference_changes.conj().T).real
    return sources


def find_pattern_changes(eps: complex, v: Voltages, wave_number: float) -> Complex:
    """Return the changes of the coefficients by the slope of H's pattern, and by that of V's, complex [2, n, 2, 4].

    An echo over a finite path L (metres) is a sum over directions, weighted by the antenna's pattern. To first order
    that adds j / (k L) r' g to a coefficient r: k is the wave number, r' the derivative of r by the angle, g the slope
    of ln of the pattern (`UNKNOWN_SLOPE`, per radian). The metal reference does not include this effect, because r of
    metal is the same at all angles.
    """
    above = reflect_flat(eps, v.theta + ANGLE_STEP)
    below = reflect_flat(eps, v.theta - ANGLE_STEP)
    slope_s, slope_p = ((up - down) / (2 * ANGLE_STEP) for up, down in zip(above, below, strict=True))
    slopes = np.stack([slope_s, slope_p, 0 * slope_s, 0 * slope_s], axis=2)
    change = 1j * UNKNOWN_SLOPE / (wave_number * v.path_m)[..., None] * slopes
    return np.eye(2)[:, None, :, None] * change


def find_common_error(fit: PermittivityFit, miss: Complex, scan: DisturbedScan, wave_number: float) -> Array:
    """Return the change of a segment's permittivity, (real, imaginary) [2], if its points are evaluated as `scan`.

    `miss` [n] are the misses at `fit.eps` with the undisturbed rig.
    """
    coefficients = reflect_points(fit.eps, scan.voltages, wave_number)
    change = find_misses(scan.voltages, scan.gains, coefficients) - miss
    return (fit.answer @ change).real


def find_reflection(v: Voltages, gains: Gains) -> Array:
    """Return the amplitude of H over that of flat metal at the same point, [n]."""
    metal = np.array([-1.0, -1.0, 0.0, 0.0])
    return (
        np.abs(v.voltage[:, 0]) / np.exp(gains.level(v)) / np.maximum(np.abs(predict_voltages(v, metal)[:, 0]), 1e-30)
    )


def find_reflecting(voltages: Voltages, amplitude: Array, segment: NDArray[np.int_], gains: Gains | None) -> NDArray:
    """Return True for points [n] where a surface reflects, False for those where only an edge diffracts.

    `segment` [n] is the number of each point's segment. A surface of one medium has the same level of H everywhere,
    without path and spreading. At the border of the zone that it reflects to, half of the amplitude is left; outside,
    there is only the echo that the edge diffracts, which is lower still. So a point reflects if its level is near its
    segment's usual one. This is the median, weighted by power (`amplitude` [n] of H, squared), because edges are seen
    from many more stage positions than a small plate.
    All points of a segment are False if too little of its power is at the usual level (`MIN_SHARE_AT_LEVEL`), or if
    that level is too low for any medium (`MIN_REFLECTION`). If `gains` is None, levels are not relative to metal: the
    second test is left out, and the tolerance of the first is larger.
    """
    level = np.log(np.maximum(np.abs(voltages.voltage[:, 0]), 1e-30))
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
        usual_level = level[order[np.searchsorted(power, power[-1] / 2)]]
        is_at_level = np.abs(level[members] - usual_level) < tolerance
        share = np.sum(amplitude[members[is_at_level]] ** 2) / power[-1]
        is_surface = share > MIN_SHARE_AT_LEVEL and np.median(reflection[members[is_at_level]]) > MIN_REFLECTION
        reflecting[members] = is_at_level & is_surface
    return reflecting


def find_filling(at_m: Array, segment: NDArray[np.int_], extent_m: tuple[Array, Array]) -> Array:
    """Return the share [n] of a disc about each point that points of its segment fill.

    The disc has the radius `BORDER_DISC_M` in the plane of the stage offsets `at_m` [n, 2], metres. `extent_m` is the
    smallest and the largest offset of the scan, [2] each. Only the part of the disc inside this extent counts, because
    the end of the scan is not a border of a surface.
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
    scanned_places = np.all((places > low - slack_m) & (places < high + slack_m), axis=2).sum(axis=1)
    for number in np.unique(segment):
        members = np.flatnonzero(segment == number)
        tree = scipy.spatial.KDTree(at_m[members])
        filled = tree.query_ball_point(at_m[members], BORDER_DISC_M, return_length=True)
        filling[members] = filled / scanned_places[members]
    return filling


def find_interior(at_m: Array, segment: NDArray[np.int_], extent_m: tuple[Array, Array]) -> NDArray[np.bool_]:
    """Return True for points [n] that are not near the border of their segment; arguments as of `find_filling`."""
    return find_filling(at_m, segment, extent_m) > MIN_FILLING


def find_shares(at_m: Array, segment: NDArray[np.int_], extent_m: tuple[Array, Array]) -> Array:
    """Return the factor of each point's weight in the fit of its segment, [n]: `LEAST_SHARE` to 1 far from the border.

    Arguments are as of `find_filling`, of the interior points alone.
    """
    filling = find_filling(at_m, segment, extent_m)
    return LEAST_SHARE + (1 - LEAST_SHARE) * np.clip((filling - MIN_FILLING) / (1 - MIN_FILLING), 0, 1)


def _find_stride(places_m: Array) -> float:
    """Return the median distance of neighbouring windows along one axis, metres; `STRIDE_M` if all are at one place."""
    steps = np.diff(np.unique(np.round(places_m, 3)))
    steps = steps[steps > SAME_COLUMN_M]
    return float(np.median(steps)) if steps.size else STRIDE_M


def judge_medium(
    fit: PermittivityFit, v: Voltages, gains: Gains, disturbed: Sequence[DisturbedScan], wave_number: float
) -> tuple[float, float]:
    """Return two deviations from a single medium, both in ln of an amplitude: level, and rise over the band.

    A wall or a coating reflects twice. So its level differs from that of a half space of its permittivity, or its
    levels change over the band.
    The level l is ln(H measured / H expected from `fit.eps`), averaged over the points. Returned is sqrt(l^2 - (2
    std)^2), with std its standard deviation, or 0 if the square is negative: so errors of the rig do not count, and a
    larger deviation is hardly reduced.
    The rise is |ln(amplitude in the upper half of the band / lower half)| relative to metal, minus twice its standard
    deviation, of H or of V, whichever is larger. It is negative where there are only errors.
    `fit`, `v` and `disturbed` hold the same points.
    """
    is_used = fit.share > 0
    blocks = int(number_blocks(v.at_m[is_used], (0.0, 0.0)).max()) + 1

    def find_levels(eps: complex, voltages: Voltages, gains: Gains) -> Array:
        expected = predict_voltages(voltages, reflect_points(eps, voltages, wave_number))
        levels = np.log(np.abs(voltages.voltage[:, 0])) - gains.level(voltages) - np.log(np.abs(expected[:, 0]))
        return levels[is_used]

    levels = find_levels(fit.eps, v, gains)
    # Ripples of a plate's edges change levels by 10 %. They cancel in the mean weighted by `share`, not in the median.
    level = float(np.average(levels, weights=fit.share[is_used]))
    # Includes the error in directions that the reference does not cover.
    unknown_std = float(np.median(gains.estimate_level_std(v)))
    variance = _spread(levels) ** 2 / blocks + unknown_std**2
    # An error of the rig changes the permittivity, and with it the expected level, not only the measured one.
    miss = find_misses(v, gains, reflect_points(fit.eps, v, wave_number))
    for scan in disturbed:
        real, imaginary = find_common_error(fit, miss, scan, wave_number)
        moved_levels = find_levels(fit.eps + complex(real, imaginary), scan.voltages, scan.gains)
        variance += (float(np.average(moved_levels, weights=fit.share[is_used])) - level) ** 2

    rises = v.band_rise[is_used] - gains.band_rise
    rise = np.abs(np.median(rises, axis=0)) - 2 * np.array([_spread(column) for column in rises.T]) / np.sqrt(blocks)
    return float(np.sqrt(max(0.0, level**2 - 4 * variance))), float(np.max(rise))


def _spread(values: Array) -> float:
    """Return the standard deviation of normal values [n]: 1.48 times their median absolute deviation."""
    return 1.48 * float(np.median(np.abs(values - np.median(values))))


def point_covariance(v: Voltages, gains: Gains, fit: PermittivityFit, wave_number: float) -> Array:
    """Return the covariance of (real, imaginary) of each point's own permittivity by the scatter around it, [n, 2, 2].

    Ripple is not part of a point's noise, and differs from place to place. So the variance of the noise is multiplied
    by the mean of `fit.excess2` over the points within `RIPPLE_M`, outliers included.
    """
    neighbours = scipy.spatial.KDTree(v.at_m).query_ball_point(v.at_m, RIPPLE_M)
    excess2 = np.array([fit.excess2[near_points].mean() for near_points in neighbours])
    noise2 = np.sum((v.std / np.maximum(np.abs(v.voltage), 1e-30)) ** 2, axis=1)
    # Relative change of b_H for a numerical derivative; chosen.
    step = 1e-3
    stepped_voltages = replace(v, voltage=v.voltage * np.array([1 + step, 1.0]))
    rate = (point_permittivity(stepped_voltages, gains, wave_number) - point_permittivity(v, gains, wave_number)) / step
    # The permittivity is an analytic function of H / V, whose error is equal in all phases. So the real and the
    # imaginary part have equal, independent errors.
    variance = np.abs(rate) ** 2 * noise2 * excess2
    return variance[:, None, None] * np.eye(2)
