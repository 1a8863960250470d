"""Antennas as vectors, and what one specular point gives: the voltages of H and V as combinations of r_s and r_p.

At a tilted surface the plane of incidence is turned: H receives p too, and V s. With the fields of the antennas as unit
vectors across the direction (Ludwig's third definition, carried along the arc from the boresight), a receiver's voltage
is g spreading exp(-j k L) (r_s (e_T.s)(e_R.s) + r_p (e_T.p_i)(e_R.p_r)): g is the gain of the antennas, k the wave
number, L the path, e the fields of TX and RX, s the axis across the plane of incidence, and p_i, p_r the axes in it,
across the incident and the reflected ray. Both coefficients are those of tangential fields, r_s = r_p = -1 for metal.

At a surface of curvature K they differ from Fresnel's to first order in K / k (`reflect_curved`):
* the wave at the surface is that of a cylinder: the logarithmic derivatives of Hankel functions (by WKB -j cos(theta)
  - K / (2 k cos^2(theta))) replace the plane wave's, inside and outside;
* the saddle point sums over directions: <d theta^2> = j K / (2 k cos(theta)) in the plane of incidence, where r''
  enters, and the same across it, where the angle grows by its square and the plane of incidence turns: s and p mix.
* curvature may be twisted between both directions: then a cylinder's wave and the sum over directions couple s and p
  (`mix_twisted`).
* a spherical wave of a finite path holds directions, too (`reflect_spherical`), at a plane as well.
The first is Snyder and Love (IEEE Trans. MTT 23, 134, 1975) and, for metal, the second term of Luneberg and Kline; the
second is the next order of the stationary phase (Felsen and Marcuvitz, section 4.2). The first three are linear in K,
the last one in 1 / path.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from polysight.polarimetry import fresnel
from polysight.surfaces.points import compute_tangents, compute_unit_legs, find_normals
from polysight_shared.config import Board, Instrument
from polysight_shared.geometry import rx_positions_m, transform_to_rig, tx_position_m
from polysight_shared.units import SPEED_OF_LIGHT_M_S

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
# Step of numerical derivatives by the angle of incidence, radians; chosen.
ANGLE_STEP = 1e-3


@dataclass(frozen=True)
class Antenna:
    """Place (metres), boresight, and field vectors at boresight of the wanted polarisation and of the other one, [3].

    `leakage` is the amplitude of the other polarisation relative to the wanted one.
    """

    at_m: Array
    boresight: Array
    wanted: Array
    other: Array
    leakage: complex = 0j

    def field(self, directions: Array) -> Complex:
        """Return the field vectors [n, 3] in unit directions [n, 3]."""
        vector = self.wanted + self.leakage * self.other
        return _carry_along_arc(self.boresight, directions, vector)

    def turn(self, angle_rad: float) -> Antenna:
        """Return the antenna with its polarisation turned about the boresight, right-handed."""
        cos = np.cos(angle_rad)
        sin = np.sin(angle_rad)
        turned_vectors = [cos * v + sin * np.cross(self.boresight, v) for v in (self.wanted, self.other)]
        return replace(self, wanted=turned_vectors[0], other=turned_vectors[1])


def _carry_along_arc(start: Array, ends: Array, vector: NDArray) -> NDArray:
    """Turn `vector`, across the unit vector `start`, as `start` is turned to `ends` [n, 3] on the shortest arc."""
    along_ends = ends @ vector
    # Rodrigues' rotation for start . vector = 0; the limit is for an end opposite to the start (no arc is shortest).
    return vector - (start + ends) * (along_ends / np.maximum(1 + ends @ start, 1e-6))[:, None]


@dataclass(frozen=True)
class Optics:
    """The antennas of a rig as H and V use them: `tx`, and the middle of the RX of both receivers, `h` and `v`.

    `wave_number`: at the middle of the band, where echoes have their phases; 1 / m.
    """

    tx: Antenna
    h: Antenna
    v: Antenna
    wave_number: float

    def receiver(self, channel: str) -> Antenna:
        """Return the receiver "h" or "v"."""
        return self.h if channel == "h" else self.v


def make_optics(rig: Instrument, leakage: tuple[complex, complex] = (0j, 0j)) -> Optics:
    """Return the antennas of a rig; the mounts give places and boresights.

    Towards their mirror points on the object plane TX has equal parts of s and p, H has s and V p, as the published
    images show. `leakage`: of p into H and of s into V. TX has none: its `other` equals its `wanted`.
    """
    plane_m = rig.geometry.object_distance_mm / 1e3
    receivers = [np.array(rx_positions_m(rig, board)).mean(axis=0) for board in rig.receivers]
    tx_m = np.array(tx_position_m(rig))
    half = np.sqrt(0.5)
    tx = aim_antenna(tx_m, _compute_boresight(rig.transmitter), receivers[0], plane_m, (half, half))
    h = aim_antenna(receivers[0], _compute_boresight(rig.receivers[0]), tx_m, plane_m, (1.0, 0.0))
    v = aim_antenna(receivers[1], _compute_boresight(rig.receivers[1]), tx_m, plane_m, (0.0, 1.0))
    # Echoes have the phase at the middle of the linear samples. At another wave number H / V would turn by the
    # difference of their paths, 0.7 mm at the sphere of the calibration.
    chirp = rig.chirp
    first, end = chirp.linear_samples
    middle_hz = chirp.first_sample_hz + chirp.hz_per_sample * (first + end - 1) / 2
    wave_number = 2 * np.pi * middle_hz / SPEED_OF_LIGHT_M_S
    return Optics(tx, replace(h, leakage=leakage[0]), replace(v, leakage=leakage[1]), wave_number)


def _compute_boresight(board: Board) -> Array:
    """Return the unit vector in which a board looks, rig frame, [3]."""
    forward_m = np.array(transform_to_rig((0.0, 0.0, 1000.0), board.mount)) - np.array(
        transform_to_rig((0.0, 0.0, 0.0), board.mount)
    )
    return forward_m / np.linalg.norm(forward_m)


def aim_antenna(at_m: Array, boresight: Array, partner_m: Array, plane_m: float, parts: tuple[float, float]) -> Antenna:
    """Return an antenna with given parts (s, p) towards the point of the object plane that mirrors its partner.

    Places `at_m` and `partner_m` [3] and the plane in metres, rig frame; `boresight` [3] is a unit vector. Its other
    polarisation has the parts exchanged. The s axis points along +y.
    """
    # The mirror point divides the way to the partner like the distances of both from the plane.
    share = (plane_m - at_m[2]) / (2 * plane_m - at_m[2] - partner_m[2])
    target = np.array([*(at_m + share * (partner_m - at_m))[:2], plane_m])
    direction = (target - at_m) / np.linalg.norm(target - at_m)
    s_axis = np.cross([0.0, 0.0, 1.0], direction)
    s_axis *= np.sign(s_axis[1]) / np.linalg.norm(s_axis)
    # Along +x, so that metal gives H and V the same sign.
    p_axis = np.cross(direction, s_axis)
    p_axis *= np.sign(p_axis[0])
    s_share, p_share = parts
    vectors = (s_share * s_axis + p_share * p_axis, p_share * s_axis + s_share * p_axis)
    boresight_vectors = [_carry_along_arc(direction, boresight[None], vector)[0] for vector in vectors]
    return Antenna(at_m, boresight, boresight_vectors[0], boresight_vectors[1])


@dataclass(frozen=True)
class VisibleNormals:
    """Normals that a grid shows at the middle of the image.

    `x_deg`, `y_deg`: largest tilts in x and in y. `alias_deg`: those at which phases alias, infinite where none does.
    """

    x_deg: float
    y_deg: float
    alias_deg: tuple[float, float]


def mirror_point(optics: Optics, plane_m: float) -> Array:
    """Return the point of the plane at z = `plane_m` that mirrors TX into H, with the stage at zero: [3]."""
    tx_m = optics.tx.at_m
    rx_m = optics.h.at_m
    share = (plane_m - tx_m[2]) / (2 * plane_m - tx_m[2] - rx_m[2])
    x, y, _ = tx_m + share * (rx_m - tx_m)
    return np.array([x, y, plane_m])


def visible_normals(rig: Instrument) -> VisibleNormals:
    """Return the normals that a rig's grid shows: those that mirror TX into H from its ends.

    The slope of a tilted plane's path is 2 cos(theta) sin(tilt); phases alias where it exceeds lambda / (2 step).
    """
    optics = make_optics(rig)
    middle = mirror_point(optics, rig.geometry.object_distance_mm / 1e3)
    half_x = (rig.grid.columns - 1) / 2 * rig.grid.step_x_mm / 1e3
    half_y = (rig.grid.rows - 1) / 2 * rig.grid.step_y_mm / 1e3
    # The stage at the end in x, at the end in y, and in the middle.
    at_m = np.array([[half_x, 0.0, 0.0], [0.0, half_y, 0.0], [0.0, 0.0, 0.0]])
    normals, cos = find_normals(np.tile(middle, (3, 1)), at_m, optics.tx.at_m, optics.h.at_m)
    tilts = np.degrees(np.arctan2(np.abs(normals[:, :2]), -normals[:, 2:]))
    wave_m = 2 * np.pi / optics.wave_number
    limits = []
    for step_mm in (rig.grid.step_x_mm, rig.grid.step_y_mm):
        sine = wave_m / (2 * step_mm / 1e3) / (2 * float(cos[2]))
        limit_deg = float("inf")
        if sine < 1:
            limit_deg = float(np.degrees(np.arcsin(sine)))
        limits.append(limit_deg)
    return VisibleNormals(float(tilts[0, 0]), float(tilts[1, 1]), (limits[0], limits[1]))


def compute_polarisation_row(points: Array, normals: Array, at_m: Array, tx: Antenna, rx: Antenna) -> Complex:
    """Return coefficients [n, 4] of r_s and r_p in a voltage, and of the reflections from s to p and from p to s.

    `points` and `normals` [n, 3] are seen from stage offsets `at_m` [n, 3].
    """
    # Unit vectors from TX and from RX to the points.
    t, r, *_ = compute_unit_legs(points, at_m, tx.at_m, rx.at_m)
    s_axis = np.cross(normals, t)
    s_axis /= np.maximum(np.linalg.norm(s_axis, axis=1, keepdims=True), 1e-12)
    p_in = np.cross(s_axis, t)
    p_out = np.cross(s_axis, r)
    sent_field = tx.field(t)
    received = rx.field(r)

    def dot(a: NDArray, b: NDArray) -> NDArray:
        return np.einsum("ni,ni->n", a, b)

    sent_s = dot(sent_field, s_axis)
    sent_p = dot(sent_field, p_in)
    received_s = dot(received, s_axis)
    received_p = dot(received, p_out)
    rows = [sent_s * received_s, sent_p * received_p, sent_s * received_p, sent_p * received_s]
    return np.stack(rows, axis=1)


def resolve_curvature(points: Array, normals: Array, curvature: Array, at_m: Array, tx_m: Array) -> Array:
    """Return the curvature in the plane of incidence, across it, and twist between both, [3, n], 1 / m.

    `curvature` [n, 2, 2] is that along the `compute_tangents` of the `normals`; `points`, `normals` and the stage
    offsets `at_m` are [n, 3].
    """
    ray = points - at_m - tx_m
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    ray_in_plane = np.einsum("nij,ni->nj", compute_tangents(normals), ray)
    ray_in_plane /= np.maximum(np.linalg.norm(ray_in_plane, axis=1, keepdims=True), 1e-12)
    ray_across = np.stack([-ray_in_plane[:, 1], ray_in_plane[:, 0]], axis=1)
    pairs = ((ray_in_plane, ray_in_plane), (ray_across, ray_across), (ray_in_plane, ray_across))
    return np.stack([np.einsum("ni,nij,nj->n", first, curvature, second) for first, second in pairs])


def reflect_flat(eps: NDArray | complex, theta: Array) -> tuple[Complex, Complex]:
    """Return Fresnel's r_s and r_p of tangential fields, broadcast; -1 and -1 for an infinite `eps`."""
    r_s, r_p = fresnel(eps, theta)
    return np.asarray(r_s), np.asarray(r_p)


