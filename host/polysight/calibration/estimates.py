"""Estimates from recorded scans: the direct path with start offsets and filters, and the positions of the receivers.

The direct path in recorded bursts: start offset, delay and crystal error, and the receivers' high-pass filters.

IF of the direct path with delay tau, start delay dt of the board relative to the transmitter, and relative frequency
error p of the board's crystal:

    f = K tau + start offset + p (f_0 + 2 K t) - K dt        (docs/spec/scene-file.md)

A crystal error makes the IF drift by 2 p K within a chirp, which separates it from dt. `fit_start` estimates the start
offset that puts the direct path in the middle of the IF band.

`fit_filter` fits a high-pass filter to scans of one scene at several start frequencies: each puts the direct path at
another IF, and trigger jitter spreads it by about 200 kHz. The direct path itself does not change, so its level over IF
is the frequency response of the filter (paper, Fig. 9).

Estimate the positions of the receivers and the object plane from a scan of points at known positions.

Samples are referenced to the direct path, so the echo of a point at v, at stage offset u, has the phase
2 pi f d / c with the excess path

    d = |v - u - tx| + |v - u - rx| - |tx - rx|

The position of the transmitter in the rig file defines the frame. Unknowns are the shift of each receiving board (3),
the distance of the plane (1), and position (2) and rotation (1) of the target. The amplitude of each point is a free
complex number per board, eliminated by variable projection (Golub and Pereyra, SIAM J. Numer. Anal. 10, 1973), so that
only phase differences over aperture and frequency count. Least squares over positions, RX and frequencies, with
whitened noise. Each unknown has a prior (the accuracy of a ruler): an unknown that the scan does not determine stays
near the rig file, with the prior as its standard error.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.calibration.files import (
    BoardFilter,
    BoardPlace,
    BoardStart,
    PlacesFile,
    SourceScan,
    Vector,
    board_rows,
    header,
    places_crc32,
)
from polysight.imaging import Antennas, image_grid, reduction, row_offsets_m, scene_gate_m
from polysight.radar import direct_if_hz
from polysight.store import RawSource
from polysight.sync import (
    FOLD,
    AlignedRow,
    BoardSetup,
    HighPass,
    align_row,
    cis,
    fit_high_pass,
    noise_power,
    reference,
    synchronise_row,
    whole_blocks,
)
from polysight_shared.config import Board, Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError
from polysight_shared.geometry import specular_midpoint_m
from polysight_shared.raster import plan_raster
from polysight_shared.tables import decode, read_toml
from polysight_shared.units import SPEED_OF_LIGHT_M_S

FULL_SCALE = 32767
PASSBAND = 0.9  # of the sample rate
ROWS = 4  # rows of a scan used by `fit_start`
MIN_FOUND = 0.25  # smallest share of chirps with a direct path

DEPTH_M = 0.02  # largest deviation of the plane from the rig file
POSITIONS = 400  # positions used by the fit; more take longer and add little
_SEARCH_POSITIONS = 100  # positions used by the search for the target
_REACH_MM, _STEP_MM = 12.0, 1.5  # range of the search and its step, less than half a resolution cell
_MIN_NOISE = 1e-3  # noise power of a component of the reduced samples, relative to the largest, below which it is empty
_MIN_EXPLAINED = 0.3  # part of the power that the points must explain


@dataclass(frozen=True)
class DirectSignal:
    """The direct path of one board.

    Attributes
    ----------
    if_hz
        float64 [chirp]: IF in the chirps with a direct path; within the receiver's band, so it may be aliased.
    power, noise_power
        float64 [chirp]: squared amplitude as recorded (high-pass filter not compensated, noise included), and the
        noise power in it; ADC counts squared.
    expected_hz
        IF expected from geometry and start offsets in the rig file.
    drift_hz_per_s
        Change of the IF within a chirp.
    chirps
        Number of chirps received whole.
    """

    if_hz: NDArray[np.float64]
    power: NDArray[np.float64]
    noise_power: NDArray[np.float64]
    expected_hz: float
    drift_hz_per_s: float
    chirps: int

    @property
    def found(self) -> bool:
        """True if most chirps have a direct path."""
        return 2 * self.if_hz.size > self.chirps > 0

    def crystal_ppm(self, rig: Instrument) -> float:
        """Return the frequency error of the board's crystal relative to the transmitter's, ppm, from the drift."""
        return self.drift_hz_per_s / (2e-6 * rig.chirp.slope_hz_per_s)

    def start_delay_s(self, rig: Instrument) -> tuple[float, float]:
        """Return the mean start delay of the board relative to the transmitter, and its standard error; seconds."""
        chirp, (a, b) = rig.chirp, whole_blocks(rig.chirp.linear_samples)
        middle_hz = chirp.first_sample_hz + 2 * chirp.hz_per_sample * (a + b - 1) / 2
        expected = self.expected_hz + self.crystal_ppm(rig) * 1e-6 * middle_hz
        delay = (expected - unwrapped(self.if_hz, rig)) / chirp.slope_hz_per_s
        return float(delay.mean()), float(delay.std(ddof=1) / np.sqrt(delay.size)) if delay.size > 1 else np.inf


def band_hz(rig: Instrument) -> tuple[float, float]:
    """Return the IF band of the receiver, Hz: 0 to 0.9 sample rates (complex 1x) or +-0.45 (complex 2x)."""
    width = PASSBAND * rig.chirp.sample_rate_hz
    return (0.0, width) if rig.chirp.if_mode == "complex1x" else (-width / 2, width / 2)


def unwrapped(if_hz: NDArray[np.float64], rig: Instrument) -> NDArray[np.float64]:
    """Unwrap the IFs [chirp] of one direct path around their circular mean, where jitter crosses the band edge."""
    rate = rig.chirp.sample_rate_hz
    middle = np.angle(np.exp(2j * np.pi * if_hz / rate).sum()) * rate / (2 * np.pi)
    middle += rate * round((if_hz.mean() - middle) / rate)
    return middle + (if_hz - middle + rate / 2) % rate - rate / 2


def jitter_hz(rig: Instrument) -> float:
    """Return the IF change due to 5 ns of trigger uncertainty, Hz."""
    return rig.chirp.slope_hz_per_s * 5e-9


def find_direct(
    rig: Instrument, board: Board, words: NDArray[Any], valid: NDArray[np.bool_], setup: BoardSetup | None = None
) -> DirectSignal:
    """Find the direct path in bursts: words int16 [frame, sample, 2, rx], `valid` bool [frame] those received whole.

    `setup` is that of the board, if it exists already.
    """
    setup, chirp = setup or BoardSetup.of(rig, board), rig.chirp
    shape = (len(words) // setup.pulses, setup.pulses)
    aligned = align_row(
        words.reshape(*shape, *words.shape[1:]), valid.reshape(shape), chirp.linear_samples, setup.equaliser, FULL_SCALE
    )
    # The drift estimate is linearised: the first pass finds 2 ppm within a tenth, the second the rest.
    drift, time = reference(aligned, setup.path, chirp).drift, np.arange(aligned.halves.shape[-1]) * float(FOLD)
    time -= time.mean()
    flat = aligned._replace(halves=aligned.halves * cis(-0.5 * drift * time**2))
    done = reference(flat, setup.path, chirp)
    good = aligned.good & done.found[:, None]
    cycles = (done.frequency[:, None] + aligned.frequency)[good]
    power = _power(words[good.ravel()], cycles, setup, drift + done.drift)
    noise = _recorded_noise(aligned) * (np.abs(setup.path.estimator[0]) ** 2).sum() / FOLD
    cycles = cycles % 1.0 if chirp.if_mode == "complex1x" else (cycles + 0.5) % 1.0 - 0.5
    rate = chirp.sample_rate_hz
    return DirectSignal(
        cycles * rate,
        power,
        np.full(power.size, noise),
        direct_if_hz(rig, board),
        (drift + done.drift) * rate**2 / (2 * np.pi),  # its phase is `drift t^2 / 2`, t in samples
        int(valid.sum()),
    )


def _recorded_noise(aligned: AlignedRow) -> float:
    """Return the noise power of a recorded sample: the estimate divided by the gain of the filter compensation."""
    raised = (aligned.gain**2 * aligned.good).sum(axis=1) / np.maximum(aligned.good.sum(axis=1), 1)
    recorded = noise_power(aligned) / np.maximum(raised, 1e-12)
    return float(np.nanmedian(recorded)) if np.isfinite(recorded).any() else 0.0


def _power(
    words: NDArray[np.int16], cycles: NDArray[np.float64], setup: BoardSetup, drift: float
) -> NDArray[np.float64]:
    """Return the power of the direct path in each chirp [chirp], by the estimator that suppresses the object."""
    if not len(words):
        return np.zeros(0)
    a, b = whole_blocks(setup.chirp.linear_samples)
    n, path = b - a, setup.path
    time = np.arange(n) - (n - 1) / 2
    raw = words[:, a:b, 0] + 1j * words[:, a:b, 1].astype(np.float32)  # [chirp, sample, rx]
    still = raw * cis(-2 * np.pi * cycles[:, None] * time - 0.5 * drift * time**2)[..., None]
    folded = still.reshape(len(words), n // FOLD, FOLD, -1).mean(axis=2).swapaxes(1, 2) * path.folded_steering
    return np.abs(folded.reshape(len(words), -1) @ path.estimator[0]) ** 2


def fit_start(source: RawSource, board_name: str) -> BoardStart:
    """Estimate the start offset of a board from the IF of its direct path.

    Raises DataError if too few chirps have a direct path; the error gives the offset from geometry alone.
    """
    rig = source.instrument
    board = rig.by_name(board_name)
    setup = BoardSetup.of(rig, board)
    found = [find_direct(rig, board, words, ok, setup) for _, words, ok in board_rows(source, board_name, ROWS)]
    if_hz, chirps = np.concatenate([s.if_hz for s in found]), sum(s.chirps for s in found)
    expected = direct_if_hz(rig, board)
    if if_hz.size < max(2, MIN_FOUND * chirps):
        raise DataError(
            f"{source.scan_id}: only {if_hz.size} of {chirps} chirps show the direct path of {board_name}",
            "it lies outside the IF band and is filtered out, or something blocks it",
            f"by geometry alone start_offset_hz = {by_geometry(rig, board):.0f} for {board_name}; scan again with it",
            code=ErrorCode.NO_DATA,
        )
    if_hz = unwrapped(if_hz, rig)
    return start_of(rig, board, expected, float(if_hz.mean()), float(if_hz.std() / np.sqrt(if_hz.size)), if_hz.size)


def start_of(
    rig: Instrument, board: Board, expected_hz: float, seen_hz: float, error_hz: float, chirps: int
) -> BoardStart:
    """Return the start offset that moves a direct path, aliased to `seen_hz`, to the middle of the IF band."""
    rate, middle = rig.chirp.sample_rate_hz, sum(band_hz(rig)) / 2
    alias = round((expected_hz - seen_hz) / rate)
    offset = board.start_offset_hz + middle - (seen_hz + alias * rate)
    return BoardStart(
        float(round(offset)), board.start_offset_hz, seen_hz, error_hz, expected_hz, middle, alias, chirps
    )


def by_geometry(rig: Instrument, board: Board) -> float:
    """Return the start offset from the rig file's geometry alone, Hz."""
    return board.start_offset_hz + sum(band_hz(rig)) / 2 - direct_if_hz(rig, board)


