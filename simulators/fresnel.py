"""Reflection of flat plates at 76..81 GHz, both polarisations. The simulators' own: independent of the host's.

Media are eps' - j eps'' (time dependence exp(+j omega t)). Signs are those of the paper's Eq. 2: a perfect conductor
has r_s = r_p = -1, so that P = r_s / r_p = 1.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from polysight.shared.units import SPEED_OF_LIGHT_M_S
from polysight.simulators.scene import Layer, Plate

Complex = NDArray[np.complexfloating]


def half_space(epsilon: complex, theta_rad: NDArray[np.floating] | float) -> tuple[Complex, Complex]:
    """Reflection coefficients of one interface, air to `epsilon` (paper Eq. 2 with Snell's law).

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
    # Principal root: the imaginary part is <= 0, so the transmitted wave exp(-j k q z) decays into the medium.
    q: Complex = np.sqrt(np.asarray(epsilon - 1.0 + cos**2, dtype=np.complex128))
    return np.asarray((cos - q) / (cos + q)), np.asarray((q - epsilon * cos) / (q + epsilon * cos))


def slab(
    epsilon: complex, thickness_m: float, frequency_hz: float, theta_rad: NDArray[np.floating] | float
) -> tuple[Complex, Complex]:
    """Reflection coefficients of a plate of finite thickness in air (Airy sum; Born and Wolf, section 1.6).

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


def layered(
    layers: Sequence[Layer], frequency_hz: float, theta_rad: NDArray[np.floating] | float
) -> tuple[Complex, Complex]:
    """Reflection coefficients of a stack of layers seen from air, as of transmission lines in series.

    From the back to the front each layer turns the impedance behind it (Pozar, Microwave Engineering, eq. 2.44) into
    Z (Z_b + j Z t) / (Z + j Z_b t), t = tan(k d q), with Z = 1 / q for s and q / eps for p, in units of free space.

    Returns
    -------
    r_s, r_p : complex128, shape of theta_rad
    """
    theta = np.asarray(theta_rad, dtype=np.float64)
    cos, sin = np.cos(theta), np.sin(theta)
    media = [(x.epsilon, x.thickness_mm) for x in layers]
    if media[-1][1] is not None:
        media.append((1.0 + 0j, None))
    z_s = z_p = np.zeros(theta.shape, np.complex128)
    for epsilon, thickness_mm in reversed(media):
        q: Complex = np.sqrt(np.asarray(epsilon - sin**2, dtype=np.complex128))
        own_s, own_p = 1 / q, q / epsilon
        if thickness_mm is None:
            z_s, z_p = own_s, own_p
            continue
        t = np.tan(2 * np.pi * frequency_hz / SPEED_OF_LIGHT_M_S * thickness_mm / 1e3 * q)
        z_s = own_s * (z_s + 1j * own_s * t) / (own_s + 1j * z_s * t)
        z_p = own_p * (z_p + 1j * own_p * t) / (own_p + 1j * z_p * t)
    # Signs of Eq. 2: both are -1 for a perfect conductor (no impedance).
    return (z_s * cos - 1) / (z_s * cos + 1), (z_p - cos) / (z_p + cos)


def strips(psi_rad: float, theta_rad: NDArray[np.floating] | float) -> tuple[Complex, Complex]:
    """What a screen that conducts along one direction alone returns of a wave whose s and p are alike.

    The current J along the strips u = (sin psi, cos psi) in (x, y) makes the total field along u zero; it meets the
    wave impedances of the two polarisations, 1 / (2 cos) for s and cos / 2 for p in units of free space.

    Returns
    -------
    r_s, r_p : complex128, shape of theta_rad; both are -1 times what the wave has along u, split by u
    """
    cos, u_x, u_y = np.cos(np.asarray(theta_rad, dtype=np.float64)), np.sin(psi_rad), np.cos(psi_rad)
    incident = u_y + u_x * cos  # tangential: E_y = 1, E_x = cos(theta)
    current = incident / (u_y**2 / (2 * cos) + u_x**2 * cos / 2)
    r_s = -current * u_y / (2 * cos)
    r_p = -current * u_x * cos / 2 / cos  # tangential E_x back to the wave's amplitude
    return r_s.astype(np.complex128), r_p.astype(np.complex128)


def plate_reflection(plate: Plate, frequency_hz: float, theta_rad: NDArray[np.floating]) -> tuple[Complex, Complex]:
    """Reflection coefficients (r_s, r_p) of a plate of the scene: metal, strips, half space, slab or stack."""
    if plate.strips_deg is not None:
        return strips(np.radians(plate.strips_deg), theta_rad)
    if plate.metal:
        minus_one = -np.ones(np.shape(theta_rad), dtype=np.complex128)
        return minus_one, minus_one.copy()
    first = plate.stack[0]
    if len(plate.stack) > 1:
        return layered(plate.stack, frequency_hz, theta_rad)
    if first.thickness_mm is None:
        return half_space(first.epsilon, theta_rad)
    return slab(first.epsilon, first.thickness_mm / 1e3, frequency_hz, theta_rad)
