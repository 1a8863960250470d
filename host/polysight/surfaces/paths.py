"""Search of the echoes in all windows of a scan: their paths and complex amplitudes.

A smooth surface reflects as a mirror: for each position of the stage there is one *specular point* on it, which sends
an echo from TX to RX. The echo's path changes smoothly with the stage offset. In a window (`polysight.surfaces.window`)
it is described by six values: its length in the window's middle, its slopes g_x and g_y (first derivatives by the stage
offset), and its bends xx, xy and yy (second derivatives).

`find_echoes` searches the strongest echo of each window, fits and subtracts it, and searches the next one in the
residual. After each search all echoes of a window are fitted together (`polysight.surfaces.joint`). The *rank* of an
echo is its place in this order, from 0. `measure_echoes` measures the amplitudes in another receiver, along paths that
are known.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from polysight.surfaces.joint import MERGED_WIDENING, START_BEND, JointFit
from polysight.surfaces.points import compute_unit_legs, find_specular_points
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

# Distance of neighbouring windows. At this distance their phases follow from each other, and a body with a radius of
# 50 mm still gives a hundred points.
STRIDE_M = 0.008
# Largest |g_x|, |g_y| searched: a tilt of some 20 degrees in x, 23 in y, at half a metre.
MAX_SLOPE = 0.47
# Slopes of the coarse search on each axis, from -MAX_SLOPE to MAX_SLOPE: two in a resolution cell of 0.11.
SLOPE_BINS = 19
# Largest number of echoes of one window; chosen.
MAX_ECHOES = 5
# Least share of a window's power in its strongest echo. Noise alone gives 0.01.
MIN_SHARE = 0.05
# Least share of a window's power in each further echo, and in the residual for a further search. A sphere in front of a
# table that is 16 dB brighter has 0.025.
MIN_LEFT = 0.012
# Echoes with a larger widening (`polysight.surfaces.joint`) in a fit to some of the positions also merge in a fit to
# all.
THINNED_WIDENING = 5 * MERGED_WIDENING
# An echo 32 dB in power below the strongest of the scan counts as a side lobe or the echo of an edge; chosen.
MIN_POWER = 10 ** (-3.2)
# Echoes whose windows are in memory together while they are measured; chosen.
_ECHOES_AT_A_TIME = 100


class _Search:
    """Coarse search of the strongest echo on a grid of paths and slopes; for windows whose positions form a lattice.

    The samples of each window are summed with the conjugate phases of an echo of path L and slopes g_x and g_y:

        sum over rx, f, y, x of  lead exp(-j omega (L - direct)) exp(-j middle g_y y) exp(-j middle g_x x) sample

    The exponentials are tables: `along_f` [rx, path, frequency], `along_y` [y, g_y] and `along_x` [x, g_x]. `lead` [rx,
    path, g_y, g_x] makes up for the place of each RX. Only `along_f` uses the rate omega of each frequency; the others
    use the middle one.
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
        # The grid has two paths in a resolution cell.
        cell_m = SPEED_OF_LIGHT_M_S / np.ptp(board.frequencies_hz)
        self.paths = np.arange(gate_m[0], gate_m[1] + cell_m / 4, cell_m / 2)
        excess = self.paths[None, :] - board.direct_m[:, None]
        self.along_f = np.exp(-1j * excess[:, :, None] * fit.omega).astype(np.complex64)
        path, gy, gx = np.meshgrid(self.paths, self.slopes, self.slopes, indexing="ij")
        slope = np.stack([gx.ravel(), gy.ravel()], axis=1)
        zero = np.zeros((slope.shape[0], 3))
        points = find_specular_points(path.ravel(), slope, zero, board.tx_m, board.middle_m)
        _, back, *_ = compute_unit_legs(points, zero, board.tx_m, board.middle_m)
        # `back` are unit vectors from the board's middle to the points: the path to an RX that lies p away from the
        # middle is shorter by back . p.
        lead = np.exp(1j * fit.middle * (back @ fit.rx_places_m.T))
        # Points nearer than 0.2 m or farther than 1.5 m (chosen) are not surfaces of the scene.
        lead[(points[:, 2] < 0.2) | (points[:, 2] > 1.5)] = 0
        self.lead = np.moveaxis(lead.reshape(*path.shape, -1), -1, 0).astype(np.complex64)

    def find(self, windows: Windows) -> Array:
        """Return start values [window, 6] of the strongest echo of each window."""
        samples = windows.samples
        count, rx = samples.shape[:2]
        # [window, path, g_y, g_x]
        total = np.zeros((count, *self.lead.shape[1:]), np.complex64)
        for index in range(rx):
            # [window, path, y, x], then [window, path, x, g_y], then [window, path, g_y, g_x].
            spectrum_by_path = (self.along_f[index] @ samples[:, index]).reshape(count, -1, *self.shape)
            spectrum_by_y = np.swapaxes(spectrum_by_path, -1, -2) @ self.along_y
            spectrum_by_slope = np.swapaxes(spectrum_by_y, -1, -2) @ self.along_x
            total += self.lead[index] * spectrum_by_slope
        power = total.real**2 + total.imag**2
        best = power.reshape(count, -1).argmax(axis=1)
        path, gy, gx = np.unravel_index(best, power.shape[1:])
        bends = np.full(count, START_BEND)
        no_bend_xy = np.zeros(count)
        return np.stack([self.paths[path], self.slopes[gx], self.slopes[gy], bends, no_bend_xy, bends], axis=1)


