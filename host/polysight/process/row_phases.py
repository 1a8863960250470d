"""Find jumps of the phase between rows, displaced rows, and a drift of the phase, from the echoes of the rows alone.

Echoes of neighbouring positions are alike, so that rows predict each other. The echo of row k at position i is

    e(k, i) = sum over d = -2, -1, 1, 2 and t = -1, 0, 1 of w(d, t) e(k + d, i + t) + residual

with weights w fitted by least squares to the rows around. Where plates reflect, the residual has 15 to 30 % of the
echo's amplitude (rows 6 mm apart).

A jump of the phase between two rows comes, for example, from a cable that was touched. Referencing to the direct path
does not remove it if only the echo has it. If the phase jumps by phi before row n, the terms of the sum from the other
side of the jump have to be multiplied by exp(j phi) in rows k >= n, and by exp(-j phi) in rows k < n; least squares
gives phi. A jump where nothing reflects (gaps between plates, rows at the ends of the scan) is not seen, and one
between the last row of one plate and the first of the next looks like a difference of the plates.

A row that is not where the stage was commanded changes the echoes of both boards by the same shift times the slope of
each echo from row to row. The residual of each row shows this shift; where both boards show the same shifts, the rows
are displaced, and jumps are searched for in echoes without these shifts.

The phase of one board against the other may also drift over the rows (a cable or a board that warms up). The stage
moves the whole rig, so the phase of V / H is constant inside a plate unless it drifts. A field over y is fitted to the
phase of V / H along all plates together (Gaussian process). Drifts of some degrees are left to
`materials/common_change.py`; far larger ones are removed from the rows.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.materials import PhaseAlongPlate
from polysight.results import PhaseJump

# Rows on either side that an echo is predicted from, and positions on either side in each of them; chosen.
_PREDICTOR_ROWS = (-2, -1, 1, 2)
_PREDICTOR_POSITIONS = 1
# Rows on either side of a jump that the weights are fitted to; chosen.
_FIT_ROWS = 6
# Regularisation of that fit, relative to the mean power of a neighbour; chosen.
_RIDGE = 1e-3
# Least jump that is reported; chosen.
_LEAST_RAD = np.radians(9)
# The ratio of a jump is its angle divided by its error. Least value of ratio^2 / third largest ratio of all rows (a
# jump's neighbours have a share of it) with which the row of the largest ratio has a jump. Of 136 boards in drawn
# scenes without a jump, two thirds of them with rows 6 mm apart, which are predicted badly from their neighbours, the
# largest value is 1.5. Of jumps of 60 degrees 82 % reach 2, of 30 degrees 65 % (all simulated); with rows 2 mm apart
# those of 15 degrees reach 11.
_LEAST_CLEAR = 2.0
# Amplitude of the residual relative to the terms from the other side of a jump, above which a row is not used; chosen.
_MAX_ERROR = 1.0
# Least number of rows that are used: the largest ratio is compared with the third. Scenes with rows 12 mm apart, where
# a row is not predicted from its neighbours, use 3 to 5 rows, and seem to have jumps; others use 8 and more.
_LEAST_ROWS = 10
# Times that a jump is measured again after it was turned back: the weights were fitted to rows on both sides of it.
_REPEATS = 2
# Most jumps of a board that are searched for, one after another (a loose cable makes several); chosen.
_MOST_JUMPS = 4
# First rows of a scan, before which no jump is searched for; scans with fewer than twice as many have none. Chosen.
_END_ROWS = 3

JUMP_LEFT = 0.2
"""Standard deviation of a plate's phase after a jump of a board's phase was removed, relative to the jump. Most jumps
of 30 degrees are measured within 4 degrees, those at the rim of weak plates within 8 (simulated)."""
# Rows are displaced if the correlation of the shifts that both boards show, the normal deviate of this correlation, and
# the rms of the shifts are at least these. In ten scenes of another author's generator with rows 0.4 mm off the least
# correlation is 0.6, in 19 with rows in their places the largest is 0.15.
_LEAST_CORRELATION = 0.4
_LEAST_DEVIATE = 3.5
_LEAST_SHIFT_MM = 0.1
# Larger shifts are cut to so many standard deviations for the correlation.
_CUT_STDS = 3.0
# Rounds in which shifts are measured and removed; chosen.
_SHIFT_ROUNDS = 2
# Largest difference of a jump's size between these rounds; chosen.
_SAME_RAD = 0.2
# Rms of a row's shift against the mean of the four rows around it, divided by the rms of independent shifts of rows.
_AGAINST_NEIGHBOURS = 1.39

# Drifts of the phase over y: standard deviations in radians and correlation lengths in metres; chosen.
_DRIFT_STDS_RAD = (0.15, 0.4, 1.0)
_DRIFT_LENGTHS_M = (0.05, 0.1, 0.2)
# Differences between plates without a drift, all chosen. Standard deviation of a plate's phase by material and leakage:
# one of `_MATERIAL_SCALES` times (first value + second value / m), with m the plate's |V / H| relative to the largest
# of all plates: weak V has any phase.
_MATERIAL_STD_RAD = 0.1
_MATERIAL_STD_BY_WEAKNESS_RAD = 0.05
_MATERIAL_SCALES = (1.0, 3.0)
# Standard deviations of a plate's own slope (radians per metre), of its unevenness over the length that follows, and of
# single rows of pixels; all times one of `_OWN_SCALES`.
_OWN_SLOPE_STD = 1.5
_OWN_STD_RAD = 0.03
_OWN_LENGTH_M = 0.006
_ROW_STD_RAD = 0.02
_OWN_SCALES = (1.0, 3.0, 10.0)
# Standard deviation of the phase that all plates share, radians: so large that any phase is possible.
_COMMON_STD_RAD = 10.0
LEAST_PLATES = 3
"""Plates from which a drift is estimated; chosen."""
# A drift is reported and removed if ln(its probability / that of none) and its rms between the plates are at least
# these. In scenes of another author's generator with drifts of 30 to 90 degrees the logarithm is 35 and more, in
# undisturbed ones 4 at most; with tables, edge strips, ripple and a drift of gains together it is 17.
_LEAST_LOG_ODDS = 15.0
_LEAST_DRIFT_RAD = 0.15
# Phases to which a drift is fitted at most: a fit to 300 takes half a second.
_MOST_VALUES = 300
MOST_DRIFT_ROUNDS = 6
"""Times that a drift is measured, each time in images from which the last estimate was removed."""
DRIFT_DONE_RAD = 0.03
"""Change of the estimated drift (rms over the plates) below which no more images are formed; chosen."""


def find_phase_jumps(rows: Mapping[int, NDArray[np.complexfloating]]) -> tuple[PhaseJump, ...]:
    """Find the clear jumps of the phase from row to row, at most `_MOST_JUMPS`, in the order of rows.

    `rows`: number to echoes, complex [rx, position], positions from the smallest x. Numbers that are missing count as
    rows without echo. Each jump is turned back before the next one is searched for.
    """
    if len(rows) < 2 * _END_ROWS:
        return ()
    first = min(rows)
    echoes = _stack_rows({number - first: echo for number, echo in rows.items()}, max(rows) - first + 1)
    jumps: list[PhaseJump] = []
    while len(jumps) < _MOST_JUMPS:
        jump = _find_clearest_jump(echoes)
        # What is left of a jump is not counted as another one.
        if jump is None or any(abs(jump.row - other.row) <= 1 for other in jumps):
            break
        echoes[jump.row :] *= np.exp(-1j * jump.angle_rad)
        jumps.append(jump)
    return tuple(PhaseJump(first + jump.row, jump.angle_rad) for jump in sorted(jumps))


def _find_clearest_jump(echoes: NDArray[np.complex128]) -> PhaseJump | None:
    """Find the clearest jump of echoes [row, rx, position]; None if no jump is clear."""
    angles, errors = _measure_jumps(echoes)
    is_sound = errors < _MAX_ERROR
    ratio = np.zeros(len(angles))
    ratio[is_sound] = np.abs(angles[is_sound]) / errors[is_sound]
    if np.count_nonzero(is_sound) < _LEAST_ROWS:
        return None
    row = int(np.argmax(ratio))
    third = float(np.sort(ratio[is_sound])[-3])
    is_clear = ratio[row] ** 2 > _LEAST_CLEAR * third
    angle = float(angles[row])
    if not is_clear or abs(angle) < _LEAST_RAD:
        return None
    for _ in range(_REPEATS):
        turned = echoes.copy()
        turned[row:] *= np.exp(-1j * angle)
        angle += float(_measure_jumps(turned)[0][row])
    return PhaseJump(row, angle)


Neighbours = dict[int, list[NDArray[np.complex128]]]
"""Row k to its neighbours e(k + d, i + t), [rx * position, tap], for each d of `_PREDICTOR_ROWS`; a tap is one t."""
Products = dict[int, tuple[NDArray[np.complex128], NDArray[np.complex128]]]
"""Row k to N^H N and N^H e(k), with N [rx * position, d and tap] its neighbours: sums for least squares."""


def _collect_neighbours(echoes: NDArray[np.complex128]) -> tuple[Neighbours, Products]:
    """Return the neighbours of rows of echoes [row, rx, position], and their sums for least squares, by row."""
    count, rx, positions = echoes.shape
    padded = np.pad(echoes, ((0, 0), (0, 0), (_PREDICTOR_POSITIONS, _PREDICTOR_POSITIONS)))
    taps = 2 * _PREDICTOR_POSITIONS + 1
    # [row, rx, position, tap]
    shifted = np.stack([padded[:, :, k : k + positions] for k in range(taps)], axis=-1)
    targets = range(-_PREDICTOR_ROWS[0], count - _PREDICTOR_ROWS[-1])
    neighbours = {k: [shifted[k + d].reshape(rx * positions, taps) for d in _PREDICTOR_ROWS] for k in targets}
    products = {}
    for k in targets:
        all_neighbours = np.concatenate(neighbours[k], axis=1)
        adjoint = all_neighbours.conj().T
        products[k] = adjoint @ all_neighbours, adjoint @ echoes[k].ravel()
    return neighbours, products


def _fit_predictor(
    products: Sequence[tuple[NDArray[np.complex128], NDArray[np.complex128]]],
) -> NDArray[np.complex128] | None:
    """Return the weights [d and tap] that predict these rows best; None if they have no echo."""
    normal = np.sum([product for product, _ in products], axis=0)
    power = float(np.trace(normal).real) / len(normal)
    if power == 0:
        return None
    right = np.sum([product for _, product in products], axis=0)
    return np.linalg.solve(normal + _RIDGE * power * np.eye(len(normal)), right)


def _measure_jumps(echoes: NDArray[np.complex128]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the jump before each row, radians, and the error of that, [row]; the error is inf if it is unknown.

    The error is the amplitude of the residual relative to that of the terms from the other side of the jump.
    """
    count, rx, positions = echoes.shape
    taps = 2 * _PREDICTOR_POSITIONS + 1
    angles = np.zeros(count)
    errors = np.full(count, np.inf)
    neighbours, products = _collect_neighbours(echoes)
    for jump in range(_END_ROWS, count - _PREDICTOR_ROWS[-1]):
        fitted = [k for k in range(jump - _FIT_ROWS, jump + _FIT_ROWS) if k in products]
        coefficients = _fit_predictor([products[k] for k in fitted])
        if coefficients is None:
            continue
        predictor = coefficients.reshape(len(_PREDICTOR_ROWS), taps)
        # `turn` sums |beyond|^2 exp(j phi), with `beyond` the terms of a row from the other side of the jump.
        turn = 0j
        turned_power = 0.0
        residual = 0.0
        for k in range(jump + _PREDICTOR_ROWS[0], jump + _PREDICTOR_ROWS[-1]):
            if k not in products:
                continue
            beyond = np.zeros(rx * positions, complex)
            unpredicted = echoes[k].ravel().copy()
            for d, values, weights in zip(_PREDICTOR_ROWS, neighbours[k], predictor, strict=True):
                is_beyond = (k + d >= jump) != (k >= jump)
                if is_beyond:
                    beyond += values @ weights
                else:
                    unpredicted -= values @ weights
            # unpredicted = exp(-j phi) beyond in rows before the jump, exp(j phi) beyond in rows after it.
            product = np.vdot(beyond, unpredicted)
            turn += product.conjugate() if k < jump else product
            turned_power += float(np.vdot(beyond, beyond).real)
            residual += float(np.vdot(unpredicted - beyond, unpredicted - beyond).real)
        if turned_power > 0:
            angles[jump] = float(np.angle(turn))
            # sum |unpredicted - exp(+-j phi) beyond|^2 = sum |unpredicted - beyond|^2 - 2 (|turn| - Re turn)
            left = max(residual - 2 * (abs(turn) - turn.real), 0.0)
            errors[jump] = max(float(np.sqrt(left / turned_power)), 1e-6)
    return angles, errors


