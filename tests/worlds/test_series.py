"""Exact series of spheres and cylinders are compared with closed forms, physical laws and physical optics."""

import numpy as np
import pytest

from polysight_worlds import METAL, Stack, cylinder, published_boards, published_rig, series, sphere
from polysight_worlds.media import LIGHT_M_PER_S
from polysight_worlds.shape_echoes import choose_solution, solve_cylinder, solve_sphere, sum_bent
from polysight_worlds.shapes import Shape, find_specular, follow_path
from polysight_worlds.zones import place_antennas, sum_window

FREQUENCY_HZ = 78e9
K = 2 * np.pi * FREQUENCY_HZ / LIGHT_M_PER_S
# Permittivities of bodies; None is metal.
MEDIA = [None, 4 - 0.4j, 9 - 1j, 2.2 - 0.05j]
# Directions of dipoles [3, 1]: across a plane of incidence y = 0, and in it.
S_AXIS = np.array([[0.0], [1.0], [0.0]])
P_AXIS = np.array([[0.0], [0.0], [1.0]])
# Distance of the published rig's object plane from the antennas.
PLANE_M = 0.499


def make_dipoles(
    tx_m: tuple[float, ...], rx_m: tuple[float, ...], sent: np.ndarray, received: np.ndarray
) -> series.Pair:
    """One pair of dipoles about the origin."""
    return series.Pair(np.array(tx_m)[:, None], np.array(rx_m)[:, None], sent + 0j, received + 0j)


def draw_pair(seed: int) -> tuple[series.Pair, series.Pair]:
    """Dipoles at drawn places 0.7 m from the body, and the same with TX and RX exchanged."""
    rng = np.random.default_rng(seed)
    places = rng.normal(size=(2, 3, 1))
    # Most of them are in front of the body, where antennas are: at negative z.
    places[:, 2] -= 1
    places *= 0.7 / np.linalg.norm(places, axis=1, keepdims=True)
    axes = rng.normal(size=(2, 3, 1)) + 1j * rng.normal(size=(2, 3, 1))
    forth = series.Pair(tx_m=places[0], rx_m=places[1], sent=axes[0], received=axes[1])
    back = series.Pair(tx_m=places[1], rx_m=places[0], sent=axes[1], received=axes[0])
    return forth, back


def test_a_large_metal_sphere_has_its_radar_cross_section():
    radius_m = 0.1
    distance_m = 60.0
    receiver_m = (0.0, 0.0, -distance_m)
    echo = series.scatter_sphere(make_dipoles(receiver_m, receiver_m, S_AXIS, S_AXIS), radius_m, None, FREQUENCY_HZ)[0]
    # Definition of the cross section, 4 pi distance^2 |echo|^2 / |incident|^2, for a wave that is 1 at 1 m and thus
    # 1 / distance at the sphere. Geometrical optics gives pi radius^2, from which this sphere, with a radius of 26
    # wavelengths, differs by 0.3 per cent.
    section = 4 * np.pi * abs(echo) ** 2 * distance_m**4
    assert section == pytest.approx(np.pi * radius_m**2, rel=0.02)


def test_a_tiny_sphere_scatters_as_rayleighs_dipole():
    # A fortieth of the wavelength.
    radius_m = 1e-4
    distance_m = 10.0
    eps = 4.0
    # RX is at a right angle to the incident wave, and all fields are across the plane of both.
    pair = make_dipoles((0, 0, -distance_m), (distance_m, 0, 0), S_AXIS, S_AXIS)
    echo = abs(series.scatter_sphere(pair, radius_m, eps - 1e-9j, FREQUENCY_HZ, with_inside=True)[0])
    expected = K**2 * radius_m**3 * (eps - 1) / (eps + 2) / distance_m**2
    # The next term of the series is smaller by (k radius)^2 = 0.03; it makes 0.5 per cent.
    assert echo == pytest.approx(expected, rel=1e-2)


# Of a wave's multipole with the coefficient a, the part 1 - 2 a goes out again. Its magnitude is 1 without loss.
@pytest.mark.parametrize("permittivity", [None, 3.0 - 1e-12j])
def test_a_sphere_without_loss_scatters_all_power_that_it_takes_from_the_wave(permittivity):
    a, b = series.sphere_coefficients(0.02, K, permittivity, with_inside=True)
    assert np.abs(1 - 2 * a) == pytest.approx(1, abs=1e-6)
    assert np.abs(1 - 2 * b) == pytest.approx(1, abs=1e-6)