Real = NDArray[np.float64]
FILTER_ROWS = 6  # rows used per scan
BIN_HZ = 10e3
MIN_CHIRPS = 6  # per bin
MIN_SNR = 20.0  # per bin, power ratio


def fit_filter(scans: list[RawSource], board_name: str) -> BoardFilter:
    """Fit the high-pass filter of a receiving board to scans of one scene at different start frequencies.

    Raises DataError if the direct path is not found, or the sweep does not determine the corners.
    """
    setups: dict[str, BoardSetup] = {}
    found = [_power_of_scan(scan, scan.instrument.by_name(board_name), setups) for scan in scans]
    if_hz, power, noise_power = (np.concatenate(parts) for parts in zip(*found, strict=True))
    middles, levels = binned(if_hz, power, noise_power)
    if middles.size == 0:
        raise DataError(
            f"no direct path of {board_name}", "see `polysight doctor`", "measure again", code=ErrorCode.NO_DATA
        )
    model = fit_high_pass(middles, levels)
    corners = np.array(model.corners_hz)
    errors, residual = _errors(middles, levels, corners)
    chirp = scans[0].instrument.chirp
    return BoardFilter(
        [float(c / 1e3) for c in corners],
        [float(e / 1e3) for e in errors],
        [chirp.hpf1_khz, chirp.hpf2_khz],
        float(middles[0] / 1e3),
        float(middles[-1] / 1e3),
        int(if_hz.size),
        residual,
    )


