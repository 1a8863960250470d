"""Estimate the receivers' high-pass filters from scans of one scene at several start frequencies.

Each start frequency puts the direct path at another IF, and trigger jitter spreads it by about 200 kHz. The direct path
itself does not change, so its level over IF is the frequency response of the filter (paper, Fig. 9).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polysight.calibration.direct_signal import find_direct
from polysight.calibration.files import BoardFilter, places_crc32
from polysight.calibration.scans import board_rows
from polysight.store import RawSource
from polysight.sync import BoardSetup, HighPass, fit_high_pass
from polysight_shared.config import Board
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

Real = NDArray[np.float64]
ROWS = 6  # rows used per scan
BIN_HZ = 10e3
MIN_CHIRPS = 6  # per bin
MIN_SNR = 20.0  # per bin, power ratio


def fit_filter(scans: list[RawSource], board_name: str) -> BoardFilter:
    """Fit the high-pass filter of a board to a sweep of start frequencies.

    Parameters
    ----------
    scans
        Scans of the same scene at different start frequencies of the receivers.
    board_name
        A receiving board.

    Raises
    ------
    DataError
        if the direct path is not found, or the sweep does not determine the corners.
    """
    setups: dict[str, BoardSetup] = {}
    found = [_power(scan, scan.instrument.by_name(board_name), setups) for scan in scans]
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


def _power(scan: RawSource, board: Board, setups: dict[str, BoardSetup]) -> tuple[Real, Real, Real]:
    """Return IF (Hz), power and noise power (ADC counts squared) of the direct path in the chirps of some rows."""
    rig = scan.instrument
    key = f"{places_crc32(rig)} {rig.chirp} {rig.burst!r}"  # scans of one sweep share the setup
    if key not in setups:
        setups[key] = BoardSetup.of(rig, board)
    found = [find_direct(rig, board, words, ok, setups[key]) for _, words, ok in board_rows(scan, board.name, ROWS)]
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
