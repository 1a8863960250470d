"""Find RX that were recorded in another order than the rig file has them: swapped lanes, or a reversed list.

An RX in another place has another delay of the direct path, and another excess path of the object's echo. Gains and
phases of the receivers' channels are unknown (tens of degrees), but they multiply direct path and echo alike, so that
the ratio of the two tells the place of each RX. The places are those of the rig file's RX in another order; the order
whose phases fit best is compared with that of the rig file.

Orders that differ by a constant phase alone cannot be told apart, and have the same image: with steps of 94 degrees
from RX to RX (the published H board) a rotation of all four is such a case.
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

# Standard deviations of the phases of an RX, radians: of its channel, which only the direct path has (chosen; the
# simulated rig has 12 degrees), and of the echo relative to the direct path, for plates lie beside the mirror point and
# are tilted (chosen; one degree of tilt moves the phase by 3 degrees from RX to RX).
_CHANNEL_RAD = np.radians(25)
_ECHO_RAD = np.radians(12)
# Smallest improvement of the sum of squares by another order, and largest sum that is left; chosen.
_LEAST_IMPROVEMENT = 14.0
_LARGEST_MISFIT = 12.0
# Cost of an RX in another place: of orders that fit equally well, the one with fewest changes is reported. Chosen.
_MOVE_COST = 0.5
# Share of an echo's power in its strongest direction from which on the echo determines the places of the RX; chosen.
_DOMINANT_SHARE = 0.8
# Coherence of the direct path over the RX of a rig file's order that needs no search; chosen.
_ORDERED_COHERENCE = 0.97
# Positions of a row that other orders are tried with, and share of them that must have a direct path; chosen.
_TRIED_POSITIONS = 12
_LEAST_FOUND_SHARE = 0.75
# Largest number of RX: orders are tried one by one.
_MOST_RX = 6


class RxPhases(NamedTuple):
    """Phases expected at the RX by geometry, radians [rx]: direct path, and echo of the mirror point relative to it."""

    direct: NDArray[np.float64]
    echo: NDArray[np.float64]


class _Vectors(NamedTuple):
    """Phasors of a row, complex [rx]: the direct path as received, and its echo relative to it; None: not known."""

    direct: NDArray[np.complexfloating]
    echo: NDArray[np.complexfloating] | None


def judge_rx_order(
    direct: NDArray[np.complexfloating], echo: NDArray[np.complexfloating], path: DirectPath
) -> tuple[int, ...]:
    """Judge the order of a row's RX; return what :func:`find_rx_order` does.

    Parameters
    ----------
    direct
        complex [rx]: direct path of the row in samples that were steered by the rig file's order.
    echo
        complex [rx, position]: echo of the mirror point in them.
    path
        Direct path by the rig file.
    """
    if not 2 <= direct.size <= _MOST_RX or not np.abs(direct).all():
        return ()
    expected = _expect_phases(path)
    return _choose(_relate(direct, echo, expected, range(direct.size)), expected)


def find_rx_order(
    aligned: AlignedRow,
    referenced: ReferencedSamples,
    path: DirectPath,
    reference_with: Callable[[AlignedRow, DirectPath], ReferencedSamples],
) -> tuple[int, ...]:
    """Find the order in which a row's RX were recorded: number in the rig file of each recorded RX, counted from 1.

    Parameters
    ----------
    aligned, referenced
        The row, and what :func:`polysight.sync.offsets.reference` made of it with the rig file's order.
    path
        Direct path by the rig file.
    reference_with
        References an aligned row with another direct path.

    Returns
    -------
    tuple[int, ...]
        Empty if the rig file's order is right, or if the row cannot tell it: a direct path that no order finds, RX
        without a signal, more RX than six.
    """
    count = len(path.steering)
    usable = np.flatnonzero(aligned.good.any(axis=1))
    if not 2 <= count <= _MOST_RX or usable.size == 0 or not np.abs(path.beam).all():
        return ()
    expected = _expect_phases(path)
    is_lost = 2 * np.count_nonzero(referenced.found) < usable.size
    if not is_lost:
        vectors = _measure(referenced, path, expected, range(count))
        return _choose(vectors, expected)

    # Without a direct path the RX may be so far out of order that it cancels: other orders are tried on some positions.
    chosen = usable[np.linspace(0, usable.size - 1, min(_TRIED_POSITIONS, usable.size)).astype(int)]
    chosen_positions = _take_positions(aligned, chosen)
    best: tuple[float, _Vectors] | None = None
    for order in itertools.permutations(range(count)):
        tried = reference_with(chosen_positions, path.reorder_rx(order))
        if np.count_nonzero(tried.found) < _LEAST_FOUND_SHARE * chosen.size:
            continue
        vectors = _measure(tried, path, expected, order)
        coherence = abs(_normalise(vectors.direct * np.exp(-1j * expected.direct[list(order)])).mean())
        if best is None or coherence > best[0]:
            best = (float(coherence), vectors)
    if best is None or best[0] < _ORDERED_COHERENCE:
        return ()
    return _choose(best[1], expected)


def _take_positions(aligned: AlignedRow, positions: NDArray[np.intp]) -> AlignedRow:
    """Return some positions of an aligned row."""
    parts: list[Any] = [np.ascontiguousarray(values[positions]) for values in aligned]
    return AlignedRow(*parts)


@lru_cache(16)
def _compute_phases(
    frequency_hz: float, tx_m: tuple[float, ...], rx_m: tuple[tuple[float, ...], ...], specular_m: tuple[float, ...]
) -> RxPhases:
    """Return the phases at the RX at one frequency."""
    tx = np.array(tx_m)
    rx = np.array(rx_m)
    wavenumber = 2 * np.pi * frequency_hz / SPEED_OF_LIGHT_M_S
    excess = excess_path_m(tx, rx, np.array([specular_m]))[:, 0]
    return RxPhases(wavenumber * np.linalg.norm(rx - tx, axis=1), wavenumber * excess)


def _expect_phases(path: DirectPath) -> RxPhases:
    """Return the phases at the RX by geometry, at the middle of the sweep."""
    _, tx_m, rx_m, specular_m = path.geometry
    return _compute_phases(float(path.sweep_hz.mean()), tx_m, rx_m, specular_m)


def _measure(referenced: ReferencedSamples, path: DirectPath, expected: RxPhases, order: Sequence[int]) -> _Vectors:
    """Measure the phasors of a row that was steered by the places of `order` [rx]."""
    samples = referenced.samples[:, referenced.found]
    _, tx_m, rx_m, specular_m = path.geometry
    excess = excess_path_m(np.array(tx_m), np.array(rx_m), np.array([specular_m])).mean()
    blocks = samples.shape[2]
    window = np.hanning(blocks + 2)[1:-1] / blocks
    # Range cells of the direct path, which is a constant, and of the mirror point, [rx, position].
    direct_cell = samples @ window
    echo_cell = samples @ (window * np.exp(-2j * np.pi * path.sweep_hz * excess / SPEED_OF_LIGHT_M_S))
    return _relate(direct_cell.sum(axis=1), echo_cell, expected, order)


def _relate(
    direct: NDArray[np.complexfloating],
    echo: NDArray[np.complexfloating],
    expected: RxPhases,
    order: Sequence[int],
) -> _Vectors:
    """Return the phasors of a row from direct path [rx] and echo [rx, position], steered by the places of `order`."""
    # The part that all positions share is the direct path; the echo is the direction of most power over positions.
    power, directions = np.linalg.eigh(echo @ echo.conj().T)
    ratio = None
    if power[-1] > _DOMINANT_SHARE * power.sum() and np.abs(direct).all():
        ratio = directions[:, -1] * direct.conj()
    return _Vectors(direct * np.exp(1j * expected.direct[list(order)]), ratio)


def _normalise(phasors: NDArray[np.complexfloating]) -> NDArray[np.complex128]:
    """Return phasors of magnitude 1; 0 stays 0."""
    size = np.abs(phasors)
    return np.divide(phasors, size, out=np.zeros(phasors.shape, complex), where=size > 0)


@lru_cache(_MOST_RX)
def _list_orders(count: int) -> NDArray[np.intp]:
    """Return all orders of `count` RX, [order, rx]; the first is that of the rig file."""
    return np.array(list(itertools.permutations(range(count))))


def _choose(vectors: _Vectors, expected: RxPhases) -> tuple[int, ...]:
    """Return the order that fits, from 1; empty if that of the rig file does, or none."""
    orders = _list_orders(vectors.direct.size)
    costs = _compute_misfit(vectors.direct, expected.direct[orders], _CHANNEL_RAD)
    if vectors.echo is not None:
        costs += _compute_misfit(vectors.echo, expected.echo[orders], _ECHO_RAD)
    costs += _MOVE_COST * np.count_nonzero(orders != orders[0], axis=1)
    best = int(np.argmin(costs))
    is_better = costs[0] - costs[best] > _LEAST_IMPROVEMENT
    if not is_better or costs[best] > _LARGEST_MISFIT:
        return ()
    return tuple((orders[best] + 1).tolist())


def _compute_misfit(
    phasors: NDArray[np.complexfloating], phases: NDArray[np.float64], std_rad: float
) -> NDArray[np.float64]:
    """Return the sum of squared deviations of phasors [rx] from phases [order, rx] of any common phase, [order].

    It is in units of the variance. Deviations count as 2 - 2 cos, which is their square where they are small.
    """
    coherence = np.abs(np.exp(-1j * phases) @ _normalise(phasors)) / phasors.size
    return 2 * phasors.size * (1 - coherence) / std_rad**2
