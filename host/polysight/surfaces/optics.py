"""Polarisation of the antennas, and reflection at a curved surface: the voltages of H and V by r_s and r_p.

H and V are the receivers. At a tilted surface the plane of incidence is turned against their polarisations: H receives
some p, too, and V some s. A receiver's voltage of an echo is

    g A exp(-j k L) (r_s (e_T.s) (e_R.s) + r_p (e_T.p_i) (e_R.p_r))

* g: gain of the antennas; A: spreading (`points.compute_spreading`); k: wave number, rad / m; L: path, m.
* r_s, r_p: reflection coefficients of the tangential fields, both -1 for metal.
* e_T, e_R: fields of TX and RX, unit vectors across the ray by Ludwig's third definition: those in boresight, carried
  along the arc to the ray's direction.
* s: unit vector across the plane of incidence; p_i, p_r: those in it, across the incident and the reflected ray.

At a surface of curvature K, r_s and r_p differ from Fresnel's coefficients r. All terms are of first order, the first
three in K / k, the last one in 1 / (k L):
* The wave at the surface is that of a cylinder (`_reflect_local`): the logarithmic derivatives of Hankel functions (by
  WKB -j cos(theta) - K / (2 k cos^2(theta))) replace those of a plane wave, inside and outside. Source: Snyder and Love
  (IEEE Trans. MTT 23, 134, 1975); for metal, the second term of Luneberg and Kline.
* An echo is a sum over directions about the specular one (`reflect_curved`). Their variance is <d theta^2> = j K / (2 k
  cos(theta)) in the plane of incidence, where r'' enters, and the same across it. There the angle of incidence grows by
  the square of the deviation, and the plane of incidence turns, which mixes s and p. Source: next order of the
  stationary phase (Felsen and Marcuvitz, section 4.2).
* Curvature may be twisted between both directions. Then both effects couple s and p (`mix_twisted`).
* The wave of an antenna at a finite distance is spherical and so a sum over directions, too (`reflect_spherical`). This
  holds for a plane as well.
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
    """An antenna: its place, boresight, and field vectors at boresight of both polarisations, [3].

    `at_m` is in metres, rig frame. `wanted` is the polarisation that the antenna is meant to have, `other` the other.
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
    """Return `vector` turned by the rotations that turn the unit vector `start` to `ends` on the shortest arc, [n, 3].

    `vector` [3] is perpendicular to `start`.
    """
    along_ends = ends @ vector
    # Rodrigues' rotation for start . vector = 0. The limit avoids a division by 0 if an end is opposite to the start.
    return vector - (start + ends) * (along_ends / np.maximum(1 + ends @ start, 1e-6))[:, None]


@dataclass(frozen=True)
class Optics:
    """The antennas of a rig: `tx`, and one for each receiver, `h` and `v`, in the middle of its RX.

    `wave_number`: at the middle of the band, rad / m; the phases of echoes are given there.
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

    A receiver and TX see each other in a mirror on the object plane at one point of it. Towards this point TX has equal
    parts of s and p, H has s alone, and V p alone, as the published images show. `leakage`: of p into H and of s into
    V. TX has none: its `other` equals its `wanted`.
    """
    plane_m = rig.geometry.object_distance_mm / 1e3
    receivers = [np.array(rx_positions_m(rig, board)).mean(axis=0) for board in rig.receivers]
    tx_m = np.array(tx_position_m(rig))
    half = np.sqrt(0.5)
    tx = aim_antenna(tx_m, _compute_boresight(rig.transmitter), receivers[0], plane_m, (half, half))
    h = aim_antenna(receivers[0], _compute_boresight(rig.receivers[0]), tx_m, plane_m, (1.0, 0.0))
    v = aim_antenna(receivers[1], _compute_boresight(rig.receivers[1]), tx_m, plane_m, (0.0, 1.0))
    # The phases of echoes are those at the middle of the linear samples. With another wave number k the phase of H / V
    # would be wrong by the error of k times the difference of both paths, 0.7 mm at the sphere of the calibration.
    chirp = rig.chirp
    first, end = chirp.linear_samples
    middle_hz = chirp.first_sample_hz + chirp.hz_per_sample * (first + end - 1) / 2
    wave_number = 2 * np.pi * middle_hz / SPEED_OF_LIGHT_M_S
    return Optics(tx, replace(h, leakage=leakage[0]), replace(v, leakage=leakage[1]), wave_number)


def _compute_boresight(board: Board) -> Array:
    """Return the unit vector in which a board looks, rig frame, [3]."""
    origin = np.array(transform_to_rig((0.0, 0.0, 0.0), board.mount))
    point_ahead = np.array(transform_to_rig((0.0, 0.0, 1000.0), board.mount))
    forward = point_ahead - origin
    return forward / np.linalg.norm(forward)


