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

# At the middle of the rig's band, 78.0 GHz; 1 / m
WAVE_NUMBER = 1634.0

# Permittivity of the surfaces here
EPS = 4.0 - 0.5j

# A region of two parts (real and imaginary) holds the true value with a probability of 95 % if the squared distance, in
# standard deviations, is below this quantile of chi squared.
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
    """Voltages of a flat surface of `EPS`, of which V has relative errors.

    `ripple` [n] is their true standard deviation in the real and in the imaginary part; the voltages report only
    `stated_noise`, as noise. The rest is what edges and other echoes do.
    """
    rng = np.random.default_rng(4)
    count = len(ripple)
    theta = np.full(count, np.radians(50.0))
    voltage = np.stack(reflect_flat(EPS, theta), axis=1)
    voltage[:, 1] *= 1 + ripple * (rng.standard_normal(count) + 1j * rng.standard_normal(count))
    std = np.zeros((count, 2))
    std[:, 1] = stated_noise * np.abs(voltage[:, 1])
    zero = np.zeros(count)
    # Ideal antennas: H receives s, V receives p.
    rows = np.zeros((count, 2, 4), complex)
    rows[:, 0, 0] = 1
    rows[:, 1, 1] = 1
    return Voltages(
        voltage=voltage,
        std=std,
        response=rows,
        theta=np.stack([theta, theta], axis=1),
        path_m=np.full((count, 2), np.inf),
        curvature_inside=zero,
        curvature_across=zero,
        twist=zero,
        arrival=np.zeros((count, 2)),
        departure=np.zeros((count, 2)),
        band_rise=np.zeros((count, 2)),
        at_m=at_m,
    )


def make_places(columns: int, rows: int) -> np.ndarray:
    """Stage offsets [n, 2] of points 8 mm apart."""
    x, y = np.meshgrid(np.arange(columns) * 0.008, np.arange(rows) * 0.008)
    return np.stack([x.ravel(), y.ravel()], axis=1)


@pytest.mark.parametrize("stated_noise", [0.003, 0.01])
def test_regions_of_points_hold_where_it_is_quiet_and_where_it_ripples(stated_noise):
    """Ripples of 0.5 % in the left half of a surface, and of 3 % in the right one."""
    at_m = make_places(columns=40, rows=40)
    is_rippled = at_m[:, 0] > at_m[:, 0].mean()
    voltages = make_voltages(np.where(is_rippled, 0.03, 0.005), at_m, stated_noise)
    fit = fit_permittivity(voltages, UNIT_GAINS, WAVE_NUMBER)
    deviation = point_permittivity(voltages, UNIT_GAINS, WAVE_NUMBER) - EPS
    covariance = point_covariance(voltages, UNIT_GAINS, fit, WAVE_NUMBER)
    parts = np.stack([deviation.real, deviation.imag], axis=1)
    distance2 = np.einsum("ni,nij,nj->n", parts, np.linalg.inv(covariance), parts)
    for half in (is_rippled, ~is_rippled):
        share_within = np.mean(distance2[half] < CHI2_95)
        # 95 % are expected of 800 points: 94 to 96 % hold the truth.
        assert 0.9 < share_within < 0.985


def test_scatter_that_noise_does_not_explain_may_be_common_to_a_block():
    """The ripple of edges shifts the mean of neighbouring points, noise does not.

    A small plate has few blocks, whose scatter does not show such a shift: it is added to the error.
    """
    at_m = make_places(columns=8, rows=20)
    ripple = np.full(len(at_m), 0.05)
    # The same scatter of 5 %, reported as noise, and as ripple for the most part
    of_noise = fit_permittivity(make_voltages(ripple, at_m, stated_noise=0.05), UNIT_GAINS, WAVE_NUMBER)
    of_edges = fit_permittivity(make_voltages(ripple, at_m, stated_noise=0.005), UNIT_GAINS, WAVE_NUMBER)
    assert np.trace(of_edges.covariance) > 1.1 * np.trace(of_noise.covariance)


@pytest.mark.parametrize("away", [-0.8 + 0.3j, 1.5 - 0.8j])
def test_a_permittivity_does_not_depend_on_where_its_fit_starts(monkeypatch, away):
    at_m = np.random.default_rng(1).uniform(0, 0.3, (400, 2))
    voltages = make_voltages(np.full(400, 0.02), at_m, stated_noise=0.01)
    usual = fit_permittivity(voltages, UNIT_GAINS, WAVE_NUMBER)
    # The fit starts at the points' own permittivities.
    monkeypatch.setattr(permittivity, "point_permittivity", lambda *_: np.full(400, usual.eps + away))
    assert fit_permittivity(voltages, UNIT_GAINS, WAVE_NUMBER).eps == pytest.approx(usual.eps, abs=1e-4)


