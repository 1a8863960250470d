"""Samples of a board, and the fit of one echo's path in windows of stage positions.

A *window* is a square patch of stage positions, 34 mm wide. In it the path of an echo, from TX over the object to the
middle of the board's RX, is

    L(d) = L + g.d + d'Q d / 2 = sum over p of  B_p(d) v_p

* d: stage offset from the window's centre, m.
* v = (L, g_x, g_y, Q_xx, Q_xy, Q_yy): the path's length, its slopes and its *bends* (1 / m). Bends are the second
  derivatives of the path; *curvature* is that of the object's surface.

`add_up` adds up the samples of a window's RX in phase for the direction from which the echo comes (*steering*). Then
`maximise` fits v and the complex amplitude by the matched filter: v maximises the magnitude of the sum of
conj(exp(j omega L(d))) times the added samples, over positions and frequencies, with omega = 2 pi f / c.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from polysight.surfaces.points import compute_unit_legs, find_specular_points
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# Side of a window. Chosen: a larger one resolves echoes better and averages more, but in it the path over a curved
# surface is no longer a parabola.
WINDOW_M = 0.034
# Steps of Newton's method that reach the maximum from a start of the coarse search.
ITERATIONS = 7
# Number of positions that is enough to find out whether a window's echoes are separate. All positions of a window are
# 289 if the stage's steps are 2 mm.
THINNED_POSITIONS = 48
# Largest change of the six values in one step of a fit: length (m), slopes, bends (1 / m); chosen.
STEP_LIMITS = np.array([0.02, 0.05, 0.05, 1.5, 1.5, 1.5])

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Samples:
    """Samples of a receiving board, direct path removed, as after synchronisation.

    Attributes
    ----------
    cube
        complex [rx, frequency, row, column]: an echo of path L and amplitude a is a exp(+2 pi j f (L - direct) / c),
        changed by the range gate (`model`).
    valid
        bool [row, column]: False where a position has no data.
    offsets_m
        float64 [row, column, 3]: stage offsets.
    frequencies_hz
        float64 [frequency], evenly spaced.
    tx_m, rx_m
        Antennas at stage offset zero, [3] and [rx, 3].
    model
        complex [frequency, frequency]: the range gate multiplies the frequencies of an echo by this matrix; None
        without a gate.
    board_middle_m
        Mean place of all RX of the board, [3]; None if `rx_m` holds all of them.
    """

    cube: NDArray[np.complexfloating]
    valid: NDArray[np.bool_]
    offsets_m: Array
    frequencies_hz: Array
    tx_m: Array
    rx_m: Array
    model: NDArray[np.complex128] | None = None
    board_middle_m: Array | None = None

    @property
    def middle_m(self) -> Array:
        """Mean place of the board's RX [3], metres: echoes are given as if received there."""
        return self.rx_m.mean(axis=0) if self.board_middle_m is None else self.board_middle_m

    @property
    def direct_m(self) -> Array:
        """Direct path from TX to each RX, [rx], metres."""
        return np.linalg.norm(self.rx_m - self.tx_m, axis=1)

    def window_shape(self) -> tuple[int, int]:
        """Return the rows and columns of a window."""
        y = self.offsets_m[:, 0, 1]
        x = self.offsets_m[0, :, 0]
        steps = [abs(axis[-1] - axis[0]) / max(1, axis.size - 1) for axis in (y, x)]
        # At least five positions a side (chosen): fewer would not carry the six values and a plane of the amplitude.
        rows, columns = (max(5, round(WINDOW_M / step)) for step in steps)
        return min(rows, y.size), min(columns, x.size)


