"""Functions on scans: labels kept by the maths, plan, simulate, compare, label, train."""

import shutil
from dataclasses import fields
from typing import assert_type

import numpy as np
import numpy.typing as npt
import pytest
import xarray
from tests.support.refusals import expect_refusal

import polysight
from polysight import compare, fresnel, multilayer, open_scan, permittivity_from_ratio
from polysight.planning import PlanChanges
from polysight.products.processed import read_image
from polysight_shared.errors import ConfigError, DataError, ErrorCode

from .conftest import COPPER, PET, simulate_plates

Complex = npt.NDArray[np.complex128]
BOXES = {"copper": (-60.0, -15.0, -30.0, 15.0), "PET": (30.0, -15.0, 60.0, 15.0)}


@pytest.fixture(scope="module")
def scan(products):
    return open_scan(products)


# --- the maths keeps labels -------------------------------------------------------------------------------------------


def test_the_permittivity_of_an_image_is_an_image(scan):
    image = scan.image()
    eps = permittivity_from_ratio(image["p"], image["incidence_rad"])
    assert isinstance(eps, xarray.DataArray)
    assert eps.dims == image["p"].dims
    xarray.testing.assert_identical(eps["x_mm"], image["x_mm"])
    assert eps.attrs["long_name"] == "relative permittivity"
    np.testing.assert_array_equal(eps, permittivity_from_ratio(image["p"].values, float(image["incidence_rad"])))


def test_reflection_coefficients_broadcast_by_name():
    theta = xarray.DataArray(np.radians([50.0, 55.0]), dims="angle", coords={"angle": [50, 55]})
    eps = xarray.DataArray([3.8 - 0.7j, 6 - 0.3j, np.inf], dims="material")
    for r in fresnel(eps, theta):
        assert r.dims == ("material", "angle")
    frequency_hz = xarray.DataArray([77e9, 78e9], dims="frequency")
    r_s, r_p = multilayer([5.5 - 0.05j, eps], [3e-3], frequency_hz, theta_rad=theta)
    assert set(r_s.dims) == set(r_p.dims) == {"frequency", "angle", "material"}
    plain = multilayer([5.5 - 0.05j, 6 - 0.3j], [3e-3], 78e9, np.radians(55))[0]
    assert complex(r_s.isel(frequency=1, material=1).sel(angle=55)) == pytest.approx(plain)


@pytest.mark.parametrize("function", ["permittivities", "thicknesses"])
def test_an_array_with_labels_is_one_medium(function):
    """Its dimension is not a list of media, whether or not it stands in a list."""
    if function == "permittivities":
        eps = xarray.DataArray([2.1 - 0.01j, 2.9 - 0.03j, 6 - 0.3j], dims="kind")
        thickness_m = 1e-3
    else:
        eps = 2.9 - 0.03j
        thickness_m = xarray.DataArray([1.2e-3, 3e-3, 10e-3], dims="kind")
    swept = multilayer(eps, thickness_m, 78e9, np.radians(55))[0]
    assert swept.dims == ("kind",)
    xarray.testing.assert_identical(swept, multilayer([eps], [thickness_m], 78e9, np.radians(55))[0])


@pytest.mark.parametrize("theta", [55.0, np.array([0.9, 55.0]), xarray.DataArray([55.0], dims="angle")])
def test_degrees_are_not_taken_as_radians(theta):
    for call in (lambda: fresnel(3.8 - 0.7j, theta), lambda: permittivity_from_ratio(2.0, theta_rad=theta)):
        with expect_refusal(ErrorCode.VALUE_INVALID, 55):
            call()
    with expect_refusal(ErrorCode.VALUE_INVALID, 55):
        multilayer(2.9 - 0.03j, 1e-3, 78e9, theta)
    assert np.isnan(fresnel(3.8 - 0.7j, np.nan)[0])


def test_types_show_whether_labels_are_preserved():
    """`assert_type` is judged by pyright: tests/api is among the files of `make check`."""
    plain = np.array([2.0, 3.0])
    labelled = xarray.DataArray(plain, dims="kind")
    assert_type(permittivity_from_ratio(plain, 0.9), Complex)
    assert_type(permittivity_from_ratio(labelled, 0.9), xarray.DataArray)
    assert_type(fresnel(3.8 - 0.7j, labelled / 4), tuple[xarray.DataArray, xarray.DataArray])
    assert_type(multilayer([2.9, 3 - 0.1j], 1e-3, 78e9, 0.9), tuple[Complex, Complex])
    assert_type(multilayer(2.9, labelled * 1e-3, 78e9, 0.9), tuple[xarray.DataArray, xarray.DataArray])
    places = np.zeros((2, 3))
    image = polysight.backproject(np.ones((2, 4), complex), np.linspace(77e9, 78e9, 4), places, places, places, plain)
    assert_type(image, Complex)


