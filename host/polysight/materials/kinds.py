"""Kinds of materials that a plate may be of, as densities over t = 1 / P: a library's, the literature's, and others.

P = H / V is the ratio relative to metal, eps = eps' - j eps'' the permittivity. A *kind* is a listed material: metal,
or a half space whose ln eps' and eps'' are normally distributed over specimens; to first order its t is normal, too. A
patch is of a kind of the library, of a kind of the literature, or *of no kind*: any other half space, a thin plate, or
a stack of layers. The density of t under all of them is the prior of the joint inversion (`inversion.py`), its parts
give the probabilities of names (`names.py`). Eq. 2 and 3 of the POLySIGHT paper convert eps to P and back.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials.catalogue import is_same_material, load_catalogue
from polysight.materials.specimens import PUBLISHED_SPREAD
from polysight.polarimetry import multilayer, permittivity_from_ratio, ratio_from_permittivity

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
Source = Literal["library", "literature"]

REAL_RANGE = (1.2, 30.0)
LOSS_RANGE = (0.0, 30.0)
SOFT_LOSS = 0.05
"""Ranges of eps' and eps'' of any half space, from nearly air to beyond water. Densities are over the coordinates
ln eps' and asinh(eps'' / SOFT_LOSS); the second is logarithmic above `SOFT_LOSS` and linear below."""
NEAR_LITERATURE = 0.8
"""Share of the half spaces of no kind that lie near a kind of the literature: materials that are in no table are mostly
like those that are. The others are uniform in both coordinates."""
NEAR_LITERATURE_STD = (0.12, 0.6)
"""Standard deviations of their distance from that kind in both coordinates. Share and distance are chosen."""
USUAL_LIBRARY_SHARE = 0.5
"""Expected share of a library's materials in a scan that was processed without it; chosen."""
LITERATURE_SHARE = 0.4
"""Share of the literature's kinds in thick plates that are of no kind of the library. The others are metal or any half
space. Chosen: with a larger share, uncertain patches are named as materials of the literature."""
METAL_SHARE = 0.1
"""Share of metal in these thick plates; chosen."""
SHEET_SHARE = 0.27
"""Share of thin plates, which reflect at both faces, in patches of no kind of the library. Chosen: with 0.25 thin wood
of the published picture was named as a laminate; with 0.3 a lossy half space counted as possibly thin."""
SHEET_REAL = (1.5, 8.0)
SHEET_LOSS_TANGENT = (1e-3, 0.2)
SHEET_MM = (0.2, 6.0)
"""Ranges of eps', loss tangent and thickness of thin plates, each uniform on a logarithmic scale; chosen."""
HOLDER_REAL = (1.0, 2.5)
"""Range of the permittivity behind half of the thin plates, uniform: foam, wood. Behind the other half is air."""
SHEET_HZ = 78e9
"""Frequency at which t of the drawn thin plates is computed, about the middle of the sweep."""
SHEET_KERNEL = 0.02
"""Standard deviation by which the distribution of the drawn plates' t is smoothed; chosen."""
STACK_SHARE = 0.05
"""Share of stacks, neither half space nor thin plate, in patches of no kind of the library: a liquid behind glass may
reflect as no passive half space does. Their t is uniform on the unit disk, with the density 1 / pi. Without stacks,
three cups of sugar water moved the estimated leakage by three standard deviations, and their own t by a fifth."""
ODD_BRIGHTNESS = 0.1
ODD_BRIGHTNESS_STD = 1.2
"""Share of patches whose |H| fits no half space (shadows, edges), and their standard deviation of ln |H|; chosen."""
# Cells of a map of densities along each side of its rectangle; chosen.
_MAP_CELLS = 96
DISPERSION_KERNEL = 0.05
DISPERSION_MODEL = 0.2
"""Standard deviations of a thin plate's change over the sweep: absolute, to smooth the drawn plates; and relative to
the change, for edges and for second echoes from the neighbourhood. Chosen."""
ODD_DISPERSION = 0.02
ODD_DISPERSION_STD = 0.05
"""Share of half spaces whose echo changes over the sweep by their surroundings, and the standard deviation of that
change; chosen."""
LEAST_LOSS_SPREAD = 0.02
"""Standard deviation of eps'' between specimens, in addition to that in proportion to eps''; chosen."""
METAL_SPREAD = 0.01
"""Standard deviation of metal's t: sheets are not perfectly flat. Chosen."""
SAME_MATERIAL = 0.005
"""Probability that two plates of a scene are of one material, before they are measured. Chosen: more leaves too few
plates to determine the published picture's leakage (its half widths exceed 20 % from 0.02 on)."""
DENSITY_OF_OTHERS = 20.0
"""Density over t of a plate of another material; that of half spaces is 5 to 50 where most solids are."""
SPECIMEN_STD = 0.01
"""Relative standard deviation of V / H between plates of one material, cut from the same sheet; chosen."""
LEAST_STD_OF_T = 1e-6
MOST_STD_BEYOND = 30.0
"""Smallest standard deviation of t by which a distance is divided, and the largest quotient that is distinguished."""
# Cells of the table of half spaces along each coordinate: a fifth of `NEAR_LITERATURE_STD` and less.
_COORDINATE_CELLS = 256
_CELL_NUMBERS = np.arange(float(_COORDINATE_CELLS))
# Smallest standard deviation of a ratio: below it a covariance has no inverse in double precision.
LEAST_RATIO_STD = 1e-6
# Step of numerical derivatives with respect to ln eps' and to eps''; chosen.
_STEP = 1e-4
# Number of thin plates that are drawn; chosen.
_SHEETS = 6000
# Frequencies of the sweep at which a thin plate is computed; chosen.
_FREQUENCIES = 9
# Keeps products of odds over several scans finite.
_MOST_LOG_ODDS = 200.0