@dataclass(frozen=True)
class Echoes:
    """Echoes of n points.

    Attributes
    ----------
    at_m
        Stage offset at which path, slope, bend and amplitude are given, [n, 3], metres.
    path_m, slope, bend
        Path from TX over the point to the middle of the RX, [n], metres; its first derivatives with respect to the
        stage offset, [n, 2]; its second derivatives, [n, 2, 2], 1 / m.
    amplitude
        complex [n]. It includes the phase factor exp(-j k path), k the wave number at the middle of the band.
    amplitude_std
        Standard deviation of the real part, and of the imaginary part, of `amplitude`, [n].
    path_std_m, slope_std
        Standard deviations of `path_m` [n] and `slope` [n, 2] by the residual of the fit.
    share
        Power of the echo as a share of the window's power without its other echoes, [n].
    band_rise
        ln of the amplitude in the upper half of the band over that in the lower half, [n].
    """

    at_m: Array
    path_m: Array
    slope: Array
    bend: Array
    amplitude: NDArray[np.complex128]
    amplitude_std: Array
    path_std_m: Array
    slope_std: Array
    share: Array
    band_rise: Array

    def __len__(self) -> int:
        return len(self.path_m)

    def __getitem__(self, keep: NDArray) -> Echoes:
        return Echoes(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})

    @staticmethod
    def join(parts: list[Echoes]) -> Echoes:
        """Return all echoes of several parts."""
        return Echoes(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Echoes)})

    def move(self, at_m: Array, wave_number: float) -> Echoes:
        """Return the echoes at other stage offsets [n, 3] near by: path, slope and phase follow the fitted path.

        `wave_number`: at the middle of the band, rad / m.
        """
        d = (at_m - self.at_m)[:, :2]
        rise = np.einsum("np,np->n", self.slope, d) + np.einsum("np,npq,nq->n", d, self.bend, d) / 2
        return replace(
            self,
            at_m=at_m,
            path_m=self.path_m + rise,
            slope=self.slope + np.einsum("npq,nq->np", self.bend, d),
            amplitude=self.amplitude * np.exp(-1j * wave_number * rise),
        )


@dataclass
class Windows:
    """Samples of some windows."""

    # [window, rx, frequency, position].
    samples: NDArray[np.complex64]
    # 1 where a position has data, else 0: [window, position].
    valid: Array
    # d: stage offsets from `at_m`, metres, [window, position, 2].
    offsets: Array
    # Stage offsets for which echoes are given, metres, [window, 3]: the windows' centres, or places near by.
    at_m: Array


class BoardFit:
    """The matched filter of one board.

    Attributes
    ----------
    board
        Its samples.
    omega
        float64 [frequency]: 2 pi f / c, the phase per metre of path, radians per metre.
    rx_places_m
        float64 [rx, 3]: places of the RX relative to the mean of the board's, metres.
    model
        [frequency, frequency]: effect of the range gate on an echo; the identity without a gate.
    gain, weights
        The range gate multiplies an echo at each frequency by a factor, on average over paths. `gain` is the sum of
        these factors, and `weights` [frequency] are the factors over `gain`.
    middle, mean_square
        Means of `omega` and of its square, weighted by `weights`.
    upper_half, band_rise
        bool [frequency], True in the upper half of the band; ln of the factors' sum there over that in the lower half.
    """

    def __init__(self, board: Samples) -> None:
        self.board = board
        self.omega = 2 * np.pi * board.frequencies_hz / SPEED_OF_LIGHT_M_S
        self.rx_places_m = board.rx_m - board.middle_m
        # Paths over which the effect of the range gate is averaged; 24 of them are enough (chosen).
        if board.model is None:
            model = np.eye(self.omega.size)
            # Any paths will do: without a gate all factors are 1.
            excess_m = np.linspace(0.05, 0.6, 24)
        else:
            model = board.model
            excess_m = np.linspace(*_find_gate(board), 24)
        # [frequency, path]
        unit_echoes = np.exp(1j * np.outer(self.omega, excess_m))
        weights = np.mean((model @ unit_echoes) * unit_echoes.conj(), axis=1).real
        self.gain = float(weights.sum())
        self.upper_half = np.arange(weights.size) >= weights.size // 2
        self.band_rise = float(np.log(weights[self.upper_half].sum() / weights[~self.upper_half].sum()))
        self.weights = weights / self.gain
        self.middle = float(self.weights @ self.omega)
        self.mean_square = float(self.weights @ self.omega**2)
        self.model = model

    def compute_steering(self, offsets: Array, path_m: Array, slope: Array) -> NDArray[np.complex128]:
        """Return the phase factors [window, rx, frequency] with which the RX add up in phase for given echoes.

        There is one echo per window: `offsets` [window, 3] are the stage offsets and `path_m` [window] the paths there,
        metres; `slope` is [window, 2].
        """
        board = self.board
        points = find_specular_points(path_m, slope, offsets, board.tx_m, board.middle_m)
        _, back, *_ = compute_unit_legs(points, offsets, board.tx_m, board.middle_m)
        # `back` points from the RX to the echo's point: an RX displaced that way has a shorter path. [window, rx].
        excess = -back @ self.rx_places_m.T - board.direct_m
        return np.exp(-1j * excess[:, :, None] * self.omega)


