"""The spectral imager: for a plane parallel to the stage, imaging is convolution.

TX and RX move together and the object stands still, so the matched filter of a position u at a pixel v depends on `v
- u` only: `image = sum over rx, f of g * k`, with kernel `k(x, y) = exp(-j 2 pi f d_rx(x, y) / c)`. All products are
summed in the spectrum, and one inverse transform makes the image.

Along y rows and pixels share a lattice, and the kernel is sampled on it: nothing is interpolated. Along x each row has
a shift of its own (the stage's travel within a burst, backlash), which is a phase ramp in the spectrum.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from polysight.host.imaging.aperture import Aperture, row_starts_m
from polysight.host.imaging.arrays import fft_of
from polysight.host.imaging.kernels import kept, key_of, lattice_key, spectra_along_x
from polysight.host.imaging.lattice import Lattice, lattice


class RowSpectra:
    """What both spectral imagers do along x: rows into the kernel's band, and the band into pixels.

    Parameters
    ----------
    aperture
        Not :func:`polysight.host.imaging.aperture.irregular`.
    xp, device
        Array API namespace, and where its arrays lie.
    slack_m
        How far rows may be shifted along x from where the aperture says.
    """

    def __init__(self, aperture: Aperture, xp: Any = np, device: Any = None, slack_m: float = 0.0) -> None:
        self.aperture, self.xp, self.device = aperture, xp, device
        self.lattice: Lattice = kept(lattice_key(aperture, slack_m), lambda: lattice(aperture, slack_m))
        self._fft = fft_of(xp)
        self.period = self.lattice.size_x // self.lattice.stride_x
        self._take = self.put(self.lattice.band % self.period)
        self._origin = float(row_starts_m(aperture.offsets_m).min())
        at = aperture.grid.x_m - self._origin - self.lattice.first_lag_m[0]
        wave = np.exp(2j * np.pi * np.outer(self.lattice.wavenumbers, at)) / self.lattice.size_x
        self._to_pixels = self.put(wave.astype(np.complex64))

    def put(self, array: Any) -> Any:
        """A numpy array beside the imager's own."""
        return self.xp.asarray(array, device=self.device)

    def kernels(self) -> Any:
        """complex64 [rx * frequency, lag y, k]."""
        return spectra_along_x(self.aperture, self.lattice, self.xp, self.device)

    def key(self, *more: Any) -> tuple[Any, ...]:
        """Of an array made from the kernels."""
        return (*more, *key_of(self.aperture, self.lattice, self.xp, self.device))

    def ramps(self, starts_m: Any) -> Any:
        """Phase ramps that put rows where they start, complex64 [row, k]."""
        cycles = np.outer(starts_m - self._origin, self.lattice.wavenumbers)
        return self.put(np.exp(-2j * np.pi * cycles).astype(np.complex64))

    def of_rows(self, rows: Any, ramps: Any) -> Any:
        """Spectra of rows [..., row, column] in the kernel's band, [..., row, k]; a row of step s repeats s times."""
        whole = self._fft.fft(rows, n=self.period, axis=-1)
        return self.xp.take(whole, self._take, axis=-1) * ramps

    def to_rows(self, spectra: Any, ramps: Any) -> Any:
        """Adjoint of :meth:`of_rows`."""
        xp, count, columns = self.xp, self.lattice.band.size, self.aperture.offsets_m.shape[1]
        rest = xp.zeros((*spectra.shape[:-1], self.lattice.size_x - count), dtype=xp.complex64, device=self.device)
        whole = xp.roll(xp.concat([spectra * xp.conj(ramps), rest], axis=-1), int(self.lattice.band[0]), axis=-1)
        folded = xp.sum(xp.reshape(whole, (*spectra.shape[:-1], self.lattice.stride_x, self.period)), axis=-2)
        return self._fft.ifft(folded, axis=-1)[..., :columns] * self.period

    def of_pixels(self, image: Any) -> Any:
        """Adjoint of :meth:`to_pixels`: [..., ny, nx] to [..., ny, k]."""
        return self.xp.matmul(image, self.xp.conj(self._to_pixels).mT)

    def to_pixels(self, spectra: Any) -> Any:
        """Spectra of rows of pixels [..., ny, k] at the pixels, [..., ny, nx]."""
        return self.xp.matmul(spectra, self._to_pixels)