@pytest.mark.parametrize(
    ("ripple", "columns", "rows"), [(0.002, 40, 24), (0.02, 40, 24), (0.02, 12, 20)], ids=["quiet", "wide", "small"]
)
def test_a_region_is_as_wide_as_the_points_ripple(ripple, columns, rows):
    """The ripple is as long as a Fresnel zone, 40 mm or five points.

    If a ripple of 2 % were assumed for all surfaces, regions of quiet ones would be ten times too wide. If it were
    assumed to be common to 68 mm, regions of small plates would be twice as wide as right.
    """
    at_m = make_places(columns, rows)
    quiet = make_voltages(np.zeros(len(at_m)), at_m, stated_noise=0.001)
    rng = np.random.default_rng(3)
    distances2 = []
    for _ in range(60):
        # Means over 5 x 5 points, times 5: errors with a variance of 1 that neighbours share
        white = rng.standard_normal((2, rows + 4, columns + 4))
        slow = np.lib.stride_tricks.sliding_window_view(white, (5, 5), axis=(1, 2)).mean(axis=(3, 4)) * 5
        noise = rng.standard_normal((2, len(at_m)))
        real, imaginary = ripple * slow.reshape(2, -1) + 0.001 * noise
        factor_of_v = 1 + real + 1j * imaginary
        factors = np.stack([np.ones(len(at_m)), factor_of_v], axis=1)
        fit = fit_permittivity(replace(quiet, voltage=quiet.voltage * factors), UNIT_GAINS, WAVE_NUMBER)
        error = fit.eps - EPS
        parts = np.array([error.real, error.imag])
        distances2.append(parts @ np.linalg.solve(fit.covariance, parts))
    # 95 % of the 60 regions should hold the truth, and the mean of chi squared of two parts is 2.
    share_within = np.mean(np.array(distances2) < CHI2_95)
    assert 0.9 < share_within < 1
    assert 1 < np.mean(distances2) < 2.5


def test_a_level_that_an_uncertain_rig_explains_does_not_refuse_a_segment():
    voltages = make_voltages(
        np.full(400, 0.005), np.random.default_rng(1).uniform(0, 0.3, (400, 2)), stated_noise=0.005
    )
    fit = fit_permittivity(voltages, UNIT_GAINS, WAVE_NUMBER)
    # H and V are 30 % too strong: no half space of this permittivity has such a level.
    strong = replace(voltages, voltage=1.3 * voltages.voltage)
    level_of_known_rig, _ = judge_medium(fit, strong, UNIT_GAINS, [], WAVE_NUMBER)
    # ln 1.3 = 0.26
    assert level_of_known_rig > 0.2
    # The boards may be displaced by what changes the voltages by 20 %: twice ln 1.2 is more than ln 1.3.
    displaced = DisturbedScan("places", replace(strong, voltage=1.2 * strong.voltage), UNIT_GAINS)
    level_of_uncertain_rig, _ = judge_medium(fit, strong, UNIT_GAINS, [displaced], WAVE_NUMBER)
    assert level_of_uncertain_rig == 0


def test_a_level_that_an_uncertain_rig_does_not_explain_refuses_a_segment():
    """Half a millimetre of plastic on a ceramic: the level is wrong by 11 %; the rig's standard error is 4 %.

    The level is reduced by two standard errors, as squares: sqrt(ln(0.893)^2 - (2 ln(1.037))^2) = 0.087.
    """
    voltages = make_voltages(
        np.full(400, 0.005), np.random.default_rng(1).uniform(0, 0.3, (400, 2)), stated_noise=0.005
    )
    fit = fit_permittivity(voltages, UNIT_GAINS, WAVE_NUMBER)
    coated = replace(voltages, voltage=0.893 * voltages.voltage)
    displaced = DisturbedScan("places", replace(coated, voltage=1.037 * coated.voltage), UNIT_GAINS)
    level, _ = judge_medium(fit, coated, UNIT_GAINS, [displaced], WAVE_NUMBER)
    # The level is above the limit from which a segment is refused, and below -ln(0.893) = 0.113, which it would be
    # without a reduction.
    assert MAX_LEVEL_MISS < level < 0.113


