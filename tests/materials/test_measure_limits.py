"""What makes a patch a flat plate, at each limit; scatter, relief and errors of drawn pixels."""

from typing import Any

import numpy as np
import pytest

from polysight.materials.measure import (
    Scatter,
    _measure_relief,
    check_patch,
    find_usual_scatter,
    measure_difference_of_halves,
    measure_patch,
    measure_scatter,
    ratio_sigma,
    relative_errors,
)
from polysight.materials.segment import Patch

SHAPE = (30, 40)
X_M = np.arange(40) * 2e-3
Y_M = np.arange(30) * 2e-3
# 20 x 10 pixels
INSIDE = np.zeros(SHAPE, bool)
INSIDE[10:20, 10:30] = True
ROWS, COLUMNS = np.nonzero(INSIDE)
CHEQUERED = np.where((np.add.outer(np.arange(30), np.arange(40)) % 2) == 0, 1.0, -1.0)


def make_patch(interior: np.ndarray = INSIDE, **changes: Any) -> Patch:
    fields: dict[str, Any] = {
        "label": 1, "box_mm": (0.0, 0.0, 1.0, 1.0), "outline_mm": np.zeros((0, 2)), "pixels": int(interior.sum()),
        "mask": interior, "interior": interior,
    }  # fmt: skip
    return Patch(**(fields | changes))


def explain(h: Any, v: Any, dark: tuple[float, float] = (np.nan, np.nan), uneven: float = 0.0, **changes: Any) -> str:
    """Why an image of H and V is not that of a plate; "" if it may be one."""
    ones = np.ones(SHAPE, complex)
    finding = check_patch(make_patch(**changes), h * ones, v * ones, dark, uneven)
    return "" if finding is None else f"{finding.what}: {finding.why}"


def test_a_uniform_patch_is_a_plate_and_one_that_is_cut_or_dark_is_not():
    assert explain(1.0, 0.8) == ""
    assert "cut by the border" in explain(1.0, 0.8, cut=True)
    assert "no signal" in explain(0.0, 0.8)


@pytest.mark.parametrize(("pixels", "is_enough"), [(12, True), (11, False)])
def test_a_patch_has_at_least_twelve_pixels(pixels, is_enough):
    interior = np.zeros(SHAPE, bool)
    interior[5, :pixels] = True
    text = explain(1.0, 0.8, interior=interior)
    assert text == ("" if is_enough else f"too few pixels: {pixels} lie inside its edges")
    # Pixels without a value do not count.
    h = np.ones(SHAPE, complex)
    h[5, 0] = np.nan
    interior[5, :13] = True
    assert explain(h, 0.8, interior=interior) == ""
    h[5, 1] = np.nan
    assert "11 lie inside" in explain(h, 0.8, interior=interior)


@pytest.mark.parametrize(("contrast", "is_flat"), [(0.39, True), (0.41, False)])
def test_a_plate_varies_in_brightness_by_less_than_two_fifths(contrast, is_flat):
    level = 1 + contrast * CHEQUERED
    assert ("noise or speckle" in explain(level, 0.8 * level)) != is_flat


@pytest.mark.parametrize(("background", "is_bright"), [(0.49, True), (0.51, False)])
def test_a_plate_is_twice_as_bright_as_the_background(background, is_bright):
    assert ("as dark as" in explain(1.0, 0.8, (background, np.nan))) != is_bright


@pytest.mark.parametrize(
    ("coherence", "level", "noise", "agrees"),
    [
        (0.71, 0.8, 0.0, True), (0.69, 0.8, 0.0, False),
        # Where V nearly vanishes, or is hardly above its noise, its phase says nothing.
        (0.1, 0.119, 0.0, True), (0.1, 0.121, 0.0, False), (0.1, 0.8, 0.401, True), (0.1, 0.8, 0.399, False),
    ],
)  # fmt: skip
def test_h_and_v_of_a_plate_agree_in_phase(coherence, level, noise, agrees):
    v = level * np.exp(1j * np.arccos(coherence) * CHEQUERED)
    assert ("H and V do not agree" in explain(1.0, v, (0.0, noise))) != agrees


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(
    ("step", "uneven", "is_one"),
    [
        # 0.07 x (1 + 2 x 0.5)
        (0.139, 0.0, True), (0.141, 0.0, False),
        # As much as the metal's own halves differ, if that is more
        (0.199, 0.1, True), (0.201, 0.1, False), (0.141, 0.06, False),
    ],
)  # fmt: skip
def test_halves_of_a_plate_have_one_ratio(axis, step, uneven, is_one):
    place = np.broadcast_to((np.arange(30) >= 15)[:, None] if axis == 0 else np.arange(40) >= 20, SHAPE)
    # The median of |V| is 0.5 as half of the pixels have it.
    v = 0.5 * np.exp(2j * np.where(place, 1, -1) * np.arcsin(step) / 2)
    assert measure_difference_of_halves(np.ones(SHAPE, complex), v, INSIDE) == pytest.approx(step)
    assert ("halves have different ratios" in explain(1.0, v, uneven=uneven)) != is_one


