"""Laws of the joint inversion: round trip, correct error bars, shares that add up, and data that makes them smaller."""

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
    compute_probability_of_same_material,
    find_permittivity_slope,
    list_literature_kinds,
)
from polysight.materials.phase_sign import join_signs, mirror_phases
from polysight.materials.result import ratio_error
from polysight.polarimetry import permittivity_from_ratio

THETA = np.radians(55.0)
KINDS = Kinds(list_literature_kinds(), float(THETA))
PUBLISHED = np.array([
    5.24 - 0.01j, 4.15 - 0.81j, 3.56 - 0.18j, 3.52 - 0.82j, 4.26 - 0.21j, 3.79 - 0.34j, 3.65 - 0.7j, 2.61 - 0.01j,
    4.0 - 0.4j, 3.78 - 0.7j, 4.21 - 0.3j, 4.75 - 2.43j, 5.06 - 1.11j, 7.26 - 0.85j, 4.69 - 0.7j, 4.63 - 0.31j,
])  # fmt: skip
"""Materials of Table 2; the first eight are scanned."""
EPS = np.array([2.6 - 0.01j, 3.5 - 0.8j, 4.0 - 0.4j, 4.7 - 0.7j, 5.1 - 1.1j, 4.75 - 2.4j, 6.3 - 0.2j, 7.5 - 0.3j])


def compute_measured_ratio(t, a, b, rho=0j):
    """V / H of a true t, relative to metal that the same rig sees."""
    return (1 + rho) * (1 + a) / (1 + b) * (t + b) / (1 + a * t)


def draw_world(rng, leak, noise=0.003, dull=0.03, angle=0.0, reference=0.0, eps=EPS):
    """Measurement of half spaces relative to metal by a rig of this leakage, by Eq. 2, independent of the code."""
    a, b = leak
    theta = THETA + angle
    q = np.sqrt(eps - np.sin(theta) ** 2)
    r_s = (np.cos(theta) - q) / (np.cos(theta) + q)
    r_p = (q - eps * np.cos(theta)) / (q + eps * np.cos(theta))
    h = (r_s + a * r_p) / -(1 + a)
    v = (r_p + b * r_s) / -(1 + b)
    z = rng.standard_normal((2, eps.size))
    ratio = v / h * (1 + reference) + noise * (z[0] + 1j * z[1])
    level = np.abs(h) * np.exp(dull * rng.standard_normal(eps.size))
    return [PatchMeasurement(complex(r), noise, THETA, float(s)) for r, s in zip(ratio, level, strict=True)]


def draw_leakage(rng):
    return 0.1 * rng.random() * np.exp(2j * np.pi * rng.random())


def compute_distances(inversion, eps=EPS):
    out = []
    for p, truth in zip(inversion.patches, eps, strict=True):
        errors = p.permittivity - truth
        pair = np.array([errors.real, errors.imag])
        out.append(float(pair @ np.linalg.solve(p.covariance, pair)))
    return out


def paint(patches, paint_mm, eps=3.3 - 0.1j):
    """The same patches relative to painted metal: a film on a perfect conductor, by its impedances (Pozar, 2.3)."""
    k = 2 * np.pi * 78.5e9 / 299792458.0
    normal = np.cos(THETA)
    inside = np.sqrt(eps - np.sin(THETA) ** 2)
    film = 1j * np.tan(k * inside * paint_mm * 1e-3)
    z_s = film / inside * normal
    z_p = film * inside / eps / normal
    ratio = (z_p - 1) / (z_p + 1) * (z_s + 1) / (z_s - 1)
    return [replace(patch, inverse_ratio=patch.inverse_ratio / complex(ratio)) for patch in patches]


small = st.floats(-0.1, 0.1)
parts = st.floats(-0.6, 0.6)


@given(ar=small, ai=small, br=small, bi=small, rr=small, ri=small, tr=parts, ti=parts)
def test_ratio_there_and_back(ar, ai, br, bi, rr, ri, tr, ti):
    a = complex(ar, ai)
    b = complex(br, bi)
    rho = complex(rr, ri)
    t = complex(tr, ti)
    assert true_ratio(compute_measured_ratio(t, a, b, rho), a, b, rho) == pytest.approx(t, abs=1e-12)
    # Metal is the reference, with any leakage
    assert compute_measured_ratio(1.0, a, b) == pytest.approx(1.0)


