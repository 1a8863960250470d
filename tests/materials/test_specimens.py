"""Specimens of one material differ in permittivity.

Their spread is estimated, converted to features by Eq. 2 of the paper, and included in probabilities.
"""

import numpy as np
import pytest

from polysight.materials import MODELS, Classifier, Entry, Library, specimens
from polysight.materials.classify import DISCRIMINANT_MODEL
from polysight.materials.library import Samples, make_features
from polysight.materials.names import add_explanation
from polysight.materials.specimens import PUBLISHED_SPREAD, effect, features, fit_spread, relative
from polysight.polarimetry import fresnel
from polysight_papers.sensys2026.patches import Errors, draw, groups

ANGLE = np.radians(60.0)
# Permittivities of six materials that differ clearly.
KINDS = {"a": 2.2 - 0.02j, "b": 3.0 - 0.6j, "c": 4.0 - 0.3j, "d": 5.0 - 1.2j, "e": 6.5 - 0.2j, "f": 4.7 - 2.4j}


def draw_pixels(spread, scans, seed=0, pixels=8, gain=0.01, kinds=KINDS, labelled=True):
    """Return pixels of every material in every scan; each scan has its own specimens.

    `spread` is the relative standard deviation of eps' and of eps'' between specimens. `gain` is the error of a patch
    in ln amplitude and phase of each channel, and also that of a pixel. With `labelled` the specimens are known.
    """
    rng = np.random.default_rng(seed)
    eps = np.array(list(kinds.values()))
    shape = (scans, eps.size)
    real = eps.real * np.exp(spread[0] * rng.standard_normal(shape))
    imag = eps.imag * np.exp(spread[1] * rng.standard_normal(shape))
    r_s, r_p = fresnel(real + 1j * imag, ANGLE)

    def draw_channel(reflection):
        patch_error = gain * (rng.standard_normal((*shape, 1)) + 1j * rng.standard_normal((*shape, 1)))
        pixel_error = gain * (rng.standard_normal((*shape, pixels)) + 1j * rng.standard_normal((*shape, pixels)))
        # Metal has -1.
        return -reflection[..., None] * np.exp(patch_error + pixel_error)

    h = draw_channel(r_s)
    v = draw_channel(r_p)
    scan, kind, _ = np.indices(h.shape)
    return Samples(
        x=make_features(h, v, h / v).reshape(-1, 4),
        names=np.array(list(kinds))[kind.ravel()],
        groups=scan.ravel().astype(str),
        patches=(scan * eps.size + kind).ravel(),
        specimens=np.char.add("s", scan.ravel().astype(str)) if labelled else None,
        angles_deg=(60.0,),
    )


def fit_discriminant(samples):
    """Return the discriminant of the features of both channels and their ratio."""
    return MODELS[DISCRIMINANT_MODEL]("H+V+P").fit(samples)


def test_the_effect_of_a_specimen_is_what_eq_2_says():
    """The features of a material that is changed a little differ by the effect times the change, under both angles."""
    angles = [np.radians(55.0), np.radians(60.0)]
    for eps in KINDS.values():
        log_h, t = features(eps, angles)
        # Steps of ln eps' and ln eps''
        for step in ((1e-3, 0.0), (0.0, 1e-2)):
            changed_eps = complex(eps.real * np.exp(step[0]), eps.imag * np.exp(step[1]))
            changed_log_h, changed_t = features(changed_eps, angles)
            change = relative(changed_log_h - log_h, changed_t - t, t).ravel()
            np.testing.assert_allclose(effect(t, angles) @ step, change, rtol=0.02, atol=1e-6)
    assert not effect(np.array([1.0 + 0j]), [ANGLE]).any(), "metal has no specimens"


def test_the_spread_of_specimens_is_estimated():
    models = [fit_discriminant(draw_pixels((0.03, 0.2), scans=40, seed=seed)) for seed in range(4)]
    # `spread` is the variance of eps' and of eps'' of each material.
    stds = np.mean([np.sqrt(model.spread) for model in models], axis=(0, 1))
    # The spreads that are found are 0.033 and 0.185.
    assert stds[0] == pytest.approx(0.03, rel=0.15)
    assert stds[1] == pytest.approx(0.2, rel=0.2)


def test_a_material_with_one_patch_does_not_change_the_errors_of_others():
    """The mean of a material with one patch is the patch itself: its deviation, which is zero, is not counted."""
    samples = draw_pixels((0.03, 0.2), scans=6)
    in_all_scans = np.isin(samples.names, ["a", "b", "c"])
    in_one_scan = ~in_all_scans & (samples.groups == samples.groups[0])
    fitted_alone = fit_discriminant(samples.take(in_all_scans))
    fitted_together = fit_discriminant(samples.take(in_all_scans | in_one_scan))
    np.testing.assert_allclose(fitted_together.spread[:3], fitted_alone.spread, rtol=1e-2)
    np.testing.assert_allclose(np.diag(fitted_together.between), np.diag(fitted_alone.between), rtol=1e-2)


def test_without_known_specimens_the_spread_is_the_published_one():
    samples = draw_pixels((0.0, 0.0), scans=6, labelled=False)
    np.testing.assert_allclose(fit_discriminant(samples).spread, [np.square(PUBLISHED_SPREAD)] * len(KINDS))


def test_the_spread_does_not_depend_on_the_order_of_patches():
    rng = np.random.default_rng(3)
    kinds = np.repeat(np.arange(3), 10)
    residual = 0.02 * rng.standard_normal((30, 3))
    plates = np.arange(30)
    effects = rng.standard_normal((3, 3, 2))
    noise = 1e-4 * np.eye(3)
    order = rng.permutation(30)
    spread = fit_spread(residual, kinds, plates, effects, noise)
    spread_of_shuffled = fit_spread(residual[order], kinds[order], plates[order], effects, noise)
    for before, after in zip(spread, spread_of_shuffled, strict=True):
        np.testing.assert_allclose(before, after, rtol=1e-6)


