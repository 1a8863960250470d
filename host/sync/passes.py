"""The passes over a burst's raw samples: compiled where numba is installed, else in NumPy, with equal results."""

from __future__ import annotations

from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

try:
    from host.sync import compiled as fastest
except ImportError:
    from host.sync import plain as fastest

from host.sync.plain import FOLD as FOLD


class Passes(Protocol):
    """What `host.sync.plain` and `host.sync.compiled` both are; documented there."""

    CHUNK: int

    def load(self, words: NDArray[np.int16]) -> NDArray[Any]:
        """Frames as the other passes take them."""
        ...

    def products(
        self, frames: NDArray[Any], reference: NDArray[np.intp], linear: tuple[int, int], size: int
    ) -> tuple[NDArray[np.complex64], NDArray[np.complex64], NDArray[np.float32], NDArray[np.int32]]:
        """Conjugate products with a reference chirp."""
        ...

    def against_others(
        self,
        frames: NDArray[Any],
        frequency: NDArray[np.float64],
        taps: NDArray[np.complex64],
        good: NDArray[np.bool_],
        linear: tuple[int, int],
        edges: NDArray[np.intp],
    ) -> tuple[NDArray[np.complex64], NDArray[np.float32], NDArray[np.float32]]:
        """Products of each chirp, filtered, with the sum of the good ones."""
        ...

    def average(
        self,
        frames: NDArray[Any],
        frequency: NDArray[np.float64],
        weights: NDArray[np.complex64],
        second_half: NDArray[np.bool_],
        linear: tuple[int, int],
    ) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
        """The average, and what two halves of the chirps add to it."""
        ...


passes = cast(Passes, fastest)