def _fit_echo(fit: BoardFit, windows: Windows, values: Array) -> Maximum:
    """Fit one echo per window; the RX are added up for the coarse path first, then for the fitted one."""
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
    # Rows and columns from one window to the next; a window has WINDOW_M on each side.
    steps = [max(1, round(STRIDE_M * n / WINDOW_M)) for n in (height, width)]
    columns = np.arange(0, shape[1] - width + 1, steps[1])
    strongest = _measure_strongest(board)
    parts = []
    for row in range(0, shape[0] - height + 1, steps[0]):
        rows = np.full(columns.size, row)
        block = board.offsets_m[row : row + height]
        at_m = np.stack([block[:, c : c + width].mean(axis=(0, 1)) for c in columns])
        windows = gather_windows(board, rows, columns, at_m)
        # Windows with data at less than half of their positions, or with little power, are not searched.
        power = (np.abs(windows.samples) ** 2).mean(axis=(1, 2, 3))
        is_searched = (windows.valid.mean(axis=1) > 0.5) & (power > MIN_POWER * strongest)
        if is_searched.any():
            parts += _separate_echoes(fit, search, select_windows(windows, is_searched))
    if not parts:
        return make_empty_echoes()
    echoes = Echoes.join(parts)
    level = np.abs(echoes.amplitude)
    is_strong = level**2 > MIN_POWER * np.percentile(level, 99) ** 2
    return echoes[is_strong]


def _measure_strongest(board: Samples) -> float:
    """Return the 99th percentile of the positions' power: the strongest per cent may be a glint."""
    power = (np.abs(board.cube) ** 2).mean(axis=(0, 1))
    return float(np.percentile(power, 99)) if power.size else 0.0


def _separate_echoes(fit: BoardFit, search: _Search, windows: Windows) -> list[Echoes]:
    """Return the echoes of windows, one list entry per rank; an entry holds the windows that have an echo of its rank.

    Each echo is subtracted before the next one is searched.
    """
    # Indices of the windows with an echo of each rank, and these echoes.
    echoes: list[tuple[NDArray, Maximum]] = []
    residual = windows.samples.copy()
    active = np.arange(len(windows.valid))
    energy = np.sum(np.abs(residual) ** 2, axis=(1, 2, 3))
    for rank in range(MAX_ECHOES):
        active_windows = select_windows(replace_samples(windows, residual), active)
        newest = _fit_echo(fit, active_windows, search.find(active_windows))
        share = _compute_power_share(fit, active_windows, newest, energy[active])
        keep = share > (MIN_SHARE if rank == 0 else MIN_LEFT)
        if not keep.any():
            break
        active = active[keep]
        newest = select_maxima(newest, keep)
        echoes.append((active, newest))
        if rank > 0:
            active = _refine(fit, windows, echoes, residual)
        else:
            joint = JointFit(fit, select_windows(windows, active), newest.values[:, None], newest.amplitude[:, None])
            joint.update_residual(np.arange(active.size))
            residual[active] = joint.residual
        energy_left = np.sum(np.abs(residual[active]) ** 2, axis=(1, 2, 3)) / energy[active]
        active = active[energy_left > MIN_LEFT]
        if not active.size:
            break
    return [make_echoes(fit, select_windows(windows, indices), maximum) for indices, maximum in echoes]


