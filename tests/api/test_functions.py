"""Functions of `polysight`: formulas that keep the labels of xarray, and compare, train, plan and simulate."""

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
from polysight.products import write_image
from polysight.products.processed import read_image
from polysight_shared.errors import ConfigError, DataError, ErrorCode

from .conftest import COPPER, PET, simulate_plates

Complex = npt.NDArray[np.complex128]
# Boxes in the middle of both plates: x0, y0, x1, y1 in mm from the centre of the image.
BOXES = {"copper": (-60.0, -15.0, -30.0, 15.0), "PET": (30.0, -15.0, 60.0, 15.0)}
FREQUENCY_HZ = 78e9
INCIDENCE_RAD = np.radians(55)
# Relative permittivities about those of plastics and glass.
EPS_PLASTIC = 2.9 - 0.03j
EPS_GLASS = 6 - 0.3j


@pytest.fixture(scope="module")
def scan(products):
    return open_scan(products)


# --- formulas keep labels ---------------------------------------------------------------------------------------------


def test_the_permittivity_of_an_image_has_the_image_s_labels(scan):
    image = scan.image()
    eps = permittivity_from_ratio(image["p"], image["incidence_rad"])
    assert isinstance(eps, xarray.DataArray)
    assert eps.dims == image["p"].dims
    xarray.testing.assert_identical(eps["x_mm"], image["x_mm"])
    assert eps.attrs["long_name"] == "relative permittivity"
    values = permittivity_from_ratio(image["p"].values, float(image["incidence_rad"]))
    np.testing.assert_array_equal(eps, values)


def test_labelled_arguments_broadcast_by_the_names_of_their_dimensions():
    theta = xarray.DataArray(np.radians([50.0, 55.0]), dims="angle", coords={"angle": [50, 55]})
    # An infinite permittivity is metal.
    eps = xarray.DataArray([EPS_PLASTIC, EPS_GLASS, np.inf], dims="material")
    for coefficient in fresnel(eps, theta):
        assert coefficient.dims == ("material", "angle")
    # A coating of 3 mm on each of the materials
    eps_coating = 5.5 - 0.05j
    frequency_hz = xarray.DataArray([77e9, FREQUENCY_HZ], dims="frequency")
    r_s, r_p = multilayer([eps_coating, eps], [3e-3], frequency_hz, theta_rad=theta)
    assert set(r_s.dims) == set(r_p.dims) == {"frequency", "angle", "material"}
    r_s_of_plain_numbers, _ = multilayer([eps_coating, EPS_GLASS], [3e-3], FREQUENCY_HZ, INCIDENCE_RAD)
    r_s_on_glass = r_s.isel(frequency=1, material=1).sel(angle=55)
    assert complex(r_s_on_glass) == pytest.approx(r_s_of_plain_numbers)


@pytest.mark.parametrize("swept_argument", ["permittivity", "thickness"])
def test_a_labelled_array_holds_the_values_of_one_layer(swept_argument):
    """Its dimension is not a list of layers, neither alone nor as the only element of a list."""
    if swept_argument == "permittivity":
        eps = xarray.DataArray([2.1 - 0.01j, EPS_PLASTIC, EPS_GLASS], dims="kind")
        thickness_m = 1e-3
    else:
        eps = EPS_PLASTIC
        thickness_m = xarray.DataArray([1.2e-3, 3e-3, 10e-3], dims="kind")
    r_s, _ = multilayer(eps, thickness_m, FREQUENCY_HZ, INCIDENCE_RAD)
    assert r_s.dims == ("kind",)
    r_s_of_lists, _ = multilayer([eps], [thickness_m], FREQUENCY_HZ, INCIDENCE_RAD)
    xarray.testing.assert_identical(r_s, r_s_of_lists)


@pytest.mark.parametrize("theta", [55.0, np.array([0.9, 55.0]), xarray.DataArray([55.0], dims="angle")])
def test_an_angle_in_degrees_is_refused(theta):
    with expect_refusal(ErrorCode.VALUE_INVALID, 55):
        fresnel(EPS_PLASTIC, theta)
    with expect_refusal(ErrorCode.VALUE_INVALID, 55):
        permittivity_from_ratio(2.0, theta_rad=theta)
    with expect_refusal(ErrorCode.VALUE_INVALID, 55):
        multilayer(EPS_PLASTIC, 1e-3, FREQUENCY_HZ, theta)


def test_an_unknown_angle_has_an_unknown_reflection():
    r_s, _ = fresnel(EPS_PLASTIC, np.nan)
    assert np.isnan(r_s)


def test_types_show_whether_labels_are_kept():
    """`assert_type` does nothing here: pyright checks it in `make check`, of which tests/api is a part."""
    theta_rad = 0.9
    numbers = np.array([2.0, 3.0])
    labelled = xarray.DataArray(numbers, dims="kind")
    assert_type(permittivity_from_ratio(numbers, theta_rad), Complex)
    assert_type(permittivity_from_ratio(labelled, theta_rad), xarray.DataArray)
    # Divided by 4 the labelled numbers are angles in radians.
    assert_type(fresnel(EPS_PLASTIC, labelled / 4), tuple[xarray.DataArray, xarray.DataArray])
    assert_type(multilayer([2.9, 3 - 0.1j], 1e-3, FREQUENCY_HZ, theta_rad), tuple[Complex, Complex])
    # Multiplied by 1e-3 they are thicknesses of 2 and 3 mm.
    assert_type(multilayer(2.9, labelled * 1e-3, FREQUENCY_HZ, theta_rad), tuple[xarray.DataArray, xarray.DataArray])
    # Two echoes of four frequencies, seen from two positions; the image has two pixels.
    positions_m = np.zeros((2, 3))
    echoes = np.ones((2, 4), complex)
    frequencies_hz = np.linspace(77e9, 78e9, 4)
    image = polysight.backproject(echoes, frequencies_hz, positions_m, positions_m, positions_m, numbers)
    assert_type(image, Complex)


