"""From recorded rows to results in memory: the only file of this package that knows the pipeline."""

from __future__ import annotations

import warnings
from functools import cached_property
from pathlib import Path

from polysight.imaging import Images
from polysight.materials import find_truth
from polysight.pipeline import Pipeline
from polysight.process import imaged_scan, processed_scan, why_unnamed
from polysight.products import ProcessedScan
from polysight.settings import Settings
from polysight.store import Source


class Processing:
    """Processes one source; each step runs once, when its result is first used.

    `folder` is where the source was read; `truth.json` there holds the truth of a simulated scene.
    """

    def __init__(self, source: Source, folder: Path, settings: Settings) -> None:
        self.source, self.folder, self.settings = source, folder, settings

    @cached_property
    def pipeline(self) -> Pipeline:
        """The pipeline, without rows at first. Raises PolysightError when calibration and rig do not fit."""
        return Pipeline(self.source, self.settings, samples="read")

    @cached_property
    def _images(self) -> Images:
        """Both channels from all rows that hold data. Raises DataError when there are none."""
        for row in self.pipeline.samples.processable(self.source, self.folder):
            self.pipeline.add_row(row)
        images = self.pipeline.form_images()
        self.pipeline.quality.note_imaging(self.pipeline.images, images)
        return images

    @cached_property
    def unreferenced(self) -> ProcessedScan:
        """Images in arbitrary units, as `polysight image` writes them. Raises PolysightError."""
        pipeline = self.pipeline
        return imaged_scan(self.folder, self.source, pipeline.rig, self._images, pipeline.quality)

    @cached_property
    def referenced(self) -> ProcessedScan:
        """Images relative to metal, patches and materials, as `polysight process` writes them.

        Raises
        ------
        DataError
            when no metal is found, a row is damaged, or library or metal reference do not fit the scan.
        """
        pipeline = self.pipeline
        unnamed = why_unnamed(self.settings, pipeline.rig)
        plates, note = find_truth(self.folder)
        if note:
            warnings.warn(note, stacklevel=2)
        findings = pipeline.examine(self._images, plates)
        return processed_scan(self.folder, self.source, pipeline.rig, findings, pipeline.quality, unnamed)
