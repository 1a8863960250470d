"""The simulated field: interpolation, cache, sums and leakage; physical optics of a large mirror equals its image."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig

from polysight_shared.config import Instrument
from polysight_shared.errors import ErrorCode
from polysight_shared.units import SPEED_OF_LIGHT_M_S
from polysight_simulators.scene import Plate, Scene, apply_scene, decode_scene, optics
from polysight_simulators.scene.field import ObjectField, build_field, node_matrix
from polysight_simulators.scene.radar import sample_frequencies_hz

GRID = {"columns": 29, "rows": 21, "step_x_mm": 10.0, "step_y_mm": 10.0}
PLATES = [
    {"name": "metal", "centre_mm": [0.0, 0.0], "size_mm": [45.0, 45.0], "metal": True},
    {"name": "acrylic", "centre_mm": [60.3, 57.1], "size_mm": [45.0, 31.0], "permittivity": [4.0, 0.4]},
]


def make_scene_and_rig(**tables: Any) -> tuple[Instrument, Scene]:
    scene = decode_scene({"name": "t", "object_distance_mm": 499.0, "grid": GRID, **tables}, "t")
    return apply_scene(load_published_rig(), scene), scene


def read(field: ObjectField, offsets_m: np.ndarray, f: np.ndarray, rx: int, samples: np.ndarray) -> np.ndarray:
    values, _ = node_matrix(field, samples)
    values_at_f = values[:, np.searchsorted(samples, f)]
    carrier = np.exp(2j * np.pi * f * field.centre_path_m / SPEED_OF_LIGHT_M_S)
    return field.interpolate(offsets_m[:, 0], offsets_m[:, 1])[:, rx] @ values_at_f * carrier


def test_interpolation_between_frequencies_is_exact() -> None:
    rig, scene = make_scene_and_rig(plates=PLATES[:1])
    board = rig.receivers[0]
    samples = sample_frequencies_hz(rig)
    field = build_field(rig, scene, board, samples)
    offset = np.array([[0.021, -0.033]])
    # The field is computed at a few of the 256 frequencies and interpolated between them.
    assert len(field.nodes_hz) < 16
    everywhere = read(field, offset, samples, 0, samples)
    exact = optics.field_exact(rig, scene, board, offset, samples)
    # The difference beyond a common factor is the error of the interpolation over frequency.
    common = np.vdot(everywhere, exact) / np.vdot(everywhere, everywhere)
    # 1e-4 is far below the noise of a scan; 4e-6 is measured.
    assert np.abs(everywhere * common - exact).max() < 1e-4 * np.abs(exact).max()


@pytest.mark.parametrize("role", ["receive_h", "receive_v"])
def test_a_large_mirror_shows_the_image_of_the_transmitter(role: str) -> None:
    size = [600.0, 500.0]
    rig, scene = make_scene_and_rig(
        plates=[{"name": "m", "centre_mm": [0.0, 0.0], "size_mm": size, "metal": True}], object_gain=1.0
    )
    scene = scene.with_disturbances(leakage_h="off", leakage_v="off")
    board = rig.by_role(role)
    antennas = optics.antennas(rig, board)
    rng = np.random.default_rng(1)
    offsets = rng.uniform(-0.06, 0.06, (200, 2))
    samples = sample_frequencies_hz(rig)
    f = samples[[128]]
    field = build_field(rig, scene, board, samples)
    field_values = read(field, offsets, f, 0, samples)[:, 0]
    # The mirror image of the receiver, behind the plane; amplitudes are relative to the direct path.
    image = antennas.rx_m[0] * [1, 1, -1] + [0, 0, 2 * antennas.plane_z_m]
    path = float(np.linalg.norm(image - antennas.tx_m))
    expected = -antennas.direct_m[0] / path * np.exp(2j * np.pi * f[0] * path / SPEED_OF_LIGHT_M_S)
    # The echoes of the plate's edges change the field by up to 11 % at single offsets, by 0.2 % in the mean (measured).
    assert abs(np.mean(field_values) / expected - 1) < 0.03
    assert np.abs(np.abs(field_values) / abs(expected) - 1).max() < 0.25


def test_echoes_add_up() -> None:
    rig, both_plates = make_scene_and_rig(plates=PLATES)
    parts = [make_scene_and_rig(plates=[p])[1] for p in PLATES]
    offsets = np.array([[0.01, 0.02]])
    f = np.array([77e9, 80e9])
    for board in rig.receivers:
        total = optics.field_exact(rig, both_plates, board, offsets, f)
        sum_of_parts = sum(optics.field_exact(rig, scene, board, offsets, f) for scene in parts)
        assert np.allclose(total, sum_of_parts, atol=1e-12)


def test_leakage_mixes_the_two_polarisations() -> None:
    rig, scene = make_scene_and_rig(plates=PLATES[1:2])
    offsets = np.array([[0.05, 0.05]])
    f = np.array([78e9])
    h, v = rig.receivers

    def compute_field(board: Any, **leakage: Any) -> complex:
        leaky_scene = scene.with_disturbances(ideal=True, **leakage)
        return complex(optics.field_exact(rig, leaky_scene, board, offsets, f)[0, 0])

    # H receives s. Leakage of 1 adds all of p, less leakage that fraction of p. Samples are conjugates of fields.
    s_only = compute_field(h)
    s_and_p = compute_field(h, leakage_h=[1.0, 0.0])
    expected = s_only + np.conj(0.05 + 0.02j) * (s_and_p - s_only)
    assert np.isclose(compute_field(h, leakage_h=[0.05, 0.02]), expected)
    # The leakage of V changes V and not H.
    assert np.isclose(compute_field(h, leakage_v=[0.1, 0.0]), s_only)
    assert not np.isclose(compute_field(v, leakage_v=[0.1, 0.0]), compute_field(v))
    leaky = scene.with_disturbances(leakage_v=[0.0, 0.1])
    # The direct path, too, has the conjugate.
    assert optics.direct_factor(v, leaky) == 1 - 0.1j


def test_a_point_at_the_specular_midpoint_equals_its_amplitude() -> None:
    rig, scene = make_scene_and_rig(points=[{"position_mm": [0.0, 0.0], "amplitude": [0.6, 0.0]}])
    ideal = scene.with_disturbances(ideal=True)
    field_values = optics.field_exact(rig, ideal, rig.receivers[0], np.zeros((1, 2)), np.array([78e9]))
    assert np.isclose(abs(field_values[0, 0]), 0.6)


def test_an_empty_scene_has_no_echo_and_offsets_outside_are_refused() -> None:
    rig, scene = make_scene_and_rig()
    field = build_field(rig, scene, rig.receivers[0], sample_frequencies_hz(rig))
    assert np.all(field.interpolate(np.array([0.0]), np.array([0.0])) == 0)
    assert field.covers(np.array([0.14, 0.3]), np.array([0.1, 0.0])).tolist() == [True, False]
    with expect_refusal(ErrorCode.MISMATCH, "300.00 mm"):
        field.interpolate(np.array([0.3]), np.array([0.0]))


# Frequency in the middle of the band, Hz.
F = 78.5e9


@given(st.floats(0.01, 1.5))
def test_a_good_conductor_reflects_as_metal_in_both_polarisations(theta: float) -> None:
    s, p = optics.half_space(1e12 - 1e12j, theta)
    m_s, m_p = optics.plate_reflection(Plate("m", (0, 0), (1, 1), metal=True), F, np.array(theta))
    assert m_s == m_p == -1
    # A permittivity of 1.4e12 differs from a perfect conductor by the inverse of its root, about 1e-6, and in p by this
    # over the cosine of the incidence angle.
    assert abs(s - m_s) < 1e-4
    assert abs(p - m_p) < 1e-4 / np.cos(theta)


def test_a_plate_with_a_thickness_reflects_as_a_slab_and_one_without_as_a_half_space() -> None:
    theta = np.array([0.9, 1.0])
    half_space = Plate("h", (0, 0), (1, 1), permittivity=(3.78, 0.7))
    thin_sheet = Plate("s", (0, 0), (1, 1), permittivity=(3.78, 0.7), thickness_mm=0.5)
    assert np.allclose(optics.plate_reflection(half_space, F, theta), optics.half_space(3.78 - 0.7j, theta))
    assert np.allclose(optics.plate_reflection(thin_sheet, F, theta), optics.slab(3.78 - 0.7j, 0.5e-3, F, theta))


def test_the_echo_of_the_back_of_a_sheet_comes_after_that_of_its_front() -> None:
    """Samples of a path tau have the phase +2 pi f tau, also inside the sheet."""
    rig = load_published_rig()
    theta = np.radians(55.0)
    thick_m = 0.1
    eps = 4.0
    sheet = Plate("sheet", (0.0, 0.0), (45.0, 45.0), permittivity=(eps, 0.02), thickness_mm=1e3 * thick_m)
    f = np.linspace(76.3e9, 79.75e9, 400)
    path_m = np.linspace(-1.0, 1.0, 2001)
    # Echo against path: the spectrum over the band, with a window against side lobes.
    advance = np.exp(-2j * np.pi / SPEED_OF_LIGHT_M_S * np.outer(path_m, f)) * np.hanning(f.size)
    # Path to the back and again to the front, at the angle inside by Snell's law, relative to the echo of the front.
    inside_m = 2 * thick_m * np.sqrt(eps - np.sin(theta) ** 2)
    for board in rig.receivers:
        reflect = optics.board_reflectivity(board, Scene("one sheet", plates=(sheet,)).with_disturbances(ideal=True))
        amplitudes = np.abs(advance @ np.array([complex(reflect(sheet, hz, theta)) for hz in f]))
        # Without the echo of the front, which is at 0
        echo_of_back = np.where(np.abs(path_m) > 0.15, amplitudes, 0)
        peak_m = path_m[np.argmax(echo_of_back)]
        # The path is 0.36 m; with a wrong sign of the phase it would be -0.36 m. Resolution (c over the band) is 9 cm;
        # the peak is 4 mm off (measured).
        assert abs(peak_m - inside_m) < 0.01
