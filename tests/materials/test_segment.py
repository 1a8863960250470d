"""Segmentation finds all plates and no other patches; boxes by hand; the metal reference."""

import numpy as np
import pytest
from benchmarks.touching import judge_gap
from scipy.ndimage import gaussian_filter
from tests.support.refusals import expect_refusal

from polysight.materials import Labels, SegmentSettings, pack_labels, read_labels
from polysight.materials.labels import make_patches_from_labels
from polysight.materials.metal import find_metal_in_box, find_metals, take_patch_as_metal
from polysight.materials.segment import box_mask, match_truth, segment
from polysight_shared.errors import ErrorCode


@pytest.mark.parametrize("seed", range(6))
def test_nine_plates_are_nine_patches_inside_their_true_boxes(synthetic, seed):
    scene = synthetic(seed, noise=0.03, uneven=0.05)
    segmentation = segment(scene.h, scene.v, scene.x_m, scene.y_m)
    matched = match_truth(segmentation.patches, scene.plates)
    assert len(segmentation.patches) == 9
    assert len(matched) == 9
    for patch in segmentation.patches:
        truth = matched[patch.label].box_mm
        # 5 mm is the resolution along x.
        np.testing.assert_allclose(patch.box_mm, truth, atol=5.0)
        inside = box_mask(truth, scene.x_m, scene.y_m)
        assert not (patch.interior & ~inside).any()
        # A plate of 45 mm has 506 pixels, and the paper uses 80 to 120 for each material.
        assert patch.interior.sum() > 80
        assert patch.pixels == patch.mask.sum()
        assert (segmentation.labels[patch.mask] == patch.label).all()


# From metal to foam, whose |r_s| is 0.16
WEAK_AND_STRONG = {
    "copper": None,
    "water": 9.37 - 18.0j,
    "rubber": 5.06 - 1.11j,
    "wood": 2.61 - 0.01j,
    "fabric": 2.21 - 0.13j,
    "foam": 1.3 - 0.0j,
}


def count_right_plates(synthetic, seeds, **scene_options):
    """Return the number of plates with a patch of their box to 6 mm, of all plates, and of patches without a plate."""
    right = 0
    plates = 0
    extra = 0
    for seed in seeds:
        scene = synthetic(seed, **scene_options)
        segmentation = segment(scene.h, scene.v, scene.x_m, scene.y_m)
        matched = match_truth(segmentation.patches, scene.plates)
        plates += len(scene.plates)
        extra += len(segmentation.patches) - len(matched)
        for patch in segmentation.patches:
            truth = matched.get(patch.label)
            right += truth is not None and bool(np.allclose(patch.box_mm, truth.box_mm, rtol=0, atol=6.0))
    return right, plates, extra


def test_speckle_does_not_hide_the_plates(synthetic):
    """Noise of a fifth of metal's amplitude: about two fifths of a dielectric's in H, and more than its whole V."""
    right, plates, extra = count_right_plates(synthetic, range(4), noise=0.2)
    # All of the 36 plates are found, and nothing else; the limits allow for five that are missed and two extra patches.
    assert right >= 0.85 * plates
    assert extra <= 2


def test_weak_plates_are_found_near_strong_ones(synthetic):
    """Foam is 20 log10(0.16) = 16 dB below metal and 8 dB above the noise of 0.06."""
    right, plates, extra = count_right_plates(synthetic, range(4), materials=WEAK_AND_STRONG, noise=0.06)
    # One of the 24 plates is missed.
    assert right >= plates - 1
    assert extra <= 1


def test_noise_alone_has_no_patches(synthetic):
    scene = synthetic(seed=1, materials={}, noise=0.1)
    assert segment(scene.h, scene.v, scene.x_m, scene.y_m).patches == ()


def test_gains_of_the_channels_do_not_change_the_patches(synthetic):
    scene = synthetic(seed=2)
    before = segment(scene.h, scene.v, scene.x_m, scene.y_m)
    after = segment(scene.h * np.complex64(30j), scene.v * np.complex64(0.01), scene.x_m, scene.y_m)
    np.testing.assert_array_equal(before.labels, after.labels)


def test_no_patch_reaches_into_the_part_that_was_not_imaged(synthetic):
    scene = synthetic(seed=2)
    valid = np.ones(scene.h.shape, bool)
    valid[:, :75] = False
    segmentation = segment(scene.h, scene.v, scene.x_m, scene.y_m, valid)
    assert segmentation.patches
    assert not segmentation.labels[:, :75].any()
    with expect_refusal(ErrorCode.NO_DATA):
        segment(scene.h, scene.v, scene.x_m, scene.y_m, np.zeros_like(valid))


def test_axes_and_channels_of_other_sizes_are_refused(synthetic):
    scene = synthetic(seed=2)
    longer_m = np.append(scene.x_m, 2 * scene.x_m[-1] - scene.x_m[-2])
    for axes in ((scene.x_m[:-1], scene.y_m), (longer_m, scene.y_m), (scene.x_m, scene.y_m[1:])):
        with expect_refusal(ErrorCode.MISMATCH):
            segment(scene.h, scene.v, *axes)
    with expect_refusal(ErrorCode.MISMATCH):
        segment(scene.h, scene.v[1:], scene.x_m, scene.y_m)


