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
RANGE = (0.3e-3, 6e-3)
NEAR = (1e-3, 2.4e-3)
SHEET = Layer("sheet", 3.4 - 0.1j, 1.7e-3)
PLATE = Layer("plate", METAL_PERMITTIVITY)
GLASS = Layer("glass", 5.5 - 0.05j, 2e-3)
OWN = 3e-4
COMMON = 3e-3


def make_shared_covariance(own=OWN, common=COMMON, bands=4):
    """An error that all bands share, in addition to one of each."""
    place = common * np.tile(np.eye(2), (bands, 1))
    return own**2 * np.eye(2 * bands) + place @ place.T


def measure_bands(stack, offset=0j, theta_std=0.0, covariance=None):
    q, h = predict(stack, BANDS, THETA)
    covariance = make_shared_covariance() if covariance is None else covariance
    sigma = np.sqrt(np.diag(covariance)[::2])
    return Bands(
        spectrum=BANDS,
        inverse_ratio=q + offset,
        sigma=sigma,
        amplitude_h=h,
        sigma_h=0.003 * h,
        covariance=covariance,
        common_h=0.1,
        theta_std_rad=theta_std,
    )


@pytest.mark.parametrize(
    ("true", "asked"),
    [
        ([SHEET], [Layer("sheet")]),
        ([SHEET, PLATE], [Layer("sheet"), PLATE]),
        ([GLASS, SHEET], [GLASS, Layer("film")]),
    ],
    ids=["sheet in air", "sheet on metal", "film behind a wall"],
)
def test_permittivity_and_thickness_come_back(true, asked):
    fit = fit_layer(measure_bands(true, covariance=make_shared_covariance(1e-5, 1e-5)), asked, THETA, RANGE)
    assert fit.permittivity == pytest.approx(SHEET.permittivity, rel=1e-4)
    assert fit.thickness_m == pytest.approx(1.7e-3, rel=1e-4)
    assert not fit.ambiguous


def test_infinite_permittivity_is_metal_behind_a_layer():
    r_s, r_p = multilayer([1.0, METAL_PERMITTIVITY], [1e-3], 77e9, THETA)
    round_trip = np.exp(-2j * 2 * np.pi * 77e9 / 299792458.0 * 1e-3 * np.cos(THETA))
    np.testing.assert_allclose([r_s, r_p], -round_trip, rtol=1e-9)


def test_an_error_that_all_bands_share_is_not_a_misfit_and_moves_little():
    """Two deviations of the common error: the data still fit, within the error bars."""
    for stack, layers in (([SHEET], [Layer("sheet")]), ([SHEET, PLATE], [Layer("sheet"), PLATE])):
        fit = fit_layer(measure_bands(stack, offset=2 * COMMON * np.exp(0.7j)), layers, THETA, NEAR)
        assert fit.chi2 < 8
        assert not any("does not explain" in words for words in fit.warnings())
        assert abs(fit.permittivity.real - 3.4) < 3 * fit.std_real
        assert abs(fit.thickness_m - 1.7e-3) < 3 * fit.std_thickness_m


def test_differences_between_bands_are_known_better_than_each():
    """With the same error of each band, the thickness is more certain if most of the error is common to all bands."""
    alone = np.eye(8) * (OWN**2 + COMMON**2)
    shared = fit_layer(measure_bands([SHEET], covariance=make_shared_covariance()), [Layer("sheet")], THETA, NEAR)
    independent = fit_layer(measure_bands([SHEET], covariance=alone), [Layer("sheet")], THETA, NEAR)
    assert shared.std_thickness_m < 0.7 * independent.std_thickness_m


def test_two_thicknesses_that_fit_are_both_reported_in_millimetres():
    """The ratio of one narrow band repeats with half a wave more in the sheet."""
    band = Spectrum(np.array([[76.3e9], [76.4e9]]), np.ones((2, 1)))
    q, h = predict([SHEET], band, THETA)
    bands = Bands(band, q, np.full(2, 0.003), h, 0.05 * h)
    fit = fit_layer(bands, [Layer("sheet")], THETA, RANGE)
    rival_m = SHEET.thickness_m + 299792458.0 / 76.35e9 / 2 / np.sqrt(3.4 - np.sin(THETA) ** 2)
    sizes = [solution.thickness_m for solution in (fit, *fit.rivals)]
    for true in (SHEET.thickness_m, rival_m):
        assert min(abs(size / true - 1) for size in sizes) < 0.05
    assert fit.ambiguous
    assert any("mm is not excluded" in words for words in fit.warnings())


