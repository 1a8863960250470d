"""Maps of permittivity: one value and its standard error per pixel, computed from P = H / V.

Each map is corrected for the leakage between the polarisations and for the incidence angle, as the error budget of the
scan estimates them, and agrees with the permittivities of the patches.
"""

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

# Complex amplitude of V in the channel H, and of H in the channel V.
LEAKAGE_H = 0.05 - 0.02j
LEAKAGE_V = -0.03 + 0.06j
# True permittivities of six pixels, from plastics to glass and stone.
TRUE_EPS = np.array([[2.05 - 0.005j, 2.6 - 0.01j, 3.78 - 0.7j], [4.75 - 2.43j, 6.3 - 0.2j, 11.0 - 0.4j]])
# Number of the patch of PET; the patch of copper is 1.
PET_PATCH = 2


@pytest.fixture(scope="module")
def scan(products):
    return open_scan(products)


def make_leaking_scan(rig: Instrument, angle_error_rad: float = 0.0) -> ProcessedScan:
    """Products of pixels of known permittivities with leakage, half of which was removed when they were made.

    The error budget has the whole leakage, the part that was removed, and the true incidence angle, which differs from
    that of the rig by `angle_error_rad`.
    """
    theta_rad = specular_incidence_rad(rig) + angle_error_rad
    r_s, r_p = fresnel(TRUE_EPS, theta_rad)
    # Both channels are divided by what metal (r_s = r_p) has in them.
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
def test_every_pixel_is_corrected_for_the_estimated_leakage_and_angle(scan, angle_error_rad):
    eps = permittivity_dataset(make_leaking_scan(scan.rig, angle_error_rad))
    np.testing.assert_allclose(eps["permittivity"].values, TRUE_EPS, rtol=1e-9)


def test_products_that_do_not_say_how_much_leakage_was_removed_are_not_corrected(scan):
    """Products of earlier releases: all of the estimated leakage was removed when they were made."""
    leaking = make_leaking_scan(scan.rig)
    assert leaking.materials is not None
    leakage = LeakageError(h=split_complex(LEAKAGE_H), v=split_complex(LEAKAGE_V), std=(0.01, 0.01), source="scene")
    vars(leaking)["materials"] = ScanMaterials(segments=[], error_budget=ErrorBudget(leakage=leakage))
    expected = permittivity_from_ratio(leaking.p, specular_incidence_rad(scan.rig))
    np.testing.assert_allclose(permittivity_dataset(leaking)["permittivity"].values, expected, rtol=1e-12)


def test_the_map_of_products_without_an_error_budget_is_not_corrected(scan):
    leaking = make_leaking_scan(scan.rig)
    vars(leaking)["materials"] = ScanMaterials(segments=[])
    expected = permittivity_from_ratio(leaking.p, specular_incidence_rad(scan.rig))
    np.testing.assert_allclose(permittivity_dataset(leaking)["permittivity"].values, expected, rtol=1e-12)


def test_the_mean_of_the_map_over_a_patch_is_the_patch_s_permittivity(scan):
    eps = scan.permittivity_map()
    patches = scan.patches()
    # The patch of copper has no permittivity.
    has_permittivity = np.isfinite(patches["permittivity"].values)
    assert patches["patch"].values[has_permittivity].tolist() == [PET_PATCH]
    pet = patches.sel(patch=PET_PATCH)
    inside = (patches["label"] == PET_PATCH) & patches["interior"]
    difference = complex(eps["permittivity"].where(inside).mean()) - complex(pet["permittivity"])
    # Measured: 2 % of a standard error in the real part, 9 % in the loss.
    assert abs(difference.real) < 0.5 * float(pet["permittivity_real_standard_error"])
    assert abs(difference.imag) < 0.5 * float(pet["permittivity_loss_standard_error"])


def test_no_pixel_is_more_certain_than_its_patch(scan):
    eps = scan.permittivity_map()
    patches = scan.patches()
    is_pet = patches["label"].values == PET_PATCH
    for part in ("real", "loss"):
        name = f"permittivity_{part}_standard_error"
        error_of_patch = float(patches[name].sel(patch=PET_PATCH))
        assert np.nanmin(eps[name].values[is_pet]) >= error_of_patch * (1 - 1e-6)


