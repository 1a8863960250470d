"""Gains of both receivers over direction, learnt from metal of known shape: the reference of a permittivity.

A metal sphere covers directions; a flat plate gives one. What TX sends depends on the direction of departure, and what
a receiver takes on that of arrival. At the distance of the reference, one of these directions gives the other. At other
distances it does not; the error of the level is then half the difference of both estimates. H over V needs only the
direction of arrival, because TX cancels.

`find_voltages` gives the voltages of H and V without path and spreading, and the rows that turn a surface's reflection
coefficients into such voltages. V sees a point from another stage position (some 15 mm from H's), under another angle.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from polysight.surfaces.measure import SeenEchoes, Shape, find_shape
from polysight.surfaces.optics import (
    Optics,
    compute_polarisation_row,
    mix_twisted,
    reflect_curved,
    reflect_spherical,
    resolve_curvature,
)
from polysight.surfaces.points import (
    compute_spreading,
    compute_unit_legs,
    find_normals,
    find_offset_that_sees,
    predict_echo,
)
from polysight.surfaces.window import WINDOW_M

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
# Blocks of stage positions whose errors count as independent: windows overlap, and ripples of edges and of other echoes
# are as long as a Fresnel zone (40 to 70 mm).
BLOCK_M = 2 * WINDOW_M


@dataclass(frozen=True)
class Voltages:
    """Voltages of points [n], with the directions, angles and curvatures that they depend on.

    Attributes
    ----------
    voltage, std
        Voltages of H and V without path and spreading, complex [n, 2], and the standard deviations of either part.
    response
        Rows of the coefficients of r_s, r_p, s to p and p to s, complex [n, 2 receivers, 4 coefficients].
    theta
        Incidence at H and V, [n, 2], radians: V sees a point from elsewhere, some 0.1 degrees steeper. Near Brewster's
        angle that changes r_p by some per cent.
    path_m
        Path from TX to H and V, [n, 2].
    bend_inside, bend_across, twist
        Curvatures in and across the plane of incidence, and twist between both, [n].
    arrival, departure
        Directions in which V sees the point, and in which TX sees it for H: x and y of unit vectors, [n, 2].
    band_rise
        ln of the amplitude in the upper half of the band over that in the lower half, of H and V [n, 2].
    at_m
        Stage offsets of H's echoes, x and y, [n, 2].
    """

    voltage: Complex
    std: Array
    response: Complex
    theta: Array
    path_m: Array
    bend_inside: Array
    bend_across: Array
    twist: Array
    arrival: Array
    departure: Array
    band_rise: Array
    at_m: Array

    def __len__(self) -> int:
        return len(self.theta)

    def __getitem__(self, keep: NDArray) -> Voltages:
        return Voltages(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})


def find_voltages(seen: SeenEchoes, optics: Optics, shape: Shape | None = None) -> Voltages:
    """Return the voltages of points; their `shape` is found from H's echoes unless given."""
    if shape is None:
        shape = find_shape(seen.h, optics)
    tx_m = optics.tx.at_m
    k = optics.wave_number
    surface = (shape.points, shape.normals, shape.curvature)
    # Stage offsets: those of H's echoes, and those from which V sees the same points, to which its echoes are moved.
    seen_from = {"h": seen.h.at_m, "v": find_offset_that_sees(*surface[:2], seen.v.at_m, tx_m, optics.v.at_m)}
    voltages = []
    std = []
    rows = []
    theta = []
    paths = []
    for channel, echoes in (("h", seen.h), ("v", seen.v)):
        receiver = optics.receiver(channel)
        at_m = seen_from[channel]
        path, _, _ = predict_echo(*surface, at_m, tx_m, receiver.at_m)
        spread = compute_spreading(*surface, at_m, tx_m, receiver.at_m)
        voltages.append(echoes.move(at_m, k).amplitude * np.exp(1j * k * path) / spread)
        std.append(echoes.amplitude_std / spread)
        rows.append(compute_polarisation_row(shape.points, shape.normals, at_m, optics.tx, receiver))
        _, cos = find_normals(shape.points, at_m, tx_m, receiver.at_m)
        theta.append(np.arccos(np.clip(cos, 0, 1)))
        paths.append(path)
    _, arrival_leg, *_ = compute_unit_legs(shape.points, seen_from["v"], tx_m, optics.v.at_m)
    departure_leg, *_ = compute_unit_legs(shape.points, seen_from["h"], tx_m, optics.h.at_m)
    bend_inside, bend_across, twist = resolve_curvature(*surface, seen.h.at_m, tx_m)
    return Voltages(
        voltage=np.stack(voltages, axis=1),
        std=np.stack(std, axis=1),
        response=np.stack(rows, axis=1),
        theta=np.stack(theta, axis=1),
        path_m=np.stack(paths, axis=1),
        bend_inside=bend_inside,
        bend_across=bend_across,
        twist=twist,
        arrival=arrival_leg[:, :2],
        departure=departure_leg[:, :2],
        band_rise=np.stack([seen.h.band_rise, seen.v.band_rise], axis=1),
        at_m=seen.h.at_m[:, :2],
    )


