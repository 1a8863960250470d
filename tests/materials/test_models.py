"""Classifiers judged on data that was left out: a split by pixel is optimistic, a split by scan is not."""

from collections import Counter
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from tests.support.refusals import expect_refusal

from polysight.materials.classify import (
    DISCRIMINANT_MODEL,
    MODELS,
    PAPER_MODEL,
    PaperKnn,
    Weights,
    _LeftOut,
    fit_weights,
)
from polysight.materials.library import CHANNELS, Model, Samples, compute_patch_medians, make_features
from polysight.materials.train import score, split
from polysight_shared.errors import ErrorCode


def draw_samples(materials=6, groups=6, pixels=20, offset=0.0, noise=0.01, seed=0, angle=0.0):
    """Return pixels of materials m0, m1 ... in groups s0, s1 ...; a group is a scan.

    The materials differ by 0.05 + 0.02j in V / H and hardly in |H|. `offset` is the standard deviation of an error of
    V / H that all pixels of a patch share, as by its placement or the metal reference, `noise` that of a pixel's own,
    and `angle` a change of V / H of all materials.
    """
    rng = np.random.default_rng(seed)
    features = []
    name_of_pixel = []
    group_of_pixel = []
    patch_of_pixel = []
    for group in range(groups):
        for material in range(materials):
            material_ratio = 0.1 + 0.05 * material + angle + 0.02j * material
            patch_ratio = material_ratio + offset * complex(*rng.standard_normal(2))
            v_over_h = patch_ratio + noise * (rng.standard_normal(pixels) + 1j * rng.standard_normal(pixels))
            h = 0.7 + 0.002 * material + noise * rng.standard_normal(pixels)
            features.append(make_features(h, np.abs(v_over_h) * h, 1 / v_over_h))
            name_of_pixel += [f"m{material}"] * pixels
            group_of_pixel += [f"s{group}"] * pixels
            patch_of_pixel += [group * materials + material] * pixels
    return Samples(
        np.concatenate(features), np.array(name_of_pixel), np.array(group_of_pixel), np.array(patch_of_pixel)
    )


def shuffle_names(data, seed=0):
    """Return the same pixels with the names shuffled among the patches."""
    patch_numbers, first_pixels = np.unique(data.patches, return_index=True)
    name_of_patch = np.random.default_rng(seed).permutation(data.names[first_pixels])
    names = name_of_patch[np.searchsorted(patch_numbers, data.patches)]
    return Samples(data.x, names, data.groups, data.patches)


@pytest.mark.parametrize("model", MODELS)
def test_every_model_learns_materials_that_differ(model):
    # Neighbouring materials differ by 0.054 in V / H, 18 standard deviations of the noise: all pixels are named right.
    assert score(draw_samples(groups=4, noise=0.003), model).pixels == 1


@pytest.mark.parametrize("model", MODELS)
def test_no_model_is_better_than_chance_on_noise(model):
    data = draw_samples(materials=4)
    rng = np.random.default_rng(1)
    noise = Samples(rng.standard_normal(data.x.shape), data.names, data.groups, data.patches)
    # Four materials: chance is 0.25. 480 independent pixels have an error of sqrt(0.25 * 0.75 / 480) = 0.02.
    assert score(noise, model).pixels == pytest.approx(0.25, abs=0.08)


@pytest.mark.parametrize("model", MODELS)
def test_with_shuffled_names_no_model_is_better_than_chance(model):
    data = draw_samples(groups=8, pixels=12, offset=0.02, noise=0.002)
    scores = [score(shuffle_names(data, seed), model) for seed in range(4)]
    # Six materials. The pixels of a patch fall together: 4 * 48 patches have an error of 0.027, the limits are wide.
    assert np.mean([s.pixels for s in scores]) == pytest.approx(1 / 6, abs=0.1)
    assert np.mean([s.patches for s in scores]) == pytest.approx(1 / 6, abs=0.12)


@pytest.mark.parametrize("folds", [2, 3, 8])
def test_no_scan_or_patch_is_on_both_sides_of_a_split_and_every_pixel_is_judged_once(folds):
    data = draw_samples(groups=5, pixels=7)
    judged = np.zeros(data.names.size, int)
    for train, test in split(data, folds=folds):
        assert not set(data.groups[train]) & set(data.groups[test])
        assert not set(data.patches[train]) & set(data.patches[test])
        assert sorted([*train, *test]) == list(range(data.names.size))
        judged[test] += 1
    assert (judged == 1).all()


