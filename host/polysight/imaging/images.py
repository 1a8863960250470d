"""Images of both channels, and the effect of tilted plates on them.

`Images` is what every later step reads and returns: imaging forms it, polarimetry adds metal reference and ratio.

A flat plate is visible where it reflects TX into RX: from the stage position whose specular point on the object plane
is the pixel. A plate that rises by s (radians, along x and y) is visible from other positions, like the object plane at
a distance

    d = H^-1 C s        H = d2 (r1 + r2) / dx dy,   C = cos of TX's leg + cos of RX's leg to the plane's normal

away: with the directions e1, e2 of both legs, specular reflection requires (e1 + e2)_xy + s (e1 + e2)_z = 0, and
(e1 + e2)_xy grows with H from the specular point. There the aperture has another weight, which differs between H and V
because their specular points differ: 2.5 % of V / H per degree on the published rig (simulated). So a pixel of a
tilted plate is divided by the mirror's footprint `d` away. The tilt follows from the image: its phase grows by k C s
per metre.

Settings that the gains of an image depend on; a metal reference is used only for images with the same settings.

Samples are referenced to the direct path, and images are divided by the footprint of an ideal mirror. The remaining
gains in the image of a metal plate come from antenna patterns, position errors and edges. They depend on position and
orientation of the antennas, object plane, frequencies, window over the aperture, and assumed high-pass filters. They do
not depend on settings that cancel:

* receiver and transmitter gain, start frequencies, triggers, crystals, power cycles: equal for direct path and echo;
* raster, masked positions, pulses of a burst: contained in the footprint;
* leakage: a property of the receivers, equal for plate and scene, and corrected after the division;
* speckle filter: applied later.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

import msgspec
import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.imaging.geometry import Antennas
from polysight.sync import HighPass, high_pass
from polysight_shared.config import Board, Instrument
from polysight_shared.geometry import Vector, place
from polysight_shared.units import SPEED_OF_LIGHT_M_S

Image = NDArray[np.complexfloating]
Mask = NDArray[np.bool_]
Rise = tuple[float, float]
"""Growth of a plate's height along x and along y."""
MAX_RISE = 0.06
"""Largest tilt of a plate (3.4 degrees); a steeper phase has another cause."""
MIN_RISE = 2e-3
"""Smallest tilt that is corrected (0.11 degrees); smaller ones may come from sidelobes of neighbours."""
_COHERENT = 0.5
"""Smallest coherence of the phase steps between pixels (1: all equal)."""
_MAX_CHANGE = 2.0
"""Largest change of the footprint over the distance `d`; a larger one occurs only at the edge of the aperture."""

SAME_MM = 1e-3
"""Tolerance of positions: 2e-3 rad of an echo's phase."""
SAME_HZ = 1e3
SAME_CORNER_KHZ = 10.0
"""Tolerance of filter corners: less than 0.1 dB and 0.1 degrees between direct path and echo, in both channels."""
ARM_MM = 100.0
"""Points at this distance along a board's x and y show its rotation, which antennas in one line do not."""


@dataclass(frozen=True)
class Illumination:
    """Illumination of the object plane by both channels.

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
        """Axis across the plane of incidence, 0 (x) or 1 (y), where a rise moves the specular point least."""
        return int(np.argmin(np.abs(np.diagonal(self.moved_m.mean(axis=0)))))

    def transposed(self) -> Illumination:
        """Return the illumination with x and y swapped."""
        turned = np.ascontiguousarray(self.footprints.transpose(0, 2, 1))
        return replace(self, footprints=turned, moved_m=self.moved_m[:, ::-1, ::-1], pixel_m=self.pixel_m[::-1])

    def rise(self, h: Image, v: Image, mask: Mask) -> Rise:
        """Estimate the rise of a patch along x and y from its phase, radians; zero if undetermined.

        `h`, `v` complex [ny, nx] are reflectivities (conjugates of the samples), `mask` bool [ny, nx] is the inside of
        the patch.
        """
        out = []
        for along in (0, 1):
            # The phase of the conjugate falls where the plate rises.
            step = sum(np.conj(_step(channel, mask, 1 - along)) for channel in (h, v)) / 2
            slope = float(np.angle(step)) / self.pixel_m[along] / float(self.steepness_rad_m.mean())
            out.append(slope if abs(step) > _COHERENT and abs(slope) < MAX_RISE else 0.0)
        return out[0], out[1]

    def to_level(self, mask: Mask, rise: Rise) -> NDArray[np.float64]:
        """Return factors [2, n] that convert H and V of a patch's pixels to those of a level plate.

        They use only the magnitude of the footprint, for its phase ripples with the rows of the grid; and only the rise
        across the plane of incidence. Along it, H and V are illuminated equally (|H| changes by 7 % per degree), and
        the phase is less reliable: plates at the sides of the image seem to rise by up to 0.3 degrees (0.8 degrees
        with a narrow aperture).
        """
        slope = rise[self.across]
        if abs(slope) < MIN_RISE:
            return np.ones((2, int(mask.sum())))
        return np.stack([self._change(k, mask, self.moved_m[k][:, self.across] * slope) for k in (0, 1)])

    def _change(self, channel: int, mask: Mask, moved_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the footprint at a patch's pixels divided by that `moved_m` away, [n]; 1 beyond the aperture."""
        rows, columns = np.nonzero(mask)
        level = np.abs(self.footprints[channel])
        at = np.stack([rows + moved_m[1] / self.pixel_m[1], columns + moved_m[0] / self.pixel_m[0]])
        with np.errstate(divide="ignore", invalid="ignore"):
            change = level[rows, columns] / scipy.ndimage.map_coordinates(level, at, order=1, mode="nearest")
        return np.where((change > 1 / _MAX_CHANGE) & (change < _MAX_CHANGE), change, 1.0)


