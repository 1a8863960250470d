"""Call the compiled loops of `burst.c` and `direct_path.c` through ctypes, which releases the interpreter.

:func:`library` returns them, or None and one warning if they were not compiled; then the slower NumPy form is used.
"""

from __future__ import annotations

import ctypes
import logging
import threading
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.sync.high_pass_filter import Equaliser
from polysight.sync.tone import search_size

RX = 4
"""Number of RX that the loops support."""

_log = logging.getLogger(__name__)
_lock = threading.Lock()


class LoadError(Exception):
    """The library is missing, or was compiled from other sources."""


class Library:
    """The compiled loops.

    Parameters
    ----------
    path
        File of the library; None: beside the sources.
    bits
        Width of vectors, 128, 256 or 512; None: the widest of the processor.

    Raises
    ------
    LoadError
        if it cannot be loaded, or was compiled from other sources.
    """

    def __init__(self, path: Path | None = None, bits: int | None = None) -> None:
        from polysight.sync import build  # not at import, so that `python -m polysight.sync.build` is clean

        path = path or build.HERE / build.LIBRARY
        if not path.is_file():
            raise LoadError(f"{path} is missing")
        try:
            if not path.read_bytes().endswith(build.source_digest().encode()):  # loading it could end the program
                raise LoadError(f"{path} was compiled from other sources, or is damaged")
            loaded = ctypes.CDLL(str(path))
        except OSError as e:
            raise LoadError(str(e)) from None
        self.bits = bits or int(loaded.vector_bits())
        self._loaded = loaded

    def align(
        self,
        words: NDArray[np.int16],
        valid: NDArray[np.bool_],
        linear: tuple[int, int],
        equaliser: Equaliser | None,
        full_scale: int,
        into: Sequence[NDArray[Any]],
    ) -> None:
        """Align positions into the fields of an `align.AlignedRow`; parameters as in `align.align_in_numpy`."""
        positions, chirps, samples, _, _ = words.shape
        a, b = linear
        filters = [0.0, 0.0, 0.0]
        if equaliser is not None:
            filters = [equaliser.sample_rate_hz, equaliser.reach, equaliser.signed, *equaliser.model.corners_hz]
        self._call(
            "align",
            *(words, valid),
            *(positions, chirps, samples, a, b, search_size(b - a), full_scale),
            *(np.array(filters), len(filters) - 3, equaliser is not None),
            *into,
        )

    def search(
        self,
        halves: NDArray[np.complex64],
        weights: NDArray[np.complex64],
        size: int,
        object_bins: tuple[int, int],
        comparable: float,
    ) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """See `numpy_direct_path.search`."""
        positions, blocks = halves.shape[0], halves.shape[-1]
        bins, median = np.empty((2, positions), np.int32), np.empty(positions)
        sizes = positions, blocks, size, *object_bins
        self._call("search", halves, weights, *sizes, np.array([comparable]), bins, median)
        return bins, median

    def refine(
        self,
        halves: NDArray[np.complex64],
        steering: NDArray[np.complex64],
        estimator: NDArray[np.complex64],
        frequency: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.complex128], NDArray[np.float64]]:
        """See `numpy_direct_path.refine`."""
        positions, blocks, rows = halves.shape[0], halves.shape[-1], len(estimator)
        found, estimate, step = frequency.copy(), np.empty((positions, rows), complex), np.empty(positions)
        self._call("refine", halves, steering, estimator, positions, blocks, rows, found, estimate, step)
        return found, estimate, step

    def turn(
        self,
        mean: NDArray[np.complex64],
        halves: NDArray[np.complex64],
        steering: NDArray[np.complex64],
        folded_steering: NDArray[np.complex64],
        origin: float,
        frequency: NDArray[np.float64],
        phase: NDArray[np.float64],
        found: NDArray[np.bool_],
    ) -> tuple[NDArray[np.complex64], NDArray[np.complex64]]:
        """See `numpy_direct_path.turn`."""
        positions, rx, samples = mean.shape
        out, halves_out = np.empty((rx, positions, samples), np.complex64), np.empty_like(halves)
        self._call(
            "turn",
            *(mean, halves, steering, folded_steering, positions, samples, halves.shape[-1]),
            *(np.array([origin]), frequency, phase / (2 * np.pi), found, out, halves_out),
        )
        return out, halves_out

    def _call(self, name: str, *arguments: NDArray[Any] | float) -> None:
        """Call a loop with arrays as pointers and numbers as int. Raises MemoryError."""
        arrays = [np.ascontiguousarray(x) if isinstance(x, np.ndarray) else x for x in arguments]
        given = [ctypes.c_void_p(x.ctypes.data) if isinstance(x, np.ndarray) else ctypes.c_int(int(x)) for x in arrays]
        if getattr(self._loaded, f"{name}_{self.bits}")(*given):
            raise MemoryError(f"no memory for {name}")


def library() -> Library | None:
    """Return the compiled loops; None, and one warning, if they cannot be used."""
    with _lock:
        return _load()


@lru_cache(maxsize=1)
def _load() -> Library | None:
    try:
        return Library()
    except LoadError as e:
        _log.warning(
            "synchronisation runs in NumPy, ten times slower than compiled: %s; to compile it, install a C compiler"
            " (apt install gcc, or pip install ziglang) and run: python -m polysight.sync.build",
            e,
        )
        return None
