"""Random numbers from a seed and words: the same on every machine, in whatever order they are asked for."""

from __future__ import annotations

from functools import cache
from zlib import crc32

import numpy as np
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
