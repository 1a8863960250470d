"""The limits within which a patch counts as a flat plate, and the scatter, relief and errors of its pixels."""

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

# Images of 30 rows and 40 columns of pixels of 2 mm. Numbers in the cases of this file lie just on either side of a
# limit of `measure.py`.
SHAPE = (30, 40)
X_M = np.arange(40) * 2e-3
Y_M = np.arange(30) * 2e-3
# A patch of 20 x 10 pixels
INSIDE = np.zeros(SHAPE, bool)
INSIDE[10:20, 10:30] = True
ROWS, COLUMNS = np.nonzero(INSIDE)
# +1 and -1 in turn, as on a chessboard: half of the pixels in any part of the image have either value.
CHEQUERED = np.where((np.add.outer(np.arange(30), np.arange(40)) % 2) == 0, 1.0, -1.0)


def make_patch(interior: np.ndarray = INSIDE, **changes: Any) -> Patch:
    fields: dict[str, Any] = {
        "label": 1, "box_mm": (0.0, 0.0, 1.0, 1.0), "outline_mm": np.zeros((0, 2)), "pixels": int(interior.sum()),
        "mask": interior, "interior": interior,
    }  # fmt: skip
    return Patch(**(fields | changes))


def explain(h: Any, v: Any, dark: tuple[float, float] = (np.nan, np.nan), uneven: float = 0.0, **changes: Any) -> str:
    """Return why an image of H and V is not that of a plate; "" if it may be one.

    `dark` is the amplitude of the background in H and in V, NaN if it is not known. `uneven` is how much V / H of the
    metal's two halves differs.
    """
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
    is_called_dark = "as dark as" in explain(1.0, 0.8, dark=(background, np.nan))
    assert is_called_dark != is_bright


@pytest.mark.parametrize(
    ("coherence", "level", "noise", "agrees"),
    [
        (0.71, 0.8, 0.0, True), (0.69, 0.8, 0.0, False),
        # Where V is below 0.12 of H, or below twice its noise (0.8 < 2 * 0.401), its phase is not used.
        (0.1, 0.119, 0.0, True), (0.1, 0.121, 0.0, False), (0.1, 0.8, 0.401, True), (0.1, 0.8, 0.399, False),
    ],
)  # fmt: skip
def test_h_and_v_of_a_plate_agree_in_phase(coherence, level, noise, agrees):
    # Half of the pixels are turned one way and half the other: the mean of exp(+- j phi) is cos(phi).
    v = level * np.exp(1j * np.arccos(coherence) * CHEQUERED)
    is_refused = "H and V do not agree" in explain(1.0, v, dark=(0.0, noise))
    assert is_refused != agrees


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(
    ("step", "uneven", "is_accepted"),
    [
        # Allowed is 0.07 * (1 + 2 |V / H|) = 0.07 * (1 + 2 * 0.5) = 0.14,
        (0.139, 0.0, True), (0.141, 0.0, False),
        # or as much as the metal's own halves differ, times the same factor 2, if that is more.
        (0.199, 0.1, True), (0.201, 0.1, False), (0.141, 0.06, False),
    ],
)  # fmt: skip
def test_halves_of_a_plate_have_one_ratio(axis, step, uneven, is_accepted):
    if axis == 0:
        is_second_half = (np.arange(30) >= 15)[:, None]
    else:
        is_second_half = np.arange(40) >= 20
    sign = np.broadcast_to(np.where(is_second_half, 1, -1), SHAPE)
    # V / H is 0.5 exp(+- j phi) in the two halves: they differ by 2 * 0.5 * sin(phi).
    v = 0.5 * np.exp(1j * sign * np.arcsin(step))
    assert measure_difference_of_halves(np.ones(SHAPE, complex), v, INSIDE) == pytest.approx(step)
    is_refused = "halves have different ratios" in explain(1.0, v, uneven=uneven)
    assert is_refused != is_accepted


def test_halves_may_differ_by_noise():
    """Allowed are 0.14 without noise, as above, and in addition 22 times the noise over the root of 200 pixels.

    That is sqrt(0.14^2 + 0.156^2) = 0.209 with a noise of 0.1, and 0.198 with 0.09.
    """
    sign = np.where(np.arange(40) >= 20, 1, -1)
    v = 0.5 * np.exp(1j * sign * np.arcsin(0.2))
    assert measure_difference_of_halves(np.ones(SHAPE, complex), v * np.ones(SHAPE), INSIDE) == pytest.approx(0.2)
    allowed = np.hypot(0.14, 22 * 0.1 / 200**0.5)
    assert allowed > 0.2
    assert explain(1.0, v, dark=(0.0, 0.1)) == ""
    assert "halves" in explain(1.0, v, dark=(0.0, 0.09))


