"""Echoes of shapes as a receiver sees them after synchronisation.

Spheres and cylinders of one medium have exact series (`series`). All other surfaces are seen by physical optics about
the specular point of each stage position (`zones`), with what it misses at bent ones (`bends`). What is left after the
phase of the specular path (the "slow" part below) is smooth, so a coarse lattice of stage positions and a few
frequencies are enough; the path itself is exact everywhere. Flat plates keep their sharp edges: they are summed facet
by facet at every position.

`places` are the parameters (a, b) of the specular points on a shape, each [offsets], see `shapes.find_specular`.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy import ndimage

from polysight_worlds.bends import find_bend_terms
from polysight_worlds.media import LIGHT_M_PER_S
from polysight_worlds.optics import CHUNK, Antenna, Waves, integrate_steps, rectangle, respond, turn_back
from polysight_worlds.rig import Boards
from polysight_worlds.series import Pair, scatter_cylinder, scatter_sphere
from polysight_worlds.shapes import Revolved, Shape, Sphere, find_specular, follow_path
from polysight_worlds.zones import (
    CosineTable,
    place_antennas,
    reflect_facets,
    spread_of_ray,
    sum_window,
    window,
    window_units,
)

# Steps of the lattice. Waves that edges diffract turn by 2 pi within 13 mm of the stage's way, relative to the specular
# path; the series has no edges, and its step is chosen.
LATTICE_M = 0.005
LATTICE_OF_SERIES_M = 0.018
# Echoes from the inside of a body below this share of its front's are left out.
INSIDE_LEVEL = 1e-3
# Nodes of the lattice beyond the offsets on each side, because splines are poor at their ends; chosen.
PADDING = 4
# Facets of a flat plate: the path bends by 3 / m, so its phase leaves the facet's plane by 0.04 rad.
PLATE_FACET_M = 0.008
# A cone ends where its area per unit of both parameters (`Patch.area`), about its radius in metres, is below this.
LEAST_AREA_M = 1e-9


def record_shapes(
    shapes: Sequence[Shape],
    boards: Boards,
    frequencies_hz: NDArray,
    offsets_m: NDArray,
) -> dict[str, NDArray]:
    """Return echoes of shapes at both boards, as after synchronisation with the direct path removed.

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
                wave += simulate_echo(shape, boards.tx, rx, frequencies_hz, flat, float(direct_m))
            cube[index] = wave.conj()
        cubes[channel] = cube.reshape(*cube.shape[:2], *offsets.shape[:-1])
    return cubes


def simulate_echo(
    shape: Shape, tx: Antenna, rx: Antenna, frequencies_hz: NDArray, offsets: NDArray, direct_m: float
) -> NDArray:
    """Return the wave of one shape at one RX, complex64 [frequencies, offsets], with exp(-jk (path - direct_m)).

    `offsets` are stage offsets [offsets, 3] in metres.
    """
    if shape.is_flat_plate:
        return _sum_facets(shape, tx, rx, frequencies_hz, offsets, direct_m)
    solution = choose_solution(shape)
    nodes_hz, expand = _place_frequency_nodes(frequencies_hz)
    lattice, coordinates = _make_lattice(offsets, LATTICE_M if solution is sum_bent else LATTICE_OF_SERIES_M)
    if shows_inside(shape):
        # What crossed the body has paths of its own: no lattice of positions or frequencies holds it.
        lattice = None
        nodes_hz = frequencies_hz
        expand = np.eye(len(frequencies_hz))
    if lattice is None:
        places = find_specular(shape, *place_antennas(tx, rx, offsets))
        slow = solution(shape, tx, rx, nodes_hz, offsets, places)
    else:
        coarse = lattice.reshape(-1, 3)
        coarse_places = find_specular(shape, *place_antennas(tx, rx, coarse))
        coarse_slow = solution(shape, tx, rx, nodes_hz, coarse, coarse_places)
        places = tuple(_interpolate(p.reshape(lattice.shape[:2]), coordinates) for p in coarse_places)
        slow = np.stack([_interpolate(s.reshape(lattice.shape[:2]), coordinates) for s in coarse_slow])
    path = follow_path(shape.evaluate(*places), *place_antennas(tx, rx, offsets))
    if solution is solve_cylinder:
        slow = slow * _end_factors(shape, path.hessian, places[0], nodes_hz)
    return _add_carrier(slow, path.length_m - direct_m, frequencies_hz, expand)


