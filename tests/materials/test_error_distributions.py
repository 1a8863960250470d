"""Parts of the discriminant of error sources, and odds of kinds, compared with textbook formulas."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.stats

from polysight.materials.discriminant import (
    _append_none,
    _clip_eigenvalues,
    _fit_two_way,
    costs,
    estimate_common_error,
    shares_of_materials,
)
from polysight.materials.kinds import _compute_shares, _tabulate_coordinate_density
from polysight.materials.names import _evaluate_normal, weigh_kinds

COVARIANCES = np.array([[[2.0, 0.5], [0.5, 1.0]], [[0.5, -0.1], [-0.1, 0.3]]])
DEVIATIONS = np.random.default_rng(1).normal(size=(5, 2, 2))


def test_costs_are_those_of_normal_distributions():
    distance2, cost = costs(DEVIATIONS, COVARIANCES)
    for material, covariance in enumerate(COVARIANCES):
        law = scipy.stats.multivariate_normal(np.zeros(2), covariance)
        np.testing.assert_allclose(cost[:, material], -2 * law.logpdf(DEVIATIONS[:, material]))
        for patch, deviation in enumerate(DEVIATIONS[:, material]):
            assert distance2[patch, material] == pytest.approx(deviation @ np.linalg.inv(covariance) @ deviation)


def test_shares_are_likelihoods_over_their_sum():
    shares = shares_of_materials(np.array([[0.0, 2.0, 4.0], [1000.0, 1002.0, 9000.0]]))
    weight = np.exp([0.0, -1.0, -2.0])
    np.testing.assert_allclose(shares[0], weight / weight.sum())
    np.testing.assert_allclose(shares[1], [1 / (1 + np.exp(-1)), np.exp(-1) / (1 + np.exp(-1)), 0.0])


def test_an_error_that_patches_share_is_their_posterior_mean():
    """One material, patches far within the threshold: the normal prior times a normal likelihood for each patch."""
    prior = np.array([[0.04, 0.01], [0.01, 0.09]])
    own = np.array([[[0.02, 0.0], [0.0, 0.01]]])
    mean = np.random.default_rng(2).normal(0.1, 0.1, (6, 1, 2))
    value, covariance = estimate_common_error(mean, own, prior, level=1e4)
    expected_covariance = np.linalg.inv(np.linalg.inv(prior) + 6 * np.linalg.inv(own[0]))
    np.testing.assert_allclose(covariance, expected_covariance, rtol=1e-6)
    np.testing.assert_allclose(value, expected_covariance @ np.linalg.inv(own[0]) @ mean[:, 0].sum(axis=0), rtol=1e-6)
    # Patches far from every material say nothing, and neither does a single one.
    value, covariance = estimate_common_error(mean + 100, own, prior, level=1.0)
    np.testing.assert_allclose(value, 0.0, atol=1e-9)
    np.testing.assert_allclose(covariance, prior)
    value, covariance = estimate_common_error(mean[:1], own, prior, level=1e4)
    assert (value == 0).all()
    assert covariance is prior


def test_levels_and_offsets_are_those_of_least_squares():
    """A balanced design of three materials in four scans; one patch of each is metal, which has no offset."""
    rng = np.random.default_rng(3)
    material = np.repeat([0, 1, 2], 4)
    scan = np.tile([0, 1, 2, 3], 3)
    mean = rng.normal(size=(12, 2))
    offset, level = _fit_two_way(mean, material, scan, np.ones(12, bool))
    design = np.hstack([np.eye(3)[material], np.eye(4)[scan]])
    fitted = design @ np.linalg.lstsq(design, mean, rcond=None)[0]
    np.testing.assert_allclose(level[material] + offset[scan], fitted, atol=1e-9)
    np.testing.assert_allclose(offset.mean(axis=0), 0.0, atol=1e-12)
    informative = material < 2
    offset, level = _fit_two_way(mean, material, scan, informative)
    np.testing.assert_allclose(level[2], mean[material == 2].mean(axis=0))
    alone, _ = _fit_two_way(mean, material, scan, scan != 3)
    assert (alone[3] == 0).all()


def test_the_nearest_matrix_without_negative_eigenvalues():
    values, vectors = np.linalg.eigh(np.array([[1.0, 2.0], [2.0, 1.0]]))
    assert values[0] == pytest.approx(-1)
    np.testing.assert_allclose(
        _clip_eigenvalues(np.array([[1.0, 2.0], [2.0, 1.0]])), 3 * np.outer(vectors[:, 1], vectors[:, 1])
    )
    positive = np.array([[2.0, 0.5], [0.5, 1.0]])
    np.testing.assert_allclose(_clip_eigenvalues(positive), positive)


def test_at_the_threshold_half_of_the_probability_is_that_of_no_material():
    probability = _append_none(np.array([[0.75, 0.25]] * 3), np.array([[0.0, 0.0], [-50.0, -50.0], [50.0, 50.0]]))
    np.testing.assert_allclose(probability, [[0.375, 0.125, 0.5], [0.75, 0.25, 0.0], [0.0, 0.0, 1.0]], atol=1e-12)


def make_kinds(t: list[complex], effects: np.ndarray, **changes: Any) -> Any:
    fields: dict[str, Any] = {
        "t": np.array(t), "effects": effects, "share": np.array([0.6, 0.4, 0.5]),
        "in_library": np.array([True, True, False]), "sheets": np.array([0.9 + 0.1j, 0.4 - 0.2j, 0.5]),
        "sheet_brightness_off": np.zeros(3), "sheet_share": 0.15, "other": 0.3, "theta_rad": 0.7,
        "compute_half_space_density": lambda *_: 0.8,
    }  # fmt: skip
    return SimpleNamespace(**(fields | changes))


def make_evidence(t: complex, covariance: np.ndarray, library_share: float = 0.5) -> Any:
    return SimpleNamespace(
        inverse_ratio=t, covariance=covariance, library_share=library_share, dispersion=None, brightness_off=np.nan
    )


def test_odds_of_kinds_are_bayes_rule_with_sheets_and_other_half_spaces():
    """The odds of other materials count 1.8 times; drawn sheets are widened by the kernel's 0.02."""
    effects = np.random.default_rng(4).uniform(-0.05, 0.05, (3, 2, 2))
    t = [0.5 + 0.1j, 0.62 + 0.0j, 0.45 + 0.2j]
    errors = np.array([[0.004, 0.001], [0.001, 0.003]])
    measured = 0.52 + 0.08j
    odds = weigh_kinds([make_kinds(t, effects)], [make_evidence(measured, errors, 0.4)])

    def density(mean: complex, covariance: np.ndarray) -> float:
        law = scipy.stats.multivariate_normal([mean.real, mean.imag], covariance)
        return float(law.pdf([measured.real, measured.imag]))

    library_share = 0.4 / (0.4 + 1.8 * 0.6)
    of_kind = [library_share, library_share, 1 - library_share]
    share = [0.6, 0.4, 0.5]
    weight = np.array(
        [
            of_kind[k] * share[k] * density(t[k], effects[k] @ effects[k].T + errors + 1e-10 * np.eye(2))
            for k in range(3)
        ]
    )
    sheets = [density(sheet, errors + 0.02**2 * np.eye(2)) for sheet in (0.9 + 0.1j, 0.4 - 0.2j, 0.5 + 0j)]
    sheet = (1 - library_share) * 0.15 * np.mean(sheets)
    other = (1 - library_share) * 0.3 * 0.8
    total = weight.sum() + sheet + other
    assert (odds.distance < 1).all()
    np.testing.assert_allclose(odds.kinds, weight / total)
    assert odds.sheet == pytest.approx(sheet / total)
    assert odds.other == pytest.approx(other / total)
    for k in range(3):
        difference = np.array([(measured - t[k]).real, (measured - t[k]).imag])
        covariance = effects[k] @ effects[k].T + errors
        squared = difference @ np.linalg.solve(covariance, difference)
        assert odds.distance[k] == pytest.approx(np.sqrt(squared / scipy.stats.chi2.ppf(0.99, 2)), rel=1e-6)


