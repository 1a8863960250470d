"""Echoes of shapes as a receiver sees them after synchronisation.

Spheres and cylinders of one medium have exact series (`series`). For all other surfaces it is physical optics about the
specular point of each stage position: the surface is sampled in units of its Fresnel zone and summed under a smooth
window; the trapezoidal rule of a smooth integrand converges exponentially. What lies outside adds nothing but edges and
shadow boundaries, which physical optics has wrong. What is left after the phase of the specular path is smooth, so a
coarse lattice of stage positions and a few frequencies are enough; the path itself is exact everywhere. Flat plates
keep their sharp edges: they are summed facet by facet at every position.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy import ndimage

from polysight_worlds.media import LIGHT_M_PER_S, reflect
from polysight_worlds.optics import CHUNK, Antenna, Response, integrate_phase, rectangle, respond
from polysight_worlds.rig import Boards
from polysight_worlds.series import Pair, scatter_cylinder, scatter_sphere
from polysight_worlds.shapes import Revolved, Shape, Sphere, find_specular, follow_path

# Window exp(-x) (1 + x + .. + x^4 / 24), x = (distance / WIDTH)^2 / 2, in units of the Fresnel zone, sqrt(1 / (k second
# derivative)). It is entire and flat to tenth order: of a quadratic phase it misses 945 / (120 (2 WIDTH^2)^5), 7e-4.
WIDTH = 1.8
END = 9.5
SPACING = 0.62
# Near a caustic the zone would grow without end.
LEAST_BEND_PER_M = 0.8
# Currents fade out from this cosine of incidence on: they do not end at the shadow's edge.
GRAZING = 0.3
# What edges diffract turns by a wave in 13 mm of the stage's way, relative to the specular path. The series has none.
LATTICE_M = 0.005
LATTICE_OF_SERIES_M = 0.018
# Echoes from the inside of a body below this share of its front's are left out.
INSIDE_LEVEL = 1e-3
# Splines are poor at the ends of their lattice.
PADDING = 4
# Facets of a flat plate: the path bends by 3 / m, so its phase leaves the facet's plane by 0.04 rad.
PLATE_FACET_M = 0.008


def record_shapes(
    shapes: Sequence[Shape],
    boards: Boards,
    frequencies_hz: NDArray,
    offsets_m: NDArray,
) -> dict[str, NDArray]:
    """Echoes of shapes at both boards, as after synchronisation with the direct path removed.

    `offsets_m` [..., 3] are stage offsets with z = 0, in any order. Returns complex64 [rx, frequency, ...] for "h" and
    "v". Phases rise with the path: an echo of path L is exp(+j 2 pi f (L - d) / c) / L for an ideal mirror, with d the
    direct path of its RX, so media appear conjugated. No part shades another.
    """
    frequencies_hz = np.asarray(frequencies_hz, float)
    offsets = np.asarray(offsets_m, float)
    flat = offsets.reshape(-1, 3)
    cubes = {}
    for channel, receivers in boards.receivers().items():
        cube = np.empty((len(receivers), len(frequencies_hz), len(flat)), np.complex64)
        for index, rx in enumerate(receivers):
            wave = np.zeros((len(frequencies_hz), len(flat)), np.complex64)
            direct_m = np.linalg.norm(rx.position - boards.tx.position)
            for shape in shapes:
                wave += echo_of(shape, boards.tx, rx, frequencies_hz, flat, float(direct_m))
            cube[index] = wave.conj()
        cubes[channel] = cube.reshape(*cube.shape[:2], *offsets.shape[:-1])
    return cubes


def echo_of(
    shape: Shape, tx: Antenna, rx: Antenna, frequencies_hz: NDArray, offsets: NDArray, direct_m: float
) -> NDArray:
    """Wave of one shape at one RX, complex64 [frequencies, offsets], with exp(-jk (path - direct_m))."""
    if shape.is_flat_plate:
        return _sum_facets(shape, tx, rx, frequencies_hz, offsets, direct_m)
    solution = choose_solution(shape)
    nodes_hz, expand = _frequency_nodes(frequencies_hz)
    lattice, coordinates = _make_lattice(offsets, LATTICE_M if solution is sum_window else LATTICE_OF_SERIES_M)
    if shows_inside(shape):
        # What crossed the body has paths of its own: no lattice of positions or frequencies holds it.
        lattice, nodes_hz, expand = None, frequencies_hz, np.eye(len(frequencies_hz))
    if lattice is None:
        places = find_specular(shape, *_antennas(tx, rx, offsets))
        slow = solution(shape, tx, rx, nodes_hz, offsets, places)
    else:
        coarse = lattice.reshape(-1, 3)
        coarse_places = find_specular(shape, *_antennas(tx, rx, coarse))
        coarse_slow = solution(shape, tx, rx, nodes_hz, coarse, coarse_places)
        places = tuple(_interpolate(p.reshape(lattice.shape[:2]), coordinates) for p in coarse_places)
        slow = np.stack([_interpolate(s.reshape(lattice.shape[:2]), coordinates) for s in coarse_slow])
    path = follow_path(shape.at(*places), *_antennas(tx, rx, offsets))
    if solution is solve_cylinder:
        slow = slow * _end_factors(shape, path.hessian, places[0], nodes_hz)
    return _add_carrier(slow, path.length_m - direct_m, frequencies_hz, expand)


Solution = Callable[[Shape, Antenna, Antenna, NDArray, NDArray, tuple[NDArray, ...]], NDArray]


def choose_solution(shape: Shape) -> Solution:
    """Exact series for spheres and cylinders of one medium; physical optics for all else."""
    if not shape.stack.layers and isinstance(shape, Sphere):
        return solve_sphere
    if not shape.stack.layers and isinstance(shape, Revolved) and not shape.slope and not shape.bulge:
        return solve_cylinder
    return sum_window


def shows_inside(shape: Shape) -> bool:
    """True if a wave that crosses the body twice comes back with more than INSIDE_LEVEL."""
    if choose_solution(shape) is sum_window or shape.stack.is_metal:
        return False
    loss = abs(np.sqrt(shape.stack.below).imag)
    across_m = 4 * shape.scale_m()[1]
    return bool(np.exp(-2 * np.pi * 78e9 / LIGHT_M_PER_S * loss * across_m) > INSIDE_LEVEL)


def _medium(shape: Shape) -> complex | None:
    return None if shape.stack.is_metal else shape.stack.below


def solve_sphere(
    shape: Shape, tx: Antenna, rx: Antenna, frequencies_hz: NDArray, offsets: NDArray, places: tuple[NDArray, ...]
) -> NDArray:
    """Mie's series, without the specular path's phase: [frequencies, offsets]."""
    patch = shape.at(*places)
    path_m = follow_path(patch, *_antennas(tx, rx, offsets)).length_m
    pair = Pair.aimed(tx, rx, offsets, np.asarray(shape.place_m), patch.point)
    waves = []
    for frequency_hz in frequencies_hz:
        wave = scatter_sphere(pair, shape.scale_m()[0], _medium(shape), frequency_hz, with_inside=shows_inside(shape))
        waves.append(wave * np.exp(2j * np.pi * frequency_hz / LIGHT_M_PER_S * path_m))
    return np.stack(waves)


def solve_cylinder(
    shape: Shape, tx: Antenna, rx: Antenna, frequencies_hz: NDArray, offsets: NDArray, places: tuple[NDArray, ...]
) -> NDArray:
    """Series of the endless cylinder, without the specular path's phase: [frequencies, offsets]."""
    patch = shape.at(*places)
    path_m = follow_path(patch, *_antennas(tx, rx, offsets)).length_m
    pair = Pair.aimed(tx, rx, offsets, np.asarray(shape.place_m), patch.point).turned(shape.axes)
    across_m = np.sqrt(path_m**2 - (pair.rx_m[0] - pair.tx_m[0]) ** 2)
    waves = []
    for frequency_hz in frequencies_hz:
        wave = scatter_cylinder(
            pair, shape.scale_m()[1], _medium(shape), frequency_hz, across_m, with_inside=shows_inside(shape)
        )
        waves.append(wave * np.exp(2j * np.pi * frequency_hz / LIGHT_M_PER_S * path_m))
    return np.stack(waves)


