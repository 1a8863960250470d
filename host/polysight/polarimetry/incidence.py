"""Incidence angle of each pixel.

A plane parallel to the stage reflects like a mirror: at every stage offset the reflection comes from the specular
point, under the same angle. So all pixels have the incidence angle of the specular midpoint.

The image of a pixel also contains stage offsets within about one Fresnel zone of the specular one, with slightly
different angles; near the border of the aperture only part of that zone was scanned. :func:`effective_incidence_map`
averages the bistatic angle over the scanned part.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import scipy

from polysight_shared.config import Instrument
from polysight_shared.geometry import rx_positions_m, specular_midpoint_m, tx_position_m
from polysight_shared.units import SPEED_OF_LIGHT_M_S

Real = npt.NDArray[np.float64]
Incidence = Literal["one", "pixel"]
"""One angle for the image (specular), or one per pixel (:func:`effective_incidence_map`)."""


def _half_bistatic(rig: Instrument, board_index: int, points_m: Real) -> tuple[Real, Real]:
    """Return half the angle TX-point-RX1 (radians) and the path TX-point-RX1 (metres) for points [..., 3]."""
    a = np.asarray(tx_position_m(rig)) - points_m
    b = np.asarray(rx_positions_m(rig, rig.receivers[board_index])[0]) - points_m
    na, nb = np.linalg.norm(a, axis=-1), np.linalg.norm(b, axis=-1)
    cosine = np.sum(a * b, axis=-1) / (na * nb)
    return np.arccos(np.clip(cosine, -1.0, 1.0)) / 2, na + nb


def specular_incidence_rad(rig: Instrument) -> float:
    """Return the incidence angle at the specular midpoint, radians; mean of H and V, which differ by 0.01 degrees."""
    angles = []
    for i, board in enumerate(rig.receivers):
        angle, _ = _half_bistatic(rig, i, np.asarray(specular_midpoint_m(rig, board)))
        angles.append(float(angle))
    return float(np.mean(angles))


def effective_incidence_map(rig: Instrument, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> Real:
    """Return the incidence angle of each pixel, averaged over the scanned stage offsets; radians, float64 [ny, nx].

    The weight of offset u for a pixel is exp(-(k D)^2 / 8), where k D is the phase of the path at u minus that of the
    specular path: 1 at the specular offset, about 0.3 at the edge of the first Fresnel zone (k D = pi). H and V are
    averaged. Pixels without any weight get the specular angle.

    Parameters
    ----------
    rig
        Geometry and grid.
    x_m, y_m
        Pixel centres, rig frame, metres; [nx] and [ny].
    """
    x, y = np.asarray(x_m, np.float64), np.asarray(y_m, np.float64)
    step = np.array([rig.grid.step_x_mm, rig.grid.step_y_mm]) / 1e3
    count = np.array([rig.grid.columns, rig.grid.rows])
    wavelength = SPEED_OF_LIGHT_M_S / (rig.chirp.first_sample_hz + rig.chirp.swept_hz / 2)
    # The first Fresnel zone is longest along x, half its length is sqrt(lambda z / (2 cos^3)); sum twice as far.
    zone = np.sqrt(wavelength * rig.geometry.object_distance_mm / 2e3 / np.cos(specular_incidence_rad(rig)) ** 3)
    reach = np.ceil(2 * zone / step).astype(int)
    dx, dy = (np.arange(-n, n + 1) * s for n, s in zip(reach, step, strict=True))
    visited = np.ones((count[1], count[0]))
    total = np.zeros((y.size, x.size))
    for i, board in enumerate(rig.receivers):
        middle = np.asarray(specular_midpoint_m(rig, board))
        points = np.empty((dy.size, dx.size, 3))
        points[..., 0], points[..., 1], points[..., 2] = middle[0] + dx[None, :], middle[1] + dy[:, None], middle[2]
        angle, path = _half_bistatic(rig, i, points)
        specular, shortest = _half_bistatic(rig, i, middle)
        weight = np.exp(-((2 * np.pi / wavelength * (path - shortest)) ** 2) / 8)
        deviation, mass = (_convolved(visited, one) for one in (weight * (angle - specular), weight))
        # Sample (row, column) of the full convolution is the pixel at offset + displacement from the midpoint.
        column = (x - middle[0]) / step[0] + (count[0] - 1) / 2 + reach[0]
        row = (y - middle[1]) / step[1] + (count[1] - 1) / 2 + reach[1]
        where = np.meshgrid(row, column, indexing="ij")
        num = scipy.ndimage.map_coordinates(deviation, where, order=1, mode="constant")
        den = scipy.ndimage.map_coordinates(mass, where, order=1, mode="constant")
        lit = den > 1e-3 * float(weight.sum())
        total += float(specular) + np.where(lit, num / np.where(lit, den, 1.0), 0.0)
    return total / len(rig.receivers)


def _convolved(a: Real, b: Real) -> Real:
    """Return the full linear convolution of two images; scipy.signal would load scipy.stats, which takes a second."""
    shape = [m + n - 1 for m, n in zip(a.shape, b.shape, strict=True)]
    fast = [scipy.fft.next_fast_len(n, real=True) for n in shape]
    both = scipy.fft.rfft2(a, fast) * scipy.fft.rfft2(b, fast)
    return np.asarray(scipy.fft.irfft2(both, fast), np.float64)[: shape[0], : shape[1]]


@dataclass(frozen=True)
class IncidenceChoice:
    """Specular and effective incidence angle of every pixel, float64 [ny, nx] radians, and the one to use."""

    choice: Incidence
    one_rad: Real
    pixel_rad: Real

    @property
    def used_rad(self) -> Real:
        """The chosen angles."""
        return self.one_rad if self.choice == "one" else self.pixel_rad

    @property
    def other_rad(self) -> Real:
        """The other angles."""
        return self.pixel_rad if self.choice == "one" else self.one_rad

    def facts(self, valid: npt.NDArray[np.bool_]) -> dict[str, Any]:
        """Return both angles and their largest difference over valid pixels, for quality.json; degrees."""
        pixel = np.degrees(self.pixel_rad[valid]) if valid.any() else np.degrees(self.pixel_rad).ravel()
        one = float(np.degrees(self.one_rad.flat[0]))
        return {
            "used": "one number for the image" if self.choice == "one" else "by pixel",
            "one_deg": round(one, 4),
            "pixel_deg": [round(float(q), 4) for q in (pixel.min(), np.median(pixel), pixel.max())],
            "largest_difference_deg": round(float(np.abs(pixel - one).max()), 4),
        }


def incidence_choice(rig: Instrument, x_m: npt.ArrayLike, y_m: npt.ArrayLike, choice: Incidence) -> IncidenceChoice:
    """Compute both kinds of incidence angles; `choice` is the one to use."""
    pixel_rad = effective_incidence_map(rig, x_m, y_m)
    return IncidenceChoice(choice, np.full(pixel_rad.shape, specular_incidence_rad(rig)), pixel_rad)
