"""Whether the reference patch of a scene is metal is judged by the other patches.

The scenes are random: plates of known and unknown materials, with and without metal.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from polysight.materials.analyse import find_most_like_metal
from polysight.materials.inversion import RigPrior
from polysight.materials.kinds import Kinds, PatchMeasurement, list_literature_kinds
from polysight.materials.metal import MetalEvidence, log_evidence_of_dielectric, weigh_metal_evidence

THETA = np.radians(55.0)
KINDS = Kinds(list_literature_kinds(), float(THETA))
# Permittivities from which the plates of a scene are drawn: polymers, materials of the paper, ceramics, water, foam.
EPS = [
    2.6 - 0.01j, 2.05 - 0.01j, 3.78 - 0.7j, 4.0 - 0.4j, 4.54 - 0.56j, 4.69 - 0.7j, 5.06 - 1.11j, 3.52 - 0.82j,
    4.75 - 2.43j, 3.66 - 0.43j, 6.3 - 0.2j, 7.5 - 0.3j, 9.4 - 0.1j, 9.37 - 18.0j, 1.3 - 0.01j,
]  # fmt: skip


def draw_scene(rng, plates, metal, patterns_db=1.0):
    """Return a scene of dielectric plates, and of metal if `metal`, as seen relative to its brightest patch.

    Returned are the patches relative to the one with the largest |H V|, True if that one is metal, and its own V / H.
    `patterns_db` is the uncertainty of V over H by the antenna patterns.
    """
    # Specimens differ from the listed values by 3 % in eps' and 30 % in eps''.
    eps = rng.choice(EPS, plates, replace=False)
    real_factor = np.exp(0.03 * rng.standard_normal(plates))
    loss_factor = np.exp(0.3 * rng.standard_normal(plates))
    eps = eps.real * real_factor + 1j * eps.imag * loss_factor

    # Reflection by Eq. 2 of the paper
    q = np.sqrt(eps - np.sin(THETA) ** 2)
    r_s = (np.cos(THETA) - q) / (np.cos(THETA) + q)
    r_p = (q - eps * np.cos(THETA)) / (q + eps * np.cos(THETA))
    if metal:
        r_s = np.append(r_s, -1.0)
        r_p = np.append(r_p, -1.0)

    # Leakage of up to 0.1 of p into H and of s into V, uneven light of 4 %, and noise of 0.4 % of H in V
    a = 0.1 * rng.random() * np.exp(2j * np.pi * rng.random())
    b = 0.1 * rng.random() * np.exp(2j * np.pi * rng.random())
    light = np.exp(0.04 * rng.standard_normal(r_s.size))
    h = (r_s + a * r_p) / (1 + a) * light
    v = (r_p + b * r_s) / (1 + b) * light
    pattern_gain = 10 ** (patterns_db * rng.standard_normal() / 20)
    v = v * pattern_gain + 0.004 * h * rng.standard_normal(r_s.size)

    brightest = int(np.argmax(np.abs(h * v)))
    ratio = v / h
    patches = []
    for patch in range(h.size):
        if patch == brightest:
            continue
        relative_ratio = complex(ratio[patch] / ratio[brightest])
        brightness = float(abs(h[patch] / h[brightest]))
        patches.append(PatchMeasurement(relative_ratio, std=0.005, theta_rad=THETA, brightness=brightness))
    # Metal comes after the dielectric plates.
    is_metal = metal and brightest == plates
    return patches, is_metal, complex(ratio[brightest])


def weigh(patches, channel):
    """Return the evidence that the reference of these patches is metal; `channel` is its V / H, None if not known."""
    return weigh_metal_evidence(dict(enumerate(patches)), RigPrior(theta_std_rad=3e-3), channel, KINDS)


@pytest.fixture
def scenes(request):
    """Number of random scenes of each kind; `--long` takes as many as the stated shares were measured with."""
    return 25 if request.config.getoption("--long") else 3


@pytest.mark.parametrize("plates", [1, 2, 3, 4, 6, 9])
def test_no_dielectric_is_taken_for_metal(plates, scenes):
    for seed in range(scenes):
        patches, _, channel = draw_scene(np.random.default_rng([plates, seed]), plates, metal=False)
        assert not weigh(patches, channel).enough


def test_evidence_of_a_dielectric_reference_does_not_depend_on_the_paint_of_metal():
    patches, _, _ = draw_scene(np.random.default_rng(0), plates=3, metal=False)
    never_painted = RigPrior(theta_std_rad=3e-3, painted=0.0)
    often_painted = RigPrior(theta_std_rad=3e-3, painted=0.5)
    evidence = log_evidence_of_dielectric(patches, never_painted, KINDS, 0.0)
    assert log_evidence_of_dielectric(patches, often_painted, KINDS, 0.0) == evidence


@pytest.mark.parametrize("plates", [7])
def test_a_dielectric_that_is_declared_as_metal_is_doubted_and_metal_is_not(plates, scenes):
    """The V / H of the declared patch itself is not known, as without a direct path: only the others are evidence."""
    doubted = []
    for seed in range(max(5, scenes // 2)):
        for metal in (True, False):
            patches, is_metal, _ = draw_scene(np.random.default_rng([plates, seed]), plates, metal)
            evidence = weigh(patches, channel=None)
            # `culprit` is the patch that speaks most against metal.
            if is_metal:
                assert evidence.culprit is None
            else:
                doubted.append(evidence.culprit is not None)
    # All five dielectrics of the short run are doubted, and 11 of the 12 of `--long`: some look as metal would among
    # the same plates.
    assert np.mean(doubted) >= 0.7


# More plates are more evidence. In the three scenes of the short run the metal is always recognised.
@pytest.mark.parametrize(("plates", "least_share"), [(2, 0.6), (4, 0.8), (8, 0.8)])
def test_metal_among_dielectrics_is_mostly_recognised(plates, least_share, scenes):
    recognised = []
    for seed in range(scenes):
        patches, is_metal, channel = draw_scene(np.random.default_rng([plates, seed]), plates, metal=True)
        assert is_metal
        recognised.append(weigh(patches, channel).enough)
    assert np.mean(recognised) >= least_share


def test_a_single_patch_is_not_shown_to_be_metal():
    evidence = weigh([], channel=1.0 + 0j)
    assert not evidence.enough
    assert evidence.others == 0


def test_patches_that_look_like_the_reference_are_not_evidence():
    """Relative to each other, several patches of water look like several of metal."""
    like_reference = PatchMeasurement(1.01 - 0.02j, std=0.005, theta_rad=THETA, brightness=1.02)
    evidence = weigh([like_reference] * 5, channel=1.0 + 0j)
    assert evidence.others == 0
    assert not evidence.enough


def make_relative_scene(label, bare, channel_ratio_db=-1.0, refused=()):
    """Return a stand-in for a scene relative to patch `label`: `bare` is the log evidence that it is bare metal.

    `channel_ratio_db` is its V over H, `refused` the patches that are not plates.
    """
    evidence = MetalEvidence(bare, bare, 8, channel_ratio_db)
    return SimpleNamespace(metal=SimpleNamespace(label=label, evidence=evidence), refused=dict.fromkeys(refused))


def test_the_reference_is_the_patch_with_the_most_evidence_of_those_that_may_be_metal():
    brightest = make_relative_scene(1, 5.0)
    bare = make_relative_scene(2, 9.0)
    # Patch 2 has more evidence, in either order.
    assert find_most_like_metal([brightest, bare]).metal.label == 2
    assert find_most_like_metal([bare, brightest]).metal.label == 2
    # Patch 2 is excluded by its V / H, which is 9 dB too small, or if it is not a plate.
    assert find_most_like_metal([brightest, make_relative_scene(2, 9.0, channel_ratio_db=-9.0)]).metal.label == 1
    assert find_most_like_metal([brightest, make_relative_scene(2, 9.0, refused=[2])]).metal.label == 1
    # In a scene that is relative to patch 2, it does not matter that patch 1 is not a plate.
    assert find_most_like_metal([brightest, make_relative_scene(2, 9.0, refused=[1])]).metal.label == 2
    # If none of the patches may be metal, the first one is taken.
    nothing_like_metal = [make_relative_scene(1, 5.0, refused=[1, 2]), make_relative_scene(2, 9.0, refused=[1, 2])]
    assert find_most_like_metal(nothing_like_metal).metal.label == 1


# `score` is the log evidence of the other patches for metal. V / H contradicts metal below `WEAK_V_DB`, -7 dB, and
# below `DOUBTFUL_V_DB` if the others are clearly against it, as with -7.0. Without a direct path V / H is not known.
@pytest.mark.parametrize(
    ("score", "channel_ratio_db", "contradicted"),
    [(20.0, -7.1, True), (-7.0, -3.1, True), (-7.0, -2.4, False), (-4.0, -6.9, False), (-30.0, None, False)],
)
def test_a_declared_metal_is_contradicted_by_its_own_v_over_h_alone_or_with_the_others(
    score, channel_ratio_db, contradicted
):
    """Unusual patches do not contradict metal: they may be liquids or sheets."""
    assert MetalEvidence(score, score, 6, channel_ratio_db).against == contradicted
