"""Pixels drawn patch by patch: their laws, and that the noise is set by H only."""

import inspect

import numpy as np
import pytest

from polysight.materials.classify import DISCRIMINANT_MODEL, PAPER_MODEL
from polysight.materials.train import score
from polysight.polarimetry import fresnel, permittivity_from_ratio
from polysight_papers.sensys2026 import patches
from polysight_papers.sensys2026.classification import pixel_bound
from polysight_papers.sensys2026.item import published_values
from polysight_papers.sensys2026.patches import Errors, calibrated_errors, draw, groups, h_accuracy

QUIET = Errors(0.0, 0.0)


@pytest.mark.parametrize("name", ["solids", "liquids", "powders"])
def test_without_errors_a_pixel_is_fresnel_s_reflection_relative_to_metal(name):
    group = groups()[name]
    drawn = draw(group.materials, group.angle_deg, QUIET, seed=0, scans=2, pixels=3)
    eps = np.array([m.permittivity for m in group.materials])
    r_s, r_p = fresnel(eps, np.radians(group.angle_deg))
    assert np.allclose(drawn.h, -r_s[:, None])
    assert np.allclose(drawn.v, -r_p[:, None])
    assert np.allclose(permittivity_from_ratio(drawn.h / drawn.v, np.radians(group.angle_deg)), eps[:, None])


def test_the_groups_are_the_table_s_36_rows():
    assert [m.number for g in groups().values() for m in g.materials] == list(range(1, 37))


@pytest.mark.parametrize("shared", [0.0, 0.5, 1.0])
def test_errors_have_the_size_and_the_share_that_was_asked_for(shared):
    metal = groups()["solids"].materials[:1]
    samples_drawn = draw(metal, 60.0, Errors(0.02, 0.03, shared), seed=1, scans=3000, pixels=8)
    r_s, _ = fresnel(metal[0].permittivity, np.radians(60.0))
    for values, std in ((np.log(np.abs(samples_drawn.h / r_s)), 0.02), (np.angle(samples_drawn.h / -r_s), 0.03)):
        within = values.var(axis=2, ddof=1).mean()
        between = values.mean(axis=2).var() - within / 8
        assert within == pytest.approx((1 - shared) * std**2, rel=0.1, abs=1e-7)
        # The patch's and the reference's
        assert between == pytest.approx(2 * shared * std**2, rel=0.1, abs=3e-6)


def test_h_and_v_err_independently():
    metal = groups()["solids"].materials[:1]
    samples_drawn = draw(metal, 60.0, Errors(0.02, 0.0), seed=2, scans=3000, pixels=2)
    assert abs(np.corrcoef(np.abs(samples_drawn.h).ravel(), np.abs(samples_drawn.v).ravel())[0, 1]) < 0.06


@pytest.mark.parametrize("name", ["liquids", "powders"])
def test_the_noise_reaches_the_published_accuracy_of_h_on_draws_it_was_not_set_on(name):
    answer = published_values()["classification"][name]["h_percent"] / 100
    assert h_accuracy(groups()[name], calibrated_errors(name, 1), (5, 6, 7)) == pytest.approx(answer, abs=0.06)


def test_the_phase_error_is_the_published_residual_and_only_h_is_used(monkeypatch):
    calls = []

    def spy(samples, model, channels="H+V+P", by_pixel=False, folds=8):
        calls.append((model, channels, by_pixel))
        return score(samples, model, channels, by_pixel, folds)

    monkeypatch.setattr(patches, "score", spy)
    errors = inspect.unwrap(calibrated_errors)("powders", 1)
    assert errors.phase_rad == 0.022
    assert set(calls) == {(PAPER_MODEL, "H", True)}


def test_v_and_p_add_to_what_h_tells():
    group = groups()["powders"]
    samples_drawn = draw(group.materials, group.angle_deg, calibrated_errors("powders", 1), seed=3).samples()
    h = score(samples_drawn, PAPER_MODEL, "H").pixels
    all_three = score(samples_drawn, PAPER_MODEL, "H+V+P").pixels
    assert all_three > h + 0.2


def test_no_classifier_passes_the_bound_and_the_better_one_comes_near():
    group = groups()["powders"]
    errors = Errors(0.03, 0.06)
    scores = [score(draw(group.materials, 60.0, errors, seed).samples(), DISCRIMINANT_MODEL) for seed in range(12)]
    alone = pixel_bound(group.materials, (60.0,), errors, True, 1)
    pixel_limit = pixel_bound(group.materials, (60.0,), errors, False, 1)
    patch = pixel_bound(group.materials, (60.0,), errors, False, 12)
    assert alone < pixel_limit < patch
    for share, bound in (("pixels", alone), ("in_scan", pixel_limit), ("by_patch", patch)):
        mean = np.mean([getattr(s, share) for s in scores])
        # Chance of twelve draws
        assert bound - 0.08 < mean < bound + 0.03, share


def test_the_bound_is_one_without_errors_and_falls_to_chance():
    materials = groups()["powders"].materials
    bounds = [pixel_bound(materials, (60.0,), Errors(a, a), True, 1) for a in (1e-6, 0.03, 0.1, 30.0)]
    assert bounds[0] == 1.0
    assert sorted(bounds, reverse=True) == bounds
    assert bounds[-1] == pytest.approx(0.25, abs=0.05)
    bound_one_angle = pixel_bound(materials, (60.0,), Errors(0.05, 0.05), True, 1)
    two = pixel_bound(materials, (60.0, 55.0), Errors(0.05, 0.05), True, 1)
    assert two > bound_one_angle


def test_confusions_stand_in_the_order_of_table_2():
    from polysight_papers.sensys2026.classification import confusion_figure

    group = groups()["powders"]
    scores = score(draw(group.materials, 60.0, Errors(0.03, 0.06), 0).samples(), DISCRIMINANT_MODEL)
    figure = confusion_figure(group.materials, scores, scores)
    labels = [t.get_text() for t in figure.axes[0].get_xticklabels()]
    assert labels == [str(m.number) for m in group.materials]
    matrix = figure.axes[0].images[0].get_array()
    salt = [m.name for m in group.materials].index("Salt (with plastic)")
    index = scores.names.index("Salt (with plastic)")
    assert matrix[salt, salt] == pytest.approx(100 * scores.confusion[index, index])
