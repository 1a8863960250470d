"""The image of a level plate relative to that of an endless mirror equals the integral over the plate's echoes."""

import numpy as np
import pytest

from polysight.imaging.geometry import StageWindow

# Phase of an echo in radians per square of its distance, in pixels, from the specular point; arbitrary
BEND = 0.05


@pytest.mark.parametrize("ends_px", [(-8.0, 8.0), (3.0, 14.0), (-30.0, -12.0)])
def test_a_level_plates_image_is_the_sum_of_its_echoes_over_the_scan(ends_px):
    """The phase of an echo grows with the square of its distance from the specular point of each scan position."""
    # Specular points of 41 scan positions and the weights of the positions; columns of the image
    specular_px = np.arange(-20.0, 21.0)
    weights = np.hanning(specular_px.size + 2)[1:-1]
    columns_px = np.arange(-10.0, 18.0)
    plate_px = np.linspace(*ends_px, 4001)
    echoes = np.exp(1j * BEND * (plate_px[:, None] - specular_px) ** 2)
    # The integral of an endless mirror is sqrt(pi / bend) at 45 degrees.
    integral_of_mirror = np.sqrt(np.pi / BEND) * np.exp(0.25j * np.pi)
    echo = np.trapezoid(echoes, plate_px, axis=0) / integral_of_mirror
    focus = weights * np.exp(-1j * BEND * (columns_px[:, None] - specular_px) ** 2)
    expected = focus @ echo / focus.sum(axis=1)
    image = StageWindow(specular_px, weights, BEND).level_image(np.array(ends_px), columns_px)
    # The sum over 4001 points of the plate differs from the integral by 1e-6 (measured).
    np.testing.assert_allclose(image, expected, atol=1e-4)
