"""Synchronise a row of a board: from raw chirps to samples referenced to the direct path."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.capture import raw_words
from polysight.sync import direct_path, residuals
from polysight.sync import high_pass_filter as hpf
from polysight.sync.align import align_pieces
from polysight.sync.numpy_passes import FOLD
from polysight_shared.config import Board, Chirp, Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

_FULL_SCALE = 32767  # largest int16: a sample with this value was clipped


@dataclass(frozen=True)
class BoardSetup:
    """Parameters of synchronisation for a board and a whole scan. Create with :meth:`of`.

    `examined` is the largest number of positions per row used for residuals (`residuals.errors`).
    """

    chirp: Chirp
    pulses: int
    equaliser: hpf.Equaliser | None
    path: direct_path.DirectPath
    examined: int = residuals.EXAMINED

    @classmethod
    def of(
        cls, rig: Instrument, board: Board, compensate_filter: bool = True, model: hpf.HighPass | None = None
    ) -> BoardSetup:
        """Return the setup of a board of a rig.

        `model` is the measured high-pass filter (`fit_high_pass`); None: the corners in the chirp profile.
        `compensate_filter=False` does not compensate the filter.
        """
        model = (model or hpf.high_pass(rig.chirp)) if compensate_filter else hpf.HighPass()
        equaliser = hpf.Equaliser.of(model, rig.chirp, FOLD) if model.corners_hz else None
        return cls(rig.chirp, rig.burst.chirps_a_position, equaliser, direct_path.prepare(rig, board))


@dataclass(frozen=True)
class SyncedRow:
    """A row of a board with every position referenced to its direct path.

    Attributes
    ----------
    samples
        complex64 [rx, position, sample]: an echo of excess path d is `a exp(+j 2 pi f(t) d / c)`; zero where not valid.
    valid
        bool [position].
    chirps
        int [position]: chirps in each average.
    direct_hz, direct_amplitude
        float64 [position]: IF and amplitude (ADC counts) of the direct path.
    freq_residual_hz, phase_residual_rad
        float64 [position]: standard deviation of one chirp's error after alignment within its burst.
    noise
        float64 [position]: noise power of a sample of one channel of one chirp (ADC counts squared), NaN with fewer
        than two good chirps; None: unknown.
    turn
        float64 [position]: phase change, radians, of the whole signal (direct path and echoes) from one position to
        the next. Burst alignment removes it within a burst, see `imaging.samples.undo_burst_motion`. None: not aligned.
    errors
        Error samples of the row after each stage (`residuals.errors`), {stage: float64 [3, n]}.
    """

    samples: NDArray[np.complex64]
    valid: NDArray[np.bool_]
    chirps: NDArray[np.int64]
    direct_hz: NDArray[np.float64]
    direct_amplitude: NDArray[np.float64]
    freq_residual_hz: NDArray[np.float64]
    phase_residual_rad: NDArray[np.float64]
    errors: residuals.Errors = field(default_factory=dict)
    noise: NDArray[np.float64] | None = None
    turn: NDArray[np.float64] | None = None

    @property
    def stages(self) -> dict[str, tuple[float, float, float]]:
        """Standard deviations of frequency (Hz), phase (rad) and relative amplitude after each stage."""
        return {name: residuals.spread(values) for name, values in self.errors.items() if values.size}


def synchronise_row(frames: NDArray[Any], valid: NDArray[np.bool_], setup: BoardSetup) -> SyncedRow:
    """Compensate, align, average and reference a row of a board (paper, section 5.2).

    Parameters
    ----------
    frames
        int16 [frame, sample, 2, rx] from `row_words` (fastest), or complex64 [rx, frame, sample] in ADC counts;
        positions in order of recording, `setup.pulses` frames each.
    valid
        bool [frame]: frames received whole.
    setup
        Setup of the board.

    Raises
    ------
    DataError
        if the frames are not whole bursts of the configured chirp.
    """
    words = raw_words(frames) if np.iscomplexobj(frames) else frames
    return synchronise_pieces([words], valid, setup)


def synchronise_pieces(pieces: Iterable[NDArray[np.int16]], valid: NDArray[np.bool_], setup: BoardSetup) -> SyncedRow:
    """As :func:`synchronise_row`, for a row that comes in pieces of whole bursts; they may share their memory."""
    if valid.size % setup.pulses:
        raise _mismatch(valid.size, setup.path.steering.shape, setup)
    aligned = align_pieces(
        _bursts(pieces, valid.size, setup),
        valid.reshape(-1, setup.pulses),
        setup.chirp.linear_samples,
        setup.equaliser,
        _FULL_SCALE,
    )
    done = direct_path.reference(aligned, setup.path, setup.chirp)
    chirps, rate = aligned.good.sum(axis=1), setup.chirp.sample_rate_hz
    residual = np.sqrt((aligned.error**2).sum(axis=-1) / np.maximum(chirps, 1)[:, None])
    return SyncedRow(
        done.samples,
        done.found,
        chirps,
        done.frequency * rate,
        np.abs(done.amplitude),
        residual[:, 0] * rate,
        residual[:, 1],
        residuals.errors(aligned, done, setup.path, rate, setup.examined),
        residuals.noise_power(aligned),
        turn_along(done),
    )


def _bursts(pieces: Iterable[NDArray[np.int16]], frames: int, setup: BoardSetup) -> Iterator[NDArray[np.int16]]:
    """Return pieces [frame, sample, 2, rx] as bursts [position, chirp, sample, 2, rx]; check that they are whole."""
    for words in pieces:
        found, samples, _, rx = words.shape
        frames -= found
        if (rx, samples) != setup.path.steering.shape or found % setup.pulses or frames < 0:
            raise _mismatch(found, (rx, samples), setup)
        yield words.reshape(-1, setup.pulses, samples, 2, rx)
    if frames:
        raise DataError(
            f"the recording ends {frames} frames before the end of its row",
            "it is truncated, or was recorded with another rig file",
            "use the rig file of this scan",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )


def _mismatch(frames: int, shape: tuple[int, ...], setup: BoardSetup) -> DataError:
    rx, samples = setup.path.steering.shape
    return DataError(
        f"{frames} frames of {shape[0]} RX x {shape[1]} samples are not bursts of {setup.pulses} frames"
        f" of {rx} RX x {samples} samples",
        "the data were recorded with another rig file",
        "use the rig file of this scan",
        code=ErrorCode.MISMATCH,
    )


def turn_along(done: direct_path.Referenced) -> NDArray[np.float64]:
    """Return `SyncedRow.turn`, from the valid neighbours of each position; 0 without any."""
    signal = done.halves.sum(axis=1) * done.found[:, None, None]
    flat = signal.reshape(len(signal), -1)
    step = np.einsum("pi,pi->p", flat[:-1].conj(), flat[1:])  # from each to the next
    return np.angle(np.pad(step, (1, 0)) + np.pad(step, (0, 1)))
