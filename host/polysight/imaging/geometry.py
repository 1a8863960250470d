"""Geometry of an aperture: positions of pixels, antennas and stage, and the `Aperture` that imagers take.

`StageWindow` corrects the estimated tilt of a plate for the ends of the scan: if the scan ends within one Fresnel zone
of the plate, more positions see the plate from one side than from the other. The phase of its image then rises as if a
level plate were tilted, by up to 0.8 degrees on a narrow scan.

The module also has checks of regularity, windows, the motion of the stage in a burst, and functions of the array API
(namespace, transforms, device), so that imagers run on NumPy, PyTorch and CuPy.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from polysight_shared.config import Board, Instrument
from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.geometry import rx_positions_m, specular_midpoint_m, tx_position_m
from polysight_shared.raster import RasterPlan, Row, mean_burst_travel_mm, plan_raster

ROUNDS = 2
END_STEP = 0.7
"""The iteration that finds slope and ends of a plate has `ROUNDS` rounds; each corrects the share `END_STEP` of the
ends' error. With more of either, it diverges for plates that lie half outside the illuminated part (78 drawn plates,
apertures of 25 to 45 columns)."""

SAME_END_PX = 5.0
"""Distance up to which a plate's end by |H| and by its segmentation count as equal: about a resolution cell."""
# Tolerance of positions: at a wavelength of 4 mm a path longer by this has 2e-3 rad more phase, far below the noise.
_SAME_M = 1e-6
# The lattice in y (of rows and pixels, `pitch_y_m`) may be finer than the pixels by this factor at most (chosen).
_MAX_REFINEMENT = 4
# Largest number of taps to either side in the filter against the motion in a burst (chosen).
REACH = 4
# Largest frequency of the filter, cycles per position; chosen, 0.5 is the limit of the sampling.
_FILTER_BAND = 0.45
Window = str | tuple[Any, ...]
"""Window as for scipy.signal.get_window; "boxcar" for none."""


def distance_m(xp: Any, x: Any, y: Any, z: Any, place_m: Any) -> Any:
    """Return `|(x, y, z) - place|`, broadcast; `place_m` is [..., 3]."""
    return xp.sqrt((x - place_m[..., 0]) ** 2 + (y - place_m[..., 1]) ** 2 + (z - place_m[..., 2]) ** 2)


def excess_path_m(xp: Any, x: Any, y: Any, z: Any, tx_m: Any, rx_m: Any, reference_m: Any) -> Any:
    """Return the excess path of scatterers at (x, y, z) for antennas at `tx_m` and `rx_m`, float64, broadcast.

    Parameters
    ----------
    xp
        Array API namespace.
    x, y, z
        Positions of scatterers, metres.
    tx_m, rx_m
        Positions of antennas [..., 3], metres.
    reference_m
        Path that is already removed from the phase: in this instrument the direct path.
    """
    return distance_m(xp, x, y, z, tx_m) + distance_m(xp, x, y, z, rx_m) - reference_m


def turn(xp: Any, cycles: Any, real: Any, kind: Any) -> Any:
    """Return exp(-j 2 pi cycles) in the given real and complex dtypes; whole cycles are removed in float64 first.

    Separate cosine and sine are many times faster than the exponential of a complex array.
    """
    phase = xp.astype((cycles - xp.round(cycles)) * (-2.0 * math.pi), real)
    return xp.astype(xp.cos(phase), kind) + xp.astype(xp.sin(phase), kind) * 1j


