"""Paths of echoes over the aperture: a smooth surface shows as a specular point whose path changes with the stage.

`find_echoes` fits path and complex amplitude of each window's echoes (`window`), the strongest first; what it explains
is subtracted, the next one is searched in the rest, and all are fitted together (`joint`). `measure_echoes` measures
the echoes of another receiver along known paths.

The six values of a path are its length in the window's middle, its slopes g_x and g_y (first derivatives by the stage's
place), and its bends xx, xy and yy (second ones).
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from polysight.surfaces.joint import MERGED_WIDENING, START_BEND, JointFit
from polysight.surfaces.points import compute_unit_legs, locate
from polysight.surfaces.window import (
    WINDOW_M,
    Array,
    BoardFit,
    Echoes,
    Maximum,
    Samples,
    Windows,
    add_up,
    choose_thinned,
    gather_windows,
    make_echoes,
    make_empty_echoes,
    maximise,
    pack_values,
    replace_samples,
    select_maxima,
    select_positions,
    select_windows,
)
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# Distance of neighbouring windows: their phases connect, and a radius of 50 mm still gives a hundred points.
STRIDE_M = 0.008
# Largest |g_x|, |g_y| searched: a tilt of some 20 degrees in x, 23 in y, at half a metre.
MAX_SLOPE = 0.47
# Slopes of the coarse search on each axis, from -MAX_SLOPE to MAX_SLOPE: two in a resolution cell of 0.11.
SLOPE_BINS = 19
# Largest number of echoes of one window; chosen.
MAX_ECHOES = 5
# Share of a window's power that a plane wave explains; noise alone gives 0.01.
MIN_SHARE = 0.05
# Least share of the power for the echoes after the strongest: a sphere in front of a table that is 16 dB brighter has
# 0.025.
MIN_LEFT = 0.012
# If a fit to some of the positions makes echoes less certain by this factor, they merge in a fit to all, too.
THINNED_WIDENING = 5 * MERGED_WIDENING
# An echo this far below the strongest of the scan, 32 dB in power, counts as a side lobe or the echo of an edge;
# chosen.
MIN_POWER = 10 ** (-3.2)
# Echoes whose windows are in memory together while they are measured; chosen.
_ECHOES_AT_A_TIME = 100


class _Search:
    """Coarse search of path and slope: phase tables for windows whose positions form a lattice.

    A window is multiplied by the conjugate phases of its frequencies (`along_f`), rows (`along_y`) and columns
    (`along_x`); `lead` is the phase of each RX relative to the board's middle. Phases follow from metres of path by
    `fit.omega` at each frequency, by `fit.middle` at the middle one.
    """

    def __init__(self, fit: BoardFit, gate_m: tuple[float, float]) -> None:
        board = fit.board
        height, width = board.window_shape()
        self.shape = (height, width)
        self.slopes = np.linspace(-MAX_SLOPE, MAX_SLOPE, SLOPE_BINS)
        y = board.offsets_m[:height, 0, 1] - board.offsets_m[:height, 0, 1].mean()
        x = board.offsets_m[0, :width, 0] - board.offsets_m[0, :width, 0].mean()
        self.along_y = np.exp(-1j * fit.middle * np.outer(y, self.slopes)).astype(np.complex64)
        self.along_x = np.exp(-1j * fit.middle * np.outer(x, self.slopes)).astype(np.complex64)
        # Two paths in a resolution cell.
        cell_m = SPEED_OF_LIGHT_M_S / np.ptp(board.frequencies_hz)
        self.paths = np.arange(gate_m[0], gate_m[1] + cell_m / 4, cell_m / 2)
        excess = self.paths[None, :] - board.direct_m[:, None]
        self.along_f = np.exp(-1j * excess[:, :, None] * fit.omega).astype(np.complex64)
        path, gy, gx = np.meshgrid(self.paths, self.slopes, self.slopes, indexing="ij")
        slope = np.stack([gx.ravel(), gy.ravel()], axis=1)
        zero = np.zeros((slope.shape[0], 3))
        points = locate(path.ravel(), slope, zero, board.tx_m, board.middle_m)
        _, back, *_ = compute_unit_legs(points, zero, board.tx_m, board.middle_m)
        # `back` are unit vectors from the board's middle to the points, `lever` the places of the RX from that middle:
        # an RX is nearer to a point by back . lever, and has so much less path.
        lead = np.exp(1j * fit.middle * (back @ fit.lever.T))
        # Places behind the stage or far away (limits chosen) are not surfaces of the scene.
        lead[(points[:, 2] < 0.2) | (points[:, 2] > 1.5)] = 0
        self.lead = np.moveaxis(lead.reshape(*path.shape, -1), -1, 0).astype(np.complex64)

    def find(self, windows: Windows) -> Array:
        """Return start values [window, 6] of the strongest echo of each window."""
        samples = windows.samples
        count, rx = samples.shape[:2]
        total = np.zeros((count, *self.lead.shape[1:]), np.complex64)
        for index in range(rx):
            spectrum_by_path = (self.along_f[index] @ samples[:, index]).reshape(count, -1, *self.shape)
            spectrum_by_y = np.swapaxes(spectrum_by_path, -1, -2) @ self.along_y
            spectrum_by_slope = np.swapaxes(spectrum_by_y, -1, -2) @ self.along_x
            total += self.lead[index] * spectrum_by_slope
        power = total.real**2 + total.imag**2
        best = power.reshape(count, -1).argmax(axis=1)
        path, gy, gx = np.unravel_index(best, power.shape[1:])
        bends = np.full(count, START_BEND)
        flat_power = np.zeros(count)
        return np.stack([self.paths[path], self.slopes[gx], self.slopes[gy], bends, flat_power, bends], axis=1)


def _fit_echo(fit: BoardFit, windows: Windows, values: Array) -> Maximum:
    """Fit an echo; the RX are added up twice, first for the coarse path."""
    maximum = maximise(fit, add_up(fit, windows, values), windows.valid, windows.offsets, values)
    return maximise(fit, add_up(fit, windows, maximum.values), windows.valid, windows.offsets, maximum.values)


def find_echoes(board: Samples, gate_m: tuple[float, float]) -> Echoes:
    """Find the echoes of all windows of a board.

    Parameters
    ----------
    board
        Its samples.
    gate_m
        Smallest and largest path searched, metres.
    """
    fit = BoardFit(board)
    search = _Search(fit, gate_m)
    height, width = search.shape
    shape = board.valid.shape
    # The stride in rows and in columns; a window has WINDOW_M on each side.
    steps = [max(1, round(STRIDE_M * n / WINDOW_M)) for n in (height, width)]
    columns = np.arange(0, shape[1] - width + 1, steps[1])
    strongest = _measure_strongest(board)
    parts = []
    for row in range(0, shape[0] - height + 1, steps[0]):
        rows = np.full(columns.size, row)
        block = board.offsets_m[row : row + height]
        at_m = np.stack([block[:, c : c + width].mean(axis=(0, 1)) for c in columns])
        windows = gather_windows(board, rows, columns, at_m)
        # A window with half of its positions is worth a fit; one without power holds no echo.
        power = (np.abs(windows.samples) ** 2).mean(axis=(1, 2, 3))
        worth = (windows.valid.mean(axis=1) > 0.5) & (power > MIN_POWER * strongest)
        if worth.any():
            parts += _separate_echoes(fit, search, select_windows(windows, worth))
    if not parts:
        return make_empty_echoes()
    echoes = Echoes.join(parts)
    level = np.abs(echoes.amplitude)
    is_strong = level**2 > MIN_POWER * np.percentile(level, 99) ** 2
    return echoes[is_strong]


def _measure_strongest(board: Samples) -> float:
    """Return the power of the strongest positions, without the strongest per cent, which may be a glint."""
    power = (np.abs(board.cube) ** 2).mean(axis=(0, 1))
    return float(np.percentile(power, 99)) if power.size else 0.0


def _separate_echoes(fit: BoardFit, search: _Search, windows: Windows) -> list[Echoes]:
    """Return the echoes of windows, one list entry per rank; the strongest are subtracted before the next search."""
    echoes: list[tuple[NDArray, Maximum]] = []
    residual = windows.samples.copy()
    active = np.arange(len(windows.valid))
    energy = np.sum(np.abs(residual) ** 2, axis=(1, 2, 3))
    for rank in range(MAX_ECHOES):
        active_windows = select_windows(replace_samples(windows, residual), active)
        first = _fit_echo(fit, active_windows, search.find(active_windows))
        share = _compute_power_share(fit, active_windows, first, energy[active])
        keep = share > (MIN_LEFT if rank else MIN_SHARE)
        if not keep.any():
            break
        active = active[keep]
        first = select_maxima(first, keep)
        echoes.append((active, first))
        if rank:
            active = _refine(fit, windows, echoes, residual)
        else:
            joint = JointFit(fit, select_windows(windows, active), first.values[:, None], first.amplitude[:, None])
            joint.subtract(np.arange(active.size))
            residual[active] = joint.rest
        energy_left = np.sum(np.abs(residual[active]) ** 2, axis=(1, 2, 3)) / energy[active]
        active = active[energy_left > MIN_LEFT]
        if not active.size:
            break
    return [make_echoes(fit, select_windows(windows, members), values) for members, values in echoes]


def _refine(
    fit: BoardFit, windows: Windows, echoes: list[tuple[NDArray, Maximum]], residual: NDArray[np.complex64]
) -> NDArray[np.int_]:
    """Fit the newest echo together with all others of its windows, and update `echoes` and `residual`.

    Returns the windows that keep the newest echo. It is dropped where it only splits another echo in two: the edge of a
    surface does that.
    """
    is_likely = _may_be_separate(fit, windows, echoes)
    members = echoes[-1][0][is_likely]
    weakest = select_maxima(echoes[-1][1], is_likely)
    echoes[-1] = (members, weakest)
    member_windows = select_windows(windows, members)
    joint = _fit_apart(fit, member_windows, _select_echoes(echoes, members))
    widening = joint.find_widening()
    is_separate = widening[..., 0].max(axis=1) < MERGED_WIDENING
    for index, (windows_of_rank, maximum) in enumerate(echoes):
        values = joint.values[:, index]
        single_echo = replace_samples(member_windows, joint.rest + joint.synthesise(index))
        # Without iterations the path of the joint fit stays, and only the amplitude is measured.
        better = maximise(
            fit, add_up(fit, single_echo, values), member_windows.valid, member_windows.offsets, values, iterations=0
        )
        # The other echoes make an echo's amplitude and path less certain.
        better.amplitude_std = better.amplitude_std * widening[:, index, 0]
        better.std = better.std * widening[:, index, 1:]
        rows = np.flatnonzero(np.isin(windows_of_rank, members))[is_separate]
        for field in fields(Maximum):
            getattr(maximum, field.name)[rows] = getattr(better, field.name)[is_separate]
    residual[members[is_separate]] = joint.rest[is_separate]
    echoes[-1] = (members[is_separate], select_maxima(weakest, is_separate))
    return members[is_separate]


def _may_be_separate(fit: BoardFit, windows: Windows, echoes: list[tuple[NDArray, Maximum]]) -> NDArray[np.bool_]:
    """False for windows of the newest echo where a fit to some of the positions finds it merged with another.

    Most windows at the edges of plates are so, and their fits need the most steps.
    """
    members = echoes[-1][0]
    shape = fit.board.window_shape()
    thinned = choose_thinned(shape)
    if thinned.size == shape[0] * shape[1]:
        return np.ones(members.size, bool)
    thinned_windows = select_windows(select_positions(windows, thinned), members)
    joint = _fit_apart(fit, thinned_windows, _select_echoes(echoes, members))
    return joint.find_widening()[..., 0].max(axis=1) < THINNED_WIDENING


def _fit_apart(fit: BoardFit, windows: Windows, starts: list[Maximum]) -> JointFit:
    """Fit all echoes of windows together, from other starts too where two have merged."""
    values = np.stack([maximum.values for maximum in starts], axis=1)
    amplitude = np.stack([maximum.amplitude for maximum in starts], axis=1)
    joint = JointFit(fit, windows, values, amplitude)
    joint.run()
    joint.part_merged_echoes()
    return joint


def _select_echoes(echoes: list[tuple[NDArray, Maximum]], members: NDArray[np.int_]) -> list[Maximum]:
    """Return the echoes of some windows, one list entry per rank."""
    return [select_maxima(maximum, np.isin(windows, members)) for windows, maximum in echoes]


def _compute_power_share(fit: BoardFit, windows: Windows, maximum: Maximum, energy: Array) -> Array:
    """Return the share [window] of a window's `energy` that an echo explains."""
    count = windows.valid.sum(axis=1) * len(fit.lever)
    # Over the F frequencies of one position and RX an echo of amplitude a has the energy |a gain|^2 / F.
    return count * np.abs(maximum.amplitude) ** 2 * fit.gain**2 / fit.omega.size / np.maximum(energy, 1e-30)


