"""Reflection of flat plates, the integrand of the object's echo, and its exact but slow sum.

Reflection at 76..81 GHz in both polarisations, implemented independently of the host. Media are eps' - j eps'' (time
dependence exp(+j omega t)). Signs of Eq. 2 of the POLySIGHT paper: a perfect conductor has r_s = r_p = -1, so that
P = r_s / r_p = 1. The echo is computed by physical optics on flat plates, each with its own height and tilt.

A receiver's samples are the conjugate of the wave: a delay tau is exp(-j 2 pi f tau) in the wave, and its conjugate
exp(+j 2 pi f tau) in the samples. So complex factors of the wave (reflection, leakage) enter as their conjugate
(:func:`conjugate`).

Amplitudes are relative to the direct path: a free path of length R has amplitude d / R, d the board's direct path to
RX1. Antenna patterns are modelled only by one constant, the scene's `object_gain`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight_shared.config import Board, Instrument
from polysight_shared.geometry import rx_positions_m, specular_midpoint_m, tx_position_m
from polysight_shared.units import SPEED_OF_LIGHT_M_S
from polysight_simulators.scene.scene_file import Layer, Plate, Scene, draw_specimens, facets, slopes

Real = NDArray[np.floating]
Complex = NDArray[np.complexfloating]
# A function of plate, frequency (Hz) and incidence (rad) that returns the plate's reflection in a board's samples.
Reflectivity = Callable[[Plate, float, Real], Complex]


def half_space(epsilon: complex, theta_rad: NDArray[np.floating] | float) -> tuple[Complex, Complex]:
    """Return the reflection coefficients of one interface, air to `epsilon` (paper Eq. 2 with Snell's law).

    With q = sqrt(eps - sin^2 theta) = n_t cos(theta_t): r_s = (cos - q)/(cos + q), r_p = (q - eps cos)/(q + eps cos).

    Parameters
    ----------
    epsilon
        Relative permittivity eps' - j eps''.
    theta_rad
        Incidence angle from the normal, any shape.

    Returns
    -------
    r_s, r_p : complex128, shape of theta_rad
    """
    cos = np.cos(np.asarray(theta_rad, dtype=np.float64))
    # Principal root: its imaginary part is <= 0, so the transmitted wave exp(-j k q z) decays.
    q: Complex = np.sqrt(np.asarray(epsilon - 1.0 + cos**2, dtype=np.complex128))
    return np.asarray((cos - q) / (cos + q)), np.asarray((q - epsilon * cos) / (q + epsilon * cos))


def slab(
    epsilon: complex, thickness_m: float, frequency_hz: float, theta_rad: NDArray[np.floating] | float
) -> tuple[Complex, Complex]:
    """Return the reflection coefficients of a plate of finite thickness in air (Airy sum; Born and Wolf, section 1.6).

    r = r1 (1 - e) / (1 - r1^2 e), e = exp(-2 j k d sqrt(eps - sin^2 theta)), r1 the single interface.

    Returns
    -------
    r_s, r_p : complex128, shape of theta_rad
    """
    sin = np.sin(np.asarray(theta_rad, dtype=np.float64))
    q = np.sqrt(np.asarray(epsilon - sin**2, dtype=np.complex128))
    e = np.exp(-2j * (2 * np.pi * frequency_hz / SPEED_OF_LIGHT_M_S) * thickness_m * q)
    s, p = half_space(epsilon, theta_rad)
    return s * (1 - e) / (1 - s * s * e), p * (1 - e) / (1 - p * p * e)


def reflect_layers(
    layers: Sequence[Layer], frequency_hz: float, theta_rad: NDArray[np.floating] | float
) -> tuple[Complex, Complex]:
    """Return the reflection coefficients of a stack of layers in air, as transmission lines in series.

    From back to front, each layer transforms the impedance behind it (Pozar, Microwave Engineering, eq. 2.44) to
    Z (Z_b + j Z t) / (Z + j Z_b t), t = tan(k d q), with Z = 1 / q for s and q / eps for p, in units of free space.

    Returns
    -------
    r_s, r_p : complex128, shape of theta_rad
    """
    theta = np.asarray(theta_rad, dtype=np.float64)
    cos = np.cos(theta)
    sin = np.sin(theta)
    media = [(x.epsilon, x.thickness_mm) for x in layers]
    if media[-1][1] is not None:
        media.append((1.0 + 0j, None))
    # Impedance of the layers behind the current one, for both polarisations; not used by the last medium.
    z_s: Complex = np.zeros(theta.shape, np.complex128)
    z_p: Complex = z_s
    for epsilon, thickness_mm in reversed(media):
        q: Complex = np.sqrt(np.asarray(epsilon - sin**2, dtype=np.complex128))
        layer_s = 1 / q
        layer_p = q / epsilon
        if thickness_mm is None:
            z_s = layer_s
            z_p = layer_p
            continue
        t = np.tan(2 * np.pi * frequency_hz / SPEED_OF_LIGHT_M_S * thickness_mm / 1e3 * q)
        z_s = layer_s * (z_s + 1j * layer_s * t) / (layer_s + 1j * z_s * t)
        z_p = layer_p * (z_p + 1j * layer_p * t) / (layer_p + 1j * z_p * t)
    # Signs of Eq. 2: both are -1 for a perfect conductor (no impedance).
    return (z_s * cos - 1) / (z_s * cos + 1), (z_p - cos) / (z_p + cos)


def strips(psi_rad: float, theta_rad: NDArray[np.floating] | float) -> tuple[Complex, Complex]:
    """Return the reflection of a screen that conducts in one direction only, at `psi_rad` from y towards x.

    Strips rotate the polarisation: each reflected component depends on both s and p of the incident wave. The
    coefficients hold only for a wave whose s and p are equal, as the transmitter sends it.
    The current J along the strips u = (sin psi, cos psi) in (x, y) makes the total field along u zero. It radiates with
    the wave impedances of the polarisations, 1 / (2 cos) for s and cos / 2 for p in units of free space.

    Returns
    -------
    r_s, r_p : complex128, shape of theta_rad
    """
    cos = np.cos(np.asarray(theta_rad, dtype=np.float64))
    u_x = np.sin(psi_rad)
    u_y = np.cos(psi_rad)
    # Tangential: E_y = 1, E_x = cos(theta)
    incident = u_y + u_x * cos
    current = incident / (u_y**2 / (2 * cos) + u_x**2 * cos / 2)
    r_s = -current * u_y / (2 * cos)
    # Tangential E_x back to the wave's amplitude
    r_p = -current * u_x * cos / 2 / cos
    return r_s.astype(np.complex128), r_p.astype(np.complex128)


def plate_reflection(plate: Plate, frequency_hz: float, theta_rad: NDArray[np.floating]) -> tuple[Complex, Complex]:
    """Return the reflection coefficients (r_s, r_p) of a plate, broadcast: metal, strips, half space, slab or stack."""
    if plate.strips_deg is not None:
        return strips(np.radians(plate.strips_deg), theta_rad)
    if plate.metal:
        minus_one = -np.ones(np.shape(theta_rad), dtype=np.complex128)
        return minus_one, minus_one.copy()
    first = plate.stack[0]
    if len(plate.stack) > 1:
        return reflect_layers(plate.stack, frequency_hz, theta_rad)
    if first.thickness_mm is None:
        return half_space(first.epsilon, theta_rad)
    return slab(first.epsilon, first.thickness_mm / 1e3, frequency_hz, theta_rad)


@dataclass(frozen=True)
class Antennas:
    """TX and RX of a board at stage offset zero, z of the object plane, and the image centre; metres, rig frame."""

    tx_m: Real
    rx_m: Real
    plane_z_m: float
    centre_m: Real

    @property
    def direct_m(self) -> Real:
        """Direct path to each RX, metres, [rx]."""
        return np.linalg.norm(self.rx_m - self.tx_m, axis=1)

    def legs(
        self, x_m: Real, y_m: Real, rx: int, z_m: Real | float | None = None, slope: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[Real, Real, Real, Real]:
        """Return r1, r2 (m), local incidence (rad) and obliquity of object points (x, y) relative to the stage.

        The points lie at z_m (None: object plane of the rig file) on a surface whose z grows by `slope` along x and y.
        Local incidence is half the angle between the directions to TX and RX. Obliquity is the mean cosine of both
        directions to the surface's normal, times the surface's area per dx dy.
        """
        z = self.plane_z_m if z_m is None else z_m
        ax = x_m - self.tx_m[0]
        ay = y_m - self.tx_m[1]
        az = z - self.tx_m[2]
        bx = x_m - self.rx_m[rx, 0]
        by = y_m - self.rx_m[rx, 1]
        bz = z - self.rx_m[rx, 2]
        r1 = np.sqrt(ax**2 + ay**2 + az**2)
        r2 = np.sqrt(bx**2 + by**2 + bz**2)
        theta = 0.5 * np.arccos(np.clip((ax * bx + ay * by + az * bz) / (r1 * r2), -1.0, 1.0))
        if any(slope):
            # The components along the normal (-slope_x, -slope_y, 1). Its length is the ratio of the surface's area to
            # dx dy, and is therefore not normalised.
            az = az - slope[0] * ax - slope[1] * ay
            bz = bz - slope[0] * bx - slope[1] * by
        return r1, r2, theta, 0.5 * (az / r1 + bz / r2)


def antennas(rig: Instrument, board: Board) -> Antennas:
    """Return the antenna positions of the transmitter and a receiving board."""
    tx = np.array(tx_position_m(rig))
    rx = np.array(rx_positions_m(rig, board))
    # The image has one centre for both boards: that of H.
    centre = np.array(specular_midpoint_m(rig, rig.by_role("receive_h")))
    return Antennas(tx, rx, rig.geometry.object_distance_mm / 1e3, centre)


def conjugate(factor: Any) -> Any:
    """Return a wave's complex factor (reflection, leakage) as it appears in samples: its conjugate."""
    return np.conj(factor)


def board_reflectivity(board: Board, scene: Scene) -> Reflectivity:
    """Return the function that gives a plate's reflection in a receiving board's samples, with cross-polar leakage.

    H: s + leak_h p. V: p + leak_v s. TX is rotated by 45 degrees and sends both polarisations equally. s and p are a
    plate's reflection in the polarisations of H and V (:func:`turn_reflection`).
    """
    leak_h = complex(*scene.disturbances.leakage_h)
    leak_v = complex(*scene.disturbances.leakage_v)

    def h(plate: Plate, frequency_hz: float, theta: Real) -> Complex:
        s, p = turn_reflection(plate, frequency_hz, theta)
        return conjugate(s + leak_h * p)

    def v(plate: Plate, frequency_hz: float, theta: Real) -> Complex:
        s, p = turn_reflection(plate, frequency_hz, theta)
        return conjugate(p + leak_v * s)

    return h if board.role == "receive_h" else v


def turn_reflection(plate: Plate, frequency_hz: float, theta: Real) -> tuple[Complex, Complex]:
    """Return the reflection of a plate in the polarisations of H and V for a wave with equal s and p there.

    A plate whose height grows along y by w turns the plane of incidence about x. Its s axis then differs by the angle
    d = w sin(theta) from that of a level plate, for the incident and for the reflected wave. In the turned axes the
    incident wave (s, p) = (1, 1) is (1 - d, 1 + d), to first order. The reflected wave, turned back, is

        H: (1 - d) r_s - d r_p,    V: (1 + d) r_p + d r_s

    For metal this is the field of TX's mirror image, whose polarisation is 2 (n . e) n - e for a polarisation e of TX
    and the normal n.
    """
    r_s, r_p = plate_reflection(plate, frequency_hz, theta)
    d = slopes(plate)[1] * np.sin(theta)
    return (1 - d) * r_s - d * r_p, (1 + d) * r_p + d * r_s


def direct_factor(board: Board, scene: Scene) -> complex:
    """Return the factor of the direct path in a board's samples: s and p are equal, so the wave is 1 + leakage."""
    d = scene.disturbances
    leakage = d.leakage_h if board.role == "receive_h" else d.leakage_v
    return conjugate(1.0 + complex(*leakage))


def plate_scale(ant: Antennas, scene: Scene, frequency_hz: float) -> complex:
    """Return the factor of the plates' integral, object_gain d / (j lambda): an infinite mirror gives -gain d / R.

    Kirchhoff's integral (Goodman, Introduction to Fourier Optics, section 3.5), which has phase +2 pi f tau as well:
    field = (1 / j lambda) integral conj(r(theta)) obliquity exp(+j 2 pi f (r1 + r2) / c) / (r1 r2) dA.
    """
    return complex(scene.object_gain * ant.direct_m[0] * frequency_hz / SPEED_OF_LIGHT_M_S / 1j)


def point_scale(ant: Antennas) -> float:
    """Return the factor of a point's 1 / (r1 r2), square metres.

    With it a point of amplitude 1 at the specular midpoint is as strong as the direct path.
    """
    r1, r2, _, _ = ant.legs(ant.centre_m[0], ant.centre_m[1], 0)
    return float(r1 * r2)


def field_exact(
    rig: Instrument, scene: Scene, board: Board, offsets_m: Real, frequencies_hz: Real, rx: int = 0
) -> Complex:
    """Compute the object field by direct quadrature; slow, for tests and small scenes.

    Gauss-Legendre quadrature over each facet of each plate (a smooth plate is one facet), with enough points for the
    phase change across it. Every point has its true height, and the plate's normal for its obliquity; facets of a rough
    plate are parallel to the plate.

    Parameters
    ----------
    rig, scene, board
        Rig with the scene applied, the scene, and one of the rig's receiving boards.
    offsets_m
        Stage offsets [n, 2], metres, rig frame.
    frequencies_hz
        [k].
    rx
        RX of the board.

    Returns
    -------
    complex128 [n, k], amplitude relative to the direct path, phase +2 pi f (r1 + r2) / c.
    """
    ant = antennas(rig, board)
    reflect = board_reflectivity(board, scene)
    scene = draw_specimens(scene)
    out = np.zeros((len(offsets_m), len(frequencies_hz)), dtype=np.complex128)
    for i, plate in enumerate(scene.plates):
        cx, cy = ant.centre_m[:2] + np.array(plate.centre_mm) / 1e3
        slope = slopes(plate)
        parts = facets(plate, i, scene.seed)
        x, y, area = _place_quadrature(parts.size_m, float(np.max(frequencies_hz)))
        for row, column in np.ndindex(parts.height_m.shape):
            px = x + parts.x_m[column]
            py = y + parts.y_m[row]
            z = ant.plane_z_m + plate.height_mm / 1e3 + slope[0] * px + slope[1] * py + parts.height_m[row, column]
            for n, (ox, oy) in enumerate(offsets_m):
                r1, r2, theta, oblique = ant.legs(cx + px - ox, cy + py - oy, rx, z, slope)
                weight = area * oblique / (r1 * r2)
                for k, f in enumerate(frequencies_hz):
                    phase = np.exp(2j * np.pi * f / SPEED_OF_LIGHT_M_S * (r1 + r2))
                    out[n, k] += plate_scale(ant, scene, f) * np.sum(weight * reflect(plate, f, theta) * phase)
    for point in scene.points:
        px, py = ant.centre_m[:2] + np.array(point.position_mm) / 1e3
        z = ant.plane_z_m + point.height_mm / 1e3
        r1, r2, _, _ = ant.legs(px - offsets_m[:, 0], py - offsets_m[:, 1], rx, z)
        # A point reflects s and p equally, as the direct path transmits them: leakage has the same effect on both.
        amplitude = conjugate(complex(*point.amplitude)) * point_scale(ant) * direct_factor(board, scene) / (r1 * r2)
        phase = np.exp(2j * np.pi / SPEED_OF_LIGHT_M_S * np.outer(r1 + r2, frequencies_hz))
        out += amplitude[:, None] * phase
    return out


def _place_quadrature(size_m: tuple[float, float], top_hz: float) -> tuple[Real, Real, Real]:
    """Return quadrature points x, y relative to the centre of a rectangle, and their areas; each [y, x]."""
    # Over a side of length L the phase changes by at most 2 k L, as exp(j k L u) for u from -1 to 1. Its series
    # converges from the degree k L on. Gauss-Legendre quadrature with n points is exact up to the degree 2 n - 1, so
    # that n = k L / 2 is enough. 0.6 k L + 16 points are taken.
    wavenumber = 2 * np.pi * top_hz / SPEED_OF_LIGHT_M_S
    width, height = size_m
    nodes_x, weights_x = np.polynomial.legendre.leggauss(int(wavenumber * width * 0.6) + 16)
    nodes_y, weights_y = np.polynomial.legendre.leggauss(int(wavenumber * height * 0.6) + 16)
    x, y = np.meshgrid(nodes_x * width / 2, nodes_y * height / 2)
    return x, y, np.outer(weights_y * height / 2, weights_x * width / 2)
