"""Permittivity of surface segments from the voltages of H and V, referenced to metal of known shape.

Voltages of a point are divided by spreading and path. The ratio of the gains of H and V over the direction of arrival
comes from a metal sphere (`learn_gains`), or from a flat metal plate, for one direction alone. A segment has one
permittivity: least squares of b_H (M r)_V = b_V (M r)_H over its points, with r the coefficients of a curved surface.
Its covariance is that of the scatter of the points, and of what is common to them: leakage, axes, places, gains.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from polysight.polarimetry import permittivity_from_ratio
from polysight.surfaces.measure import Seen, Shape, shape_of
from polysight.surfaces.optics import (
    Antenna,
    Optics,
    polarisation_row,
    principal_bends,
    reflect_curved,
    reflect_flat,
)
from polysight.surfaces.points import offset_that_sees, predict_echo, spreading, unit_legs

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
# Degree of the gains' polynomial in the direction of arrival, by the angle that the reference covers.
DEGREE = 2
# Change of ln(H / V) per radian of direction that a flat plate cannot exclude: two boards 20 degrees apart with the
# pattern cos^2 differ by 0.7.
UNKNOWN_SLOPE = 0.7
# Windows of 34 mm every 8 mm: so many share their noise and the ripple of edges.
OVERLAP = 18
# A point whose ratio lies so many standard deviations from the segment's does not belong to it.
OUTLIER = 4.0


@dataclass(frozen=True)
class Voltages:
    """What points [n] give: voltages `b` [n, 2] of H and V without path and spreading, their standard deviations,
    the rows `m` [n, 2 receivers, 2 coefficients], incidence, curvatures in and across the plane of incidence, and the
    direction of arrival at V [n, 2].
    """

    b: Complex
    std: Array
    m: Complex
    theta: Array
    bend_inside: Array
    bend_across: Array
    arrival: Array


def voltages_of(seen: Seen, optics: Optics, shape: Shape | None = None) -> Voltages:
    """Return the voltages of points; `shape` is that of H's echoes unless given."""
    shape = shape_of(seen.h, optics) if shape is None else shape
    tx, k = optics.tx, optics.wave_number
    at_v = offset_that_sees(shape.points, shape.normals, seen.v.at_m, tx.at_m, optics.v.at_m)
    b, rows, std, arrival = [], [], [], None
    for rx, echoes, at_m in ((optics.h, seen.h, seen.h.at_m), (optics.v, seen.v, at_v)):
        moved = echoes.moved(at_m, k)
        path, _, _ = predict_echo(shape.points, shape.normals, shape.curvature, at_m, tx.at_m, rx.at_m)
        spread = spreading(shape.points, shape.normals, shape.curvature, at_m, tx.at_m, rx.at_m)
        b.append(moved.amplitude * np.exp(1j * k * path) / spread)
        std.append(echoes.amplitude_std / spread)
        rows.append(polarisation_row(shape.points, shape.normals, at_m, tx, rx))
        _, back, *_ = unit_legs(shape.points, at_m, tx.at_m, rx.at_m)
        arrival = back[:, :2]
    inside, across = principal_bends(shape.points, shape.normals, shape.curvature, seen.h.at_m, tx.at_m)
    theta = np.arccos(np.clip(shape.cos, 0, 1))
    return Voltages(
        np.stack(b, axis=1), np.stack(std, axis=1), np.stack(rows, axis=1), theta, inside, across, np.asarray(arrival)
    )


@dataclass(frozen=True)
class Gains:
    """ln(gain of H / gain of V) as a polynomial of the direction of arrival, with covariance of its coefficients.

    `reach`: largest distance from the reference's directions that counts as covered, radians.
    """

    coefficients: Complex
    middle: Array
    degree: int
    std: float
    covered: tuple[Array, Array]

    def ratio(self, arrival: Array) -> Complex:
        """Gain of H over that of V, [n]."""
        return np.exp(self._basis(arrival) @ self.coefficients)

    def unknown(self, arrival: Array) -> Array:
        """Standard deviation of ln(H / V) by directions that the reference does not cover, [n]."""
        low, high = self.covered
        beyond = np.linalg.norm(np.maximum(0, np.maximum(low - arrival, arrival - high)), axis=1)
        slope = UNKNOWN_SLOPE if self.degree == 0 else UNKNOWN_SLOPE / 4
        return np.hypot(self.std, slope * beyond)

    def _basis(self, arrival: Array) -> Array:
        return _polynomials(arrival - self.middle, self.degree)


