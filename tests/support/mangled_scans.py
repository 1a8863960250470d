"""A small scan of six plates, whose recorded samples are changed while they are read: the radar had a fault.

A scan is read from raw rows (int16 words of I and Q), or from cubes of synchronised samples.
"""

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

# Name of each dielectric plate to its centre in millimetres and its permittivity eps', eps''
PLATES = {
    "ceramic": ([-62.0, 32.0], [4.75, 2.43]), "acrylic": ([0.0, 34.0], [4.0, 0.4]), "PET": ([62.0, 32.0], [3.78, 0.7]),
    "wood": ([-62.0, -32.0], [2.61, 0.01]), "rubber": ([62.0, -32.0], [5.06, 1.11]),
}  # fmt: skip
SCENE: dict[str, Any] = {
    "name": "small", "seed": 5, "burst": {"pulses": 4}, "image": {"columns": 110, "rows": 86},
    "grid": {"columns": 43, "rows": 41, "step_x_mm": 10.0, "step_y_mm": 6.0},
    "plates": [
        {"name": "metal", "centre_mm": [0.0, -34.0], "size_mm": [46.0, 46.0], "metal": True},
        *(
            {"name": name, "centre_mm": centre_mm, "size_mm": [46.0, 46.0], "permittivity": permittivity}
            for name, (centre_mm, permittivity) in PLATES.items()
        ),
    ],
}  # fmt: skip
ROWS = SCENE["grid"]["rows"]
# A function that changes the samples of a row in place. Its arguments are the board, the row, and the samples: int16
# [chirp, sample, I or Q, RX] of raw rows, complex [chirp, sample, 1, RX] of cubes.
Mangle = Callable[[str, int, np.ndarray], None]


class Mangled:
    """A source of rows, whose samples `mangle` changes while they are read."""

    def __init__(self, source: Any, mangle: Mangle) -> None:
        self._source = source
        self._mangle = mangle

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def read_row(self, board: str, row: int) -> RowData | CubeRow:
        recorded = self._source.read_row(board, row)
        if isinstance(recorded, CubeRow):
            cube = recorded.cube.copy()
            # [RX, chirp, sample] as a view [chirp, sample, 1, RX]
            view = cube.transpose(1, 2, 0)[:, :, None]
            self._mangle(board, row, view)
            return replace(recorded, cube=cube)
        samples = self.instrument.chirp.samples
        words = recorded.payload.copy().view(np.int16).reshape(-1, samples, 2, 4)
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
    """Return a function that processes this source or another one (`of`), with its samples changed by `mangle`.

    It returns pipeline, images and findings. A source without changes is processed only once.
    """
    processed: dict[Any, tuple[Pipeline, Images, Findings]] = {}

    def process(source: Any) -> tuple[Pipeline, Images, Findings]:
        pipeline = make_pipeline(source)
        images = pipeline.form_images()
        return pipeline, images, pipeline.examine(images)

    def process_once(mangle: Mangle | None = None, of: Source = source) -> tuple[Pipeline, Images, Findings]:
        if mangle is not None:
            return process(Mangled(of, mangle))
        if of not in processed:
            processed[of] = process(of)
        return processed[of]

    return process_once
