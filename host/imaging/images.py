"""From synchronised rows to the two channel images: of the whole sweep, and of its sub-bands.

`ImageBuilder` collects rows in any order and forms both images of those it has. `SubBandImages` does the same for parts
of the sweep that overlap by half.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import import_module

import msgspec
import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.host.imaging.geometry import Antennas, image_grid
from polysight.host.imaging.reduce import reduction, scene_gate_m
from polysight.host.imaging.samples import BoardSamples, Image
from polysight.host.imaging.tilt import Illumination, illumination_geometry, levelled
from polysight.host.imaging.window import Window, window_weights
from polysight.host.sync import SyncedRow
from polysight.shared.config import Chirp, Instrument
from polysight.shared.errors import ConfigError, DataError
from polysight.shared.raster import plan_raster

_VISIBLE = 0.15  # of the strongest footprint: weaker pixels would be mostly amplified noise
_NEIGHBOURS = 15  # pixels
TAPERS: dict[str, Window] = {"none": "boxcar", "kaiser": ("kaiser", 4.0), "taylor": ("taylor", 4, 30)}
"""Windows over the aperture by their name in the rig file, as scipy names them."""
LEAST_SAMPLES = 24
"""Of a sub-band: fewer cannot tell the object from the direct path."""


@dataclass(frozen=True)
class ChannelImages:
    """The two channels on one grid.

    Attributes
    ----------
    h, v
        complex64 [ny, nx]: reflectivity as Fresnel's coefficients state it (time dependence exp(+j omega t)): the
        conjugate of the image divided by the footprint of a uniform mirror; 0 where not valid. Samples whose phase is
        +2 pi f tau are the conjugate of the wave, for which a delay is exp(-j 2 pi f tau), and so is what they show of
        the object. Still to be referenced to metal: each holds its channel's constant gain.
    h_raw, v_raw
        complex64 [ny, nx]: before that, as the samples have it.
    h_footprint, v_footprint
        complex64 [ny, nx].
    x_m, y_m
        float64 [nx], [ny]: axes in the rig frame.
    valid
        bool [ny, nx]: both footprints are strong enough.
    rx_calibration
        Board name to complex128 [rx]: gain and phase of each RX, from the direct path, that was divided out.
    notices
        What the user should know of how they were made.
    lit
        How both channels light the plane: what a plate's tilt changes. None where that is not known.
    """

    h: NDArray[np.complex64]
    v: NDArray[np.complex64]
    h_raw: NDArray[np.complex64]
    v_raw: NDArray[np.complex64]
    h_footprint: NDArray[np.complex64]
    v_footprint: NDArray[np.complex64]
    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    valid: NDArray[np.bool_]
    rx_calibration: dict[str, NDArray[np.complex128]]
    notices: tuple[str, ...] = ()
    lit: Illumination | None = None

    def transposed(self) -> ChannelImages:
        """The images with x and y swapped."""
        pixels = ("h", "v", "h_raw", "v_raw", "h_footprint", "v_footprint", "valid")
        turned = {name: np.ascontiguousarray(getattr(self, name).T) for name in pixels}
        lit = None if self.lit is None else self.lit.transposed()
        return replace(self, **turned, x_m=self.y_m, y_m=self.x_m, lit=lit)

    def level(self, plate: NDArray[np.bool_]) -> tuple[NDArray[np.complexfloating], NDArray[np.complexfloating]]:
        """H and V with one plate, bool [ny, nx], as it would be without its tilt."""
        if self.lit is None:
            return self.h, self.v
        return levelled(self.h, self.v, self.lit, [plate], [self.lit.rise(self.h, self.v, plate)])


@dataclass(frozen=True)
class View:
    """Another plane and other pixels than the rig file's; None: as there. A plane lies `depth_mm` farther."""

    depth_mm: float = 0.0
    columns: int | None = None
    rows: int | None = None
    pixel_mm: float | None = None

    def of(self, rig: Instrument, swapped: bool = False) -> Instrument:
        """The rig with this plane and these pixels; `swapped`: its x is the image's y."""
        columns, rows = (self.rows, self.columns) if swapped else (self.columns, self.rows)
        wanted = {"columns": columns, "rows": rows, "pixel_mm": self.pixel_mm}
        image = msgspec.structs.replace(rig.image, **{k: v for k, v in wanted.items() if v is not None})
        distance = rig.geometry.object_distance_mm + self.depth_mm
        geometry = msgspec.structs.replace(rig.geometry, object_distance_mm=distance)
        return msgspec.structs.replace(rig, image=image, geometry=geometry)


AS_IN_RIG_FILE = View()


def needed_gate_m(rig: Instrument, depth_m: float = 0.0) -> tuple[float, float]:
    """Smallest and largest excess path of a rig's image, `depth_m` nearer or farther."""
    antennas = tuple(Antennas.of(rig, board) for board in rig.receivers)
    return scene_gate_m(antennas, plan_raster(rig.grid), image_grid(rig), depth_m)


