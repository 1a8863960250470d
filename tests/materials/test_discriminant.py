"""The discriminant of error sources: it estimates their sizes, corrects scans, and rejects unknown materials."""

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.materials.classify import DISCRIMINANT_MODEL, PAPER_MODEL, fit_weights
from polysight.materials.discriminant import REJECTED_SHARE, ErrorDiscriminant
from polysight.materials.library import Samples, make_features
from polysight.materials.train import fit_samples, score, score_unseen_materials
from polysight_shared.errors import ErrorCode

# Features of five materials: ln |H|, ln |V| and arg P. The phases of two of them lie on either side of 180 degrees.
MEANS = np.array([[-0.6, -2.0, 0.1], [-0.55, -1.9, 0.2], [-0.5, -2.2, 3.1], [-0.4, -1.5, -3.1], [-0.3, -1.2, 0.5]])


def convert_to_features(logs):
    """Return the features of pixels [n, 4] from their ln |H|, ln |V| and arg P, [..., 3]."""
    h = np.exp(logs[..., 0]).ravel()
    v = np.exp(logs[..., 1]).ravel()
    p = h / v * np.exp(1j * logs[..., 2].ravel())
    return make_features(h, v, p)


def draw_pixels(seed=0, scans=8, pixels=12, scan_std=0.02, patch_std=0.01, pixel_std=0.03, means=MEANS):
    """Return `pixels` pixels of every material in each of `scans` scans; materials are m0, m1 ..., scans s0, s1 ...

    The errors of ln |H|, ln |V| and arg P have three parts each, with the standard deviations `scan_std`, `patch_std`
    and `pixel_std`: one that all pixels of a scan share, one that the pixels of a patch share, and one of each pixel.
    """
    rng = np.random.default_rng(seed)
    materials = len(means)
    scan_error = scan_std * rng.standard_normal((scans, 1, 1, 3))
    patch_error = patch_std * rng.standard_normal((scans, materials, 1, 3))
    pixel_error = pixel_std * rng.standard_normal((scans, materials, pixels, 3))
    features = convert_to_features(np.array(means)[None, :, None] + scan_error + patch_error + pixel_error)
    scan_number, material_number, _ = np.indices((scans, materials, pixels))
    names = np.char.add("m", material_number.ravel().astype(str))
    groups = np.char.add("s", scan_number.ravel().astype(str))
    patches = (scan_number * materials + material_number).ravel()
    return Samples(features, names, groups, patches)


def join_samples(first, second):
    return Samples(
        x=np.concatenate([first.x, second.x]),
        names=np.concatenate([first.names, second.names]),
        groups=np.concatenate([first.groups, second.groups]),
        patches=np.concatenate([first.patches, second.patches]),
    )


def test_the_sizes_of_the_errors_are_found():
    models = [ErrorDiscriminant().fit(draw_pixels(seed, scans=40)) for seed in range(6)]
    for covariances, true_std in (
        ([model.within for model in models], 0.03),
        ([model.between for model in models], 0.01),
        ([model.scan for model in models], 0.02),
    ):
        mean = np.mean(covariances, axis=0)
        # The scatter of 6 * 40 scans has an error of 1 / sqrt(2 * 240) = 5 %, and a covariance one of
        # 1 / sqrt(240) = 6 % of the variance: three of these each.
        assert np.sqrt(np.diag(mean)) == pytest.approx(true_std, rel=0.15)
        errors_of_different_features = mean - np.diag(np.diag(mean))
        assert np.abs(errors_of_different_features).max() < 0.2 * true_std**2


def test_an_error_that_all_patches_of_a_scan_share_changes_no_name():
    # Materials that differ by 8 % in |H| only.
    close_means = [[-0.6 + 0.08 * i, -2.0, 0.1] for i in range(5)]
    model = ErrorDiscriminant().fit(draw_pixels(seed=0, means=close_means))
    test = draw_pixels(seed=1, scans=1, scan_std=0.0, means=close_means)

    # The metal reference of the scan is wrong by one to two standard deviations of the scans' errors, 0.02. Features
    # are |H|, |V| and the parts of 1 / P.
    gain_h = 1.03
    gain_v = 0.96
    phase = np.exp(0.04j)
    true_p = 1 / (test.x[:, 2] + 1j * test.x[:, 3])
    moved = make_features(test.x[:, 0] * gain_h, test.x[:, 1] * gain_v, phase * gain_h / gain_v * true_p)

    verdicts = model.by_scan(test.x, test.patches)
    moved_verdicts = model.by_scan(moved, test.patches)
    right_names = [f"m{i}" for i in range(5)]
    assert verdicts.names.tolist() == right_names
    assert moved_verdicts.names.tolist() == right_names
    # A model that looks at each pixel alone cannot estimate the error that all pixels of the scan share.
    share_right_pixel_by_pixel = (model.classify_pixels(moved)[0] == test.names).mean()
    assert (moved_verdicts.pixel_names == test.names).mean() > share_right_pixel_by_pixel


