"""Vector physical optics: what an antenna receives of a wave that facets reflect.

A spherical wave of the transmit antenna meets a facet as a plane wave. It is split into s and p at the facet's own
normal, reflected by the facet's medium, and the currents of the reflected wave (electric J = n x H, magnetic
M = -n x E) radiate to the receive antenna. The phase over a facet is linear: its integral is a product of two sinc
functions. Amplitudes are relative to a transmitter with the far field g e exp(-jkr) / r.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from polysight_worlds.media import LIGHT_M_PER_S, ReflectionTable, Stack

# Facets times positions that are evaluated at once; chosen: their arrays stay in the processor's cache.
CHUNK = 20_000
# Smallest gain (-30 dB, chosen): side lobes keep some power beside and behind the main lobe.
PATTERN_FLOOR = 0.03


@dataclass(frozen=True)
class Antenna:
    """An antenna at `position` (3 metres) that looks along `boresight`, with pattern cos^n in amplitude.

    `polarisation`: complex vector at boresight. In other directions it is carried along the arc from the boresight, as
    of a Huygens source (Ludwig's third definition); of a dipole it is the part across the direction.
    """

    position: NDArray
    boresight: NDArray
    polarisation: NDArray
    exponent: float = 2.0
    is_dipole: bool = False

    @staticmethod
    def aim(
        position: NDArray, boresight: NDArray, direction: NDArray, polarisation: NDArray, exponent: float = 2.0
    ) -> Antenna:
        """Return the antenna whose field in `direction` has the given polarisation (a vector across `direction`)."""
        at_boresight = _carry(direction, boresight, polarisation)
        return Antenna(position, boresight, at_boresight, exponent)

    def rotate(self, rotation: NDArray, shift_m: NDArray) -> Antenna:
        """Return the antenna after a turn about its own place and a shift."""
        return replace(
            self,
            position=self.position + shift_m,
            boresight=rotation @ self.boresight,
            polarisation=rotation @ self.polarisation,
        )

    def with_leakage(self, leakage: complex) -> Antenna:
        """Return the antenna that also receives `leakage` times the other polarisation."""
        cross_axis = np.cross(self.boresight, self.polarisation)
        return replace(self, polarisation=self.polarisation + leakage * cross_axis)

    def field(self, directions: NDArray) -> NDArray:
        """Return the complex field vectors [3, ...] of unit distance in unit `directions` [3, ...]."""
        cosine = _dot(self.boresight, directions)
        gain = np.maximum(np.maximum(cosine, 0) ** self.exponent, PATTERN_FLOOR)
        if self.is_dipole:
            along = _dot(self.polarisation, directions)
            return gain * (_make_column(self.polarisation, directions) - along * directions)
        return gain * _carry(self.boresight, directions, self.polarisation)

    def as_dipoles(self, points_m: NDArray) -> Antenna:
        """Return dipoles [n] in its place whose fields towards `points_m` [3, n] are the antenna's.

        For `field` and `Waves.between` with directions and points [3, n, ...]. Over a Fresnel zone their fields change
        by what a direction makes of a dipole, and not by the slope of the pattern: the currents of physical optics do
        not answer to that, and what it does to an echo, 0.3 % of V in the published rig, would come out wrong.
        """
        ray = points_m - self.position[:, None]
        moments = self.field(ray / np.linalg.norm(ray, axis=0))
        return replace(self, polarisation=moments[:, :, None], exponent=0.0, is_dipole=True)


def _make_column(vector: NDArray, like: NDArray) -> NDArray:
    """Return a vector [3] in a shape that broadcasts with `like` [3, ...]; an array of vectors unchanged."""
    if vector.ndim == 1:
        return vector.reshape(3, *(1,) * (like.ndim - 1))
    return vector


def _dot(a: NDArray, b: NDArray) -> NDArray:
    """Return the scalar products of vectors [3, ...] or [3], without conjugation."""
    a, b = _make_column(a, b), _make_column(b, a)
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: NDArray, b: NDArray) -> NDArray:
    """Return the vector products of vectors [3, ...] or [3]."""
    a, b = _make_column(a, b), _make_column(b, a)
    product = np.empty(np.broadcast_shapes(a.shape, b.shape), np.result_type(a, b))
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        np.multiply(a[j], b[k], out=product[i])
        product[i] -= a[k] * b[j]
    return product


def _carry(start: NDArray, end: NDArray, vector: NDArray) -> NDArray:
    """Turn `vector` as the unit vector `start` is turned to `end` on the shortest arc; `vector` is across `start`."""
    start = _make_column(start, end)
    vector = _make_column(vector, end)
    summed = start + end
    return vector - summed * (_dot(vector, end) / np.maximum(1 + _dot(start, end), 1e-6))


@dataclass(frozen=True)
class Response:
    """What a facet of unit area gives before its medium and frequency are known; arrays of one shape.

    Received: (jk / 4 pi) (r_s s_weight + r_p p_weight) exp(-jk path) times the facet's phase integral. `gradient` and
    `curvature_z` are the path's first derivatives by the facet's place [3, ...] and its second one by z (1 / m).
    """

    path_m: NDArray
    gradient: NDArray
    curvature_z: NDArray
    s_weight: NDArray
    p_weight: NDArray
    cos_incidence: NDArray

    def path_steps(self, edge_u: NDArray, edge_v: NDArray) -> tuple[NDArray, NDArray]:
        """Change of the path along both edges [3, ...] of the facets, metres."""
        return _dot(self.gradient, edge_u), _dot(self.gradient, edge_v)


@dataclass(frozen=True)
class Waves:
    """Waves between the antennas and points, for any surface: unit directions and fields [3, ...], distances [...].

    `out_m` and `incident` lead from TX to the point, `back_m` and `scattered` from there to RX. `field` and `received`
    are the electric fields of TX, and of RX if it sent, towards the point at unit distance; `received_magnetic` is
    minus the magnetic field of RX times the impedance of free space.
    """

    out_m: NDArray
    back_m: NDArray
    incident: NDArray
    scattered: NDArray
    field: NDArray
    received: NDArray
    received_magnetic: NDArray

    @staticmethod
    def between(tx: Antenna, rx: Antenna, points: NDArray) -> Waves:
        """Return the waves from `tx` by way of `points` [3, ...] to `rx`."""
        out = points - _make_column(tx.position, points)
        back = _make_column(rx.position, points) - points
        out_m = np.sqrt(_dot(out, out))
        back_m = np.sqrt(_dot(back, back))
        incident = out / out_m
        scattered = back / back_m
        received = rx.field(-scattered)
        return Waves(
            out_m=out_m,
            back_m=back_m,
            incident=incident,
            scattered=scattered,
            field=tx.field(incident),
            received=received,
            received_magnetic=_cross(scattered, received),
        )


def respond(waves: Waves, normals: NDArray) -> Response:
    """Return the response of facets with unit `normals` [3, ...] or [3] towards the antennas."""
    incident = waves.incident
    scattered = waves.scattered
    normals = _make_column(normals, incident)
    cos_incidence = -_dot(incident, normals)
    lit = (cos_incidence > 0) & (_dot(scattered, normals) > 0)

    s_axis = _cross(incident, normals)
    length = np.sqrt(_dot(s_axis, s_axis))
    is_normal = length <= 1e-9
    if is_normal.any():
        # At normal incidence any axis across will do.
        s_axis = np.where(is_normal, _cross(incident, np.array([0.6, 0.8, 0.0])), s_axis)
        length = np.sqrt(_dot(s_axis, s_axis))
    s_axis = s_axis / length
    reflected = incident + 2 * cos_incidence * normals
    p_axis_in = _cross(s_axis, incident)
    p_axis_out = _cross(reflected, s_axis)

    s_part = _dot(waves.field, s_axis)
    p_part = _dot(waves.field, p_axis_in)
    n_cross_s = _cross(normals, s_axis)
    n_cross_p = _cross(normals, p_axis_out)
    # Reflected wave of unit s: E = s, eta H = p_out; of unit p: E = p_out, eta H = -s.
    from_s = _dot(waves.received, n_cross_p) - _dot(waves.received_magnetic, n_cross_s)
    from_p = -_dot(waves.received, n_cross_s) - _dot(waves.received_magnetic, n_cross_p)
    # With the minus a large plate's echo is r_s times the direct field at the distance of the mirror image.
    spread = np.where(lit, -1 / (waves.out_m * waves.back_m), 0)
    return Response(
        path_m=waves.out_m + waves.back_m,
        gradient=incident - scattered,
        curvature_z=(1 - incident[2] ** 2) / waves.out_m + (1 - scattered[2] ** 2) / waves.back_m,
        s_weight=spread * s_part * from_s,
        p_weight=spread * p_part * from_p,
        cos_incidence=cos_incidence,
    )


def integrate_steps(steps_m: tuple[NDArray, NDArray], frequency_hz: float) -> NDArray:
    """Return the integral of the linear phase over a parallelogram, relative to its area, of the steps' shape.

    `steps_m`: change of the path along both edges, see `Response.path_steps`.
    """
    over_u, over_v = (np.sinc((frequency_hz / LIGHT_M_PER_S * step_m).astype(np.float32)) for step_m in steps_m)
    return over_u * over_v


def turn_back(path_m: NDArray, frequency_hz: float) -> NDArray:
    """Return exp(-j k path), complex64 [...]: less than a turn is left, which single precision holds to 4e-7 rad."""
    turns = frequency_hz / LIGHT_M_PER_S * path_m
    angle = (2 * np.pi * (turns - np.rint(turns))).astype(np.float32)
    phasors = np.empty(angle.shape, np.complex64)
    np.cos(angle, out=phasors.real)
    np.sin(-angle, out=phasors.imag)
    return phasors


def receive_direct(tx: Antenna, rx: Antenna, frequencies_hz: NDArray) -> NDArray:
    """Return the direct path from TX to RX, complex [frequencies]."""
    way = rx.position - tx.position
    distance_m = np.linalg.norm(way)
    direction = way / distance_m
    amplitude = _dot(tx.field(direction), rx.field(-direction)) / distance_m
    return amplitude * np.exp(-2j * np.pi * np.asarray(frequencies_hz) * distance_m / LIGHT_M_PER_S)


@dataclass(frozen=True)
class Facets:
    """Parallelograms: centres and edges, each [3, n] in metres; edge_u x edge_v points out of the body."""

    centres: NDArray
    edge_u: NDArray
    edge_v: NDArray


def scatter(
    tx: Antenna, rx: Antenna, facets: Facets, stack: Stack, frequencies_hz: NDArray, offsets: NDArray | None = None
) -> NDArray:
    """Sum over all facets, complex128 [offsets, frequencies], with both antennas moved by `offsets` [n, 3] (metres).

    Works for bodies of any form; each facet is seen without shadows of others.
    """
    offsets = np.zeros((1, 3)) if offsets is None else np.asarray(offsets, float)
    across = np.cross(facets.edge_u, facets.edge_v, axis=0)
    area_m2 = np.linalg.norm(across, axis=0)
    normals = (across / area_m2)[:, None]
    tables = [ReflectionTable(stack, f) for f in frequencies_hz]
    sums = np.empty((len(offsets), len(frequencies_hz)), complex)
    positions_at_once = max(1, CHUNK // len(area_m2))
    for first in range(0, len(offsets), positions_at_once):
        chunk = slice(first, first + positions_at_once)
        points = facets.centres[:, None] - offsets[chunk].T[:, :, None]
        response = respond(Waves.between(tx, rx, points), np.broadcast_to(normals, points.shape))
        steps_m = response.path_steps(facets.edge_u[:, None], facets.edge_v[:, None])
        for i, frequency_hz in enumerate(frequencies_hz):
            k = 2 * np.pi * frequency_hz / LIGHT_M_PER_S
            r_s, r_p = tables[i].look_up(response.cos_incidence)
            terms = r_s * response.s_weight + r_p * response.p_weight
            phase_integral = integrate_steps(steps_m, frequency_hz)
            phase = np.exp(-1j * k * response.path_m)
            sums[chunk, i] = 1j * k / (4 * np.pi) * (terms * phase_integral * phase) @ area_m2
    return sums


def rectangle(centre: NDArray, edge_a: NDArray, edge_b: NDArray, facet_m: float) -> Facets:
    """Facets of about `facet_m` of a flat rectangle with the given full edges [3]; edge_a x edge_b points out."""
    count_a = max(1, round(np.linalg.norm(edge_a) / facet_m))
    count_b = max(1, round(np.linalg.norm(edge_b) / facet_m))
    a = (np.arange(count_a) + 0.5) / count_a - 0.5
    b = (np.arange(count_b) + 0.5) / count_b - 0.5
    a, b = (grid.ravel() for grid in np.meshgrid(a, b))
    centres = np.asarray(centre)[:, None] + np.outer(edge_a, a) + np.outer(edge_b, b)
    repeated = np.ones_like(a)
    return Facets(centres, np.outer(edge_a, repeated) / count_a, np.outer(edge_b, repeated) / count_b)


def ellipsoid(centre: NDArray, radii: NDArray, facet_m: float, half_widths: NDArray | None = None) -> Facets:
    """Return facets of the half of an ellipsoid that faces the antennas (smaller z).

    A large radius in x or y makes a cylinder; `half_widths` in x and y then say where it ends.
    """
    # Tangent parallelograms over a regular grid in x and y, as far as the surface is not too steep.
    radii = np.asarray(radii, float)
    half_widths = radii[:2] if half_widths is None else np.asarray(half_widths, float)
    counts = np.ceil(2 * half_widths / facet_m).astype(int)
    step = 2 * half_widths / counts
    x, y = (np.arange(n) * d - w + d / 2 for n, d, w in zip(counts, step, half_widths, strict=True))
    x, y = (grid.ravel() for grid in np.meshgrid(x, y))
    # Beyond 0.97 (chosen) the slope is over 80 degrees for a sphere: no mirror image is seen there.
    inside = (x / radii[0]) ** 2 + (y / radii[1]) ** 2 < 0.97
    x = x[inside]
    y = y[inside]
    root = np.sqrt(1 - (x / radii[0]) ** 2 - (y / radii[1]) ** 2)
    slope_x = radii[2] * x / radii[0] ** 2 / root
    slope_y = radii[2] * y / radii[1] ** 2 / root
    zero = np.zeros_like(x)
    centres = np.asarray(centre, float)[:, None] + np.stack([x, y, -radii[2] * root])
    edge_x = np.stack([zero + step[0], zero, slope_x * step[0]])
    edge_y = np.stack([zero, zero + step[1], slope_y * step[1]])
    # In this order their product points out of the body, to smaller z.
    return Facets(centres, edge_y, edge_x)
