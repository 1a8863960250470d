"""The angle of incidence behind each pixel.

For a plane parallel to the stage the radars move past a mirror: at every stage offset the reflection happens at the
specular point of that offset, which is always seen under the same angle. A pixel is bright exactly when it is that
point, so its angle is that of the specular midpoint, everywhere (:func:`incidence_map`).

The image of a pixel also gathers offsets around its specular one, about one Fresnel zone to each side, under slightly
different angles; near the border of the scanned aperture only part of that zone was visited.
:func:`effective_incidence_map` weights the local bistatic angle over the part that was.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import scipy

from polysight.shared.config import Instrument
from polysight.shared.geometry import rx_positions_m, specular_midpoint_m, tx_position_m
from polysight.shared.units import SPEED_OF_LIGHT_M_S

Real = npt.NDArray[np.float64]
Incidence = Literal["one", "pixel"]
"""One angle for the image (the specular one), or each pixel's own (:func:`effective_incidence_map`)."""


def _half_bistatic(rig: Instrument, board_index: int, points_m: Real) -> tuple[Real, Real]:
    """Half the angle TX-point-RX1 in radians, and the path TX-point-RX1 in metres, for points [..., 3]."""
    a = np.asarray(tx_position_m(rig)) - points_m
    b = np.asarray(rx_positions_m(rig, rig.receivers[board_index])[0]) - points_m
    na, nb = np.linalg.norm(a, axis=-1), np.linalg.norm(b, axis=-1)
    cosine = np.sum(a * b, axis=-1) / (na * nb)
    return np.arccos(np.clip(cosine, -1.0, 1.0)) / 2, na + nb


def specular_incidence_rad(rig: Instrument) -> float:
    """Incidence angle at the specular midpoints, mean of H and V (they differ by hundredths of a degree), radians."""
    angles = []
    for i, board in enumerate(rig.receivers):
        angle, _ = _half_bistatic(rig, i, np.asarray(specular_midpoint_m(rig, board)))
        angles.append(float(angle))
    return float(np.mean(angles))


def incidence_map(rig: Instrument, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> Real:
    """Incidence angle of each pixel of a plane parallel to the stage, radians, float64 [ny, nx].

    Constant: every pixel is bright where it is the specular point (see the module's text). Given as a map so that a
    tilted plane or :func:`effective_incidence_map` fit the same place.
    """
    return np.full((np.size(y_m), np.size(x_m)), specular_incidence_rad(rig))


def effective_incidence_map(rig: Instrument, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> Real:
    """Incidence angle of each pixel, weighted over the stage offsets that were visited; radians, float64 [ny, nx].

    The weight of offset u for pixel v is exp(-(k D)^2 / 8) with k D the phase by which the path at u exceeds the
    specular one: 1 at the specular offset, falling to about 0.3 at the edge of the first Fresnel zone (k D = pi). H
    and V are averaged. Where no visited offset carries weight the specular angle stands.

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
    # Half of the first Fresnel zone along x, sqrt(lambda z / (2 cos^3)), is its longest: reach twice as far.
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
    """Full linear convolution of two images; scipy.signal has it too, and loads scipy.stats with it for a second."""
    shape = [m + n - 1 for m, n in zip(a.shape, b.shape, strict=True)]
    fast = [scipy.fft.next_fast_len(n, real=True) for n in shape]
    both = scipy.fft.rfft2(a, fast) * scipy.fft.rfft2(b, fast)
    return np.asarray(scipy.fft.irfft2(both, fast), np.float64)[: shape[0], : shape[1]]


@dataclass(frozen=True)
class IncidenceChoice:
    """Both angles of every pixel, float64 [ny, nx] radians, and which of them is used."""

    choice: Incidence
    one_rad: Real
    pixel_rad: Real

    @property
    def used_rad(self) -> Real:
        """The one that was chosen."""
        return self.one_rad if self.choice == "one" else self.pixel_rad

    @property
    def other_rad(self) -> Real:
        """The one that was not."""
        return self.pixel_rad if self.choice == "one" else self.one_rad

    def facts(self, valid: npt.NDArray[np.bool_]) -> dict[str, Any]:
        """How far they are apart over the valid pixels, for quality.json; degrees."""
        pixel = np.degrees(self.pixel_rad[valid]) if valid.any() else np.degrees(self.pixel_rad).ravel()
        one = float(np.degrees(self.one_rad.flat[0]))
        return {
            "used": "one number for the image" if self.choice == "one" else "by pixel",
            "one_deg": round(one, 4),
            "pixel_deg": [round(float(q), 4) for q in (pixel.min(), np.median(pixel), pixel.max())],
            "largest_difference_deg": round(float(np.abs(pixel - one).max()), 4),
        }


def incidence_choice(rig: Instrument, x_m: npt.ArrayLike, y_m: npt.ArrayLike, choice: Incidence) -> IncidenceChoice:
    """One number for the image and each pixel's own angle, of which `choice` is to be used."""
    return IncidenceChoice(choice, incidence_map(rig, x_m, y_m), effective_incidence_map(rig, x_m, y_m))
