"""A layer of unknown thickness: its parameters are recovered, and ambiguity is reported."""

import json

import numpy as np
import pytest
from msgspec import structs
from tests.support.paths import RIG_FILE
from tests.support.rigs import load_published_rig

from polysight import multilayer
from polysight.cli.main import main
from polysight.imaging import sub_bands
from polysight.materials import METAL_PERMITTIVITY, Layer, parse_layer
from polysight.materials.layers import Bands, Spectrum, _Model, fit_layer, predict
from polysight.materials.sub_bands import bands_of_row
from polysight.results import NoResult, ScanMaterials

THETA = np.radians(55.0)
CHIRP = load_published_rig().chirp
BANDS = Spectrum.from_chirp(CHIRP, 4)
# Ranges of thickness in metres in which a sheet of 1.7 mm is searched: a wide one that contains solutions with half a
# wave more or less in the sheet (1.2 mm), and a narrow one that contains none.
WIDE_RANGE_M = (0.3e-3, 6e-3)
NARROW_RANGE_M = (1e-3, 2.4e-3)
SHEET = Layer("sheet", 3.4 - 0.1j, 1.7e-3)
PLATE = Layer("plate", METAL_PERMITTIVITY)
GLASS = Layer("glass", 5.5 - 0.05j, 2e-3)
# Errors of V / H, standard deviations of each part: of one sub-band alone, and common to all of them. Products have
# about these.
OWN_STD = 3e-4
COMMON_STD = 3e-3


def make_shared_covariance(own_std=OWN_STD, common_std=COMMON_STD, bands=4):
    """Return the covariance of real and imaginary part of V / H in all bands, [2 bands, 2 bands]."""
    # Both parts of the common error are the same in each band.
    effect_of_common_error = common_std * np.tile(np.eye(2), (bands, 1))
    return own_std**2 * np.eye(2 * bands) + effect_of_common_error @ effect_of_common_error.T


def measure_bands(stack, offset=0j, theta_std=0.0, covariance=None):
    """Return exact data of the stack with their errors; `offset` is added to V / H of all bands."""
    v_over_h, brightness = predict(stack, BANDS, THETA)
    covariance = make_shared_covariance() if covariance is None else covariance
    # The real part of each band
    sigma = np.sqrt(np.diag(covariance)[::2])
    return Bands(
        spectrum=BANDS,
        inverse_ratio=v_over_h + offset,
        sigma=sigma,
        amplitude_h=brightness,
        sigma_h=0.003 * brightness,
        covariance=covariance,
        common_h=0.1,
        theta_std_rad=theta_std,
    )


@pytest.mark.parametrize(
    ("true_stack", "stack_to_fit"),
    [
        ([SHEET], [Layer("sheet")]),
        ([SHEET, PLATE], [Layer("sheet"), PLATE]),
        ([GLASS, SHEET], [GLASS, Layer("film")]),
    ],
    ids=["sheet in air", "sheet on metal", "film behind a wall"],
)
def test_permittivity_and_thickness_are_recovered_from_exact_data(true_stack, stack_to_fit):
    bands = measure_bands(true_stack, covariance=make_shared_covariance(own_std=1e-5, common_std=1e-5))
    fit = fit_layer(bands, stack_to_fit, THETA, WIDE_RANGE_M)
    assert fit.permittivity == pytest.approx(SHEET.permittivity)
    assert fit.thickness_m == pytest.approx(SHEET.thickness_m)
    assert not fit.ambiguous


def test_infinite_permittivity_is_metal_behind_a_layer():
    # 1 mm of air before the metal
    r_s, r_p = multilayer([1.0, METAL_PERMITTIVITY], [1e-3], 77e9, THETA)
    round_trip = np.exp(-2j * 2 * np.pi * 77e9 / 299792458.0 * 1e-3 * np.cos(THETA))
    np.testing.assert_allclose([r_s, r_p], -round_trip, rtol=1e-9)


def test_an_error_that_all_bands_share_is_not_a_misfit_and_is_within_the_error_bars():
    """V / H of all bands is wrong by two standard deviations of the common error, in some direction."""
    offset = 2 * COMMON_STD * np.exp(0.7j)
    for stack, layers in (([SHEET], [Layer("sheet")]), ([SHEET, PLATE], [Layer("sheet"), PLATE])):
        fit = fit_layer(measure_bands(stack, offset=offset), layers, THETA, NARROW_RANGE_M)
        # The offset itself costs 2^2 = 4 at most. As an error of the bands alone it would cost 4 * 20^2 = 1600.
        assert fit.chi2 < 8
        assert not any("does not explain" in words for words in fit.warnings())
        assert abs(fit.permittivity.real - 3.4) < 3 * fit.std_real
        assert abs(fit.thickness_m - 1.7e-3) < 3 * fit.std_thickness_m


