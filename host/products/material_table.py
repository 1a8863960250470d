"""The table of materials: one column a quantity, one entry a patch, as every export has it."""

from __future__ import annotations

import math
from typing import Any, Protocol

_COLUMNS = (
    "patch", "name", "confidence", "metal_reference", "metal_like", "centre_x_mm", "centre_y_mm", "width_mm",
    "height_mm", "pixels", "incidence_deg", "permittivity_real", "permittivity_real_standard_error",
    "permittivity_loss", "permittivity_loss_standard_error", "p_real", "p_imag", "p_abs_db", "p_phase_deg",
    "inverse_p_standard_error", "true_name", "true_permittivity_real", "true_permittivity_loss",
)  # fmt: skip


class HasSegments(Protocol):
    """Anything with patches as materials.json lists them."""

    @property
    def segments(self) -> list[dict[str, Any]]:
        """One dict a patch."""
        ...


def material_columns(products: HasSegments) -> dict[str, list[Any]]:
    """Columns by name, an entry for each patch; None where a number is not known.

    Permittivity is `permittivity_real` - j `permittivity_loss`; p_imag and p_phase are those of P = H / V relative to
    metal; positions count from the image's centre.
    """
    rows = [_row(segment) for segment in products.segments]
    return {name: [row[name] for row in rows] for name in _COLUMNS}


def _row(s: dict[str, Any]) -> dict[str, Any]:
    x0, y0, x1, y1 = s["box_mm"]
    e, truth = s.get("permittivity") or {}, s.get("truth") or {}
    true = truth.get("permittivity") or {}
    p = s.get("ratio")
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
        "permittivity_real_standard_error": e.get("real_std"),
        "permittivity_loss": _minus(e.get("imag")),
        "permittivity_loss_standard_error": e.get("imag_std"),
        "p_real": p["real"] if p else None,
        "p_imag": p["imag"] if p else None,
        "p_abs_db": 20 * math.log10(size) if size else None,
        "p_phase_deg": math.degrees(math.atan2(p["imag"], p["real"])) if p else None,
        "inverse_p_standard_error": s.get("inverse_ratio_std"),
        "true_name": truth.get("name"),
        "true_permittivity_real": true.get("real"),
        "true_permittivity_loss": _minus(true.get("imag")),
    }


def _minus(value: float | None) -> float | None:
    return None if value is None else -value
