"""Gains of both receivers over direction, learnt from metal of known shape, and the voltages of points.

The measured voltages of H and V are products of the surface's reflection, the path, the spreading and the antennas'
gains. `find_voltages` removes path and spreading, and computes the rows by which a surface's reflection coefficients
become voltages for gains of 1 (`optics`). V sees a point from another stage position than H, some 15 mm away, under
another angle.

`learn_gains` compares such voltages of metal, whose coefficients are known, with those for gains of 1. A metal sphere
covers many directions; a flat plate gives one. The ratio of the gains of H and V depends on the direction of arrival
only, because TX cancels. The level of H depends on two directions: that of departure at TX and that of arrival. At the
distance of the reference one of these gives the other. At other distances it does not: the level is then the mean of
two estimates, by either direction, and its error is half their difference.
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
# Errors of points in different square blocks of stage offsets, with this side, count as independent: windows overlap,
# and ripples of edges and of other echoes are as long as a Fresnel zone (40 to 70 mm).
BLOCK_M = 2 * WINDOW_M


@dataclass(frozen=True)
class Voltages:
    """Voltages of n points, with the directions, angles and curvatures that they depend on.

    Attributes
    ----------
    voltage, std
        Voltages of H and V without path and spreading, complex [n, 2]; standard deviations of their real parts, and of
        their imaginary parts, [n, 2].
    response
        Factors of r_s, r_p, r_sp (s to p) and r_ps in the voltages, complex [n, 2 receivers, 4].
    theta
        Angles of incidence for H and V, [n, 2], radians. V's is some 0.1 degrees steeper, which changes r_p by some per
        cent near Brewster's angle.
    path_m
        Path from TX over the point to H and V, [n, 2].
    curvature_inside, curvature_across, twist
        The surface's curvatures in the plane of incidence and across it, and the twist between both, [n], 1 / m.
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
    curvature_inside: Array
    curvature_across: Array
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
    # H's stage offsets are those of its echoes. V's are those from which it sees the same points; its echoes, measured
    # close by, are moved there.
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
    curvature_inside, curvature_across, twist = resolve_curvature(*surface, seen.h.at_m, tx_m)
    return Voltages(
        voltage=np.stack(voltages, axis=1),
        std=np.stack(std, axis=1),
        response=np.stack(rows, axis=1),
        theta=np.stack(theta, axis=1),
        path_m=np.stack(paths, axis=1),
        curvature_inside=curvature_inside,
        curvature_across=curvature_across,
        twist=twist,
        arrival=arrival_leg[:, :2],
        departure=departure_leg[:, :2],
        band_rise=np.stack([seen.h.band_rise, seen.v.band_rise], axis=1),
        at_m=seen.h.at_m[:, :2],
    )


def reflect_points(eps: NDArray | complex, points: Voltages, wave_number: float) -> Complex:
    """Return the coefficients r_s, r_p, r_sp and r_ps of the curved surface at each point for H and V, [n, 2, 4]."""
    eps_of_receivers = np.asarray(eps)[..., None]
    r_s, r_p = reflect_curved(
        eps_of_receivers, points.theta, points.curvature_inside[:, None], points.curvature_across[:, None], wave_number
    )
    mixed = mix_twisted(eps_of_receivers, points.theta, points.twist[:, None], wave_number)
    # The antennas are near: a spherical wave is not reflected quite like a plane one.
    more_s, more_p = reflect_spherical(eps_of_receivers, points.theta, points.path_m, wave_number)
    return np.stack([r_s + more_s, r_p + more_p, mixed, mixed], axis=2)


def predict_voltages(points: Voltages, coefficients: Complex) -> Complex:
    """Return the voltages of H and V, [n, 2], for coefficients [n, 2, 4] and gains of 1."""
    return np.sum(points.response * coefficients, axis=2)


def compute_expansion_parameter(points: Voltages, wave_number: float) -> Array:
    """Return K / (k cos^3(theta)) of each point, [n]: the parameter of the expansion of reflection at a curved surface.

    Each order of the expansion is about this times the one before. K is the mean of both curvatures' magnitudes, k the
    wave number.
    """
    curvature = (np.abs(points.curvature_inside) + np.abs(points.curvature_across)) / 2
    return curvature / (wave_number * np.cos(points.theta[:, 0]) ** 3)