def test_probabilities_of_unseen_specimens_are_calibrated():
    """The mean confidence is the share of right names, with four materials that are close to each other."""
    close = {"a": 4.0 - 0.4j, "b": 4.2 - 0.45j, "c": 4.45 - 0.6j, "d": 4.7 - 0.7j}
    model = fit_discriminant(draw_pixels((0.03, 0.15), scans=40, seed=1, kinds=close))
    confidences = []
    is_right = []
    for seed in range(40):
        test = draw_pixels((0.03, 0.15), scans=1, seed=100 + seed, kinds=close)
        verdicts = model.by_scan(test.x, test.patches)
        confidences += verdicts.confidence.tolist()
        is_right += (verdicts.names == list(close)).tolist()
        np.testing.assert_allclose(verdicts.probabilities.sum(axis=1), 1)
    # The case is neither hopeless nor trivial.
    assert 0.4 < np.mean(is_right) < 0.95
    # A share of 160 patches has an error of up to sqrt(0.25 / 160) = 0.04: two of these.
    assert np.mean(confidences) == pytest.approx(np.mean(is_right), abs=0.08)


def make_entries(samples):
    """Return a library of the same patches."""
    entries = []
    for patch in np.unique(samples.patches):
        of_patch = samples.patches == patch
        h = samples.x[of_patch, 0]
        v = samples.x[of_patch, 1]
        v_over_h = samples.x[of_patch, 2] + 1j * samples.x[of_patch, 3]
        entries.append(
            Entry(
                name=str(samples.names[of_patch][0]),
                scan=f"scan {samples.groups[of_patch][0]}",
                h=h.astype(np.float32),
                v=v.astype(np.float32),
                p=(1 / v_over_h).astype(np.complex64),
                incidence_deg=60.0,
                simulated=True,
                specimen=str(samples.specimens[of_patch][0]),
            )
        )
    return Library(tuple(entries))


def name_patches(classifier, samples):
    """Return the names of all patches of the samples, as of one scan."""
    return classifier.scan([samples.x[samples.patches == patch] for patch in np.unique(samples.patches)])


@pytest.mark.parametrize("model", ["knn", "discriminant"])
def test_materials_that_the_library_lacks_get_no_name_of_it_from_any_model(model):
    library = make_entries(draw_pixels((0.01, 0.05), scans=12, seed=3))
    classifier = Classifier(library, model=model, angles_deg=[60.0])
    other_materials = {"s": 8.0 - 0.5j, "t": 3.0 - 2.5j, "u": 2.8 - 0.02j, "v": 5.6 - 0.5j}
    named = name_patches(classifier, draw_pixels((0.01, 0.05), scans=1, seed=9, kinds=other_materials))
    assert not [n.patch_name.name for n in named if n.patch_name.source == "library"]


@pytest.mark.parametrize("own_freedom", [10.0, 40.0])
def test_liquids_of_a_small_library_are_seldom_called_unknown(own_freedom, monkeypatch):
    """The features of liquids differ by far more than the errors, and so do the effects of their specimens.

    Any mean of the materials' covariances is then far from that of each. `OWN_FREEDOM` is how much a material's own
    scatter counts against that mean.
    """
    monkeypatch.setattr(specimens, "OWN_FREEDOM", own_freedom)
    liquids = groups()["liquids"].materials
    errors = Errors(amplitude=0.00356, phase_rad=0.022, spread=(0.05, 0.2))
    model = fit_discriminant(draw(liquids, 55.0, errors, seed=43, scans=8).samples())
    test = draw(liquids, 55.0, errors, seed=500, scans=12).samples()
    rejected = []
    for scan in np.unique(test.groups):
        scan_samples = test.take(test.groups == scan)
        # Beyond a distance of 1 a patch is unknown.
        rejected += (model.by_scan(scan_samples.x, scan_samples.patches).distance > 1).tolist()
    # At most 1 % of the patches are rejected.
    assert np.mean(rejected) < 0.1


@pytest.mark.parametrize("model", ["knn", "discriminant"])
def test_only_models_with_probabilities_report_that_no_other_material_is_near(model):
    library = make_entries(draw_pixels((0.01, 0.05), scans=12, seed=3))
    classifier = Classifier(library, model=model, angles_deg=[60.0])
    named = name_patches(classifier, draw_pixels((0.0, 0.0), scans=1, seed=4))
    reasons = []
    for patch, eps in zip(named, KINDS.values(), strict=True):
        reason = add_explanation(patch, eps, None, classifier.permittivities).patch_name.why
        assert patch.patch_name.name in reason
        reasons.append(reason)
    assert any("no other material" in reason for reason in reasons) == (model == "discriminant")


def test_a_patch_unlike_every_material_is_reported_with_the_nearest():
    """The nearest material is given at any distance, so that a person knows where to begin."""
    library = make_entries(draw_pixels((0.01, 0.05), scans=12, seed=5))
    classifier = Classifier(library, model="discriminant", angles_deg=[60.0])
    foreign = {"glass": 7.5 - 0.05j, "water": 9.4 - 18j}
    named = name_patches(classifier, draw_pixels((0.0, 0.0), scans=1, seed=3, kinds=foreign))
    permittivities = classifier.permittivities
    for patch, eps in zip(named, foreign.values(), strict=True):
        nearest = patch.patch_name.nearest
        assert patch.patch_name.source != "library"
        assert nearest in permittivities
        assert f"nearest: {nearest}" in add_explanation(patch, eps, None, permittivities).patch_name.why
