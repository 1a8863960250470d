"""The receivers' high-pass filters, from scans of one scene at several start frequencies.

Each start frequency puts the direct path at another IF, and the trigger's jitter spreads it by some 200 kHz more. The
direct path itself stays the same, so its level over IF is the filter's response (paper, Fig. 9).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polysight.host.calibration.direct_signal import find_direct
from polysight.host.calibration.files import BoardFilter, places_crc32
from polysight.host.calibration.rows import board_rows
from polysight.host.store import RawSource
from polysight.host.sync import BoardSetup, HighPass, fit_high_pass
from polysight.shared.config import Board
from polysight.shared.errors import DataError

Real = NDArray[np.float64]
ROWS = 6  # of a scan that are looked at
BIN_HZ = 10e3
LEAST = 6  # chirps that a bin needs
CLEAR = 20.0  # times the noise that it must hold


def fit_filter(scans: list[RawSource], board_name: str) -> BoardFilter:
    """Fit a board's filter to a sweep.

    Parameters
    ----------
    scans
        Scans of the same scene, at different start frequencies of the receivers.
    board_name
        A receiving board.

    Raises
    ------
    DataError
        when the direct path is not found, or the sweep does not tell the corners.
    """
    setups: dict[str, BoardSetup] = {}
    heard = [_power(scan, scan.instrument.by_name(board_name), setups) for scan in scans]
    if_hz, power, noise_power = (np.concatenate(parts) for parts in zip(*heard, strict=True))
    middles, levels = binned(if_hz, power, noise_power)
    if middles.size == 0:
        raise DataError(f"no direct path of {board_name}", "see `polysight doctor`", "measure again")
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
    """IF (Hz), power and the noise in it (ADC counts squared) of the direct path in every chirp of some rows."""
    rig = scan.instrument
    key = f"{places_crc32(rig)} {rig.chirp} {rig.burst!r}"  # scans of one sweep share it
    if key not in setups:
        setups[key] = BoardSetup.of(rig, board)
    heard = [find_direct(rig, board, words, ok, setups[key]) for _, words, ok in board_rows(scan, board.name, ROWS)]
    return (
        np.concatenate([s.if_hz for s in heard]),
        np.concatenate([s.power for s in heard]),
        np.concatenate([s.noise_power for s in heard]),
    )


def binned(if_hz: Real, power: Real, noise_power: Real) -> tuple[Real, Real]:
    """Mean IF and level, noise taken off, in bins of `BIN_HZ` that hold enough chirps and signal; IF ascending.

    The median is of power, less the noise in it: chirps whose direct path was mistaken do not count.
    """
    bins = np.floor(if_hz / BIN_HZ).astype(int)
    groups = [(bins == b) & (if_hz > 0) for b in np.unique(bins)]
    means = [(if_hz[g].mean(), np.median(power[g]), noise_power[g].mean()) for g in groups if g.sum() >= LEAST]
    means = [(f, p - n) for f, p, n in means if p > CLEAR * n]
    return np.array([f for f, _ in means]), np.sqrt([s for _, s in means])


def _errors(if_hz: Real, level: Real, corners_hz: Real) -> tuple[Real, float]:
    """Standard errors of the corners (Hz), from what the fit leaves of the log levels, and that in dB (rms)."""

    def left(logs: Real) -> Real:
        out = np.log(level) - np.log(np.abs(HighPass(tuple(np.exp(logs))).response(if_hz)))
        return out - out.mean()

    logs, step = np.log(corners_hz), 1e-4
    slopes = np.stack([(left(logs + d) - left(logs - d)) / (2 * step) for d in step * np.eye(logs.size)], axis=1)
    rest = left(logs)
    variance = float(rest @ rest) / max(1, rest.size - logs.size - 1)
    errors = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)) * variance)
    return errors * corners_hz, float(np.sqrt(np.mean(rest**2)) * 20 / np.log(10))
