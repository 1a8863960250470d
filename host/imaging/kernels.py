"""The matched filter of one position, sampled on a lattice, and its spectrum along x; what was made is kept."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import numpy as np

from polysight.host.imaging.aperture import Aperture
from polysight.host.imaging.arrays import fft_of
from polysight.host.imaging.lattice import Lattice, cross_fade, delays_s
from polysight.host.imaging.model import turn

KEEP_BYTES = 1 << 28
"""Spectra kept in memory: two boards of the published grid are 90 MB."""

_kept: OrderedDict[tuple[Any, ...], Any] = OrderedDict()


def kept(key: tuple[Any, ...], make: Callable[[], Any]) -> Any:
    """Arrays made before under this key, or made now; the longest unused go when `KEEP_BYTES` are full."""
    if key not in _kept:
        _kept[key] = make()
    _kept.move_to_end(key)
    while len(_kept) > 1 and sum(_bytes(a) for a in _kept.values()) > KEEP_BYTES:
        _kept.popitem(last=False)
    return _kept[key]


def _bytes(arrays: Any) -> int:
    if isinstance(arrays, tuple):
        return sum(_bytes(a) for a in arrays)
    return math.prod(getattr(arrays, "shape", (0,))) * 8  # a lattice is small


def forget() -> None:
    """Drop every kept spectrum."""
    _kept.clear()


def lattice_key(aperture: Aperture, slack_m: float) -> tuple[Any, ...]:
    """All that a lattice depends on."""
    a, grid = aperture.antennas, aperture.grid
    numbers = (a.tx_m, a.rx_m, aperture.frequencies_hz, aperture.offsets_m, grid.x_m, grid.y_m)
    return ("lattice", slack_m, float(grid.z_m), grid.pixel_m, *(n.tobytes() for n in numbers))


def key_of(aperture: Aperture, lattice: Lattice, xp: Any, device: Any) -> tuple[Any, ...]:
    """All that a kernel depends on."""
    a, grid = aperture.antennas, aperture.grid
    numbers = (a.tx_m, a.rx_m, aperture.frequencies_hz, lattice.band)
    return (
        *(n.tobytes() for n in numbers),
        float(grid.z_m) - float(aperture.offsets_m[0, 0, 2]),
        (lattice.size_x, lattice.pitch_x_m, lattice.exact_x, lattice.first_lag_m, lattice.lags_y, lattice.pitch_y_m),
        xp.__name__,
        str(device),
    )


def spectra_along_x(aperture: Aperture, lattice: Lattice, xp: Any = np, device: Any = None) -> Any:
    """Kernels `exp(-j 2 pi f d / c)` of `pixel - position`, transformed along x: complex64 [rx * frequency, lag y, k].

    One distance map an RX, and a constant turn from one frequency to the next.
    """
    fft, n, f = fft_of(xp), lattice.size_x, aperture.frequencies_hz
    fade = n - lattice.exact_x
    x = lattice.first_lag_m[0] + xp.arange(-fade, n, dtype=xp.float64, device=device) * lattice.pitch_x_m
    y = lattice.first_lag_m[1] + xp.arange(lattice.lags_y, dtype=xp.float64, device=device) * lattice.pitch_y_m
    step = float(f[-1] - f[0]) / max(1, f.size - 1)
    band = xp.asarray(lattice.band % n, device=device)
    size = (len(aperture.antennas.rx_m) * f.size, lattice.lags_y, lattice.band.size)
    out = xp.empty(size, dtype=xp.complex64, device=device)
    for rx, delay in enumerate(delays_s(aperture, x, y, xp, device)):
        kernel = turn(xp, delay * float(f[0]), xp.float32, xp.complex64)
        turned = turn(xp, delay * step, xp.float32, xp.complex64)
        for m in range(f.size):
            spectrum = fft.fft(cross_fade(xp, kernel, n), axis=1)
            out[rx * f.size + m, :, :] = xp.take(spectrum, band, axis=1)
            kernel = kernel * turned
    return out
