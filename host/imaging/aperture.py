"""What an imager is made for: antennas, stage positions, frequencies, pixels; and whether they are regular.

Also the array library of an array (array API), its Fourier transforms and its device, so that imagers run on NumPy,
PyTorch and CuPy alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.host.imaging.geometry import Antennas, ImageGrid
from polysight.shared.errors import ConfigError

_SAME_M = 1e-6  # closer places are one: 2e-3 rad at one position, far below the noise of any
_FINER = 4  # the lattice in y may be this much finer than the pixels


@dataclass(frozen=True)
class Aperture:
    """One board's measurement of one scene.

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
        """Of the samples an imager takes: (rx, frequency, row, column)."""
        return (len(self.antennas.rx_m), self.frequencies_hz.size, *self.offsets_m.shape[:2])


def irregular(aperture: Aperture) -> str | None:
    """Why positions and pixels form no lattice, in a few words; None when they do."""
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
    """Mean distance of two neighbours in a row; 0 for rows of one position."""
    x = offsets_m[..., 0]
    return float((x[:, -1] - x[:, 0]).mean()) / max(1, x.shape[1] - 1)


def row_starts_m(offsets_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where each row's evenly spaced positions begin along x, [row]: the best fit to all of the row."""
    x = offsets_m[..., 0]
    return (x - np.arange(x.shape[1]) * column_step_m(offsets_m)).mean(axis=1)


def pitch_y_m(aperture: Aperture) -> float | None:
    """Common measure of the rows' distances and the pixel; None without one."""
    y = aperture.offsets_m[:, 0, 1]
    for finer in range(1, _FINER + 1):
        pitch = aperture.grid.pixel_m / finer
        cells = (y - y[0]) / pitch
        if np.abs(cells - np.round(cells)).max() * pitch < _SAME_M:
            return pitch
    return None


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
