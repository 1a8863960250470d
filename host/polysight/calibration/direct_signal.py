"""Estimate start offset, start delay and crystal error of a board, and its high-pass filter, from the direct path.

The IF of the direct path at the time t after the first sample is

    f = K tau + start offset + p (f_0 + 2 K t) - K dt        (docs/spec/scene-file.md)

with tau the delay of the direct path, dt the start delay of the board relative to the transmitter, p the relative
frequency error of the board's crystal, f_0 the transmit frequency of the first sample, and K the slope of the chirp.
A crystal error makes the IF drift by 2 p K within a chirp, which distinguishes it from dt. `fit_start` estimates the
start offset that puts the direct path in the middle of the IF band.

`fit_filter` fits a high-pass filter to scans of one scene at several start frequencies: each puts the direct path at
another IF, and trigger jitter spreads it by about 200 kHz. The direct path itself does not change, so its level over IF
is the frequency response of the filter (POLySIGHT paper, Fig. 9).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight import sync
from polysight.calibration.files import BoardFilter, BoardStart, places_crc32, read_board_rows
from polysight.radar import direct_if_hz
from polysight.store import RawSource
from polysight_shared.config import Board, Instrument
from polysight_shared.errors import DataError, ErrorCode

Real = NDArray[np.float64]

# Largest value of a 16-bit word of the card.
FULL_SCALE = 32767
# Share of the sample rate that the receiver's filter passes (TI).
PASSBAND = 0.9
# Rows of a scan used by `fit_start`, and by `fit_filter`, which spreads their chirps over many bins of the IF; chosen.
START_ROWS = 4
FILTER_ROWS = 6
# Smallest share of chirps with a direct path with which a start offset is estimated; chosen.
MIN_FOUND = 0.25
# Width of a bin of the filter's response, and the chirps and the SNR (power ratio) that each needs; chosen.
BIN_HZ = 10e3
MIN_CHIRPS = 6
MIN_SNR = 20.0


@dataclass(frozen=True)
class DirectSignal:
    """The direct path of one board.

    Attributes
    ----------
    if_hz
        float64 [chirp]: IF in the chirps with a direct path, as sampled: it may be aliased.
    power, noise_power
        float64 [chirp]: squared amplitude as recorded (high-pass filter not compensated, noise included), and the
        noise power in it; ADC counts squared.
    expected_hz
        IF expected from geometry and start offsets in the rig file.
    drift_hz_per_s
        Change of the IF within a chirp.
    chirps
        Number of chirps received whole.
    rx_order
        Places in the rig file of the recorded RX, counted from 1, if they show another order; empty otherwise.
    """

    if_hz: NDArray[np.float64]
    power: NDArray[np.float64]
    noise_power: NDArray[np.float64]
    expected_hz: float
    drift_hz_per_s: float
    chirps: int
    rx_order: tuple[int, ...] = ()

    @property
    def found(self) -> bool:
        """True if most chirps have a direct path."""
        return 2 * self.if_hz.size > self.chirps > 0

    def crystal_ppm(self, rig: Instrument) -> float:
        """Return the frequency error of the board's crystal relative to the transmitter's, ppm, from the drift."""
        return self.drift_hz_per_s / (2e-6 * rig.chirp.slope_hz_per_s)

    def start_delay_s(self, rig: Instrument) -> tuple[float, float]:
        """Return the mean start delay of the board relative to the transmitter, and its standard error; seconds.

        An IF expected beyond the band was aliased: whole sample rates bring it near the expected one.
        """
        chirp = rig.chirp
        first, end = sync.whole_blocks(chirp.linear_samples)
        middle_sample = (first + end - 1) / 2
        # f_0 + 2 K t in the middle of the samples that the IF is estimated from: the crystal error adds p times this.
        if_per_crystal_error_hz = chirp.first_sample_hz + 2 * chirp.hz_per_sample * middle_sample
        expected_if_hz = self.expected_hz + self.crystal_ppm(rig) * 1e-6 * if_per_crystal_error_hz
        if_hz = unwrap_if(self.if_hz, rig)
        low, high = band_hz(rig)
        if not low <= self.expected_hz <= high:
            if_hz += chirp.sample_rate_hz * round((expected_if_hz - if_hz.mean()) / chirp.sample_rate_hz)
        delay = (expected_if_hz - if_hz) / chirp.slope_hz_per_s
        standard_error = np.inf
        if delay.size > 1:
            standard_error = float(delay.std(ddof=1) / np.sqrt(delay.size))
        return float(delay.mean()), standard_error


def band_hz(rig: Instrument) -> tuple[float, float]:
    """Return the IF band of the receiver, Hz: 0 to 0.9 sample rates (complex 1x) or +-0.45 (complex 2x)."""
    width = PASSBAND * rig.chirp.sample_rate_hz
    if rig.chirp.if_mode == "complex1x":
        return (0.0, width)
    return (-width / 2, width / 2)


def unwrap_if(if_hz: NDArray[np.float64], rig: Instrument) -> NDArray[np.float64]:
    """Return the IFs [chirp] of one direct path, each within half a sample rate of their circular mean.

    Where jitter crosses the band's edge, IFs of one path lie at both of its ends.
    """
    rate = rig.chirp.sample_rate_hz
    middle = np.angle(np.exp(2j * np.pi * if_hz / rate).sum()) * rate / (2 * np.pi)
    middle += rate * round((if_hz.mean() - middle) / rate)
    return middle + (if_hz - middle + rate / 2) % rate - rate / 2


def jitter_hz(rig: Instrument) -> float:
    """Return the IF change due to 5 ns of trigger uncertainty, one clock of the radar at 200 MHz; Hz."""
    return rig.chirp.slope_hz_per_s * 5e-9


def find_direct(
    rig: Instrument, board: Board, words: NDArray[Any], valid: NDArray[np.bool_], setup: sync.BoardSetup | None = None
) -> DirectSignal:
    """Find the direct path in bursts; `words` int16 [chirp, sample, 2, rx], I before Q.

    `valid` bool [chirp] is true for those received whole; `setup` is that of the board, if it exists already.
    """
    setup = setup or sync.BoardSetup.from_rig(rig, board)
    chirp = rig.chirp
    shape = (len(words) // setup.pulses, setup.pulses)
    aligned = sync.align_row(
        words.reshape(*shape, *words.shape[1:]), valid.reshape(shape), chirp.linear_samples, setup.equaliser, FULL_SCALE
    )
    # The drift estimate is linearised: the first pass finds 2 ppm within a tenth, the second the rest. `halves` are two
    # averages of a position's chirps, mixed down, with one sample for every `FOLD` recorded ones; time is in recorded
    # samples, so the drift is in radians per sample squared, and the frequencies are in cycles per sample.
    drift = sync.reference(aligned, setup.path, chirp).drift
    time = np.arange(aligned.halves.shape[-1]) * float(sync.FOLD)
    time -= time.mean()
    drift_free = aligned._replace(halves=aligned.halves * sync.cis(-0.5 * drift * time**2))
    referenced = sync.reference(drift_free, setup.path, chirp)
    has_direct_path = aligned.good & referenced.found[:, None]
    cycles = (referenced.frequency[:, None] + aligned.frequency)[has_direct_path]
    power = _measure_power(words[has_direct_path.ravel()], cycles, setup, drift + referenced.drift)
    # The amplitude is a weighted sum of means of `FOLD` samples: this share of a sample's noise remains in it. Row 0
    # of the estimator has the weights of the amplitude.
    share_of_noise = (np.abs(setup.path.estimator[0]) ** 2).sum() / sync.FOLD
    noise = _estimate_recorded_noise(aligned, referenced.noise) * share_of_noise
    # Frequencies that differ by a whole cycle per sample are the same: bring them into the receiver's band.
    if chirp.if_mode == "complex1x":
        cycles = cycles % 1.0
    else:
        cycles = (cycles + 0.5) % 1.0 - 0.5
    rate = chirp.sample_rate_hz
    # The phase of a drifting IF is drift t^2 / 2 with t in samples: its frequency changes by drift / (2 pi) a sample.
    drift_hz_per_s = (drift + referenced.drift) * rate**2 / (2 * np.pi)
    return DirectSignal(
        if_hz=cycles * rate,
        power=power,
        noise_power=np.full(power.size, noise),
        expected_hz=direct_if_hz(rig, board),
        drift_hz_per_s=drift_hz_per_s,
        chirps=int(valid.sum()),
        rx_order=sync.find_rx_order(
            drift_free, referenced, setup.path, lambda row, path: sync.reference(row, path, chirp)
        ),
    )


def _estimate_recorded_noise(aligned: sync.AlignedRow, noise: NDArray[np.float64]) -> float:
    """Return the noise power of a recorded sample: the estimate divided by the power gain of the filter compensation.

    `noise` [position] is the estimate after compensation; the result is the median, 0 if nothing is known.
    """
    good_chirps = np.maximum(aligned.good.sum(axis=1), 1)
    power_gain = (aligned.gain**2 * aligned.good).sum(axis=1) / good_chirps
    recorded_noise = noise / np.maximum(power_gain, 1e-12)
    if np.isfinite(recorded_noise).any():
        return float(np.nanmedian(recorded_noise))
    return 0.0


def _measure_power(
    words: NDArray[np.int16], cycles: NDArray[np.float64], setup: sync.BoardSetup, drift: float
) -> NDArray[np.float64]:
    """Return the power of the direct path in each chirp [chirp], by the estimator that suppresses the object.

    `words` int16 [chirp, sample, 2, rx]; `cycles` [chirp] is the IF in cycles per sample, `drift` its change in radians
    per sample squared.
    """
    if not len(words):
        return np.zeros(0)
    first, end = sync.whole_blocks(setup.chirp.linear_samples)
    n = end - first
    path = setup.path
    time = np.arange(n) - (n - 1) / 2
    # [chirp, sample, rx], then mixed down to a constant
    raw = words[:, first:end, 0] + 1j * words[:, first:end, 1].astype(np.float32)
    derotated = raw * sync.cis(-2 * np.pi * cycles[:, None] * time - 0.5 * drift * time**2)[..., None]
    # Means of `FOLD` samples, [chirp, rx, block], with the phases of all RX made equal.
    blocks = derotated.reshape(len(words), n // sync.FOLD, sync.FOLD, -1).mean(axis=2).swapaxes(1, 2)
    folded = blocks * path.folded_steering
    amplitude = folded.reshape(len(words), -1) @ path.estimator[0]
    return np.abs(amplitude) ** 2


def fit_start(source: RawSource, board_name: str) -> BoardStart:
    """Estimate the start offset of a board from the IF of its direct path.

    Raises DataError if too few chirps have a direct path; the error gives the offset from geometry alone.
    """
    rig = source.instrument
    board = rig.by_name(board_name)
    setup = sync.BoardSetup.from_rig(rig, board)
    signals = [
        find_direct(rig, board, words, ok, setup) for _, words, ok in read_board_rows(source, board_name, START_ROWS)
    ]
    if_hz = np.concatenate([s.if_hz for s in signals])
    chirps = sum(s.chirps for s in signals)
    expected = direct_if_hz(rig, board)
    if if_hz.size < max(2, MIN_FOUND * chirps):
        raise DataError(
            f"{source.scan_id}: only {if_hz.size} of {chirps} chirps show the direct path of {board_name}",
            "it lies outside the IF band and is filtered out, or something blocks it",
            f"by geometry alone start_offset_hz = {predict_by_geometry(rig, board):.0f} for {board_name};"
            " scan again with it",
            code=ErrorCode.NO_DATA,
        )
    if_hz = unwrap_if(if_hz, rig)
    return choose_start_offset(
        rig, board, expected, float(if_hz.mean()), float(if_hz.std() / np.sqrt(if_hz.size)), if_hz.size
    )


def choose_start_offset(
    rig: Instrument, board: Board, expected_hz: float, seen_hz: float, error_hz: float, chirps: int
) -> BoardStart:
    """Return the start offset that moves a direct path, aliased to `seen_hz`, to the middle of the IF band.

    `expected_hz` is the IF of the direct path by the rig file, from which the number of sample rates follows by which
    it is aliased. `error_hz` is the standard error of `seen_hz` over `chirps` chirps. The offset is rounded to 1 Hz.
    """
    rate = rig.chirp.sample_rate_hz
    middle = sum(band_hz(rig)) / 2
    alias = round((expected_hz - seen_hz) / rate)
    offset = board.start_offset_hz + middle - (seen_hz + alias * rate)
    return BoardStart(
        start_offset_hz=float(round(offset)),
        start_offset_was_hz=board.start_offset_hz,
        direct_if_hz=seen_hz,
        direct_if_standard_error_hz=error_hz,
        expected_if_hz=expected_hz,
        middle_hz=middle,
        alias=alias,
        chirps=chirps,
    )


def predict_by_geometry(rig: Instrument, board: Board) -> float:
    """Return the start offset, Hz, that puts the direct path in the middle of the band by the rig's geometry alone."""
    return board.start_offset_hz + sum(band_hz(rig)) / 2 - direct_if_hz(rig, board)


