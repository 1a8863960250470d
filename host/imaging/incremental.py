"""The row-incremental spectral imager: every row updates the image as soon as it is there.

Along x a row is a spectrum; along y its part in a row of pixels depends on their distance only. So with kernels
transformed along x alone, one row's update is, for each wavenumber, a small matrix product: (rows of pixels x
channels) times (channels). The sum over rows is kept as it is, with one column an RX, whose gains may become known
later. Adding the difference replaces an earlier take of a row.

For one wavenumber the kernels of all channels (RX x frequency) are much alike: they see the scene under nearly one
angle in x. Their principal components, about half as many, take their place.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from polysight.host.imaging.aperture import Aperture, row_starts_m
from polysight.host.imaging.kernels import kept
from polysight.host.imaging.spectral import RowSpectra

SLACK_M = 2e-3
"""How far along x a row may start from where the aperture says."""

_LEFT_OUT = 6e-6  # of the strongest principal component: weaker ones are left out
_AT_ONCE = 32  # wavenumbers in double precision at once


class IncrementalImager(RowSpectra):
    """Image of the rows so far.

    Parameters
    ----------
    aperture
        The nominal one; rows may start up to 2 mm along x from where it says.
    echo
        complex [rx, frequency]: the constant echo imaged along; None for none.
    xp, device
        Array API namespace, and where its arrays lie.
    """

    def __init__(self, aperture: Aperture, echo: Any = None, xp: Any = np, device: Any = None) -> None:
        super().__init__(aperture, xp, device, SLACK_M)
        rows, lines = aperture.shape[2], aperture.grid.shape[0]
        self._last = self.lattice.row_stride * (rows - 1)
        self._span = self.lattice.pixel_stride * (lines - 1) + 1
        self._kernels, self._components = kept(self.key("rows"), self._principal_kernels)
        self._clear(np.zeros(aperture.shape[:2]) if echo is None else echo)

    def add_row(self, index: int, samples: Any, weights: Any, start_m: float) -> None:
        """Add a row to the image.

        Parameters
        ----------
        index
            Of the row.
        samples
            complex64 [rx, frequency, column], weighted already. To replace an earlier take, the difference to it.
        weights
            float32 [column], for the constant echo; the difference likewise.
        start_m
            Stage offset of its first column.
        """
        ramp = self.ramps(np.array([start_m]))[0, :]
        white = self.of_rows(self.xp.astype(weights, self.xp.complex64), ramp)
        self.add_spectra(index, self.of_rows(samples, ramp), white)

    def add_spectra(self, index: int, lines: Any, white: Any) -> None:
        """:meth:`add_row` of a row that is transformed already, [rx, frequency, k], and its weights, [k]."""
        xp, (rx, m) = self.xp, self.aperture.shape[:2]
        by_rx = xp.zeros((lines.shape[-1], rx * m, rx), dtype=xp.complex64, device=self.device)
        for r in range(rx):
            by_rx[:, r * m : (r + 1) * m, r] = lines[r, :, :].mT
        at = self._lags(index)
        self._sum += xp.matmul(self._kernels[:, at, :], xp.matmul(self._components, by_rx))
        self._constant += self._echo_kernel[:, at] * white[:, None]

    def image_of_sum(self, factors: Any) -> Any:
        """The image of all rows so far, with a factor for each RX [rx], complex64 [ny, nx]."""
        total = self.xp.matmul(self._sum, self.put(np.asarray(factors, np.complex64))[:, None])[:, :, 0]
        return self.to_pixels(total.mT)

    def constant_of_sum(self) -> Any:
        """The image of the constant echo at all rows so far, complex64 [ny, nx]."""
        return self.to_pixels(self._constant.mT)

    def image(self, samples: Any) -> Any:
        """See :class:`polysight.host.imaging.imager.Imager`; what was added before is dropped."""
        rx, m, rows, columns = self.aperture.shape
        self._clear(np.zeros((rx, m)))
        self._add_all(samples, self.xp.zeros((rows, columns), dtype=self.xp.float32, device=self.device))
        return self.image_of_sum(np.ones(rx))

    def constant(self, echo: Any, weights: Any) -> Any:
        """See :class:`polysight.host.imaging.imager.Imager`; what was added before is dropped."""
        self._clear(echo)
        self._add_all(self.xp.zeros(self.aperture.shape, dtype=self.xp.complex64, device=self.device), weights)
        return self.constant_of_sum()

    def samples(self, image: Any) -> Any:
        """See :class:`polysight.host.imaging.imager.Imager`."""
        xp, (rx, m, rows, columns) = self.xp, self.aperture.shape
        lines = self.of_pixels(image).mT[:, :, None]
        ramps = self.ramps(row_starts_m(self.aperture.offsets_m))
        out = []
        for index in range(rows):
            parts = xp.matmul(xp.conj(self._kernels[:, self._lags(index), :]).mT, lines)
            answer = xp.matmul(xp.conj(self._components).mT, parts)[:, :, 0]
            out.append(self.to_rows(answer.mT, ramps[index, :]))
        return xp.permute_dims(xp.reshape(xp.stack(out), (rows, rx, m, columns)), (1, 2, 0, 3))

    def _clear(self, echo: Any) -> None:
        """Forget all rows."""
        xp, (rx, _, _, _) = self.xp, self.aperture.shape
        size = (self.lattice.band.size, self.aperture.grid.shape[0])
        self._sum = xp.zeros((*size, rx), dtype=xp.complex64, device=self.device)
        self._constant = xp.zeros(size, dtype=xp.complex64, device=self.device)
        channels = xp.reshape(xp.asarray(echo, dtype=xp.complex64, device=self.device), (-1,))[:, None]
        self._echo_kernel = xp.matmul(self._kernels, xp.matmul(self._components, channels))[:, :, 0]

    def _add_all(self, samples: Any, weights: Any) -> None:
        for index, start in enumerate(row_starts_m(self.aperture.offsets_m)):
            self.add_row(index, samples[:, :, index, :], weights[index, :], float(start))

    def _lags(self, index: int) -> slice:
        """Lags in y between a row of positions and every row of pixels."""
        first = self._last - index * self.lattice.row_stride
        return slice(first, first + self._span, self.lattice.pixel_stride)

    def _principal_kernels(self) -> tuple[Any, Any]:
        """Kernels [k, lag, component], and what makes components of channels, [k, component, channel]."""
        xp = self.xp
        whole = self.kernels()
        by_k = xp.empty(whole.shape[::-1], dtype=xp.complex64, device=self.device)
        by_k[...] = xp.permute_dims(whole, (2, 1, 0))  # contiguous, so that products are fast
        squares = []
        for first in range(0, by_k.shape[0], _AT_ONCE):
            last = min(first + _AT_ONCE, by_k.shape[0])
            exact = xp.astype(by_k[first:last, :, :], xp.complex128)  # weak components need the digits
            squares.append(xp.matmul(xp.conj(exact).mT, exact))
        power, vectors = xp.linalg.eigh(xp.concat(squares))
        strongest = xp.max(power, axis=0)  # ascending: the last component is the strongest at every wavenumber
        count = int(xp.sum(xp.astype(strongest > _LEFT_OUT**2 * strongest[-1], xp.int64)))
        kept_vectors = xp.astype(vectors[:, :, -count:], xp.complex64)
        return xp.matmul(by_k, kept_vectors), xp.asarray(xp.conj(kept_vectors).mT, copy=True)
