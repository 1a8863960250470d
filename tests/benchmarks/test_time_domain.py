"""The time-domain sum, whose speed a benchmark compares with the imager's, makes the image of the direct sum."""

import numpy as np
import pytest
from benchmarks.data import published_scene
from numpy.typing import NDArray

from polysight.imaging import backproject, image_grid
from polysight.imaging.geometry import Antennas, Aperture

ROWS = 6
COLUMNS = 7
FREQUENCIES = 14
# The sum over all positions takes long: the benchmark takes every so many-th row, and scales the time.
EVERY_NTH_ROW = 2


@pytest.fixture(scope="module")
def aperture() -> Aperture:
    rig, _ = published_scene(quick=True)
    rng = np.random.default_rng(1)
    # Random positions of the antennas in x and y.
    offsets_m = np.zeros((ROWS, COLUMNS, 3))
    offsets_m[..., :2] = rng.uniform(-0.2, 0.2, (ROWS, COLUMNS, 2))
    frequencies_hz = np.linspace(76.3e9, 79.7e9, FREQUENCIES)
    return Aperture(Antennas.from_rig(rig, rig.receivers[1]), offsets_m, frequencies_hz, image_grid(rig))


@pytest.fixture(scope="module")
def samples(aperture: Aperture) -> NDArray[np.complex64]:
    rng = np.random.default_rng(2)
    real = rng.normal(size=aperture.shape)
    imaginary = rng.normal(size=aperture.shape)
    return (real + 1j * imaginary).astype(np.complex64)


def test_the_image_is_that_of_the_direct_sum(aperture: Aperture, samples: NDArray[np.complex64]) -> None:
    pytest.importorskip("numba", reason="numba is not here; `pip install --group bench` adds it")
    from benchmarks import time_domain

    image, seconds = time_domain.timed_image(aperture, samples, EVERY_NTH_ROW)
    shifts_m = aperture.offsets_m[::EVERY_NTH_ROW].reshape(-1, 3)
    position_count = len(shifts_m)
    antennas = aperture.antennas
    true = np.zeros(image.size, np.complex128)
    for rx, rx_m in enumerate(antennas.rx_m):
        samples_of_rows = samples[rx, :, ::EVERY_NTH_ROW]
        true += backproject(
            samples_of_rows.reshape(FREQUENCIES, position_count).T,
            aperture.frequencies_hz,
            antennas.tx_m + shifts_m,
            rx_m + shifts_m,
            aperture.grid.voxels_m,
            np.full(position_count, antennas.direct_m[rx]),
        )
    assert np.linalg.norm(image.ravel() - true) < 1e-3 * np.linalg.norm(true)
    assert seconds > 0
