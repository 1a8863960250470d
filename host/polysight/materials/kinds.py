"""What a plate may be: kinds of materials as densities over t = 1 / P, of a library, of the literature, and others.

A kind is a half space whose `(ln eps', ln eps'')` is normal about its value (two specimens of a material differ). Most
patches are of the library's kinds; the others are of the literature's, or any half space at all. The density of a
measured ratio under all of them is the prior of the joint inversion, and its parts are the probabilities of names.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials.catalogue import load_catalogue, same_material
from polysight.materials.specimens import LOSS_RANGE, PUBLISHED_SPREAD, REAL_RANGE, SOFT_LOSS
from polysight.polarimetry import permittivity_from_ratio, ratio_from_permittivity

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
Source = Literal["library", "literature"]

LITERATURE_SHARE = 0.7
"""Share of the literature in the patches that are none of the library's materials; the others are any half space."""
METAL_SHARE = 0.1
"""Share of metal in these patches."""
LEAST_LOSS_SPREAD = 0.02
"""Standard deviation of eps'' between specimens of low-loss materials."""
METAL_SPREAD = 0.01
"""Standard deviation of metal's t: sheets are not perfectly flat."""
_STEP = 1e-4


@dataclass(frozen=True)
class Kind:
    """One material: its name, permittivity (None: metal), and the standard deviations of ln eps' and ln eps''."""

    name: str
    permittivity: complex | None
    spread: tuple[float, float] = PUBLISHED_SPREAD
    source: Source = "library"


def inverse_ratio(permittivity: npt.ArrayLike, theta_rad: npt.ArrayLike) -> Complex:
    """Return t = 1 / P of half spaces (Eq. 2)."""
    return np.asarray(1 / ratio_from_permittivity(permittivity, theta_rad), np.complex128)


def pair(value: npt.ArrayLike) -> Real:
    """Return real and imaginary part on a last axis of two."""
    value = np.asarray(value, np.complex128)
    return np.stack([value.real, value.imag], axis=-1)


def turned(factor: npt.ArrayLike, covariance: npt.ArrayLike) -> Real:
    """Return the covariance [..., 2, 2] of a complex number with `covariance`, times a complex `factor` [...]."""
    factor = np.asarray(factor, np.complex128)
    matrix = np.stack([pair(factor), pair(1j * factor)], axis=-1)
    return np.asarray(matrix @ np.asarray(covariance, np.float64) @ matrix.swapaxes(-1, -2), np.float64)


class Kinds:
    """All kinds at one angle of incidence.

    Attributes
    ----------
    kinds
        The library's and the literature's.
    ours
        bool [kind]: those of the library.
    t, covariance, share
        complex [kind], float64 [kind, 2, 2], float64 [kind]: each kind's mean of t, the covariance by its specimens,
        and its share in the library, or in what is none of the library's.
    other
        Share of any other half space in what is none of the library's.
    """

    def __init__(self, kinds: Sequence[Kind], theta_rad: float) -> None:
        self.kinds = (*kinds, Kind("metal", None, source="literature"))
        self.theta_rad = theta_rad
        self.ours = np.array([kind.source == "library" for kind in self.kinds])
        self.t = np.array([_mean(kind, theta_rad) for kind in self.kinds], np.complex128)
        self.covariance = np.stack([_covariance(kind, theta_rad) for kind in self.kinds])
        self.share, self.other = _shares(self.kinds)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each kind."""
        return tuple(kind.name for kind in self.kinds)

    def densities(self, t: Complex, covariance: Real) -> tuple[Real, Real]:
        """Return share times density of measured ratios t [...] under each kind [..., kind], and as any other [...].

        `covariance` float64 [2, 2] is that of their errors.
        """
        off = pair(t[..., None] - self.t)
        inverse = np.linalg.inv(self.covariance + covariance)
        distance2 = np.einsum("...ki,kij,...kj->...k", off, inverse, off)
        scale = self.share * np.sqrt(np.linalg.det(inverse)) / (2 * np.pi)
        return scale * np.exp(-0.5 * distance2), self.other * self._any_half_space(t, covariance)

    def density_map(self, low: complex, high: complex, covariance: Real, cells: int = 96) -> DensityMap:
        """Return the densities of the library's kinds and of all others on a rectangle of t, for quick looking up."""
        real = np.linspace(low.real, high.real, cells)
        imag = np.linspace(low.imag, high.imag, cells)
        others = self.other * self._any_half_space(real[None, :] + 1j * imag[:, None], covariance)
        density = np.stack([np.zeros_like(others), others])
        both = self.covariance + covariance
        reach = 4.5 * np.sqrt(both[:, (0, 1), (0, 1)])
        columns = np.searchsorted(real, self.t.real + np.array([-1, 1])[:, None] * reach[:, 0])
        rows = np.searchsorted(imag, self.t.imag + np.array([-1, 1])[:, None] * reach[:, 1])
        inverse = np.linalg.inv(both)
        scale = self.share * np.sqrt(np.linalg.det(inverse)) / (2 * np.pi)
        for k in np.flatnonzero((columns[1] > columns[0]) & (rows[1] > rows[0])):
            window = slice(rows[0, k], rows[1, k]), slice(columns[0, k], columns[1, k])
            x = real[window[1]] - self.t[k].real
            y = (imag[window[0]] - self.t[k].imag)[:, None]
            distance2 = inverse[k, 0, 0] * x**2 + 2 * inverse[k, 0, 1] * x * y + inverse[k, 1, 1] * y**2
            density[0 if self.ours[k] else 1][window] += scale[k] * np.exp(-0.5 * distance2)
        return DensityMap(low, high, np.log(density + 1e-12))

    def _any_half_space(self, t: Complex, covariance: Real) -> Real:
        """Return the density of t of any half space: ln eps' uniform, eps'' uniform on a scale that ends in a line.

        Errors of the measurement soften the border of the passive half spaces: the density there is that of the
        nearest passive one, times the probability of an error as large.
        """
        s, cosine = np.sin(self.theta_rad), np.cos(self.theta_rad)
        with np.errstate(divide="ignore", invalid="ignore"):
            parts = pair(permittivity_from_ratio(t, self.theta_rad))
            slope = np.abs(4 * s**2 * (s / cosine) ** 2 * (1 + t) / (1 - t) ** 3)
        eps_real = np.where(np.isfinite(parts[..., 0]), parts[..., 0], REAL_RANGE[1])
        eps_loss = np.where(np.isfinite(parts[..., 1]), -parts[..., 1], 0.0)
        slope = np.maximum(np.where(np.isfinite(slope), slope, 1e6), 1e-6)
        error = slope * np.sqrt(np.trace(covariance) / 2)
        real = np.clip(eps_real, *REAL_RANGE)
        loss = np.clip(eps_loss, *LOSS_RANGE)
        beyond = np.hypot(eps_real - real, eps_loss - loss) / np.maximum(error, 1e-9)
        width = np.log(REAL_RANGE[1] / REAL_RANGE[0]) * np.arcsinh(LOSS_RANGE[1] / SOFT_LOSS)
        floor = np.hypot(SOFT_LOSS, error)
        density = slope**2 / (width * real * np.hypot(loss, floor))
        return np.asarray(density * np.exp(-0.5 * np.minimum(beyond, 30.0) ** 2), np.float64)


