"""Errors that a scene shows: displaced images, a drift, a halo of an overdriven receiver."""

from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from polysight.imaging import Images
from polysight.materials import common_change
from polysight.materials.analyse import HALO_OF_METAL, KnownScene, Optics, SceneScatter, analyse
from polysight.materials.common_change import _ExpectedFromSlopes, estimate_common_change
from polysight.materials.inversion import RigPrior
from polysight.materials.measure import LEAST_STD, Scatter, compute_median_ratio, relative_errors
from polysight.materials.metal import (
    Halo,
    divide_by_reference,
    find_halo,
    measure_metal_unevenness,
    take_patch_as_metal,
)
from polysight.materials.result import Tilts
from polysight.materials.segment import align, segment
from polysight.polarimetry import calibrate as to_metal_by_paper

PIXEL_M = 2e-3
SIDE = 120
AXIS = (np.arange(SIDE) - (SIDE - 1) / 2) * PIXEL_M
# Centres of nine plates in three rows, metres. The metal reference is the one in the middle.
PLACES_M = [(x, y) for y in (-0.064, 0.0, 0.064) for x in (-0.064, 0.0, 0.064)]
ORIGIN_M = PLACES_M[4]


def draw_plates(ratio=0.25, seed=0):
    """Return H and V of copper, at the top left, and three dielectrics with V / H of `ratio`.

    The plates are 23 pixels, 46 mm, wide, and blurred by a pixel; each part of the noise is 50 dB below them.
    """
    rng = np.random.default_rng(seed)
    h, v = np.zeros((2, SIDE, SIDE))
    for number, (x0, y0) in enumerate([(20, 20), (70, 20), (20, 70), (70, 70)]):
        h[y0 : y0 + 23, x0 : x0 + 23] = 1.0
        v[y0 : y0 + 23, x0 : x0 + 23] = 1.0 if number == 0 else ratio
    noise = 0.003 * (rng.standard_normal((2, SIDE, SIDE)) + 1j * rng.standard_normal((2, SIDE, SIDE)))
    return ndimage.gaussian_filter(h, 1.0) + noise[0], ndimage.gaussian_filter(v, 1.0) + noise[1]


def make_images(h, v):
    return Images(h, v, AXIS, AXIS, np.ones(h.shape, bool))


def dim_copper(h, v):
    """Return images in which copper is lit less towards the edge of the scan, and V less than H."""
    light = np.linspace(0.3, 1.0, 23)[:, None]
    h = h.copy()
    v = v.copy()
    h[20:43, 20:43] *= np.sqrt(light)
    v[20:43, 20:43] *= light
    return make_images(h, v)


def test_the_reference_of_unevenly_lit_metal_is_its_median_ratio_as_of_other_plates():
    """The root mean squares of H and of V, which the paper takes, have another ratio, by some per cent."""
    scene = dim_copper(*draw_plates())
    segmentation = segment(scene.h, scene.v, scene.x_m, scene.y_m)
    metal = take_patch_as_metal(int(segmentation.labels[30, 30]), segmentation)
    relative = divide_by_reference(scene, metal, reference=None)
    # The median ratio of the metal itself becomes 1 (to 5e-6), although the light on the metal changes V / H.
    assert abs(compute_median_ratio(relative.h[metal.mask], relative.v[metal.mask]) - 1) < 1e-4
    # 0.019 is how much V / H varies; it is also what the root mean squares differ from the median by.
    assert measure_metal_unevenness(relative, metal.mask) > 0.01
    rms = to_metal_by_paper(scene, metal.mask)
    assert abs(compute_median_ratio(rms.h[metal.mask], rms.v[metal.mask]) - 1) > 0.01


def test_uneven_light_on_metal_is_in_the_errors_of_all_plates():
    errors = []
    for scene in (make_images(*draw_plates()), dim_copper(*draw_plates())):
        segmentation = segment(scene.h, scene.v, scene.x_m, scene.y_m)
        known_scene = KnownScene(segmentation=segmentation, metal=int(segmentation.labels[30, 30]))
        result = analyse(scene, Optics(np.radians(55.0)), known_scene)
        errors.append(result.prior.reference_std)
        uneven = measure_metal_unevenness(divide_by_reference(scene, result.metal, reference=None), result.metal.mask)
        assert errors[-1] >= 0.5 * uneven
    assert errors[1] > 1.5 * errors[0]


