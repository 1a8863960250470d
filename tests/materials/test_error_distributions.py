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
from polysight.materials.kinds import RatioEvidence, _compute_shares, _tabulate_coordinate_density
from polysight.materials.names import _evaluate_normal, weigh_kinds

# Covariances of two materials, and the deviations of five patches from the mean of each: any numbers.
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
    """A cost is -2 ln of the likelihood. Likelihoods as small as exp(-500), in the second patch, keep their ratio."""
    shares = shares_of_materials(np.array([[0.0, 2.0, 4.0], [1000.0, 1002.0, 9000.0]]))
    weight = np.exp([0.0, -1.0, -2.0])
    np.testing.assert_allclose(shares[0], weight / weight.sum())
    np.testing.assert_allclose(shares[1], [1 / (1 + np.exp(-1)), np.exp(-1) / (1 + np.exp(-1)), 0.0])


def test_an_error_that_patches_share_is_their_posterior_mean():
    """One material and six patches: the normal prior times a normal likelihood for each patch.

    The threshold `level` beyond which a patch belongs to no material is far away.
    """
    prior = np.array([[0.04, 0.01], [0.01, 0.09]])
    patch_covariance = np.array([[[0.02, 0.0], [0.0, 0.01]]])
    deviations = np.random.default_rng(2).normal(0.1, 0.1, (6, 1, 2))
    value, covariance = estimate_common_error(deviations, patch_covariance, prior, level=1e4)
    patch_precision = np.linalg.inv(patch_covariance[0])
    expected_covariance = np.linalg.inv(np.linalg.inv(prior) + 6 * patch_precision)
    expected_value = expected_covariance @ patch_precision @ deviations[:, 0].sum(axis=0)
    np.testing.assert_allclose(covariance, expected_covariance, rtol=1e-6)
    np.testing.assert_allclose(value, expected_value, rtol=1e-6)
    # Patches that are far from every material do not change the prior, and neither does a single patch.
    value, covariance = estimate_common_error(deviations + 100, patch_covariance, prior, level=1.0)
    np.testing.assert_allclose(value, 0.0, atol=1e-9)
    np.testing.assert_allclose(covariance, prior)
    value, covariance = estimate_common_error(deviations[:1], patch_covariance, prior, level=1e4)
    assert (value == 0).all()
    assert covariance is prior


def test_levels_of_materials_and_offsets_of_scans_are_those_of_least_squares():
    """Each of three materials is in each of four scans: value = level of its material + offset of its scan."""
    rng = np.random.default_rng(3)
    material = np.repeat([0, 1, 2], 4)
    scan = np.tile([0, 1, 2, 3], 3)
    patch_means = rng.normal(size=(12, 2))
    offset, level = _fit_two_way(patch_means, material, scan, np.ones(12, bool))
    design = np.hstack([np.eye(3)[material], np.eye(4)[scan]])
    fitted = design @ np.linalg.lstsq(design, patch_means, rcond=None)[0]
    np.testing.assert_allclose(level[material] + offset[scan], fitted, atol=1e-9)
    np.testing.assert_allclose(offset.mean(axis=0), 0.0, atol=1e-12)
    # The third material is metal, which has no offset: its level is the plain mean.
    shares_the_offset = material < 2
    offset, level = _fit_two_way(patch_means, material, scan, shares_the_offset)
    np.testing.assert_allclose(level[2], patch_means[material == 2].mean(axis=0))
    # The last scan has only metal: its offset is not known, and 0.
    offset, _ = _fit_two_way(patch_means, material, scan, scan != 3)
    assert (offset[3] == 0).all()


def test_negative_eigenvalues_of_a_matrix_become_zero():
    # Its eigenvalues are -1 and 3.
    matrix = np.array([[1.0, 2.0], [2.0, 1.0]])
    values, vectors = np.linalg.eigh(matrix)
    assert values[0] == pytest.approx(-1)
    np.testing.assert_allclose(_clip_eigenvalues(matrix), 3 * np.outer(vectors[:, 1], vectors[:, 1]))
    positive = np.array([[2.0, 0.5], [0.5, 1.0]])
    np.testing.assert_allclose(_clip_eigenvalues(positive), positive)