def _end_factors(shape: Shape, hessian: NDArray, along: NDArray, frequencies_hz: NDArray) -> NDArray:
    """What a cylinder's ends leave of the endless one's echo, [frequencies, offsets]: a Fresnel integral along it."""
    bend = hessian[0, 0] - hessian[0, 1] ** 2 / hessian[1, 1]
    units = _window_units()
    weights = _window(units) * np.exp(-0.5j * units**2)
    weights /= weights.sum()
    factors = []
    for frequency_hz in frequencies_hz:
        zone_m = 1 / np.sqrt(2 * np.pi * frequency_hz / LIGHT_M_PER_S * bend)
        places = along[:, None] + zone_m[:, None] * units
        factors.append(shape.cover(places, np.zeros_like(places)) @ weights)
    return np.stack(factors)


def _add_carrier(slow: NDArray, excess_m: NDArray, frequencies_hz: NDArray, expand: NDArray) -> NDArray:
    """Interpolate [nodes, offsets] in frequency, and turn by the path."""
    echo = (expand @ slow).astype(np.complex64)
    for index, frequency_hz in enumerate(frequencies_hz):
        turns = frequency_hz / LIGHT_M_PER_S * excess_m
        angle = (-2 * np.pi * (turns - np.round(turns))).astype(np.float32)
        echo[index] *= np.cos(angle) + 1j * np.sin(angle)
    return echo


