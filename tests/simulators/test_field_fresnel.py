"""Reflection in the simulator: limits, energy, and the paper's Eq. 3 as the inverse of Eq. 2."""

from pathlib import Path

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from polysight.shared.config import load_instrument
from polysight.shared.units import SPEED_OF_LIGHT_M_S
from polysight.simulators.scene import Layer, Plate, Scene
from polysight.simulators.scene.optics import board_reflectivity, half_space, layered, plate_reflection, slab

permittivities = st.builds(lambda e, loss: complex(e, -loss), st.floats(1.1, 20.0), st.floats(0.0, 20.0))
angles = st.floats(0.01, 1.5)
thicknesses = st.floats(1e-5, 0.05)
F = 78.5e9


@given(permittivities, angles)
def test_an_interface_reflects_at_most_all_power(eps: complex, theta: float) -> None:
    s, p = half_space(eps, theta)
    assert abs(s) <= 1 + 1e-12
    assert abs(p) <= 1 + 1e-12


@given(permittivities)
def test_both_polarisations_agree_at_normal_incidence(eps: complex) -> None:
    s, p = half_space(eps, 0.0)
    assert np.allclose(s, p, atol=1e-12)
    assert np.allclose(s, (1 - np.sqrt(eps)) / (1 + np.sqrt(eps)), atol=1e-12)


@given(permittivities, st.floats(0.5, 1.4))
def test_equation_3_inverts_equation_2(eps: complex, theta: float) -> None:
    s, p = half_space(eps, theta)
    ratio = s / p
    back = (1 + 4 * ratio / (1 - ratio) ** 2 * np.sin(theta) ** 2) * np.tan(theta) ** 2
    assert abs(back - eps) < 1e-6 * abs(eps)


@given(st.floats(1.5, 20.0))
def test_p_vanishes_at_the_brewster_angle_and_only_p(eps: float) -> None:
    s, p = half_space(eps, np.arctan(np.sqrt(eps)))
    assert abs(p) < 1e-12
    assert abs(s) > 0.1


@given(angles)
def test_a_good_conductor_tends_to_metal_with_p_of_plus_one(theta: float) -> None:
    s, p = half_space(1e12 - 1e12j, theta)
    m_s, m_p = plate_reflection(Plate("m", (0, 0), (1, 1), metal=True), F, np.array(theta))
    assert m_s == m_p == -1
    assert abs(s - m_s) < 1e-4
    assert abs(p - m_p) < 1e-4 / np.cos(theta)


@given(permittivities, thicknesses, angles)
def test_a_passive_plate_reflects_at_most_all_power(eps: complex, d: float, theta: float) -> None:
    s, p = slab(eps, d, F, theta)
    assert abs(s) <= 1 + 1e-9
    assert abs(p) <= 1 + 1e-9


@given(st.floats(1.1, 20.0), st.floats(1.0, 20.0), angles)
def test_a_thick_absorbing_plate_is_a_half_space(real: float, loss: float, theta: float) -> None:
    thick, half = slab(complex(real, -loss), 0.2, F, theta), half_space(complex(real, -loss), theta)
    assert np.allclose(thick, half, atol=1e-9)


@given(permittivities, angles)
def test_a_plate_of_zero_thickness_has_no_echo(eps: complex, theta: float) -> None:
    assert np.allclose(slab(eps, 1e-12, F, theta), 0.0, atol=1e-5)


@given(st.floats(1.5, 20.0), angles, st.integers(1, 5))
def test_a_lossless_half_wave_plate_is_transparent(eps: float, theta: float, order: int) -> None:
    d = order * 299_792_458.0 / (2 * F * np.sqrt(eps - np.sin(theta) ** 2))
    assert np.allclose(slab(eps, d, F, theta), 0.0, atol=1e-9)


def test_scene_plates_choose_their_model() -> None:
    theta = np.array([0.9, 1.0])
    half = Plate("h", (0, 0), (1, 1), permittivity=(3.78, 0.7))
    thin = Plate("s", (0, 0), (1, 1), permittivity=(3.78, 0.7), thickness_mm=0.5)
    assert np.allclose(plate_reflection(half, F, theta), half_space(3.78 - 0.7j, theta))
    assert np.allclose(plate_reflection(thin, F, theta), slab(3.78 - 0.7j, 0.5e-3, F, theta))


def test_stacks_reduce_to_slabs_and_half_spaces():
    theta = np.radians([0.0, 40.0, 55.0, 70.0])
    water, glass = Layer((9.37, 18.0)), Layer((5.5, 0.05), 3.0)
    np.testing.assert_allclose(layered([water], F, theta), half_space(9.37 - 18j, theta), rtol=1e-12)
    np.testing.assert_allclose(layered([glass], F, theta), slab(5.5 - 0.05j, 3e-3, F, theta), rtol=1e-10)
    halves = [Layer((5.5, 0.05), 1.3), Layer((5.5, 0.05), 1.7)]
    np.testing.assert_allclose(layered(halves, F, theta), layered([glass], F, theta), rtol=1e-10)
    np.testing.assert_allclose(
        layered([glass, Layer((1.0, 0.0))], F, theta), slab(5.5 - 0.05j, 3e-3, F, theta), rtol=1e-10
    )
    opaque = Layer((6.0, 9.0), 50.0)
    np.testing.assert_allclose(layered([opaque, water], F, theta), half_space(6 - 9j, theta), rtol=1e-9)


def test_the_echo_of_the_back_of_a_sheet_comes_after_that_of_its_front() -> None:
    """Samples of a path tau have the phase +2 pi f tau, also inside the sheet."""
    rig = load_instrument(Path(__file__).parents[2] / "instrument.toml")
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