def reflect_curved(
    eps: NDArray | complex, theta: Array, bend_inside: Array, bend_across: Array, wave_number: float
) -> tuple[Complex, Complex]:
    """Return coefficients (r_s, r_p) [n] at a curved surface, to first order in curvature / wave number.

    `eps` is the permittivity, infinite for metal, `theta` the incidence angle in radians. `bend_inside`, `bend_across`:
    curvature (1 / m, convex positive) in the plane of incidence and across it.
    """
    bends = (bend_inside, bend_across)
    single_wave = _reflect_local(eps, theta, bends, wave_number)
    # Derivatives by the angle are those of the flat coefficients. Metal's are -1 at every angle: there those with the
    # bends count (2 % of V of a sphere of 50 mm). For dielectrics the next order of all other terms is missing anyway,
    # and derivatives without bends are closer to the series.
    is_metal = bool(np.any(np.isinf(eps)))
    bends_of_slopes = bends
    if not is_metal:
        bends_of_slopes = (0 * bend_inside, 0 * bend_across)
    middle = _reflect_local(eps, theta, bends_of_slopes, wave_number)
    above = _reflect_local(eps, theta + ANGLE_STEP, bends_of_slopes, wave_number)
    below = _reflect_local(eps, theta - ANGLE_STEP, bends_of_slopes, wave_number)
    cos = np.cos(theta)
    sin = np.sin(theta)
    coefficients = []
    # s, then p. `change_inside` is half the variance of the angle times r''. For `change_across`, the angle grows by
    # half the squared deviation over tan(theta), and the plane turns by the deviation over sin(theta).
    for local, r, other, up, down in zip(single_wave, middle, middle[::-1], above, below, strict=True):
        first = (up - down) / (2 * ANGLE_STEP)
        second = (up - 2 * r + down) / ANGLE_STEP**2
        change_inside = 1j * bend_inside / (4 * wave_number * cos) * second
        change_across = 1j * bend_across / (2 * wave_number * cos) * (first * cos / sin / 2 + (other - r) / sin**2)
        coefficients.append(local + change_inside + change_across)
    return coefficients[0], coefficients[1]