@dataclass(frozen=True)
class Kind:
    """One material: its name, its mean permittivity (None: metal), and the source of both.

    `spread`: standard deviations between specimens of ln eps', and of eps'' relative to its mean.
    """

    name: str
    permittivity: complex | None
    spread: tuple[float, float] = PUBLISHED_SPREAD
    source: Source = "library"
    family: str = ""
    """Class of a material of the literature, for example "polymer" or "wood"; "" for the library's."""


@dataclass(frozen=True)
class PatchDispersion:
    """Change of one patch over the sweep relative to metal, from its first to its last frequency.

    Attributes
    ----------
    change, std
        float64 [3]: change of ln |H|, of ln |V / H| and of the phase of V / H (radians); their standard deviations.
    band_hz
        First and last frequency of the sweep.
    """

    change: Real
    std: Real
    band_hz: tuple[float, float]


@dataclass(frozen=True)
class RatioCase:
    """t of a patch in one of several cases of the scene, and the probability of the case.

    `covariance`: float64 [2, 2] of the real and imaginary part of `inverse_ratio`.
    """

    probability: float
    inverse_ratio: complex
    covariance: Real


@dataclass(frozen=True)
class PatchMeasurement:
    """Measurement of one patch, relative to metal; leakage is not removed.

    Attributes
    ----------
    inverse_ratio
        V / H.
    std
        Standard deviation of the real part, and of the imaginary part, of V / H by noise and sidelobes.
    theta_rad
        Nominal incidence angle.
    brightness
        |H|; None if it is not used.
    relative_std
        Standard deviations of ln |V / H| and of the phase of V / H (radians) by edges, ripple and tilt of the plate.
    rise
        Rise of the plate along the plane of incidence and across it, radians.
    dispersion
        Change of the patch over the sweep; None if it was not measured.
    """

    inverse_ratio: complex
    std: float
    theta_rad: float
    brightness: float | None = None
    relative_std: tuple[float, float] = (0.0, 0.0)
    rise: tuple[float, float] = (0.0, 0.0)
    dispersion: PatchDispersion | None = None

    @property
    def covariance(self) -> Real:
        """Covariance of real and imaginary part of V / H, float64 [2, 2]."""
        std = max(self.std, LEAST_RATIO_STD)
        return std**2 * np.eye(2) + turn_covariance(self.inverse_ratio, np.diag(np.square(self.relative_std)))

    def widen_phase(self, std_rad: float) -> PatchMeasurement:
        """Return the measurement with another standard deviation of the phase of V / H, radians, added."""
        amplitude, phase = self.relative_std
        return replace(self, relative_std=(amplitude, float(np.hypot(phase, std_rad))))


