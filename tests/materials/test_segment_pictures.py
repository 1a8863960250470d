"""Segmentation of pictures as real rigs make them: rippled, unevenly lit plates with bright strips and narrow gaps."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from polysight.materials.copies import find_copies
from polysight.materials.labels import make_patches_from_labels
from polysight.materials.measure import background_mean, check_patch, measure_background, measure_difference_of_halves
from polysight.materials.segment import Segmentation, make_patch, segment
from polysight.results.rules import judge_patches
from polysight_worlds import METAL, Plate, Stack, World, published_rig, simulate

PIXEL_MM = 2.0
SIDE = 150
AXIS = (np.arange(SIDE) - (SIDE - 1) / 2) * PIXEL_MM / 1e3
COPPER = 1.0 + 0j
PUBLISHED = os.environ.get("POLYSIGHT_PUBLISHED_IMAGES")
"""Folder of the published rig's own picture and its boxes, which is not part of the repository."""


def draw_ripple(rng, amplitude, phase_rad):
    """A multiplicative error of these standard deviations, correlated over some 15 mm."""
    fields = [ndimage.gaussian_filter(rng.standard_normal((SIDE, SIDE)), 7.5 / PIXEL_MM) for _ in range(2)]
    real, imag = (field / field.std() for field in fields)
    return np.exp(amplitude * real + 1j * phase_rad * imag)


def draw(seed, plates, strips=1.8, amplitude=0.25, phase_deg=13.0, background_db=-35.0):
    """H and V of plates: (x0, y0, x1, y1) in pixels to (level of H in dB, V / H); strips of 4 mm along two edges."""
    rng = np.random.default_rng(seed)
    h, v = np.zeros((2, SIDE, SIDE), complex)
    for (x0, y0, x1, y1), (level_db, ratio) in plates.items():
        lit = np.full((y1 - y0, x1 - x0), 10 ** (level_db / 20), complex)
        lit[:2] *= strips
        lit[:, -2:] *= strips
        h[y0:y1, x0:x1] = lit
        v[y0:y1, x0:x1] = ratio * lit
    # The ripple of V / H is that of a metal plate; each channel has half of it.
    share = np.sqrt(0.5)
    out = []
    for channel in (h, v):
        rippled = channel * draw_ripple(rng, share * amplitude, share * np.radians(phase_deg))
        noise = (rng.standard_normal((SIDE, SIDE)) + 1j * rng.standard_normal((SIDE, SIDE))) * 10 ** (
            background_db / 20
        )
        blurred = [ndimage.gaussian_filter(part, 1.2) for part in (rippled.real, rippled.imag)]
        out.append(blurred[0] + 1j * blurred[1] + noise)
    return out


