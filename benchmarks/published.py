"""The published method (POLySIGHT, SenSys 2026: CITATION.cff) in plain form: the peer of the instrument's processing.

The steps, sizes and number formats of the authors' public code and of its notebooks' settings, rewritten for one
core with NumPy and SciPy; no line is theirs. `docs/benchmarks.md` says how its time compares with their code's.

`Synchroniser` (paper, section 5.2; notebook 1): a loop over positions, division, transforms. `form_image` (section 6.1;
the authors' `sum_bins`): one convolution for each range bin and RX. Range is read off the nearest bin of a zero-padded
FFT of every position, and the kernel of a bin holds the phase of every pixel whose excess path falls into it. Products
are summed over the bins before one inverse transform an RX. More points make finer bins, and more convolutions.
"""

import numpy as np
import scipy.fft
import scipy.signal
from numpy.typing import NDArray

from polysight.imaging.geometry import Antennas, ImageGrid
from polysight_shared.config import Board, Instrument
from polysight_shared.geometry import rx_positions_m, tx_position_m
from polysight_shared.units import SPEED_OF_LIGHT_M_S

Complex = NDArray[np.complexfloating]
# Constants are the settings of the authors' code. Transforms of the alignment are so many times longer than a chirp.
UPSCALE = 64
# Bins of the spectra in which the direct path is searched.
RANGE_BINS = 1024
# Points of the finer spectrum around the peak, over two bins.
ZOOM = 100
# RX whose samples alone are used for the alignment.
SYNC_RX = 0