@given(parts, parts)
def test_slope_is_the_derivative(tr, ti):
    t = complex(tr, ti)
    step = 1e-6
    by = (permittivity_from_ratio(t + step, THETA) - permittivity_from_ratio(t - step, THETA)) / (2 * step)
    assert find_permittivity_slope(t, THETA) == pytest.approx(by, rel=1e-5, abs=1e-6)


def test_without_errors_the_truth_comes_back():
    leak = (0.04 + 0.02j, -0.03j)
    result = invert(
        draw_world(np.random.default_rng(0), leak, 1e-9, 0.0), RigPrior(1e-6, leak, 1e-6, True, reference_std=1e-6)
    )
    for p, truth in zip(result.patches, EPS, strict=True):
        assert p.permittivity == pytest.approx(truth, rel=2e-5)


@pytest.mark.parametrize("measured", [True, False], ids=["leakage measured", "leakage not measured"])
def test_regions_hold_the_truth_as_often_as_they_say(measured, request):
    d = []
    for seed in range(60 if request.config.getoption("--long") else 12):
        rng = np.random.default_rng(seed)
        leak = (draw_leakage(rng), draw_leakage(rng))
        angle = 2e-3 * rng.standard_normal()
        reference = 0.005 * complex(*rng.standard_normal(2))
        patches = draw_world(rng, leak, angle=angle, reference=reference)
        if measured:
            measured_leakage = tuple(x + 0.003 * complex(*rng.standard_normal(2)) for x in leak)
        else:
            measured_leakage = (0j, 0j)
        prior = RigPrior(2e-3, measured_leakage, 0.003 if measured else 0.041, measured, reference_std=0.005)
        d += compute_distances(invert(patches, prior))
    d = np.array(d)
    # The patches of a scene share leakage, angle and reference: 12 scenes are not 96 independent draws.
    assert 0.58 < np.mean(d < 2.279) < 0.80
    assert np.mean(d < 5.991) > 0.90
    assert np.sqrt(np.mean(d) / 2) < 1.2


def test_leakage_that_was_not_measured_is_within_the_error_bars_whatever_its_phase():
    for phase in np.linspace(0, 2 * np.pi, 8, endpoint=False):
        leak = 0.05 * np.exp(1j * phase)
        result = invert(draw_world(np.random.default_rng(1), (leak, leak)), RigPrior(2e-3))
        assert np.sqrt(np.mean(compute_distances(result)) / 2) < 1.5
        assert all(p.dominated_by == "leakage" for p in result.patches)


def test_leakage_is_found_from_evenly_lit_plates():
    leak = (0.05j, 0.05j)
    patches = draw_world(np.random.default_rng(2), leak, noise=5e-4, dull=0.0)
    result = invert(patches, RigPrior(1e-5, reference_std=5e-4, brightness_range=(0.002, 0.002)))
    assert result.leakage_std[1] < 0.3 * result.prior_std  # leakage of s into V, which matters most
    for p, truth in zip(result.patches, EPS, strict=True):
        assert abs(p.permittivity - truth) < 0.03 * abs(truth)


def test_shares_add_up_and_a_better_measurement_shrinks_what_it_dominates():
    patches = draw_world(np.random.default_rng(3), (0j, 0j))
    wide = invert(patches, RigPrior(2e-3))
    measured = invert(patches, RigPrior(2e-3, (0j, 0j), 0.001, True))
    for a, b in zip(wide.patches, measured.patches, strict=True):
        assert set(a.shares) == set(SOURCES)
        assert sum(a.shares.values()) == pytest.approx(1.0, abs=1e-6)
        assert np.trace(b.covariance) < 0.2 * np.trace(a.covariance)
        assert b.dominated_by != "leakage"


def test_metal_like_patches_get_no_permittivity():
    for t in (1.0, 0.98 + 0.02j, 1.1 - 0.05j):
        result = invert([PatchMeasurement(complex(t), 0.01, THETA, 1.0)], RigPrior(2e-3))
        assert result.patches[0].permittivity is None
        assert result.patches[0].covariance is None


