"""Synchronised rows of point targets, on a small grid."""

from collections.abc import Iterator

import msgspec
import numpy as np
import pytest

from polysight.imaging.geometry import Antennas, row_offsets_m
from polysight.sync import SyncedRow, sample_frequencies_hz
from polysight_shared.config import Board, Instrument
from polysight_shared.raster import plan_raster
from polysight_shared.units import SPEED_OF_LIGHT_M_S


@pytest.fixture(scope="session")
def make_rig(rig):
    """`make_rig(...)`: the published rig with a small grid and image; steps and pixels in mm."""

    def make(columns=31, rows=31, step_x=4.0, step_y=4.0, pixels=(40, 40), pixel=2.0) -> Instrument:
        grid = msgspec.structs.replace(rig.grid, columns=columns, rows=rows, step_x_mm=step_x, step_y_mm=step_y)
        image = msgspec.structs.replace(rig.image, columns=pixels[0], rows=pixels[1], pixel_mm=pixel)
        return msgspec.structs.replace(rig, grid=grid, image=image)

    return make


@pytest.fixture(scope="session")
def synced_row(rig):
    """`synced_row(samples, valid)`: a synchronised row from samples [rx, position, sample] and a mask [position]."""

    def make(samples, valid=None) -> SyncedRow:
        n = samples.shape[1]
        valid = np.ones(n, bool) if valid is None else valid
        zero = np.zeros(n)
        samples = np.where(valid[:, None], samples, 0).astype(np.complex64)
        return SyncedRow(
            samples=samples,
            sweep_hz=sample_frequencies_hz(rig.chirp),
            valid=valid,
            chirps=np.full(n, 16),
            direct_hz=zero,
            direct_amplitude=zero,
            errors={},
        )

    return make


@pytest.fixture(scope="session")
def points_rows(synced_row):
    """`points_rows(rig, board, points, amplitudes)`: rows of point targets at (x, y, z) m, in the order of the plan.

    The samples contain the direct path from TX to each RX, of amplitude `direct` over its length. `gains` are those of
    the four RX; `noise` is the standard deviation of real and imaginary part. `shifts_m` [row] moves whole rows along
    x, `jitter_m` [row, position, 3] moves single positions.
    """

    def make(
        rig: Instrument,
        board: Board,
        points,
        amplitudes,
        direct: float = 1.0,
        gains=(1, 1, 1, 1),
        noise: float = 0.0,
        shifts_m=None,
        jitter_m=None,
    ) -> Iterator[tuple[int, SyncedRow]]:
        rng = np.random.default_rng(4)
        antennas = Antennas.from_rig(rig, board)
        for row in plan_raster(rig.grid):
            stage_m = np.column_stack([row_offsets_m(rig, row), np.zeros(row.points)])
            if shifts_m is not None:
                stage_m[:, 0] += shifts_m[row.index]
            if jitter_m is not None:
                stage_m += jitter_m[row.index]
            direct_waves = (direct / antennas.direct_m)[:, None, None].astype(complex)
            s = np.tile(direct_waves, (1, row.points, rig.chirp.samples))
            for point, amplitude in zip(points, amplitudes, strict=True):
                from_tx_m = np.linalg.norm(point - stage_m - antennas.tx_m, axis=1)
                to_rx_m = np.linalg.norm(point - stage_m - antennas.rx_m[:, None], axis=2)
                # Synchronised samples have the phase of the path in excess of the direct one.
                excess_m = from_tx_m + to_rx_m - antennas.direct_m[:, None]
                turn_per_hz = 2j * np.pi / SPEED_OF_LIGHT_M_S * excess_m
                # Each sample advances by the same angle: this is faster than as many exponentials.
                waves = np.repeat(np.exp(turn_per_hz * rig.chirp.hz_per_sample)[..., None], rig.chirp.samples, axis=2)
                waves[..., 0] = amplitude * np.exp(turn_per_hz * rig.chirp.first_sample_hz)
                s += np.cumprod(waves, axis=2)
            if noise:
                s += noise * (rng.standard_normal(s.shape) + 1j * rng.standard_normal(s.shape))
            yield row.index, synced_row(s * np.array(gains)[:, None, None])

    return make
