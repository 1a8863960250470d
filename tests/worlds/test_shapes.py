"""Geometry of shapes, and their echoes compared with geometrical optics, with facets and with each other."""

import numpy as np
import pytest

import polysight_worlds as worlds
from polysight_worlds.media import LIGHT_M_PER_S, reflect
from polysight_worlds.optics import Antenna
from polysight_worlds.shapes import find_specular, follow_path

BOARDS = worlds.published_boards()
ONE_RX = worlds.Boards(BOARDS.tx, BOARDS.h[2:3], BOARDS.v[2:3])
FREQUENCIES_HZ = np.linspace(76.3e9, 79.7e9, 9)
CENTRE_M = np.array([*worlds.published_rig().centre_m, 0.499])
DIELECTRIC = worlds.Stack(below=4 - 0.4j)
OFFSETS_M = np.array([[0.0, 0, 0], [0.05, 0.02, 0], [-0.1, 0.06, 0], [0.12, -0.05, 0]])


def make_point_behind(depth_m: float) -> tuple[float, float, float]:
    """A point so far behind the middle of the picture: the centre of a body whose front is there."""
    x, y, z = CENTRE_M
    return x, y, z + depth_m


SPHERE = worlds.sphere("sphere", worlds.METAL, make_point_behind(0.1), 0.1)
CYLINDER = worlds.cylinder("cylinder", DIELECTRIC, make_point_behind(0.1), 0.1, 0.6, axis=(0.3, 1.0, 0.1))
CONE = worlds.cylinder("cone", worlds.METAL, make_point_behind(0.09), 0.09, 0.6, slope=-0.15)
# Curvatures along x and y, and the twist, 1 / m.
SADDLE = worlds.plate("saddle", worlds.METAL, make_point_behind(0.0), (0.3, 0.3), bends=(7.0, -6.0, 1.0))
# A large plate with soft edges, which hardly diffract.
TILTED = worlds.plate("tilted", DIELECTRIC, make_point_behind(0.0), (0.9, 0.9), tilt_deg=(4.0, -2.0), is_soft=True)
SHAPES = [SPHERE, CYLINDER, CONE, SADDLE, TILTED]


def compute_geometrical_optics(
    shape: worlds.Shape, tx: Antenna, rx: Antenna, offset_m: np.ndarray, frequency_hz: float
) -> complex:
    """The echo of the ray at the specular point: Fresnel's coefficients, and the path's second derivatives.

    The echo is that of `record_shapes`: with the phase of the path beyond the direct one, and conjugated.
    """
    tx_m = (tx.position + offset_m)[:, None]
    rx_m = (rx.position + offset_m)[:, None]
    patch = shape.evaluate(*find_specular(shape, tx_m, rx_m))
    path = follow_path(patch, tx_m, rx_m)
    out = patch.point - tx_m
    back = rx_m - patch.point
    out_m = np.linalg.norm(out)
    back_m = np.linalg.norm(back)
    incident = out[:, 0] / out_m
    scattered = back[:, 0] / back_m
    normal = patch.normal[:, 0]
    across = np.cross(incident, normal)
    s_axis = across / np.linalg.norm(across)
    cosine = -incident @ normal

    # Stationary phase: the more the path bends over the surface, the smaller is the zone that reflects.
    basis = patch.tangents()[..., 0]
    path_curvatures = np.linalg.eigvalsh(basis @ path.hessian[..., 0] @ basis.T)
    spread = cosine / (out_m * back_m * np.sqrt(np.abs(np.prod(path_curvatures))))
    # A path that is longest in one direction, on a saddle, has passed a focus: a quarter of a period more.
    phase_factor = 1 if np.all(path_curvatures > 0) else 1j

    r_s, r_p = reflect(shape.stack, frequency_hz, cosine)
    sent = tx.field(incident[:, None])[:, 0]
    received = rx.field(-scattered[:, None])[:, 0]
    s_part = r_s * (sent @ s_axis) * (received @ s_axis)
    p_part = r_p * (sent @ np.cross(s_axis, incident)) * (received @ np.cross(scattered, s_axis))
    wave = (s_part + p_part) * spread * phase_factor
    direct_m = np.linalg.norm(rx.position - tx.position)
    phase = 2 * np.pi * frequency_hz / LIGHT_M_PER_S * (path.length_m[0] - direct_m)
    return complex(np.conj(wave) * np.exp(1j * phase))


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.name)
def test_a_shape_reflects_by_geometrical_optics_but_for_a_few_per_cent(shape):
    cubes = worlds.record_shapes([shape], ONE_RX, FREQUENCIES_HZ[:1], OFFSETS_M)
    for channel, receivers in ONE_RX.receivers().items():
        rx = receivers[0]
        expected = np.array(
            [compute_geometrical_optics(shape, BOARDS.tx, rx, offset_m, 76.3e9) for offset_m in OFFSETS_M]
        )
        # Geometrical optics is the limit of short waves, and the bodies are some 25 wavelengths large: the largest
        # difference, of the cone, is 1.9 per cent.
        assert np.abs(cubes[channel][0, 0] - expected).max() < 0.04 * np.abs(expected).max()


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape.name)
def test_a_surface_knows_its_points_normals_and_derivatives(shape):
    a = np.array([0.02, -0.03])
    b = np.array([0.01, 0.04])
    patch = shape.evaluate(a, b)
    # Derivatives by central differences.
    step = 1e-5
    along_a = (shape.evaluate(a + step, b).point - shape.evaluate(a - step, b).point) / (2 * step)
    mixed = (shape.evaluate(a, b + step).d_a - shape.evaluate(a, b - step).d_a) / (2 * step)
    assert patch.d_a == pytest.approx(along_a, abs=1e-8)
    assert patch.d_ab == pytest.approx(mixed, abs=1e-8)
    # A point a millimetre in front of the surface is projected back to where it came from.
    point_in_front_m = patch.point + 1e-3 * patch.normal
    distances, near_a, near_b = shape.project(point_in_front_m.T)
    assert distances == pytest.approx(1e-3, abs=1e-9)
    assert shape.evaluate(near_a, near_b).point == pytest.approx(patch.point, abs=1e-9)
    # Normals point to the antennas, at smaller z.
    assert np.all(patch.normal[2] < 0)


