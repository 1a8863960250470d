"""A layer within a stack: its parameters are recovered, error bars are right, and ambiguity is reported."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig

from polysight.materials.layers import Bands, Layer, LayerFit, Spectrum, check_range, check_stack, fit_layer, predict
from polysight.polarimetry import permittivity_from_ratio, ratio_from_permittivity
from polysight_shared.errors import ConfigError, ErrorCode

THETA = np.radians(55.0)
WATER = 9.37 - 18.0j
GLASS = Layer("glass", 5.5 - 0.05j, 3e-3)
CHIRP = load_published_rig().chirp
BANDS = Spectrum.from_chirp(CHIRP, 4)


def measure_bands(stack, sigma=1e-4, sigma_h=None, spectrum=BANDS, rng=None):
    q, h = predict(stack, spectrum, THETA)
    k = q.size
    if rng is not None:
        q = q + sigma * (rng.normal(size=k) + 1j * rng.normal(size=k))
        h = h + (sigma_h or 0.0) * rng.normal(size=k)
    if sigma_h is None:
        return Bands(spectrum, q, np.full(k, sigma))
    return Bands(spectrum, q, np.full(k, sigma), h, np.full(k, sigma_h))


def test_a_half_space_is_eq2_and_eq3():
    eps = 3.78 - 0.7j
    q, _ = predict([Layer("pet", eps)], BANDS, THETA)
    np.testing.assert_allclose(1 / q, ratio_from_permittivity(eps, THETA), rtol=1e-12)
    fit = fit_layer(measure_bands([Layer("pet", eps)]), [Layer("pet")], THETA)
    assert fit.permittivity == pytest.approx(permittivity_from_ratio(1 / q[0], THETA), rel=1e-6)


@settings(max_examples=25)
@given(st.floats(2.0, 12.0), st.floats(0.05, 5.0), st.floats(0.3e-3, 4e-3))
def test_a_sheet_of_known_thickness_is_recovered(real, loss, thickness):
    eps = complex(real, -loss)
    fit = fit_layer(measure_bands([Layer("sheet", eps, thickness)]), [Layer("sheet", None, thickness)], THETA)
    candidates = [fit.permittivity, *(r.permittivity for r in fit.rivals)]
    assert min(abs(c - eps) for c in candidates) < 1e-3 * abs(eps)


@settings(max_examples=15)
@given(st.floats(3.0, 15.0), st.floats(3.0, 25.0), st.floats(1e-3, 3.5e-3))
def test_a_liquid_behind_a_wall_is_recovered(real, loss, wall):
    glass = Layer("glass", 5.5 - 0.05j, wall)
    fit = fit_layer(measure_bands([glass, Layer("liquid", complex(real, -loss))]), [glass, Layer("liquid")], THETA)
    candidates = [fit.permittivity, *(r.permittivity for r in fit.rivals)]
    assert min(abs(c - complex(real, -loss)) for c in candidates) < 1e-2 * abs(complex(real, -loss))


def test_water_behind_glass_where_eq3_is_off_by_a_factor():
    """One percent of the ratio, as after calibration: the stack gives water within 10 %, one interface does not."""
    stack = [GLASS, Layer("water", WATER)]
    rng = np.random.default_rng(2)
    fits = [
        fit_layer(measure_bands(stack, 0.01, 0.03, rng=rng), [GLASS, Layer("water")], THETA).permittivity
        for _ in range(20)
    ]
    assert np.sqrt(np.mean([(f.real / 9.37 - 1) ** 2 for f in fits])) < 0.1
    assert np.sqrt(np.mean([(f.imag / -18.0 - 1) ** 2 for f in fits])) < 0.1
    q, _ = predict(stack, BANDS, THETA)
    single = permittivity_from_ratio(1 / q.mean(), THETA)
    assert single.real < 9.37 / 1.5 or single.real > 9.37 * 1.5 or abs(single.imag) < 18 / 1.5


def test_error_bars_are_those_of_repeated_measurements():
    stack = [Layer("pvc", 4.15 - 0.81j, 1.5e-3)]
    unknown = [Layer("pvc", None, 1.5e-3)]
    rng = np.random.default_rng(1)
    fits = [fit_layer(measure_bands(stack, 0.01, rng=rng), unknown, THETA) for _ in range(60)]
    near = [f for f in fits if abs(f.permittivity - stack[0].permittivity) < 1.0]
    assert len(near) > 50
    for value, claimed in (
        ([f.permittivity.real for f in near], [f.std_real for f in near]),
        ([-f.permittivity.imag for f in near], [f.std_loss for f in near]),
    ):
        assert np.std(value) == pytest.approx(np.median(claimed), rel=0.35)


def test_error_bars_grow_faster_than_the_noise_where_the_posterior_is_bent():
    """Eq. 3 is nearly linear for errors of some per cent, and not for 20 %."""
    pet = Layer("pet", 3.78 - 0.7j)
    stds_over_noise = []
    for noise in (0.02, 0.04, 0.2):
        fit = fit_layer(measure_bands([pet], noise), [Layer("pet")], THETA)
        stds_over_noise.append(np.array([fit.std_real, fit.std_loss]) / noise)
    small, double, large = stds_over_noise
    np.testing.assert_allclose(double, small, rtol=1e-3)
    assert (large > 1.15 * small).all()
    assert (large < 1.5 * small).all()


def test_ambiguity_is_reported():
    """The ratio of one narrow band repeats with every half wave in the sheet; the whole sweep distinguishes them."""
    eps = 7.0 - 0.1j
    sheet = [Layer("sheet", None, 2e-3)]
    band = Spectrum(np.array([[76.3e9]]), np.array([[1.0]]))
    narrow = fit_layer(measure_bands([Layer("sheet", eps, 2e-3)], 0.005, spectrum=band), sheet, THETA)
    assert narrow.ambiguous
    assert any(abs(s.permittivity.real - eps.real) < 3 * s.std_real for s in (narrow, *narrow.rivals))
    assert any("is not excluded" in w for w in narrow.warnings())
    wide = fit_layer(measure_bands([Layer("sheet", eps, 2e-3)], 0.005), sheet, THETA)
    assert not wide.ambiguous
    assert abs(wide.permittivity - eps) < 1e-3


def test_what_the_wave_does_not_reach_has_a_large_error_bar():
    wall = Layer("lossy wall", 6.0 - 6.0j, 5e-3)
    fit = fit_layer(measure_bands([wall, Layer("liquid", WATER)], 0.01), [wall, Layer("liquid")], THETA)
    assert any("large" in w or "as well" in w for w in fit.warnings())


def test_a_layer_before_which_nothing_lies_is_not_called_hidden_for_a_large_error_of_its_loss():
    fit = LayerFit(
        6.08 - 0.53j, thickness_m=None, std_real=0.47, std_loss=0.49, std_thickness_m=0.0, chi2=0.0, freedom=0
    )
    assert fit.warnings() == ["the data hardly tell the loss of this layer: it is known to +- 0.49"]
    assert replace(fit, std_loss=0.15).warnings() == []
    assert replace(fit, std_real=2.0).warnings() == ["the data hardly depend on this layer: its error bar is large"]


def test_as_many_unknowns_as_numbers_are_reported_with_the_missing_measurements():
    rival = LayerFit(
        6.11 - 1.58j, thickness_m=0.96e-3, std_real=0.1, std_loss=0.1, std_thickness_m=1e-5, chi2=0.02, freedom=0
    )
    fit = replace(rival, permittivity=6.28 - 1.22j, thickness_m=1.74e-3, chi2=0.01, rivals=(rival,))
    warnings = fit.warnings()
    assert any("--bands 4" in words for words in warnings)
    assert not any("degrees of freedom" in words for words in warnings)
    assert any("9 degrees of freedom" in words for words in replace(fit, freedom=9).warnings())
    assert not any("--bands" in words for words in replace(fit, freedom=9).warnings())


def test_a_stack_that_is_not_the_one_measured_is_noticed():
    bands = measure_bands([GLASS, Layer("water", WATER)], 0.003)
    fit = fit_layer(bands, [Layer("sheet", None, 0.2e-3)], THETA)
    assert any("does not explain" in w for w in fit.warnings())


@pytest.mark.parametrize(
    ("stack", "code"),
    [
        ([GLASS], ErrorCode.VALUES_CONFLICT),
        ([Layer("a", None, 1e-3), Layer("b")], ErrorCode.VALUES_CONFLICT),
        ([Layer("a", 2.0), Layer("b")], ErrorCode.KEY_MISSING),
    ],
)
def test_stacks_that_cannot_be_fitted_are_refused(stack, code):
    with expect_refusal(code) as caught:
        fit_layer(measure_bands([GLASS]), stack, THETA)
    assert isinstance(caught.value, ConfigError)


def test_fewer_data_than_unknowns_are_refused():
    bands = measure_bands([Layer("sheet", 3.0, 1e-3)], spectrum=Spectrum.from_chirp(CHIRP, 1))
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA):
        fit_layer(bands, [Layer("sheet", None, 1e-3)], THETA, (0.5e-3, 2e-3))


def test_a_solution_at_the_end_of_the_search_range_is_reported():
    fit = fit_layer(measure_bands([Layer("dense", 60 - 2j)]), [Layer("dense")], THETA)
    assert any("at the limit" in words for words in fit.warnings())
    lossless = fit_layer(measure_bands([Layer("clear", 4 - 0j)]), [Layer("clear")], THETA)
    assert not any("at the limit" in words for words in lossless.warnings())  # zero loss is a valid result


def test_a_misfit_of_one_scan_in_a_thousand_is_reported_and_its_rivals_are_kept():
    # Probability 0.97e-3
    fit = LayerFit(
        permittivity=4 - 0.4j, thickness_m=3e-3, std_real=0.03, std_loss=0.03, std_thickness_m=0.0, chi2=24.4, freedom=7
    )
    assert any("does not explain" in words for words in fit.warnings())
    assert not any("does not explain" in words for words in replace(fit, chi2=24.0).warnings())
    # Two sheets that the data distinguish only as far as the model fits them.
    sheet = [Layer("sheet", 4 - 0.1j, 3e-3)]
    q, _ = predict(sheet, BANDS, THETA)
    stiff = fit_layer(Bands(BANDS, q * 1.08, np.full(q.size, 0.02)), [Layer("sheet", None, 3e-3)], THETA)
    loose = fit_layer(Bands(BANDS, q * 1.08, np.full(q.size, 0.002)), [Layer("sheet", None, 3e-3)], THETA)
    assert stiff.stretch == 1
    assert loose.stretch > 2
    # It is kept nevertheless
    assert loose.rivals[0].chi2 - loose.chi2 > 9
    assert loose.rivals[0].permittivity == pytest.approx(stiff.rivals[0].permittivity, rel=1e-3)


@pytest.mark.parametrize("eps", [0.5 + 0j, 4 + 0.5j, 1e9 + 0j, 4 - 1e9j])
def test_a_known_layer_that_no_passive_material_is(eps):
    with expect_refusal(ErrorCode.VALUE_INVALID):
        check_stack([Layer("a", eps, 1e-3), Layer("b")])


def test_a_range_of_thickness_too_wide_to_distinguish_solutions_is_refused():
    check_range((0.5e-3, 20e-3))
    with expect_refusal(ErrorCode.VALUE_INVALID, "1000 mm"):
        check_range((0.5e-3, 1.0))
