"""Exact series against closed forms, laws and physical optics."""

import numpy as np
import pytest

from polysight_worlds import METAL, Stack, cylinder, published_boards, published_rig, series, sphere
from polysight_worlds.media import LIGHT_M_PER_S
from polysight_worlds.shape_echoes import choose_solution, solve_cylinder, solve_sphere, sum_bent
from polysight_worlds.shapes import Shape, find_specular, follow_path
from polysight_worlds.zones import place_antennas, sum_window

FREQUENCY_HZ = 78e9
K = 2 * np.pi * FREQUENCY_HZ / LIGHT_M_PER_S
MEDIA = [None, 4 - 0.4j, 9 - 1j, 2.2 - 0.05j]
S_AXIS = np.array([[0.0], [1.0], [0.0]])
P_AXIS = np.array([[0.0], [0.0], [1.0]])


def make_dipoles(
    tx_m: tuple[float, ...], rx_m: tuple[float, ...], sent: np.ndarray, received: np.ndarray
) -> series.Pair:
    """One pair of dipoles about the origin."""
    return series.Pair(np.array(tx_m)[:, None], np.array(rx_m)[:, None], sent + 0j, received + 0j)


def draw_pair(seed: int) -> tuple[series.Pair, series.Pair]:
    """Dipoles at drawn places, and the same with TX and RX exchanged."""
    rng = np.random.default_rng(seed)
    places = rng.normal(size=(2, 3, 1))
    places[:, 2] -= 1
    places *= 0.7 / np.linalg.norm(places, axis=1, keepdims=True)
    axes = rng.normal(size=(2, 3, 1)) + 1j * rng.normal(size=(2, 3, 1))
    return series.Pair(places[0], places[1], axes[0], axes[1]), series.Pair(places[1], places[0], axes[1], axes[0])


def test_a_large_metal_sphere_has_its_radar_cross_section():
    radius_m = 0.1
    distance_m = 60.0
    receiver_m = (0.0, 0.0, -distance_m)
    echo = series.scatter_sphere(make_dipoles(receiver_m, receiver_m, S_AXIS, S_AXIS), radius_m, None, FREQUENCY_HZ)[0]
    # sigma = 4 pi |E_s|^2 R^4 for a unit wave at 1 m; geometrical optics: pi a^2.
    section = 4 * np.pi * abs(echo) ** 2 * distance_m**4
    assert section == pytest.approx(np.pi * radius_m**2, rel=0.02)


def test_a_tiny_sphere_is_rayleighs_dipole():
    radius_m = 1e-4
    distance_m = 10.0
    eps = 4.0
    pair = make_dipoles((0, 0, -distance_m), (distance_m, 0, 0), S_AXIS, S_AXIS)
    echo = abs(series.scatter_sphere(pair, radius_m, eps - 1e-9j, FREQUENCY_HZ, with_inside=True)[0])
    expected = K**2 * radius_m**3 * (eps - 1) / (eps + 2) / distance_m**2
    assert echo == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize("permittivity", [None, 3.0 - 1e-12j])
def test_a_sphere_without_loss_scatters_all_it_takes(permittivity):
    a, b = series.sphere_coefficients(0.02, K, permittivity, with_inside=True)
    # |1 - 2 a| = 1 for each multipole.
    assert np.abs(1 - 2 * a) == pytest.approx(1, abs=1e-6)
    assert np.abs(1 - 2 * b) == pytest.approx(1, abs=1e-6)


def test_a_sphere_with_loss_takes_more_than_it_scatters():
    for with_inside in (False, True):
        for part in series.sphere_coefficients(0.02, K, 4 - 0.4j, with_inside=with_inside):
            assert np.abs(1 - 2 * part).max() <= 1 + 1e-9


@pytest.mark.parametrize("permittivity", MEDIA)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_transmitter_and_receiver_may_be_exchanged(permittivity, seed):
    forth, back = draw_pair(seed)
    exchanged = series.scatter_sphere(forth, 0.05, permittivity, FREQUENCY_HZ)
    assert series.scatter_sphere(back, 0.05, permittivity, FREQUENCY_HZ) == pytest.approx(exchanged, rel=1e-9)
    path_m = np.array([1.3])
    exchanged = series.scatter_cylinder(forth, 0.05, permittivity, FREQUENCY_HZ, path_m)
    assert series.scatter_cylinder(back, 0.05, permittivity, FREQUENCY_HZ, path_m) == pytest.approx(exchanged, rel=1e-9)