class Synchroniser:
    """Synchronises one board's positions, one at a time.

    Parameters
    ----------
    rig, board
        Rig file and one of its receiving boards: the linear samples, and where the direct path comes from.
    """

    def __init__(self, rig: Instrument, board: Board) -> None:
        chirp = rig.chirp
        self._samples = chirp.samples
        self._a, self._b = chirp.linear_samples
        middle = chirp.first_sample_hz + chirp.hz_per_sample * chirp.samples / 2
        tx = np.array(tx_position_m(rig))
        rx = np.array(rx_positions_m(rig, board))
        path = np.linalg.norm(rx - tx, axis=-1)
        # [rx]: bring the direct path of every RX to the phase of RX1's.
        self._beam = np.exp(-2j * np.pi * middle / SPEED_OF_LIGHT_M_S * (path - path[0])).astype(np.complex64)
        self._n = np.arange(chirp.samples)
        # Spectrum of the linear samples at all range bins.
        self._to_bins = scipy.signal.ZoomFFT(self._b - self._a, [0, RANGE_BINS], RANGE_BINS, fs=RANGE_BINS)

    def decode(self, payload: NDArray[np.uint8], chirps: int) -> Complex:
        """Convert one position's bytes to complex64 [rx, chirp, sample]: I of RX1..RX4, then Q, for every sample."""
        words = payload.view("<i2").reshape(chirps, self._samples, 2, -1)
        return (words[:, :, 0] + 1j * words[:, :, 1]).astype(np.complex64).transpose(2, 0, 1)

    def align(self, chirps: Complex) -> Complex:
        """Align every chirp with the strongest one in frequency and phase; return the mean, complex64 [rx, sample].

        The quotient of two chirps is a tone (paper, equation 4): its frequency and phase are read off the largest
        point of a transform of one RX, and hold for all of them, which share a clock.

        Parameters
        ----------
        chirps
            complex64 [rx, chirp, sample].
        """
        frequency, phase = (part[:, None] for part in self.offsets(chirps))
        out = np.empty_like(chirps)
        # As published: each RX makes the same factors again, in double precision.
        for rx, channel in enumerate(chirps):
            out[rx] = channel * np.exp(-1j * (2 * np.pi * frequency * self._n + phase))
        return out.mean(axis=1)

    def offsets(self, chirps: Complex) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Return frequency (cycles a sample) and phase (rad at the first sample) of each chirp against the strongest.

        `chirps`: complex64 [rx, chirp, sample].
        """
        channel = chirps[SYNC_RX]
        reference = channel[np.abs(channel).sum(axis=1).argmax()].copy()
        # As published: samples near zero are replaced before the division.
        reference[np.abs(reference) < 0.1] = 0.1
        points = UPSCALE * self._samples
        spectra = np.asarray(np.fft.fftshift(np.fft.fft(channel / reference, points), -1))
        peaks = np.abs(spectra).argmax(axis=1)
        frequency = (peaks - points / 2) / points
        return frequency, np.angle(spectra[np.arange(len(peaks)), peaks])

    def reference(self, mean: Complex) -> tuple[Complex, float]:
        """Remove the frequency and phase of the direct path from a position's samples of every RX.

        The RX's spectra are steered to the direct path and summed; the first peak of 1,024 points is looked at
        more closely, and the phase is read off a spectrum of the result.

        Parameters
        ----------
        mean
            complex64 [rx, sample].

        Returns
        -------
        complex [rx, sample], and the direct path's phase (rad) at the first linear sample.
        """
        linear = mean[:, self._a : self._b]
        power = np.abs(self._beam @ self._to_bins(linear))
        # As published: the first of the peaks of at least half the maximum, two bins apart or more.
        peaks, _ = scipy.signal.find_peaks(power, height=power.max() / 2, distance=2)
        best = int(peaks[0] if len(peaks) else power.argmax())
        # As published: each RX within a bin of the peak, then once more the whole spectrum, of which bin 0 is read.
        near = scipy.signal.ZoomFFT(linear.shape[1], [best - 1, best + 1], ZOOM, fs=RANGE_BINS)
        frequency = (best + 2 * int(np.abs(self._beam @ near(linear)).argmax()) / ZOOM - 1) / RANGE_BINS
        moved = (mean * np.exp(-2j * np.pi * frequency * (self._n - self._a))).astype(np.complex64)
        back_to_range = self._beam @ np.fft.fft(moved[:, self._a : self._b], RANGE_BINS)
        phase = float(np.angle(back_to_range[0]))
        return moved * (self._beam * np.exp(-1j * phase)).astype(np.complex64)[:, None], phase

    def row(self, payload: NDArray[np.uint8], positions: int) -> Complex:
        """Process the positions of a row in all steps: bytes to complex [rx, position, sample]."""
        size = payload.size // positions
        chirps = size // (self._samples * 4 * len(self._beam))
        bursts = (self.decode(payload[i * size : (i + 1) * size], chirps) for i in range(positions))
        return np.stack([self.reference(self.align(burst))[0] for burst in bursts], axis=1)


# Points of the range FFT, the cheapest first.
SETTINGS = (1024, 2048, 4096)


def form_image(
    cube: NDArray[np.complex64],
    rig: Instrument,
    board: Board,
    grid: ImageGrid,
    points: int = SETTINGS[0],
) -> NDArray[np.complexfloating]:
    """Form the image of one board.

    The grid's pixels must be as far apart as the positions; the burst's travel is ignored, as published.

    Parameters
    ----------
    cube
        complex64 [rx, row, column, sample], referenced to the direct path; may be memory mapped.
    rig, board, grid
        Geometry.
    points
        Points of the range FFT.

    Returns
    -------
    complex [ny, nx].
    """
    chirp = rig.chirp
    a, b = chirp.linear_samples
    n_rx, rows, columns, _ = cube.shape
    ny, nx = grid.shape
    y = _make_lattice(grid.y_m, rows)
    x = _make_lattice(grid.x_m, columns)
    excess = Antennas.from_rig(rig, board).excess_m(x[None, :], y[:, None], grid.z_m)
    start_hz = chirp.first_sample_hz + chirp.hz_per_sample * a
    shape = rows + y.size - 1, columns + x.size - 1
    # The part of the convolution in which every position counts: one entry for each pixel.
    pixels = slice(rows - 1, rows - 1 + ny), slice(columns - 1, columns - 1 + nx)
    image = np.zeros((ny, nx), np.complex64)
    total = np.zeros(shape, np.complex64)
    for rx in range(n_rx):
        spectrum = np.asarray(scipy.fft.fft(cube[rx, :, :, a:b], points))
        bins = np.round(excess[rx] / SPEED_OF_LIGHT_M_S * chirp.hz_per_sample * points).astype(int)
        angle = (-2 * np.pi * start_hz / SPEED_OF_LIGHT_M_S * excess[rx]).astype(np.float32)
        for n in range(int(bins.min()), int(bins.max()) + 1):
            kernel = np.asarray(scipy.fft.fft2(np.exp(1j * angle) * (bins == n), shape))
            total += kernel * np.asarray(scipy.fft.fft2(spectrum[:, :, n % points], shape))
        image += np.asarray(scipy.fft.ifft2(total))[pixels]
        total[:] = 0
    return image


def _make_lattice(axis_m: NDArray[np.float64], positions: int) -> NDArray[np.float64]:
    """Return every pixel minus every position along one axis, [lag], ascending, metres."""
    pixel = axis_m[1] - axis_m[0]
    first = axis_m[0] - (positions - 1) / 2 * pixel
    return first + pixel * np.arange(axis_m.size + positions - 1)
