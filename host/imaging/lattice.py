"""How regular positions and pixels fit together for the spectral imagers (docs/decisions/0002-imaging.md)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.special import erf

from polysight.host.imaging.aperture import Aperture, column_step_m, pitch_y_m
from polysight.host.imaging.model import excess_path_m, turn
from polysight.shared.units import SPEED_OF_LIGHT_M_S

_FADE = 0.08  # of the kernel's length in x: room in which it fades out and in again
_FADE_COLUMNS = 20  # at least
_FILLED = 1e-5  # of the kernel's strongest spectral bin: weaker ones are left out


@dataclass(frozen=True)
class Lattice:
    """Periods, pitches and strides.

    Attributes
    ----------
    size_x, pitch_x_m, stride_x
        Points and pitch of the kernel's period in x; columns are `stride_x` pitches apart.
    first_lag_m
        Smallest `pixel - position` (x, y) the kernel is exact for.
    exact_x
        Lags in x that must be exact; the rest of the period is the fade.
    band
        Signed spectral bins along x that the kernel fills, [k].
    size_y, pitch_y_m
        Points of the transform along y, and its pitch.
    row_stride, pixel_stride
        Pitches from one row to the next, of positions and of pixels.
    lags_y
        Number of lags in y.
    """

    size_x: int
    pitch_x_m: float
    stride_x: int
    first_lag_m: tuple[float, float]
    exact_x: int
    band: NDArray[np.intp]
    size_y: int
    pitch_y_m: float
    row_stride: int
    pixel_stride: int
    lags_y: int

    @property
    def wavenumbers(self) -> NDArray[np.float64]:
        """Of the band, cycles a metre."""
        return self.band / (self.size_x * self.pitch_x_m)


def lattice(aperture: Aperture, slack_m: float = 0.0) -> Lattice:
    """The lattice of an aperture that is not :func:`irregular`.

    Parameters
    ----------
    aperture
        The nominal one.
    slack_m
        Rows may be shifted along x by up to this much from where it says.
    """
    grid, offsets = aperture.grid, aperture.offsets_m
    x, y = offsets[..., 0], offsets[:, 0, 1]
    pitch_y = pitch_y_m(aperture) or grid.pixel_m
    pixel_stride = round(grid.pixel_m / pitch_y)
    row_stride = round((y[1] - y[0]) / pitch_y) if y.size > 1 else 1
    lags = row_stride * (y.size - 1) + pixel_stride * (grid.shape[0] - 1) + 1

    first = grid.x_m[0] - x.max() - slack_m
    last = grid.x_m[-1] - x.min() + slack_m
    step = column_step_m(offsets) or grid.pixel_m
    spans = (last - first) / step + 1
    columns = _fast(math.ceil(spans + max(_FADE * spans, _FADE_COLUMNS)))  # of one period
    band = _band(aperture, first, last, step, columns)
    stride_x = -(-band.size // columns)
    pitch = step / stride_x
    return Lattice(
        columns * stride_x,
        pitch,
        stride_x,
        (float(first), float(grid.y_m[0] - y.max())),
        math.ceil((last - first) / pitch) + 1,
        band,
        row_stride * _fast(-(-lags // row_stride)),
        pitch_y,
        row_stride,
        pixel_stride,
        lags,
    )


def delays_s(aperture: Aperture, x: Any, y: Any, xp: Any = np, device: Any = None) -> Iterator[Any]:
    """Delay of the excess path for lags `pixel - position` (x [nx], y [ny]), float64 [ny, nx], for each RX in turn."""
    a = aperture.antennas
    z = float(aperture.grid.z_m) - float(aperture.offsets_m[0, 0, 2])
    tx, places = xp.asarray(a.tx_m, device=device), xp.asarray(a.rx_m, device=device)
    for rx, direct in enumerate(a.direct_m):
        path = excess_path_m(xp, x[None, :], y[:, None], z, tx, places[rx, :], float(direct))
        yield path / SPEED_OF_LIGHT_M_S


def cross_fade(xp: Any, kernel: Any, size: int) -> Any:
    """One period of a kernel [..., fade + size], whose first `fade` points lie left of the period.

    At the end of the period the right end fades out, and the left end, one period on, fades in: a smooth periodic
    function with a narrow spectrum, so that phase ramps may shift it by any fraction.
    """
    fade = kernel.shape[-1] - size
    curve = (1 + erf(np.linspace(-1, 1, fade + 2)[1:-1] * 2.7)) / 2  # 1e-4 from its ends
    ramp = xp.asarray(curve, dtype=xp.float32, device=getattr(kernel, "device", None))
    period = xp.asarray(kernel[..., fade:], copy=True)
    period[..., size - fade :] = period[..., size - fade :] * (1 - ramp) + kernel[..., :fade] * ramp
    return period


def _band(aperture: Aperture, first: float, last: float, step: float, columns: int) -> NDArray[np.intp]:
    """Spectral bins along x that the kernels of lags `first` to `last` fill, for a period of `columns` steps.

    Seen on a finer lattice, for the first and the last frequency, all RX, and distances in y from end to end.
    """
    grid, y = aperture.grid, aperture.offsets_m[:, 0, 1]
    fastest = 2 * aperture.frequencies_hz[-1] / SPEED_OF_LIGHT_M_S  # cycles a metre that no geometry can exceed
    finer = max(1, math.ceil(2.2 * step * fastest))
    size = columns * finer
    fade = size - math.ceil((last - first) / step * finer) - 1
    x = first + np.arange(-fade, size) * step / finer
    spectrum = np.zeros(size)
    for delay in delays_s(aperture, x, np.linspace(grid.y_m[0] - y.max(), grid.y_m[-1] - y.min(), 9)):
        for f in aperture.frequencies_hz[[0, -1]]:
            kernel = cross_fade(np, turn(np, delay * f, np.float64, np.complex128), size)
            spectrum = np.maximum(spectrum, np.abs(np.fft.fft(kernel, axis=1)).max(axis=0))
    filled = np.fft.fftfreq(size, 1 / size)[spectrum > _FILLED * spectrum.max()]
    return np.arange(round(filled.min()), round(filled.max()) + 1)


def _fast(n: int) -> int:
    """A length from `n` up that transforms fast."""
    return int(scipy.fft.next_fast_len(n) or n)
