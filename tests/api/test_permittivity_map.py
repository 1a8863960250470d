"""Maps of permittivity agree with the patches, are corrected for the estimated leakage, and have correct errors."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray
from tests.support.refusals import expect_refusal

import polysight
from polysight import fresnel, open_scan, permittivity_from_ratio
from polysight.imaging import Images
from polysight.polarimetry import correct_leakage, specular_incidence_rad
from polysight.products import ProcessedScan, permittivity_dataset
from polysight.results import ErrorBudget, IncidenceError, LeakageError, ScanFacts, ScanMaterials, ScanQuality, to_plain
from polysight_shared.config import Instrument
from polysight_shared.errors import ErrorCode

LEAKAGE_H = 0.05 - 0.02j
LEAKAGE_V = -0.03 + 0.06j
TRUE = np.array([[2.05 - 0.005j, 2.6 - 0.01j, 3.78 - 0.7j], [4.75 - 2.43j, 6.3 - 0.2j, 11.0 - 0.4j]])


@pytest.fixture(scope="module")
def scan(products):
    return open_scan(products)


def make_leaking_scan(rig: Instrument, angle_error_rad: float = 0.0) -> ProcessedScan:
    """Pixels of known permittivities with a leakage that the error budget knows, of which half was removed."""
    theta_rad = specular_incidence_rad(rig) + angle_error_rad
    r_s, r_p = fresnel(TRUE, theta_rad)
    received_h = (r_s + LEAKAGE_H * r_p) / (1 + LEAKAGE_H)
    received_v = (r_p + LEAKAGE_V * r_s) / (1 + LEAKAGE_V)
    h, v = correct_leakage(received_h, received_v, LEAKAGE_H / 2, LEAKAGE_V / 2)
    images = Images(
        h=h, v=v, p=h / v, x_m=np.array([0.0, 2e-3, 4e-3]), y_m=np.array([0.0, 2e-3]), valid=np.ones(h.shape, bool),
        p_sigma=np.full(h.shape, 1e-3, np.float32),
    )  # fmt: skip
    leakage = LeakageError(
        h=split_complex(LEAKAGE_H), v=split_complex(LEAKAGE_V), std=(0.01, 0.01), source="prior and scene",
        removed_h=split_complex(LEAKAGE_H / 2), removed_v=split_complex(LEAKAGE_V / 2),
    )  # fmt: skip
    incidence = IncidenceError(deg=float(np.degrees(theta_rad)), std_deg=0.0)
    return ProcessedScan.from_results(
        Path(),
        images=images,
        quality=ScanQuality(),
        facts=ScanFacts(instrument=to_plain(rig)),
        materials=ScanMaterials(segments=[], error_budget=ErrorBudget(leakage=leakage, incidence=incidence)),
        labels=np.zeros(h.shape, np.int32),
    )


def split_complex(value: complex) -> tuple[float, float]:
    return value.real, value.imag


@pytest.mark.parametrize("angle_error_rad", [0.0, 3e-3])
def test_known_leakage_and_angle_are_taken_out_of_every_pixel(scan, angle_error_rad):
    eps = permittivity_dataset(make_leaking_scan(scan.rig, angle_error_rad))
    np.testing.assert_allclose(eps["permittivity"].values, TRUE, rtol=1e-9)


def test_products_without_a_record_of_corrections_are_not_corrected_twice(scan):
    leaking = make_leaking_scan(scan.rig)
    assert leaking.materials is not None
    applied_leakage = LeakageError(
        h=split_complex(LEAKAGE_H), v=split_complex(LEAKAGE_V), std=(0.01, 0.01), source="scene"
    )
    earlier = ScanMaterials(segments=[], error_budget=ErrorBudget(leakage=applied_leakage))
    vars(leaking)["materials"] = earlier
    expected = permittivity_from_ratio(leaking.p, specular_incidence_rad(scan.rig))
    np.testing.assert_allclose(permittivity_dataset(leaking)["permittivity"].values, expected, rtol=1e-12)


def test_products_without_an_error_budget_have_a_map(scan):
    leaking = make_leaking_scan(scan.rig)
    vars(leaking)["materials"] = ScanMaterials(segments=[])
    expected = permittivity_from_ratio(leaking.p, specular_incidence_rad(scan.rig))
    np.testing.assert_allclose(permittivity_dataset(leaking)["permittivity"].values, expected, rtol=1e-12)


def test_the_mean_of_the_map_over_a_patch_is_the_patchs_permittivity(scan):
    eps = scan.permittivity_map()
    patches = scan.patches()
    judged = 0
    for patch in patches["patch"].values:
        patch_figures = patches.sel(patch=patch)
        if not np.isfinite(patch_figures["permittivity"]):
            continue
        mean = complex(eps["permittivity"].where((patches["label"] == patch) & patches["interior"]).mean())
        difference = mean - complex(patch_figures["permittivity"])
        assert abs(difference.real) < 0.5 * float(patch_figures["permittivity_real_standard_error"])
        assert abs(difference.imag) < 0.5 * float(patch_figures["permittivity_loss_standard_error"])
        judged += 1
    assert judged == 1


def test_no_pixel_is_more_certain_than_its_patch(scan):
    eps = scan.permittivity_map()
    patches = scan.patches()
    inside = patches["label"] == 2
    for part in ("real", "loss"):
        name = f"permittivity_{part}_standard_error"
        pixels = eps[name].values[inside.values]
        assert np.nanmin(pixels) >= float(patches[name].sel(patch=2)) * (1 - 1e-6)


def test_the_mask_holds_no_value_that_a_half_space_cannot_have(scan):
    """The edges of the metal have no values, either."""
    eps = scan.permittivity_map()
    permittivities = eps["permittivity"].values[eps["mask"].values]
    errors = eps["permittivity_real_standard_error"].values[eps["mask"].values]
    assert permittivities.size > 0
    assert np.all(permittivities.real + 2 * errors >= 1)
    assert np.all(permittivities.imag - 2 * errors <= 1e-6)
    assert bool(eps["mask"].sel(x_mm=slice(32, 58), y_mm=slice(-13, 13)).mean() > 0.9)
    assert not eps["mask"].sel(x_mm=slice(-60, -30), y_mm=slice(-15, 15)).any()


def test_the_errors_of_the_map_are_those_of_its_ratio(scan):
    """Beside patches and without an error of the angle: a ratio off by `p_sigma` moves the value by its error."""
    leaking = make_leaking_scan(scan.rig)
    eps = permittivity_dataset(leaking)
    vars(leaking)["images"] = move_images(leaking.images)
    change = np.abs(permittivity_dataset(leaking)["permittivity"].values - eps["permittivity"].values) * 1e3
    for part in ("real", "loss"):
        np.testing.assert_allclose(eps[f"permittivity_{part}_standard_error"].values, change, rtol=0.15)


def move_images(images: Images) -> Images:
    """Images whose P is off by a thousandth of `p_sigma`."""
    assert images.p is not None
    assert images.p_sigma is not None
    return replace(images, p=images.p + images.p_sigma.astype(np.float64) * 1e-3)


def test_where_the_scan_lights_nothing_neither_value_nor_error_is_known(scan):
    leaking = make_leaking_scan(scan.rig)
    dark = np.zeros(TRUE.shape, bool)
    dark[0, 1] = True
    vars(leaking)["images"] = replace(leaking.images, valid=~dark)
    eps = permittivity_dataset(leaking)
    for name in ("permittivity", "permittivity_real_standard_error", "permittivity_loss_standard_error"):
        np.testing.assert_array_equal(np.isnan(eps[name].values), dark)


def test_a_map_is_written_and_read_back(scan, tmp_path):
    eps = scan.permittivity_map()
    polysight.write_netcdf(tmp_path / "map.nc", eps)
    xarray.testing.assert_identical(polysight.read_netcdf(tmp_path / "map.nc"), eps)


def test_a_place_has_the_figures_of_map_and_patch(scan):
    eps = scan.permittivity_map()
    pixel = scan.probe(45, 0)
    assert complex(pixel["permittivity"]) == complex(eps["permittivity"].sel(x_mm=45, y_mm=0, method="nearest"))
    assert int(pixel["label"]) == 2
    assert pixel["name"].item() == scan.materials()["name"].sel(patch=2).item()
    assert scan.probe(0, 45)["name"].item() == ""


@pytest.mark.parametrize("place", [(900.0, 0.0), (0.0, -900.0)])
def test_a_place_outside_the_image_is_not_a_border_pixel(scan, place):
    with expect_refusal(ErrorCode.VALUE_INVALID):
        scan.probe(*place)