def _find_gate(board: Samples) -> tuple[float, float]:
    """Return the smallest and largest excess path over which the gate's effect is averaged, metres.

    They are a fifth of the unambiguous range apart. An excess path is a path less the direct one.
    """
    reach = SPEED_OF_LIGHT_M_S / (board.frequencies_hz[1] - board.frequencies_hz[0])
    # Objects are taken to have the path of a mirror at 0.5 m, about the published rig's object plane (chosen).
    centre = find_mirror_path(board, 0.5) - board.direct_m.mean()
    return centre - reach / 10, centre + reach / 10


def find_mirror_path(board: Samples, z_m: float) -> float:
    """Return the path from TX over a mirror in the plane z = `z_m` of the rig frame to the middle of the RX, metres."""
    mirrored_tx = board.tx_m * [1, 1, -1] + [0, 0, 2 * z_m]
    return float(np.linalg.norm(board.middle_m - mirrored_tx))


def find_basis(offsets: Array) -> Array:
    """Return B = (1, x, y, x^2 / 2, x y, y^2 / 2), [window, position, 6], at d = `offsets` [window, position, 2].

    B_p is the derivative of the path by its value v_p.
    """
    x = offsets[..., 0]
    y = offsets[..., 1]
    return np.stack([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2], axis=-1)


def pack_values(path_m: Array, slope: Array, bend: Array) -> Array:
    """Stack paths [n], slopes [n, 2] and bends [n, 2, 2] as values [n, 6]."""
    return np.stack([path_m, *slope.T, bend[:, 0, 0], bend[:, 0, 1], bend[:, 1, 1]], axis=1)


def unpack_values(values: Array) -> tuple[Array, Array, Array]:
    """Return paths [n], slopes [n, 2] and bends [n, 2, 2] of values [n, 6]."""
    bend = np.stack([values[:, [3, 4]], values[:, [4, 5]]], axis=1)
    return values[:, 0], values[:, 1:3], bend


@dataclass
class Maximum:
    """Result of :func:`maximise`, one echo per window.

    `values` [window, 6] are v, `std` [window, 6] their standard deviations. `amplitude` [window] is without the phase
    of the path, which the matched filter removes; `amplitude_std` [window] is the standard deviation of its real part,
    and of its imaginary part. `share` and `band_rise` [window] are those of :class:`Echoes`.
    """

    values: Array
    amplitude: NDArray[np.complex128]
    amplitude_std: Array
    std: Array
    share: Array
    band_rise: Array