@dataclass(frozen=True)
class DisplacedRows:
    """Rows that are not where the stage was commanded.

    Attributes
    ----------
    shifts
        float64 [round, row]: shift of each row against its neighbours, in row spacings, measured after the shifts of
        the rounds before were removed. No rounds if no rows are displaced.
    rms_mm
        Root mean square of the rows' independent shifts; 0 if no rows are displaced.
    """

    shifts: NDArray[np.float64]
    rms_mm: float


NOT_DISPLACED = DisplacedRows(np.zeros((0, 0)), 0.0)


def find_displaced_rows(boards: Sequence[Mapping[int, NDArray[np.complexfloating]]], step_mm: float) -> DisplacedRows:
    """Find shifts of rows that the echoes of both boards share.

    `boards` are rows as of :func:`find_phase_jumps`; `step_mm` is the distance of rows.
    """
    if min(map(len, boards), default=0) < 2 * _FIT_ROWS:
        return NOT_DISPLACED
    count = 1 + max(map(max, boards))
    echoes = [_stack_rows(rows, count) for rows in boards]
    measured = [_measure_shifts(of_board) for of_board in echoes]
    is_known = np.isfinite([variances for _, variances in measured]).all(axis=0)
    if np.count_nonzero(is_known) < 2 * _FIT_ROWS:
        return NOT_DISPLACED
    known = np.array([shifts[is_known] for shifts, _ in measured])
    known -= np.median(known, axis=1)[:, None]
    # Rows beyond the plates, where nothing but edges echoes, may show any shift.
    largest = _CUT_STDS * 1.4826 * np.median(np.abs(known), axis=1)[:, None]
    covariance = np.cov(np.clip(known, -largest, largest))
    if not covariance.diagonal().all():
        return NOT_DISPLACED
    correlation = float(covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1]))
    # Fisher's transformation: a normal deviate if the boards' shifts had nothing in common.
    deviate = float(np.arctanh(min(correlation, 0.999)) * np.sqrt(known.shape[1] - 3))
    rms_mm = float(np.sqrt(max(covariance[0, 1], 0.0))) * step_mm / _AGAINST_NEIGHBOURS
    if correlation < _LEAST_CORRELATION or deviate < _LEAST_DEVIATE or rms_mm < _LEAST_SHIFT_MM:
        return NOT_DISPLACED
    rounds = [_average_shifts(measured)]
    for _ in range(1, _SHIFT_ROUNDS):
        echoes = [_shift_back(of_board, rounds[-1]) for of_board in echoes]
        rounds.append(_average_shifts([_measure_shifts(of_board) for of_board in echoes]))
    return DisplacedRows(np.array(rounds), rms_mm)