def _polynomials(d: Array, degree: int) -> Array:
    terms = [d[:, 0] ** i * d[:, 1] ** j for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.stack(terms, axis=1)


def learn_gains(metal: Voltages, wave_number: float) -> Gains:
    """Fit the gains to points of metal; directions closer than 3 degrees together give one value for all."""
    r_s, r_p = reflect_curved(np.inf, metal.theta, metal.bend_inside, metal.bend_across, wave_number)
    expected = metal.m @ np.stack([r_s, r_p], axis=1)[..., None]
    gain = (metal.b / expected[..., 0])[:, 0] / (metal.b / expected[..., 0])[:, 1]
    good = np.isfinite(gain) & (np.abs(gain) > 0)
    gain, arrival = gain[good], metal.arrival[good]
    weight = 1 / (np.sum((metal.std / np.abs(metal.b)) ** 2, axis=1)[good] + 1e-4)
    middle = np.average(arrival, axis=0, weights=weight)
    low, high = np.percentile(arrival, [3, 97], axis=0)
    degree = DEGREE if float(np.min(high - low)) > 0.1 else 0
    centre = np.angle(np.sum(weight * gain / np.abs(gain)))
    log = np.log(np.abs(gain)) + 1j * (np.angle(gain * np.exp(-1j * centre)) + centre)
    basis = _polynomials(arrival - middle, degree)
    coefficients = np.zeros(basis.shape[1], complex)
    spread = 0.0
    for _ in range(5):
        root = np.sqrt(weight)
        coefficients = np.linalg.lstsq(basis * root[:, None], log * root, rcond=None)[0]
        rest = np.abs(log - basis @ coefficients)
        spread = 1.48 * float(np.median(rest))
        weight = weight / (1 + (rest / (2 * spread + 1e-9)) ** 2)
    std = float(spread / np.sqrt(max(1.0, len(log) / OVERLAP)))
    return Gains(coefficients, middle, degree, std, (low, high))


@dataclass(frozen=True)
class SegmentResult:
    """Permittivity of a segment: `eps` and covariance [2, 2] of (real, imaginary); which points count; the scatter of
    the points over their expected one (1: noise alone); shares of variance by source.
    """

    eps: complex
    covariance: Array
    used: NDArray[np.bool_]
    scatter: float
    sources: dict[str, float]


def point_ratio(v: Voltages, gains: Gains) -> Complex:
    """Ratio r_s / r_p of each point."""
    b = v.b.copy()
    b[:, 0] /= gains.ratio(v.arrival)
    r = np.linalg.solve(v.m, b[..., None])[..., 0]
    return r[:, 0] / np.where(r[:, 1] == 0, 1e-30, r[:, 1])


def point_permittivity(v: Voltages, gains: Gains, wave_number: float) -> Complex:
    """Permittivity of each point: Eq. 3 of the ratio, corrected for curvature and iterated."""
    ratio = point_ratio(v, gains)
    eps = clip_permittivity(permittivity_from_ratio(ratio, v.theta))
    for _ in range(4):
        r_s, r_p = reflect_flat(eps, v.theta)
        c_s, c_p = reflect_curved(eps, v.theta, v.bend_inside, v.bend_across, wave_number)
        eps = clip_permittivity(permittivity_from_ratio(ratio * (r_s / r_p) / (c_s / c_p), v.theta))
    return eps


def clip_permittivity(eps: NDArray) -> Complex:
    """Limit permittivities to those of solids, so that iterations go on."""
    finite = np.where(np.isfinite(eps), eps, 4.0)
    return np.clip(np.real(finite), 1.2, 40) + 1j * np.clip(np.imag(finite), -20, 0.5)


def _misses(v: Voltages, gains: Gains, eps: complex, wave_number: float) -> tuple[Complex, Array]:
    """b_H (M r)_V - b_V (M r)_H of each point, relative to its standard deviation's scale; and that scale [n]."""
    r = np.stack(reflect_curved(eps, v.theta, v.bend_inside, v.bend_across, wave_number), axis=1)
    expected = (v.m @ r[..., None])[..., 0]
    ratio = gains.ratio(v.arrival)
    miss = v.b[:, 0] / ratio * expected[:, 1] - v.b[:, 1] * expected[:, 0]
    std = np.hypot(v.std[:, 0] / np.abs(ratio) * np.abs(expected[:, 1]), v.std[:, 1] * np.abs(expected[:, 0]))
    return miss, std


# What the first order in curvature and the antennas' changing gain over the zone leave of r_p / r_s (compared with the
# series of spheres and cylinders: 0.003), and what drawn scenes show besides (1 to 2 % of a permittivity, mostly too
# high): in proportion, and near Brewster's angle as a share of r_s.
MODEL_RATIO_STD = 0.008
MODEL_FLOOR_STD = 0.002
# Errors of a point besides noise: edges, other echoes, curvature; relative to the voltages.
MODEL_ERROR = 0.02


def fit_permittivity(v: Voltages, gains: Gains, wave_number: float, start: complex | None = None) -> SegmentResult:
    """Weighted least squares of one permittivity over points, by Gauss and Newton; robust by iterated weights."""
    if start is None:
        eps = point_permittivity(v, gains, wave_number)
        start = complex(np.median(eps.real), min(np.median(eps.imag), -0.01))
    value = np.array([start.real, start.imag])
    used = np.ones(len(v.theta), bool)
    information = np.eye(2)
    scatter = 1.0
    weights = np.ones(len(v.theta))
    jacobian = np.zeros((len(v.theta), 2), complex)
    miss = noise = np.zeros(len(v.theta))
    for _ in range(12):
        eps = complex(value[0], value[1])
        miss, noise = _misses(v, gains, eps, wave_number)
        scale = np.hypot(noise, MODEL_ERROR * np.abs(v.b[:, 0] * v.m[:, 1, 1]))
        step = 1e-4
        rate = [(_misses(v, gains, eps + d, wave_number)[0] - miss) / step for d in (step, 1j * step)]
        size = np.abs(miss) / scale
        middle = np.median(size) + 1e-12
        used = size < OUTLIER * max(middle, 0.3)
        weights = used / scale**2 / (1 + (size / (2 * middle)) ** 2)
        jacobian = np.stack([*rate], axis=1)
        information = np.einsum("np,nq,n->pq", jacobian.conj(), jacobian, weights).real
        right = -np.einsum("np,n,n->p", jacobian.conj(), miss, weights).real
        move = np.linalg.solve(information + 1e-15 * np.eye(2), right)
        value = value + np.clip(move, -1, 1)
        value = np.array([np.clip(value[0], 1.2, 40), np.clip(value[1], -20, 0.5)])
        if np.abs(move).max() < 1e-6:
            break
    # Scatter of the misses, not the assumed noise, gives the error.
    terms = np.einsum("np,n,n->np", jacobian.conj(), miss, weights).real
    meat = terms.T @ terms * OVERLAP
    inverse = np.linalg.inv(information)
    covariance = inverse @ meat @ inverse
    scatter = float(np.sqrt(np.average((np.abs(miss) / np.maximum(noise, 1e-30)) ** 2, weights=weights) / 2))
    return SegmentResult(
        complex(value[0], value[1]), covariance, used, scatter, {"scatter": float(np.trace(covariance))}
    )


@dataclass(frozen=True)
class Uncertainty:
    """Standard errors common to a scan: leakage (each part), axes of polarisation, places of the antennas."""

    leakage: float = 0.041
    axis_rad: float = 0.01
    place_m: float = 0.0005


def _perturbed(optics: Optics, uncertainty: Uncertainty) -> list[tuple[str, Optics]]:
    """Return the rigs that differ by one standard error in one property, with the source's name."""
    rigs = []
    for name in ("h", "v"):
        antenna: Antenna = getattr(optics, name)
        for part in (1, 1j):
            leaking = replace(antenna, leakage=antenna.leakage + uncertainty.leakage * part)
            rigs.append(("leakage", replace(optics, **{name: leaking})))
        for axis in np.eye(3):
            moved = replace(antenna, at_m=antenna.at_m + uncertainty.place_m * axis)
            rigs.append(("places", replace(optics, **{name: moved})))
    for name in ("tx", "h", "v"):
        turned = getattr(optics, name).turned(uncertainty.axis_rad)
        rigs.append(("axes", replace(optics, **{name: turned})))
    return rigs


Reference = Callable[[Optics], Gains]
"""Gains that a reference gives, if the rig is as stated."""


def segment_permittivity(seen: Seen, optics: Optics, reference: Reference, uncertainty: Uncertainty) -> SegmentResult:
    """Permittivity of the points of one segment, with what is common to them in the covariance.

    Each common error moves reference and object together: gains are learnt again for each.
    """
    k = optics.wave_number
    gains = reference(optics)
    v = voltages_of(seen, optics)
    found = fit_permittivity(v, gains, k)
    used = seen[found.used]
    covariance = found.covariance.copy()
    sources = dict(found.sources)

    def add(source: str, eps: complex) -> None:
        d = np.array([eps.real - found.eps.real, eps.imag - found.eps.imag])
        covariance[:] += np.outer(d, d)
        sources[source] = sources.get(source, 0.0) + float(d @ d)

    for source, rig in _perturbed(optics, uncertainty):
        changed = fit_permittivity(voltages_of(used, rig), reference(rig), k, found.eps)
        add(source, changed.eps)
    part = voltages_of(used, optics)
    log_std = float(np.sqrt(np.mean(gains.unknown(part.arrival) ** 2)))
    for direction in (1, 1j):
        shifted = replace(gains, coefficients=gains.coefficients + direction * log_std * _constant(gains))
        add("reference", fit_permittivity(part, shifted, k, found.eps).eps)
        shifted = replace(gains, coefficients=gains.coefficients + direction * MODEL_RATIO_STD * _constant(gains))
        add("model", fit_permittivity(part, shifted, k, found.eps).eps)
        of_s = part.b[:, 0] / gains.ratio(part.arrival) * part.m[:, 1, 1] / part.m[:, 0, 0]
        b = np.stack([part.b[:, 0], part.b[:, 1] + direction * MODEL_FLOOR_STD * of_s], axis=1)
        add("model", fit_permittivity(replace(part, b=b), gains, k, found.eps).eps)
    return replace(found, covariance=covariance, sources=sources)


def _constant(gains: Gains) -> Array:
    return (np.arange(len(gains.coefficients)) == 0).astype(float)