def measure_echoes(
    board: Samples,
    at_m: Array,
    path_m: Array,
    slope: Array,
    bend: Array,
    *,
    window: NDArray[np.int_] | None = None,
    is_measured: NDArray[np.bool_] | None = None,
) -> tuple[Echoes, NDArray]:
    """Measure the amplitudes of echoes of known path, slope and curvature, in the windows around `at_m` [n, 3].

    `path_m` [n] are the paths there, `slope` [n, 2] and `bend` [n, 2, 2] their first and second derivatives by the
    stage's place. The path is not fitted: a maximum over paths is too high by the noise, by most where V nearly
    vanishes. Echoes of the same number `window` [n] are distinguished by their paths; without it, each is measured as
    if alone.
    Returns the echoes and which of them lie inside the scan and are to be measured (others are not).
    """
    fit = BoardFit(board)
    height, width = board.window_shape()
    y = board.offsets_m[:, 0, 1]
    x = board.offsets_m[0, :, 0]
    rows = np.round(np.interp(at_m[:, 1], y, np.arange(y.size)) - (height - 1) / 2).astype(int)
    columns = np.round(np.interp(at_m[:, 0], x, np.arange(x.size)) - (width - 1) / 2).astype(int)
    starts = pack_values(path_m, slope, bend)
    is_known = np.isfinite(at_m).all(axis=1) & np.isfinite(starts).all(axis=1)
    is_inside = is_known & (rows >= 0) & (columns >= 0) & (rows <= y.size - height) & (columns <= x.size - width)
    if is_measured is not None:
        is_inside &= is_measured
    if window is None:
        window = np.arange(len(at_m))
    known_of_window: dict[int, list[int]] = {}
    for index in np.flatnonzero(is_known):
        known_of_window.setdefault(int(window[index]), []).append(int(index))
    chosen = np.flatnonzero(is_inside)
    # Each measured echo first, then the others of its window.
    members = [[index, *(o for o in known_of_window[int(window[index])] if o != index)] for index in chosen.tolist()]
    counts = np.array([len(group) for group in members], int)
    parts: list[Echoes] = []
    order: list[NDArray] = []
    for count in np.unique(counts):
        windows_of_count = np.flatnonzero(counts == count)
        for first in range(0, windows_of_count.size, _ECHOES_AT_A_TIME):
            part = windows_of_count[first : first + _ECHOES_AT_A_TIME]
            group = np.array([members[index] for index in part])
            measured = group[:, 0]
            windows = gather_windows(board, rows[measured], columns[measured], at_m[measured])
            values = _move_starts(starts[group], at_m[measured][:, None] - at_m[group])
            parts.append(_measure_windows(fit, windows, values))
            order.append(part)
    if not parts:
        return make_empty_echoes(), is_inside
    return Echoes.join(parts)[np.argsort(np.concatenate(order))], is_inside