def test_a_kind_beyond_its_region_has_no_probability():
    errors = 1e-4 * np.eye(2)
    effects = np.zeros((3, 2, 2))
    # 99 % of a normal distribution of two parts is within 3.03 standard deviations.
    for off, is_possible in ((0.0300, True), (0.0306, False)):
        odds = weigh_kinds([make_kinds([0.5 + off, 5.0, 9.0], effects)], [make_evidence(0.5, errors)])
        assert (odds.kinds[0] > 0) == is_possible
        assert odds.kinds.sum() + odds.sheet + odds.other == pytest.approx(1.0)


def test_without_any_density_a_patch_is_of_no_kind():
    nothing = make_kinds([90.0, 95.0, 99.0], np.zeros((3, 2, 2)), other=0.0, sheet_share=0.0)
    odds = weigh_kinds([nothing], [make_evidence(0.5, 1e-4 * np.eye(2))])
    assert (odds.kinds.tolist(), odds.sheet, odds.other) == ([0.0, 0.0, 0.0], 0.0, 1.0)


def test_a_density_of_two_scans_is_that_of_four_numbers():
    covariance = np.diag([1.0, 2.0, 3.0, 4.0]) + 0.1
    draws = np.array([[0.5 + 0.2j, 1.0 - 1j], [0.0, 2.0j]])
    mean = np.array([0.1j, 1.0])
    law = scipy.stats.multivariate_normal([0.0, 0.1, 1.0, 0.0], covariance)
    expected = [law.pdf([0.5, 0.2, 1.0, -1.0]), law.pdf([0.0, 0.0, 0.0, 2.0])]
    np.testing.assert_allclose(_evaluate_normal(draws, mean, covariance), expected)