def _power_of_scan(scan: RawSource, board: Board, setups: dict[str, BoardSetup]) -> tuple[Real, Real, Real]:
    """Return IF (Hz), power and noise power (ADC counts squared) of the direct path in the chirps of some rows."""
    rig = scan.instrument
    key = f"{places_crc32(rig)} {rig.chirp} {rig.burst!r}"  # scans of one sweep share the setup
    if key not in setups:
        setups[key] = BoardSetup.of(rig, board)
    found = [
        find_direct(rig, board, words, ok, setups[key]) for _, words, ok in board_rows(scan, board.name, FILTER_ROWS)
    ]
    return (
        np.concatenate([s.if_hz for s in found]),
        np.concatenate([s.power for s in found]),
        np.concatenate([s.noise_power for s in found]),
    )


def binned(if_hz: Real, power: Real, noise_power: Real) -> tuple[Real, Real]:
    """Return mean IF and level without noise, in bins of `BIN_HZ` with enough chirps and signal; IF ascending.

    The level comes from the median power, so that chirps with a wrong direct path do not count.
    """
    bins = np.floor(if_hz / BIN_HZ).astype(int)
    groups = [(bins == b) & (if_hz > 0) for b in np.unique(bins)]
    means = [(if_hz[g].mean(), np.median(power[g]), noise_power[g].mean()) for g in groups if g.sum() >= MIN_CHIRPS]
    means = [(f, p - n) for f, p, n in means if p > MIN_SNR * n]
    return np.array([f for f, _ in means]), np.sqrt([s for _, s in means])


