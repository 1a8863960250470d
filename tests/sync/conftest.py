"""Small test signals of known truth: direct path, echoes, noise."""

from collections.abc import Callable

import numpy as np
import pytest

from polysight.capture.dca1000 import encode_row_words
from polysight.sync.offsets import AlignedRow, align_row
from polysight_shared.config import Board, Instrument
from polysight_shared.geometry import rx_positions_m, specular_midpoint_m, tx_position_m
from polysight_shared.units import SPEED_OF_LIGHT_M_S


def sweep_hz(rig: Instrument) -> np.ndarray:
    """Return the transmit frequency of each sample of a chirp."""
    return rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * np.arange(rig.chirp.samples)


@pytest.fixture(scope="session")
def paths(rig: Instrument) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """`paths(board, positions, echo, rng)`: ideal signal [position, rx, sample], and direct path [rx], metres.

    The signal is the direct path of amplitude 1 and echoes of points on the object plane, at most `spread_m` away from
    the mirror point along x and y. `echo` is the rms amplitude of all echoes together; each has a random phase.
    """

    def make(
        board: Board, positions: int, echo: float, rng: np.random.Generator, echoes: int = 1, spread_m: float = 0.1
    ) -> tuple[np.ndarray, np.ndarray]:
        tx = np.array(tx_position_m(rig))
        rx = np.array(rx_positions_m(rig, board))
        direct_m = np.linalg.norm(rx - tx, axis=1)
        f = sweep_hz(rig)
        signal = np.zeros((positions, len(rx), f.size), complex)
        signal += np.exp(2j * np.pi * f * direct_m[:, None] / SPEED_OF_LIGHT_M_S)
        for _ in range(echoes):
            aside_m = spread_m * rng.uniform(-1, 1, (positions, 2))
            points = np.array(specular_midpoint_m(rig, board)) + np.column_stack([aside_m, np.zeros(positions)])
            from_tx_m = np.linalg.norm(points - tx, axis=1)[:, None]
            to_rx_m = np.linalg.norm(points[:, None] - rx, axis=2)
            path_m = from_tx_m + to_rx_m
            amplitude = echo / np.sqrt(echoes) * np.exp(2j * np.pi * rng.uniform(size=(positions, 1, 1)))
            signal += amplitude * np.exp(2j * np.pi * f * path_m[..., None] / SPEED_OF_LIGHT_M_S)
        return signal, direct_m

    return make


@pytest.fixture(scope="session")
def noise() -> Callable[..., np.ndarray]:
    """`noise(shape, power_db, rng)`: complex white noise; 0 dB is the power of a tone of amplitude 1."""

    def make(shape: tuple[int, ...], power_db: float, rng: np.random.Generator) -> np.ndarray:
        return 10 ** (power_db / 20) / np.sqrt(2) * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))

    return make


@pytest.fixture(scope="session")
def counts() -> Callable[..., np.ndarray]:
    """`counts(frames)`: bursts, complex [rx, position, chirp, sample], as int16 [position, chirp, sample, I and Q, rx].

    An amplitude of 1 becomes 1000 counts.
    """

    def make(frames: np.ndarray) -> np.ndarray:
        rx, positions, chirps, samples = frames.shape
        return encode_row_words(1000 * frames.reshape(rx, -1, samples)).reshape(positions, chirps, samples, 2, rx)

    return make


@pytest.fixture(scope="session")
def align_single(counts: Callable[..., np.ndarray]) -> Callable[..., AlignedRow]:
    """Align positions [position, rx, sample] of one chirp each."""

    def align(received: np.ndarray, usable: np.ndarray, linear: tuple[int, int] = (0, 192)) -> AlignedRow:
        return align_row(counts(received.swapaxes(0, 1)[:, :, None]), usable[:, None], linear)

    return align
