"""Estimate the backlash of the stage from the data: the shift of odd rows along x relative to even rows.

Neighbouring rows have nearly the same echo. If odd rows, which run in the opposite direction, are shifted by `d` along
+x, they differ from their neighbours by `d` times the slope of the echo along x. Least squares gives `d`, the jackknife
over groups of rows its standard deviation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polysight.results import Backlash
from polysight.sync.decimate import sample_frequencies_hz
from polysight.sync.direct_path import excess_path_m
from polysight_shared.config import Board, Instrument
from polysight_shared.geometry import rx_positions_m, specular_midpoint_m, tx_position_m
from polysight_shared.raster import mean_burst_travel_mm, plan_raster
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# Number of groups of rows for the jackknife (chosen).
_GROUPS = 10
# Number of Gauss-Newton steps (chosen).
_STEPS = 3
# Largest share of power in the upper fifth of the spectrum; more means aliasing: positions too far apart (chosen).
_ALIASED_SHARE = 0.02


def object_filter(rig: Instrument, board: Board, sweep_hz: NDArray[np.float64]) -> NDArray[np.complex64]:
    """Return weights [sample] that select the mirror point's range cell and suppress the direct path.

    `sweep_hz` [sample] is the transmit frequency of each sample; those outside the linear part have weight 0.
    """
    tx = np.array(tx_position_m(rig))
    rx = np.array(rx_positions_m(rig, board))
    excess = excess_path_m(tx, rx, np.array([specular_midpoint_m(rig, board)])).mean()
    a, b = rig.chirp.linear_samples
    first, last = sample_frequencies_hz(rig.chirp)[[a, b - 1]]
    linear = np.flatnonzero((sweep_hz >= first) & (sweep_hz <= last))
    weights = np.zeros(sweep_hz.size, np.complex64)
    weights[linear] = np.hanning(linear.size + 2)[1:-1] / linear.size
    weights[linear] *= np.exp(-2j * np.pi * (sweep_hz[linear] - first) * excess / SPEED_OF_LIGHT_M_S)
    return weights


def estimate_backlash(rows: dict[int, NDArray[np.complex64]], rig: Instrument) -> Backlash | None:
    """Estimate the backlash of a scan.

    Parameters
    ----------
    rows
        Echoes by row index, complex64 [rx, position] in the order of recording (odd rows with falling x): synchronised
        rows through `object_filter` (:meth:`SyncedRow.through`). Rows without both neighbours are left out.
    rig
        Rig of the scan.

    Returns
    -------
    Backlash | None
        None if undetermined: too few rows, steps too coarse for the echo along x, or a standard deviation above a
        quarter of the step.
    """
    plan = plan_raster(rig.grid)
    inner = [r for r in sorted(rows) if r - 1 in rows and r + 1 in rows]
    if len(inner) < _GROUPS:
        return None
    # `_compute_spectrum` continues each row by its mirror image: spectra have twice its length, and the window of the
    # least squares is 0 on the image.
    k = 2 * np.pi * np.fft.fftfreq(2 * plan.columns, plan.step_x_mm)
    # A burst's middle lies so far beyond the planned position, in the direction of motion.
    travel_mm = mean_burst_travel_mm(rig.burst, rig.stage)
    window = np.pad(np.hanning(plan.columns + 2)[1:-1], (0, plan.columns))

    def compute_row_spectrum(r: int, shift_mm: float) -> NDArray[np.complex128]:
        """Return the spectrum of a row at its planned positions; odd rows were recorded `shift_mm` beyond."""
        direction = plan.row(r).direction
        backlash_mm = shift_mm if r % 2 else 0.0
        return _compute_spectrum(rows[r][:, ::direction], k, direction * travel_mm + backlash_mm)

    def sum_groups(shift_mm: float) -> NDArray[np.float64]:
        """Return sums over groups of rows: slope times difference, slope squared, power, power at the highest k."""
        sums = np.zeros((_GROUPS, 4))
        # Spectra of the row and its neighbours; each is computed once.
        recent = {r: compute_row_spectrum(r, shift_mm) for r in (inner[0] - 1, inner[0])}
        for i, r in enumerate(inner):
            neighbours = (r - 1, r, r + 1)
            recent = {q: recent[q] if q in recent else compute_row_spectrum(q, shift_mm) for q in neighbours}
            mean = (recent[r - 1] + recent[r + 1]) / 2
            slope = np.fft.ifft(1j * k * mean, axis=-1)
            difference = np.fft.ifft(recent[r] - mean, axis=-1)
            power = np.abs(mean) ** 2
            # An even row has odd neighbours, so that its difference has the opposite sign.
            sign = 1 if r % 2 else -1
            sums[i * _GROUPS // len(inner)] += (
                sign * (window * slope.conj() * difference).real.sum(),
                (window * np.abs(slope) ** 2).sum(),
                power.sum(),
                # The highest fifth of the wavenumbers: much power there is a sign of steps that are too coarse.
                power[:, np.abs(k) > 0.8 * np.abs(k).max()].sum(),
            )
        return sums

    shift = 0.0
    shift_without_group = np.zeros(_GROUPS)
    for _ in range(_STEPS):
        sums = sum_groups(shift)
        product, slope2, power, power_at_high_k = sums.sum(axis=0)
        # Jackknife (Efron 1982): sums without one group, for each group.
        product_without, slope2_without, _, _ = (sums.sum(axis=0) - sums).T
        if slope2 == 0 or slope2_without.min() <= 0 or power_at_high_k > _ALIASED_SHARE * power:
            return None
        shift_without_group = shift + product_without / slope2_without
        shift += float(np.clip(product / slope2, -plan.step_x_mm / 2, plan.step_x_mm / 2))
    std = float(np.sqrt((_GROUPS - 1) / _GROUPS * np.sum((shift_without_group - shift_without_group.mean()) ** 2)))
    if std < plan.step_x_mm / 4:
        return Backlash(shift, std)
    return None


def _compute_spectrum(row: NDArray[np.complex64], k: NDArray[np.floating], shift_mm: float) -> NDArray[np.complex128]:
    """Return the spectrum along x of a row at its planned positions, [rx, 2 position].

    It was recorded `shift_mm` beyond them (along +x). The row is continued by its mirror image to avoid a jump at its
    ends. `k` is in radians per millimetre.
    """
    return np.fft.fft(np.concatenate([row, row[:, ::-1]], axis=-1), axis=-1) * np.exp(-1j * k * shift_mm)