def _errors(if_hz: Real, level: Real, corners_hz: Real) -> tuple[Real, float]:
    """Return the standard errors of the corners (Hz), and the residual of the log levels (dB, RMS)."""

    def residual(logs: Real) -> Real:
        out = np.log(level) - np.log(np.abs(HighPass(tuple(np.exp(logs))).response(if_hz)))
        return out - out.mean()

    logs, step = np.log(corners_hz), 1e-4
    slopes = np.stack(
        [(residual(logs + d) - residual(logs - d)) / (2 * step) for d in step * np.eye(logs.size)], axis=1
    )
    rest = residual(logs)
    variance = float(rest @ rest) / max(1, rest.size - logs.size - 1)
    errors = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)) * variance)
    return errors * corners_hz, float(np.sqrt(np.mean(rest**2)) * 20 / np.log(10))


class TargetPoint(msgspec.Struct, frozen=True):
    """A scatterer of the target, millimetres along x and y from its middle."""

    position_mm: tuple[float, float]
    name: str = ""


class Target(msgspec.Struct, frozen=True):
    """A target file: `[[points]]`. Other keys are ignored, so that a scene file can be used too."""

    points: tuple[TargetPoint, ...] = ()


@dataclass(frozen=True)
class Prior:
    """Prior standard deviations of the unknowns."""

    board_mm: float = 5.0
    plane_mm: float = 5.0
    target_mm: float = 10.0
    turn_deg: float = 2.0

    def scale(self, boards: int) -> Real:
        """Return the standard deviation of each unknown."""
        return np.array([self.board_mm] * 3 * boards + [self.plane_mm, *2 * [self.target_mm], self.turn_deg])


