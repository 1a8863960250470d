"""Images of parts of the sweep, for what changes with frequency: thin layers and their inner echoes.

Each sub-band is a shorter chirp: the same synchronised rows, reduced over fewer of their samples. Its range resolution
is coarser in proportion; the footprint is that of the sub-band too, so that a mirror is flat in all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec

from polysight.host.imaging.images import ChannelImages, ImageBuilder
from polysight.host.sync.chain import SyncedRow
from polysight.shared.config import Chirp, Instrument
from polysight.shared.errors import ConfigError

LEAST_SAMPLES = 24
"""Of a sub-band: fewer cannot tell the object from the direct path."""


@dataclass(frozen=True)
class SubBand:
    """One part of the sweep: samples `first` to `last` (half open), and the transmit frequencies they span."""

    samples: tuple[int, int]
    first_hz: float
    last_hz: float


def sub_bands(chirp: Chirp, count: int) -> tuple[SubBand, ...]:
    """Parts of the linear samples that overlap by half, as in Welch's method; one part is all of them.

    Raises
    ------
    ConfigError
        when the chirp is too short for so many.
    """
    first, last = chirp.linear_samples
    length = 2 * (last - first) / (count + 1) if count > 0 else 0.0
    if length < LEAST_SAMPLES:
        most = 2 * (last - first) // LEAST_SAMPLES - 1
        raise ConfigError(
            f"{count} sub-bands of {last - first} linear samples",
            f"each needs {LEAST_SAMPLES} samples to tell the object from the direct path",
            f"ask for 1 to {most}",
        )
    out = []
    for k in range(count):
        a = first + round(k * length / 2)
        b = min(last, a + round(length))
        edges = (chirp.first_sample_hz + chirp.hz_per_sample * n for n in (a, b - 1))
        out.append(SubBand((a, b), *edges))
    return tuple(out)


class SubBandImages:
    """Collects rows as :class:`polysight.host.imaging.ImageBuilder` does, and forms the images of every sub-band.

    Parameters
    ----------
    rig
        The scan's rig file.
    count
        Sub-bands.
    """

    def __init__(self, rig: Instrument, count: int) -> None:
        self.bands = sub_bands(rig.chirp, count)
        self.builders = tuple(ImageBuilder(_part(rig, band)) for band in self.bands)

    def add_row(self, board_name: str, row_index: int, row: SyncedRow) -> None:
        """Take in one synchronised row of one board; a row taken again replaces the earlier take."""
        for builder in self.builders:
            builder.add_row(board_name, row_index, row)

    def finish(self) -> tuple[ChannelImages, ...]:
        """The images of every sub-band from the rows added so far, lowest frequency first."""
        return tuple(builder.finish() for builder in self.builders)


def _part(rig: Instrument, band: SubBand) -> Instrument:
    """The rig with a chirp of which only a sub-band's samples count."""
    chirp = msgspec.structs.replace(rig.chirp, linear_samples=band.samples)
    return msgspec.structs.replace(rig, chirp=chirp)
