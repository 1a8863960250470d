"""Laws of the joint inversion, which estimates the permittivities of all plates of a scene and the errors of the rig.

Without errors the truth comes back, error bars hold the truth as often as stated, and more data make them smaller.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from polysight.materials import inversion
from polysight.materials.inversion import SOURCES, RigPrior, SceneLikelihood, invert, sample_posterior, true_ratio
from polysight.materials.kinds import (
    Kind,
    Kinds,
    PatchMeasurement,
    RatioCase,
    compute_probability_of_same_material,
    find_permittivity_slope,
    list_literature_kinds,
)
from polysight.materials.phase_sign import join_signs, mirror_phases
from polysight.materials.result import ratio_error
from polysight.polarimetry import permittivity_from_ratio

# Names of this file: t is V / H relative to metal; leakage is a pair (a, b), of p into H and of s into V; `theta` is
# the incidence angle.

# The squared distance of an estimate from the truth, in units of its covariance of real part and loss, is chi-square of
# two numbers: below 2.279 with a probability of 68 % and below 5.99 with 95 %.
CHI2_68 = 2.279
CHI2_95 = 5.99
THETA = np.radians(55.0)
KINDS = Kinds(list_literature_kinds(), float(THETA))
# Materials of Table 2 of the paper. The first eight are in the scenes, all sixteen in the libraries.
PUBLISHED = np.array([
    5.24 - 0.01j, 4.15 - 0.81j, 3.56 - 0.18j, 3.52 - 0.82j, 4.26 - 0.21j, 3.79 - 0.34j, 3.65 - 0.7j, 2.61 - 0.01j,
    4.0 - 0.4j, 3.78 - 0.7j, 4.21 - 0.3j, 4.75 - 2.43j, 5.06 - 1.11j, 7.26 - 0.85j, 4.69 - 0.7j, 4.63 - 0.31j,
])  # fmt: skip
# Eight plates over the whole range of usual permittivities.
EPS = np.array([2.6 - 0.01j, 3.5 - 0.8j, 4.0 - 0.4j, 4.7 - 0.7j, 5.1 - 1.1j, 4.75 - 2.4j, 6.3 - 0.2j, 7.5 - 0.3j])


def compute_measured_ratio(t, a, b, rho=0j):
    """Return V / H of a true t as measured relative to metal by the same rig.

    The leakages a and b and the relative error rho of the metal reference change it.
    """
    return (1 + rho) * (1 + a) / (1 + b) * (t + b) / (1 + a * t)


def draw_world(rng, leakages, noise=0.003, brightness_std=0.03, angle_error_rad=0.0, reference_error=0.0, eps=EPS):
    """Return measurements of half spaces relative to metal by a rig with the pair `leakages`.

    Reflection is by Eq. 2 of the paper, independent of the code under test. `noise` is the standard deviation of each
    part of V / H, `brightness_std` the relative one of a plate's brightness, `angle_error_rad` the error of the
    incidence angle, and `reference_error` the relative error of the metal reference.
    """
    a, b = leakages
    theta = THETA + angle_error_rad
    q = np.sqrt(eps - np.sin(theta) ** 2)
    r_s = (np.cos(theta) - q) / (np.cos(theta) + q)
    r_p = (q - eps * np.cos(theta)) / (q + eps * np.cos(theta))
    h = (r_s + a * r_p) / -(1 + a)
    v = (r_p + b * r_s) / -(1 + b)
    real_noise, imaginary_noise = noise * rng.standard_normal((2, eps.size))
    ratios = v / h * (1 + reference_error) + real_noise + 1j * imaginary_noise
    brightnesses = np.abs(h) * np.exp(brightness_std * rng.standard_normal(eps.size))
    return [
        PatchMeasurement(complex(ratio), noise, THETA, float(brightness))
        for ratio, brightness in zip(ratios, brightnesses, strict=True)
    ]


def draw_leakage(rng):
    """Return a leakage of any phase, up to 0.1: -20 dB is the poor end of such antennas."""
    return 0.1 * rng.random() * np.exp(2j * np.pi * rng.random())


def compute_distances(result, eps=EPS):
    """Return the squared distance of each estimate from the truth, chi-square of two numbers, by its own covariance."""
    distances = []
    for patch, truth in zip(result.patches, eps, strict=True):
        error = patch.permittivity - truth
        parts = np.array([error.real, error.imag])
        distances.append(float(parts @ np.linalg.solve(patch.covariance, parts)))
    return distances


def paint(patches, paint_mm, eps=3.3 - 0.1j):
    """Return the same patches relative to painted metal.

    The paint is a short-circuited transmission line: its impedance is j Z tan(k_z d) (Pozar, Microwave Engineering,
    section 2.3). Impedances are relative to those of air, for s and for p.
    """
    # Middle of the sweep
    wave_number = 2 * np.pi * 78.5e9 / 299792458.0
    cos_in_air = np.cos(THETA)
    # k_z over the wave number in air
    normal_part_in_paint = np.sqrt(eps - np.sin(THETA) ** 2)
    tangent = 1j * np.tan(wave_number * normal_part_in_paint * paint_mm * 1e-3)
    z_s = tangent / normal_part_in_paint * cos_in_air
    z_p = tangent * normal_part_in_paint / eps / cos_in_air
    r_s = (z_s - 1) / (z_s + 1)
    r_p = (z_p - 1) / (z_p + 1)
    return [replace(patch, inverse_ratio=patch.inverse_ratio / complex(r_p / r_s)) for patch in patches]


# Complex numbers: leakages and errors of the reference, and ratios t
any_small_number = st.builds(complex, st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
any_ratio = st.builds(complex, st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))


@given(a=any_small_number, b=any_small_number, rho=any_small_number, t=any_ratio)
def test_the_true_ratio_is_recovered_from_the_measured_one(a, b, rho, t):
    assert true_ratio(compute_measured_ratio(t, a, b, rho), a, b, rho) == pytest.approx(t, abs=1e-12)
    # Metal is the reference: it is 1 with any leakage.
    assert compute_measured_ratio(1.0, a, b) == pytest.approx(1.0)


@given(any_ratio)
def test_the_slope_of_permittivity_over_ratio_is_the_derivative(t):
    step = 1e-6
    difference = permittivity_from_ratio(t + step, THETA) - permittivity_from_ratio(t - step, THETA)
    # A difference over a step of 1e-6 loses six of sixteen digits, and more where the slope is small.
    assert find_permittivity_slope(t, THETA) == pytest.approx(difference / (2 * step), rel=1e-5, abs=1e-6)


def test_without_errors_the_truth_comes_back():
    leakages = (0.04 + 0.02j, -0.03j)
    patches = draw_world(np.random.default_rng(0), leakages, noise=1e-9, brightness_std=0.0)
    prior = RigPrior(theta_std_rad=1e-6, leakage=leakages, leakage_std=1e-6, leakage_measured=True, reference_std=1e-6)
    result = invert(patches, prior)
    # Angle, leakage and reference are known to 1e-6; the permittivities are wrong by less than that, relatively.
    for patch, truth in zip(result.patches, EPS, strict=True):
        assert patch.permittivity == pytest.approx(truth, rel=2e-5)


@pytest.mark.parametrize("measured", [True, False], ids=["leakage measured", "leakage not measured"])
def test_regions_hold_the_truth_as_often_as_they_say(measured, request):
    distances = []
    scenes = 60 if request.config.getoption("--long") else 12
    for seed in range(scenes):
        rng = np.random.default_rng(seed)
        leakages = (draw_leakage(rng), draw_leakage(rng))
        angle_error_rad = 2e-3 * rng.standard_normal()
        reference_error = 0.005 * complex(*rng.standard_normal(2))
        patches = draw_world(rng, leakages, angle_error_rad=angle_error_rad, reference_error=reference_error)
        # 0.041 is each part's standard deviation of `draw_leakage`, whose amplitude is uniform from 0 to 0.1:
        # 0.1 / sqrt(3) / sqrt(2).
        leakage_std = 0.003 if measured else 0.041
        if measured:
            measured_leakage = tuple(x + leakage_std * complex(*rng.standard_normal(2)) for x in leakages)
        else:
            measured_leakage = (0j, 0j)
        prior = RigPrior(
            theta_std_rad=2e-3,
            leakage=measured_leakage,
            leakage_std=leakage_std,
            leakage_measured=measured,
            reference_std=0.005,
        )
        distances += compute_distances(invert(patches, prior))
    distances = np.array(distances)
    # Right regions hold the truth in 68 % and 95 % of the cases, and the mean of chi-square is 2. The patches of a
    # scene are not independent, because they share leakage, angle and reference; shares of 12 independent draws have
    # errors of 0.13 and 0.06. The shares are 0.79 and 0.98 with measured leakage, and 0.65 and 1.0 without.
    assert 0.58 < np.mean(distances < CHI2_68) < 0.80
    assert np.mean(distances < CHI2_95) > 0.90
    assert np.sqrt(np.mean(distances) / 2) < 1.2


def test_leakage_that_was_not_measured_is_within_the_error_bars_whatever_its_phase():
    for phase in np.linspace(0, 2 * np.pi, 8, endpoint=False):
        leakage = 0.05 * np.exp(1j * phase)
        patches = draw_world(np.random.default_rng(1), (leakage, leakage))
        result = invert(patches, RigPrior(theta_std_rad=2e-3))
        # Root mean square error in standard deviations. It is 1 on average over many rigs; this is one rig each.
        assert np.sqrt(np.mean(compute_distances(result)) / 2) < 1.5
        assert all(p.dominated_by == "leakage" for p in result.patches)


def test_leakage_is_found_from_evenly_lit_plates():
    leakages = (0.05j, 0.05j)
    patches = draw_world(np.random.default_rng(2), leakages, noise=5e-4, brightness_std=0.0)
    prior = RigPrior(theta_std_rad=1e-5, reference_std=5e-4, brightness_range=(0.002, 0.002))
    result = invert(patches, prior)
    # Leakage of s into V has the largest effect, because r_s of a plate is larger than r_p. Its error falls to 0.17 of
    # the one that is assumed without measurements; the permittivities are wrong by up to 1.6 %.
    assert result.leakage_std[1] < 0.3 * result.prior_std
    for patch, truth in zip(result.patches, EPS, strict=True):
        assert abs(patch.permittivity - truth) < 0.03 * abs(truth)


def test_shares_add_up_and_a_better_measurement_shrinks_what_it_dominates():
    patches = draw_world(np.random.default_rng(3), (0j, 0j))
    unmeasured = invert(patches, RigPrior(theta_std_rad=2e-3))
    measured = invert(patches, RigPrior(theta_std_rad=2e-3, leakage_std=0.001, leakage_measured=True))
    for wide_patch, narrow_patch in zip(unmeasured.patches, measured.patches, strict=True):
        assert set(wide_patch.shares) == set(SOURCES)
        assert sum(wide_patch.shares.values()) == pytest.approx(1.0, abs=1e-6)
        assert np.trace(narrow_patch.covariance) < 0.2 * np.trace(wide_patch.covariance)
        assert narrow_patch.dominated_by != "leakage"


def test_metal_like_patches_get_no_permittivity():
    # Metal is t = 1.
    for t in (1.0, 0.98 + 0.02j, 1.1 - 0.05j):
        patch = PatchMeasurement(complex(t), std=0.01, theta_rad=THETA, brightness=1.0)
        result = invert([patch], RigPrior(theta_std_rad=2e-3))
        assert result.patches[0].permittivity is None
        assert result.patches[0].covariance is None


def test_error_bars_of_drawn_ratios_are_nearly_proportional_to_small_noise():
    """The covariance is that of permittivities of drawn ratios; Eq. 3 is nearly linear over a few per cent."""
    eps = np.array([12.0 - 3.0j])
    (exact,) = draw_world(np.random.default_rng(4), (0j, 0j), noise=1e-9, eps=eps)
    prior = RigPrior(theta_std_rad=1e-4, leakage_std=1e-4, leakage_measured=True, reference_std=1e-4)
    stds_over_noise = []
    for noise in (0.01, 0.03):
        patch = replace(exact, std=noise, brightness=None)
        result = invert([patch], prior)
        stds_over_noise.append(np.sqrt(np.trace(result.patches[0].covariance)) / noise)
    # The curvature of Eq. 3 adds 3 %. An error that grew with the square of the noise would be three times as large.
    assert stds_over_noise[1] == pytest.approx(stds_over_noise[0], rel=0.3)


def test_a_thin_sheet_does_not_change_the_permittivities_of_the_others():
    """A thin sheet is much darker than a half space of the same ratio."""
    patches = draw_world(np.random.default_rng(5), (0j, 0j), brightness_std=0.01)
    sheet = replace(patches[-1], brightness=0.3 * patches[-1].brightness)
    prior = RigPrior(theta_std_rad=2e-3)
    result = invert(patches, prior)
    result_with_sheet = invert([*patches[:-1], sheet], prior)
    for before, after in zip(result.patches[:-1], result_with_sheet.patches[:-1], strict=True):
        assert abs(before.permittivity - after.permittivity) < np.sqrt(np.trace(before.covariance))


def test_the_stated_error_of_a_ratio_is_the_scatter_of_drawn_rigs():
    prior = RigPrior(theta_std_rad=2e-3)
    result = invert([PatchMeasurement(0.2 + 0.1j, std=0.003, theta_rad=THETA, brightness=None)], prior)
    rng = np.random.default_rng(6)
    # The unknowns of a rig in units of their prior: parts of both leakages and of the reference's error.
    unit = rng.multivariate_normal(np.zeros(6), result.nuisance_covariance, 20000)
    a = prior.leakage_std * (unit[:, 0] + 1j * unit[:, 1])
    b = prior.leakage_std * (unit[:, 2] + 1j * unit[:, 3])
    rho = prior.reference_std * (unit[:, 4] + 1j * unit[:, 5])
    ratios = np.array([0.1 + 0.05j, -0.2j, 0.5])
    for t, stated_std in zip(ratios, ratio_error(result, prior, ratios), strict=True):
        deviations = compute_measured_ratio(t, a, b, rho) - t
        # The stated error is that of each part. It is computed by the slope, and differs from draws by a few per cent.
        assert stated_std == pytest.approx(np.sqrt(np.mean(np.abs(deviations) ** 2) / 2), rel=0.06)


@pytest.mark.parametrize("paint_mm", [0.1, 0.15, 0.2])
def test_paint_on_the_metal_is_recognised_and_the_permittivities_are_within_their_errors(paint_mm):
    rng = np.random.default_rng(11)
    prior = RigPrior(theta_std_rad=1e-3, leakage_std=0.01, leakage_measured=True)
    patches = paint(draw_world(rng, (0.003j, 0.004)), paint_mm)
    result = invert(patches, prior, KINDS)
    # Probability of paint
    assert result.painted > 0.8
    assert result.paint_mm == pytest.approx(paint_mm, abs=0.04)
    # The 95 % regions of all plates but one hold the truth: at least seven of eight.
    assert sum(distance < CHI2_95 for distance in compute_distances(result)) >= 7


def test_error_bars_contain_paint_that_is_not_certain():
    """Four scenes of painted metal in which the probability of paint is neither near 0 nor near 1."""
    probabilities = []
    is_covered = []
    for seed in (101, 118, 124, 125):
        rng = np.random.default_rng(seed)
        # The default standard deviation of the prior for leakage that was not measured
        parts = 0.041 * rng.standard_normal(4)
        # Each plate is another specimen: eps' varies by 2 %, eps'' by 30 %.
        eps = EPS * (1 + 0.02 * rng.standard_normal(EPS.size))
        eps = eps.real + 1j * eps.imag * np.exp(0.3 * rng.standard_normal(EPS.size))
        plates = draw_world(rng, (complex(*parts[:2]), complex(*parts[2:])), noise=0.006, eps=eps)
        painted_plates = paint(plates, paint_mm=rng.uniform(0.05, 0.2))
        result = invert(painted_plates, RigPrior(theta_std_rad=1e-3), KINDS)
        probabilities.append(result.painted)
        is_covered += [distance < CHI2_95 for distance in compute_distances(result, eps)]
    # The probabilities are 0.30 to 0.75.
    assert 0.05 < min(probabilities) < max(probabilities) < 0.95
    # 95 % are expected; of 32 plates two standard deviations less: sqrt(0.95 * 0.05 / 32) = 0.039.
    assert np.mean(is_covered) > 0.87


def test_names_have_both_cases_of_metal_that_may_be_painted():
    """Mean and covariance of both cases together are those of the whole."""
    patches = paint(draw_world(np.random.default_rng(1), (0.003j, 0.004)), 0.03)
    result = invert(patches, RigPrior(1e-3, leakage_std=0.01, leakage_measured=True), KINDS)
    # The probability of paint is 0.235: both cases matter.
    assert 0.05 < result.painted < 0.95
    for estimate in result.patches:
        painted, bare = estimate.evidence.cases
        assert painted.probability == pytest.approx(result.painted)
        assert painted.probability + bare.probability == pytest.approx(1)
        middle = sum(case.probability * case.inverse_ratio for case in (painted, bare))
        assert estimate.evidence.inverse_ratio == pytest.approx(middle)
        covariance = np.zeros((2, 2))
        for case in (painted, bare):
            difference = case.inverse_ratio - middle
            parts = np.array([difference.real, difference.imag])
            covariance += case.probability * (case.covariance + np.outer(parts, parts))
        # The covariances agree to 0.2 % here.
        assert estimate.evidence.covariance == pytest.approx(covariance, rel=0.03, abs=1e-6)


def test_metal_that_is_certainly_painted_is_one_case():
    patches = paint(draw_world(np.random.default_rng(11), (0.003j, 0.004)), 0.2)
    result = invert(patches, RigPrior(1e-3, leakage_std=0.01, leakage_measured=True), KINDS)
    # The probability of paint is 1.0.
    assert result.painted > 0.95
    assert not any(estimate.evidence.cases for estimate in result.patches)


def test_bare_metal_is_not_called_painted():
    for seed in range(3):
        rng = np.random.default_rng(seed)
        leakages = (draw_leakage(rng) / 3, draw_leakage(rng) / 3)
        result = invert(draw_world(rng, leakages), RigPrior(theta_std_rad=1e-3, leakage_std=0.025), KINDS)
        # A fifth is the probability from which paint counts, see the next test; here it is 0.0.
        assert result.painted < 0.2


def test_paint_is_an_error_of_the_reference_from_a_probability_of_a_fifth():
    """Less probable paint does not change the error of the metal reference; two scenes, one of each."""
    prior = RigPrior(theta_std_rad=1e-3, leakage_std=0.01, leakage_measured=True)
    probabilities = []
    for seed in range(2):
        patches = paint(draw_world(np.random.default_rng(seed), (0.003j, 0.004)), paint_mm=0.03)
        result = invert(patches, prior, KINDS)
        probabilities.append(result.painted)
        # Paint delays p more than s: it is an error of the metal reference's phase, number 5 of the rig's unknowns, in
        # units of its prior. Patches only reduce its variance, from 1.
        variance_of_reference_phase = np.diag(result.nuisance_covariance)[5]
        assert (variance_of_reference_phase > 2) == (result.painted > 0.2)
    # The probabilities are 0.16 and 0.24.
    assert 0.05 < probabilities[0] < 0.2 < probabilities[1]


@pytest.mark.parametrize("draw", range(4))
def test_a_board_that_was_turned_after_its_calibration_is_found_with_any_random_numbers(draw):
    # All plates are of the library, but with the leakage that was measured before the turn none of them fits it.
    plates = [Kind(f"plate {i}", complex(e), spread=(0.02, 0.1)) for i, e in enumerate(PUBLISHED)]
    kinds = Kinds([*list_literature_kinds(), *plates], float(THETA))
    # The prior probability of a turn is 0.1. With 0.05 one of the four draws finds a turn with a probability of only
    # 0.89: two of the plates have nearly the same V / H, so that they count for less than two.
    prior = RigPrior(theta_std_rad=0.0015, leakage_std=0.003, leakage_measured=True, channels_known=True, moved=0.1)
    patches = draw_world(np.random.default_rng(0), (0j, 0.055), eps=PUBLISHED[:8])
    model = SceneLikelihood(patches, prior, kinds)
    particles, _, _ = sample_posterior(model, np.random.default_rng(draw))
    # The probability of a turn is 0.96 to 0.99.
    assert model.has_moved(particles).mean() > 0.9
    _, into_v = model.leakage(particles)
    # The leakage after the turn is 0.055 of s into V. Its estimate is wrong by up to 0.007; without a turn it would be
    # wrong by 0.055.
    assert abs(into_v.mean() - 0.055) < 0.015


def test_images_with_the_wrong_sign_of_phase_are_recognised():
    """A wrong sign makes losses gains: plates would be of impossible or unknown materials."""
    rng = np.random.default_rng(3)
    prior = RigPrior(theta_std_rad=1e-3, leakage_std=0.01)
    measurements = draw_world(rng, (0.01, -0.01j))
    mirrored_measurements, mirrored_prior = mirror_phases(measurements, prior)
    right_sign = invert(measurements, prior, KINDS)
    wrong_sign = invert(mirrored_measurements, mirrored_prior, KINDS)
    for prior_of_wrong in (0.1, 0.5, 0.9):
        _, probability_of_wrong = join_signs(right_sign, wrong_sign, prior_of_wrong)
        # The same question with exchanged roles
        _, probability_of_right = join_signs(wrong_sign, right_sign, 1 - prior_of_wrong)
        assert probability_of_wrong < 0.5
        assert probability_of_right == pytest.approx(1 - probability_of_wrong, abs=1e-9)


@pytest.mark.parametrize("evidence", [-1.0, 0.0, 1.0])
def test_errors_hold_both_signs_of_phase_in_the_share_of_their_probability(evidence):
    rng = np.random.default_rng(4)
    prior = RigPrior(theta_std_rad=1e-3, leakage_std=0.01)
    measurements = draw_world(rng, (0j, 0j))
    right_sign = invert(measurements, prior, KINDS)
    mirrored_measurements, mirrored_prior = mirror_phases(measurements, prior)
    wrong_sign = invert(mirrored_measurements, mirrored_prior, KINDS)
    # Both signs explain the data about as well.
    wrong_sign = replace(wrong_sign, log_evidence=right_sign.log_evidence + evidence)
    joined, probability_of_wrong = join_signs(right_sign, wrong_sign, 0.3)
    for right_patch, wrong_patch, joined_patch in zip(
        right_sign.patches, wrong_sign.patches, joined.patches, strict=True
    ):
        assert joined_patch.permittivity == right_patch.permittivity
        # Mean square distance from the estimate: by the errors of the right sign, or by those of the wrong sign and the
        # difference between the two.
        distance2 = abs(wrong_patch.permittivity - right_patch.permittivity) ** 2
        if_right = np.trace(right_patch.covariance)
        if_wrong = np.trace(wrong_patch.covariance) + distance2
        expected = (1 - probability_of_wrong) * if_right + probability_of_wrong * if_wrong
        assert np.trace(joined_patch.covariance) == pytest.approx(expected)
        wider = np.sqrt(np.diag(joined_patch.covariance) / np.diag(right_patch.covariance))
        np.testing.assert_allclose(np.array(joined_patch.half_widths_68) / right_patch.half_widths_68, wider)
        assert sum(joined_patch.shares.values()) == pytest.approx(1.0)
    # A wrong sign that is as improbable as 1e-6 changes nothing.
    assert join_signs(right_sign, wrong_sign, 1e-6)[0] == right_sign


def test_the_errors_with_paint_and_without_it_hold_both_signs_of_phase():
    """Painted and bare metal give a t and errors of their own; the estimate of the wrong sign is added to either."""
    prior = RigPrior(theta_std_rad=1e-3, leakage_std=0.01)
    measurements = draw_world(np.random.default_rng(4), (0j, 0j))
    solution = invert(measurements, prior, KINDS)
    mirrored_measurements, mirrored_prior = mirror_phases(measurements, prior)
    wrong_sign = invert(mirrored_measurements, mirrored_prior, KINDS)
    # Both signs explain the data alike.
    wrong_sign = replace(wrong_sign, log_evidence=solution.log_evidence)
    patches = []
    for patch in solution.patches:
        t = patch.evidence.inverse_ratio
        painted = RatioCase(0.4, t + 0.1j, 2 * patch.evidence.covariance)
        bare = RatioCase(0.6, t, patch.evidence.covariance)
        patches.append(replace(patch, evidence=replace(patch.evidence, cases=(painted, bare))))
    right_sign = replace(solution, patches=tuple(patches))
    joined, probability_of_wrong = join_signs(right_sign, wrong_sign, 0.3)
    for right_patch, wrong_patch, joined_patch in zip(
        right_sign.patches, wrong_sign.patches, joined.patches, strict=True
    ):
        for case, joined_case in zip(right_patch.evidence.cases, joined_patch.evidence.cases, strict=True):
            distance2 = abs(wrong_patch.evidence.inverse_ratio - case.inverse_ratio) ** 2
            if_wrong = np.trace(wrong_patch.evidence.covariance) + distance2
            expected = (1 - probability_of_wrong) * np.trace(case.covariance) + probability_of_wrong * if_wrong
            assert np.trace(joined_case.covariance) == pytest.approx(expected)
            assert (joined_case.probability, joined_case.inverse_ratio) == (case.probability, case.inverse_ratio)


def test_the_kinds_of_plates_count_less_for_the_leakage_if_it_was_never_measured():
    """Known kinds of plates show the leakage, but the list of kinds is not complete: they get a weight below 1.

    With the full weight the error bars would be smaller. Leakage that was measured needs no such caution.
    """
    patches = draw_world(np.random.default_rng(4), (0.03, 0.02j), eps=EPS[:5])
    measured = RigPrior(theta_std_rad=2e-3, leakage=(0.03 + 0j, 0.02j), leakage_std=0.003, leakage_measured=True)
    unmeasured = RigPrior(theta_std_rad=2e-3)
    with_unmeasured = invert(patches, unmeasured, KINDS)
    with_measured = invert(patches, measured, KINDS)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("polysight.materials.inversion.WEIGHT_OF_KINDS", 1.0)
        with_unmeasured_full_weight = invert(patches, unmeasured, KINDS)
        with_measured_full_weight = invert(patches, measured, KINDS)
    variances = np.array([np.trace(p.covariance) for p in with_unmeasured.patches])
    variances_full_weight = np.array([np.trace(p.covariance) for p in with_unmeasured_full_weight.patches])
    # The weight below 1 makes the variances 22 % larger.
    assert np.median(variances / variances_full_weight) > 1.05
    assert with_measured.leakage == with_measured_full_weight.leakage


def test_half_widths_hold_68_percent_of_errors_whose_size_varies_from_plate_to_plate():
    """Errors whose variance is drawn for each plate: an inverse gamma distribution, three degrees of freedom.

    Their scale is such that 95 % lie within the same limit as with the fixed size of 0.01, but most are smaller.
    """
    rng = np.random.default_rng(3)
    prior = RigPrior(theta_std_rad=1e-5, leakage_std=5e-4, leakage_measured=True, reference_std=1e-4)
    inside_68 = []
    inside_95 = []
    for _ in range(20):
        exact = draw_world(rng, (0j, 0j), noise=0.0, brightness_std=0.0, eps=np.full(10, 4.0 - 0.4j))
        # Two numbers with such a variance have a squared length below 19.1 with a probability of 95 % (twice the F
        # distribution of 2 and 3 degrees of freedom, 9.55); with a fixed variance of 1 it is chi-square, 5.991.
        size = 0.01 * np.sqrt(3.0 / rng.chisquare(3.0, 10)) * np.sqrt(CHI2_95 / 19.1)
        errors = size * (rng.standard_normal(10) + 1j * rng.standard_normal(10))
        patches = [
            replace(patch, inverse_ratio=patch.inverse_ratio + complex(error), std=0.01)
            for patch, error in zip(exact, errors, strict=True)
        ]
        for patch in invert(patches, prior).patches:
            deviation = np.abs([patch.permittivity.real - 4.0, patch.permittivity.imag + 0.4])
            inside_68.append(deviation < patch.half_widths_68)
            inside_95.append(deviation < 1.96 * np.sqrt(np.diag(patch.covariance)))
    # Within three standard deviations of the count of 200 draws: 0.033 and 0.0154.
    np.testing.assert_allclose(np.mean(inside_68, axis=0), 0.683, atol=0.1)
    np.testing.assert_allclose(np.mean(inside_95, axis=0), 0.95, atol=0.046)


@pytest.mark.parametrize("eps", [2.5 - 0.08j, 2.75 - 0.01j, 5.3 - 0.36j])
def test_six_plates_of_one_foreign_material_are_not_explained_by_turned_boards(eps):
    """Plates of gypsum, PVC or concrete, and a library that has none of them. No board was turned.

    If the plates counted as six independent ones, a turn of the boards that makes them materials of the library would
    be likelier: 0, 67 and 0 % of the error regions would hold the truth.
    """
    library = [Kind(f"material {i}", complex(value)) for i, value in enumerate(PUBLISHED)]
    kinds = Kinds([*library, *list_literature_kinds()], float(THETA), with_sheets=True)
    plates = np.full(6, eps)
    inside = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        # The true leakage is 0; it was measured with this error.
        error = 0.003 * (rng.standard_normal(2) + 1j * rng.standard_normal(2))
        prior = RigPrior(
            theta_std_rad=1e-3,
            leakage=(complex(error[0]), complex(error[1])),
            leakage_std=0.003,
            leakage_measured=True,
            channels_known=True,
            moved=0.5,
        )
        result = invert(draw_world(rng, (0j, 0j), noise=0.002, brightness_std=0.1, eps=plates), prior, kinds)
        inside += [distance < CHI2_95 for distance in compute_distances(result, plates)]
    # All 18 regions hold the truth; 17 of them are 0.94.
    assert np.mean(inside) > 0.9


def test_plates_are_of_one_material_if_their_ratios_agree_within_their_errors():
    rng = np.random.default_rng(0)
    equal_plates = draw_world(rng, (0j, 0j), noise=0.002, eps=np.full(5, 4.0 - 0.4j))
    other_plates = draw_world(rng, (0j, 0j), noise=0.002, eps=np.array([2.6 - 0.01j, 7.5 - 0.3j]))
    same = compute_probability_of_same_material([*equal_plates, *other_plates])
    among_equal = same[:5, :5]
    equal_with_other = same[:5, 5:]
    assert np.diag(same) == pytest.approx(1)
    assert same == pytest.approx(same.T)
    # Of ten pairs of equal plates, noise makes one look different: the probability of the same material is 0.51.
    assert among_equal.min() > 0.5
    assert equal_with_other.max() < 1e-6
    # Leakage is common to all plates: it changes the probabilities by up to 0.03.
    leaking = draw_world(np.random.default_rng(0), (0.05j, 0.04), noise=0.002, eps=np.full(5, 4.0 - 0.4j))
    assert compute_probability_of_same_material(leaking) == pytest.approx(among_equal, abs=0.05)
    assert compute_probability_of_same_material([]).shape == (0, 0)


@pytest.mark.parametrize("painted_share", [0.25, 0.75])
def test_without_the_evidence_of_a_patch_the_metal_is_painted_as_probably_as_before(painted_share):
    """A particle stands for painted metal if its first number is positive. No patch gives any evidence."""

    class PaintAlone:
        width = 2

        @staticmethod
        def paint(z):
            return z[:, :1]

        @staticmethod
        def log_likelihoods(z):
            return np.zeros((len(z), 1))

    rng = np.random.default_rng(5)
    z = rng.standard_normal((400, 2))
    is_painted = np.arange(400) < 400 * painted_share
    z[:, 0] = np.where(is_painted, abs(z[:, 0]), -abs(z[:, 0]))
    weights = np.zeros(1)
    moved = inversion._anneal_without_patch(PaintAlone(), z, weights, weights, rng, PaintAlone.log_likelihoods(z))
    assert np.mean(moved[:, 0] > 0) == painted_share
    assert not np.isin(moved, z).all()
