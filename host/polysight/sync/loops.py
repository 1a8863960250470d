"""The loops of synchronisation in two forms with equal results: compiled, and in NumPy, which is the readable one.

* Tones: frequency and phase of a tone in many short records, at the Cramer-Rao bound (`signal.h`).
* Passes over a burst (`passes.h`): `match` and `reduce_chirps` read the raw samples; `against_others` and `average` use
  the reduced chirps, one sample for every block of `FOLD` = 4 (`decimate.py`). `offsets.py` decides between them. A
  burst is the chirps of a position; its linear samples are those in which the sweep is linear. Words are int16
  [position, chirp, sample, 2, rx] as the card sends them, I before Q. Mixing multiplies by
  `exp(-j 2 pi f (n - centre))`, with f in cycles per sample and `centre` the middle of the linear samples.
* `NumpyLoops`: loops over positions that find the direct path from TX to RX (`direct_path.c`; method: `offsets.py`).
* `Library` calls `burst.c` and `direct_path.c` through ctypes, which releases the interpreter. :func:`load_library`
  returns it, or None and one warning if nothing was compiled; then the slower NumPy form is used.
"""

from __future__ import annotations

import ctypes
import logging
import threading
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.sync import high_pass_filter as hpf
from polysight.sync.decimate import FOLD, decimator, flatten, fold

CHUNK = 8
"""Positions per chunk: the working set fits in the second-level cache."""
RX = 4
"""Number of RX that the compiled loops support."""
# Blocks of a record whose sums the Newton steps of `refine` use, see `block_edges`.
_BLOCKS = 8
MOST_CHIRPS = 256
"""Chirps of a burst that the compiled loops support."""

_log = logging.getLogger(__name__)
_lock = threading.Lock()

# Any array as an argument in C, made in a third of the time that `ctypes.data` takes.
_ANY_ARRAY = ctypes.c_char * 0
Real = NDArray[np.floating]
Complex = NDArray[np.complexfloating]


class Tone(NamedTuple):
    """`frequency` [...], cycles per sample, about -1/2..1/2; `amplitude` complex [...], at the record's centre."""

    frequency: NDArray[np.float64]
    amplitude: Complex


def cis(angle: Real) -> NDArray[np.complex64]:
    """Return exp(j angle), any shape, within 3e-7. Angles are reduced in float64; sines of float32 are vectorised."""
    turns = np.asarray(angle) / (2 * np.pi)
    turns -= np.rint(turns)
    small = (2 * np.pi * turns).astype(np.float32)
    phasors = np.empty(small.shape, np.complex64)
    np.cos(small, out=phasors.real)
    np.sin(small, out=phasors.imag)
    return phasors


def complex64(values: Complex) -> NDArray[np.complex64]:
    """Return values of any shape in single precision, contiguous, as the loops take them."""
    return np.ascontiguousarray(values, np.complex64)


def phasor(frequency: Real, phase: Real, samples: int, origin: float) -> NDArray[np.complex64]:
    """Return exp(j (2 pi frequency (n - origin) + phase)) for n = 0..samples-1.

    An outer product of a coarse and a fine ramp: 32 exponentials instead of 256, phases in float64.

    Parameters
    ----------
    frequency, phase
        float64 [...], cycles per sample, and radians at `origin`.
    samples, origin
        Number of samples, and the sample at which the phase is `phase`.

    Returns
    -------
    complex64 [..., samples].
    """
    step = max(1, round(samples**0.5))
    coarse = np.arange(0, samples, step) - origin
    w = 2 * np.pi * frequency[..., None]
    a = cis(w * coarse + phase[..., None])
    b = cis(w * np.arange(step))
    ramp = a[..., :, None] * b[..., None, :]
    return ramp.reshape(*frequency.shape, coarse.size * step)[..., :samples]


@lru_cache(maxsize=8)
def block_edges(n: int) -> NDArray[np.intp]:
    """Return the edges [9] of eight blocks in a record of n samples; fewer blocks if n is below eight.

    For frequencies below half a cycle per record, block sums lose less than 1.3 % of the information.
    """
    return np.unique(np.linspace(0, n, min(_BLOCKS, n) + 1).astype(np.intp))


