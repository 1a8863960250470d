"""Limits of the field of view: the alias-free field for a step size, and the mirror zone around flat plates.

TX and RX move together, so an echo's phase slope against stage offset, `k (sin a_tx + sin a_rx)`, depends only on the
object's place relative to the stage. Samples `d` apart cannot distinguish slopes that differ by `2 pi / d`: an object
has a ghost where its slope differs by that much. The nearest ghost counts, seen from the middle half of the aperture,
because the taper suppresses the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from polysight.imaging import Antennas
from polysight_shared.config import Instrument
from polysight_shared.geometry import specular_midpoint_m
from polysight_shared.units import SPEED_OF_LIGHT_M_S

_STEP_M = 1e-4  # of the numerical derivative
_MAX_DISTANCE_M = 20.0
_PRECISION_M = 1e-6
_PLACES = 5


@dataclass(frozen=True)
class FieldLimits:
    """Limits for (x, y).

    Attributes
    ----------
    alias_free_mm
        Distance from an object to its nearest ghost at the highest frequency; infinite if there is none.
    mirror_zone_mm
        Radius of the first Fresnel zone: the margin of aperture that a flat plate needs on every side.
    """

    alias_free_mm: tuple[float, float]
    mirror_zone_mm: tuple[float, float]


class PhaseSlope:
    """Phase slope of an echo against stage offset along an axis (0: x, 1: y) for the H receiver, rad/m."""

    def __init__(self, rig: Instrument, axis: int) -> None:
        self._antennas = Antennas.of(rig, rig.receivers[0])
        self._middle = np.array(specular_midpoint_m(rig, rig.receivers[0]))
        self._axis = axis

    def at(self, place_m: float, frequency_hz: float) -> float:
        """Return the slope for an object at this distance from the specular midpoint along the axis."""
        point = self._middle.copy()
        point[self._axis] += place_m
        total = 0.0
        for antenna in (self._antennas.tx_m, self._antennas.rx_m[0]):
            offset = point - antenna
            total += float(offset[self._axis] / np.linalg.norm(offset))
        return 2 * np.pi * frequency_hz / SPEED_OF_LIGHT_M_S * total


def field_limits(rig: Instrument) -> FieldLimits:
    """Compute the limits for a rig's grid."""
    chirp, grid = rig.chirp, rig.grid
    low, high = (chirp.first_sample_hz + n * chirp.hz_per_sample for n in chirp.linear_samples)
    free, zone = [], []
    for axis, (count, step_mm) in enumerate(((grid.columns, grid.step_x_mm), (grid.rows, grid.step_y_mm))):
        slope = PhaseSlope(rig, axis)
        change = (slope.at(_STEP_M, (low + high) / 2) - slope.at(-_STEP_M, (low + high) / 2)) / (2 * _STEP_M)
        zone.append(1e3 * float(np.sqrt(2 * np.pi / change)))
        size_m = (count - 1) * step_mm / 1e3
        places = np.linspace(-size_m / 4, size_m / 4, _PLACES)
        free.append(1e3 * min(_nearest_ghost_m(slope, high, 2e3 * np.pi / step_mm, p) for p in places))
    return FieldLimits((free[0], free[1]), (zone[0], zone[1]))


def _nearest_ghost_m(slope: PhaseSlope, frequency_hz: float, difference_rad_per_m: float, centre_m: float) -> float:
    """Distance between two places around `centre_m` whose slopes differ by `difference_rad_per_m`."""

    def too_far(distance_m: float) -> bool:
        far, near = (slope.at(centre_m + side * distance_m / 2, frequency_hz) for side in (1, -1))
        return far - near >= difference_rad_per_m

    if not too_far(_MAX_DISTANCE_M):
        return float("inf")
    near, far = 0.0, _MAX_DISTANCE_M
    while far - near > _PRECISION_M:  # bisection: importing scipy.optimize takes longer than the whole forecast
        middle = (near + far) / 2
        near, far = (near, middle) if too_far(middle) else (middle, far)
    return far
