"""Reconstruct the missing positions of sparse scans, iteratively with an imager and its adjoint.

The matched filter of a scan with few positions contains aliases. In mostly empty scenes they can be removed: FISTA
(Beck and Teboulle, SIAM J. Imaging Sci. 2, 2009) finds the image x that minimises

    1/2 |W (G A x - y)|^2 + threshold |x|_1

with the samples y, the imager's forward model A, the effect G of the range gate on an echo, and the weights W of the
positions. `fill_missing` predicts the samples of the missing positions from x. Recorded samples are not changed: a scan
without missing positions remains as it is. To estimate the error, a first fit leaves out some recorded positions, whose
prediction is compared with their samples.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight.imaging.images import ImageBuilder, Mask, SubBandImages
from polysight.imaging.resolution import compute_field_limits
from polysight.imaging.samples import BoardSamples, choose_imager
from polysight.results import ReconstructedPositions
from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError

STRENGTH = 0.002
"""Threshold relative to the strongest pixel, found with simulated plates (docs/decisions/0002-imaging.md): a larger
value removes plates with a weak V reflection, a smaller one leaves more aliases.
"""
ITERATIONS = 40
"""Steps of the first fit of missing positions; the second fit starts from its image and takes half as many; chosen."""
LARGEST_DIVISOR = 4
"""Largest number of parts into which a step between positions is divided; chosen."""
TEST_ONE_IN = 10
"""One in this number of recorded rows, columns or positions is left out of the first fit, to test the prediction;
chosen."""
# The power iteration approaches the eigenvalue from below: after 12 rounds 5 % are added, so that the estimate is not
# too small; both chosen.
_POWER_ROUNDS = 12
_EIGENVALUE_MARGIN = 1.05


@dataclass(frozen=True)
class Reconstruction:
    """A reconstructed image.

    Attributes
    ----------
    image
        complex64 [ny, nx]: reflectivity of each pixel, which counts as a point scatterer of this amplitude. Its phase
        is that of the samples, so that it is the complex conjugate of a reflectivity in `Images.h` or `Images.v`.
    residual
        float64 [iteration]: `|W (G A x - y)| / |W y|`, the unexplained share at the point that the step starts from.
    """

    image: NDArray[np.complex64]
    residual: NDArray[np.float64]


class _Model:
    """Forward model of one board and its adjoint, `G A` and `A^H G^H` of the module, without the weights W."""

    def __init__(self, board: BoardSamples) -> None:
        self.imager, _ = choose_imager(board.aperture)
        # The range gate's effect G on an echo, [frequency, frequency].
        self._gate = board.model.astype(np.complex64)

    def samples(self, image: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """Return the samples that an image predicts, [rx, frequency, row, column].

        They compare with those of `BoardSamples.calibrate_samples`.
        """
        echoes = self.imager.samples(image)
        return (self._gate @ echoes.reshape(*echoes.shape[:2], -1)).reshape(echoes.shape)

    def adjoint(self, samples: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
        """Return the adjoint of :meth:`samples`, complex64 [ny, nx]."""
        gated = self._gate.conj().T @ samples.reshape(*samples.shape[:2], -1)
        return self.imager.image(gated.reshape(samples.shape))


def reconstruct(
    board: BoardSamples,
    iterations: int = 60,
    strength: float = STRENGTH,
    selected: Mask | None = None,
    start: NDArray[np.complex64] | None = None,
) -> Reconstruction:
    """Reconstruct the image of a board from its valid positions.

    Parameters
    ----------
    board
        Samples of one board; omitted positions are not valid.
    iterations
        Number of steps, each one forward and one adjoint imaging; the default is chosen.
    strength
        Threshold relative to the strongest pixel of the matched filter: amplitudes are reduced by about this much, and
        pixels below it become 0. For a few points with many random omissions 0.01 converges faster.
    selected
        bool [row, column]: positions to use; None: all that are valid.
    start
        complex64 [ny, nx]: image to start from; None: empty.
    """
    model = _Model(board)
    # [rx, 1, row, column]; the weight of an RX that is not used is 0.
    weights = board.weights * board.used_rx[:, None, None, None]
    if selected is not None:
        weights = weights * selected
    # The misfit |W (G A x - y)|^2 weights squared samples by W^2, which are the weights so far: W is their root.
    weights = np.sqrt(weights)
    data = board.calibrate_samples() * weights

    def forward(x: NDArray[np.complex64]) -> NDArray[np.complex64]:
        return model.samples(x) * weights

    def adjoint(y: NDArray[np.complex64]) -> NDArray[np.complex64]:
        return model.adjoint(y * weights)

    matched = adjoint(data)
    # A gradient step of the length 1 / lipschitz cannot overshoot. After each step, amplitudes shrink by the threshold
    # of the module's formula times this length.
    lipschitz = _estimate_largest_eigenvalue(lambda x: adjoint(forward(x)), matched)
    shrinkage = strength * float(np.abs(matched).max()) / lipschitz
    norm = float(np.linalg.norm(data)) or 1.0
    x = np.zeros_like(matched) if start is None else start

    # FISTA (equations 4.1 to 4.3): each step starts from the last image, extrapolated in the direction of its last
    # change.
    extrapolated = x
    momentum = 1.0
    residuals = []
    for _ in range(iterations):
        misfit = forward(extrapolated) - data
        residuals.append(float(np.linalg.norm(misfit)) / norm)
        new = _shrink_amplitudes(extrapolated - adjoint(misfit) / np.float32(lipschitz), shrinkage)
        next_momentum = (1 + np.sqrt(1 + 4 * momentum * momentum)) / 2
        extrapolated = (new + (momentum - 1) / next_momentum * (new - x)).astype(np.complex64)
        x = new
        momentum = next_momentum
    return Reconstruction(x, np.array(residuals))


def _shrink_amplitudes(x: NDArray[np.complexfloating], threshold: float) -> NDArray[np.complex64]:
    """Reduce amplitudes [ny, nx] by a threshold and keep phases: the proximal operator of the 1-norm."""
    size = np.abs(x)
    return (x * (np.maximum(size - threshold, 0) / np.maximum(size, 1e-30))).astype(np.complex64)


def _estimate_largest_eigenvalue(
    operator: Callable[[NDArray[np.complex64]], NDArray[np.complex64]], start: NDArray[np.complex64]
) -> float:
    """Return the largest eigenvalue of a positive operator by power iteration, with a margin."""
    x = start
    value = 1.0
    for _ in range(_POWER_ROUNDS):
        norm = float(np.linalg.norm(x))
        if norm == 0:
            return 1.0
        x = operator((x / norm).astype(np.complex64))
        value = float(np.linalg.norm(x))
    return _EIGENVALUE_MARGIN * value


def find_step_divisors(rig: Instrument) -> tuple[int, int]:
    """Return into how many parts to divide the steps between rows and between columns, at most `LARGEST_DIVISOR`.

    The image is free of ghosts with steps so short that the ghosts of an object inside the image lie outside of it.
    """
    free_mm = compute_field_limits(rig).alias_free_mm
    size_mm = (rig.image.columns * rig.image.pixel_mm, rig.image.rows * rig.image.pixel_mm)
    parts_x, parts_y = (int(np.ceil(size / limit_mm)) for size, limit_mm in zip(size_mm, free_mm, strict=True))
    row_divisor = min(LARGEST_DIVISOR, max(1, parts_y))
    column_divisor = min(LARGEST_DIVISOR, max(1, parts_x))
    return row_divisor, column_divisor


def fill_missing(
    builder: ImageBuilder, iterations: int = ITERATIONS
) -> tuple[ImageBuilder, dict[str, ReconstructedPositions]]:
    """Reconstruct the positions that were masked, not recorded, or not planned although the image needs them.

    Returns
    -------
    filled
        A builder with samples at all positions of a grid without ghosts; recorded samples are unchanged.
    errors
        Board name to the errors of its reconstructed positions; boards without a missing or without a recorded position
        are left out.

    Raises
    ------
    ConfigError
        if positions are missing and the aperture needs the direct sum: about a hundred images would take hours.
    """
    divisors = find_step_divisors(builder.rig)
    filled = ImageBuilder(_divide_steps(builder.rig, divisors), builder.taper, gate_m=builder.gate_m)
    errors = {}
    for name, board in filled.boards.items():
        board.copy_samples(builder.boards[name], divisors)
        if board.valid.any() and not board.valid.all():
            _, direct_sum_notice = choose_imager(board.aperture)
            if direct_sum_notice is not None:
                raise ConfigError(
                    "missing positions cannot be reconstructed on this grid of pixels",
                    direct_sum_notice,
                    "leave --sparse out, or choose pixels that divide the distance of rows evenly (--grid, [image])",
                )
            errors[name] = _fill(board, iterations)
    return filled, errors


def fill_sub_bands(sub_bands: SubBandImages) -> SubBandImages:
    """Return the images of every sub-band with missing positions reconstructed, see :func:`fill_missing`."""
    filled = copy(sub_bands)
    filled.builders = tuple(fill_missing(builder)[0] for builder in sub_bands.builders)
    return filled


def _divide_steps(rig: Instrument, divisors: tuple[int, int]) -> Instrument:
    """Return the rig with the steps between rows and between columns divided into that many parts."""
    row_divisor, column_divisor = divisors
    grid = msgspec.structs.replace(
        rig.grid,
        rows=(rig.grid.rows - 1) * row_divisor + 1,
        columns=(rig.grid.columns - 1) * column_divisor + 1,
        step_y_mm=rig.grid.step_y_mm / row_divisor,
        step_x_mm=rig.grid.step_x_mm / column_divisor,
    )
    return msgspec.structs.replace(rig, grid=grid)


def _fill(board: BoardSamples, iterations: int) -> ReconstructedPositions:
    """Predict the samples of a board's missing positions and put them in their place; return their errors."""
    model = _Model(board)
    recorded = board.valid.copy()
    samples = board.calibrate_samples()
    tested = _choose_test_positions(recorded)
    first = reconstruct(board, iterations, selected=~tested)
    error = None
    if tested.any():
        misfit = model.samples(first.image) - samples
        weights = board.taper * tested * board.used_rx[:, None, None, None]
        error = _measure_image(model, misfit, weights) / _measure_image(model, samples, weights)
    last = reconstruct(board, max(1, iterations // 2), start=first.image)
    board.fill(model.samples(last.image))
    samples = board.calibrate_samples()
    # Only the part of the image that comes from reconstructed positions has their error.
    norm_of_reconstructed_part = _measure_image(model, samples, board.taper * ~recorded)
    share = norm_of_reconstructed_part / _measure_image(model, samples, board.taper)
    return ReconstructedPositions(
        missing_share=float(1 - recorded.mean()),
        residual=float(last.residual[-1]),
        prediction_error=error,
        image_error=None if error is None else error * share,
    )


def _choose_test_positions(recorded: Mask) -> Mask:
    """Return recorded positions to leave out of a fit: whole rows or columns if such are missing, else random ones."""
    rows = np.flatnonzero(recorded.any(axis=1))
    columns = np.flatnonzero(recorded.any(axis=0))
    tested = np.zeros_like(recorded)
    if rows.size < recorded.shape[0]:
        tested[rows[TEST_ONE_IN // 2 :: TEST_ONE_IN]] = True
    elif columns.size < recorded.shape[1]:
        tested[:, columns[TEST_ONE_IN // 2 :: TEST_ONE_IN]] = True
    else:
        tested = np.random.default_rng(0).uniform(size=recorded.shape) < 1 / TEST_ONE_IN
    return tested & recorded


def _measure_image(model: _Model, samples: NDArray[np.complexfloating], weights: NDArray[Any]) -> float:
    """Return the norm of the image of samples [rx, frequency, row, column] under weights [..., row, column]; not 0."""
    image = model.imager.image((samples * weights).astype(np.complex64))
    return float(np.linalg.norm(image)) or 1e-30
