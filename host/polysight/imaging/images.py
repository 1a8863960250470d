"""Images of both channels: formed from synchronised rows, corrected for tilted plates, and what their gains depend on.

`ImageBuilder` collects rows in any order and forms the images from the rows so far. `SubBandImages` does the same for
parts of the sweep that overlap by half. `Images` is what every later step reads and returns: imaging forms it,
polarimetry adds metal reference and ratio.

Tilt. A level plate is seen at a pixel from the stage position whose specular point on the object plane is that pixel. A
plate with the rise s (dz/dx, dz/dy) is seen there from another position, whose specular point is away from it by

    d = H^-1 C s        H = second derivatives of r1 + r2 by x and y [2, 2],   C = (e1 + e2)_z

with r1, r2 the lengths of TX's and RX's legs (metres) and e1, e2 their unit vectors: specular reflection requires
(e1 + e2)_xy + s (e1 + e2)_z = 0, and (e1 + e2)_xy grows with H from the specular point. At that position the aperture
has another weight. It differs between H and V, as their specular points differ: 2.5 % of V / H per degree on the
published rig (simulated). So a pixel of a tilted plate is divided by the mirror's footprint at the distance d, not by
that at the pixel (`Illumination.to_level`). The rise follows from the image, whose phase grows by k C s, radians per
metre, k the wave number (`Illumination.estimate_rise`).

`ImagedWith` has the settings on which the gains of an image depend; a metal reference is used only for images with the
same settings. Samples are divided by the direct path, and images by the footprint of an ideal mirror. The remaining
gains come from antenna patterns, position errors and edges. They depend on position and orientation of the antennas,
object plane, frequencies, window over the aperture, and assumed high-pass filters, but not on settings that cancel:

* receiver and transmitter gain, start frequencies, triggers, crystals, power cycles: equal for direct path and echo;
* raster, masked positions, pulses of a burst: contained in the footprint;
* leakage: a property of the receivers, equal for plate and scene, and corrected after the division;
* speckle filter: applied later.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from importlib import import_module

import msgspec
import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.imaging import geometry
from polysight.imaging.geometry import Antennas, StageWindow, Window, image_grid, make_window, scan_offsets_m
from polysight.imaging.samples import BoardSamples, reduction
from polysight.sync import HighPass, SyncedRow, high_pass
from polysight_shared.config import Board, Chirp, Instrument
from polysight_shared.errors import ConfigError, DataError, ErrorCode
from polysight_shared.geometry import Vector, transform_to_rig
from polysight_shared.raster import plan_raster
from polysight_shared.units import SPEED_OF_LIGHT_M_S

Image = NDArray[np.complexfloating]
Mask = NDArray[np.bool_]
Rise = tuple[float, float]
"""Slope of a plate, dz/dx and dz/dy (about radians); z points away from the antennas."""
MAX_RISE = 0.06
"""Largest rise that counts as a tilt (3.4 degrees); a steeper phase has another cause; chosen."""
MIN_RISE = 2e-3
"""Smallest rise that is corrected (0.11 degrees); smaller ones may come from sidelobes of neighbours; chosen."""
_FEEBLE_RATIO = 0.12
"""V's phase is not used in patches with |V| / |H| below this: permittivities below 2.8 at 55 degrees."""
_LEAST_LINES = 6
"""Least number of columns or rows of pixels in a patch for an estimate of its curvature; chosen."""
_LEAST_COHERENCE = 0.5
"""Smallest coherence of the phase steps between pixels (1: all equal); chosen."""
_MAX_CHANGE = 2.0
"""Largest factor between two footprints that is used; chosen: larger ones occur only at the edge."""

SAME_MM = 1e-3
"""Tolerance of positions, mm: 2e-3 rad of an echo's phase."""
SAME_HZ = 1e3
"""Tolerance of transmit frequencies; chosen."""
SAME_CORNER_KHZ = 10.0
"""Tolerance of filter corners: less than 0.1 dB and 0.1 degrees between direct path and echo, in both channels."""
ARM_MM = 100.0
"""Distance of two points along a board's x and y, whose places show its rotation; the antennas are in one line."""