def maximise(
    fit: BoardFit, added: NDArray, valid: Array, offsets: Array, values: Array, *, iterations: int = ITERATIONS
) -> Maximum:
    """Fit one echo per window by the matched filter, with Newton's method from the start `values` [window, 6].

    `added` [window, frequency, position] are the samples of `add_up`; `valid` [window, position] and `offsets`
    [window, position, 2] are those of :class:`Windows`. With `iterations` = 0 the values are not changed, and only the
    amplitude is measured.
    """
    # ln |total| is maximised, total = sum of conj(wave) added over frequencies and positions. Its expected second
    # derivative by v is -C, with C the covariance of omega B_p over frequencies and positions:
    #     C_pq = mean(omega^2) mean(B_p B_q) - mean(omega)^2 mean(B_p) mean(B_q)
    # It is scaled to a diagonal of ones, for the values differ by orders of magnitude; the small terms here and below
    # only keep matrices invertible and divisors from zero.
    basis = find_basis(offsets)
    count = np.maximum(valid.sum(axis=1), 1)
    weighted = valid[:, :, None] * basis
    mean = weighted.sum(axis=1) / count[:, None]
    square = np.einsum("wnp,wnq->wpq", weighted, basis) / count[:, None, None]
    curvature = fit.mean_square * square - fit.middle**2 * np.einsum("wp,wq->wpq", mean, mean)
    scale = np.sqrt(np.einsum("wpp->wp", curvature) + 1e-12)
    scaled = curvature / scale[:, :, None] / scale[:, None, :] + 1e-9 * np.eye(6)
    values = values.copy()
    # Three sums over the frequencies: of all, weighted by the distance from the middle, and of the band's upper half.
    # [3, frequency] @ [window, frequency, position].
    frequency_weights = np.stack([np.ones_like(fit.omega), fit.omega - fit.middle, fit.upper_half]).astype(np.complex64)
    sums = np.zeros(basis.shape[:2], complex)
    upper = np.zeros(basis.shape[:2], complex)
    total = np.zeros(len(values), complex)
    for step in range(iterations + 1):
        paths = (basis @ values[..., None])[..., 0]
        sums, changing, upper = np.moveaxis(frequency_weights @ (make_waves(fit, paths).conj() * added), 1, 0)
        # Derivative of each position's sum by its path; the gradient is that of ln |total| by v.
        rates = -1j * (fit.middle * sums + changing)
        total = (sums * valid).sum(axis=1)
        if step == iterations:
            break
        gradient = np.einsum("wnp,wn->wp", weighted, rates) / np.where(total == 0, 1, total)[:, None]
        # C^-1 gradient.
        values_step = np.linalg.solve(scaled, (gradient.real / scale)[..., None])[..., 0] / scale
        values += np.clip(values_step, -STEP_LIMITS, STEP_LIMITS)
    # The amplitude may change linearly over the window: a plane c_0 + c_1 x + c_2 y is fitted to the positions' sums,
    # and what it leaves counts as noise. c_0 is the amplitude at `at_m`. The mean over the positions would be that at
    # the window's centre, which may lie elsewhere.
    plane = weighted[:, :, :3]
    matrix = np.einsum("wnp,wnq->wpq", plane, basis[:, :, :3]) + 1e-12 * np.eye(3)
    plane_inverse = np.linalg.inv(matrix)
    plane_terms = np.einsum("wpq,wnq,wn->wp", plane_inverse, plane, sums, optimize=True)
    residual = (sums - np.einsum("wnp,wp->wn", basis[:, :, :3], plane_terms)) * valid
    # Residual power of a position. Nine unknowns were fitted: six values and the plane's three coefficients.
    power = (np.abs(residual) ** 2).sum(axis=1) / np.maximum(count - 9, 1) / fit.gain**2
    # Variance of the real part, and of the imaginary part, of the mean over the positions.
    noise = power / count / 2
    amplitude = plane_terms[:, 0] / fit.gain
    # The mean's phase has the variance noise / |amplitude|^2, and v has the covariance C^-1 noise / |amplitude|^2.
    inverse = np.linalg.inv(scaled)
    spread = np.einsum("wpp->wp", inverse) / scale**2
    std = np.sqrt(spread * (noise / np.maximum(np.abs(amplitude) ** 2, 1e-30))[:, None])
    # An echo of amplitude 1 has the power gain^2 / frequencies in the waves that the matched filter compares with.
    energy = np.einsum("wfn,wn->w", np.abs(added) ** 2, valid)
    share = count * np.abs(amplitude) ** 2 * fit.gain**2 / fit.omega.size / np.maximum(energy, 1e-30)
    upper_total = (upper * valid).sum(axis=1)
    lower_total = np.maximum(np.abs(total - upper_total), 1e-30)
    band_rise = np.log(np.maximum(np.abs(upper_total), 1e-30) / lower_total) - fit.band_rise
    return Maximum(
        values=values,
        amplitude=amplitude,
        # c_0 is less certain than the mean where `at_m` is not the window's centre.
        amplitude_std=np.sqrt(noise * np.maximum(1, count * plane_inverse[:, 0, 0])),
        std=std,
        share=share,
        band_rise=band_rise,
    )


def make_echoes(fit: BoardFit, windows: Windows, maximum: Maximum) -> Echoes:
    """Return the echoes of the maxima in windows."""
    path, slope, bend = unpack_values(maximum.values)
    # The matched filter has taken exp(+j k path) out of the samples. It is put back at the weighted middle of the band,
    # where an error of the path does not matter. `Echoes` has the conjugate phase.
    turned_amplitude = maximum.amplitude * np.exp(1j * fit.middle * path)
    return Echoes(
        at_m=windows.at_m,
        path_m=path,
        slope=slope,
        bend=bend,
        amplitude=turned_amplitude.conj(),
        amplitude_std=maximum.amplitude_std,
        path_std_m=maximum.std[:, 0],
        slope_std=maximum.std[:, 1:3],
        share=maximum.share,
        band_rise=maximum.band_rise,
    )


def gather_windows(board: Samples, rows: NDArray, columns: NDArray, at_m: Array) -> Windows:
    """Return windows whose first positions are at (rows, columns), each [window]; `at_m` as of `Windows`."""
    height, width = board.window_shape()
    # Rows [window, height, 1] and columns [window, 1, width] of all positions.
    r = rows[:, None, None] + np.arange(height)[:, None]
    c = columns[:, None, None] + np.arange(width)
    count = len(rows)
    samples = np.moveaxis(board.cube[:, :, r, c], 2, 0).reshape(count, *board.cube.shape[:2], -1)
    valid = board.valid[r, c].reshape(count, -1).astype(float)
    offsets = board.offsets_m[r, c].reshape(count, -1, 3) - at_m[:, None]
    return Windows(samples * valid[:, None, None].astype(np.float32), valid, offsets[..., :2], at_m)