def test_drawn_covariance_agrees_with_the_slope_where_both_hold():
    eps = np.array([12.0 - 3.0j])
    noises = (0.01, 0.03)
    ratios = []
    for noise in noises:
        patches = [
            PatchMeasurement(s.inverse_ratio, noise, THETA, None)
            for s in draw_world(np.random.default_rng(4), (0j, 0j), 1e-9, eps=eps)
        ]
        result = invert(patches, RigPrior(1e-4, (0j, 0j), 1e-4, True, reference_std=1e-4))
        ratios.append(np.sqrt(np.trace(result.patches[0].covariance)) / noise)
    assert ratios[1] == pytest.approx(ratios[0], rel=0.3)


def test_a_thin_sheet_does_not_pull_the_others():
    patches = draw_world(np.random.default_rng(5), (0j, 0j), dull=0.01)
    odd = [
        *patches[:-1],
        PatchMeasurement(patches[-1].inverse_ratio, patches[-1].std, THETA, 0.3 * patches[-1].brightness),
    ]
    result_before = invert(patches, RigPrior(2e-3))
    result_after = invert(odd, RigPrior(2e-3))
    for a, b in zip(result_before.patches[:-1], result_after.patches[:-1], strict=True):
        assert abs(a.permittivity - b.permittivity) < np.sqrt(np.trace(a.covariance))


def test_ratio_error_is_that_of_draws():
    prior = RigPrior(2e-3)
    result = invert([PatchMeasurement(0.2 + 0.1j, 0.003, THETA, None)], prior)
    rng = np.random.default_rng(6)
    t = np.array([0.1 + 0.05j, -0.2j, 0.5])
    z = rng.multivariate_normal(np.zeros(6), result.nuisance_covariance, 20000)
    a = prior.leakage_std * (z[:, 0] + 1j * z[:, 1])
    b = prior.leakage_std * (z[:, 2] + 1j * z[:, 3])
    rho = prior.reference_std * (z[:, 4] + 1j * z[:, 5])
    for value, stated in zip(t, ratio_error(result, prior, t), strict=True):
        deviations = np.array([compute_measured_ratio(value, *x) - value for x in zip(a, b, rho, strict=True)])
        assert stated == pytest.approx(np.sqrt(np.mean(np.abs(deviations) ** 2) / 2), rel=0.06)


@pytest.mark.parametrize("paint_mm", [0.1, 0.15, 0.2])
def test_paint_on_the_metal_is_found_out_and_does_not_carry_the_permittivities_off(paint_mm):
    rng = np.random.default_rng(11)
    prior = RigPrior(1e-3, leakage_std=0.01, leakage_measured=True)
    patches = paint(draw_world(rng, (0.003j, 0.004)), paint_mm)
    inversion = invert(patches, prior, KINDS)
    assert inversion.painted > 0.8
    assert inversion.paint_mm == pytest.approx(paint_mm, abs=0.04)
    assert sum(d < 5.99 for d in compute_distances(inversion)) >= 7


def test_paint_that_only_may_be_there_is_in_every_error_bar():
    """Four scenes in which paint has a probability of 0.3 to 0.8; without one of the patches the metal seems bare."""
    probabilities = []
    is_covered = []
    for seed in (101, 118, 124, 125):
        rng = np.random.default_rng(seed)
        parts = 0.041 * rng.standard_normal(4)
        eps = EPS * (1 + 0.02 * rng.standard_normal(EPS.size))
        eps = eps.real + 1j * eps.imag * np.exp(0.3 * rng.standard_normal(EPS.size))
        plates = draw_world(rng, (complex(*parts[:2]), complex(*parts[2:])), noise=0.006, eps=eps)
        inversion = invert(paint(plates, rng.uniform(0.05, 0.2)), RigPrior(1e-3), KINDS)
        probabilities.append(inversion.painted)
        is_covered += [d < 5.99 for d in compute_distances(inversion, eps)]
    assert 0.05 < min(probabilities) < max(probabilities) < 0.95
    assert np.mean(is_covered) > 0.87


def test_bare_metal_is_not_called_painted():
    for seed in range(3):
        rng = np.random.default_rng(seed)
        leak = (draw_leakage(rng) / 3, draw_leakage(rng) / 3)
        inversion = invert(draw_world(rng, leak), RigPrior(1e-3, leakage_std=0.025), KINDS)
        assert inversion.painted < 0.2