def block_times(edges: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return the centres of the blocks, [edges - 1], in samples from the record's centre."""
    return (edges[:-1] + edges[1:] - 1) / 2 - (edges[-1] - 1) / 2


def refine(blocks: Complex, times: Real, steps: int = 3) -> Tone:
    """Maximise the periodogram |sum_n y_n exp(-j w t_n)|^2 by Newton's method, starting at zero frequency.

    From the nearest bin of a twofold zero-padded FFT, two steps reach the Cramer-Rao bound up to 30 dB (Rife and
    Boorstyn 1974); the third removes the remaining bias of a thousandth of a bin.

    Parameters
    ----------
    blocks, times
        complex [..., block], and the blocks' times in samples from the centre.
    steps
        Newton steps.
    """
    w = np.zeros(blocks.shape[:-1])
    limit = 2 * np.pi / (times[-1] - times[0])
    turned_blocks, s0, s1, s2, step = blocks, w, w, w, w
    # Slope and curvature are half the derivatives of |s0|^2 by w; a step is at most a cycle per record.
    for i in range(steps):
        if i > 0:
            turned_blocks = blocks * cis(-w[..., None] * times)
        s0 = turned_blocks.sum(axis=-1)
        s1 = turned_blocks @ times
        s2 = turned_blocks @ times**2
        slope = (s0.conj() * s1).imag
        curvature = np.abs(s1) ** 2 - (s0.conj() * s2).real
        step = np.divide(-slope, curvature, out=np.zeros_like(slope), where=curvature < 0)
        step = np.minimum(np.maximum(step, -limit), limit)
        w += step
    # The sum at the final frequency, by a Taylor series about the one before: the last step is small.
    return Tone(w / (2 * np.pi), s0 - 1j * step * s1 - step**2 / 2 * s2)


def search_size(n: int) -> int:
    """Return the FFT size to find a tone of n samples: a power of four, with at least a quarter of padding."""
    return 4 ** int(np.ceil(np.log2(1.25 * n) / 2))


def find_strongest(z: NDArray[np.complex64], samples: int) -> Tone:
    """Return the strongest tone of each record, within some hundredths of a bin: FFT peak with parabolic interpolation.

    Parameters
    ----------
    z
        complex64 [..., size], zero beyond the first `samples`; overwritten.
    samples
        Length of the record. The tone's amplitude is the sum over it (not the mean), at its centre.
    """
    size = z.shape[-1]
    spectrum: NDArray[np.complex64] = np.asarray(scipy.fft.fft(z, axis=-1, overwrite_x=True)).reshape(-1, size)
    top = np.argmax(spectrum.real**2 + spectrum.imag**2, axis=-1)
    spectrum_rows = np.arange(len(spectrum))
    bin_below = spectrum[spectrum_rows, (top - 1) % size]
    bin_value = spectrum[spectrum_rows, top]
    bin_above = spectrum[spectrum_rows, (top + 1) % size]
    fraction = find_peak_between(np.abs(bin_below), np.abs(bin_value), np.abs(bin_above))
    bin_frequency = np.where(top < size // 2, top, top - size) / size
    # The transform of a symmetrical window is real, so the phase of the bin is that of the tone at the centre.
    amplitude = bin_value * cis(2 * np.pi * bin_frequency * (samples - 1) / 2)
    shape = z.shape[:-1]
    return Tone((bin_frequency + fraction / size).reshape(shape), amplitude.reshape(shape))


def estimate_tone(z: NDArray[np.complex64]) -> Tone:
    """Return the strongest tone of each record [..., sample]: FFT, then Newton. Amplitude as `find_strongest`."""
    n = z.shape[-1]
    padded = np.zeros((*z.shape[:-1], search_size(n)), np.complex64)
    padded[..., :n] = z
    coarse = find_strongest(padded, n).frequency
    demodulated = z * phasor(-coarse, np.zeros(coarse.shape), n, (n - 1) / 2)
    edges = block_edges(n)
    sums = np.add.reduceat(demodulated, edges[:-1], axis=-1).astype(complex)
    fine = refine(sums, block_times(edges))
    return Tone(coarse + fine.frequency, fine.amplitude)


def match(
    words: NDArray[np.int16], reference: NDArray[np.intp], linear: tuple[int, int]
) -> tuple[NDArray[np.float64], NDArray[np.complex128], NDArray[np.float64], NDArray[np.float32]]:
    """Find the tone between each chirp and a reference chirp: the strongest in their conjugate product over all RX.

    Parameters
    ----------
    words
        int16 [position, chirp, sample, 2, rx].
    reference
        int [position]: the reference chirp of each.
    linear
        Linear samples `[a, b)`.

    Returns
    -------
    frequency
        float64 [position, chirp], cycles per sample, within some hundredths of a bin.
    amplitude
        complex128 [position, chirp]: the tone's sum over RX and linear samples, at their middle.
    centre
        float64 [position]: middle of the band of the reference chirp, from :func:`find_band`.
    energy
        float32 [position, chirp], over RX and linear samples.
    """
    linear_part = _convert_to_complex(words[:, :, slice(*linear)])
    positions, chirps, _, n = linear_part.shape
    size = search_size(n)
    reference_chirp = linear_part[np.arange(positions), reference]
    products = np.zeros((positions, chirps, size), np.complex64)
    products[..., :n] = (linear_part * reference_chirp[:, None].conj()).sum(axis=2)
    tone = find_strongest(products, n)
    energy = (linear_part.real**2 + linear_part.imag**2).sum(axis=(2, 3))
    return tone.frequency, tone.amplitude.astype(complex), find_band(reference_chirp), energy


def find_band(chirps: NDArray[np.complex64]) -> NDArray[np.float64]:
    """Return the middle of the signal's band in chirps [position, rx, sample], cycles per sample 0..1.

    The power spectra of the quarters of a chirp, summed over the RX and smoothed, show direct path and object as one
    peak: a quarter resolves four range bins. A parabola through its top gives the middle.
    """
    positions, rx, n = chirps.shape
    size = search_size(n) // 4
    spectra: NDArray[np.complex64] = np.asarray(scipy.fft.fft(chirps.reshape(positions, rx, 4, n // 4), size, axis=-1))
    power = (spectra.real**2 + spectra.imag**2).sum(axis=(1, 2))
    smooth = np.roll(power, 1, axis=-1) + 2 * power + np.roll(power, -1, axis=-1)
    top = np.argmax(smooth, axis=-1)
    below = smooth[np.arange(positions), (top - 1) % size]
    middle = smooth[np.arange(positions), top]
    above = smooth[np.arange(positions), (top + 1) % size]
    return (top + find_peak_between(below, middle, above)) / size % 1.0


def find_peak_between(below: Real, middle: Real, above: Real) -> NDArray[np.float64]:
    """Return the place of the maximum between three values [any], relative to the middle one, by a parabola; or 0."""
    bend = below.astype(np.float64) - 2 * middle + above
    return np.divide(0.5 * (below - above), bend, out=np.zeros(bend.shape), where=bend < 0)


def reduce_chirps(
    words: NDArray[np.int16],
    frequency: NDArray[np.float64],
    taps: NDArray[np.complex64],
    linear: tuple[int, int],
) -> NDArray[np.complex64]:
    """Return the linear samples of every chirp, mixed down, decimated (`decimate.fold`) and filtered.

    Parameters
    ----------
    words
        int16 [position, chirp, sample, 2, rx].
    frequency
        float64 [position, chirp], cycles per sample.
    taps
        complex64 [position, chirp, 3]: one block apart (`high_pass_filter.Equaliser`).
    linear
        Linear samples `[a, b)`, a multiple of `FOLD` many.

    Returns
    -------
    complex64 [position, chirp, rx, block].
    """
    a, b = linear
    turn = phasor(-frequency, np.zeros(frequency.shape), b - a, (b - a - 1) / 2)
    return hpf.apply_filter(fold(_convert_to_complex(words[:, :, a:b]) * turn[:, :, None]), taps)


def against_others(
    reduced: NDArray[np.complex64], good: NDArray[np.bool_]
) -> tuple[Tone, NDArray[np.float32], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Find the tone between each chirp and the sum of all others, and the rest of the chirp.

    Parameters
    ----------
    reduced
        complex64 [position, chirp, rx, block] from :func:`reduce_chirps`.
    good
        bool [position, chirp]: chirps in the sum.

    Returns
    -------
    tone
        float64 and complex128 [position, chirp]: the tone from `refine`, two Newton steps from zero.
    energy
        float32 [position, chirp]: energy of the chirp, over RX and blocks.
    sum_energy
        float64 [position, part]: energy of the good chirps' sum, in each of eight parts of a chirp.
    half_difference
        float64 [2, position, chirp]: difference of the tones from even and from odd RX, with the chirp itself in the
        sum: cycles per sample, and radians.
    residual_energy
        float64 [position, chirp, part]: energy of a chirp's part that is not a multiple of the others' sum.
    """
    positions, chirps, rx, blocks = reduced.shape
    good_sum = good[:, None].astype(np.complex64) @ reduced.reshape(positions, chirps, rx * blocks)
    total = good_sum.reshape(positions, 1, rx, blocks)
    edges = block_edges(blocks)
    times, starts = block_times(edges) * FOLD, edges[:-1]
    product = reduced * total.conj()
    halves = np.stack([product[:, :, 0::2].sum(axis=2), product[:, :, 1::2].sum(axis=2)])
    sums = np.add.reduceat(halves, starts, axis=-1).astype(complex)
    energy = (reduced.real**2 + reduced.imag**2).sum(axis=2)
    own_energy = np.add.reduceat(energy, starts, axis=-1).astype(np.float64)
    sum_energy = np.add.reduceat((total.real**2 + total.imag**2).sum(axis=(1, 2)), starts, axis=-1).astype(np.float64)
    correlation = sums[0] + sums[1]
    # A good chirp c is in the total T: without it, c (T - c)* = c T* - |c|^2, |T - c|^2 = |T|^2 - 2 Re c T* + |c|^2.
    correlation_with_others = correlation - np.where(good[..., None], own_energy, 0)
    others_energy = sum_energy[:, None] - np.where(good[..., None], 2 * correlation.real - own_energy, 0)
    has_others = others_energy > 1e-30
    explained = np.divide(np.abs(correlation_with_others) ** 2, others_energy, out=own_energy.copy(), where=has_others)
    residual_energy = own_energy - explained
    tone = refine(correlation_with_others, times, steps=2)
    split = refine(sums * cis(-2 * np.pi * tone.frequency[..., None] * times), times, steps=1)
    half_difference = split.frequency[0] - split.frequency[1], np.angle(split.amplitude[0] * split.amplitude[1].conj())
    return tone, own_energy.sum(axis=-1).astype(np.float32), sum_energy, np.stack(half_difference), residual_energy


def average(
    reduced: NDArray[np.complex64],
    frequency: NDArray[np.float64],
    phase: NDArray[np.float64],
    weights: NDArray[np.float32],
) -> NDArray[np.complex64]:
    """Return weighted sums of the reduced chirps, each turned by a frequency and a phase, flat (`decimate.flatten`).

    Parameters
    ----------
    reduced
        complex64 [position, chirp, rx, block].
    frequency, phase
        float64 [position, chirp]: cycles per sample; radians at the middle of the linear samples.
    weights
        float32 [position, 2, chirp]: of the chirps in each half.

    Returns
    -------
    complex64 [position, 2, rx, block].
    """
    positions, chirps, rx, blocks = reduced.shape
    derotated = reduced * phasor(-FOLD * frequency, -phase, blocks, (blocks - 1) / 2)[:, :, None]
    halves = weights.astype(np.complex64) @ derotated.reshape(positions, chirps, rx * blocks)
    return flatten(complex64(halves.reshape(positions, 2, rx, blocks)))


def _convert_to_complex(words: NDArray[np.int16]) -> NDArray[np.complex64]:
    """Return raw words as complex64 [position, chirp, rx, sample]."""
    positions, chirps, samples, _, rx = words.shape
    complex_words = np.empty((positions, chirps, rx, samples), np.complex64)
    complex_words.real = words[..., 0, :].swapaxes(2, 3)
    complex_words.imag = words[..., 1, :].swapaxes(2, 3)
    return complex_words


@lru_cache(maxsize=4)
def _weigh_bins(size: int) -> NDArray[np.float32]:
    """Return factors of a spectrum's bins [bin]: of two equal peaks, the one nearer the band's middle counts."""
    return np.sinc(np.fft.fftfreq(size)).astype(np.float32)


def signal_energy(signal: NDArray[np.complex64]) -> NDArray[np.float32]:
    """Return the energy over RX and blocks of signals [position, rx, block]."""
    parts = np.ascontiguousarray(signal).view(np.float32)
    return np.einsum("prn,prn->p", parts, parts)


class FirstLook(NamedTuple):
    """`peaks` [2, position]: frequency of the direct path's peak, and of a second candidate; `median` [position]: upper
    median of the spectrum's magnitude; `frequency` [position] and `estimate` [position, 3] from `NumpyLoops.refine`.
    """

    peaks: NDArray[np.float64]
    median: NDArray[np.float64]
    frequency: NDArray[np.float64]
    estimate: NDArray[np.complex128]


class Removed(NamedTuple):
    """`frequency` [position], `estimate` [position, 2] and last `step` [position] from `NumpyLoops.refine`; `samples`
    [rx, position, block] and `half_difference` [position] from `NumpyLoops.turn`.
    """

    frequency: NDArray[np.float64]
    estimate: NDArray[np.complex128]
    step: NDArray[np.float64]
    samples: NDArray[np.complex64]
    half_difference: NDArray[np.float32]


class NumpyLoops:
    """Loops over positions that find and remove the direct path; :class:`Library` has `find` and `remove`, too.

    Halves are complex64 [position, 2, rx, block] from burst alignment (`offsets.AlignedRow`): what the good chirps at
    even and at odd places add to the burst's average, which is their sum. Frequencies are in cycles per sample.
    """

    @staticmethod
    def find(
        halves: NDArray[np.complex64],
        weights: NDArray[np.complex64],
        size: int,
        object_bins: tuple[int, int],
        comparable: float,
        steering: NDArray[np.complex64],
        estimator: NDArray[np.complex64],
        steps: int,
    ) -> FirstLook:
        """Call :meth:`search`, then :meth:`refine` from the first peak, with three estimates."""
        bins, median = NumpyLoops.search(halves, weights, size, object_bins, comparable)
        peaks = ((bins + size // 2) % size - size // 2) / size / FOLD
        frequency, estimate, _ = NumpyLoops.refine(halves, steering, estimator, peaks[0], steps)
        return FirstLook(peaks, median, frequency, estimate)

    @staticmethod
    def remove(
        halves: NDArray[np.complex64],
        steering: NDArray[np.complex64],
        estimator: NDArray[np.complex64],
        frequency: NDArray[np.float64],
        steps: int,
        scale: NDArray[np.float32],
    ) -> Removed:
        """Call :meth:`refine` with two estimates, then :meth:`turn` by the frequency and phase found."""
        frequency, estimate, step = NumpyLoops.refine(halves, steering, estimator, frequency, steps)
        samples, half_difference = NumpyLoops.turn(halves, steering, frequency, np.angle(estimate[:, 0]), scale)
        return Removed(frequency, estimate, step, samples, half_difference)

    @staticmethod
    def search(
        halves: NDArray[np.complex64],
        weights: NDArray[np.complex64],
        size: int,
        object_bins: tuple[int, int],
        comparable: float,
    ) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """Find the peak of the direct path and a second candidate.

        The object's echo has a higher IF, by a distance known from the geometry. If there is a comparable peak at that
        distance below the strongest one, the strongest is the object.

        Parameters
        ----------
        halves
            Both halves are added.
        weights
            complex64 [rx, block]: beam, steering and window.
        size
            Size of the FFT.
        object_bins
            Smallest and largest distance of the object, in bins.
        comparable
            Smallest amplitude of the lower peak relative to the strongest to be the direct path.

        Returns
        -------
        bins
            int32 [2, position]: direct path, and second candidate.
        median
            float64 [position]: upper median of the spectrum's magnitude.
        """
        beamed = np.einsum("rn,prn->pn", weights, halves[:, 0] + halves[:, 1])
        spectrum = np.abs(np.asarray(scipy.fft.fft(beamed, size, axis=-1)))
        median = np.sort(spectrum, axis=-1)[:, size // 2].astype(np.float64)
        spectrum *= _weigh_bins(size)
        rows = np.arange(len(beamed))
        top = np.argmax(spectrum, axis=-1)
        below = top[:, None] - np.arange(object_bins[0], object_bins[1] + 1)
        values = spectrum[rows[:, None], below % size]
        is_peak = (values >= spectrum[rows[:, None], (below - 1) % size]) & (
            values >= spectrum[rows[:, None], (below + 1) % size]
        )
        values = np.where(is_peak, values, 0)
        best = np.argmax(values, axis=-1)
        lower = np.where(values[rows, best] > 0, below[rows, best] % size, top)
        is_object = values[rows, best] > comparable * spectrum[rows, top]
        return np.where(is_object, [lower, top], [top, lower]).astype(np.int32), median

    @staticmethod
    def refine(
        halves: NDArray[np.complex64],
        steering: NDArray[np.complex64],
        estimator: NDArray[np.complex64],
        frequency: NDArray[np.float64],
        steps: int,
    ) -> tuple[NDArray[np.float64], NDArray[np.complex128], NDArray[np.float64]]:
        """Refine frequencies by Gauss-Newton steps.

        Demodulation is the same for all RX, so the estimator sums over RX first.

        Parameters
        ----------
        halves
            Both halves are added.
        steering
            complex64 [rx, block]: phases after which all RX share the direct path's tone.
        estimator
            complex64 [2 or 3, rx * block]: rows give A, A w and the drift (`offsets.DirectPath`) of a tone A exp(jwt).
        frequency
            [position]: starting values.
        steps
            Number of steps.

        Returns
        -------
        Frequency [position], the estimate [position, 2 or 3] there, and the last step taken [position].
        """
        positions, _, rx, n = halves.shape
        g = np.einsum("prn,krn->pkn", (halves[:, 0] + halves[:, 1]) * steering, estimator.reshape(-1, rx, n))
        zero = step = np.zeros(positions)
        reach = 1 / (n * FOLD)

        def amplitude_estimate(frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
            return np.einsum("pkn,pn->pk", g, phasor(-frequency * FOLD, zero, n, (n - 1) / 2)).astype(complex)

        estimate = amplitude_estimate(frequency)
        for _ in range(steps):
            amplitude = np.where(estimate[:, 0] != 0, estimate[:, 0], np.inf)
            step = np.clip(np.real(estimate[:, 1] / amplitude) / (2 * np.pi), -reach, reach)
            frequency = frequency + step
            estimate = amplitude_estimate(frequency)
        return frequency, estimate, step

    @staticmethod
    def turn(
        halves: NDArray[np.complex64],
        steering: NDArray[np.complex64],
        frequency: NDArray[np.float64],
        phase: NDArray[np.float64],
        scale: NDArray[np.float32],
    ) -> tuple[NDArray[np.complex64], NDArray[np.float32]]:
        """Apply the steering and remove frequency and phase of the direct path from a row.

        Parameters
        ----------
        halves
            Both halves are added.
        steering
            complex64 [rx, block]: as of :meth:`refine`.
        frequency, phase
            [position], cycles per sample; radians at the middle of the linear samples.
        scale
            float32 [position, 2]: factors that make each half an average of its chirps.

        Returns
        -------
        The halves' sums complex64 [rx, position, block], and the energy of the scaled halves' difference [position].
        """
        n = halves.shape[-1]
        turn = phasor(-frequency * FOLD, -phase, n, (n - 1) / 2)
        turned_sum = (halves[:, 0] + halves[:, 1]) * steering * turn[:, None]
        half_difference = complex64(halves[:, 0] * scale[:, 0, None, None] - halves[:, 1] * scale[:, 1, None, None])
        return complex64(turned_sum.swapaxes(0, 1)), signal_energy(half_difference)


class LoadError(Exception):
    """The library is missing, or was compiled from other sources."""


class Library:
    """The compiled loops.

    Parameters
    ----------
    path
        File of the library; None: in the folder of the sources.
    bits
        Width of vectors, 128, 256 or 512; None: the widest of the processor.

    Raises
    ------
    LoadError
        if it cannot be loaded, or was compiled from other sources.
    """

    def __init__(self, path: Path | None = None, bits: int | None = None) -> None:
        from polysight.sync import build  # not at import, so that `python -m polysight.sync.build` is clean

        path = path or build.HERE / build.LIBRARY
        if not path.is_file():
            raise LoadError(f"{path} is missing")
        try:
            if not path.read_bytes().endswith(build.source_digest().encode()):  # loading it could end the program
                raise LoadError(f"{path} was compiled from other sources, or is damaged")
            loaded = ctypes.CDLL(str(path))
        except OSError as e:
            raise LoadError(str(e)) from None
        self.bits = bits or int(loaded.vector_bits())
        self._decimator = decimator()
        self._loaded = loaded

    def align(
        self,
        words: NDArray[np.int16],
        valid: NDArray[np.bool_],
        linear: tuple[int, int],
        equaliser: hpf.Equaliser | None,
        full_scale: int,
        into: Sequence[NDArray[Any]],
    ) -> None:
        """Align positions into the fields of an `offsets.AlignedRow`; parameters as in `offsets.align_in_numpy`."""
        positions, chirps, samples, _, _ = words.shape
        a, b = linear
        # Numbers of the `Equaliser`: sample rate, reach, sign, corners in Hz. Without corners the reach has no effect.
        filters = [1.0, 1 / 8 / FOLD, 0.0]
        if equaliser is not None:
            filters = [equaliser.sample_rate_hz, equaliser.reach, equaliser.signed, *equaliser.model.corners_hz]
        sizes = (positions, chirps, samples, a, b, search_size(b - a), full_scale)
        taps = (np.array(filters), len(filters) - 3, self._decimator.taps, self._decimator.flat)
        self._call("align", (words, valid, *sizes, *taps, *into))

    def find(
        self,
        halves: NDArray[np.complex64],
        weights: NDArray[np.complex64],
        size: int,
        object_bins: tuple[int, int],
        comparable: float,
        steering: NDArray[np.complex64],
        estimator: NDArray[np.complex64],
        steps: int,
    ) -> FirstLook:
        """See `NumpyLoops.find`."""
        positions, _, _, blocks = halves.shape
        out = FirstLook(
            peaks=np.empty((2, positions)),
            median=np.empty(positions),
            frequency=np.empty(positions),
            estimate=np.empty((positions, len(estimator)), complex),
        )
        spectra = _take_apart(weights), _weigh_bins(size), positions, blocks, size, *object_bins, np.array([comparable])
        estimates = _take_apart(steering), _take_apart(estimator, axis=1), steps
        self._call("find", (halves, *spectra, *estimates, *out))
        return out

    def remove(
        self,
        halves: NDArray[np.complex64],
        steering: NDArray[np.complex64],
        estimator: NDArray[np.complex64],
        frequency: NDArray[np.float64],
        steps: int,
        scale: NDArray[np.float32],
    ) -> Removed:
        """See `NumpyLoops.remove`."""
        positions, _, rx, blocks = halves.shape
        out = Removed(
            frequency=frequency.copy(),
            estimate=np.empty((positions, len(estimator)), complex),
            step=np.empty(positions),
            samples=np.empty((rx, positions, blocks), np.complex64),
            half_difference=np.empty(positions, np.float32),
        )
        parts = _take_apart(steering), _take_apart(estimator, axis=1)
        self._call("remove", (halves, *parts, positions, blocks, steps, scale, *out))
        return out

    def _call(self, name: str, arguments: Sequence[NDArray[Any] | float]) -> None:
        """Call a loop with arrays as pointers and numbers as int. Raises MemoryError."""
        arrays = [np.ascontiguousarray(x) if isinstance(x, np.ndarray) else x for x in arguments]
        c_arguments = [_convert_argument(x) for x in arrays]
        if getattr(self._loaded, f"{name}_{self.bits}")(*c_arguments):
            raise MemoryError(f"no memory for {name}")


def _take_apart(values: NDArray[np.complex64], axis: int = 0) -> NDArray[np.float32]:
    """Return real and imaginary parts along a new axis, [2, ...]."""
    return np.stack([values.real, values.imag], axis=axis)


def _convert_argument(value: NDArray[Any] | float) -> Any:
    """Return a contiguous array as a pointer, a number as int."""
    if not isinstance(value, np.ndarray):
        return ctypes.c_int(int(value))
    if value.flags.writeable:
        return _ANY_ARRAY.from_buffer(value.data)
    return ctypes.c_void_p(value.ctypes.data)


def load_library() -> Library | None:
    """Return the compiled loops; None, and one warning, if they cannot be used."""
    with _lock:
        return _load()


@lru_cache(maxsize=1)
def _load() -> Library | None:
    try:
        return Library()
    except LoadError as e:
        _log.warning(
            "synchronisation runs in NumPy, ten times slower than compiled: %s; to compile it, install a C compiler"
            " (apt install gcc, or pip install ziglang) and run: python -m polysight.sync.build",
            e,
        )
        return None