def _move_starts(values: Array, offsets_m: Array) -> Array:
    """Return the values [..., 6] of paths at other stage offsets near by."""
    x = offsets_m[..., 0]
    y = offsets_m[..., 1]
    path, slope_x, slope_y, xx, xy, yy = np.moveaxis(values, -1, 0)
    moved_path = path + slope_x * x + slope_y * y + xx * x * x / 2 + xy * x * y + yy * y * y / 2
    return np.stack([moved_path, slope_x + xx * x + xy * y, slope_y + xy * x + yy * y, xx, xy, yy], axis=-1)


def _measure_windows(fit: BoardFit, windows: Windows, values: Array) -> Echoes:
    """Measure the first echo of each window, of known values [window, echo, 6], in the presence of the others."""
    first_values = values[:, 0]
    if values.shape[1] > 1:
        joint = JointFit(fit, windows, values, np.zeros(values.shape[:2]))
        widening = joint.fit_amplitudes()
        windows = replace_samples(windows, joint.rest + joint.synthesise(0))
    else:
        widening = np.ones(len(values))
    measured = maximise(
        fit, add_up(fit, windows, first_values), windows.valid, windows.offsets, first_values, iterations=0
    )
    measured.amplitude_std = measured.amplitude_std * widening
    return make_echoes(fit, windows, measured)