def test_halves_are_compared_from_twelve_pixels_on():
    h = np.ones(SHAPE, complex)
    # V / H is 1 left of column 12 and 2 right of it, in the middle of columns 6 to 17.
    v = h * np.where(np.arange(40) >= 12, 2, 1)
    few_pixels = np.zeros(SHAPE, bool)
    few_pixels[3, 6:17] = True
    assert measure_difference_of_halves(h, v, few_pixels) == 0.0
    few_pixels[3, 17] = True
    assert measure_difference_of_halves(h, v, few_pixels) == pytest.approx(1.0)
    # No pixels, and none with a signal
    assert measure_difference_of_halves(h, v, np.zeros(SHAPE, bool)) == 0.0
    assert measure_difference_of_halves(0 * h, v, few_pixels) == 0.0


@pytest.mark.parametrize(
    ("odd_pixels", "ratio_of_odd", "noise", "is_accepted"),
    [
        # Of 200 pixels 15 %, 30, may be odd. The usual ratio is 0.3: a pixel is odd that differs by more than half of
        # it, 0.15,
        (30, 0.0, 0.0, True), (31, 0.0, 0.0, False), (60, 0.151, 0.0, True), (60, 0.149, 0.0, False),
        # or with noise by more than sqrt(0.15^2 + (2 * 0.1)^2) = 0.25.
        (60, 0.06, 0.1, True), (60, 0.04, 0.1, False),
    ],
)  # fmt: skip
def test_a_plate_has_few_odd_pixels(odd_pixels, ratio_of_odd, noise, is_accepted):
    v = np.full(SHAPE, 0.3, complex)
    # Every third pixel is odd, so that both halves of the patch are alike.
    odd_rows = ROWS[::3][:odd_pixels]
    odd_columns = COLUMNS[::3][:odd_pixels]
    v[odd_rows, odd_columns] = ratio_of_odd
    is_refused = "pixels have another ratio" in explain(1.0, v, dark=(0.0, noise))
    assert is_refused != is_accepted


def draw_ratio(amplitude: float, phase: float, slope: tuple[complex, complex] = (0.0, 0.0)) -> np.ndarray:
    """Return V / H of 0.5 with this scatter of its logarithm, which changes by `slope` per metre along x and y."""
    rng = np.random.default_rng(3)
    noise = amplitude * rng.standard_normal(SHAPE) + 1j * phase * rng.standard_normal(SHAPE)
    # The middle of the image is at 39 and 29 mm.
    return 0.5 * np.exp(noise + slope[0] * (X_M - 0.039) + slope[1] * (Y_M[:, None] - 0.029))


def test_scatter_is_that_of_amplitude_and_phase():
    everywhere = np.ones(SHAPE, bool)
    scatter = measure_scatter(everywhere, np.ones(SHAPE, complex), draw_ratio(0.03, 0.05), X_M, Y_M)
    assert scatter is not None
    # The scatter of 1200 pixels, from the median deviation, has an error of 1.17 / sqrt(1200) = 3.4 %.
    assert (scatter.amplitude, scatter.phase) == pytest.approx((0.03, 0.05), rel=0.08)
    # Independent places of 12 x 12 mm: 1200 pixels of 4 mm^2
    assert scatter.blocks == pytest.approx(1200 * 4 / 144)
    assert scatter.centre_m == pytest.approx((0.039, 0.029))
    assert scatter.level == pytest.approx(0.5, rel=0.01)
    assert scatter.relief_rad == pytest.approx(0.0, abs=1e-9)
    # Error of the slope of a straight line through as many values as there are independent places, with this scatter
    for axis_m, std in ((X_M, scatter.slope_std[0]), (Y_M, scatter.slope_std[1])):
        std_per_scatter = 1 / np.sqrt(scatter.blocks) / np.std(axis_m)
        assert (std.real, std.imag) == pytest.approx((0.03 * std_per_scatter, 0.05 * std_per_scatter), rel=0.1)


def test_a_slope_over_a_plate_is_found():
    ratio = draw_ratio(0.001, 0.001, (1.0 - 2.0j, -0.5 + 1.5j))
    scatter = measure_scatter(np.ones(SHAPE, bool), np.ones(SHAPE, complex), ratio, X_M, Y_M)
    assert scatter is not None
    np.testing.assert_allclose(scatter.slope, (1.0 - 2.0j, -0.5 + 1.5j), rtol=0.05)


def test_a_plate_of_few_or_dark_pixels_has_no_scatter():
    ones = np.ones(SHAPE, complex)
    pixels = np.zeros(SHAPE, bool)
    pixels[4, :11] = True
    assert measure_scatter(pixels, ones, 0.5 * ones, X_M, Y_M) is None
    # Twelve pixels are enough, 48 mm^2: less than an independent place of 144 mm^2 counts as one.
    pixels[4, 11] = True
    scatter = measure_scatter(pixels, ones, 0.5 * ones, X_M, Y_M)
    assert scatter is not None
    assert scatter.blocks == 1.0
    assert measure_scatter(pixels, ones, 0 * ones, X_M, Y_M) is None
    assert measure_scatter(pixels, 0 * ones, ones, X_M, Y_M) is None


