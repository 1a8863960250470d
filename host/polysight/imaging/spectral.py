"""Spectral imagers: for a plane parallel to the stage, imaging is a convolution.

The image is the matched filter of the samples g of all RX and frequencies f at all positions u of the stage:

    image(v) = sum over rx, f, u of  g(rx, f, u) kernel(rx, f, v - u)
    kernel(rx, f, x, y) = exp(-j 2 pi f d_rx(x, y) / c)

with v the pixel and d_rx the excess path, beyond the direct one. TX and RX move together, so that d_rx depends only on
the *lag* v - u. A convolution is a product of spectra: the products of all RX and frequencies are summed in the
spectrum, and one inverse transform gives the image.

Along y, the rows of positions and of pixels lie on one lattice, on which the kernel is sampled without interpolation.
Along x each row has its own shift (travel of the stage within a burst, backlash), which is a phase ramp in the
spectrum. The kernel's period along x is made smooth by a cross-fade (`cross_fade`), so that few of its spectral bins k
have energy: these are the *band*.

A `Lattice` has the periods, pitches and strides of regular positions and pixels (docs/decisions/0002-imaging.md). The
spectra of the kernels along x are computed here and cached in memory, for one aperture is imaged many times. Arrays
have the axes [rx * frequency] (*channel*), lag or row along y, and bin k along x.
"""

from __future__ import annotations

import itertools
import math
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.imaging.geometry import (
    Aperture,
    excess_path_m,
    fit_row_starts_m,
    measure_column_step_m,
    pitch_y_m,
    transform_in_place,
    turn,
)
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# Length of the cross-fade relative to the kernel's length in x, and its smallest length in columns. Chosen: a shorter
# one makes the band wider, a longer one makes the period longer.
_FADE_SHARE = 0.08
_FADE_COLUMNS = 20
# The band has the spectral bins with at least this amplitude, relative to the strongest (chosen: more bins are slower).
_LEAST_BIN = 1e-5
KEEP_BYTES = 1 << 28
"""Size of the cache in bytes: two boards of the published grid take 115 MB, 166 MB with the kernels of a live scan."""
# Lattices and kernels by key, the least recently used first.
_cache: OrderedDict[tuple[Any, ...], Any] = OrderedDict()

SLACK_M = 2e-3
"""Largest deviation of a row's start along x from the aperture; chosen: one step of the published grid."""
# Principal components of the kernels with a smaller amplitude, relative to the strongest, are left out (chosen: 17 of
# the published rig's 40 are kept).
_LEAST_COMPONENT = 6e-6
# Number of bins k processed in double precision at a time: with 32 a live scan takes 11 MB more memory, and no less
# time.
_CHUNK = 8
# Complex numbers in a cache line
_CACHE_LINE = 8


