"""What the patches of a scan share, and what they are: names have the probability with which they are right."""

from __future__ import annotations

import numpy as np
import pytest

from polysight.materials.discriminant import CommonError, Patches, costs, explanations, probabilities

ROW = np.arange(7.0)[:, None] * np.array([1.0, 0.0, 0.3])
"""Materials in a row: a common error of one step makes each look like its neighbour."""
OWN, COMMON = 0.2, 0.8
COUNT = 4


def never(_: CommonError) -> np.ndarray:
    """None of the materials is out of the question."""
    return np.full(COUNT, 1e6)


def before() -> CommonError:
    width = ROW.shape[1]
    known = COMMON**2 * np.eye(width)
    return CommonError(
        np.tile(np.eye(width), (COUNT, 1, 1)), np.zeros(width), known, np.asarray(np.linalg.inv(known), np.float64)
    )


def drawn(seed: int) -> tuple[np.ndarray, Patches]:
    """What four patches are, and what is seen of them under an error that is drawn as it is known."""
    rng = np.random.default_rng(seed)
    truth = rng.choice(len(ROW), COUNT, replace=False)
    common, own = COMMON * rng.standard_normal(3), OWN * rng.standard_normal((COUNT, 3))
    mean = (ROW[truth] + common + own)[:, None] - ROW
    return truth, Patches(mean, np.tile(OWN**2 * np.eye(3), (COUNT, len(ROW), 1, 1)), np.ones(COUNT, bool))


def named(seen: Patches, found: list[tuple[float, CommonError]]) -> np.ndarray:
    """Probability of each material [patch, materials]."""
    out = np.zeros(seen.mean.shape[:2])
    for weight, error in found:
        _, cost = costs(seen.mean - error.shift[:, None], seen.own + error.spread[:, None])
        out += weight * probabilities(cost, never(error))[:, :-1]
    return out


def exact(seen: Patches) -> np.ndarray:
    """The same from every way to name the patches: the integral over the error of each is Gaussian."""
    kinds = np.stack(np.meshgrid(*[range(len(ROW))] * COUNT, indexing="ij"), -1).reshape(-1, COUNT)
    off = seen.mean[np.arange(COUNT), kinds]  # [ways, patch, 3]
    whole = np.kron(np.full((COUNT, COUNT), COMMON**2) + OWN**2 * np.eye(COUNT), np.eye(3))
    flat = off.reshape(len(kinds), -1)
    log_w = -0.5 * np.einsum("ni,ni->n", flat, np.linalg.solve(whole, flat.T).T)
    w = np.exp(log_w - log_w.max())
    return np.stack([np.bincount(kinds[:, p], w, len(ROW)) for p in range(COUNT)]) / w.sum()


def test_every_explanation_counts_with_its_evidence():
    away, right, sure, alone = [], 0, 0.0, []
    for seed in range(60):
        truth, seen = drawn(seed)
        found = explanations(seen, before(), never)
        assert sum(w for w, _ in found) == pytest.approx(1)
        mine, true = named(seen, found), exact(seen)
        away.append(np.abs(mine - true).max())
        alone.append(np.abs(named(seen, [(1.0, found[0][1])]) - true).max())
        right, sure = right + np.sum(mine.argmax(axis=1) == truth), sure + mine.max(axis=1).sum()
    assert np.mean(away) < 0.05  # of the exact posterior
    assert np.mean(alone) > 2 * np.mean(away)  # the likeliest explanation by itself is too sure
    assert right / sure == pytest.approx(1, abs=0.1)


def test_one_patch_tells_nothing_of_the_error():
    _, seen = drawn(1)
    one = Patches(seen.mean, seen.own, np.arange(COUNT) == 0)
    start = before()
    assert explanations(one, start, never) == [(1.0, start)]


def test_patches_that_are_none_of_the_materials_tell_nothing():
    _, seen = drawn(2)
    found = explanations(seen, before(), lambda _: np.full(COUNT, -1e6))
    assert len(found) == 1
    np.testing.assert_allclose(found[0][1].value, 0, atol=1e-9)
    np.testing.assert_allclose(found[0][1].covariance, COMMON**2 * np.eye(3), rtol=1e-6)