def test_a_rise_over_the_band_that_is_within_its_scatter_refuses_no_segment():
    """A solid of permittivity 2.1 reflects little into V.

    The rise of V (amplitude in the upper half of the band over that in the lower half) scatters over the points, so
    that its mean over the blocks has a standard deviation of 1 %.
    """
    rng = np.random.default_rng(1)
    voltages = make_voltages(np.full(400, 0.005), rng.uniform(0, 0.3, (400, 2)), stated_noise=0.005)
    fit = fit_permittivity(voltages, UNIT_GAINS, WAVE_NUMBER)
    blocks = 1 + number_blocks(voltages.at_m, (0.0, 0.0)).max()
    scatter = rng.standard_normal((400, 2))
    scatter -= np.median(scatter, axis=0)

    def judge_rise(rise, std_of_mean):
        """The rise beyond twice its standard deviation."""
        band_rise = rise + std_of_mean * np.sqrt(blocks) * scatter
        return judge_medium(fit, replace(voltages, band_rise=band_rise), UNIT_GAINS, [], WAVE_NUMBER)[1]

    # 0.02 - 2 * 0.008 = 0.004 and 0.02 - 2 * 0.002 = 0.016; at most 0.01 is accepted.
    assert judge_rise(0.02, std_of_mean=0.008) < MAX_BAND_RISE
    assert judge_rise(0.02, std_of_mean=0.002) > MAX_BAND_RISE


def test_errors_of_the_gains_average_over_an_object_of_many_directions_and_not_over_a_flat_one():
    """Errors of the gains are common to a cell of directions of 0.05, and independent between cells."""
    measured_gains = replace(UNIT_GAINS, degree=2, std=0.004, terms_root=np.zeros((6, 1)), cell=np.full(2, 0.05))
    x, y = np.meshgrid(np.arange(8) * 0.05 + 0.01, np.arange(8) * 0.05 + 0.01)
    directions = np.stack([x.ravel(), y.ravel()], axis=1)

    def find_std_of_mean(arrival: np.ndarray) -> float:
        return float(np.linalg.norm(measured_gains.list_errors(arrival).mean(axis=1)))

    # One cell, as of a flat object; and 8 x 8 cells
    assert find_std_of_mean(directions[:1]) == pytest.approx(0.004)
    assert find_std_of_mean(directions) == pytest.approx(0.004 / 8)
    # Beyond the directions that the reference covers all points are wrong together, by far more than 0.004.
    assert find_std_of_mean(directions + 1.5) > 0.05


@pytest.mark.parametrize(
    ("wave", "least", "most"), [(0.0, 0.0, 0.0012), (0.006, 0.0028, 0.005)], ids=["noise", "gains"]
)
def test_noise_of_the_points_of_a_reference_does_not_enter_its_gains(wave, least, most):
    """Gains are fitted by polynomials of the direction, which average over the noise of the points.

    Waves of the gains that no polynomial follows are the same for every object: they are the error `std` of the gains.
    A wave of 0.6 % has a standard deviation of 0.6 % / sqrt(2) = 0.0042; `least` and `most` are limits about that.
    """
    x, y = np.meshgrid(np.arange(16) * 0.028, np.arange(14) * 0.028)
    at_m = np.stack([x.ravel(), y.ravel()], axis=1)
    metal = make_voltages(np.zeros(len(at_m)), at_m, stated_noise=0.0)
    rng = np.random.default_rng(2)
    noise = rng.standard_normal((len(at_m), 2)) + 1j * rng.standard_normal((len(at_m), 2))
    # Waves of 150 mm, 0.12 rad of direction, which no polynomial of second degree follows and a block half averages.
    phase = 2 * np.pi * at_m[:, 0] / 0.15
    gain = np.stack([np.exp(wave * (np.sin(phase) + 1j * np.cos(phase))), np.ones(len(at_m))], axis=1)
    metal = replace(metal, voltage=-gain * (1 + 0.003 * noise), std=np.full((len(at_m), 2), 0.003), arrival=0.8 * at_m)
    gains = learn_gains(metal, WAVE_NUMBER)
    assert least <= gains.std < most
    # Noise and waves both make the polynomials uncertain.
    assert np.linalg.norm(gains.terms_root) > 0