@dataclass(frozen=True)
class Lattice:
    """Periods, pitches and strides of the spectral imagers.

    Attributes
    ----------
    size_x, pitch_x_m, stride_x
        Points and pitch of the kernel's period in x; columns are `stride_x` pitches apart.
    first_lag_m
        Smallest lag (x, y) at which the period holds the kernel itself.
    exact_x
        Number of lags in x at which it does; the rest of the period is the cross-fade.
    band
        Spectral bins along x with kernel energy, consecutive and signed, [k].
    size_y, pitch_y_m
        Points and pitch of the transform along y.
    row_stride, pixel_stride
        Spacing of rows of positions and of rows of pixels along y, in pitches.
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
        """Wavenumbers of the band along x, cycles per metre, in the shape of `band`."""
        return self.band / (self.size_x * self.pitch_x_m)


def make_lattice(aperture: Aperture, slack_m: float = 0.0) -> Lattice:
    """Return the lattice of a regular aperture, see :func:`polysight.imaging.geometry.find_irregularity`.

    Parameters
    ----------
    aperture
        The nominal aperture.
    slack_m
        Largest shift of rows along x from their nominal position.
    """
    grid = aperture.grid
    offsets = aperture.offsets_m
    x = offsets[..., 0]
    y = offsets[:, 0, 1]
    # The pitch is that of the pixels if rows and pixels have no common one.
    pitch_y = pitch_y_m(aperture) or grid.pixel_m
    pixel_stride = round(grid.pixel_m / pitch_y)
    row_stride = round((y[1] - y[0]) / pitch_y) if y.size > 1 else 1
    lags = row_stride * (y.size - 1) + pixel_stride * (grid.shape[0] - 1) + 1

    first = grid.x_m[0] - x.max() - slack_m
    last = grid.x_m[-1] - x.min() + slack_m
    # Rows of one position have no step.
    step = measure_column_step_m(offsets) or grid.pixel_m
    exact_columns = (last - first) / step + 1
    # Number of columns of one period: the exact lags and the cross-fade.
    columns = _find_fast_length(math.ceil(exact_columns + max(_FADE_SHARE * exact_columns, _FADE_COLUMNS)))
    band = _find_band(aperture, first, last, step, columns)
    # band.size / columns, rounded up: a period needs at least as many points as the band has bins.
    stride_x = -(-band.size // columns)
    pitch = step / stride_x
    return Lattice(
        size_x=columns * stride_x,
        pitch_x_m=pitch,
        stride_x=stride_x,
        first_lag_m=(float(first), float(grid.y_m[0] - y.max())),
        exact_x=math.ceil((last - first) / pitch) + 1,
        band=band,
        size_y=row_stride * _find_fast_length(-(-lags // row_stride)),
        pitch_y_m=pitch_y,
        row_stride=row_stride,
        pixel_stride=pixel_stride,
        lags_y=lags,
    )


def list_delays_s(aperture: Aperture, x: Any, y: Any, xp: Any = np, device: Any = None) -> Iterator[Any]:
    """Yield the delay of the excess path for lags x [nx] and y [ny], float64 [ny, nx] in seconds, for each RX."""
    a = aperture.antennas
    z = float(aperture.grid.z_m) - float(aperture.offsets_m[0, 0, 2])
    tx = xp.asarray(a.tx_m, device=device)
    places = xp.asarray(a.rx_m, device=device)
    for rx, direct in enumerate(a.direct_m):
        path = excess_path_m(
            xp=xp, x=x[None, :], y=y[:, None], z=z, tx_m=tx, rx_m=places[rx, :], reference_m=float(direct)
        )
        yield path / SPEED_OF_LIGHT_M_S


def cross_fade(xp: Any, kernel: Any, size: int) -> Any:
    """Return one period of a kernel [..., fade + size], whose first `fade` points precede the period.

    At the end of the period the kernel is cross-faded into those points, which lead to its start:

        period = (1 - ramp) end of the kernel + ramp points before its start,   ramp from 0 to 1

    The periodic function is smooth and has a narrow spectrum, so that phase ramps shift it by any fraction of a pitch.
    """
    fade = kernel.shape[-1] - size
    # The curve is within 2e-4 of 0 and 1 at its ends (published grid).
    curve = (1 + scipy.special.erf(np.linspace(-1, 1, fade + 2)[1:-1] * 2.7)) / 2
    ramp = xp.asarray(curve, dtype=xp.float32, device=getattr(kernel, "device", None))
    period = xp.asarray(kernel[..., fade:], copy=True)
    period[..., size - fade :] = period[..., size - fade :] * (1 - ramp) + kernel[..., :fade] * ramp
    return period


def _find_band(aperture: Aperture, first: float, last: float, step: float, columns: int) -> NDArray[np.intp]:
    """Return the spectral bins along x with kernel energy for lags `first` to `last` and a period of `columns` steps.

    Computed on a finer lattice, for the first and the last frequency, all RX, and nine lags in y.
    """
    grid = aperture.grid
    y = aperture.offsets_m[:, 0, 1]
    # Largest possible wavenumber, cycles per metre
    fastest = 2 * aperture.frequencies_hz[-1] / SPEED_OF_LIGHT_M_S
    # Two points per cycle would be enough; 2.2 leave a margin.
    finer = max(1, math.ceil(2.2 * step * fastest))
    size = columns * finer
    fade = size - math.ceil((last - first) / step * finer) - 1
    x = first + np.arange(-fade, size) * step / finer
    spectrum = np.zeros(size)
    for delay in list_delays_s(aperture, x, np.linspace(grid.y_m[0] - y.max(), grid.y_m[-1] - y.min(), 9)):
        for f in aperture.frequencies_hz[[0, -1]]:
            # exp(-j 2 pi f delay)
            kernel = cross_fade(np, turn(np, delay * f, np.float64, np.complex128), size)
            spectrum = np.maximum(spectrum, np.abs(np.fft.fft(kernel, axis=1)).max(axis=0))
    filled = np.fft.fftfreq(size, 1 / size)[spectrum > _LEAST_BIN * spectrum.max()]
    return np.arange(round(filled.min()), round(filled.max()) + 1)


def _list_runs(bins: NDArray[np.intp]) -> list[tuple[slice, slice]]:
    """Return the runs of consecutive numbers in `bins`: for each its slice of indices, and the slice of its numbers."""
    ends = [0, *(np.flatnonzero(np.diff(bins) != 1) + 1), bins.size]
    return [(slice(a, b), slice(int(bins[a]), int(bins[a]) + b - a)) for a, b in itertools.pairwise(ends)]


def _find_fast_length(n: int) -> int:
    """Return the smallest fast transform length of at least `n`."""
    return int(scipy.fft.next_fast_len(n) or n)


def get_cached(key: tuple[Any, ...], make: Callable[[], Any]) -> Any:
    """Return the cached arrays of a key, or make them; the least recently used are dropped beyond `KEEP_BYTES`."""
    if key not in _cache:
        _cache[key] = make()
    _cache.move_to_end(key)
    while len(_cache) > 1 and sum(_count_bytes(a) for a in _cache.values()) > KEEP_BYTES:
        _cache.popitem(last=False)
    return _cache[key]


def _count_bytes(arrays: Any) -> int:
    """Return the bytes of a complex64 array, or of a tuple of these."""
    if isinstance(arrays, tuple):
        return sum(_count_bytes(a) for a in arrays)
    # The size of a lattice is negligible
    return math.prod(getattr(arrays, "shape", (0,))) * 8


def clear_cache() -> None:
    """Clear the cache."""
    _cache.clear()


def make_lattice_key(aperture: Aperture, slack_m: float) -> tuple[Any, ...]:
    """Return the cache key of a lattice."""
    a = aperture.antennas
    grid = aperture.grid
    offsets = aperture.offsets_m
    # Positions of a regular aperture: starts and spacing of its rows are enough, and a thousandth of the bytes.
    numbers = (a.tx_m, a.rx_m, aperture.frequencies_hz, fit_row_starts_m(offsets), offsets[:, 0, 1], grid.x_m, grid.y_m)
    heights = float(grid.z_m), float(offsets[0, 0, 2])
    sizes = offsets.shape[1], measure_column_step_m(offsets), grid.pixel_m
    return ("lattice", slack_m, *heights, *sizes, *(n.tobytes() for n in numbers))


def make_kernel_key(aperture: Aperture, lattice: Lattice, xp: Any, device: Any) -> tuple[Any, ...]:
    """Return the cache key of kernels."""
    a = aperture.antennas
    grid = aperture.grid
    numbers = (a.tx_m, a.rx_m, aperture.frequencies_hz, lattice.band)
    return (
        *(n.tobytes() for n in numbers),
        float(grid.z_m) - float(aperture.offsets_m[0, 0, 2]),
        (lattice.size_x, lattice.pitch_x_m, lattice.exact_x, lattice.first_lag_m, lattice.lags_y, lattice.pitch_y_m),
        xp.__name__,
        str(device),
    )


def compute_spectra_along_x(aperture: Aperture, lattice: Lattice, lines: int, xp: Any = np, device: Any = None) -> Any:
    """Return the spectra of the kernels along x in the band: complex64 [rx * frequency, lag y, k].

    The delays are computed once per RX. Frequencies are evenly spaced, so that each kernel is the one before times a
    phase step. Zeros follow the lags in y up to the number of `lines`.
    """
    n = lattice.size_x
    f = aperture.frequencies_hz
    fade = n - lattice.exact_x
    x = lattice.first_lag_m[0] + xp.arange(-fade, n, dtype=xp.float64, device=device) * lattice.pitch_x_m
    y = lattice.first_lag_m[1] + xp.arange(lattice.lags_y, dtype=xp.float64, device=device) * lattice.pitch_y_m
    step = float(f[-1] - f[0]) / max(1, f.size - 1)
    runs = _list_runs(lattice.band % n)
    size = (len(aperture.antennas.rx_m) * f.size, lines, lattice.band.size)
    spectra = xp.zeros(size, dtype=xp.complex64, device=device)
    for rx, delay in enumerate(list_delays_s(aperture, x, y, xp, device)):
        kernel = turn(xp, delay * float(f[0]), xp.float32, xp.complex64)
        phase_step = turn(xp, delay * step, xp.float32, xp.complex64)
        for m in range(f.size):
            spectrum = transform_in_place(xp, cross_fade(xp, kernel, n), axis=1)
            for in_band, bins in runs:
                spectra[rx * f.size + m, : lattice.lags_y, in_band] = spectrum[:, bins]
            kernel *= phase_step
    return spectra


class RowSpectra:
    """Transforms along x for both spectral imagers: rows to the kernel's band, and the band to pixels.

    Parameters
    ----------
    aperture
        A regular aperture, see :func:`polysight.imaging.geometry.find_irregularity`.
    xp, device
        Array API namespace and device.
    slack_m
        Largest shift of rows along x from the aperture.
    """

    def __init__(self, aperture: Aperture, xp: Any = np, device: Any = None, slack_m: float = 0.0) -> None:
        self.aperture = aperture
        self.xp = xp
        self.device = device
        key = make_lattice_key(aperture, slack_m)
        self.lattice: Lattice = get_cached(key, lambda: make_lattice(aperture, slack_m))
        # Columns in a period. The spectrum of rows repeats every `period` bins, so that it has each bin of the band.
        self.period = self.lattice.size_x // self.lattice.stride_x
        self._runs = _list_runs(self.lattice.band % self.period)
        self._origin = float(fit_row_starts_m(aperture.offsets_m).min())
        # Inverse transform along x at the pixels only, [k, nx].
        self._to_pixels = get_cached(("pixels", xp.__name__, str(device), *key), self._compute_waves_at_pixels)

    def _compute_waves_at_pixels(self) -> Any:
        lags_m = self.aperture.grid.x_m - self._origin - self.lattice.first_lag_m[0]
        wave = np.exp(2j * np.pi * np.outer(self.lattice.wavenumbers, lags_m)) / self.lattice.size_x
        return self.move_to_device(wave.astype(np.complex64))

    def move_to_device(self, array: Any) -> Any:
        """Copy a numpy array to the imager's device."""
        return self.xp.asarray(array, device=self.device)

    def compute_kernels(self, lines: int) -> Any:
        """Return the kernels, padded with zeros to this number of lines, complex64 [rx * frequency, lag y, k]."""
        return compute_spectra_along_x(self.aperture, self.lattice, lines, self.xp, self.device)

    def make_key(self, *more: Any) -> tuple[Any, ...]:
        """Return the cache key of an array made from the kernels."""
        return (*more, *make_kernel_key(self.aperture, self.lattice, self.xp, self.device))

    def compute_ramps(self, starts_m: Any) -> Any:
        """Return phase ramps that shift rows to their starts, complex64 [row, k]."""
        cycles = np.outer(starts_m - self._origin, self.lattice.wavenumbers)
        return self.move_to_device(np.exp(-2j * np.pi * cycles).astype(np.complex64))

    def transform_rows(self, rows: Any, ramps: Any) -> Any:
        """Return the spectra of rows [..., row, column] in the kernel's band, [..., row, k]."""
        xp = self.xp
        padded = xp.zeros((*rows.shape[:-1], self.period), dtype=xp.complex64, device=self.device)
        padded[..., : rows.shape[-1]] = rows
        spectra = xp.empty((*rows.shape[:-1], self.lattice.band.size), dtype=xp.complex64, device=self.device)
        self.transform_padded(padded, ramps, spectra)
        return spectra

    def transform_padded(self, padded: Any, ramps: Any, spectra: Any) -> None:
        """Write :meth:`transform_rows` of rows padded with zeros to a period to `spectra`; may overwrite the rows."""
        full_spectrum = transform_in_place(self.xp, padded, axis=-1)
        for in_band, bins in self._runs:
            spectra[..., in_band] = full_spectrum[..., bins] * ramps[..., in_band]

    def transform_rows_adjoint(self, spectra: Any, ramps: Any) -> Any:
        """Apply the adjoint of :meth:`transform_rows`."""
        xp = self.xp
        count = self.lattice.band.size
        columns = self.aperture.offsets_m.shape[1]
        padding = xp.zeros((*spectra.shape[:-1], self.lattice.size_x - count), dtype=xp.complex64, device=self.device)
        # The band is put back to its bins of the kernel's period. Bins that are `period` apart are one bin of the rows.
        spectrum = xp.roll(xp.concat([spectra * xp.conj(ramps), padding], axis=-1), int(self.lattice.band[0]), axis=-1)
        folded = xp.sum(xp.reshape(spectrum, (*spectra.shape[:-1], self.lattice.stride_x, self.period)), axis=-2)
        return transform_in_place(xp, folded, axis=-1, inverse=True)[..., :columns] * self.period

    def evaluate_pixels_adjoint(self, image: Any) -> Any:
        """Apply the adjoint of :meth:`evaluate_pixels`: [..., ny, nx] to [..., ny, k]."""
        return self.xp.matmul(image, self.xp.conj(self._to_pixels).mT)

    def evaluate_pixels(self, spectra: Any) -> Any:
        """Evaluate the spectra of rows of pixels [..., ny, k] at the pixels, [..., ny, nx]."""
        return self.xp.matmul(spectra, self._to_pixels)


