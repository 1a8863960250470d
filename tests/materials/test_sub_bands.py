"""Sub-bands of patches: only imaged pixels count, and an error that all bands share does not average out."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace as replace_fields
from tests.support.rigs import load_published_rig

from polysight.imaging import Images
from polysight.imaging.images import SubBand
from polysight.materials.layers import Bands, Layer, Spectrum, fit_layer, predict
from polysight.materials.sub_bands import BAND_AMPLITUDE_STD, bands_of_row, list_band_rows
from polysight.polarimetry import fresnel, ratio_from_permittivity
from polysight.results import ComplexNumber, PatchFigures, to_plain

THETA = np.radians(55.0)
# The images of these tests are made, not formed from samples: the band is only copied into the results.
BAND = SubBand((0, 96), 76.3e9, 78.0e9)
CHIRP = load_published_rig().chirp
# Acrylic (Table 2 of the paper). A plate thick enough that nothing returns from its far face has this permittivity in
# every sub-band.
THICK_PLATE_EPS = 4.0 - 0.4j
# Standard deviation of the real and of the imaginary part of V / H, the inverse of the ratio H / V in materials.json.
V_OVER_H_STD = 0.01
# The median brightness of half of a plate is that of the whole plate within 0.3 % (measured in the scene below, whose
# illumination varies by 1 %). If the pixels of the other half counted as 0, it would change by tens of per cent.
BRIGHTNESS_OF_HALF_A_PLATE = 0.02
RATIO_OF_HALF_A_PLATE = 0.03


def make_channels(scene, valid) -> Images:
    """Return the scene's images as an image builder makes them: 0 where not valid."""
    h = np.where(valid, scene.h, 0).astype(np.complex64)
    v = np.where(valid, scene.v, 0).astype(np.complex64)
    return Images(h, v, scene.x_m, scene.y_m, valid)


def measure_sub_bands(analysis, images_of_bands):
    """Return the rows of each patch, by patch number: one row for each of the image pairs.

    The scene has no leakage that would have to be removed. The speckle filter is 1.5 pixels wide, 3 mm.
    """
    bands = [BAND] * len(images_of_bands)
    return list_band_rows(analysis, bands, images_of_bands, leakage=(0, 0), smooth_px=1.5)


@pytest.fixture(scope="module")
def scene(synthetic):
    return synthetic(seed=3)


@pytest.fixture(scope="module")
def analysis(scene):
    return scene.analyse()


def cut_left_half(mask):
    columns = np.flatnonzero(mask.any(axis=0))
    left_of_middle = np.zeros_like(mask)
    left_of_middle[:, : int(np.median(columns))] = True
    return mask & left_of_middle


def test_metal_that_a_sub_band_does_not_show_is_not_part_of_its_reference(scene, analysis):
    everywhere = np.ones(scene.h.shape, bool)
    half_of_metal_missing = everywhere & ~cut_left_half(analysis.metal.mask)
    full_rows = measure_sub_bands(analysis, [make_channels(scene, everywhere)])
    cut_rows = measure_sub_bands(analysis, [make_channels(scene, half_of_metal_missing)])
    for patch in analysis.patches:
        (full_row,) = full_rows[patch.patch.label]
        (cut_row,) = cut_rows[patch.patch.label]
        assert cut_row.amplitude_h == pytest.approx(full_row.amplitude_h, rel=BRIGHTNESS_OF_HALF_A_PLATE)
        assert cut_row.ratio.value == pytest.approx(full_row.ratio.value, rel=RATIO_OF_HALF_A_PLATE)


