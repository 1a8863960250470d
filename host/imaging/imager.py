"""The contract that the three imagers keep, and the choice between them."""

from __future__ import annotations

from typing import Any, Protocol

from polysight.host.imaging.aperture import Aperture, irregular
from polysight.host.imaging.direct import DirectImager
from polysight.host.imaging.spectral import SpectralImager


class Imager(Protocol):
    """Matched filter of an aperture's samples at its pixels, and its adjoint; sums, not means.

    With A the forward model of unit reflectivities, `samples(x)` is A x and `image(y)` is A^H y.
    """

    @property
    def aperture(self) -> Aperture:
        """Positions, antennas, frequencies, pixels."""
        ...

    def image(self, samples: Any) -> Any:
        """Of complex64 [rx, frequency, row, column], weighted, 0 where masked: complex [ny, nx]."""
        ...

    def constant(self, echo: Any, weights: Any) -> Any:
        """Image of an echo complex [rx, frequency], the same at every position, times weights [row, column]."""
        ...

    def samples(self, image: Any) -> Any:
        """What pixels complex [ny, nx] answer: complex [rx, frequency, row, column]."""
        ...


def choose_imager(aperture: Aperture) -> tuple[Imager, str | None]:
    """The fastest imager that is exact for an aperture, and a notice when it is the slow one."""
    reason = irregular(aperture)
    if reason is None:
        return SpectralImager(aperture), None
    rx, _, rows, columns = aperture.shape
    sums = rx * rows * columns * aperture.grid.x_m.size * aperture.grid.y_m.size
    notice = f"imaging by direct sum, {sums:.1e} terms, some {sums / 1e7:.0f} s a board: {reason}"
    return DirectImager(aperture), notice