def reflect_spherical(
    eps: NDArray | complex, theta: Array, path_m: Array, wave_number: float
) -> tuple[Complex, Complex]:
    """Return additions to (r_s, r_p) [n] for a spherical wave of a finite path, to first order in 1 / (k path).

    The sum over directions of a plane: <d theta^2> = j / (k path), in the plane of incidence and across it.
    """
    flat_coefficients = reflect_flat(eps, theta)
    above = reflect_flat(eps, theta + ANGLE_STEP)
    below = reflect_flat(eps, theta - ANGLE_STEP)
    spread = 1j / (2 * wave_number * path_m)
    additions = []
    for r, up, down in zip(flat_coefficients, above, below, strict=True):
        first = (up - down) / (2 * ANGLE_STEP)
        second = (up - 2 * r + down) / ANGLE_STEP**2
        additions.append(spread * (second + first / np.tan(theta)))
    return additions[0], additions[1]


def mix_twisted(eps: NDArray | complex, theta: Array, twist: Array, wave_number: float) -> Complex:
    """Coefficient [n] of p from s, and of s from p, at a twisted surface, to first order in curvature / wave number.

    `twist`: curvature (1 / m) between the direction of incidence along the surface and normal x that direction. Both
    coefficients are the same, by reciprocity.
    """
    cos = np.cos(theta)
    sin = np.sin(theta)
    r_s, r_p = reflect_flat(eps, theta)
    next_s, next_p = reflect_flat(eps, theta + ANGLE_STEP)
    previous_s, previous_p = reflect_flat(eps, theta - ANGLE_STEP)
    first = ((next_s - next_p) - (previous_s - previous_p)) / (2 * ANGLE_STEP)
    # The sum over directions: with the angle of incidence its plane turns.
    directions = first / (2 * sin * cos) - (r_s - r_p) / (2 * sin**2)
    # The wave of a cylinder: its logarithmic derivative differs from a plane wave's, in air and in the medium. The
    # tangential electric fields at the surface are 1 + r of the incident ones, the magnetic ones 1 - r.
    if np.any(np.isinf(eps)):
        electric = 0.0
        magnetic = 1 / cos**2
    else:
        # Square of the normal wave number in the medium over k.
        normal2 = np.asarray(eps) - sin**2
        electric = 1 / cos**2 - eps / normal2
        magnetic = 1 / cos**2 - 1 / normal2
    local = (electric * (1 + r_s) * (1 + r_p) + magnetic * (1 - r_s) * (1 - r_p)) / 4
    return np.asarray(1j * twist / wave_number * (directions + local))


