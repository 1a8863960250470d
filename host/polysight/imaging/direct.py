"""Direct imager: matched filter by direct summation, for any antennas, positions and voxels.

`xp` is the array library of the samples (array API standard): NumPy, or one of a GPU.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Protocol, TypeVar, overload

import numpy as np
import numpy.typing as npt

from polysight.imaging.geometry import Aperture, excess_path_m, find_array_namespace, get_device, turn
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# Products of position and voxel that are in memory at a time (chosen).
_CHUNK = 1 << 20


class ApiArray(Protocol):
    """An array of any array API library."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values along each dimension."""
        ...


Array = TypeVar("Array", bound=ApiArray)


@overload
def backproject(
    samples: npt.NDArray[Any],
    frequencies_hz: ApiArray,
    tx_m: ApiArray,
    rx_m: ApiArray,
    voxels_m: ApiArray,
    reference_m: ApiArray,
) -> npt.NDArray[np.complex128]: ...
@overload
def backproject(
    samples: Array, frequencies_hz: ApiArray, tx_m: ApiArray, rx_m: ApiArray, voxels_m: ApiArray, reference_m: ApiArray
) -> Array: ...
def backproject(
    samples: Array | npt.NDArray[Any],
    frequencies_hz: ApiArray,
    tx_m: ApiArray,
    rx_m: ApiArray,
    voxels_m: ApiArray,
    reference_m: ApiArray,
) -> Array | npt.NDArray[np.complex128]:
    """Backproject samples (POLySIGHT paper, Eq. 6, with the exponent's sign of the conjugate of the received phase).

    `image(v) = sum_p sum_f samples[p, f] exp(-j 2 pi f (|v - tx_p| + |v - rx_p| - reference_p) / c)`

    Parameters
    ----------
    samples
        complex [position, frequency], phase +2 pi f tau, of any array API library and device. One antenna pair per
        position; several RX are several positions.
    frequencies_hz
        float [frequency]; evenly spaced ones are summed by Horner's rule.
    tx_m, rx_m
        float [position, 3], metres.
    voxels_m
        float [n, 3], metres.
    reference_m
        float [position]: path already removed from the phase (the direct path; twice the range to the scene's centre
        for a monostatic radar referenced to it; 0 for raw phase).

    Returns
    -------
    complex128 [n].

    Raises
    ------
    ValueError
        if the shapes do not fit.
    """
    scene = _Scene(samples, frequencies_hz, tx_m, rx_m, voxels_m, reference_m)
    xp = scene.xp
    s = xp.asarray(samples, dtype=xp.complex128)
    image = xp.zeros(scene.voxels.shape[0], dtype=xp.complex128, device=scene.device)
    # `part` is a slice of positions, `delay` [position, voxel]. `turn` returns exp(-2j pi x) of its argument.
    for part, delay in scene.delays():
        if scene.step is None:
            for k, f in enumerate(scene.frequencies):
                image += xp.sum(s[part, k : k + 1] * turn(xp, delay * f, xp.float64, xp.complex128), axis=0)
            continue
        # Horner's rule: sum over k of s_k q^k = s_0 + q (s_1 + q (s_2 + ...)), q = exp(-2j pi delay step).
        phase_step = turn(xp, delay * scene.step, xp.float64, xp.complex128)
        total = s[part, -1:] * xp.ones_like(phase_step)
        for k in range(len(scene.frequencies) - 2, -1, -1):
            total *= phase_step
            total += s[part, k : k + 1]
        image += xp.sum(total * turn(xp, delay * scene.frequencies[0], xp.float64, xp.complex128), axis=0)
    return image


def project(reflectivity: Any, frequencies_hz: Any, tx_m: Any, rx_m: Any, voxels_m: Any, reference_m: Any) -> Any:
    """Compute the echoes of voxels [n], complex128 [position, frequency]; the adjoint of :func:`backproject`."""
    voxels = find_array_namespace(reflectivity).asarray(reflectivity)
    # Only the shape of these samples is used.
    no_samples = np.empty((len(tx_m), len(frequencies_hz)))
    scene = _Scene(no_samples, frequencies_hz, tx_m, rx_m, voxels_m, reference_m, like=voxels)
    xp = scene.xp
    v = xp.asarray(voxels, dtype=xp.complex128)[:, None]
    rows = []
    for _, delay in scene.delays():
        columns = [
            xp.matmul(xp.conj(turn(xp, delay * f, xp.float64, xp.complex128)), v)[:, 0] for f in scene.frequencies
        ]
        rows.append(xp.stack(columns, axis=1))
    return xp.concat(rows, axis=0)


