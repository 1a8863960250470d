"""Fit of several echoes of a window together.

A *window* is a square patch of stage positions (`polysight.surfaces.window`). Its samples are, but for the
range gate, a sum of echoes e:

    s[rx, f, d] = sum over e of  a_e conj(steering_e[rx, f]) exp(j omega L_e(d))
    L_e(d) = L + g.d + d'Q d / 2 = sum over p of  B_p(d) v_p

* d: stage offset from the window's centre, m; omega = 2 pi f / c, rad / m.
* a: complex amplitude; L_e(d): path from TX over the object to the middle of the board's RX, m.
* v: the six values of a path: its length L, slopes g_x and g_y, and bends Q_xx, Q_xy and Q_yy (first and second
  derivatives of the path by d). B is their basis, see `find_basis`.
* steering: phase factors with which the samples of the RX add up in phase for this echo.

The fit seeks a and v of all echoes. Echoes of two objects 150 mm apart in x differ by one resolution cell in slope.
Fits of one echo after the other, each to the residual of the others, had errors of 6 mm and 3 dB after as many rounds
as time allowed. A fit of all echoes together is exact.

Echoes that a window hardly resolves make each other uncertain. The *widening* of a value is the ratio of its standard
error in the joint fit to that in a fit of its echo alone. It is at least 1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polysight.surfaces.window import (
    STEP_LIMITS,
    WINDOW_M,
    Array,
    BoardFit,
    Windows,
    add_rx,
    find_basis,
    make_waves,
    select_windows,
    synthesise,
    unpack_values,
)
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# Bend at which fits start, 1 / m; chosen. Convex bodies have bends between 0 (plane) and 2.3 / m (point).
START_BEND = 0.8
# The fit ends after MAX_STEPS steps, after a step that reduces the residual's energy by a smaller share than
# MIN_REDUCTION, or when the damping reaches MAX_DAMPING; all chosen.
MAX_STEPS = 14
MIN_REDUCTION = 3e-3
MAX_DAMPING = 10
# The steering is computed for the current paths, and again after the fit has changed them: in up to
# MAX_STEERING_ROUNDS rounds. A further round follows only if the energy of the residual is below MAX_ENERGY_LEFT of
# that after the round before; both chosen.
MAX_STEERING_ROUNDS = 4
MAX_ENERGY_LEFT = 0.9
# Two echoes count as one if the widening of an amplitude is larger than this. They then fit one echo twice, or the
# halves of a wave that reaches only a part of the window, as at the edge of a surface. Echoes of objects 150 mm apart
# in x have a widening of 1.4 and remain two; those 50 mm apart in range have 2.8 and do not. A plate of 200 mm keeps
# 524 surface points with a limit of 2, 488 with 3, and 120 with 12 (simulated).
MERGED_WIDENING = 2
# Index pairs p <= q of the six values of a path: the rest of a symmetric matrix follows from these.
PAIRS = np.triu_indices(6)
# Square of the widening of a value that the samples do not determine.
NO_INFORMATION = 1e12


class JointFit:
    """Paths and amplitudes of all echoes of some windows, by Levenberg's and Marquardt's method.

    Each echo has 8 unknowns, in this order: real and imaginary part of the amplitude a, and the six values v of its
    path. When a step changes v by dv, a is multiplied by exp(-j mean_rate.dv), so that the echo's mean phase over the
    window does not change.

    Attributes
    ----------
    values, amplitude
        float64 [window, echo, 6]: v of each echo; complex [window, echo]: a.
    residual
        complex64 [window, rx, frequency, position]: samples minus all echoes.
    """

    def __init__(self, fit: BoardFit, windows: Windows, values: Array, amplitude: NDArray) -> None:
        self.fit = fit
        self.windows = windows
        self.values = values.copy()
        self.amplitude = amplitude.astype(complex)
        # B [window, position, 6].
        self.basis = find_basis(windows.offsets)
        count = np.maximum(windows.valid.sum(axis=1), 1)
        mean_basis = np.einsum("wn,wnp->wp", windows.valid, self.basis) / count[:, None]
        # Derivatives of an echo's mean phase by v, [window, 6].
        self.mean_rate = fit.middle * mean_basis
        # `nu` [frequency] is the distance of `omega` from its weighted mean `middle`, rad / m. The fit uses 7 products
        # w_i of an echo's wave exp(j omega L_e(d)): the wave itself, and, but for a factor j a, its derivatives by v:
        #     w_0 = wave,   w_p = wave (omega B_p(d) - mean_rate_p)   for p = 1 to 6
        # All are linear in nu and in B:
        #     w_i = wave sum over q of  (steady[i, q] + nu changing[i, q]) B_q(d)
        self.nu = fit.omega - fit.middle
        # [window, 7, 6] and [7, 6]. B_1 is 1 everywhere: column 0 holds what does not depend on d.
        self.steady = np.zeros((len(mean_basis), 7, 6))
        self.steady[:, 0, 0] = 1
        self.steady[:, 1:] = fit.middle * np.eye(6)
        self.steady[:, 1:, 0] -= self.mean_rate
        self.changing = np.eye(7, 6, -1)
        # Products B_p B_q of `PAIRS`, [window, position, 21], and their sums over the positions, [window, 21].
        first, second = PAIRS
        self.products = windows.valid[..., None] * self.basis[..., first] * self.basis[..., second]
        self.product_sums = self.products.sum(axis=1)
        # [window, echo, rx, frequency], and exp(j omega L_e(d)) [window, echo, frequency, position].
        self.steering = np.zeros((*self.amplitude.shape, len(fit.rx_places_m), fit.omega.size), complex)
        self.waves = np.zeros((*self.amplitude.shape, fit.omega.size, self.basis.shape[1]), np.complex64)
        self.residual = windows.samples.copy()

    def run(self) -> None:
        """Fit in up to `MAX_STEERING_ROUNDS` rounds, each with the steering for the paths of the round before."""
        fitted_windows = np.arange(len(self.values))
        energy = np.full(len(self.values), np.inf)
        for _ in range(MAX_STEERING_ROUNDS):
            self.update_residual(fitted_windows)
            self._descend(fitted_windows)
            new_energy = find_energy(self.residual[fitted_windows])
            is_improving = new_energy < MAX_ENERGY_LEFT * energy[fitted_windows]
            fitted_windows = fitted_windows[is_improving]
            energy[fitted_windows] = new_energy[is_improving]
            # A single RX is not added to any other: there are no phases between RX to improve.
            if len(self.fit.rx_places_m) == 1 or not fitted_windows.size:
                break

    def update_residual(self, window_indices: NDArray) -> None:
        """Set steering, waves and residual of some windows for their current paths and amplitudes."""
        at_m = self.windows.at_m[window_indices]
        values = self.values[window_indices]
        for index in range(values.shape[1]):
            path, slope, _ = unpack_values(values[:, index])
            self.steering[window_indices, index] = self.fit.compute_steering(at_m, path, slope)
        waves, residual = self._compute_residual(window_indices, values, self.amplitude[window_indices])
        self.waves[window_indices] = waves
        self.residual[window_indices] = residual

    def synthesise(self, index: int) -> NDArray[np.complex64]:
        """Return the samples of one echo, [window, rx, frequency, position]."""
        echo = slice(index, index + 1)
        waves = self.waves[:, echo]
        return synthesise(self.fit, self.windows.valid, waves, self.amplitude[:, echo], self.steering[:, echo])

    def _compute_residual(
        self, window_indices: NDArray, values: Array, amplitude: NDArray
    ) -> tuple[NDArray, NDArray[np.complex64]]:
        """Return waves and residual of some windows for v [window, echo, 6] and a [window, echo] of their echoes."""
        waves = make_waves(self.fit, values @ np.swapaxes(self.basis[window_indices], 1, 2))
        valid = self.windows.valid[window_indices]
        echoes = synthesise(self.fit, valid, waves, amplitude, self.steering[window_indices])
        return waves, self.windows.samples[window_indices] - echoes

    def _descend(self, window_indices: NDArray) -> None:
        """Improve values and amplitudes of some windows by damped steps; the steering is not changed."""
        echoes = self.amplitude.shape[1]
        energy = np.zeros(len(self.residual))
        energy[window_indices] = find_energy(self.residual[window_indices])
        # Levenberg-Marquardt damping. Its start and its factors are chosen: 0.2 after a step that reduces the energy, 8
        # after one that does not.
        damping = np.full(len(self.residual), 1e-3)
        running = window_indices
        for _ in range(MAX_STEPS):
            normal, gradient = self._find_normal_equations(running)
            # Step = (N + damping diag(N))^-1 gradient. 1e-12 keeps the matrix invertible: an echo of amplitude 0, from
            # which `separate_merged_echoes` starts, has no derivatives by its path.
            diagonal = np.einsum("wii->wi", normal)
            added_diagonal = damping[running, None] * diagonal + 1e-12
            damped = normal + added_diagonal[:, :, None] * np.eye(8 * echoes)
            step = np.linalg.solve(damped, gradient[..., None])[..., 0].reshape(-1, echoes, 8)
            path_step = np.clip(step[..., 2:], -STEP_LIMITS, STEP_LIMITS)
            values = self.values[running] + path_step
            turn = np.exp(-1j * np.einsum("wep,wp->we", path_step, self.mean_rate[running]))
            amplitude = (self.amplitude[running] + step[..., 0] + 1j * step[..., 1]) * turn
            waves, residual = self._compute_residual(running, values, amplitude)
            new_energy = find_energy(residual)
            reduction = energy[running] - new_energy
            is_better = reduction > 0
            accepted = running[is_better]
            self.values[accepted] = values[is_better]
            self.amplitude[accepted] = amplitude[is_better]
            self.waves[accepted] = waves[is_better]
            self.residual[accepted] = residual[is_better]
            has_converged = is_better & (reduction < MIN_REDUCTION * energy[running])
            energy[accepted] = new_energy[is_better]
            damping[running] *= np.where(is_better, 0.2, 8)
            running = running[~has_converged & (damping[running] < MAX_DAMPING)]
            if not running.size:
                break

    def separate_merged_echoes(self) -> None:
        """Fit the windows again in which two echoes have merged.

        The paths of two merged echoes are nearly the same, and their amplitudes are large and of opposite sign. The two
        echoes with the largest widening are taken as these. Three further fits start with both half a resolution cell
        to either side of their mean: in L, in g_x, and in g_y. Of all four fits the one with the least residual energy
        is kept.
        """
        widening = self.find_widening()[..., 0]
        merged = np.flatnonzero(widening.max(axis=1) > MERGED_WIDENING)
        if not merged.size:
            return
        pair = np.argsort(-widening[merged], axis=1)[:, :2]
        rows = np.arange(merged.size)
        middle = (self.values[merged, pair[:, 0]] + self.values[merged, pair[:, 1]]) / 2
        middle[:, 3:] = [START_BEND, 0, START_BEND]
        merged_windows = select_windows(self.windows, merged)
        path_cell_m = SPEED_OF_LIGHT_M_S / np.ptp(self.fit.board.frequencies_hz)
        slope_cell = 2 * np.pi / self.fit.middle / WINDOW_M
        # The first three values are L, g_x and g_y.
        for value_index, cell in enumerate([path_cell_m, slope_cell, slope_cell]):
            values = self.values[merged]
            amplitude = self.amplitude[merged]
            for echo, side in zip(pair.T, (-0.5, 0.5), strict=True):
                start = middle.copy()
                start[:, value_index] += side * cell
                values[rows, echo] = start
                amplitude[rows, echo] = 0
            refit = JointFit(self.fit, merged_windows, values, amplitude)
            refit.run()
            is_better = find_energy(refit.residual) < find_energy(self.residual[merged])
            for name in ("values", "amplitude", "steering", "waves", "residual"):
                getattr(self, name)[merged[is_better]] = getattr(refit, name)[is_better]

    def _find_normal_equations(self, window_indices: NDArray) -> tuple[Array, Array]:
        """Return the normal matrix N [window, 8 echoes, 8 echoes], and the right side [window, 8 echoes].

        An echo's derivative by its unknown u is D[u, i] w_i, summed over i (`_find_derivatives`). With <a, b> the sum
        of conj(a) b over frequencies and positions, averaged over the RX, the block of N for the echoes e and f is
        Re(conj(D_e) <w_e, w_f> D_f'), and the right side of e is Re(conj(D_e) <w_e, residual>).
        """
        echoes = self.amplitude.shape[1]
        count = len(window_indices)
        normal = np.zeros((count, echoes, 8, echoes, 8))
        gradient = np.zeros((count, echoes, 8))
        derivatives = [self._find_derivatives(window_indices, index) for index in range(echoes)]
        for first in range(echoes):
            conjugate = derivatives[first].conj()
            projections = self._project_residual(window_indices, first)
            gradient[:, first] = np.einsum("wui,wi->wu", conjugate, projections).real
            for second in range(first, echoes):
                products = self._multiply_echoes(window_indices, first, second)
                block = (conjugate @ products @ np.swapaxes(derivatives[second], 1, 2)).real
                normal[:, first, :, second] = block
                normal[:, second, :, first] = np.swapaxes(block, 1, 2)
        return normal.reshape(count, 8 * echoes, 8 * echoes), gradient.reshape(count, 8 * echoes)

    def _find_derivatives(self, window_indices: NDArray, index: int) -> NDArray[np.complex128]:
        """Return D [window, 8, 7]: the coefficients of w_0 to w_6 in an echo's derivatives by its 8 unknowns."""
        derivatives = np.zeros((len(window_indices), 8, 7), complex)
        derivatives[:, 0, 0] = 1
        derivatives[:, 1, 0] = 1j
        derivatives[:, 2:, 1:] = 1j * self.amplitude[window_indices, index, None, None] * np.eye(6)
        return derivatives

    def _project_residual(self, window_indices: NDArray, index: int) -> NDArray[np.complex128]:
        """Return <w_i, residual> of one echo, [window, 7]."""
        factors = self.steering[window_indices, index] / len(self.fit.rx_places_m)
        added = add_rx(factors, self.residual[window_indices])
        # [window, frequency, position].
        turned_samples = self.waves[window_indices, index].conj() * added
        # Sums over the frequencies, weighted by 1 and by nu: [2, frequency] @ [window, frequency, position].
        sums_by_power = np.stack([np.ones_like(self.nu), self.nu]).astype(np.complex64) @ turned_samples
        # Sums over the positions, weighted by B: [window, 2, position] @ [window, position, 6].
        valid = self.windows.valid[window_indices, None]
        sums = _multiply_parts(sums_by_power * valid, self.basis[window_indices])
        steady = self.steady[window_indices]
        return np.einsum("wiq,wq->wi", steady, sums[:, 0]) + sums[:, 1] @ self.changing.T

    def _multiply_echoes(self, window_indices: NDArray, first: int, second: int) -> NDArray[np.complex128]:
        """Return <w_i of the first echo, w_k of the second one>, [window, 7, 7].

        With S = `steady` and C = `changing`, the sums M_n [window, 6, 6] give all products:

            M_n[p, q] = sum over f, d of  h(f) nu^n B_p(d) B_q(d) conj(first wave) (second wave)
            <w_i, w_k> = S M_0 S' + S M_1 C' + (S M_1 C')' + C M_2 C'

        h is the mean over the RX of the steering of both echoes, times the factor that the range gate leaves at f.
        """
        fit = self.fit
        # [window, frequency]
        steering = np.mean(self.steering[window_indices, first] * self.steering[window_indices, second].conj(), axis=1)
        # h nu^n [window, 3, frequency]; `weights * gain` is the factor of the range gate.
        factors = (steering * fit.weights * fit.gain)[:, None] * self.nu ** np.arange(3)[:, None]
        # M_n at the index pairs of `PAIRS`, [window, 3, 21]. The product of a wave with itself is 1.
        if first == second:
            sums = factors.sum(axis=2)[..., None] * self.product_sums[window_indices, None]
        else:
            turned_waves = self.waves[window_indices, first].conj() * self.waves[window_indices, second]
            sums = _multiply_parts(factors.astype(np.complex64) @ turned_waves, self.products[window_indices])
        moments = np.empty((len(window_indices), 3, 6, 6), complex)
        rows, columns = PAIRS
        moments[..., rows, columns] = sums
        moments[..., columns, rows] = sums
        steady = self.steady[window_indices]
        mixed = steady @ moments[:, 1] @ self.changing.T
        products = steady @ moments[:, 0] @ np.swapaxes(steady, 1, 2) + self.changing @ moments[:, 2] @ self.changing.T
        return (products + mixed + np.swapaxes(mixed, 1, 2)).astype(complex)

    def fit_amplitudes(self) -> Array:
        """Fit the amplitudes for given paths; return the widening of the first echo's amplitude, [window]."""
        all_windows = np.arange(len(self.values))
        echoes = self.amplitude.shape[1]
        self.update_residual(all_windows)
        # Products of the waves of any two echoes, [window, echo, echo].
        gram = np.empty((len(all_windows), echoes, echoes), complex)
        for first in range(echoes):
            for second in range(echoes):
                gram[:, first, second] = self._multiply_echoes(all_windows, first, second)[:, 0, 0]
        # A small diagonal, so that the amplitudes of echoes that coincide can be solved.
        gram += 1e-6 * np.einsum("wii->w", gram).real[:, None, None] * np.eye(echoes)
        # Two rounds: `synthesise` filters an echo by the range gate exactly, `gram` only by one factor per frequency.
        for _ in range(2):
            right = np.stack([self._project_residual(all_windows, index)[:, 0] for index in range(echoes)], axis=1)
            self.amplitude = self.amplitude + np.linalg.solve(gram, right[..., None])[..., 0]
            self.waves, self.residual = self._compute_residual(all_windows, self.values, self.amplitude)
        return np.sqrt(np.maximum(1, (np.linalg.inv(gram)[:, 0, 0] * gram[:, 0, 0]).real))

    def find_widening(self) -> Array:
        """Return the widening of the amplitude and of the six values of the path, [window, echo, 7]."""
        count, echoes = self.amplitude.shape
        normal, _ = self._find_normal_equations(np.arange(count))
        # Scaled to a diagonal of ones, which leaves ratios of variances the same. The small constants keep a matrix
        # invertible in which an unknown has no effect, or two echoes coincide.
        scale = np.sqrt(np.einsum("wii->wi", normal) + 1e-30)
        scaled = normal / scale[:, :, None] / scale[:, None, :] + 1e-9 * np.eye(8 * echoes)
        joint_variance = np.einsum("wii->wi", np.linalg.inv(scaled)).reshape(count, echoes, 8)
        widening = np.empty((count, echoes, 7))
        for index in range(echoes):
            unknowns = slice(8 * index, 8 * index + 8)
            single_variance = np.einsum("wii->wi", np.linalg.inv(scaled[:, unknowns, unknowns]))
            ratio = joint_variance[:, index] / single_variance
            # Rounding can make the inverse of a nearly singular matrix negative: the value is then not determined.
            is_positive = (joint_variance[:, index] > 0) & (single_variance > 0)
            ratio = np.where(is_positive, ratio, NO_INFORMATION)
            widening[:, index, 0] = np.sqrt(ratio[:, :2].max(axis=1))
            widening[:, index, 1:] = np.sqrt(ratio[:, 2:])
        return np.maximum(widening, 1)


def _multiply_parts(values: NDArray[np.complexfloating], matrices: Array) -> NDArray[np.complex128]:
    """Products [window, row, column] of complex values [window, row, position] with real [window, position, column]."""
    rows = values.shape[1]
    parts = np.concatenate([np.real(values), np.imag(values)], axis=1) @ matrices
    return parts[:, :rows] + 1j * parts[:, rows:]


def find_energy(samples: NDArray[np.complexfloating]) -> Array:
    """Return the sum of |samples|^2 of each window, [window]; `samples` are [window, rx, frequency, position]."""
    # Real and imaginary parts as neighbours on the last axis, [window, rx, frequency, 2 positions]. The product of each
    # row [1, 2 positions] with itself as a column, [2 positions, 1], is its sum of squares.
    parts = np.ascontiguousarray(samples).view(samples.real.dtype)
    squares = parts[..., None, :] @ parts[..., None]
    return squares.sum(axis=(1, 2, 3, 4), dtype=float)
