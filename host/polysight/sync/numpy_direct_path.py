"""Loops over positions that find the direct path, in NumPy: the readable form of `direct_path.c`, with equal results.

Halves are complex64 [position, 2, rx, block] from burst alignment (`align.AlignedRow`); frequencies are in cycles per
sample. The method is described in `direct_path.py`.
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.sync.numpy_passes import FOLD
from polysight.sync.tone import phasor

STEPS = 3
"""Gauss-Newton steps."""

_Real, _Complex = NDArray[np.float64], NDArray[np.complex64]


def search(
    halves: _Complex, weights: _Complex, size: int, object_bins: tuple[int, int], comparable: float
) -> tuple[NDArray[np.int32], _Real]:
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
        float64 [position]: median magnitude of the spectrum.
    """
    beamed = np.einsum("rn,prn->pn", weights, halves[:, 0] + halves[:, 1])
    spectrum = np.abs(np.asarray(scipy.fft.fft(beamed, size, axis=-1)))
    middle = np.sort(spectrum, axis=-1)[:, size // 2 - 1 : size // 2 + 1]  # their mean is the median, ten times as fast
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
    return np.where(is_object, [lower, top], [top, lower]).astype(np.int32), middle.mean(axis=-1).astype(np.float64)


def refine(
    halves: _Complex, steering: _Complex, estimator: _Complex, frequency: _Real
) -> tuple[_Real, NDArray[np.complex128], _Real]:
    """Refine frequencies by Gauss-Newton steps.

    Demodulation is the same for all RX, so the estimator sums over RX first.

    Parameters
    ----------
    halves
        Both halves are added.
    steering
        complex64 [rx, block].
    estimator
        complex64 [2 or 3, rx * block]: see `direct_path.DirectPath`.
    frequency
        [position]: starting values.

    Returns
    -------
    Frequency [position], the estimate [position, 2 or 3] there, and the last step taken [position].
    """
    positions, _, rx, n = halves.shape
    g = np.einsum("prn,krn->pkn", (halves[:, 0] + halves[:, 1]) * steering, estimator.reshape(-1, rx, n))
    zero = step = np.zeros(positions)
    reach = 1 / (n * FOLD)

    def estimate_at(frequency: _Real) -> NDArray[np.complex128]:
        return np.einsum("pkn,pn->pk", g, phasor(-frequency * FOLD, zero, n, (n - 1) / 2)).astype(complex)

    estimate = estimate_at(frequency)
    for _ in range(STEPS):
        amplitude = np.where(estimate[:, 0] != 0, estimate[:, 0], np.inf)
        step = np.clip(np.real(estimate[:, 1] / amplitude) / (2 * np.pi), -reach, reach)
        frequency = frequency + step
        estimate = estimate_at(frequency)
    return frequency, estimate, step


def turn(
    mean: _Complex,
    halves: _Complex,
    steering: _Complex,
    folded_steering: _Complex,
    origin: float,
    frequency: _Real,
    phase: _Real,
    found: NDArray[np.bool_],
) -> tuple[_Complex, _Complex]:
    """Apply the steering and remove frequency and phase of the direct path from a row.

    Parameters
    ----------
    mean
        complex64 [position, rx, sample].
    halves
        One block is the average of `FOLD` samples.
    steering, folded_steering
        complex64 [rx, sample] and [rx, block].
    origin
        Sample at which `phase` is given.
    frequency, phase
        [position], cycles per sample and radians.
    found
        bool [position]: other positions become zero.

    Returns
    -------
    complex64 [rx, position, sample], and the halves.
    """
    n, samples = halves.shape[-1], mean.shape[-1]
    folded = phasor(-frequency * FOLD, -phase, n, (n - 1) / 2)
    whole = phasor(-frequency, -phase, samples, origin) * found[:, None]
    out = np.empty((mean.shape[1], len(mean), samples), np.complex64)
    np.multiply(mean.swapaxes(0, 1), steering[:, None], out=out)
    out *= whole
    return out, (halves * folded_steering * folded[:, None, None]).astype(np.complex64)
