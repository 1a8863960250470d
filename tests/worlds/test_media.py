"""Reflection at layers against closed forms, and laws of energy."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from polysight_worlds import METAL, Stack, reflect
from polysight_worlds.media import LIGHT_M_PER_S, ReflectionTable

FREQUENCY_HZ = 78e9
cosines = st.floats(0.05, 1.0)
permittivities = st.builds(lambda real, loss: real - 1j * loss, st.floats(1.01, 20), st.floats(0, 20))


def compute_fresnel(permittivity: complex, cosine: float) -> tuple[complex, complex]:
    """Fresnel's formulas; r_p is of the tangential electric field."""
    root = np.sqrt(permittivity - (1 - cosine**2))
    return (cosine - root) / (cosine + root), (root - permittivity * cosine) / (root + permittivity * cosine)


def compute_fresnel_between(above: complex, below: complex, cosine: float) -> tuple[complex, complex]:
    """Fresnel's formulas at a boundary of two media; `cosine` is that of the angle in air.

    By Snell's law the wavenumber along the boundary is the same in all media, so that the sine in air is enough.
    """
    sine_squared = 1 - cosine**2
    first = np.sqrt(above - sine_squared + 0j)
    second = np.sqrt(below - sine_squared + 0j)
    s = (first - second) / (first + second)
    return s, (above * second - below * first) / (above * second + below * first)


@given(permittivities, cosines)
def test_a_half_space_reflects_by_fresnel(permittivity, cosine):
    assert reflect(Stack(below=permittivity), FREQUENCY_HZ, cosine) == pytest.approx(
        compute_fresnel(permittivity, cosine)
    )


@given(permittivities, permittivities, st.floats(0.0, 0.006), cosines)
def test_a_layer_reflects_by_airy(layer, below, thickness_m, cosine):
    """Airy's formula: the reflection at the top, and all that returns from the bottom, in one fraction."""
    root = np.sqrt(layer - (1 - cosine**2))
    # The phase of the way down and up in the layer.
    turn = np.exp(-4j * np.pi * FREQUENCY_HZ / LIGHT_M_PER_S * root * thickness_m)
    stack = Stack(((layer, thickness_m),), below)
    pairs = zip(compute_fresnel_between(1, layer, cosine), compute_fresnel_between(layer, below, cosine), strict=True)
    expected = [(top + bottom * turn) / (1 + top * bottom * turn) for top, bottom in pairs]
    assert reflect(stack, FREQUENCY_HZ, cosine) == pytest.approx(expected, abs=1e-9)


@given(permittivities, permittivities, st.floats(0.0, 0.004), st.floats(0.0, 0.004), cosines)
def test_a_layer_cut_in_two_is_one_layer(layer, below, first_m, second_m, cosine):
    cut = Stack(((layer, first_m), (layer, second_m)), below)
    full_layer = Stack(((layer, first_m + second_m),), below)
    whole_r = np.array(reflect(full_layer, FREQUENCY_HZ, cosine))
    assert np.array(reflect(cut, FREQUENCY_HZ, cosine)) == pytest.approx(whole_r, abs=1e-9)


@given(st.lists(st.tuples(permittivities, st.floats(0.0, 0.01)), max_size=4), permittivities, cosines)
def test_no_stack_returns_more_than_it_was_given(layers, below, cosine):
    assert all(abs(r) <= 1 + 1e-9 for r in reflect(Stack(tuple(layers), below), FREQUENCY_HZ, cosine))


@given(st.lists(st.tuples(st.floats(1.01, 20), st.floats(0.0, 0.01)), max_size=4), cosines)
def test_layers_without_loss_on_metal_return_all(layers, cosine):
    # A permittivity of -1e7 is a conductor without loss. Copper has some, which grows where the layers resonate.
    stack = Stack(tuple(layers), below=-1e7)
    assert np.abs(reflect(stack, FREQUENCY_HZ, cosine)) == pytest.approx([1, 1])


@given(cosines)
def test_metal_turns_both_polarisations_alike(cosine):
    # Copper's own loss at cosines down to 0.05 is below 2 %.
    assert np.array(reflect(METAL, FREQUENCY_HZ, cosine)) == pytest.approx([-1, -1], abs=0.02)


def test_the_table_interpolates_the_solution():
    stack = Stack(((4 - 0.4j, 0.003),), 2 - 0.1j)
    cosine = np.linspace(0.2, 1, 97)
    table = np.array(ReflectionTable(stack, FREQUENCY_HZ).look_up(cosine))
    assert table == pytest.approx(np.array(reflect(stack, FREQUENCY_HZ, cosine)), abs=1e-4)
