"""The published method (POLySIGHT paper), with which benchmarks compare this project, synchronises and makes images.

Its results are compared with a direct sum of the undisturbed scene, so that the comparison of times is a fair one.
"""

import numpy as np
import pytest
from benchmarks.data import RIG
from benchmarks.published import SETTINGS, SYNC_RX, Synchroniser, form_image
from numpy.typing import NDArray

from polysight.imaging import backproject, image_grid
from polysight.imaging.geometry import Antennas
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.raster import mean_burst_travel_mm, plan_raster
from polysight_simulators.scene import Scene, SimulatedRig, apply_scene, decode_scene, reference_cube, row_offsets_mm

STEP_MM = 5.0
# A small scan of three points, with two chirps at each position.
SCENE = {
    "name": "three points",
    "grid": {"columns": 45, "rows": 37, "step_x_mm": STEP_MM, "step_y_mm": STEP_MM},
    "burst": {"pulses": 2},
    "image": {"columns": 24, "rows": 24, "pixel_mm": STEP_MM},
    "points": [
        {"position_mm": [0.0, 0.0], "amplitude": [0.6, 0.0]},
        {"position_mm": [40.0, 10.0], "amplitude": [0.4, 0.0]},
        {"position_mm": [-30.0, 35.0], "amplitude": [0.0, 0.4]},
    ],
}


@pytest.fixture(scope="module")
def world() -> tuple[Instrument, Scene]:
    scene = decode_scene(SCENE, "test")
    return apply_scene(load_instrument(RIG), scene), scene


@pytest.fixture(scope="module")
def cube(world: tuple[Instrument, Scene]) -> NDArray[np.complex64]:
    """Echoes of the three points without direct path and noise, perfectly synchronised: [rx, row, column, sample]."""
    return reference_cube(*world)["RH"]


@pytest.fixture(scope="module")
def truth(world: tuple[Instrument, Scene], cube: NDArray[np.complex64]) -> NDArray[np.complex128]:
    """Image of the three points by a matched filter in double precision (a direct sum), complex [y, x].

    The antennas are where they were on average during each burst. The sum uses every twelfth sample of a chirp: ranges
    then alias only far beyond the three points.
    """
    rig, _ = world
    antennas = Antennas.from_rig(rig, rig.by_name("RH"))
    grid = image_grid(rig)
    chirp = rig.chirp
    first_sample, end_sample = chirp.linear_samples
    used_samples = np.arange(first_sample, end_sample, 12)
    frequencies_hz = chirp.first_sample_hz + chirp.hz_per_sample * used_samples
    # A burst begins at its position, and the stage moves on while it lasts: to the right in one row, to the left in the
    # next one.
    mean_travel_mm = mean_burst_travel_mm(rig.burst, rig.stage)
    antenna_count, _, column_count, _ = cube.shape
    middle_column = (column_count - 1) / 2
    shifts_mm = []
    for row in plan_raster(rig.grid):
        for column in range(column_count):
            x_mm = (column - middle_column) * STEP_MM + row.direction * mean_travel_mm
            shifts_mm.append((x_mm, row.y_mm, 0.0))
    shifts_m = np.array(shifts_mm) / 1e3
    position_count = len(shifts_m)
    image = np.zeros(len(grid.voxels_m), np.complex128)
    for rx in range(antenna_count):
        samples = cube[rx].reshape(position_count, -1)
        image += backproject(
            samples[:, used_samples],
            frequencies_hz,
            antennas.tx_m + shifts_m,
            antennas.rx_m[rx] + shifts_m,
            grid.voxels_m,
            np.full(position_count, antennas.direct_m[rx]),
        )
    return image.reshape(grid.shape)


def correlate(a: NDArray[np.complexfloating], b: NDArray[np.complexfloating]) -> float:
    """Magnitude of the correlation of two images: 1 if they differ by a complex factor only."""
    return float(abs(np.vdot(a, b)) / np.linalg.norm(a) / np.linalg.norm(b))


def test_the_published_imager_makes_the_image_of_the_direct_sum(
    world: tuple[Instrument, Scene], cube: NDArray[np.complex64], truth: NDArray[np.complex128]
) -> None:
    rig, _ = world
    grid = image_grid(rig)
    board = rig.by_name("RH")
    correlations = [correlate(form_image(cube, rig, board, grid, fft_points), truth) for fft_points in SETTINGS]
    # The imager takes the nearest range bin; with the coarsest bins this leaves a correlation of 0.993 (measured).
    assert correlations[0] > 0.98
    assert correlations == sorted(correlations), "finer range bins must not make the image worse"


def test_the_published_synchroniser_uses_a_single_antenna_in_single_precision(world: tuple[Instrument, Scene]) -> None:
    """As the authors' code does. Double precision and four receive antennas would make it 2.4 times as slow."""
    rig, scene = world
    radar = SimulatedRig(rig, scene)
    method = Synchroniser(rig, rig.by_name("RH"))
    first_row = next(iter(plan_raster(rig.grid)))
    x_mm, y_mm = row_offsets_mm(radar, first_row)
    chirps_of_row = radar.chirps("RH", x_mm, y_mm, 0)
    payload = chirps_of_row[: rig.burst.pulses].view(np.uint8).ravel()
    burst = method.decode(payload, rig.burst.pulses)
    burst_of_one_antenna = np.zeros_like(burst)
    burst_of_one_antenna[SYNC_RX] = burst[SYNC_RX]
    np.testing.assert_array_equal(method.offsets(burst_of_one_antenna), method.offsets(burst))
    aligned = method.align(burst)
    # Samples from which the frequency and the phase of the direct path were removed, and that phase.
    referenced, _ = method.reference(aligned)
    for samples in (burst, aligned, referenced):
        assert samples.dtype == np.complex64


def test_the_published_imager_works_in_single_precision(
    world: tuple[Instrument, Scene], cube: NDArray[np.complex64]
) -> None:
    rig, _ = world
    assert form_image(cube, rig, rig.by_name("RH"), image_grid(rig)).dtype == np.complex64


def test_the_published_method_makes_the_undisturbed_image_from_a_disturbed_scan(
    world: tuple[Instrument, Scene], truth: NDArray[np.complex128]
) -> None:
    """The two chirps of each position, with all disturbances, are aligned and averaged, and then imaged."""
    rig, scene = world
    board = rig.by_name("RH")
    radar = SimulatedRig(rig, scene)
    method = Synchroniser(rig, board)
    plan = plan_raster(rig.grid)
    synced = np.empty((4, plan.rows, plan.columns, rig.chirp.samples), np.complex64)
    for row in plan:
        x_mm, y_mm = row_offsets_mm(radar, row)
        first_chirp = row.index * len(x_mm)
        payload = radar.chirps("RH", x_mm, y_mm, first_chirp).view(np.uint8).ravel()
        # In every second row the stage moves to the left, from the last column to the first.
        columns = [row.column(point) for point in range(row.points)]
        synced[:, row.index, columns] = method.row(payload, row.points)
    # 0.993 (measured), as without disturbances: the range bins limit it.
    assert correlate(form_image(synced, rig, board, image_grid(rig)), truth) > 0.9
