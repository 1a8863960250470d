"""Compiled and plain passes over raw samples: the same results."""

import numpy as np
import pytest

from polysight.host.sync import numpy_passes as plain
from polysight.host.sync.align import align_row
from polysight.host.sync.high_pass_filter import Equaliser, high_pass
from polysight.host.sync.passes import passes_for

compiled = pytest.importorskip("polysight.host.sync.compiled", reason="numba is not installed")


@pytest.fixture(scope="module")
def words():
    rng = np.random.default_rng(4)
    n = np.arange(256)
    tones = np.exp(2j * np.pi * (0.2 * n[:, None] + 0.1 * rng.standard_normal((5, 6, 1, 1)) * n[:, None]))
    tones = tones * np.exp(1j * np.arange(4)) + 0.5 * rng.standard_normal((5, 6, 256, 4))
    return np.rint(1000 * np.stack([tones.real, tones.imag], axis=3)).astype(np.int16)


def same(one, other):
    """Equal to a millionth of the largest value."""
    for a, b in zip(one, other, strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_allclose(a, b, rtol=0, atol=2e-6 * max(1.0, float(np.abs(b).max())))


@pytest.mark.parametrize("linear", [(0, 192), (8, 204), (3, 243), (10, 90), (4, 24)])
def test_matches_agree(words, linear):
    reference = np.array([0, 5, 2, 1, 3])
    same(*(by.match(words, reference, linear) for by in (compiled, plain)))


@pytest.mark.parametrize(("samples", "linear"), [(255, (0, 192)), (193, (1, 193)), (198, (5, 181)), (37, (0, 36))])
def test_they_agree_on_any_number_of_samples(words, samples, linear):
    """Nothing depends on whole vectors, or on blocks that fill a chirp."""
    rng, reference = np.random.default_rng(2), np.array([0, 5, 2, 1, 3])
    words = np.ascontiguousarray(words[:, :, :samples])
    matches = plain.match(words, reference, linear)
    same(compiled.match(words, reference, linear), matches)
    frequency = matches[2][:, None] + matches[0]
    weights = ([0.1, 1, 0.2j] + 0.1 * rng.standard_normal((5, 6, 3))).astype(np.complex64)
    good = rng.uniform(size=(5, 6)) < 0.8
    same(*(by.against_others(words, frequency, weights, good, linear)[:-1] for by in (compiled, plain)))
    same(*(by.average(words, frequency, weights, good, linear) for by in (compiled, plain)))


def test_more_chirps_than_are_transformed_at_once_agree(words):
    many = np.concatenate([words] * 3, axis=1)
    assert many.shape[1] > 16
    reference = np.array([0, 17, 2, 9, 3])
    same(*(by.match(many, reference, (0, 192)) for by in (compiled, plain)))


@pytest.mark.parametrize("taps", [1, 3])
def test_products_with_the_others_and_the_average_agree(words, taps):
    rng = np.random.default_rng(1)
    frequency = 0.2 + 0.005 * rng.standard_normal((5, 6))
    weights = (rng.standard_normal((5, 6, taps)) + 1j * rng.standard_normal((5, 6, taps))).astype(np.complex64)
    good = rng.uniform(size=(5, 6)) < 0.8
    got, expected = (by.against_others(words, frequency, weights, good, (4, 196)) for by in (compiled, plain))
    same(got[:-1], expected[:-1])
    apart = np.angle(np.exp(1j * (got[-1] - expected[-1])))  # radians wrap
    assert np.abs(apart).max() < 1e-4
    args = (words, frequency, weights * good[..., None], rng.uniform(size=(5, 6)) < 0.5, (5, 197))
    same(*(by.average(*args) for by in (compiled, plain)))


def test_three_receivers_take_the_plain_passes(words):
    """Compiled loops are for four; what they give up is only speed."""
    assert passes_for(3) is plain
    one = align_row(words[..., :3], np.ones(words.shape[:2], bool), (0, 192))
    assert one.good.all()


def test_a_whole_row_agrees_and_the_compiled_passes_are_used(rig, words):
    assert passes_for(4) is compiled
    valid = np.ones(words.shape[:2], bool)
    valid[2, 3] = False
    equaliser = Equaliser.of(high_pass(rig.chirp), rig.chirp, 4)
    one, other = (align_row(words, valid, (0, 192), equaliser, by=by) for by in (compiled, plain))
    np.testing.assert_array_equal(one.good, other.good)
    np.testing.assert_allclose(one.mean, other.mean, atol=1e-5 * np.abs(other.mean).max())
    np.testing.assert_allclose(one.frequency, other.frequency, atol=1e-8)
    np.testing.assert_allclose(np.exp(1j * one.phase), np.exp(1j * other.phase), atol=1e-5)