@dataclass(frozen=True)
class RatioEvidence:
    """Evidence of one scan on a patch, for its name.

    Attributes
    ----------
    theta_rad
        Angle of incidence at which the patch has this t.
    inverse_ratio, covariance
        t, corrected for all estimated errors; covariance float64 [2, 2] of its real and imaginary part.
    library_share
        Expected share of the library's materials in this scan.
    brightness_off, brightness_std
        ln of |H| over that of a half space with this t, and its standard deviation over the scene's patches; the first
        is NaN if |H| is not used. Thin plates are brighter or darker than half spaces of the same t.
    dispersion
        Change of the patch over the sweep; None if it was not measured.
    cases
        t if the metal is painted, and if it is bare, where both are possible; `inverse_ratio` and `covariance` are
        those of both together. Empty: there is one case.
    """

    theta_rad: float
    inverse_ratio: complex
    covariance: Real
    library_share: float
    brightness_off: float = np.nan
    brightness_std: float = np.nan
    dispersion: PatchDispersion | None = None
    cases: tuple[RatioCase, ...] = ()

    def split(self) -> list[tuple[float, RatioEvidence]]:
        """Return the probability of each case, and the evidence in it; of one case the evidence itself."""
        if not self.cases:
            return [(1.0, self)]
        return [
            (case.probability, replace(self, inverse_ratio=case.inverse_ratio, covariance=case.covariance, cases=()))
            for case in self.cases
        ]


@dataclass(frozen=True)
class PatchEstimate:
    """Permittivity of one patch.

    Attributes
    ----------
    inverse_ratio
        t = 1 / P = r_p / r_s, corrected for all estimated errors.
    inverse_ratio_covariance
        float64 [2, 2] of its real and imaginary part.
    permittivity
        eps' - j eps''; None if t is too near to metal's (`LEAST_DISTANCE` of inversion.py), as are the next fields.
    covariance
        float64 [2, 2] of the real and the imaginary part of `permittivity`.
    shares
        Source (`SOURCES` of inversion.py) to its share of the trace of `covariance`; the sum is 1. Empty without a
        permittivity.
    evidence
        Evidence from which the patch is named; None if the scene was inverted without kinds.
    half_widths_68
        Half widths of the 68 % intervals about the real and the imaginary part of `permittivity`.
    """

    inverse_ratio: complex
    inverse_ratio_covariance: Real
    permittivity: complex | None
    covariance: Real | None
    shares: Mapping[str, float]
    evidence: RatioEvidence | None = None
    half_widths_68: tuple[float, float] | None = None

    @property
    def dominated_by(self) -> str | None:
        """The source with the largest share of the error; None without shares."""
        return max(self.shares, key=lambda s: self.shares[s], default=None)


def inverse_ratio(permittivity: npt.ArrayLike, theta_rad: npt.ArrayLike) -> Complex:
    """Return t = 1 / P of half spaces (Eq. 2), complex128, broadcast."""
    return np.asarray(1 / ratio_from_permittivity(permittivity, theta_rad), np.complex128)


def compute_probability_of_same_material(measurements: Sequence[PatchMeasurement]) -> Real:
    """Return the probability that two plates of a scene are of one material, float64 [patch, patch]; 1 on the diagonal.

    The V / H of two plates of one material differ by errors and specimens alone. The errors of leakage and reference,
    which all plates share, hardly change the difference.
    """
    inverse_ratios = np.array([m.inverse_ratio for m in measurements], np.complex128)
    error_covariance = np.array([m.covariance for m in measurements], np.float64).reshape(-1, 2, 2)
    specimen_covariance = np.square(SPECIMEN_STD * np.abs(inverse_ratios))[:, None, None] * np.eye(2)
    covariance = error_covariance + specimen_covariance
    # Normal density of the difference of each pair: [patch, patch, 2, 2] and [patch, patch, 2].
    inverse = np.linalg.inv(covariance[:, None] + covariance)
    difference = split_complex(inverse_ratios[:, None] - inverse_ratios)
    distance2 = np.einsum("...i,...ij,...j->...", difference, inverse, difference)
    density = np.sqrt(np.linalg.det(inverse)) / (2 * np.pi) * np.exp(-0.5 * distance2)
    odds = SAME_MATERIAL * density / DENSITY_OF_OTHERS
    return np.where(np.eye(len(measurements), dtype=bool), 1.0, odds / (1 + odds))


class HalfSpaces:
    """Half spaces of t = 1 / P at angles of incidence `theta_rad`, which broadcast.

    With u = (1 + t) / (1 - t) Eq. 3 is q = sqrt(eps - sin^2) = u sin^2 / cos.
    """

    def __init__(self, t: npt.ArrayLike, theta_rad: npt.ArrayLike) -> None:
        self.t = np.asarray(t, np.complex128)
        self._cosine = np.cos(theta_rad)
        self._sine2 = 1 - np.square(self._cosine)
        with np.errstate(divide="ignore", invalid="ignore"):
            self._q = (1 + self.t) / (1 - self.t) * (self._sine2 / self._cosine)

    def log_brightness(self) -> Real:
        """Return ln |r_s| by Eq. 2, r_s = (cos - q) / (cos + q), broadcast; NaN for metal."""
        loss2 = np.square(self._q.imag)
        with np.errstate(divide="ignore", invalid="ignore"):
            difference2 = np.square(self._cosine - self._q.real) + loss2
            sum2 = np.square(self._cosine + self._q.real) + loss2
            return np.asarray(0.5 * np.log(difference2 / sum2), np.float64)

    def move_to_angle(self, other_rad: float) -> Complex:
        """Return t of the same half spaces at another angle, complex128, broadcast; metal's t is not changed."""
        other2 = np.sin(other_rad) ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            # q at the other angle: the root on the side of q, so that a loss stays a loss. Then its u, and its t.
            root = np.sqrt(np.square(self._q) + (self._sine2 - other2))
            along_q = root.real * self._q.real + root.imag * self._q.imag
            root = root * np.copysign(np.cos(other_rad) / other2, along_q)
            moved_t = (root - 1) / (root + 1)
        return np.where(np.isfinite(moved_t), moved_t, self.t)