def test_at_the_threshold_half_of_the_probability_is_that_of_no_material():
    shares = np.array([[0.75, 0.25]] * 3)
    # Chi-square of three patches minus the threshold: at it, far inside and far outside.
    beyond_threshold = np.array([[0.0, 0.0], [-50.0, -50.0], [50.0, 50.0]])
    probability = _append_none(shares, beyond_threshold)
    np.testing.assert_allclose(probability, [[0.375, 0.125, 0.5], [0.75, 0.25, 0.0], [0.0, 0.0, 1.0]], atol=1e-12)


def make_kinds(t: list[complex], effects: np.ndarray, **changes: Any) -> Any:
    """Return a stand-in for `Kinds`: two kinds of the library and one of the literature, thin sheets, and half spaces.

    `t` is V / H of each kind, `effects` [3, 2, 2] how its two parts change with the kind's own spread.
    """
    fields: dict[str, Any] = {
        "t": np.array(t), "effects": effects, "share": np.array([0.6, 0.4, 0.5]),
        "in_library": np.array([True, True, False]), "sheets": np.array([0.9 + 0.1j, 0.4 - 0.2j, 0.5]),
        "sheet_brightness_off": np.zeros(3), "sheet_share": 0.15, "other": 0.3, "theta_rad": 0.7,
        "compute_half_space_density": lambda *_: 0.8,
    }  # fmt: skip
    return SimpleNamespace(**(fields | changes))


def make_evidence(t: complex, covariance: np.ndarray, library_share: float = 0.5) -> RatioEvidence:
    """Return the evidence of one scan whose |H| and change over the sweep are not used."""
    return RatioEvidence(0.7, t, covariance, library_share)


def test_odds_of_kinds_are_bayes_rule_with_sheets_and_other_half_spaces():
    """Each kind's share times its normal density of the measured ratio, over the sum of all."""
    effects = np.random.default_rng(4).uniform(-0.05, 0.05, (3, 2, 2))
    t = [0.5 + 0.1j, 0.62 + 0.0j, 0.45 + 0.2j]
    errors = np.array([[0.004, 0.001], [0.001, 0.003]])
    measured = 0.52 + 0.08j
    odds = weigh_kinds([make_kinds(t, effects)], [make_evidence(measured, errors, library_share=0.4)])

    def density(mean: complex, covariance: np.ndarray) -> float:
        law = scipy.stats.multivariate_normal([mean.real, mean.imag], covariance)
        return float(law.pdf([measured.real, measured.imag]))

    # The odds of materials that are not in the library count 1.8 times (`LOOK_ALIKE_ODDS`).
    library_share = 0.4 / (0.4 + 1.8 * 0.6)
    share_of_source = [library_share, library_share, 1 - library_share]
    share_in_source = [0.6, 0.4, 0.5]
    # 1e-10 keeps the covariance of a kind without a spread from being singular.
    densities = [density(t[k], effects[k] @ effects[k].T + errors + 1e-10 * np.eye(2)) for k in range(3)]
    weight = np.array(share_of_source) * share_in_source * densities
    # Sheets are drawn at random; each stands for a normal density about it with a standard deviation of 0.02.
    sheets = [density(sheet, errors + 0.02**2 * np.eye(2)) for sheet in (0.9 + 0.1j, 0.4 - 0.2j, 0.5 + 0j)]
    sheet = (1 - library_share) * 0.15 * np.mean(sheets)
    other = (1 - library_share) * 0.3 * 0.8
    total = weight.sum() + sheet + other
    assert (odds.distance < 1).all()
    np.testing.assert_allclose(odds.kinds, weight / total)
    assert odds.sheet == pytest.approx(sheet / total)
    assert odds.other == pytest.approx(other / total)
    # The distance is 1 at the edge of the 99 % region.
    for k in range(3):
        difference = np.array([(measured - t[k]).real, (measured - t[k]).imag])
        covariance = effects[k] @ effects[k].T + errors
        squared = difference @ np.linalg.solve(covariance, difference)
        assert odds.distance[k] == pytest.approx(np.sqrt(squared / scipy.stats.chi2.ppf(0.99, 2)), rel=1e-6)