# A function of the shape, TX, RX, frequencies, offsets and specular points that returns the slow part, complex
# [frequencies, offsets].
Solution = Callable[[Shape, Antenna, Antenna, NDArray, NDArray, tuple[NDArray, ...]], NDArray]


def choose_solution(shape: Shape) -> Solution:
    """Exact series for spheres and cylinders of one medium; physical optics for all else."""
    if not shape.stack.layers and isinstance(shape, Sphere):
        return solve_sphere
    if not shape.stack.layers and isinstance(shape, Revolved) and not shape.slope and not shape.bulge:
        return solve_cylinder
    return sum_bent


def shows_inside(shape: Shape) -> bool:
    """True if a wave that crosses the body twice comes back with more than INSIDE_LEVEL."""
    if choose_solution(shape) is sum_bent or shape.stack.is_metal:
        return False
    loss = abs(np.sqrt(shape.stack.below).imag)
    # Two diameters: the way through the body and back. The radius is the metres per radian of b.
    across_m = 4 * shape.scale_m()[1]
    # In the middle of the radars' band.
    return bool(np.exp(-2 * np.pi * 78e9 / LIGHT_M_PER_S * loss * across_m) > INSIDE_LEVEL)


def _find_medium(shape: Shape) -> complex | None:
    """Return the permittivity of a body as `series` takes it: None for metal."""
    return None if shape.stack.is_metal else shape.stack.below


def solve_sphere(
    shape: Shape, tx: Antenna, rx: Antenna, frequencies_hz: NDArray, offsets: NDArray, places: tuple[NDArray, ...]
) -> NDArray:
    """Mie's series, without the specular path's phase: [frequencies, offsets]."""
    patch = shape.evaluate(*places)
    path_m = follow_path(patch, *place_antennas(tx, rx, offsets)).length_m
    pair = Pair.aim(tx, rx, offsets, np.asarray(shape.place_m), patch.point)
    waves = []
    for frequency_hz in frequencies_hz:
        wave = scatter_sphere(
            pair, shape.scale_m()[0], _find_medium(shape), frequency_hz, with_inside=shows_inside(shape)
        )
        waves.append(wave * np.exp(2j * np.pi * frequency_hz / LIGHT_M_PER_S * path_m))
    return np.stack(waves)


def solve_cylinder(
    shape: Shape, tx: Antenna, rx: Antenna, frequencies_hz: NDArray, offsets: NDArray, places: tuple[NDArray, ...]
) -> NDArray:
    """Series of the endless cylinder, without the specular path's phase: [frequencies, offsets].

    `_end_factors` makes a cylinder with ends of it.
    """
    patch = shape.evaluate(*places)
    path_m = follow_path(patch, *place_antennas(tx, rx, offsets)).length_m
    pair = Pair.aim(tx, rx, offsets, np.asarray(shape.place_m), patch.point).rotate(shape.axes)
    # The specular path in the cross-section of the cylinder.
    across_m = np.sqrt(path_m**2 - (pair.rx_m[0] - pair.tx_m[0]) ** 2)
    waves = []
    for frequency_hz in frequencies_hz:
        wave = scatter_cylinder(
            pair, shape.scale_m()[1], _find_medium(shape), frequency_hz, across_m, with_inside=shows_inside(shape)
        )
        waves.append(wave * np.exp(2j * np.pi * frequency_hz / LIGHT_M_PER_S * path_m))
    return np.stack(waves)


def _end_factors(shape: Shape, hessian: NDArray, along: NDArray, frequencies_hz: NDArray) -> NDArray:
    """Return the echo of a cylinder relative to an endless one, [frequencies, offsets]: a Fresnel integral along it.

    `hessian`: second derivatives of the path at the specular points; `along`: their a, metres along the axis.
    """
    # Second derivative of the path along the cylinder, if the point slides around it so that the path stays stationary.
    bend = hessian[0, 0] - hessian[0, 1] ** 2 / hessian[1, 1]
    # Places along the axis in Fresnel zones about the specular point, under a window that fades to both sides.
    units = window_units()
    weights = window(units) * np.exp(-0.5j * units**2)
    weights /= weights.sum()
    factors = []
    for frequency_hz in frequencies_hz:
        zone_m = 1 / np.sqrt(2 * np.pi * frequency_hz / LIGHT_M_PER_S * bend)
        places = along[:, None] + zone_m[:, None] * units
        factors.append(shape.cover(places, np.zeros_like(places)) @ weights)
    return np.stack(factors)


