"""What the gains of an image depend on, so that a metal reference is only used for images of the same rig.

Samples are referenced to the direct path and images are divided by the footprint of a perfect mirror. What is left in
the image of a metal plate is what both do not know: antenna patterns, errors of the measured places, edges. It depends
on places and turns of the antennas, on the object plane, on the frequencies, on the window over the aperture, and on
what is taken for the high-pass filters. It does not depend on what cancels:

* receiver and transmitter gain, start frequencies, triggers, crystals, power cycles: direct path and echo share them;
* the raster, masked positions, pulses of a burst: the footprint has them too;
* leakage: it is corrected behind the division, and is the receivers' own, the same on the plate as on the scene;
* speckle filter: it comes later.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import msgspec

from polysight.host.sync import HighPass, high_pass
from polysight.shared.config import Board, Instrument
from polysight.shared.geometry import Vector, place

SAME_MM = 1e-3
"""Closer places are one: 2e-3 rad of an echo's phase."""
SAME_HZ = 1e3
SAME_CORNER_KHZ = 10.0
"""Of a filter's corner: less than 0.1 dB and 0.1 degree between direct path and echo, in both channels alike."""
ARM_MM = 100.0
"""Points so far along a board's x and y show its turn, which antennas in one line do not."""


class ImagedWith(msgspec.Struct, frozen=True, kw_only=True):
    """What a pair of images was made with, as plain numbers.

    Attributes
    ----------
    places_mm
        Rig frame, by board: its antennas in use, then the ends of two arms along the board's x and y.
    object_distance_mm
        z of the image plane.
    band_hz
        Transmit frequency at the first and last linear sample.
    samples
        Linear samples.
    apodisation
        Window over the aperture, by its name in the rig file.
    high_pass_khz
        Corners that were undone, by receiver.
    """

    places_mm: dict[str, list[Vector]]
    object_distance_mm: float
    band_hz: tuple[float, float]
    samples: int
    apodisation: str
    high_pass_khz: dict[str, list[float]]

    @classmethod
    def of(cls, rig: Instrument, filters: Mapping[str, HighPass | None]) -> ImagedWith:
        """Of a rig with its calibrated places; `filters` by receiver, None or absent: as the chirp programs them."""
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
        """What is another in `now`, in a few words each; empty when gains can be carried over."""
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
    """Antennas in use and two arms of a board, rig frame, rounded to a nanometre."""
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
