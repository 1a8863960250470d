"""Concentration of a solution from its polarisation angle (section 9.4 of the paper).

Phi = arctan |P| (Eq. 8) falls steadily as sugar is dissolved. The calibration is a straight line through known
concentrations, which gives unknown ones with a prediction interval. It is judged by cross-validation: all patches of
one concentration are left out together.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials.library import Library
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

Real = npt.NDArray[np.float64]
_PERCENT = re.compile(r"(\d+(?:\.\d+)?)\s*%")


def polarisation_angle_rad(p: npt.ArrayLike) -> Real:
    """Return the polarisation angle arctan |P| of metal-referenced ratios (Eq. 8), radians; 45 degrees for metal."""
    return np.arctan(np.abs(np.asarray(p)))


@dataclass(frozen=True)
class Line:
    """Concentration as a linear function of the polarisation angle, by least squares.

    Attributes
    ----------
    slope, intercept
        Concentration in percent by weight = intercept + slope * angle in radians.
    mean_rad, spread_rad2
        Mean of the angles and sum of their squared deviations.
    residual_std
        Standard deviation about the line, percent.
    patches
        Number of patches fitted.
    """

    slope: float
    intercept: float
    mean_rad: float
    spread_rad2: float
    residual_std: float
    patches: int

    @classmethod
    def through(cls, angle_rad: npt.ArrayLike, percent: npt.ArrayLike) -> Line:
        """Fit the line. Raises DataError with fewer than three patches or two concentrations."""
        x, y = np.asarray(angle_rad, np.float64), np.asarray(percent, np.float64)
        if x.size < 3 or np.unique(y).size < 2 or np.ptp(x) == 0:
            raise DataError(
                f"{x.size} patches of {np.unique(y).size} concentrations",
                "a line with an interval needs three patches and two concentrations with different angles",
                "measure more concentrations",
                code=ErrorCode.NOT_ENOUGH_DATA,
            )
        slope, intercept = (float(c) for c in np.polyfit(x, y, 1))
        residual = y - (intercept + slope * x)
        std = float(np.sqrt((residual**2).sum() / (x.size - 2)))
        spread = float(((x - x.mean()) ** 2).sum())
        return cls(slope, intercept, float(x.mean()), spread, std, int(x.size))

    def percent(self, angle_rad: npt.ArrayLike) -> Real:
        """Return the concentrations, percent by weight, in the shape of the angles."""
        return self.intercept + self.slope * np.asarray(angle_rad, np.float64)

    def interval(self, angle_rad: npt.ArrayLike, confidence: float = 0.9) -> tuple[Real, Real]:
        """Return the prediction interval of a new patch: lower and upper end, percent by weight.

        Student's t over the residuals, wider away from the calibration's middle (Draper and Smith, Applied Regression
        Analysis, section 1.4).
        """
        x = np.asarray(angle_rad, np.float64)
        t = float(scipy.special.stdtrit(self.patches - 2, 0.5 + confidence / 2))
        width = t * self.residual_std * np.sqrt(1 + 1 / self.patches + (x - self.mean_rad) ** 2 / self.spread_rad2)
        middle = self.percent(x)
        return middle - width, middle + width


@dataclass(frozen=True)
class LeftOut:
    """Estimate of one patch by a line fitted without its concentration."""

    name: str
    true_percent: float
    percent: float
    low: float
    high: float


@dataclass(frozen=True)
class ConcentrationResult:
    """The line through all patches, and the estimates with each concentration left out."""

    line: Line
    left_out: tuple[LeftOut, ...]

    @property
    def median_error(self) -> float:
        """Median absolute error over left-out patches, percent by weight."""
        return float(np.median([abs(r.percent - r.true_percent) for r in self.left_out]))

    @property
    def covered(self) -> float:
        """Share of left-out patches whose interval holds the truth."""
        return float(np.mean([r.low <= r.true_percent <= r.high for r in self.left_out]))


def concentrations(names: Iterable[str], given: Mapping[str, float] | None = None) -> dict[str, float]:
    """Return material name to percent by weight: as given, or the number before a percent sign in the name.

    Names without either are omitted.
    """
    out: dict[str, float] = {}
    for name in names:
        found = _PERCENT.search(name)
        if given and name in given:
            out[name] = given[name]
        elif found:
            out[name] = float(found[1])
    return out


def fit_concentration(
    library: Library, given: Mapping[str, float] | None = None, confidence: float = 0.9
) -> ConcentrationResult:
    """Fit a line through a library's patches of known concentration, and judge it with each one left out.

    The concentration is in the names of the patches (``"sugar (3.8%)"``) or in `given`, name to percent by weight
    (``{"water": 0.0}``). `confidence` is that of the intervals.

    Raises DataError with fewer than three known concentrations, or patches of several incidence angles.
    """
    known = concentrations(library.names, given)
    entries = [e for e in library.entries if e.name in known]
    values = {known[e.name] for e in entries}
    if len(values) < 3:
        raise DataError(
            f"{len(values)} known concentrations in this library",
            "three are needed to leave one out; names contain them as in 'sugar (3.8%)'",
            "add scans, or give the concentration of a name: --value water=0",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    angles = [e.incidence_deg for e in entries]
    if max(angles) - min(angles) > 1.0:
        raise DataError(
            f"patches under incidence angles of {min(angles):.1f} to {max(angles):.1f} degrees",
            "the polarisation angle changes with the incidence angle",
            "use scans of one geometry",
            code=ErrorCode.MISMATCH,
        )
    x = np.array([float(np.median(polarisation_angle_rad(e.p))) for e in entries])
    y = np.array([known[e.name] for e in entries])
    rows: list[LeftOut] = []
    for value in sorted(values):
        test = y == value
        line = Line.through(x[~test], y[~test])
        low, high = line.interval(x[test], confidence)
        names = [entries[i].name for i in np.flatnonzero(test)]
        estimates = zip(names, line.percent(x[test]), low, high, strict=True)
        rows += [LeftOut(name, value, float(percent), float(lo), float(hi)) for name, percent, lo, hi in estimates]
    return ConcentrationResult(Line.through(x, y), tuple(rows))