def test_differences_between_bands_are_known_better_than_each():
    """With the same error of each band, the thickness is more certain if most of the error is common to all bands."""
    independent_covariance = np.eye(8) * (OWN_STD**2 + COMMON_STD**2)
    bands_shared = measure_bands([SHEET], covariance=make_shared_covariance())
    bands_independent = measure_bands([SHEET], covariance=independent_covariance)
    shared = fit_layer(bands_shared, [Layer("sheet")], THETA, NARROW_RANGE_M)
    independent = fit_layer(bands_independent, [Layer("sheet")], THETA, NARROW_RANGE_M)
    # The standard deviation is 0.53 times as large.
    assert shared.std_thickness_m < 0.7 * independent.std_thickness_m


def test_two_thicknesses_that_fit_are_both_reported_in_millimetres():
    """The ratio of one narrow band repeats with half a wave more in the sheet."""
    # Two frequencies that differ by 0.1 GHz
    spectrum = Spectrum(np.array([[76.3e9], [76.4e9]]), np.ones((2, 1)))
    v_over_h, brightness = predict([SHEET], spectrum, THETA)
    bands = Bands(spectrum, v_over_h, sigma=np.full(2, 0.003), amplitude_h=brightness, sigma_h=0.05 * brightness)
    fit = fit_layer(bands, [Layer("sheet")], THETA, WIDE_RANGE_M)
    wavelength_m = 299792458.0 / 76.35e9
    # Normal part of the wave number in the sheet over that in air
    normal_index = np.sqrt(3.4 - np.sin(THETA) ** 2)
    rival_m = SHEET.thickness_m + wavelength_m / 2 / normal_index
    thicknesses_m = [solution.thickness_m for solution in (fit, *fit.rivals)]
    # The rival is 0.8 % from half a wave more. Half a wave is 1.2 mm, 70 % of the thickness.
    for expected_m in (SHEET.thickness_m, rival_m):
        relative_errors = [abs(thickness_m / expected_m - 1) for thickness_m in thicknesses_m]
        assert min(relative_errors) < 0.05
    assert fit.ambiguous
    assert any("mm is not excluded" in words for words in fit.warnings())


def test_an_uncertain_angle_widens_the_error_bars():
    known_angle = fit_layer(measure_bands([SHEET], theta_std=0), [Layer("sheet")], THETA, NARROW_RANGE_M)
    # 0.01 rad is 0.6 degrees.
    uncertain_angle = fit_layer(measure_bands([SHEET], theta_std=0.01), [Layer("sheet")], THETA, NARROW_RANGE_M)
    # The error bar becomes four times as large.
    assert uncertain_angle.std_real > 1.1 * known_angle.std_real


@pytest.mark.parametrize(
    ("text", "layer"),
    [
        ("glass,5.5,0.05,3", Layer("glass", 5.5 - 0.05j, 3e-3)),
        ("water, 9.37, 18", Layer("water", 9.37 - 18j)),
        ("sheet,?,0.5", Layer("sheet", thickness_m=0.5e-3)),
        ("liquid,?", Layer("liquid")),
        ("sheet,?,0.5-3", Layer("sheet", thickness_range_m=(0.5e-3, 3e-3))),
        ("sheet, ?, ?", Layer("sheet", thickness_range_m=(0.1e-3, 12e-3))),
        ("plate,metal", PLATE),
    ],
)
def test_a_layer_is_read_from_its_text(text, layer):
    assert parse_layer(text) == layer


# Ranges that are empty, begin at 0 or are no numbers; a word that is not a material; numbers that are not finite, not
# positive, missing or too many.
INVALID_LAYERS = (
    "?,3-0.5",
    "?,0-3",
    "?,a-b",
    "?,1-2-3",
    "?,1,2",
    "?,-1",
    "steel",
    "nan,1",
    "2,0,-1",
    "5.5",
    "a,b",
    "1,2,3,4",
    "",
)


@pytest.mark.parametrize("text", [f"sheet,{rest}" for rest in INVALID_LAYERS])
def test_a_layer_in_another_form_is_refused_with_a_list_of_the_forms(text, capsys):
    with pytest.raises(SystemExit):
        main(["permittivity", "out", "--layer", text])
    assert "NAME,?,A-B" in capsys.readouterr().err


