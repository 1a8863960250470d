"""The whole flow in one file: recorded rows -> synchronised rows -> images -> polarimetry -> materials -> report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.host.calibration.active import of_scan
from polysight.host.capture.decode import row_words
from polysight.host.imaging import ChannelImages, ImageBuilder
from polysight.host.imaging.gain_conditions import ImagedWith
from polysight.host.imaging.images import SubBandImages
from polysight.host.imaging.resolution import imaging_facts
from polysight.host.materials import Classifier, MaterialsResult, TruthPlate, analyse, pixel_accuracy
from polysight.host.materials.analyse import permittivity_change
from polysight.host.materials.segment import Box, Segmentation
from polysight.host.materials.sub_bands import band_rows
from polysight.host.polarimetry import Incidence, PlaneReference, incidence_choice
from polysight.host.process.quality import Quality
from polysight.host.process.request import Options
from polysight.host.process.save import Products, write_images, write_materials, write_quality
from polysight.host.products.files import write_scan_facts
from polysight.host.store.scan_folder import ScanFolder
from polysight.host.store.sources.published import AuthorsCube
from polysight.host.store.sources.published_settings import mirrored
from polysight.host.store.sources.source import RowData, ScanSource
from polysight.host.sync.chain import BoardSetup, SyncedRow, synchronise_row
from polysight.host.sync.synchronised import CubeReader
from polysight.shared.config import Instrument


class Pipeline:
    """Processes one scan, row by row as they are committed, then to the end.

    With `live`, the images so far can be looked at after every row at next to no cost (`images.current()`).
    `depth_m` keeps what lies that much nearer or farther than the rig file says, for autofocus. With `bands` above 1
    that many sub-bands of the sweep are imaged too.
    """

    def __init__(
        self, source: ScanSource | AuthorsCube, live: bool = False, depth_m: float = 0.0, bands: int = 1
    ) -> None:
        self.calibration = of_scan(source)
        rig = self.calibration.rig(source.instrument)
        self.source = CubeReader(source) if isinstance(source, AuthorsCube) else source
        self.by_columns = getattr(source, "by_columns", False)  # its rig is the mirrored one, and so is its image
        self.setups = {b.name: BoardSetup.of(rig, b, model=self.calibration.high_pass(b.name)) for b in rig.receivers}
        self.images = ImageBuilder(rig, live=live, depth_m=depth_m)
        self.sub_bands = SubBandImages(rig, bands) if bands > 1 else None
        self.quality = Quality(rig)
        self.quality_notes: dict[str, Any] = {}

    def add_row(self, row: int) -> dict[str, SyncedRow]:
        """Decode, compensate the filter, align the bursts, reference to the direct path, reduce for the image.

        Returns each board's synchronised row, for who wants to look at it.
        """
        made: dict[str, SyncedRow] = {}
        for board, setup in self.setups.items():
            recorded, frames_valid, synced = self._synchronised(board, row, setup)
            with self.quality.timed("reduce"):
                self.images.add_row(board, row, synced)
                if self.sub_bands is not None:
                    self.sub_bands.add_row(board, row, synced)
            self.quality.boards[board].add(row, recorded, frames_valid, synced)
            made[board] = synced
        return made

    def _synchronised(self, board: str, row: int, setup: BoardSetup) -> tuple[RowData, int, SyncedRow]:
        """A row as recorded, how many of its frames are whole, and what synchronisation makes of it.

        A cube was synchronised by its maker; only its form is brought to ours.
        """
        if isinstance(self.source, CubeReader):
            with self.quality.timed("read and decode"):
                synced = self.source.row(board, row)
            return RowData.none(synced.valid.size), int(synced.valid.sum()), synced
        with self.quality.timed("read and decode"):
            recorded = self.source.read_row(board, row)
            samples = self.source.instrument.chirp.samples
            frames, valid = row_words(recorded.payload, recorded.missing, recorded.frames_expected, samples)
        with self.quality.timed("synchronise"):
            return recorded, int(valid.sum()), synchronise_row(frames, valid, setup)

    @property
    def rig(self) -> Instrument:
        """The rig of the images, x from TX to RX: the source's, mirrored back where it was scanned by columns."""
        rig = self.calibration.rig(self.source.instrument)
        return mirrored(rig) if self.by_columns else rig

    @property
    def axes_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Pixel centres of the images, x and y, ascending."""
        grid = self.images.grid
        return (grid.y_m, grid.x_m) if self.by_columns else (grid.x_m, grid.y_m)

    @property
    def imaged_with(self) -> ImagedWith:
        """What the gains of these images depend on: metal is their reference only where it was imaged with the same."""
        return self.calibration.imaged_with(self.rig)

    def metal_reference(self, options: Options, in_scene: bool = False) -> PlaneReference | None:
        """Metal scanned on its own: what was asked for, or what the scan was calibrated with; None: the scene's own.

        `in_scene` says that a box drawn by hand names metal, which then comes before the calibration.

        Raises
        ------
        DataError
            when it was imaged with another rig, or without the sub-bands that are asked for.
        """
        reference, name = options.reference, "the metal reference"
        if reference is None and options.metal_box_mm is None and not in_scene:
            reference, name = self.calibration.reference(), self.calibration.name_of("metal")
        if reference is not None:
            reference.check_rig(self.imaged_with, name)
            reference.check_bands(options.bands, name)
        return reference

    def form_images(self) -> ChannelImages:
        """Both channels, flattened by their footprint, not yet referenced to metal."""
        with self.quality.timed("image"):
            images = self.images.finish()
        if in_force := self.calibration.facts():
            self.quality_notes["calibration"] = in_force
        with self.quality.timed("point response"):
            self.quality_notes["imaging"] = imaging_facts(self.images, images)
        if recording := getattr(self.source, "recording", None):
            self.quality_notes["recording"] = recording()
        if isinstance(self.source, ScanFolder):
            self.quality_notes |= self.source.retaken()
        return images.transposed() if self.by_columns else images

    def find_materials(
        self,
        images: ChannelImages,
        metal_box_mm: Box | None = None,
        classifier: Classifier | None = None,
        plates: tuple[TruthPlate, ...] = (),
        segmentation: Segmentation | None = None,
        metal_label: int | None = None,
        reference: PlaneReference | None = None,
        incidence: Incidence = "one",
    ) -> MaterialsResult:
        """Patches (found, unless given), metal reference, leakage, permittivity, names; sub-bands where imaged."""
        rig = self.rig
        leakage = (complex(*rig.polarimetry.leakage_h), complex(*rig.polarimetry.leakage_v))
        with self.quality.timed("materials"):
            angles = incidence_choice(rig, images.x_m, images.y_m, incidence)
            found = analyse(
                images.h,
                images.v,
                images.x_m,
                images.y_m,
                images.valid,
                theta_rad=angles.used_rad,
                classifier=classifier,
                metal_box_mm=metal_box_mm,
                metal_label=metal_label,
                leakage=leakage,
                smooth_px=rig.polarimetry.smooth_px,
                plates=plates,
                segmentation=segmentation,
                reference=reference,
            )
            self.quality_notes["incidence"] = {**angles.facts(images.valid), **permittivity_change(found, angles)}
        if reference is not None:
            self.quality_notes["metal_reference"] = reference.facts()
        if self.sub_bands is None:
            return found
        with self.quality.timed("sub-bands"):
            parts = reference.bands if reference is not None else None
            bands = self.sub_bands.bands
            rows = band_rows(found, bands, self.band_images(), leakage, rig.polarimetry.smooth_px, parts)
        return replace(found, bands=rows)

    def band_images(self) -> tuple[ChannelImages, ...]:
        """Both channels in every sub-band, flattened; none when they were not asked for."""
        made = self.sub_bands.finish() if self.sub_bands is not None else ()
        return tuple(images.transposed() for images in made) if self.by_columns else made

    def finish(self, out: Path, options: Options, plates: tuple[TruthPlate, ...] = ()) -> Products:
        """Images, materials and report into `out`. The images are written even when no metal reference is found."""
        images = self.form_images()
        write_images(out, images)
        write_scan_facts(out, self.source, self.rig, images)
        write_quality(out, self.quality.to_dict(**self.quality_notes))
        classifier = options.classifier(self.rig)
        boxes, names, metal = options.drawn(images.x_m, images.y_m)
        reference = self.metal_reference(options, metal is not None)
        if reference is not None:
            reference.check_axes(images.x_m, images.y_m)
            images = replace(images, valid=images.valid & reference.valid)
        found = self.find_materials(
            images,
            options.metal_box_mm,
            classifier,
            plates,
            segmentation=boxes,
            metal_label=metal,
            reference=reference,
            incidence=options.incidence,
        )
        found = replace(found, boxes=names)
        quality = self.quality.to_dict(pixel_accuracy=pixel_accuracy(found), **self.quality_notes)
        unnamed = options.unnamed(self.rig)
        return write_materials(out, self.source, images, found, classifier, quality, plates, self.rig, unnamed)