@dataclass(frozen=True)
class Images:
    """Both channels on one grid; what is added on the way is None before. Row 0 is the smallest y.

    Attributes
    ----------
    h, v
        complex [ny, nx]: reflectivity with the sign convention of the Fresnel coefficients (time dependence
        exp(+j omega t)), 0 where not valid: the conjugate of the image divided by the footprint. The conjugate is
        needed because samples have the phase +2 pi f tau, while a delayed wave has exp(-j 2 pi f tau). Each channel
        contains a constant gain until it is divided by metal.
    x_m, y_m
        float64 [nx], [ny]: pixel centres in the rig frame.
    valid
        bool [ny, nx]: pixels illuminated in both channels (and where the metal reference is valid).
    p
        complex [ny, nx]: h / v; NaN where v is zero.
    p_sigma
        float32 [ny, nx]: standard deviation of the complex p; NaN where unknown.
    metal_h, metal_v
        Metal by which h and v were divided: complex numbers, or images [ny, nx] of a reference over the whole plane.
        Then |h| = |v| = 1 on metal, and their phase difference is zero there.
    h_raw, v_raw
        complex64 [ny, nx]: the images before the footprint was divided out, with the phase of the samples.
    illumination
        Illumination of the plane by both channels, to correct tilted plates.
    rx_gains
        Board name to complex128 [rx]: gain of each RX, from the direct path, which was divided out.
    notices
        Notices for the user, for example of slow imaging.
    """

    h: Image
    v: Image
    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    valid: Mask
    p: Image | None = None
    p_sigma: NDArray[np.floating] | None = None
    metal_h: complex | Image | None = None
    metal_v: complex | Image | None = None
    h_raw: Image | None = None
    v_raw: Image | None = None
    illumination: Illumination | None = None
    rx_gains: Mapping[str, NDArray[np.complex128]] = field(default_factory=dict)
    notices: tuple[str, ...] = ()

    @property
    def usable(self) -> Mask:
        """Pixels that are valid and finite in both channels, bool [ny, nx]."""
        return self.valid & np.isfinite(self.h) & np.isfinite(self.v)

    def within(self, area: Mask) -> Images:
        """Return the images, valid only inside `area`, bool [ny, nx]."""
        return replace(self, valid=self.valid & area)

    def transposed(self) -> Images:
        """Return the images with x and y swapped."""
        turned = {
            f.name: np.ascontiguousarray(value.T)
            for f in fields(self)
            if isinstance(value := getattr(self, f.name), np.ndarray) and value.ndim == 2
        }
        illumination = None if self.illumination is None else self.illumination.transposed()
        return replace(self, **turned, x_m=self.y_m, y_m=self.x_m, illumination=illumination)

    def level(self, plate: Mask) -> Images:
        """Return the images with the tilt of one plate, bool [ny, nx], corrected."""
        if self.illumination is None:
            return self
        return correct_tilt(self, [plate], [self.illumination.rise(self.h, self.v, plate)])


def illumination_geometry(antennas: Antennas, z_m: float, frequency_hz: float) -> tuple[NDArray[np.float64], float]:
    """Return `moved_m` [2, 2] and `steepness_rad_m` of a board at its specular point on the plane at `z_m`."""
    tx, rx = antennas.tx_m, antennas.rx_m.mean(axis=0)
    z_tx, z_rx = z_m - tx[2], z_m - rx[2]
    point = np.append((tx[:2] * z_rx + rx[:2] * z_tx) / (z_tx + z_rx), z_m)
    bend, cosines = np.zeros((2, 2)), 0.0
    for antenna in (tx, rx):
        leg = point - antenna
        r = float(np.linalg.norm(leg))
        e = leg / r
        bend += (np.eye(2) - np.outer(e[:2], e[:2])) / r
        cosines += float(e[2])
    wave = 2 * np.pi * frequency_hz / SPEED_OF_LIGHT_M_S
    return np.asarray(np.linalg.inv(bend) * cosines, np.float64), wave * cosines


def correct_tilt(images: Images, masks: Sequence[Mask], rises: Sequence[Rise]) -> Images:
    """Return the images with the tilt of every patch corrected; other pixels are unchanged.

    Without the illumination of the plane the images are returned unchanged.
    """
    if images.illumination is None:
        return images
    h = images.h.copy()
    v = images.v.copy()
    for mask, rise in zip(masks, rises, strict=True):
        factor_h, factor_v = images.illumination.to_level(mask, rise)
        h[mask] *= factor_h
        v[mask] *= factor_v
    return replace(images, h=h, v=v)


