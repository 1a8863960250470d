"""Truth of a scene: its plates as listed in truth.json, matched to patches by position."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from polysight.materials.segment import Box, Patch
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError
from polysight_shared.files import read_json

TRUTH = "truth.json"


@dataclass(frozen=True)
class TruthPlate:
    """A rectangular plate of the true scene.

    Box in millimetres from the image centre; permittivity eps' - j eps'', None for metal, strips and stacks of layers.
    """

    name: str
    box_mm: Box
    permittivity: complex | None
    thickness_mm: float | None = None
    metal: bool = False

    @property
    def centre_mm(self) -> tuple[float, float]:
        """Middle of the box."""
        return (self.box_mm[0] + self.box_mm[2]) / 2, (self.box_mm[1] + self.box_mm[3]) / 2


def truth_plates(truth: Mapping[str, Any]) -> tuple[TruthPlate, ...]:
    """Return the plates in the content of truth.json: name, centre_mm, size_mm, and permittivity or metal each.

    Raises
    ------
    DataError
        if the content is invalid.
    """
    try:
        return tuple(_plate(p) for p in truth["plates"])
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as e:
        raise DataError(
            f"the content of the truth file is invalid: {type(e).__name__}: {e}",
            "expected plates = [{name, centre_mm, size_mm, permittivity or metal}]",
            code=ErrorCode.VALUE_INVALID,
        ) from None


Plates = tuple[TruthPlate, ...]


def read_truth(path: Path) -> tuple[TruthPlate, ...]:
    """Read the plates of a truth.json. Raises DataError."""
    remedy = f"give the one that polysight simulate wrote beside its data, or move {path.name} away"
    try:
        return truth_plates(read_json(path))
    except DataError as e:
        raise DataError(f"{path}: {e.what}", e.why, remedy, code=e.code) from None
    except (OSError, ValueError) as e:
        raise DataError(
            f"{path}: cannot be read as truth: {e}", "another program's file, or damaged", remedy,
            code=ErrorCode.FILE_UNREADABLE,
        ) from None  # fmt: skip


def specimen_seed(path: Path) -> int | None:
    """Return the seed of the plates' random permittivities (`specimen_spread`) in a truth.json; None if not random.

    Raises DataError.
    """
    read_truth(path)
    scene = read_json(path).get("scene")
    spread = scene.get("specimen_spread") if isinstance(scene, dict) else None
    return scene.get("seed") if isinstance(scene, dict) and isinstance(spread, list) and any(spread) else None


def find_truth(folder: Path) -> tuple[Plates, str]:
    """Read the plates of a scan folder's truth.json, if there is one.

    Returns
    -------
    plates, note
        No plates without the file; no plates and the reason, in one line, if the file is invalid.
    """
    path = folder / TRUTH
    if not path.exists():
        return (), ""
    try:
        return read_truth(path), ""
    except DataError as e:
        return (), f"{e.what}; {e.why}. The truth is not used.".replace("\n", " ")


def _plate(raw: Mapping[str, Any]) -> TruthPlate:
    cx, cy = (float(c) for c in raw["centre_mm"])
    w, h = (float(s) for s in raw["size_mm"])
    eps = None
    metal = bool(raw.get("metal", False))
    if not metal and not raw.get("layers") and raw.get("strips_deg") is None:
        re, loss = raw["permittivity"]
        eps = complex(float(re), -float(loss))
    thickness = raw.get("thickness_mm")
    if not np.isfinite([cx, cy, w, h, *([] if eps is None else [eps.real, eps.imag])]).all():
        raise ValueError(f"a number of plate {raw['name']} is not finite")
    box = (cx - w / 2, cy - h / 2, cx + w / 2, cy + h / 2)
    return TruthPlate(str(raw["name"]), box, eps, None if thickness is None else float(thickness), metal)


def match_truth(patches: Iterable[Patch], plates: Iterable[TruthPlate]) -> dict[int, TruthPlate]:
    """Return patch label to plate: the patch's centre lies in the plate; of several patches the nearest gets it."""
    pairs = []
    for plate in plates:
        x0, y0, x1, y1 = plate.box_mm
        for patch in patches:
            x, y = patch.centre_mm
            if x0 <= x <= x1 and y0 <= y <= y1:
                distance = float(np.hypot(x - plate.centre_mm[0], y - plate.centre_mm[1]))
                pairs.append((distance, patch.label, plate))
    out: dict[int, TruthPlate] = {}
    for _, label, plate in sorted(pairs, key=lambda p: p[0]):
        if label not in out and all(p is not plate for p in out.values()):
            out[label] = plate
    return out
