"""Reflection of a half space: passive media, metal, the Brewster angle, total reflection, and values that are NaN.

Eq. 2 of the paper (`fresnel`) gives r_s and r_p of a permittivity, Eq. 3 the permittivity of the ratio r_s / r_p.
"""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from polysight.polarimetry import brewster_angle_rad, fresnel, permittivity_from_ratio, ratio_from_permittivity

real_part = st.floats(1.05, 60.0)
loss = st.floats(0.0, 40.0)
angle = st.floats(40.0, 75.0).map(np.radians)


@given(real_part, loss, angle)
def test_eq3_inverts_fresnel(re, im, theta):
    eps = re - 1j * im
    r_s, r_p = fresnel(eps, theta)
    # At Brewster's angle r_p vanishes, and with it the precision of the ratio.
    if abs(r_p) > 1e-6:
        assert permittivity_from_ratio(r_s / r_p, theta) == pytest.approx(eps, rel=1e-9)
    assert permittivity_from_ratio(ratio_from_permittivity(eps, theta), theta) == pytest.approx(eps, rel=1e-9)


@given(st.floats(0.0, 0.9), st.floats(-3.1, 3.1), angle)
def test_permittivity_is_the_same_for_a_ratio_and_its_reciprocal(modulus, phase, theta):
    p = (0.01 + modulus) * np.exp(1j * phase)
    assert permittivity_from_ratio(1 / p, theta) == pytest.approx(permittivity_from_ratio(p, theta), rel=1e-9)


@given(st.floats(0.01, 60.0), angle)
def test_a_medium_without_loss_is_the_limit_of_little_loss(re, theta):
    """This holds for total reflection, too, where the square root with a decaying wave is taken."""
    without_loss = fresnel(re + 0j, theta)
    with_little_loss = fresnel(re - 1e-12j, theta)
    # At the angle of total reflection the coefficients change as the root of the loss: 1e-6 times some factor.
    assert without_loss == pytest.approx(with_little_loss, abs=1e-4)


@given(real_part, loss, angle)
def test_passive_media_reflect_at_most_all_power(re, im, theta):
    r_s, r_p = fresnel(re - 1j * im, theta)
    assert abs(r_s) <= 1 + 1e-12
    assert abs(r_p) <= 1 + 1e-12
    # True for any half space: |r_p| <= |r_s|
    assert abs(r_p) <= abs(r_s) + 1e-12


def test_metal_is_one_at_every_angle_and_the_pole_of_eq3():
    theta = np.radians([0.0, 30.0, 55.0, 80.0])
    r_s, r_p = fresnel(np.inf, theta)
    np.testing.assert_array_equal(r_s, -1)
    np.testing.assert_array_equal(r_p, -1)
    np.testing.assert_array_equal(ratio_from_permittivity(np.inf, theta), 1)
    assert np.isinf(permittivity_from_ratio(1.0, theta)).all()
    # A poor conductor, with a permittivity of 3e5, is nearly metal: its ratio differs from 1 by 0.004.
    assert abs(ratio_from_permittivity(1.29e5 - 3.05e5j, np.radians(55.0)) - 1) < 0.01


NAN = float("nan")
INF = float("inf")

# Real or imaginary part: any number, infinity or nan
any_part = st.floats(allow_nan=True, allow_infinity=True)


@given(any_part, any_part, st.sampled_from([0.9, NAN]))
def test_nan_stays_nan_and_only_infinite_permittivity_is_metal(re, im, theta):
    """complex(inf, nan) is unknown, any other infinity is metal; another permittivity in the array is not affected."""
    eps = np.array([complex(re, im), 4 - 0.1j])
    is_unknown = np.isnan([re, im, theta]).any()
    is_metal = not is_unknown and np.isinf([re, im]).any()
    with np.errstate(all="ignore"):
        r_s, r_p = fresnel(eps, theta)
        p = ratio_from_permittivity(eps, theta)
    for (drawn, known), value_of_metal in ((r_s, -1), (r_p, -1), (p, 1)):
        if is_unknown:
            assert np.isnan(drawn)
        if is_metal:
            assert drawn == value_of_metal
        assert np.isnan(known) == np.isnan(theta)


@pytest.mark.parametrize("eps", [NAN, complex(NAN, 1), complex(1, NAN), complex(NAN, NAN), complex(INF, NAN)])
@pytest.mark.parametrize("function", [fresnel, ratio_from_permittivity])
def test_an_unknown_permittivity_gives_an_unknown_reflection_without_warnings(eps, function):
    with np.errstate(all="raise"):
        assert np.isnan(function(eps, 0.9)).all()


@pytest.mark.parametrize("eps", [4 - 0.1j, 1.0, INF])
@pytest.mark.parametrize("function", [fresnel, ratio_from_permittivity])
def test_an_unknown_angle_gives_an_unknown_reflection_even_of_metal(eps, function):
    with np.errstate(all="raise"):
        assert np.isnan(function(eps, NAN)).all()


def test_normal_incidence_and_an_example_worked_by_hand():
    n = np.sqrt(3.78)
    for r in fresnel(3.78, 0.0):
        assert r == pytest.approx((1 - n) / (1 + n))
    # PET at 55 degrees, worked by hand from Eq. 2.
    assert ratio_from_permittivity(3.78 - 0.70j, np.radians(55)) == pytest.approx(4.499 + 1.142j, abs=1e-3)


def test_brewster_angle_is_where_p_vanishes():
    # tan(theta) = sqrt(4) = 2
    theta = brewster_angle_rad(4.0)
    assert np.degrees(theta) == pytest.approx(63.4349, abs=1e-3)
    r_s, r_p = fresnel(4.0, theta)
    assert abs(r_p) < 1e-12
    # Eq. 2 at Brewster's angle: r_s = (1 - eps) / (1 + eps)
    assert r_s == pytest.approx((1 - 4.0) / (1 + 4.0))
    assert permittivity_from_ratio(np.inf, theta) == pytest.approx(4.0)


def test_air_is_invisible_but_has_a_finite_ratio():
    """The ratio is the limit as the permittivity approaches 1; both coefficients vanish."""
    theta = np.radians(50.0)
    assert fresnel(1.0, theta) == (0, 0)
    assert ratio_from_permittivity(1.0, theta) == pytest.approx(1 / np.cos(2 * theta))


def test_permittivity_of_an_unknown_ratio_is_unknown():
    eps = permittivity_from_ratio(np.array([complex(np.nan, 0), 2 + 0j]), 1.0)
    assert np.isnan(eps[0])
    assert np.isfinite(eps[1])


def test_shapes_broadcast():
    r_s, r_p = fresnel(np.array([[2.0], [3.0]]), np.radians([40.0, 50.0, 60.0]))
    assert r_s.shape == r_p.shape == (2, 3)