def test_phases_on_either_side_of_180_degrees_are_near_each_other():
    assert score(draw_pixels(2), DISCRIMINANT_MODEL).patches == 1.0


def test_a_patch_alone_is_named_like_its_pixels_without_a_correction_of_its_scan():
    model = ErrorDiscriminant().fit(draw_pixels(seed=0))
    test = draw_pixels(seed=3, scans=1)
    for patch in np.unique(test.patches):
        of_patch = test.patches == patch
        alone = model.by_scan(test.x[of_patch], test.patches[of_patch])
        assert alone.patches.tolist() == [patch]
        assert alone.names[0] == test.names[of_patch][0]
        assert alone.pixel_names.tolist() == model.classify_pixels(test.x[of_patch])[0].tolist()


def test_known_patches_are_called_unknown_at_the_stated_rate():
    rates = [score(draw_pixels(seed, pixels=6), DISCRIMINANT_MODEL).unknown for seed in range(12)]
    # 12 draws of 5 materials in 8 scans are 480 patches: a share of 0.02 has an error of 0.006 there.
    assert np.mean(rates) == pytest.approx(REJECTED_SHARE, abs=0.015)


def test_probabilities_mean_what_they_say():
    """The mean confidence is the share of right names, with five materials that differ by 2 % in |H| only.

    The error that all pixels of a scan share is as large: 0.02 in ln |H|.
    """
    close_means = [[-0.6 + 0.02 * i, -2.0, 0.1] for i in range(5)]
    model = ErrorDiscriminant().fit(draw_pixels(seed=0, scans=60, means=close_means))
    confidences = []
    is_right = []
    for seed in range(60):
        test = draw_pixels(seed=100 + seed, scans=1, means=close_means)
        verdicts = model.by_scan(test.x, test.patches)
        confidences += verdicts.confidence.tolist()
        is_right += [name == f"m{i}" for i, name in enumerate(verdicts.names)]
    # The case is neither hopeless nor trivial.
    assert 0.4 < np.mean(is_right) < 0.95
    # Patches of a scan share its error: 60 independent draws of a share have an error of up to sqrt(0.25 / 60) = 0.065.
    assert np.mean(confidences) == pytest.approx(np.mean(is_right), abs=0.1)


def test_a_material_that_was_never_learnt_is_unknown():
    share_unknown = score_unseen_materials(draw_pixels(seed=4), DISCRIMINANT_MODEL)
    assert set(share_unknown) == {f"m{i}" for i in range(5)}
    # The share is 1 of each material: they differ by several standard deviations of the errors.
    assert min(share_unknown.values()) > 0.9


def test_patches_of_an_unknown_material_do_not_change_the_correction_of_the_others():
    model = ErrorDiscriminant().fit(draw_pixels(seed=0))
    known = draw_pixels(seed=5, scans=1)
    # Three patches that are unlike all materials.
    unlike = draw_pixels(seed=6, scans=1, means=[[-1.5, -3.5, 1.5]] * 3)
    alone = model.by_scan(known.x, known.patches)
    # The known patches have the numbers 0 to 4; 100 is added to those of the others.
    features = np.concatenate([known.x, unlike.x])
    patches = np.concatenate([known.patches, unlike.patches + 100])
    together = model.by_scan(features, patches)
    assert together.names[:5].tolist() == alone.names.tolist()
    # A distance of 1 is the limit beyond which a patch is unknown.
    assert (together.distance[5:] > 1).all()
    assert together.distance[:5] == pytest.approx(alone.distance, abs=1e-3)


def add_metal(samples, stray):
    """Return the samples with a patch of metal added to each scan; pixel number `stray` of the patch is unlike metal.

    Metal is the reference: it has neither an error of the scan nor one of the patch.
    """
    rng = np.random.default_rng(7)
    scans = np.unique(samples.groups)
    pixels = int((samples.patches == 0).sum())
    logs = 0.03 * rng.standard_normal((scans.size, pixels, 3))
    # V is 40 % weaker and P turned by 0.3 rad: |1/P - 1| is about 0.5.
    logs[:, stray] += [0.0, -0.5, 0.3]
    features = convert_to_features(logs)
    patches = samples.patches.max() + 1 + np.repeat(np.arange(scans.size), pixels)
    metal = Samples(features, np.full(len(features), "metal"), np.repeat(scans, pixels), patches)
    return join_samples(samples, metal)


