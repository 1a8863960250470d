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

    `echo` is the rms amplitude of all echoes over the direct path; they lie within `spread_m` of the mirror point.
    """

    def make(
        board: Board, positions: int, echo: float, rng: np.random.Generator, echoes: int = 1, spread_m: float = 0.1
    ) -> tuple[np.ndarray, np.ndarray]:
        tx = np.array(tx_position_m(rig))
        rx = np.array(rx_positions_m(rig, board))
        direct = np.linalg.norm(rx - tx, axis=1)
        f = sweep_hz(rig)
        out = np.zeros((positions, len(rx), f.size), complex)
        out += np.exp(2j * np.pi * f * direct[:, None] / SPEED_OF_LIGHT_M_S)
        for _ in range(echoes):
            aside = spread_m * rng.uniform(-1, 1, (positions, 2))
            v = np.array(specular_midpoint_m(rig, board)) + np.column_stack([aside, np.zeros(positions)])
            d = np.linalg.norm(v - tx, axis=1)[:, None] + np.linalg.norm(v[:, None] - rx, axis=2)
            amplitude = echo / np.sqrt(echoes) * np.exp(2j * np.pi * rng.uniform(size=(positions, 1, 1)))
            out += amplitude * np.exp(2j * np.pi * f * d[..., None] / SPEED_OF_LIGHT_M_S)
        return out, direct

    return make


@pytest.fixture(scope="session")
def noise() -> Callable[..., np.ndarray]:
    """`noise(shape, power_db, rng)`: complex white noise."""

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