def test_a_material_is_judged_that_is_in_two_groups_one_of_them_two_scans_of_the_same_specimen():
    """Scans s8 and s9 have the same specimen of m1 and are one group; s7 is the other one.

    These groups are the smallest, as their patches have one pixel each: by size alone they would come into one fold,
    and no scan with m1 would be left to learn from.
    """
    data = draw_samples(materials=2, groups=10, pixels=20)
    is_late_scan = np.isin(data.groups, ["s7", "s8", "s9"])
    _, first_of_patch = np.unique(data.patches, return_index=True)
    is_first_of_patch = np.isin(np.arange(data.names.size), first_of_patch)
    data = data.take(np.where(is_late_scan, is_first_of_patch, data.names == "m0"))
    labelled = (data.names == "m1") & np.isin(data.groups, ["s8", "s9"])
    data = replace(data, specimens=np.where(labelled, "one piece", ""))
    assert np.unique(data.independent[data.names == "m1"]).size == 2
    for train, test in split(data):
        assert set(data.names[test]) <= set(data.names[train])


def test_single_scans_are_left_out_if_groups_of_one_specimen_share_no_material():
    """Two pairs of scans, each of its own specimen and materials: with a pair left out nothing could be judged."""
    data = draw_samples(materials=4, groups=4, pixels=9)
    in_first = np.isin(data.groups, ["s0", "s1"])
    data = data.take(in_first == np.isin(data.names, ["m0", "m1"]))
    specimens = np.where(np.isin(data.groups, ["s0", "s1"]), "a", "b")
    judged = score(replace(data, specimens=specimens), DISCRIMINANT_MODEL)
    assert "4 scans" in judged.split
    assert np.isfinite([judged.pixels, judged.by_patch, judged.patches, judged.unknown]).all()


def test_a_split_by_pixel_divides_patches_and_is_reported_as_optimistic():
    data = draw_samples(groups=5, pixels=7)
    assert all(set(data.patches[train]) & set(data.patches[test]) for train, test in split(data, by_pixel=True))
    assert "optimistic" in score(data, DISCRIMINANT_MODEL, by_pixel=True).split


def test_a_split_by_pixel_needs_two_pixels_of_a_material():
    # Every pixel has its own scan and patch.
    numbers = np.array([0, 1, 2])
    names = np.array(["PET", "PET", "oak"])
    pixels = Samples(np.eye(3, 4), names, groups=numbers, patches=numbers)
    judged = np.concatenate([test for _, test in split(pixels, by_pixel=True)])
    assert sorted(judged) == [0, 1, 2]
    # One pixel of PET and one of oak
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA, "two pixels"):
        list(split(pixels.take(np.array([False, True, True])), by_pixel=True))


def test_a_split_by_pixel_gives_too_high_an_accuracy():
    """Common errors of a patch's pixels are memorised if its pixels are on both sides of the split."""
    data = draw_samples(pixels=10, offset=0.03, noise=0.003)
    # The accuracy is 0.86 by pixel, and 0.63 by scan.
    assert score(data, PAPER_MODEL, by_pixel=True).pixels > score(data, PAPER_MODEL).pixels + 0.15


def test_the_order_of_pixels_does_not_change_the_accuracy():
    data = draw_samples(groups=4, offset=0.02)
    shuffled = data.take(np.random.default_rng(5).permutation(data.names.size))
    assert score(shuffled, DISCRIMINANT_MODEL).pixels == pytest.approx(score(data, DISCRIMINANT_MODEL).pixels, abs=1e-9)