def add_up(fit: BoardFit, windows: Windows, values: Array) -> NDArray:
    """Return the mean of all RX's samples, in phase for echoes of the given values: [window, frequency, position]."""
    path, slope, _ = unpack_values(values)
    return add_rx(fit.compute_steering(windows.at_m, path, slope) / len(fit.rx_places_m), windows.samples)


def add_rx(factors: NDArray, samples: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """Sum over the RX of factors [window, rx, frequency] times samples [window, rx, frequency, position]."""
    # For each window and frequency: [1, rx] @ [rx, position].
    factors_by_frequency = np.moveaxis(factors, 1, 2).astype(np.complex64)[:, :, None]
    return (factors_by_frequency @ np.moveaxis(samples, 1, 2))[:, :, 0]


def make_waves(fit: BoardFit, paths: Array) -> NDArray[np.complex64]:
    """Return exp(j omega path) of paths [..., position]: [..., frequency, position].

    The frequencies are evenly spaced: each wave is the one before, turned by the same phase.
    """
    waves = np.empty((*paths.shape[:-1], fit.omega.size, paths.shape[-1]), np.complex64)
    wave = np.exp(1j * fit.omega[0] * paths).astype(np.complex64)
    turn = np.exp(1j * (fit.omega[1] - fit.omega[0]) * paths).astype(np.complex64)
    for index in range(fit.omega.size):
        waves[..., index, :] = wave
        wave = wave * turn
    return waves


def synthesise(
    fit: BoardFit, valid: Array, waves: NDArray, amplitude: NDArray, steering: NDArray
) -> NDArray[np.complex64]:
    """Return samples of all echoes together, [window, rx, frequency, position].

    `waves` [window, echo, frequency, position], `amplitude` [window, echo], `steering` [window, echo, rx, frequency].
    """
    factors = (amplitude[..., None, None] * steering.conj()).astype(np.complex64)
    echoes = np.empty((len(waves), *factors.shape[2:], waves.shape[-1]), np.complex64)
    # For each window and frequency: [rx, echo] @ [echo, position].
    np.matmul(factors.transpose(0, 3, 2, 1), np.swapaxes(waves, 1, 2), out=np.moveaxis(echoes, 1, 2))
    if not valid.all():
        echoes *= valid[:, None, None].astype(np.float32)
    if fit.board.model is not None:
        echoes = fit.model.astype(np.complex64) @ echoes
    return echoes


def make_empty_echoes() -> Echoes:
    """Return an empty set of echoes."""
    return Echoes(
        at_m=np.zeros((0, 3)),
        path_m=np.zeros(0),
        slope=np.zeros((0, 2)),
        bend=np.zeros((0, 2, 2)),
        amplitude=np.zeros(0, np.complex128),
        amplitude_std=np.zeros(0),
        path_std_m=np.zeros(0),
        slope_std=np.zeros((0, 2)),
        share=np.zeros(0),
        band_rise=np.zeros(0),
    )


def select_windows(windows: Windows, keep: NDArray) -> Windows:
    """Return some of the windows, by index [k] or bool mask [window]."""
    return Windows(windows.samples[keep], windows.valid[keep], windows.offsets[keep], windows.at_m[keep])


def choose_thinned(shape: tuple[int, int]) -> NDArray[np.int_]:
    """Return about `THINNED_POSITIONS` of the positions of a window of `rows` and `columns`, evenly spread.

    They are indices into the flattened window, row by row.
    """
    # Each row keeps one of `step` positions, shifted by `turn` from those of the row before.
    step = max(1, round(shape[0] * shape[1] / THINNED_POSITIONS))
    rows, columns = np.indices(shape)
    # With 1 less the golden ratio 0.618 the distances to the nearest positions are similar in all directions.
    turn = max(1, round(0.382 * step))
    return np.flatnonzero((turn * rows + columns) % step == 0)


def select_positions(windows: Windows, keep: NDArray[np.int_]) -> Windows:
    """Return windows with some of their positions."""
    return Windows(windows.samples[..., keep], windows.valid[:, keep], windows.offsets[:, keep], windows.at_m)


def replace_samples(windows: Windows, samples: NDArray) -> Windows:
    """Return windows with other samples of the same shape."""
    return Windows(samples, windows.valid, windows.offsets, windows.at_m)


def select_maxima(maximum: Maximum, keep: NDArray) -> Maximum:
    """Return copies of some maxima, by index [k] or bool mask [window]."""
    return Maximum(*(getattr(maximum, f.name)[keep].copy() for f in fields(Maximum)))
