"""A small scan of six plates whose words or cubes are changed while they are read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from polysight.imaging import Images
from polysight.materials import match_truth, read_true_plates
from polysight.pipeline import Pipeline
from polysight.process import Findings
from polysight.store import CubeRow, RowData, Source
from polysight.store.source import split_pieces
from polysight_simulators.scene import decode_scene
from polysight_simulators.scene.simulated_scan import truth
from tests.support.pipelines import make_pipeline

PLATES = {
    "ceramic": ([-62.0, 32.0], [4.75, 2.43]), "acrylic": ([0.0, 34.0], [4.0, 0.4]), "PET": ([62.0, 32.0], [3.78, 0.7]),
    "wood": ([-62.0, -32.0], [2.61, 0.01]), "rubber": ([62.0, -32.0], [5.06, 1.11]),
}  # fmt: skip
SCENE: dict[str, Any] = {
    "name": "small", "seed": 5, "burst": {"pulses": 4}, "image": {"columns": 110, "rows": 86},
    "grid": {"columns": 43, "rows": 41, "step_x_mm": 10.0, "step_y_mm": 6.0},
    "plates": [
        {"name": "metal", "centre_mm": [0.0, -34.0], "size_mm": [46.0, 46.0], "metal": True},
        *({"name": n, "centre_mm": at, "size_mm": [46.0, 46.0], "permittivity": e} for n, (at, e) in PLATES.items()),
    ],
}  # fmt: skip
ROWS = SCENE["grid"]["rows"]
# Changes the words of a row in place: board, row, int16 [chirp, sample, 2, rx].
Mangle = Callable[[str, int, np.ndarray], None]


class Mangled:
    """A source whose words or cubes are changed while they are read."""

    def __init__(self, source: Any, mangle: Mangle) -> None:
        self._source = source
        self._mangle = mangle

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def read_row(self, board: str, row: int) -> RowData | CubeRow:
        recorded = self._source.read_row(board, row)
        if isinstance(recorded, CubeRow):
            cube = recorded.cube.copy()
            self._mangle(board, row, cube.transpose(1, 2, 0)[:, :, None])
            return replace(recorded, cube=cube)
        chirp = self.instrument.chirp
        words = recorded.payload.copy().view(np.int16).reshape(-1, chirp.samples, 2, 4)
        self._mangle(board, row, words)
        return replace(recorded, pieces=split_pieces(words.reshape(-1).view(np.uint8)))


def compute_distances(source: Any, findings: Findings) -> list[float]:
    """Return for each patch the squared distance of its permittivity from the truth, in standard deviations."""
    scene = decode_scene(SCENE, "test")
    plates = read_true_plates(truth(source.instrument, scene, scene.seed))
    plates_of_patches = match_truth([result.patch for result in findings.analysis.patches], plates)
    squared_distances = []
    for result in findings.analysis.patches:
        estimate = result.permittivity
        plate = plates_of_patches.get(result.patch.label)
        if estimate.value is not None and plate is not None and plate.permittivity is not None:
            error = estimate.value - plate.permittivity
            error_parts = np.array([error.real, error.imag])
            covariance = np.array(estimate.covariance)
            squared_distances.append(float(error_parts @ np.linalg.solve(covariance, error_parts)))
    return squared_distances


ProcessMangled = Callable[..., tuple[Pipeline, Images, Findings]]


def make_processor(source: Source) -> ProcessMangled:
    """Return a function that processes the scan, with its words changed by `mangle`, or another source `of`.

    It returns pipeline, images and findings. A scan without changes is processed once.
    """
    processed: dict[Any, tuple[Pipeline, Images, Findings]] = {}

    def make(mangle: Mangle | None, of: Source = source) -> tuple[Pipeline, Images, Findings]:
        pipeline = make_pipeline(Mangled(of, mangle) if mangle else of)  # type: ignore[arg-type]
        images = pipeline.form_images()
        return pipeline, images, pipeline.examine(images)

    def process_once(mangle: Mangle | None = None, of: Source = source) -> tuple[Pipeline, Images, Findings]:
        if mangle is not None:
            return make(mangle, of)
        if of not in processed:
            processed[of] = make(None, of)
        return processed[of]

    return process_once