def compute_brightness_density(difference: Real | float, std: Real | float) -> Real:
    """Return a multiple of the density of the `difference` of ln |H| from its expected value.

    The density is a sum of two normal ones: that of usual patches with `std`, and that of patches whose |H| fits no
    half space (`ODD_BRIGHTNESS`).
    """
    usual_density = (1 - ODD_BRIGHTNESS) / std * np.exp(-0.5 * (difference / std) ** 2)
    odd_density = ODD_BRIGHTNESS / ODD_BRIGHTNESS_STD * np.exp(-0.5 * (difference / ODD_BRIGHTNESS_STD) ** 2)
    return np.asarray(usual_density + odd_density, np.float64)


def find_permittivity_slope(t: npt.ArrayLike, theta_rad: npt.ArrayLike) -> Complex:
    """Return d eps / d t of Eq. 3, broadcast, with t = 1 / P: eps = sin^2 (1 + tan^2 u^2), u = (1 + t) / (1 - t)."""
    t = np.asarray(t, np.complex128)
    return 4 * np.sin(theta_rad) ** 2 * np.tan(theta_rad) ** 2 * (1 + t) / (1 - t) ** 3


def move_to_angle_of_kinds(evidence: RatioEvidence, kinds: Kinds) -> RatioEvidence:
    """Return the evidence with its t converted to the incidence angle of the kinds.

    The covariance is not converted: angles of a library differ from the scan's by a degree at most.
    """

    def move(t: complex) -> complex:
        return complex(HalfSpaces(t, evidence.theta_rad).move_to_angle(kinds.theta_rad))

    cases = tuple(replace(case, inverse_ratio=move(case.inverse_ratio)) for case in evidence.cases)
    moved_t = move(evidence.inverse_ratio)
    return replace(evidence, theta_rad=kinds.theta_rad, inverse_ratio=moved_t, cases=cases)


def split_complex(value: npt.ArrayLike) -> Real:
    """Return real and imaginary part, float64 [..., 2]."""
    value = np.asarray(value, np.complex128)
    return np.stack([value.real, value.imag], axis=-1)


def turn_covariance(factor: npt.ArrayLike, covariance: npt.ArrayLike) -> Real:
    """Return the covariance [..., 2, 2] of a complex number with `covariance`, times a complex `factor` [...]."""
    factor = np.asarray(factor, np.complex128)
    # The matrix [[a, -b], [b, a]] multiplies (real, imaginary) parts by a + j b.
    matrix = np.stack([split_complex(factor), split_complex(1j * factor)], axis=-1)
    return np.asarray(matrix @ np.asarray(covariance, np.float64) @ matrix.swapaxes(-1, -2), np.float64)


