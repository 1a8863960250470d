"""Compare two processed scans: differences of P and permittivity in standard deviations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.catalogue.pictures import Picture, Pixels, draw_values, mask_values
from polysight.products import read_products
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

Real = NDArray[np.float64]
DIFFERENCE = "RdBu"
SIGNIFICANT = 3.0
"""Standard deviations above which a difference is significant."""
_LEAST_SCATTER = 0.1  # smallest scatter of two scans in their stated errors: a copy has none at all
_NEAR_MM = 15.0  # largest distance of the centres of one patch in both scans


@dataclass(frozen=True)
class Comparison:
    """Differences of the first scan minus the second, on the first one's pixels [ny, nx].

    Attributes
    ----------
    p, permittivity
        complex128; nan where one of the scans has no value.
    sigmas
        float64: |difference of P| in standard deviations of such differences; nan where the error is not known.
    scatter
        Those standard deviations in stated errors, :func:`scatter_of`; nan if the errors are not known.
    patches
        For each pair of patches at one place: names, permittivities, difference.
    notes
        Reasons why the two are hard to compare.
    """

    first: Pixels
    second: Pixels
    p: NDArray[np.complex128]
    permittivity: NDArray[np.complex128]
    sigmas: Real
    scatter: float
    patches: tuple[dict[str, Any], ...]
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """As plain data, without the maps."""
        known = self.sigmas[np.isfinite(self.sigmas)]
        share = float((known > SIGNIFICANT).mean()) if known.size else None
        return {
            "patches": list(self.patches),
            "notes": list(self.notes),
            "extent_mm": list(self.first.extent_mm),
            "compared": int(np.isfinite(self.p).sum()),
            "significant_share": share,
            "scatter": None if np.isnan(self.scatter) else round(self.scatter, 3),
            "significant_sigmas": SIGNIFICANT,
        }


def compare(first: Path, second: Path) -> Comparison:
    """Compare two processed scans, pixel by pixel and patch by patch.

    Raises
    ------
    DataError
        if one of them has no products or is not referenced to metal, or they show different places.
    """
    a, b = (Pixels(read_products(folder).folder) for folder in (first, second))
    for folder, pixels in ((first, a), (second, b)):
        if not pixels.referenced:
            raise DataError(
                f"{folder}: cannot be compared", "its images are not referenced to metal, or support no result",
                "process it with a metal reference", code=ErrorCode.NO_DATA,
            )  # fmt: skip
    rows, row_inside = _places(a.y_mm, b.y_mm)
    columns, column_inside = _places(a.x_mm, b.x_mm)
    both = row_inside[:, None] & column_inside[None, :] & a.clear & b.clear[np.ix_(rows, columns)]
    if not both.any():
        raise DataError(
            "the two scans have no place in common", "their images lie apart, or one of them is dark",
            "take other scans", code=ErrorCode.MISMATCH,
        )  # fmt: skip
    at = np.ix_(rows, columns)
    p = np.where(both, a.p - b.p[at], np.nan).astype(np.complex128)
    eps = np.where(both, a.permittivity - b.permittivity[at], np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        stated = np.abs(p) / np.hypot(a.p_std, b.p_std[at])
    scatter = scatter_of(stated)
    return Comparison(a, b, p, eps, stated / scatter, scatter, tuple(_pairs(a, b)), tuple(_notes(a, b, scatter)))


def scatter_of(differences: Real) -> float:
    """Estimate the scatter of unchanged pixels, 0.1 to 1, from |differences| in stated errors; nan without any.

    Stated errors include those that both scans share (leakage, metal reference, sidelobes), which cancel in a
    difference. Taken from the median, so that changes of less than half of the image hardly matter: the median of a
    complex normal error with unit variance in each part is sqrt(2 ln 2).
    """
    known = differences[np.isfinite(differences)]
    if known.size == 0:
        return float("nan")
    return float(np.clip(np.median(known) / np.sqrt(2 * np.log(2)), _LEAST_SCATTER, 1.0))


def _places(mine: Real, other: Real) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Index of the nearest of `other` for each of `mine` (mm), and True where it is within half a pixel."""
    nearest = np.abs(mine[:, None] - other[None, :]).argmin(axis=1)
    return nearest, np.abs(mine - other[nearest]) <= max(abs(other[1] - other[0]), abs(mine[1] - mine[0])) * 0.51


