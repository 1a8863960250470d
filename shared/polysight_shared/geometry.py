"""Antenna positions in the rig frame, computed from the mounts in the rig file.

Rig frame: origin midway between the two board origins, x from TX to RX, y vertical, z towards the object.
Plain Python, because the Pi has no numpy.
"""

from __future__ import annotations

import math

from polysight_shared.config import Board, Instrument, MountStep

Vector = tuple[float, float, float]


def _turn(v: Vector, axis: str, degrees: float) -> Vector:
    """Rotate a column vector about x, y or z (right-handed)."""
    c = math.cos(math.radians(degrees))
    s = math.sin(math.radians(degrees))
    x, y, z = v
    if axis == "x":
        return (x, c * y - s * z, s * y + c * z)
    if axis == "y":
        return (c * x + s * z, y, -s * x + c * z)
    return (c * x - s * y, s * x + c * y, z)


def transform_to_rig(point_mm: Vector, mount: tuple[MountStep, ...]) -> Vector:
    """Transform a point of a board (mm) by the steps of its mount, in order; returns metres in the rig frame."""
    v = point_mm
    for step in mount:
        if step.turn_deg is not None and step.about is not None:
            v = _turn(v, step.about, step.turn_deg)
        elif step.shift_mm is not None:
            v = (v[0] + step.shift_mm[0], v[1] + step.shift_mm[1], v[2] + step.shift_mm[2])
    return (v[0] / 1e3, v[1] / 1e3, v[2] / 1e3)


def tx_position_m(rig: Instrument) -> Vector:
    """Return the position of the transmitting antenna at stage offset zero, metres, rig frame."""
    board = rig.transmitter
    return transform_to_rig(rig.antennas.tx_mm[board.tx_antenna], board.mount)


def rx_positions_m(rig: Instrument, board: Board) -> tuple[Vector, ...]:
    """Return the positions of a board's RX antennas at stage offset zero, metres, rig frame, as they are recorded.

    RX1 is first, unless the board has an `rx_order`.
    """
    positions = [transform_to_rig(p, board.mount) for p in rig.antennas.rx_mm]
    if not board.rx_order:
        return tuple(positions)
    return tuple(positions[number - 1] for number in board.rx_order)


def direct_path_m(rig: Instrument, board: Board) -> tuple[float, ...]:
    """Return the length of the straight path from TX to each RX of a board, metres."""
    tx = tx_position_m(rig)
    return tuple(math.dist(tx, rx) for rx in rx_positions_m(rig, board))


def specular_midpoint_m(rig: Instrument, board: Board) -> Vector:
    """Return the point of the object plane that reflects TX into the board's first RX, stage offset zero, metres."""
    tx = tx_position_m(rig)
    rx = transform_to_rig(rig.antennas.rx_mm[0], board.mount)
    z = rig.geometry.object_distance_mm / 1e3
    # Mirror RX in the object plane: the straight path from TX to it crosses the plane at this part of its length.
    t = (z - tx[2]) / ((z - tx[2]) + (z - rx[2]))
    return (tx[0] + t * (rx[0] - tx[0]), tx[1] + t * (rx[1] - tx[1]), z)


def incidence_deg(rig: Instrument, board: Board) -> float:
    """Return the incidence angle at the specular midpoint of TX and the board's first RX, degrees."""
    tx = tx_position_m(rig)
    midpoint = specular_midpoint_m(rig, board)
    return math.degrees(math.atan2(math.hypot(midpoint[0] - tx[0], midpoint[1] - tx[1]), midpoint[2] - tx[2]))
