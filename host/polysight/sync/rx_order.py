"""Find RX that were recorded in another order than the rig file has them: swapped lanes, or a reversed list.

An *order* [rx] holds the place of each recorded RX: its index in the rig file's list of RX. The RX at place p has the
distance r_p from the TX, and the excess path x_p of an echo from the mirror point (the specular point between TX and
RX): the echo's path minus r_p. With k = 2 pi f / c at the middle of the sweep, recorded RX n of place p_n receives

    direct path   d_n = exp(j (k r_p + c_n + a))            with p = p_n
    echo          e_n = exp(j (k r_p + k x_p + c_n + b))    relative to it: e_n conj(d_n) = exp(j (k x_p + b - a))

up to amplitudes. The phase c_n of the receiver's channel is unknown (tens of degrees), a and b are the same at all RX.
All orders are tried; the one whose phases k r_p and k x_p fit best is compared with that of the rig file. The echo fits
more closely, as c_n cancels in it.

Two orders whose phases differ by a constant cannot be distinguished, and have the same image. On the board RH of the
published rig k r_p grows by 94 degrees from RX to RX: if all four are rotated by one place, three of them change by
94 degrees and the fourth by 94 - 4 * 94 + 360 = 78, which is nearly a constant.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polysight.sync.direct_path import DirectPath, excess_path_m
from polysight.sync.offsets import AlignedRow, ReferencedSamples
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# Standard deviation of the phase c_n of an RX's channel, radians; chosen (the simulated rig has 12 degrees).
_CHANNEL_RAD = np.radians(25)
# Standard deviation of the phase of the echo relative to the direct path, radians; chosen. Plates lie beside the mirror
# point and are tilted: one degree of tilt moves the phase by 3 degrees from RX to RX.
_ECHO_RAD = np.radians(12)
# Smallest amount by which another order must lower the cost, and its largest cost; chosen. A cost is a sum of squared
# phase errors in units of their variances, as of `_compute_misfit`, plus `_MOVE_COST` for each moved RX.
_LEAST_IMPROVEMENT = 14.0
_LARGEST_MISFIT = 12.0
# Cost of an RX in another place: of orders that fit equally well, the one with fewest changes is reported. Chosen.
_MOVE_COST = 0.5
# Smallest share of the echo's power that one set of phases at the RX explains at all positions; otherwise the echo is
# not used. Chosen.
_DOMINANT_SHARE = 0.8
# If no direct path was found: smallest coherence of the direct path over the RX in the best of all orders; chosen.
_LEAST_COHERENCE = 0.97
# If no direct path was found: positions of a row on which all orders are tried, and share of these in which an order
# must find a direct path; chosen.
_TRIED_POSITIONS = 12
_LEAST_FOUND_SHARE = 0.75
# Largest number of RX: all orders are tried, and six RX have 720.
_MOST_RX = 6


class RxPhases(NamedTuple):
    """Phases expected at the places of the rig file, radians [place]: k r_p of the direct path, k x_p of the echo."""

    direct: NDArray[np.float64]
    echo: NDArray[np.float64]


class _RowPhasors(NamedTuple):
    """Phasors of a row at the recorded RX, complex [rx].

    `direct` is d_n, the direct path as received. `echo` is e_n conj(d_n), the echo relative to it; None if one set of
    phases does not explain enough of the echo's power.
    """

    direct: NDArray[np.complexfloating]
    echo: NDArray[np.complexfloating] | None


def judge_rx_order(
    direct: NDArray[np.complexfloating], echo: NDArray[np.complexfloating], path: DirectPath
) -> tuple[int, ...]:
    """Find the order of a row's RX from its direct path and echo in steered samples.

    Steering has multiplied the samples of each RX by exp(-j k r_p), with the places p of the rig file's order.

    Parameters
    ----------
    direct, echo
        complex [rx] and [rx, position]: direct path of the row, and echo of the mirror point, in the steered samples.
    path
        Direct path by the rig file.

    Returns
    -------
    The place of each recorded RX in the rig file, counted from 1. Empty if the rig file's order fits, no order fits, an
    RX has no signal, or there are more than six RX.
    """
    if not 2 <= direct.size <= _MOST_RX or not np.abs(direct).all():
        return ()
    expected = _expect_phases(path)
    return _choose_order(_find_phasors(direct, echo, expected, range(direct.size)), expected)


def find_rx_order(
    aligned: AlignedRow,
    referenced: ReferencedSamples,
    path: DirectPath,
    reference_with: Callable[[AlignedRow, DirectPath], ReferencedSamples],
) -> tuple[int, ...]:
    """Find the order in which a row's RX were recorded, also if the rig file's order finds no direct path.

    Parameters
    ----------
    aligned, referenced
        The row after burst alignment, and after :func:`polysight.sync.offsets.reference` with the rig file's order.
    path
        Direct path by the rig file.
    reference_with
        Calls :func:`polysight.sync.offsets.reference` for an aligned row and the direct path of another order.

    Returns
    -------
    As :func:`judge_rx_order`; also empty if no order finds a direct path.
    """
    count = len(path.steering)
    usable = np.flatnonzero(aligned.good.any(axis=1))
    if not 2 <= count <= _MOST_RX or usable.size == 0 or not np.abs(path.beam).all():
        return ()
    expected = _expect_phases(path)
    is_direct_path_lost = 2 * np.count_nonzero(referenced.found) < usable.size
    if not is_direct_path_lost:
        phasors = _measure_phasors(referenced, path, expected, range(count))
        return _choose_order(phasors, expected)

    # The sum over RX in a wrong order may cancel the direct path: all orders are tried on some positions.
    chosen = usable[np.linspace(0, usable.size - 1, min(_TRIED_POSITIONS, usable.size)).astype(int)]
    chosen_positions = _take_positions(aligned, chosen)
    best: tuple[float, _RowPhasors] | None = None
    for order in itertools.permutations(range(count)):
        tried = reference_with(chosen_positions, path.reorder_rx(order))
        if np.count_nonzero(tried.found) < _LEAST_FOUND_SHARE * chosen.size:
            continue
        phasors = _measure_phasors(tried, path, expected, order)
        # After steering by the right order only the channels' phases c_n are left.
        steered_direct = phasors.direct * np.exp(-1j * expected.direct[list(order)])
        coherence = abs(_normalise(steered_direct).mean())
        if best is None or coherence > best[0]:
            best = (float(coherence), phasors)
    if best is None or best[0] < _LEAST_COHERENCE:
        return ()
    return _choose_order(best[1], expected)


def _take_positions(aligned: AlignedRow, positions: NDArray[np.intp]) -> AlignedRow:
    """Return some positions of an aligned row."""
    parts: list[Any] = [np.ascontiguousarray(values[positions]) for values in aligned]
    return AlignedRow(*parts)


# All rows of a board have the same geometry; 16 boards are kept.
@lru_cache(16)
def _compute_phases(
    frequency_hz: float, tx_m: tuple[float, ...], rx_m: tuple[tuple[float, ...], ...], specular_m: tuple[float, ...]
) -> RxPhases:
    """Return the phases at the places of the RX at one frequency."""
    tx = np.array(tx_m)
    rx = np.array(rx_m)
    wavenumber = 2 * np.pi * frequency_hz / SPEED_OF_LIGHT_M_S
    excess = excess_path_m(tx, rx, np.array([specular_m]))[:, 0]
    return RxPhases(wavenumber * np.linalg.norm(rx - tx, axis=1), wavenumber * excess)


def _expect_phases(path: DirectPath) -> RxPhases:
    """Return the phases at the places of the RX by geometry, at the middle of the sweep."""
    _, tx_m, rx_m, specular_m = path.geometry
    return _compute_phases(float(path.sweep_hz.mean()), tx_m, rx_m, specular_m)


def _measure_phasors(
    referenced: ReferencedSamples, path: DirectPath, expected: RxPhases, order: Sequence[int]
) -> _RowPhasors:
    """Measure the phasors of a row that was steered by the places of `order` [rx]."""
    # [rx, position, block]: a block is one frequency point of the sweep.
    samples = referenced.samples[:, referenced.found]
    _, tx_m, rx_m, specular_m = path.geometry
    excess = excess_path_m(np.array(tx_m), np.array(rx_m), np.array([specular_m])).mean()
    # A Hann window without the zeros at its ends.
    blocks = samples.shape[2]
    window = np.hanning(blocks + 2)[1:-1] / blocks
    # Over the sweep the referenced direct path is constant, an echo turns with its excess path: [rx, position] each.
    direct_cell = samples @ window
    echo_cell = samples @ (window * np.exp(-2j * np.pi * path.sweep_hz * excess / SPEED_OF_LIGHT_M_S))
    return _find_phasors(direct_cell.sum(axis=1), echo_cell, expected, order)


def _find_phasors(
    direct: NDArray[np.complexfloating],
    echo: NDArray[np.complexfloating],
    expected: RxPhases,
    order: Sequence[int],
) -> _RowPhasors:
    """Return the phasors of a row from direct path [rx] and echo [rx, position], steered by the places of `order`."""
    # Phases of the echo at the RX, equal at all positions: strongest eigenvector of its covariance [rx, rx].
    power, eigenvectors = np.linalg.eigh(echo @ echo.conj().T)
    relative_echo = None
    if power[-1] > _DOMINANT_SHARE * power.sum() and np.abs(direct).all():
        relative_echo = eigenvectors[:, -1] * direct.conj()
    # Restore the phases that steering removed; in `relative_echo` they cancel.
    direct_as_received = direct * np.exp(1j * expected.direct[list(order)])
    return _RowPhasors(direct_as_received, relative_echo)


def _normalise(phasors: NDArray[np.complexfloating]) -> NDArray[np.complex128]:
    """Return phasors of magnitude 1; 0 stays 0."""
    size = np.abs(phasors)
    return np.divide(phasors, size, out=np.zeros(phasors.shape, complex), where=size > 0)


@lru_cache(_MOST_RX)
def _list_orders(count: int) -> NDArray[np.intp]:
    """Return all orders of `count` RX, [order, rx]; the first is that of the rig file."""
    return np.array(list(itertools.permutations(range(count))))


def _choose_order(phasors: _RowPhasors, expected: RxPhases) -> tuple[int, ...]:
    """Return the order that fits, places counted from 1; empty if the rig file's order fits, or no order does."""
    orders = _list_orders(phasors.direct.size)
    costs = _compute_misfit(phasors.direct, expected.direct[orders], _CHANNEL_RAD)
    if phasors.echo is not None:
        costs += _compute_misfit(phasors.echo, expected.echo[orders], _ECHO_RAD)
    costs += _MOVE_COST * np.count_nonzero(orders != orders[0], axis=1)
    best = int(np.argmin(costs))
    is_better = costs[0] - costs[best] > _LEAST_IMPROVEMENT
    if not is_better or costs[best] > _LARGEST_MISFIT:
        return ()
    return tuple((orders[best] + 1).tolist())


def _compute_misfit(
    phasors: NDArray[np.complexfloating], phases: NDArray[np.float64], std_rad: float
) -> NDArray[np.float64]:
    """Return the sum of squared phase errors of phasors u_n [rx] for the phases phi_n [order, rx] of each order.

    It is the least over a phase a that is common to all RX, in units of the variance, [order], with |u_n| = 1:

        min over a of sum_n |u_n exp(-j phi_n) - exp(j a)|^2 / std^2 = 2 N (1 - |mean_n u_n exp(-j phi_n)|) / std^2

    where |u exp(-j phi) - exp(j a)|^2 is nearly the square of a small phase error.
    """
    coherence = np.abs(np.exp(-1j * phases) @ _normalise(phasors)) / phasors.size
    return 2 * phasors.size * (1 - coherence) / std_rad**2