def _step(image: Image, mask: Mask, axis: int) -> complex:
    """Return exp(j mean phase step between pixels of a patch) times the coherence of the steps."""
    inside = np.where(mask & np.isfinite(image), image, 0).astype(np.complex128)
    ahead, behind = (np.take(inside, range(k, inside.shape[axis] - 1 + k), axis) for k in (1, 0))
    product = ahead * np.conj(behind)
    return complex(product.sum()) / max(float(np.abs(product).sum()), 1e-300)


class ImagedWith(msgspec.Struct, frozen=True, kw_only=True):
    """Settings that a pair of images was made with, as plain numbers.

    Attributes
    ----------
    places_mm
        By board, rig frame: antennas in use, then two points along the board's x and y.
    object_distance_mm
        z of the image plane.
    band_hz
        Transmit frequency at the first and last linear sample.
    samples
        Number of linear samples.
    apodisation
        Window over the aperture, by its name in the rig file.
    high_pass_khz
        Corners of the compensated filters, by receiver.
    """

    places_mm: dict[str, list[Vector]]
    object_distance_mm: float
    band_hz: tuple[float, float]
    samples: int
    apodisation: str
    high_pass_khz: dict[str, list[float]]

    @classmethod
    def of(cls, rig: Instrument, filters: Mapping[str, HighPass | None]) -> ImagedWith:
        """Return the settings of a calibrated rig; `filters` by receiver, None or missing: as in the chirp profile."""
        chirp = rig.chirp
        first, last = chirp.linear_samples
        boards = (rig.transmitter, *rig.receivers)
        models = {b.name: filters.get(b.name) or high_pass(chirp) for b in rig.receivers}
        return cls(
            places_mm={b.name: list(_places_mm(rig, b)) for b in boards},
            object_distance_mm=rig.geometry.object_distance_mm,
            band_hz=(
                chirp.first_sample_hz + chirp.hz_per_sample * first,
                chirp.first_sample_hz + chirp.hz_per_sample * (last - 1),
            ),
            samples=last - first,
            apodisation=rig.image.apodisation,
            high_pass_khz={name: sorted(hz / 1e3 for hz in model.corners_hz) for name, model in models.items()},
        )

    def differences(self, now: ImagedWith) -> list[str]:
        """Return the differences to `now`, in a few words each; empty if the gains apply."""
        return list(self._differences(now))

    def _differences(self, now: ImagedWith) -> Iterator[str]:
        if set(self.places_mm) != set(now.places_mm):
            yield f"the boards are {', '.join(now.places_mm)}, not {', '.join(self.places_mm)}"
        for name in self.places_mm.keys() & now.places_mm.keys():
            before, after = self.places_mm[name], now.places_mm[name]
            if len(before) != len(after):
                yield f"{name} has {len(after) - 2} antennas in use, not {len(before) - 2}"
                continue
            moved = max(math.dist(a, b) for a, b in zip(before, after, strict=True))
            if moved > SAME_MM:
                yield f"{name} or its antennas moved or turned, by up to {moved:.2g} mm"
        if abs(self.object_distance_mm - now.object_distance_mm) > SAME_MM:
            yield f"the object plane is at {now.object_distance_mm:.2f} mm, not {self.object_distance_mm:.2f} mm"
        off = max(abs(a - b) for a, b in zip(self.band_hz, now.band_hz, strict=True))
        if off > SAME_HZ or self.samples != now.samples:
            yield f"the linear samples are {_band(now)}, not {_band(self)}"
        if self.apodisation != now.apodisation:
            yield f"image.apodisation is {now.apodisation!r}, not {self.apodisation!r}"
        for name in self.high_pass_khz.keys() & now.high_pass_khz.keys():
            was, corners = self.high_pass_khz[name], now.high_pass_khz[name]
            same = len(was) == len(corners)
            if not same or any(abs(a - b) > SAME_CORNER_KHZ for a, b in zip(was, corners, strict=True)):
                yield f"{name}'s high-pass corners are {_corners(corners)}, not {_corners(was)}"


def _places_mm(rig: Instrument, board: Board) -> Iterator[Vector]:
    """Yield antennas in use and two points along a board's x and y, rig frame, rounded to a nanometre."""
    antennas = rig.antennas
    used = (antennas.tx_mm[board.tx_antenna],) if board.role == "transmit" else antennas.rx_mm
    for point in (*used, (ARM_MM, 0.0, 0.0), (0.0, ARM_MM, 0.0)):
        x, y, z = (round(1e3 * v, 6) for v in place(point, board.mount))
        yield (x, y, z)


def _band(made: ImagedWith) -> str:
    first, last = made.band_hz
    return f"{made.samples} of {first / 1e9:.4f}..{last / 1e9:.4f} GHz"


def _corners(khz: list[float]) -> str:
    return " and ".join(f"{c:.0f}" for c in khz) + " kHz" if khz else "none"