def test_a_patch_that_a_sub_band_shows_in_part_is_not_darkened_by_the_missing_pixels(scene, analysis):
    dielectric = next(r for r in analysis.patches if r.patch.label != analysis.metal.label)
    everywhere = np.ones(scene.h.shape, bool)
    half_of_patch_missing = everywhere & ~cut_left_half(dielectric.patch.interior)
    full_rows = measure_sub_bands(analysis, [make_channels(scene, everywhere)])
    cut_rows = measure_sub_bands(analysis, [make_channels(scene, half_of_patch_missing)])
    (full_row,) = full_rows[dielectric.patch.label]
    (cut_row,) = cut_rows[dielectric.patch.label]
    assert cut_row.amplitude_h == pytest.approx(full_row.amplitude_h, rel=BRIGHTNESS_OF_HALF_A_PLATE)


def test_a_sub_band_without_metal_has_no_results_and_the_other_sub_band_has_its_own(scene, analysis):
    everywhere = np.ones(scene.h.shape, bool)
    images = [make_channels(scene, everywhere), make_channels(scene, everywhere & ~analysis.metal.mask)]
    rows = measure_sub_bands(analysis, images)
    for patch in analysis.patches:
        row_with_metal, row_without_metal = rows[patch.patch.label]
        assert row_with_metal.ratio is not None
        assert row_without_metal.ratio is None
        assert row_without_metal.inverse_ratio_std is None
        assert row_without_metal.amplitude_h is None


def test_patches_that_reach_beyond_the_valid_area_are_measured_inside_it(scene, analysis):
    """The patches are given, as by boxes that a user draws; half of the metal patch lies where nothing was imaged."""
    valid = ~cut_left_half(analysis.metal.mask)
    cut_scene = replace(scene, h=np.where(valid, scene.h, 0), v=np.where(valid, scene.v, 0))
    given = {"metal": analysis.metal.label, "segmentation": analysis.segmentation}
    full_result = scene.analyse(**given, pair=scene.pair.limit_to_area(np.ones_like(valid)))
    cut_result = cut_scene.analyse(**given, pair=cut_scene.pair.limit_to_area(valid))
    for full_row, cut_row in zip(full_result.rows(), cut_result.rows(), strict=True):
        assert cut_row.amplitude_h == pytest.approx(full_row.amplitude_h, rel=BRIGHTNESS_OF_HALF_A_PLATE)


def test_brightness_that_a_sub_band_changes_over_a_plate_is_an_error_of_that_band(scene, analysis):
    """Echoes of the surroundings that change both channels alike do not change V / H and its error."""
    everywhere = np.ones(scene.h.shape, bool)
    images = make_channels(scene, everywhere)
    # A ripple of 5 % with a period of 25 mm: nearly two periods over a plate of 45 mm.
    ripple = 1 + 0.05 * np.sin(2 * np.pi * scene.x_m / 0.025)
    rippled = replace(images, h=(images.h * ripple).astype(np.complex64), v=(images.v * ripple).astype(np.complex64))
    rows = measure_sub_bands(analysis, [images, rippled])
    for patch in analysis.patches:
        even_row, rippled_row = rows[patch.patch.label]
        assert BAND_AMPLITUDE_STD <= even_row.own_amplitude_std < rippled_row.own_amplitude_std / 2
        # About 0.02. The spread of a sine of amplitude 0.05 is 1.48 * 0.05 / sqrt(2) = 0.052 (from the median
        # deviation); the speckle filter leaves three quarters of it, and the error is half of the spread.
        assert 0.01 < rippled_row.own_amplitude_std < 0.05
        assert rippled_row.own_std == pytest.approx(even_row.own_std, rel=0.2)