def reflect_points(eps: NDArray | complex, points: Voltages, wave_number: float) -> Complex:
    """Return coefficients (r_s, r_p, s to p, p to s) of the curved surface at each point for H and V, [n, 2, 4]."""
    eps_of_receivers = np.asarray(eps)[..., None]
    r_s, r_p = reflect_curved(
        eps_of_receivers, points.theta, points.bend_inside[:, None], points.bend_across[:, None], wave_number
    )
    mixed = mix_twisted(eps_of_receivers, points.theta, points.twist[:, None], wave_number)
    # The antennas are near: a spherical wave is reflected a little differently than a plane one.
    more_s, more_p = reflect_spherical(eps_of_receivers, points.theta, points.path_m, wave_number)
    return np.stack([r_s + more_s, r_p + more_p, mixed, mixed], axis=2)


def predict_voltages(points: Voltages, coefficients: Complex) -> Complex:
    """Return voltages of H and V [n, 2] that coefficients [n, 2, 4] give with gains of 1."""
    return np.sum(points.response * coefficients, axis=2)


def compute_expansion_parameter(points: Voltages, wave_number: float) -> Array:
    """Return K / (k cos^3 theta) of each point [n]: ratio of successive orders of reflection at a curved surface.

    K is the mean of both curvatures' sizes, k the wave number.
    """
    bend = (np.abs(points.bend_inside) + np.abs(points.bend_across)) / 2
    return bend / (wave_number * np.cos(points.theta[:, 0]) ** 3)


def number_blocks(at_m: Array, shift: tuple[float, float], block_m: float = BLOCK_M) -> NDArray[np.int_]:
    """Return the number of the block of each stage offset [n, 2]; `shift` moves the borders by a share of a block."""
    cell = np.floor(at_m / block_m + np.array(shift)).astype(int)
    _, number = np.unique(cell, axis=0, return_inverse=True)
    return number.reshape(-1)


# Degree of the gains' polynomials in the direction of arrival or departure, if the reference covers directions; chosen.
DEGREE = 2
# A reference whose directions span no more than this, in radians, counts as a plate, which has one direction; chosen.
LEAST_SPAN_RAD = 0.1
# Change of ln(H / V) per radian of direction that a flat plate cannot exclude: two boards 20 degrees apart with the
# pattern cos^2 differ by 0.7.
UNKNOWN_SLOPE = 0.7
# Share of `UNKNOWN_SLOPE` beyond the directions that a sphere covers. It is less than 1, because the polynomial that is
# fitted to a sphere continues the pattern. Chosen.
SHARE_BEYOND_SPHERE = 0.25


