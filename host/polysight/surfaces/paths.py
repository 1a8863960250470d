"""Paths of echoes over the aperture: a smooth surface shows as a specular point whose path changes with the stage.

In a window of some 34 mm of stage positions the path of an echo is L + g.d + d'Q d / 2, with d the offset from the
window's centre. `find_echoes` fits L, g, Q and the complex amplitude to the samples of all positions, frequencies and
RX of each window by maximising the matched filter, the strongest echo first; what it explains is subtracted, the next
one is searched in the rest, and all are fitted again in turn. `measure_echoes` fits the echoes of another receiver from
given starts. A window's RX are added up in phase for the direction from which the echo comes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from polysight.surfaces.points import locate, unit_legs
from polysight_shared.units import SPEED_OF_LIGHT_M_S

WINDOW_M = 0.034
# Distance of neighbouring windows: their phases connect, and a radius of 50 mm still gives a hundred points.
STRIDE_M = 0.008
# Largest |g_x|, |g_y| searched: a tilt of 17 degrees in x, 24 in y.
MAX_SLOPE = 0.47
# Bins of the coarse search per resolution cell.
SLOPE_BINS = 19
MAX_ECHOES = 5
# Share of a window's power that a plane wave explains; noise alone gives 0.01.
MIN_SHARE = 0.05
# What is left after the stronger echoes: a sphere before a table that is 16 dB brighter has 0.025.
MIN_LEFT = 0.012
# An echo this far below the strongest of the scan is a side lobe or the echo of an edge.
MIN_POWER = 10 ** (-3.2)
ITERATIONS = 7
# The curvature Q of a convex body's path is between 0 (plane) and 2.3 / m (point).
START_BEND = 0.8

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Samples:
    """Samples of a receiving board, direct path removed, as after synchronisation.

    Attributes
    ----------
    cube
        complex [rx, frequency, row, column]: an echo of path L is a exp(+2 pi j f (L - direct) / c), seen through
        `model`.
    valid
        bool [row, column].
    offsets_m
        float64 [row, column, 3]: stage offsets.
    frequencies_hz
        float64 [frequency], evenly spaced.
    tx_m, rx_m
        Antennas at stage offset zero, [3] and [rx, 3].
    model
        complex [frequency, frequency]: effect of the range gate on an echo; None: none.
    """

    cube: NDArray[np.complexfloating]
    valid: NDArray[np.bool_]
    offsets_m: Array
    frequencies_hz: Array
    tx_m: Array
    rx_m: Array
    model: NDArray[np.complex128] | None = None

    @property
    def middle_m(self) -> Array:
        """Mean place of the RX: echoes are given as if received there."""
        return self.rx_m.mean(axis=0)

    @property
    def direct_m(self) -> Array:
        """Direct path to each RX, [rx]."""
        return np.linalg.norm(self.rx_m - self.tx_m, axis=1)

    def window_shape(self) -> tuple[int, int]:
        """Rows and columns of a window."""
        y = self.offsets_m[:, 0, 1]
        x = self.offsets_m[0, :, 0]
        steps = [abs(axis[-1] - axis[0]) / max(1, axis.size - 1) for axis in (y, x)]
        rows, columns = (max(5, round(WINDOW_M / step)) for step in steps)
        return min(rows, y.size), min(columns, x.size)


@dataclass(frozen=True)
class Echoes:
    """Echoes [n]: stage offset `at_m` [n, 3], path, its gradient [n, 2] and curvature [n, 2, 2] (1 / m) there.

    `amplitude`: complex, exp(-j k path) with the path's phase at the centre frequency in it. `amplitude_std`: of its
    real and of its imaginary part. `path_std_m`, `slope_std` [n, 2]: by the rest of the fit. `share`: of a window's
    power that its echoes explain. `band_rise`: ln of the amplitude in the upper half of the band over that in the lower
    half.
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
        """Return the echoes at other stage offsets [n, 3] near by: path, slope and phase follow the fitted path."""
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
class _Windows:
    """Samples of some windows: [window, rx, frequency, position], offsets from their centres [window, position, 2]."""

    samples: NDArray[np.complex64]
    valid: Array
    offsets: Array
    at_m: Array