# Creeping waves around metal are not part of a smooth integrand.
@pytest.mark.parametrize(("permittivity", "tolerance"), [(None, 0.01), (4 - 0.4j, 0.005)])
@pytest.mark.parametrize("places", [((-0.25, 0.3, -0.5), (0.3, -0.2, -0.5)), ((-0.4, 0.05, -0.4), (0.4, -0.05, -0.4))])
@pytest.mark.parametrize(("sent", "received"), [(S_AXIS, S_AXIS), (P_AXIS, P_AXIS), (S_AXIS, P_AXIS)])
def test_the_stationary_axial_wave_gives_the_whole_integral(permittivity, tolerance, places, sent, received):
    frequency_hz = 24e9
    radius_m = 0.06
    k = 2 * np.pi * frequency_hz / LIGHT_M_PER_S
    # A turn of both dipoles, so that all parts of the sum are there.
    tx_m, rx_m = places
    pair = make_dipoles(tx_m, rx_m, sent + 0.3 * S_AXIS, received + 0.2 * P_AXIS)
    body = series.EndlessCylinder(radius_m, permittivity, False)
    round_x = cylinder("cylinder", METAL, (0.0, 0.0, 0.0), radius_m, 2.0, axis=(1.0, 0.0, 0.0))
    path = follow_path(round_x.evaluate(*find_specular(round_x, pair.tx_m, pair.rx_m)), pair.tx_m, pair.rx_m)
    specular = np.sqrt(path.length_m**2 - (pair.rx_m[0] - pair.tx_m[0]) ** 2)
    # The contour passes below the branch point k and above -k.
    t = np.linspace(-2.2 * k, 2.2 * k, 4001)
    h = t * (1 - 0.02j)
    many = series.Pair(*(np.repeat(part, len(t), axis=1) for part in vars(pair).values()))
    m_m, n_n, m_n = (table.T for table in body.coefficients(k, h, series.needed_orders(k * radius_m)))
    integrand = series.sum_orders(many, (m_m, n_n, m_n), k, h, np.zeros(len(t))) * np.exp(
        1j * h * (pair.rx_m[0] - pair.tx_m[0])
    )
    full_integral = np.conj(0.5j * integrand.sum() * (h[1] - h[0]))
    quick = series.scatter_cylinder(pair, radius_m, permittivity, frequency_hz, specular)[0]
    assert quick == pytest.approx(full_integral, rel=tolerance)


@pytest.mark.parametrize("medium", [METAL, Stack(below=4 - 0.4j), Stack(below=9 - 1j)], ids=["metal", "4", "9"])
@pytest.mark.parametrize("axis", [None, (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)], ids=["sphere", "upright", "level"])
def test_series_and_physical_optics_agree_where_the_radius_is_large(medium, axis):
    boards = published_boards()
    x, y = published_rig().centre_m
    offsets = np.array([[0.0, 0.0, 0.0], [0.1, 0.05, 0.0]])
    frequencies_hz = np.array([FREQUENCY_HZ])
    differences = []
    for radius_m in (0.1, 0.2):
        centre_m = (float(x), float(y), 0.499 + radius_m)
        shape: Shape = sphere("sphere", medium, centre_m, radius_m)
        if axis is not None:
            shape = cylinder("cylinder", medium, centre_m, radius_m, 2.0, axis=axis)
        for rx in (boards.h[0], boards.v[3]):
            antennas = boards.tx, rx, frequencies_hz, offsets
            places = find_specular(shape, boards.tx.position[:, None] + offsets.T, rx.position[:, None] + offsets.T)
            exact = choose_solution(shape)(shape, *antennas, places)
            optics = sum_window(shape, *antennas, places)
            differences.append(np.abs(exact / optics - 1).max())
    # Of first order in 1 / (k radius): 0.6 and 0.3 per cent, times some 3.
    assert max(differences[:2]) < 0.025
    assert max(differences[2:]) < 0.015


def test_what_physical_optics_misses_is_found_from_the_series():
    """On solids that the terms were not made from: another radius, a skew axis, a sphere."""
    boards = published_boards()
    x, y = published_rig().centre_m
    centre_m = (float(x), float(y), 0.499 + 0.1)
    offsets = np.array([[0.0, 0.0, 0.0], [0.1, 0.05, 0.0], [-0.2, 0.1, 0.0]])
    residuals = []
    missed = []
    for shape in (sphere("ball", METAL, centre_m, 0.1), cylinder("pipe", METAL, centre_m, 0.1, 2.0, axis=(1, 2, 0.1))):
        ratios = []
        for rx in (boards.h[0], boards.v[0]):
            places = find_specular(shape, boards.tx.position[:, None] + offsets.T, rx.position[:, None] + offsets.T)
            arguments = shape, boards.tx, rx, np.array([FREQUENCY_HZ]), offsets, places
            exact = choose_solution(shape)(*arguments)
            ratios.append([optics(*arguments) / exact for optics in (sum_window, sum_bent)])
        # Only H over V counts: antennas and spreading are common to both.
        without, with_bends = np.array(ratios[0]) / np.array(ratios[1])
        missed.append(np.abs(without - 1).max())
        residuals.append(np.abs(with_bends - 1).max())
    assert min(missed) > 0.015
    assert max(residuals) < 0.007


