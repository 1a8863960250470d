"""Fit of several echoes of a window together.

Echoes of two objects 150 mm apart in x are one resolution cell apart in slope (the derivative of the path with respect
to the stage offset). Fits of one echo after the other, each to the residual of the others, had errors of 6 mm and 3 dB
after as many rounds as time allowed. A fit of all echoes together is exact.

Echoes that a window hardly resolves make each other uncertain. The *widening* of a value is its standard error in the
joint fit over that in a fit of its echo alone; 1 at least.
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

# Curvature Q at which fits start, 1 / m. That of a convex body's path is between 0 (plane) and 2.3 / m (point).
START_BEND = 0.8
# Largest number of steps of the fit; the fit ends if a step reduces the residual's energy by less than the share
# JOINT_GAIN, or if the damping reaches MOST_DAMPING; all chosen.
JOINT_ITERATIONS = 14
JOINT_GAIN = 3e-3
MOST_DAMPING = 10
# The RX are added with phases for the current paths (`steering`). Largest number of rounds with new phases; another
# round follows only if the last one left less than the share STEERING_GAIN of the residual's energy; chosen.
STEERING_ROUNDS = 4
STEERING_GAIN = 0.9
# Widening of the amplitude above which two fitted echoes are a single one, or two halves of a wave that an edge cuts.
# Echoes 150 mm apart in x have 1.4, 50 mm apart in range 2.8. A plate of 200 mm keeps 524 points with a limit of
# 2, 488 with 3, and 120 with 12 (simulated).
MERGED_WIDENING = 2
# Pairs of the six values of a path, each once.
PAIRS = np.triu_indices(6)
# Square of the widening of a value that the samples do not determine.
NO_INFORMATION = 1e12


class JointFit:
    """Paths and amplitudes of all echoes of some windows, by Levenberg's and Marquardt's method.

    Each echo has 8 unknowns: real and imaginary part of the amplitude, and the six values of its path: length L (m),
    slopes g_x and g_y, curvatures Q_xx, Q_xy and Q_yy (1 / m), see `find_basis`. A step of the path turns the amplitude
    so that the mean phase stays.

    Attributes
    ----------
    values, amplitude
        float64 [window, echo, 6]: the six values of each path; complex [window, echo]: the amplitudes.
    rest
        complex64 [window, rx, frequency, position]: samples minus all echoes.
    """

    def __init__(self, fit: BoardFit, windows: Windows, values: Array, amplitude: NDArray) -> None:
        self.fit = fit
        self.windows = windows
        self.values = values.copy()
        self.amplitude = amplitude.astype(complex)
        # [window, position, 6]: derivatives of the path at each position with respect to its six values.
        self.basis = find_basis(windows.offsets)
        count = np.maximum(windows.valid.sum(axis=1), 1)
        mean_basis = np.einsum("wn,wnp->wp", windows.valid, self.basis) / count[:, None]
        # Derivative of an echo's mean phase with respect to the six values of its path.
        self.mean_rate = fit.middle * mean_basis
        # An echo's wave (row 0) and its derivatives by the six values (rows 1 to 6) are the wave times (steady + nu
        # changing) in the basis, [window, 7, 6] and [7, 6]; `_find_directions` gives the derivatives their factor j.
        # `nu` [frequency] is the distance of `omega` (2 pi f / c, rad / m) from its mean, `middle`.
        self.nu = fit.omega - fit.middle
        self.steady = np.zeros((len(mean_basis), 7, 6))
        self.steady[:, 0, 0] = 1
        self.steady[:, 1:] = fit.middle * np.eye(6)
        self.steady[:, 1:, 0] -= self.mean_rate
        self.changing = np.eye(7, 6, -1)
        # Products of the basis, those with p <= q, [window, position, 21], and their sums over the positions.
        first, second = PAIRS
        self.products = windows.valid[..., None] * self.basis[..., first] * self.basis[..., second]
        self.product_sums = self.products.sum(axis=1)
        # Phase factors with which the RX add in phase, [window, echo, rx, frequency], and waves of amplitude 1,
        # [window, echo, frequency, position]. `lever` [rx, 3] are the places of the RX.
        self.steering = np.zeros((*self.amplitude.shape, len(fit.lever), fit.omega.size), complex)
        self.waves = np.zeros((*self.amplitude.shape, fit.omega.size, self.basis.shape[1]), np.complex64)
        self.rest = windows.samples.copy()

    def run(self) -> None:
        """Fit in up to `STEERING_ROUNDS` rounds, each with the RX added for the paths of the round before."""
        members = np.arange(len(self.values))
        energy = np.full(len(self.values), np.inf)
        for _ in range(STEERING_ROUNDS):
            self.subtract(members)
            self._descend(members)
            new_energy = find_energy(self.rest[members])
            members = members[new_energy < STEERING_GAIN * energy[members]]
            energy[members] = find_energy(self.rest[members])
            # One RX is added to nothing: no phases to improve.
            if len(self.fit.lever) == 1 or not members.size:
                break

    def subtract(self, members: NDArray) -> None:
        """Set the phases of the RX of windows `members` for the current paths, and subtract the echoes from samples."""
        for index in range(self.values.shape[1]):
            path, slope, _ = unpack_values(self.values[members, index])
            self.steering[members, index] = self.fit.compute_steering(self.windows.at_m[members], path, slope)
        self.waves[members], self.rest[members] = self._subtract(members, self.values[members], self.amplitude[members])

    def synthesise(self, index: int) -> NDArray[np.complex64]:
        """Return the samples of one echo, [window, rx, frequency, position]."""
        echo = slice(index, index + 1)
        waves = self.waves[:, echo]
        return synthesise(self.fit, self.windows.valid, waves, self.amplitude[:, echo], self.steering[:, echo])

    def _subtract(self, members: NDArray, values: Array, amplitude: NDArray) -> tuple[NDArray, NDArray[np.complex64]]:
        """Return the waves of echoes of given values [window, echo, 6], and the samples of the windows less these."""
        waves = make_waves(self.fit, values @ np.swapaxes(self.basis[members], 1, 2))
        echoes = synthesise(self.fit, self.windows.valid[members], waves, amplitude, self.steering[members])
        return waves, self.windows.samples[members] - echoes

    def _descend(self, members: NDArray) -> None:
        """Improve values and amplitudes of windows `members` by damped steps; the phases of the RX stay."""
        echoes = self.amplitude.shape[1]
        energy = np.zeros(len(self.rest))
        energy[members] = find_energy(self.rest[members])
        # Levenberg-Marquardt damping. Its start and its factors are chosen: 0.2 after a step that reduces the energy, 8
        # after one that does not.
        damping = np.full(len(self.rest), 1e-3)
        running = members
        for _ in range(JOINT_ITERATIONS):
            normal, gradient = self._find_normal_equations(running)
            diagonal = np.einsum("wii->wi", normal)
            damped = normal + (damping[running, None] * diagonal + 1e-12)[:, :, None] * np.eye(8 * echoes)
            step = np.linalg.solve(damped, gradient[..., None])[..., 0].reshape(-1, echoes, 8)
            path_step = np.clip(step[..., 2:], -STEP_LIMITS, STEP_LIMITS)
            values = self.values[running] + path_step
            turn = np.exp(-1j * np.einsum("wep,wp->we", path_step, self.mean_rate[running]))
            amplitude = (self.amplitude[running] + step[..., 0] + 1j * step[..., 1]) * turn
            waves, residual = self._subtract(running, values, amplitude)
            new_energy = find_energy(residual)
            gain = energy[running] - new_energy
            better = gain > 0
            accepted = running[better]
            self.values[accepted] = values[better]
            self.amplitude[accepted] = amplitude[better]
            self.waves[accepted] = waves[better]
            self.rest[accepted] = residual[better]
            has_converged = better & (gain < JOINT_GAIN * energy[running])
            energy[accepted] = new_energy[better]
            damping[running] *= np.where(better, 0.2, 8)
            running = running[~has_converged & (damping[running] < MOST_DAMPING)]
            if not running.size:
                break

    def part_merged_echoes(self) -> None:
        """Fit windows again in which two echoes have the same path: they are large then, and of opposite sign.

        The two echoes with the largest widening start half a resolution cell to either side of their mean: one fit
        apart in path, one in g_x, one in g_y. The fit that leaves the least energy is kept, the first one included.
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
        for parameter, cell in enumerate([path_cell_m, slope_cell, slope_cell]):
            values = self.values[merged]
            amplitude = self.amplitude[merged]
            for echo, side in zip(pair.T, (-0.5, 0.5), strict=True):
                start = middle.copy()
                start[:, parameter] += side * cell
                values[rows, echo] = start
                amplitude[rows, echo] = 0
            refit = JointFit(self.fit, merged_windows, values, amplitude)
            refit.run()
            better = find_energy(refit.rest) < find_energy(self.rest[merged])
            for name in ("values", "amplitude", "steering", "waves", "rest"):
                getattr(self, name)[merged[better]] = getattr(refit, name)[better]

    def _find_normal_equations(self, members: NDArray) -> tuple[Array, Array]:
        """Return the normal matrix, [window, 8 echoes, 8 echoes], and its right side.

        Of an echo's 8 unknowns the two parts of the amplitude come first.
        """
        echoes = self.amplitude.shape[1]
        count = len(members)
        normal = np.zeros((count, echoes, 8, echoes, 8))
        gradient = np.zeros((count, echoes, 8))
        directions = [self._find_directions(members, index) for index in range(echoes)]
        for first in range(echoes):
            conjugate = directions[first].conj()
            gradient[:, first] = np.einsum("wip,wp->wi", conjugate, self._project(members, first)).real
            for second in range(first, echoes):
                products = self._multiply(members, first, second)
                block = (conjugate @ products @ np.swapaxes(directions[second], 1, 2)).real
                normal[:, first, :, second] = block
                normal[:, second, :, first] = np.swapaxes(block, 1, 2)
        return normal.reshape(count, 8 * echoes, 8 * echoes), gradient.reshape(count, 8 * echoes)

    def _find_directions(self, members: NDArray, index: int) -> NDArray[np.complex128]:
        """Return an echo's derivatives by its 8 unknowns, as factors of its wave and 6 derivatives: [window, 8, 7]."""
        directions = np.zeros((len(members), 8, 7), complex)
        directions[:, 0, 0] = 1
        directions[:, 1, 0] = 1j
        directions[:, 2:, 1:] = 1j * self.amplitude[members, index, None, None] * np.eye(6)
        return directions

    def _project(self, members: NDArray, index: int) -> NDArray[np.complex128]:
        """Return the products of an echo's wave, and of its 6 derivatives, with the residual `rest`, [window, 7]."""
        added = add_rx(self.steering[members, index] / len(self.fit.lever), self.rest[members])
        turned_samples = self.waves[members, index].conj() * added
        # Sums over the frequencies with the powers 0 and 1 of nu, [window, 2, position].
        sums_by_power = np.stack([np.ones_like(self.nu), self.nu]).astype(np.complex64) @ turned_samples
        sums = _multiply_parts(sums_by_power * self.windows.valid[members, None], self.basis[members])
        return np.einsum("wpb,wb->wp", self.steady[members], sums[:, 0]) + sums[:, 1] @ self.changing.T

    def _multiply(self, members: NDArray, first: int, second: int) -> NDArray[np.complex128]:
        """Return the products of wave and 6 derivatives of one echo with those of another: [window, 7, 7]."""
        # Sums over the frequencies with the powers 0, 1 and 2 of nu, and over the positions with the products of the
        # basis, give all products of the waves' derivatives: each is linear in nu and in the basis.
        fit = self.fit
        steering = np.mean(self.steering[members, first] * self.steering[members, second].conj(), axis=1)
        # `weights` are the shares of the frequencies, `gain` is their sum before they were made shares.
        factors = (steering * fit.weights * fit.gain)[:, None] * self.nu ** np.arange(3)[:, None]
        if first == second:
            sums = factors.sum(axis=2)[..., None] * self.product_sums[members, None]
        else:
            turned_waves = self.waves[members, first].conj() * self.waves[members, second]
            sums = _multiply_parts(factors.astype(np.complex64) @ turned_waves, self.products[members])
        grams = np.empty((len(members), 3, 6, 6), complex)
        rows, columns = PAIRS
        grams[..., rows, columns] = sums
        grams[..., columns, rows] = sums
        steady = self.steady[members]
        mixed = steady @ grams[:, 1] @ self.changing.T
        products = steady @ grams[:, 0] @ np.swapaxes(steady, 1, 2) + self.changing @ grams[:, 2] @ self.changing.T
        return (products + mixed + np.swapaxes(mixed, 1, 2)).astype(complex)

    def fit_amplitudes(self) -> Array:
        """Fit the amplitudes for given paths; return the widening of the first echo's amplitude, [window]."""
        members = np.arange(len(self.values))
        echoes = self.amplitude.shape[1]
        self.subtract(members)
        gram = np.empty((len(members), echoes, echoes), complex)
        for first in range(echoes):
            for second in range(echoes):
                gram[:, first, second] = self._multiply(members, first, second)[:, 0, 0]
        # A small diagonal, so that the amplitudes of echoes that coincide can be solved.
        gram += 1e-6 * np.einsum("wii->w", gram).real[:, None, None] * np.eye(echoes)
        # Two rounds, as the matrix holds the range gate's effect on an echo only approximately, by its weights.
        for _ in range(2):
            right = np.stack([self._project(members, index)[:, 0] for index in range(echoes)], axis=1)
            self.amplitude = self.amplitude + np.linalg.solve(gram, right[..., None])[..., 0]
            self.waves, self.rest = self._subtract(members, self.values, self.amplitude)
        return np.sqrt(np.maximum(1, (np.linalg.inv(gram)[:, 0, 0] * gram[:, 0, 0]).real))

    def find_widening(self) -> Array:
        """Return the widening of the amplitude and of the six values of the path, [window, echo, 7]."""
        count, echoes = self.amplitude.shape
        normal, _ = self._find_normal_equations(np.arange(count))
        scale = np.sqrt(np.einsum("wii->wi", normal) + 1e-30)
        scaled = normal / scale[:, :, None] / scale[:, None, :] + 1e-9 * np.eye(8 * echoes)
        together = np.einsum("wii->wi", np.linalg.inv(scaled)).reshape(count, echoes, 8)
        widening = np.empty((count, echoes, 7))
        for index in range(echoes):
            unknowns = slice(8 * index, 8 * index + 8)
            inverse_diagonal = np.einsum("wii->wi", np.linalg.inv(scaled[:, unknowns, unknowns]))
            ratio = together[:, index] / inverse_diagonal
            # Rounding can make the inverse of a nearly singular matrix negative: the value is then not determined.
            ratio = np.where((together[:, index] > 0) & (inverse_diagonal > 0), ratio, NO_INFORMATION)
            widening[:, index, 0] = np.sqrt(ratio[:, :2].max(axis=1))
            widening[:, index, 1:] = np.sqrt(ratio[:, 2:])
        return np.maximum(widening, 1)


def _multiply_parts(values: NDArray[np.complexfloating], matrices: Array) -> NDArray[np.complex128]:
    """Products [window, row, column] of complex values [window, row, position] with real [window, position, column]."""
    rows = values.shape[1]
    parts = np.concatenate([np.real(values), np.imag(values)], axis=1) @ matrices
    return parts[:, :rows] + 1j * parts[:, rows:]


def find_energy(samples: NDArray[np.complexfloating]) -> Array:
    """Return the energy of the samples [window, rx, frequency, position] of each window, [window]."""
    # Real and imaginary parts side by side; each row times itself is the sum of its squares.
    parts = np.ascontiguousarray(samples).view(samples.real.dtype)
    return (parts[..., None, :] @ parts[..., None]).sum(axis=(1, 2, 3, 4), dtype=float)
