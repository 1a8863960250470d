"""Form the H and V images from synchronised rows, for the whole sweep and for its sub-bands.

`ImageBuilder` collects rows in any order and forms the images from the rows so far. `SubBandImages` does the same for
parts of the sweep that overlap by half.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import import_module

import msgspec
import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.imaging.geometry import Antennas, Window, image_grid, window_weights
from polysight.imaging.images import Illumination, Images, illumination_geometry
from polysight.imaging.samples import BoardSamples, Image, reduction, scene_gate_m
from polysight.sync import SyncedRow
from polysight_shared.config import Chirp, Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError
from polysight_shared.raster import plan_raster

_VISIBLE = 0.15  # smallest footprint relative to the strongest; weaker pixels are mostly noise
_NEIGHBOURS = 15  # pixels, width of the majority filter
TAPERS: dict[str, Window] = {"none": "boxcar", "kaiser": ("kaiser", 4.0), "taylor": ("taylor", 4, 30)}
"""Windows over the aperture by their name in the rig file, as for scipy."""
MIN_SAMPLES = 24
"""Smallest number of samples in a sub-band; fewer do not separate the object from the direct path."""


@dataclass(frozen=True)
class View:
    """Plane and pixels other than the rig file's (None: as there); the plane lies `depth_mm` farther."""

    depth_mm: float = 0.0
    columns: int | None = None
    rows: int | None = None
    pixel_mm: float | None = None

    def of(self, rig: Instrument, swapped: bool = False) -> Instrument:
        """Return the rig with this plane and these pixels; `swapped`: the rig's x is the image's y."""
        columns, rows = (self.rows, self.columns) if swapped else (self.columns, self.rows)
        wanted = {"columns": columns, "rows": rows, "pixel_mm": self.pixel_mm}
        image = msgspec.structs.replace(rig.image, **{k: v for k, v in wanted.items() if v is not None})
        distance = rig.geometry.object_distance_mm + self.depth_mm
        geometry = msgspec.structs.replace(rig.geometry, object_distance_mm=distance)
        return msgspec.structs.replace(rig, image=image, geometry=geometry)


AS_IN_RIG_FILE = View()


def needed_gate_m(rig: Instrument, depth_m: float = 0.0) -> tuple[float, float]:
    """Return the smallest and largest excess path in a rig's image, with planes `depth_m` nearer and farther."""
    antennas = tuple(Antennas.of(rig, board) for board in rig.receivers)
    return scene_gate_m(antennas, plan_raster(rig.grid), image_grid(rig), depth_m)


class ImageBuilder:
    """Collects rows in any order and forms images of the rows so far.

    A row added again replaces the earlier one. Only reduced samples are kept: 10 frequencies instead of 192.

    Parameters
    ----------
    rig
        Rig of the scan.
    taper
        Window over the aperture in x and y, as for scipy; "boxcar" for none; None: the rig file's. Without a taper,
        sidelobes make the inside of a plate depend on its surroundings, differently in H and V
        (docs/decisions/0002-imaging.md).
    live
        Update running sums with every row (2 ms per row and board of the published grid), so that :meth:`current` is
        fast, and compute the kernels of the final image in advance.
    depth_m
        Keep echoes from planes up to this much nearer or farther than the rig file's, for autofocus.
    gate_m
        Excess paths to keep, for example of kept samples; None: those needed by grid and `depth_m`.
    """

    def __init__(
        self,
        rig: Instrument,
        taper: Window | None = None,
        live: bool = False,
        depth_m: float = 0.0,
        gate_m: tuple[float, float] | None = None,
    ) -> None:
        self.rig, self.grid, self.live = rig, image_grid(rig), live
        if live:
            import_module("scipy.ndimage")  # load it now instead of after the last row
        plan = plan_raster(rig.grid)
        antennas = tuple(Antennas.of(rig, board) for board in rig.receivers)
        self.gate_m = needed_gate_m(rig, depth_m) if gate_m is None else gate_m
        self.taper = TAPERS[rig.image.apodisation] if taper is None else taper
        weights_y = window_weights(self.taper, plan.rows)
        weights = np.outer(weights_y, window_weights(self.taper, plan.columns)).astype(np.float32)
        gated = reduction(rig.chirp, self.gate_m)
        self._antennas, self._middle_hz = antennas, float(np.mean(gated.frequencies_hz))
        self.boards = {b.name: BoardSamples(rig, b, self.grid, gated, weights, live) for b in rig.receivers}

    def add_row(
        self, board_name: str, row_index: int, row: SyncedRow, offsets_m: NDArray[np.float64] | None = None
    ) -> None:
        """Add a synchronised row of a board, see :meth:`polysight.imaging.samples.BoardSamples.add_row`.

        Raises
        ------
        DataError
            if the row is not in the plan.
        """
        if board_name not in self.boards:
            raise DataError(
                f"row {row_index} of board {board_name!r} is not in this scan",
                "the data were recorded with another rig file",
                "use the rig file of this scan",
                code=ErrorCode.MISMATCH,
            )
        self.boards[board_name].add_row(row_index, row, offsets_m)

    def rx_calibration(self, board_name: str) -> NDArray[np.complex128]:
        """Return the complex gain of each RX of a board, [rx]."""
        return self.boards[board_name].rx_calibration()

    def finish(self, offset_m: float = 0.0) -> Images:
        """Form both images from the rows so far; more rows may be added later.

        `offset_m`: distance of the imaged plane behind the rig file's plane.
        """
        grid = replace(self.grid, z_m=self.grid.z_m + offset_m) if offset_m else None
        return self._channels({name: board.image(grid) for name, board in self.boards.items()}, offset_m)

    def current(self) -> Images:
        """Return the images from running sums, within 1e-6 of the peak; fast if the builder is `live`."""
        return self._channels({name: board.current() for name, board in self.boards.items()})

    def _channels(self, made: dict[str, tuple[Image, Image, str | None]], offset_m: float = 0.0) -> Images:
        h, v = made.values()
        visible = np.ones(self.grid.shape, bool)
        for _, weight, _ in (h, v):
            strong = np.abs(weight) >= _VISIBLE * np.abs(weight).max()
            # The rim of the footprint ripples with the row spacing; a majority filter avoids stripes.
            share = scipy.ndimage.uniform_filter(strong.astype(np.float32), size=_NEIGHBOURS, mode="nearest")
            visible &= (share > 0.5) & (weight != 0)
        flat = [np.divide(raw, w, out=np.zeros_like(raw), where=visible).conj() for raw, w, _ in (h, v)]
        return Images(
            h=flat[0],
            v=flat[1],
            x_m=self.grid.x_m,
            y_m=self.grid.y_m,
            valid=visible,
            h_raw=h[0],
            v_raw=v[0],
            illumination=self._illumination(np.stack([h[1], v[1]]), float(np.mean(self.grid.z_m)) + offset_m),
            rx_gains={name: board.rx_calibration() for name, board in self.boards.items()},
            notices=tuple(f"{name}: {notice}" for name, (_, _, notice) in made.items() if notice),
        )

    def _illumination(self, footprints: NDArray[np.complex64], z_m: float) -> Illumination:
        """Return the illumination of the plane at `z_m` by both channels."""
        moved, steep = zip(*(illumination_geometry(a, z_m, self._middle_hz) for a in self._antennas), strict=True)
        pitch = self.grid.pixel_m
        return Illumination(footprints, np.stack(moved), np.array(steep), (pitch, pitch))