class _Fit:
    """The matched filter of one board: frequencies, weights and directions."""

    def __init__(self, board: Samples) -> None:
        self.board = board
        self.omega = 2 * np.pi * board.frequencies_hz / SPEED_OF_LIGHT_M_S
        self.middle = float(self.omega.mean())
        self.lever = board.rx_m - board.middle_m
        # The largest gain of the range gate for an echo, and the spread of its frequencies.
        if board.model is None:
            model = np.eye(self.omega.size)
            gate = np.linspace(0.05, 0.6, 24)
        else:
            model = board.model
            gate = np.linspace(*_find_gate(board), 24)
        phases = np.exp(1j * np.outer(self.omega, gate))
        weights = np.mean((model @ phases) * phases.conj(), axis=1).real
        self.gain = float(weights.sum())
        self.upper_half = np.arange(weights.size) >= weights.size // 2
        self.band_rise = float(np.log(weights[self.upper_half].sum() / weights[~self.upper_half].sum()))
        self.weights = weights / self.gain
        self.middle = float(self.weights @ self.omega)
        self.mean_square = float(self.weights @ self.omega**2)
        self.model = model

    def steer(self, offsets: Array, path_m: Array, slope: Array) -> NDArray[np.complex128]:
        """Phase factors [window, rx, frequency] that add up the RX for echoes of given path and slope."""
        board = self.board
        points = locate(path_m, slope, offsets, board.tx_m, board.middle_m)
        _, back, *_ = unit_legs(points, offsets, board.tx_m, board.middle_m)
        excess = -back @ self.lever.T - board.direct_m
        return np.exp(-1j * excess[:, :, None] * self.omega)


def _find_gate(board: Samples) -> tuple[float, float]:
    """Range of excess paths in which the model's gain is looked at: the middle half of its unambiguous range."""
    reach = SPEED_OF_LIGHT_M_S / (board.frequencies_hz[1] - board.frequencies_hz[0])
    centre = find_mirror_path(board, 0.5) - board.direct_m.mean()
    return centre - reach / 10, centre + reach / 10


def find_mirror_path(board: Samples, z_m: float) -> float:
    """Path over a mirror at `z_m`."""
    image = board.tx_m * [1, 1, -1] + [0, 0, 2 * z_m]
    return float(np.linalg.norm(board.middle_m - image))


def _basis(offsets: Array) -> Array:
    """Rates of the path by (L, g_x, g_y, Q_xx, Q_xy, Q_yy): [window, position, 6]."""
    x = offsets[..., 0]
    y = offsets[..., 1]
    return np.stack([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2], axis=-1)


def _pack(path_m: Array, slope: Array, bend: Array) -> Array:
    return np.stack([path_m, *slope.T, bend[:, 0, 0], bend[:, 0, 1], bend[:, 1, 1]], axis=1)


def _unpack(values: Array) -> tuple[Array, Array, Array]:
    bend = np.stack([values[:, [3, 4]], values[:, [4, 5]]], axis=1)
    return values[:, 0], values[:, 1:3], bend


@dataclass
class _Maximum:
    """Result of :func:`_maximise`: parameters, amplitude, noise, standard deviations, share and rise over the band."""

    values: Array
    amplitude: NDArray[np.complex128]
    rest: Array
    std: Array
    share: Array
    band_rise: Array


def _derotate(fit: _Fit, added: NDArray, paths: Array) -> Iterator[tuple[float, NDArray]]:
    """Yield each frequency's wave number and samples [window, position] turned back by the path."""
    first = np.exp(-1j * fit.omega[0] * paths)
    step = np.exp(-1j * (fit.omega[1] - fit.omega[0]) * paths) if fit.omega.size > 1 else first
    for index, omega in enumerate(fit.omega):
        yield float(omega), added[:, index] * first
        first = first * step


