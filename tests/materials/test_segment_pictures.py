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
# Folder of the published rig's own picture and its boxes, which is not part of the repository.
PUBLISHED = os.environ.get("POLYSIGHT_PUBLISHED_IMAGES")


def draw_ripple(rng, amplitude, phase_rad):
    """Return a random factor with these standard deviations of ln amplitude and phase, correlated over some 15 mm."""
    fields = [ndimage.gaussian_filter(rng.standard_normal((SIDE, SIDE)), 7.5 / PIXEL_MM) for _ in range(2)]
    real, imag = (field / field.std() for field in fields)
    return np.exp(amplitude * real + 1j * phase_rad * imag)


def draw(seed, plates, strips=1.8, amplitude=0.25, phase_deg=13.0, background_db=-35.0):
    """Return H and V, complex [SIDE, SIDE], of plates before a background of noise.

    `plates` is (x0, y0, x1, y1) in pixels to (level of H in dB, V / H). Strips of 4 mm along two edges of a plate are
    `strips` times as bright. `amplitude` and `phase_deg` are the ripple of V / H over a plate; as large as on metal of
    the real picture.
    """
    rng = np.random.default_rng(seed)
    h, v = np.zeros((2, SIDE, SIDE), complex)
    for (x0, y0, x1, y1), (level_db, ratio) in plates.items():
        lit = np.full((y1 - y0, x1 - x0), 10 ** (level_db / 20), complex)
        lit[:2] *= strips
        lit[:, -2:] *= strips
        h[y0:y1, x0:x1] = lit
        v[y0:y1, x0:x1] = ratio * lit
    # Each channel has half of the variance of the ripple of V / H.
    share = np.sqrt(0.5)
    noise_level = 10 ** (background_db / 20)
    images = []
    for channel in (h, v):
        rippled = channel * draw_ripple(rng, share * amplitude, share * np.radians(phase_deg))
        noise = noise_level * (rng.standard_normal((SIDE, SIDE)) + 1j * rng.standard_normal((SIDE, SIDE)))
        blurred = ndimage.gaussian_filter(rippled.real, 1.2) + 1j * ndimage.gaussian_filter(rippled.imag, 1.2)
        images.append(blurred + noise)
    return images