def aim_antenna(at_m: Array, boresight: Array, partner_m: Array, plane_m: float, parts: tuple[float, float]) -> Antenna:
    """Return an antenna with given parts (s, p) of its field towards the mirror point of its partner.

    The mirror point is where the antenna sees its partner in a mirror in the plane z = `plane_m`. Places `at_m` and
    `partner_m` [3] are in metres, rig frame; `boresight` [3] is a unit vector. The other polarisation has the parts
    exchanged. The s axis points along +y.
    """
    # The mirror point divides the line to the partner in the ratio of the distances of both from the plane.
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
    """Normals of surfaces at the middle of the image that a rig sees within its grid of stage positions.

    `x_deg`, `y_deg`: largest tilts in x and in y. `alias_deg`: tilts in x and in y from which phases alias from one
    stage position to the next; infinite if none does.
    """

    x_deg: float
    y_deg: float
    alias_deg: tuple[float, float]


def mirror_point(optics: Optics, plane_m: float) -> Array:
    """Return the point [3] of a mirror in the plane z = `plane_m` at which H sees TX; the stage is at zero. Metres."""
    tx_m = optics.tx.at_m
    rx_m = optics.h.at_m
    share = (plane_m - tx_m[2]) / (2 * plane_m - tx_m[2] - rx_m[2])
    x, y, _ = tx_m + share * (rx_m - tx_m)
    return np.array([x, y, plane_m])


def visible_normals(rig: Instrument) -> VisibleNormals:
    """Return the normals that a rig sees within its grid: those at which H sees TX mirrored from the grid's ends.

    The path over a plane with a tilt changes by 2 cos(theta) sin(tilt) per metre of the stage. Phases alias where this
    exceeds lambda / (2 step).
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
    """Return the factors [n, 4] of r_s, r_p, r_sp (s to p) and r_ps (p to s) in a voltage without gain and path.

        (e_T.s) (e_R.s), (e_T.p_i) (e_R.p_r), (e_T.s) (e_R.p_r), (e_T.p_i) (e_R.s)

    `points` and `normals` are [n, 3], and `at_m` [n, 3] the stage offsets from which the points are seen.
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
    """Return the curvature in the plane of incidence, that across it, and the twist between both, [3, n], 1 / m.

    With a and b unit vectors along the surface, in the plane of incidence and across it, these are a'K a, b'K b and
    a'K b. K = `curvature` [n, 2, 2] is given along the `compute_tangents` of the `normals`; `points`, `normals` and the
    stage offsets `at_m` are [n, 3].
    """
    ray = points - at_m - tx_m
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    ray_in_plane = np.einsum("nij,ni->nj", compute_tangents(normals), ray)
    ray_in_plane /= np.maximum(np.linalg.norm(ray_in_plane, axis=1, keepdims=True), 1e-12)
    ray_across = np.stack([-ray_in_plane[:, 1], ray_in_plane[:, 0]], axis=1)
    pairs = ((ray_in_plane, ray_in_plane), (ray_across, ray_across), (ray_in_plane, ray_across))
    return np.stack([np.einsum("ni,nij,nj->n", first, curvature, second) for first, second in pairs])


def reflect_flat(eps: NDArray | complex, theta: Array) -> tuple[Complex, Complex]:
    """Return Fresnel's r_s and r_p of tangential fields, -1 for an infinite `eps`; `eps` and `theta` are broadcast."""
    r_s, r_p = fresnel(eps, theta)
    return np.asarray(r_s), np.asarray(r_p)


def reflect_curved(
    eps: NDArray | complex, theta: Array, curvature_inside: Array, curvature_across: Array, wave_number: float
) -> tuple[Complex, Complex]:
    """Return coefficients (r_s, r_p) [n] at a curved surface, to first order in curvature / wave number.

    `eps` is the permittivity, infinite for metal, `theta` the incidence angle in radians. `curvature_inside` is the
    curvature in the plane of incidence, `curvature_across` that across it, 1 / m, positive for convex bodies.
    """
    curvatures = (curvature_inside, curvature_across)
    single_wave = _reflect_local(eps, theta, curvatures, wave_number)
    # The derivatives r' and r'' by the angle are those of flat surfaces for dielectrics: the next order of all other
    # terms is missing, too, and so the result is closer to the exact series. Flat metal has -1 at every angle, without
    # derivatives; there those of the curved surface are taken (2 % of V of a sphere of 50 mm).
    is_metal = bool(np.any(np.isinf(eps)))
    curvatures_of_derivatives = curvatures
    if not is_metal:
        curvatures_of_derivatives = (0 * curvature_inside, 0 * curvature_across)
    middle = _reflect_local(eps, theta, curvatures_of_derivatives, wave_number)
    above = _reflect_local(eps, theta + ANGLE_STEP, curvatures_of_derivatives, wave_number)
    below = _reflect_local(eps, theta - ANGLE_STEP, curvatures_of_derivatives, wave_number)
    cos = np.cos(theta)
    sin = np.sin(theta)
    coefficients = []
    # s, then p; `other` is the respective other coefficient. `change_inside` is half the variance of the angle times
    # r''. `change_across`: a deviation d across increases the angle by d^2 / (2 tan(theta)), and turns the plane of
    # incidence by d / sin(theta).
    for local, r, other, up, down in zip(single_wave, middle, middle[::-1], above, below, strict=True):
        first = (up - down) / (2 * ANGLE_STEP)
        second = (up - 2 * r + down) / ANGLE_STEP**2
        change_inside = 1j * curvature_inside / (4 * wave_number * cos) * second
        change_across = 1j * curvature_across / (2 * wave_number * cos) * (first * cos / sin / 2 + (other - r) / sin**2)
        coefficients.append(local + change_inside + change_across)
    return coefficients[0], coefficients[1]


