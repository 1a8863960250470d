"""Errors of single points: their regions are right in quiet segments and where edges or other echoes ripple."""

from dataclasses import replace

import numpy as np
import pytest

from polysight.surfaces import permittivity
from polysight.surfaces.gains import Gains, Voltages, learn_gains, number_blocks
from polysight.surfaces.optics import reflect_flat
from polysight.surfaces.permittivity import (
    DisturbedScan,
    fit_permittivity,
    judge_medium,
    point_covariance,
    point_permittivity,
)
from polysight.surfaces.result import MAX_BAND_RISE, MAX_LEVEL_MISS

WAVE_NUMBER = 1634.0
EPS = 4.0 - 0.5j
CHI2_95 = 5.991
# Metal of known gain, the same in all directions.
UNIT_GAINS = Gains(
    ratio_terms=np.zeros(1, complex),
    level_terms=np.zeros((2, 1)),
    band_rise=np.zeros(2),
    middle=np.zeros(2),
    departure_middle=np.zeros(2),
    degree=0,
    std=0.0,
    covered=(np.full(2, -1.0), np.full(2, 1.0)),
    terms_root=np.zeros((1, 1)),
    cell=np.full(2, np.inf),
)


def make_voltages(ripple: np.ndarray, at_m: np.ndarray, stated_noise: float) -> Voltages:
    """Voltages of a flat surface with a relative ripple [n] in each part of V, of which `stated_noise` is known."""
    rng = np.random.default_rng(4)
    count = len(ripple)
    theta = np.full(count, np.radians(50.0))
    b = np.stack(reflect_flat(EPS, theta), axis=1)
    b[:, 1] *= 1 + ripple * (rng.standard_normal(count) + 1j * rng.standard_normal(count))
    std = np.zeros((count, 2))
    std[:, 1] = stated_noise * np.abs(b[:, 1])
    zero = np.zeros(count)
    rows = np.zeros((count, 2, 4), complex)
    rows[:, 0, 0] = 1
    rows[:, 1, 1] = 1
    return Voltages(
        voltage=b,
        std=std,
        response=rows,
        theta=np.stack([theta, theta], axis=1),
        path_m=np.full((count, 2), np.inf),
        bend_inside=zero,
        bend_across=zero,
        twist=zero,
        arrival=np.zeros((count, 2)),
        departure=np.zeros((count, 2)),
        band_rise=np.zeros((count, 2)),
        at_m=at_m,
    )


@pytest.mark.parametrize("stated_noise", [0.003, 0.01])
def test_regions_of_points_hold_where_it_is_quiet_and_where_it_ripples(stated_noise):
    x, y = np.meshgrid(np.arange(40) * 0.008, np.arange(40) * 0.008)
    at_m = np.stack([x.ravel(), y.ravel()], axis=1)
    is_rippled = at_m[:, 0] > x.mean()
    voltages = make_voltages(np.where(is_rippled, 0.03, 0.005), at_m, stated_noise)
    fit = fit_permittivity(voltages, UNIT_GAINS, WAVE_NUMBER)
    deviation = point_permittivity(voltages, UNIT_GAINS, WAVE_NUMBER) - EPS
    covariance = point_covariance(voltages, UNIT_GAINS, fit, WAVE_NUMBER)
    parts = np.stack([deviation.real, deviation.imag], axis=1)
    distance2 = np.einsum("ni,nij,nj->n", parts, np.linalg.inv(covariance), parts)
    for half in (is_rippled, ~is_rippled):
        assert 0.9 < np.mean(distance2[half] < CHI2_95) < 0.985


def test_scatter_that_noise_does_not_explain_may_be_common_to_a_block():
    """Few blocks of a small plate do not show the shift of their mean by edges; noise does not shift it."""
    x, y = np.meshgrid(np.arange(8) * 0.008, np.arange(20) * 0.008)
    at_m = np.stack([x.ravel(), y.ravel()], axis=1)
    ripple = np.full(len(at_m), 0.05)
    noise = fit_permittivity(make_voltages(ripple, at_m, 0.05), UNIT_GAINS, WAVE_NUMBER)
    edges = fit_permittivity(make_voltages(ripple, at_m, 0.005), UNIT_GAINS, WAVE_NUMBER)
    assert np.trace(edges.covariance) > 1.1 * np.trace(noise.covariance)