@pytest.mark.parametrize("shift_px", [(0.0, 1.5), (-2.0, 1.0), (1.2, 0.0)])
def test_images_of_h_and_v_that_are_displaced_are_aligned(shift_px):
    h, v = draw_plates()
    # Rows (y) and columns (x) of 2 mm
    moved = ndimage.shift(v, shift_px, order=3)
    aligned, displacement_mm = align(make_images(h, moved))
    # The displacement is found to a fifth of a pixel, 0.4 mm.
    assert displacement_mm == pytest.approx((2 * shift_px[1], 2 * shift_px[0]), abs=0.4)
    # The border has no data after a shift.
    inside = np.s_[10:110, 10:110]
    assert np.abs(aligned.v - v)[inside].mean() < 0.5 * np.abs(moved - v)[inside].mean()


def test_aligned_images_are_not_changed():
    pair = make_images(*draw_plates())
    aligned, displacement_mm = align(pair)
    assert displacement_mm == (0.0, 0.0)
    assert np.array_equal(aligned.v, pair.v)


def test_images_of_noise_are_not_displaced():
    rng = np.random.default_rng(1)
    h, v = rng.standard_normal((2, SIDE, SIDE)) + 1j * rng.standard_normal((2, SIDE, SIDE))
    assert align(make_images(h, v))[1] == (0.0, 0.0)


def look_up(slopes):
    """Return a function for `make_scatter` that takes the slopes of each plate from a table, by the plate's place."""
    return lambda x_m, y_m: slopes[x_m, y_m]


def make_scatter(slope_of, slope_std=0.1):
    """Return nine plates; `slope_of(x_m, y_m)` is the slope of ln(V / H) along x and y of the plate there, per metre.

    `slope_std` is the error of each part of a slope.
    """
    std = np.full(2, slope_std * (1 + 1j))
    return [
        Scatter(
            amplitude=0.01,
            phase=0.01,
            blocks=8.0,
            slope=np.array(slope_of(*place)),
            slope_std=std,
            centre_m=place,
        )
        for place in PLACES_M
    ]


def test_equal_slopes_of_all_plates_are_a_property_of_the_plates_and_not_a_drift():
    change = estimate_common_change(make_scatter(lambda _x, _y: (0.7 + 0.5j, 0.4j)), ORIGIN_M)
    # A drift with these slopes would change ln(V / H) by 0.4 * 0.064 m = 0.026 from row to row; 5e-5 are found.
    assert np.abs(change.value).max() < 0.01


def test_a_drift_over_the_rows_is_followed_within_its_error():
    """Real and imaginary part of ln(V / H) are both 0.06 cos(20 y), relative to y = 0."""
    y_m = np.array(PLACES_M)[:, 1]
    true_change = (1 + 1j) * 0.06 * (np.cos(20 * y_m) - 1)

    def slope_of(_x, y):
        return 0j, -(1 + 1j) * 0.06 * 20 * np.sin(20 * y)

    change = estimate_common_change(make_scatter(slope_of), ORIGIN_M)
    deviation = change.value - true_change
    assert (np.abs(deviation.real) <= 2 * change.std.real + 1e-6).all()
    # Two rows besides that of the metal show the drift only in part.
    assert np.abs(deviation).max() < 0.6 * np.abs(true_change).max()
    assert max(change.largest_drift()) > 0.01
    assert change.drifts > 0.9