def test_a_sphere_with_loss_scatters_no_more_power_than_it_takes_from_the_wave():
    for with_inside in (False, True):
        for coefficients in series.sphere_coefficients(0.02, K, 4 - 0.4j, with_inside=with_inside):
            # 1e-9 is for rounding.
            assert np.abs(1 - 2 * coefficients).max() <= 1 + 1e-9


@pytest.mark.parametrize("permittivity", MEDIA)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_transmitter_and_receiver_may_be_exchanged(permittivity, seed):
    forth, back = draw_pair(seed)
    echo_forth = series.scatter_sphere(forth, 0.05, permittivity, FREQUENCY_HZ)
    echo_back = series.scatter_sphere(back, 0.05, permittivity, FREQUENCY_HZ)
    assert echo_back == pytest.approx(echo_forth, rel=1e-9)
    # A specular path of any length, the same for both
    path_m = np.array([1.3])
    echo_forth = series.scatter_cylinder(forth, 0.05, permittivity, FREQUENCY_HZ, path_m)
    echo_back = series.scatter_cylinder(back, 0.05, permittivity, FREQUENCY_HZ, path_m)
    assert echo_back == pytest.approx(echo_forth, rel=1e-9)


# The limit of metal is wider: waves creep around it, which are not part of a smooth integrand. The differences are up
# to 0.8 per cent for metal and 0.23 per cent for the dielectric.
@pytest.mark.parametrize(("permittivity", "tolerance"), [(None, 0.01), (4 - 0.4j, 0.005)])
@pytest.mark.parametrize("places", [((-0.25, 0.3, -0.5), (0.3, -0.2, -0.5)), ((-0.4, 0.05, -0.4), (0.4, -0.05, -0.4))])
@pytest.mark.parametrize(("sent", "received"), [(S_AXIS, S_AXIS), (P_AXIS, P_AXIS), (S_AXIS, P_AXIS)])
def test_the_axial_wave_of_stationary_phase_gives_the_whole_integral(permittivity, tolerance, places, sent, received):
    """The echo of an endless cylinder is an integral over waves along its axis; `scatter_cylinder` computes one wave.

    The test sums the whole integral. It uses a lower frequency and a thin cylinder, where fewer waves are enough.
    """
    frequency_hz = 24e9
    radius_m = 0.06
    k = 2 * np.pi * frequency_hz / LIGHT_M_PER_S
    # A turn of both dipoles, so that all parts of the sum are there.
    tx_m, rx_m = places
    pair = make_dipoles(tx_m, rx_m, sent + 0.3 * S_AXIS, received + 0.2 * P_AXIS)
    along_axis_m = pair.rx_m[0] - pair.tx_m[0]
    body = series.EndlessCylinder(radius_m, permittivity, with_inside=False)

    # The specular path in the cross-section: the whole path without its part along the axis. It is found on a piece of
    # 2 m, on which the specular point lies.
    piece = cylinder("cylinder", METAL, (0.0, 0.0, 0.0), radius_m, 2.0, axis=(1.0, 0.0, 0.0))
    specular_patch = piece.evaluate(*find_specular(piece, pair.tx_m, pair.rx_m))
    path = follow_path(specular_patch, pair.tx_m, pair.rx_m)
    path_across_m = np.sqrt(path.length_m**2 - along_axis_m**2)

    # Axial wave numbers h, on a contour that passes below the branch point k and above -k. Beyond 2.2 k the waves have
    # decayed.
    real_h = np.linspace(-2.2 * k, 2.2 * k, 4001)
    h = real_h * (1 - 0.02j)
    pair_for_each_h = series.Pair(*(np.repeat(part, len(h), axis=1) for part in vars(pair).values()))
    orders = series.needed_orders(k * radius_m)
    m_m, n_n, m_n = (table.T for table in body.coefficients(k, h, orders))
    scattered = series.sum_orders(pair_for_each_h, (m_m, n_n, m_n), k, h, np.zeros(len(h)))
    integrand = scattered * np.exp(1j * h * along_axis_m)
    # The factor j / 2 is that of the cylinder's Green's function; the series has the conjugate time factor.
    full_integral = np.conj(0.5j * integrand.sum() * (h[1] - h[0]))

    by_stationary_phase = series.scatter_cylinder(pair, radius_m, permittivity, frequency_hz, path_across_m)[0]
    assert by_stationary_phase == pytest.approx(full_integral, rel=tolerance)


