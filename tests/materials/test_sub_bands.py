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
BAND = SubBand((0, 96), 76.3e9, 78.0e9)
CHIRP = load_published_rig().chirp
THICK = 4.0 - 0.4j
INVERSE_STD = 0.01


def make_channels(scene, valid) -> Images:
    """Images as an image builder makes them: 0 where not valid."""
    h = np.where(valid, scene.h, 0).astype(np.complex64)
    v = np.where(valid, scene.v, 0).astype(np.complex64)
    return Images(h, v, scene.x_m, scene.y_m, valid)


@pytest.fixture(scope="module")
def scene(synthetic):
    return synthetic(3)


@pytest.fixture(scope="module")
def analysis(scene):
    return scene.analyse()


def cut_left_half(mask):
    """The left half of a region."""
    columns = np.flatnonzero(mask.any(axis=0))
    left_half = np.zeros_like(mask)
    left_half[:, : int(np.median(columns))] = True
    return mask & left_half


def test_metal_that_a_sub_band_does_not_show_is_not_part_of_its_reference(scene, analysis):
    everywhere = np.ones(scene.h.shape, bool)
    without = everywhere & ~cut_left_half(analysis.metal.mask)
    full_rows = list_band_rows(analysis, [BAND], [make_channels(scene, everywhere)], (0, 0), 1.5)
    cut = list_band_rows(analysis, [BAND], [make_channels(scene, without)], (0, 0), 1.5)
    for patch in analysis.patches:
        (row_before,) = full_rows[patch.patch.label]
        (row_after,) = cut[patch.patch.label]
        assert row_after.amplitude_h == pytest.approx(row_before.amplitude_h, rel=0.02)
        assert row_after.ratio.value == pytest.approx(row_before.ratio.value, rel=0.03)


def test_a_patch_that_is_shown_in_part_is_not_darkened_by_the_rest(scene, analysis):
    dielectric = next(r for r in analysis.patches if r.patch.label != analysis.metal.label)
    everywhere = np.ones(scene.h.shape, bool)
    without = everywhere & ~cut_left_half(dielectric.patch.interior)
    rows = [
        list_band_rows(analysis, [BAND], [make_channels(scene, valid)], (0, 0), 1.5) for valid in (everywhere, without)
    ]
    (row_before,), (row_after,) = (r[dielectric.patch.label] for r in rows)
    assert row_after.amplitude_h == pytest.approx(row_before.amplitude_h, rel=0.02)


def test_a_sub_band_without_metal_is_null_and_the_others_stay(scene, analysis):
    everywhere = np.ones(scene.h.shape, bool)
    images = [make_channels(scene, everywhere), make_channels(scene, everywhere & ~analysis.metal.mask)]
    rows = list_band_rows(analysis, [BAND, BAND], images, (0, 0), 1.5)
    for patch in analysis.patches:
        row_with_metal, row_without = rows[patch.patch.label]
        assert row_with_metal.ratio is not None
        assert (row_without.ratio, row_without.inverse_ratio_std, row_without.amplitude_h) == (None, None, None)


def test_boxes_drawn_over_what_is_not_valid_count_only_where_it_is(scene, analysis):
    """The metal's box, and all others, are cut to the image."""
    valid = ~cut_left_half(analysis.metal.mask)
    cut = replace(scene, h=np.where(valid, scene.h, 0), v=np.where(valid, scene.v, 0))
    label = analysis.metal.label
    full_result = scene.analyse(
        metal=label, segmentation=analysis.segmentation, pair=scene.pair.limit_to_area(np.ones_like(valid))
    )
    part = cut.analyse(metal=label, segmentation=analysis.segmentation, pair=cut.pair.limit_to_area(valid))
    for row_before, row_after in zip(full_result.rows(), part.rows(), strict=True):
        assert row_after.amplitude_h == pytest.approx(row_before.amplitude_h, rel=0.02)