def draw_raster(levels_db, ratios, gap_px):
    """Plates of 46 mm in rows of three, `gap_px` apart."""
    size = 23
    first = (SIDE - 3 * size - 2 * gap_px) // 2
    boxes = [(first + (size + gap_px) * (i % 3), first + (size + gap_px) * (i // 3)) for i in range(len(levels_db))]
    return {
        (x, y, x + size, y + size): (level, ratio)
        for (x, y), level, ratio in zip(boxes, levels_db, ratios, strict=True)
    }


def convert_boxes_to_px(segmentation):
    return [tuple(round(b / PIXEL_MM + SIDE / 2) for b in patch.box_mm) for patch in segmentation.patches]


def assert_found(segmentation, plates, tolerance_px=4):
    boxes = convert_boxes_to_px(segmentation)
    assert len(boxes) == len(plates), boxes
    for plate in plates:
        assert any(np.abs(np.subtract(plate, box)).max() <= tolerance_px for box in boxes), (plate, boxes)


RATIOS = [COPPER, 0.2, 0.22 + 0.05j, 0.3, 0.35 - 0.1j, 0.19, 0.5, 0.28, 0.2]


@pytest.mark.parametrize("gap_px", [6, 8])
@pytest.mark.parametrize("seed", range(4))
def test_rippled_plates_with_bright_strips_and_narrow_gaps_are_found(seed, gap_px):
    """Levels as in a real picture: 1.2 times metal's to a quarter of it."""
    levels = np.random.default_rng(seed).permutation([0.0, 1.0, -4.0, 1.5, 1.0, -6.0, 1.5, -8.0, -11.0])
    plates = draw_raster(levels, RATIOS, gap_px)
    assert_found(segment(*draw(seed, plates), AXIS, AXIS), plates)


@pytest.mark.parametrize("seed", range(4))
def test_plates_25_db_below_the_brightest_are_found(seed):
    plates = draw_raster([0.0, -12.0, -25.0, -18.0, -1.0, -22.0], RATIOS[:6], 10)
    assert_found(segment(*draw(seed, plates, amplitude=0.12, background_db=-48.0), AXIS, AXIS), plates)


@pytest.mark.parametrize("seed", range(4))
def test_sheets_that_only_h_shows_are_found(seed):
    plates = draw_raster([0.0, -6.0, -16.0, -3.0], [COPPER, 0.0, 0.0, 0.2], 10)
    assert_found(segment(*draw(seed, plates, background_db=-40.0), AXIS, AXIS), plates)


def draw_band_limited_noise(rng, level_db):
    """Complex noise [2, SIDE, SIDE] of this level with resolution cells of some 4 mm."""
    parts = [ndimage.gaussian_filter(rng.standard_normal((SIDE, SIDE)), 1.0) for _ in range(4)]
    noise = np.array([parts[0] + 1j * parts[1], parts[2] + 1j * parts[3]])
    return noise / np.sqrt(np.mean(np.abs(noise) ** 2)) * 10 ** (level_db / 20)


@pytest.mark.parametrize("noise_db", [-20.0, -14.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_sheet_whose_v_is_noise_is_one_plate_of_one_kind(seed, noise_db):
    plates = draw_raster([0.0, -3.0], [COPPER, 0.01], 12)
    h, v = draw(seed, plates, strips=1.0, amplitude=0.02, phase_deg=1.0, background_db=-60.0)
    v = v + draw_band_limited_noise(np.random.default_rng(seed), noise_db)[1]
    usable = np.ones(h.shape, bool)
    segmentation, _ = make_patches_from_labels({str(i): box for i, box in enumerate(plates)}, AXIS, AXIS, margin_mm=6.0)
    dark = measure_background(h, v, segmentation, usable)
    assert [check_patch(patch, h, v, dark, 0.05) for patch in segmentation.patches] == [None, None]


def draw_uneven_light(seed):
    """An amplitude [SIDE, SIDE] that varies by 5 dB (standard deviation) over some 100 mm."""
    field = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal((SIDE, SIDE)), 20.0)
    return 10 ** (5.0 * field / field.std() / 20)


@pytest.mark.parametrize("seed", range(3))
def test_plates_are_found_over_an_uneven_background_whose_levels_overlap_with_theirs(seed):
    """A table in the antennas' pattern and reflections of the direct path; one threshold does not separate them."""
    plates = draw_raster([0.0, -12.0, -13.0, -11.0, -10.0, -12.0, -14.0], [COPPER, 0.1, 0.2, 0.1, 0.2, 0.15, 0.1], 12)
    channels = np.array(draw(seed, plates, strips=1.0, amplitude=0.15, background_db=-60.0))
    background = draw_band_limited_noise(np.random.default_rng(seed), -24.0) * draw_uneven_light(seed + 50)
    boxes = convert_boxes_to_px(segment(*(channels + background), AXIS, AXIS))
    is_box_found = [any(np.abs(np.subtract(plate, box)).max() <= 4 for box in boxes) for plate in plates]
    assert sum(is_box_found) >= 6
    assert len(boxes) <= len(plates) + 1


@pytest.mark.parametrize("seed", range(6))
def test_band_limited_noise_alone_holds_no_plate(seed):
    assert not segment(*draw_band_limited_noise(np.random.default_rng(seed), 0.0), AXIS, AXIS).patches


def test_halves_are_as_far_apart_as_their_median_ratios():
    """V / H that grows along an axis: the medians of the outer halves, without the middle line."""
    mask = np.zeros((SIDE, SIDE), bool)
    mask[40:60, 70:79] = True
    across = np.arange(SIDE) * np.ones((SIDE, 1))
    h = np.full((SIDE, SIDE), 2.0 + 0j)
    for ratio in (across, across.T):
        extent = np.ptp(ratio[mask]) + 1
        assert measure_difference_of_halves(h, h * (0.3 + 0.4j) * ratio, mask) == pytest.approx(
            0.5 * ((extent + 1) // 2)
        )


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize(("coherence", "agree"), [(0.65, False), (0.75, True)])
def test_channels_agree_at_a_coherence_above_0_7_in_any_unit(unit, coherence, agree):
    rng = np.random.default_rng(3)
    box = (-20.0, -20.0, 20.0, 20.0)
    patch = make_patches_from_labels({"plate": box}, AXIS, AXIS)[0].patches[0]
    angle = np.arccos(coherence) * np.where(rng.random((SIDE, SIDE)) < 0.5, 1, -1)
    h = np.full((SIDE, SIDE), unit + 0j)
    cause = check_patch(patch, h, 0.5 * h * np.exp(1j * angle), (0.0, 0.0), 0.0)
    assert cause is not None
    assert (cause.what != "H and V do not agree") == agree


@pytest.mark.parametrize(("x0", "cut"), [(0, True), (130, True), (8, False)])
def test_a_plate_at_the_border_is_cut_and_refused(x0, cut):
    plates = {(60, 60, 84, 84): (0.0, COPPER), (x0, 20, min(x0 + 24, SIDE), 44): (-2.0, 0.25)}
    h, v = draw(1, plates)
    segmentation = segment(h, v, AXIS, AXIS)
    assert_found(segmentation, plates)
    patch = min(segmentation.patches, key=lambda p: p.centre_mm[1])
    assert patch.cut is cut
    refusal_cause = check_patch(patch, h, v, measure_background(h, v, segmentation, np.ones(h.shape, bool)), 0.0)
    assert (refusal_cause is not None and "border" in refusal_cause.what) is cut


def find_refusal(h, v, box, amplitude_of_metal=0.0):
    segmentation, _ = make_patches_from_labels({"plate": box}, AXIS, AXIS)
    patch = segmentation.patches[0]
    uneven = max(amplitude_of_metal, measure_difference_of_halves(h, v, patch.interior) if amplitude_of_metal else 0.0)
    return check_patch(patch, h, v, measure_background(h, v, segmentation, np.ones(h.shape, bool)), uneven)


@pytest.mark.parametrize("seed", range(6))
def test_metal_that_ripples_as_real_metal_does_is_one_material(seed):
    """25 % and 13 degrees; its halves are compared with its own, as for a metal reference."""
    plates = {(60, 60, 88, 88): (0.0, COPPER)}
    h, v = draw(seed, plates, strips=1.0)
    assert find_refusal(h, v, (64, 64, 84, 84), amplitude_of_metal=0.1) is None


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("other", [0.2, 0.35 - 0.1j])
def test_metal_and_a_dielectric_in_one_box_are_not(seed, other):
    plates = {(60, 60, 74, 88): (0.0, COPPER), (74, 60, 88, 88): (0.0, other)}
    h, v = draw(seed, plates, strips=1.0, amplitude=0.1, phase_deg=5.0)
    assert find_refusal(h, v, (62, 62, 86, 86)) is not None


def test_clutter_of_a_plates_size_is_counted_but_no_patch():
    rng = np.random.default_rng(3)
    plates = draw_raster([0.0, 0.0, -3.0], [COPPER, 0.25, 0.25], 10)
    h, v = draw(3, plates)
    field = ndimage.gaussian_filter(rng.standard_normal((SIDE, SIDE)), 6)
    clutter = 10 ** ((-24 + 4 * field / field.std()) / 20)
    segmentation = segment(h + clutter, v + 0.3 * clutter, AXIS, AXIS)
    assert_found(segmentation, plates)
    assert len(segmentation.left_out) > 0


@pytest.mark.parametrize("seed", range(3))
def test_a_plate_cut_off_from_a_larger_patch_is_reported(seed):
    """Six plates without gaps: four in a square, two in a row at its corner. The last one was once lost."""
    size = 23
    places = [(0, 0), (1, 0), (0, 1), (1, 1), (1, 2), (2, 2)]
    boxes = [(35 + size * i, 35 + size * j, 35 + size * (i + 1), 35 + size * (j + 1)) for i, j in places]
    h, v = draw(seed, dict.fromkeys(boxes, (-6.0, 0.25)), strips=1.0, amplitude=0.05)
    segmentation = segment(h, v, AXIS, AXIS)
    x0, y0, x1, y1 = boxes[-1]
    reported_masks = [patch.mask for patch in segmentation.patches] + list(segmentation.left_out)
    # The background may be left out, too: a mask that is mostly of this plate counts.
    of_plate = [mask for mask in reported_masks if mask[y0:y1, x0:x1].sum() > 0.4 * mask.sum()]
    assert max((mask[y0:y1, x0:x1].mean() for mask in of_plate), default=0.0) > 0.5


@pytest.mark.parametrize("seed", range(3))
def test_copies_of_the_plates_by_a_second_path_are_recognised(seed):
    """Fringes over the scan shift the whole picture; each channel's copies have a place of their own."""
    plates = draw_raster([0.0, -3.0, 0.0, -2.0, -1.0, 0.0], RATIOS[:6], 8)
    h, v = draw(seed, plates, amplitude=0.1, phase_deg=6.0)
    assert find_copies(segment(h, v, AXIS, AXIS).patches, h, v, PIXEL_MM) is None
    doubled = h + 0.16 * np.roll(h, (30, 45), axis=(0, 1))
    copies = find_copies(segment(doubled, v, AXIS, AXIS).patches, doubled, v, PIXEL_MM)
    assert copies is not None
    assert copies.shift_mm == pytest.approx((90.0, 60.0), abs=6.0)
    assert copies.level_db == pytest.approx(-16.0, abs=2.0)


def test_weak_plates_one_pitch_away_are_not_copies_if_both_channels_show_them():
    """Cups and sheets of a grid lie where a shift by one pitch would copy others, 16 dB weaker in H."""
    plates = draw_raster([0.0, 0.0, 0.0, 0.0], [COPPER, 0.3, 0.25, 0.35], 8)
    h, v = draw(5, plates, amplitude=0.05, phase_deg=3.0)
    weak_copy = 0.16 * np.roll(h, (30, 45), axis=(0, 1))
    # Their own ratios have nothing to do with those of the plates beside them.
    level = np.where(np.arange(SIDE)[None, :] < SIDE // 2, 2.5, 0.7)
    own_v = level * weak_copy
    assert find_copies(segment(h + weak_copy, v, AXIS, AXIS).patches, h + weak_copy, v, PIXEL_MM) is not None
    segmentation = segment(h + weak_copy, v + own_v, AXIS, AXIS)
    assert find_copies(segmentation.patches, h + weak_copy, v + own_v, PIXEL_MM) is None


@pytest.mark.skipif(PUBLISHED is None, reason="POLYSIGHT_PUBLISHED_IMAGES is not set: the folder of the real picture")
def test_the_nine_plates_of_the_published_rigs_picture_are_found_and_nothing_else():
    folder = Path(PUBLISHED or "")
    boxes = json.loads((folder / "20250612_142257_multi.json").read_text())["boxes_px"]
    with np.load(folder / "20250612_142257_multi.npz") as z:
        h = z["h"]
        v = z["v"]
    segmentation = segment(h, v, AXIS, AXIS)
    assert len(segmentation.patches) == len(boxes) == 9
    for name, (x0, y0, x1, y1) in boxes.items():
        drawn = np.zeros(h.shape, bool)
        drawn[y0:y1, x0:x1] = True
        best = max(segmentation.patches, key=lambda p: int((p.mask & drawn).sum()))
        assert (best.mask & drawn).sum() >= 0.85 * drawn.sum(), name
        assert not best.cut


def test_a_dim_plate_outside_patches_is_not_background_but_a_table_is():
    """A dim plate is not a measure of the background of others; a table behind is as dim, but larger than any plate."""
    usable = np.ones((AXIS.size, AXIS.size), bool)
    patch_mask = np.zeros_like(usable)
    patch_mask[20:45, 20:45] = True
    plate_mask = np.zeros_like(usable)
    plate_mask[80:105, 80:105] = True
    h = np.where(plate_mask, 0.3, 0.01).astype(np.complex64)
    patch = make_patch(1, patch_mask, AXIS, AXIS, 5.0, usable)
    beside_plate = Segmentation(patch_mask.astype(np.int32), (patch,), (plate_mask,))
    assert measure_background(h, h, beside_plate, usable) == pytest.approx((0.01, 0.01))
    table = np.where(patch_mask, 1.0, 0.3).astype(np.complex64)
    before_table = Segmentation(patch_mask.astype(np.int32), (patch,), (~patch_mask,))
    assert measure_background(table, table, before_table, usable) == pytest.approx((0.3, 0.3))


@pytest.mark.parametrize(("pixels", "is_background"), [(6 * 25, False), (6 * 25 + 1, True)])
def test_a_dim_region_larger_than_six_plates_is_background(pixels, is_background):
    usable = np.ones((AXIS.size, AXIS.size), bool)
    patch_mask = np.zeros_like(usable)
    patch_mask[20:25, 20:25] = True
    region = np.zeros_like(usable)
    region.flat[60 * AXIS.size : 60 * AXIS.size + pixels] = True
    patch = make_patch(1, patch_mask, AXIS, AXIS, 5.0, usable)
    segmentation = Segmentation(patch_mask.astype(np.int32), (patch,), (region,))
    h = region.astype(np.complex64)
    assert (measure_background(h, h, segmentation, usable)[0] > 0) == is_background


def test_a_background_that_is_alike_over_a_plates_size_does_not_average_away():
    """A table behind the plates adds one number to a plate; noise adds its mean over the plate's pixels."""
    plates = {(20, 20, 44, 44): (0.0, COPPER), (90, 90, 114, 114): (-6.0, 0.3)}
    segmentation = segment(*draw(1, plates, background_db=-60.0), AXIS, AXIS)
    usable = np.ones((SIDE, SIDE), bool)
    noise = np.random.default_rng(2).standard_normal((2, SIDE, 2 * SIDE)).view(np.complex128) / np.sqrt(2)
    table = np.full((2, SIDE, SIDE), 0.08 + 0.06j)
    width_px = np.sqrt(np.median([p.interior.sum() for p in segmentation.patches]))
    assert background_mean(*table, segmentation, usable) == pytest.approx((0.1, 0.1), rel=1e-6)
    assert background_mean(*noise, segmentation, usable) == pytest.approx((1 / width_px, 1 / width_px), rel=0.35)
    everywhere = segment(np.ones((SIDE, SIDE), complex), np.ones((SIDE, SIDE), complex), AXIS, AXIS)
    assert background_mean(*table, everywhere, usable & False) == (0.0, 0.0)


@pytest.mark.parametrize("pixels", [50, 90])
@pytest.mark.parametrize("stack", [METAL, Stack(below=4.69 - 0.7j)], ids=["copper", "dielectric"])
def test_a_plate_that_fills_the_picture_is_one_region_and_stated(pixels, stack):
    rig = published_rig()
    plate = Plate("board", (rig.centre_m[0], rig.centre_m[1]), (0.34, 0.34), stack)
    pair = simulate(World((plate,)), rig=rig, pixels=pixels)
    segmentation = segment(pair.h, pair.v, pair.x_m, pair.y_m)
    assert segmentation.patches == ()
    share = max(mask.sum() for mask in segmentation.left_out) / pixels**2
    (finding,) = judge_patches({}, 0, len(segmentation.left_out), share)
    assert "fills" in finding.what