def test_paint_is_an_error_of_the_reference_from_a_probability_of_a_fifth():
    """Less probable paint leaves the reference its own error; two scenes, one of each."""
    probabilities = []
    for seed in range(2):
        patches = paint(draw_world(np.random.default_rng(seed), (0.003j, 0.004)), 0.03)
        inversion = invert(patches, RigPrior(1e-3, leakage_std=0.01, leakage_measured=True), KINDS)
        probabilities.append(inversion.painted)
        assert (np.diag(inversion.nuisance_covariance)[5] > 2) == (inversion.painted > 0.2)
    assert 0.05 < probabilities[0] < 0.2 < probabilities[1]


@pytest.mark.parametrize("draw", range(4))
def test_a_mount_that_has_moved_is_found_whatever_is_drawn(draw):
    # The patches are of the library, which with the leakage that was measured before the turn none of them fits.
    plates = [Kind(f"plate {i}", complex(e), spread=(0.02, 0.1)) for i, e in enumerate(PUBLISHED)]
    kinds = Kinds([*list_literature_kinds(), *plates], float(THETA))
    # With 0.05 one draw of four has 0.89: two of the plates have nearly the same V / H, and count for less than two.
    prior = RigPrior(0.0015, leakage_std=0.003, leakage_measured=True, channels_known=True, moved=0.1)
    patches = draw_world(np.random.default_rng(0), (0j, 0.055), eps=PUBLISHED[:8])
    model = SceneLikelihood(patches, prior, kinds)
    particles, _, _ = sample_posterior(model, np.random.default_rng(draw))
    assert model.has_moved(particles).mean() > 0.9
    _, into_v = model.leakage(particles)
    assert abs(into_v.mean() - 0.055) < 0.015


def test_images_with_the_other_sign_of_phase_are_distinguished_from_ours():
    rng = np.random.default_rng(3)
    prior = RigPrior(1e-3, leakage_std=0.01)
    measurements = draw_world(rng, (0.01, -0.01j))
    mirrored_measurements, their_prior = mirror_phases(measurements, prior)
    upright = invert(measurements, prior, KINDS)
    mirrored = invert(mirrored_measurements, their_prior, KINDS)
    for prior_probability in (0.1, 0.5, 0.9):
        _, wrong_probability = join_signs(upright, mirrored, prior_probability)
        _, right_probability = join_signs(mirrored, upright, 1 - prior_probability)
        assert wrong_probability < 0.5
        assert right_probability == pytest.approx(1 - wrong_probability, abs=1e-9)


@pytest.mark.parametrize("evidence", [-1.0, 0.0, 1.0])
def test_errors_hold_both_signs_of_phase_in_the_share_of_their_probability(evidence):
    rng = np.random.default_rng(4)
    prior = RigPrior(1e-3, leakage_std=0.01)
    measurements = draw_world(rng, (0j, 0j))
    upright = invert(measurements, prior, KINDS)
    mirrored = replace(invert(*mirror_phases(measurements, prior), KINDS), log_evidence=upright.log_evidence + evidence)
    joined, wrong_probability = join_signs(upright, mirrored, 0.3)
    for right_patch, wrong_patch, joined_patch in zip(upright.patches, mirrored.patches, joined.patches, strict=True):
        assert joined_patch.permittivity == right_patch.permittivity
        distance2 = abs(wrong_patch.permittivity - right_patch.permittivity) ** 2
        expected = (1 - wrong_probability) * np.trace(right_patch.covariance) + wrong_probability * (
            np.trace(wrong_patch.covariance) + distance2
        )
        assert np.trace(joined_patch.covariance) == pytest.approx(expected)
        wider = np.sqrt(np.diag(joined_patch.covariance) / np.diag(right_patch.covariance))
        np.testing.assert_allclose(np.array(joined_patch.half_widths_68) / right_patch.half_widths_68, wider)
        assert sum(joined_patch.shares.values()) == pytest.approx(1.0)
    # Without any doubt nothing changes
    assert join_signs(upright, mirrored, 1e-6)[0] == upright


def test_what_plates_may_be_counts_less_on_leakage_that_was_never_measured():
    patches = draw_world(np.random.default_rng(4), (0.03, 0.02j), eps=EPS[:5])
    measured = RigPrior(2e-3, (0.03 + 0j, 0.02j), 0.003, True)
    unmeasured = RigPrior(2e-3)
    inversions = [invert(patches, prior, KINDS) for prior in (unmeasured, measured)]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("polysight.materials.inversion.WEIGHT_OF_KINDS", 1.0)
        in_full = [invert(patches, prior, KINDS) for prior in (unmeasured, measured)]
    errors = [np.trace(p.covariance) for p in inversions[0].patches]
    errors_in_full = [np.trace(p.covariance) for p in in_full[0].patches]
    assert np.median(np.array(errors) / errors_in_full) > 1.05
    assert inversions[1].leakage == in_full[1].leakage