def test_the_mask_has_only_values_that_a_dielectric_can_have(scan):
    """A real part of at least 1 and no negative loss, within two standard errors; nothing on the metal or its edges."""
    eps = scan.permittivity_map()
    permittivities = eps["permittivity"].values[eps["mask"].values]
    errors = eps["permittivity_real_standard_error"].values[eps["mask"].values]
    assert permittivities.size > 0
    assert np.all(permittivities.real + 2 * errors >= 1)
    assert np.all(permittivities.imag - 2 * errors <= 1e-6)
    inside_pet = eps["mask"].sel(x_mm=slice(32, 58), y_mm=slice(-13, 13))
    # Measured: all of these pixels.
    assert inside_pet.mean() > 0.9
    inside_copper = eps["mask"].sel(x_mm=slice(-60, -30), y_mm=slice(-15, 15))
    assert not inside_copper.any()


def test_the_standard_error_is_the_change_of_the_permittivity_with_an_error_of_p(scan):
    """True for pixels that are in no patch, if the angle has no error: `p_sigma` is then the only error."""
    leaking = make_leaking_scan(scan.rig)
    eps = permittivity_dataset(leaking)
    # A small part of `p_sigma`, for which the permittivity changes in proportion
    part_of_sigma = 1e-3
    vars(leaking)["images"] = add_errors(leaking.images, part_of_sigma)
    change = np.abs(permittivity_dataset(leaking)["permittivity"].values - eps["permittivity"].values)
    for part in ("real", "loss"):
        errors = eps[f"permittivity_{part}_standard_error"].values
        # Measured: 3 to 4 % apart in the first row of pixels.
        np.testing.assert_allclose(errors, change / part_of_sigma, rtol=0.15)


def add_errors(images: Images, part_of_sigma: float) -> Images:
    """Images whose P is wrong by this part of its standard deviation `p_sigma`."""
    assert images.p is not None
    assert images.p_sigma is not None
    return replace(images, p=images.p + part_of_sigma * images.p_sigma.astype(np.float64))


def test_a_pixel_that_the_scan_does_not_illuminate_has_neither_value_nor_error(scan):
    leaking = make_leaking_scan(scan.rig)
    is_dark = np.zeros(TRUE_EPS.shape, bool)
    is_dark[0, 1] = True
    vars(leaking)["images"] = replace(leaking.images, valid=~is_dark)
    eps = permittivity_dataset(leaking)
    for name in ("permittivity", "permittivity_real_standard_error", "permittivity_loss_standard_error"):
        np.testing.assert_array_equal(np.isnan(eps[name].values), is_dark)


def test_a_map_is_written_and_read_back(scan, tmp_path):
    eps = scan.permittivity_map()
    polysight.write_netcdf(tmp_path / "map.nc", eps)
    xarray.testing.assert_identical(polysight.read_netcdf(tmp_path / "map.nc"), eps)


def test_probe_returns_the_results_of_a_pixel_and_of_its_patch(scan):
    # The centre of the plate of PET
    x_mm, y_mm = 45, 0
    eps = scan.permittivity_map()["permittivity"].sel(x_mm=x_mm, y_mm=y_mm, method="nearest")
    pixel = scan.probe(x_mm, y_mm)
    assert complex(pixel["permittivity"]) == complex(eps)
    assert int(pixel["label"]) == PET_PATCH
    assert pixel["name"].item() == scan.materials()["name"].sel(patch=PET_PATCH).item()
    beside_the_plates = scan.probe(0, 45)
    assert beside_the_plates["name"].item() == ""


@pytest.mark.parametrize(("x_mm", "y_mm"), [(900.0, 0.0), (0.0, -900.0)])
def test_probe_refuses_a_position_outside_the_image(scan, x_mm, y_mm):
    """The nearest pixel would be one at the border."""
    with expect_refusal(ErrorCode.VALUE_INVALID):
        scan.probe(x_mm, y_mm)
