"""Laws of the probability densities of V / H of half spaces, and of their brightness."""

import numpy as np
import pytest

from polysight.materials.kinds import (
    HalfSpaces,
    Kinds,
    find_permittivity_slope,
    inverse_ratio,
    list_literature_kinds,
)
from polysight.polarimetry import fresnel

THETA = np.radians(55.0)
KINDS = Kinds(list_literature_kinds(), float(THETA))


@pytest.mark.parametrize("std", [0.005, 0.02, 0.06])
def test_half_spaces_have_a_density_that_adds_up_to_one(std):
    """Summed over the plane of t = V / H, the density should give 1. It is approximate: 1.23 to 1.26.

    The approximation is worst near metal, t = 1, where the permittivity has no bound. Errors of the measurement add
    values of t that no passive material has.
    """
    axis = np.linspace(-0.6, 1.6, 1101)
    step = axis[1] - axis[0]
    t = axis[None, :] + 1j * axis[:, None]
    density = KINDS.compute_half_space_density(t, std**2 * np.eye(2))
    total = float(density.sum()) * step**2
    assert 1.0 < total < 1.3


def test_no_half_space_lies_at_metal():
    """An unbounded density at metal would attract every patch that is like metal, and change the estimated leakage."""
    covariance = 0.03**2 * np.eye(2)
    # Metal is t = 1; twelve points on a circle around it.
    circle = 1 + 0.1 * np.exp(2j * np.pi * np.arange(12) / 12)
    near_metal = KINDS.compute_half_space_density(np.append(circle, 1.0), covariance)
    # The ratio of a usual plate has a density of 6.5; near metal it is 1e-11.
    of_usual_plate = KINDS.compute_half_space_density(np.array([0.2 - 0.03j]), covariance)
    assert near_metal.max() < 0.2 * float(of_usual_plate[0])


def test_brightness_of_a_half_space_is_that_of_eq_2():
    eps = np.array([1.5 - 0.1j, 2.3 - 0.22j, 4.0 - 0.4j, 7.3 - 0.9j, 9.0 - 17.0j])
    for theta_rad in np.radians([30.0, 55.0, 60.0]):
        r_s, _ = fresnel(eps, theta_rad)
        brightness = HalfSpaces(inverse_ratio(eps, theta_rad), theta_rad).log_brightness()
        np.testing.assert_allclose(brightness, np.log(np.abs(r_s)), atol=1e-9)


def test_an_unknown_material_is_likelier_near_those_of_the_literature():
    """Compared per step of the coordinates in which the density is defined: ln eps' and asinh(eps'' / 0.05)."""

    def compute_density_per_step(eps: complex, loss_per_step: float) -> float:
        t = np.array([inverse_ratio(eps, THETA)])
        density_of_t = float(KINDS.compute_half_space_density(t, 0.02**2 * np.eye(2))[0])
        # A step of t is a step of permittivity by the slope; an area by its square. The step of ln eps' is the same
        # for both materials: only that of the loss differs.
        slope = abs(complex(find_permittivity_slope(t[0], THETA)))
        return density_of_t / slope**2 * loss_per_step

    # At a real part of 2.5, a loss of 0.02 is usual; no measured material has 4.0. The loss changes by
    # sqrt(eps''^2 + 0.05^2) per step of asinh(eps'' / 0.05): by 0.054 (0.06 here, to one digit) and by 4.0. The first
    # density is 5.4 times the second.
    usual = compute_density_per_step(2.5 - 0.02j, loss_per_step=0.06)
    odd = compute_density_per_step(2.5 - 4.0j, loss_per_step=4.0)
    assert usual > 5 * odd
