"""The image of a level plate over that of a mirror, compared with the integral over the plate's echoes."""

import numpy as np
import pytest

from polysight.imaging.geometry import StageWindow

BEND = 0.05


@pytest.mark.parametrize("ends_px", [(-8.0, 8.0), (3.0, 14.0), (-30.0, -12.0)])
def test_a_level_plates_image_is_the_sum_of_its_echoes_over_the_scan(ends_px):
    """The phase of an echo grows by the square of its distance from each position's specular point."""
    places = np.arange(-20.0, 21.0)
    weights = np.hanning(places.size + 2)[1:-1]
    columns = np.arange(-10.0, 18.0)
    plate = np.linspace(*ends_px, 4001)
    echoes = np.exp(1j * BEND * (plate[:, None] - places) ** 2)
    # Of an endless mirror the integral is sqrt(pi / bend) at 45 degrees.
    echo = np.trapezoid(echoes, plate, axis=0) / (np.sqrt(np.pi / BEND) * np.exp(0.25j * np.pi))
    focus = weights * np.exp(-1j * BEND * (columns[:, None] - places) ** 2)
    expected = focus @ echo / focus.sum(axis=1)
    image = StageWindow(places, weights, BEND).level_image(np.array(ends_px), columns)
    np.testing.assert_allclose(image, expected, atol=1e-4)
