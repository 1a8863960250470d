"""The discriminant of error sources: it estimates their sizes, corrects scans, and rejects unknown materials."""

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.materials.classify import DISCRIMINANT_MODEL, PAPER_MODEL, fit_weights
from polysight.materials.discriminant import REJECTED_SHARE, ErrorDiscriminant
from polysight.materials.library import Samples, make_features
from polysight.materials.train import fit_samples, score, score_unseen_materials
from polysight_shared.errors import ErrorCode

MEANS = np.array([[-0.6, -2.0, 0.1], [-0.55, -1.9, 0.2], [-0.5, -2.2, 3.1], [-0.4, -1.5, -3.1], [-0.3, -1.2, 0.5]])
"""ln|H|, ln|V| and arg P of five materials; two of them lie on either side of 180 degrees."""


def draw_pixels(seed=0, scans=8, pixels=12, scan=0.02, patch=0.01, pixel=0.03, means=MEANS):
    """Pixels of every material in every scan with errors of three sources, in all three features alike."""
    rng = np.random.default_rng(seed)
    shape = (scans, len(means), pixels, 3)
    z = np.array(means)[None, :, None] + scan * rng.standard_normal((scans, 1, 1, 3))
    z = z + patch * rng.standard_normal((*shape[:2], 1, 3)) + pixel * rng.standard_normal(shape)
    h = np.exp(z[..., 0]).ravel()
    v = np.exp(z[..., 1]).ravel()
    x = make_features(h, v, h / v * np.exp(1j * z[..., 2].ravel()))
    s, m, _ = np.indices(shape[:3])
    names = np.char.add("m", m.ravel().astype(str))
    groups = np.char.add("s", s.ravel().astype(str))
    return Samples(x, names, groups, (s * len(means) + m).ravel())


def join_samples(one, other):
    return Samples(
        *(np.concatenate([getattr(s, k) for s in (one, other)]) for k in ("x", "names", "groups", "patches"))
    )


def test_the_sizes_of_the_errors_are_found():
    models = [ErrorDiscriminant().fit(draw_pixels(seed, scans=40)) for seed in range(6)]
    for covariances, size in (
        ([f.within for f in models], 0.03),
        ([f.between for f in models], 0.01),
        ([f.scan for f in models], 0.02),
    ):
        mean = np.mean(covariances, axis=0)
        assert np.sqrt(np.diag(mean)) == pytest.approx(size, rel=0.15)
        assert np.abs(mean - np.diag(np.diag(mean))).max() < 0.2 * size**2


def test_an_error_that_all_patches_of_a_scan_share_changes_no_name():
    near = [[-0.6 + 0.08 * i, -2.0, 0.1] for i in range(5)]
    model = ErrorDiscriminant().fit(draw_pixels(0, means=near))
    test = draw_pixels(1, scans=1, scan=0.0, means=near)
    gains = np.array([1.03, 0.96]), np.exp(0.04j)
    h = test.x[:, 0] * gains[0][0]
    v = test.x[:, 1] * gains[0][1]
    p = gains[1] * gains[0][0] / gains[0][1] / (test.x[:, 2] + 1j * test.x[:, 3])
    moved = make_features(h, v, p)
    verdicts = model.by_scan(test.x, test.patches)
    moved_verdicts = model.by_scan(moved, test.patches)
    assert verdicts.names.tolist() == moved_verdicts.names.tolist() == [f"m{i}" for i in range(5)]
    alone = (model.by_pixel(moved)[0] == test.names).mean()
    assert (moved_verdicts.pixel_names == test.names).mean() > alone


def test_a_phase_of_180_degrees_is_not_an_edge():
    assert score(draw_pixels(2), DISCRIMINANT_MODEL).patches == 1.0


def test_a_patch_alone_is_named_as_before_and_scans_do_not_touch_each_other():
    model = ErrorDiscriminant().fit(draw_pixels(0))
    test = draw_pixels(3, scans=1)
    for patch in np.unique(test.patches):
        of_patch = test.patches == patch
        alone = model.by_scan(test.x[of_patch], test.patches[of_patch])
        assert alone.patches.tolist() == [patch]
        assert alone.names[0] == test.names[of_patch][0]
        assert alone.pixel_names.tolist() == model.by_pixel(test.x[of_patch])[0].tolist()


def test_known_patches_are_called_unknown_at_the_stated_rate():
    rates = [score(draw_pixels(seed, pixels=6), DISCRIMINANT_MODEL).unknown for seed in range(12)]
    assert np.mean(rates) == pytest.approx(REJECTED_SHARE, abs=0.015)


def test_probabilities_mean_what_they_say():
    """Of the patches named with confidence c, a share c is named right: five materials close to each other in |H|."""
    near = [[-0.6 + 0.02 * i, -2.0, 0.1] for i in range(5)]
    model = ErrorDiscriminant().fit(draw_pixels(0, scans=60, means=near))
    sure = []
    right = []
    for seed in range(60):
        test = draw_pixels(100 + seed, scans=1, means=near)
        verdicts = model.by_scan(test.x, test.patches)
        sure += verdicts.confidence.tolist()
        right += [name == f"m{i}" for i, name in enumerate(verdicts.names)]
    assert 0.4 < np.mean(right) < 0.95
    assert np.mean(sure) == pytest.approx(np.mean(right), abs=0.1)


def test_a_material_that_was_never_learnt_is_unknown():
    missed = score_unseen_materials(draw_pixels(4), DISCRIMINANT_MODEL)
    assert set(missed) == {f"m{i}" for i in range(5)}
    assert min(missed.values()) > 0.9