@dataclass(frozen=True)
class ImageGrid:
    """Pixels of an image: `x_m` [nx] and `y_m` [ny] ascend with spacing `pixel_m`.

    `z_m` is the plane of the pixels, or a surface as float64 [ny, nx].
    """

    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    z_m: float | NDArray[np.float64]
    pixel_m: float

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx)."""
        return self.y_m.size, self.x_m.size

    @property
    def voxels_m(self) -> NDArray[np.float64]:
        """Positions of all pixels, float64 [ny * nx, 3], row by row."""
        y, x = np.meshgrid(self.y_m, self.x_m, indexing="ij")
        return np.stack([x.ravel(), y.ravel(), np.broadcast_to(self.z_m, x.shape).ravel()], axis=1)


def image_grid(rig: Instrument) -> ImageGrid:
    """Return the configured grid on the object plane, centred on the specular midpoint of TX and H."""
    x, y, z = specular_midpoint_m(rig, rig.receivers[0])
    pixel = rig.image.pixel_mm / 1e3

    def axis(n: int, centre: float) -> NDArray[np.float64]:
        return centre + (np.arange(n, dtype=np.float64) - (n - 1) / 2) * pixel

    return ImageGrid(axis(rig.image.columns, x), axis(rig.image.rows, y), z, pixel)


@dataclass(frozen=True)
class Antennas:
    """TX [3] and RX [rx, 3] of one board at stage offset zero, metres."""

    tx_m: NDArray[np.float64]
    rx_m: NDArray[np.float64]

    @classmethod
    def from_rig(cls, rig: Instrument, board: Board) -> Antennas:
        """Return the transmit and receive antennas of a board's image."""
        return cls(np.array(tx_position_m(rig)), np.array(rx_positions_m(rig, board)))

    @property
    def direct_m(self) -> NDArray[np.float64]:
        """Direct path to each RX, [rx]."""
        return np.sqrt(((self.rx_m - self.tx_m) ** 2).sum(axis=1))

    def excess_m(
        self, dx: NDArray[np.float64], dy: NDArray[np.float64], z: float | NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the excess path of points `(dx, dy)` from the stage offset in the plane `z`, metres, [rx, ...]."""
        pairs = zip(self.rx_m, self.direct_m, strict=True)
        return np.stack(
            [excess_path_m(xp=np, x=dx, y=dy, z=z, tx_m=self.tx_m, rx_m=rx, reference_m=direct) for rx, direct in pairs]
        )

    def mirror_m(self, z: float) -> NDArray[np.float64]:
        """Return the path from TX over a mirror in the plane `z` to each RX, [rx]: distance from TX's image."""
        image = self.tx_m * [1, 1, -1] + [0, 0, 2 * z]
        return np.sqrt(((self.rx_m - image) ** 2).sum(axis=1))


def row_offsets_m(rig: Instrument, row: Row) -> NDArray[np.float64]:
    """Return the mean stage offset (x, y) during each burst of a row, metres [position, 2], in order of recording.

    The stage does not stop: a burst is centred half its duration after the trigger point, so even and odd rows differ.
    """
    travel = row.direction * mean_burst_travel_mm(rig.burst, rig.stage)
    x = np.array(row.x_mm) + travel
    return np.stack([x, np.full(row.points, row.y_mm)], axis=1) / 1e3


def scan_offsets_m(rig: Instrument) -> NDArray[np.float64]:
    """Return the mean stage offsets of all rows, metres [row, column, 3], columns from the smallest x."""
    plan = plan_raster(rig.grid)
    offsets = np.zeros((plan.rows, plan.columns, 3))
    # Rows run to and fro: the first two give x of either direction.
    offsets_by_direction = {
        row.direction: row_offsets_m(rig, row)[:: row.direction, 0] for row in itertools.islice(plan, 2)
    }
    rows = list(plan)
    offsets[..., 0] = [offsets_by_direction[row.direction] for row in rows]
    offsets[..., 1] = [[row.y_mm / 1e3] for row in rows]
    return offsets


def find_scene_gate_m(
    antennas: tuple[Antennas, ...], plan: RasterPlan, grid: ImageGrid, depth_m: float = 0.0
) -> tuple[float, float]:
    """Return the smallest and largest excess path of all pixels (`depth_m` nearer and farther) and stage positions."""
    # Margin of 2 mm (chosen) for the travel of the stage within a burst. The largest excess path is at a corner. Near
    # the smallest one the excess path changes little, so that 41 points per axis (chosen) find it closely.
    half_x = ((plan.columns - 1) / 2 * plan.step_x_mm + 2) / 1e3
    half_y = (plan.rows - 1) / 2 * plan.step_y_mm / 1e3
    dx, dy = np.meshgrid(
        np.linspace(grid.x_m[0] - half_x, grid.x_m[-1] + half_x, 41),
        np.linspace(grid.y_m[0] - half_y, grid.y_m[-1] + half_y, 41),
    )
    planes = (float(np.min(grid.z_m)) - depth_m, float(np.max(grid.z_m)) + depth_m)
    excess = np.stack([a.excess_m(dx, dy, z) for a in antennas for z in planes])
    return float(excess.min()), float(excess.max())


def find_needed_gate_m(rig: Instrument, depth_m: float = 0.0) -> tuple[float, float]:
    """Return the smallest and largest excess path in a rig's image, with planes `depth_m` nearer and farther."""
    antennas = tuple(Antennas.from_rig(rig, board) for board in rig.receivers)
    return find_scene_gate_m(antennas, plan_raster(rig.grid), image_grid(rig), depth_m)


@dataclass(frozen=True)
class Aperture:
    """Geometry of one board's measurement of a scene.

    Attributes
    ----------
    antennas
        TX and RX at stage offset zero.
    offsets_m
        float64 [row, column, 3]: true mean stage offset of every position; x ascends in a row.
    frequencies_hz
        float64 [frequency], evenly spaced.
    grid
        Pixels.
    """

    antennas: Antennas
    offsets_m: NDArray[np.float64]
    frequencies_hz: NDArray[np.float64]
    grid: ImageGrid

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of an imager's samples: (rx, frequency, row, column)."""
        return (len(self.antennas.rx_m), self.frequencies_hz.size, *self.offsets_m.shape[:2])


def find_irregularity(aperture: Aperture) -> str | None:
    """Return the reason why positions and pixels do not form a lattice; None if they do."""
    offsets = aperture.offsets_m
    grid = aperture.grid
    if np.ndim(grid.z_m):
        return "the imaged surface is not a plane parallel to the stage"
    if np.abs(offsets[..., 2] - offsets[0, 0, 2]).max() > _SAME_M:
        return "the stage's positions are not in one plane"
    if np.ptp(offsets[..., 1], axis=1).max() > _SAME_M:
        return "the rows are not straight"
    places = np.arange(offsets.shape[1]) * measure_column_step_m(offsets)
    if np.abs(offsets[..., 0] - fit_row_starts_m(offsets)[:, None] - places).max() > _SAME_M:
        return "the positions of a row are not evenly spaced"
    y = offsets[:, 0, 1]
    if np.abs(y - np.linspace(y[0], y[-1], y.size)).max() > _SAME_M:
        return "the rows are not evenly spaced"
    if pitch_y_m(aperture) is None:
        return "the distance of the rows and that of the pixels are not multiples of one length"
    return None


def measure_column_step_m(offsets_m: NDArray[np.float64]) -> float:
    """Return the mean spacing of positions [row, column, axis] in a row, metres; 0 for rows of one position."""
    x = offsets_m[..., 0]
    return float((x[:, -1] - x[:, 0]).mean()) / max(1, x.shape[1] - 1)


def fit_row_starts_m(offsets_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the x of each row's first position, [row]: best fit of evenly spaced positions to the row."""
    x = offsets_m[..., 0]
    return (x - np.arange(x.shape[1]) * measure_column_step_m(offsets_m)).mean(axis=1)


def pitch_y_m(aperture: Aperture) -> float | None:
    """Return the largest common divisor of row spacing and pixel, metres; None if it is below a quarter pixel."""
    y = aperture.offsets_m[:, 0, 1]
    for finer in range(1, _MAX_REFINEMENT + 1):
        pitch = aperture.grid.pixel_m / finer
        cells = (y - y[0]) / pitch
        if np.abs(cells - np.round(cells)).max() * pitch < _SAME_M:
            return pitch
    return None


def design_burst_filters(rig: Instrument) -> NDArray[np.float32]:
    """Return inverse filters of the motion in a burst, float32 [reach, REACH + 1], for each reach from 0 to `REACH`.

    `reach` is the number of taps to either side. The first tap is the middle one, each further one applies on both
    sides. The motion multiplies the spectrum by the mean of cos(2 pi f shift) over the chirps of a burst; the filters
    are least squares fits to the inverse of this loss, for f up to 0.45 cycles per position.
    """
    times_s = np.array(rig.burst.chirp_times_s)
    # Motion of the stage from the middle of the burst to each chirp, in positions.
    shift_positions = (times_s - times_s.mean()) * rig.stage.speed_mm_s / rig.grid.step_x_mm
    frequencies = np.linspace(0, _FILTER_BAND, 91)
    loss = np.cos(2 * np.pi * np.outer(frequencies, shift_positions)).mean(axis=1)
    filters = np.zeros((REACH + 1, REACH + 1))
    filters[0, 0] = 1
    for reach in range(1, REACH + 1):
        # The sum of the taps is one, so that constants keep their amplitude.
        basis = 2 * np.cos(2 * np.pi * np.outer(frequencies, np.arange(1, reach + 1))) - 2
        side = np.linalg.lstsq(basis, 1 / loss - 1, rcond=None)[0]
        filters[reach, 0] = 1 - 2 * side.sum()
        filters[reach, 1 : reach + 1] = side
    return filters.astype(np.float32)


def undo_burst_motion(
    samples: NDArray[np.complex64], valid: NDArray[np.bool_], turn: NDArray[np.float64], filters: NDArray[np.float32]
) -> NDArray[np.complex64]:
    """Compensate the motion of the stage during each burst of a row.

    Parameters
    ----------
    samples
        complex64 [..., position].
    valid
        bool [position]. At each position the filter reaches as far as all neighbours are valid on both sides; not at
        all at the row's ends.
    turn
        float64 [position]: centre of the filter's band, radians per position.
    filters
        Filters that :func:`design_burst_filters` returned.
    """
    count = valid.size
    # Reach of the filter at each position: it grows by one while both neighbours at the next distance are valid.
    reach = np.zeros(valid.size, int)
    for i in range(1, min(REACH, (count - 1) // 2) + 1):
        has_valid_neighbours = np.zeros(count, bool)
        has_valid_neighbours[i : count - i] = valid[: count - 2 * i] & valid[2 * i :] & valid[i : count - i]
        reach += has_valid_neighbours & (reach == i - 1)
    taps = filters[reach]
    filtered = samples * taps[:, 0]
    for i in range(1, int(reach.max(initial=0)) + 1):
        side = (taps[:, i] * np.exp(1j * i * turn)).astype(np.complex64)
        filtered[..., :-i] += side[:-i].conj() * samples[..., i:]
        filtered[..., i:] += side[i:] * samples[..., :-i]
    return filtered


def make_window(name: Window, n: int) -> NDArray[np.float64]:
    """Return a symmetric window, float64 [n]: one of n + 2 points without its end points (zero for some windows)."""
    # Common windows are made with NumPy: scipy.signal loads scipy.stats, which takes a second.
    match name:
        case "boxcar":
            weights = np.ones(n + 2)
        case "hann":
            weights = np.hanning(n + 2)
        case ("kaiser", float(beta)):
            weights = np.kaiser(n + 2, beta)
        case _:
            from scipy.signal import get_window

            weights = np.asarray(get_window(name, n + 2, fftbins=False), np.float64)
    return weights[1:-1]


def find_array_namespace(array: Any) -> Any:
    """Return the array API namespace of an array; numpy for lists and numbers.

    Raises
    ------
    ConfigError
        if the array is of another library and `array-api-compat` is not installed.
    """
    if isinstance(array, np.ndarray | np.generic | list | tuple | float | int | complex):
        return np
    try:
        import array_api_compat
    except ImportError:
        raise ConfigError(
            f"arrays of type {type(array).__module__}.{type(array).__name__} need the package array-api-compat",
            "it is an optional dependency, for GPUs",
            "pip install array-api-compat, or give numpy arrays",
            code=ErrorCode.PACKAGE_MISSING,
        ) from None
    return array_api_compat.array_namespace(array)


def transform_in_place(xp: Any, array: Any, axis: int, inverse: bool = False) -> Any:
    """Return the Fourier transform of complex64 along an axis; it may be in the memory of `array`.

    SciPy's transforms are used for NumPy arrays, because they keep single precision. A result in new memory may take
    three times as long (published grid): the system clears new pages first.
    """
    transforms = scipy.fft if xp is np else xp.fft
    transform = transforms.ifft if inverse else transforms.fft
    if xp is np:
        return transform(array, axis=axis, overwrite_x=True)
    return transform(array, axis=axis)


def get_device(array: Any) -> Any:
    """Return the device of an array; None if its library has none."""
    return getattr(array, "device", None)


@dataclass(frozen=True)
class StageWindow:
    """The scan along one axis (x or y): the specular point of each position on the object plane, and its weight.

    Attributes
    ----------
    places_px
        [position]: specular points, in pixels from the first pixel.
    weights
        [position]: window over the aperture.
    bend_px
        b, radians per pixel^2: an echo from a point at the distance d from the specular point has the phase b d^2 more
        than one from the specular point.
    """

    places_px: NDArray[np.float64]
    weights: NDArray[np.float64]
    bend_px: float

    def level_image(self, ends_px: NDArray[np.float64], columns_px: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return the image of a level plate over that of an endless mirror, at the pixels `columns_px`, [column].

        The plate lies between `ends_px` [2].
        Unless the plate is in the middle of the scan, the scan sees more of its spectrum on one side, so that the phase
        of its image rises. The echo at each position is a Fresnel integral over the plate; the image sums the echoes
        with weight times exp(-j b d^2).
        """
        # Ends of the plate as arguments of the Fresnel integrals, [2, position].
        distance_from_specular = (ends_px[:, None] - self.places_px) * np.sqrt(2 * self.bend_px / np.pi)
        sine, cosine = scipy.special.fresnel(distance_from_specular)
        # Echo of the plate at each position [position]; that of an endless mirror is 1 + j.
        echo = (cosine[1] - cosine[0]) + 1j * (sine[1] - sine[0])
        # [column, position]
        distance = columns_px[:, None] - self.places_px
        kernel = self.weights * np.exp(-1j * self.bend_px * distance**2)
        return np.asarray(kernel @ echo / kernel.sum(axis=1) / (1 + 1j), np.complex128)

    def correct_slope(
        self,
        slope: float,
        inside_px: NDArray[np.intp],
        *,
        slope_per_rad: float,
        profile: NDArray[np.float64],
        lit: NDArray[np.bool_],
        mask_ends_px: NDArray[np.float64],
        moved_px: float,
    ) -> float:
        """Return the rise of a plate, radians, without the apparent rise of a level plate at the same place.

        The apparent rise follows from `level_image`, which needs the plate's ends. Where |H| falls to half shows them,
        but the scan shifts this place, too. So slope and ends are improved in turn, in `ROUNDS` rounds.

        Parameters
        ----------
        slope
            Rise that follows from the phase step between pixels alone, radians.
        inside_px
            Pixels along this axis inside the plate, ascending.
        slope_per_rad
            Rise for a phase step of one radian.
        profile, lit
            |H| along this axis, mean over the plate's lines, [pixel]; True where the scan illuminates it enough (for at
            least one pixel).
        mask_ends_px
            Ends of the plate along this axis by its segmentation, [2].
        moved_px
            A plate with the rise 1 is seen this many pixels away from its place.
        """
        step_rad = slope / slope_per_rad
        columns_px = np.arange(profile.size, dtype=np.float64)
        seen_px = find_ends(profile, lit, inside_px)
        # Between plates that touch, |H| does not fall to half at the end, or does so elsewhere: there the end of the
        # segmentation is taken. A plate that is segmented up to the end of the illuminated part may continue beyond it:
        # its end is taken at infinity.
        touching = np.abs(seen_px - mask_ends_px) > SAME_END_PX
        light_ends_px = np.flatnonzero(lit)[[0, -1]]
        is_end_in_light = np.abs(light_ends_px - mask_ends_px) > SAME_END_PX
        ends_px = np.where(touching, np.where(is_end_in_light, mask_ends_px, [-np.inf, np.inf]), seen_px)
        for _ in range(ROUNDS):
            # A rising plate reflects towards the antennas at other stage positions than a level one at its place: at
            # those of a level plate `level_offset_px` away. The image is computed there.
            level_offset_px = moved_px * slope
            image = self.level_image(ends_px + level_offset_px, columns_px + level_offset_px)
            # Its angle is the mean phase step of the level plate between pixels.
            product = np.vdot(image[inside_px[:-1]], image[inside_px[1:]])
            slope = slope_per_rad * (step_rad - float(np.angle(product)))
            seen_of_level = find_ends(np.abs(image), lit, inside_px)
            # Correct the ends that are illuminated, of the plate and of the level one. The distance between an end and
            # the place where |H| falls to half is taken as the same for both plates.
            is_seen = ~touching & np.isfinite(seen_of_level) & np.isfinite(ends_px)
            off_px = seen_of_level[is_seen] - ends_px[is_seen]
            ends_px[is_seen] = seen_px[is_seen] - END_STEP * off_px
        return slope


def find_ends(profile: NDArray[np.float64], lit: NDArray[np.bool_], inside_px: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return the two places where a plate's |H| falls to half of its median inside, [2], pixels.

    A place is -inf or inf if |H| does not fall to half within `lit`, or if it is already below half at the outermost
    pixel inside.
    """
    half = float(np.median(profile[inside_px])) / 2
    ends = []
    for outwards, start in ((-1, int(inside_px[0])), (1, int(inside_px[-1]))):
        end = outwards * np.inf
        below_half_indices = np.flatnonzero((profile < half)[start::outwards])
        if below_half_indices.size and below_half_indices[0] > 0 and lit[start + outwards * below_half_indices[0]]:
            dark = start + outwards * int(below_half_indices[0])
            bright = dark - outwards
            end = bright + outwards * (profile[bright] - half) / (profile[bright] - profile[dark])
        ends.append(float(end))
    return np.array(ends)
