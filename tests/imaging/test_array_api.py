"""Imagers run on other array libraries: array-api-strict, and PyTorch or CuPy on a GPU if there is one."""

import importlib

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.imaging import backproject, project
from polysight.imaging.direct import DirectImager
from polysight.imaging.geometry import Antennas, Aperture, image_grid, scan_offsets_m
from polysight.imaging.spectral import IncrementalImager, SpectralImager
from polysight_shared.errors import ErrorCode


def _load_strict():
    return importlib.import_module("array_api_strict"), None


def _load_gpu():
    try:
        torch = importlib.import_module("torch")
    except ImportError:
        torch = None
    if torch is not None and torch.cuda.is_available():
        return importlib.import_module("array_api_compat.torch"), "cuda"
    try:
        cupy = importlib.import_module("cupy")
        cupy.zeros(1)
    except Exception:  # noqa: BLE001 - any error of CuPy without a GPU
        pytest.skip("no GPU with PyTorch or CuPy here")
    return importlib.import_module("array_api_compat.cupy"), None


@pytest.fixture(params=[_load_strict, _load_gpu], ids=["array-api-strict", "gpu"])
def library(request):
    return request.param()


@pytest.fixture
def aperture(make_rig):
    rig = make_rig(columns=15, rows=6, step_x=4.0, step_y=4.0, pixels=(12, 10))
    grid = image_grid(rig)
    antennas = Antennas.from_rig(rig, rig.receivers[0])
    # Seven frequencies over the linear part of the rig's sweep
    return Aperture(antennas, scan_offsets_m(rig), frequencies_hz=np.linspace(76.3e9, 79.7e9, 7), grid=grid)


def _copy_to_numpy(array):
    """The array in the memory of the CPU: PyTorch copies with `cpu`, CuPy with `get`."""
    if hasattr(array, "cpu"):
        array = array.cpu()
    if hasattr(array, "get"):
        array = array.get()
    return np.asarray(array)


@pytest.mark.parametrize("make_imager", [SpectralImager, IncrementalImager, DirectImager])
def test_images_and_samples_are_those_of_numpy(aperture, library, make_imager):
    xp, device = library
    rng = np.random.default_rng(0)
    samples = (rng.standard_normal(aperture.shape) + 1j * rng.standard_normal(aperture.shape)).astype(np.complex64)
    pixels = (rng.standard_normal(aperture.grid.shape) + 0j).astype(np.complex64)
    echo = samples[:, :, 0, 0]
    weights = rng.uniform(size=aperture.shape[2:]).astype(np.float32)
    numpy_imager = make_imager(aperture)
    if make_imager is DirectImager:
        # The direct imager computes on the library of its samples.
        imager = make_imager(aperture)
    else:
        imager = make_imager(aperture, xp=xp, device=device)

    def put(array):
        return xp.asarray(array, device=device)

    for result, expected in (
        (imager.image(put(samples)), numpy_imager.image(samples)),
        (imager.image_constant_echo(put(echo), put(weights)), numpy_imager.image_constant_echo(echo, weights)),
        (imager.samples(put(pixels)), numpy_imager.samples(pixels)),
    ):
        assert type(result) is type(put(samples))
        # Single precision: the libraries sum in another order.
        assert np.abs(_copy_to_numpy(result) - expected).max() < 1e-5 * np.abs(expected).max()


def test_backproject_and_project_run_on_the_library_of_their_samples(library):
    """Samples of seven pulses at nine frequencies, and seven voxels, all at random places."""
    xp, device = library
    rng = np.random.default_rng(1)
    frequencies_hz = 76e9 + 1e8 * np.arange(9)
    reference_m = rng.uniform(0, 1, 7)
    tx_m, rx_m, voxels_m = (rng.uniform(-0.5, 0.5, (7, 3)) for _ in range(3))
    geometry = (frequencies_hz, tx_m, rx_m, voxels_m, reference_m)
    samples = rng.standard_normal((7, 9)) + 1j
    pixels = rng.standard_normal(7) + 1j
    for function, array in ((backproject, samples), (project, pixels)):
        result = function(xp.asarray(array, device=device), *geometry)
        np.testing.assert_allclose(_copy_to_numpy(result), function(array, *geometry), rtol=1e-9)


def test_without_array_api_compat_other_libraries_are_refused(monkeypatch, aperture):
    strict = importlib.import_module("array_api_strict")
    # An import of a module that is None in `sys.modules` fails.
    monkeypatch.setitem(importlib.import_module("sys").modules, "array_api_compat", None)
    with expect_refusal(ErrorCode.PACKAGE_MISSING, "array-api-compat"):
        DirectImager(aperture).image(strict.asarray(np.zeros(aperture.shape, np.complex64)))
