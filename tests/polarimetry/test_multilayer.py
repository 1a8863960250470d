"""Reflection of layered media, compared with `tmm` (S. J. Byrnes), an independent transfer-matrix implementation.

`tmm` works in exp(-i omega t): its index is the conjugate of ours, and so are its coefficients. Its r_p has the
opposite sign (a perfect conductor has r_p = +1 there, -1 in Eq. 2 of the paper).
"""

import numpy as np
import pytest
import tmm
from hypothesis import given, settings, strategies as st

from polysight.polarimetry import fresnel, multilayer
from polysight_shared.errors import PolysightError
from polysight_shared.units import SPEED_OF_LIGHT_M_S
from polysight_simulators.scene import Layer, reflect_layers
from polysight_simulators.scene.optics import half_space, slab

media = st.tuples(st.floats(1.0, 12.0), st.floats(0.0, 20.0)).map(lambda e: complex(e[0], -e[1]))
lossless = st.floats(1.0, 12.0).map(complex)
thickness = st.floats(0.05e-3, 4e-3)
angle = st.floats(0.0, 1.4)
frequency = st.floats(76e9, 81e9)


def reflect_by_tmm(eps, thickness_m, frequency_hz, theta):
    """(r_s, r_p) in our signs, and the transmitted powers (T_s, T_p); a half space ends the stack."""
    # Air before the stack; `tmm` wants the thickness of both half spaces, too.
    indices = [1.0, *(np.conj(np.sqrt(complex(e))) for e in eps)]
    thicknesses_m = [np.inf, *thickness_m, np.inf]
    wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz
    s = tmm.coh_tmm("s", indices, thicknesses_m, theta, wavelength_m)
    p = tmm.coh_tmm("p", indices, thicknesses_m, theta, wavelength_m)
    return (np.conj(s["r"]), -np.conj(p["r"])), (s["T"], p["T"])


@settings(max_examples=60)
@given(st.lists(st.tuples(media, thickness), max_size=4), media, frequency, angle)
def test_random_stacks_agree_with_tmm(layers, last, f, theta):
    """`multilayer` sums echoes, the simulator chains transmission lines, and `tmm` multiplies transfer matrices."""
    eps = [e for e, _ in layers] + [last]
    thickness_m = [d for _, d in layers]
    expected, _ = reflect_by_tmm(eps, thickness_m, f, theta)
    np.testing.assert_allclose(multilayer(eps, thickness_m, f, theta), expected, rtol=1e-8, atol=1e-10)
    # The simulator's layers have the loss as a positive number, and millimetres.
    stack = [Layer((e.real, -e.imag), 1e3 * d) for e, d in layers] + [Layer((last.real, -last.imag))]
    np.testing.assert_allclose(reflect_layers(stack, f, theta), expected, rtol=1e-8, atol=1e-10)


@settings(max_examples=60)
@given(media, thickness, frequency, angle)
def test_interfaces_and_plates_of_the_simulator_agree_with_tmm(eps, d, f, theta):
    of_interface, _ = reflect_by_tmm([eps], [], f, theta)
    np.testing.assert_allclose(half_space(eps, theta), of_interface, rtol=1e-8, atol=1e-10)
    of_plate_in_air, _ = reflect_by_tmm([eps, 1.0], [d], f, theta)
    np.testing.assert_allclose(slab(eps, d, f, theta), of_plate_in_air, rtol=1e-8, atol=1e-10)


@settings(max_examples=40)
@given(st.lists(st.tuples(lossless, thickness), min_size=1, max_size=4), frequency, angle)
def test_energy_is_conserved_by_lossless_layers(layers, f, theta):
    eps, thickness_m = zip(*layers, strict=True)
    # As many thicknesses as media: air is behind them.
    reflected = multilayer(list(eps), list(thickness_m), f, theta)
    _, transmitted_power = reflect_by_tmm([*eps, 1.0], thickness_m, f, theta)
    np.testing.assert_allclose(np.abs(reflected) ** 2 + transmitted_power, 1.0, atol=1e-9)
    # A conductor behind the layers reflects all power.
    conductor = 1 - 1e16j
    with_conductor = multilayer([*eps, conductor], list(thickness_m), f, theta)
    np.testing.assert_allclose(np.abs(with_conductor), 1.0, atol=1e-6)


@settings(max_examples=40)
@given(st.lists(st.tuples(media, thickness), min_size=1, max_size=3), media, frequency, angle)
def test_a_passive_stack_reflects_at_most_all_power(layers, last, f, theta):
    r = multilayer([e for e, _ in layers] + [last], [d for _, d in layers], f, theta)
    assert np.all(np.abs(r) <= 1 + 1e-9)


@settings(max_examples=40)
@given(media, media, frequency, angle)
def test_a_stack_of_one_visible_medium_reflects_by_fresnel(eps, second, f, theta):
    """The first medium fills all of the space, the second one is of the same material, or the first one hides it."""
    for endless in (multilayer(eps, np.inf, f, theta), multilayer([eps], [], f, theta)):
        np.testing.assert_allclose(endless, fresnel(eps, theta), rtol=1e-12)
    np.testing.assert_allclose(multilayer([eps, eps], [1e-3], f, theta), fresnel(eps, theta), rtol=1e-9, atol=1e-12)
    # A metre of a lossy medium hides the media behind it.
    lossy = complex(eps.real, min(eps.imag, -1.0))
    np.testing.assert_allclose(multilayer([lossy, second], [1.0], f, theta), fresnel(lossy, theta), rtol=1e-9)


def test_water_behind_glass():
    """Water behind 3 mm of glass, at the rig's angle and in its band."""
    glass = 5.5 - 0.05j
    # At 75 GHz
    water = 9.37 - 18j
    stack = ([glass, water], [3e-3], 78.6e9, np.radians(55.0))
    expected, _ = reflect_by_tmm(*stack)
    assert multilayer(*stack) == pytest.approx(expected)


def test_shapes_broadcast():
    r_s, _ = multilayer([2.5, 4.0], [1e-3, 2e-3], np.linspace(76e9, 81e9, 5)[:, None], np.radians([50.0, 60.0]))
    assert r_s.shape == (5, 2)


@pytest.mark.parametrize(
    ("eps", "thickness_m"), [([2.0, 3.0], []), ([2.0], [1e-3, 1e-3]), ([2.0, 3.0], [np.inf]), ([2.0], [-1e-3])]
)
def test_stacks_with_a_wrong_number_of_thicknesses_or_an_impossible_one_are_refused(eps, thickness_m):
    with pytest.raises(PolysightError):
        multilayer(eps, thickness_m, 78e9, 1.0)