def test_with_a_given_error_of_brightness_the_loss_of_a_sheet_is_within_its_error():
    sheet = Layer("sheet", permittivity=3.0 - 0.1j, thickness_m=1.2e-3)
    unknown_sheet = replace(sheet, permittivity=None)
    brightness_std = 0.01
    band_count = 4
    v_over_h, brightness = predict([sheet], Spectrum.from_chirp(CHIRP, band_count), THETA)
    row = make_row(ratio=1 / v_over_h[0], band_count=band_count)
    # Real and imaginary part of V / H in each of the four sub-bands: eight independent errors. A sub-band's row has the
    # two lines of the matrix that belong to it.
    covariance = V_OVER_H_STD**2 * np.eye(2 * band_count)
    lines_of_band = covariance.reshape(band_count, 2, 2 * band_count)

    rng = np.random.default_rng(1)
    errors_in_stds = []
    for _ in range(40):
        measured_brightness = brightness * (1 + brightness_std * rng.standard_normal(band_count))
        band_rows = [
            replace_fields(
                band_row,
                ratio=ComplexNumber.from_complex(1 / v_over_h[k]),
                covariance=lines_of_band[k].tolist(),
                amplitude_h=measured_brightness[k],
                own_amplitude_std=brightness_std,
            )
            for k, band_row in enumerate(row.bands)
        ]
        bands = bands_of_row(replace_fields(row, bands=band_rows), CHIRP, band_count)
        fit = fit_layer(bands, [unknown_sheet], THETA)
        errors_in_stds.append((-fit.permittivity.imag - 0.1) / fit.std_loss)
    # 95 % are expected. Of 40 draws 0.85 is three standard deviations below: sqrt(0.95 * 0.05 / 40) = 0.034.
    assert np.mean(np.abs(errors_in_stds) < 1.96) >= 0.85


def make_row(ratio, band_count):
    """Return a segment of materials.json with the same ratio H / V in all parts of the sweep, as of a thick plate."""
    figures = {
        "first_hz": 0.0,
        "last_hz": 1.0,
        "ratio": {"real": ratio.real, "imag": ratio.imag},
        "inverse_ratio_std": V_OVER_H_STD,
        "amplitude_h": abs(fresnel(THICK_PLATE_EPS, THETA)[0]),
    }
    return msgspec.convert(to_plain({"label": 1, **figures, "bands": [figures] * band_count}), PatchFigures)


def make_bands(ratio, band_count) -> Bands:
    """Return the input of `fit_layer` for a plate with the same ratio H / V in each sub-band."""
    bands = bands_of_row(make_row(ratio, band_count), CHIRP, band_count)
    assert bands is not None
    return bands


def test_errors_that_sub_bands_share_do_not_shrink_with_their_number():
    """Errors by metal, edges and size are the same in every band. A thick plate looks the same in all of them, so that
    its permittivity has the same error bar for any number of bands."""
    ratio = ratio_from_permittivity(THICK_PLATE_EPS, THETA)
    fits = [fit_layer(make_bands(ratio, band_count), [Layer("plate")], THETA) for band_count in (1, 2, 4, 8)]
    # Errors that averaged out would be smaller by sqrt(2) already with two sub-bands.
    for fit in fits[1:]:
        assert fit.permittivity == pytest.approx(fits[0].permittivity, rel=1e-3)
        assert fit.std_real == pytest.approx(fits[0].std_real, rel=0.05)
        assert fit.std_loss == pytest.approx(fits[0].std_loss, rel=0.05)


def test_error_bars_of_four_sub_bands_are_those_of_repeated_placements():
    """Each placement has one error of V / H, the same in all of its sub-bands."""
    rng = np.random.default_rng(4)
    true_v_over_h = 1 / ratio_from_permittivity(THICK_PLATE_EPS, THETA)
    fits = []
    for _ in range(60):
        measured_v_over_h = true_v_over_h + V_OVER_H_STD * complex(*rng.standard_normal(2))
        bands = make_bands(ratio=1 / measured_v_over_h, band_count=4)
        bands_without_brightness = replace(bands, amplitude_h=None, sigma_h=None)
        fits.append(fit_layer(bands_without_brightness, [Layer("plate")], THETA))
    scatter = np.std([f.permittivity.real for f in fits])
    stated_std = np.median([f.std_real for f in fits])
    # The scatter of 60 draws has an error of 1 / sqrt(2 * 60) = 9 %; 30 % are three of these.
    assert scatter == pytest.approx(stated_std, rel=0.3)
