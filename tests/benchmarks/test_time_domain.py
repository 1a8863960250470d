"""The time-domain sum of the benchmark makes the image of a direct sum, so that the comparison of times is fair."""

import numpy as np
import pytest
from benchmarks.data import published_scene
from numpy.typing import NDArray

from polysight.imaging import backproject, image_grid
from polysight.imaging.geometry import Antennas, Aperture

ROWS = 6
COLUMNS = 7
EVERY = 2


@pytest.fixture(scope="module")
def aperture() -> Aperture:
    rig, _ = published_scene(quick=True)
    rng = np.random.default_rng(1)
    offsets = np.pad(rng.uniform(-0.2, 0.2, (ROWS, COLUMNS, 2)), ((0, 0), (0, 0), (0, 1)))
    return Aperture(Antennas.from_rig(rig, rig.receivers[1]), offsets, np.linspace(76.3e9, 79.7e9, 14), image_grid(rig))


@pytest.fixture(scope="module")
def samples(aperture: Aperture) -> NDArray[np.complex64]:
    rng = np.random.default_rng(2)
    return (rng.normal(size=aperture.shape) + 1j * rng.normal(size=aperture.shape)).astype(np.complex64)


def test_image_is_the_direct_sum(aperture: Aperture, samples: NDArray[np.complex64]) -> None:
    pytest.importorskip("numba", reason="numba is not here; `pip install --group bench` adds it")
    from benchmarks import time_domain

    image, seconds = time_domain.timed_image(aperture, samples, EVERY)
    shift = aperture.offsets_m[::EVERY].reshape(-1, 3)
    antennas = aperture.antennas
    true = sum(
        backproject(
            samples[rx][:, ::EVERY].reshape(14, -1).T,
            aperture.frequencies_hz,
            antennas.tx_m + shift,
            place + shift,
            aperture.grid.voxels_m,
            np.full(len(shift), antennas.direct_m[rx]),
        )
        for rx, place in enumerate(antennas.rx_m)
    )
    assert np.linalg.norm(image.ravel() - true) < 1e-3 * np.linalg.norm(true)
    assert seconds > 0