def test_half_widths_hold_68_percent_of_errors_whose_size_varies_from_plate_to_plate():
    """Own errors of a drawn size, inverse gamma: 95 % lie where they did, but most errors are small."""
    rng = np.random.default_rng(3)
    prior = RigPrior(theta_std_rad=1e-5, leakage_std=5e-4, leakage_measured=True, reference_std=1e-4)
    inside_68 = []
    inside_95 = []
    for _ in range(20):
        exact = draw_world(rng, (0j, 0j), noise=0.0, dull=0.0, eps=np.full(10, 4.0 - 0.4j))
        size = 0.01 * np.sqrt(3.0 / rng.chisquare(3.0, 10)) * np.sqrt(5.991 / 19.1)
        errors = size * (rng.standard_normal(10) + 1j * rng.standard_normal(10))
        patches = [
            replace(patch, inverse_ratio=patch.inverse_ratio + complex(error), std=0.01)
            for patch, error in zip(exact, errors, strict=True)
        ]
        for patch in invert(patches, prior).patches:
            deviation = np.abs([patch.permittivity.real - 4.0, patch.permittivity.imag + 0.4])
            inside_68.append(deviation < patch.half_widths_68)
            inside_95.append(deviation < 1.96 * np.sqrt(np.diag(patch.covariance)))
    # Within three standard deviations of the count of 200 draws
    np.testing.assert_allclose(np.mean(inside_68, axis=0), 0.683, atol=0.1)
    np.testing.assert_allclose(np.mean(inside_95, axis=0), 0.95, atol=0.046)


@pytest.mark.parametrize("eps", [2.5 - 0.08j, 2.75 - 0.01j, 5.3 - 0.36j])
def test_plates_of_one_foreign_material_do_not_turn_the_boards(eps):
    """Six plates of gypsum, PVC or concrete and a library that has none of them; leakage measured, nothing moved.

    As six independent plates they turned the boards until they agreed with the library: 0, 67 and 0 % of regions held.
    """
    library = [Kind(f"material {i}", complex(value)) for i, value in enumerate(PUBLISHED)]
    kinds = Kinds([*library, *list_literature_kinds()], float(THETA), with_sheets=True)
    plates = np.full(6, eps)
    inside = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        error = 0.003 * (rng.standard_normal(2) + 1j * rng.standard_normal(2))
        prior = RigPrior(1e-3, (complex(error[0]), complex(error[1])), 0.003, True, channels_known=True, moved=0.5)
        result = invert(draw_world(rng, (0j, 0j), noise=0.002, dull=0.1, eps=plates), prior, kinds)
        inside += [distance < 5.991 for distance in compute_distances(result, plates)]
    assert np.mean(inside) > 0.9


def test_plates_are_of_one_material_if_their_ratios_agree_within_their_errors():
    rng = np.random.default_rng(0)
    equal_plates = draw_world(rng, (0j, 0j), noise=0.002, eps=np.full(5, 4.0 - 0.4j))
    other_plates = draw_world(rng, (0j, 0j), noise=0.002, eps=np.array([2.6 - 0.01j, 7.5 - 0.3j]))
    same = compute_probability_of_same_material([*equal_plates, *other_plates])
    assert np.diag(same) == pytest.approx(1)
    assert same == pytest.approx(same.T)
    assert same[:5, :5].min() > 0.5
    assert same[:5, 5:].max() < 1e-6
    # Leakage is common to all plates: it hardly changes which of them agree.
    leaking = draw_world(np.random.default_rng(0), (0.05j, 0.04), noise=0.002, eps=np.full(5, 4.0 - 0.4j))
    assert compute_probability_of_same_material(leaking) == pytest.approx(same[:5, :5], abs=0.05)
    assert compute_probability_of_same_material([]).shape == (0, 0)


@pytest.mark.parametrize("painted_share", [0.25, 0.75])
def test_without_the_evidence_of_a_patch_the_metal_is_painted_as_probably_as_before(painted_share):
    """Of a particle of one column, the metal is painted where it is positive. No patch tells anything."""

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
