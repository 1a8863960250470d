"""The stage's travel within a burst, undone.

The stage does not stop, so the chirps of a burst see the object from places `x_k` about their mean. Their average
weighs an echo whose phase turns by `kappa` cycles a metre along the row with

    D(kappa) = mean_k exp(j 2 pi kappa x_k) = sin(pi kappa n s) / (n sin(pi kappa s)),

n pulses, s apart: real and even, so an echo loses amplitude, most where the aperture ends, and no phase. A burst ends
before the next point (`polysight.shared.raster.check_burst_fits`), so up to the row's Nyquist limit D is above 2/pi: 1 / D is a
short symmetrical filter along the row.

Only turns beside each other are seen: burst alignment has turned each chirp back by the phase that all it holds, direct
path and echoes weighed by their power, turns by (`sync.chain.SyncedRow.turn`). So the filter is centred there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polysight.shared.config import Instrument

REACH = 4  # positions to either side
_BAND = 0.45  # cycles a position the filter is made for


def burst_filters(rig: Instrument) -> NDArray[np.float32]:
    """Filters `1 / D` that reach 0, 1, .. `REACH` positions to either side, float32 [reach, REACH + 1].

    The first tap is the middle one, the others stand on both sides. By least squares up to 0.45 cycles a position.
    """
    burst = rig.burst
    step = rig.stage.speed_mm_s * burst.period_us * 1e-6 / rig.grid.step_x_mm  # of a pulse, in positions
    turns = np.linspace(0, _BAND, 91)
    loss = np.cos(2 * np.pi * np.outer(turns, (np.arange(burst.pulses) - (burst.pulses - 1) / 2) * step)).mean(axis=1)
    out = np.zeros((REACH + 1, REACH + 1))
    out[0, 0] = 1
    for reach in range(1, REACH + 1):
        # What does not turn keeps its amplitude exactly: the taps' sum is one.
        basis = 2 * np.cos(2 * np.pi * np.outer(turns, np.arange(1, reach + 1))) - 2
        side = np.linalg.lstsq(basis, 1 / loss - 1, rcond=None)[0]
        out[reach, 0], out[reach, 1 : reach + 1] = 1 - 2 * side.sum(), side
    return out.astype(np.float32)


def undo_burst_motion(
    samples: NDArray[np.complex64], valid: NDArray[np.bool_], turn: NDArray[np.float64], filters: NDArray[np.float32]
) -> NDArray[np.complex64]:
    """Samples of a row as if the stage had stood still during each burst.

    Parameters
    ----------
    samples
        complex64 [..., position].
    valid
        bool [position]: a position is filtered as far as all positions to either side are valid; not at all at the
        row's ends.
    turn
        float64 [position]: where the filter is centred, radians from one position to the next.
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
