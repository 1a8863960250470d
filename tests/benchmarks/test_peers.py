"""The peers beside our imager make the image that a direct sum makes, so that comparing their time is fair."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks import peers
from benchmarks.data import published
from numpy.typing import NDArray

from polysight.imaging import backproject, image_grid
from polysight.imaging.aperture import Aperture
from polysight.imaging.geometry import Antennas

ROWS, COLUMNS, EVERY = 6, 7, 2


@pytest.fixture(scope="module")
def aperture() -> Aperture:
    rig, _ = published(quick=True)
    rng = np.random.default_rng(1)
    offsets = np.pad(rng.uniform(-0.2, 0.2, (ROWS, COLUMNS, 2)), ((0, 0), (0, 0), (0, 1)))
    return Aperture(Antennas.of(rig, rig.receivers[1]), offsets, np.linspace(76.3e9, 79.7e9, 14), image_grid(rig))


@pytest.fixture(scope="module")
def samples(aperture: Aperture) -> NDArray[np.complex64]:
    rng = np.random.default_rng(2)
    return (rng.normal(size=aperture.shape) + 1j * rng.normal(size=aperture.shape)).astype(np.complex64)


@pytest.mark.parametrize(
    ("package", "form", "error"),
    [("numba", peers.time_domain_image, 1e-3), ("fastsar", peers.fastsar_image, 1e-2)],
)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_image_is_the_direct_sum(
    aperture: Aperture, samples: NDArray[np.complex64], package: str, form: object, error: float
) -> None:
    if not peers.installed(package):
        pytest.skip(f"{package} {peers.MISSING}")
    found = form(aperture, samples, EVERY)  # type: ignore[operator]
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
    assert np.linalg.norm(found.image.ravel() - true) < error * np.linalg.norm(true)
    assert found.seconds > 0
