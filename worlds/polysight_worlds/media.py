"""Reflection of plane waves at layered media, from the boundary conditions.

Fields vary as exp(+j omega t), so a lossy permittivity is eps' - j eps''. Both coefficients are ratios of the electric
field's tangential part: metal has r_s = r_p = -1, and P = r_s / r_p = 1, at every angle.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

LIGHT_M_PER_S = 299_792_458.0
# Copper at 78 GHz: sigma / (omega eps0), with 5.8e7 S/m.
COPPER = 1 - 1.3e7j


@dataclass(frozen=True)
class Stack:
    """Layers on a half space: `layers` from the top as (relative permittivity, thickness in metres).

    `below`: relative permittivity of the half space.
    """

    layers: tuple[tuple[complex, float], ...] = ()
    below: complex = 1.0 + 0j

    @property
    def is_metal(self) -> bool:
        """True if the wave meets metal first."""
        # Far above every dielectric, far below every metal.
        return not self.layers and abs(self.below) > 1e4


METAL = Stack(below=COPPER)


def reflect(stack: Stack, frequency_hz: ArrayLike, cos_incidence: ArrayLike) -> tuple[NDArray, NDArray]:
    """Return the reflection coefficients (r_s, r_p) in air, complex128 of the broadcast shape of the two arguments.

    Solves for the waves in all layers at once: tangential E and H are continuous at each boundary.
    """
    k0 = 2 * np.pi * np.asarray(frequency_hz, float) / LIGHT_M_PER_S
    k0, cos_incidence = np.broadcast_arrays(k0, np.asarray(cos_incidence, float))
    permittivities = [1.0, *(eps for eps, _ in stack.layers), stack.below]
    # Vertical wave numbers over k0. The principal root of eps' - j eps'' decays downwards.
    kz = [np.sqrt(complex(eps) - (1 - cos_incidence**2) + 0j) for eps in permittivities]
    # Exact for air: near grazing incidence the difference above loses digits.
    kz[0] = cos_incidence + 0j
    # Factor of the wave's phase and decay over each layer. Air and half space have none: their values do not matter.
    delays = [np.ones_like(kz[0])]
    for (_, thickness_m), root in zip(stack.layers, kz[1:-1], strict=True):
        delays.append(np.exp(-1j * k0 * root * thickness_m))
    delays.append(np.zeros_like(kz[0]))
    s_admittances = kz
    p_admittances = [eps / root for eps, root in zip(permittivities, kz, strict=True)]
    return _solve_waves(s_admittances, delays), _solve_waves(p_admittances, delays)


def _solve_waves(admittances: list[NDArray], delays: list[NDArray]) -> NDArray:
    """Return the amplitude of the wave that comes back, for a unit wave that falls onto the first boundary.

    Unknowns in order: r; of each layer the wave down (at its top) and up (at its bottom); the wave in the half space.
    """
    boundaries = len(admittances) - 1
    size = 2 * boundaries
    matrix = np.zeros((*delays[0].shape, size, size), complex)
    source = np.zeros((*delays[0].shape, size, 1), complex)
    for m in range(boundaries):
        above = admittances[m]
        below = admittances[m + 1]
        # Rows: continuity of E and of H at this boundary. Columns: 2 m - 1 is the wave down in the layer above, 2 m the
        # wave up in it (r in air), then the waves down and up in the layer below.
        electric = 2 * m
        magnetic = 2 * m + 1
        down_below = 2 * m + 1
        if m == 0:
            source[..., electric, 0] = -1
            source[..., magnetic, 0] = -above
        else:
            matrix[..., electric, 2 * m - 1] = delays[m]
            matrix[..., magnetic, 2 * m - 1] = above * delays[m]
        matrix[..., electric, 2 * m] = 1
        matrix[..., magnetic, 2 * m] = -above
        matrix[..., electric, down_below] = -1
        matrix[..., magnetic, down_below] = -below
        if m + 1 < boundaries:
            matrix[..., electric, down_below + 1] = -delays[m + 1]
            matrix[..., magnetic, down_below + 1] = below * delays[m + 1]
    return np.linalg.solve(matrix, source)[..., 0, 0]


class ReflectionTable:
    """Coefficients of a stack at one frequency over the cosine of incidence, for quick look-up."""

    # Chosen.
    POINTS = 513

    def __init__(self, stack: Stack, frequency_hz: float) -> None:
        cosines = np.linspace(0, 1, self.POINTS)
        # Exactly along the surface the admittances of air are 0 and infinite.
        cosines[0] = 1e-6
        self._tables = [table.astype(np.complex64) for table in reflect(stack, frequency_hz, cosines)]

    def look_up(self, cos_incidence: NDArray) -> tuple[NDArray, NDArray]:
        """Return (r_s, r_p) by linear interpolation, complex64 of the shape of `cos_incidence`."""
        place = np.clip(cos_incidence, 0, 1) * (self.POINTS - 1)
        left_index = np.minimum(place.astype(np.int32), self.POINTS - 2)
        share = (place - left_index).astype(np.float32)
        s, p = (table[left_index] + share * (table[left_index + 1] - table[left_index]) for table in self._tables)
        return s, p
