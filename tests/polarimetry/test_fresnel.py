"""Laws of reflection: Eq. 3 inverts Eq. 2, reciprocity, stacks reduce to single interfaces and conserve energy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from polysight.host.polarimetry import (
    brewster_angle_rad,
    fresnel,
    multilayer,
    permittivity_from_ratio,
    ratio_from_permittivity,
)
from polysight.shared.errors import PolysightError
from polysight.shared.units import SPEED_OF_LIGHT_M_S

real_part = st.floats(1.05, 60.0)
loss = st.floats(0.0, 40.0)
angle = st.floats(40.0, 75.0).map(np.radians)


def abeles(eps, thickness_m, frequency_hz, theta, polarisation):
    """Characteristic-matrix solution (Born & Wolf 1.6), written independently: reflected and transmitted power."""
    k0 = 2 * np.pi * frequency_hz / SPEED_OF_LIGHT_M_S
    cosines = [np.sqrt(1 - np.sin(theta) ** 2 / e + 0j) for e in eps]
    n = [np.sqrt(complex(e)) for e in eps]
    # Tilted admittances; H for p, E for s.
    eta = [ni * ci if polarisation == "s" else ni / ci for ni, ci in zip(n, cosines, strict=True)]
    m = np.eye(2, dtype=complex)
    for i, d in enumerate(thickness_m, start=1):
        delta = k0 * n[i] * d * cosines[i]
        m = m @ np.array([[np.cos(delta), 1j * np.sin(delta) / eta[i]], [1j * eta[i] * np.sin(delta), np.cos(delta)]])
    b, c = m @ np.array([1.0, eta[-1]])
    r = (eta[0] * b - c) / (eta[0] * b + c)
    t = 4 * eta[0].real * eta[-1].real / abs(eta[0] * b + c) ** 2
    return r, t


@given(real_part, loss, angle)
def test_eq3_inverts_fresnel(re, im, theta):
    eps = re - 1j * im
    r_s, r_p = fresnel(eps, theta)
    if abs(r_p) > 1e-6:
        assert permittivity_from_ratio(r_s / r_p, theta) == pytest.approx(eps, rel=1e-9)
    assert permittivity_from_ratio(ratio_from_permittivity(eps, theta), theta) == pytest.approx(eps, rel=1e-9)


@given(st.floats(0.0, 0.9), st.floats(-3.1, 3.1), angle)
def test_permittivity_is_the_same_for_p_and_its_reciprocal(modulus, phase, theta):
    p = (0.01 + modulus) * np.exp(1j * phase)
    assert permittivity_from_ratio(1 / p, theta) == pytest.approx(permittivity_from_ratio(p, theta), rel=1e-9)


@given(real_part, loss, angle)
def test_passive_media_reflect_no_more_than_they_receive(re, im, theta):
    r_s, r_p = fresnel(re - 1j * im, theta)
    assert abs(r_s) <= 1 + 1e-12
    assert abs(r_p) <= 1 + 1e-12
    assert abs(r_p) <= abs(r_s) + 1e-12


def test_metal_is_one_at_every_angle_and_the_pole_of_eq3():
    theta = np.radians([0.0, 30.0, 55.0, 80.0])
    r_s, r_p = fresnel(np.inf, theta)
    np.testing.assert_array_equal(r_s, -1)
    np.testing.assert_array_equal(r_p, -1)
    np.testing.assert_array_equal(ratio_from_permittivity(np.inf, theta), 1)
    assert np.isinf(permittivity_from_ratio(1.0, theta)).all()
    assert abs(ratio_from_permittivity(1.29e5 - 3.05e5j, np.radians(55.0)) - 1) < 0.01


NAN, INF = float("nan"), float("inf")
any_part = st.floats(allow_nan=True, allow_infinity=True)


@given(any_part, any_part, st.sampled_from([0.9, NAN]))
def test_what_is_not_a_number_stays_so_and_only_infinite_permittivity_is_metal(re, im, theta):
    """complex(inf, nan) too: which infinity it is does not matter, but nan says that nobody knows."""
    eps = np.array([complex(re, im), 4 - 0.1j])
    unknown = np.isnan([re, im, theta]).any()
    with np.errstate(all="ignore"):
        r_s, r_p = fresnel(eps, theta)
        p = ratio_from_permittivity(eps, theta)
    for value, metal in ((r_s, -1), (r_p, -1), (p, 1)):
        assert np.isnan(value[0]) or not unknown
        assert np.isnan(value[1]) == np.isnan(theta)
        if not unknown and np.isinf([re, im]).any():
            assert value[0] == metal


@pytest.mark.parametrize("eps", [NAN, complex(NAN, 1), complex(1, NAN), complex(NAN, NAN), complex(INF, NAN)])
@pytest.mark.parametrize("function", [fresnel, ratio_from_permittivity])
def test_unknown_permittivity_gives_unknown_reflection_without_warnings(eps, function):
    with np.errstate(all="raise"):
        assert np.isnan(function(eps, 0.9)).all()


@pytest.mark.parametrize("eps", [4 - 0.1j, 1.0, INF])
@pytest.mark.parametrize("function", [fresnel, ratio_from_permittivity])
def test_an_unknown_angle_gives_unknown_reflection_of_metal_too(eps, function):
    with np.errstate(all="raise"):
        assert np.isnan(function(eps, NAN)).all()


def test_normal_incidence_and_published_example():
    n = np.sqrt(3.78)
    for r in fresnel(3.78, 0.0):
        assert r == pytest.approx((1 - n) / (1 + n))
    # PET at 55 degrees, worked by hand from Eq. 2.
    assert ratio_from_permittivity(3.78 - 0.70j, np.radians(55)) == pytest.approx(4.499 + 1.142j, abs=1e-3)


def test_brewster_angle_is_where_p_vanishes():
    theta = brewster_angle_rad(4.0)
    assert np.degrees(theta) == pytest.approx(63.4349, abs=1e-3)
    r_s, r_p = fresnel(4.0, theta)
    assert abs(r_p) < 1e-12
    assert abs(r_s) > 0.5
    assert permittivity_from_ratio(np.inf, theta) == pytest.approx(4.0)


def test_air_is_invisible_but_has_a_finite_ratio():
    theta = np.radians(50.0)
    assert fresnel(1.0, theta) == (0, 0)
    assert ratio_from_permittivity(1.0, theta) == pytest.approx(1 / np.cos(2 * theta))


def test_not_a_number_stays_so():
    eps = permittivity_from_ratio(np.array([complex(np.nan, 0), 2 + 0j]), 1.0)
    assert np.isnan(eps[0])
    assert np.isfinite(eps[1])


def test_shapes_broadcast():
    r_s, r_p = fresnel(np.array([[2.0], [3.0]]), np.radians([40.0, 50.0, 60.0]))
    assert r_s.shape == r_p.shape == (2, 3)
    r_s, _ = multilayer([2.5, 4.0], [1e-3, 2e-3], np.linspace(76e9, 81e9, 5)[:, None], np.radians([50.0, 60.0]))
    assert r_s.shape == (5, 2)


@given(real_part, loss, angle)
def test_infinite_second_medium_is_fresnel(re, im, theta):
    eps = re - 1j * im
    for stack in (
        multilayer(eps, np.inf, 78e9, theta),
        multilayer([eps], [], 78e9, theta),
        multilayer([eps, eps], [3e-3], 78e9, theta),
        multilayer([1.0, eps], [0.0], 78e9, theta),
    ):
        np.testing.assert_allclose(stack, fresnel(eps, theta), rtol=1e-9, atol=1e-12)


def test_very_thick_lossy_layer_hides_what_is_behind_without_overflow():
    theta = np.radians(55.0)
    np.testing.assert_allclose(multilayer(5 - 2j, 10.0, 78e9, theta), fresnel(5 - 2j, theta), rtol=1e-12)


@given(
    st.lists(st.tuples(st.floats(1.1, 9.0), st.floats(1e-4, 5e-3)), min_size=1, max_size=4),
    st.floats(0.0, 1.2),
    st.floats(76e9, 81e9),
)
def test_lossless_stack_conserves_energy(layers, theta, frequency):
    eps, thickness = [e for e, _ in layers], [d for _, d in layers]
    for r, polarisation in zip(multilayer(eps, thickness, frequency, theta), "sp", strict=True):
        _, t = abeles([1.0, *eps, 1.0], thickness, frequency, theta, polarisation)
        assert abs(r) ** 2 + t == pytest.approx(1.0, abs=1e-9)


def test_stack_agrees_with_characteristic_matrices():
    """Glass in front of water, against an independently written solution."""
    eps, d, f, theta = [6.5 - 0.2j, 9.37 - 18j], [3e-3], 78e9, np.radians(55.0)
    r_s, r_p = multilayer(eps, d, f, theta)
    ref_s, _ = abeles([1.0, *eps], d, f, theta, "s")
    ref_p, _ = abeles([1.0, *eps], d, f, theta, "p")
    assert r_s == pytest.approx(ref_s, rel=1e-9)
    assert abs(r_p) == pytest.approx(abs(ref_p), rel=1e-9)
    assert r_s / r_p == pytest.approx(-ref_s / ref_p, rel=1e-9) or r_s / r_p == pytest.approx(ref_s / ref_p, rel=1e-9)


def test_misfit_stacks_are_refused():
    for eps, d in (([2.0, 3.0], []), ([2.0], [1e-3, 1e-3]), ([2.0, 3.0], [np.inf]), ([2.0], [-1e-3])):
        with pytest.raises(PolysightError):
            multilayer(eps, d, 78e9, 1.0)