# --- compare ----------------------------------------------------------------------------------------------------------


def test_two_scans_are_compared_on_labelled_pixels(folder, products):
    same = compare(products, open_scan(folder))
    assert float(abs(same["p_difference"]).max()) < 1e-5
    assert same.sizes["pair"] == 1
    assert [same["pair_x_mm"].item(), same["pair_y_mm"].item()] == pytest.approx(PET["centre_mm"], abs=6)
    assert abs(same["pair_difference"].item()) < 1e-5
    assert set(same["p_difference"].dims) == {"y_mm", "x_mm"}
    for variable in same.variables.values():
        assert {"units", "long_name"} <= set(variable.attrs)


# --- labels, libraries ------------------------------------------------------------------------------------------------


def test_labelled_scans_make_a_library_that_names_them(products, tmp_path):
    folders = [shutil.copytree(products, tmp_path / name) for name in ("one", "two")]
    for place in folders:
        assert open_scan(place).label(BOXES).exists()
    image = read_image(folders[1] / "image.npz")
    image.h[:] *= 1.01
    from polysight.products import write_image

    write_image(folders[1] / "image.npz", image)
    library = polysight.train([open_scan(folders[0]), folders[1]])
    assert library.names == ("PET", "copper")
    X, y, scans = library.columns()
    assert X.shape == (len(y), 4)
    assert set(scans) == set(library.scans)
    library.save(tmp_path / "own.npz")
    assert polysight.Library.load(tmp_path / "own.npz").names == library.names
    X_new, patch = open_scan(products).columns()
    named = polysight.Classifier("knn").fit(X, y).predict(X_new)
    assert (named[patch == 2] == "PET").mean() > 0.9


@pytest.mark.parametrize("box", [[1, 2, 3], 7.0, "10,10,20,20", (20, 10, 10, 20)])
def test_a_value_that_is_not_a_box_is_refused_by_name(products, tmp_path, box):
    place = shutil.copytree(products, tmp_path / "one")
    (place / "labels.json").unlink(missing_ok=True)
    with expect_refusal(ErrorCode.VALUE_INVALID, "oak"):
        open_scan(place).label({"oak": box})
    assert not (place / "labels.json").exists()


def test_one_path_is_one_scan(products):
    """A text is one scan, not one for each of its letters."""
    with pytest.raises(DataError, match=r"products|1 scan"):
        polysight.train(str(products))


# --- plan, simulate, show ---------------------------------------------------------------------------------------------


def test_a_plan_is_a_text_and_its_numbers():
    planned = polysight.plan(step_x_mm=2.0, step_y_mm=2.0)
    assert planned.forecast.rig.grid.step_x_mm == 2.0
    assert planned.forecast.time.total_s > 0
    assert "resolution" in str(planned)
    assert planned._repr_html_().startswith("<pre>")


def test_an_unknown_change_of_a_plan_is_refused_with_those_that_are_known():
    with pytest.raises(ConfigError) as caught:
        polysight.plan(speed=1, spead_mm_s=2)
    assert caught.value.code == ErrorCode.VALUE_INVALID
    assert all(word in str(caught.value) for word in ("spead_mm_s", *(field.name for field in fields(PlanChanges))))


@pytest.mark.parametrize("changes", [{"width_mm": "wide"}, {"columns": None}, {"pulses": [7]}])
def test_a_changed_plan_value_that_is_not_a_number_is_refused_by_name(changes):
    with expect_refusal(ErrorCode.VALUE_INVALID, next(iter(changes)), "not a number"):
        polysight.plan(**changes)


def test_a_scene_can_be_written_in_python(tmp_path):
    scene = {
        "name": "one plate",
        "grid": {"columns": 9, "rows": 9, "step_x_mm": 8.0, "step_y_mm": 8.0},
        "burst": {"pulses": 2},
        "plates": [COPPER],
    }
    with pytest.warns(UserWarning, match="COPPER|copper"):
        simulated_scan = polysight.simulate(scene, tmp_path / "scan", seed=5)
    assert simulated_scan.simulated is True
    assert simulated_scan.rows.planned == 9
    with pytest.warns(UserWarning, match="grid"), expect_refusal(ErrorCode.OTHER):
        polysight.simulate({"name": "wrong", "plates": [{"nme": "x"}]}, tmp_path / "other")


def test_a_scan_shows_itself_without_processing(products, tmp_path):
    assert "recorded rows" in open_scan(simulate_plates(tmp_path / "scan"))._repr_html_()
    page = open_scan(products)._repr_html_()
    for text in ("SIMULATED", "<td>metal reference</td>", "verdict"):
        assert text in page