def test_halves_may_differ_by_noise():
    """22 times the noise over the root of 200 pixels: 0.156 for a tenth; without noise 0.14 are too much."""
    v = 0.5 * np.exp(1j * np.where(np.arange(40) >= 20, 1, -1) * np.arcsin(0.2))
    assert measure_difference_of_halves(np.ones(SHAPE, complex), v * np.ones(SHAPE), INSIDE) == pytest.approx(0.2)
    allowed = np.hypot(0.14, 22 * 0.1 / 200**0.5)
    assert allowed > 0.2
    assert explain(1.0, v, (0.0, 0.1)) == ""
    assert "halves" in explain(1.0, v, (0.0, 0.09))


def test_few_pixels_have_no_halves():
    values = np.ones(SHAPE, complex)
    v = values * np.where(np.arange(40) >= 12, 2, 1)
    few = np.zeros(SHAPE, bool)
    few[3, 6:17] = True
    assert measure_difference_of_halves(values, v, few) == 0.0
    few[3, 17] = True
    assert measure_difference_of_halves(values, v, few) == pytest.approx(1.0)
    assert measure_difference_of_halves(values, v, np.zeros(SHAPE, bool)) == 0.0
    assert measure_difference_of_halves(0 * values, v, few) == 0.0


@pytest.mark.parametrize(
    ("odd_pixels", "ratio_of_odd", "noise", "is_one"),
    [
        # Of 200 pixels 15 % may be odd, by 0.15 or half of the usual ratio.
        (30, 0.0, 0.0, True), (31, 0.0, 0.0, False), (60, 0.151, 0.0, True), (60, 0.149, 0.0, False),
        # And twice the noise
        (60, 0.06, 0.1, True), (60, 0.04, 0.1, False),
    ],
)  # fmt: skip
def test_a_plate_has_few_odd_pixels(odd_pixels, ratio_of_odd, noise, is_one):
    v = np.full(SHAPE, 0.3, complex)
    # Every third pixel, so that halves are alike
    v[ROWS[::3][:odd_pixels], COLUMNS[::3][:odd_pixels]] = ratio_of_odd
    assert ("pixels have another ratio" in explain(1.0, v, (0.0, noise))) != is_one


def draw_ratio(amplitude: float, phase: float, slope: tuple[complex, complex] = (0.0, 0.0)) -> np.ndarray:
    """V / H of 0.5 with this scatter of its logarithm, and a change per metre along x and y."""
    rng = np.random.default_rng(3)
    noise = amplitude * rng.standard_normal(SHAPE) + 1j * phase * rng.standard_normal(SHAPE)
    return 0.5 * np.exp(noise + slope[0] * (X_M - 0.039) + slope[1] * (Y_M[:, None] - 0.029))


def test_scatter_is_that_of_amplitude_and_phase():
    everywhere = np.ones(SHAPE, bool)
    scatter = measure_scatter(everywhere, np.ones(SHAPE, complex), draw_ratio(0.03, 0.05), X_M, Y_M)
    assert scatter is not None
    assert (scatter.amplitude, scatter.phase) == pytest.approx((0.03, 0.05), rel=0.08)
    # 1200 pixels of 4 mm^2 in places of 12 mm
    assert scatter.blocks == pytest.approx(1200 * 4 / 144)
    assert scatter.centre_m == pytest.approx((0.039, 0.029))
    assert scatter.level == pytest.approx(0.5, rel=0.01)
    assert scatter.relief_rad == pytest.approx(0.0, abs=1e-9)
    # A slope's error from so many independent places, each with the scatter
    for axis_m, std in ((X_M, scatter.slope_std[0]), (Y_M, scatter.slope_std[1])):
        expected = 1 / np.sqrt(scatter.blocks) / np.std(axis_m)
        assert (std.real, std.imag) == pytest.approx((0.03 * expected, 0.05 * expected), rel=0.1)


def test_a_slope_over_a_plate_is_found():
    ratio = draw_ratio(0.001, 0.001, (1.0 - 2.0j, -0.5 + 1.5j))
    scatter = measure_scatter(np.ones(SHAPE, bool), np.ones(SHAPE, complex), ratio, X_M, Y_M)
    assert scatter is not None
    np.testing.assert_allclose(scatter.slope, (1.0 - 2.0j, -0.5 + 1.5j), rtol=0.05)