class _Scene:
    """Geometry of a direct sum, with its shapes checked, as arrays of the library of `like` (default: `samples`)."""

    def __init__(
        self, samples: Any, frequencies_hz: Any, tx_m: Any, rx_m: Any, voxels_m: Any, reference_m: Any, like: Any = None
    ) -> None:
        pattern = samples if like is None else like
        self.xp = find_array_namespace(pattern)
        self.device = get_device(pattern)
        # Lists have no shape of their own; arrays of other libraries are unknown to `np.shape`.
        shape = tuple(samples.shape) if hasattr(samples, "shape") else np.shape(samples)
        self.frequencies = [float(f) for f in frequencies_hz]
        if len(shape) != 2 or not self.frequencies or len(self.frequencies) != shape[1]:
            raise ValueError(
                f"samples must be [position, frequency] with frequencies_hz [frequency]: {shape},"
                f" ({len(self.frequencies)},)"
            )
        self.tx, self.rx, self.voxels, self.reference = (
            self.xp.asarray(a, dtype=self.xp.float64, device=self.device) for a in (tx_m, rx_m, voxels_m, reference_m)
        )
        if self.tx.shape != (shape[0], 3) or self.rx.shape != (shape[0], 3) or self.reference.shape != (shape[0],):
            raise ValueError(
                f"tx_m and rx_m must be [{shape[0]}, 3], reference_m [{shape[0]}]:"
                f" {self.tx.shape}, {self.rx.shape}, {self.reference.shape}"
            )
        if self.voxels.ndim != 2 or self.voxels.shape[1] != 3:
            raise ValueError(f"voxels_m must be [n, 3]: {self.voxels.shape}")

    @property
    def step(self) -> float | None:
        """Spacing of three or more evenly spaced frequencies, Hz; otherwise None."""
        f = np.array(self.frequencies)
        step = (f[-1] - f[0]) / max(1, f.size - 1)
        is_even = f.size > 2 and np.allclose(np.diff(f), step, rtol=1e-9, atol=1e-6 * abs(step))
        return float(step) if is_even else None

    def delays(self) -> Iterator[tuple[slice, Any]]:
        """Yield chunks of positions and their delays to all voxels, float64 [position, voxel], seconds."""
        v = self.voxels
        size = max(1, _CHUNK // max(1, v.shape[0]))
        for first in range(0, self.tx.shape[0], size):
            positions = slice(first, min(first + size, self.tx.shape[0]))
            tx = self.tx[positions, None, :]
            rx = self.rx[positions, None, :]
            reference = self.reference[positions, None]
            d = excess_path_m(
                xp=self.xp, x=v[None, :, 0], y=v[None, :, 1], z=v[None, :, 2], tx_m=tx, rx_m=rx, reference_m=reference
            )
            yield positions, d / SPEED_OF_LIGHT_M_S


class DirectImager:
    """Imager by direct sum: exact for any positions and pixels, but slow. See `samples.Imager`."""

    def __init__(self, aperture: Aperture) -> None:
        self.aperture = aperture

    def image(self, samples: Any) -> Any:
        """Return the matched filter of samples [rx, frequency, row, column], complex128 [ny, nx]."""
        xp = find_array_namespace(samples)
        rx, m, rows, columns = self.aperture.shape
        total = 0
        for r in range(rx):
            samples_by_position = xp.permute_dims(xp.reshape(samples[r, ...], (m, rows * columns)), (1, 0))
            total = total + backproject(samples_by_position, *self._list_geometry(r))
        return xp.reshape(total, self.aperture.grid.shape)

    def image_constant_echo(self, echo: Any, weights: Any) -> Any:
        """Return the image of an echo [rx, frequency] at every position, times weights [row, column]."""
        xp = find_array_namespace(echo)
        return self.image(echo[:, :, None, None] * xp.astype(weights, echo.dtype)[None, None, :, :])

    def samples(self, image: Any) -> Any:
        """Return the echoes of pixels [ny, nx], [rx, frequency, row, column]; the adjoint of :meth:`image`."""
        xp = find_array_namespace(image)
        rx, m, rows, columns = self.aperture.shape
        pixels = xp.reshape(image, (-1,))
        echoes = [xp.permute_dims(project(pixels, *self._list_geometry(r)), (1, 0)) for r in range(rx)]
        return xp.reshape(xp.stack(echoes), (rx, m, rows, columns))

    def _list_geometry(self, rx: int) -> tuple[Any, ...]:
        """Return the arguments of `backproject` after the samples."""
        a = self.aperture
        shift = a.offsets_m.reshape(-1, 3)
        places = (a.antennas.tx_m + shift, a.antennas.rx_m[rx] + shift, a.grid.voxels_m)
        return a.frequencies_hz, *places, np.full(len(shift), a.antennas.direct_m[rx])