def _maximise(
    fit: _Fit, added: NDArray, valid: Array, offsets: Array, values: Array, *, iterations: int = ITERATIONS
) -> _Maximum:
    """Maximise |sum of derotated samples| by Newton's method with the expected curvature.

    `added`: [window, frequency, position], RX added up; `values` [window, 6].
    """
    basis = _basis(offsets)
    count = np.maximum(valid.sum(axis=1), 1)
    weighted = valid[:, :, None] * basis
    mean = weighted.sum(axis=1) / count[:, None]
    square = np.einsum("wnp,wnq->wpq", weighted, basis) / count[:, None, None]
    curvature = fit.mean_square * square - fit.middle**2 * np.einsum("wp,wq->wpq", mean, mean)
    scale = np.sqrt(np.einsum("wpp->wp", curvature) + 1e-12)
    scaled = curvature / scale[:, :, None] / scale[:, None, :] + 1e-9 * np.eye(6)
    values = values.copy()
    limit = np.array([0.02, 0.05, 0.05, 1.5, 1.5, 1.5])
    sums = np.zeros(basis.shape[:2], complex)
    upper = np.zeros(basis.shape[:2], complex)
    total = np.zeros(len(values), complex)
    for step in range(iterations + 1):
        paths = np.einsum("wnp,wp->wn", basis, values)
        sums = np.zeros(paths.shape, complex)
        upper = np.zeros(paths.shape, complex)
        rates = np.zeros(paths.shape, complex)
        for index, (omega, turned) in enumerate(_derotate(fit, added, paths)):
            sums += turned
            rates -= 1j * omega * turned
            if fit.upper_half[index]:
                upper += turned
        total = (sums * valid).sum(axis=1)
        if step == iterations:
            break
        slope = np.einsum("wnp,wn->wp", weighted, rates) / np.where(total == 0, 1, total)[:, None]
        move = np.linalg.solve(scaled, (slope.real / scale)[..., None])[..., 0] / scale
        values += np.clip(move, -limit, limit)
    amplitude = total / count / fit.gain
    # The amplitude may change linearly over the window: a plane is taken out before the rest counts as noise.
    plane = weighted[:, :, :3]
    matrix = np.einsum("wnp,wnq->wpq", plane, basis[:, :, :3]) + 1e-12 * np.eye(3)
    flat = np.linalg.solve(matrix, np.einsum("wnp,wn->wp", plane, sums)[..., None])[..., 0]
    rest = (sums - np.einsum("wnp,wp->wn", basis[:, :, :3], flat)) * valid
    power = (np.abs(rest) ** 2).sum(axis=1) / np.maximum(count - 9, 1) / fit.gain**2
    noise = power / count / 2
    inverse = np.linalg.inv(scaled)
    spread = np.einsum("wpp->wp", inverse) / scale**2
    std = np.sqrt(spread * (noise / np.maximum(np.abs(amplitude) ** 2, 1e-30))[:, None])
    energy = np.einsum("wfn,wn->w", np.abs(added) ** 2, valid)
    share = count * np.abs(amplitude) ** 2 * fit.gain**2 / fit.omega.size / np.maximum(energy, 1e-30)
    upper_total = (upper * valid).sum(axis=1)
    lower_total = np.maximum(np.abs(total - upper_total), 1e-30)
    band_rise = np.log(np.maximum(np.abs(upper_total), 1e-30) / lower_total) - fit.band_rise
    return _Maximum(
        values=values,
        amplitude=amplitude,
        rest=np.sqrt(noise),
        std=std,
        share=share,
        band_rise=band_rise,
    )


def _echoes(fit: _Fit, windows: _Windows, found: _Maximum) -> Echoes:
    path, slope, bend = _unpack(found.values)
    # The matched filter's phase is that at the weighted middle of the band.
    turned = found.amplitude * np.exp(1j * fit.middle * path)
    return Echoes(
        at_m=windows.at_m,
        path_m=path,
        slope=slope,
        bend=bend,
        amplitude=turned.conj(),
        amplitude_std=found.rest,
        path_std_m=found.std[:, 0],
        slope_std=found.std[:, 1:3],
        share=found.share,
        band_rise=found.band_rise,
    )