def _reflect_local(
    eps: NDArray | complex, theta: Array, bends: tuple[Array, Array], wave_number: float
) -> tuple[Complex, Complex]:
    """Return coefficients (r_s, r_p) [n] of a single cylindrical wave, without the sum over directions.

    `bends` are the curvatures in the plane of incidence and across it. Both cylinders change the flat coefficients
    independently, to first order.
    """
    bend_inside, bend_across = bends
    cos = np.cos(theta)
    sin = np.sin(theta)
    if np.any(np.isinf(eps)):
        # The axial field or its derivative vanishes: s in the plane of incidence and p across it stay -1.
        turn_p = bend_inside / (wave_number * cos**3)
        turn_s = bend_across / (wave_number * cos)
        return -np.exp(1j * turn_s), -np.exp(1j * turn_p)
    eps = np.asarray(eps, complex)
    root = np.sqrt(eps)
    cos_medium = np.sqrt(1 - sin**2 / eps)
    r_s, r_p = reflect_flat(eps, theta)

    # Cylinder across the plane of incidence. Logarithmic derivatives along the normal, over k: of the waves towards the
    # surface and away from it in air (`into`, `out`), and of the wave in the medium (`inside_term`). `outer` and
    # `inner` are the changes by curvature outside and inside.
    outer = bend_inside / (2 * wave_number * cos**2)
    inner = bend_inside / (2 * wave_number * cos_medium**2)
    into = 1j * cos - outer
    out = -1j * cos - outer
    inside_term = 1j * root * cos_medium - inner
    local_s = -(into - inside_term) / (out - inside_term)
    local_p = (into - inside_term / eps) / (out - inside_term / eps)
    # Cylinder along the plane of incidence: the same of the fields along its axis, over the square of the normal wave
    # numbers (`k_out`, `k_in`, over k), since so the fields around it follow from these.
    k_out = cos
    k_in = root * cos_medium
    outer = bend_across / (2 * wave_number * k_out)
    inner = bend_across / (2 * wave_number * k_in)
    into = (1j - outer) / k_out
    out = (-1j - outer) / k_out
    inside_term = (1j - inner) / k_in
    across_s = (into - inside_term) / (out - inside_term)
    across_p = -(into - eps * inside_term) / (out - eps * inside_term)
    return local_s + across_s - r_s, local_p + across_p - r_p
