"""The object's echo at every stage position, fast.

TX and RX move together and the plane is parallel to the stage, so the echo depends on plate and stage position only
through their difference: field(u) = integral A(v) g(v - u) dv, a convolution. It is done in the spectral domain:

* plates and points enter through their analytic Fourier transforms, so edges are exact and lie anywhere;
* the kernel g is sampled just finely enough for its phase gradient (per axis) and fades out beyond the scene's reach;
* r(theta) of each plate is a short Chebyshev series in the local angle, one kernel for each order;
* only a few Chebyshev nodes of the IF band are computed, with the centre delay removed; the rest is interpolated;
* the result is kept oversampled and read at any stage position through a windowed sinc.

:func:`spectral_axes` says how far the kernel must reach, and how fine it must be, in x and in y.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.fft
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.special import i0

from polysight.shared.config import Board, Instrument
from polysight.shared.errors import DataError
from polysight.shared.raster import mean_burst_travel_mm
from polysight.shared.tables import to_builtins
from polysight.shared.units import SPEED_OF_LIGHT_M_S
from polysight.simulators.scene.optics import (
    Antennas,
    Real,
    Reflectivity,
    antennas,
    board_reflectivity,
    direct_factor,
    plate_scale,
    point_scale,
    sampled,
)
from polysight.simulators.scene.scene_file import Scene

FADE_M = 0.06  # the kernel's fade-out beyond the reach of the scene
TAPS = 12  # of the windowed sinc
MARGIN_M = 0.012  # offsets beyond the aperture that the sinc's taps need
OVERSAMPLING = 2


@dataclass(frozen=True)
class Axis:
    """One axis of the computation: spectral grid and the wanted offsets, metres."""

    low_u: float
    high_u: float
    low_w: float
    high_w: float
    step: float
    points: int

    @property
    def w(self) -> Real:
        """Kernel positions (object point minus stage offset)."""
        return self.low_w - FADE_M + self.step * np.arange(self.points)

    @property
    def fade(self) -> Real:
        """1 within reach of the scene, a smooth way to 0 outside."""
        w = self.w
        beyond = np.maximum(self.low_w - w, w - self.high_w) / FADE_M
        return np.cos(np.pi / 2 * np.clip(beyond, 0.0, 1.0)) ** 4

    @property
    def kappa(self) -> Real:
        """Spatial frequencies of the DFT, rad/m."""
        return 2 * np.pi * np.fft.fftfreq(self.points, self.step)

    @property
    def first_u(self) -> float:
        """First offset of the output grid: some taps before the aperture."""
        return self.low_u - (TAPS // 2) * self.step / OVERSAMPLING

    @property
    def outputs(self) -> int:
        """Offsets of the output grid."""
        return int(np.ceil((self.high_u - self.low_u) / self.step * OVERSAMPLING)) + TAPS + 1


def spectral_axes(rig: Instrument, scene: Scene, ant: Antennas, top_hz: float) -> tuple[Axis, Axis]:
    """Extent and pitch in x and y from the scene's reach and the kernel's steepest phase."""
    travel = 2 * mean_burst_travel_mm(rig.burst, rig.stage) + abs(scene.disturbances.backlash_mm)
    edges = [(*p.centre_mm, p.size_mm[0] / 2, p.size_mm[1] / 2) for p in scene.plates]
    edges += [(*p.position_mm, 0.0, 0.0) for p in scene.points]
    table = np.array(edges or [(0.0, 0.0, 0.0, 0.0)])
    spans = []
    for i, (n, step, extra) in enumerate(
        ((rig.grid.columns, rig.grid.step_x_mm, travel + 1.0), (rig.grid.rows, rig.grid.step_y_mm, 1.0))
    ):
        half = (n - 1) / 2 * step + extra
        low_v = ant.centre_m[i] * 1e3 + np.min(table[:, i] - table[:, i + 2])
        high_v = ant.centre_m[i] * 1e3 + np.max(table[:, i] + table[:, i + 2])
        spans.append(np.array([-half, half, low_v - half, high_v + half]) / 1e3 + [0, 0, -MARGIN_M, MARGIN_M])
    corners = np.meshgrid(*(np.linspace(s[2] - FADE_M, s[3] + FADE_M, 9) for s in spans))
    wave = 2 * np.pi * top_hz / SPEED_OF_LIGHT_M_S
    axes = []
    for i, span in enumerate(spans):
        steepest = 0.0
        for rx in ant.rx_m:
            slope = np.zeros_like(corners[0])
            for antenna in (ant.tx_m, rx):
                away = np.stack([corners[0] - antenna[0], corners[1] - antenna[1]])
                slope += away[i] / np.sqrt(away[0] ** 2 + away[1] ** 2 + (ant.plane_z_m - antenna[2]) ** 2)
            steepest = max(steepest, wave * float(np.abs(slope).max()))
        step = min(np.pi / (1.1 * steepest + 6 * np.pi / FADE_M), 4e-3)
        points = int(scipy.fft.next_fast_len(int(np.ceil((span[3] - span[2] + 2 * FADE_M) / step)) + 1) or 0)
        axes.append(Axis(span[0], span[1], span[2], span[3], step, points))
    return axes[0], axes[1]


_PHYSICS = 2  # counts changes of what a cached field holds

_KAISER_BETA = 8.0
_ANGLE_TOLERANCE = 1e-4  # of the Chebyshev series in the local angle


@dataclass(frozen=True)
class ObjectField:
    """Object field of one board on a regular grid of stage offsets.

    Attributes
    ----------
    values
        complex64 [ny, nx, rx, node], the phase of `centre_path_m` removed.
    start_m, step_m
        First offset and pitch in (x, y), metres.
    nodes_hz
        Frequencies of the nodes.
    centre_path_m
        Path whose phase was removed.
    """

    values: NDArray[np.complex64]
    start_m: tuple[float, float]
    step_m: tuple[float, float]
    nodes_hz: Real
    centre_path_m: float

    def at(self, x_m: Real, y_m: Real) -> NDArray[np.complex64]:
        """Field at stage offsets, complex64 [n, rx, node], centre path removed.

        Raises
        ------
        DataError
            when an offset lies outside the field's aperture.
        """
        x_m, y_m = np.broadcast_arrays(np.asarray(x_m, np.float64), np.asarray(y_m, np.float64))
        ix, wx = self._taps(x_m, 0)
        out = np.empty((len(x_m), *self.values.shape[2:]), dtype=np.complex64)
        for y in np.unique(y_m):
            iy, wy = self._taps(np.array([y]), 1)
            on = np.flatnonzero(y_m == y)
            low, high = ix[on].min(), ix[on].max() + 1
            line = np.einsum("t,tx...->x...", wy[0], self.values[iy[0], low:high])
            out[on] = np.einsum("nt,nt...->n...", wx[on], line[ix[on] - low])
        return out

    def covers(self, x_m: Real, y_m: Real) -> NDArray[np.bool_]:
        """Whether offsets lie inside the aperture this field can be read at, bool [n]."""
        inside = np.ones(len(x_m), dtype=np.bool_)
        for axis, u in enumerate((x_m, y_m)):
            low, high = self._reach(axis)
            inside &= (u >= low) & (u <= high)
        return inside

    def _reach(self, axis: int) -> tuple[float, float]:
        """First and last offset with all taps inside the grid, metres; 0 = x, 1 = y."""
        first, step = self.start_m[axis], self.step_m[axis]
        half, n = TAPS // 2, self.values.shape[1 - axis]
        return first + (half - 1) * step, first + (n - half - 1) * step

    def _taps(self, u: Real, axis: int) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Grid indices [n, taps] and weights of the Kaiser-windowed sinc at offsets u."""
        low, high = self._reach(axis)
        if u.min() < low or u.max() > high:
            raise DataError(
                f"stage offset {1e3 * u[np.argmax(np.abs(u))]:.2f} mm in {'xy'[axis]} is outside the simulated aperture"
                f" {1e3 * low:.2f}..{1e3 * high:.2f} mm",
                "the scan does not follow the grid the simulated rig was started with",
                "start the simulated rig with the same instrument.toml and scene as the scan",
            )
        position = (u - self.start_m[axis]) / self.step_m[axis]
        index = np.floor(position).astype(np.intp)[:, None] + np.arange(1 - TAPS // 2, 1 + TAPS // 2)
        away = position[:, None] - index
        window = i0(_KAISER_BETA * np.sqrt(np.maximum(0.0, 1 - (2 * away / TAPS) ** 2))) / i0(_KAISER_BETA)
        return index, (np.sinc(away) * window).astype(np.float32)


def node_matrix(field: ObjectField, frequencies_hz: Real) -> tuple[Real, Real]:
    """Interpolation from the nodes to frequencies, and its derivative per Hz: two float64 [node, k].

    Barycentric in effect: discrete orthogonality of the Chebyshev polynomials on their own nodes.
    """
    q = len(field.nodes_hz)
    low, high = frequencies_hz[0], frequencies_hz[-1]
    scale = 2.0 / (high - low)
    x = (frequencies_hz - low) * scale - 1.0
    at_nodes = chebyshev.chebvander(_cheb_nodes(q), q - 1) * (2.0 / q)
    at_nodes[:, 0] /= 2.0
    derivative = chebyshev.chebder(np.eye(q), axis=0)
    values = chebyshev.chebvander(x, q - 1)
    slopes = chebyshev.chebvander(x, max(q - 2, 0)) @ derivative
    return at_nodes @ values.T, at_nodes @ slopes.T * scale


def build_field(
    rig: Instrument, scene: Scene, board: Board, samples_hz: Real, cache_dir: Path | None = None
) -> ObjectField:
    """Object field of one board over the aperture of the rig's grid.

    Parameters
    ----------
    rig, scene, board
        Rig with the scene applied, the scene, and one of the rig's receiving boards.
    samples_hz
        Transmit frequency of the ADC samples; nodes span first to last.
    cache_dir
        Where fields are kept between runs, keyed by everything they depend on; None keeps nothing.

    Raises
    ------
    DataError
        when the cache holds a file that cannot be read.
    """
    if cache_dir is None:
        return _compute(rig, scene, board, samples_hz)
    d = scene.disturbances
    key = to_builtins([rig, scene.plates, scene.points, scene.object_gain, d.leakage_h, d.leakage_v, d.backlash_mm])
    text = json.dumps([_PHYSICS, key, board.name, list(samples_hz[[0, -1]])], sort_keys=True)
    path = cache_dir / f"field-{hashlib.sha256(text.encode()).hexdigest()[:24]}.npz"
    if path.exists():
        try:
            with np.load(path, allow_pickle=False) as f:
                sx, sy = f["start_m"], f["step_m"]
                return ObjectField(
                    f["values"], (sx[0], sx[1]), (sy[0], sy[1]), f["nodes_hz"], float(f["centre_path_m"])
                )
        except (OSError, ValueError, KeyError) as e:
            raise DataError(f"{path}: not a field: {e}", "an interrupted write", "delete the file") from None
    field = _compute(rig, scene, board, samples_hz)
    cache_dir.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(f".{board.name}.tmp.npz")
    np.savez(partial, allow_pickle=False, **vars(field))
    partial.replace(path)
    return field


def _cheb_nodes(q: int) -> Real:
    return np.cos(np.pi * (np.arange(q) + 0.5) / q)


def _angle_series(
    scene: Scene, reflect: Reflectivity, nodes_hz: Real, theta: tuple[float, float]
) -> NDArray[np.complexfloating]:
    """Chebyshev coefficients of r(theta) for each plate and node, [plate, node, order]; as few orders as suffice."""
    centre, half = (theta[0] + theta[1]) / 2, max((theta[1] - theta[0]) / 2, 1e-9)
    many = 16
    x = _cheb_nodes(many)
    to_series = chebyshev.chebvander(x, many - 1).T * (2.0 / many)
    to_series[0] /= 2.0
    rows = [[reflect(p, f, centre + half * x) for f in nodes_hz] for p in scene.plates]
    values = np.array(rows, dtype=np.complex128)
    series = np.einsum("pfm,jm->pfj", values.reshape(len(scene.plates), len(nodes_hz), many), to_series)
    tail = np.cumsum(np.abs(series).max(axis=(0, 1), initial=0.0)[::-1])[::-1]
    orders = max(1, int(np.sum(tail > _ANGLE_TOLERANCE)))
    return series[:, :, :orders]


def _spectra(axis: Axis, centres: Real, sizes: Real) -> NDArray[np.complexfloating]:
    """Fourier transforms of intervals (or points, size 0) along one axis, [item, kappa], phase-shifted to the grid."""
    k = axis.kappa
    width = np.where(sizes > 0, sizes, 1.0)[:, None]
    shift = axis.w[0] + axis.first_u - centres
    envelope = width * np.sinc(np.outer(sizes, k) / (2 * np.pi))
    return envelope.astype(np.complex128) * np.exp(1j * np.outer(shift, k))


def _outer(
    y: NDArray[np.complexfloating], weight: NDArray[np.complexfloating], x: NDArray[np.complexfloating]
) -> NDArray[np.complex64]:
    """Weighted sum of outer products over items, [kappa_y, kappa_x]; without BLAS and its threads."""
    scaled = (y * weight[:, None]).astype(np.complex64)
    return np.einsum("py,px->yx", scaled, x.astype(np.complex64))


def _compute(rig: Instrument, scene: Scene, board: Board, samples_hz: Real) -> ObjectField:
    ant, reflect = antennas(rig, board), board_reflectivity(board, scene)
    ax, ay = spectral_axes(rig, scene, ant, float(samples_hz[-1]))
    wx, wy = np.meshgrid(ax.w, ay.w)
    legs = [ant.legs(wx, wy, rx) for rx in range(len(ant.rx_m))]
    paths = np.stack([r1 + r2 for r1, r2, _, _ in legs])
    reach = paths[:, (ay.fade == 1)[:, None] & (ax.fade == 1)]
    inside = 0.0
    for p in scene.plates:  # inner echoes lengthen the response
        depth = sum((layer.thickness_mm or 0.0) / 1e3 * abs(np.sqrt(layer.epsilon)) for layer in p.stack)
        inside = max(inside, 4 * depth)
    spread = float(reach.max() - reach.min()) + 2 * inside
    centre = float(reach.max() + reach.min()) / 2
    # Time-bandwidth product plus a few: interpolation error of the Chebyshev series below 1e-6.
    nodes = int(np.ceil((samples_hz[-1] - samples_hz[0]) * spread / SPEED_OF_LIGHT_M_S)) + 8
    nodes_hz = samples_hz[0] + (samples_hz[-1] - samples_hz[0]) * (_cheb_nodes(nodes) + 1) / 2

    theta_low, theta_high = min(leg[2].min() for leg in legs), max(leg[2].max() for leg in legs)
    series = _angle_series(scene, reflect, nodes_hz, (theta_low, theta_high))
    plates = np.array([(*p.centre_mm, *p.size_mm) for p in scene.plates]).reshape(-1, 4) / 1e3
    points = np.array([p.position_mm for p in scene.points]).reshape(-1, 2) / 1e3
    plate_x = _spectra(ax, ant.centre_m[0] + plates[:, 0], plates[:, 2])
    plate_y = _spectra(ay, ant.centre_m[1] + plates[:, 1], plates[:, 3])
    none = np.zeros(len(points))
    point_x = _spectra(ax, ant.centre_m[0] + points[:, 0], none)
    point_y = _spectra(ay, ant.centre_m[1] + points[:, 1], none)
    amplitudes = sampled(np.array([complex(*p.amplitude) for p in scene.points])) * point_scale(ant)
    amplitudes = amplitudes * direct_factor(board, scene)

    fade = np.outer(ay.fade, ax.fade)
    angle = chebyshev.chebvander(
        (np.stack([leg[2] for leg in legs]) - (theta_low + theta_high) / 2) / max((theta_high - theta_low) / 2, 1e-9),
        series.shape[2] - 1,
    )
    values = np.empty((ay.outputs, ax.outputs, len(ant.rx_m), nodes), dtype=np.complex64)
    for q, f in enumerate(nodes_hz):
        maps = [
            _outer(plate_y, series[:, q, j] * plate_scale(ant, scene, f), plate_x)
            for j in range(series.shape[2] if len(plates) else 0)
        ]
        point_map = _outer(point_y, amplitudes, point_x) if len(points) else None
        for rx, (r1, r2, _, oblique) in enumerate(legs):
            phase = np.exp(2j * np.pi * f / SPEED_OF_LIGHT_M_S * (paths[rx] - centre))
            base = phase * (fade / (r1 * r2))
            total = np.zeros(base.shape, dtype=np.complex64)
            for j, plate_map in enumerate(maps):
                kernel = (base * oblique * angle[rx, :, :, j]).astype(np.complex64)
                total += plate_map * np.asarray(scipy.fft.ifft2(kernel, norm="forward"))
            if point_map is not None:
                total += point_map * np.asarray(scipy.fft.ifft2(base.astype(np.complex64), norm="forward"))
            values[:, :, rx, q] = _oversampled(_oversampled(total, ay, 0), ax, 1)
    step = (ax.step / OVERSAMPLING, ay.step / OVERSAMPLING)
    return ObjectField(values, (ax.first_u, ay.first_u), step, nodes_hz, centre)


def _oversampled(spectrum: NDArray[np.complex64], axis: Axis, along: int) -> NDArray[np.complex64]:
    """Inverse DFT along one axis onto the finer output grid, cut to the wanted offsets."""
    n = axis.points
    shape = list(spectrum.shape)
    shape[along] = n * OVERSAMPLING
    padded = np.zeros(shape, dtype=np.complex64)
    head, tail = (n + 1) // 2, n // 2
    lead = (slice(None),) * along
    padded[(*lead, slice(0, head))] = spectrum[(*lead, slice(0, head))]
    padded[(*lead, slice(-tail, None))] = spectrum[(*lead, slice(n - tail, n))]
    line = np.asarray(scipy.fft.ifft(padded, axis=along), dtype=np.complex64)
    line *= np.float32(OVERSAMPLING)
    return line[(*lead, slice(0, axis.outputs))]
