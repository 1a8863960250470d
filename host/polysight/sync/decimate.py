"""Decimation of chirps: the linear samples, mixed down, become one sample for every block of `FOLD`; their frequencies.

After mixing to the middle of its band, a chirp's signal lies within a few range bins of zero, far below the rate of its
samples. `fold` weights the samples of each block and its neighbours with a low-pass filter of ten taps. A plain average
of the block would let echoes from 4 m behind the scene through (-16 dB), which decimation moves into the scene; this
filter has -58 dB there. Noise from there would make images differ from those of all samples, too. It attenuates echoes
away from the middle by some per cent. `flatten` undoes this with nine taps over the blocks, once for each average over
chirps. Both together pass 0.45 m of path to either side of the middle within 7e-5, and 1 m within 5e-4 (published
chirp, inner blocks).

The filters are fitted by least squares. The first and last blocks lack neighbours: there `fold` is the plain average,
and `flatten` has taps of its own for the four blocks at either end.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polysight_shared.config import Chirp

FOLD = 4
"""Samples of a block, which become one decimated sample."""
TAPS = 10
"""Samples that `fold` weights for a block: three before it, its own, three after it."""
FLATTENED_BLOCKS = 9
"""Blocks that `flatten` weights."""
SEARCH_FFT = 256
"""Size of the FFT that searches the direct path, over decimated samples; chosen."""

# Samples that `fold` weights on either side of a block, and blocks that `flatten` weights on either side of one.
_TAPS_EACH_SIDE = (TAPS - FOLD) // 2
_BLOCKS_EACH_SIDE = FLATTENED_BLOCKS // 2
# Half the passband, cycles per sample: 13 range bins of 192 samples, 1.1 m of path with the published chirp.
_PASSBAND = 13 / 192
# Within this distance of the middle, where the scene is, the filters are ten or twenty times as exact.
_SCENE_BAND = 6 / 192

# Weight of small taps for the first block, in the least squares fit (chosen): less noise there for a worse fit.
_TAP_WEIGHT = 0.08


def whole_blocks(linear: tuple[int, int]) -> tuple[int, int]:
    """Return the linear samples that fill whole blocks of `FOLD`; estimates count time from their middle."""
    first, end = linear
    return first, end - (end - first) % FOLD


class Decimator(NamedTuple):
    """Taps of both filters.

    Attributes
    ----------
    taps
        float32 [3, TAPS]: of the first block, of inner ones, of the last block; 0 for samples beyond the ends.
    flat
        float32 [output, FLATTENED_BLOCKS]: for the first four blocks, taps over blocks 0 to 8; for an inner block, over
        it and four on either side; for the last four blocks, over the last nine.
    noise
        Noise power of a sample after both filters, relative to a sample before.
    """

    taps: NDArray[np.float32]
    flat: NDArray[np.float32]
    noise: float


@lru_cache(maxsize=1)
def decimator() -> Decimator:
    """Return the taps of both filters, fitted at the first call."""
    inner = _design_low_pass()
    first = np.zeros(TAPS)
    first[_TAPS_EACH_SIDE:-_TAPS_EACH_SIDE] = 1 / FOLD
    cycles = np.linspace(-_PASSBAND, _PASSBAND, 121)
    weight = np.where(np.abs(cycles) < _SCENE_BAND, 10.0, 1.0)
    # `phasors @ taps` is the response of `fold` [cycle]: its sum over the samples at each frequency.
    phasors = np.exp(2j * np.pi * np.outer(cycles, np.arange(TAPS) - (TAPS - 1) / 2))
    # `flatten` of each of the first blocks, and of an inner one: taps over `FLATTENED_BLOCKS` blocks whose response,
    # together with that of `fold`, is 1 in the passband.
    flat_taps = []
    for block in range(_BLOCKS_EACH_SIDE + 1):
        lags = FOLD * (np.arange(FLATTENED_BLOCKS) - block)
        passed = np.exp(2j * np.pi * np.outer(cycles, lags)) * (phasors @ inner)[:, None]
        if block < _BLOCKS_EACH_SIDE:
            passed[:, 0] *= (phasors @ first) / (phasors @ inner)
        model = weight[:, None] * passed
        # Real taps: real and imaginary parts are equations of their own. At the very end, large taps would raise noise.
        tap_weight = _TAP_WEIGHT if block == 0 else 0.0
        small = tap_weight * np.eye(FLATTENED_BLOCKS)
        equations = np.concatenate([model.real, model.imag, small])
        target_response = np.concatenate([weight, np.zeros(cycles.size + FLATTENED_BLOCKS)])
        flat_taps.append(np.linalg.lstsq(equations, target_response, rcond=None)[0])
    # Both filters of an inner block as one, over the samples: noise is amplified by the sum of its squares.
    combined_taps = np.zeros(FOLD * (FLATTENED_BLOCKS - 1) + TAPS)
    for block, weight_of_block in enumerate(flat_taps[-1]):
        combined_taps[FOLD * block : FOLD * block + TAPS] += weight_of_block * inner
    taps = np.stack([first, inner, first]).astype(np.float32)
    # The end of a chirp is its beginning in reverse.
    flat_taps += [part[::-1] for part in flat_taps[-2::-1]]
    return Decimator(taps, np.stack(flat_taps).astype(np.float32), float((combined_taps**2).sum()))


def _design_low_pass() -> NDArray[np.float64]:
    """Return symmetric taps of sum 1 with the least response where decimation would move echoes into the passband."""
    aliases = [np.linspace(0.25 - _PASSBAND, 0.25 + _PASSBAND, 61), np.linspace(0.5 - _PASSBAND, 0.5, 31)]
    cycles = np.concatenate(aliases)
    # Distance from the scene's middle after decimation, which moves 1/4 and 1/2 cycle per sample to 0.
    off_middle = np.minimum(np.abs(cycles - 0.25), np.abs(cycles - 0.5))
    # Outside the scene the response may be twenty times as high.
    weight = np.where(off_middle < _SCENE_BAND, 1.0, 0.05)
    # Response of each pair of equal taps, half a sample, one and a half... before and after the middle.
    pairs = 2 * np.cos(2 * np.pi * np.outer(cycles, np.arange(TAPS // 2) + 0.5))
    # The sum of the taps is 1, so the last tap is what the others leave.
    basis = pairs[:, :-1] - pairs[:, -1:]
    half = np.linalg.lstsq(weight[:, None] * basis, -weight * pairs[:, -1] / 2, rcond=None)[0]
    half = np.append(half, 0.5 - half.sum())
    return np.concatenate([half[::-1], half]).astype(np.float64)


def fold(signal: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """Return one sample for each block of mixed samples: complex64 [..., sample] to [..., block]."""
    taps = decimator().taps
    padded = np.zeros((*signal.shape[:-1], signal.shape[-1] + 2 * _TAPS_EACH_SIDE), np.complex64)
    padded[..., _TAPS_EACH_SIDE:-_TAPS_EACH_SIDE] = signal
    blocks = signal.shape[-1] // FOLD
    folded = np.zeros((*signal.shape[:-1], blocks), np.complex64)
    weights = np.repeat(taps[1][:, None], blocks, axis=1)
    weights[:, 0] = taps[0]
    weights[:, -1] = taps[2]
    for tap in range(TAPS):
        folded += weights[tap] * padded[..., tap : tap + FOLD * (blocks - 1) + 1 : FOLD]
    return folded


def flatten(folded: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """Undo the attenuation by :func:`fold` in averages over chirps [..., block], unless `FLATTENED_BLOCKS` are more."""
    blocks = folded.shape[-1]
    if blocks < FLATTENED_BLOCKS:
        return folded
    return (folded @ _make_flat_matrix(blocks)).astype(np.complex64)


@lru_cache(maxsize=8)
def _make_flat_matrix(blocks: int) -> NDArray[np.float32]:
    """Return `flatten` as a matrix [block in, block out]."""
    flat = decimator().flat
    matrix = np.zeros((blocks, blocks), np.float32)
    for block in range(blocks):
        # The nine blocks about this one, or those nearest to the end.
        first = min(max(block - _BLOCKS_EACH_SIDE, 0), blocks - FLATTENED_BLOCKS)
        matrix[first : first + FLATTENED_BLOCKS, block] = flat[block - first]
    return matrix


def decimation(samples: int, middle: float) -> NDArray[np.complex128]:
    """Return the decimation of samples whose band has its middle at `middle`, cycles per sample: [block, sample].

    The phase of the mixing is restored in the blocks, so that an echo keeps its frequency.
    """
    time = np.arange(samples) - (samples - 1) / 2
    # Row k is a chirp whose sample k alone is 1, mixed down.
    mixed = np.diag(np.exp(-2j * np.pi * middle * time)).astype(np.complex64)
    blocks = flatten(fold(mixed)).T.astype(np.complex128)
    return blocks * np.exp(2j * np.pi * middle * time.reshape(-1, FOLD).mean(axis=1))[:, None]


def sample_frequencies_hz(chirp: Chirp) -> NDArray[np.float64]:
    """Return the transmit frequency of every sample of a chirp, Hz [sample]."""
    return chirp.first_sample_hz + chirp.hz_per_sample * np.arange(chirp.samples, dtype=np.float64)


def block_frequencies_hz(chirp: Chirp) -> NDArray[np.float64]:
    """Return the transmit frequency in the middle of every block of linear samples, Hz [block]."""
    first, end = whole_blocks(chirp.linear_samples)
    return sample_frequencies_hz(chirp)[first:end].reshape(-1, FOLD).mean(axis=1)


def search_window(blocks: int) -> NDArray[np.float32]:
    """Return the search's window [block]: a Hann window without zeros at its ends."""
    return np.hanning(blocks + 2)[1:-1].astype(np.float32)
