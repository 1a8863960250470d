"""What a plate's tilt does to its images, and how to take it out.

A flat plate is seen where it mirrors TX to RX: from the stage position whose specular point on the object plane is the
pixel. A plate that rises by s (radians, along x and y) is seen from elsewhere, as the object plane is a distance

    d = H^-1 C s        H = d2 (r1 + r2) / dx dy,   C = cos of TX's leg + cos of RX's leg to the plane's normal

away: with e1, e2 the directions of both legs, mirroring asks (e1 + e2)_xy + s (e1 + e2)_z = 0, and (e1 + e2)_xy grows
with H from the specular point. There the aperture weighs differently, and for H and V differently, whose specular
points lie apart: 2.5 % of V / H a degree on the published rig (simulated). So a pixel of a tilted plate is divided by
the mirror's footprint `d` away. The tilt itself is in the image: its phase grows by k C s a metre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.host.imaging.geometry import Antennas
from polysight.shared.units import SPEED_OF_LIGHT_M_S

Rise = tuple[float, float]
"""Growth of a plate's height along x and along y."""
MOST_RISE = 0.06
"""Beyond this (3.4 degrees) a phase slope is no plate's tilt."""
LEAST_ACROSS = 2e-3
"""Below this (0.11 degrees) it is a neighbour's sidelobe as likely as a tilt: nothing is corrected."""
_COHERENT = 0.5
"""Neighbouring pixels' phase steps must agree so far (1: all the same)."""
_MOST_CHANGE = 2.0
"""Factor by which a footprint may differ from its neighbour's `d` away: beyond, the plate is seen past the aperture."""


@dataclass(frozen=True)
class Illumination:
    """How both channels light the object plane.

    Attributes
    ----------
    footprints
        complex64 [2, ny, nx]: the image of a uniform mirror, H and V.
    moved_m
        float64 [2, 2, 2]: `d` of each channel (x, y) for a rise of 1 along x and along y, metres.
    steepness_rad_m
        float64 [2]: growth of the phase, radians a metre, for a rise of 1.
    pixel_m
        Pitch of the pixels along x and y.
    """

    footprints: NDArray[np.complex64]
    moved_m: NDArray[np.float64]
    steepness_rad_m: NDArray[np.float64]
    pixel_m: tuple[float, float]

    @property
    def across(self) -> int:
        """The axis across the plane of incidence, 0 (x) or 1 (y): there a rise moves the specular point least."""
        return int(np.argmin(np.abs(np.diagonal(self.moved_m.mean(axis=0)))))

    def transposed(self) -> Illumination:
        """The same with x and y swapped."""
        turned = np.ascontiguousarray(self.footprints.transpose(0, 2, 1))
        return replace(self, footprints=turned, moved_m=self.moved_m[:, ::-1, ::-1], pixel_m=self.pixel_m[::-1])

    def rise(self, h: NDArray[np.complexfloating], v: NDArray[np.complexfloating], mask: NDArray[np.bool_]) -> Rise:
        """Rise of a patch along x and y, radians, from its phase; zero where the phase tells none.

        `h`, `v` complex [ny, nx] are reflectivities (conjugates of the samples), `mask` bool [ny, nx] the patch's
        inside.
        """
        out = []
        for along in (0, 1):
            # The conjugate's phase falls where the plate rises.
            step = sum(np.conj(_step(channel, mask, 1 - along)) for channel in (h, v)) / 2
            slope = float(np.angle(step)) / self.pixel_m[along] / float(self.steepness_rad_m.mean())
            out.append(slope if abs(step) > _COHERENT and abs(slope) < MOST_RISE else 0.0)
        return out[0], out[1]

    def to_level(self, mask: NDArray[np.bool_], rise: Rise) -> NDArray[np.float64]:
        """Factors [2, n] that bring H and V of a patch's pixels to what a level plate shows there.

        Of the footprint's magnitude: its phase ripples with the rows of the grid. And for the rise across the plane of
        incidence alone: along it H and V are lit alike (|H| changes by some 7 % a degree), and the phase tells less:
        plates at the sides of the image seem to rise by up to 0.3 degrees, of a narrow aperture by 0.8.
        """
        slope = rise[self.across]
        if abs(slope) < LEAST_ACROSS:
            return np.ones((2, int(mask.sum())))
        return np.stack([self._change(k, mask, self.moved_m[k][:, self.across] * slope) for k in (0, 1)])

    def _change(self, channel: int, mask: NDArray[np.bool_], moved_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """A channel's footprint at a patch's pixels over that so far away, [n]; 1 where the light ends between."""
        rows, columns = np.nonzero(mask)
        level = np.abs(self.footprints[channel])
        at = np.stack([rows + moved_m[1] / self.pixel_m[1], columns + moved_m[0] / self.pixel_m[0]])
        with np.errstate(divide="ignore", invalid="ignore"):
            change = level[rows, columns] / scipy.ndimage.map_coordinates(level, at, order=1, mode="nearest")
        return np.where((change > 1 / _MOST_CHANGE) & (change < _MOST_CHANGE), change, 1.0)


def illumination_geometry(antennas: Antennas, z_m: float, frequency_hz: float) -> tuple[NDArray[np.float64], float]:
    """Of one board at its specular point on the plane at `z_m`: `d` a rise [2, 2], metres; radians a metre a rise."""
    tx, rx = antennas.tx_m, antennas.rx_m.mean(axis=0)
    z_tx, z_rx = z_m - tx[2], z_m - rx[2]
    point = np.append((tx[:2] * z_rx + rx[:2] * z_tx) / (z_tx + z_rx), z_m)
    bend, cosines = np.zeros((2, 2)), 0.0
    for place in (tx, rx):
        leg = point - place
        r = float(np.linalg.norm(leg))
        e = leg / r
        bend += (np.eye(2) - np.outer(e[:2], e[:2])) / r
        cosines += float(e[2])
    wave = 2 * np.pi * frequency_hz / SPEED_OF_LIGHT_M_S
    return np.asarray(np.linalg.inv(bend) * cosines, np.float64), wave * cosines


def levelled(
    h: NDArray[np.complexfloating],
    v: NDArray[np.complexfloating],
    lit: Illumination,
    masks: Sequence[NDArray[np.bool_]],
    rises: Sequence[Rise],
) -> tuple[NDArray[np.complexfloating], NDArray[np.complexfloating]]:
    """Both channels with every patch as a level plate would show it; the rest as it is."""
    out = (h.copy(), v.copy())
    for mask, rise in zip(masks, rises, strict=True):
        for channel, factor in zip(out, lit.to_level(mask, rise), strict=True):
            channel[mask] *= factor
    return out


def _step(image: NDArray[np.complexfloating], mask: NDArray[np.bool_], axis: int) -> complex:
    """Mean step of the phase from pixel to pixel inside a patch, as exp(j step) times how well the steps agree."""
    inside = np.where(mask & np.isfinite(image), image, 0).astype(np.complex128)
    ahead, behind = (np.take(inside, range(k, inside.shape[axis] - 1 + k), axis) for k in (1, 0))
    product = ahead * np.conj(behind)
    return complex(product.sum()) / max(float(np.abs(product).sum()), 1e-300)
