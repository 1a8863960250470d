"""Voltages of H and V without path and spreading, and what the coefficients of a surface would give.

V sees a point from a stage position some 15 mm from H's, under an incidence of its own.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from polysight.surfaces.measure import Seen, Shape, find_shape
from polysight.surfaces.optics import (
    Optics,
    bends_by_incidence,
    mix_twisted,
    polarisation_row,
    reflect_curved,
    reflect_spherical,
)
from polysight.surfaces.points import find_normals, find_offset_that_sees, predict_echo, spreading, unit_legs
from polysight.surfaces.window import WINDOW_M

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
# Blocks of stage positions whose errors count as independent: windows overlap, and ripples of edges and of other echoes
# are as long as a Fresnel zone (40 to 70 mm).
BLOCK_M = 2 * WINDOW_M


@dataclass(frozen=True)
class Voltages:
    """Voltages of points [n], with the directions, angles and curvatures that they depend on.

    Attributes
    ----------
    b, std
        Voltages of H and V without path and spreading, complex [n, 2], and the standard deviations of either part.
    m
        Rows of the coefficients of r_s, r_p, s to p and p to s, complex [n, 2 receivers, 4 coefficients].
    theta
        Incidence at H and V, [n, 2], radians: V sees a point from elsewhere, some 0.1 degrees steeper. Near Brewster's
        angle that changes r_p by some per cent.
    path_m
        Path from TX to H and V, [n, 2].
    bend_inside, bend_across, twist
        Curvatures in and across the plane of incidence, and twist between both, [n].
    arrival, departure
        Directions of arrival at V, and of departure at TX to H, their x and y, [n, 2].
    band_rise
        ln of the amplitude in the upper half of the band over that in the lower half, of H and V [n, 2].
    at_m
        Stage offsets, [n, 2].
    """

    b: Complex
    std: Array
    m: Complex
    theta: Array
    path_m: Array
    bend_inside: Array
    bend_across: Array
    twist: Array
    arrival: Array
    departure: Array
    band_rise: Array
    at_m: Array

    def __len__(self) -> int:
        return len(self.theta)

    def __getitem__(self, keep: NDArray) -> Voltages:
        return Voltages(**{f.name: getattr(self, f.name)[keep] for f in fields(self)})


def find_voltages(seen: Seen, optics: Optics, shape: Shape | None = None) -> Voltages:
    """Return the voltages of points; their `shape` is found from H's echoes unless given."""
    if shape is None:
        shape = find_shape(seen.h, optics)
    tx_m = optics.tx.at_m
    k = optics.wave_number
    solid = (shape.points, shape.normals, shape.curvature)
    seen_from = {"h": seen.h.at_m, "v": find_offset_that_sees(*solid[:2], seen.v.at_m, tx_m, optics.v.at_m)}
    b = []
    std = []
    rows = []
    theta = []
    paths = []
    for channel, echoes in (("h", seen.h), ("v", seen.v)):
        receiver = optics.receiver(channel)
        at_m = seen_from[channel]
        path, _, _ = predict_echo(*solid, at_m, tx_m, receiver.at_m)
        spread = spreading(*solid, at_m, tx_m, receiver.at_m)
        b.append(echoes.move(at_m, k).amplitude * np.exp(1j * k * path) / spread)
        std.append(echoes.amplitude_std / spread)
        rows.append(polarisation_row(shape.points, shape.normals, at_m, optics.tx, receiver))
        _, cos = find_normals(shape.points, at_m, tx_m, receiver.at_m)
        theta.append(np.arccos(np.clip(cos, 0, 1)))
        paths.append(path)
    _, back, *_ = unit_legs(shape.points, seen_from["v"], tx_m, optics.v.at_m)
    out, *_ = unit_legs(shape.points, seen_from["h"], tx_m, optics.h.at_m)
    inside, across, twist = bends_by_incidence(*solid, seen.h.at_m, tx_m)
    return Voltages(
        b=np.stack(b, axis=1),
        std=np.stack(std, axis=1),
        m=np.stack(rows, axis=1),
        theta=np.stack(theta, axis=1),
        path_m=np.stack(paths, axis=1),
        bend_inside=inside,
        bend_across=across,
        twist=twist,
        arrival=back[:, :2],
        departure=out[:, :2],
        band_rise=np.stack([seen.h.band_rise, seen.v.band_rise], axis=1),
        at_m=seen.h.at_m[:, :2],
    )


def reflect_points(eps: NDArray | complex, v: Voltages, wave_number: float) -> Complex:
    """Coefficients (r_s, r_p, s to p, p to s) of the curved surface at each point for H and V, [n, 2, 4]."""
    eps_of_receivers = np.asarray(eps)[..., None]
    r_s, r_p = reflect_curved(eps_of_receivers, v.theta, v.bend_inside[:, None], v.bend_across[:, None], wave_number)
    mixed = mix_twisted(eps_of_receivers, v.theta, v.twist[:, None], wave_number)
    more_s, more_p = reflect_spherical(eps_of_receivers, v.theta, v.path_m, wave_number)
    return np.stack([r_s + more_s, r_p + more_p, mixed, mixed], axis=2)


def receive(v: Voltages, coefficients: Complex) -> Complex:
    """Voltages of H and V [n, 2] that coefficients [n, 2, 4] give with gains of 1."""
    return np.sum(v.m * coefficients, axis=2)


def expansion_parameter(v: Voltages, wave_number: float) -> Array:
    """Return K / (k cos^3 theta) of each point [n]: ratio of successive orders of reflection at a curved surface."""
    bend = (np.abs(v.bend_inside) + np.abs(v.bend_across)) / 2
    return bend / (wave_number * np.cos(v.theta[:, 0]) ** 3)


def number_blocks(at_m: Array, shift: tuple[float, float], block_m: float = BLOCK_M) -> NDArray[np.int_]:
    """Return the number of the block of each stage offset [n, 2]; `shift` moves the borders by a share of a block."""
    cell = np.floor(at_m / block_m + np.array(shift)).astype(int)
    _, number = np.unique(cell, axis=0, return_inverse=True)
    return number.reshape(-1)