def wave_number(board: Samples) -> float:
    """Wave number at which the phases of a board's echoes are given, rad / m."""
    return _Fit(board).middle


def _gather(board: Samples, rows: NDArray, columns: NDArray, at_m: Array) -> _Windows:
    """Windows whose first positions are at (rows, columns), each [window]; `at_m` [window, 3] are their centres."""
    height, width = board.window_shape()
    r = rows[:, None, None] + np.arange(height)[:, None]
    c = columns[:, None, None] + np.arange(width)
    count = len(rows)
    samples = np.moveaxis(board.cube[:, :, r, c], 2, 0).reshape(count, *board.cube.shape[:2], -1)
    valid = board.valid[r, c].reshape(count, -1).astype(float)
    offsets = board.offsets_m[r, c].reshape(count, -1, 3) - at_m[:, None]
    return _Windows(samples * valid[:, None, None].astype(np.float32), valid, offsets[..., :2], at_m)


class _Search:
    """Coarse search of path and slope: tables for windows whose positions form a lattice."""

    def __init__(self, fit: _Fit, gate_m: tuple[float, float]) -> None:
        board = fit.board
        height, width = board.window_shape()
        self.shape = (height, width)
        self.slopes = np.linspace(-MAX_SLOPE, MAX_SLOPE, SLOPE_BINS)
        y = board.offsets_m[:height, 0, 1] - board.offsets_m[:height, 0, 1].mean()
        x = board.offsets_m[0, :width, 0] - board.offsets_m[0, :width, 0].mean()
        self.along_y = np.exp(-1j * fit.middle * np.outer(y, self.slopes)).astype(np.complex64)
        self.along_x = np.exp(-1j * fit.middle * np.outer(x, self.slopes)).astype(np.complex64)
        band = SPEED_OF_LIGHT_M_S / np.ptp(board.frequencies_hz)
        self.paths = np.arange(gate_m[0], gate_m[1] + band / 4, band / 2)
        excess = self.paths[None, :] - board.direct_m[:, None]
        self.along_f = np.exp(-1j * excess[:, :, None] * fit.omega).astype(np.complex64)
        path, gy, gx = np.meshgrid(self.paths, self.slopes, self.slopes, indexing="ij")
        slope = np.stack([gx.ravel(), gy.ravel()], axis=1)
        zero = np.zeros((slope.shape[0], 3))
        points = locate(path.ravel(), slope, zero, board.tx_m, board.middle_m)
        _, back, *_ = unit_legs(points, zero, board.tx_m, board.middle_m)
        lead = np.exp(1j * fit.middle * (back @ fit.lever.T))
        # Places behind the stage or far away are no surfaces of the scene.
        lead[(points[:, 2] < 0.2) | (points[:, 2] > 1.5)] = 0
        self.lead = np.moveaxis(lead.reshape(*path.shape, -1), -1, 0).astype(np.complex64)

    def find(self, windows: _Windows) -> Array:
        """Start values [window, 6] of the strongest echo of each window."""
        y = windows.samples
        count, rx = y.shape[:2]
        total = np.zeros((count, *self.lead.shape[1:]), np.complex64)
        for index in range(rx):
            by_path = (self.along_f[index] @ y[:, index]).reshape(count, -1, *self.shape)
            by_y = np.swapaxes(by_path, -1, -2) @ self.along_y
            by_slope = np.swapaxes(by_y, -1, -2) @ self.along_x
            total += self.lead[index] * by_slope
        power = total.real**2 + total.imag**2
        best = power.reshape(count, -1).argmax(axis=1)
        path, gy, gx = np.unravel_index(best, power.shape[1:])
        bends = np.full(count, START_BEND)
        flat = np.zeros(count)
        return np.stack([self.paths[path], self.slopes[gx], self.slopes[gy], bends, flat, bends], axis=1)