class Kinds:
    """All kinds at one angle of incidence, with or without thin plates (`with_sheets`).

    Attributes
    ----------
    kinds
        The library's, the literature's, and metal.
    in_library
        bool [kind]: True for materials of the library.
    t, effects, covariance, share
        complex [kind]: mean t. float64 [kind, 2, 2]: effect of one standard deviation of ln eps' and of eps'' on the
        real and imaginary part of t; covariance of t by both. float64 [kind]: share of the kind in the library, or in
        patches of no kind of the library.
    other
        Share of any other half space in patches of no kind of the library.
    sheet_share, sheets, sheet_brightness_off
        Share of thin plates in these patches (0: plates are thick). complex [draw]: t of the drawn thin plates. float64
        [draw]: ln of their |r_s| over that of the half space with the same t.
    """

    def __init__(self, kinds: Sequence[Kind], theta_rad: float, with_sheets: bool = False) -> None:
        self.kinds = (*kinds, Kind("metal", None, source="literature", family="metal"))
        self.theta_rad = theta_rad
        self.in_library = np.array([kind.source == "library" for kind in self.kinds])
        self.t = np.array([_nominal_ratio(kind, theta_rad) for kind in self.kinds], np.complex128)
        self.effects = np.stack([_compute_effects(kind, theta_rad) for kind in self.kinds])
        # The added variance, far below any real one, keeps the matrix invertible where a kind has one effect.
        self.covariance = self.effects @ self.effects.mT + 1e-10 * np.eye(2)
        self.sheet_share = SHEET_SHARE if with_sheets else 0.0
        self.share, self.other = _compute_shares(self.kinds, self.sheet_share)
        self.sheets, self.sheet_brightness_off = draw_sheets(theta_rad)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each kind."""
        return tuple(kind.name for kind in self.kinds)

    def density_map(self, low: complex, high: complex, covariance: Real) -> DensityMap:
        """Tabulate the densities of `DensityMap` on the rectangle of t from `low` to `high`.

        `covariance`, float64 [2, 2], is that of the real and the imaginary part of a measured t.
        """
        real = np.linspace(low.real, high.real, _MAP_CELLS)
        imag = np.linspace(low.imag, high.imag, _MAP_CELLS)
        other_density = self.other * self.compute_half_space_density(real[None, :] + 1j * imag[:, None], covariance)
        layers = np.zeros_like(other_density)
        if self.sheet_share:
            layers += self.sheet_share * _compute_histogram(self.sheets, real, imag, covariance)
        density = np.stack([np.zeros_like(other_density), other_density, layers])
        summed = self.covariance + covariance
        # A kind counts within 4.5 standard deviations of its mean.
        reach = 4.5 * np.sqrt(summed[:, (0, 1), (0, 1)])
        columns = np.searchsorted(real, self.t.real + np.array([-1, 1])[:, None] * reach[:, 0])
        rows = np.searchsorted(imag, self.t.imag + np.array([-1, 1])[:, None] * reach[:, 1])
        # The exponent of a normal density is a term of x, plus a term of y, plus a product of both. Only the product is
        # computed for every cell.
        inverse = np.linalg.inv(summed)
        scale = self.share * np.sqrt(np.linalg.det(inverse)) / (2 * np.pi)
        x = real - self.t.real[:, None]
        y = imag - self.t.imag[:, None]
        along_x = np.log(scale)[:, None] - 0.5 * inverse[:, 0, :1] * x**2
        along_y = -0.5 * inverse[:, 1, 1:] * y**2
        x *= -inverse[:, 0, 1:]
        for k in np.flatnonzero((columns[1] > columns[0]) & (rows[1] > rows[0])):
            row_slice = slice(rows[0, k], rows[1, k])
            column_slice = slice(columns[0, k], columns[1, k])
            exponent = y[k, row_slice, None] * x[k, column_slice]
            exponent += along_x[k, column_slice]
            exponent += along_y[k, row_slice, None]
            density[0 if self.in_library[k] else 1, row_slice, column_slice] += np.exp(exponent, out=exponent)
        density[1:] *= 1 - STACK_SHARE
        density[2] += STACK_SHARE / np.pi
        # A density of zero counts as 1e-12: its logarithm stays finite.
        return DensityMap(low, high, np.log(density + 1e-12))

    def compute_half_space_density(self, t: Complex, covariance: Real) -> Real:
        """Return the density of t of half spaces of no kind, shape of `t`; see `REAL_RANGE` and `NEAR_LITERATURE`.

        `covariance` [2, 2] is that of the real and imaginary part of a measured t. Errors of the measurement soften the
        border of the allowed half spaces: the density beyond it is that at the border times exp(-x^2 / 2), with x the
        distance of t from the border in standard deviations.
        """
        std = float(np.sqrt(np.trace(covariance) / 2))
        with np.errstate(divide="ignore", invalid="ignore"):
            parts = split_complex(permittivity_from_ratio(t, self.theta_rad))
        eps_real = np.where(np.isfinite(parts[..., 0]), parts[..., 0], REAL_RANGE[1])
        eps_loss = np.where(np.isfinite(parts[..., 1]), -parts[..., 1], 0.0)
        real = np.clip(eps_real, *REAL_RANGE)
        loss = np.clip(eps_loss, *LOSS_RANGE)
        border_t = t.copy()
        is_outside = (real != parts[..., 0]) | (loss != -parts[..., 1])
        border_t[is_outside] = inverse_ratio(real[is_outside] - 1j * loss[is_outside], self.theta_rad)
        # The slope is taken at the border instead of t: near t = 1, which is metal, it has no bound.
        slope = np.abs(find_permittivity_slope(border_t, self.theta_rad))
        # density over t = density over coordinates (x, y) * dx/deps' * dy/deps'' * |deps/dt|^2, with 1 / eps' and
        # 1 / hypot(eps'', SOFT_LOSS) for x and y. An error of eps'' widens the linear part of y.
        floor = np.hypot(SOFT_LOSS, slope * std)
        density = slope**2 * _interpolate_coordinate_density(real, loss) / (real * np.hypot(loss, floor))
        distance_beyond = np.abs(t - border_t) / max(std, LEAST_STD_OF_T)
        return np.asarray(density * np.exp(-0.5 * np.minimum(distance_beyond, MOST_STD_BEYOND) ** 2), np.float64)


@dataclass(frozen=True)
class DensityMap:
    """Logarithms of densities over t on a rectangle from `low` to `high`, `log_density` float64 [3, imaginary, real].

    They are of the library's kinds, of all other half spaces (literature and metal included), and of layers.
    """

    low: complex
    high: complex
    log_density: Real


@dataclass(frozen=True)
class DensityMaps:
    """The density maps of all patches, which have equal numbers of cells.

    Attributes
    ----------
    low, cells_per_unit
        complex128 [patch]: lower corner of each rectangle; cells per unit of t along the real and the imaginary axis.
    log_density
        float64 [3, patch, imaginary, real].
    """

    low: Complex
    cells_per_unit: Complex
    log_density: Real

    @classmethod
    def collect(cls, maps: Sequence[DensityMap]) -> DensityMaps:
        """Return the maps of patches, one each, as arrays."""
        low = np.array([density_map.low for density_map in maps], np.complex128)
        size = np.array([density_map.high for density_map in maps], np.complex128) - low
        log_density = np.stack([density_map.log_density for density_map in maps], axis=1)
        _, _, rows, columns = log_density.shape
        return cls(low, (columns - 1) / size.real + 1j * (rows - 1) / size.imag, log_density)

    def log_densities(self, t: Complex) -> Real:
        """Return the logarithms of the three densities at each patch's t [..., patch], [3, ..., patch].

        They are interpolated linearly. Beyond its rectangle a patch has the values of the border.
        """
        _, patches, rows, columns = self.log_density.shape
        x = np.fmin(np.fmax((t.real - self.low.real) * self.cells_per_unit.real, 0.0), columns - 1)
        y = np.fmin(np.fmax((t.imag - self.low.imag) * self.cells_per_unit.imag, 0.0), rows - 1)
        column = np.minimum(x.astype(np.intp), columns - 2)
        row = np.minimum(y.astype(np.intp), rows - 2)
        fraction_x = x - column
        fraction_y = y - row
        corner = (np.arange(patches) * rows + row) * columns + column
        at_corner, at_right, at_upper, at_upper_right = (
            self.log_density.reshape(3, -1).take(corner + step, axis=1) for step in (0, 1, columns, columns + 1)
        )
        lower_edge = at_corner + fraction_x * (at_right - at_corner)
        upper_edge = at_upper + fraction_x * (at_upper_right - at_upper)
        return lower_edge + fraction_y * (upper_edge - lower_edge)


def list_literature_kinds(library: Collection[str] = ()) -> list[Kind]:
    """Return the materials of the catalogue without those whose names are in `library`, which has measured them."""
    return [
        Kind(material.name, material.permittivity, material.spread, "literature", material.kind)
        for material in load_catalogue()
        if not any(is_same_material(material.name, name) for name in library)
    ]


def _nominal_ratio(kind: Kind, theta_rad: float) -> complex:
    """Return t of a kind's mean permittivity; 1 for metal."""
    if kind.permittivity is None:
        return 1.0 + 0j
    return complex(inverse_ratio(kind.permittivity, theta_rad))