@pytest.mark.parametrize("away", [-0.8 + 0.3j, 1.5 - 0.8j])
def test_a_permittivity_does_not_depend_on_where_its_fit_starts(monkeypatch, away):
    at_m = np.random.default_rng(1).uniform(0, 0.3, (400, 2))
    voltages = make_voltages(np.full(400, 0.02), at_m, 0.01)
    usual = fit_permittivity(voltages, UNIT_GAINS, WAVE_NUMBER)
    monkeypatch.setattr(permittivity, "point_permittivity", lambda *_: np.full(400, usual.eps + away))
    assert fit_permittivity(voltages, UNIT_GAINS, WAVE_NUMBER).eps == pytest.approx(usual.eps, abs=1e-4)


@pytest.mark.parametrize(
    ("ripple", "columns", "rows"), [(0.002, 40, 24), (0.02, 40, 24), (0.02, 12, 20)], ids=["quiet", "wide", "small"]
)
def test_a_region_is_as_wide_as_the_points_ripple(ripple, columns, rows):
    """Ripple as long as a Fresnel zone, 40 mm. When 2 % was assumed for all, regions were ten times too wide.

    When ripple was assumed to be common to 68 mm, regions of small plates were twice as wide as right.
    """
    x, y = np.meshgrid(np.arange(columns) * 0.008, np.arange(rows) * 0.008)
    at_m = np.stack([x.ravel(), y.ravel()], axis=1)
    quiet = make_voltages(np.zeros(len(at_m)), at_m, 0.001)
    rng = np.random.default_rng(3)
    distances2 = []
    for _ in range(60):
        white = rng.standard_normal((2, rows + 4, columns + 4))
        slow = np.lib.stride_tricks.sliding_window_view(white, (5, 5), axis=(1, 2)).mean(axis=(3, 4)) * 5
        noise = rng.standard_normal((2, len(at_m)))
        real, imaginary = ripple * slow.reshape(2, -1) + 0.001 * noise
        v = replace(quiet, voltage=quiet.voltage * np.stack([np.ones(len(at_m)), 1 + real + 1j * imaginary], axis=1))
        fit = fit_permittivity(v, UNIT_GAINS, WAVE_NUMBER)
        miss = fit.eps - EPS
        parts = np.array([miss.real, miss.imag])
        distances2.append(parts @ np.linalg.solve(fit.covariance, parts))
    assert 0.9 < np.mean(np.array(distances2) < CHI2_95) < 1
    assert 1 < np.mean(distances2) < 2.5


def test_a_level_that_a_badly_known_rig_explains_does_not_refuse_a_segment():
    voltages = make_voltages(np.full(400, 0.005), np.random.default_rng(1).uniform(0, 0.3, (400, 2)), 0.005)
    fit = fit_permittivity(voltages, UNIT_GAINS, WAVE_NUMBER)
    # H is 30 % too strong, as of a board that may stand so: the level of no half space of this permittivity.
    loud = replace(voltages, voltage=voltages.voltage * np.array([1.3, 1.3]))
    well_known, _ = judge_medium(fit, loud, UNIT_GAINS, [], WAVE_NUMBER)
    moved = DisturbedScan("places", replace(loud, voltage=loud.voltage * np.array([1.2, 1.2])), UNIT_GAINS)
    badly_known, _ = judge_medium(fit, loud, UNIT_GAINS, [moved], WAVE_NUMBER)
    assert well_known > 0.2
    assert badly_known == 0