def test_a_stranger_does_not_shift_the_others():
    model = ErrorDiscriminant().fit(draw_pixels(0))
    test = draw_pixels(5, scans=1)
    unlike_samples = draw_pixels(6, scans=1, means=[[-1.5, -3.5, 1.5]] * 3)
    alone = model.by_scan(test.x, test.patches)
    joint = model.by_scan(
        np.concatenate([test.x, unlike_samples.x]), np.concatenate([test.patches, unlike_samples.patches + 100])
    )
    assert joint.names[:5].tolist() == alone.names.tolist()
    assert (joint.distance[5:] > 1).all()
    assert joint.distance[:5] == pytest.approx(alone.distance, abs=1e-3)


def add_metal(samples, stray):
    """The same scans with a metal patch: no error of scan or patch, and one stray pixel a patch, the first or last."""
    rng = np.random.default_rng(7)
    scans = np.unique(samples.groups)
    n = int((samples.patches == 0).sum())
    z = 0.03 * rng.standard_normal((scans.size, n, 3))
    # |1/P - 1| of 0.5
    z[:, stray] += [0.0, -0.5, 0.3]
    h = np.exp(z[..., 0]).ravel()
    v = np.exp(z[..., 1]).ravel()
    x = make_features(h, v, h / v * np.exp(1j * z[..., 2].ravel()))
    patches = samples.patches.max() + 1 + np.repeat(np.arange(scans.size), n)
    metal = Samples(x, np.full(len(x), "metal"), np.repeat(scans, n), patches)
    return join_samples(samples, metal)


def test_whether_a_patch_is_metal_does_not_depend_on_the_order_of_its_pixels():
    samples = add_metal(draw_pixels(8), 0)
    reversed_samples = samples.take(np.arange(len(samples.x))[::-1])
    model = ErrorDiscriminant().fit(samples)
    turned_model = ErrorDiscriminant().fit(reversed_samples)
    np.testing.assert_allclose(model.scan, turned_model.scan, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(model.level, turned_model.level, rtol=1e-9, atol=1e-12)
    assert model.patch_level == pytest.approx(turned_model.patch_level)


@pytest.mark.parametrize("stray", [0, 5])
def test_metal_with_a_stray_pixel_does_not_change_the_results_of_others(stray):
    """The reference has no error of its own, so its patch does not change the results of others."""
    model = ErrorDiscriminant().fit(add_metal(draw_pixels(8), 0))
    test = add_metal(draw_pixels(9, scans=1), stray)
    without_metal = test.take(test.names != "metal")
    alone = model.by_scan(without_metal.x, without_metal.patches)
    named_together = model.by_scan(test.x, test.patches)
    np.testing.assert_allclose(named_together.distance[: len(alone.distance)], alone.distance, rtol=1e-9)
    assert named_together.names[-1] == "metal"


def test_two_angles_are_independent_and_separate_materials_better():
    first_angle = draw_pixels(0, pixel=0.1, patch=0.05)
    two = draw_pixels(1, pixel=0.1, patch=0.05)
    both_angles = first_angle.join(two)
    model = ErrorDiscriminant().fit(both_angles)
    for covariance in (model.scan, model.between, model.within):
        assert np.abs(covariance[:3, 3:]).max() < 1e-12
    assert score(both_angles, DISCRIMINANT_MODEL).pixels > score(first_angle, DISCRIMINANT_MODEL).pixels


def add_lonely_material(samples, scans=1):
    """The same scans; the first few have an additional material that is unlike all others."""
    only = draw_pixels(11, scans=scans, means=[[-1.5, -3.5, 1.5]])
    names = np.full(len(only.x), "lonely")
    lonely_samples = Samples(only.x, names, only.groups, samples.patches.max() + 1 + only.patches)
    return join_samples(samples, lonely_samples)


@pytest.mark.parametrize("model", [DISCRIMINANT_MODEL, PAPER_MODEL])
def test_a_material_of_one_scan_is_neither_right_nor_wrong(model):
    """The material cannot be learnt from other scans: the accuracy is that of the others, and a note names it."""
    pixels = draw_pixels(12, scans=4, pixels=4)
    score_without = score(pixels, model)
    score_with = score(add_lonely_material(pixels), model)
    assert (score_without.not_judged, score_with.not_judged) == ((), ("lonely",))
    assert score_with.pixels == pytest.approx(score_without.pixels, abs=0.02)
    assert score_with.patches == pytest.approx(score_without.patches, abs=0.02)
    assert score_with.names[0] == "lonely"
    assert not score_with.confusion[0].any()
    assert score_with.confusion[1:].sum(axis=1) == pytest.approx(1.0)


def test_a_library_lists_the_materials_that_could_not_be_judged():
    samples = draw_pixels(12, scans=3, pixels=3, means=MEANS[[0, 3, 4]])
    fit = fit_samples(add_lonely_material(samples))
    assert (fit["materials"], fit["not_judged"]) == (4, ["lonely"])
    assert fit["pixel_accuracy"] == fit["patch_accuracy"] == 1.0


def test_the_channels_alone_are_judged_on_the_same_materials():
    pixels = draw_pixels(0, scans=4, pixels=6)
    weights_without = fit_weights(pixels).by_channel
    weights_with = fit_weights(add_lonely_material(pixels)).by_channel
    assert [weights_with[c] for c in "hv"] == pytest.approx([weights_without[c] for c in "hv"])


def test_a_material_of_two_scans_among_many_is_judged():
    """This holds for any split of the scans into folds."""
    assert score(add_lonely_material(draw_pixels(13, scans=20, pixels=3), scans=2), DISCRIMINANT_MODEL).not_judged == ()


def test_scans_without_a_common_material_are_refused():
    samples = draw_pixels(14, scans=5)
    disjoint = samples.take(np.char.lstrip(samples.names, "m") == np.char.lstrip(samples.groups, "s"))
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA):
        score(disjoint, DISCRIMINANT_MODEL)