@dataclass(frozen=True)
class DensityMap:
    """Logarithms of the densities of the library's kinds and of all others on a rectangle from `low` to `high`.

    `log_density` float64 [2, imaginary, real].
    """

    low: complex
    high: complex
    log_density: Real

    def at(self, t: Complex) -> Real:
        """Return the logarithms of both densities at t [...], [2, ...]; beyond the rectangle those of its border."""
        _, rows, columns = self.log_density.shape
        parts = pair(t)
        x = (parts[..., 0] - self.low.real) / (self.high.real - self.low.real) * (columns - 1)
        y = (parts[..., 1] - self.low.imag) / (self.high.imag - self.low.imag) * (rows - 1)
        place = np.stack([y, x])
        return np.stack(
            [scipy.ndimage.map_coordinates(part, place, order=1, mode="nearest") for part in self.log_density]
        )


def literature(library: Collection[str] = ()) -> list[Kind]:
    """Return the materials of the catalogue, but for those that a library of these names has measured itself."""
    return [
        Kind(material.name, material.permittivity, material.spread, "literature")
        for material in load_catalogue()
        if not any(same_material(material.name, name) for name in library)
    ]


def _mean(kind: Kind, theta_rad: float) -> complex:
    if kind.permittivity is None:
        return 1.0 + 0j
    return complex(inverse_ratio(kind.permittivity, theta_rad))


def _covariance(kind: Kind, theta_rad: float) -> Real:
    """Return the covariance of t by the differences of specimens, [2, 2]."""
    if kind.permittivity is None:
        return METAL_SPREAD**2 * np.eye(2)
    eps = kind.permittivity
    stretched = np.array([eps + _STEP * eps.real, eps - 1j * _STEP])
    slopes = pair((inverse_ratio(stretched, theta_rad) - inverse_ratio(eps, theta_rad)) / _STEP)
    loss_std = np.hypot(kind.spread[1] * abs(eps.imag), LEAST_LOSS_SPREAD)
    scaled = slopes * np.array([[kind.spread[0]], [loss_std]])
    return np.asarray(scaled.T @ scaled + 1e-10 * np.eye(2), np.float64)


def _shares(kinds: Sequence[Kind]) -> tuple[Real, float]:
    """Return the share of each kind in the library or in the rest, and that of any other half space in the rest."""
    ours = np.array([kind.source == "library" for kind in kinds])
    metal = np.array([kind.permittivity is None for kind in kinds]) & ~ours
    literature = ~ours & ~metal
    share_literature = LITERATURE_SHARE if literature.any() else 0.0
    out = np.zeros(len(kinds))
    for mask, share in ((ours, 1.0), (metal, METAL_SHARE), (literature, share_literature)):
        if mask.any():
            out[mask] = share / mask.sum()
    return out, 1 - METAL_SHARE - share_literature
