"""The passes over a burst's raw samples: compiled where numba is installed, else in NumPy, with equal results."""

from __future__ import annotations

from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray

from polysight.host.sync import numpy_passes as plain
from polysight.host.sync.numpy_passes import FOLD as FOLD

_Real, _Complex, _Chosen = NDArray[np.float64], NDArray[np.complex128], NDArray[np.bool_]


class Passes(Protocol):
    """What `polysight.host.sync.numpy_passes` and `polysight.host.sync.compiled` both are; documented there."""

    CHUNK: int

    def match(
        self, words: NDArray[np.int16], reference: NDArray[np.intp], linear: tuple[int, int]
    ) -> tuple[_Real, _Complex, _Real, NDArray[np.float32], NDArray[np.int32]]:
        """Tones between each chirp and a reference chirp."""
        ...

    def against_others(
        self,
        words: NDArray[np.int16],
        frequency: _Real,
        taps: NDArray[np.complex64],
        good: _Chosen,
        linear: tuple[int, int],
    ) -> tuple[_Real, _Complex, NDArray[np.float32], NDArray[np.float32], _Real]:
        """Tones between each chirp, filtered, and the sum of the good others."""
        ...

    def average(
        self,
        words: NDArray[np.int16],
        frequency: _Real,
        weights: NDArray[np.complex64],
        second_half: _Chosen,
        linear: tuple[int, int],
    ) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
        """The average, and what two halves of the chirps add to it."""
        ...


def passes_for(rx: int) -> Passes:
    """The fastest passes for a number of RX: compiled ones are for the four of an AWR2243."""
    if rx != 4:
        return cast(Passes, plain)
    try:  # imported where it is used: numba is half a second's work that most commands never need
        from polysight.host.sync import compiled as fastest
    except ImportError:
        fastest = plain
    return cast(Passes, fastest)
