"""Reflection of plates in the simulator; interfaces, plates and stacks are compared with tmm in tests/polarimetry."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from tests.support.rigs import published_rig

from polysight_shared.units import SPEED_OF_LIGHT_M_S
from polysight_simulators.scene import Plate, Scene
from polysight_simulators.scene.optics import board_reflectivity, half_space, plate_reflection, slab

F = 78.5e9


@given(st.floats(0.01, 1.5))
def test_a_good_conductor_tends_to_metal_with_p_of_plus_one(theta: float) -> None:
    s, p = half_space(1e12 - 1e12j, theta)
    m_s, m_p = plate_reflection(Plate("m", (0, 0), (1, 1), metal=True), F, np.array(theta))
    assert m_s == m_p == -1
    assert abs(s - m_s) < 1e-4
    assert abs(p - m_p) < 1e-4 / np.cos(theta)


def test_scene_plates_choose_their_model() -> None:
    theta = np.array([0.9, 1.0])
    half = Plate("h", (0, 0), (1, 1), permittivity=(3.78, 0.7))
    thin = Plate("s", (0, 0), (1, 1), permittivity=(3.78, 0.7), thickness_mm=0.5)
    assert np.allclose(plate_reflection(half, F, theta), half_space(3.78 - 0.7j, theta))
    assert np.allclose(plate_reflection(thin, F, theta), slab(3.78 - 0.7j, 0.5e-3, F, theta))


def test_the_echo_of_the_back_of_a_sheet_comes_after_that_of_its_front() -> None:
    """Samples of a path tau have the phase +2 pi f tau, also inside the sheet."""
    rig = published_rig()
    theta, thick_m, eps = np.radians(55.0), 0.1, 4.0
    sheet = Plate("sheet", (0.0, 0.0), (45.0, 45.0), permittivity=(eps, 0.02), thickness_mm=1e3 * thick_m)
    f = np.linspace(76.3e9, 79.75e9, 400)
    path_m = np.linspace(-1.0, 1.0, 2001)
    later = np.exp(-2j * np.pi / SPEED_OF_LIGHT_M_S * np.outer(path_m, f)) * np.hanning(f.size)
    inside_m = 2 * thick_m * np.sqrt(eps - np.sin(theta) ** 2)  # Snell
    for board in rig.receivers:
        reflect = board_reflectivity(board, Scene("one sheet", plates=(sheet,)).with_disturbances(ideal=True))
        seen = np.abs(later @ np.array([complex(reflect(sheet, hz, theta)) for hz in f]))
        back = np.where(np.abs(path_m) > 0.15, seen, 0)
        assert abs(path_m[np.argmax(back)] - inside_m) < 0.01