def fit_filter(scans: list[RawSource], board_name: str) -> BoardFilter:
    """Fit the high-pass filter of a receiving board to scans of one scene at different start frequencies.

    Raises DataError if the direct path is not found, or the sweep does not determine the corners.
    """
    setups: dict[str, sync.BoardSetup] = {}
    powers = [_measure_power_of_scan(scan, scan.instrument.by_name(board_name), setups) for scan in scans]
    if_hz, power, noise_power = (np.concatenate(parts) for parts in zip(*powers, strict=True))
    middles, levels = average_in_bins(if_hz, power, noise_power)
    if middles.size == 0:
        raise DataError(
            f"no direct path of {board_name}", "see `polysight doctor`", "measure again", code=ErrorCode.NO_DATA
        )
    model = sync.fit_high_pass(middles, levels)
    corners = np.array(model.corners_hz)
    errors, residual = _estimate_corner_errors(middles, levels, corners)
    chirp = scans[0].instrument.chirp
    return BoardFilter(
        corners_khz=[float(c / 1e3) for c in corners],
        standard_error_khz=[float(e / 1e3) for e in errors],
        programmed_khz=[chirp.hpf1_khz, chirp.hpf2_khz],
        if_from_khz=float(middles[0] / 1e3),
        if_to_khz=float(middles[-1] / 1e3),
        chirps=int(if_hz.size),
        residual_db=residual,
    )


