"""Simulate scenes with the simulated rig, and process them like recorded scans."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import tomli_w

from polysight.jobs.demo import run_simulator
from polysight.jobs.train import EDGE_MM
from polysight.materials import (
    TRUTH,
    KnownScene,
    MaterialsResult,
    MetalChoice,
    TruthPlate,
    patches_from_plates,
    read_truth,
)
from polysight.pipeline import Pipeline
from polysight.store import RawSource, ScanFolder
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ScanError

PLATE_MM = 45.0
GRID = {"columns": 49, "rows": 49, "step_x_mm": 10.0, "step_y_mm": 6.0}
"""The sparse aperture of `examples/nine-materials.toml`, explained there."""


def plate(name: str, eps: complex | None, x_mm: float, y_mm: float) -> dict[str, Any]:
    """Return a square plate for the scene file; without permittivity it is metal."""
    material = {"metal": True} if eps is None else {"permittivity": [eps.real, -eps.imag]}
    return {"name": name, "centre_mm": [x_mm, y_mm], "size_mm": [PLATE_MM, PLATE_MM], **material}


@contextmanager
def scanned(
    name: str, plates: Sequence[Mapping[str, Any]], config: Path, seed: int, **more: Any
) -> Iterator[tuple[ScanFolder, tuple[TruthPlate, ...]]]:
    """Simulate a scan of plates with all disturbances; yield it with its truth. Its files are deleted afterwards.

    `more` are further keys of the scene file. Raises ScanError.
    """
    content = {"name": name, "seed": seed, "object_distance_mm": 499.0, "grid": GRID, "plates": list(plates)} | more
    with tempfile.TemporaryDirectory(prefix="polysight-reproduce-") as temporary:
        file, folder = Path(temporary) / "scene.toml", Path(temporary) / "scan"
        file.write_text(tomli_w.dumps(content), encoding="utf-8")
        if run_simulator(["simulate", str(file), "--config", str(config), "--out", str(folder)]):
            raise ScanError(f"the scene {name!r} could not be simulated", "see above", code=ErrorCode.VALUE_INVALID)
        yield ScanFolder.load(folder), read_truth(folder / TRUTH)


@dataclass(frozen=True)
class Imaged:
    """Result of a scan's images, and their axes in the rig frame (float64, metres)."""

    result: MaterialsResult
    x_m: npt.NDArray[np.float64]
    y_m: npt.NDArray[np.float64]


def imaged(source: RawSource, plates: tuple[TruthPlate, ...]) -> Imaged:
    """Process a scan with known positions of its plates (the paper segments by hand), referenced to its metal plate."""
    pipeline = Pipeline(source)
    for row in source.rows():
        pipeline.add_row(row)
    images = pipeline.form_images()
    metal = next(p for p in plates if p.metal)
    known, _ = patches_from_plates(plates, images.x_m, images.y_m, EDGE_MM)
    result = pipeline.find_materials(images, MetalChoice(metal.box_mm), KnownScene(known, plates))
    return Imaged(result, images.x_m, images.y_m)