def draw_raster(levels_db, ratios, gap_px):
    """Return plates of 46 mm in rows of three, `gap_px` apart, as `draw` takes them."""
    size = 23
    pitch = size + gap_px
    first = (SIDE - 3 * size - 2 * gap_px) // 2
    plates = {}
    for i, (level_db, ratio) in enumerate(zip(levels_db, ratios, strict=True)):
        x = first + pitch * (i % 3)
        y = first + pitch * (i // 3)
        plates[(x, y, x + size, y + size)] = (level_db, ratio)
    return plates


def convert_boxes_to_px(segmentation):
    return [tuple(round(edge / PIXEL_MM + SIDE / 2) for edge in patch.box_mm) for patch in segmentation.patches]


def has_box(boxes, plate, tolerance_px=4):
    """True if the edges of one of the boxes are those of the plate, to 8 mm, a sixth of its width."""
    return any(np.abs(np.subtract(plate, box)).max() <= tolerance_px for box in boxes)


def assert_found(segmentation, plates):
    boxes = convert_boxes_to_px(segmentation)
    assert len(boxes) == len(plates), boxes
    for plate in plates:
        assert has_box(boxes, plate), (plate, boxes)


# V / H of nine plates
RATIOS = [COPPER, 0.2, 0.22 + 0.05j, 0.3, 0.35 - 0.1j, 0.19, 0.5, 0.28, 0.2]


@pytest.mark.parametrize("gap_px", [6, 8])
@pytest.mark.parametrize("seed", range(4))
def test_rippled_plates_with_bright_strips_and_narrow_gaps_are_found(seed, gap_px):
    """Levels as in a real picture: from 1.2 times metal's to a quarter of it."""
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
    """Return complex noise [2, SIDE, SIDE] of this level with resolution cells of some 4 mm."""
    parts = [ndimage.gaussian_filter(rng.standard_normal((SIDE, SIDE)), 1.0) for _ in range(4)]
    noise = np.array([parts[0] + 1j * parts[1], parts[2] + 1j * parts[3]])
    return noise / np.sqrt(np.mean(np.abs(noise) ** 2)) * 10 ** (level_db / 20)


@pytest.mark.parametrize("noise_db", [-20.0, -14.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_sheet_whose_v_is_noise_is_accepted_as_a_plate(seed, noise_db):
    """The V / H of such a sheet varies because it is noise, and not because the patch is of several materials."""
    plates = draw_raster([0.0, -3.0], [COPPER, 0.01], 12)
    h, v = draw(seed, plates, strips=1.0, amplitude=0.02, phase_deg=1.0, background_db=-60.0)
    v = v + draw_band_limited_noise(np.random.default_rng(seed), noise_db)[1]
    usable = np.ones(h.shape, bool)
    segmentation, _ = make_patches_from_labels({str(i): box for i, box in enumerate(plates)}, AXIS, AXIS, margin_mm=6.0)
    dark = measure_background(h, v, segmentation, usable)
    findings = [check_patch(patch, h, v, dark, uneven=0.05) for patch in segmentation.patches]
    assert findings == [None, None]


def draw_uneven_light(seed):
    """Return an amplitude [SIDE, SIDE] that varies by 5 dB (standard deviation) over some 100 mm."""
    field = ndimage.gaussian_filter(np.random.default_rng(seed).standard_normal((SIDE, SIDE)), 20.0)
    return 10 ** (5.0 * field / field.std() / 20)


@pytest.mark.parametrize("seed", range(3))
def test_plates_are_found_over_an_uneven_background_whose_levels_overlap_with_theirs(seed):
    """The background is a table in the antennas' pattern: no single threshold separates it from the plates."""
    plates = draw_raster([0.0, -12.0, -13.0, -11.0, -10.0, -12.0, -14.0], [COPPER, 0.1, 0.2, 0.1, 0.2, 0.15, 0.1], 12)
    channels = np.array(draw(seed, plates, strips=1.0, amplitude=0.15, background_db=-60.0))
    background = draw_band_limited_noise(np.random.default_rng(seed), -24.0) * draw_uneven_light(seed + 50)
    boxes = convert_boxes_to_px(segment(*(channels + background), AXIS, AXIS))
    # In some of the three pictures one of seven plates is missed, or one patch is background.
    found_plates = [plate for plate in plates if has_box(boxes, plate)]
    assert len(found_plates) >= 6
    assert len(boxes) <= len(plates) + 1


@pytest.mark.parametrize("seed", range(6))
def test_band_limited_noise_alone_holds_no_plate(seed):
    assert not segment(*draw_band_limited_noise(np.random.default_rng(seed), 0.0), AXIS, AXIS).patches


def test_the_difference_of_halves_is_that_of_their_median_ratios():
    """V / H grows by 0.5 a pixel along an axis. The medians of the halves are half of the extent apart.

    With an odd number of lines the middle one belongs to neither half.
    """
    mask = np.zeros((SIDE, SIDE), bool)
    mask[40:60, 70:79] = True
    across = np.arange(SIDE) * np.ones((SIDE, 1))
    h = np.full((SIDE, SIDE), 2.0 + 0j)
    for ratio in (across, across.T):
        lines = np.ptp(ratio[mask]) + 1
        difference = measure_difference_of_halves(h, h * (0.3 + 0.4j) * ratio, mask)
        assert difference == pytest.approx(0.5 * ((lines + 1) // 2))


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize(("coherence", "agree"), [(0.65, False), (0.75, True)])
def test_channels_agree_at_a_coherence_above_0_7_in_any_unit(unit, coherence, agree):
    rng = np.random.default_rng(3)
    box = (-20.0, -20.0, 20.0, 20.0)
    segmentation, _ = make_patches_from_labels({"plate": box}, AXIS, AXIS)
    # Half of the pixels are turned one way and half the other: the mean of exp(+- j phi) is cos(phi).
    angle = np.arccos(coherence) * np.where(rng.random((SIDE, SIDE)) < 0.5, 1, -1)
    h = np.full((SIDE, SIDE), unit + 0j)
    v = 0.5 * h * np.exp(1j * angle)
    finding = check_patch(segmentation.patches[0], h, v, dark=(0.0, 0.0), uneven=0.0)
    # A patch that agrees is refused too: its pixels have different ratios.
    assert finding is not None
    assert (finding.what != "H and V do not agree") == agree


@pytest.mark.parametrize(("x0", "cut"), [(0, True), (130, True), (8, False)])
def test_a_plate_at_the_border_is_cut_and_refused(x0, cut):
    plates = {(60, 60, 84, 84): (0.0, COPPER), (x0, 20, min(x0 + 24, SIDE), 44): (-2.0, 0.25)}
    h, v = draw(1, plates)
    segmentation = segment(h, v, AXIS, AXIS)
    assert_found(segmentation, plates)
    patch = min(segmentation.patches, key=lambda p: p.centre_mm[1])
    assert patch.cut is cut
    dark = measure_background(h, v, segmentation, np.ones(h.shape, bool))
    finding = check_patch(patch, h, v, dark, uneven=0.0)
    is_refused_as_cut = finding is not None and "border" in finding.what
    assert is_refused_as_cut is cut


def find_refusal(h, v, box, least_uneven=0.0):
    """Return why the pixels in a box are not a plate; None if they are.

    With `least_uneven` the box is metal, whose halves may differ by this, or by as much as they do.
    """
    segmentation, _ = make_patches_from_labels({"plate": box}, AXIS, AXIS)
    patch = segmentation.patches[0]
    uneven = 0.0
    if least_uneven:
        uneven = max(least_uneven, measure_difference_of_halves(h, v, patch.interior))
    dark = measure_background(h, v, segmentation, np.ones(h.shape, bool))
    return check_patch(patch, h, v, dark, uneven)


@pytest.mark.parametrize("seed", range(6))
def test_metal_that_ripples_as_real_metal_does_is_one_material(seed):
    """A ripple of 25 % and 13 degrees."""
    plates = {(60, 60, 88, 88): (0.0, COPPER)}
    h, v = draw(seed, plates, strips=1.0)
    assert find_refusal(h, v, (64, 64, 84, 84), least_uneven=0.1) is None


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("other", [0.2, 0.35 - 0.1j])
def test_metal_and_a_dielectric_in_one_box_are_refused(seed, other):
    plates = {(60, 60, 74, 88): (0.0, COPPER), (74, 60, 88, 88): (0.0, other)}
    h, v = draw(seed, plates, strips=1.0, amplitude=0.1, phase_deg=5.0)
    assert find_refusal(h, v, (62, 62, 86, 86)) is not None


def test_clutter_as_large_as_a_plate_is_reported_as_left_out_and_is_not_a_patch():
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
    """Six plates without gaps: four in a square, two in a row at its corner. The last one must not be lost."""
    size = 23
    boxes = []
    for column, row in [(0, 0), (1, 0), (0, 1), (1, 1), (1, 2), (2, 2)]:
        x0 = 35 + size * column
        y0 = 35 + size * row
        boxes.append((x0, y0, x0 + size, y0 + size))
    h, v = draw(seed, dict.fromkeys(boxes, (-6.0, 0.25)), strips=1.0, amplitude=0.05)
    segmentation = segment(h, v, AXIS, AXIS)
    x0, y0, x1, y1 = boxes[-1]
    reported_masks = [patch.mask for patch in segmentation.patches] + list(segmentation.left_out)
    # The background may be left out, too: a mask that is mostly of this plate counts.
    of_plate = [mask for mask in reported_masks if mask[y0:y1, x0:x1].sum() > 0.4 * mask.sum()]
    assert max((mask[y0:y1, x0:x1].mean() for mask in of_plate), default=0.0) > 0.5


@pytest.mark.parametrize("seed", range(3))
def test_copies_of_the_plates_by_a_second_path_are_recognised(seed):
    """A second path makes a weak copy of the whole picture elsewhere, in each channel at another place."""
    plates = draw_raster([0.0, -3.0, 0.0, -2.0, -1.0, 0.0], RATIOS[:6], 8)
    h, v = draw(seed, plates, amplitude=0.1, phase_deg=6.0)
    assert find_copies(segment(h, v, AXIS, AXIS).patches, h, v, PIXEL_MM) is None
    # 0.16 is -16 dB. 30 rows and 45 columns of 2 mm are 60 mm along y and 90 mm along x. The level is found to 0.1 dB
    # and the shift to a pixel.
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
    # A real plate has its own V / H: it is not that of the plate one pitch away, as of a copy.
    level = np.where(np.arange(SIDE)[None, :] < SIDE // 2, 2.5, 0.7)
    h_with_weak = h + weak_copy
    v_with_weak = v + level * weak_copy
    seen_in_h_alone = segment(h_with_weak, v, AXIS, AXIS)
    assert find_copies(seen_in_h_alone.patches, h_with_weak, v, PIXEL_MM) is not None
    seen_in_both = segment(h_with_weak, v_with_weak, AXIS, AXIS)
    assert find_copies(seen_in_both.patches, h_with_weak, v_with_weak, PIXEL_MM) is None


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
    """Both are regions that are left out of the patches. A table behind the plates is larger than any plate."""
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


# The patch has 5 x 5 pixels.
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


def test_a_background_that_does_not_vary_over_a_plate_does_not_average_out():
    """A table behind the plates adds one number to all pixels of a plate; noise adds its mean over them."""
    plates = {(20, 20, 44, 44): (0.0, COPPER), (90, 90, 114, 114): (-6.0, 0.3)}
    segmentation = segment(*draw(1, plates, background_db=-60.0), AXIS, AXIS)
    usable = np.ones((SIDE, SIDE), bool)
    # Complex noise of amplitude 1, and a table of amplitude 0.1
    noise = np.random.default_rng(2).standard_normal((2, SIDE, 2 * SIDE)).view(np.complex128) / np.sqrt(2)
    table = np.full((2, SIDE, SIDE), 0.08 + 0.06j)
    # The mean over n independent pixels is smaller by sqrt(n), the width of a square plate.
    width_px = np.sqrt(np.median([p.interior.sum() for p in segmentation.patches]))
    assert background_mean(*table, segmentation, usable) == pytest.approx((0.1, 0.1), rel=1e-6)
    assert background_mean(*noise, segmentation, usable) == pytest.approx((1 / width_px, 1 / width_px), rel=0.35)
    # Without usable pixels the background is not known.
    everywhere = segment(np.ones((SIDE, SIDE), complex), np.ones((SIDE, SIDE), complex), AXIS, AXIS)
    assert background_mean(*table, everywhere, usable & False) == (0.0, 0.0)


@pytest.mark.parametrize("pixels", [50, 90])
@pytest.mark.parametrize("stack", [METAL, Stack(below=4.69 - 0.7j)], ids=["copper", "dielectric"])
def test_a_plate_that_fills_the_picture_is_not_a_patch_and_the_reason_is_given(pixels, stack):
    rig = published_rig()
    plate = Plate("board", (rig.centre_m[0], rig.centre_m[1]), (0.34, 0.34), stack)
    pair = simulate(World((plate,)), rig=rig, pixels=pixels)
    segmentation = segment(pair.h, pair.v, pair.x_m, pair.y_m)
    assert segmentation.patches == ()
    share = max(mask.sum() for mask in segmentation.left_out) / pixels**2
    (finding,) = judge_patches({}, 0, len(segmentation.left_out), share)
    assert "fills" in finding.what
