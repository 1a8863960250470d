"""The error bar of a permittivity: by the slope of Eq. 3, and the same plate elsewhere lies within it."""

import numpy as np
import pytest

from polysight.materials.measure import estimate_permittivity
from polysight.polarimetry import permittivity_from_ratio, ratio_from_permittivity

THETA = np.radians(55.0)


def pixels(eps, sigma, n, rng):
    q = 1 / ratio_from_permittivity(eps, THETA)
    return np.ones(n, complex), q + sigma * (rng.standard_normal(n) + 1j * rng.standard_normal(n))


def test_the_error_grows_towards_metal():
    sizes = [
        estimate_permittivity(*pixels(eps, 0.004, 500, np.random.default_rng(3)), THETA).real_std
        for eps in (2.0 - 0.1j, 4.0 - 0.1j, 8.0 - 0.1j, 16.0 - 0.1j)
    ]
    assert sizes == sorted(sizes)
    step = 1e-6
    q = 1 / ratio_from_permittivity(4.0 - 0.1j, THETA)
    slope = abs(permittivity_from_ratio(q + step, THETA) - permittivity_from_ratio(q - step, THETA)) / (2 * step)
    h, v = pixels(4.0 - 0.1j, 0.004, 4000, np.random.default_rng(4))
    assert estimate_permittivity(h, v, THETA).real_std == pytest.approx(slope * 0.004, rel=0.05)


def test_a_shifted_plate_stays_within_its_error_bar(synthetic, request):
    """Nine plates in random placements with noise: no estimate leaves three of its standard errors."""
    placements = 8 if request.config.getoption("--long") else 3
    z = []
    for seed in range(placements):
        scene = synthetic(seed, uneven=0.0)
        for patch in scene.analyse().patches:
            e = patch.permittivity
            truth = patch.truth
            if truth is None or truth.permittivity is None or e.value is None:
                continue
            difference = e.value - truth.permittivity
            z += [difference.real / e.real_std, difference.imag / e.loss_std]
    assert len(z) > 10 * placements
    assert max(np.abs(z)) < 3
    assert np.sqrt(np.mean(np.square(z))) < 1.2