def test_no_pixel_of_a_test_scan_is_ever_trained_on(monkeypatch):
    test_pixel_was_known = []

    class Spy(Model):
        """Notes whether a pixel that it has to name was one of those it learnt from."""

        distributions = None

        def fit(self, samples):
            self.known = {row.tobytes() for row in samples.x}
            self.name = samples.names[0]
            return self

        def classify_pixels(self, x):
            test_pixel_was_known.append(any(row.tobytes() in self.known for row in x))
            return np.full(len(x), self.name), np.zeros(len(x))

    monkeypatch.setitem(MODELS, "spy", lambda _: Spy())
    data = draw_samples()
    with_twins = Samples(data.x.copy(), data.names, data.groups, data.patches)
    # Every second pixel is equal to the one before it, in the same patch.
    with_twins.x[1::2] = with_twins.x[::2]
    score(with_twins, "spy")
    assert not any(test_pixel_was_known)
    score(with_twins, "spy", by_pixel=True)
    assert any(test_pixel_was_known)


def test_a_second_angle_makes_the_nearest_neighbours_more_accurate():
    """The same of the discriminant is in test_discriminant."""
    model = PAPER_MODEL
    first_angle = draw_samples(groups=6, pixels=12, offset=0.02, seed=1)
    both_angles = first_angle.join(draw_samples(groups=6, pixels=12, offset=0.02, seed=2, angle=0.05))
    assert both_angles.x.shape[1] == 2 * first_angle.x.shape[1]
    assert score(both_angles, model).pixels > score(first_angle, model).pixels


def test_joining_angles_pairs_whole_patches():
    first_angle = draw_samples(groups=3, pixels=5)
    other_samples = draw_samples(groups=3, pixels=4, seed=2)
    # Scans of the second angle may have the same names and patch numbers as those of the first, or others.
    other_groups = np.char.add("at 55 ", other_samples.groups)
    renumbered = Samples(other_samples.x, other_samples.names, other_groups, other_samples.patches + 1000)
    for second_angle in (other_samples, renumbered):
        both_angles = first_angle.join(second_angle)
        # Three scans of six materials; of 5 and 4 pixels of a patch, 4 are paired.
        assert both_angles.names.size == 3 * 6 * 4
        for patch in np.unique(both_angles.patches):
            of_patch = both_angles.patches == patch
            # The first four features are those of the first angle, the last four those of the second.
            source = {tuple(row) for row in first_angle.x[first_angle.patches == patch]}
            assert all(tuple(row) in source for row in both_angles.x[of_patch, :4])
            partner = [np.flatnonzero((second_angle.x == row).all(axis=1))[0] for row in both_angles.x[of_patch, 4:]]
            assert np.unique(second_angle.patches[partner]).size == 1
            assert set(second_angle.names[partner]) == set(both_angles.names[of_patch])
    other_materials = np.char.add("x", other_samples.names)
    with expect_refusal(ErrorCode.MISMATCH):
        first_angle.join(Samples(other_samples.x, other_materials, other_samples.groups, other_samples.patches))


def test_a_single_channel_is_not_more_accurate_than_all_together():
    data = draw_samples(groups=4, offset=0.005)
    together = score(data, DISCRIMINANT_MODEL)
    # 0.02 is the chance of 480 pixels.
    assert all(score(data, DISCRIMINANT_MODEL, channel).pixels <= together.pixels + 0.02 for channel in CHANNELS)
    for table in (together.confusion, together.patch_confusion):
        assert table.shape == (6, 6)
        np.testing.assert_allclose(table.sum(axis=1), 1)


def test_one_scan_is_refused():
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA):
        score(draw_samples(groups=1), PAPER_MODEL)


def test_the_paper_s_distance_is_what_scikit_learn_votes_with():
    """lambda_H |dH| + lambda_V |dV| with no P is a Manhattan distance, which scikit-learn computes by itself."""
    from sklearn.neighbors import KNeighborsClassifier

    data = draw_samples(noise=0.02)
    queries = draw_samples(noise=0.02, seed=9)
    lambda_h, lambda_v = 3.0, 0.7
    our_model = PaperKnn(weights=Weights(lambda_h, lambda_v, 0.0, neighbours=7)).fit(data)
    our_names, _ = our_model.classify_pixels(queries.x)
    scale = [lambda_h, lambda_v]
    sklearn_model = KNeighborsClassifier(7, metric="manhattan").fit(data.x[:, :2] * scale, data.names)
    sklearn_names = sklearn_model.predict(queries.x[:, :2] * scale)
    # Ties may be decided either way.
    assert (our_names == sklearn_names).mean() > 0.99