def _notes(a: Pixels, b: Pixels, scatter: float) -> list[str]:
    notes = []
    if scatter < 1:
        notes.append(
            f"P of unchanged pixels scatters by {scatter:.2f} of the stated errors, of which the scans share a part:"
            " significance counts from that scatter"
        )
    degrees = [float(np.degrees(x.theta_rad)) for x in (a, b)]
    if abs(degrees[0] - degrees[1]) > 0.5:
        notes.append(f"the incidence angles differ: {degrees[0]:.1f} and {degrees[1]:.1f} degrees; P depends on them")
    if a.simulated != b.simulated:
        notes.append("one of the two is simulated")
    if not (np.isfinite(a.p_std).any() and np.isfinite(b.p_std).any()):
        notes.append("the errors of one are not known (processed by an earlier release): significance cannot be judged")
    return notes


def _pairs(a: Pixels, b: Pixels) -> list[dict[str, Any]]:
    """Pairs of patches with their centres at one place."""
    out = []
    others = [s for s in b.segments if not s.get("metal_reference")]
    for one in a.segments:
        if one.get("metal_reference"):
            continue
        near = [(float(np.hypot(*np.subtract(_middle(one), _middle(s)))), s) for s in others]
        distance, other = min(near, key=lambda pair: pair[0], default=(np.inf, {}))
        if distance <= _NEAR_MM:
            out.append(_pair(one, other))
    return out


def _middle(segment: dict[str, Any]) -> tuple[float, float]:
    x0, y0, x1, y1 = segment["box_mm"]
    return (x0 + x1) / 2, (y0 + y1) / 2


def _pair(one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {
        "place_mm": [round(m, 1) for m in _middle(one)],
        "names": [one.get("name"), other.get("name")],
        "labels": [one["label"], other["label"]],
        "permittivity": [one.get("permittivity"), other.get("permittivity")],
        "difference": None,
        "sigmas": None,
    }
    e, f = one.get("permittivity"), other.get("permittivity")
    if not e or not f:
        return found
    difference = np.array([e["real"] - f["real"], e["imag"] - f["imag"]])
    covariance = _covariance(e) + _covariance(f)
    found["difference"] = {"real": round(float(difference[0]), 4), "imag": round(float(difference[1]), 4)}
    if np.isfinite(covariance).all() and np.linalg.det(covariance) > 0:
        found["sigmas"] = round(float(np.sqrt(difference @ np.linalg.solve(covariance, difference))), 2)
        found["difference"] |= {
            part: round(float(np.sqrt(covariance[k, k])), 4) for k, part in enumerate(("real_std", "imag_std"))
        }
    return found


def draw_comparison(found: Comparison, name: str) -> Picture:
    """A map of the differences: `p` (|difference of P|), `sigmas`, `permittivity` or `loss` (first minus second).

    Raises DataError where there is no such map.
    """
    if name in ("p", "sigmas"):
        values = np.abs(found.p) if name == "p" else found.sigmas
        seen = np.isfinite(values)
        high = max(float(np.percentile(values[seen], 98)), 1e-3) if seen.any() else 1.0
        return draw_values(mask_values(values, seen, (0.0, max(high, 2 * SIGNIFICANT) if name == "sigmas" else high)))
    if name not in ("permittivity", "loss"):
        raise DataError(
            f"no map is called {name[:40]!r}", "the name is wrong", "p, sigmas, permittivity or loss",
            code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    values = found.permittivity.real if name == "permittivity" else -found.permittivity.imag
    seen = np.isfinite(values)
    reach = max(float(np.percentile(np.abs(values[seen]), 95)), 1e-3) if seen.any() else 1.0
    return draw_values(mask_values(values, seen, (-reach, reach), DIFFERENCE))


def _covariance(permittivity: dict[str, Any]) -> Real:
    """Covariance of (real, imaginary); nan if an earlier release did not write it."""
    known = permittivity.get("covariance")
    return np.array(known, np.float64) if known else np.full((2, 2), np.nan)
