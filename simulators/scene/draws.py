"""Random numbers from a seed and words: the same on every machine, in whatever order they are asked for."""

from __future__ import annotations

from functools import cache
from zlib import crc32

import numpy as np
import scipy
from numpy.typing import NDArray

_U64 = np.uint64


@cache
def stream_key(seed: int, *words: str) -> int:
    """A 64-bit key from a seed and words, the same on every machine."""
    state = np.random.SeedSequence([seed, *(crc32(w.encode()) for w in words)]).generate_state(1, np.uint64)
    return int(state[0])


def pulse_uniform(key: int, pulses: NDArray[np.int64]) -> NDArray[np.floating]:
    """One number in [0, 1) for each pulse, whatever order or batch they come in (splitmix64: Steele et al. 2014)."""
    z = (pulses.astype(_U64) + _U64(1)) * _U64(0x9E3779B97F4A7C15) + _U64(key)
    z = (z ^ (z >> _U64(30))) * _U64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> _U64(27))) * _U64(0x94D049BB133111EB)
    return ((z ^ (z >> _U64(31))) >> _U64(11)).astype(np.float64) * 2.0**-53


def pulse_normal(key: int, first: int, out: NDArray[np.float32]) -> None:
    """Fill out[i] with standard normal numbers of pulse `first` + i, whatever batch they come in.

    Sixteen bits of a counter-based generator choose one of 65536 equally likely values: seven times faster than drawing
    from the continuous distribution, and the same after the ADC. The largest is 4.3; the variance is 1.
    """
    values = out[0].size
    blocks = -(-values // 16)  # of 256 bits, which is what the generator's counter counts
    bits = np.random.Philox(key=key, counter=first * blocks).random_raw(len(out) * blocks * 4).view("<u2")
    chosen = bits.reshape(len(out), -1)[:, :values].reshape(out.shape)
    np.take(_normal_values(), chosen, out=out, mode="clip")  # "clip": no copy of `out` in case of a wrong index


@cache
def _normal_values() -> NDArray[np.float32]:
    """The middles of 65536 equally likely intervals of the normal distribution, variance 1."""
    middles = scipy.special.ndtri((np.arange(1 << 16) + 0.5) / (1 << 16))
    return (middles / middles.std()).astype(np.float32)
