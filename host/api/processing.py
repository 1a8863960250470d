"""From recorded rows to results in memory: the only file of this package that knows the pipeline."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import numpy as np

from polysight.host.imaging import ChannelImages
from polysight.host.materials import pixel_accuracy, read_truth
from polysight.host.pipeline import Pipeline
from polysight.host.polarimetry import ratio
from polysight.host.process.request import Options
from polysight.host.process.save import materials_content
from polysight.host.products.datasets import ProcessedScan
from polysight.host.products.files import plain, scan_facts
from polysight.host.store.raw import require_raw
from polysight.host.store.scan_folder import ScanFolder
from polysight.host.store.sources.published import AuthorsCube
from polysight.host.store.sources.source import ScanSource
from polysight.shared.errors import DataError, advice

Source = ScanSource | AuthorsCube


class Processing:
    """Processes one source; each step is done once, when its result is first asked for.

    Parameters
    ----------
    source
        Recorded scan.
    folder
        Where it was read; `truth.json` there holds the truth of a simulated scene.
    options
        Library, model, metal box, sub-bands, incidence.
    """

    def __init__(self, source: Source, folder: Path, options: Options) -> None:
        self.source, self.folder, self.options = source, folder, options

    @cached_property
    def pipeline(self) -> Pipeline:
        """The pipeline, without rows at first. Raises PolysightError when calibration and rig do not fit."""
        return Pipeline(self.source, bands=self.options.bands)

    @cached_property
    def _images(self) -> ChannelImages:
        """Both channels from all rows that hold data. Raises DataError when there are none."""
        if isinstance(self.source, ScanFolder):
            require_raw(self.source)
        rows = list(self.source.rows())
        if not rows:
            raise DataError(
                f"{self.folder}: no row is recorded whole",
                "the scan was stopped in its first row, or files are missing",
                f"`polysight resume {self.folder}` takes the missing rows of a scan folder",
            )
        for row in rows:
            self.pipeline.add_row(row)
        return self.pipeline.form_images()

    @cached_property
    def unreferenced(self) -> ProcessedScan:
        """Images in arbitrary units, as `polysight image` writes them. Raises PolysightError."""
        images, none = self._images, np.zeros(self._images.h.shape, np.int32)
        pixels = {"h": images.h, "v": images.v, "p": ratio(images.h, images.v), "valid": images.valid}
        return self._processed(images, pixels, {}, none, None)

    @cached_property
    def referenced(self) -> ProcessedScan:
        """Images relative to metal, patches and materials, as `polysight process` writes them.

        Raises
        ------
        DataError
            when no metal is found, a row is damaged, or library or metal reference do not fit the scan.
        """
        pipeline, options = self.pipeline, self.options
        classifier, unnamed = options.classifier(pipeline.rig), options.unnamed(pipeline.rig)
        reference = pipeline.metal_reference(options)
        images, truth = self._images, self.folder / "truth.json"
        plates = read_truth(truth) if truth.exists() else ()
        try:
            found = pipeline.find_materials(
                images,
                options.metal_box_mm,
                classifier,
                plates,
                reference=reference,
                incidence=options.incidence,
            )
        except DataError as e:
            raise DataError(e.what, e.why, advice(e.remedy, "metal_referenced=False shows images without")) from e
        pipeline.quality_notes["pixel_accuracy"] = pixel_accuracy(found)
        valid = images.valid if reference is None else images.valid & reference.valid
        c, labels = found.calibrated, found.segmentation.labels
        interior = np.zeros(labels.shape, bool)
        for patch in found.segmentation.patches:
            interior |= patch.interior
        materials = plain(materials_content(self.source, found, classifier, unnamed))
        return self._processed(images, {"h": c.h, "v": c.v, "p": c.p, "valid": valid}, materials, labels, interior)

    def _processed(self, images: ChannelImages, pixels, materials, labels, interior) -> ProcessedScan:
        return ProcessedScan(
            {**pixels, "x_m": images.x_m, "y_m": images.y_m},
            plain(scan_facts(self.source, self.pipeline.rig, images)),
            plain(self.pipeline.quality.to_dict(**self.pipeline.quality_notes)),
            materials,
            labels,
            interior,
        )
