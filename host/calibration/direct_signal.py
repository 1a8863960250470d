"""The direct path in a short capture: its IF chirp by chirp, and what it says of start frequency, trigger, crystal.

IF of the direct path, with tau its delay, dt how much later the board started than the transmitter, and p what its
crystal is faster by:

    f = K tau + start offset + p (f_0 + 2 K t) - K dt        (docs/spec/scene-file.md)

A crystal shows by itself: it makes the IF drift by 2 p K within the chirp. What remains beside the geometry is dt.
`fit_start` takes a scan's direct path and finds the start offset that puts it in the middle of the band.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.host.calibration.files import BoardStart
from polysight.host.calibration.rows import board_rows
from polysight.host.radar.constraints import direct_if_hz
from polysight.host.store.source import RawSource
from polysight.host.sync import BoardSetup
from polysight.host.sync.align import AlignedRow, align_row, whole_blocks
from polysight.host.sync.direct_path import reference
from polysight.host.sync.passes import FOLD
from polysight.host.sync.residuals import noise_power
from polysight.host.sync.tone import cis
from polysight.shared.config import Board, Instrument
from polysight.shared.errors import DataError

FULL_SCALE = 32767
PASSBAND = 0.9  # of the sample rate
ROWS = 4  # of a scan that are looked at
FOUND = 0.25  # part of the chirps in which a direct path must be found to be believed


@dataclass(frozen=True)
class DirectSignal:
    """The direct path of one board.

    Attributes
    ----------
    if_hz
        float64 [chirp]: its IF, of the chirps in which it was found; in the receiver's band, so it may be aliased.
    power, noise_power
        float64 [chirp]: square of its amplitude as recorded, before any filter is undone, and of the noise in that
        estimate; ADC counts squared. The first holds the second.
    expected_hz
        IF by the rig file: geometry and start offsets.
    drift_hz_per_s
        Change of the IF within a chirp.
    chirps
        Chirps that were received whole.
    """

    if_hz: NDArray[np.float64]
    power: NDArray[np.float64]
    noise_power: NDArray[np.float64]
    expected_hz: float
    drift_hz_per_s: float
    chirps: int

    @property
    def found(self) -> bool:
        """Whether there is a direct path at all: in most chirps."""
        return 2 * self.if_hz.size > self.chirps > 0

    def crystal_ppm(self, rig: Instrument) -> float:
        """How much faster the board's crystal is than the transmitter's, parts per million, by the drift."""
        return self.drift_hz_per_s / (2e-6 * rig.chirp.slope_hz_per_s)

    def later_s(self, rig: Instrument) -> tuple[float, float]:
        """How much later the board starts its chirps than the transmitter, and the mean's standard error; seconds."""
        chirp, (a, b) = rig.chirp, whole_blocks(rig.chirp.linear_samples)
        middle_hz = chirp.first_sample_hz + 2 * chirp.hz_per_sample * (a + b - 1) / 2
        expected = self.expected_hz + self.crystal_ppm(rig) * 1e-6 * middle_hz
        later = (expected - unwrapped(self.if_hz, rig)) / chirp.slope_hz_per_s
        return float(later.mean()), float(later.std(ddof=1) / np.sqrt(later.size)) if later.size > 1 else np.inf


def band_hz(rig: Instrument) -> tuple[float, float]:
    """IF that the receiver keeps: 0..0.9 sample rates (complex 1x) or +-0.45 (complex 2x)."""
    width = PASSBAND * rig.chirp.sample_rate_hz
    return (0.0, width) if rig.chirp.if_mode == "complex1x" else (-width / 2, width / 2)


def unwrapped(if_hz: NDArray[np.float64], rig: Instrument) -> NDArray[np.float64]:
    """IFs [chirp] of one direct path about their circular mean: unbroken where jitter crosses the band's edge."""
    rate = rig.chirp.sample_rate_hz
    middle = np.angle(np.exp(2j * np.pi * if_hz / rate).sum()) * rate / (2 * np.pi)
    middle += rate * round((if_hz.mean() - middle) / rate)
    return middle + (if_hz - middle + rate / 2) % rate - rate / 2


