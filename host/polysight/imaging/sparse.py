"""Reconstruct images of scans with omitted positions, iteratively with an imager and its adjoint.

The matched filter of a thinned grid contains aliases. In mostly empty scenes they can be removed: FISTA (Beck and
Teboulle, SIAM J. Imaging Sci. 2, 2009) finds the image x that minimises `1/2 |W (G A x - y)|^2 + threshold |x|_1`, with
the imager's forward model A, the effect G of the range gate on an echo, and the weights W of the positions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polysight.imaging.samples import BoardSamples, choose_imager

STRENGTH = 0.002
"""Found with simulated plates (docs/decisions/0002-imaging.md): a larger value removes plates with a weak V reflection,
a smaller one leaves more aliases.
"""
_POWER_ROUNDS = 12  # steps of the power iteration


@dataclass(frozen=True)
class Reconstruction:
    """A reconstructed image.

    Attributes
    ----------
    image
        complex64 [ny, nx]: reflectivity of each pixel with the phase of the samples, the conjugate of `Images.h`
        and `v`. A point has its own amplitude in one pixel.
    residual
        float64 [iteration]: `|W (G A x - y)| / |W y|`, the unexplained share.
    """

    image: NDArray[np.complex64]
    residual: NDArray[np.float64]


def reconstruct(board: BoardSamples, iterations: int = 60, strength: float = STRENGTH) -> Reconstruction:
    """Reconstruct the image of a board from its valid positions.

    Parameters
    ----------
    board
        Samples of one board; omitted positions are not valid.
    iterations
        Number of steps, each one forward and one adjoint imaging.
    strength
        Weight of sparsity relative to the strongest pixel of the matched filter: pixels below about this level become
        0, and the others weaker by as much. For a few points with many random omissions 0.01 converges faster.
    """
    imager, _ = choose_imager(board.aperture)
    weights, gate = np.sqrt(board.weights), board.model.astype(np.complex64)
    data = board.calibrated() * weights
    shape = data.shape

    def forward(x: NDArray[np.complex64]) -> NDArray[np.complex64]:
        return (gate @ imager.samples(x).reshape(*shape[:2], -1)).reshape(shape) * weights

    def adjoint(y: NDArray[np.complex64]) -> NDArray[np.complex64]:
        return imager.image((gate.conj().T @ (y * weights).reshape(*shape[:2], -1)).reshape(shape))

    matched = adjoint(data)
    lipschitz = _largest_eigenvalue(lambda x: adjoint(forward(x)), matched)
    threshold = strength * float(np.abs(matched).max()) / lipschitz
    norm = float(np.linalg.norm(data)) or 1.0
    x = np.zeros_like(matched)
    ahead, t = x, 1.0
    residuals = []
    for _ in range(iterations):
        misfit = forward(ahead) - data
        residuals.append(float(np.linalg.norm(misfit)) / norm)
        new = _shrunk(ahead - adjoint(misfit) / np.float32(lipschitz), threshold)
        grown = (1 + np.sqrt(1 + 4 * t * t)) / 2
        ahead = (new + (t - 1) / grown * (new - x)).astype(np.complex64)
        x, t = new, grown
    return Reconstruction(x, np.array(residuals))


def _shrunk(x: NDArray[np.complexfloating], threshold: float) -> NDArray[np.complex64]:
    """Reduce amplitudes by a threshold and keep phases: the proximal operator of the 1-norm."""
    size = np.abs(x)
    return (x * (np.maximum(size - threshold, 0) / np.maximum(size, 1e-30))).astype(np.complex64)


def _largest_eigenvalue(
    operator: Callable[[NDArray[np.complex64]], NDArray[np.complex64]], start: NDArray[np.complex64]
) -> float:
    """Return the largest eigenvalue of a positive operator by power iteration, plus 5 %."""
    x, value = start, 1.0
    for _ in range(_POWER_ROUNDS):
        norm = float(np.linalg.norm(x))
        if norm == 0:
            return 1.0
        x = operator((x / norm).astype(np.complex64))
        value = float(np.linalg.norm(x))
    return 1.05 * value