def _compute_effects(kind: Kind, theta_rad: float) -> Real:
    """Return the change of t (real, imaginary) by one standard deviation of ln eps' and of eps'', [part, deviation]."""
    if kind.permittivity is None:
        return METAL_SPREAD * np.eye(2)
    eps = kind.permittivity
    stretched = np.array([eps + _STEP * eps.real, eps - 1j * _STEP])
    slopes = split_complex((inverse_ratio(stretched, theta_rad) - inverse_ratio(eps, theta_rad)) / _STEP)
    loss_std = np.hypot(kind.spread[1] * abs(eps.imag), LEAST_LOSS_SPREAD)
    return np.asarray((slopes * np.array([[kind.spread[0]], [loss_std]])).T, np.float64)


def _compute_shares(kinds: Sequence[Kind], sheets: float) -> tuple[Real, float]:
    """Return the share of each kind in the library or in the rest, and the share of half spaces of no kind in the rest.

    The rest are patches of no kind of the library. `sheets` is the share of thin plates in it.
    """
    is_in_library = np.array([kind.source == "library" for kind in kinds])
    is_metal = np.array([kind.permittivity is None for kind in kinds]) & ~is_in_library
    is_in_literature = ~is_in_library & ~is_metal
    share_literature = LITERATURE_SHARE if is_in_literature.any() else 0.0
    shares = np.zeros(len(kinds))
    for mask, share in ((is_in_library, 1.0), (is_metal, METAL_SHARE), (is_in_literature, share_literature)):
        if mask.any():
            shares[mask] = share / mask.sum()
    shares[~is_in_library] *= 1 - sheets
    return shares, (1 - METAL_SHARE - share_literature) * (1 - sheets)


