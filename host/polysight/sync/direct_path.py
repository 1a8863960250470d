"""Direct path of a board from geometry alone: its phases at the RX, and the estimators of `offsets.reference`.

The estimators suppress the object with all RX together: one that gives no signal leaves the object in the estimate.
`offsets.find_dead_rx` finds such RX, and `DirectPath.without_rx` leaves them out.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.sync.decimate import FOLD, SEARCH_FFT, block_frequencies_hz, sample_frequencies_hz, search_window
from polysight.sync.loops import cis, complex64
from polysight_shared.config import Board, Chirp, Instrument
from polysight_shared.geometry import Vector, rx_positions_m, specular_midpoint_m, tx_position_m
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# Standard deviation in x and y of the places that echoes come from, around the mirror point (the specular point between
# TX and RX on the object plane); chosen.
_SPREAD_M = 0.1
# Relative gain and phase differences of the RX that the nulls tolerate; chosen.
_GAIN_SPREAD = 0.3
# Noise power of a sample relative to an echo as strong as the direct path; chosen.
_NOISE_POWER = 1e-2
# Clutter behind the object: largest excess path, and its total power relative to the direct path. With this power in
# the covariance R, the estimate contains a sixth of the clutter's power that it otherwise does, and 0.5 % more noise.
_CLUTTER_M = 1.5
_CLUTTER_POWER = 4e-3


class DirectPath(NamedTuple):
    """Steering and estimators for a board's direct path, from geometry alone; fixed for a scan.

    After steering and mixing down, the direct path is A exp(j w t) at all RX, t in samples from the middle.

    Attributes
    ----------
    steering
        complex64 [rx, sample]: `exp(-j 2 pi f(t) (tau_r - tau_0))`, after which all RX share the direct path's tone.
    folded_steering
        complex64 [rx, block]: steering at the middle of each block of `FOLD` linear samples.
    estimator
        complex128 [2, rx * block]: its rows times the steered samples give A and A w (w in radians per sample, near 0).
    drift_estimator
        complex128 [3, rx * block]: A, A w and A q, q the drift in radians per sample squared.
    half_estimators
        complex128 [2, 2, rx * block]: A and A w from every other RX alone; 0 for the rest.
    beam
        complex64 [rx]: weights of the steered RX for the search, sum 1, with low gain towards the object.
    search_weights
        complex64 [rx, block]: beam, steering and window of the search.
    object_bins
        IF of the nearest and of the farthest echo minus that of the direct path, in bins of the search FFT.
    sweep_hz
        float64 [block]: transmit frequency at the middle of each block.
    geometry
        Chirp, places of TX and RX, and the specular point between them, metres.
    """

    steering: NDArray[np.complex64]
    folded_steering: NDArray[np.complex64]
    estimator: NDArray[np.complex128]
    drift_estimator: NDArray[np.complex128]
    half_estimators: NDArray[np.complex128]
    beam: NDArray[np.complex64]
    search_weights: NDArray[np.complex64]
    object_bins: tuple[float, float]
    sweep_hz: NDArray[np.float64]
    geometry: tuple[Chirp, Vector, tuple[Vector, ...], Vector]

    def without_rx(self, dead: NDArray[np.bool_]) -> DirectPath:
        """Return the steering and estimators without the `dead` RX [rx]: their weights are 0."""
        return _prepare(*self.geometry, tuple(np.flatnonzero(dead).tolist()))

    def reorder_rx(self, order: Sequence[int]) -> DirectPath:
        """Return the same for another order of the RX: recorded RX k is that at place `order[k]`, counted from 0."""
        places = list(order)
        blocks = self.folded_steering.shape[1]

        def reorder(estimator: NDArray[np.complex128]) -> NDArray[np.complex128]:
            estimator_by_rx = estimator.reshape(*estimator.shape[:-1], len(places), blocks)
            return estimator_by_rx[..., places, :].reshape(estimator.shape)

        chirp, tx_m, rx_m, specular_m = self.geometry
        return self._replace(
            steering=self.steering[places],
            folded_steering=self.folded_steering[places],
            estimator=reorder(self.estimator),
            drift_estimator=reorder(self.drift_estimator),
            half_estimators=reorder(self.half_estimators),
            beam=self.beam[places],
            search_weights=self.search_weights[places],
            geometry=(chirp, tx_m, tuple(rx_m[k] for k in places), specular_m),
        )


def excess_path_m(
    tx_m: NDArray[np.float64], rx_m: NDArray[np.float64], points_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return `|v - tx| + |v - rx| - |tx - rx|`, metres, [rx, point], for rx [rx, 3] and points [point, 3]."""
    path = np.linalg.norm(points_m - tx_m, axis=-1) + np.linalg.norm(points_m[None] - rx_m[:, None], axis=-1)
    return path - np.linalg.norm(rx_m - tx_m, axis=-1)[:, None]


def prepare(rig: Instrument, board: Board) -> DirectPath:
    """Return steering, search beam and estimators of a board, from geometry alone; callers must not change them."""
    return _prepare(rig.chirp, tx_position_m(rig), rx_positions_m(rig, board), specular_midpoint_m(rig, board))