def _antennas(tx: Antenna, rx: Antenna, offsets: NDArray) -> tuple[NDArray, NDArray]:
    return tx.position[:, None] + offsets.T, rx.position[:, None] + offsets.T


def _make_lattice(offsets: NDArray, step_m: float) -> tuple[NDArray | None, NDArray]:
    """Coarse lattice [rows, columns, 3] around the offsets and their coordinates on it [2, n]; None: they are few."""
    low, high = offsets.min(axis=0), offsets.max(axis=0)
    counts = np.ceil((high - low)[:2] / step_m).astype(int) + 1 + 2 * PADDING
    if counts.prod() > len(offsets) or np.any(offsets[:, 2] != offsets[0, 2]):
        return None, np.zeros((2, 0))
    first = (low + high)[:2] / 2 - (counts - 1) / 2 * step_m
    x, y = (start + step_m * np.arange(count) for start, count in zip(first, counts, strict=True))
    grid_x, grid_y = np.meshgrid(x, y)
    lattice = np.stack([grid_x, grid_y, np.full_like(grid_x, offsets[0, 2])], axis=-1)
    coordinates = (offsets[:, :2] - first).T / step_m
    return lattice, coordinates[::-1]


def _interpolate(values: NDArray, coordinates: NDArray) -> NDArray:
    return np.asarray(ndimage.map_coordinates(values, coordinates, order=5, mode="nearest"))


def _frequency_nodes(frequencies_hz: NDArray, count: int = 5) -> tuple[NDArray, NDArray]:
    """Chebyshev nodes over the band and the matrix [frequencies, nodes] that interpolates from them."""
    if len(frequencies_hz) <= count:
        return frequencies_hz, np.eye(len(frequencies_hz))
    middle = (frequencies_hz[0] + frequencies_hz[-1]) / 2
    half = (frequencies_hz[-1] - frequencies_hz[0]) / 2
    nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    basis = chebyshev.chebvander(nodes, count - 1)
    wanted = chebyshev.chebvander((frequencies_hz - middle) / half, count - 1)
    return middle + half * nodes, wanted @ np.linalg.inv(basis)


def _window_units() -> NDArray:
    return np.arange(-np.floor(END / SPACING), np.floor(END / SPACING) + 1) * SPACING


def _window(units: NDArray) -> NDArray:
    """Smooth window over distances in Fresnel zones."""
    x = (units / WIDTH) ** 2 / 2
    return np.exp(-x) * (1 + x * (1 + x / 2 * (1 + x / 3 * (1 + x / 4))))


def _fade_shadow(normals: NDArray, response: Response) -> NDArray:
    """Smooth step to 0 towards grazing incidence or scattering."""
    # The gradient is incident minus scattered direction.
    rise = np.einsum("i...,i...->...", normals, response.gradient)
    cosine = np.minimum(response.cos_incidence, -response.cos_incidence - rise)
    share = np.clip(cosine / GRAZING, 0, 1)
    return share**2 * (3 - 2 * share)