@pytest.fixture
def folder(tmp_path):
    """Folder with materials.json of a sheet on metal, which has no permittivity as a single interface."""
    v_over_h, brightness = predict([SHEET, PLATE], BANDS, THETA)
    ratio = 1 / v_over_h
    # Each band has its two lines of the 8 x 8 matrix.
    lines_of_band = make_shared_covariance().reshape(4, 2, 8)
    bands = [
        {
            "first_hz": band.first_hz, "last_hz": band.last_hz,
            "ratio": {"real": ratio[k].real, "imag": ratio[k].imag},
            "inverse_ratio_std": COMMON_STD, "own_std": OWN_STD, "amplitude_h": brightness[k],
            "covariance": lines_of_band[k].tolist(),
        }
        for k, band in enumerate(sub_bands(CHIRP, 4))
    ]  # fmt: skip
    row = {"label": 3, "name": None, "incidence_deg": 55.0, "metal_reference": False, "permittivity": None}
    row |= {"ratio": bands[0]["ratio"], "inverse_ratio_std": COMMON_STD, "amplitude_h": brightness[0], "bands": bands}
    row["refused"] = {"what": "it would amplify beyond its error bar", "why": "layers", "do": "fit"}
    out = tmp_path / "out"
    out.mkdir()
    (out / "materials.json").write_text(json.dumps({"segments": [row]}))
    return out


def test_the_command_prints_the_fit_of_a_sheet_on_metal(folder, capsys):
    """Thin sheets seldom have a permittivity by one interface: their fit is printed without it."""
    layers = ["--layer", "sheet,?,1-2.4", "--layer", "plate,metal"]
    command = ["permittivity", str(folder), "--config", str(RIG_FILE), *layers]
    assert main([*command, "--json"]) == 0
    layer = json.loads(capsys.readouterr().out)[0]["layer"]
    # The data of the folder are exact.
    assert layer["permittivity"] == pytest.approx([3.4, 0.1])
    assert layer["thickness_mm"] == pytest.approx(1.7)
    # Covariance of real part, loss and thickness in millimetres
    assert np.sqrt(layer["covariance"][2][2]) == pytest.approx(layer["thickness_std_mm"])
    assert all("thickness_mm" in rival for rival in layer["rivals"])
    assert main(command) == 0
    out = capsys.readouterr().out
    assert "thickness 1.70" in out
    assert " mm" in out
    assert main(["permittivity", str(folder), "--patch", "9"]) != 0
    assert "no patch 9" in capsys.readouterr().err


def test_products_without_patches_print_none_and_their_verdict(folder, capsys):
    """No patch was requested by its number, so none is missing."""
    (folder / "materials.json").write_text(json.dumps({"segments": []}))
    assert main(["permittivity", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == []
    (folder / "materials.json").write_text(json.dumps({"segments": [], "verdict": {"level": "none", "reasons": []}}))
    assert main(["permittivity", str(folder)]) == NoResult.exit_status
    assert "no patch" not in capsys.readouterr().err


def test_products_without_the_covariance_of_their_bands_count_as_one_band(folder):
    """Products of earlier releases lack the covariance, so their errors count as independent and twice as large.

    Four independent errors that are twice as large leave as much as the error of one band.
    """
    row = ScanMaterials.read(folder / "materials.json").segments[0]
    with_covariance = bands_of_row(row, CHIRP, 4)
    rows_without_covariance = [structs.replace(band, covariance=None) for band in row.bands]
    without_covariance = bands_of_row(structs.replace(row, bands=rows_without_covariance), CHIRP, 4)
    assert without_covariance.covariance is None
    np.testing.assert_allclose(without_covariance.sigma, 2 * COMMON_STD)
    assert with_covariance.covariance.shape == (8, 8)


def test_samples_of_the_posterior_follow_the_valley_of_thickness_times_index():
    """The posterior is sampled in coordinates in which this bent valley is straight.

    Their derivatives are the inverse of those of the conversion back, here by small steps.
    """
    model = _Model(measure_bands([SHEET, PLATE]), (Layer("sheet"), PLATE), 0, THETA, WIDE_RANGE_M)
    # Real part, loss and thickness in millimetres
    x = np.array([3.4, 0.1, 1.7])
    step = 1e-6
    derivatives = (model._convert_from_straight(x, step * np.eye(3)) - x).T / step
    np.testing.assert_allclose(model._differentiate_straight(x) @ derivatives, np.eye(3), atol=1e-5)
