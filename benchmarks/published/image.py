"""Imaging as published (paper, section 6.1; the authors' `sum_bins`): one convolution for each range bin and RX.

Range is read off the nearest bin of a zero-padded FFT of every position, and the kernel of a bin holds the phase of
every pixel whose excess path falls into it. Products are summed over the bins before one inverse transform an RX. More
points make finer bins, and more convolutions.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from polysight.imaging.geometry import Antennas, ImageGrid
from polysight_shared.config import Board, Instrument
from polysight_shared.units import SPEED_OF_LIGHT_M_S

SETTINGS = (1024, 2048, 4096)  # points of the range FFT, from the cheapest


def form_image(
    cube: NDArray[np.complex64],
    rig: Instrument,
    board: Board,
    grid: ImageGrid,
    points: int = SETTINGS[0],
    tuned: bool = False,
) -> NDArray[np.complexfloating]:
    """Image of one board.

    The grid's pixels must be as far apart as the positions; the burst's travel is ignored, as published.

    Parameters
    ----------
    cube
        complex64 [rx, row, column, sample], referenced to the direct path; may be memory mapped.
    rig, board, grid
        Geometry.
    points
        Points of the range FFT.
    tuned
        The same convolutions padded to sizes whose transforms are fast, with a kernel's phases made once and not for
        every bin, and one inverse transform for all RX.

    Returns
    -------
    complex [ny, nx].
    """
    chirp, (a, b) = rig.chirp, rig.chirp.linear_samples
    n_rx, rows, columns, _ = cube.shape
    ny, nx = grid.shape
    y = _lattice(grid.y_m, rows)
    x = _lattice(grid.x_m, columns)
    excess = Antennas.of(rig, board).excess_m(x[None, :], y[:, None], grid.z_m)
    start_hz = chirp.first_sample_hz + chirp.hz_per_sample * a
    full = rows + y.size - 1, columns + x.size - 1
    shape = tuple(int(scipy.fft.next_fast_len(n) or n) for n in full) if tuned else full
    seen = slice(rows - 1, rows - 1 + ny), slice(columns - 1, columns - 1 + nx)
    image, total = np.zeros((ny, nx), np.complex64), np.zeros(shape, np.complex64)
    for rx in range(n_rx):
        spectrum = np.asarray(scipy.fft.fft(cube[rx, :, :, a:b], points))
        bins = np.round(excess[rx] / SPEED_OF_LIGHT_M_S * chirp.hz_per_sample * points).astype(int)
        turns = (-2 * np.pi * start_hz / SPEED_OF_LIGHT_M_S * excess[rx]).astype(np.float32)
        wave = np.exp(1j * turns) if tuned else None
        for n in range(int(bins.min()), int(bins.max()) + 1):
            kernel = np.where(bins == n, wave, 0) if wave is not None else np.exp(1j * turns) * (bins == n)
            kernel = np.asarray(scipy.fft.fft2(kernel, shape))
            total += kernel * np.asarray(scipy.fft.fft2(spectrum[:, :, n % points], shape))
        if not tuned:
            image += np.asarray(scipy.fft.ifft2(total))[seen]
            total[:] = 0
    return np.asarray(scipy.fft.ifft2(total))[seen] if tuned else image


def _lattice(axis_m: NDArray[np.float64], positions: int) -> NDArray[np.float64]:
    """Every pixel minus every position along one axis, ascending, metres."""
    pixel = axis_m[1] - axis_m[0]
    first = axis_m[0] - (positions - 1) / 2 * pixel
    return first + pixel * np.arange(axis_m.size + positions - 1)
