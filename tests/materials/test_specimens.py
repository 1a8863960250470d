"""Specimens differ: their spread is estimated, converted to features by Eq. 2, and included in probabilities."""

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
KINDS = {"a": 2.2 - 0.02j, "b": 3.0 - 0.6j, "c": 4.0 - 0.3j, "d": 5.0 - 1.2j, "e": 6.5 - 0.2j, "f": 4.7 - 2.4j}


def draw_pixels(spread, scans, seed=0, pixels=8, gain=0.01, kinds=KINDS, labelled=True):
    """Pixels of every material in every scan, a specimen of its own in each, errors of the patch's gains and phase."""
    rng = np.random.default_rng(seed)
    eps = np.array(list(kinds.values()))
    shape = (scans, eps.size)
    specimen_eps = eps.real * np.exp(spread[0] * rng.standard_normal(shape)) + 1j * eps.imag * np.exp(
        spread[1] * rng.standard_normal(shape)
    )
    s, p = fresnel(specimen_eps, ANGLE)

    def channel(r):
        error = gain * (rng.standard_normal((*shape, 1)) + 1j * rng.standard_normal((*shape, 1)))
        speckle = gain * (rng.standard_normal((*shape, pixels)) + 1j * rng.standard_normal((*shape, pixels)))
        return -r[..., None] * np.exp(error + speckle)

    h = channel(s)
    v = channel(p)
    i, k, _ = np.indices(h.shape)
    specimens = np.char.add("s", i.ravel().astype(str)) if labelled else None
    names = np.array(list(kinds))[k.ravel()]
    x = make_features(h, v, h / v).reshape(-1, 4)
    return Samples(x, names, i.ravel().astype(str), (i * eps.size + k).ravel(), specimens, (60.0,))


def test_the_effect_of_a_specimen_is_what_eq_2_says():
    """A material that is changed a little looks as the effect predicts, under both angles together."""
    angles = [np.radians(55.0), np.radians(60.0)]
    for eps in KINDS.values():
        log_h, t = features(eps, angles)
        for step in ((1e-3, 0.0), (0.0, 1e-2)):
            shifted = features(complex(eps.real * np.exp(step[0]), eps.imag * np.exp(step[1])), angles)
            moved = relative(shifted[0] - log_h, shifted[1] - t, t).ravel()
            np.testing.assert_allclose(effect(t, angles) @ step, moved, rtol=0.02, atol=1e-6)
    assert not effect(np.array([1.0 + 0j]), [ANGLE]).any(), "metal has no specimens"


def test_the_spread_is_found():
    spreads = [
        np.sqrt(MODELS[DISCRIMINANT_MODEL]("H+V+P").fit(draw_pixels((0.03, 0.2), 40, seed)).spread) for seed in range(4)
    ]
    assert np.mean([f[:, 0].mean() for f in spreads]) == pytest.approx(0.03, rel=0.15)
    assert np.mean([f[:, 1].mean() for f in spreads]) == pytest.approx(0.2, rel=0.2)


def test_a_material_with_one_patch_does_not_change_the_errors_of_others():
    """Its patch is its mean: a residual of zero does not count."""
    samples = draw_pixels((0.03, 0.2), 6)
    repeated = np.isin(samples.names, ["a", "b", "c"])
    once = ~repeated & (samples.groups == samples.groups[0])
    fitted_alone = MODELS[DISCRIMINANT_MODEL]("H+V+P").fit(samples.take(repeated))
    fitted_together = MODELS[DISCRIMINANT_MODEL]("H+V+P").fit(samples.take(repeated | once))
    np.testing.assert_allclose(fitted_together.spread[:3], fitted_alone.spread, rtol=1e-2)
    np.testing.assert_allclose(np.diag(fitted_together.between), np.diag(fitted_alone.between), rtol=1e-2)


def test_without_specimens_apart_the_published_spread_stands():
    samples = draw_pixels((0.0, 0.0), 6, labelled=False)
    np.testing.assert_allclose(
        MODELS[DISCRIMINANT_MODEL]("H+V+P").fit(samples).spread, [np.square(PUBLISHED_SPREAD)] * len(KINDS)
    )


