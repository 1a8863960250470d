"""Physical optics about specular points, and the amplitudes of rays by geometrical optics.

Around a specular point the surface is sampled in units of its Fresnel zone and summed under a smooth window; the
trapezoidal rule of a smooth integrand converges exponentially. What lies outside adds nothing but edges and shadow
boundaries, which physical optics has wrong.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from polysight_worlds.media import LIGHT_M_PER_S, Stack, reflect
from polysight_worlds.optics import CHUNK, Antenna, Response, Waves, respond, turn_back
from polysight_worlds.shapes import Patch, PathAt, Shape, follow_path

# Window exp(-x) (1 + x + .. + x^4 / 24), x = (distance / WIDTH)^2 / 2, in units of the Fresnel zone, sqrt(1 / (k second
# derivative)). It is entire and flat to tenth order: of a quadratic phase it misses 945 j / (120 (2 WIDTH^2)^5), 0.9 %,
# which `_fresnel_zones` puts back. A wider one reached the shadow of a sphere of 100 mm: with 1.8, and currents that
# faded below a cosine of 0.3, its permittivity was 0.1 to 0.3 % off.
WIDTH = 1.4
# The last samples, where the window has fallen to 5e-3; chosen.
END = 7.0
# Along a flat direction the phase of an oblique path grows faster than by its square. Samples 0.62 apart took its far
# part for another stationary point: H / V of metal was 0.2 % off.
SPACING = 0.5
# Least second derivative of the path for the size of a zone: near a caustic the zone would grow without end. Chosen.
LEAST_BEND_PER_M = 0.8
# Below this cosine of incidence, or of scattering, currents fade to 0 at grazing: they do not end suddenly at the
# shadow's edge. Chosen: a smaller one is truer to the surface and leaves a steeper step.
GRAZING = 0.15


def place_antennas(tx: Antenna, rx: Antenna, offsets: NDArray) -> tuple[NDArray, NDArray]:
    """Return places of TX and RX [3, offsets] at stage offsets [offsets, 3]."""
    return tx.position[:, None] + offsets.T, rx.position[:, None] + offsets.T


def window_units() -> NDArray:
    """Return distances [sample] in Fresnel zones at which the window is sampled."""
    return np.arange(-np.floor(END / SPACING), np.floor(END / SPACING) + 1) * SPACING


def window(units: NDArray) -> NDArray:
    """Smooth window at distances in Fresnel zones, of any shape."""
    x = (units / WIDTH) ** 2 / 2
    return np.exp(-x) * (1 + x * (1 + x / 2 * (1 + x / 3 * (1 + x / 4))))


def _fade_shadow(normals: NDArray, response: Response) -> NDArray:
    """Smooth step from 1 to 0 towards grazing incidence or scattering; `normals` [3, ...]."""
    # The gradient of the path is the direction of incidence minus that of scattering, and cos_incidence their -n i.
    cos_scattering = -response.cos_incidence - np.einsum("i...,i...->...", normals, response.gradient)
    share = np.clip(np.minimum(response.cos_incidence, cos_scattering) / GRAZING, 0, 1)
    return share**2 * (3 - 2 * share)


def spread_of_ray(patch: Patch, path: PathAt, tx_m: NDArray, rx_m: NDArray) -> NDArray:
    """Return the amplitude of a ray at n specular points by geometrical optics, complex [n], of 1 at 1 m from TX.

    cos(incidence) / (r1 r2 sqrt(det path'')), with the path's second derivatives by the tangent plane's metres. After a
    focus it has the phase of that: a factor j for each negative curvature of the path.
    """
    out_m = np.linalg.norm(patch.point - tx_m, axis=0)
    back_m = np.linalg.norm(patch.point - rx_m, axis=0)
    cosine = np.einsum("in,in->n", patch.normal, tx_m - patch.point) / out_m
    # [tangent, parameter, n]: turns derivatives by the parameters into those by metres along the tangents.
    basis = patch.tangents()
    bends = np.linalg.eigvalsh(np.moveaxis(np.einsum("ij...,jk...,lk...->il...", basis, path.hessian, basis), -1, 0))
    return cosine / (out_m * back_m * np.sqrt(np.abs(bends.prod(axis=1)))) * 1j ** (bends < 0).sum(axis=1)


def sum_window(
    shape: Shape,
    tx: Antenna,
    rx: Antenna,
    frequencies_hz: NDArray,
    offsets: NDArray,
    places: tuple[NDArray, ...],
) -> NDArray:
    """Physical optics about specular points, without the specular path's phase: complex [frequencies, offsets].

    `places`: the surface's parameters a and b at the specular point of each offset. Antennas are replaced by dipoles
    with the same fields towards these points, as in the exact series (series.py). The sum is that of `Response`.
    """
    units = window_units()
    xi, eta = (grid.ravel() for grid in np.meshgrid(units, units))
    weights = window(xi) * window(eta) * SPACING**2
    sums = np.empty((len(frequencies_hz), len(offsets)), complex)
    at_once = max(1, CHUNK // len(weights))
    middle_k = 2 * np.pi * float(np.mean(frequencies_hz)) / LIGHT_M_PER_S
    tables = [CosineTable.get_cached(shape.stack, f) for f in frequencies_hz]
    for first in range(0, len(offsets), at_once):
        chunk = slice(first, first + at_once)
        a0 = places[0][chunk]
        b0 = places[1][chunk]
        u = offsets[chunk]
        middle = shape.evaluate(a0, b0)
        tx_dipoles = tx.as_dipoles(middle.point - u.T)
        rx_dipoles = rx.as_dipoles(middle.point - u.T)
        path = follow_path(middle, *place_antennas(tx, rx, u))
        zones, zone_area = _fresnel_zones(middle.tangents(), path.hessian, middle_k)
        a = a0[:, None] + zones[0, 0, :, None] * xi + zones[1, 0, :, None] * eta
        b = b0[:, None] + zones[0, 1, :, None] * xi + zones[1, 1, :, None] * eta
        patch = shape.evaluate(a, b)
        moved = patch.point - u.T[:, :, None]
        response = respond(Waves.between(tx_dipoles, rx_dipoles, moved), patch.normal)
        area = patch.area * zone_area[:, None] * weights * shape.cover(a, b) * _fade_shadow(patch.normal, response)
        rest_m = response.path_m - path.length_m[:, None]
        reflected = reflect_facets(tables, response)
        for i, (frequency_hz, reflections) in enumerate(zip(frequencies_hz, reflected, strict=True)):
            k = 2 * np.pi * frequency_hz / LIGHT_M_PER_S
            terms = reflections * area * turn_back(rest_m, frequency_hz)
            sums[i, chunk] = 1j * k / (4 * np.pi) * terms.sum(axis=1)
    return sums


def _fresnel_zones(tangents: NDArray, hessian: NDArray, k: float) -> tuple[NDArray, NDArray]:
    """Change of both parameters by one Fresnel zone along each axis [2 axes, 2 parameters, n], and the zone's area [n].

    The axes are those along which the path's second derivatives do not mix. The area is in units of both parameters,
    and complex: what the window misses of a quadratic phase is put back.
    """
    bends = np.einsum("ij...,jk...,lk...->il...", tangents, hessian, tangents)
    eigenvalues, vectors = np.linalg.eigh(np.moveaxis(bends, -1, 0))
    lengths = 1 / np.sqrt(k * np.maximum(np.abs(eigenvalues), LEAST_BEND_PER_M))
    # vectors [n, component, axis]
    rates = np.einsum("nia,ijn,na->ajn", vectors, tangents, lengths)
    units = window_units()
    # Share of the integral of exp(-j units^2 / 2) that the windowed sum finds.
    found = SPACING * (window(units) @ np.exp(-0.5j * units**2)) / np.sqrt(-2j * np.pi)
    found_of_both = np.where(eigenvalues > 0, found, found.conj()).prod(axis=1)
    return rates, np.abs(rates[0, 0] * rates[1, 1] - rates[0, 1] * rates[1, 0]) / found_of_both


class CosineTable:
    """Reflection coefficients of a medium over the cosine of incidence, linear between 513 (chosen) places; complex128.

    `media.ReflectionTable` is the same in single precision.
    """

    @staticmethod
    def get_cached(stack: Stack, frequency_hz: float) -> CosineTable:
        """Return the table of a medium, made once; without layers it is the same at all frequencies."""
        return _make_table(stack, frequency_hz if stack.layers else 0.0)

    def __init__(self, stack: Stack, frequency_hz: float) -> None:
        cosines = np.linspace(0, 1, 513)
        # At 0 the formula of r_p divides by it.
        cosines[0] = 1e-6
        tables = reflect(stack, frequency_hz, cosines)
        # Values, and their steps to the next place.
        self._tables = [(np.ascontiguousarray(table), np.diff(table, append=table[-1:])) for table in tables]

    def look_up(self, cos_incidence: NDArray) -> tuple[NDArray, NDArray]:
        """Return (r_s, r_p) as complex128 of the shape of `cos_incidence`."""
        place = np.clip(cos_incidence, 0, 1) * 512
        left_index = np.minimum(place.astype(np.int32), 511)
        share = place - left_index
        s, p = (values.take(left_index) + share * steps.take(left_index) for values, steps in self._tables)
        return s, p


def reflect_facets(tables: Sequence[CosineTable], response: Response) -> Iterator[NDArray]:
    """Yield r_s s_weight + r_p p_weight by each table; successive equal tables are computed once."""
    last = None
    terms = np.zeros(0)
    for table in tables:
        if table is not last:
            r_s, r_p = table.look_up(response.cos_incidence)
            terms = r_s * response.s_weight + r_p * response.p_weight
            last = table
        yield terms


@lru_cache(maxsize=256)
def _make_table(stack: Stack, frequency_hz: float) -> CosineTable:
    return CosineTable(stack, frequency_hz)