def test_curvatures_are_those_of_the_solids():
    # A radius of 0.1 m is a curvature of 10 / m, along a cylinder's axis 0.
    assert np.linalg.eigvalsh(SPHERE.evaluate(0.1, 0.2).curvature()) == pytest.approx([10, 10])
    assert np.linalg.eigvalsh(CYLINDER.evaluate(0.1, 0.2).curvature()) == pytest.approx([0, 10], abs=1e-9)
    assert SADDLE.evaluate(0.0, 0.0).curvature() == pytest.approx(np.array([[7, 1], [1, -6]]))


@pytest.mark.parametrize("shape", [SPHERE, CYLINDER, CONE], ids=lambda shape: shape.name)
def test_a_whole_scan_is_that_of_its_single_positions(shape):
    # Many positions are interpolated from few that are computed; few are all computed.
    x = 0.002 * np.arange(-30, 30)
    offsets = np.stack([*np.meshgrid(x, x), np.zeros((60, 60))], axis=-1)
    full_scan = worlds.record_shapes([shape], ONE_RX, FREQUENCIES_HZ[:2], offsets)
    part_of_scan = worlds.record_shapes([shape], ONE_RX, FREQUENCIES_HZ[:2], offsets[::20, ::20])
    for channel in full_scan:
        difference = np.abs(full_scan[channel][..., ::20, ::20] - part_of_scan[channel]).max()
        # The interpolation is wrong by up to 1.6e-4.
        assert difference < 5e-3 * np.abs(part_of_scan[channel]).max()


def test_a_large_flat_plate_is_the_same_in_facets_and_in_zones():
    """The echo of a plate with sharp edges is a sum over facets, with soft edges over the zone that reflects."""
    # The wave from an edge adds or subtracts, by the Fresnel zone in which the edge lies. Over plates of growing size
    # it cancels in the mean.
    widths_m = np.linspace(0.5, 0.56, 9)
    sharp_plates = [
        worlds.plate("sharp", DIELECTRIC, make_point_behind(0.0), (width_m, width_m), tilt_deg=(4.0, -2.0))
        for width_m in widths_m
    ]
    offsets_m = OFFSETS_M[:2]
    by_facets = [worlds.record_shapes([plate], ONE_RX, FREQUENCIES_HZ[:1], offsets_m)["h"] for plate in sharp_plates]
    by_zones = worlds.record_shapes([TILTED], ONE_RX, FREQUENCIES_HZ[:1], offsets_m)["h"]
    # The mean still has a part of the waves from the edges.
    assert np.mean(by_facets, axis=0) == pytest.approx(by_zones, rel=0.03)


def test_the_phase_is_that_of_the_path_beyond_the_direct_one():
    rx = BOARDS.h[0]
    direct_m = np.linalg.norm(rx.position - BOARDS.tx.position)
    echo = worlds.record_shapes([SPHERE], BOARDS, FREQUENCIES_HZ, OFFSETS_M[:1])["h"][0, :, 0]
    # A path turns the phase by 2 pi f / c times its length: the change over the band gives the length.
    phase_change = np.ptp(np.unwrap(np.angle(echo)))
    measured_m = phase_change / (2 * np.pi * np.ptp(FREQUENCIES_HZ)) * LIGHT_M_PER_S
    tx_m = BOARDS.tx.position[:, None]
    rx_m = rx.position[:, None]
    path = follow_path(SPHERE.evaluate(*find_specular(SPHERE, tx_m, rx_m)), tx_m, rx_m)
    # A twentieth of the wavelength; they differ by 4 micrometres.
    assert measured_m == pytest.approx(path.length_m[0] - direct_m, abs=2e-4)


def test_the_tip_of_a_cone_beyond_its_end_has_no_echo():
    """The search for a specular point may end at the tip, where the path is stationary, but the surface ends before.

    The cone is the shoulder of a bottle; from these positions the search ends at its tip.
    """
    shoulder = worlds.draw_shapes(83902, "bottle").shapes[1]
    x, y = np.meshgrid(np.linspace(0.32, 0.35, 4), [0.169, 0.184])
    far_offsets_m = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    rx = ONE_RX.h[0]
    tx_m = ONE_RX.tx.position[:, None] + far_offsets_m.T
    rx_m = rx.position[:, None] + far_offsets_m.T
    places = find_specular(shoulder, tx_m, rx_m)
    echoes = worlds.record_shapes([shoulder], ONE_RX, FREQUENCIES_HZ, far_offsets_m)["h"][0]

    is_tip = shoulder.evaluate(*places).area < 1e-12
    assert is_tip.any()
    assert not echoes[:, is_tip].any()
    assert np.isfinite(echoes).all()
