"""The whole flow on one screen: recorded rows -> synchronised rows -> images -> polarimetry -> materials -> report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from host.capture.decode import row_words
from host.imaging import ChannelImages, ImageBuilder
from host.imaging.facts import imaging_facts
from host.materials import Classifier, Library, MaterialsResult, TruthPlate, analyse, pixel_accuracy
from host.materials.segment import Box, Segmentation
from host.polarimetry import incidence_map
from host.products import Products, write_images, write_materials, write_quality
from host.quality import Quality
from host.store.source import ScanSource
from host.sync.chain import BoardSetup, synchronise_row

LIBRARY = Path(__file__).parent / "materials" / "simulated-library.npz"


@dataclass(frozen=True)
class Options:
    """What the user may choose: where the metal is (else it is found), and the classifier's library."""

    metal_box_mm: Box | None = None
    library: Path | None = None


class Pipeline:
    """Processes one scan, row by row as they are committed, then to the end.

    With `live`, the images so far can be looked at after every row at next to no cost (`images.current()`).
    `depth_m` keeps what lies that much nearer or farther than the rig file says, for autofocus.
    """

    def __init__(self, source: ScanSource, live: bool = False, depth_m: float = 0.0) -> None:
        rig = source.instrument
        self.source = source
        self.setups = {board.name: BoardSetup.of(rig, board) for board in rig.receivers}
        self.images = ImageBuilder(rig, live=live, depth_m=depth_m)
        self.quality = Quality(rig)
        self.quality_notes: dict[str, Any] = {}

    def add_row(self, row: int) -> None:
        """Decode, compensate the filter, align the bursts, reference to the direct path, reduce for the image."""
        chirp = self.source.instrument.chirp
        for board, setup in self.setups.items():
            with self.quality.timed("read and decode"):
                recorded = self.source.read_row(board, row)
                frames, valid = row_words(recorded.payload, recorded.missing, recorded.frames_expected, chirp.samples)
            with self.quality.timed("synchronise"):
                synced = synchronise_row(frames, valid, setup)
            with self.quality.timed("reduce"):
                self.images.add_row(board, row, synced)
            self.quality.boards[board].add(row, recorded, int(valid.sum()), synced)

    def form_images(self) -> ChannelImages:
        """Both channels, flattened by their footprint, not yet referenced to metal."""
        with self.quality.timed("image"):
            images = self.images.finish()
        with self.quality.timed("point response"):
            self.quality_notes["imaging"] = imaging_facts(self.images, images)
        return images

    def find_materials(
        self,
        images: ChannelImages,
        metal_box_mm: Box | None = None,
        classifier: Classifier | None = None,
        plates: tuple[TruthPlate, ...] = (),
        segmentation: Segmentation | None = None,
    ) -> MaterialsResult:
        """Patches (found, unless given), metal reference, leakage, permittivity, names."""
        rig = self.source.instrument
        with self.quality.timed("materials"):
            return analyse(
                images.h,
                images.v,
                images.x_m,
                images.y_m,
                images.valid,
                theta_rad=incidence_map(rig, images.x_m, images.y_m),
                classifier=classifier,
                metal_box_mm=metal_box_mm,
                leakage=(complex(*rig.polarimetry.leakage_h), complex(*rig.polarimetry.leakage_v)),
                smooth_px=rig.polarimetry.smooth_px,
                plates=plates,
                segmentation=segmentation,
            )

    def finish(self, out: Path, options: Options, plates: tuple[TruthPlate, ...] = ()) -> Products:
        """Images, materials and report into `out`. The images are written even when no metal reference is found."""
        library = Library.load(options.library or LIBRARY)
        images = self.form_images()
        write_images(out, images)
        write_quality(out, self.quality.to_dict(**self.quality_notes))
        found = self.find_materials(images, options.metal_box_mm, Classifier(library), plates)
        quality = self.quality.to_dict(pixel_accuracy=pixel_accuracy(found), **self.quality_notes)
        return write_materials(out, self.source, images, found, library, quality, plates)