def reflect_spherical(
    eps: NDArray | complex, theta: Array, path_m: Array, wave_number: float
) -> tuple[Complex, Complex]:
    """Return the changes of (r_s, r_p) [n] for a spherical wave with a finite path, to first order in 1 / (k path).

    The change is j / (2 k path) (r'' + r' / tan(theta)): the variance of the directions is <d theta^2> = j / (k path),
    in the plane of incidence and across it.
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
    """Return the coefficient [n] of p from s at a twisted surface, to first order in curvature / wave number.

    That of s from p is the same, by reciprocity. `twist` is a'K b (`resolve_curvature`), 1 / m.
    """
    cos = np.cos(theta)
    sin = np.sin(theta)
    r_s, r_p = reflect_flat(eps, theta)
    next_s, next_p = reflect_flat(eps, theta + ANGLE_STEP)
    previous_s, previous_p = reflect_flat(eps, theta - ANGLE_STEP)
    first = ((next_s - next_p) - (previous_s - previous_p)) / (2 * ANGLE_STEP)
    # The sum over directions: the plane of incidence turns while the angle of incidence changes.
    directions = first / (2 * sin * cos) - (r_s - r_p) / (2 * sin**2)
    # The wave of a cylinder: its logarithmic derivative differs from a plane wave's, in air and in the medium. The
    # tangential fields at the surface over the incident ones are 1 + r (electric) and 1 - r (magnetic).
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
    eps: NDArray | complex, theta: Array, curvatures: tuple[Array, Array], wave_number: float
) -> tuple[Complex, Complex]:
    """Return coefficients (r_s, r_p) [n] of a single cylindrical wave, without the sum over directions.

    `curvatures` are those in the plane of incidence and across it, 1 / m. To first order each changes the flat
    coefficients as if it were alone, so that the result is r(inside) + r(across) - r(flat).
    """
    curvature_inside, curvature_across = curvatures
    cos = np.cos(theta)
    sin = np.sin(theta)
    if np.any(np.isinf(eps)):
        # On metal the field along a cylinder's axis vanishes, or its derivative: curvature in the plane of incidence
        # does not change r_s, and curvature across it does not change r_p.
        turn_p = curvature_inside / (wave_number * cos**3)
        turn_s = curvature_across / (wave_number * cos)
        return -np.exp(1j * turn_s), -np.exp(1j * turn_p)
    eps = np.asarray(eps, complex)
    root = np.sqrt(eps)
    cos_medium = np.sqrt(1 - sin**2 / eps)
    r_s, r_p = reflect_flat(eps, theta)

    # Curvature in the plane of incidence: a cylinder whose axis is across that plane. `into`, `out` and `inside_term`
    # are logarithmic derivatives along the normal, over k, of the waves in air towards the surface and away from it,
    # and of the wave in the medium. `outer` and `inner` are their changes by the curvature, in air and in the medium.
    outer = curvature_inside / (2 * wave_number * cos**2)
    inner = curvature_inside / (2 * wave_number * cos_medium**2)
    into = 1j * cos - outer
    out = -1j * cos - outer
    inside_term = 1j * root * cos_medium - inner
    local_s = -(into - inside_term) / (out - inside_term)
    local_p = (into - inside_term / eps) / (out - inside_term / eps)
    # Curvature across the plane of incidence: a cylinder whose axis lies in that plane. The same for the fields along
    # its axis, divided by the squares of the normal wave numbers (over k: `k_out`, `k_in`): this turns fields along the
    # axis into those around it.
    k_out = cos
    k_in = root * cos_medium
    outer = curvature_across / (2 * wave_number * k_out)
    inner = curvature_across / (2 * wave_number * k_in)
    into = (1j - outer) / k_out
    out = (-1j - outer) / k_out
    inside_term = (1j - inner) / k_in
    across_s = (into - inside_term) / (out - inside_term)
    across_p = -(into - eps * inside_term) / (out - eps * inside_term)
    return local_s + across_s - r_s, local_p + across_p - r_p