@pytest.mark.parametrize("medium", [METAL, Stack(below=4 - 0.4j), Stack(below=9 - 1j)], ids=["metal", "4", "9"])
@pytest.mark.parametrize("axis", [None, (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)], ids=["sphere", "upright", "level"])
def test_series_and_physical_optics_agree_where_the_radius_is_large(medium, axis):
    boards = published_boards()
    x, y = published_rig().centre_m
    offsets = np.array([[0.0, 0.0, 0.0], [0.1, 0.05, 0.0]])
    frequencies_hz = np.array([FREQUENCY_HZ])
    differences = []
    for radius_m in (0.1, 0.2):
        centre_m = (float(x), float(y), PLANE_M + radius_m)
        shape: Shape = sphere("sphere", medium, centre_m, radius_m)
        if axis is not None:
            shape = cylinder("cylinder", medium, centre_m, radius_m, 2.0, axis=axis)
        for rx in (boards.h[0], boards.v[3]):
            antennas = boards.tx, rx, frequencies_hz, offsets
            places = find_specular(shape, boards.tx.position[:, None] + offsets.T, rx.position[:, None] + offsets.T)
            exact = choose_solution(shape)(shape, *antennas, places)
            optics = sum_window(shape, *antennas, places)
            differences.append(np.abs(exact / optics - 1).max())
    # Physical optics is wrong to first order in 1 / (k radius), which is 0.6 per cent at 0.1 m and 0.3 at 0.2 m. The
    # largest differences are 1.7 and 0.9 per cent; the limits are about four times 1 / (k radius).
    of_small_radius = differences[:2]
    of_large_radius = differences[2:]
    assert max(of_small_radius) < 0.025
    assert max(of_large_radius) < 0.015


def test_terms_of_curvature_found_from_the_series_correct_physical_optics_of_other_solids():
    """The terms that `sum_bent` adds hold for solids from which they were not found: a sphere, a skew cylinder."""
    boards = published_boards()
    x, y = published_rig().centre_m
    radius_m = 0.1
    centre_m = (float(x), float(y), PLANE_M + radius_m)
    offsets = np.array([[0.0, 0.0, 0.0], [0.1, 0.05, 0.0], [-0.2, 0.1, 0.0]])
    ball = sphere("ball", METAL, centre_m, radius_m)
    pipe = cylinder("pipe", METAL, centre_m, radius_m, 2.0, axis=(1, 2, 0.1))
    errors_without_terms = []
    errors_with_terms = []
    for shape in (ball, pipe):
        # For H and V: physical optics without and with the terms, over the exact echo.
        over_exact = []
        for rx in (boards.h[0], boards.v[0]):
            places = find_specular(shape, boards.tx.position[:, None] + offsets.T, rx.position[:, None] + offsets.T)
            arguments = shape, boards.tx, rx, np.array([FREQUENCY_HZ]), offsets, places
            exact = choose_solution(shape)(*arguments)
            over_exact.append([optics(*arguments) / exact for optics in (sum_window, sum_bent)])
        # Only the error of H over V counts: permittivities are found from it.
        of_h, of_v = np.array(over_exact)
        without_terms, with_terms = of_h / of_v
        errors_without_terms.append(np.abs(without_terms - 1).max())
        errors_with_terms.append(np.abs(with_terms - 1).max())
    # The terms reduce the error from at least 2.2 per cent to at most 0.23, on each of the solids.
    assert min(errors_without_terms) > 0.015
    assert max(errors_with_terms) < 0.007


