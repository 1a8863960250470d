"""The forward model that all imagers share: bistatic excess path, and the phase it leaves.

A scatterer at v answers, once the direct path is the reference, with `exp(+j 2 pi f d / c)`, `d = |v - tx| + |v - rx| -
reference` (paper, equation 6). Paths and cycles are float64: at 80 GHz a float32 path of 1.5 m would be off by 1e-4
rad. Only what is left of the phase after whole cycles are taken off is rounded.
"""

from __future__ import annotations

import math
from typing import Any


def distance_m(xp: Any, x: Any, y: Any, z: Any, place_m: Any) -> Any:
    """`|(x, y, z) - place|`, broadcast; `place_m` is [..., 3]."""
    return xp.sqrt((x - place_m[..., 0]) ** 2 + (y - place_m[..., 1]) ** 2 + (z - place_m[..., 2]) ** 2)


def excess_path_m(xp: Any, x: Any, y: Any, z: Any, tx_m: Any, rx_m: Any, reference_m: Any) -> Any:
    """Excess path of scatterers at (x, y, z) for antennas at `tx_m` and `rx_m`, float64, all broadcast together.

    Parameters
    ----------
    xp
        Array API namespace.
    x, y, z
        Places of scatterers, metres.
    tx_m, rx_m
        Places of antennas [..., 3], metres.
    reference_m
        Path that the samples' phase no longer holds (here the direct path).
    """
    return distance_m(xp, x, y, z, tx_m) + distance_m(xp, x, y, z, rx_m) - reference_m


def turn(xp: Any, cycles: Any, real: Any, kind: Any) -> Any:
    """`exp(-j 2 pi cycles)` in the real and complex dtypes given; `cycles` is float64, and its whole part goes first.

    Cosine and sine one by one: many times faster than the exponential of a complex array.
    """
    phase = xp.astype((cycles - xp.round(cycles)) * (-2.0 * math.pi), real)
    return xp.astype(xp.cos(phase), kind) + xp.astype(xp.sin(phase), kind) * 1j