@pytest.mark.parametrize("medium", [METAL, Stack(below=4.5 - 0.3j)], ids=["metal", "4.5"])
def test_physical_optics_holds_where_a_surface_is_flat_along_the_plane_of_incidence(medium):
    """Fresnel's zones are longest there: the phase leaves its square, and coarse samples made H / V 0.2 % wrong."""
    boards = published_boards()
    x, y = published_rig().centre_m
    log = cylinder("log", medium, (float(x), float(y), 0.699), 0.2, 4.0, axis=(1.0, 0.0, 0.0))
    offsets = np.array([[0.0, 0.0, 0.0], [0.1, 0.05, 0.0], [-0.1, 0.05, 0.0], [0.05, -0.1, 0.0]])
    echoes = []
    for rx in (boards.h[0], boards.v[0]):
        places = find_specular(log, boards.tx.position[:, None] + offsets.T, rx.position[:, None] + offsets.T)
        arguments = log, boards.tx, rx, np.array([FREQUENCY_HZ]), offsets, places
        echoes.append([solution(*arguments)[0] for solution in (sum_bent, solve_cylinder)])
    (optics_h, exact_h), (optics_v, exact_v) = echoes
    # V nearly vanishes at Brewster's angle: its error counts over H.
    miss = (optics_v / exact_v) / (optics_h / exact_h) - 1
    assert np.abs(miss * exact_v / exact_h).max() < 0.001


@pytest.mark.parametrize(("radius_m", "tolerance"), [(0.1, 0.002), (0.15, 0.0006)])
def test_physical_optics_of_a_dielectric_sphere_has_no_bias_over_a_scan(radius_m, tolerance):
    """Neither the slopes of the antennas' patterns nor the shadow behind the sphere's edge may turn H / V."""
    boards = published_boards()
    x, y = published_rig().centre_m
    ball = sphere("ball", Stack(below=4.5 - 0.3j), (float(x), float(y), 0.499 + radius_m), radius_m)
    grid_x, grid_y = np.meshgrid([-0.15, -0.07, 0.01, 0.09, 0.17], [-0.1, -0.02, 0.06, 0.14])
    offsets = np.stack([grid_x.ravel(), grid_y.ravel(), np.zeros(grid_x.size)], axis=1)
    over_series = []
    for rx in (boards.h[1], boards.v[1]):
        places = find_specular(ball, *place_antennas(boards.tx, rx, offsets))
        arguments = ball, boards.tx, rx, np.array([FREQUENCY_HZ]), offsets, places
        over_series.append(sum_bent(*arguments)[0] / solve_sphere(*arguments)[0])
    assert np.abs(np.mean(over_series[0] / over_series[1]) - 1) < tolerance


@pytest.mark.parametrize("axis", [(-0.967, 0.251, 0.045), (-0.815, 0.568, 0.115), (0.1, 1.0, 0.05)])
def test_a_cylinder_looked_up_for_many_positions_is_that_computed_one_by_one(axis):
    boards = published_boards()
    x, y = published_rig().centre_m
    rod = cylinder("rod", Stack(below=6.8 - 0.35j), (float(x), float(y), 0.68), 0.18, 0.4, axis=axis)
    grid_x, grid_y = np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.25, 0.25, 7))
    offsets = np.stack([grid_x.ravel(), grid_y.ravel(), np.zeros(grid_x.size)], axis=1)
    places = find_specular(rod, *place_antennas(boards.tx, boards.h[0], offsets))
    frequencies_hz = np.array([FREQUENCY_HZ])
    together = solve_cylinder(rod, boards.tx, boards.h[0], frequencies_hz, offsets, places)[0]
    for index in (0, 17, 31, 62):
        own_places = tuple(place[[index]] for place in places)
        alone = solve_cylinder(rod, boards.tx, boards.h[0], frequencies_hz, offsets[[index]], own_places)[0]
        assert together[index] == pytest.approx(complex(alone[0]), rel=1e-6)