@dataclass
class BoardEchoes:
    """Whitened samples of one board, from :func:`load_echoes`.

    Attributes
    ----------
    antennas
        Antennas by the rig file.
    samples
        complex128 [rx, position, k]: whitened samples, k their components.
    echo
        complex128 [k, frequency]: maps a spectrum to the components.
    offsets_m
        float64 [position, 3]: stage offsets.
    frequencies_hz
        float64 [frequency], evenly spaced.
    """

    antennas: Antennas
    samples: NDArray[np.complex128]
    echo: NDArray[np.complex128]
    offsets_m: Real
    frequencies_hz: Real


@dataclass
class PlacesFit:
    """Estimated unknowns (millimetres, degrees), their covariance, and the explained share of the power."""

    values: Real
    covariance: Real
    explained: float
    boards: list[str] = field(default_factory=list)

    @property
    def errors(self) -> Real:
        """Standard errors of the unknowns."""
        return np.sqrt(np.diag(self.covariance))


def read_target(path: Path) -> list[TargetPoint]:
    """Read the points of a target file. Raises ConfigError, and DataError for fewer than three."""
    points = list(decode(read_toml(path), Target, str(path)).points)
    if len(points) < 3:
        raise DataError(
            f"{path}: {len(points)} points",
            "two points do not separate rotation from shift",
            "give three or more [[points]] with position_mm = [x, y]",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    return points


def load_echoes(
    source: RawSource, rig: Instrument, filters: dict[str, HighPass | None] | None = None
) -> dict[str, BoardEchoes]:
    """Load the whitened samples of a scan by receiving board; `filters` are measured ones. Raises DataError."""
    return {b.name: _load_board(source, rig, b.name, (filters or {}).get(b.name)) for b in rig.receivers}


def fit_places(
    echoes: dict[str, BoardEchoes], rig: Instrument, points: list[TargetPoint], prior: Prior = Prior()
) -> PlacesFit:
    """Estimate the positions of boards, plane and target, starting from the rig file's, of standard deviation `prior`.

    `echoes` are those of :func:`load_echoes`.
    """
    mm = np.array([p.position_mm for p in points])
    centre = np.array(specular_midpoint_m(rig, rig.receivers[0]))
    scale = prior.scale(len(echoes))
    boards = list(echoes.values())

    def misfit(unknown: Real, sigma: float) -> Real:
        parts = [_residual(b, unknown[3 * i : 3 * i + 3], _places_m(centre, mm, unknown)) for i, b in enumerate(boards)]
        flat = np.concatenate([p.ravel() for p in parts]) / sigma
        return np.concatenate([flat.real, flat.imag, unknown / scale])

    start = np.zeros(scale.size)
    start[-3:-1] = _find_target(boards, centre, mm)
    size = sum(b.samples.size for b in boards)
    sigma = float(np.sqrt(np.mean(misfit(start, 1.0)[: 2 * size] ** 2)))
    found: Any = None
    for tolerance in (1e-3, 1e-6, 1e-8):  # each fit improves the estimate of the noise
        found = scipy.optimize.least_squares(
            misfit, start, args=(sigma,), method="lm", x_scale=scale / 10, ftol=tolerance, xtol=tolerance
        )
        start = found.x
        sigma *= float(np.sqrt(np.mean(found.fun[: 2 * size] ** 2)))
    power = sum(float((np.abs(b.samples) ** 2).sum()) for b in boards)
    explained = 1 - 2 * size * sigma**2 / power
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    return PlacesFit(found.x, covariance, explained, list(echoes))


def _load_board(source: RawSource, rig: Instrument, name: str, model: HighPass | None) -> BoardEchoes:
    """Synchronise a board's scan, reduce it to the range gate, equalise its RX and whiten its noise."""
    board, plan = rig.by_name(name), plan_raster(rig.grid)
    setup = BoardSetup.of(rig, board, model=model)
    every = tuple(Antennas.of(rig, b) for b in rig.receivers)
    gate = scene_gate_m(every, plan, image_grid(rig), DEPTH_M)
    maps = reduction(rig.chirp, gate)
    reduced, direct, offsets = [], [], []
    stride = max(1, int(np.ceil(np.sqrt(plan.positions / POSITIONS))))
    for row, words, valid in board_rows(source, name):
        if row % stride:
            continue
        synced = synchronise_row(words, valid, setup)
        keep = np.flatnonzero(synced.valid)[::stride]
        reduced.append(synced.samples[:, keep] @ maps.matrix.T)
        direct.append(synced.samples[:, keep] @ maps.direct)
        offsets.append(row_offsets_m(rig, plan.row(row))[keep])
    samples, gains = np.concatenate(reduced, axis=1), np.concatenate(direct, axis=1).mean(axis=1)
    if not samples.size or np.any(gains == 0):
        raise DataError(
            f"{source.scan_id}: no direct path of {name}",
            "see `polysight sync-report`",
            "scan again",
            code=ErrorCode.NO_DATA,
        )
    # Noise is white in the raw samples, so its covariance in the reduced samples is that of the reduction.
    power, directions = scipy.linalg.eigh(maps.matrix @ maps.matrix.conj().T)
    kept = power > _MIN_NOISE * power[-1]
    white = directions[:, kept].conj().T / np.sqrt(power[kept])[:, None]
    samples = (samples / gains[:, None, None]) @ white.T
    flat = np.concatenate(offsets)
    places = np.column_stack([flat, np.zeros(len(flat))])
    return BoardEchoes(Antennas.of(rig, board), samples, white @ maps.model, places, maps.frequencies_hz)


def _places_m(centre: Real, mm: Real, unknown: Real) -> Real:
    """Return the positions of the target's points, metres [point, 3], rig frame."""
    depth, x, y, turn = unknown[-4:]
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    flat = mm @ np.array([[c, s], [-s, c]]) + [x, y]
    return centre + np.column_stack([flat, np.full(len(mm), depth)]) / 1e3


def _design(board: BoardEchoes, shift_mm: Real, places_m: Real) -> NDArray[np.complex128]:
    """Return the echo of each point with amplitude one, complex [rx * position * k, point]."""
    tx, rx = board.antennas.tx_m, board.antennas.rx_m + np.asarray(shift_mm) / 1e3
    away = places_m[None] - board.offsets_m[:, None]  # [position, point, 3]
    out = np.linalg.norm(away - tx, axis=-1)
    back = np.linalg.norm(away[None] - rx[:, None, None], axis=-1)
    path = out + back - np.linalg.norm(rx - tx, axis=-1)[:, None, None]
    f = board.frequencies_hz / SPEED_OF_LIGHT_M_S
    step = _turns(path * (f[-1] - f[0]) / (f.size - 1))
    tones = np.empty((*path.shape, f.size), np.complex128)
    tones[..., 0] = _turns(path * f[0]) / (out * back)
    for k in range(1, f.size):  # evenly spaced
        np.multiply(tones[..., k - 1], step, out=tones[..., k])
    echoes = tones.reshape(-1, f.size) @ board.echo.T
    return echoes.reshape(*path.shape, -1).transpose(0, 1, 3, 2).reshape(-1, len(places_m))


def _turns(cycles: Real) -> NDArray[np.complex128]:
    """Return exp(2j pi cycles), accurate for many cycles."""
    return np.exp(2j * np.pi * (cycles - np.round(cycles)))


def _residual(board: BoardEchoes, shift_mm: Real, places_m: Real) -> NDArray[np.complex128]:
    """Return the samples minus the best-fitting sum of the points' echoes."""
    design, samples = _design(board, shift_mm, places_m), board.samples.reshape(-1)
    amplitude = np.linalg.lstsq(design.conj().T @ design, design.conj().T @ samples, rcond=1e-9)[0]
    return samples - design @ amplitude


def _find_target(boards: list[BoardEchoes], centre: Real, mm: Real) -> tuple[float, float]:
    """Return the position of the target on a coarse grid, millimetres: maximum of the power at all points."""
    best, found = -1.0, (0.0, 0.0)
    few = [_subset(b) for b in boards]
    steps = np.arange(-_REACH_MM, _REACH_MM + _STEP_MM / 2, _STEP_MM)
    for x in steps:
        for y in steps:
            places = _places_m(centre, mm, np.array([0.0, x, y, 0.0]))
            total = 0.0
            for board in few:
                design = _design(board, np.zeros(3), places)
                answer = design.conj().T @ board.samples.reshape(-1)
                total += float((np.abs(answer) ** 2 / (np.abs(design) ** 2).sum(axis=0)).sum())
            if total > best:
                best, found = total, (float(x), float(y))
    return found


def _subset(b: BoardEchoes) -> BoardEchoes:
    """Return the samples of one RX at some positions."""
    at = slice(None, None, -(-len(b.offsets_m) // _SEARCH_POSITIONS))
    antennas = Antennas(b.antennas.tx_m, b.antennas.rx_m[:1])
    return BoardEchoes(antennas, b.samples[:1, at], b.echo, b.offsets_m[at], b.frequencies_hz)


def places_file(rig: Instrument, fit: PlacesFit, points: int, sources: list[SourceScan]) -> PlacesFile:
    """Return a fit as a calibration file. Raises DataError if the points explain too little of the data."""
    if fit.explained < _MIN_EXPLAINED:
        raise DataError(
            f"the points explain {100 * fit.explained:.0f} % of the echoes",
            "another target was scanned, it lay more than a centimetre off the middle, or other objects reflect too",
            "check the target file; cover other reflecting objects",
            code=ErrorCode.MISMATCH,
        )
    errors, boards = fit.errors, {}
    for i, name in enumerate(fit.boards):
        own = slice(3 * i, 3 * i + 3)
        antennas = Antennas.of(rig, rig.by_name(name))
        before = antennas.rx_m[0] - antennas.tx_m
        after = before + fit.values[own] / 1e3
        along = after / np.linalg.norm(after)
        boards[name] = BoardPlace(
            _vector(fit.values[own]),
            _vector(errors[own]),
            float(np.linalg.norm(after) * 1e3),
            float(np.linalg.norm(before) * 1e3),
            float(np.sqrt(along @ fit.covariance[own, own] @ along)),
        )
    depth, x, y, turn = (float(v) for v in fit.values[-4:])
    return PlacesFile(
        **header("direct_path", sources),
        rig_crc32=places_crc32(rig),
        boards=boards,
        object_distance_mm=rig.geometry.object_distance_mm + depth,
        object_distance_was_mm=rig.geometry.object_distance_mm,
        object_distance_standard_error_mm=float(errors[-4]),
        target_mm=(x, y),
        target_standard_error_mm=(float(errors[-3]), float(errors[-2])),
        target_turn_deg=turn,
        target_turn_standard_error_deg=float(errors[-1]),
        explained=fit.explained,
        points=points,
    )


def _vector(values: Real) -> Vector:
    x, y, z = (float(v) for v in values)
    return x, y, z