def test_any_drift_is_within_its_error():
    """Random drifts along y: a linear rise and waves, in amplitude and phase of V / H independently.

    The slopes of a linear rise are the same on all plates. If they were taken for a property of the plates, the errors
    would be too small.
    """
    rng = np.random.default_rng(11)
    rows_m = np.array(PLACES_M)[:, 1]
    along_m = np.linspace(-0.2, 0.2, 81)
    slope_std = 0.25
    standardised = []
    for _ in range(30):
        # The amplitude drifts by 5 to 25 % over the scan, the phase by 2 to 15 degrees.
        parts = []
        for span in (rng.uniform(0.05, 0.25), np.radians(rng.uniform(2, 15))):
            drift = rng.uniform(-1, 1) * along_m / 0.4
            for waves in (1, 2, 3):
                wave = np.sin(np.pi * waves * along_m / 0.4 + 2 * np.pi * rng.random())
                drift = drift + rng.standard_normal() / (2 * waves) * wave
            parts.append(span * drift / np.ptp(drift))
        drift = parts[0] + 1j * parts[1]
        true_change = np.interp(rows_m, along_m, drift)
        slope = np.interp(rows_m, along_m, np.gradient(drift, along_m))
        # Images show about nine tenths of a slope, with an error.
        measured_slope = 0.9 * slope + slope_std * (rng.standard_normal(9) + 1j * rng.standard_normal(9))
        slopes = {place: (0j, along_y) for place, along_y in zip(PLACES_M, measured_slope, strict=True)}
        change = estimate_common_change(make_scatter(look_up(slopes), slope_std), ORIGIN_M)
        # Changes are relative to the row of the metal.
        in_other_rows = rows_m != ORIGIN_M[1]
        true_change = true_change - true_change[PLACES_M.index(ORIGIN_M)]
        deviation = (change.value - true_change)[in_other_rows]
        standardised.append(deviation.real / change.std.real[in_other_rows])
        standardised.append(deviation.imag / change.std.imag[in_other_rows])
    # Right errors have a root mean square of 1 standard deviation; these have 1.27.
    assert np.sqrt(np.mean(np.square(standardised))) < 1.3


def test_drifts_taken_together_or_one_by_one_give_the_same_change(monkeypatch):
    """With many plates, all candidates for a drift together would need too much memory."""
    scatters = make_scatter(lambda x, y: (20 * x * y + 0.1j, 0.8 * np.cos(30 * y)))
    together = estimate_common_change(scatters, ORIGIN_M)
    monkeypatch.setattr(common_change, "MOST_NUMBERS", 1)
    one_by_one = estimate_common_change(scatters, ORIGIN_M)
    for field in fields(together):
        assert getattr(together, field.name) == pytest.approx(getattr(one_by_one, field.name), rel=1e-9, abs=1e-12)


def test_a_scene_without_plates_has_no_drift():
    assert estimate_common_change([], ORIGIN_M).largest_drift() == (0.0, 0.0)


def test_a_slope_along_y_alone_is_more_likely_a_drift_than_one_along_x_and_y():
    along_y_alone = estimate_common_change(make_scatter(lambda _x, _y: (0j, 0.8)), ORIGIN_M)
    both_ways = estimate_common_change(make_scatter(lambda _x, _y: (0.8, 0.8)), ORIGIN_M)
    assert np.abs(along_y_alone.value).max() > 2 * np.abs(both_ways.value).max()


def test_slopes_along_a_row_are_not_a_drift():
    change = estimate_common_change(make_scatter(lambda x, _y: (20 * x, 0j)), ORIGIN_M)
    # No change is found, and a drift has a probability of 0.013; the report names a drift from 0.9 on.
    assert np.abs(change.value).max() < 0.005
    assert change.drifts < 0.9


def test_plates_at_the_border_are_not_evidence_of_a_drift():
    """The illumination falls off at the border: the last row has steep slopes, which do not change the other rows."""
    steep = make_scatter(lambda _x, y: (0j, 8.0 if y > 0.05 else 0j))
    is_at_border = [place[1] > 0.05 for place in PLACES_M]
    change = estimate_common_change(steep, ORIGIN_M, is_at_border)
    # The first six plates are those of the other two rows. The slope of 8 / m would change them by 8 * 0.064 = 0.5.
    assert np.abs(change.value[:6]).max() < 0.01


def test_long_fringes_are_within_the_error():
    """Both parts of ln(V / H) follow 0.12 exp(i k . place) in any direction, fringes of 0.2 to 0.3 m."""
    rng = np.random.default_rng(7)
    places = np.array(PLACES_M)
    standardised = []
    for _ in range(8):
        direction = rng.uniform(0, 2 * np.pi)
        wave_vector = 2 * np.pi / rng.uniform(0.2, 0.3) * np.array([np.cos(direction), np.sin(direction)])
        phase = rng.uniform(0, 2 * np.pi)
        fringes = 0.12 * np.exp(1j * (places @ wave_vector + phase))
        # The derivative of exp(i k . place) is i k exp(i k . place).
        slopes = dict(zip(PLACES_M, 1j * fringes[:, None] * wave_vector, strict=True))
        change = estimate_common_change(make_scatter(look_up(slopes)), ORIGIN_M)
        true_change = fringes - fringes[PLACES_M.index(ORIGIN_M)]
        for place in range(len(PLACES_M)):
            if PLACES_M[place] == ORIGIN_M:
                continue
            value, (amplitude_std, phase_std) = change.log_ratio(place)
            deviation = true_change[place] - value
            standardised += [deviation.real / amplitude_std, deviation.imag / phase_std]
    # 95 % are expected, and 87 % found. The numbers of a scene are not independent: of 8 independent ones 0.95 has an
    # error of sqrt(0.95 * 0.05 / 8) = 0.08.
    assert np.mean(np.abs(standardised) < 2) >= 0.85


