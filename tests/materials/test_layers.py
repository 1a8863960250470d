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
# Water at 75 GHz, as quoted in section 9.2 of the paper.
WATER = 9.37 - 18.0j
GLASS = Layer("glass", 5.5 - 0.05j, 3e-3)
CHIRP = load_published_rig().chirp
BANDS = Spectrum.from_chirp(CHIRP, 4)


def measure_bands(stack, sigma=1e-4, sigma_h=None, spectrum=BANDS, rng=None):
    """Return data of the stack in each sub-band: V / H, and |H| if its error `sigma_h` is given.

    `sigma` is the standard deviation of each part of V / H. The data are exact unless `rng` draws their errors.
    """
    v_over_h, brightness = predict(stack, spectrum, THETA)
    bands = v_over_h.size
    if rng is not None:
        v_over_h = v_over_h + sigma * (rng.normal(size=bands) + 1j * rng.normal(size=bands))
        brightness = brightness + (sigma_h or 0.0) * rng.normal(size=bands)
    if sigma_h is None:
        return Bands(spectrum, v_over_h, np.full(bands, sigma))
    return Bands(spectrum, v_over_h, np.full(bands, sigma), amplitude_h=brightness, sigma_h=np.full(bands, sigma_h))


def compute_distance_of_nearest_solution(fit, eps):
    """Return how far the fit or the nearest of its rivals is from a permittivity: exact data may have several."""
    solutions = [fit.permittivity, *(rival.permittivity for rival in fit.rivals)]
    return min(abs(solution - eps) for solution in solutions)


def test_a_half_space_is_eq2_and_eq3():
    eps = 3.78 - 0.7j
    v_over_h, _ = predict([Layer("pet", eps)], BANDS, THETA)
    np.testing.assert_allclose(1 / v_over_h, ratio_from_permittivity(eps, THETA), rtol=1e-12)
    fit = fit_layer(measure_bands([Layer("pet", eps)]), [Layer("pet")], THETA)
    assert fit.permittivity == pytest.approx(permittivity_from_ratio(1 / v_over_h[0], THETA), rel=1e-6)


@settings(max_examples=25)
@given(st.floats(2.0, 12.0), st.floats(0.05, 5.0), st.floats(0.3e-3, 4e-3))
def test_a_sheet_of_known_thickness_is_recovered(real, loss, thickness):
    eps = complex(real, -loss)
    bands = measure_bands([Layer("sheet", eps, thickness)])
    fit = fit_layer(bands, [Layer("sheet", thickness_m=thickness)], THETA)
    assert compute_distance_of_nearest_solution(fit, eps) < 1e-3 * abs(eps)


@settings(max_examples=15)
@given(st.floats(3.0, 15.0), st.floats(3.0, 25.0), st.floats(1e-3, 3.5e-3))
def test_a_liquid_behind_a_wall_is_recovered(real, loss, wall):
    eps = complex(real, -loss)
    glass = Layer("glass", 5.5 - 0.05j, wall)
    fit = fit_layer(measure_bands([glass, Layer("liquid", eps)]), [glass, Layer("liquid")], THETA)
    # Less exact than a sheet: the wall reflects much of the wave before the liquid does.
    assert compute_distance_of_nearest_solution(fit, eps) < 1e-2 * abs(eps)


def test_water_behind_glass_is_measured_by_the_stack_where_eq3_is_wrong_by_a_factor():
    """V / H has an error of 0.01, as after calibration: the stack gives water within 10 %, one interface does not."""
    stack = [GLASS, Layer("water", WATER)]
    rng = np.random.default_rng(2)
    estimates = []
    for _ in range(20):
        bands = measure_bands(stack, sigma=0.01, sigma_h=0.03, rng=rng)
        estimates.append(fit_layer(bands, [GLASS, Layer("water")], THETA).permittivity)
    relative_errors_real = np.real(estimates) / WATER.real - 1
    relative_errors_loss = np.imag(estimates) / WATER.imag - 1
    # The root mean square errors are 0.8 % and 0.4 %.
    assert np.sqrt(np.mean(relative_errors_real**2)) < 0.1
    assert np.sqrt(np.mean(relative_errors_loss**2)) < 0.1
    # One interface gives 0.69 + j0.26: a permittivity that no passive dielectric has.
    v_over_h, _ = predict(stack, BANDS, THETA)
    by_one_interface = permittivity_from_ratio(1 / v_over_h.mean(), THETA)
    is_real_part_wrong = by_one_interface.real < WATER.real / 1.5 or by_one_interface.real > WATER.real * 1.5
    is_loss_wrong = abs(by_one_interface.imag) < abs(WATER.imag) / 1.5
    assert is_real_part_wrong or is_loss_wrong