def _add_carrier(slow: NDArray, excess_m: NDArray, frequencies_hz: NDArray, expand: NDArray) -> NDArray:
    """Interpolate [nodes, offsets] in frequency by the matrix `expand`, and turn by the path, here less the direct one.

    Returns complex64 [frequencies, offsets].
    """
    echo = (expand @ slow).astype(np.complex64)
    for index, frequency_hz in enumerate(frequencies_hz):
        turns = frequency_hz / LIGHT_M_PER_S * excess_m
        angle = (-2 * np.pi * (turns - np.round(turns))).astype(np.float32)
        echo[index] *= np.cos(angle) + 1j * np.sin(angle)
    return echo


def _make_lattice(offsets: NDArray, step_m: float) -> tuple[NDArray | None, NDArray]:
    """Return coarse lattice [rows, columns, 3] around the offsets, and their coordinates on it, row and column [2, n].

    None where it had more nodes than there are offsets, or where these do not lie in one plane z.
    """
    low = offsets.min(axis=0)
    high = offsets.max(axis=0)
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
    """Return the quintic spline through values on a lattice [rows, columns], at coordinates [2, n]: [n]."""
    return np.asarray(ndimage.map_coordinates(values, coordinates, order=5, mode="nearest"))


def _place_frequency_nodes(frequencies_hz: NDArray, count: int = 5) -> tuple[NDArray, NDArray]:
    """Chebyshev nodes over the band and the matrix [frequencies, nodes] that interpolates from them.

    At most `count` frequencies are nodes themselves. Five are chosen, for waves without the specular path's phase.
    """
    if len(frequencies_hz) <= count:
        return frequencies_hz, np.eye(len(frequencies_hz))
    middle = (frequencies_hz[0] + frequencies_hz[-1]) / 2
    half = (frequencies_hz[-1] - frequencies_hz[0]) / 2
    nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    basis = chebyshev.chebvander(nodes, count - 1)
    target = chebyshev.chebvander((frequencies_hz - middle) / half, count - 1)
    return middle + half * nodes, target @ np.linalg.inv(basis)


def sum_bent(
    shape: Shape, tx: Antenna, rx: Antenna, frequencies_hz: NDArray, offsets: NDArray, places: tuple[NDArray, ...]
) -> NDArray:
    """Physical optics without the specular path's phase: [frequencies, offsets].

    For media without layers, what it misses to first order in curvature and distance is added.
    """
    # The path is stationary at the tip of a cone, too: beyond the piece's edges, without any surface.
    has_surface = shape.evaluate(*places).area > LEAST_AREA_M
    offsets = offsets[has_surface]
    places = tuple(place[has_surface] for place in places)
    sums = sum_window(shape, tx, rx, frequencies_hz, offsets, places)
    if not shape.stack.layers:
        sums += _find_missing_parts(shape, tx, rx, frequencies_hz, offsets, places)
    waves = np.zeros((len(frequencies_hz), len(has_surface)), complex)
    waves[:, has_surface] = sums
    return waves