# All scans of a rig have the same few boards; each takes 10 ms.
@lru_cache(8)
def _prepare(
    chirp: Chirp, tx_m: Vector, rx_m: tuple[Vector, ...], specular_m: Vector, dead: tuple[int, ...] = ()
) -> DirectPath:
    """Return what :func:`prepare` does, without the `dead` RX (indices).

    The covariance R [rx * block, rx * block] of all but the direct path is a sum of three: echoes from places around
    the mirror point, clutter behind the object, and noise.
    """
    tx = np.array(tx_m)
    is_live = ~np.isin(np.arange(len(rx_m)), dead)
    rx = np.array(rx_m)[is_live]
    sweep = sample_frequencies_hz(chirp)
    middles = block_frequencies_hz(chirp)
    direct = np.linalg.norm(rx - tx, axis=-1)
    lag_s = (direct - direct[0])[:, None] / SPEED_OF_LIGHT_M_S
    # Echoes in the steered samples, exp(j 2 pi f excess / c): [point, rx, block].
    grid = np.linspace(-3, 3, 25) * _SPREAD_M
    dx, dy = (m.ravel() for m in np.meshgrid(grid, grid))
    amplitude = np.sqrt(np.exp(-(dx**2 + dy**2) / (2 * _SPREAD_M**2)))
    points = np.array(specular_m) + np.stack([dx, dy, 0 * dx], axis=1)
    excess = excess_path_m(tx, rx, points)
    echoes = np.exp(2j * np.pi * middles * excess.T[:, :, None] / SPEED_OF_LIGHT_M_S)
    echoes *= (amplitude / np.linalg.norm(amplitude))[:, None, None]
    n_rx = len(rx)
    n = middles.size
    all_rx = echoes.reshape(len(points), n_rx * n)
    # All samples of an RX have the same gain error: it adds echo power between samples of one RX, not between two RX.
    same_rx = np.kron(np.eye(n_rx), np.ones((n, n)))
    nearest_m = excess_path_m(tx, rx, np.array([specular_m])).min()
    clutter = np.exp(2j * np.pi / SPEED_OF_LIGHT_M_S * np.outer(np.linspace(nearest_m, _CLUTTER_M, 8 * n), middles))
    clutter_of_rx = _CLUTTER_POWER / len(clutter) * (clutter.T @ clutter.conj())
    covariance = (all_rx.T @ all_rx.conj()) * (1 + _GAIN_SPREAD**2 * same_rx) + np.kron(np.eye(n_rx), clutter_of_rx)
    covariance = (covariance + _NOISE_POWER / FOLD * np.eye(n_rx * n)).astype(np.complex128)
    time = np.tile((np.arange(n) - (n - 1) / 2) * FOLD, n_rx)
    model = np.stack([np.ones(n_rx * n), 1j * time, 0.5j * time**2], axis=1).astype(np.complex128)
    samples_of_half = [np.flatnonzero(np.repeat(np.arange(n_rx) % 2 == h, n)) for h in (0, 1)]
    half_estimators = np.zeros((2, 2, n_rx * n), complex)
    # A single RX has no second half: the errors of the direct path are not known then.
    for h in range(min(2, n_rx)):
        s = samples_of_half[h]
        half_estimators[h][:, s] = _invert_model(model[s, :2], covariance[np.ix_(s, s)])
    centre = echoes[:, :, n // 2]
    spatial = (centre.T @ centre.conj()) * (1 + _GAIN_SPREAD**2 * np.eye(n_rx)) + _NOISE_POWER * np.eye(n_rx)
    beam = np.linalg.solve(spatial, np.ones(n_rx)).conj()
    beam = complex64(beam / beam.sum())
    folded_steering = cis(-2 * np.pi * middles * lag_s)
    bins_per_m = chirp.hz_per_sample * FOLD * SEARCH_FFT / SPEED_OF_LIGHT_M_S
    return DirectPath(
        steering=_fill_dead_rx(cis(-2 * np.pi * sweep * lag_s), is_live),
        folded_steering=_fill_dead_rx(folded_steering, is_live),
        estimator=_fill_dead_rx(_invert_model(model[:, :2], covariance), is_live, n),
        drift_estimator=_fill_dead_rx(_invert_model(model, covariance), is_live, n),
        half_estimators=_fill_dead_rx(half_estimators, is_live, n),
        beam=_fill_dead_rx(beam, is_live),
        search_weights=_fill_dead_rx(complex64(beam[:, None] * folded_steering * search_window(n)), is_live),
        object_bins=(float(excess.min() * bins_per_m), float(excess.max() * bins_per_m)),
        sweep_hz=middles,
        geometry=(chirp, tx_m, rx_m, specular_m),
    )


def _fill_dead_rx(live_values: NDArray[Any], is_live: NDArray[np.bool_], blocks: int = 0) -> NDArray[Any]:
    """Return values of live RX for all RX, 0 for the others: [rx, ...], or [..., rx * block] if `blocks` is given."""
    if blocks:
        values_by_rx = np.moveaxis(live_values.reshape(*live_values.shape[:-1], -1, blocks), -2, 0)
        return np.moveaxis(_fill_dead_rx(values_by_rx, is_live), 0, -2).reshape(*live_values.shape[:-1], -1)
    all_values = np.zeros((is_live.size, *live_values.shape[1:]), live_values.dtype)
    all_values[is_live] = live_values
    return all_values


def _invert_model(model: NDArray[np.complex128], covariance: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Return `(G^H R^-1 G)^-1 G^H R^-1` for a model G [sample, parameter] and a covariance R."""
    whitened = np.asarray(scipy.linalg.solve(covariance, model, assume_a="pos"), np.complex128)
    return np.linalg.solve(model.conj().T @ whitened, whitened.conj().T).astype(np.complex128)
