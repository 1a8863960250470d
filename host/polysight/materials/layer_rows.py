"""Layers of a segment of materials.json: parse the stack, fit it, and convert the fit to plain values."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from polysight.materials.layer_fit import THICKNESS_RANGE_M, LayerFit, fit_layer
from polysight.materials.layers import METAL, Layer
from polysight.materials.measure import NOT_PASSIVE
from polysight.materials.sub_bands import AMPLITUDE_ERROR, bands_of_row
from polysight_shared.config import Chirp

LAYER_FORMS = (
    "NAME,REAL,LOSS,MM (known; without MM a half space), NAME,metal, NAME,?,MM (unknown), NAME,?,A-B (its thickness"
    " too, from A to B mm), NAME,?,? (of any thickness) or NAME,? (unknown half space)"
)
_RANGE = re.compile(r"([0-9.eE+]+)\s*-\s*([0-9.eE+]+)")


def parse_layer(text: str) -> Layer:
    """Parse a layer in one of `LAYER_FORMS`. Raises ValueError for another form."""
    name, *rest = (part.strip() for part in text.split(","))
    if rest == ["metal"]:
        return Layer(name, METAL)
    if rest and rest[0] == "?" and len(rest) <= 2:
        return _unknown(name, *rest[1:])
    if len(rest) not in (2, 3):
        raise ValueError(text)
    real, loss, *thickness = (float(part) for part in rest)
    if not (np.isfinite(real) and np.isfinite(loss)):
        raise ValueError(text)
    return Layer(name, complex(real, -loss), _metres(thickness[0]) if thickness else None)


def _unknown(name: str, size: str = "") -> Layer:
    if not size:
        return Layer(name)
    if size == "?":
        return Layer(name, thickness_range_m=THICKNESS_RANGE_M)
    if between := _RANGE.fullmatch(size):
        low, high = (_metres(float(mm)) for mm in between.groups())
        if low >= high:
            raise ValueError(size)
        return Layer(name, thickness_range_m=(low, high))
    return Layer(name, None, _metres(float(size)))


def _metres(mm: float) -> float:
    if not 0 < mm < np.inf:
        raise ValueError(mm)
    return mm / 1e3


def fit_row(
    row: Mapping[str, Any],
    chirp: Chirp,
    stack: Sequence[Layer],
    bands: int | None = None,
    amplitude_error: float = AMPLITUDE_ERROR,
    theta_std_rad: float = 0.0,
) -> LayerFit | None:
    """Fit the unknown layer of a stack to a segment of materials.json.

    Parameters
    ----------
    row, chirp
        The segment, and the chirp of its scan.
    stack
        Layers in the order the wave meets them, one unknown.
    bands
        Sub-bands to use; None: those of the segment if a thickness is fitted, else the whole sweep.
    amplitude_error
        Relative standard deviation of |H|; 0: it is not used.
    theta_std_rad
        Standard deviation of the incidence angle.

    Returns
    -------
    None for the metal reference, a segment without a usable ratio, or one that is no plate (noise, several materials).

    Raises
    ------
    DataError
        if the segment has not so many sub-bands, or there are fewer data than unknowns.
    PolysightError
        if the stack has not exactly one unknown layer, or a thickness is missing.
    """
    refused = row.get("refused")
    if row.get("metal_reference") or (refused and refused.get("what") not in NOT_PASSIVE):
        return None
    if bands is None:
        sized = any(layer.thickness_range_m for layer in stack)
        bands = max(1, len(row.get("bands") or ())) if sized else 1
    data = bands_of_row(row, chirp, bands, amplitude_error, theta_std_rad)
    return None if data is None else fit_layer(data, stack, float(np.radians(row["incidence_deg"])))


def incidence_std_rad(materials: Mapping[str, Any]) -> float:
    """Return the standard deviation of the incidence angle in materials.json, radians; 0 if it is not there."""
    std_deg = ((materials.get("error_budget") or {}).get("incidence") or {}).get("std_deg")
    return float(np.radians(std_deg or 0.0))


def layer_content(fit: LayerFit) -> dict[str, Any]:
    """Return a fit as plain values for JSON; permittivities as [eps', eps''], lengths in millimetres."""
    sized = fit.std_thickness_m > 0
    units = np.array([1.0, 1.0, 1e3])[: 3 if sized else 2]
    covariance = None if fit.covariance is None else (fit.covariance * np.outer(units, units)).tolist()
    return {
        **_solution(fit),
        "std_real": fit.std_real,
        "std_loss": fit.std_loss,
        "thickness_std_mm": 1e3 * fit.std_thickness_m if sized else None,
        "covariance": covariance,
        "freedom": fit.freedom,
        "ambiguous": fit.ambiguous,
        "rivals": [_solution(r) for r in fit.rivals],
        "at_limit": list(fit.at_limit),
        "warnings": fit.warnings(),
    }


def _solution(fit: LayerFit) -> dict[str, Any]:
    return {
        "permittivity": [fit.permittivity.real, -fit.permittivity.imag],
        "thickness_mm": None if fit.thickness_m is None else 1e3 * fit.thickness_m,
        "chi2": fit.chi2,
    }