def test_whether_a_patch_is_metal_does_not_depend_on_the_order_of_its_pixels():
    samples = add_metal(draw_pixels(seed=8), stray=0)
    reversed_samples = samples.take(np.arange(len(samples.x))[::-1])
    model = ErrorDiscriminant().fit(samples)
    reversed_model = ErrorDiscriminant().fit(reversed_samples)
    np.testing.assert_allclose(model.scan, reversed_model.scan, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(model.level, reversed_model.level, rtol=1e-9, atol=1e-12)
    assert model.patch_level == pytest.approx(reversed_model.patch_level)


@pytest.mark.parametrize("stray", [0, 5])
def test_metal_with_a_stray_pixel_does_not_change_the_results_of_others(stray):
    """The reference has no error of its own, so its patch does not change the results of others."""
    model = ErrorDiscriminant().fit(add_metal(draw_pixels(seed=8), stray=0))
    test = add_metal(draw_pixels(seed=9, scans=1), stray)
    without_metal = test.take(test.names != "metal")
    alone = model.by_scan(without_metal.x, without_metal.patches)
    named_together = model.by_scan(test.x, test.patches)
    np.testing.assert_allclose(named_together.distance[: len(alone.distance)], alone.distance, rtol=1e-9)
    assert named_together.names[-1] == "metal"


def test_two_angles_are_independent_and_separate_materials_better():
    first_angle = draw_pixels(seed=0, pixel_std=0.1, patch_std=0.05)
    second_angle = draw_pixels(seed=1, pixel_std=0.1, patch_std=0.05)
    both_angles = first_angle.join(second_angle)
    model = ErrorDiscriminant().fit(both_angles)
    # The first three features are of the first angle, the others of the second.
    for covariance in (model.scan, model.between, model.within):
        assert np.abs(covariance[:3, 3:]).max() < 1e-12
    assert score(both_angles, DISCRIMINANT_MODEL).pixels > score(first_angle, DISCRIMINANT_MODEL).pixels


def add_lonely_material(samples, scans=1):
    """Return the samples with a material "lonely", unlike all others, that is only in the first `scans` scans."""
    pixels = draw_pixels(seed=11, scans=scans, means=[[-1.5, -3.5, 1.5]])
    names = np.full(len(pixels.x), "lonely")
    patches = samples.patches.max() + 1 + pixels.patches
    return join_samples(samples, Samples(pixels.x, names, pixels.groups, patches))


@pytest.mark.parametrize("model", [DISCRIMINANT_MODEL, PAPER_MODEL])
def test_a_material_of_one_scan_is_neither_right_nor_wrong(model):
    """The material cannot be learnt from other scans: the accuracy is that of the others, and a note names it."""
    pixels = draw_pixels(seed=12, scans=4, pixels=4)
    score_without = score(pixels, model)
    score_with = score(add_lonely_material(pixels), model)
    assert score_without.not_judged == ()
    assert score_with.not_judged == ("lonely",)
    # If the material counted as wrong, the accuracy would fall by 0.12 (12 of 92 pixels) and 0.05 (1 of 21 patches).
    assert score_with.pixels == pytest.approx(score_without.pixels, abs=0.02)
    assert score_with.patches == pytest.approx(score_without.patches, abs=0.02)
    # Names are in alphabetical order; the row of the confusion matrix is empty.
    assert score_with.names[0] == "lonely"
    assert not score_with.confusion[0].any()
    assert score_with.confusion[1:].sum(axis=1) == pytest.approx(1.0)


def test_a_library_lists_the_materials_that_could_not_be_judged():
    # Three materials that are far from each other
    samples = draw_pixels(seed=12, scans=3, pixels=3, means=MEANS[[0, 3, 4]])
    fit = fit_samples(add_lonely_material(samples))
    assert fit["materials"] == 4
    assert fit["not_judged"] == ["lonely"]
    assert fit["pixel_accuracy"] == fit["patch_accuracy"] == 1.0


def test_a_material_of_one_scan_does_not_change_how_single_channels_are_judged():
    pixels = draw_pixels(seed=0, scans=4, pixels=6)
    weights_without = fit_weights(pixels).by_channel
    weights_with = fit_weights(add_lonely_material(pixels)).by_channel
    assert [weights_with[c] for c in "hv"] == pytest.approx([weights_without[c] for c in "hv"])


def test_a_material_of_two_scans_among_many_is_judged():
    """Of the two scans with the material, one is learnt from while the other is judged: they are never in one fold."""
    samples = add_lonely_material(draw_pixels(seed=13, scans=20, pixels=3), scans=2)
    assert score(samples, DISCRIMINANT_MODEL).not_judged == ()


def test_scans_without_a_common_material_are_refused():
    samples = draw_pixels(seed=14, scans=5)
    # Material m0 of scan s0, m1 of s1, and so on.
    material_number = np.char.lstrip(samples.names, "m")
    scan_number = np.char.lstrip(samples.groups, "s")
    disjoint = samples.take(material_number == scan_number)
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA):
        score(disjoint, DISCRIMINANT_MODEL)