@pytest.mark.parametrize("medium", [METAL, Stack(below=4.5 - 0.3j)], ids=["metal", "4.5"])
def test_physical_optics_holds_where_a_surface_is_flat_along_the_plane_of_incidence(medium):
    """Fresnel's zones are longest there, so that the phase is no longer a square of the distance from the middle.

    With coarser samples of the surface, H / V would be wrong by 0.2 per cent.
    """
    boards = published_boards()
    x, y = published_rig().centre_m
    radius_m = 0.2
    log = cylinder("log", medium, (float(x), float(y), PLANE_M + radius_m), radius_m, 4.0, axis=(1.0, 0.0, 0.0))
    offsets = np.array([[0.0, 0.0, 0.0], [0.1, 0.05, 0.0], [-0.1, 0.05, 0.0], [0.05, -0.1, 0.0]])
    echoes = []
    for rx in (boards.h[0], boards.v[0]):
        places = find_specular(log, boards.tx.position[:, None] + offsets.T, rx.position[:, None] + offsets.T)
        arguments = log, boards.tx, rx, np.array([FREQUENCY_HZ]), offsets, places
        echoes.append([solution(*arguments)[0] for solution in (sum_bent, solve_cylinder)])
    (optics_h, exact_h), (optics_v, exact_v) = echoes
    error_of_v = (optics_v / exact_v) / (optics_h / exact_h) - 1
    # V nearly vanishes at Brewster's angle: its error is taken relative to H.
    error_relative_to_h = error_of_v * exact_v / exact_h
    # 0.023 per cent; the limit is half of the error with coarse samples.
    assert np.abs(error_relative_to_h).max() < 0.001


@pytest.mark.parametrize(("radius_m", "tolerance"), [(0.1, 0.002), (0.15, 0.0006)])
def test_physical_optics_of_a_dielectric_sphere_has_no_bias_over_a_scan(radius_m, tolerance):
    """Neither the slopes of the antennas' patterns nor the shadow behind the sphere's edge may change H / V.

    The smaller the sphere is, the nearer is its edge to the reflection: 0.11 and 0.023 per cent are left.
    """
    boards = published_boards()
    x, y = published_rig().centre_m
    ball = sphere("ball", Stack(below=4.5 - 0.3j), (float(x), float(y), PLANE_M + radius_m), radius_m)
    grid_x, grid_y = np.meshgrid([-0.15, -0.07, 0.01, 0.09, 0.17], [-0.1, -0.02, 0.06, 0.14])
    offsets = np.stack([grid_x.ravel(), grid_y.ravel(), np.zeros(grid_x.size)], axis=1)
    optics_over_exact = []
    for rx in (boards.h[1], boards.v[1]):
        places = find_specular(ball, *place_antennas(boards.tx, rx, offsets))
        arguments = ball, boards.tx, rx, np.array([FREQUENCY_HZ]), offsets, places
        optics_over_exact.append(sum_bent(*arguments)[0] / solve_sphere(*arguments)[0])
    of_h, of_v = optics_over_exact
    assert np.abs(np.mean(of_h / of_v) - 1) < tolerance


@pytest.mark.parametrize("axis", [(-0.967, 0.251, 0.045), (-0.815, 0.568, 0.115), (0.1, 1.0, 0.05)])
def test_a_cylinder_looked_up_for_many_positions_is_that_computed_one_by_one(axis):
    """For many positions `solve_cylinder` computes a table and interpolates in it; for one, it computes the echo."""
    boards = published_boards()
    x, y = published_rig().centre_m
    rod = cylinder("rod", Stack(below=6.8 - 0.35j), (float(x), float(y), 0.68), 0.18, 0.4, axis=axis)
    grid_x, grid_y = np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.25, 0.25, 7))
    offsets = np.stack([grid_x.ravel(), grid_y.ravel(), np.zeros(grid_x.size)], axis=1)
    places = find_specular(rod, *place_antennas(boards.tx, boards.h[0], offsets))
    frequencies_hz = np.array([FREQUENCY_HZ])
    together = solve_cylinder(rod, boards.tx, boards.h[0], frequencies_hz, offsets, places)[0]
    # Four of the 63 positions: both corners, and two between them.
    for index in (0, 17, 31, 62):
        place_of_one = tuple(place[[index]] for place in places)
        alone = solve_cylinder(rod, boards.tx, boards.h[0], frequencies_hz, offsets[[index]], place_of_one)[0]
        assert together[index] == pytest.approx(complex(alone[0]), rel=1e-6)
