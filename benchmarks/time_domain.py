"""The best plain time-domain sum, a rival of the spectral imager: bistatic, compiled, vectorised by LLVM.

Samples at a few frequencies become an oversampled range profile per position and RX (one FFT); every pixel reads every
profile at its own excess path (TX to pixel to RX, less the direct path from TX to RX) by linear interpolation and turns
it back by its phase. Sine and cosine are polynomials, so that the innermost loop, over positions, has no calls in it.
"""

from __future__ import annotations

import math

import numba  # pyright: ignore[reportMissingImports]  # of the group `bench`, which few install
import numpy as np
import scipy.fft
from numpy.typing import NDArray

from benchmarks.measure import Seconds
from polysight.imaging.geometry import Antennas, Aperture, ImageGrid
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# Bins of a range profile for each frequency: with 32 linear interpolation is good enough (the benchmark prints the
# difference of both images).
OVERSAMPLING = 32
# Positions at a time: their profiles stay in the second-level cache.
BLOCK = 128


@numba.njit(fastmath=True, error_model="numpy")
def _sum(
    real: NDArray[np.float32],  # profiles [rx, position * bin], `bins` bins after one another for each position
    imag: NDArray[np.float32],
    offset_x: NDArray[np.float32],  # stage offset [position]
    offset_y: NDArray[np.float32],
    tx: NDArray[np.float32],  # [3]
    rx: NDArray[np.float32],  # [rx, 3]
    direct: NDArray[np.float32],  # direct path to each RX [rx]
    x: NDArray[np.float32],  # pixels [x], [y], and their plane
    y: NDArray[np.float32],
    z: np.float32,
    bins: np.int32,
    bins_per_m: np.float32,
    first_m: np.float32,
    cycles_per_m: np.float32,
    image: NDArray[np.float32],  # [2, y, x]
) -> None:
    """Add every position's profile, at each pixel's excess path and turned back by its phase, to the image.

    The image has real and imaginary part. Lengths are metres. A profile begins at the excess path `first_m`, has `bins`
    bins and `bins_per_m` per metre; the phase of an echo turns by `cycles_per_m` cycles per metre.
    """
    unit = np.float32(1)
    half = np.float32(0.5)
    pi = np.float32(math.pi)
    dz2_t = (z - tx[2]) ** 2
    for begin in range(0, offset_x.size, BLOCK):
        count = min(BLOCK, offset_x.size - begin)
        for r in range(rx.shape[0]):
            dz2_r = (z - rx[r, 2]) ** 2
            real_part = real[r, begin * bins :]
            imaginary_part = imag[r, begin * bins :]
            u = offset_x[begin : begin + count]
            v = offset_y[begin : begin + count]
            for i in range(y.size):
                for j in range(x.size):
                    sum_re = sum_im = np.float32(0)
                    for p in range(count):
                        dx = x[j] - u[p]
                        dy = y[i] - v[p]
                        to_tx = np.sqrt((dx - tx[0]) ** 2 + (dy - tx[1]) ** 2 + dz2_t)
                        d = to_tx + np.sqrt((dx - rx[r, 0]) ** 2 + (dy - rx[r, 1]) ** 2 + dz2_r) - direct[r]
                        place = (d - first_m) * bins_per_m
                        low = np.int32(place)
                        w = place - np.float32(low)
                        # Unsigned, so that the compiled code does not check for negative indices.
                        k = np.uint64(np.uint32(low + np.int32(p) * bins))
                        re = real_part[k] + w * (real_part[k + np.uint64(1)] - real_part[k])
                        im = imaginary_part[k] + w * (imaginary_part[k + np.uint64(1)] - imaginary_part[k])
                        turns = -d * cycles_per_m
                        # Half the angle, -pi/2..pi/2, where the Taylor series of sine (s, to a^9) and cosine (c, to
                        # a^8) are good to 3e-5.
                        a = (turns - np.floor(turns + half)) * pi
                        q = a * a
                        s = np.float32(-1 / 5040) + q * np.float32(1 / 362880)
                        s = a * (unit + q * (np.float32(-1 / 6) + q * (np.float32(1 / 120) + q * s)))
                        c = np.float32(-1 / 720) + q * np.float32(1 / 40320)
                        c = unit + q * (-half + q * (np.float32(1 / 24) + q * c))
                        cos = unit - np.float32(2) * s * s
                        sin = np.float32(2) * s * c
                        sum_re += re * cos - im * sin
                        sum_im += re * sin + im * cos
                    image[0, i, j] += sum_re
                    image[1, i, j] += sum_im