def _refine(
    fit: BoardFit, windows: Windows, echoes: list[tuple[NDArray, Maximum]], residual: NDArray[np.complex64]
) -> NDArray[np.int_]:
    """Fit the newest echo together with all others of its windows, and update `echoes` and `residual`.

    Returns the indices of the windows that keep the newest echo. A window drops it if it only splits another echo in
    two, as happens at the edge of a surface.
    """
    is_likely = _may_be_separate(fit, windows, echoes)
    refitted = echoes[-1][0][is_likely]
    newest = select_maxima(echoes[-1][1], is_likely)
    echoes[-1] = (refitted, newest)
    refitted_windows = select_windows(windows, refitted)
    joint = _fit_together(fit, refitted_windows, _select_echoes(echoes, refitted))
    widening = joint.find_widening()
    is_separate = widening[..., 0].max(axis=1) < MERGED_WIDENING
    for index, (windows_of_rank, maximum) in enumerate(echoes):
        values = joint.values[:, index]
        single_echo = replace_samples(refitted_windows, joint.residual + joint.synthesise(index))
        # Without iterations the path of the joint fit is kept, and only the amplitude is measured.
        refit = maximise(
            fit,
            add_up(fit, single_echo, values),
            refitted_windows.valid,
            refitted_windows.offsets,
            values,
            iterations=0,
        )
        # The other echoes make an echo's amplitude and path less certain.
        refit.amplitude_std = refit.amplitude_std * widening[:, index, 0]
        refit.std = refit.std * widening[:, index, 1:]
        rows = np.flatnonzero(np.isin(windows_of_rank, refitted))[is_separate]
        for field in fields(Maximum):
            getattr(maximum, field.name)[rows] = getattr(refit, field.name)[is_separate]
    residual[refitted[is_separate]] = joint.residual[is_separate]
    echoes[-1] = (refitted[is_separate], select_maxima(newest, is_separate))
    return refitted[is_separate]


def _may_be_separate(fit: BoardFit, windows: Windows, echoes: list[tuple[NDArray, Maximum]]) -> NDArray[np.bool_]:
    """Return False for windows of the newest echo if a fit to some of the positions finds it merged with another one.

    This saves time: most windows at the edges of plates have merged echoes, and their fits need the most steps.
    """
    newest_windows = echoes[-1][0]
    shape = fit.board.window_shape()
    thinned = choose_thinned(shape)
    if thinned.size == shape[0] * shape[1]:
        return np.ones(newest_windows.size, bool)
    thinned_windows = select_windows(select_positions(windows, thinned), newest_windows)
    joint = _fit_together(fit, thinned_windows, _select_echoes(echoes, newest_windows))
    return joint.find_widening()[..., 0].max(axis=1) < THINNED_WIDENING


def _fit_together(fit: BoardFit, windows: Windows, starts: list[Maximum]) -> JointFit:
    """Fit all echoes of windows together; where two have merged, from further starts, too."""
    values = np.stack([maximum.values for maximum in starts], axis=1)
    amplitude = np.stack([maximum.amplitude for maximum in starts], axis=1)
    joint = JointFit(fit, windows, values, amplitude)
    joint.run()
    joint.separate_merged_echoes()
    return joint


def _select_echoes(echoes: list[tuple[NDArray, Maximum]], window_indices: NDArray[np.int_]) -> list[Maximum]:
    """Return the echoes of some windows, one list entry per rank."""
    return [select_maxima(maximum, np.isin(windows, window_indices)) for windows, maximum in echoes]