def test_a_disturbed_plate_gets_a_large_error_and_the_others_do_not():
    """A copy of another plate on it makes its slopes unlike all others."""
    disturbed = make_scatter(lambda x, y: (8 + 6j, 5j) if (x, y) == PLACES_M[0] else (0j, 0j))
    error_by_ripple = estimate_common_change(disturbed, ORIGIN_M).ripple
    # The disturbed plate gets an error of 7.5 %, and the others get none.
    assert error_by_ripple[0] > 0.05
    assert error_by_ripple[1:].max() == 0


def test_slopes_of_bent_plates_are_not_a_ripple():
    """The brightness of a bent plate changes along it. H and V see places that are apart along y: V / H has a slope."""
    rng = np.random.default_rng(3)
    bent = make_scatter(lambda _x, _y: (0j, complex(rng.normal(0, 4))))
    assert estimate_common_change(bent, ORIGIN_M).ripple.max() == 0


def test_a_halo_around_the_metal_in_v_alone_shows_an_overdriven_receiver():
    """A glow in both channels is light of the scene."""
    h, v = draw_plates()
    pair = make_images(h, v)
    patches = segment(h, v, AXIS, AXIS).patches
    metal = next(p for p in patches if np.median(np.abs(v[p.interior])) > 0.8)
    assert find_halo(metal.interior, patches, pair).level == 0
    # The glow is 30 % of the metal's amplitude, blurred over 16 mm.
    glow = 0.3 * ndimage.gaussian_filter(metal.mask.astype(float), 8.0)
    halo = find_halo(metal.interior, patches, make_images(h, v + glow))
    assert halo.level > 0.005
    assert max(halo.around, key=lambda label: halo.around[label]) == metal.label
    assert find_halo(metal.interior, patches, make_images(h + glow, v + glow)).level == 0


def test_only_the_plate_that_is_brightest_in_v_has_a_halo():
    """A dielectric that is declared as metal does not overdrive the receiver."""
    h, v = draw_plates()
    patches = segment(h, v, AXIS, AXIS).patches
    by_level = sorted(patches, key=lambda patch: float(np.median(np.abs(v[patch.interior]))))
    glow = 0.3 * ndimage.gaussian_filter(by_level[-1].mask.astype(float), 8.0)
    assert find_halo(by_level[-1].interior, patches, make_images(h, v + glow)).level > 0
    assert find_halo(by_level[0].interior, patches, make_images(h, v + glow)).level == 0


# The metal ends at column 42 and the plate begins at column 59 or 61: a gap of 16 or 18 pixels, 32 or 36 mm.
@pytest.mark.parametrize(("left_px", "lies_in_halo"), [(59, True), (61, False)])
def test_a_plate_within_36_mm_of_the_metal_lies_in_its_halo_even_without_free_pixels_around_it(left_px, lies_in_halo):
    metal = np.zeros((SIDE, SIDE), bool)
    metal[50:73, 20:43] = True
    plate = np.zeros_like(metal)
    plate[50:73, left_px : left_px + 23] = True
    patches = [SimpleNamespace(label=k, mask=mask, interior=mask) for k, mask in enumerate((metal, plate), 1)]
    h = metal + 0.4 * plate + 0.003
    v = metal + 0.1 * plate + 0.003 + 0.3 * ndimage.gaussian_filter(metal.astype(float), 8.0)
    # Nothing was imaged around the plate: its own glow cannot be measured.
    around_plate = ndimage.binary_dilation(plate, iterations=10) & ~plate
    halo = find_halo(metal, patches, Images(h, v, AXIS, AXIS, ~around_plate))
    assert halo.level > 0.005
    assert halo.around[2] == (halo.level if lies_in_halo else 0)


