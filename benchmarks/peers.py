"""Time-domain imagers beside ours, timed on some positions: their cost is positions times pixels, nothing else."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import Seconds
from polysight.imaging.aperture import Aperture

MISSING = "is not here, so there is no line for it: `pip install --group bench` adds it (FastSAR also needs g++)"


@dataclass(frozen=True)
class PeerImage:
    """Image of the chosen positions, and the CPU seconds that all positions would take."""

    image: NDArray[np.complex64]
    seconds: float


@dataclass(frozen=True)
class Peer:
    """An imager beside ours: its package, the function that forms its image, and the rows per timed one."""

    name: str
    package: str
    form: Callable[[Aperture, NDArray[np.complex64], int], PeerImage]
    every: int
    limits: tuple[float | None, float | None] = (None, None)


def installed(name: str) -> bool:
    """True if a package that only benchmarks need is installed, with the compiler of its kernels."""
    return importlib.util.find_spec(name) is not None and (name != "fastsar" or shutil.which("g++") is not None)


def time_domain_image(aperture: Aperture, samples: NDArray[np.complex64], every: int) -> PeerImage:
    """The plain sum of every so many-th row of reduced samples [rx, frequency, row, column]."""
    from benchmarks import time_domain  # needs numba

    chosen, offsets = _chosen(aperture, samples, every)

    def form(count: int) -> NDArray[np.complex64]:
        return time_domain.form_image(
            chosen[:, :count], aperture.frequencies_hz, offsets[:count, :2], aperture.antennas, aperture.grid
        )

    form(2)  # compiles
    return _timed(form, aperture, len(offsets))


def fastsar_image(aperture: Aperture, samples: NDArray[np.complex64], every: int) -> PeerImage:
    """FastSAR's bistatic sum over arbitrary points, of every so many-th row.

    FastSAR's phase history is the conjugate of ours and its range half of the path.
    """
    import fastsar

    chosen, offsets = _chosen(aperture, samples, every)
    f = aperture.frequencies_hz
    antennas = aperture.antennas

    def form(count: int) -> NDArray[np.complex64]:
        shift = offsets[:count]
        rx = range(len(antennas.rx_m))
        image = fastsar.backproject(
            chosen[:, :count].conj().reshape(-1, f.size),
            np.concatenate([antennas.tx_m + shift for _ in rx]),
            float(f[0]),
            float(f[1] - f[0]),
            aperture.grid.voxels_m,
            rcv=np.concatenate([antennas.rx_m[r] + shift for r in rx]),
            ref=np.repeat(antennas.direct_m, count) / 2,
            window=False,
            backend="cpu",
        )
        return np.asarray(image).conj().reshape(aperture.grid.shape)

    form(2)  # compiles
    return _timed(form, aperture, len(offsets))


def _timed(form: Callable[[int], NDArray[np.complex64]], aperture: Aperture, positions: int) -> PeerImage:
    took = Seconds()
    with took.timed():
        image = form(positions)
    rows, columns = aperture.shape[2:]
    return PeerImage(image, took.cpu[0] * rows * columns / positions)


def _chosen(
    aperture: Aperture, samples: NDArray[np.complex64], every: int
) -> tuple[NDArray[np.complex64], NDArray[np.float64]]:
    """Samples [rx, position, frequency] and offsets [position, 3] of every so many-th row."""
    part = samples[:, :, ::every]
    rx, m = part.shape[:2]
    flat = np.ascontiguousarray(part.reshape(rx, m, -1).swapaxes(1, 2))
    return flat, aperture.offsets_m[::every].reshape(-1, 3)