def test_an_uncertain_angle_widens_the_error_bars():
    sure = fit_layer(measure_bands([SHEET], theta_std=0), [Layer("sheet")], THETA, NEAR)
    unsure = fit_layer(measure_bands([SHEET], theta_std=0.01), [Layer("sheet")], THETA, NEAR)
    assert unsure.std_real > 1.1 * sure.std_real


@pytest.mark.parametrize(
    ("text", "layer"),
    [
        ("glass,5.5,0.05,3", Layer("glass", 5.5 - 0.05j, 3e-3)),
        ("water, 9.37, 18", Layer("water", 9.37 - 18j)),
        ("sheet,?,0.5", Layer("sheet", None, 0.5e-3)),
        ("liquid,?", Layer("liquid")),
        ("sheet,?,0.5-3", Layer("sheet", thickness_range_m=(0.5e-3, 3e-3))),
        ("sheet, ?, ?", Layer("sheet", thickness_range_m=(0.1e-3, 12e-3))),
        ("plate,metal", PLATE),
    ],
)
def test_forms_of_a_layer(text, layer):
    assert parse_layer(text) == layer


BAD = ("?,3-0.5", "?,0-3", "?,a-b", "?,1-2-3", "?,1,2", "?,-1", "steel", "nan,1", "2,0,-1", "5.5", "a,b", "1,2,3,4", "")


@pytest.mark.parametrize("text", [f"sheet,{rest}" for rest in BAD])
def test_other_forms_are_refused_with_those_that_are_known(text, capsys):
    with pytest.raises(SystemExit):
        main(["permittivity", "out", "--layer", text])
    assert "NAME,?,A-B" in capsys.readouterr().err


@pytest.fixture
def folder(tmp_path):
    """Products of a sheet on metal, which has no permittivity as a single interface."""
    q, h = predict([SHEET, PLATE], BANDS, THETA)
    covariance = make_shared_covariance()
    ratio = 1 / q
    edges = [(b.first_hz, b.last_hz) for b in sub_bands(CHIRP, 4)]
    bands = [
        {
            "first_hz": edges[k][0], "last_hz": edges[k][1], "ratio": {"real": ratio[k].real, "imag": ratio[k].imag},
            "inverse_ratio_std": COMMON, "own_std": OWN, "amplitude_h": h[k],
            "covariance": covariance[2 * k : 2 * k + 2].tolist(),
        }
        for k in range(4)
    ]  # fmt: skip
    row = {"label": 3, "name": None, "incidence_deg": 55.0, "metal_reference": False, "permittivity": None}
    row |= {"ratio": bands[0]["ratio"], "inverse_ratio_std": COMMON, "amplitude_h": h[0], "bands": bands}
    row["refused"] = {"what": "it would amplify beyond its error bar", "why": "layers", "do": "fit"}
    out = tmp_path / "out"
    out.mkdir()
    (out / "materials.json").write_text(json.dumps({"segments": [row]}))
    return out


def test_a_sheet_on_metal_as_typed(folder, capsys):
    """Thin sheets seldom have a permittivity by one interface: their fit is printed all the same."""
    layers = ["--layer", "sheet,?,1-2.4", "--layer", "plate,metal"]
    words = ["permittivity", str(folder), "--config", str(RIG_FILE), *layers]
    assert main([*words, "--json"]) == 0
    layer = json.loads(capsys.readouterr().out)[0]["layer"]
    assert layer["permittivity"] == pytest.approx([3.4, 0.1], rel=0.01)
    assert layer["thickness_mm"] == pytest.approx(1.7, rel=0.01)
    assert np.sqrt(layer["covariance"][2][2]) == pytest.approx(layer["thickness_std_mm"])
    assert all("thickness_mm" in rival for rival in layer["rivals"])
    assert main(words) == 0
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


def test_products_without_the_errors_that_bands_share_count_as_one_band(folder):
    row = ScanMaterials.read(folder / "materials.json").segments[0]
    new = bands_of_row(row, CHIRP, 4)
    bands = [structs.replace(band, covariance=None) for band in row.bands]
    old = bands_of_row(structs.replace(row, bands=bands), CHIRP, 4)
    assert old.covariance is None
    np.testing.assert_allclose(old.sigma, 2 * COMMON)
    assert new.covariance.shape == (8, 8)


def test_samples_of_the_posterior_follow_the_valley_of_thickness_times_index():
    """The derivatives are those of the conversion: a small step along the valley is recovered."""
    model = _Model(measure_bands([SHEET, PLATE]), (Layer("sheet"), PLATE), 0, THETA, RANGE)
    x = np.array([3.4, 0.1, 1.7])
    steps = 1e-6 * np.eye(3)
    derivatives = (model._convert_from_straight(x, steps) - x).T / 1e-6
    np.testing.assert_allclose(model._differentiate_straight(x) @ derivatives, np.eye(3), atol=1e-5)