def test_error_bars_are_those_of_repeated_measurements():
    stack = [Layer("pvc", 4.15 - 0.81j, 1.5e-3)]
    unknown = [Layer("pvc", thickness_m=1.5e-3)]
    rng = np.random.default_rng(1)
    fits = [fit_layer(measure_bands(stack, sigma=0.01, rng=rng), unknown, THETA) for _ in range(60)]
    # Some find another solution, with another number of half waves in the sheet: the error bar is that of one solution.
    near = [fit for fit in fits if abs(fit.permittivity - stack[0].permittivity) < 1.0]
    assert len(near) > 50
    # The scatter of 50 draws has an error of 1 / sqrt(2 * 50) = 10 %; 35 % are three of these.
    scatter_real = np.std([fit.permittivity.real for fit in near])
    scatter_loss = np.std([fit.permittivity.imag for fit in near])
    assert scatter_real == pytest.approx(np.median([fit.std_real for fit in near]), rel=0.35)
    assert scatter_loss == pytest.approx(np.median([fit.std_loss for fit in near]), rel=0.35)


def test_error_bars_grow_faster_than_large_noise():
    """Eq. 3 is nearly linear for errors of some per cent, and not for 20 %."""
    pet = Layer("pet", 3.78 - 0.7j)
    stds_over_noise = []
    for noise in (0.02, 0.04, 0.2):
        fit = fit_layer(measure_bands([pet], sigma=noise), [Layer("pet")], THETA)
        stds_over_noise.append(np.array([fit.std_real, fit.std_loss]) / noise)
    small, double, large = stds_over_noise
    np.testing.assert_allclose(double, small, rtol=1e-3)
    # Noise of 20 % has an error bar that is 19 % (loss) and 30 % (real part) larger than in proportion.
    assert (large > 1.15 * small).all()
    assert (large < 1.5 * small).all()


def test_several_permittivities_that_fit_are_reported():
    """The ratio of one narrow band repeats with every half wave in the sheet; the whole sweep distinguishes them."""
    eps = 7.0 - 0.1j
    sheet = [Layer("sheet", thickness_m=2e-3)]
    one_frequency = Spectrum(np.array([[76.3e9]]), np.array([[1.0]]))
    bands = measure_bands([Layer("sheet", eps, 2e-3)], sigma=0.005, spectrum=one_frequency)
    narrow = fit_layer(bands, sheet, THETA)
    assert narrow.ambiguous
    assert any(abs(s.permittivity.real - eps.real) < 3 * s.std_real for s in (narrow, *narrow.rivals))
    assert any("is not excluded" in w for w in narrow.warnings())
    wide = fit_layer(measure_bands([Layer("sheet", eps, 2e-3)], sigma=0.005), sheet, THETA)
    assert not wide.ambiguous
    # The data are exact.
    assert wide.permittivity == pytest.approx(eps)


def test_a_liquid_behind_a_wall_that_absorbs_the_wave_has_a_large_error_bar():
    # On its way through the wall and back the wave is reduced to 6e-9: exp(-4 pi 5 mm 1.16 / 3.84 mm), with 1.16 the
    # imaginary part of sqrt(eps - sin(theta)^2).
    wall = Layer("lossy wall", 6.0 - 6.0j, 5e-3)
    fit = fit_layer(measure_bands([wall, Layer("liquid", WATER)], sigma=0.01), [wall, Layer("liquid")], THETA)
    assert any("large" in w or "as well" in w for w in fit.warnings())


def test_a_large_error_of_the_loss_alone_is_not_called_a_layer_that_the_data_do_not_show():
    fit = LayerFit(
        6.08 - 0.53j, thickness_m=None, std_real=0.47, std_loss=0.49, std_thickness_m=0.0, chi2=0.0, freedom=0
    )
    assert fit.warnings() == ["the data hardly determine the loss of this layer: it is known to +- 0.49"]
    assert replace(fit, std_loss=0.15).warnings() == []
    assert replace(fit, std_real=2.0).warnings() == ["the data hardly depend on this layer: its error bar is large"]


