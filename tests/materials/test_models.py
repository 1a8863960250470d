"""Classifiers judged on what they have not seen: a split by pixel flatters, a split by scan does not."""

import numpy as np
import pytest

from host.materials.models import CHANNELS, MODELS, Samples, best_model, feature_matrix, score
from shared.errors import DataError


def samples(materials=6, groups=6, pixels=20, offset=0.0, noise=0.01, seed=0, angle=0.0):
    """Materials in a row of V/H; `offset`: what all pixels of a patch share (placement, reference)."""
    rng = np.random.default_rng(seed)
    x, names, group, patch = [], [], [], []
    for g in range(groups):
        for m in range(materials):
            q = 0.1 + 0.05 * m + angle + 0.02j * m + offset * complex(*rng.standard_normal(2))
            q = q + noise * (rng.standard_normal(pixels) + 1j * rng.standard_normal(pixels))
            h = 0.7 + 0.002 * m + noise * rng.standard_normal(pixels)
            x.append(feature_matrix(h, np.abs(q) * h, 1 / q))
            names += [f"m{m}"] * pixels
            group += [f"s{g}"] * pixels
            patch += [g * materials + m] * pixels
    return Samples(np.concatenate(x), np.array(names), np.array(group), np.array(patch))


@pytest.mark.parametrize("model", MODELS)
def test_every_model_learns_what_is_there_to_learn(model):
    assert score(samples(noise=0.003), model).pixels > 0.97


@pytest.mark.parametrize("model", MODELS)
def test_no_model_finds_what_is_not_there(model):
    data = samples(materials=4)
    rng = np.random.default_rng(1)
    noise = Samples(rng.standard_normal(data.x.shape), data.names, data.groups, data.patches)
    assert score(noise, model).pixels == pytest.approx(0.25, abs=0.08)


def test_a_split_by_pixel_flatters():
    """What the pixels of a patch share is learnt by heart when they stand on both sides of the split."""
    data = samples(offset=0.03, noise=0.003)
    honest = score(data, "weighted KNN (paper)")
    flattering = score(data, "weighted KNN (paper)", by_pixel=True)
    assert flattering.pixels > honest.pixels + 0.15
    assert "optimistic" in flattering.split


def test_order_and_names_do_not_matter():
    data = samples(offset=0.02)
    rng = np.random.default_rng(5)
    at = rng.permutation(len(data.names))
    shuffled = Samples(data.x[at], data.names[at], data.groups[at], data.patches[at])
    for model in ("weighted KNN (paper)", "quadratic discriminant"):
        assert score(shuffled, model).pixels == pytest.approx(score(data, model).pixels, abs=1e-9)


def test_no_pixel_of_a_test_scan_is_ever_trained_on(monkeypatch):
    seen = []

    class Spy:
        def fit(self, x, y):
            self.known = {row.tobytes() for row in x}
            self.name = y[0]
            return self

        def predict(self, x):
            seen.append(any(row.tobytes() in self.known for row in x))
            return np.full(len(x), self.name)

    monkeypatch.setitem(MODELS, "spy", Spy)
    data = samples()
    copied = Samples(data.x.copy(), data.names, data.groups, data.patches)
    copied.x[1::2] = copied.x[::2]  # twins within a patch
    score(copied, "spy")
    assert not any(seen)
    score(copied, "spy", by_pixel=True)
    assert any(seen)


def test_a_second_angle_helps():
    one = samples(groups=16, offset=0.02, seed=1)
    both = one.joined(samples(groups=16, offset=0.02, seed=2, angle=0.05))
    assert both.x.shape[1] == 2 * one.x.shape[1]
    assert score(both, "linear discriminant").pixels > score(one, "linear discriminant").pixels


def test_channels_alone_know_less():
    data = samples(offset=0.005)
    together = score(data, "linear discriminant")
    assert all(score(data, "linear discriminant", c).pixels <= together.pixels + 0.01 for c in CHANNELS)
    assert together.confusion.shape == (6, 6)
    np.testing.assert_allclose(together.confusion.sum(axis=1), 1)


def test_the_best_is_chosen_and_one_scan_is_refused():
    name, scores = best_model(samples(groups=4, pixels=10))
    assert max(scores, key=lambda s: s.pixels).model == name
    with pytest.raises(DataError, match="1 scan"):
        score(samples(groups=1), name)
