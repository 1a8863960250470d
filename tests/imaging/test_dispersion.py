"""The dispersion of an echo, its relative change over the sweep, follows from the change of its image with range.

The images are computed here as sums over the sweep, for several windows.
"""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from polysight.imaging.samples import BoardSamples
from polysight_shared.units import SPEED_OF_LIGHT_M_S

FREQUENCIES_HZ = np.linspace(76e9, 80e9, 33)
FROM_MIDDLE_HZ = FREQUENCIES_HZ - 78e9

# Change of an echo's phase per hertz and metre of path
PHASE_PER_HZ_M = -2j * np.pi / SPEED_OF_LIGHT_M_S


def measure_dispersion(weights: np.ndarray, growth: np.ndarray) -> complex:
    """Dispersion of an echo with `growth` [frequency] over a constant one, under a window [frequency]."""
    weights = weights / weights.sum()

    def make_image(spectrum: np.ndarray) -> np.ndarray:
        return np.array([[(weights * spectrum).sum()]])

    slope = PHASE_PER_HZ_M * FROM_MIDDLE_HZ
    ones = np.ones(FREQUENCIES_HZ.size)
    board: Any = SimpleNamespace(
        image=lambda _: (make_image(growth), make_image(ones), None),
        range_slope=lambda _: (make_image(growth * slope), make_image(slope)),
        _make_constant_image=lambda echo, _: make_image(echo),
        _mirror=lambda _: ones,
        _compute_range_slope_factors=lambda: slope,
        _reduction=SimpleNamespace(frequencies_hz=FREQUENCIES_HZ),
    )
    return complex(BoardSamples.dispersion(board)[0, 0])


@pytest.mark.parametrize("window", [np.ones(33), np.hanning(33), np.linspace(1.0, 2.0, 33)])
@pytest.mark.parametrize("per_sweep", [0.1, -0.05 + 0.2j])
def test_an_echo_that_grows_along_the_sweep_has_that_growth_relative_to_its_mean(window, per_sweep):
    sweep_hz = FREQUENCIES_HZ[-1] - FREQUENCIES_HZ[0]
    growth = 1 + per_sweep * FROM_MIDDLE_HZ / sweep_hz
    mean = (window * growth).sum() / window.sum()
    # Equal within rounding: 1.5e-8 is measured.
    assert measure_dispersion(window, growth) == pytest.approx(per_sweep / mean, rel=1e-4)


def test_the_dispersion_of_a_constant_echo_is_zero_and_without_an_echo_it_is_unknown():
    assert abs(measure_dispersion(np.hanning(33), np.full(33, 0.3j))) < 1e-6
    assert np.isnan(measure_dispersion(np.hanning(33), np.zeros(33)))
