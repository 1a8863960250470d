"""Range gate: reduce 192 fast-time samples to the few frequency samples that describe the scene; motion in a burst.

A pixel is the matched filter `S(d) = sum_t w_t x_t exp(-j 2 pi f_t d / c)` at its excess path d. All d lie in a gate
`[d_1, d_2]` of few range cells. The functions `exp(-j 2 pi f d / c)` of d in this gate, f in the swept band B, span a
space of about `B (d_2 - d_1) / c + 1` dimensions (Landau and Pollak 1962), so each is a combination of those at a few
evenly spaced f_m: `exp(-j 2 pi f_t d / c) w_t = sum_m M_mt exp(-j 2 pi f_m d / c)`, with M from least squares over the
gate. Then `S(d) = sum_m (M x)_m exp(-j 2 pi f_m d / c)`, and `M x` is computed once per position; the imagers use only
M x at f_m. Six samples more than the time-bandwidth product make the error 1e-6 of the peak (derivation:
docs/decisions/0002-imaging.md).

The direct path is a constant in x, close to the gate. Windowing alone does not remove it, so its amplitude is estimated
(generalised least squares with the gate as coloured noise) and subtracted.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from polysight.imaging.aperture import Window, window_weights
from polysight.imaging.geometry import Antennas, ImageGrid
from polysight_shared.config import Chirp, Instrument
from polysight_shared.raster import RasterPlan
from polysight_shared.units import SPEED_OF_LIGHT_M_S

_NOISE = 1e-3  # noise power of a sample relative to the gate, for the estimate of the direct path
REACH = 4  # positions to either side
_BAND = 0.45  # largest frequency of the filter, cycles per position


@dataclass(frozen=True)
class Reduction:
    """Linear maps of a scan's range gate.

    Attributes
    ----------
    frequencies_hz
        float64 [m].
    matrix
        complex128 [m, sample]: window, removal of the direct path and projection. Samples outside the linear part have
        weight 0.
    direct
        complex128 [sample]: `direct @ x` is the amplitude of the direct path.
    model
        complex128 [m, m]: an echo of path d and amplitude 1 becomes `model @ exp(+j 2 pi frequencies_hz d / c)`.
    gate_m
        Smallest and largest excess path in the gate.
    """

    frequencies_hz: NDArray[np.float64]
    matrix: NDArray[np.complex128]
    direct: NDArray[np.complex128]
    model: NDArray[np.complex128]
    gate_m: tuple[float, float]


def scene_gate_m(
    antennas: tuple[Antennas, ...], plan: RasterPlan, grid: ImageGrid, depth_m: float = 0.0
) -> tuple[float, float]:
    """Return the smallest and largest excess path of all pixels (`depth_m` nearer and farther) and stage positions."""
    half_x = ((plan.columns - 1) / 2 * plan.step_x_mm + 2) / 1e3  # 2 mm more: the travel within a burst
    half_y = (plan.rows - 1) / 2 * plan.step_y_mm / 1e3
    dx, dy = np.meshgrid(
        np.linspace(grid.x_m[0] - half_x, grid.x_m[-1] + half_x, 41),
        np.linspace(grid.y_m[0] - half_y, grid.y_m[-1] + half_y, 41),
    )
    planes = (float(np.min(grid.z_m)) - depth_m, float(np.max(grid.z_m)) + depth_m)
    excess = np.stack([a.excess_m(dx, dy, z) for a in antennas for z in planes])
    return float(excess.min()), float(excess.max())


@lru_cache(maxsize=8)
def reduction(chirp: Chirp, gate_m: tuple[float, float], window: Window = "hann", extra: int = 6) -> Reduction:
    """Return the linear maps of a range gate.

    Parameters
    ----------
    chirp
        Chirp of the samples.
    gate_m
        Smallest and largest excess path, metres.
    window
        Fast-time window over the linear samples, as for scipy; "boxcar" for none.
    extra
        Frequency samples beyond the time-bandwidth product.
    """
    a, b = chirp.linear_samples
    sweep = chirp.first_sample_hz + chirp.hz_per_sample * np.arange(a, b)
    weight = window_weights(window, b - a)
    weight = weight / weight.sum()
    band = sweep[-1] - sweep[0]
    product = (gate_m[1] - gate_m[0]) * band / SPEED_OF_LIGHT_M_S
    frequencies = np.linspace(sweep[0], sweep[-1], int(np.ceil(product)) + extra)
    d = np.linspace(*gate_m, max(64, 8 * frequencies.size)) / SPEED_OF_LIGHT_M_S
    wanted = np.exp(-2j * np.pi * np.outer(d, sweep)) * weight
    basis = np.exp(-2j * np.pi * np.outer(d, frequencies))
    m = np.linalg.lstsq(basis, wanted, rcond=1e-6)[0]

    echoes = np.exp(2j * np.pi * np.outer(sweep, d)) / np.sqrt(d.size)
    covariance = echoes @ echoes.conj().T + _NOISE * np.eye(b - a)
    direct = np.linalg.solve(covariance, np.ones(b - a)).conj()
    direct /= direct.sum()

    matrix = np.zeros((frequencies.size, chirp.samples), complex)
    matrix[:, a:b] = m - np.outer(m.sum(axis=1), direct)
    whole = np.zeros(chirp.samples, complex)
    whole[a:b] = direct
    # Echoes at the samples' frequencies are combinations of echoes at the few frequencies.
    few = np.exp(2j * np.pi * np.outer(d, frequencies))
    from_few = np.linalg.lstsq(few, np.exp(2j * np.pi * np.outer(d, sweep)), rcond=1e-9)[0].T
    return Reduction(frequencies, matrix, whole, (matrix[:, a:b] @ from_few).astype(np.complex128), gate_m)


def burst_filters(rig: Instrument) -> NDArray[np.float32]:
    """Return inverse filters of the motion in a burst with 0, 1, .. `REACH` taps per side, float32 [reach, REACH + 1].

    The first tap is the middle one, the others apply on both sides. Least squares up to 0.45 cycles per position.
    """
    times_s = np.array(rig.burst.chirp_times_s)
    moved = (times_s - times_s.mean()) * rig.stage.speed_mm_s / rig.grid.step_x_mm  # motion of each chirp, in positions
    turns = np.linspace(0, _BAND, 91)
    loss = np.cos(2 * np.pi * np.outer(turns, moved)).mean(axis=1)
    out = np.zeros((REACH + 1, REACH + 1))
    out[0, 0] = 1
    for reach in range(1, REACH + 1):
        # The sum of the taps is one, so that constants keep their amplitude.
        basis = 2 * np.cos(2 * np.pi * np.outer(turns, np.arange(1, reach + 1))) - 2
        side = np.linalg.lstsq(basis, 1 / loss - 1, rcond=None)[0]
        out[reach, 0], out[reach, 1 : reach + 1] = 1 - 2 * side.sum(), side
    return out.astype(np.float32)


def undo_burst_motion(
    samples: NDArray[np.complex64], valid: NDArray[np.bool_], turn: NDArray[np.float64], filters: NDArray[np.float32]
) -> NDArray[np.complex64]:
    """Compensate the motion of the stage during each burst of a row.

    Parameters
    ----------
    samples
        complex64 [..., position].
    valid
        bool [position]: the filter uses as many neighbours as are valid on both sides; none at the row's ends.
    turn
        float64 [position]: centre of the filter's band, radians per position.
    filters
        From :func:`burst_filters`.
    """
    count, reach = valid.size, np.zeros(valid.size, int)
    for i in range(1, min(REACH, (count - 1) // 2) + 1):
        near = np.zeros(count, bool)
        near[i : count - i] = valid[: count - 2 * i] & valid[2 * i :] & valid[i : count - i]
        reach += near & (reach == i - 1)
    taps = filters[reach]
    out = samples * taps[:, 0]
    for i in range(1, int(reach.max(initial=0)) + 1):
        side = (taps[:, i] * np.exp(1j * i * turn)).astype(np.complex64)
        out[..., :-i] += side[:-i].conj() * samples[..., i:]
        out[..., i:] += side[i:] * samples[..., :-i]
    return out