class ImageBuilder:
    """Collects rows in any order, and forms the images of those it has.

    A row taken again replaces the earlier take. Only reduced samples are kept: 10 frequencies instead of 192.

    Parameters
    ----------
    rig
        The scan's rig file.
    window
        Fast-time window, see :func:`polysight.host.imaging.reduce.reduction`.
    taper
        Window over the aperture in x and y, by scipy's name; "boxcar" for none; None takes the rig file's. A sharp
        aperture's sidelobes make the inside of a plate depend on all that surrounds it, and H and V differently
        (docs/decisions/0002-imaging.md).
    live
        Let every row update sums, 2 ms a row and board of the published grid, so that :meth:`current` costs next to
        nothing after each; and make the kernels of the final image beforehand.
    depth_m
        Keep echoes of a scene that may lie this much nearer or farther than the rig file says, for autofocus.
    gate_m
        Excess paths to keep, as samples kept earlier have them; None: those that grid and `depth_m` need.
    """

    def __init__(
        self,
        rig: Instrument,
        window: Window = "hann",
        taper: Window | None = None,
        live: bool = False,
        depth_m: float = 0.0,
        gate_m: tuple[float, float] | None = None,
    ) -> None:
        self.rig, self.grid, self.live = rig, image_grid(rig), live
        if live:
            import_module("scipy.ndimage")  # scipy loads it at its first use: now, not behind the last row
        plan = plan_raster(rig.grid)
        antennas = tuple(Antennas.of(rig, board) for board in rig.receivers)
        self.gate_m = needed_gate_m(rig, depth_m) if gate_m is None else gate_m
        taper = TAPERS[rig.image.apodisation] if taper is None else taper
        weights = np.outer(window_weights(taper, plan.rows), window_weights(taper, plan.columns)).astype(np.float32)
        gated = reduction(rig.chirp, self.gate_m, window)
        self._antennas, self._middle_hz = antennas, float(np.mean(gated.frequencies_hz))
        self.boards = {b.name: BoardSamples(rig, b, self.grid, gated, weights, live) for b in rig.receivers}

    def add_row(
        self, board_name: str, row_index: int, row: SyncedRow, offsets_m: NDArray[np.float64] | None = None
    ) -> None:
        """Take in one synchronised row of one board, see :meth:`polysight.host.imaging.samples.BoardSamples.add_row`.

        Raises
        ------
        DataError
            when the row is not one of this plan's.
        """
        if board_name not in self.boards:
            raise DataError(
                f"row {row_index} of board {board_name!r} is not in this scan",
                "data and rig file do not belong together",
                "use the rig file of this scan",
            )
        self.boards[board_name].add_row(row_index, row, offsets_m)

    def rx_calibration(self, board_name: str) -> NDArray[np.complex128]:
        """Complex gain of each RX of a board, [rx]."""
        return self.boards[board_name].rx_calibration()

    def finish(self, offset_m: float = 0.0) -> ChannelImages:
        """Both images from the rows added so far, all at once; more rows may follow.

        `offset_m`: on a plane that lies so much farther than the rig file's.
        """
        grid = replace(self.grid, z_m=self.grid.z_m + offset_m) if offset_m else None
        return self._channels({name: board.image(grid) for name, board in self.boards.items()}, offset_m)

    def current(self) -> ChannelImages:
        """The same within 1e-6 of the peak, for looking on: at once where the builder is `live`."""
        return self._channels({name: board.current() for name, board in self.boards.items()})

    def _channels(self, made: dict[str, tuple[Image, Image, str | None]], offset_m: float = 0.0) -> ChannelImages:
        h, v = made.values()
        visible = np.ones(self.grid.shape, bool)
        for _, weight, _ in (h, v):
            strong = np.abs(weight) >= _VISIBLE * np.abs(weight).max()
            # The footprint's rim ripples with the row spacing: the majority of the neighbourhood decides, not stripes.
            share = scipy.ndimage.uniform_filter(strong.astype(np.float32), size=_NEIGHBOURS, mode="nearest")
            visible &= (share > 0.5) & (weight != 0)
        flat = [np.divide(raw, w, out=np.zeros_like(raw), where=visible).conj() for raw, w, _ in (h, v)]
        calibration = {name: board.rx_calibration() for name, board in self.boards.items()}
        notices = tuple(f"{name}: {notice}" for name, (_, _, notice) in made.items() if notice)
        axes = (self.grid.x_m, self.grid.y_m)
        lit = self._illumination(np.stack([h[1], v[1]]), float(np.mean(self.grid.z_m)) + offset_m)
        return ChannelImages(flat[0], flat[1], h[0], v[0], h[1], v[1], *axes, visible, calibration, notices, lit)

    def _illumination(self, footprints: NDArray[np.complex64], z_m: float) -> Illumination:
        """How both channels light a plane at `z_m`."""
        moved, steep = zip(*(illumination_geometry(a, z_m, self._middle_hz) for a in self._antennas), strict=True)
        pitch = self.grid.pixel_m
        return Illumination(footprints, np.stack(moved), np.array(steep), (pitch, pitch))


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
        Sub-bands; 1: none, the image of the whole sweep is enough.
    gate_m
        As of the image of the whole sweep.
    """

    def __init__(self, rig: Instrument, count: int, gate_m: tuple[float, float] | None = None) -> None:
        self.bands = sub_bands(rig.chirp, count) if count > 1 else ()
        self.builders = tuple(ImageBuilder(_part(rig, band), gate_m=gate_m) for band in self.bands)

    def add_row(self, board_name: str, row_index: int, row: SyncedRow) -> None:
        """Take in one synchronised row of one board; a row taken again replaces the earlier take."""
        for builder in self.builders:
            builder.add_row(board_name, row_index, row)

    def finish(self, transposed: bool = False, offset_m: float = 0.0) -> tuple[ChannelImages, ...]:
        """The images of every sub-band from the rows so far, lowest frequency first; x and y swapped on demand.

        `offset_m`: on a plane that lies so much farther than the rig file's, as the image of the whole sweep.
        """
        made = (builder.finish(offset_m) for builder in self.builders)
        return tuple(images.transposed() if transposed else images for images in made)


def _part(rig: Instrument, band: SubBand) -> Instrument:
    """The rig with a chirp of which only a sub-band's samples count."""
    chirp = msgspec.structs.replace(rig.chirp, linear_samples=band.samples)
    return msgspec.structs.replace(rig, chirp=chirp)