def jitter_hz(rig: Instrument) -> float:
    """IF that 5 ns of trigger uncertainty make."""
    return rig.chirp.slope_hz_per_s * 5e-9


def find_direct(
    rig: Instrument, board: Board, words: NDArray[Any], valid: NDArray[np.bool_], setup: BoardSetup | None = None
) -> DirectSignal:
    """Look for the direct path in bursts.

    Parameters
    ----------
    rig, board
        The rig file, and one of its receiving boards.
    words
        int16 [frame, sample, 2, rx], whole bursts.
    valid
        bool [frame].
    setup
        The board's, where it is there already.
    """
    setup, chirp = setup or BoardSetup.of(rig, board), rig.chirp
    shape = (len(words) // setup.pulses, setup.pulses)
    aligned = align_row(
        words.reshape(*shape, *words.shape[1:]), valid.reshape(shape), chirp.linear_samples, setup.equaliser, FULL_SCALE
    )
    # The estimate of the drift is linear in it: what two ppm make is found to a tenth, and what that leaves, exactly.
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
    """Noise power of a recorded sample; compensation has raised it by its gain. The same in all positions."""
    raised = (aligned.gain**2 * aligned.good).sum(axis=1) / np.maximum(aligned.good.sum(axis=1), 1)
    recorded = noise_power(aligned) / np.maximum(raised, 1e-12)
    return float(np.nanmedian(recorded)) if np.isfinite(recorded).any() else 0.0


def _power(
    words: NDArray[np.int16], cycles: NDArray[np.float64], setup: BoardSetup, drift: float
) -> NDArray[np.float64]:
    """Power of the direct path in each chirp [chirp], by the estimator that does not hear the object."""
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
    """The start offset of a board, from where its direct path was.

    Raises
    ------
    DataError
        when it was hardly ever found; the error names the offset by geometry alone.
    """
    rig = source.instrument
    board = rig.by_name(board_name)
    setup = BoardSetup.of(rig, board)
    heard = [find_direct(rig, board, words, ok, setup) for _, words, ok in board_rows(source, board_name, ROWS)]
    if_hz, chirps = np.concatenate([s.if_hz for s in heard]), sum(s.chirps for s in heard)
    expected = direct_if_hz(rig, board)
    if if_hz.size < max(2, FOUND * chirps):
        raise DataError(
            f"{source.scan_id}: a direct path of {board_name} in {if_hz.size} of {chirps} chirps only",
            "it lies outside the band and is filtered away, or something stands in it",
            f"by geometry alone start_offset_hz = {by_geometry(rig, board):.0f} for {board_name}; scan again with it",
        )
    if_hz = unwrapped(if_hz, rig)
    return start_of(rig, board, expected, float(if_hz.mean()), float(if_hz.std() / np.sqrt(if_hz.size)), if_hz.size)


def start_of(
    rig: Instrument, board: Board, expected_hz: float, seen_hz: float, error_hz: float, chirps: int
) -> BoardStart:
    """The offset that moves a direct path seen at `seen_hz`, whatever sample rates away it really is, to the middle."""
    rate, middle = rig.chirp.sample_rate_hz, sum(band_hz(rig)) / 2
    alias = round((expected_hz - seen_hz) / rate)
    offset = board.start_offset_hz + middle - (seen_hz + alias * rate)
    return BoardStart(
        float(round(offset)), board.start_offset_hz, seen_hz, error_hz, expected_hz, middle, alias, chirps
    )


def by_geometry(rig: Instrument, board: Board) -> float:
    """The offset by the rig file alone, hertz."""
    return board.start_offset_hz + sum(band_hz(rig)) / 2 - direct_if_hz(rig, board)