# Smallest footprint of a valid pixel, relative to the strongest; chosen: weaker pixels are mostly noise.
_LEAST_FOOTPRINT = 0.15
# Width of the majority filter, pixels; chosen.
_NEIGHBOURS = 15
TAPERS: dict[str, Window] = {"none": "boxcar", "kaiser": ("kaiser", 4.0), "taylor": ("taylor", 4, 30)}
"""Windows over the aperture by their name in the rig file, as for scipy; Kaiser's beta and Taylor's -30 dB chosen."""
MIN_SAMPLES = 24
"""Smallest number of samples in a sub-band (chosen); fewer do not separate the object from the direct path."""


@dataclass(frozen=True)
class Illumination:
    """Illumination of the object plane by both channels.

    Attributes
    ----------
    footprints
        complex64 [2, ny, nx]: the image of a uniform mirror, H and V.
    moved_m
        float64 [channel, (x, y) of d, rise along x or y]: H^-1 C, d in metres for a rise of 1.
    steepness_rad_m
        float64 [2]: k C of each channel, growth of the phase for a rise of 1, radians per metre.
    pixel_m
        Pitch of the pixels along x and y, metres.
    windows
        Positions and weights of the scan along x and along y; None if they are not known.
    """

    footprints: NDArray[np.complex64]
    moved_m: NDArray[np.float64]
    steepness_rad_m: NDArray[np.float64]
    pixel_m: tuple[float, float]
    windows: tuple[StageWindow, StageWindow] | None = None

    @property
    def across(self) -> int:
        """Axis across the plane of incidence, 0 (x) or 1 (y): that along which a rise moves the point least."""
        return int(np.argmin(np.abs(np.diagonal(self.moved_m.mean(axis=0)))))

    def transpose(self) -> Illumination:
        """Return the illumination with x and y swapped."""
        transposed = np.ascontiguousarray(self.footprints.transpose(0, 2, 1))
        return replace(
            self,
            footprints=transposed,
            moved_m=self.moved_m[:, ::-1, ::-1],
            pixel_m=self.pixel_m[::-1],
            windows=None if self.windows is None else self.windows[::-1],
        )

    def estimate_rise(self, h: Image, v: Image, mask: Mask, plate: Mask | None = None) -> Rise:
        """Estimate the rise of a patch along x and y from its phase; 0 along an axis where it is undetermined.

        `h`, `v` complex [ny, nx] are reflectivities (conjugates of the samples), `mask` bool [ny, nx] is the inside of
        the patch. V is left out where it nearly vanishes (`_FEEBLE_RATIO`): its phase is that of neighbours' sidelobes.
        `plate` [ny, nx] is the whole patch. With it, the apparent rise of a level plate is subtracted (`StageWindow` in
        :mod:`polysight.imaging.geometry`).
        """
        if not mask.any():
            return 0.0, 0.0
        level_h = float(np.nanmedian(np.abs(h[mask])))
        level_v = float(np.nanmedian(np.abs(v[mask])))
        channels = [h] if level_v < _FEEBLE_RATIO * level_h else [h, v]
        slopes = []
        for along in (0, 1):
            # The phase of the conjugate falls where the plate rises.
            step = sum(np.conj(_step(channel, mask, 1 - along)) for channel in channels) / len(channels)
            slope = (
                self._estimate_slope(float(np.angle(step)), h, along, mask, plate)
                if abs(step) > _LEAST_COHERENCE
                else 0.0
            )
            slopes.append(slope)
        return slopes[0], slopes[1]

    def _estimate_slope(self, step_rad: float, h: Image, along: int, mask: Mask, plate: Mask | None) -> float:
        """Return a plate's rise along x (`along` 0) or y (1) from its mean phase step per pixel."""
        slope_per_rad = 1 / (self.pixel_m[along] * float(self.steepness_rad_m.mean()))
        slope = slope_per_rad * step_rad
        inside_px = np.flatnonzero(mask.any(axis=along))
        if self.windows is None or plate is None or inside_px.size < 2:
            return slope
        is_lit = np.abs(self.footprints).min(axis=0) >= _LEAST_FOOTPRINT * np.abs(self.footprints).max()
        level = np.where(is_lit & np.isfinite(h), np.abs(h), np.nan)
        if along == 1:
            level = level.T
            mask = mask.T
            plate = plate.T
        lines = level[mask.any(axis=1)]
        if not np.isfinite(lines).any():
            return slope
        plate_px = np.flatnonzero(plate.any(axis=0))
        return self.windows[along].correct_slope(
            slope,
            inside_px,
            slope_per_rad=slope_per_rad,
            profile=np.nansum(lines, axis=0) / np.maximum(np.isfinite(lines).sum(axis=0), 1),
            lit=np.asarray(np.isfinite(lines).any(axis=0)),
            mask_ends_px=np.array([plate_px[0] - 0.5, plate_px[-1] + 0.5]),
            moved_px=float(self.moved_m.mean(axis=0)[along, along]) / self.pixel_m[along],
        )

    def estimate_bend(self, h: Image, v: Image, mask: Mask) -> tuple[float, float]:
        """Estimate a patch's curvature along x and y from its phase, 1 / m, positive where it bends away; 0 if unknown.

        On a surface of one curvature the phase step between pixels grows linearly; it is averaged over 3 or more lines.
        """
        channel = h if np.nansum(np.abs(h[mask])) >= np.nansum(np.abs(v[mask])) else v
        bends = []
        for pitch_m, lines, is_inside in ((self.pixel_m[0], channel, mask), (self.pixel_m[1], channel.T, mask.T)):
            is_pair = is_inside[:, :-1] & is_inside[:, 1:]
            steps = np.sum(np.where(is_pair, lines[:, 1:] * np.conj(lines[:, :-1]), 0), axis=0)
            enough_pixels = is_pair.sum(axis=0) > 2
            if enough_pixels.sum() < _LEAST_LINES:
                bends.append(0.0)
                continue
            place_m = np.flatnonzero(enough_pixels) * pitch_m
            weight = np.sqrt(np.abs(steps[enough_pixels]))
            growth = float(np.polyfit(place_m, np.unwrap(np.angle(steps[enough_pixels])), 1, w=weight)[0])
            # The samples are conjugated: the phase falls where the surface is farther.
            bends.append(-growth / pitch_m / float(self.steepness_rad_m.mean()))
        return bends[0], bends[1]

    @property
    def known(self) -> bool:
        """True if the footprints are those of a recorded scan; False if they are the same at all pixels."""
        return bool(np.ptp(np.abs(self.footprints)) > 0)

    def to_level(self, mask: Mask, rise: Rise) -> NDArray[np.float64]:
        """Return factors [2, n] that convert H and V of a patch's n pixels to those of a level plate.

        Only the magnitude of the footprint is used, for its phase ripples with the rows of the grid. Only the rise
        across the plane of incidence is used, and from `MIN_RISE`. A rise along the plane changes H and V equally (|H|
        by 7 % per degree), and its estimate is less reliable.
        """
        slope = rise[self.across]
        if abs(slope) < MIN_RISE:
            return np.ones((2, int(mask.sum())))
        return np.stack([self._change(k, mask, self.moved_m[k][:, self.across] * slope) for k in (0, 1)])

    def _change(self, channel: int, mask: Mask, moved_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return |footprint| at a patch's n pixels over that `moved_m` away; 1 if the factor exceeds `_MAX_CHANGE`."""
        rows, columns = np.nonzero(mask)
        level = np.abs(self.footprints[channel])
        coordinates = np.stack([rows + moved_m[1] / self.pixel_m[1], columns + moved_m[0] / self.pixel_m[0]])
        with np.errstate(divide="ignore", invalid="ignore"):
            change = level[rows, columns] / scipy.ndimage.map_coordinates(level, coordinates, order=1, mode="nearest")
        return np.where((change > 1 / _MAX_CHANGE) & (change < _MAX_CHANGE), change, 1.0)


@dataclass(frozen=True)
class Dispersion:
    """Change of the reflectivity over the sweep: 0 for a half space; not for a thin plate, whose faces interfere.

    `h`, `v` complex [ny, nx]: change of ln h and of ln v from the first to the last frequency of `band_hz`, relative to
    a mirror on the plane; NaN where nothing is seen. Each includes a constant until the change of metal is subtracted.
    """

    h: Image
    v: Image
    band_hz: tuple[float, float]

    def transpose(self) -> Dispersion:
        """Return the dispersion with x and y swapped."""
        return replace(self, h=np.ascontiguousarray(self.h.T), v=np.ascontiguousarray(self.v.T))


@dataclass(frozen=True)
class Images:
    """Both channels on one grid; row 0 is the smallest y. Fields that a later step adds are None before it.

    Attributes
    ----------
    h, v
        complex [ny, nx]: reflectivity with the sign convention of the Fresnel coefficients (time dependence
        exp(+j omega t)), 0 where not valid: the conjugate of the image divided by the footprint. The conjugate is
        needed because samples have the phase +2 pi f tau, while a delayed wave has exp(-j 2 pi f tau). Each channel
        contains a constant gain until it is divided by metal.
    x_m, y_m
        float64 [nx], [ny]: pixel centres in the rig frame, metres.
    valid
        bool [ny, nx]: pixels illuminated in both channels (and where the metal reference is valid).
    p
        complex [ny, nx]: h / v; NaN where v is zero.
    p_sigma
        float32 [ny, nx]: standard deviation of p as a complex number; NaN where unknown.
    metal_h, metal_v
        Metal by which h and v were divided: complex numbers, or images [ny, nx] of a reference over the whole plane.
        Then |h| = |v| = 1 on metal, and their phase difference is zero there.
    h_raw, v_raw
        complex64 [ny, nx]: the images before the footprint was divided out, with the phase of the samples.
    illumination
        Illumination of the plane by both channels, to correct tilted plates.
    dispersion
        Change over the sweep; None where it was not formed.
    raised_m
        float64 [ny, nx]: distance behind the images' plane at which a pixel was imaged (negative: nearer); None: 0.
    rx_gains
        Board name to complex128 [rx]: gain by which each RX was divided, measured by the direct path. NaN: not used.
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
    dispersion: Dispersion | None = None
    raised_m: NDArray[np.float64] | None = None
    rx_gains: Mapping[str, NDArray[np.complex128]] = field(default_factory=dict)
    notices: tuple[str, ...] = ()

    @property
    def usable(self) -> Mask:
        """Pixels that are valid and finite in both channels, bool [ny, nx]."""
        return self.valid & np.isfinite(self.h) & np.isfinite(self.v)

    def limit_to_area(self, area: Mask) -> Images:
        """Return the images, valid only inside `area`, bool [ny, nx]."""
        return replace(self, valid=self.valid & area)

    def transpose(self) -> Images:
        """Return the images with x and y swapped."""
        transposed = {
            f.name: np.ascontiguousarray(value.T)
            for f in fields(self)
            if isinstance(value := getattr(self, f.name), np.ndarray) and value.ndim == 2
        }
        illumination = None if self.illumination is None else self.illumination.transpose()
        dispersion = None if self.dispersion is None else self.dispersion.transpose()
        return replace(self, **transposed, x_m=self.y_m, y_m=self.x_m, illumination=illumination, dispersion=dispersion)

    def level(self, plate: Mask) -> Images:
        """Return the images with the tilt of one plate, bool [ny, nx], corrected if it is at most `MAX_RISE`."""
        if self.illumination is None:
            return self
        rise = self.illumination.estimate_rise(self.h, self.v, plate)
        if max(map(abs, rise)) <= MAX_RISE:
            return correct_tilt(self, [plate], [rise])
        return self


def specular_point_m(antennas: Antennas, z_m: float) -> NDArray[np.float64]:
    """Return the point of a mirror at `z_m` that reflects TX into a board's RX: x, y [2], metres, stage at zero."""
    tx = antennas.tx_m
    rx = antennas.rx_m.mean(axis=0)
    z_tx = z_m - tx[2]
    z_rx = z_m - rx[2]
    return (tx[:2] * z_rx + rx[:2] * z_tx) / (z_tx + z_rx)


def illumination_geometry(antennas: Antennas, z_m: float, frequency_hz: float) -> tuple[NDArray[np.float64], float]:
    """Return H^-1 C (`moved_m`, [2, 2]) and k C (`steepness_rad_m`) of a board's specular point on the plane `z_m`."""
    tx = antennas.tx_m
    rx = antennas.rx_m.mean(axis=0)
    point = np.append(specular_point_m(antennas, z_m), z_m)
    hessian = np.zeros((2, 2))
    cosines = 0.0
    for antenna in (tx, rx):
        leg = point - antenna
        distance_m = float(np.linalg.norm(leg))
        direction = leg / distance_m
        hessian += (np.eye(2) - np.outer(direction[:2], direction[:2])) / distance_m
        cosines += float(direction[2])
    wave = 2 * np.pi * frequency_hz / SPEED_OF_LIGHT_M_S
    return np.asarray(np.linalg.inv(hessian) * cosines, np.float64), wave * cosines


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
    masked_image = np.where(mask & np.isfinite(image), image, 0).astype(np.complex128)
    next_pixels = np.take(masked_image, range(1, masked_image.shape[axis]), axis)
    previous_pixels = np.take(masked_image, range(masked_image.shape[axis] - 1), axis)
    product = next_pixels * np.conj(previous_pixels)
    return complex(product.sum()) / max(float(np.abs(product).sum()), 1e-300)


@dataclass(frozen=True)
class View:
    """Plane and pixels of an image: the plane is `depth_mm` behind the rig file's; None stands for the rig file's."""

    depth_mm: float = 0.0
    columns: int | None = None
    rows: int | None = None
    pixel_mm: float | None = None

    def apply_to(self, rig: Instrument, swapped: bool = False) -> Instrument:
        """Return the rig with this plane and these pixels; `swapped`: the rig's x is the image's y."""
        columns, rows = (self.rows, self.columns) if swapped else (self.columns, self.rows)
        values = {"columns": columns, "rows": rows, "pixel_mm": self.pixel_mm}
        image = msgspec.structs.replace(rig.image, **{k: v for k, v in values.items() if v is not None})
        distance = rig.geometry.object_distance_mm + self.depth_mm
        geometry = msgspec.structs.replace(rig.geometry, object_distance_mm=distance)
        return msgspec.structs.replace(rig, image=image, geometry=geometry)


AS_IN_RIG_FILE = View()


class ImageBuilder:
    """Collects rows in any order and forms images of the rows so far.

    A row added again replaces the earlier one. Only reduced samples are kept: about 10 frequencies instead of 192.

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
        self.rig = rig
        self.grid = image_grid(rig)
        self.live = live
        if live:
            # Loaded now, so that the last row does not wait for it.
            import_module("scipy.ndimage")
        plan = plan_raster(rig.grid)
        antennas = tuple(Antennas.from_rig(rig, board) for board in rig.receivers)
        self.gate_m = geometry.find_needed_gate_m(rig, depth_m) if gate_m is None else gate_m
        self.taper = TAPERS[rig.image.apodisation] if taper is None else taper
        weights_y = make_window(self.taper, plan.rows)
        weights = np.outer(weights_y, make_window(self.taper, plan.columns)).astype(np.float32)
        gated = reduction(rig.chirp, self.gate_m)
        self._antennas = antennas
        self._middle_hz = float(np.mean(gated.frequencies_hz))
        self._band_hz = float(gated.frequencies_hz[0]), float(gated.frequencies_hz[-1])
        self.boards = {b.name: BoardSamples(rig, b, self.grid, gated, weights, live) for b in rig.receivers}

    def add_row(
        self, board_name: str, row_index: int, row: SyncedRow, offsets_m: NDArray[np.float64] | None = None
    ) -> None:
        """Add a synchronised row of a board, see :meth:`polysight.imaging.samples.BoardSamples.add_row`.

        Raises
        ------
        DataError
            if board or row is not in this scan, or the row has another number of positions.
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
        return self._make_channels({name: board.image(grid) for name, board in self.boards.items()}, offset_m)

    def form_dispersion(self, offset_m: float = 0.0) -> Dispersion:
        """Form the dispersion from the rows so far; `offset_m` as of :meth:`finish`."""
        grid = replace(self.grid, z_m=self.grid.z_m + offset_m) if offset_m else None
        h, v = (board.dispersion(grid).conj() for board in self.boards.values())
        return Dispersion(h, v, self._band_hz)

    def current(self) -> Images:
        """Return the images from running sums, within 1e-6 of the peak; fast if the builder is `live`."""
        return self._make_channels({name: board.image_current_sums() for name, board in self.boards.items()})

    def _make_channels(self, channels: dict[str, tuple[Image, Image, str | None]], offset_m: float = 0.0) -> Images:
        """Divide the images by their footprints; `channels`: board name to image, footprint and notice (None: none)."""
        h, v = channels.values()
        visible = np.ones(self.grid.shape, bool)
        for _, footprint, _ in (h, v):
            strong = np.abs(footprint) >= _LEAST_FOOTPRINT * np.abs(footprint).max()
            # Near its edge the footprint ripples with the row spacing; a majority filter avoids stripes.
            share = scipy.ndimage.uniform_filter(strong.astype(np.float32), size=_NEIGHBOURS, mode="nearest")
            visible &= (share > 0.5) & (footprint != 0)
        divided = [np.divide(raw, foot, out=np.zeros_like(raw), where=visible).conj() for raw, foot, _ in (h, v)]
        return Images(
            h=divided[0],
            v=divided[1],
            x_m=self.grid.x_m,
            y_m=self.grid.y_m,
            valid=visible,
            h_raw=h[0],
            v_raw=v[0],
            illumination=self._compute_illumination(np.stack([h[1], v[1]]), float(np.mean(self.grid.z_m)) + offset_m),
            rx_gains={name: board.rx_calibration() for name, board in self.boards.items()},
            notices=tuple(f"{name}: {notice}" for name, (_, _, notice) in channels.items() if notice),
        )

    def _compute_illumination(self, footprints: NDArray[np.complex64], z_m: float) -> Illumination:
        """Return the illumination of the plane at `z_m` by both channels."""
        shifts, steep = zip(*(illumination_geometry(a, z_m, self._middle_hz) for a in self._antennas), strict=True)
        pitch = self.grid.pixel_m
        moved_m = np.stack(shifts)
        steepness_rad_m = np.array(steep)
        # k H / 2: half of the phase's second derivative by the distance from the specular point, rad / m^2.
        bend_rad_m2 = steepness_rad_m.mean() * np.diagonal(np.linalg.inv(moved_m.mean(axis=0))) / 2
        specular_m = np.mean([specular_point_m(a, z_m) for a in self._antennas], axis=0)
        offsets_m = scan_offsets_m(self.rig)
        along_x, along_y = (
            StageWindow(
                places_px=(specular_m[axis] + offsets - start_m) / pitch,
                weights=make_window(self.taper, len(offsets)),
                bend_px=float(bend_rad_m2[axis] * pitch**2),
            )
            for axis, offsets, start_m in (
                (0, offsets_m[0, :, 0], self.grid.x_m[0]),
                (1, offsets_m[:, 0, 1], self.grid.y_m[0]),
            )
        )
        return Illumination(footprints, moved_m, steepness_rad_m, (pitch, pitch), (along_x, along_y))


@dataclass(frozen=True)
class SubBand:
    """Part of the sweep: its samples [first, last), and the transmit frequencies of the first and the last of them."""

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
        max_bands = 2 * (last - first) // MIN_SAMPLES - 1
        raise ConfigError(
            f"{count} sub-bands of {last - first} linear samples",
            f"each needs {MIN_SAMPLES} samples to separate the object from the direct path",
            f"use 1 to {max_bands}",
            code=ErrorCode.VALUE_INVALID,
        )
    bands = []
    for k in range(count):
        a = first + round(k * length / 2)
        b = min(last, a + round(length))
        edges = (chirp.first_sample_hz + chirp.hz_per_sample * n for n in (a, b - 1))
        bands.append(SubBand((a, b), *edges))
    return tuple(bands)


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
        self.builders = tuple(ImageBuilder(_limit_to_band(rig, band), gate_m=gate_m) for band in self.bands)

    def add_row(self, board_name: str, row_index: int, row: SyncedRow) -> None:
        """Add a synchronised row of a board; a row added again replaces the earlier one."""
        for builder in self.builders:
            builder.add_row(board_name, row_index, row)

    def finish(
        self, transposed: bool = False, form: Callable[[ImageBuilder], Images] = ImageBuilder.finish
    ) -> tuple[Images, ...]:
        """Form the images of every sub-band with `form`, lowest frequency first; `transposed`: swap x and y."""
        band_images = map(form, self.builders)
        return tuple(images.transpose() if transposed else images for images in band_images)


def _limit_to_band(rig: Instrument, band: SubBand) -> Instrument:
    """Return the rig with the linear samples limited to a sub-band."""
    chirp = msgspec.structs.replace(rig.chirp, linear_samples=band.samples)
    return msgspec.structs.replace(rig, chirp=chirp)


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
    def from_rig(cls, rig: Instrument, filters: Mapping[str, HighPass | None]) -> ImagedWith:
        """Return the settings of a calibrated rig; `filters` by receiver, None or missing: as in the chirp profile."""
        chirp = rig.chirp
        first, last = chirp.linear_samples
        boards = (rig.transmitter, *rig.receivers)
        models = {b.name: filters.get(b.name) or high_pass(chirp) for b in rig.receivers}
        return cls(
            places_mm={b.name: list(_list_places_mm(rig, b)) for b in boards},
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
        """Return the differences from these settings to `now`, a few words each; empty if the gains apply."""
        return list(self._list_differences(now))

    def _list_differences(self, now: ImagedWith) -> Iterator[str]:
        if set(self.places_mm) != set(now.places_mm):
            yield f"the boards are {', '.join(now.places_mm)}, not {', '.join(self.places_mm)}"
        for name in self.places_mm.keys() & now.places_mm.keys():
            place_before = self.places_mm[name]
            place_after = now.places_mm[name]
            if len(place_before) != len(place_after):
                yield f"{name} has {len(place_after) - 2} antennas in use, not {len(place_before) - 2}"
                continue
            distance_mm = max(math.dist(a, b) for a, b in zip(place_before, place_after, strict=True))
            if distance_mm > SAME_MM:
                yield f"{name} or its antennas moved or turned, by up to {distance_mm:.2g} mm"
        if abs(self.object_distance_mm - now.object_distance_mm) > SAME_MM:
            yield f"the object plane is at {now.object_distance_mm:.2f} mm, not {self.object_distance_mm:.2f} mm"
        difference_hz = max(abs(a - b) for a, b in zip(self.band_hz, now.band_hz, strict=True))
        if difference_hz > SAME_HZ or self.samples != now.samples:
            yield f"the linear samples are {_describe_band(now)}, not {_describe_band(self)}"
        if self.apodisation != now.apodisation:
            yield f"image.apodisation is {now.apodisation!r}, not {self.apodisation!r}"
        for name in self.high_pass_khz.keys() & now.high_pass_khz.keys():
            old_khz = self.high_pass_khz[name]
            corners = now.high_pass_khz[name]
            is_equal = len(old_khz) == len(corners)
            if not is_equal or any(abs(a - b) > SAME_CORNER_KHZ for a, b in zip(old_khz, corners, strict=True)):
                yield f"{name}'s high-pass corners are {_describe_corners(corners)}, not {_describe_corners(old_khz)}"


def _list_places_mm(rig: Instrument, board: Board) -> Iterator[Vector]:
    """Yield antennas in use and two points along a board's x and y, rig frame, rounded to a nanometre."""
    antennas = rig.antennas
    antennas_mm = (antennas.tx_mm[board.tx_antenna],) if board.role == "transmit" else antennas.rx_mm
    for point in (*antennas_mm, (ARM_MM, 0.0, 0.0), (0.0, ARM_MM, 0.0)):
        x, y, z = (round(1e3 * v, 6) for v in transform_to_rig(point, board.mount))
        yield (x, y, z)


def _describe_band(settings: ImagedWith) -> str:
    first, last = settings.band_hz
    return f"{settings.samples} of {first / 1e9:.4f}..{last / 1e9:.4f} GHz"


def _describe_corners(khz: list[float]) -> str:
    return " and ".join(f"{c:.0f}" for c in khz) + " kHz" if khz else "none"