def test_the_phase_of_a_tilted_plane_is_not_relief():
    places = np.stack([X_M[COLUMNS], Y_M[ROWS]], axis=1)
    places -= places.mean(axis=0)
    # Radians per metre along x and y, and any constant
    tilt_phase = places @ (10.0, -5.0) + 2
    assert _measure_relief(np.exp(1j * tilt_phase), places) == pytest.approx(0.0, abs=1e-9)
    relief_phase = 0.2 * CHEQUERED[INSIDE]
    assert _measure_relief(np.exp(1j * (tilt_phase + relief_phase)), places) == pytest.approx(0.2, rel=0.01)


def make_scatter(amplitude: float, phase: float, blocks: float) -> Scatter:
    """Return the scatter of a plate without slopes, with this number of independent places (`blocks`)."""
    zero = np.zeros(2, complex)
    return Scatter(amplitude, phase, blocks, zero, zero, (0.0, 0.0))


def test_errors_of_a_mean_fall_with_the_places_of_a_plate():
    """The variance is a mean: the plate's own counts once for each of its places, the usual one of all plates twice."""
    usual = (0.04, 0.08)
    # 0.85 and 0.75 are measured factors of the error of a mean over its scatter (`measure.py`).
    assert relative_errors(None, usual) == pytest.approx((0.85 * 0.04, 0.75 * 0.08))
    amplitude, phase = relative_errors(make_scatter(amplitude=0.01, phase=0.02, blocks=8.0), usual)
    variance = (2 * 0.04**2 + 8 * 0.01**2) / 10
    assert amplitude == pytest.approx(0.85 * (variance / 8) ** 0.5)
    # All phases here are twice the amplitudes: four times the variance.
    assert phase == pytest.approx(0.75 * (4 * variance / 8) ** 0.5)


def test_the_usual_scatter_is_the_median_over_the_plates():
    plates = [make_scatter(0.01, 0.05, 1), make_scatter(0.02, 0.01, 1), make_scatter(0.09, 0.02, 1)]
    assert find_usual_scatter(plates) == (0.02, 0.02)
    assert find_usual_scatter([]) == (0.0, 0.0)


def test_a_patch_is_measured_with_all_its_errors():
    v = np.full(SHAPE, 0.5 - 0.1j)
    h = np.full(SHAPE, 0.8 + 0j)
    plain = measure_patch(make_patch(), h, v, theta_rad=0.7)
    assert plain.inverse_ratio == pytest.approx((0.5 - 0.1j) / 0.8)
    assert plain.relative_std == (0.0, 0.0)
    assert plain.rise == (0.0, 0.0)

    # ln(V / H) is known to be wrong by 0.2 + 0.1j, with errors of 0.03 and 0.05.
    changed = measure_patch(
        make_patch(), h, v, theta_rad=0.7, usual=(0.04, 0.08), change=(0.2 + 0.1j, (0.03, 0.05)), local_std=(0.01, 0.02)
    )
    assert changed.inverse_ratio == pytest.approx((0.5 - 0.1j) / 0.8 * np.exp(-0.2 - 0.1j))
    # All pixels are equal: `std` has its least value.
    assert changed.std == pytest.approx(0.6e-3)
    assert changed.theta_rad == pytest.approx(0.7)
    assert changed.brightness == pytest.approx(0.8)
    # The squares add up of: the usual scatter times 0.85 and 0.75 as above, the error of the change, and `local_std`.
    amplitude_std = ((0.85 * 0.04) ** 2 + 0.03**2 + 0.01**2) ** 0.5
    phase_std = ((0.75 * 0.08) ** 2 + 0.05**2 + 0.02**2) ** 0.5
    assert changed.relative_std == pytest.approx((amplitude_std, phase_std))


def test_the_error_of_a_ratio_is_that_of_the_background_and_the_systematic_one():
    """1 / P = V / H has an error of (dV - V/H dH) / H. That of P is |P|^2 times as large.

    The amplitudes of the background are 0.1 in H and 0.2 in V; each of two parts has 1 / sqrt(2) of that.
    """
    h = np.array([[2.0, 2.0, 2.0, np.nan, 1.0]], complex)
    v = np.array([[1.0, 1.0j, 4.0, 1.0, np.inf]], complex)
    systematic = np.array([[0.0, 0.03, 0.0, 0.0, 0.0]])
    sigma = ratio_sigma(h, v, (0.1, 0.2), systematic)
    # The first two pixels have |V / H| = 0.5 and |H| = 2, so |P|^2 = 4; the third has |V / H| = 2 and |P|^2 = 1 / 4.
    noise = np.hypot(0.2, 0.5 * 0.1) / 2 / 2**0.5
    assert sigma[0, 0] == pytest.approx(noise * 4)
    assert sigma[0, 1] == pytest.approx(np.hypot(noise, 0.03) * 4)
    assert sigma[0, 2] == pytest.approx(np.hypot(0.2, 2 * 0.1) / 2 / 2**0.5 / 4)
    assert np.isnan(sigma[0, 3:]).all()
    assert sigma.dtype == np.float32
    # Without a background only the systematic part is known.
    assert ratio_sigma(h, v, (np.nan, np.nan), systematic)[0, 1] == pytest.approx(0.03 * 4)
