"""The discriminant of error sources: it finds their sizes, frees a scan of its reference's error, rejects strangers."""

import numpy as np
import pytest

from host.materials.discriminant import REJECTED, ErrorDiscriminant
from host.materials.judge import score, strangers
from host.materials.models import DISCRIMINANT
from host.materials.samples import Samples, feature_matrix

MEANS = np.array([[-0.6, -2.0, 0.1], [-0.55, -1.9, 0.2], [-0.5, -2.2, 3.1], [-0.4, -1.5, -3.1], [-0.3, -1.2, 0.5]])
"""ln|H|, ln|V| and arg P of five materials; two of them lie on either side of 180 degrees."""


def drawn(seed=0, scans=8, pixels=12, scan=0.02, patch=0.01, pixel=0.03, means=MEANS):
    """Pixels of every material in every scan with errors of three sources, in all three features alike."""
    rng = np.random.default_rng(seed)
    shape = (scans, len(means), pixels, 3)
    z = np.array(means)[None, :, None] + scan * rng.standard_normal((scans, 1, 1, 3))
    z = z + patch * rng.standard_normal((*shape[:2], 1, 3)) + pixel * rng.standard_normal(shape)
    h, v = np.exp(z[..., 0]).ravel(), np.exp(z[..., 1]).ravel()
    x = feature_matrix(h, v, h / v * np.exp(1j * z[..., 2].ravel()))
    s, m, _ = np.indices(shape[:3])
    names, groups = np.char.add("m", m.ravel().astype(str)), np.char.add("s", s.ravel().astype(str))
    return Samples(x, names, groups, (s * len(means) + m).ravel())


def test_the_sizes_of_the_errors_are_found():
    found = [ErrorDiscriminant().fit(drawn(seed, scans=40)) for seed in range(6)]
    for covariances, size in (
        ([f.within[0] for f in found], 0.03),
        ([f.between[0] for f in found], 0.01),
        ([f.scan for f in found], 0.02),
    ):
        mean = np.mean(covariances, axis=0)
        assert np.sqrt(np.diag(mean)) == pytest.approx(size, rel=0.15)
        assert np.abs(mean - np.diag(np.diag(mean))).max() < 0.2 * size**2


def test_an_error_that_all_patches_of_a_scan_share_changes_no_name():
    near = [[-0.6 + 0.08 * i, -2.0, 0.1] for i in range(5)]
    model = ErrorDiscriminant().fit(drawn(0, means=near))
    test = drawn(1, scans=1, scan=0.0, means=near)
    gains = np.array([1.03, 0.96]), np.exp(0.04j)
    h, v = test.x[:, 0] * gains[0][0], test.x[:, 1] * gains[0][1]
    p = gains[1] * gains[0][0] / gains[0][1] / (test.x[:, 2] + 1j * test.x[:, 3])
    moved = feature_matrix(h, v, p)
    here, there = model.by_scan(test.x, test.patches), model.by_scan(moved, test.patches)
    assert here.names.tolist() == there.names.tolist() == [f"m{i}" for i in range(5)]
    alone = (model.by_pixel(moved)[0] == test.names).mean()
    assert (there.pixel_names == test.names).mean() > alone


def test_a_phase_of_180_degrees_is_no_edge():
    assert score(drawn(2), DISCRIMINANT).patches == 1.0


def test_a_patch_alone_is_named_as_before_and_scans_do_not_touch_each_other():
    model = ErrorDiscriminant().fit(drawn(0))
    test = drawn(3, scans=1)
    for patch in np.unique(test.patches):
        at = test.patches == patch
        one = model.by_scan(test.x[at], test.patches[at])
        assert one.patches.tolist() == [patch]
        assert one.names[0] == test.names[at][0]
        assert one.pixel_names.tolist() == model.by_pixel(test.x[at])[0].tolist()


def test_known_patches_are_called_unknown_at_the_stated_rate():
    rates = [score(drawn(seed, pixels=6), DISCRIMINANT).unknown for seed in range(12)]
    assert np.mean(rates) == pytest.approx(REJECTED, abs=0.015)


def test_probabilities_mean_what_they_say():
    """Of the patches named with confidence c, a share c is named right."""
    near = [[-0.6 + 0.02 * i, -2.0, 0.1] for i in range(5)]
    model = ErrorDiscriminant().fit(drawn(0, scans=60, means=near))
    sure, right = [], []
    for seed in range(60):
        test = drawn(100 + seed, scans=1, means=near)
        found = model.by_scan(test.x, test.patches)
        sure += found.confidence.tolist()
        right += [name == f"m{i}" for i, name in enumerate(found.names)]
    assert 0.4 < np.mean(right) < 0.95
    assert np.mean(sure) == pytest.approx(np.mean(right), abs=0.1)


def test_a_material_that_was_never_learnt_is_unknown():
    missed = strangers(drawn(4), DISCRIMINANT)
    assert set(missed) == {f"m{i}" for i in range(5)}
    assert min(missed.values()) > 0.9


def test_a_stranger_does_not_shift_the_others():
    model = ErrorDiscriminant().fit(drawn(0))
    test, strange = drawn(5, scans=1), drawn(6, scans=1, means=[[-1.5, -3.5, 1.5]] * 3)
    alone = model.by_scan(test.x, test.patches)
    joint = model.by_scan(np.concatenate([test.x, strange.x]), np.concatenate([test.patches, strange.patches + 100]))
    assert joint.names[:5].tolist() == alone.names.tolist()
    assert (joint.distance[5:] > 1).all()
    assert joint.distance[:5] == pytest.approx(alone.distance, abs=1e-3)


def test_two_angles_are_independent_and_tell_more():
    one, two = drawn(0, pixel=0.1, patch=0.05), drawn(1, pixel=0.1, patch=0.05)
    both = one.joined(two)
    model = ErrorDiscriminant().fit(both)
    for covariance in (model.scan, model.between[0], model.within[0]):
        assert np.abs(covariance[:3, 3:]).max() < 1e-12
    assert score(both, DISCRIMINANT).pixels > score(one, DISCRIMINANT).pixels