def test_the_outline_of_a_patch_reaches_to_its_box(synthetic):
    scene = synthetic(seed=4)
    segmentation = segment(scene.h, scene.v, scene.x_m, scene.y_m, settings=SegmentSettings(margin_mm=6.0))
    for patch in segmentation.patches:
        # An outline reaches to its box within a pixel of 2 mm.
        np.testing.assert_allclose(patch.outline_mm.min(axis=0), patch.box_mm[:2], atol=2.1)
        np.testing.assert_allclose(patch.outline_mm.max(axis=0), patch.box_mm[2:], atol=2.1)


def test_metal_is_found_without_help_also_with_a_weak_channel(synthetic, request):
    for seed in range(4 if request.config.getoption("--long") else 2):
        # V is 26 dB weaker than H.
        scene = synthetic(seed, gain_v=0.05j)
        segmentation = segment(scene.h, scene.v, scene.x_m, scene.y_m)
        metal = find_metals(scene.h, scene.v, segmentation)[0]
        assert match_truth(segmentation.patches, scene.plates)[metal.label].name == "copper"
        assert scene.analyse().metal.certain
        assert "brightest in both channels" in metal.how


def test_metal_may_be_given_by_a_box_or_by_the_number_of_a_patch(synthetic):
    scene = synthetic(seed=0)
    segmentation = segment(scene.h, scene.v, scene.x_m, scene.y_m)
    copper = next(p for p in scene.plates if p.metal)
    by_box = find_metal_in_box(copper.box_mm, segmentation, scene.x_m, scene.y_m)
    assert by_box.label is not None
    assert (by_box.mask == take_patch_as_metal(by_box.label, segmentation).mask).all()
    with expect_refusal(ErrorCode.NO_DATA, "--metal-box x0,y0,x1,y1"):
        find_metal_in_box((1e3, 1e3, 2e3, 2e3), segmentation, scene.x_m, scene.y_m)
    with expect_refusal(ErrorCode.NO_DATA, 99):
        take_patch_as_metal(99, segmentation)


def test_label_files_round_trip_and_make_patches(tmp_path, synthetic):
    scene = synthetic(seed=0)
    # Corners in pixels
    boxes = {"acrylic": (10.0, 20.0, 30.0, 35.0), "copper": (60.0, 60.0, 80.0, 82.0)}
    (tmp_path / "l.json").write_bytes(pack_labels(Labels(boxes)))
    assert read_labels(tmp_path / "l.json").boxes == boxes
    segmentation, names = make_patches_from_labels(boxes, scene.x_m, scene.y_m)
    assert names == {1: "acrylic", 2: "copper"}
    assert segmentation.patches[0].pixels == 20 * 15
    # The box of acrylic begins at row 20 and column 10, and ends before row 35.
    assert segmentation.labels[20, 10] == 1
    assert segmentation.labels[35, 10] == 0
    with expect_refusal(ErrorCode.NO_DATA, "far"):
        make_patches_from_labels({"far": (500.0, 0.0, 600.0, 10.0)}, scene.x_m, scene.y_m)


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("", ErrorCode.FILE_UNREADABLE),
        ("[]", ErrorCode.VALUE_INVALID),
        ('{"labels": 3}', ErrorCode.VALUE_INVALID),
        ('{"labels": {"a": [1, 2, 3]}}', ErrorCode.VALUE_INVALID),
        ('{"labels": [1]}', ErrorCode.VALUE_INVALID),
    ],
)
def test_bad_label_files_are_refused(tmp_path, text, code):
    path = tmp_path / "bad.json"
    path.write_text(text)
    with expect_refusal(code, path):
        read_labels(path)


@pytest.mark.parametrize("gap_cells", [1.5, 2.0, 3.0])
@pytest.mark.parametrize("same_material", [False, True])
def test_plates_that_nearly_touch_are_separate_patches(gap_cells, same_material):
    # The gap is in resolution cells. `share` is that of the scenes' plates that have a patch of their own.
    figures = judge_gap(gap_cells, same_material, scenes=8, first_seed=38_000)
    assert figures.share >= 0.95
    assert figures.strays == 0


@pytest.mark.parametrize("seed", range(3))
def test_plates_that_fill_the_image_with_metal_are_all_found(seed):
    """Six plates of 46 mm, 20 mm apart, as a small aperture sees them; all but the metal are 12 to 24 dB below it."""
    rng = np.random.default_rng(seed)
    levels_db = rng.permutation([0.0, -12.0, -15.0, -18.0, -21.0, -24.0]).reshape(2, 3)
    x_m = (np.arange(93) - 46) * 2e-3
    y_m = (np.arange(60) - 29.5) * 2e-3
    # Plates of 23 pixels begin every 33 pixels.
    amplitude = np.full((60, 93), 0.003)
    for (row, column), level_db in np.ndenumerate(levels_db):
        top = 2 + 33 * row
        left = 2 + 33 * column
        amplitude[top : top + 23, left : left + 23] = 10 ** (level_db / 20)
    noise = 0.003 * (rng.standard_normal((2, 60, 93)) + 1j * rng.standard_normal((2, 60, 93)))
    blurred = gaussian_filter(amplitude, (2, 1))
    h = blurred + noise[0]
    v = 0.6j * blurred + noise[1]
    segmentation = segment(h, v, x_m, y_m)
    assert len(segmentation.patches) == levels_db.size
    assert segmentation.left_out == ()