def number_blocks(at_m: Array, shift: tuple[float, float], block_m: float = BLOCK_M) -> NDArray[np.int_]:
    """Return the number of the block of each stage offset, [n]; `at_m` is [n, 2].

    `shift` moves the borders of the blocks in x and y, as a fraction of a block.
    """
    cell = np.floor(at_m / block_m + np.array(shift)).astype(int)
    _, number = np.unique(cell, axis=0, return_inverse=True)
    return number.reshape(-1)


# Degree of the gains' polynomials in the direction of arrival or departure, if the reference is a sphere; chosen.
DEGREE = 2
# A reference whose directions span no more than this, in radians, counts as a plate, which has one direction; chosen.
LEAST_SPAN_RAD = 0.1
# Standard deviation of the unknown change of ln(H / V) per radian from the one direction of a plate: two boards 20
# degrees apart with the pattern cos^2 differ by 0.7.
UNKNOWN_SLOPE = 0.7
# Factor of `UNKNOWN_SLOPE` outside the directions that a sphere covers. It is less than 1, because the polynomial that
# is fitted to a sphere continues the pattern. Chosen.
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
        Coefficients of ln|gain of H| as a polynomial of the direction of arrival, and as one of that of departure, [2,
        terms].
    band_rise
        ln of the level in the upper half of the band over that in the lower half, of H and V.
    middle, departure_middle, degree
        Mean directions of arrival and of departure, from which the polynomials start, [2]; their degree.
    std
        Standard deviation of the real part, and of the imaginary part, of ln(H / V) within the directions covered. It
        holds the misfit of the polynomial without the noise of the reference's points, and the next order of the
        expansion in the reference's curvature.
    covered
        Smallest and largest direction of arrival of the reference, [2] each.
    terms_root
        R [terms, blocks]: the real part of `ratio_terms`, and the imaginary part, has the covariance R R'.
    cell
        Size [2] of a cell of directions within which the misfit of the polynomial is the same.
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
        """Return the standard deviation of the level, [n]; it includes half the difference of both estimates."""
        level_by_arrival, level_by_departure = self._find_levels(points)
        return np.hypot(np.abs(level_by_arrival - level_by_departure) / 2, self.estimate_unknown_std(points.arrival))

    def _find_levels(self, points: Voltages) -> tuple[Array, Array]:
        """Return ln|gain of H| by the direction of arrival, and by that of departure, [n] each."""
        arrival_terms, departure_terms = self.level_terms
        departure = _evaluate_polynomials(points.departure - self.departure_middle, self.degree)
        return self._make_basis(points.arrival) @ arrival_terms, departure @ departure_terms

    def estimate_unknown_std(self, arrival: Array) -> Array:
        """Return the standard deviation of ln(H / V), [n]; it grows outside the directions that are covered."""
        return np.hypot(self.std, self._extrapolate_std(arrival))

    def _extrapolate_std(self, arrival: Array) -> Array:
        """Return the part of the standard deviation that grows outside the directions covered, [n]; 0 within them."""
        low, high = self.covered
        distance_beyond = np.linalg.norm(np.maximum(0, np.maximum(low - arrival, arrival - high)), axis=1)
        if self.degree == 0:
            return UNKNOWN_SLOPE * distance_beyond
        return SHARE_BEYOND_SPHERE * UNKNOWN_SLOPE * distance_beyond

    def list_errors(self, arrival: Array) -> Array:
        """Return independent errors of the real part of ln(H / V), one standard deviation each, [errors, n].

        Those of the imaginary part are the same. The misfit of the polynomial is one error per cell of directions: a
        wide object averages over it. Errors of the polynomial's terms are common to all directions, and so is the one
        outside the directions covered.
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
    """Return x^i y^j for all i + j <= degree, [n, terms], with x and y the columns of `directions` [n, 2]."""
    terms = [directions[:, 0] ** i * directions[:, 1] ** j for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.stack(terms, axis=1)


def _fit_robustly(basis: Array, values: NDArray, weight: Array) -> tuple[NDArray, NDArray]:
    """Return the coefficients [terms] of `values` [n] in `basis` [n, terms], and the residuals [n].

    Least squares with the weights `weight` [n], which are reduced for outliers.
    """
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
    """Fit the gains to points of metal.

    If their directions span no more than `LEAST_SPAN_RAD`, gains are the same in all directions. `wave_number` is that
    at the middle of the band, rad / m.
    """
    coefficients = reflect_points(np.inf, metal, wave_number)
    gain = metal.voltage / predict_voltages(metal, coefficients)
    is_valid = np.asarray(np.isfinite(gain).all(axis=1) & (np.abs(gain) > 0).all(axis=1))
    metal = metal[is_valid]
    gain = gain[is_valid]
    ratio = gain[:, 0] / gain[:, 1]
    # 1 / relative variance; the error of a point is at least 1 % (chosen).
    weight = 1 / (np.sum((metal.std / np.abs(metal.voltage)) ** 2, axis=1) + 1e-4)
    middle = np.average(metal.arrival, axis=0, weights=weight)
    departure_middle = np.average(metal.departure, axis=0, weights=weight)
    # Percentiles, so that a few points with wrong directions do not widen the covered range.
    low, high = np.percentile(metal.arrival, [3, 97], axis=0)
    degree = DEGREE if float(np.min(high - low)) > LEAST_SPAN_RAD else 0
    basis = _evaluate_polynomials(metal.arrival - middle, degree)
    # Phases are measured from their mean, so that none wraps.
    centre = np.angle(np.sum(weight * ratio / np.abs(ratio)))
    log_ratio = np.log(np.abs(ratio)) + 1j * (np.angle(ratio * np.exp(-1j * centre)) + centre)
    ratio_terms, residual = _fit_robustly(basis, log_ratio, weight)
    departure_basis = _evaluate_polynomials(metal.departure - departure_middle, degree)
    level = np.log(np.abs(gain[:, 0]))
    level_terms = np.stack([_fit_robustly(terms, level, weight)[0] for terms in (basis, departure_basis)])
    # The next order of the expansion for the metal's curvature, with r_p / r_s = 1 + first order.
    first_order = np.abs(coefficients[is_valid, 0, 1] / coefficients[is_valid, 0, 0] - 1)
    next_order = float(np.median(first_order * compute_expansion_parameter(metal, wave_number)))
    noise2 = np.sum((metal.std / np.abs(metal.voltage)) ** 2, axis=1)
    misfit_std, noise_std = _compute_misfit_std(residual, noise2, metal.at_m)
    std = float(np.hypot(np.sqrt(max(0.0, misfit_std**2 - noise_std**2)), next_order))
    # A cell is as wide as the direction changes while the stage moves by a block; a plate has one direction.
    rate = np.linalg.lstsq(metal.at_m - metal.at_m.mean(axis=0), metal.arrival - middle, rcond=None)[0]
    cell = BLOCK_M * np.linalg.norm(rate, axis=0) if degree else np.full(2, np.inf)
    block = number_blocks(metal.at_m, (0.0, 0.0))
    # Errors of blocks are independent: an error of one block changes the terms by its column of the pseudo-inverse.
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
    """Return the standard deviation of a fit's residuals averaged over blocks, and that which noise explains.

    Both are those of the real part, and of the imaginary part. `residual` [n] are the residuals, `noise2` [n] the
    variances of the points' noise, `at_m` [n, 2] their stage offsets.
    """
    # Outliers count as five times the median (chosen).
    clipped = residual / np.maximum(1, np.abs(residual) / (5 * np.median(np.abs(residual)) + 1e-12))
    block = number_blocks(at_m, (0.0, 0.0))
    count = np.bincount(block)
    sums = np.bincount(block, clipped.real) + 1j * np.bincount(block, clipped.imag)
    variance = np.average(np.abs(sums / count) ** 2, weights=count) / 2
    noise_variance = np.average(np.bincount(block, noise2) / count**2, weights=count)
    return float(np.sqrt(variance)), float(np.sqrt(noise_variance))
