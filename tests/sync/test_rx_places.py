"""The order of a row's RX by the phases of its direct path and echo, drawn from geometry, without noise."""

from itertools import permutations

import numpy as np

from polysight.sync.direct_path import DirectPath, excess_path_m, prepare
from polysight.sync.rx_order import judge_rx_order
from polysight_shared.units import SPEED_OF_LIGHT_M_S

ORDERS = list(permutations(range(4)))


def draw_row(path: DirectPath, order: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Direct path [rx] and echo [rx, position] of RX in this order, with the phases of the rig file's order removed."""
    _, tx_m, rx_m, specular_m = path.geometry
    wavenumber = 2 * np.pi * path.sweep_hz.mean() / SPEED_OF_LIGHT_M_S
    rx = np.array(rx_m)
    direct_m = np.linalg.norm(rx - np.array(tx_m), axis=1)
    excess_m = excess_path_m(np.array(tx_m), rx, np.array([specular_m]))[:, 0]
    places = list(order)
    direct = np.exp(1j * wavenumber * (direct_m[places] - direct_m))
    echo_of_rx = direct * np.exp(1j * wavenumber * excess_m[places])
    # Along the row the phase of the echo turns once.
    phase_of_position = np.exp(2j * np.pi * np.linspace(0, 1, 9))
    return direct, echo_of_rx[:, None] * phase_of_position


def test_every_order_of_four_rx_is_found(rig):
    """On the board of V, whose orders differ by more than a constant phase."""
    path = prepare(rig, rig.by_name("RV"))
    for order in ORDERS[1:]:
        direct, echo = draw_row(path, order)
        # Orders are reported in numbers from 1.
        assert judge_rx_order(direct, echo, path) == tuple(place + 1 for place in order)


def test_of_orders_that_fit_equally_the_one_with_fewest_changes_is_reported(rig):
    """Two RX at one place cannot be told apart."""
    path = prepare(rig, rig.by_name("RV"))
    chirp, tx_m, rx_m, specular_m = path.geometry
    same_place = path._replace(geometry=(chirp, tx_m, (rx_m[0], rx_m[0], *rx_m[2:]), specular_m))
    for order in ((2, 1, 0, 3), (2, 0, 1, 3)):
        direct, echo = draw_row(same_place, order)
        assert judge_rx_order(direct, echo, same_place) == (3, 2, 1, 4)


def test_rx_in_the_rig_files_order_are_not_reported(rig):
    for board in rig.receivers:
        path = prepare(rig, board)
        direct, echo = draw_row(path, ORDERS[0])
        assert judge_rx_order(direct, echo, path) == ()
