"""Table of materials for all exports: one column per quantity, one entry per patch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.products.files import SavedProducts

_COLUMNS = (
    "patch", "name", "confidence", "metal_reference", "metal_like", "centre_x_mm", "centre_y_mm", "width_mm",
    "height_mm", "pixels", "incidence_deg", "permittivity_real", "permittivity_real_standard_error",
    "permittivity_loss", "permittivity_loss_standard_error", "permittivity_real_loss_covariance", "dominated_by",
    "refused", "p_real", "p_imag", "p_abs_db", "p_phase_deg", "inverse_p_standard_error", "true_name",
    "true_permittivity_real", "true_permittivity_loss", "drawn_as",
)  # fmt: skip


@dataclass(frozen=True)
class PermittivitySpread:
    """Error of a permittivity eps' - j eps''.

    Attributes
    ----------
    real_std, loss_std
        Standard deviations of eps' and eps''.
    covariance
        Covariance of eps' and eps''; None in products of earlier releases.
    """

    real_std: float
    loss_std: float
    covariance: float | None = None

    @property
    def matrix(self) -> npt.NDArray[np.float64]:
        """Covariance matrix of (eps', eps''), [2, 2]; diagonal if the covariance is unknown."""
        c = self.covariance or 0.0
        return np.array([[self.real_std**2, c], [c, self.loss_std**2]])


def permittivity_spread(permittivity: Mapping[str, Any] | None) -> PermittivitySpread | None:
    """Return the error of a segment's `permittivity`; None if unknown.

    `covariance` in materials.json refers to (real, imag). The loss is -imag, so the off-diagonal term changes sign.
    """
    e = permittivity or {}
    given = e.get("covariance")
    if given is not None and None not in (given[0][0], given[0][1], given[1][1]):
        return PermittivitySpread(math.sqrt(given[0][0]), math.sqrt(given[1][1]), -given[0][1] + 0.0)
    if e.get("real_std") is None or e.get("imag_std") is None:
        return None
    return PermittivitySpread(e["real_std"], e["imag_std"])


def refused_text(segment: Mapping[str, Any]) -> str:
    """Return why a patch has no result, and the remedy, in one line; "" if it has one."""
    refused = segment.get("refused") or {}
    head = ": ".join(part for part in (refused.get("what"), refused.get("why")) if part)
    return "; ".join(part for part in (head, refused.get("do")) if part)


def material_columns(products: SavedProducts) -> dict[str, list[Any]]:
    """Return the columns by name, with one entry per patch; None for unknown values.

    Permittivity is `permittivity_real` - j `permittivity_loss`; `dominated_by` is the largest source of its error,
    `refused` the reason why a patch has no result, `drawn_as` the name of its box drawn by hand. `p_...` refer to
    P = H / V relative to metal; positions are relative to the image centre.
    """
    rows = [_row(segment) for segment in products.segments]
    return {name: [row[name] for row in rows] for name in _COLUMNS}


def _row(s: dict[str, Any]) -> dict[str, Any]:
    x0, y0, x1, y1 = s["box_mm"]
    e, truth = s.get("permittivity") or {}, s.get("truth") or {}
    true = truth.get("permittivity") or {}
    p, spread = s.get("ratio"), permittivity_spread(e)
    size = math.hypot(p["real"], p["imag"]) if p else 0.0
    return {
        "patch": s["label"],
        "name": s.get("name"),
        "confidence": s.get("confidence"),
        "metal_reference": bool(s.get("metal_reference")),
        "metal_like": bool(s.get("metal_like")),
        "centre_x_mm": (x0 + x1) / 2,
        "centre_y_mm": (y0 + y1) / 2,
        "width_mm": x1 - x0,
        "height_mm": y1 - y0,
        "pixels": s.get("interior_pixels"),
        "incidence_deg": s.get("incidence_deg"),
        "permittivity_real": e.get("real"),
        "permittivity_real_standard_error": spread.real_std if spread else None,
        "permittivity_loss": _minus(e.get("imag")),
        "permittivity_loss_standard_error": spread.loss_std if spread else None,
        "permittivity_real_loss_covariance": spread.covariance if spread else None,
        "dominated_by": e.get("dominated_by"),
        "refused": refused_text(s) or None,
        "p_real": p["real"] if p else None,
        "p_imag": p["imag"] if p else None,
        "p_abs_db": 20 * math.log10(size) if size else None,
        "p_phase_deg": math.degrees(math.atan2(p["imag"], p["real"])) if p else None,
        "inverse_p_standard_error": s.get("inverse_ratio_std"),
        "true_name": truth.get("name"),
        "true_permittivity_real": true.get("real"),
        "true_permittivity_loss": _minus(true.get("imag")),
        "drawn_as": s.get("box"),
    }


def _minus(value: float | None) -> float | None:
    return None if value is None else -value