def _find_missing_parts(
    shape: Shape, tx: Antenna, rx: Antenna, frequencies_hz: NDArray, offsets: NDArray, places: tuple[NDArray, ...]
) -> NDArray:
    """Return what physical optics misses at the specular points, [frequencies, offsets], see `bends`."""
    tx_m, rx_m = place_antennas(tx, rx, offsets)
    patch = shape.evaluate(*places)
    spread = spread_of_ray(patch, follow_path(patch, tx_m, rx_m), tx_m, rx_m) * shape.cover(*places)
    out = patch.point - tx_m
    back = rx_m - patch.point
    incident = out / np.linalg.norm(out, axis=0)
    scattered = back / np.linalg.norm(back, axis=0)
    s_axis = np.cross(incident, patch.normal, axis=0)
    s_axis /= np.linalg.norm(s_axis, axis=0)
    cosine = -np.einsum("in,in->n", incident, patch.normal)
    along = (incident + cosine * patch.normal) / np.sqrt(1 - cosine**2)
    # The curvature of the surface in the directions along the plane of incidence and across it.
    tangents = np.einsum("ijn,jcn->icn", patch.tangents(), np.array([patch.d_a, patch.d_b]))
    directions = np.array([[np.einsum("cn,cn->n", t, d) for t in tangents] for d in (along, s_axis)])
    curvature = np.einsum("xin,ijn,yjn->xyn", directions, patch.curvature(), directions)
    # [offset, 4], of the terms' four rows: plane, curvature along, across, and twist.
    weights = np.stack([np.ones_like(cosine), curvature[0, 0], curvature[1, 1], curvature[0, 1]], axis=1)
    sent = tx.field(incident)
    received = rx.field(-scattered)
    # Parts of both fields along s and p, and their products in the order of `bends.PAIRS`.
    parts_in = [np.einsum("in,in->n", sent, axis) for axis in (s_axis, np.cross(s_axis, incident, axis=0))]
    parts_out = [np.einsum("in,in->n", received, axis) for axis in (s_axis, np.cross(scattered, s_axis, axis=0))]
    pairs = np.stack([parts_in[i] * parts_out[j] for i, j in ((0, 0), (1, 1), (0, 1), (1, 0))], axis=1)
    terms = find_bend_terms(shape.stack)
    return np.stack([
        spread * np.einsum("nr,nrc,nc->n", weights, terms.evaluate(cosine, frequency_hz), pairs)
        for frequency_hz in frequencies_hz
    ])  # fmt: skip


def _sum_facets(
    shape: Shape, tx: Antenna, rx: Antenna, frequencies_hz: NDArray, offsets: NDArray, direct_m: float
) -> NDArray:
    """Sum a flat plate with sharp edges, facet by facet at each position: complex64 [frequencies, offsets]."""
    edges = shape.axes[:, :2] * np.asarray(shape.size_m)
    facets = rectangle(np.asarray(shape.place_m), edges[:, 1], edges[:, 0], PLATE_FACET_M)
    area_m2 = float(np.linalg.norm(np.cross(facets.edge_u[:, 0], facets.edge_v[:, 0])))
    normal = -shape.axes[:, 2]
    middle = np.asarray(shape.place_m)[:, None]
    antennas = place_antennas(tx, rx, offsets)
    middle_path_m = np.linalg.norm(middle - antennas[0], axis=0) + np.linalg.norm(middle - antennas[1], axis=0)
    # Paths over a plate differ by less than its diagonal from end to end: so many radians lie between the middle and an
    # end over half of the band, and a Chebyshev series converges from this degree on.
    radians = np.pi / 2 * float(np.hypot(*shape.size_m)) * np.ptp(frequencies_hz) / LIGHT_M_PER_S
    nodes_hz, expand = _place_frequency_nodes(frequencies_hz, 5 + int(np.ceil(radians)))
    tables = [CosineTable.get_cached(shape.stack, f) for f in nodes_hz]
    slow = np.empty((len(nodes_hz), len(offsets)), complex)
    at_once = max(1, CHUNK // len(facets.centres[0]))
    for first in range(0, len(offsets), at_once):
        chunk = slice(first, first + at_once)
        points = facets.centres[:, None] - offsets[chunk].T[:, :, None]
        response = respond(Waves.between(tx, rx, points), normal)
        rest_m = response.path_m - middle_path_m[chunk, None]
        steps_m = response.path_steps(facets.edge_u[:, :1, None], facets.edge_v[:, :1, None])
        reflected = reflect_facets(tables, response)
        for i, (frequency_hz, reflections) in enumerate(zip(nodes_hz, reflected, strict=True)):
            k = 2 * np.pi * frequency_hz / LIGHT_M_PER_S
            terms = reflections * integrate_steps(steps_m, frequency_hz) * turn_back(rest_m, frequency_hz)
            slow[i, chunk] = 1j * k / (4 * np.pi) * area_m2 * terms.sum(axis=1)
    return _add_carrier(slow, middle_path_m - direct_m, frequencies_hz, expand)
