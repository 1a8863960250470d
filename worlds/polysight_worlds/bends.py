"""What physical optics misses at a bent surface, to first order in the curvature over the wave number.

Physical optics takes each point's tangent plane for the surface. The true reflection differs by terms of first order
in 1 / (k R), which are linear in the three curvatures: along the plane of incidence, across it, and the twist between
both (which couples s and p). Three solids with exact series distinguish them: a cylinder across the plane of incidence,
one along it, and one at 45 degrees. Series minus physical optics at two radii gives the terms for any medium, also
those of a plane (radius without end) for antennas at a finite distance.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from polysight_worlds.media import LIGHT_M_PER_S, Stack
from polysight_worlds.optics import Antenna
from polysight_worlds.series import Pair, scatter_cylinder
from polysight_worlds.shapes import cylinder, find_specular, follow_path
from polysight_worlds.zones import spread_of_ray, sum_window

# Angles of incidence at which the terms are found; outside of them, those of the nearest are taken. Chosen.
ANGLES_DEG = np.linspace(30, 65, 8)
# Radii of the solids. Chosen: smaller ones have terms of second order, larger ones differ less from physical optics.
RADII_M = (0.2, 0.4)
# In the middle of the band; the terms fall as 1 / frequency.
FREQUENCY_HZ = 78e9
# Each antenna's distance from the specular point, as in the published rig.
DISTANCE_M = 0.86
# Solids: axis, and (curvature along the plane of incidence, across it, twist) of one with radius 1.
SOLIDS: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = (
    ((0.0, 1.0, 0.0), (1.0, 0.0, 0.0)),
    ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((1.0, 1.0, 0.0), (0.5, 0.5, -0.5)),
)
# Polarisations sent and received: 0 is s, 1 is p.
PAIRS = ((0, 0), (1, 1), (0, 1), (1, 0))


@dataclass(frozen=True)
class BendTerms:
    """Additions to the reflection coefficients, as functions of the angle of incidence, at `FREQUENCY_HZ`.

    `spline` gives them over the angle in degrees, real [4 rows, 4 coefficients, 2 parts]. The rows are for a plane, a
    curvature along, one across, and a twist (the last three times metres), the coefficients s to s, p to p, s to p and
    p to s.
    """

    spline: CubicSpline

    def evaluate(self, cos_incidence: NDArray, frequency_hz: float) -> NDArray:
        """Return complex [..., 4 rows, 4 coefficients] at these cosines."""
        angles = np.clip(np.degrees(np.arccos(cos_incidence)), ANGLES_DEG[0], ANGLES_DEG[-1])
        values = self.spline(angles)
        return (values[..., 0] + 1j * values[..., 1]) * (FREQUENCY_HZ / frequency_hz)


@lru_cache(maxsize=64)
def find_bend_terms(stack: Stack) -> BendTerms:
    """Return the terms of a half space or metal; `stack` has no layers."""
    slopes = []
    planes = []
    for axis, _ in SOLIDS:
        near, far = (_compare(stack, axis, radius_m) for radius_m in RADII_M)
        slope = (near - far) / (1 / RADII_M[0] - 1 / RADII_M[1])
        slopes.append(slope)
        planes.append(far - slope / RADII_M[1])
    # The slopes by 1 / radius of three solids s are sums over their curvatures r: solve for the slope by each of these,
    # at each angle a and for each coefficient c.
    curvatures = np.array([curvature for _, curvature in SOLIDS])
    by_curvature = np.einsum("rs,sac->arc", np.linalg.inv(curvatures), np.array(slopes))
    # Each solid gives the terms of a plane again. The third one's are left out as the least sure: it bends along both
    # directions.
    table = np.concatenate([np.mean(planes[:2], axis=0)[:, None], by_curvature], axis=1)
    # By symmetry, only a twist couples s and p, and it does nothing else.
    table[:, :3, 2:] = 0
    table[:, 3, :2] = 0
    return BendTerms(CubicSpline(ANGLES_DEG, np.stack([np.real(table), np.imag(table)], axis=-1)))


def _compare(stack: Stack, axis: tuple[float, float, float], radius_m: float) -> NDArray:
    """Return (series minus physical optics) / amplitude of the ray for a cylinder, complex [angle, 4 as of `PAIRS`].

    The cylinder has the given `axis`, and its front is at the origin, the specular point.
    """
    sines = np.sin(np.radians(ANGLES_DEG))
    cosines = np.cos(np.radians(ANGLES_DEG))
    # 10 m are endless here.
    shape = cylinder("solid", stack, (0.0, 0.0, radius_m), radius_m, 10.0, axis=axis)
    s_axis = np.array([0.0, 1.0, 0.0])
    optics = []
    spreads = []
    columns = []
    for sine, cosine in zip(sines, cosines, strict=True):
        # The plane of incidence is y = 0, the specular point the origin; p axes as of `optics.respond`.
        tx_way = np.array([-sine, 0.0, -cosine])
        rx_way = np.array([sine, 0.0, -cosine])
        axes = (s_axis, np.cross(s_axis, -tx_way)), (s_axis, np.cross(rx_way, s_axis))
        tx_m = DISTANCE_M * tx_way[:, None]
        rx_m = DISTANCE_M * rx_way[:, None]
        specular = find_specular(shape, tx_m, rx_m)
        patch = shape.evaluate(*specular)
        path = follow_path(patch, tx_m, rx_m)
        # Dipoles, whose polarisation in the specular direction is the given one.
        for sent, received in PAIRS:
            tx = Antenna(tx_m[:, 0], -tx_way, axes[0][sent], 0.0, is_dipole=True)
            rx = Antenna(rx_m[:, 0], -rx_way, axes[1][received], 0.0, is_dipole=True)
            arguments = (shape, tx, rx, np.array([FREQUENCY_HZ]), np.zeros((1, 3)), specular)
            optics.append(sum_window(*arguments)[0, 0])
            spreads.append(spread_of_ray(patch, path, tx_m, rx_m)[0])
            centre_m = np.asarray(shape.place_m)
            columns.append((tx.position - centre_m, rx.position - centre_m, tx.polarisation, rx.polarisation))
    # In the cylinder's own coordinates: x is along it.
    pair = Pair(*(np.array(part).T for part in zip(*columns, strict=True))).rotate(shape.axes)
    # The specular path in the cross-section: the whole path without its part along the cylinder.
    path_m = np.sqrt((2 * DISTANCE_M) ** 2 - (pair.rx_m[0] - pair.tx_m[0]) ** 2)
    medium = None if stack.is_metal else stack.below
    series = scatter_cylinder(pair, radius_m, medium, FREQUENCY_HZ, path_m)
    # Remove the phase of the specular path, which `sum_window` leaves out.
    series = series * np.exp(2j * np.pi * FREQUENCY_HZ / LIGHT_M_PER_S * 2 * DISTANCE_M)
    return ((series - np.array(optics)) / np.array(spreads)).reshape(len(ANGLES_DEG), len(PAIRS))
