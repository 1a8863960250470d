"""The error bar of a permittivity: two ways to it agree, and the same plate elsewhere lies within it."""

import numpy as np
import pytest

from polysight.host.materials.permittivity import bootstrap_permittivity_std, estimate_permittivity
from polysight.host.polarimetry import permittivity_from_ratio, ratio_from_permittivity

THETA = np.radians(55.0)


def pixels(eps, sigma, n, rng, gain=1.0):
    q = 1 / ratio_from_permittivity(eps, THETA)
    return np.ones(n, complex), gain * (q + sigma * (rng.standard_normal(n) + 1j * rng.standard_normal(n)))


@pytest.mark.parametrize("eps", [2.2 - 0.1j, 3.78 - 0.7j, 5.0 - 1.1j])
@pytest.mark.parametrize("calibration_std", [0.0, 0.02])
def test_slope_and_bootstrap_agree(eps, calibration_std):
    h, v = pixels(eps, 0.004, 3000, np.random.default_rng(1))
    found = estimate_permittivity(h, v, THETA, calibration_std)
    drawn = bootstrap_permittivity_std(h, v, float(THETA), calibration_std)
    assert drawn == pytest.approx((found.real_std, found.loss_std), rel=0.1)


def test_error_of_the_reference_is_in_the_error_bar():
    """Patches whose metal reference is off by its standard error: their estimates scatter as claimed."""
    rng = np.random.default_rng(2)
    eps, sigma, reference = 4.0 - 0.5j, 1e-4, 0.02
    found = []
    for _ in range(400):
        gain = 1 + reference * (rng.standard_normal() + 1j * rng.standard_normal())
        found.append(estimate_permittivity(*pixels(eps, sigma, 30, rng, gain), THETA, reference))
    claimed = np.median([f.real_std for f in found])
    assert np.std([f.value.real for f in found]) == pytest.approx(claimed, rel=0.15)
    assert np.std([f.value.imag for f in found]) == pytest.approx(claimed, rel=0.15)


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


def test_a_shifted_plate_stays_within_its_error_bar(synthetic):
    """Nine plates in eight random placements with noise: no estimate leaves three of its standard errors."""
    z = []
    for seed in range(8):
        scene = synthetic(seed, uneven=0.0)
        for patch in scene.analyse().patches:
            e, truth = patch.permittivity, patch.truth
            if truth is None or truth.permittivity is None or e.value is None:
                continue
            difference = e.value - truth.permittivity
            z += [difference.real / e.real_std, difference.imag / e.loss_std]
    assert len(z) > 80
    assert max(np.abs(z)) < 3
    assert np.sqrt(np.mean(np.square(z))) < 1.2
