"""Fields of facets against closed forms."""

import numpy as np
import pytest

from polysight_worlds import METAL, Stack, reflect
from polysight_worlds.media import LIGHT_M_PER_S
from polysight_worlds.optics import Antenna, ellipsoid, receive_direct, rectangle, scatter

FREQUENCY_HZ = 78e9
WAVELENGTH_M = LIGHT_M_PER_S / FREQUENCY_HZ
K = 2 * np.pi / WAVELENGTH_M
S_AXIS = np.array([0.0, 1.0, 0.0])


def make_antenna(position: np.ndarray, target: np.ndarray, *, p_share: float = 0.0) -> Antenna:
    """An antenna that looks at `target`, polarised along y (s) or, with `p_share` 1, across it (p)."""
    direction = (target - position) / np.linalg.norm(target - position)
    p_axis = np.cross(direction, S_AXIS)
    p_axis /= np.linalg.norm(p_axis)
    return Antenna(position, direction, (1 - p_share) * S_AXIS + p_share * p_axis, exponent=1.0)


def mirror_pair(angle_deg: float, distance_m: float, *, p_share: float) -> tuple[Antenna, Antenna]:
    """TX and RX at one angle to the plane z = 0 from either side."""
    angle = np.radians(angle_deg)
    tx = distance_m * np.array([-np.sin(angle), 0, -np.cos(angle)])
    rx = tx * [-1, 1, 1]
    return make_antenna(tx, np.zeros(3), p_share=p_share), make_antenna(rx, np.zeros(3), p_share=p_share)


def make_plate(width_m: float, facet_m: float, height_m: float | None = None):
    edge_x = np.array([width_m, 0.0, 0.0])
    edge_y = np.array([0.0, width_m if height_m is None else height_m, 0.0])
    return rectangle(np.zeros(3), edge_y, edge_x, facet_m)


@pytest.mark.parametrize("p_share", [0.0, 1.0])
def test_a_large_metal_plate_is_a_mirror(p_share):
    tx, rx = mirror_pair(55, 0.3, p_share=p_share)
    # The mean over Fresnel zones of the rim: plates of growing size swing around the mirror's field.
    widths = np.linspace(0.30, 0.34, 9)
    fields = [scatter(tx, rx, make_plate(w, 0.0025), METAL, [FREQUENCY_HZ])[0, 0] for w in widths]
    image = np.exp(-1j * K * 0.6) / 0.6
    # The image has the opposite sign: s as it stands; p because the axes of TX and RX are mirror images.
    assert np.mean(fields) == pytest.approx(-image, rel=0.04)


def test_a_small_plate_has_its_radar_cross_section():
    width_m = 0.02
    antenna = make_antenna(np.array([0.0, 0, -60.0]), np.zeros(3))
    received = scatter(antenna, antenna, make_plate(width_m, 0.002), METAL, [FREQUENCY_HZ])[0, 0]
    # sigma = 4 pi |E_s|^2 R^2 / |E_i|^2 with E_i = 1 / R; closed form 4 pi A^2 / lambda^2.
    section = 4 * np.pi * abs(received) ** 2 * 60.0**4
    assert section == pytest.approx(4 * np.pi * width_m**4 / WAVELENGTH_M**2, rel=1e-3)


@pytest.mark.parametrize("angle_deg", [3.0, 7.0, 12.0])
def test_a_plate_off_its_specular_direction_falls_as_a_sinc(angle_deg):
    width_m = 0.02
    distance_m = 80.0
    tx = make_antenna(np.array([0.0, 0, -distance_m]), np.zeros(3))
    angle = np.radians(angle_deg)
    rx = make_antenna(distance_m * np.array([np.sin(angle), 0, -np.cos(angle)]), np.zeros(3))
    received = abs(scatter(tx, rx, make_plate(width_m, 0.004), METAL, [FREQUENCY_HZ])[0, 0])
    # s: J and M radiate with the mean of 1 and cos(angle).
    lobe = abs(np.sinc(width_m * np.sin(angle) / WAVELENGTH_M)) * (1 + np.cos(angle)) / 2
    assert received == pytest.approx(width_m**2 / WAVELENGTH_M / distance_m**2 * lobe, rel=2e-3)


@pytest.mark.parametrize("radii_m", [(0.05, 0.05, 0.05), (0.04, 0.08, 0.05)])
def test_a_curved_body_reflects_by_geometrical_optics(radii_m):
    antenna = make_antenna(np.array([0.0, 0, -2.0]), np.zeros(3))
    body = ellipsoid(np.zeros(3), radii_m, 0.0008)
    received = abs(scatter(antenna, antenna, body, METAL, [FREQUENCY_HZ])[0, 0])
    # Radii of curvature at the tip are a^2 / c and b^2 / c. The reflected wave has the curvatures 1 / d + 2 / R.
    distance_m = 2.0 - radii_m[2]
    expected = 1 / distance_m
    for half_axis_m in radii_m[:2]:
        radius_m = half_axis_m**2 / radii_m[2]
        focus_m = 1 / (1 / distance_m + 2 / radius_m)
        expected *= np.sqrt(focus_m / (focus_m + distance_m))
    assert received == pytest.approx(expected, rel=0.03)


