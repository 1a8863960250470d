"""What the choice of the incidence angle changes: each pixel's own against one number for the image."""

from __future__ import annotations

from typing import Any

import numpy as np

from polysight.host.materials.analyse import MaterialsResult
from polysight.host.polarimetry import IncidenceChoice, permittivity_from_ratio


def permittivity_change(found: MaterialsResult, angles: IncidenceChoice) -> dict[str, Any]:
    """Largest relative change of a patch's permittivity (Eq. 3) if the other angle were used; for quality.json.

    `largest_permittivity_change` is |eps_other / eps - 1|, `of_patch` its number; empty without any permittivity.
    """
    changes = []
    for r in found.patches:
        at = r.patch.interior
        if r.permittivity.value is not None and at.any():
            used, other = (float(np.mean(a[at])) for a in (angles.used_rad, angles.other_rad))
            eps = permittivity_from_ratio(r.permittivity.ratio, np.array([used, other]))
            changes.append((float(abs(eps[1] / eps[0] - 1)), r.patch.label))
    if not changes:
        return {}
    largest, label = max(changes)
    return {"largest_permittivity_change": round(largest, 5), "of_patch": label}
