"""Data of a scan by convolutions: facets on the lattice of the stage, so that all positions see the same kernels.

A plate is a height field over cells of one stage step. With d = cell - offset, a cell gives mask(cell) x kernel(d): the
kernel holds patterns, polarisation, reflection and phase of a facet of the plate's mean slope at the reference height.
Height differences delta (tilt, waviness, roughness) multiply by exp(-jk c(d) delta), where c = d path / d z hardly
varies; what varies is a short Taylor series. Slopes of a rough surface turn the local normal, to first order.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from polysight_worlds.media import LIGHT_M_PER_S, ReflectionTable
from polysight_worlds.optics import Antenna, Waves, integrate_steps, respond, scatter
from polysight_worlds.rig import Rig
from polysight_worlds.world import Plate, World

# Correlation lengths of the random heights; chosen: about a wavelength, and several.
ROUGHNESS_LENGTH_M = 0.005
WAVINESS_LENGTH_M = 0.020
# The Taylor series ends where its next term is below this; chosen.
SERIES_ERROR = 2e-3
# Difference of slopes by which the change of an echo with the slope is computed; chosen.
SLOPE_STEP = 0.01


@dataclass(frozen=True)
class Surface:
    """Cells of a plate, [rows, columns]: x, y of the first (metres), cover 0..1, z beyond the reference plane, slopes.

    `local_slopes` are those of bow, waviness and roughness, without the mean ones; None on a flat plate.
    """

    x0_m: float
    y0_m: float
    cover: NDArray
    height_m: NDArray
    local_slopes: tuple[NDArray, NDArray] | None
    mean_slopes: tuple[float, float]


def make_surface(plate: Plate, step_m: float, rng: np.random.Generator) -> Surface:
    """Cut a plate into cells of one stage step; cells at the edges are covered in part."""
    columns, rows = (int(np.ceil(size / step_m - 1e-6)) for size in plate.size_m)
    x = (np.arange(columns) - (columns - 1) / 2) * step_m
    y = (np.arange(rows) - (rows - 1) / 2) * step_m
    cover_x, cover_y = (
        np.clip((size / 2 - np.abs(places)) / step_m + 0.5, 0, 1)
        for size, places in zip(plate.size_m, (x, y), strict=True)
    )
    cover = np.outer(cover_y, cover_x)
    if plate.round_:
        from_rim = 0.5 - np.hypot(x / plate.size_m[0], y[:, None] / plate.size_m[1])
        cover = np.clip(from_rim * min(plate.size_m) / step_m + 0.5, 0, 1)
    mean_slopes = np.tan(np.radians(plate.tilt_x_deg)), np.tan(np.radians(plate.tilt_y_deg))
    bumps = np.zeros((rows, columns))
    for rms_mm, length_m in ((plate.roughness_mm, ROUGHNESS_LENGTH_M), (plate.waviness_mm, WAVINESS_LENGTH_M)):
        if rms_mm:
            bumps += rms_mm / 1000 * _draw_surface(rng, bumps.shape, length_m / step_m)
    bows = (np.square(2 * places / size) for size, places in zip(plate.size_m, (x, y), strict=True))
    bow_x, bow_y = (bow_mm / 1000 * bow for bow_mm, bow in zip(plate.bow_mm, bows, strict=True))
    bumps = bumps + bow_x + bow_y[:, None]
    slopes = None
    if bumps.any():
        slopes = np.asarray(np.gradient(bumps, step_m, axis=1)), np.asarray(np.gradient(bumps, step_m, axis=0))
    height = bumps + mean_slopes[0] * x + mean_slopes[1] * y[:, None]
    return Surface(
        x0_m=plate.centre_m[0] + x[0],
        y0_m=plate.centre_m[1] + y[0],
        cover=cover,
        height_m=height,
        local_slopes=slopes,
        mean_slopes=mean_slopes,
    )


def _draw_surface(rng: np.random.Generator, shape: tuple[int, int], length_cells: float) -> NDArray:
    """Return a Gaussian random surface of this shape, of rms 1 and correlation exp(-(d / length)^2)."""
    # White noise filtered with sigma has the correlation exp(-d^2 / 4 sigma^2).
    sigma = length_cells / 2
    pad = int(np.ceil(4 * sigma))
    noise = rng.standard_normal((shape[0] + 2 * pad, shape[1] + 2 * pad))
    smooth = ndimage.gaussian_filter(noise, sigma)[pad:-pad, pad:-pad]
    # The filter's own variance, not the sample's: a small plate may happen to be smooth.
    return smooth * 2 * np.sqrt(np.pi) * sigma


def _compute_normal(slopes: tuple[float, float]) -> NDArray:
    """Return the unit normal towards the antennas of a surface z = slope_x x + slope_y y."""
    normal = np.array([slopes[0], slopes[1], -1.0])
    return normal / np.linalg.norm(normal)


class PlateEchoes:
    """One plate's echoes at one receiver, frequency by frequency."""

    def __init__(self, rig: Rig, rx: Antenna, plate: Plate, surface: Surface) -> None:
        self._rig = rig
        self._surface = surface
        self._brightness = plate.brightness
        rows, columns = surface.cover.shape
        self._shape = fast_length(rig.rows + rows - 1), fast_length(rig.columns + columns - 1)
        waves = Waves.between(rig.tx, rx, self._list_points(plate))
        # What a facet gives before medium and frequency are known: at the mean slopes, and with either slope varied.
        slopes = surface.mean_slopes
        variations = [slopes]
        if surface.local_slopes is not None:
            variations += [(slopes[0] + SLOPE_STEP, slopes[1]), (slopes[0], slopes[1] + SLOPE_STEP)]
        self._responses = [respond(waves, _compute_normal(varied)) for varied in variations]
        # A medium without layers reflects equally at all frequencies: one table is enough.
        table_frequencies_hz = rig.frequencies_hz if plate.stack.layers else rig.frequencies_hz[:1]
        self._tables = [ReflectionTable(plate.stack, f) for f in table_frequencies_hz]
        self._reflections: list[NDArray] = []
        main = self._responses[0]
        along_x, along_y = self._find_edges()
        # How much the path changes across a facet, in x and y.
        self._steps_m = main.path_steps(along_x, along_y)
        self._phase = _PhaseSteps(main.path_m, rig.frequencies_hz)
        # Height differences change the path by c delta, with c = d path / d z: the mean of c goes into the mask, the
        # deviations from it into the Taylor series.
        weight = np.abs(main.s_weight) + np.abs(main.p_weight)
        weight /= np.sum(weight)
        self._rise_mean = float(np.sum(weight * main.gradient[2]))
        self._rise_deviation = main.gradient[2] - self._rise_mean
        bend_mean = float(np.sum(weight * main.curvature_z))
        # What the heights add to the path of each cell, to second order, with the means of c and of its derivative.
        self._height_path_m = self._rise_mean * surface.height_m + bend_mean / 2 * surface.height_m**2
        k = 2 * np.pi * rig.frequencies_hz[-1] / LIGHT_M_PER_S
        rms_phase = k * np.abs(surface.height_m).max() * np.sqrt(np.sum(weight * self._rise_deviation**2))
        # Twice the rms is taken as the largest phase. The series has one term at least, and twelve at most (chosen).
        self._orders = 1
        term = 2 * rms_phase
        while term > SERIES_ERROR and self._orders < 12:
            self._orders += 1
            term *= 2 * rms_phase / self._orders

    def _list_points(self, plate: Plate) -> NDArray:
        """Return cell minus offset for all circular lags, [3, lags_y, lags_x], and z of the plate's reference height.

        A lag is the index of the offset minus that of the cell.
        """
        rig = self._rig
        surface = self._surface
        offsets_x, offsets_y = rig.offsets_m()
        x = surface.x0_m - offsets_x[0] - signed_lags(self._shape[1], rig.columns) * rig.step_m
        y = surface.y0_m - offsets_y[0] - signed_lags(self._shape[0], rig.rows) * rig.step_m
        z = rig.plane_m - plate.height_mm / 1000
        return np.stack(np.broadcast_arrays(x[None, :], y[:, None], z))

    def _find_edges(self) -> tuple[NDArray, NDArray]:
        """Return edges of a cell along x and y, [3] each."""
        step = self._rig.step_m
        slope_x, slope_y = self._surface.mean_slopes
        return np.array([step, 0, slope_x * step]), np.array([0, step, slope_y * step])

    def _reflect(self, index: int) -> list[NDArray]:
        """Return the reflection of cells of each slope at frequency `index`."""
        if not self._reflections or len(self._tables) > 1:
            self._reflections = []
            for response in self._responses:
                r_s, r_p = self._tables[index].look_up(response.cos_incidence)
                self._reflections.append(r_s * response.s_weight + r_p * response.p_weight)
        return self._reflections

    def add_echoes(self, data: NDArray, index: int) -> None:
        """Add the echoes at frequency `index` to complex `data` [rows, columns]."""
        rig = self._rig
        surface = self._surface
        frequency_hz = rig.frequencies_hz[index]
        k = 2 * np.pi * frequency_hz / LIGHT_M_PER_S
        phase_integral = integrate_steps(self._steps_m, frequency_hz)
        area_m2 = float(np.linalg.norm(np.cross(*self._find_edges())))
        # Physical optics of a facet, see `optics.Response`.
        common = (1j * k / (4 * np.pi) * area_m2 * phase_integral).astype(np.complex64) * self._phase.phases(index)
        mean_reflection, *varied_reflections = self._reflect(index)
        kernel = (common * mean_reflection).astype(np.complex64)
        mask = self._brightness * surface.cover * np.exp(-1j * k * self._height_path_m)
        spectrum = self._multiply(mask, kernel)
        # Local slopes to first order: slope times the change of the kernel with it.
        if surface.local_slopes is not None:
            for slope, varied in zip(surface.local_slopes, varied_reflections, strict=True):
                spectrum += self._multiply(mask * slope, common * (varied - mean_reflection) / SLOPE_STEP)
        # Taylor series of exp(-jk (c - mean c) delta): each order multiplies by one factor of height and one of c.
        for order in range(1, self._orders):
            mask = mask * surface.height_m
            kernel = kernel * (-1j * k / order * self._rise_deviation).astype(np.complex64)
            spectrum += self._multiply(mask, kernel)
        data += ifft2(spectrum)[: rig.rows, : rig.columns]

    def _multiply(self, mask: NDArray, kernel: NDArray) -> NDArray:
        """Return the spectrum of the convolution of mask and kernel."""
        return fft2(mask.astype(np.complex64), self._shape) * fft2(kernel.astype(np.complex64))