class SpectralImager(RowSpectra):
    """All rows at once: a 2-D product for each RX and frequency, one inverse transform."""

    def __init__(self, aperture: Aperture, xp: Any = np, device: Any = None, slack_m: float = 0.0) -> None:
        super().__init__(aperture, xp, device, slack_m)
        self._ramps = self.ramps(row_starts_m(aperture.offsets_m))
        self._echo: Any = None  # the last constant echo, and its kernel
        sizes, rows, lines = self.lattice, aperture.offsets_m.shape[0], aperture.grid.shape[0]
        self._last = sizes.row_stride * (rows - 1)  # where the first row of pixels comes out
        count = sizes.size_y // sizes.row_stride
        self._tall = self.xp.zeros((count, sizes.band.size), dtype=self.xp.complex64, device=device)  # zeros below rows
        self._repeat = self.put(np.arange(sizes.size_y) % count)
        self._rows = self.put(np.arange(rows) * sizes.row_stride)
        self._pixel_rows = self.put(self._last + np.arange(lines) * sizes.pixel_stride)
        self._kernels = kept(
            self.key("2d", self.lattice.size_y), lambda: self._fft.fft(self.kernels(), n=self.lattice.size_y, axis=-2)
        )

    def image(self, samples: Any) -> Any:
        """Matched filter of samples [rx, frequency, row, column], complex64 [ny, nx]."""
        rx, m, rows, columns = self.aperture.shape
        channels = self.xp.reshape(samples, (rx * m, rows, columns))
        total = self.xp.zeros(self._kernels.shape[1:], dtype=self.xp.complex64, device=self.device)
        for c in range(rx * m):
            total += self._kernels[c, :, :] * self._along_y(self.of_rows(channels[c, :, :], self._ramps))
        return self._inverse(total)

    def spectra_of_row(self, samples: Any, index: int) -> Any:
        """A row [..., column] ready for :meth:`image_of_spectra`: its spectra [..., k]."""
        return self.of_rows(samples, self._ramps[index, :])

    def image_of_spectra(self, spectra: Any, factors: Any) -> Any:
        """:meth:`image` of rows that are transformed along x already [rx, frequency, row, k], with a factor an RX."""
        rx, m = self.aperture.shape[:2]
        total = self.xp.zeros(self._kernels.shape[1:], dtype=self.xp.complex64, device=self.device)
        for r in range(rx):
            part = self.xp.zeros(self._kernels.shape[1:], dtype=self.xp.complex64, device=self.device)
            for c in range(m):
                part += self._kernels[r * m + c, :, :] * self._along_y(spectra[r, c, :, :])
            total += part * factors[r]
        return self._inverse(total)

    def constant(self, echo: Any, weights: Any) -> Any:
        """Image of an echo [rx, frequency] that is the same at every position, times weights [row, column]."""
        xp, echo = self.xp, self.xp.asarray(echo, dtype=self.xp.complex64)
        if self._echo is None or not bool(xp.all(self._echo[0] == echo)):
            channels = xp.reshape(echo, (-1,))
            total = xp.zeros(self._kernels.shape[1:], dtype=xp.complex64, device=self.device)
            for c in range(channels.shape[0]):
                total += self._kernels[c, :, :] * channels[c]
            self._echo = (echo, total)
        white = self._along_y(self.of_rows(xp.astype(weights, xp.complex64), self._ramps))
        return self._inverse(self._echo[1] * white)

    def samples(self, image: Any) -> Any:
        """Forward model, the adjoint of :meth:`image`: what pixels [ny, nx] answer, [rx, frequency, row, column]."""
        xp, sizes = self.xp, self.lattice
        lines = self.of_pixels(image)
        spread = xp.zeros((sizes.size_y, lines.shape[-1]), dtype=xp.complex64, device=self.device)
        end = self._last + sizes.pixel_stride * lines.shape[0]
        spread[self._last : end : sizes.pixel_stride, :] = lines
        spectrum = self._fft.fft(spread, axis=0)
        out = []
        for c in range(self._kernels.shape[0]):
            product = self._fft.ifft(xp.conj(self._kernels[c, :, :]) * spectrum, axis=0)
            out.append(self.to_rows(xp.take(product, self._rows, axis=0), self._ramps))
        return xp.reshape(xp.stack(out), self.aperture.shape)

    def _along_y(self, lines: Any) -> Any:
        """2-D spectrum on the lattice [ky, k], of the rows' spectra [row, k]; a row distance of s repeats s times."""
        self._tall[: lines.shape[0], :] = lines
        whole = self._fft.fft(self._tall, axis=0)
        return whole if self.lattice.row_stride == 1 else self.xp.take(whole, self._repeat, axis=0)

    def _inverse(self, total: Any) -> Any:
        lines = self.xp.take(self._fft.ifft(total, axis=0), self._pixel_rows, axis=0)
        return self.to_pixels(lines)
