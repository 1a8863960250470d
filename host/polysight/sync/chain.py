"""Synchronise a row of a board: from raw chirps to samples referenced to the direct path, with the residual errors.

Residuals are frequency, phase and amplitude errors after each stage (paper, Fig. 15).
They are measured on the scan itself, for any scene: an error is half the difference between two measurements with
independent noise. For a chirp and for the direct path these are two halves of the RX, for the object two averages of
every other chirp.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.capture import raw_words
from polysight.sync import direct_path
from polysight.sync import high_pass_filter as hpf
from polysight.sync.align import AlignedRow, align_pieces
from polysight.sync.direct_path import DirectPath, Referenced
from polysight.sync.numpy_passes import FOLD
from polysight.sync.tone import Complex, Real, block_edges, block_times, cis, phasor, refine
from polysight_shared.config import Board, Chirp, Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

STAGES = {
    "received": "one chirp as received",
    "aligned": "one chirp after burst alignment",
    "averaged": "the direct path in a position's average",
    "referenced": "the object beside the direct path in a position's average",
}

EXAMINED = 32
"""Positions per row used for residuals: standard deviations within 13 % for a row, 1 % for 150 rows."""

Errors = dict[str, NDArray[np.float64]]

_FULL_SCALE = 32767  # largest int16: a sample with this value was clipped


def errors(
    aligned: AlignedRow, done: Referenced, path: DirectPath, sample_rate_hz: float, most: int = EXAMINED
) -> Errors:
    """Return the errors after each stage, float64 [3, n]: Hz, rad, and amplitude relative to its mean.

    At most `most` valid positions are used, evenly spaced. Empty if no position is valid. `referenced` contains only
    positions with an echo.
    """
    if not done.found.any():
        return {}
    valid = np.flatnonzero(done.found)
    found = np.zeros_like(done.found)
    found[valid[np.linspace(0, valid.size - 1, min(most, valid.size)).astype(int)]] = True
    good = aligned.good[found]
    received = np.stack(
        [
            done.frequency[found, None] + aligned.frequency[found],
            np.angle(done.amplitude)[found, None] + aligned.phase[found],
            np.abs(done.amplitude)[found, None] * aligned.amplitude[found] / aligned.gain[found],
        ]
    )[:, good]
    turns = cis(received[1])
    received[0] -= received[0].mean()
    received[1] = np.angle(turns * np.conj(turns.mean()))
    received[2] = received[2] / received[2].mean() - 1

    own = (aligned.amplitude[found] * good).sum(axis=1) / good.sum(axis=1)
    one = np.stack([*aligned.error[found].swapaxes(0, 1), aligned.amplitude[found] / own[:, None] - 1])[:, good]

    two = found & (aligned.good.sum(axis=1) > 1)
    n = aligned.good[two].sum(axis=1)
    whole = (n[:, None] / np.stack([(n + 1) // 2, n // 2], axis=1)).astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):  # dead RX have no direct path: their figures are not finite
        out = {
            "received": received,
            "aligned": one,
            "averaged": _direct_path(done.halves[found].sum(axis=1), path),
            "referenced": _object(done.halves[two] * whole[..., None, None], path) if two.any() else np.zeros((3, 0)),
        }
    for values in out.values():
        values[0] *= sample_rate_hz
    return out


def noise_power(aligned: AlignedRow) -> NDArray[np.float64]:
    """Return the noise power of a sample of one channel of one chirp, [position], NaN with fewer than two chirps."""
    n = aligned.good.sum(axis=1)
    parts = np.stack([(n + 1) // 2, n // 2], axis=1)
    whole = (n[:, None] / np.maximum(parts, 1)).astype(np.float32)[..., None, None]
    apart = aligned.halves[:, 0] * whole[:, 0] - aligned.halves[:, 1] * whole[:, 1]
    power = _energy(apart) / (apart.shape[1] * apart.shape[2])
    return np.where(n > 1, power * FOLD / (1 / np.maximum(parts, 1)).sum(axis=1), np.nan)


def _energy(signal: NDArray[np.complex64]) -> NDArray[np.float32]:
    """Return the energy over RX and blocks of signals [position, rx, block]."""
    parts = np.ascontiguousarray(signal).view(np.float32)
    return np.einsum("prn,prn->p", parts, parts)


def _direct_path(mean: NDArray[np.complex64], path: DirectPath) -> NDArray[np.float64]:
    """Return the errors of the direct path [3, n] in averages [position, rx, block], from two halves of the RX."""
    frequency, phase, size = [], [], []
    for h in (0, 1):
        amplitude, w = _estimate(mean[:, h::2], path.half_estimators[h])
        frequency.append(w / (2 * np.pi))
        phase.append(np.angle(amplitude * np.conj(amplitude.mean())))  # without the constant difference of the RX
        size.append(np.abs(amplitude) / np.abs(amplitude).mean())
    return np.stack([x[0] - x[1] for x in (frequency, phase, size)]) / 2


def _estimate(signal: NDArray[np.complex64], estimator: NDArray[np.complex128]) -> tuple[Complex, Real]:
    """Return amplitude and frequency (radians per sample) [...] of the direct path in signals [..., rx, block]."""
    estimate = signal.reshape(*signal.shape[:-2], -1) @ estimator.T.astype(np.complex64)
    return estimate[..., 0].astype(complex), np.real(estimate[..., 1] / estimate[..., 0])


def _object(halves: NDArray[np.complex64], path: DirectPath) -> NDArray[np.float64]:
    """Return the errors of the object [3, n] from two averages [position, 2, rx, block], for positions with an echo."""
    rx, n = halves.shape[2:]
    # Reference each half to its own direct path and subtract it; the object remains.
    amplitude, w = _estimate(halves, path.estimator)
    back = phasor(-w * FOLD / (2 * np.pi), -np.angle(amplitude), n, (n - 1) / 2)
    echo = halves * back[:, :, None]
    echo -= np.abs(amplitude).astype(np.float32)[..., None, None]
    product = (echo[:, 0] * echo[:, 1].conj()).sum(axis=1)
    edges = block_edges(n)
    tone = refine(np.add.reduceat(product, edges[:-1], axis=-1).astype(complex), block_times(edges) * FOLD, steps=2)
    # Amplitudes relative to the mean of both halves.
    energy, common = np.stack([_energy(echo[:, h]) for h in (0, 1)], axis=1), product.sum(axis=1)
    size = np.abs(energy + np.stack([common, common.conj()], axis=1))
    contrast = (size[:, 0] - size[:, 1]) / np.maximum(size.sum(axis=1), 1e-30)
    # Keep positions whose halves are more coherent than noise would be by chance.
    echoing = np.abs(tone.amplitude) > 4 / np.sqrt(rx * n) * np.sqrt(energy.prod(axis=1))
    return np.stack([tone.frequency / 2, np.angle(tone.amplitude) / 2, contrast])[:, echoing]


def spread(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the RMS of errors [3, n]."""
    f, p, a = np.sqrt((values**2).mean(axis=1))
    return float(f), float(p), float(a)


@dataclass(frozen=True)
class BoardSetup:
    """Parameters of synchronisation for a board and a whole scan. Create with :meth:`of`.

    `examined` is the largest number of positions per row used for residuals (`errors`).
    """

    chirp: Chirp
    pulses: int
    equaliser: hpf.Equaliser | None
    path: direct_path.DirectPath
    examined: int = EXAMINED

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
        Error samples of the row after each stage (`errors`), {stage: float64 [3, n]}.
    """

    samples: NDArray[np.complex64]
    valid: NDArray[np.bool_]
    chirps: NDArray[np.int64]
    direct_hz: NDArray[np.float64]
    direct_amplitude: NDArray[np.float64]
    freq_residual_hz: NDArray[np.float64]
    phase_residual_rad: NDArray[np.float64]
    errors: Errors = field(default_factory=dict)
    noise: NDArray[np.float64] | None = None
    turn: NDArray[np.float64] | None = None

    @property
    def stages(self) -> dict[str, tuple[float, float, float]]:
        """Standard deviations of frequency (Hz), phase (rad) and relative amplitude after each stage."""
        return {name: spread(values) for name, values in self.errors.items() if values.size}


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
        errors(aligned, done, setup.path, rate, setup.examined),
        noise_power(aligned),
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
