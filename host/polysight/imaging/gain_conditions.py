"""Settings that the gains of an image depend on; a metal reference is used only for images with the same settings.

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
from collections.abc import Iterator, Mapping

import msgspec

from polysight.sync import HighPass, high_pass
from polysight_shared.config import Board, Instrument
from polysight_shared.geometry import Vector, place

SAME_MM = 1e-3
"""Tolerance of positions: 2e-3 rad of an echo's phase."""
SAME_HZ = 1e3
SAME_CORNER_KHZ = 10.0
"""Tolerance of filter corners: less than 0.1 dB and 0.1 degrees between direct path and echo, in both channels."""
ARM_MM = 100.0
"""Points at this distance along a board's x and y show its rotation, which antennas in one line do not."""


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