def _add_up(fit: _Fit, windows: _Windows, values: Array) -> NDArray:
    """Samples of all RX added up for echoes of the given values: [window, frequency, position]."""
    path, slope, _ = _unpack(values)
    factors = fit.steer(windows.at_m, path, slope) / len(fit.lever)
    return np.einsum("wrf,wrfn->wfn", factors, windows.samples)


def _fit_one(fit: _Fit, windows: _Windows, values: Array) -> _Maximum:
    """Fit an echo; the RX are added up twice, first for the coarse path."""
    maximum = _maximise(fit, _add_up(fit, windows, values), windows.valid, windows.offsets, values)
    return _maximise(fit, _add_up(fit, windows, maximum.values), windows.valid, windows.offsets, maximum.values)


def _synthesise(fit: _Fit, windows: _Windows, found: _Maximum) -> NDArray[np.complex64]:
    """Samples of the fitted echoes, [window, rx, frequency, position]."""
    path, slope, _ = _unpack(found.values)
    paths = np.einsum("wnp,wp->wn", _basis(windows.offsets), found.values)
    wave = np.exp(1j * fit.omega[:, None] * paths[:, None]) * (found.amplitude[:, None] * windows.valid)[:, None]
    conjugate_steering = fit.steer(windows.at_m, path, slope).conj()
    echo = conjugate_steering[..., None] * wave[:, None]
    if fit.board.model is not None:
        echo = np.einsum("fg,wrgn->wrfn", fit.model, echo)
    return echo.astype(np.complex64)


def find_echoes(board: Samples, gate_m: tuple[float, float]) -> Echoes:
    """Find the echoes of all windows of a board.

    Parameters
    ----------
    board
        Its samples.
    gate_m
        Smallest and largest path searched, metres.
    """
    fit = _Fit(board)
    search = _Search(fit, gate_m)
    height, width = search.shape
    shape = board.valid.shape
    steps = [max(1, round(STRIDE_M * n / WINDOW_M)) for n in (height, width)]
    columns = np.arange(0, shape[1] - width + 1, steps[1])
    loudest = _loudest(board)
    parts = []
    for row in range(0, shape[0] - height + 1, steps[0]):
        rows = np.full(columns.size, row)
        block = board.offsets_m[row : row + height]
        at_m = np.stack([block[:, c : c + width].mean(axis=(0, 1)) for c in columns])
        windows = _gather(board, rows, columns, at_m)
        # A window with half of its positions is worth a fit; one without power holds no echo.
        power = (np.abs(windows.samples) ** 2).mean(axis=(1, 2, 3))
        worth = (windows.valid.mean(axis=1) > 0.5) & (power > MIN_POWER * loudest)
        if worth.any():
            parts += _separate(fit, search, _select(windows, worth))
    if not parts:
        return _none()
    echoes = Echoes.join(parts)
    level = np.abs(echoes.amplitude)
    loud = level**2 > MIN_POWER * np.percentile(level, 99) ** 2
    return echoes[loud]


def _loudest(board: Samples) -> float:
    power = (np.abs(board.cube) ** 2).mean(axis=(0, 1))
    return float(np.percentile(power, 99)) if power.size else 0.0


def _none() -> Echoes:
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


def _select(windows: _Windows, keep: NDArray) -> _Windows:
    return _Windows(windows.samples[keep], windows.valid[keep], windows.offsets[keep], windows.at_m[keep])