def test_brightness_that_a_sub_band_changes_over_a_plate_is_an_error_of_that_band(scene, analysis):
    """Echoes of the surroundings that change both channels alike do not change V / H and its error."""
    everywhere = np.ones(scene.h.shape, bool)
    ripple = 1 + 0.05 * np.sin(2 * np.pi * scene.x_m / 0.025)
    images = make_channels(scene, everywhere)
    rippled = replace(images, h=(images.h * ripple).astype(np.complex64), v=(images.v * ripple).astype(np.complex64))
    rows = list_band_rows(analysis, [BAND, BAND], [images, rippled], (0, 0), 1.5)
    for patch in analysis.patches:
        even, uneven = rows[patch.patch.label]
        assert BAND_AMPLITUDE_STD <= even.own_amplitude_std < uneven.own_amplitude_std / 2
        assert 0.01 < uneven.own_amplitude_std < 0.05
        assert uneven.own_std == pytest.approx(even.own_std, rel=0.2)


def test_with_a_given_error_of_brightness_the_loss_of_a_sheet_is_within_its_error():
    sheet = Layer("sheet", 3.0 - 0.1j, 1.2e-3)
    told_std = 0.01
    rng = np.random.default_rng(1)
    ratio, brightness = predict([sheet], Spectrum.from_chirp(CHIRP, 4), THETA)
    row = make_row(1 / ratio[0], 4)
    covariance = INVERSE_STD**2 * np.eye(8)
    errors = []
    for _ in range(40):
        measured_h = brightness * (1 + told_std * rng.standard_normal(4))
        parts = [
            replace_fields(
                part,
                ratio=ComplexNumber.from_complex(1 / ratio[k]),
                covariance=covariance[2 * k : 2 * k + 2].tolist(),
                amplitude_h=measured_h[k],
                own_amplitude_std=told_std,
            )
            for k, part in enumerate(row.bands)
        ]
        bands = bands_of_row(replace_fields(row, bands=parts), CHIRP, 4)
        fit = fit_layer(bands, [replace(sheet, permittivity=None)], THETA)
        errors.append((-fit.permittivity.imag - 0.1) / fit.std_loss)
    assert np.mean(np.abs(errors) < 1.96) >= 0.85


def make_row(ratio, parts):
    """A segment of materials.json with the same ratio in all parts of the sweep, as of a thick plate."""
    part_row = {
        "first_hz": 0.0,
        "last_hz": 1.0,
        "ratio": {"real": ratio.real, "imag": ratio.imag},
        "inverse_ratio_std": INVERSE_STD,
        "amplitude_h": abs(fresnel(THICK, THETA)[0]),
    }
    return msgspec.convert(to_plain({"label": 1, **part_row, "bands": [part_row] * parts}), PatchFigures)


def make_bands(ratio, parts) -> Bands:
    bands = bands_of_row(make_row(ratio, parts), CHIRP, parts)
    assert bands is not None
    return bands


def test_errors_that_sub_bands_share_do_not_shrink_with_their_number():
    """Errors by metal, edges and size are the same in every band. A thick plate looks the same in all of them, so that
    its permittivity has the same error bar for any number of bands."""
    ratio = ratio_from_permittivity(THICK, THETA)
    fits = [fit_layer(make_bands(ratio, parts), [Layer("plate")], THETA) for parts in (1, 2, 4, 8)]
    for fit in fits[1:]:
        assert fit.permittivity == pytest.approx(fits[0].permittivity, rel=1e-3)
        assert fit.std_real == pytest.approx(fits[0].std_real, rel=0.05)
        assert fit.std_loss == pytest.approx(fits[0].std_loss, rel=0.05)


def test_error_bars_of_four_sub_bands_are_those_of_repeated_placements():
    """Each placement has one error of V / H, the same in all of its sub-bands."""
    rng = np.random.default_rng(4)
    inverse = 1 / ratio_from_permittivity(THICK, THETA)
    fits = []
    for _ in range(60):
        error = INVERSE_STD * complex(*rng.standard_normal(2))
        bands = replace(make_bands(1 / (inverse + error), 4), amplitude_h=None, sigma_h=None)
        fits.append(fit_layer(bands, [Layer("plate")], THETA))
    scatter = np.std([f.permittivity.real for f in fits])
    assert scatter == pytest.approx(np.median([f.std_real for f in fits]), rel=0.3)