def _compute_coordinates(real: npt.ArrayLike, loss: npt.ArrayLike) -> Real:
    """Return the coordinates of half spaces eps' - j eps'', ln eps' and asinh(eps'' / SOFT_LOSS), float64 [2, ...]."""
    return np.stack([np.log(real), np.arcsinh(np.asarray(loss, np.float64) / SOFT_LOSS)])


@cache
def _tabulate_coordinate_density() -> tuple[Real, Real, Real]:
    """Return the density of half spaces of no kind over both coordinates, float64 [eps', eps''], and its two axes.

    All families of the catalogue have the same weight: those with many entries (laminates, tissues) are not more common
    on a table than others. Density that would lie beyond the ranges is reflected at their ends.
    """
    ends = _compute_coordinates(REAL_RANGE, LOSS_RANGE)
    axes = [np.linspace(low, high, _COORDINATE_CELLS) for low, high in ends]
    step = np.array([axis[1] - axis[0] for axis in axes])
    materials = load_catalogue()
    _, family_index, family_size = np.unique([m.kind for m in materials], return_inverse=True, return_counts=True)
    eps = np.array([material.permittivity for material in materials], np.complex128)
    places = _compute_coordinates(np.clip(eps.real, *REAL_RANGE), np.clip(-eps.imag, *LOSS_RANGE))
    edges = [np.append(axis - d / 2, axis[-1] + d / 2) for axis, d in zip(axes, step, strict=True)]
    weights = 1 / (family_size.size * family_size[family_index])
    count = np.histogram2d(places[0], places[1], edges, weights=weights)[0]
    density_near_literature = (
        scipy.ndimage.gaussian_filter(count, np.array(NEAR_LITERATURE_STD) / step, mode="reflect") / step.prod()
    )
    even_density = 1 / np.prod(ends[:, 1] - ends[:, 0])
    return NEAR_LITERATURE * density_near_literature + (1 - NEAR_LITERATURE) * even_density, axes[0], axes[1]


def _interpolate_coordinate_density(real: Real, loss: Real) -> Real:
    """Interpolate the table of `_tabulate_coordinate_density` at eps' and eps'' linearly; shape of `real`."""
    table, real_axis, loss_axis = _tabulate_coordinate_density()
    x, y = _compute_coordinates(real, loss)
    cells = np.stack([np.interp(x, real_axis, _CELL_NUMBERS), np.interp(y, loss_axis, _CELL_NUMBERS)])
    # map_coordinates takes no scalars.
    density = scipy.ndimage.map_coordinates(table, cells.reshape(2, -1), order=1, mode="nearest")
    return np.asarray(density, np.float64).reshape(x.shape)


@cache
def draw_sheets(theta_rad: float) -> tuple[Complex, Real]:
    """Return t of drawn thin plates in front of air or a holder, complex128 [draw], and a brightness, float64 [draw].

    The brightness is ln of |r_s| over that of a half space with the same t. The plates are the same at every angle.
    """
    eps, holder, thickness_m = _draw_sheet_properties()
    r_s, r_p = multilayer([eps, holder], [thickness_m, np.inf], SHEET_HZ, theta_rad)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = r_p / r_s
        brightness_off = np.log(np.abs(r_s)) - HalfSpaces(t, theta_rad).log_brightness()
    # A plate that reflects no s has no finite t: 1e3 is far from every measured one.
    sheets = np.where(np.isfinite(t), t, 1e3).astype(np.complex128)
    return sheets, np.where(np.isfinite(brightness_off), brightness_off, 0.0)