def test_what_a_badly_known_rig_does_not_explain_refuses_a_segment():
    """Half a millimetre of plastic on a ceramic: a level 11 % off, of which the rig's errors explain 4."""
    voltages = make_voltages(np.full(400, 0.005), np.random.default_rng(1).uniform(0, 0.3, (400, 2)), 0.005)
    fit = fit_permittivity(voltages, UNIT_GAINS, WAVE_NUMBER)
    coated = replace(voltages, voltage=0.893 * voltages.voltage)
    moved = DisturbedScan("places", replace(coated, voltage=1.037 * coated.voltage), UNIT_GAINS)
    level, _ = judge_medium(fit, coated, UNIT_GAINS, [moved], WAVE_NUMBER)
    assert MAX_LEVEL_MISS < level < 0.113


def test_a_rise_that_its_own_scatter_may_be_refuses_no_segment():
    """A solid of 2.1 reflects little of V, whose rise scatters over the points: 1 % in the mean of its blocks."""
    rng = np.random.default_rng(1)
    voltages = make_voltages(np.full(400, 0.005), rng.uniform(0, 0.3, (400, 2)), 0.005)
    fit = fit_permittivity(voltages, UNIT_GAINS, WAVE_NUMBER)
    blocks = 1 + number_blocks(voltages.at_m, (0.0, 0.0)).max()
    scatter = rng.standard_normal((400, 2))
    scatter -= np.median(scatter, axis=0)

    def judge(rise, std_of_mean):
        band_rise = rise + std_of_mean * np.sqrt(blocks) * scatter
        return judge_medium(fit, replace(voltages, band_rise=band_rise), UNIT_GAINS, [], WAVE_NUMBER)[1]

    assert judge(0.02, 0.008) < MAX_BAND_RISE
    assert judge(0.02, 0.002) > MAX_BAND_RISE


def test_a_wide_object_averages_over_what_a_reference_leaves_and_a_flat_one_does_not():
    measured_gains = replace(UNIT_GAINS, degree=2, std=0.004, terms_root=np.zeros((6, 1)), cell=np.full(2, 0.05))
    x, y = np.meshgrid(np.arange(8) * 0.05 + 0.01, np.arange(8) * 0.05 + 0.01)
    directions = np.stack([x.ravel(), y.ravel()], axis=1)

    def find_std_of_mean(arrival: np.ndarray) -> float:
        return float(np.linalg.norm(measured_gains.list_errors(arrival).mean(axis=1)))

    assert find_std_of_mean(directions[:1]) == pytest.approx(0.004)
    assert find_std_of_mean(directions) == pytest.approx(0.004 / 8)
    # Beyond the directions that the reference covers all points are wrong together.
    assert find_std_of_mean(directions + 1.5) > 0.05


@pytest.mark.parametrize(
    ("wave", "least", "most"), [(0.0, 0.0, 0.0012), (0.006, 0.0028, 0.005)], ids=["noise", "gains"]
)
def test_noise_of_the_points_of_a_reference_does_not_enter_its_gains(wave, least, most):
    """The polynomials average over noise; gains that they do not follow are the same for every object."""
    x, y = np.meshgrid(np.arange(16) * 0.028, np.arange(14) * 0.028)
    at_m = np.stack([x.ravel(), y.ravel()], axis=1)
    metal = make_voltages(np.zeros(len(at_m)), at_m, 0.0)
    rng = np.random.default_rng(2)
    noise = rng.standard_normal((len(at_m), 2)) + 1j * rng.standard_normal((len(at_m), 2))
    # Waves of 150 mm, 0.12 rad of direction, which no polynomial of second degree follows and a block half averages.
    phase = 2 * np.pi * at_m[:, 0] / 0.15
    gain = np.stack([np.exp(wave * (np.sin(phase) + 1j * np.cos(phase))), np.ones(len(at_m))], axis=1)
    metal = replace(metal, voltage=-gain * (1 + 0.003 * noise), std=np.full((len(at_m), 2), 0.003), arrival=0.8 * at_m)
    gains = learn_gains(metal, WAVE_NUMBER)
    assert least <= gains.std < most
    # Both change the values of the polynomials.
    assert np.linalg.norm(gains.terms_root) > 0