def test_a_plate_of_few_or_dark_pixels_has_no_scatter():
    ones = np.ones(SHAPE, complex)
    few = np.zeros(SHAPE, bool)
    few[4, :11] = True
    assert measure_scatter(few, ones, 0.5 * ones, X_M, Y_M) is None
    few[4, 11] = True
    scatter = measure_scatter(few, ones, 0.5 * ones, X_M, Y_M)
    assert scatter is not None
    # One place at least
    assert scatter.blocks == 1.0
    assert measure_scatter(few, ones, 0 * ones, X_M, Y_M) is None
    assert measure_scatter(few, 0 * ones, ones, X_M, Y_M) is None


def test_a_tilt_is_no_relief():
    places = np.stack([X_M[COLUMNS], Y_M[ROWS]], axis=1)
    places -= places.mean(axis=0)
    phase = places @ (10.0, -5.0)
    assert _measure_relief(np.exp(1j * (phase + 2)), places) == pytest.approx(0.0, abs=1e-9)
    wavy = 0.2 * CHEQUERED[INSIDE]
    assert _measure_relief(np.exp(1j * (phase + wavy)), places) == pytest.approx(0.2, rel=0.01)


def make_scatter(amplitude: float, phase: float, blocks: float) -> Scatter:
    zero = np.zeros(2, complex)
    return Scatter(amplitude, phase, blocks, zero, zero, (0.0, 0.0))


def test_errors_of_a_mean_fall_with_the_places_of_a_plate():
    """A plate's scatter counts as often as it has places, the usual one twice."""
    assert relative_errors(None, (0.04, 0.08)) == pytest.approx((0.85 * 0.04, 0.75 * 0.08))
    amplitude, phase = relative_errors(make_scatter(0.01, 0.02, 8.0), (0.04, 0.08))
    variance = (2 * 0.04**2 + 8 * 0.01**2) / 10
    assert amplitude == pytest.approx(0.85 * (variance / 8) ** 0.5)
    assert phase == pytest.approx(0.75 * (4 * variance / 8) ** 0.5)
    plates = [make_scatter(0.01, 0.05, 1), make_scatter(0.02, 0.01, 1), make_scatter(0.09, 0.02, 1)]
    assert find_usual_scatter(plates) == (0.02, 0.02)
    assert find_usual_scatter([]) == (0.0, 0.0)


def test_a_patch_is_measured_with_all_its_errors():
    v = np.full(SHAPE, 0.5 - 0.1j)
    h = np.full(SHAPE, 0.8 + 0j)
    plain = measure_patch(make_patch(), h, v, theta_rad=0.7)
    assert plain.inverse_ratio == pytest.approx((0.5 - 0.1j) / 0.8)
    assert (plain.relative_std, plain.rise) == ((0.0, 0.0), (0.0, 0.0))
    changed = measure_patch(
        make_patch(), h, v, theta_rad=0.7, usual=(0.04, 0.08), change=(0.2 + 0.1j, (0.03, 0.05)), local_std=(0.01, 0.02)
    )
    assert changed.inverse_ratio == pytest.approx((0.5 - 0.1j) / 0.8 * np.exp(-0.2 - 0.1j))
    assert (changed.std, changed.theta_rad, changed.brightness) == pytest.approx((0.6e-3, 0.7, 0.8))
    assert changed.relative_std == pytest.approx(
        (
            (0.034**2 + 0.03**2 + 0.01**2) ** 0.5,
            (0.06**2 + 0.05**2 + 0.02**2) ** 0.5,
        )
    )


def test_the_error_of_a_ratio_is_that_of_the_background_and_what_is_systematic():
    """d(1/P) of noise in V and H, each part, and dP = P^2 d(1/P)."""
    h = np.array([[2.0, 2.0, 2.0, np.nan, 1.0]], complex)
    v = np.array([[1.0, 1.0j, 4.0, 1.0, np.inf]], complex)
    systematic = np.array([[0.0, 0.03, 0.0, 0.0, 0.0]])
    sigma = ratio_sigma(h, v, (0.1, 0.2), systematic)
    noise = np.hypot(0.2, 0.5 * 0.1) / 2 / 2**0.5
    assert sigma[0, 0] == pytest.approx(noise * 4)
    assert sigma[0, 1] == pytest.approx(np.hypot(noise, 0.03) * 4)
    assert sigma[0, 2] == pytest.approx(np.hypot(0.2, 2 * 0.1) / 2 / 2**0.5 / 4)
    assert np.isnan(sigma[0, 3:]).all()
    assert sigma.dtype == np.float32
    # Without a background only the systematic part is known.
    assert ratio_sigma(h, v, (np.nan, np.nan), systematic)[0, 1] == pytest.approx(0.03 * 4)