def _measure_power_of_scan(
    scan: RawSource, board: Board, setups: dict[str, sync.BoardSetup]
) -> tuple[Real, Real, Real]:
    """Return IF (Hz), power and noise power (ADC counts squared) of the direct path in chirps of some rows, [chirp]."""
    rig = scan.instrument
    # Scans of one sweep share the setup: it depends on the places of antennas and object, the chirp and the burst.
    key = f"{places_crc32(rig)} {rig.chirp} {rig.burst!r}"
    if key not in setups:
        setups[key] = sync.BoardSetup.from_rig(rig, board)
    signals = [
        find_direct(rig, board, words, ok, setups[key])
        for _, words, ok in read_board_rows(scan, board.name, FILTER_ROWS)
    ]
    return (
        np.concatenate([s.if_hz for s in signals]),
        np.concatenate([s.power for s in signals]),
        np.concatenate([s.noise_power for s in signals]),
    )


def average_in_bins(if_hz: Real, power: Real, noise_power: Real) -> tuple[Real, Real]:
    """Return mean IF (Hz) and amplitude without noise, [bin], in bins of `BIN_HZ` with enough chirps and signal.

    `if_hz`, `power` and `noise_power` are of one chirp each, [chirp], in any order; the bins' IFs ascend. Chirps of a
    negative IF are left out. The level comes from the median power, so that chirps with a wrong direct path do not
    count.
    """
    bin_of_chirp = np.floor(if_hz / BIN_HZ).astype(int)
    mean_if_hz = []
    signal_power = []
    for bin_number in np.unique(bin_of_chirp):
        is_in_bin = (bin_of_chirp == bin_number) & (if_hz > 0)
        if is_in_bin.sum() < MIN_CHIRPS:
            continue
        total = np.median(power[is_in_bin])
        noise = noise_power[is_in_bin].mean()
        if total > MIN_SNR * noise:
            mean_if_hz.append(if_hz[is_in_bin].mean())
            signal_power.append(total - noise)
    return np.array(mean_if_hz), np.sqrt(signal_power)


def _estimate_corner_errors(if_hz: Real, level: Real, corners_hz: Real) -> tuple[Real, float]:
    """Return the standard errors of the corners [corner], Hz, and the residual of the levels [bin], dB (RMS)."""

    def residual(logs: Real) -> Real:
        log_misfit = np.log(level) - np.log(np.abs(sync.HighPass(tuple(np.exp(logs))).response(if_hz)))
        return log_misfit - log_misfit.mean()

    logs = np.log(corners_hz)
    step = 1e-4
    slopes = np.stack(
        [(residual(logs + d) - residual(logs - d)) / (2 * step) for d in step * np.eye(logs.size)], axis=1
    )
    misfit = residual(logs)
    # Least squares. The parameters are the corners and the level, which the subtraction of the mean fits.
    variance = float(misfit @ misfit) / max(1, misfit.size - logs.size - 1)
    errors = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)) * variance)
    return errors * corners_hz, float(np.sqrt(np.mean(misfit**2)) * 20 / np.log(10))