def _explain_cases(mean: float, std: tuple[float, ...]) -> _ExpectedFromSlopes:
    """Return what the slopes of one plate show in as many cases (drifts) as there are standard deviations.

    The mean of the change is the same in all cases.
    """
    square = np.array([[mean**2 + s**2] for s in std])
    mean_of_cases = np.full_like(square, mean)
    return _ExpectedFromSlopes(
        log_evidence=np.zeros(len(std)),
        mean=mean_of_cases,
        square=square,
        drift=mean_of_cases,
        drift_square=square,
        remaining=np.zeros((len(std), 2, 1)),
    )


@pytest.mark.parametrize("wide_share", [0.0, 0.03, 0.1, 0.2, 0.5, 1.0])
def test_the_error_of_the_common_change_holds_95_percent_of_unlike_cases(wide_share: float):
    """A rig is stable or drifts ten times as much: 1.96 times the root mean square hold 92 % if half of them drift."""
    explained = _explain_cases(mean=0.02, std=(0.001, 0.01))
    weight = np.array([1 - wide_share, wide_share])
    rng = np.random.default_rng(3)
    std = np.where(rng.random(200_000) < wide_share, 0.01, 0.001)
    drawn = 0.02 + std * rng.standard_normal(std.size)

    error = float(explained.error(weight)[0])

    # 200,000 draws of 95 % have an error of 0.0005.
    assert np.mean(np.abs(drawn - 0.02) < 1.96 * error) >= 0.947
    assert error >= 0.999 * np.std(drawn - 0.02) - 1e-5


def test_the_error_of_a_common_change_is_the_standard_deviation_of_a_single_case():
    error = _explain_cases(mean=-0.3, std=(0.004,)).error(np.ones(1))

    # The error is found by bisection.
    assert error == pytest.approx(0.004, rel=1e-3)


def test_fringes_that_only_weak_plates_show_are_not_reported():
    """Bright edges disturb V of plates that reflect little of it: their slopes are no sign of a second path."""
    places = np.array(PLACES_M)
    wave_vector = 2 * np.pi / 0.25 * np.array([0.6, 0.8])
    fringes = 0.15 * np.exp(1j * places @ wave_vector)
    slopes = dict(zip(PLACES_M, 1j * fringes[:, None] * wave_vector, strict=True))
    strong_places = {PLACES_M[0], PLACES_M[4], PLACES_M[8]}
    scatters = make_scatter(lambda x, y: (0j, 0j) if (x, y) in strong_places else slopes[x, y])
    # |V / H| of the plates with fringes is 0.1.
    levels = [0.9 if place in strong_places else 0.1 for place in PLACES_M]
    scatters_of_weak = [replace(scatter, level=level) for scatter, level in zip(scatters, levels, strict=True)]
    change = estimate_common_change(scatters, ORIGIN_M)
    # Fringes are reported from a probability of a half on.
    assert change.fringes > 0.5
    change_of_weak = estimate_common_change(scatters_of_weak, ORIGIN_M)
    assert change_of_weak.fringes < 0.5
    # The errors are the same in both cases.
    np.testing.assert_array_equal(change_of_weak.std, change.std)


def test_the_error_of_the_metal_is_the_root_of_the_sum_of_squares_of_its_parts():
    scene = SceneScatter(
        scatter={}, usual=(0.02, 0.01), metal=None, change=None, metal_spread=None, border={},
        tilts=Tilts({}, across=1), lit_evenly=True, metal_rise=(0.0, 0.0), halo=Halo(level=0.003), metal_std=0.017,
    )  # fmt: skip
    amplitude, phase = relative_errors(None, (0.02, 0.01))
    # Amplitude and phase are one part each of a complex error whose parts are alike.
    parts = (LEAST_STD, amplitude / np.sqrt(2), phase / np.sqrt(2), 0.003 * HALO_OF_METAL, 0.017)
    rig = RigPrior(theta_std_rad=0.01)
    assert scene.prior(rig, 0.0).reference_std == pytest.approx(np.sqrt(np.sum(np.square(parts))))
    # Metal that was scanned separately has none of the scene's errors.
    assert replace(scene, metal_spread=0.1).prior(rig, 0.0).reference_std == LEAST_STD
