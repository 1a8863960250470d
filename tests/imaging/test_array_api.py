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
    rig = make_rig(15, 6, 4.0, 4.0, (12, 10))
    grid = image_grid(rig)
    antennas = Antennas.from_rig(rig, rig.receivers[0])
    return Aperture(antennas, scan_offsets_m(rig), np.linspace(76.3e9, 79.7e9, 7), grid)


def _copy_to_numpy(array):
    array = array.cpu() if hasattr(array, "cpu") else array
    return np.asarray(array.get() if hasattr(array, "get") else array)


@pytest.mark.parametrize("make", [SpectralImager, IncrementalImager, DirectImager])
def test_images_and_samples_are_those_of_numpy(aperture, library, make):
    xp, device = library
    rng = np.random.default_rng(0)
    samples = (rng.standard_normal(aperture.shape) + 1j * rng.standard_normal(aperture.shape)).astype(np.complex64)
    pixels = (rng.standard_normal(aperture.grid.shape) + 0j).astype(np.complex64)
    echo = samples[:, :, 0, 0]
    weights = rng.uniform(size=aperture.shape[2:]).astype(np.float32)
    plain = make(aperture)
    imager = make(aperture) if make is DirectImager else make(aperture, xp=xp, device=device)

    def put(array):
        return xp.asarray(array, device=device)

    for result, want in (
        (imager.image(put(samples)), plain.image(samples)),
        (imager.image_constant_echo(put(echo), put(weights)), plain.image_constant_echo(echo, weights)),
        (imager.samples(put(pixels)), plain.samples(pixels)),
    ):
        assert type(result) is type(put(samples))
        assert np.abs(_copy_to_numpy(result) - want).max() < 1e-5 * np.abs(want).max()


def test_backproject_and_project_run_on_the_library_of_their_samples(library):
    xp, device = library
    rng = np.random.default_rng(1)
    f = 76e9 + 1e8 * np.arange(9)
    reference = rng.uniform(0, 1, 7)
    places = [rng.uniform(-0.5, 0.5, (7, 3)) for _ in range(3)]
    samples = rng.standard_normal((7, 9)) + 1j
    pixels = rng.standard_normal(7) + 1j
    for function, array in ((backproject, samples), (project, pixels)):
        result = function(xp.asarray(array, device=device), f, *places, reference)
        np.testing.assert_allclose(_copy_to_numpy(result), function(array, f, *places, reference), rtol=1e-9)


def test_without_array_api_compat_other_libraries_are_refused(monkeypatch, aperture):
    strict = importlib.import_module("array_api_strict")
    monkeypatch.setitem(importlib.import_module("sys").modules, "array_api_compat", None)
    with expect_refusal(ErrorCode.PACKAGE_MISSING, "array-api-compat"):
        DirectImager(aperture).image(strict.asarray(np.zeros(aperture.shape, np.complex64)))