def test_a_channel_without_information_gets_a_small_weight():
    data = draw_samples(groups=5, pixels=10)
    # Noise of 1 is as large as the features themselves. Feature 0 is |H|, feature 1 is |V|.
    noise = np.random.default_rng(3).standard_normal(len(data.x))
    noisy_h = data.x.copy()
    noisy_h[:, 0] += noise
    noisy_v = data.x.copy()
    noisy_v[:, 1] += noise
    fit_noisy_h = fit_weights(Samples(noisy_h, data.names, data.groups, data.patches))
    fit_noisy_v = fit_weights(Samples(noisy_v, data.names, data.groups, data.patches))
    assert fit_noisy_h.weights.h / fit_noisy_h.weights.v < fit_noisy_v.weights.h / fit_noisy_v.weights.v
    # H, which is noise, is as good as chance, 1/6, and V names 99 % of the pixels right.
    assert fit_noisy_h.by_channel["h"] < 0.35 < fit_noisy_h.by_channel["v"]


def test_one_odd_specimen_does_not_make_a_material_accept_any_pixel():
    """The nearest neighbours accept pixels up to a distance: at most three times the median one of all materials."""
    data = draw_samples(groups=6, noise=0.003)
    is_in_patch = data.patches == data.patches[data.names == "m2"][0]
    moved = data.x.copy()
    moved[is_in_patch] += 5 * np.ptp(data.x, axis=0)
    thresholds = fit_weights(Samples(moved, data.names, data.groups, data.patches)).thresholds
    assert thresholds["m2"] <= 3 * np.median(list(thresholds.values())) * (1 + 1e-9)


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.sampled_from([0.0, np.inf, np.nan]))
def test_the_median_of_each_patch_is_that_of_its_values_alone(seed, patches, odd_one):
    rng = np.random.default_rng(seed)
    # Each patch has a pixel at least, and twelve more are of any patch.
    patch = rng.permutation(np.concatenate([np.arange(patches), rng.integers(0, patches, 12)]))
    # There are only four different values, so that many pixels have the same.
    values = rng.integers(0, 4, patch.size) / 4
    values[rng.integers(patch.size)] = odd_one
    expected = [np.median(values[patch == i]) for i in range(patches)]
    assert np.array_equal(compute_patch_medians(values, patch), expected, equal_nan=True)


@pytest.mark.parametrize("steps", [None, 5])
def test_pixels_left_out_are_named_by_most_of_the_nearest_of_other_scans(steps):
    """The five nearest vote, written out pixel by pixel.

    With `steps` distances have five values only: of pixels that are equally far any may vote, and the accuracy lies
    between those of the worst and the best choice.
    """
    rng = np.random.default_rng(4)
    names = np.repeat(np.array(["acrylic", "copper", "rubber"]), 8)
    scans = np.tile(np.array(["a", "b", "c", "d"]), 6)
    pixels = Samples(np.ones((24, 4)), names, scans, np.arange(24))
    distance = rng.random((24, 24))
    if steps is not None:
        distance = np.floor(distance * steps)
    same_scan = scans[:, None] == scans[None, :]
    surely_right = []
    possibly_right = []
    for pixel in range(24):
        other_pixels = np.flatnonzero(~same_scan[pixel])
        # The fifth smallest distance
        limit = np.sort(distance[pixel, other_pixels])[4]
        nearer = names[other_pixels[distance[pixel, other_pixels] < limit]]
        as_far = names[other_pixels[distance[pixel, other_pixels] == limit]]
        votes_left = 5 - nearer.size
        is_right = set()
        for chosen in combinations(as_far.tolist(), votes_left):
            votes = Counter([*nearer.tolist(), *chosen])
            # The name with the most votes, and of equals the first in the alphabet
            winner = min(votes, key=lambda name: (-votes[name], name))
            is_right.add(winner == names[pixel])
        surely_right.append(is_right == {True})
        possibly_right.append(True in is_right)
    accuracy = _LeftOut.prepare(pixels, same_scan, 5).accuracy(distance)
    assert np.mean(surely_right) - 1e-9 <= accuracy <= np.mean(possibly_right) + 1e-9
    assert steps is not None or np.mean(surely_right) == np.mean(possibly_right)
