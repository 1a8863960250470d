"""Reproducible random numbers from a seed and names: equal on every machine and in any order of calls."""

from __future__ import annotations

from functools import cache
from zlib import crc32

import numpy as np
import scipy
from numpy.typing import NDArray

_U64 = np.uint64


@cache
def stream_key(seed: int, *words: str) -> int:
    """Return a 64-bit key from a seed and words, equal on every machine."""
    state = np.random.SeedSequence([seed, *(crc32(w.encode()) for w in words)]).generate_state(1, np.uint64)
    return int(state[0])


def pulse_uniform(key: int, pulses: NDArray[np.int64]) -> NDArray[np.floating]:
    """Return a uniform number in [0, 1) per pulse, independent of order and batch (splitmix64: Steele et al. 2014)."""
    z = (pulses.astype(_U64) + _U64(1)) * _U64(0x9E3779B97F4A7C15) + _U64(key)
    z = (z ^ (z >> _U64(30))) * _U64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> _U64(27))) * _U64(0x94D049BB133111EB)
    return ((z ^ (z >> _U64(31))) >> _U64(11)).astype(np.float64) * 2.0**-53


def pulse_normal(key: int, first: int, out: NDArray[np.float32]) -> None:
    """Fill out[i] with standard normal numbers of pulse `first` + i, independent of the batch.

    Sixteen bits of a counter-based generator select one of 65536 equally likely values: seven times faster than the
    continuous distribution, and equal after the ADC. The largest is 4.3; the variance is 1.
    """
    values = out[0].size
    blocks = -(-values // 16)  # the generator's counter counts blocks of 256 bits
    bits = np.random.Philox(key=key, counter=first * blocks).random_raw(len(out) * blocks * 4).view("<u2")
    chosen = bits.reshape(len(out), -1)[:, :values].reshape(out.shape)
    np.take(_normal_values(), chosen, out=out, mode="clip")  # "clip": no copy of `out` in case of a wrong index


@cache
def _normal_values() -> NDArray[np.float32]:
    """Return the middles of 65536 equally likely intervals of the normal distribution, variance 1."""
    middles = scipy.special.ndtri((np.arange(1 << 16) + 0.5) / (1 << 16))
    return (middles / middles.std()).astype(np.float32)