@dataclass(frozen=True)
class Gains:
    """Gains of H and V as polynomials of the direction of arrival, learnt from metal.

    Directions are the x and y of unit vectors, [n, 2]; small changes of them are radians.

    Attributes
    ----------
    ratio_terms
        Coefficients of ln(gain of H / gain of V), complex.
    level_terms
        Coefficients of ln|gain of H| in the direction of arrival, and in that of departure, [2, terms].
    band_rise
        ln of the level in the upper half of the band over that in the lower half, of H and V.
    middle, departure_middle, degree
        Middles of the directions of arrival and of departure, and the degree of the polynomials.
    std
        Standard deviation of each part of ln(H / V) within the directions covered: the misfit of the polynomial without
        the noise of the reference's points, and the next order of the reference's own curvature.
    covered
        Smallest and largest direction, [2] each.
    terms_root, cell
        Square root of the covariance of each part of `ratio_terms`, [terms, blocks]; size of a cell of directions [2]
        within which the misfit is the same.
    """

    ratio_terms: Complex
    level_terms: Array
    band_rise: Array
    middle: Array
    departure_middle: Array
    degree: int
    std: float
    covered: tuple[Array, Array]
    terms_root: Array
    cell: Array

    @property
    def v_over_h_db(self) -> float:
        """V's gain over H's in the middle of the directions; about 0 for samples relative to the direct path."""
        return float(-20 / np.log(10) * self.ratio_terms[0].real)

    def ratio(self, arrival: Array) -> Complex:
        """Return the gain of H over that of V for directions of arrival [n, 2], [n]."""
        return np.exp(self._make_basis(arrival) @ self.ratio_terms)

    def level(self, points: Voltages) -> Array:
        """Return ln|gain of H|, [n]: the mean of the estimates from arrival and departure."""
        return np.mean(self._find_levels(points), axis=0)

    def estimate_level_std(self, points: Voltages) -> Array:
        """Return the standard deviation of the level, [n], also where arrival and departure disagree."""
        level_by_arrival, level_by_departure = self._find_levels(points)
        return np.hypot(np.abs(level_by_arrival - level_by_departure) / 2, self.estimate_unknown_std(points.arrival))

    def _find_levels(self, points: Voltages) -> tuple[Array, Array]:
        """Return ln|gain of H| by the direction of arrival, and by that of departure, [n] each."""
        arrival_terms, departure_terms = self.level_terms
        departure = _evaluate_polynomials(points.departure - self.departure_middle, self.degree)
        return self._make_basis(points.arrival) @ arrival_terms, departure @ departure_terms

    def estimate_unknown_std(self, arrival: Array) -> Array:
        """Return the standard deviation of ln(H / V), [n], also of directions that the reference does not cover."""
        return np.hypot(self.std, self._extrapolate_std(arrival))

    def _extrapolate_std(self, arrival: Array) -> Array:
        """Return the standard deviation of ln(H / V) by the distance from the directions covered, [n]; 0 within."""
        low, high = self.covered
        distance_beyond = np.linalg.norm(np.maximum(0, np.maximum(low - arrival, arrival - high)), axis=1)
        if self.degree == 0:
            return UNKNOWN_SLOPE * distance_beyond
        return SHARE_BEYOND_SPHERE * UNKNOWN_SLOPE * distance_beyond

    def list_errors(self, arrival: Array) -> Array:
        """Return independent errors of each part of ln(H / V), one standard deviation each, [errors, n].

        The misfit of the polynomials differs from cell to cell of the directions; a wide object averages over it.
        Errors of the polynomials' terms are common to all directions, and so are those of directions that are not
        covered.
        """
        term_errors = self._make_basis(arrival) @ self.terms_root
        cells = np.floor((arrival - self.middle) / self.cell)
        number = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
        cell_errors = self.std * (number == np.arange(number.max() + 1)[:, None])
        return np.concatenate([term_errors.T, cell_errors, self._extrapolate_std(arrival)[None]])

    def _make_basis(self, arrival: Array) -> Array:
        """Return the polynomials of `ratio_terms` at directions of arrival, [n, terms]."""
        return _evaluate_polynomials(arrival - self.middle, self.degree)


