"""Common lattice of regular positions and pixels for the spectral imagers (docs/decisions/0002-imaging.md).

A `Lattice` has the periods, pitches and strides. The spectra of the kernels along x are computed here and cached in
memory, for one aperture is imaged many times.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.imaging.aperture import Aperture, column_step_m, fft_of, pitch_y_m
from polysight.imaging.geometry import excess_path_m, turn
from polysight_shared.units import SPEED_OF_LIGHT_M_S

_FADE = 0.08  # length of the cross-fade relative to the kernel's length in x
_FADE_COLUMNS = 20  # smallest length of the cross-fade
_FILLED = 1e-5  # relative to the kernel's strongest spectral bin: weaker ones are left out
KEEP_BYTES = 1 << 28
"""Size of the cache: two boards of the published grid take 90 MB."""
_cache: OrderedDict[tuple[Any, ...], Any] = OrderedDict()


@dataclass(frozen=True)
class Lattice:
    """Periods, pitches and strides of the spectral imagers.

    Attributes
    ----------
    size_x, pitch_x_m, stride_x
        Points and pitch of the kernel's period in x; columns are `stride_x` pitches apart.
    first_lag_m
        Smallest exact `pixel - position` (x, y).
    exact_x
        Number of exact lags in x; the rest of the period is the cross-fade.
    band
        Signed spectral bins along x with kernel energy, [k].
    size_y, pitch_y_m
        Points and pitch of the transform along y.
    row_stride, pixel_stride
        Spacing of rows of positions and of rows of pixels, in pitches.
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
        """Wavenumbers of the band, cycles per metre."""
        return self.band / (self.size_x * self.pitch_x_m)


def lattice(aperture: Aperture, slack_m: float = 0.0) -> Lattice:
    """Return the lattice of a regular aperture, see :func:`polysight.imaging.aperture.irregular`.

    Parameters
    ----------
    aperture
        The nominal aperture.
    slack_m
        Largest shift of rows along x from their nominal position.
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
    """Yield the delay of the excess path for lags `pixel - position` (x [nx], y [ny]), float64 [ny, nx], by RX."""
    a = aperture.antennas
    z = float(aperture.grid.z_m) - float(aperture.offsets_m[0, 0, 2])
    tx, places = xp.asarray(a.tx_m, device=device), xp.asarray(a.rx_m, device=device)
    for rx, direct in enumerate(a.direct_m):
        path = excess_path_m(xp, x[None, :], y[:, None], z, tx, places[rx, :], float(direct))
        yield path / SPEED_OF_LIGHT_M_S


def cross_fade(xp: Any, kernel: Any, size: int) -> Any:
    """Return one period of a kernel [..., fade + size], whose first `fade` points precede the period.

    At the end of the period the kernel is cross-faded into its start. The smooth periodic function has a narrow
    spectrum, so that phase ramps shift it by any fraction.
    """
    fade = kernel.shape[-1] - size
    curve = (1 + scipy.special.erf(np.linspace(-1, 1, fade + 2)[1:-1] * 2.7)) / 2  # 1e-4 from its ends
    ramp = xp.asarray(curve, dtype=xp.float32, device=getattr(kernel, "device", None))
    period = xp.asarray(kernel[..., fade:], copy=True)
    period[..., size - fade :] = period[..., size - fade :] * (1 - ramp) + kernel[..., :fade] * ramp
    return period


def _band(aperture: Aperture, first: float, last: float, step: float, columns: int) -> NDArray[np.intp]:
    """Return the spectral bins along x with kernel energy for lags `first` to `last` and a period of `columns` steps.

    Computed on a finer lattice, for the first and the last frequency, all RX, and nine lags in y.
    """
    grid, y = aperture.grid, aperture.offsets_m[:, 0, 1]
    fastest = 2 * aperture.frequencies_hz[-1] / SPEED_OF_LIGHT_M_S  # largest possible wavenumber, cycles per metre
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
    """Return the smallest fast transform length of at least `n`."""
    return int(scipy.fft.next_fast_len(n) or n)


def cached(key: tuple[Any, ...], make: Callable[[], Any]) -> Any:
    """Return the cached arrays of a key, or make them; the least recently used are dropped beyond `KEEP_BYTES`."""
    if key not in _cache:
        _cache[key] = make()
    _cache.move_to_end(key)
    while len(_cache) > 1 and sum(_bytes(a) for a in _cache.values()) > KEEP_BYTES:
        _cache.popitem(last=False)
    return _cache[key]


def _bytes(arrays: Any) -> int:
    if isinstance(arrays, tuple):
        return sum(_bytes(a) for a in arrays)
    return math.prod(getattr(arrays, "shape", (0,))) * 8  # the size of a lattice is negligible


def forget() -> None:
    """Clear the cache."""
    _cache.clear()


def lattice_key(aperture: Aperture, slack_m: float) -> tuple[Any, ...]:
    """Return the cache key of a lattice."""
    a, grid = aperture.antennas, aperture.grid
    numbers = (a.tx_m, a.rx_m, aperture.frequencies_hz, aperture.offsets_m, grid.x_m, grid.y_m)
    return ("lattice", slack_m, float(grid.z_m), grid.pixel_m, *(n.tobytes() for n in numbers))


def key_of(aperture: Aperture, lattice: Lattice, xp: Any, device: Any) -> tuple[Any, ...]:
    """Return the cache key of kernels."""
    a, grid = aperture.antennas, aperture.grid
    numbers = (a.tx_m, a.rx_m, aperture.frequencies_hz, lattice.band)
    return (
        *(n.tobytes() for n in numbers),
        float(grid.z_m) - float(aperture.offsets_m[0, 0, 2]),
        (lattice.size_x, lattice.pitch_x_m, lattice.exact_x, lattice.first_lag_m, lattice.lags_y, lattice.pitch_y_m),
        xp.__name__,
        str(device),
    )


def spectra_along_x(aperture: Aperture, lattice: Lattice, xp: Any = np, device: Any = None) -> Any:
    """Return kernels `exp(-j 2 pi f d / c)` of `pixel - position` along x: complex64 [rx * frequency, lag y, k].

    One distance map per RX; a constant phase step leads from one frequency to the next.
    """
    fft, n, f = fft_of(xp), lattice.size_x, aperture.frequencies_hz
    fade = n - lattice.exact_x
    x = lattice.first_lag_m[0] + xp.arange(-fade, n, dtype=xp.float64, device=device) * lattice.pitch_x_m
    y = lattice.first_lag_m[1] + xp.arange(lattice.lags_y, dtype=xp.float64, device=device) * lattice.pitch_y_m
    step = float(f[-1] - f[0]) / max(1, f.size - 1)
    band = xp.asarray(lattice.band % n, device=device)
    size = (len(aperture.antennas.rx_m) * f.size, lattice.lags_y, lattice.band.size)
    out = xp.empty(size, dtype=xp.complex64, device=device)
    for rx, delay in enumerate(delays_s(aperture, x, y, xp, device)):
        kernel = turn(xp, delay * float(f[0]), xp.float32, xp.complex64)
        turned = turn(xp, delay * step, xp.float32, xp.complex64)
        for m in range(f.size):
            spectrum = fft.fft(cross_fade(xp, kernel, n), axis=1)
            out[rx * f.size + m, :, :] = xp.take(spectrum, band, axis=1)
            kernel = kernel * turned
    return out