def fast_length(length: int) -> int:
    """Return the length of at least `length` that an FFT does fast."""
    return int(fft.next_fast_len(length) or length)


def fft2(values: NDArray, shape: tuple[int, int] | None = None) -> NDArray:
    """Return the two-dimensional spectrum, padded to `shape`, in the precision of `values`."""
    rows, columns = shape or values.shape[-2:]
    # Along y first: padding adds columns of zeros, whose spectrum along y is zero and need not be computed.
    return np.asarray(fft.fft(fft.fft(values, rows, axis=-2), columns, axis=-1))


def ifft2(spectrum: NDArray) -> NDArray:
    """Return the inverse of `fft2`."""
    return np.asarray(fft.ifft2(spectrum))


def signed_lags(length: int, positive: int) -> NDArray:
    """Return lags [length] of a circular convolution: 0 .. positive - 1, then the negative ones."""
    lags = np.arange(length)
    return np.where(lags < positive, lags, lags - length)


class _PhaseSteps:
    """exp(-jk path) for evenly spaced frequencies, each made from the one before."""

    def __init__(self, path_m: NDArray, frequencies_hz: NDArray) -> None:
        delay_s = path_m / LIGHT_M_PER_S
        self._now = np.exp(-2j * np.pi * frequencies_hz[0] * delay_s).astype(np.complex64)
        spacing_hz = frequencies_hz[1] - frequencies_hz[0] if len(frequencies_hz) > 1 else 0.0
        self._factor = np.exp(-2j * np.pi * spacing_hz * delay_s).astype(np.complex64)
        self._index = 0

    def phases(self, index: int) -> NDArray:
        """Return phases of frequency `index`, of the path's shape; indices are asked for in rising order."""
        while self._index < index:
            self._now = self._now * self._factor
            self._index += 1
        return self._now


def record(rig: Rig, rx: Antenna, world: World, seed: int = 0) -> NDArray:
    """Return echoes of a world at one receiver: complex64 [frequencies, rows, columns], fields as of `optics.scatter`.

    Frequencies must be evenly spaced. `seed`: of rough surfaces, the same for both receivers.
    """
    data = np.zeros((len(rig.frequencies_hz), rig.rows, rig.columns), np.complex64)
    for number, plate in enumerate(world.plates):
        # The 2 keeps these numbers independent of others that are drawn with the same seed.
        rng = np.random.default_rng([seed, 2, number])
        echoes = PlateEchoes(rig, rx, plate, make_surface(plate, rig.step_m, rng))
        for index in range(len(rig.frequencies_hz)):
            echoes.add_echoes(data[index], index)
    x, y = (grid.ravel() for grid in np.meshgrid(*rig.offsets_m()))
    offsets = np.stack([x, y, np.zeros_like(x)], axis=1)
    for body in world.bodies:
        sums = scatter(rig.tx, rx, body.facets, body.stack, rig.frequencies_hz, offsets)
        data += sums.T.reshape(data.shape).astype(np.complex64)
    return data