def _evaluate_polynomials(directions: Array, degree: int) -> Array:
    """Return the products of powers of both columns of `directions` [n, 2] up to a total degree, [n, terms]."""
    terms = [directions[:, 0] ** i * directions[:, 1] ** j for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.stack(terms, axis=1)


def _fit_robustly(basis: Array, values: NDArray, weight: Array) -> tuple[NDArray, NDArray]:
    """Return the coefficients of `values` [n] in `basis` [n, terms], and the residuals; outliers lose their weight."""
    coefficients = np.zeros(basis.shape[1], values.dtype)
    residual = values
    # Five rounds, and weights that halve at two standard deviations: chosen.
    for _ in range(5):
        root = np.sqrt(weight)
        coefficients = np.linalg.lstsq(basis * root[:, None], values * root, rcond=None)[0]
        residual = values - basis @ coefficients
        # 1.48 turns the median of normal deviations into their standard deviation.
        spread = 1.48 * np.median(np.abs(residual))
        weight = weight / (1 + (np.abs(residual) / (2 * spread + 1e-9)) ** 2)
    return coefficients, residual


def learn_gains(metal: Voltages, wave_number: float) -> Gains:
    """Fit the gains to points of metal; if their directions span no more than `LEAST_SPAN_RAD`, one value for all.

    `wave_number` is that at the middle of the band, 1 / m.
    """
    coefficients = reflect_points(np.inf, metal, wave_number)
    gain = metal.voltage / predict_voltages(metal, coefficients)
    is_valid = np.asarray(np.isfinite(gain).all(axis=1) & (np.abs(gain) > 0).all(axis=1))
    metal = metal[is_valid]
    gain = gain[is_valid]
    ratio = gain[:, 0] / gain[:, 1]
    # No point counts as better than 1 % (chosen).
    weight = 1 / (np.sum((metal.std / np.abs(metal.voltage)) ** 2, axis=1) + 1e-4)
    middle = np.average(metal.arrival, axis=0, weights=weight)
    departure_middle = np.average(metal.departure, axis=0, weights=weight)
    # Few points of wrong directions do not widen the covered range.
    low, high = np.percentile(metal.arrival, [3, 97], axis=0)
    degree = DEGREE if float(np.min(high - low)) > LEAST_SPAN_RAD else 0
    basis = _evaluate_polynomials(metal.arrival - middle, degree)
    # Phases are taken about their mean, so that none wraps.
    centre = np.angle(np.sum(weight * ratio / np.abs(ratio)))
    log_ratio = np.log(np.abs(ratio)) + 1j * (np.angle(ratio * np.exp(-1j * centre)) + centre)
    ratio_terms, residual = _fit_robustly(basis, log_ratio, weight)
    departure_basis = _evaluate_polynomials(metal.departure - departure_middle, degree)
    level = np.log(np.abs(gain[:, 0]))
    level_terms = np.stack([_fit_robustly(terms, level, weight)[0] for terms in (basis, departure_basis)])
    # The next order of metal's own correction, r_p / r_s = 1 + first order.
    first_order = np.abs(coefficients[is_valid, 0, 1] / coefficients[is_valid, 0, 0] - 1)
    next_order = float(np.median(first_order * compute_expansion_parameter(metal, wave_number)))
    noise2 = np.sum((metal.std / np.abs(metal.voltage)) ** 2, axis=1)
    misfit_std, noise_std = _compute_misfit_std(residual, noise2, metal.at_m)
    std = float(np.hypot(np.sqrt(max(0.0, misfit_std**2 - noise_std**2)), next_order))
    # A cell is as wide as the direction changes while the stage moves by a block; a plate has one direction.
    rate = np.linalg.lstsq(metal.at_m - metal.at_m.mean(axis=0), metal.arrival - middle, rcond=None)[0]
    cell = BLOCK_M * np.linalg.norm(rate, axis=0) if degree else np.full(2, np.inf)
    block = number_blocks(metal.at_m, (0.0, 0.0))
    # Errors are independent from block to block: each block's shifts the terms by its column of the inverse.
    block_means = np.stack([np.bincount(block, term) / np.bincount(block) for term in basis.T], axis=1)
    return Gains(
        ratio_terms=ratio_terms,
        level_terms=level_terms,
        band_rise=np.median(metal.band_rise, axis=0),
        middle=middle,
        departure_middle=departure_middle,
        degree=degree,
        std=std,
        covered=(low, high),
        terms_root=np.asarray(np.hypot(misfit_std, next_order) * np.linalg.pinv(block_means), np.float64),
        cell=np.asarray(cell, np.float64),
    )


def _compute_misfit_std(residual: Complex, noise2: Array, at_m: Array) -> tuple[float, float]:
    """Return the standard deviation of each part of a fit's residuals, and its part by noise of variance `noise2` [n].

    It is the root mean square over blocks of the mean `residual` [n] in each block.
    """
    # Outliers count as five times the median (chosen).
    clipped = residual / np.maximum(1, np.abs(residual) / (5 * np.median(np.abs(residual)) + 1e-12))
    block = number_blocks(at_m, (0.0, 0.0))
    count = np.bincount(block)
    sums = np.bincount(block, clipped.real) + 1j * np.bincount(block, clipped.imag)
    variance = np.average(np.abs(sums / count) ** 2, weights=count) / 2
    noise_variance = np.average(np.bincount(block, noise2) / count**2, weights=count)
    return float(np.sqrt(variance)), float(np.sqrt(noise_variance))