@dataclass(frozen=True)
class SubBand:
    """Part of the sweep: its samples [first, last), and its first and last transmit frequency."""

    samples: tuple[int, int]
    first_hz: float
    last_hz: float


def sub_bands(chirp: Chirp, count: int) -> tuple[SubBand, ...]:
    """Divide the linear samples into `count` parts that overlap by half, as in Welch's method.

    Raises
    ------
    ConfigError
        if the chirp is too short for so many parts.
    """
    first, last = chirp.linear_samples
    length = 2 * (last - first) / (count + 1) if count > 0 else 0.0
    if length < MIN_SAMPLES:
        most = 2 * (last - first) // MIN_SAMPLES - 1
        raise ConfigError(
            f"{count} sub-bands of {last - first} linear samples",
            f"each needs {MIN_SAMPLES} samples to separate the object from the direct path",
            f"use 1 to {most}",
            code=ErrorCode.VALUE_INVALID,
        )
    out = []
    for k in range(count):
        a = first + round(k * length / 2)
        b = min(last, a + round(length))
        edges = (chirp.first_sample_hz + chirp.hz_per_sample * n for n in (a, b - 1))
        out.append(SubBand((a, b), *edges))
    return tuple(out)


class SubBandImages:
    """Collects rows like :class:`ImageBuilder` and forms the images of every sub-band.

    Parameters
    ----------
    rig
        Rig of the scan.
    count
        Number of sub-bands; 1: none.
    gate_m
        Range gate of the whole sweep.
    """

    def __init__(self, rig: Instrument, count: int, gate_m: tuple[float, float] | None = None) -> None:
        self.bands = sub_bands(rig.chirp, count) if count > 1 else ()
        self.builders = tuple(ImageBuilder(_part(rig, band), gate_m=gate_m) for band in self.bands)

    def add_row(self, board_name: str, row_index: int, row: SyncedRow) -> None:
        """Add a synchronised row of a board; a row added again replaces the earlier one."""
        for builder in self.builders:
            builder.add_row(board_name, row_index, row)

    def finish(self, transposed: bool = False, offset_m: float = 0.0) -> tuple[Images, ...]:
        """Form the images of every sub-band from the rows so far, lowest frequency first.

        `transposed`: swap x and y. `offset_m`: as in :meth:`ImageBuilder.finish`.
        """
        made = (builder.finish(offset_m) for builder in self.builders)
        return tuple(images.transposed() if transposed else images for images in made)


def _part(rig: Instrument, band: SubBand) -> Instrument:
    """Return the rig with the linear samples limited to a sub-band."""
    chirp = msgspec.structs.replace(rig.chirp, linear_samples=band.samples)
    return msgspec.structs.replace(rig, chirp=chirp)
