"""A surface that twists in the plane of incidence mixes the polarisations s and p.

The estimator's formula is compared with the exact series of a cylinder.
"""

import numpy as np
import pytest

from polysight.surfaces import mix_twisted
from polysight_worlds.media import Stack
from polysight_worlds.series import Pair, scatter_cylinder
from polysight_worlds.shapes import cylinder, find_specular, follow_path
from polysight_worlds.zones import spread_of_ray

FREQUENCY_HZ = 78e9
WAVE_NUMBER = 2 * np.pi * FREQUENCY_HZ / 299792458
# Distance of the antennas from the cylinder. At a finite distance the series has one more term of 1 / (k distance),
# here 1e-4, which does not depend on the curvature.
DISTANCE_M = 5.0


def mix_by_series(eps: complex | None, theta: float, radius_m: float) -> complex:
    """Echo that is sent in s and received in p, over the amplitude of a ray, of a cylinder by its exact series.

    Its axis is at 45 degrees to the plane of incidence, y = 0.
    """
    # Metal has no stack of layers; for the shape's geometry any medium will do.
    stack = Stack(below=4.0) if eps is None else Stack(below=eps)
    solid = cylinder("solid", stack, (0.0, 0.0, radius_m), radius_m, 10.0, axis=(1.0, 1.0, 0.0))
    ray = np.array([np.sin(theta), 0.0, np.cos(theta)])
    back = np.array([-np.sin(theta), 0.0, np.cos(theta)])
    tx_m = -DISTANCE_M * ray
    rx_m = -DISTANCE_M * back
    # Axes of the estimator: s = normal x ray, p = s x ray of each antenna.
    s_axis = np.cross([0.0, 0.0, -1.0], ray) / np.sin(theta)
    p_axis = np.cross(s_axis, back)
    place = np.array([0.0, 0.0, radius_m])
    columns = [column[:, None] for column in (tx_m - place, rx_m - place, s_axis, p_axis)]
    pair = Pair(*columns).rotate(solid.axes)
    along_m = pair.rx_m[0] - pair.tx_m[0]
    across_m = np.sqrt((2 * DISTANCE_M) ** 2 - along_m**2)
    wave = scatter_cylinder(pair, radius_m, eps, FREQUENCY_HZ, across_m)
    patch = solid.evaluate(*find_specular(solid, tx_m[:, None], rx_m[:, None]))
    path = follow_path(patch, tx_m[:, None], rx_m[:, None])
    spread = spread_of_ray(patch, path, tx_m[:, None], rx_m[:, None])
    return complex((wave * np.exp(2j * WAVE_NUMBER * DISTANCE_M) / spread)[0])


@pytest.mark.parametrize("eps", [2.2 - 0.05j, 4 - 0.5j, 7 - 1j, None], ids=["2.2", "4", "7", "metal"])
@pytest.mark.parametrize("angle_deg", [45.0, 55.0])
def test_a_twisted_surface_mixes_s_and_p_as_the_series_does(eps, angle_deg):
    theta = np.radians(angle_deg)
    radius_m = 0.2
    expected = mix_by_series(eps, float(theta), radius_m)
    # The cylinder is curved along (1, -1), across its axis: 1 / radius. Along x and along y it is half of that, and so
    # is the mixed term, the twist.
    ray_across = np.cross([0.0, 0.0, -1.0], [1.0, 0.0, 0.0])
    bent_along = np.array([1.0, -1.0, 0.0]) / np.sqrt(2)
    twist = bent_along[0] * (bent_along @ ray_across) / radius_m
    permittivity = np.inf if eps is None else eps
    mixed = mix_twisted(permittivity, np.array([theta]), np.array([twist]), WAVE_NUMBER)[0]
    # The formula is wrong by 1.5 % for dielectrics and by up to 3 % for metal. The mixed echoes are 2e-4 to 5e-3.
    assert mixed == pytest.approx(expected, rel=0.08)
    assert abs(expected) > 1e-4


def test_without_a_twist_s_and_p_do_not_mix():
    assert mix_twisted(4 - 0.3j, np.array([0.9]), np.zeros(1), WAVE_NUMBER) == 0
