"""Residual frequency, phase and amplitude errors after each stage of synchronisation (paper, Fig. 15).

They are measured on the scan itself, for any scene: an error is half the difference between two measurements with
independent noise. For a chirp and for the direct path these are two halves of the RX, for the object two averages of
every other chirp.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polysight.sync.align import AlignedRow
from polysight.sync.direct_path import DirectPath, Referenced
from polysight.sync.numpy_passes import FOLD
from polysight.sync.tone import Complex, Real, block_edges, block_times, cis, phasor, refine

STAGES = {
    "received": "one chirp as received",
    "aligned": "one chirp after burst alignment",
    "averaged": "the direct path in a position's average",
    "referenced": "the object beside the direct path in a position's average",
}

EXAMINED = 32
"""Positions per row used for residuals: standard deviations within 13 % for a row, 1 % for 150 rows."""

Errors = dict[str, NDArray[np.float64]]


def errors(
    aligned: AlignedRow, done: Referenced, path: DirectPath, sample_rate_hz: float, most: int = EXAMINED
) -> Errors:
    """Return the errors after each stage, float64 [3, n]: Hz, rad, and amplitude relative to its mean.

    At most `most` valid positions are used, evenly spaced. Empty if no position is valid. `referenced` contains only
    positions with an echo.
    """
    if not done.found.any():
        return {}
    valid = np.flatnonzero(done.found)
    found = np.zeros_like(done.found)
    found[valid[np.linspace(0, valid.size - 1, min(most, valid.size)).astype(int)]] = True
    good = aligned.good[found]
    received = np.stack(
        [
            done.frequency[found, None] + aligned.frequency[found],
            np.angle(done.amplitude)[found, None] + aligned.phase[found],
            np.abs(done.amplitude)[found, None] * aligned.amplitude[found] / aligned.gain[found],
        ]
    )[:, good]
    turns = cis(received[1])
    received[0] -= received[0].mean()
    received[1] = np.angle(turns * np.conj(turns.mean()))
    received[2] = received[2] / received[2].mean() - 1

    own = (aligned.amplitude[found] * good).sum(axis=1) / good.sum(axis=1)
    one = np.stack([*aligned.error[found].swapaxes(0, 1), aligned.amplitude[found] / own[:, None] - 1])[:, good]

    two = found & (aligned.good.sum(axis=1) > 1)
    n = aligned.good[two].sum(axis=1)
    whole = (n[:, None] / np.stack([(n + 1) // 2, n // 2], axis=1)).astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):  # dead RX have no direct path: their figures are not finite
        out = {
            "received": received,
            "aligned": one,
            "averaged": _direct_path(done.halves[found].sum(axis=1), path),
            "referenced": _object(done.halves[two] * whole[..., None, None], path) if two.any() else np.zeros((3, 0)),
        }
    for values in out.values():
        values[0] *= sample_rate_hz
    return out


def noise_power(aligned: AlignedRow) -> NDArray[np.float64]:
    """Return the noise power of a sample of one channel of one chirp, [position], NaN with fewer than two chirps."""
    n = aligned.good.sum(axis=1)
    parts = np.stack([(n + 1) // 2, n // 2], axis=1)
    whole = (n[:, None] / np.maximum(parts, 1)).astype(np.float32)[..., None, None]
    apart = aligned.halves[:, 0] * whole[:, 0] - aligned.halves[:, 1] * whole[:, 1]
    power = _energy(apart) / (apart.shape[1] * apart.shape[2])
    return np.where(n > 1, power * FOLD / (1 / np.maximum(parts, 1)).sum(axis=1), np.nan)


def _energy(signal: NDArray[np.complex64]) -> NDArray[np.float32]:
    """Return the energy over RX and blocks of signals [position, rx, block]."""
    parts = np.ascontiguousarray(signal).view(np.float32)
    return np.einsum("prn,prn->p", parts, parts)


def _direct_path(mean: NDArray[np.complex64], path: DirectPath) -> NDArray[np.float64]:
    """Return the errors of the direct path [3, n] in averages [position, rx, block], from two halves of the RX."""
    frequency, phase, size = [], [], []
    for h in (0, 1):
        amplitude, w = _estimate(mean[:, h::2], path.half_estimators[h])
        frequency.append(w / (2 * np.pi))
        phase.append(np.angle(amplitude * np.conj(amplitude.mean())))  # without the constant difference of the RX
        size.append(np.abs(amplitude) / np.abs(amplitude).mean())
    return np.stack([x[0] - x[1] for x in (frequency, phase, size)]) / 2


def _estimate(signal: NDArray[np.complex64], estimator: NDArray[np.complex128]) -> tuple[Complex, Real]:
    """Return amplitude and frequency (radians per sample) [...] of the direct path in signals [..., rx, block]."""
    estimate = signal.reshape(*signal.shape[:-2], -1) @ estimator.T.astype(np.complex64)
    return estimate[..., 0].astype(complex), np.real(estimate[..., 1] / estimate[..., 0])


def _object(halves: NDArray[np.complex64], path: DirectPath) -> NDArray[np.float64]:
    """Return the errors of the object [3, n] from two averages [position, 2, rx, block], for positions with an echo."""
    rx, n = halves.shape[2:]
    # Reference each half to its own direct path and subtract it; the object remains.
    amplitude, w = _estimate(halves, path.estimator)
    back = phasor(-w * FOLD / (2 * np.pi), -np.angle(amplitude), n, (n - 1) / 2)
    echo = halves * back[:, :, None]
    echo -= np.abs(amplitude).astype(np.float32)[..., None, None]
    product = (echo[:, 0] * echo[:, 1].conj()).sum(axis=1)
    edges = block_edges(n)
    tone = refine(np.add.reduceat(product, edges[:-1], axis=-1).astype(complex), block_times(edges) * FOLD, steps=2)
    # Amplitudes relative to the mean of both halves.
    energy, common = np.stack([_energy(echo[:, h]) for h in (0, 1)], axis=1), product.sum(axis=1)
    size = np.abs(energy + np.stack([common, common.conj()], axis=1))
    contrast = (size[:, 0] - size[:, 1]) / np.maximum(size.sum(axis=1), 1e-30)
    # Keep positions whose halves are more coherent than noise would be by chance.
    echoing = np.abs(tone.amplitude) > 4 / np.sqrt(rx * n) * np.sqrt(energy.prod(axis=1))
    return np.stack([tone.frequency / 2, np.angle(tone.amplitude) / 2, contrast])[:, echoing]


def spread(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the RMS of errors [3, n]."""
    f, p, a = np.sqrt((values**2).mean(axis=1))
    return float(f), float(p), float(a)
