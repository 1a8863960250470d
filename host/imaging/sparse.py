"""Images of scans that leave positions out: iterative reconstruction with the imager and its adjoint.

The matched filter of a thinned grid shows aliases of everything. Where the scene is mostly empty they can be told from
it: the image x with the least `1/2 |W (G A x - y)|^2 + threshold |x|_1` is found by FISTA (Beck and Teboulle, SIAM J.
Imaging Sci. 2, 2009): A is the imager's forward model, G what the range gate makes of an echo, W the weights of the
positions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polysight.host.imaging.samples import BoardSamples, choose_imager

STRENGTH = 0.002
"""By measurement on simulated plates (docs/decisions/0002-imaging.md): more takes what hardly reflects in V out of the
image, and with it the plates' names; less leaves more of the aliases in.
"""
_POWER_ROUNDS = 12  # of the power iteration for the largest eigenvalue


@dataclass(frozen=True)
class Reconstruction:
    """A reconstructed image.

    Attributes
    ----------
    image
        complex64 [ny, nx]: reflectivity of each pixel as the samples have it, the conjugate of what `ChannelImages.h`
        and `v` hold; a point's own amplitude, where the matched filter spreads it.
    residual
        float64 [iteration]: `|W (G A x - y)| / |W y|`, what the image does not explain.
    """

    image: NDArray[np.complex64]
    residual: NDArray[np.float64]


def reconstruct(
    board: BoardSamples,
    iterations: int = 60,
    strength: float = STRENGTH,
    progress: Callable[[int, int], None] | None = None,
) -> Reconstruction:
    """Reconstruct one board's image from the positions that are valid.

    Parameters
    ----------
    board
        Samples of one board; what was not scanned is not valid.
    iterations
        Steps, each one forward and one adjoint imaging.
    strength
        Weight of sparsity, of the strongest pixel of the matched filter: pixels below about this level come out 0, and
        the others as much weaker. A few points with much left out at random come sooner with 0.01.
    progress
        Called with steps done and steps in all.
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
    for i in range(iterations):
        misfit = forward(ahead) - data
        residuals.append(float(np.linalg.norm(misfit)) / norm)
        new = _shrunk(ahead - adjoint(misfit) / np.float32(lipschitz), threshold)
        grown = (1 + np.sqrt(1 + 4 * t * t)) / 2
        ahead = (new + (t - 1) / grown * (new - x)).astype(np.complex64)
        x, t = new, grown
        if progress is not None:
            progress(i + 1, iterations)
    return Reconstruction(x, np.array(residuals))


def _shrunk(x: NDArray[np.complexfloating], threshold: float) -> NDArray[np.complex64]:
    """Amplitudes reduced by a threshold, phases kept: the proximal step of the 1-norm."""
    size = np.abs(x)
    return (x * (np.maximum(size - threshold, 0) / np.maximum(size, 1e-30))).astype(np.complex64)


def _largest_eigenvalue(
    operator: Callable[[NDArray[np.complex64]], NDArray[np.complex64]], start: NDArray[np.complex64]
) -> float:
    """Of a positive operator, by power iteration, 5 % on the safe side."""
    x, value = start, 1.0
    for _ in range(_POWER_ROUNDS):
        norm = float(np.linalg.norm(x))
        if norm == 0:
            return 1.0
        x = operator((x / norm).astype(np.complex64))
        value = float(np.linalg.norm(x))
    return 1.05 * value
