"""Reflection coefficients of layers are compared with closed forms, and keep the laws of energy."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from polysight_worlds import METAL, Stack, reflect
from polysight_worlds.media import LIGHT_M_PER_S, ReflectionTable

FREQUENCY_HZ = 78e9
# Cosines of the angle of incidence up to 87 degrees: nearer to grazing, formulas subtract nearly equal numbers.
cosines = st.floats(0.05, 1.0)
# From that of foam to more than that of water at these frequencies
permittivities = st.builds(lambda real, loss: real - 1j * loss, st.floats(1.01, 20), st.floats(0, 20))


def compute_fresnel(permittivity: complex, cosine: float) -> tuple[complex, complex]:
    """Fresnel's reflection coefficients of s and p in air; that of p is of the electric field along the surface."""
    root = np.sqrt(permittivity - (1 - cosine**2))
    r_s = (cosine - root) / (cosine + root)
    r_p = (root - permittivity * cosine) / (root + permittivity * cosine)
    return r_s, r_p


def compute_fresnel_between(above: complex, below: complex, cosine: float) -> tuple[complex, complex]:
    """Fresnel's coefficients of s and p at a boundary of two media; `cosine` is that of the angle in air.

    By Snell's law the wavenumber along the boundary is the same in all media, so that the sine in air is enough.
    """
    sine_squared = 1 - cosine**2
    # Wavenumbers across the boundary, in units of that in air.
    wavenumber_above = np.sqrt(above - sine_squared + 0j)
    wavenumber_below = np.sqrt(below - sine_squared + 0j)
    r_s = (wavenumber_above - wavenumber_below) / (wavenumber_above + wavenumber_below)
    p_above = below * wavenumber_above
    p_below = above * wavenumber_below
    r_p = (p_below - p_above) / (p_below + p_above)
    return r_s, r_p


@given(permittivities, cosines)
def test_a_half_space_reflects_by_fresnel(permittivity, cosine):
    assert reflect(Stack(below=permittivity), FREQUENCY_HZ, cosine) == pytest.approx(
        compute_fresnel(permittivity, cosine)
    )


@given(permittivities, permittivities, st.floats(0.0, 0.006), cosines)
def test_a_layer_reflects_by_airy(layer, below, thickness_m, cosine):
    """Airy's formula sums the reflection at the top and all waves that return from the bottom, in one fraction."""
    root = np.sqrt(layer - (1 - cosine**2))
    # Phase and loss on the way down and up in the layer.
    down_and_up = np.exp(-4j * np.pi * FREQUENCY_HZ / LIGHT_M_PER_S * root * thickness_m)
    stack = Stack(((layer, thickness_m),), below)
    at_top = compute_fresnel_between(1, layer, cosine)
    at_bottom = compute_fresnel_between(layer, below, cosine)
    expected = [
        (top + bottom * down_and_up) / (1 + top * bottom * down_and_up)
        for top, bottom in zip(at_top, at_bottom, strict=True)
    ]
    assert reflect(stack, FREQUENCY_HZ, cosine) == pytest.approx(expected, abs=1e-9)


@given(permittivities, permittivities, st.floats(0.0, 0.004), st.floats(0.0, 0.004), cosines)
def test_a_layer_cut_in_two_reflects_as_one_layer(layer, below, first_m, second_m, cosine):
    two_layers = Stack(((layer, first_m), (layer, second_m)), below)
    one_layer = Stack(((layer, first_m + second_m),), below)
    r_of_one = np.array(reflect(one_layer, FREQUENCY_HZ, cosine))
    assert np.array(reflect(two_layers, FREQUENCY_HZ, cosine)) == pytest.approx(r_of_one, abs=1e-9)


@given(st.lists(st.tuples(permittivities, st.floats(0.0, 0.01)), max_size=4), permittivities, cosines)
def test_no_stack_reflects_more_than_the_incident_wave(layers, below, cosine):
    coefficients = reflect(Stack(tuple(layers), below), FREQUENCY_HZ, cosine)
    # 1e-9 is for rounding.
    assert all(abs(coefficient) <= 1 + 1e-9 for coefficient in coefficients)


@given(st.lists(st.tuples(st.floats(1.01, 20), st.floats(0.0, 0.01)), max_size=4), cosines)
def test_layers_without_loss_on_a_conductor_without_loss_reflect_all(layers, cosine):
    # A large negative permittivity, here -1e7, is a conductor without loss. Copper has some, and it grows where the
    # layers resonate.
    stack = Stack(tuple(layers), below=-1e7)
    assert np.abs(reflect(stack, FREQUENCY_HZ, cosine)) == pytest.approx([1, 1])


@given(cosines)
def test_metal_turns_both_polarisations_alike(cosine):
    # Copper's loss at cosines down to 0.05 is below 2 per cent.
    assert np.array(reflect(METAL, FREQUENCY_HZ, cosine)) == pytest.approx([-1, -1], abs=0.02)


def test_a_table_of_reflection_coefficients_agrees_with_the_solution_between_its_entries():
    stack = Stack(((4 - 0.4j, 0.003),), 2 - 0.1j)
    # Cosines that do not fall on the entries of the table
    cosine = np.linspace(0.2, 1, 97)
    looked_up = np.array(ReflectionTable(stack, FREQUENCY_HZ).look_up(cosine))
    assert looked_up == pytest.approx(np.array(reflect(stack, FREQUENCY_HZ, cosine)), abs=1e-4)
