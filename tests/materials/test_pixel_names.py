"""Names of pixels, compared with Bayes' rule written out for each pixel; texts of numbers and names."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.stats

from polysight.materials.kinds import turn_covariance
from polysight.materials.names import (
    _format_estimate,
    _join_with_or,
    _name_pixels,
    _sort_likeliest_first,
    compute_name_shares,
    derive_evidence_from_pixels,
    format_permittivity,
    make_patch_without_pixels,
)

# Four kinds of plates, of which two have the same name: name, probability of the patch, and membership of the library.
# The last one is "unknown" and has no ratio of its own.
NAMES = np.array(["PET", "wood", "PET", "unknown"])
ODDS = np.array([0.3, 0.4, 0.2, 0.1])
IN_LIBRARY = np.array([True, True, False, False])
# V / H of each kind in two scans, [scan, kind], and the effects of the two parameters in which specimens of a kind
# differ on its real and imaginary part, [scan, kind, part, parameter]. Covariance of the measurement in each scan.
RATIOS = np.array([[0.5 + 0.1j, 0.7 - 0.2j, 0.2 + 0.4j, 1.0], [0.6 + 0.0j, 0.8 - 0.1j, 0.3 + 0.3j, 1.0]])
EFFECTS = np.random.default_rng(2).uniform(-0.05, 0.05, (2, 4, 2, 2))
COVARIANCES = (np.array([[4e-4, 1e-4], [1e-4, 9e-4]]), np.array([[9e-4, -2e-4], [-2e-4, 4e-4]]))


def name_by_bayes(pixels: np.ndarray, scans: int) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Return names, distances and confidences, computed for one pixel and one kind at a time.

    5 % of the pixels are inclusions of any material of the library.
    """
    # Real and imaginary part in the first scan, and then in the second, as often as there are scans.
    parts = np.ascontiguousarray(pixels).view(np.float64)
    scatter = np.cov(parts.T)
    # 1e-10 keeps the matrix from being singular.
    errors = scipy.linalg.block_diag(*COVARIANCES[:scans]) + scatter + 1e-10 * np.eye(2 * scans)
    names = []
    shares = []
    distances = []
    for pixel in parts:
        likelihood = {"PET": 0.0, "wood": 0.0}
        squares: dict[str, list[float]] = {"PET": [], "wood": []}
        for kind in range(3):
            mean = np.concatenate([[RATIOS[scan, kind].real, RATIOS[scan, kind].imag] for scan in range(scans)])
            effects = np.concatenate([EFFECTS[scan, kind] for scan in range(scans)])
            covariance = effects @ effects.T + errors
            # The library has two materials.
            prior = 0.95 * ODDS[kind] + 0.05 * IN_LIBRARY[kind] / 2
            density = scipy.stats.multivariate_normal(mean, covariance).pdf(pixel)
            likelihood[NAMES[kind]] += prior * density
            squares[NAMES[kind]].append(float((pixel - mean) @ np.linalg.solve(covariance, pixel - mean)))
        best = max(likelihood, key=lambda name: likelihood[name])
        # Confidence is relative to all kinds: those with a name have 0.3 + 0.4 + 0.2 = 0.9, and inclusions add 0.05.
        shares.append(0.95 * likelihood[best] / sum(likelihood.values()))
        # A distance of 1 is the edge of the region that holds 99 % of the pixels of a kind.
        distances.append(np.sqrt(min(squares[best]) / scipy.stats.chi2.ppf(0.99, 2 * scans)))
        names.append(best if distances[-1] <= 1 else "unknown")
    return names, np.array(distances), np.array(shares)


