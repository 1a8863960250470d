"""Synchronisation as published (paper, section 5.2): position after position, by division and large transforms."""

from __future__ import annotations

import numpy as np
import scipy.fft
import scipy.signal
from numpy.typing import NDArray

from polysight.shared.config import Board, Instrument
from polysight.shared.geometry import rx_positions_m, tx_position_m
from polysight.shared.units import SPEED_OF_LIGHT_M_S

Complex = NDArray[np.complexfloating]
FFT = 16_384
ZOOM, TUNED_ZOOM = 4_096, 512  # points of a zoom transform; the published size is not stated (docs/benchmarks.md)


class Synchroniser:
    """One board's positions, one at a time.

    Parameters
    ----------
    rig, board
        Rig file and one of its receiving boards: the linear samples, and where the direct path comes from.
    tuned
        The same steps in complex64 instead of the complex128 that NumPy makes of int16 `I + 1j * Q`, smaller zooms, and
        one transform of the RX's sum instead of the sum of their transforms.
    """

    def __init__(self, rig: Instrument, board: Board, tuned: bool = False) -> None:
        chirp, self._tuned = rig.chirp, tuned
        self._type, self._zoom = (np.complex64, TUNED_ZOOM) if tuned else (np.complex128, ZOOM)
        self._chirp, (self._a, self._b) = chirp, chirp.linear_samples
        sweep = chirp.first_sample_hz + chirp.hz_per_sample * np.arange(chirp.samples)
        tx, rx = np.array(tx_position_m(rig)), np.array(rx_positions_m(rig, board))
        path = np.linalg.norm(rx - tx, axis=-1)
        turns = np.outer(path - path[0], sweep) / SPEED_OF_LIGHT_M_S
        self._steering = np.exp(-2j * np.pi * turns).astype(self._type)
        self._n = np.arange(chirp.samples)
        t = chirp.sample_rate_hz
        f = np.fft.fftfreq(chirp.samples, 1 / t)
        f = np.where(f < 0, f + t, f) if chirp.if_mode == "complex1x" else f
        h = np.ones(f.shape, complex)
        for corner_hz in (khz * 1e3 for khz in (chirp.hpf1_khz, chirp.hpf2_khz) if khz):
            h *= (1j * f / corner_hz) / (1 + 1j * f / corner_hz)
        self._unfilter = (h.conj() / np.maximum(np.abs(h) ** 2, 1 / 16)).astype(self._type)

    def decode(self, payload: NDArray[np.uint8], chirps: int) -> Complex:
        """One position's bytes to complex [chirp, rx, sample]: I of RX1..RX4, then Q, for every sample."""
        words = payload.view("<i2").reshape(chirps, self._chirp.samples, 2, -1)
        return (words[:, :, 0] + 1j * words[:, :, 1]).astype(self._type).transpose(0, 2, 1)

    def align(self, chirps: Complex) -> Complex:
        """Every chirp turned into the first one's frequency and phase, then the mean.

        The quotient of two chirps is a tone (paper, equation 4): its frequency and phase are read off the largest of
        16,384 points, summed over the RX, which share a clock.

        Parameters
        ----------
        chirps
            complex [chirp, rx, sample].

        Returns
        -------
        complex [rx, sample].
        """
        total = chirps[0].copy()
        for chirp, (frequency, phase) in zip(chirps[1:], self.offsets(chirps)[1:], strict=True):
            total += chirp * np.exp(-1j * (2 * np.pi * frequency * self._n + phase)).astype(self._type)
        return total / len(chirps)

    def offsets(self, chirps: Complex) -> list[tuple[float, float]]:
        """Frequency (cycles a sample) and phase (rad at the first linear sample) of each chirp against the first."""
        reference = chirps[0, :, self._a : self._b]
        found = [(0.0, 0.0)]
        for chirp in chirps[1:]:
            quotient = chirp[:, self._a : self._b] / reference
            if self._tuned:
                quotient = quotient.sum(axis=0, keepdims=True)
            spectrum = np.asarray(scipy.fft.fft(quotient, FFT)).sum(axis=0)
            peak = int(np.argmax(np.abs(spectrum)))
            frequency = (peak if peak < FFT // 2 else peak - FFT) / FFT
            found.append((frequency, float(np.angle(spectrum[peak])) - 2 * np.pi * frequency * self._a))
        return found

    def compensate(self, chirps: Complex) -> Complex:
        """The high-pass filter taken out of every chirp; the paper does this first."""
        spectrum = np.asarray(scipy.fft.fft(chirps))
        spectrum *= self._unfilter
        return np.asarray(scipy.fft.ifft(spectrum))

    def reference(self, mean: Complex) -> tuple[Complex, float]:
        """A position's samples with the direct path's frequency and phase taken out of every RX.

        The RX are steered to the direct path and summed; the peak of 16,384 points is found and looked at twice more
        closely.

        Parameters
        ----------
        mean
            complex [rx, sample].

        Returns
        -------
        complex [rx, sample], and the direct path's phase (rad) at the first linear sample.
        """
        beam = (mean * self._steering).mean(axis=0)[self._a : self._b]
        peak = int(np.argmax(np.abs(np.asarray(scipy.fft.fft(beam, FFT)))))
        frequency, width = peak / FFT, 1 / FFT
        value = 0j
        for _ in range(2):
            near = scipy.signal.zoom_fft(beam, [frequency - width, frequency + width], self._zoom, fs=1, endpoint=True)
            best = int(np.argmax(np.abs(near)))
            frequency += width * (2 * best / (self._zoom - 1) - 1)
            width /= self._zoom / 4
            value = near[best]
        phase = float(np.angle(value))
        turn = np.exp(-1j * (2 * np.pi * frequency * (self._n - self._a) + phase)).astype(self._type)
        return mean * self._steering * turn, phase

    def row(self, payload: NDArray[np.uint8], positions: int) -> Complex:
        """All steps for the positions of a row: bytes to complex [rx, position, sample]."""
        size = payload.size // positions
        chirps = size // (self._chirp.samples * 4 * len(self._steering))
        done = []
        for i in range(positions):
            burst = self.compensate(self.decode(payload[i * size : (i + 1) * size], chirps))
            done.append(self.reference(self.align(burst))[0])
        return np.stack(done, axis=1)