def test_two_solutions_that_fit_equally_are_reported_with_what_would_distinguish_them():
    """More sub-bands, unless the data have degrees of freedom already."""
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
    bands = measure_bands([GLASS, Layer("water", WATER)], sigma=0.003)
    fit = fit_layer(bands, [Layer("sheet", thickness_m=0.2e-3)], THETA)
    assert any("does not explain" in w for w in fit.warnings())


@pytest.mark.parametrize(
    ("stack", "code"),
    [
        # No unknown layer, two of them, and a layer without thickness before another
        ([GLASS], ErrorCode.VALUES_CONFLICT),
        ([Layer("a", thickness_m=1e-3), Layer("b")], ErrorCode.VALUES_CONFLICT),
        ([Layer("a", 2.0), Layer("b")], ErrorCode.KEY_MISSING),
    ],
)
def test_stacks_that_cannot_be_fitted_are_refused(stack, code):
    with expect_refusal(code) as caught:
        fit_layer(measure_bands([GLASS]), stack, THETA)
    assert isinstance(caught.value, ConfigError)


def test_fewer_data_than_unknowns_are_refused():
    bands = measure_bands([Layer("sheet", 3.0, 1e-3)], spectrum=Spectrum.from_chirp(CHIRP, 1))
    # One sub-band has two numbers; unknown are permittivity (two) and thickness.
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA):
        fit_layer(bands, [Layer("sheet", thickness_m=1e-3)], THETA, thickness_range_m=(0.5e-3, 2e-3))


def test_a_solution_at_the_end_of_the_search_range_is_reported():
    fit = fit_layer(measure_bands([Layer("dense", 60 - 2j)]), [Layer("dense")], THETA)
    assert any("at the limit" in words for words in fit.warnings())
    lossless = fit_layer(measure_bands([Layer("clear", 4 - 0j)]), [Layer("clear")], THETA)
    # Zero loss is at the limit too, but a valid result.
    assert not any("at the limit" in words for words in lossless.warnings())


def test_a_misfit_that_one_scan_in_a_thousand_has_is_reported():
    # Chi-square of 7 degrees of freedom is above 24.4 with a probability of 0.97e-3, above 24.0 with 1.14e-3.
    fit = LayerFit(
        permittivity=4 - 0.4j, thickness_m=3e-3, std_real=0.03, std_loss=0.03, std_thickness_m=0.0, chi2=24.4, freedom=7
    )
    assert any("does not explain" in words for words in fit.warnings())
    assert not any("does not explain" in words for words in replace(fit, chi2=24.0).warnings())


def test_a_misfit_keeps_the_rivals_that_the_stated_errors_would_exclude():
    """Data with an error of 8 % that is stated, or that is not: then error bars are stretched until the data fit."""
    v_over_h, _ = predict([Layer("sheet", 4 - 0.1j, 3e-3)], BANDS, THETA)
    unknown = [Layer("sheet", thickness_m=3e-3)]
    stated_error = Bands(BANDS, v_over_h * 1.08, sigma=np.full(v_over_h.size, 0.02))
    unstated_error = replace(stated_error, sigma=np.full(v_over_h.size, 0.002))
    fit = fit_layer(stated_error, unknown, THETA)
    misfit = fit_layer(unstated_error, unknown, THETA)
    assert fit.stretch == 1
    # The error bars become 4.9 times as large.
    assert misfit.stretch > 2
    # By the unstretched errors the rival would be excluded by three standard deviations.
    assert misfit.rivals[0].chi2 - misfit.chi2 > 9
    assert misfit.rivals[0].permittivity == pytest.approx(fit.rivals[0].permittivity, rel=1e-3)


# Below vacuum, gain, and beyond any dielectric in real part and loss
@pytest.mark.parametrize("eps", [0.5 + 0j, 4 + 0.5j, 1e9 + 0j, 4 - 1e9j])
def test_a_known_layer_whose_permittivity_no_passive_dielectric_has_is_refused(eps):
    with expect_refusal(ErrorCode.VALUE_INVALID):
        check_stack([Layer("a", eps, 1e-3), Layer("b")])


def test_a_range_of_thickness_too_wide_to_distinguish_solutions_is_refused():
    check_range((0.5e-3, 20e-3))
    with expect_refusal(ErrorCode.VALUE_INVALID, "1000 mm"):
        check_range((0.5e-3, 1.0))