def keep_jumps_without_shifts(
    jumps: Sequence[PhaseJump], rows: Mapping[int, NDArray[np.complexfloating]], shifts: NDArray[np.float64]
) -> tuple[PhaseJump, ...]:
    """Return those of the `jumps` that the echoes still show, at the same row and as large, after each round of shifts.

    A row that is displaced looks like a jump, and so may one whose shift was measured wrongly.
    """
    echoes = _stack_rows(rows, shifts.shape[1])
    kept = list(jumps)
    for shifts_of_round in shifts:
        if not kept:
            break
        echoes = _shift_back(echoes, shifts_of_round)
        found = find_phase_jumps({number: echoes[number] for number in rows})
        kept = [
            jump
            for jump in found
            if any(jump.row == other.row and abs(jump.angle_rad - other.angle_rad) < _SAME_RAD for other in kept)
        ]
    return tuple(kept)


def _average_shifts(measured: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]]) -> NDArray[np.float64]:
    """Return the shifts [row] of both boards averaged by their variances; 0 where a variance is inf."""
    shifts, variances = (np.array(part) for part in zip(*measured, strict=True))
    is_known = np.isfinite(variances).all(axis=0)
    precision = np.where(is_known, 1 / variances, 0.0)
    return np.where(is_known, (precision * shifts).sum(axis=0) / np.where(is_known, precision.sum(axis=0), 1.0), 0.0)


