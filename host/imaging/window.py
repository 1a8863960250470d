"""Windows over the aperture and over a chirp: symmetric, without the zeros at their ends."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Window = str | tuple[Any, ...]
"""As scipy.signal.get_window takes it; "boxcar" for none."""


def window_weights(name: Window, n: int) -> NDArray[np.float64]:
    """A window of n points, float64 [n]."""
    match name:  # the usual ones by NumPy: scipy.signal brings scipy.stats along, a second's work for every command
        case "boxcar":
            weights = np.ones(n + 2)
        case "hann":
            weights = np.hanning(n + 2)
        case ("kaiser", float(beta)):
            weights = np.kaiser(n + 2, beta)
        case _:
            from scipy.signal import get_window

            weights = np.asarray(get_window(name, n + 2, fftbins=False), np.float64)
    return weights[1:-1]