class SpectralImager(RowSpectra):
    """Imager of all rows together: one 2-D product per RX and frequency, one inverse transform."""

    def __init__(self, aperture: Aperture, xp: Any = np, device: Any = None, slack_m: float = 0.0) -> None:
        super().__init__(aperture, xp, device, slack_m)
        key = (xp.__name__, str(device), *make_lattice_key(aperture, slack_m))
        self._ramps = get_cached(("ramps", *key), lambda: self.compute_ramps(fit_row_starts_m(aperture.offsets_m)))
        sizes = self.lattice
        # The last constant echo and the sum of the kernels for it; shared by all imagers with the same kernels, and
        # empty before the first echo.
        self._echoes: list[tuple[Any, Any]] = get_cached(self.make_key("echo", sizes.size_y), list)
        rows = aperture.offsets_m.shape[0]
        lines = aperture.grid.shape[0]
        # Lattice row of the first row of pixels.
        self._first_pixel_row = sizes.row_stride * (rows - 1)
        count = sizes.size_y // sizes.row_stride
        # Rows, padded with zeros below. They are an odd number of cache lines apart in memory: otherwise all would use
        # the same places of the cache (transforms took 1.6 times as long).
        pitch = _CACHE_LINE * (-(-sizes.band.size // _CACHE_LINE) | 1)
        padded_lines = self.xp.zeros((count, pitch), dtype=self.xp.complex64, device=device)
        self._padded_lines = padded_lines[:, : sizes.band.size]
        # Rows are `row_stride` pitches apart: their spectrum along y repeats `row_stride` times in that of the lattice.
        self._repeat = self.move_to_device(np.arange(sizes.size_y) % count)
        # Lattice rows of positions, and of pixels.
        self._rows = self.move_to_device(np.arange(rows) * sizes.row_stride)
        self._pixel_rows = self.move_to_device(self._first_pixel_row + np.arange(lines) * sizes.pixel_stride)
        self._kernels = get_cached(
            self.make_key("2d", sizes.size_y),
            lambda: transform_in_place(xp, self.compute_kernels(sizes.size_y), axis=-2),
        )

    def image(self, samples: Any) -> Any:
        """Return the matched filter of samples [rx, frequency, row, column], complex64 [ny, nx]."""
        return self.form_weighted_image(samples, 1.0, [1.0] * self.aperture.shape[0])

    def form_weighted_image(self, samples: Any, weights: Any, factors: Any) -> Any:
        """Return :meth:`image` of samples times weights [row, column] (or one number) and a factor per RX."""
        xp = self.xp
        rows, columns = self.aperture.shape[2:]
        padded = xp.zeros((rows, self.period), dtype=xp.complex64, device=self.device)

        def put_spectra(r: int, c: int) -> None:
            padded[:, :columns] = samples[r, c, :, :] * weights
            padded[:, columns:] = 0
            self.transform_padded(padded, self._ramps, self._padded_lines[:rows, :])

        return self._sum_channels(put_spectra, factors)

    def spectra_of_row(self, samples: Any, index: int) -> Any:
        """Return the spectra [..., k] of a row [..., column] for :meth:`image_of_spectra`."""
        return self.transform_rows(samples, self._ramps[index, :])

    def image_of_spectra(self, spectra: Any, factors: Any) -> Any:
        """Return :meth:`image` of rows transformed along x [rx, frequency, row, k], with a factor per RX."""

        def put_spectra(r: int, c: int) -> None:
            self._padded_lines[: spectra.shape[2], :] = spectra[r, c, :, :]

        return self._sum_channels(put_spectra, factors)

    def _sum_channels(self, put_spectra: Callable[[int, int], None], factors: Any) -> Any:
        """Return the image of all channels; `put_spectra` writes the rows of one RX and frequency to the padded lines.

        It is the inverse transform of the sum over rx of factor times the sum over f of (spectrum times kernel).
        """
        rx, m = self.aperture.shape[:2]
        shape = self._kernels.shape[1:]
        total = self.xp.zeros(shape, dtype=self.xp.complex64, device=self.device)
        for r in range(rx):
            channel_sum = self.xp.zeros(shape, dtype=self.xp.complex64, device=self.device)
            for c in range(m):
                put_spectra(r, c)
                spectrum = self._transform_along_y()
                spectrum *= self._kernels[r * m + c, :, :]
                channel_sum += spectrum
            channel_sum *= factors[r]
            total += channel_sum
        return self._invert_transform(total)

    def image_constant_echo(self, echo: Any, weights: Any) -> Any:
        """Return the image of an echo [rx, frequency] at every position, times weights [row, column]."""
        xp = self.xp
        echo = self.xp.asarray(echo, dtype=self.xp.complex64)
        last = self._echoes[0] if self._echoes else None
        if last is None or not bool(xp.all(last[0] == echo)):
            last = (echo, xp.tensordot(xp.reshape(echo, (-1,)), self._kernels, axes=1))
            self._echoes[:] = [last]
        spectra = self.transform_rows(xp.astype(weights, xp.complex64), self._ramps)
        self._padded_lines[: spectra.shape[0], :] = spectra
        return self._invert_transform(last[1] * self._transform_along_y())

    def samples(self, image: Any) -> Any:
        """Return the echoes of pixels [ny, nx], [rx, frequency, row, column]; the adjoint of :meth:`image`."""
        xp = self.xp
        sizes = self.lattice
        lines = self.evaluate_pixels_adjoint(image)
        padded = xp.zeros((sizes.size_y, lines.shape[-1]), dtype=xp.complex64, device=self.device)
        end = self._first_pixel_row + sizes.pixel_stride * lines.shape[0]
        padded[self._first_pixel_row : end : sizes.pixel_stride, :] = lines
        spectrum = transform_in_place(xp, padded, axis=0)
        rows = []
        for c in range(self._kernels.shape[0]):
            product = transform_in_place(xp, xp.conj(self._kernels[c, :, :]) * spectrum, axis=0, inverse=True)
            rows.append(self.transform_rows_adjoint(xp.take(product, self._rows, axis=0), self._ramps))
        return xp.reshape(xp.stack(rows), self.aperture.shape)

    def _transform_along_y(self) -> Any:
        """Return the 2-D spectrum on the lattice [ky, k] of the rows in the padded lines, which it may overwrite."""
        self._padded_lines[self.aperture.shape[2] :, :] = 0
        spectrum = transform_in_place(self.xp, self._padded_lines, axis=0)
        if self.lattice.row_stride == 1:
            return spectrum
        return self.xp.take(spectrum, self._repeat, axis=0)

    def _invert_transform(self, total: Any) -> Any:
        """Return the pixels [ny, nx] of a spectrum on the lattice [ky, k], which may be overwritten."""
        lines = self.xp.take(transform_in_place(self.xp, total, axis=0, inverse=True), self._pixel_rows, axis=0)
        return self.evaluate_pixels(lines)


class IncrementalImager(RowSpectra):
    """Imager that adds row by row to the image.

    At each bin k, a row adds kernel [ny, channel] @ spectra [channel]. The kernels of the channels are similar, so that
    few principal components describe them all: this makes the product smaller (`_compute_principal_kernels`).

    Parameters
    ----------
    aperture
        The nominal aperture; rows may start up to 2 mm along x from it.
    echo
        complex [rx, frequency]: constant echo that is imaged as well; None for none.
    xp, device
        Array API namespace and device.
    """

    def __init__(self, aperture: Aperture, echo: Any = None, xp: Any = np, device: Any = None) -> None:
        super().__init__(aperture, xp, device, SLACK_M)
        rows = aperture.shape[2]
        lines = aperture.grid.shape[0]
        # Index of the lag in y from the first row of positions to the first row of pixels; number of lags from one row
        # to all rows of pixels.
        self._first_pixel_row = self.lattice.row_stride * (rows - 1)
        self._span = self.lattice.pixel_stride * (lines - 1) + 1
        self._kernels, self._components = get_cached(self.make_key("rows"), self._compute_principal_kernels)
        if echo is None:
            echo = np.zeros(aperture.shape[:2])
        self._clear(echo)

    def add_row(self, index: int, samples: Any, weights: Any, start_m: float) -> None:
        """Add a row to the image.

        Parameters
        ----------
        index
            Index of the row.
        samples
            complex64 [rx, frequency, column], weighted. To replace a row, give the difference.
        weights
            float32 [column], for the constant echo. To replace a row, give the difference.
        start_m
            Stage offset of the first column.
        """
        ramp = self.compute_ramps(np.array([start_m]))[0, :]
        weight_spectra = self.transform_rows(self.xp.astype(weights, self.xp.complex64), ramp)
        self.add_spectra(index, self.transform_rows(samples, ramp), weight_spectra)

    def add_spectra(self, index: int, lines: Any, weight_spectra: Any) -> None:
        """Add a row that is transformed along x, [rx, frequency, k], and its weights, [k]."""
        xp = self.xp
        rx, m = self.aperture.shape[:2]
        # Block diagonal [k, channel, rx], so that each RX has a column of its own.
        spectra_by_rx = xp.zeros((lines.shape[-1], rx * m, rx), dtype=xp.complex64, device=self.device)
        for r in range(rx):
            spectra_by_rx[:, r * m : (r + 1) * m, r] = lines[r, :, :].mT
        lags = self._find_lags(index)
        # [k, ny, component] @ [k, component, channel] @ [k, channel, rx]
        self._sum += xp.matmul(self._kernels[:, lags, :], xp.matmul(self._components, spectra_by_rx))
        self._constant += self._echo_kernel[:, lags] * weight_spectra[:, None]

    def image_of_sum(self, factors: Any) -> Any:
        """Return the image of the rows so far, with a factor per RX [rx], complex64 [ny, nx]."""
        total = self.xp.matmul(self._sum, self.move_to_device(np.asarray(factors, np.complex64))[:, None])[:, :, 0]
        return self.evaluate_pixels(total.mT)

    def image_summed_constant_echo(self) -> Any:
        """Return the image of the constant echo for the rows so far, complex64 [ny, nx]."""
        return self.evaluate_pixels(self._constant.mT)

    def image(self, samples: Any) -> Any:
        """See :class:`polysight.imaging.samples.Imager`; removes all rows first."""
        rx, m, rows, columns = self.aperture.shape
        self._clear(np.zeros((rx, m)))
        self._add_all(samples, self.xp.zeros((rows, columns), dtype=self.xp.float32, device=self.device))
        return self.image_of_sum(np.ones(rx))

    def image_constant_echo(self, echo: Any, weights: Any) -> Any:
        """See :class:`polysight.imaging.samples.Imager`; removes all rows first."""
        self._clear(echo)
        self._add_all(self.xp.zeros(self.aperture.shape, dtype=self.xp.complex64, device=self.device), weights)
        return self.image_summed_constant_echo()

    def samples(self, image: Any) -> Any:
        """See :class:`polysight.imaging.samples.Imager`."""
        xp = self.xp
        rx, m, rows, columns = self.aperture.shape
        lines = self.evaluate_pixels_adjoint(image).mT[:, :, None]
        ramps = self.compute_ramps(fit_row_starts_m(self.aperture.offsets_m))
        out = []
        for index in range(rows):
            # [k, component, ny] @ [k, ny, 1], then [k, channel, component] @ [k, component, 1]
            parts = xp.matmul(xp.conj(self._kernels[:, self._find_lags(index), :]).mT, lines)
            row_spectra = xp.matmul(xp.conj(self._components).mT, parts)[:, :, 0]
            out.append(self.transform_rows_adjoint(row_spectra.mT, ramps[index, :]))
        return xp.permute_dims(xp.reshape(xp.stack(out), (rows, rx, m, columns)), (1, 2, 0, 3))

    def _clear(self, echo: Any) -> None:
        """Remove all rows."""
        xp = self.xp
        rx = self.aperture.shape[0]
        size = (self.lattice.band.size, self.aperture.grid.shape[0])
        # Sums over the rows so far, spectra along x of the lines of pixels: those of the samples [k, ny, rx], and those
        # of the constant echo [k, ny].
        self._sum = xp.zeros((*size, rx), dtype=xp.complex64, device=self.device)
        self._constant = xp.zeros(size, dtype=xp.complex64, device=self.device)
        channels = xp.reshape(xp.asarray(echo, dtype=xp.complex64, device=self.device), (-1,))[:, None]
        self._echo_kernel = xp.matmul(self._kernels, xp.matmul(self._components, channels))[:, :, 0]

    def _add_all(self, samples: Any, weights: Any) -> None:
        """Add every row at its place in the aperture."""
        for index, start in enumerate(fit_row_starts_m(self.aperture.offsets_m)):
            self.add_row(index, samples[:, :, index, :], weights[index, :], float(start))

    def _find_lags(self, index: int) -> slice:
        """Return the indices of the lags in y between a row of positions and every row of pixels."""
        first = self._first_pixel_row - index * self.lattice.row_stride
        return slice(first, first + self._span, self.lattice.pixel_stride)

    def _compute_principal_kernels(self) -> tuple[Any, Any]:
        """Return kernels [k, lag, component], and the transform from channels, [k, component, channel].

        With K [lag, channel] the kernels at one bin, and V [channel, component] the strongest eigenvectors of K^H K,
        these are K V and V^H: K is nearly K V V^H.
        """
        xp = self.xp
        lattice = self.lattice
        channels = math.prod(self.aperture.shape[:2])
        kernels_by_k = xp.empty((lattice.band.size, lattice.lags_y, channels), dtype=xp.complex64, device=self.device)
        # The kernels are stored contiguously by k, so that products are fast.
        kernels_by_k[...] = xp.permute_dims(self.compute_kernels(lattice.lags_y), (2, 1, 0))
        powers = []
        bases = []
        for first in range(0, kernels_by_k.shape[0], _CHUNK):
            last = min(first + _CHUNK, kernels_by_k.shape[0])
            # Weak components need double precision.
            exact = xp.astype(kernels_by_k[first:last, :, :], xp.complex128)
            powers_of_chunk, vectors = xp.linalg.eigh(xp.matmul(xp.conj(exact).mT, exact))
            powers.append(powers_of_chunk)
            bases.append(xp.astype(vectors, xp.complex64))
        power = xp.concat(powers)
        # Powers ascend: the last component is the strongest at every bin. The same number is kept at all bins.
        strongest = xp.max(power, axis=0)
        count = int(xp.sum(xp.astype(strongest > _LEAST_COMPONENT**2 * strongest[-1], xp.int64)))
        vectors_used = xp.concat([vectors[:, :, -count:] for vectors in bases])
        return xp.matmul(kernels_by_k, vectors_used), xp.asarray(xp.conj(vectors_used).mT, copy=True)