@cache
def draw_sheet_dispersions(theta_rad: float, band_hz: tuple[float, float]) -> Real:
    """Return the change of the thin plates of :func:`draw_sheets` over a sweep, float64 [draw, 3].

    It is that of ln |r_s|, ln |t| and the phase of t: a line fitted with the range gate's weights over the sweep.
    """
    eps, holder, thickness_m = _draw_sheet_properties()
    # Place of each frequency in the sweep, from -0.5 to 0.5.
    position = (np.arange(_FREQUENCIES) + 0.5) / _FREQUENCIES - 0.5
    # Hann's window; scipy.signal takes a second to load.
    weight = np.hanning(_FREQUENCIES + 2)[1:-1]
    first_hz, last_hz = band_hz
    mean = np.zeros((2, eps.size), np.complex128)
    slope = np.zeros((2, eps.size), np.complex128)
    for offset, share in zip(position, weight / weight.sum(), strict=True):
        frequency_hz = first_hz + (offset + 0.5) * (last_hz - first_hz)
        coefficients = np.stack(multilayer([eps, holder], [thickness_m, np.inf], frequency_hz, theta_rad))
        mean += share * coefficients
        slope += share * offset * coefficients
    variance = float(np.sum(weight * position**2) / weight.sum())
    with np.errstate(divide="ignore", invalid="ignore"):
        slope_s, slope_p = slope / mean / variance
    change = np.stack([slope_s.real, (slope_p - slope_s).real, (slope_p - slope_s).imag], axis=-1)
    return np.where(np.isfinite(change), change, 0.0)


def compute_layer_odds(dispersion: PatchDispersion, theta_rad: float) -> Real:
    """Return the likelihood of a change over the sweep for each drawn thin plate over that for a half space, [draw]."""
    sheet_dispersions = draw_sheet_dispersions(theta_rad, dispersion.band_hz)
    width = np.sqrt(dispersion.std**2 + DISPERSION_KERNEL**2 + (DISPERSION_MODEL * sheet_dispersions) ** 2)
    layers = _sum_log_normal_densities(dispersion.change - sheet_dispersions, width)
    log_usual_density = np.log(1 - ODD_DISPERSION) + _sum_log_normal_densities(dispersion.change, dispersion.std)
    log_odd_density = np.log(ODD_DISPERSION) + _sum_log_normal_densities(
        dispersion.change, np.hypot(dispersion.std, ODD_DISPERSION_STD)
    )
    log_odds = layers - np.logaddexp(log_usual_density, log_odd_density)
    return np.asarray(np.exp(np.clip(log_odds, -_MOST_LOG_ODDS, _MOST_LOG_ODDS)), np.float64)


def compute_log_layer_odds(dispersion: PatchDispersion | None, kinds: Kinds | None) -> float:
    """Return ln of the mean of `compute_layer_odds` over the thin plates; 0 without dispersion or without kinds."""
    if dispersion is None or kinds is None:
        return 0.0
    return float(np.log(np.mean(compute_layer_odds(dispersion, kinds.theta_rad))))


def _sum_log_normal_densities(difference: Real, std: Real) -> Real:
    """Return the sum over the last axis of the logarithms of normal densities, up to a constant."""
    return np.sum(-0.5 * (difference / std) ** 2 - np.log(std), axis=-1)


@cache
def _draw_sheet_properties() -> tuple[Complex, Complex, Real]:
    """Return the drawn thin plates: permittivity, permittivity behind them, and thickness in metres, [draw] each."""
    uniform = np.random.default_rng(0).random((_SHEETS, 5))
    real, tangent, size_mm = (
        low * (high / low) ** part
        for (low, high), part in zip((SHEET_REAL, SHEET_LOSS_TANGENT, SHEET_MM), uniform.T[:3], strict=True)
    )
    eps_behind = np.where(uniform[:, 3] < 0.5, 1.0, HOLDER_REAL[0] + (HOLDER_REAL[1] - HOLDER_REAL[0]) * uniform[:, 4])
    return real * (1 - 1j * tangent), eps_behind.astype(np.complex128), size_mm / 1e3


def _compute_histogram(draws: Complex, real: Real, imag: Real, covariance: Real) -> Real:
    """Return the density of `draws` of t on a grid [imaginary, real], smoothed by `SHEET_KERNEL` and errors of t."""
    step = np.array([imag[1] - imag[0], real[1] - real[0]])
    edges = [np.append(axis - d / 2, axis[-1] + d / 2) for axis, d in zip((imag, real), step, strict=True)]
    count = np.histogram2d(draws.imag, draws.real, edges)[0] / (draws.size * step.prod())
    width = np.sqrt(np.diag(covariance)[::-1] + SHEET_KERNEL**2) / step
    return scipy.ndimage.gaussian_filter(count, width, mode="nearest")