def test_the_order_of_patches_does_not_matter_to_the_spread():
    rng = np.random.default_rng(3)
    kinds = np.repeat(np.arange(3), 10)
    residual = 0.02 * rng.standard_normal((30, 3))
    plates = np.arange(30)
    effects = rng.standard_normal((3, 3, 2))
    noise = 1e-4 * np.eye(3)
    turn = rng.permutation(30)
    forward_spread, shuffled_spread = (
        fit_spread(residual[order], kinds[order], plates[order], effects, noise) for order in (np.arange(30), turn)
    )
    for a, b in zip(forward_spread, shuffled_spread, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


def test_probabilities_of_unseen_specimens_are_calibrated():
    close = {"a": 4.0 - 0.4j, "b": 4.2 - 0.45j, "c": 4.45 - 0.6j, "d": 4.7 - 0.7j}
    model = MODELS[DISCRIMINANT_MODEL]("H+V+P").fit(draw_pixels((0.03, 0.15), 40, 1, kinds=close))
    sure = []
    right = []
    for seed in range(40):
        test = draw_pixels((0.03, 0.15), 1, 100 + seed, kinds=close)
        verdicts = model.by_scan(test.x, test.patches)
        sure += verdicts.confidence.tolist()
        right += (verdicts.names == list(close)).tolist()
        np.testing.assert_allclose(verdicts.probabilities.sum(axis=1), 1)
    assert 0.4 < np.mean(right) < 0.95
    assert np.mean(sure) == pytest.approx(np.mean(right), abs=0.08)


def make_entries(samples):
    """A library of the same patches."""
    out = []
    for p in np.unique(samples.patches):
        of_patch = samples.patches == p
        h = samples.x[of_patch, 0]
        v = samples.x[of_patch, 1]
        q = samples.x[of_patch, 2] + 1j * samples.x[of_patch, 3]
        out.append(
            Entry(
                name=str(samples.names[of_patch][0]),
                scan=f"scan {samples.groups[of_patch][0]}",
                h=h.astype(np.float32),
                v=v.astype(np.float32),
                p=(1 / q).astype(np.complex64),
                incidence_deg=60.0,
                simulated=True,
                specimen=str(samples.specimens[of_patch][0]),
            )
        )
    return Library(tuple(out))


@pytest.mark.parametrize("model", ["knn", "discriminant"])
def test_what_the_library_lacks_gets_no_name_from_any_model(model):
    classifier = Classifier(make_entries(draw_pixels((0.01, 0.05), 12, 3)), model=model, angles_deg=[60.0])
    other_materials = {"s": 8.0 - 0.5j, "t": 3.0 - 2.5j, "u": 2.8 - 0.02j, "v": 5.6 - 0.5j}
    test = draw_pixels((0.01, 0.05), 1, 9, kinds=other_materials)
    named = classifier.scan([test.x[test.patches == p] for p in np.unique(test.patches)])
    assert not [n.patch_name.name for n in named if n.patch_name.source == "library"]


@pytest.mark.parametrize("own", [10.0, 40.0])
def test_liquids_of_a_small_library_are_seldom_called_unknown(own, monkeypatch):
    """They are compared with none of these under the same errors: of the rig, and of what the scan has in common.

    The liquids' features differ by far more than the errors, and their specimens' effects by more than that: any mean
    of the materials' covariances is far from each.
    """
    monkeypatch.setattr(specimens, "OWN_FREEDOM", own)
    liquids = groups()["liquids"].materials
    errors = Errors(0.00356, 0.022, spread=(0.05, 0.2))
    model = MODELS[DISCRIMINANT_MODEL]("H+V+P").fit(draw(liquids, 55.0, errors, 43, 8).samples())
    test = draw(liquids, 55.0, errors, 500, 12).samples()
    rejected = []
    for scan in np.unique(test.groups):
        scan_samples = test.take(test.groups == scan)
        rejected += (model.by_scan(scan_samples.x, scan_samples.patches).distance > 1).tolist()
    assert np.mean(rejected) < 0.1


@pytest.mark.parametrize("model", ["knn", "discriminant"])
def test_only_models_with_probabilities_report_that_no_other_material_is_near(model):
    samples = draw_pixels((0.01, 0.05), 12, 3)
    classifier = Classifier(make_entries(samples), model=model, angles_deg=[60.0])
    test = draw_pixels((0.0, 0.0), 1, 4)
    named = classifier.scan([test.x[test.patches == p] for p in np.unique(test.patches)])
    whys = [
        add_explanation(n, eps, None, classifier.permittivities).patch_name.why
        for n, eps in zip(named, KINDS.values(), strict=True)
    ]
    assert all(n.patch_name.name in cause for n, cause in zip(named, whys, strict=True))
    assert any("no other material" in cause for cause in whys) == (model == "discriminant")


def test_a_patch_unlike_every_material_is_reported_with_the_nearest():
    """It is named for any distance, so that a person knows where to begin."""
    classifier = Classifier(make_entries(draw_pixels((0.01, 0.05), 12, 5)), model="discriminant", angles_deg=[60.0])
    x = draw_pixels((0.0, 0.0), 1, 3, kinds={"glass": 7.5 - 0.05j, "water": 9.4 - 18j})
    named = classifier.scan([x.x[x.patches == p] for p in np.unique(x.patches)])
    permittivities = classifier.permittivities
    for n, eps in zip(named, (7.5 - 0.05j, 9.4 - 18j), strict=True):
        assert n.patch_name.source != "library"
        assert n.patch_name.nearest in permittivities
        assert (
            f"nearest: {n.patch_name.nearest}"
            in add_explanation(n, eps, None, classifier.permittivities).patch_name.why
        )