def test_a_kind_beyond_its_99_percent_region_has_no_probability():
    errors = 0.01**2 * np.eye(2)
    effects = np.zeros((3, 2, 2))
    # 99 % of a normal distribution of two parts is within sqrt(-2 ln 0.01) = 3.03 standard deviations.
    for deviation, is_possible in ((0.0300, True), (0.0306, False)):
        odds = weigh_kinds([make_kinds([0.5 + deviation, 5.0, 9.0], effects)], [make_evidence(0.5, errors)])
        assert (odds.kinds[0] > 0) == is_possible
        assert odds.kinds.sum() + odds.sheet + odds.other == pytest.approx(1.0)


def test_without_any_density_a_patch_is_of_no_kind():
    nothing = make_kinds([90.0, 95.0, 99.0], np.zeros((3, 2, 2)), other=0.0, sheet_share=0.0)
    odds = weigh_kinds([nothing], [make_evidence(0.5, 1e-4 * np.eye(2))])
    assert odds.kinds.tolist() == [0.0, 0.0, 0.0]
    assert odds.sheet == 0.0
    assert odds.other == 1.0


def test_the_density_of_two_complex_ratios_is_that_of_their_four_parts():
    covariance = np.diag([1.0, 2.0, 3.0, 4.0]) + 0.1
    draws = np.array([[0.5 + 0.2j, 1.0 - 1j], [0.0, 2.0j]])
    mean = np.array([0.1j, 1.0])
    law = scipy.stats.multivariate_normal([0.0, 0.1, 1.0, 0.0], covariance)
    expected = [law.pdf([0.5, 0.2, 1.0, -1.0]), law.pdf([0.0, 0.0, 0.0, 2.0])]
    np.testing.assert_allclose(_evaluate_normal(draws, mean, covariance), expected)


def test_the_density_of_half_spaces_covers_their_whole_range():
    """Over ln eps' and asinh(eps'' / 0.05) it sums to one. A fifth of it is uniform, the rest near the literature."""
    table, real_axis, loss_axis = _tabulate_coordinate_density()
    assert (np.exp(real_axis[[0, -1]])).tolist() == pytest.approx([1.2, 30.0])
    assert (0.05 * np.sinh(loss_axis[[0, -1]])).tolist() == pytest.approx([0.0, 30.0])
    # The sum of the table's trapezoids is 0.991.
    assert np.trapezoid(np.trapezoid(table, loss_axis), real_axis) == pytest.approx(1.0, rel=0.02)
    # Far from the literature only the uniform fifth is left.
    area = np.log(30 / 1.2) * np.arcsinh(30 / 0.05)
    assert table.min() == pytest.approx(0.2 / area)


# Other half spaces have half of the probability that thin sheets do not take.
@pytest.mark.parametrize(("sheets", "others"), [(0.0, 0.5), (0.3, 0.5 * (1 - 0.3))])
def test_kinds_of_a_source_share_its_probability(sheets, others):
    """Of the probability of materials outside the library, metal has 0.1, the literature 0.4, other half spaces 0.5.

    The probability of thin sheets is taken from all three in proportion. The kinds of the library share 1.
    """
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
    without_sheets = 1 - sheets
    np.testing.assert_allclose(shares, [0.5, 0.5, 0.2 * without_sheets, 0.2 * without_sheets, 0.1 * without_sheets])
    assert other == pytest.approx(others)
    assert shares[2:].sum() + other == pytest.approx(without_sheets)
    shares, other = _compute_shares(kinds[:2], sheets)
    assert shares.tolist() == [0.5, 0.5]
    # Without materials of the literature, other half spaces have the probability of these, too.
    assert other == pytest.approx(0.9 * without_sheets)