def sum_window(
    shape: Shape, tx: Antenna, rx: Antenna, frequencies_hz: NDArray, offsets: NDArray, places: tuple[NDArray, ...]
) -> NDArray:
    """Physical optics about the specular points (a, b), without the specular path's phase: [frequencies, offsets]."""
    units = _window_units()
    xi, eta = (grid.ravel() for grid in np.meshgrid(units, units))
    weights = _window(xi) * _window(eta) * SPACING**2
    sums = np.empty((len(frequencies_hz), len(offsets)), complex)
    at_once = max(1, CHUNK // len(weights))
    middle_k = 2 * np.pi * float(np.mean(frequencies_hz)) / LIGHT_M_PER_S
    tables = [CosineTable(shape, f) for f in frequencies_hz]
    for first in range(0, len(offsets), at_once):
        chunk = slice(first, first + at_once)
        a0, b0 = places[0][chunk], places[1][chunk]
        u = offsets[chunk]
        middle = shape.at(a0, b0)
        path = follow_path(middle, *_antennas(tx, rx, u))
        zones, zone_area = _fresnel_zones(middle.tangents(), path.hessian, middle_k)
        a = a0[:, None] + zones[0, 0, :, None] * xi + zones[1, 0, :, None] * eta
        b = b0[:, None] + zones[0, 1, :, None] * xi + zones[1, 1, :, None] * eta
        patch = shape.at(a, b)
        moved = patch.point - u.T[:, :, None]
        response = respond(tx, rx, moved, patch.normal)
        area = patch.area * zone_area[:, None] * weights * shape.cover(a, b) * _fade_shadow(patch.normal, response)
        rest_m = response.path_m - path.length_m[:, None]
        for i, frequency_hz in enumerate(frequencies_hz):
            k = 2 * np.pi * frequency_hz / LIGHT_M_PER_S
            r_s, r_p = tables[i].look_up(response.cos_incidence)
            terms = (r_s * response.s_weight + r_p * response.p_weight) * area
            sums[i, chunk] = 1j * k / (4 * np.pi) * (terms * np.exp(-1j * k * rest_m)).sum(axis=1)
    return sums


def _fresnel_zones(tangents: NDArray, hessian: NDArray, k: float) -> tuple[NDArray, NDArray]:
    """Parameters' rates [2 axes, 2 parameters, n] per Fresnel zone along the path's two axes, and their area [n]."""
    bends = np.einsum("ij...,jk...,lk...->il...", tangents, hessian, tangents)
    eigenvalues, vectors = np.linalg.eigh(np.moveaxis(bends, -1, 0))
    lengths = 1 / np.sqrt(k * np.maximum(np.abs(eigenvalues), LEAST_BEND_PER_M))
    # vectors [n, component, axis]
    rates = np.einsum("nia,ijn,na->ajn", vectors, tangents, lengths)
    return rates, np.abs(rates[0, 0] * rates[1, 1] - rates[0, 1] * rates[1, 0])


class CosineTable:
    """Reflection coefficients of a shape's medium over the cosine of incidence, linear between 513 places."""

    def __init__(self, shape: Shape, frequency_hz: float) -> None:
        cosines = np.linspace(0, 1, 513)
        cosines[0] = 1e-6
        self._tables = [np.ascontiguousarray(table) for table in reflect(shape.stack, frequency_hz, cosines)]

    def look_up(self, cos_incidence: NDArray) -> tuple[NDArray, NDArray]:
        """(r_s, r_p) as complex128."""
        place = np.clip(cos_incidence, 0, 1) * 512
        left = np.minimum(place.astype(np.int32), 511)
        share = place - left
        s, p = (table[left] + share * (table[left + 1] - table[left]) for table in self._tables)
        return s, p


def _sum_facets(
    shape: Shape, tx: Antenna, rx: Antenna, frequencies_hz: NDArray, offsets: NDArray, direct_m: float
) -> NDArray:
    """A flat plate with sharp edges, facet by facet at each position."""
    edges = shape.axes[:, :2] * np.asarray(shape.size_m)
    facets = rectangle(np.asarray(shape.place_m), edges[:, 1], edges[:, 0], PLATE_FACET_M)
    area_m2 = float(np.linalg.norm(np.cross(facets.edge_u[:, 0], facets.edge_v[:, 0])))
    normal = -shape.axes[:, 2]
    middle = np.asarray(shape.place_m)[:, None]
    antennas = _antennas(tx, rx, offsets)
    middle_path_m = np.linalg.norm(middle - antennas[0], axis=0) + np.linalg.norm(middle - antennas[1], axis=0)
    # Paths over a plate differ by less than its diagonal: so many radians to either side over half of the band.
    radians = np.pi / 2 * float(np.hypot(*shape.size_m)) * np.ptp(frequencies_hz) / LIGHT_M_PER_S
    nodes_hz, expand = _frequency_nodes(frequencies_hz, 5 + int(np.ceil(radians)))
    tables = [CosineTable(shape, f) for f in nodes_hz]
    slow = np.empty((len(nodes_hz), len(offsets)), complex)
    at_once = max(1, CHUNK // len(facets.centres[0]))
    for first in range(0, len(offsets), at_once):
        chunk = slice(first, first + at_once)
        points = facets.centres[:, None] - offsets[chunk].T[:, :, None]
        response = respond(tx, rx, points, normal)
        rest_m = response.path_m - middle_path_m[chunk, None]
        for i, frequency_hz in enumerate(nodes_hz):
            k = 2 * np.pi * frequency_hz / LIGHT_M_PER_S
            r_s, r_p = tables[i].look_up(response.cos_incidence)
            spread = integrate_phase(response, facets.edge_u[:, :1, None], facets.edge_v[:, :1, None], frequency_hz)
            terms = (r_s * response.s_weight + r_p * response.p_weight) * spread
            slow[i, chunk] = 1j * k / (4 * np.pi) * area_m2 * (terms * np.exp(-1j * k * rest_m)).sum(axis=1)
    return _add_carrier(slow, middle_path_m - direct_m, frequencies_hz, expand)