def _compute_power_share(fit: BoardFit, windows: Windows, maximum: Maximum, energy: Array) -> Array:
    """Return the energy of an echo as a share of `energy`, that of its window, [window]."""
    count = windows.valid.sum(axis=1) * len(fit.rx_places_m)
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
    """Measure the amplitudes of echoes of known paths, in the windows around the stage offsets `at_m` [n, 3].

    `path_m` [n] are the paths there, `slope` [n, 2] and `bend` [n, 2, 2] their first and second derivatives by the
    stage offset. The path is not fitted: a maximum over paths would be too high, because noise adds to it, most of all
    where V nearly vanishes.
    Echoes with the same number in `window` [n] are fitted together, so that none disturbs another. Without `window`,
    each is measured as if it were alone.
    Echoes are measured if `is_measured` [n] is True (default: all) and their window lies inside the scan. Returns the
    measured echoes, and a mask [n] of these.
    """
    fit = BoardFit(board)
    height, width = board.window_shape()
    y = board.offsets_m[:, 0, 1]
    x = board.offsets_m[0, :, 0]
    rows = np.round(np.interp(at_m[:, 1], y, np.arange(y.size)) - (height - 1) / 2).astype(int)
    columns = np.round(np.interp(at_m[:, 0], x, np.arange(x.size)) - (width - 1) / 2).astype(int)
    values = pack_values(path_m, slope, bend)
    is_known = np.isfinite(at_m).all(axis=1) & np.isfinite(values).all(axis=1)
    is_inside = is_known & (rows >= 0) & (columns >= 0) & (rows <= y.size - height) & (columns <= x.size - width)
    if is_measured is not None:
        is_inside &= is_measured
    if window is None:
        window = np.arange(len(at_m))
    echoes_of_window: dict[int, list[int]] = {}
    for index in np.flatnonzero(is_known):
        echoes_of_window.setdefault(int(window[index]), []).append(int(index))
    # One group per measured echo: this echo first, then the others of its window.
    groups = []
    for index in np.flatnonzero(is_inside).tolist():
        others = [other for other in echoes_of_window[int(window[index])] if other != index]
        groups.append([index, *others])
    sizes = np.array([len(group) for group in groups], int)
    parts: list[Echoes] = []
    order: list[NDArray] = []
    # Groups of the same size are measured together.
    for size in np.unique(sizes):
        groups_of_size = np.flatnonzero(sizes == size)
        for start in range(0, groups_of_size.size, _ECHOES_AT_A_TIME):
            part = groups_of_size[start : start + _ECHOES_AT_A_TIME]
            # [group, echo]
            echo_indices = np.array([groups[index] for index in part])
            measured = echo_indices[:, 0]
            windows = gather_windows(board, rows[measured], columns[measured], at_m[measured])
            moved_values = _move_values(values[echo_indices], at_m[measured][:, None] - at_m[echo_indices])
            parts.append(_measure_windows(fit, windows, moved_values))
            order.append(part)
    if not parts:
        return make_empty_echoes(), is_inside
    return Echoes.join(parts)[np.argsort(np.concatenate(order))], is_inside


def _move_values(values: Array, offsets_m: Array) -> Array:
    """Return the values [..., 6] of paths at stage offsets that are `offsets_m` [..., 3] away."""
    x = offsets_m[..., 0]
    y = offsets_m[..., 1]
    path, slope_x, slope_y, xx, xy, yy = np.moveaxis(values, -1, 0)
    moved_path = path + slope_x * x + slope_y * y + xx * x * x / 2 + xy * x * y + yy * y * y / 2
    return np.stack([moved_path, slope_x + xx * x + xy * y, slope_y + xy * x + yy * y, xx, xy, yy], axis=-1)


def _measure_windows(fit: BoardFit, windows: Windows, values: Array) -> Echoes:
    """Measure the first echo of each window; all echoes have known `values` [window, echo, 6]."""
    first_values = values[:, 0]
    if values.shape[1] > 1:
        joint = JointFit(fit, windows, values, np.zeros(values.shape[:2]))
        widening = joint.fit_amplitudes()
        windows = replace_samples(windows, joint.residual + joint.synthesise(0))
    else:
        widening = np.ones(len(values))
    measured = maximise(
        fit, add_up(fit, windows, first_values), windows.valid, windows.offsets, first_values, iterations=0
    )
    measured.amplitude_std = measured.amplitude_std * widening
    return make_echoes(fit, windows, measured)
