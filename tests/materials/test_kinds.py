"""Laws of the densities of what a plate may be."""

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
    """Also beside metal, t = 1, where permittivity has no bound; errors add what lies beyond the passive ones."""
    axis = np.linspace(-0.6, 1.6, 1101)
    t = axis[None, :] + 1j * axis[:, None]
    density = KINDS.compute_half_space_density(t, std**2 * np.eye(2))
    total = float(density.sum()) * (axis[1] - axis[0]) ** 2
    assert 0.5 < total < 1.6


def test_no_half_space_lies_at_metal():
    """An unbounded density there once attracted every metal-like patch, and changed the estimated leakage."""
    near = 1 + 0.1 * np.exp(2j * np.pi * np.arange(12) / 12)
    density = KINDS.compute_half_space_density(np.append(near, 1.0), 0.03**2 * np.eye(2))
    everywhere = KINDS.compute_half_space_density(np.array([0.2 - 0.03j]), 0.03**2 * np.eye(2))
    assert density.max() < 0.2 * float(everywhere[0])


def test_brightness_of_a_half_space_is_that_of_eq_2():
    eps = np.array([1.5 - 0.1j, 2.3 - 0.22j, 4.0 - 0.4j, 7.3 - 0.9j, 9.0 - 17.0j])
    for theta_rad in np.radians([30.0, 55.0, 60.0]):
        r_s, _ = fresnel(eps, theta_rad)
        brightness = HalfSpaces(inverse_ratio(eps, theta_rad), theta_rad).log_brightness()
        np.testing.assert_allclose(brightness, np.log(np.abs(r_s)), atol=1e-9)


def test_materials_that_no_table_has_lie_near_those_that_one_has():
    """Per step of their coordinates they are several times rarer where no material was ever measured."""
    usual = KINDS.compute_half_space_density(inverse_ratio(np.array([2.5 - 0.02j]), THETA), 0.02**2 * np.eye(2))
    odd = KINDS.compute_half_space_density(inverse_ratio(np.array([2.5 - 4.0j]), THETA), 0.02**2 * np.eye(2))
    slopes = [
        abs(complex(find_permittivity_slope(inverse_ratio(eps, THETA), THETA))) for eps in (2.5 - 0.02j, 2.5 - 4.0j)
    ]
    # Densities of t become those of permittivities, and then of the coordinates: ln eps' and about ln eps''.
    per_cell = [float(usual[0]) / slopes[0] ** 2 * 0.06, float(odd[0]) / slopes[1] ** 2 * 4.0]
    assert per_cell[0] > 5 * per_cell[1]
