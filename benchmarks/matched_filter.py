"""The instrument's image against a matched filter over all samples in double precision. Simulated points."""

from __future__ import annotations

import numpy as np
import scipy.signal
from numpy.typing import NDArray

from benchmarks.data import as_synced, point_row
from polysight.imaging import ImageBuilder, backproject
from polysight.imaging.geometry import Antennas, row_offsets_m
from polysight.imaging.reduce import reduction, scene_gate_m
from polysight_shared.config import Board, Instrument
from polysight_shared.raster import plan_raster

SEED = 7
POINTS, POSITIONS, PIXELS = 9, 2000, 60


def image_error(rig: Instrument, board: Board) -> float:
    """Largest difference at some pixels, of the image's peak.

    Points lie anywhere in the image, positions anywhere in the grid (2000 of them, the others masked), and each holds
    its direct path. The matched filter takes all linear samples with the imager's window, after the
    direct path is taken out of every position as the range gate does (`Reduction.direct`).
    """
    rng = np.random.default_rng(SEED)
    builder = ImageBuilder(rig)
    grid, plan, chirp = builder.grid, plan_raster(rig.grid), rig.chirp
    antennas = Antennas.of(rig, board)
    margin = 0.02
    points = np.column_stack(
        [rng.uniform(a[0] + margin, a[-1] - margin, POINTS) for a in (grid.x_m, grid.y_m)]
        + [np.full(POINTS, float(np.mean(grid.z_m)))]
    )
    sweep = chirp.first_sample_hz + chirp.hz_per_sample * np.arange(chirp.samples, dtype=float)
    used = rng.random((plan.rows, plan.columns)) < POSITIONS / plan.positions
    samples, shifts = [], []
    for row in plan:
        valid = used[row.index]
        received = np.zeros((len(antennas.rx_m), plan.columns, chirp.samples), np.complex64)
        if valid.any():
            echoes = point_row(rig, antennas, row, points, sweep, valid)
            received[:, valid] = echoes + 1 / antennas.direct_m[:, None, None]
        builder.add_row(board.name, row.index, as_synced(received, valid))
        samples.append(received[:, valid])
        shifts.append(np.pad(row_offsets_m(rig, row)[valid], ((0, 0), (0, 1))))
    image, _, _ = builder.boards[board.name].image()
    chosen = rng.choice(image.size, PIXELS, replace=False)
    chosen[0] = np.abs(image).argmax()
    weights = builder.boards[board.name].weights
    taper = np.concatenate([weights[r.index, :: r.direction][used[r.index]] for r in plan])
    true = _matched(
        rig,
        board,
        np.concatenate(samples, axis=1).astype(complex) / builder.rx_calibration(board.name)[:, None, None],
        np.concatenate(shifts),
        taper.astype(float),
        grid.voxels_m[chosen],
        builder,
    )
    return float(np.abs(image.ravel()[chosen] - true).max() / np.abs(image).max())


def _matched(
    rig: Instrument,
    board: Board,
    samples: NDArray[np.complex128],
    shifts_m: NDArray[np.float64],
    taper: NDArray[np.float64],
    voxels_m: NDArray[np.float64],
    builder: ImageBuilder,
) -> NDArray[np.complex128]:
    """Sum over RX, positions and all linear samples, normalised as the imager does, complex128 [voxel]."""
    chirp, (a, b) = rig.chirp, rig.chirp.linear_samples
    all_antennas = tuple(Antennas.of(rig, receiver) for receiver in rig.receivers)
    gate = reduction(chirp, scene_gate_m(all_antennas, plan_raster(rig.grid), builder.grid))
    antennas = Antennas.of(rig, board)
    window = np.asarray(scipy.signal.get_window("hann", b - a + 2, fftbins=False), float)[1:-1]
    sweep = chirp.first_sample_hz + chirp.hz_per_sample * np.arange(a, b)
    total = np.zeros(len(voxels_m), complex)
    for place, direct, received in zip(antennas.rx_m, antennas.direct_m, samples, strict=True):
        echoes = received[:, a:b] - (received @ gate.direct)[:, None]
        total += backproject(
            echoes * (window / window.sum()) * taper[:, None],
            sweep,
            antennas.tx_m + shifts_m,
            place + shifts_m,
            voxels_m,
            np.full(len(shifts_m), direct),
        )
    return total / (taper.sum() * len(antennas.rx_m))
