"""The other patches show whether one is metal: random scenes of known and unknown materials, with and without metal."""

from types import SimpleNamespace

import numpy as np
import pytest

from polysight.materials.analyse import find_most_like_metal
from polysight.materials.inversion import RigPrior
from polysight.materials.kinds import Kinds, PatchMeasurement, list_literature_kinds
from polysight.materials.metal import MetalEvidence, log_evidence_of_dielectric, weigh_metal_evidence

THETA = np.radians(55.0)
KINDS = Kinds(list_literature_kinds(), float(THETA))
EPS = [
    2.6 - 0.01j, 2.05 - 0.01j, 3.78 - 0.7j, 4.0 - 0.4j, 4.54 - 0.56j, 4.69 - 0.7j, 5.06 - 1.11j, 3.52 - 0.82j,
    4.75 - 2.43j, 3.66 - 0.43j, 6.3 - 0.2j, 7.5 - 0.3j, 9.4 - 0.1j, 9.37 - 18.0j, 1.3 - 0.01j,
]  # fmt: skip


def draw_scene(rng, plates, metal, patterns_db=1.0):
    """Patches relative to the one that is brightest in both channels; True if that is metal; and its V / H."""
    eps = rng.choice(EPS, plates, replace=False)
    eps = eps.real * np.exp(0.03 * rng.standard_normal(plates)) + 1j * eps.imag * np.exp(
        0.3 * rng.standard_normal(plates)
    )
    q = np.sqrt(eps - np.sin(THETA) ** 2)
    r_s = (np.cos(THETA) - q) / (np.cos(THETA) + q)
    r_p = (q - eps * np.cos(THETA)) / (q + eps * np.cos(THETA))
    if metal:
        r_s = np.append(r_s, -1.0)
        r_p = np.append(r_p, -1.0)
    a = 0.1 * rng.random() * np.exp(2j * np.pi * rng.random())
    b = 0.1 * rng.random() * np.exp(2j * np.pi * rng.random())
    dull = np.exp(0.04 * rng.standard_normal(r_s.size))
    h = (r_s + a * r_p) / (1 + a) * dull
    v = (r_p + b * r_s) / (1 + b) * dull
    v = v * 10 ** (patterns_db * rng.standard_normal() / 20) + 0.004 * h * rng.standard_normal(r_s.size)
    best = int(np.argmax(np.abs(h * v)))
    rest = [i for i in range(h.size) if i != best]
    patches = [
        PatchMeasurement(complex(v[i] / h[i] / (v[best] / h[best])), 0.005, THETA, float(abs(h[i] / h[best])))
        for i in rest
    ]
    return patches, metal and best == plates, complex(v[best] / h[best])


@pytest.fixture
def scenes(request):
    """Number of random scenes of each kind; `--long` takes as many as the stated shares were measured with."""
    return 25 if request.config.getoption("--long") else 3


@pytest.mark.parametrize("plates", [1, 2, 3, 4, 6, 9])
def test_no_dielectric_is_taken_for_metal(plates, scenes):
    for seed in range(scenes):
        patches, _, channel = draw_scene(np.random.default_rng([plates, seed]), plates, False)
        assert not weigh_metal_evidence(dict(enumerate(patches)), RigPrior(3e-3), channel, KINDS).enough


def test_evidence_of_a_dielectric_reference_does_not_depend_on_the_paint_of_metal():
    patches, _, _ = draw_scene(np.random.default_rng(0), 3, False)
    priors = [RigPrior(3e-3, painted=probability) for probability in (0.0, 0.5)]
    evidence = [log_evidence_of_dielectric(patches, prior, KINDS, 0.0) for prior in priors]
    assert evidence[0] == evidence[1]


@pytest.mark.parametrize("plates", [7])
def test_a_dielectric_that_is_declared_as_metal_is_doubted_and_metal_is_not(plates, scenes):
    """Without a direct path only the other patches are evidence."""
    doubted = []
    for seed in range(max(5, scenes // 2)):
        for metal in (True, False):
            patches, is_metal, _ = draw_scene(np.random.default_rng([plates, seed]), plates, metal)
            evidence = weigh_metal_evidence(dict(enumerate(patches)), RigPrior(3e-3), None, KINDS)
            if is_metal:
                assert evidence.culprit is None
            else:
                doubted.append(evidence.culprit is not None)
    assert np.mean(doubted) >= 0.7


@pytest.mark.parametrize(("plates", "least"), [(2, 0.6), (4, 0.8), (8, 0.8)])
def test_metal_among_dielectrics_is_mostly_recognised(plates, least, scenes):
    recognised = []
    for seed in range(scenes):
        patches, metal, channel = draw_scene(np.random.default_rng([plates, seed]), plates, True)
        assert metal
        recognised.append(weigh_metal_evidence(dict(enumerate(patches)), RigPrior(3e-3), channel, KINDS).enough)
    assert np.mean(recognised) >= least


def test_alone_nothing_is_shown():
    evidence = weigh_metal_evidence({}, RigPrior(3e-3), 1.0 + 0j, KINDS)
    assert not evidence.enough
    assert evidence.others == 0


def test_a_patch_that_looks_the_same_is_not_evidence():
    """Water beside water looks like metal beside metal."""
    equal_patches = [PatchMeasurement(1.01 - 0.02j, 0.005, THETA, 1.02)] * 5
    evidence = weigh_metal_evidence(dict(enumerate(equal_patches)), RigPrior(3e-3), 1.0 + 0j, KINDS)
    assert evidence.others == 0
    assert not evidence.enough


def make_relative_scene(label, bare, channel_ratio_db=-1.0, refused=()):
    evidence = MetalEvidence(bare, bare, 8, channel_ratio_db)
    return SimpleNamespace(metal=SimpleNamespace(label=label, evidence=evidence), refused=dict.fromkeys(refused))


def test_the_reference_is_the_best_shown_metal_of_those_that_may_be_one():
    brightest = make_relative_scene(1, 5.0)
    bare = make_relative_scene(2, 9.0)
    assert find_most_like_metal([brightest, bare]).metal.label == 2
    assert find_most_like_metal([bare, brightest]).metal.label == 2
    assert find_most_like_metal([brightest, make_relative_scene(2, 9.0, channel_ratio_db=-9.0)]).metal.label == 1
    assert find_most_like_metal([brightest, make_relative_scene(2, 9.0, refused=[2])]).metal.label == 1
    assert find_most_like_metal([brightest, make_relative_scene(2, 9.0, refused=[1])]).metal.label == 2
    nothing_like_metal = [make_relative_scene(1, 5.0, refused=[1, 2]), make_relative_scene(2, 9.0, refused=[1, 2])]
    assert find_most_like_metal(nothing_like_metal).metal.label == 1


@pytest.mark.parametrize(
    ("score", "channel_ratio_db", "contradicted"),
    [(20.0, -7.1, True), (-7.0, -3.1, True), (-7.0, -2.4, False), (-4.0, -6.9, False), (-30.0, None, False)],
)
def test_a_declared_metal_is_contradicted_by_its_own_v_over_h_alone_or_with_the_others(
    score, channel_ratio_db, contradicted
):
    """Unusual patches do not contradict metal: they may be liquids or sheets."""
    assert MetalEvidence(score, score, 6, channel_ratio_db).against == contradicted