def name_pixels(pixels: np.ndarray, scans: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    # Stand-ins with just the fields that are used
    kinds: Any = [
        SimpleNamespace(t=RATIOS[scan], effects=EFFECTS[scan], in_library=IN_LIBRARY) for scan in range(scans)
    ]
    evidence: Any = [SimpleNamespace(covariance=COVARIANCES[scan]) for scan in range(scans)]
    return _name_pixels(kinds, evidence, pixels, ODDS, NAMES)


@pytest.mark.parametrize("scans", [1, 2])
def test_names_of_pixels_are_those_of_bayes_rule(scans):
    rng = np.random.default_rng(scans)
    ratio_of_kind = RATIOS[:scans, rng.integers(0, 3, 60)].T
    pixels = ratio_of_kind + 0.08 * (rng.standard_normal((60, scans)) + 1j * rng.standard_normal((60, scans)))
    # Three pixels are far from all kinds.
    pixels[:3] += 3
    names, distance, confidence = name_pixels(pixels, scans)
    expected_names, expected_distance, expected_confidence = name_by_bayes(pixels, scans)
    assert names.tolist() == expected_names
    # All three answers occur: PET, wood and unknown.
    assert len(set(expected_names)) == 3
    np.testing.assert_allclose(distance, expected_distance, rtol=1e-6)
    np.testing.assert_allclose(confidence, expected_confidence, rtol=1e-6)


def test_a_pixel_that_is_not_usable_has_no_name():
    pixels = np.array([[0.5 + 0.1j, 0.6], [np.nan, 0.6], [0.7 - 0.2j, np.inf], [0.7 - 0.2j, 0.8 - 0.1j]])
    names, distance, confidence = name_pixels(pixels, 2)
    assert names.tolist() == ["PET", "unknown", "unknown", "wood"]
    assert np.isinf(distance).tolist() == [False, True, True, False]
    assert (confidence == 0).tolist() == [False, True, True, False]
    # Of two pixels no scatter is estimated: the two usable ones above are like these two alone.
    alone, distance_alone, _ = name_pixels(pixels[[0, 3]], 2)
    assert alone.tolist() == ["PET", "wood"]
    np.testing.assert_array_equal(distance_alone, distance[[0, 3]])


def test_a_patch_without_usable_pixels_is_unknown():
    patch = make_patch_without_pixels(3)
    assert patch.pixel_names.tolist() == ["unknown"] * 3
    assert np.isinf(patch.distance).all()
    assert patch.patch_name.name == "unknown"
    assert patch.patch_name.pixels == 0


def test_names_are_listed_by_their_share_of_the_pixels_and_then_by_the_alphabet():
    shares = compute_name_shares(np.array(["b", "a", "c", "c", "a", "c", "b", "c"]))
    assert list(shares.items()) == [("c", 0.5), ("a", 0.25), ("b", 0.25)]


def test_probabilities_below_half_a_percent_are_left_out():
    probability = {"a": 0.00499, "b": 0.005, "c": 0.123456, "d": 0.8}
    assert list(_sort_likeliest_first(probability).items()) == [("d", 0.8), ("c", 0.1235), ("b", 0.005)]
    assert list(_sort_likeliest_first({"a": 0.0, "b": 0.1}, least_probability=0.0)) == ["b", "a"]


def test_the_ratio_of_pixels_alone_has_their_spread_and_three_percent():
    kinds: Any = SimpleNamespace(theta_rad=0.7)
    pixels = np.array([1.0, 1.2 + 0.2j, 1.4 - 0.1j, np.nan, 5.0 + 0.1j])
    evidence = derive_evidence_from_pixels(pixels, kinds)
    usable = pixels[np.isfinite(pixels)]
    # Medians of the real parts 1, 1.2, 1.4, 5 and of the imaginary parts -0.1, 0, 0.1, 0.2
    middle = 1.3 + 0.05j
    assert evidence.inverse_ratio == pytest.approx(middle)
    # Half of the variance in each part
    variance = np.mean(np.abs(usable - usable.mean()) ** 2) + (0.03 * abs(middle)) ** 2
    np.testing.assert_allclose(evidence.covariance, variance / 2 * np.eye(2))
    assert evidence.theta_rad == 0.7
    assert evidence.library_share == 0.5
    without_usable_pixels = derive_evidence_from_pixels(np.array([np.nan]), kinds)
    assert without_usable_pixels.inverse_ratio == 0
    np.testing.assert_array_equal(without_usable_pixels.covariance, np.eye(2))


def test_the_covariance_of_a_complex_number_turns_and_grows_with_a_complex_factor():
    """3j multiplies by 3 and exchanges real and imaginary part, one of them with the other sign."""
    covariance = np.array([[4.0, 1.0], [1.0, 2.0]])
    np.testing.assert_allclose(turn_covariance(1.0, covariance), covariance)
    np.testing.assert_allclose(turn_covariance(3j, covariance), 9 * np.array([[2.0, -1.0], [-1.0, 4.0]]))
    rng = np.random.default_rng(1)
    draws = rng.multivariate_normal([0, 0], covariance, 100_000)
    factor = 0.6 - 1.1j
    turned = (draws[:, 0] + 1j * draws[:, 1]) * factor
    np.testing.assert_allclose(turn_covariance(factor, covariance), np.cov(turned.real, turned.imag), rtol=0.05)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (2.891 - 0.429j, "2.89 - j0.43"),
        (2.89 + 27.3j, "2.89 + j27.30"),
        (3.0, "3.00 - j0.00"),
        (-0.001 - 0.001j, "0.00 - j0.00"),
    ],
)
def test_a_permittivity_has_two_digits_and_a_sign(value, text):
    assert format_permittivity(value) == text


def test_a_permittivity_may_be_aligned_and_have_an_error():
    assert format_permittivity(2.891 - 0.429j, digits=1, width=5) == "  2.9 - j0.4"
    assert _format_estimate(3 - 1j, np.diag([0.04, 0.09])) == "permittivity 3.00 - j1.00 (+- 0.20, 0.30)"
    assert _format_estimate(3 - 1j, np.diag([np.nan, 0.09])) == "permittivity 3.00 - j1.00"
    assert _format_estimate(3 - 1j, None) == "permittivity 3.00 - j1.00"
    assert _format_estimate(None, None) == ""


def test_names_are_joined_as_in_a_sentence():
    assert [_join_with_or(names) for names in (["A"], ["A", "B"], ["A", "B", "C"])] == ["A", "A or B", "A, B or C"]