def form_image(
    samples: NDArray[np.complex64],
    frequencies_hz: NDArray[np.float64],
    offsets_m: NDArray[np.float64],
    antennas: Antennas,
    grid: ImageGrid,
) -> NDArray[np.complex64]:
    """Form the image of one board from reduced samples.

    Parameters
    ----------
    samples
        complex64 [rx, position, frequency], phase +2 pi f d / c.
    frequencies_hz
        float64 [frequency], evenly spaced, at least two.
    offsets_m
        float64 [position, 2], stage offset (x, y).
    antennas, grid
        Geometry; the pixels lie on a level plane (`grid.z_m` is one number).

    Returns
    -------
    complex64 [ny, nx], the plain sum.
    """
    step_hz = float(frequencies_hz[1] - frequencies_hz[0])
    size = OVERSAMPLING * frequencies_hz.size
    # Shortest and longest excess path, on a grid of 33 x 33 differences of pixel and position (chosen).
    corners = np.array([offsets_m.min(axis=0), offsets_m.max(axis=0)])
    dx = np.linspace(grid.x_m[0] - corners[1, 0], grid.x_m[-1] - corners[0, 0], 33)
    dy = np.linspace(grid.y_m[0] - corners[1, 1], grid.y_m[-1] - corners[0, 1], 33)
    reach = antennas.excess_m(dx[None, :], dy[:, None], grid.z_m)
    middle_hz = frequencies_hz[len(frequencies_hz) // 2]
    # Profile at excess paths d from the shortest on: samples times exp(-j 2 pi (f - middle) d / c), summed over f. It
    # repeats itself after `period_m`. Three bins more, for rounding and for the bin behind that linear interpolation
    # needs.
    period_m = SPEED_OF_LIGHT_M_S / step_hz
    bins = math.ceil((float(reach.max()) - float(reach.min())) / period_m * size) + 3
    first_bin = math.floor(float(reach.min()) / period_m * size)
    k = np.arange(first_bin, first_bin + bins)
    # The FFT takes the first frequency as 0: `turn` adds its distance from the middle one.
    turn = np.exp(-2j * np.pi * (frequencies_hz[0] - middle_hz) / step_hz * k / size)
    spectrum = np.asarray(scipy.fft.fft(samples, size))[..., k % size] * turn
    real = single(spectrum.real.reshape(len(samples), -1))
    imag = single(spectrum.imag.reshape(len(samples), -1))
    image = np.zeros((2, *grid.shape), np.float32)
    _sum(
        real=real,
        imag=imag,
        offset_x=single(offsets_m[:, 0]),
        offset_y=single(offsets_m[:, 1]),
        tx=single(antennas.tx_m),
        rx=single(antennas.rx_m),
        direct=single(antennas.direct_m),
        x=single(grid.x_m),
        y=single(grid.y_m),
        z=np.float32(grid.z_m),
        bins=np.int32(bins),
        bins_per_m=np.float32(size / period_m),
        first_m=np.float32(first_bin * period_m / size),
        cycles_per_m=np.float32(middle_hz / SPEED_OF_LIGHT_M_S),
        image=image,
    )
    return (image[0] + 1j * image[1]).astype(np.complex64)


def single(a: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the array in single precision, contiguous."""
    return np.ascontiguousarray(a, np.float32)


def timed_image(aperture: Aperture, samples: NDArray[np.complex64], every: int) -> tuple[NDArray[np.complex64], float]:
    """Form the image of one row in `every` of reduced samples [rx, frequency, row, column].

    Return it, complex64 [ny, nx], and the CPU seconds that all rows would take: the cost is proportional to the number
    of positions.
    """
    part = samples[:, :, ::every]
    rx, frequencies, *_ = part.shape
    flat = np.ascontiguousarray(part.reshape(rx, frequencies, -1).swapaxes(1, 2))
    offsets = aperture.offsets_m[::every].reshape(-1, 3)[:, :2]
    # Untimed, of two positions: the first call compiles.
    form_image(flat[:, :2], aperture.frequencies_hz, offsets[:2], aperture.antennas, aperture.grid)
    took = Seconds()
    with took.time_block():
        image = form_image(flat, aperture.frequencies_hz, offsets, aperture.antennas, aperture.grid)
    rows, columns = aperture.shape[2:]
    return image, took.cpu[0] * rows * columns / len(offsets)