def test_a_cylinder_reflects_more_than_a_sphere_of_its_radius():
    antenna = make_antenna(np.array([0.0, 0, -1.0]), np.zeros(3))
    cylinder = ellipsoid(np.zeros(3), [0.05, 1e3, 0.05], 0.001, half_widths=[0.05, 0.12])
    received = abs(scatter(antenna, antenna, cylinder, METAL, [FREQUENCY_HZ])[0, 0])
    # Along its axis the cylinder is a mirror: the wave spreads as if it continued by the same distance.
    distance_m = 0.95
    focus_m = 1 / (1 / distance_m + 2 / 0.05)
    assert received == pytest.approx(np.sqrt(focus_m / (focus_m + distance_m) / 2) / distance_m, rel=0.1)


@pytest.mark.parametrize("angle_deg", [30.0, 55.0, 60.0])
def test_a_dielectric_plate_returns_s_and_p_as_fresnel_says(angle_deg):
    stack = Stack(below=5 - 1j)
    fields = []
    for p_share in (0.0, 1.0):
        tx, rx = mirror_pair(angle_deg, 2.0, p_share=p_share)
        facets = make_plate(0.03, 0.003)
        dielectric = scatter(tx, rx, facets, stack, [FREQUENCY_HZ])[0, 0]
        metal = scatter(tx, rx, facets, METAL, [FREQUENCY_HZ])[0, 0]
        fields.append(-dielectric / metal)
    expected = np.array(reflect(stack, FREQUENCY_HZ, np.cos(np.radians(angle_deg))))
    assert fields[0] / fields[1] == pytest.approx(expected[0] / expected[1], rel=0.02)
    assert np.array(fields) == pytest.approx(expected, rel=0.02)


def test_metal_returns_both_polarisations_alike():
    values = []
    for p_share in (0.0, 1.0):
        tx, rx = mirror_pair(55, 1.0, p_share=p_share)
        values.append(abs(scatter(tx, rx, make_plate(0.05, 0.0025), METAL, [FREQUENCY_HZ])[0, 0]))
    assert values[0] == pytest.approx(values[1], rel=5e-3)


def test_antennas_may_change_places_near_the_specular_direction():
    rng = np.random.default_rng(0)
    facets = make_plate(0.05, 0.0025)
    stack = Stack(((4 - 0.4j, 0.003),), 2 - 0.1j)
    for _ in range(5):
        tx, rx = mirror_pair(55, 0.87, p_share=rng.uniform(0.2, 0.8))
        moved = Antenna(rx.position + rng.normal(0, 0.003, 3), rx.boresight, rx.polarisation, 2.0)
        exchanged = scatter(tx, moved, facets, stack, [FREQUENCY_HZ])[0, 0]
        back = scatter(moved, tx, facets, stack, [FREQUENCY_HZ])[0, 0]
        assert abs(exchanged - back) < 0.03 * abs(exchanged)


def test_the_direct_path_is_the_same_both_ways():
    tx, rx = mirror_pair(70, 0.5, p_share=0.3)
    assert receive_direct(tx, rx, [FREQUENCY_HZ]) == pytest.approx(receive_direct(rx, tx, [FREQUENCY_HZ]))


def test_smaller_facets_change_nothing():
    tx, rx = mirror_pair(55, 0.87, p_share=0.5)
    sums = [scatter(tx, rx, make_plate(0.048, facet), METAL, [FREQUENCY_HZ])[0, 0] for facet in (0.004, 0.002, 0.001)]
    assert abs(sums[0] - sums[2]) < 0.02 * abs(sums[2])
    assert abs(sums[1] - sums[2]) < 0.005 * abs(sums[2])


def test_polarisation_is_across_the_direction_and_keeps_its_length():
    rng = np.random.default_rng(1)
    antenna = make_antenna(np.zeros(3), np.array([0.3, 0.1, 1.0]), p_share=0.0)
    boresight = antenna.boresight
    polarisation = np.cross(boresight, [1.0, 0, 0])
    polarisation /= np.linalg.norm(polarisation)
    antenna = Antenna(np.zeros(3), boresight, polarisation, exponent=0.0)
    directions = rng.normal(size=(3, 50)) + 2 * boresight[:, None]
    directions /= np.linalg.norm(directions, axis=0)
    field = antenna.field(directions)
    assert np.sum(field * directions, axis=0) == pytest.approx(0, abs=1e-12)
    assert np.linalg.norm(field, axis=0) == pytest.approx(1)