def _shift_back(echoes: NDArray[np.complex128], shifts: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Return echoes [row, rx, position] without the shifts [row] of the rows, in row spacings."""
    return echoes - shifts[:, None, None] * _slope_over_rows(echoes)


def _stack_rows(rows: Mapping[int, NDArray[np.complexfloating]], count: int) -> NDArray[np.complex128]:
    """Return echoes [row, rx, position] of `count` rows; those that are missing are 0."""
    echoes = np.zeros((count, *next(iter(rows.values())).shape), complex)
    for number, echo in rows.items():
        echoes[number] = echo
    return echoes


def _slope_over_rows(echoes: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return the change of echoes [row, rx, position] per row, from two rows on either side; 0 at the ends."""
    slope = np.zeros_like(echoes)
    slope[2:-2] = (8 * (echoes[3:-1] - echoes[1:-3]) - (echoes[4:] - echoes[:-4])) / 12
    return slope


def _measure_shifts(echoes: NDArray[np.complex128]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the shift of each row against its neighbours, in row spacings, and its variance but for a factor, [row].

    The shift is the least-squares factor of the slope in the residual of the prediction. The variance is inf where a
    row without echo is involved.
    """
    count = len(echoes)
    slopes = _slope_over_rows(echoes)
    power = np.sum(np.abs(echoes) ** 2, axis=(1, 2))
    neighbours, products = _collect_neighbours(echoes)
    shifts = np.zeros(count)
    variances = np.full(count, np.inf)
    for row in products:
        fitted = [products[k] for k in range(row - _FIT_ROWS, row + _FIT_ROWS + 1) if k in products]
        predictor = _fit_predictor(fitted)
        slope = slopes[row].ravel()
        slope_power = float(np.vdot(slope, slope).real)
        if predictor is None or slope_power == 0 or not power[row - 2 : row + 3].all():
            continue
        residual = echoes[row].ravel() - np.concatenate(neighbours[row], axis=1) @ predictor
        shifts[row] = float(np.vdot(slope, residual).real) / slope_power
        variances[row] = max(float(np.vdot(residual, residual).real), 1e-9 * float(power[row])) / slope_power
    return shifts, variances


@dataclass(frozen=True)
class PhaseDrift:
    """Estimated drift of the phase of V / H over y, the slow axis.

    Attributes
    ----------
    log_odds
        Logarithm of the probability of a drift over that of none.
    rms_rad, range_rad
        Root mean square of the drift over the plates, and its largest difference between two of them.
    left_rad
        Standard deviation of its error at a plate against another plate.
    of_v
        True if the phase of V has larger slopes inside the plates than that of H: then V drifts, otherwise H.
    field
        The field that was fitted.
    """

    log_odds: float
    rms_rad: float
    range_rad: float
    left_rad: float
    of_v: bool
    field: _DriftField

    @property
    def clear(self) -> bool:
        """True if there is a drift far beyond what plates and materials do."""
        return self.log_odds > _LEAST_LOG_ODDS and self.rms_rad > max(_LEAST_DRIFT_RAD, 2 * self.left_rad)

    def at(self, y_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the drift of the phase of V / H in the image at y, radians; 0 on average over the plates."""
        return self.field.mean(y_m) - float(np.mean(self.field.mean(self.field.centres_m)))


@dataclass(frozen=True)
class _DriftField:
    """Gaussian process for the phase of V / H along y, averaged over its cases by their evidence.

    Attributes
    ----------
    y_m, centres_m
        [value]: y of the measured phases. [plate]: y of the middle of each plate's rows.
    cases
        Of each case: weight; standard deviation (radians) and correlation length (metres) of the drift; covariance S of
        the measured phases s, [value, value]; and S^-1 s, [value].
    """

    y_m: NDArray[np.float64]
    centres_m: NDArray[np.float64]
    cases: Sequence[tuple[float, float, float, NDArray[np.float64], NDArray[np.float64]]]

    def mean(self, y_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the expected drift at y, radians, but for a constant."""
        parts = [w * _drift_covariance(std, length, y_m, self.y_m) @ answer for w, std, length, _, answer in self.cases]
        return np.sum(parts, axis=0)

    def covariance(self, y_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the covariance of the drift's errors at y: its mean over the cases plus that of the cases' means."""
        mean = self.mean(y_m)
        total = np.zeros((y_m.size, y_m.size))
        for weight, std, length, measured, answer in self.cases:
            with_measured = _drift_covariance(std, length, y_m, self.y_m)
            explained = with_measured @ np.linalg.solve(measured, with_measured.T)
            away = with_measured @ answer - mean
            total += weight * (_drift_covariance(std, length, y_m, y_m) - explained + np.outer(away, away))
        return total


def _drift_covariance(
    std_rad: float, length_m: float, a_m: NDArray[np.float64], b_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the covariance of a drift between places along y, [a, b]."""
    return std_rad**2 * np.exp(-0.5 * ((a_m[:, None] - b_m[None]) / length_m) ** 2)


def estimate_phase_drift(
    plates: Sequence[PhaseAlongPlate], removed: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
) -> PhaseDrift:
    """Estimate the drift of the phase of V / H over y from three plates or more.

    `removed` are y (metres, ascending) and the drift that the images are without, radians: it is added to what they
    show, so that the estimate is always that of the whole drift.
    """
    # Of many plates every second, third ... row of pixels is enough.
    step = 1 + sum(plate.y_m.size for plate in plates) // _MOST_VALUES
    places_m = [plate.y_m[::step] for plate in plates]
    phases = [plate.phase_rad[::step] for plate in plates]
    if removed is not None:
        phases = [phase + np.interp(y_m, *removed) for y_m, phase in zip(places_m, phases, strict=True)]
    number = np.concatenate([np.full(y_m.size, number) for number, y_m in enumerate(places_m)])
    y_m = np.concatenate(places_m)
    centres_m = np.array([y_m.mean() for y_m in places_m])
    levels = np.array([plate.level for plate in plates])
    field, log_odds = _fit_drift(y_m, _join_turns(phases, centres_m), number, centres_m, levels)
    drift = field.mean(centres_m)
    away = np.eye(centres_m.size) - 1 / centres_m.size
    error = away @ field.covariance(centres_m) @ away.T
    steps_of_v = sum(plate.step_v_rad**2 for plate in plates)
    steps_of_h = sum(plate.step_h_rad**2 for plate in plates)
    return PhaseDrift(
        log_odds=log_odds,
        rms_rad=float(np.std(drift)),
        range_rad=float(np.ptp(drift)),
        left_rad=float(np.sqrt(2 * max(np.mean(np.diag(error)), 0.0))),
        of_v=steps_of_v > steps_of_h,
        field=field,
    )


def _join_turns(phases: Sequence[NDArray[np.float64]], centres_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return all phases in one array, with each plate moved by whole turns as near as possible to those below it.

    "Below" is along y: the mean of the last `LEAST_PLATES` plates counts. The mean of all phases is subtracted.
    """
    joined: dict[int, NDArray[np.float64]] = {}
    level = 0.0
    for number in np.argsort(centres_m, kind="stable").tolist():
        mean = float(phases[number].mean())
        if not joined:
            level = mean
        joined[number] = phases[number] - 2 * np.pi * np.round((mean - level) / (2 * np.pi))
        level = float(np.mean([p.mean() for p in list(joined.values())[-LEAST_PLATES:]]))
    together = np.concatenate([joined[number] for number in range(len(phases))])
    return together - together.mean()


def _fit_drift(
    y_m: NDArray[np.float64],
    phase: NDArray[np.float64],
    plate: NDArray[np.int64],
    centres_m: NDArray[np.float64],
    level: NDArray[np.float64],
) -> tuple[_DriftField, float]:
    """Fit drifts to the phases [value] of plates; return the field and the log odds of a drift.

    `plate` [value] is the number of the plate, `centres_m` [plate] its middle, `level` [plate] its |V / H|.
    """
    material_std = _MATERIAL_STD_RAD + _MATERIAL_STD_BY_WEAKNESS_RAD * level.max() / level
    material_variance = np.minimum(material_std, np.pi)[plate] ** 2
    same = plate[:, None] == plate[None]
    from_middle = y_m - centres_m[plate]
    slope = np.outer(from_middle, from_middle)
    uneven = np.exp(-0.5 * ((y_m[:, None] - y_m[None]) / _OWN_LENGTH_M) ** 2)
    drifts = [(0.0, 1.0), *itertools.product(_DRIFT_STDS_RAD, _DRIFT_LENGTHS_M)]
    cases = []
    evidences = []
    for material, scale, (std, length) in itertools.product(_MATERIAL_SCALES, _OWN_SCALES, drifts):
        own = (
            (_OWN_SLOPE_STD * scale) ** 2 * slope
            + (_OWN_STD_RAD * scale) ** 2 * uneven
            + material_variance * material**2
        )
        covariance = same * own + (_ROW_STD_RAD * scale) ** 2 * np.eye(y_m.size) + _COMMON_STD_RAD**2
        covariance = covariance + _drift_covariance(std, length, y_m, y_m)
        factor = scipy.linalg.cholesky(covariance, lower=True)
        answer = scipy.linalg.cho_solve((factor, True), phase)
        prior = 0.0 if std == 0 else -np.log(len(drifts) - 1)
        evidences.append(prior - 0.5 * float(phase @ answer) - float(np.log(np.diag(factor)).sum()))
        cases.append((std, length, covariance, answer))
    evidence = np.array(evidences)
    is_drift = np.array([std > 0 for std, _, _, _ in cases])
    weights = np.exp(evidence - evidence.max())
    weights /= weights.sum()
    log_odds = float(scipy.special.logsumexp(evidence[is_drift]) - scipy.special.logsumexp(evidence[~is_drift]))
    # Cases of less weight change nothing.
    kept = [(float(w), *case) for w, case in zip(weights, cases, strict=True) if w > 1e-4]
    return _DriftField(y_m, centres_m, kept), log_odds
