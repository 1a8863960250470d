"""What the spacing of positions lets through: the alias-free field, and the zone a mirror needs around itself.

TX and RX move together, so an echo's phase slope against stage offset, `k (sin a_tx + sin a_rx)`, depends only on where
the object lies relative to the stage. Samples `d` apart cannot tell slopes that differ by `2 pi / d`: an object has a
ghost where its slope is that much more or less. The nearest ghost counts, seen from the middle half of the aperture;
what the rest adds to it is tapered.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from polysight.host.imaging import Antennas
from polysight.shared.config import Instrument
from polysight.shared.geometry import specular_midpoint_m
from polysight.shared.units import SPEED_OF_LIGHT_M_S

_STEP_M = 1e-4  # of the numerical derivative
_FARTHEST_M = 20.0
_PRECISION_M = 1e-6
_PLACES = 5


@dataclass(frozen=True)
class FieldLimits:
    """For (x, y), millimetres.

    Attributes
    ----------
    alias_free_mm
        Distance from an object to its nearest ghost, at the highest frequency; infinite where there is none.
    mirror_zone_mm
        Radius of the first Fresnel zone: how far the aperture should reach beyond a flat plate on every side.
    slope_rad_per_mm2
        Change of the echo's phase slope with the object's place, in the middle, at the mean frequency.
    """

    alias_free_mm: tuple[float, float]
    mirror_zone_mm: tuple[float, float]
    slope_rad_per_mm2: tuple[float, float]


class PhaseSlope:
    """Phase slope of an echo against stage offset along an axis, for the board that makes H, rad/m."""

    def __init__(self, rig: Instrument, axis: int) -> None:
        self._antennas = Antennas.of(rig, rig.receivers[0])
        self._middle = np.array(specular_midpoint_m(rig, rig.receivers[0]))
        self._axis = axis

    def at(self, place_m: float, frequency_hz: float) -> float:
        """Of an object so far from the specular midpoint along the axis."""
        point = self._middle.copy()
        point[self._axis] += place_m
        total = 0.0
        for antenna in (self._antennas.tx_m, self._antennas.rx_m[0]):
            away = point - antenna
            total += float(away[self._axis] / np.linalg.norm(away))
        return 2 * np.pi * frequency_hz / SPEED_OF_LIGHT_M_S * total


def field_limits(rig: Instrument) -> FieldLimits:
    """Limits of a rig's grid."""
    chirp, grid = rig.chirp, rig.grid
    low, high = (chirp.first_sample_hz + n * chirp.hz_per_sample for n in chirp.linear_samples)
    free, zone, slopes = [], [], []
    for axis, step_mm in enumerate((grid.step_x_mm, grid.step_y_mm)):
        slope = PhaseSlope(rig, axis)
        change = (slope.at(_STEP_M, (low + high) / 2) - slope.at(-_STEP_M, (low + high) / 2)) / (2 * _STEP_M)
        slopes.append(change * 1e-6)
        zone.append(1e3 * np.sqrt(2 * np.pi / change))
        size_m = ((grid.columns, grid.rows)[axis] - 1) * step_mm / 1e3
        places = np.linspace(-size_m / 4, size_m / 4, _PLACES)
        free.append(1e3 * min(_nearest_ghost_m(slope, high, 2e3 * np.pi / step_mm, p) for p in places))
    return FieldLimits((free[0], free[1]), (float(zone[0]), float(zone[1])), (slopes[0], slopes[1]))


def _nearest_ghost_m(slope: PhaseSlope, frequency_hz: float, difference_rad_per_m: float, around_m: float) -> float:
    """Distance over which the slope changes by so much, half of it on either side of a place."""

    def short_by(distance_m: float) -> float:
        far, near = (slope.at(around_m + side * distance_m / 2, frequency_hz) for side in (1, -1))
        return far - near - difference_rad_per_m

    if short_by(_FARTHEST_M) < 0:
        return float("inf")
    near, far = 0.0, _FARTHEST_M
    while far - near > _PRECISION_M:  # halved: scipy.optimize would load for longer than all of the plan takes
        middle = (near + far) / 2
        near, far = (near, middle) if short_by(middle) >= 0 else (middle, far)
    return far