# --- compare ----------------------------------------------------------------------------------------------------------


def test_a_scan_does_not_differ_from_its_own_products(folder, products):
    comparison = compare(products, open_scan(folder))
    # Differences are 0 but for the rounding of saved numbers.
    assert float(abs(comparison["p_difference"]).max()) < 1e-5
    assert abs(comparison["pair_difference"].item()) < 1e-5
    assert set(comparison["p_difference"].dims) == {"y_mm", "x_mm"}
    # A pair is a patch of either scan at the same position. The metal reference is no such patch.
    assert comparison.sizes["pair"] == 1
    position_mm = [comparison["pair_x_mm"].item(), comparison["pair_y_mm"].item()]
    # Three pixels of 2 mm; measured 1 mm.
    assert position_mm == pytest.approx(PET["centre_mm"], abs=3 * 2)
    for variable in comparison.variables.values():
        assert {"units", "long_name"} <= set(variable.attrs)


# --- labels, libraries ------------------------------------------------------------------------------------------------


def test_a_library_of_labelled_scans_names_their_materials(products, tmp_path):
    folders = [shutil.copytree(products, tmp_path / name) for name in ("one", "two")]
    for folder in folders:
        assert open_scan(folder).label(BOXES).exists()
    # The second scan is not the same as the first one: H is 1 % larger.
    image = read_image(folders[1] / "image.npz")
    image.h[:] *= 1.01
    write_image(folders[1] / "image.npz", image)
    library = polysight.train([open_scan(folders[0]), folders[1]])
    assert library.names == ("PET", "copper")
    X, y, scans = library.columns()
    # |H|, |V|, and the real and the imaginary part of P
    features = 4
    assert X.shape == (len(y), features)
    assert set(scans) == set(library.scans)
    library.save(tmp_path / "own.npz")
    assert polysight.Library.load(tmp_path / "own.npz").names == library.names
    X_new, patch = open_scan(products).columns()
    names = polysight.Classifier("knn").fit(X, y).predict(X_new)
    # Without the library half of the names would be PET; measured: all.
    assert (names[patch == 2] == "PET").mean() > 0.9


@pytest.mark.parametrize("box", [[1, 2, 3], 7.0, "10,10,20,20", (20, 10, 10, 20)])
def test_the_refusal_of_a_value_that_is_not_a_box_names_its_material(products, tmp_path, box):
    folder = shutil.copytree(products, tmp_path / "one")
    (folder / "labels.json").unlink(missing_ok=True)
    with expect_refusal(ErrorCode.VALUE_INVALID, "oak"):
        open_scan(folder).label({"oak": box})
    assert not (folder / "labels.json").exists()


def test_train_takes_a_single_path_as_one_scan(products):
    """Not as a sequence of paths, one for each letter. One scan is too few to train on."""
    with pytest.raises(DataError, match=r"products|1 scan"):
        polysight.train(str(products))


# --- plan, simulate, show ---------------------------------------------------------------------------------------------


def test_a_plan_has_numbers_a_text_and_a_view_for_notebooks():
    planned = polysight.plan(step_x_mm=2.0, step_y_mm=2.0)
    assert planned.forecast.rig.grid.step_x_mm == 2.0
    assert planned.forecast.time.total_s > 0
    assert "resolution" in str(planned)
    assert planned._repr_html_().startswith("<pre>")


def test_the_refusal_of_an_unknown_change_of_a_plan_lists_the_known_ones():
    known_changes = [field.name for field in fields(PlanChanges)]
    with expect_refusal(ErrorCode.VALUE_INVALID, "spead_mm_s", *known_changes) as caught:
        polysight.plan(speed=1, spead_mm_s=2)
    assert isinstance(caught.value, ConfigError)


@pytest.mark.parametrize(("name", "value"), [("width_mm", "wide"), ("columns", None), ("pulses", [7])])
def test_the_refusal_of_a_plan_s_value_that_is_not_a_number_names_it(name, value):
    with expect_refusal(ErrorCode.VALUE_INVALID, name, "not a number"):
        polysight.plan(**{name: value})


def test_a_scene_can_be_written_in_python(tmp_path):
    scene = {
        "name": "one plate",
        "grid": {"columns": 9, "rows": 9, "step_x_mm": 8.0, "step_y_mm": 8.0},
        "burst": {"pulses": 2},
        "plates": [COPPER],
    }
    # A warning says that the plate is too small.
    with pytest.warns(UserWarning, match="COPPER|copper"):
        simulated_scan = polysight.simulate(scene, tmp_path / "scan", seed=5)
    assert simulated_scan.simulated is True
    assert simulated_scan.rows.planned == 9


def test_a_scene_in_python_with_an_unknown_key_is_refused(tmp_path):
    scene = {"name": "wrong", "plates": [{"nme": "x"}]}
    # A warning says that the scene has no grid.
    with pytest.warns(UserWarning, match="grid"), expect_refusal(ErrorCode.OTHER):
        polysight.simulate(scene, tmp_path / "other")


def test_a_notebook_shows_a_scan_without_processing_it(products, tmp_path):
    unprocessed = open_scan(simulate_plates(tmp_path / "scan"))
    assert "recorded rows" in unprocessed._repr_html_()
    page = open_scan(products)._repr_html_()
    for text in ("SIMULATED", "<td>metal reference</td>", "verdict"):
        assert text in page
