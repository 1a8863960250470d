"""Input of an imager: antennas, stage positions, frequencies and pixels; regularity checks; windows.

Also functions of the array API (namespace, transforms, device), so that imagers run on NumPy, PyTorch and CuPy.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.imaging.geometry import Antennas, ImageGrid
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError

_SAME_M = 1e-6  # tolerance of positions: 2e-3 rad at one position, far below the noise
_FINER = 4  # the lattice in y may be this much finer than the pixels
Window = str | tuple[Any, ...]
"""Window as for scipy.signal.get_window; "boxcar" for none."""


@dataclass(frozen=True)
class Aperture:
    """Geometry of one board's measurement of a scene.

    Attributes
    ----------
    antennas
        TX and RX at stage offset zero.
    offsets_m
        float64 [row, column, 3]: true mean stage offset of every position; x ascends in a row.
    frequencies_hz
        float64 [frequency], evenly spaced.
    grid
        Pixels.
    """

    antennas: Antennas
    offsets_m: NDArray[np.float64]
    frequencies_hz: NDArray[np.float64]
    grid: ImageGrid

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of an imager's samples: (rx, frequency, row, column)."""
        return (len(self.antennas.rx_m), self.frequencies_hz.size, *self.offsets_m.shape[:2])


def irregular(aperture: Aperture) -> str | None:
    """Return the reason why positions and pixels do not form a lattice; None if they do."""
    offsets, grid = aperture.offsets_m, aperture.grid
    if np.ndim(grid.z_m):
        return "the imaged surface is not a plane parallel to the stage"
    if np.abs(offsets[..., 2] - offsets[0, 0, 2]).max() > _SAME_M:
        return "the stage's positions are not in one plane"
    if np.ptp(offsets[..., 1], axis=1).max() > _SAME_M:
        return "the rows are not straight"
    places = np.arange(offsets.shape[1]) * column_step_m(offsets)
    if np.abs(offsets[..., 0] - row_starts_m(offsets)[:, None] - places).max() > _SAME_M:
        return "the positions of a row are not evenly spaced"
    y = offsets[:, 0, 1]
    if np.abs(y - np.linspace(y[0], y[-1], y.size)).max() > _SAME_M:
        return "the rows are not evenly spaced"
    if pitch_y_m(aperture) is None:
        return "the rows' distance and the pixels' have no common measure"
    return None


def column_step_m(offsets_m: NDArray[np.float64]) -> float:
    """Return the mean spacing of positions in a row; 0 for rows of one position."""
    x = offsets_m[..., 0]
    return float((x[:, -1] - x[:, 0]).mean()) / max(1, x.shape[1] - 1)


def row_starts_m(offsets_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the x of each row's first position, [row]: best fit of evenly spaced positions to the row."""
    x = offsets_m[..., 0]
    return (x - np.arange(x.shape[1]) * column_step_m(offsets_m)).mean(axis=1)


def pitch_y_m(aperture: Aperture) -> float | None:
    """Return a common divisor of row spacing and pixel; None without one."""
    y = aperture.offsets_m[:, 0, 1]
    for finer in range(1, _FINER + 1):
        pitch = aperture.grid.pixel_m / finer
        cells = (y - y[0]) / pitch
        if np.abs(cells - np.round(cells)).max() * pitch < _SAME_M:
            return pitch
    return None


def window_weights(name: Window, n: int) -> NDArray[np.float64]:
    """Return a symmetric window of n points without the zeros at its ends, float64 [n]."""
    match name:  # common ones in NumPy: scipy.signal loads scipy.stats, which takes a second
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


def namespace(array: Any) -> Any:
    """Return the array API namespace of an array; numpy for lists and numbers.

    Raises
    ------
    ConfigError
        if the array is of another library and `array-api-compat` is not installed.
    """
    if isinstance(array, np.ndarray | np.generic | list | tuple | float | int | complex):
        return np
    try:
        import array_api_compat
    except ImportError:
        raise ConfigError(
            f"arrays of type {type(array).__module__}.{type(array).__name__} need the package array-api-compat",
            "it is an optional dependency, for GPUs",
            "pip install array-api-compat, or give numpy arrays",
            code=ErrorCode.PACKAGE_MISSING,
        ) from None
    return array_api_compat.array_namespace(array)


def fft_of(xp: Any) -> ModuleType | Any:
    """Return the Fourier transforms of a namespace; scipy's for numpy, which keep single precision."""
    return scipy.fft if xp is np else xp.fft


def device_of(array: Any) -> Any:
    """Return the device of an array."""
    return getattr(array, "device", None)