def test_half_spaces_of_no_kind_have_a_density_over_all_of_their_range():
    """Over ln eps' and asinh(eps'' / 0.05) it sums up to one; a fifth of it is even, the rest near the literature."""
    table, real_axis, loss_axis = _tabulate_coordinate_density()
    assert (np.exp(real_axis[[0, -1]])).tolist() == pytest.approx([1.2, 30.0])
    assert (0.05 * np.sinh(loss_axis[[0, -1]])).tolist() == pytest.approx([0.0, 30.0])
    assert np.trapezoid(np.trapezoid(table, loss_axis), real_axis) == pytest.approx(1.0, rel=0.02)
    area = np.log(30 / 1.2) * np.arcsinh(30 / 0.05)
    assert table.min() == pytest.approx(0.2 / area, rel=1e-3)


@pytest.mark.parametrize(("sheets", "others"), [(0.0, 0.5), (0.3, 0.35)])
def test_kinds_of_a_source_share_its_part(sheets, others):
    """Metal 0.1, literature 0.4, other half spaces 0.5 of what is in no library; thin plates take theirs from these."""
    kinds: Any = [
        SimpleNamespace(source=source, permittivity=eps)
        for source, eps in (
            ("library", 3.0),
            ("library", None),
            ("literature", 4.0),
            ("literature", 5.0),
            ("literature", None),
        )
    ]
    shares, other = _compute_shares(kinds, sheets)
    left = 1 - sheets
    np.testing.assert_allclose(shares, [0.5, 0.5, 0.2 * left, 0.2 * left, 0.1 * left])
    assert other == pytest.approx(others)
    assert shares[2:].sum() + other == pytest.approx(left)
    shares, other = _compute_shares(kinds[:2], sheets)
    assert shares.tolist() == [0.5, 0.5]
    assert other == pytest.approx(0.9 * left)
