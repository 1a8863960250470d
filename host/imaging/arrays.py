"""Which array library computes: numpy, or through the array API a GPU's (CuPy, PyTorch).

The imagers use the functions of the Python array API standard only, from the library their samples come in. numpy
needs nothing more; for any other library the package `array-api-compat` maps what differs (`pip install
polysight[gpu]`).
"""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import scipy.fft

from polysight.shared.errors import ConfigError


def namespace(array: Any) -> Any:
    """The array API namespace of an array; numpy for anything that is no array.

    Raises
    ------
    ConfigError
        when the array is of another library and `array-api-compat` is not installed.
    """
    if isinstance(array, np.ndarray | np.generic | list | tuple | float | int | complex):
        return np
    try:
        import array_api_compat
    except ImportError:
        raise ConfigError(
            f"arrays of type {type(array).__module__}.{type(array).__name__} need the package array-api-compat",
            "it is an optional dependency, for GPUs",
            "pip install polysight[gpu], or give numpy arrays",
        ) from None
    return array_api_compat.array_namespace(array)


def fft_of(xp: Any) -> ModuleType | Any:
    """Fourier transforms of a namespace. scipy's for numpy: several transforms at once, in single precision."""
    return scipy.fft if xp is np else xp.fft


def device_of(array: Any) -> Any:
    """Where an array lies, to make others beside it."""
    return getattr(array, "device", None)
