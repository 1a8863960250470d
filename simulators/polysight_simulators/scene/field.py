"""Object field: the object's echo at every stage position, computed fast and cached.

TX and RX move together in a plane, so the echo depends only on the difference of plate and stage position:
field(u) = integral A(v) g(v - u) dv, a convolution. It is computed in the spectral domain:

* plates and points enter by their analytic Fourier transforms, so edges are exact at any position;
* the kernel g is sampled finely enough for its phase gradient (per axis) and fades out beyond the scene;
* r(theta) of each plate is a short Chebyshev series in the local angle, with one kernel per order;
* only a few Chebyshev nodes of the IF band are computed, with the centre delay removed; the rest is interpolated;
* the result is oversampled, and evaluated at any stage position with a windowed sinc.

The computation is in :mod:`polysight_simulators.scene.spectral`, also for tilted, raised or rough plates.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from polysight_shared.config import Board, Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError
from polysight_shared.tables import to_builtins
from polysight_simulators.scene.field_grid import TAPS
from polysight_simulators.scene.optics import Real
from polysight_simulators.scene.scene_file import Scene
from polysight_simulators.scene.specimens import draw_specimens
from polysight_simulators.scene.spectral import cheb_nodes, compute

_PHYSICS = 2  # version of the content of cached fields

_KAISER_BETA = 8.0


@dataclass(frozen=True)
class ObjectField:
    """Object field of a board on a regular grid of stage offsets.

    Attributes
    ----------
    values
        complex64 [ny, nx, rx, node], without the phase of `centre_path_m`.
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
        """Return the field at stage offsets, complex64 [n, rx, node], without the phase of the centre path.

        Raises
        ------
        DataError
            if an offset lies outside the field's aperture.
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
        """True for offsets inside the field's aperture, bool [n]."""
        inside = np.ones(len(x_m), dtype=np.bool_)
        for axis, u in enumerate((x_m, y_m)):
            low, high = self._reach(axis)
            inside &= (u >= low) & (u <= high)
        return inside

    def _reach(self, axis: int) -> tuple[float, float]:
        """Return the first and last offset with all taps inside the grid, metres; 0 = x, 1 = y."""
        first, step = self.start_m[axis], self.step_m[axis]
        half, n = TAPS // 2, self.values.shape[1 - axis]
        return first + (half - 1) * step, first + (n - half - 1) * step

    def _taps(self, u: Real, axis: int) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Return grid indices [n, taps] and weights of the Kaiser-windowed sinc at offsets u."""
        low, high = self._reach(axis)
        if u.min() < low or u.max() > high:
            raise DataError(
                f"stage offset {1e3 * u[np.argmax(np.abs(u))]:.2f} mm in {'xy'[axis]} is outside the simulated aperture"
                f" {1e3 * low:.2f}..{1e3 * high:.2f} mm",
                "the scan has another grid than the simulated rig",
                "start the simulated rig with the same instrument.toml and scene as the scan",
                code=ErrorCode.MISMATCH,
            )
        position = (u - self.start_m[axis]) / self.step_m[axis]
        index = np.floor(position).astype(np.intp)[:, None] + np.arange(1 - TAPS // 2, 1 + TAPS // 2)
        away = position[:, None] - index
        inner = np.sqrt(np.maximum(0.0, 1 - (2 * away / TAPS) ** 2))
        window = scipy.special.i0(_KAISER_BETA * inner) / scipy.special.i0(_KAISER_BETA)
        return index, (np.sinc(away) * window).astype(np.float32)


def node_matrix(field: ObjectField, frequencies_hz: Real) -> tuple[Real, Real]:
    """Return the interpolation from nodes to frequencies, and its derivative per Hz: two float64 [node, k].

    It uses the discrete orthogonality of the Chebyshev polynomials on their nodes.
    """
    q = len(field.nodes_hz)
    low, high = frequencies_hz[0], frequencies_hz[-1]
    scale = 2.0 / (high - low)
    x = (frequencies_hz - low) * scale - 1.0
    at_nodes = chebyshev.chebvander(cheb_nodes(q), q - 1) * (2.0 / q)
    at_nodes[:, 0] /= 2.0
    derivative = chebyshev.chebder(np.eye(q), axis=0)
    values = chebyshev.chebvander(x, q - 1)
    slopes = chebyshev.chebvander(x, max(q - 2, 0)) @ derivative
    return at_nodes @ values.T, at_nodes @ slopes.T * scale


def build_field(
    rig: Instrument,
    scene: Scene,
    board: Board,
    samples_hz: Real,
    cache_dir: Path | None = None,
    rx: Sequence[int] | None = None,
) -> ObjectField:
    """Compute the object field of a board over the aperture of the rig's grid, or read it from the cache.

    Parameters
    ----------
    rig, scene, board
        Rig with the scene applied, the scene, and one of the rig's receiving boards.
    samples_hz
        Transmit frequency of the ADC samples, ascending. If there are fewer than the nodes needed for interpolation,
        the field is computed at the samples.
    cache_dir
        Folder that caches fields between runs, keyed by everything they depend on; None: no cache.
    rx
        Channels to compute; None for all.

    Raises
    ------
    DataError
        if a cached file cannot be read.
    """
    scene = draw_specimens(scene)
    rx = range(len(rig.antennas.rx_mm)) if rx is None else rx
    if cache_dir is None:
        return ObjectField(*compute(rig, scene, board, samples_hz, rx))
    d = scene.disturbances
    key = to_builtins([rig, scene.plates, scene.points, scene.object_gain, d.leakage_h, d.leakage_v, d.backlash_mm])
    drawn = scene.seed if any(p.rough_mm for p in scene.plates) else None
    text = json.dumps([_PHYSICS, key, board.name, list(samples_hz), list(rx), drawn], sort_keys=True)
    path = cache_dir / f"field-{hashlib.sha256(text.encode()).hexdigest()[:24]}.npz"
    if path.exists():
        try:
            with np.load(path, allow_pickle=False) as f:
                sx, sy = f["start_m"], f["step_m"]
                return ObjectField(
                    f["values"], (sx[0], sx[1]), (sy[0], sy[1]), f["nodes_hz"], float(f["centre_path_m"])
                )
        except (OSError, ValueError, KeyError) as e:
            raise DataError(
                f"{path}: not a field: {e}", "an interrupted write", "delete the file", code=ErrorCode.FILE_DAMAGED
            ) from None
    field = ObjectField(*compute(rig, scene, board, samples_hz, rx))
    cache_dir.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(f".{board.name}.tmp.npz")
    np.savez(partial, allow_pickle=False, **vars(field))
    partial.replace(path)
    return field