def _separate(fit: _Fit, search: _Search, windows: _Windows) -> list[Echoes]:
    """Echoes of windows, one list entry per rank; the strongest are subtracted before the next are searched."""
    echoes: list[tuple[NDArray, _Maximum, NDArray]] = []
    rest = windows.samples.copy()
    active = np.arange(len(windows.valid))
    energy = np.sum(np.abs(rest) ** 2, axis=(1, 2, 3))
    for rank in range(MAX_ECHOES):
        part = _select(replace_samples(windows, rest), active)
        first = _fit_one(fit, part, search.find(part))
        share = _power_share(fit, part, first, energy[active])
        keep = share > (MIN_LEFT if rank else MIN_SHARE)
        if not keep.any():
            break
        active = active[keep]
        first = _kept(first, keep)
        echo = _synthesise(fit, _select(windows, active), first)
        rest[active] -= echo
        echoes.append((active, first, echo))
        energy_left = np.sum(np.abs(rest[active]) ** 2, axis=(1, 2, 3)) / energy[active]
        has_more = energy_left > MIN_LEFT
        if rank and has_more.any():
            _refine(fit, windows, rest, echoes)
        active = active[has_more]
        if not active.size:
            break
    if len(echoes) > 1:
        for _ in range(2):
            _refine(fit, windows, rest, echoes)
    return [_echoes(fit, _select(windows, members), values) for members, values, _ in echoes]


def _refine(fit: _Fit, windows: _Windows, rest: NDArray, found: list) -> None:
    """Fit every echo again to the rest plus itself."""
    shared = found[1][0]
    for index, (active, values, echo) in enumerate(found):
        again = np.isin(active, shared)
        picked = active[again]
        with_echo = rest[picked] + echo[again]
        part = _select(windows, picked)
        part.samples = with_echo
        start = values.values[again]
        better = _maximise(fit, _add_up(fit, part, start), part.valid, part.offsets, start, iterations=4)
        new = _synthesise(fit, part, better)
        rest[picked] = with_echo - new
        echo[again] = new
        for field in fields(_Maximum):
            getattr(values, field.name)[again] = getattr(better, field.name)
        found[index] = (active, values, echo)


def replace_samples(windows: _Windows, samples: NDArray) -> _Windows:
    """Return windows with other samples."""
    return _Windows(samples, windows.valid, windows.offsets, windows.at_m)


def _power_share(fit: _Fit, windows: _Windows, found: _Maximum, energy: Array) -> Array:
    count = windows.valid.sum(axis=1) * len(fit.lever)
    return count * np.abs(found.amplitude) ** 2 * fit.gain**2 / fit.omega.size / np.maximum(energy, 1e-30)


def _kept(found: _Maximum, keep: NDArray) -> _Maximum:
    return _Maximum(*(getattr(found, f.name)[keep].copy() for f in fields(_Maximum)))


def measure_echoes(board: Samples, at_m: Array, path_m: Array, slope: Array, bend: Array) -> tuple[Echoes, NDArray]:
    """Measure the amplitudes of echoes of known path, slope and curvature, in the windows around `at_m` [n, 3].

    The path is not fitted: a maximum over paths is too high by the noise, by most where V nearly vanishes.
    Returns the echoes and which of them lie inside the scan (others are not measured).
    """
    fit = _Fit(board)
    height, width = board.window_shape()
    y = board.offsets_m[:, 0, 1]
    x = board.offsets_m[0, :, 0]
    rows = np.round(np.interp(at_m[:, 1], y, np.arange(y.size)) - (height - 1) / 2).astype(int)
    columns = np.round(np.interp(at_m[:, 0], x, np.arange(x.size)) - (width - 1) / 2).astype(int)
    inside = (rows >= 0) & (columns >= 0) & (rows <= y.size - height) & (columns <= x.size - width)
    inside &= np.isfinite(at_m).all(axis=1) & np.isfinite(path_m)
    starts = _pack(path_m, slope, bend)
    parts = []
    chosen = np.flatnonzero(inside)
    for first in range(0, chosen.size, 100):
        part = chosen[first : first + 100]
        windows = _gather(board, rows[part], columns[part], at_m[part])
        added = _add_up(fit, windows, starts[part])
        measured = _maximise(fit, added, windows.valid, windows.offsets, starts[part], iterations=0)
        parts.append(_echoes(fit, windows, measured))
    if not parts:
        return _none(), inside
    return Echoes.join(parts), inside
