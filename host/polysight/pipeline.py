"""The whole flow on one screen: recorded rows -> synchronised rows -> images -> plane -> materials -> verdict."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from polysight import calibration, imaging, materials, polarimetry, process, store, sync
from polysight.process import Progress, no_progress
from polysight.settings import DEFAULT, Settings


class Pipeline:
    """Processes one scan: add its rows, in any order, then `finish`. `live` and `samples` as of `KeptSamples`."""

    def __init__(
        self,
        source: store.Source,
        settings: Settings = DEFAULT,
        inputs: process.Inputs = process.NO_INPUTS,
        *,
        live: bool = False,
        samples: process.Use = "none",
    ) -> None:
        self.source, self.settings, self.inputs = source, settings, inputs
        self.calibration = calibration.calibration_of_scan(source)
        rig = self.calibration.rig(source.instrument)
        filters, self.plane = self.calibration.high_passes(rig), imaging.UNKNOWN_PLANE
        self.synchroniser = sync.RowSynchroniser(source, rig, filters)
        self.quality = process.Quality(rig, source, self.calibration.facts())
        kept = process.KeptSamples(source, rig, filters, self.quality, settings, live=live, samples=samples)
        self.samples, self.images, self.sub_bands = kept, kept.images, kept.sub_bands
        self.rig = store.mirrored(self.images.rig) if source.mirrored else self.images.rig  # x from TX to RX

    def add_row(self, row: int) -> None:
        """Add one row of every board to the images: from kept samples, or from raw data."""
        if not self.samples.restore(row):
            self.synchronise_row(row)
            self.samples.save(row)

    def synchronise_row(self, row: int) -> dict[str, sync.SyncedRow]:
        """Read, synchronise and reduce one row of every board for the images; return the synchronised rows."""
        return process.map_boards(self.quality.boards, lambda board: self._synchronise(board, row), self.images.live)

    def _synchronise(self, board: str, row: int) -> sync.SyncedRow:
        with self.quality.timed("read and synchronise"):
            recorded = self.source.read_row(board, row)
            synced, frames_whole = self.synchroniser.synchronise(board, recorded)
        with self.quality.timed("reduce"):
            self.images.add_row(board, row, synced)
            self.sub_bands.add_row(board, row, synced)
        self.quality.boards[board].add(row, recorded, frames_whole, synced)
        return synced

    def form_images(self, from_sums: bool = False) -> imaging.Images:
        """Form both images on the rig file's plane, divided by the footprint, not referenced; `from_sums`: live."""
        if self.settings.sparse and not from_sums:
            self.sub_bands = self.samples.fill_missing()
        with self.quality.timed("image"):
            images = self.images.current() if from_sums else self.samples.filled.finish()
        self.quality.note(**self.synchroniser.recording_facts())
        return images.transposed() if self.source.mirrored else images

    def place_plane(self, images: imaging.Images, move: bool = True) -> imaging.Images:
        """Estimate the plane of the plates; return the images on it (unchanged if `move` is False)."""
        with self.quality.timed("plane"):
            masks, swapped = materials.insides(images), self.source.mirrored
            self.plane, images = imaging.move_to_plane(self.samples.filled, images, masks, swapped, move)
        return images

    def find_materials(
        self,
        images: imaging.Images,
        known: materials.KnownScene | None = None,
        classifier: materials.Classifier | None = None,
    ) -> materials.MaterialsResult:
        """Find patches (unless known), metal reference, permittivities and names; in sub-bands too, if imaged."""
        with self.quality.timed("materials"):
            rig, std = self.plane.applied_to(self.rig), self.plane.incidence_std_rad(self.rig)
            angles = polarimetry.incidence_choice(rig, images.x_m, images.y_m, self.settings.incidence)
            optics = materials.Optics.of(self.rig, angles, std, self.synchroniser.direct_path_known)
            found = materials.analyse(images, optics, known, classifier)
            plane = None if known is None else known.plane
            self.quality.note_materials(found, angles, images.valid, plane)
        with self.quality.timed("sub-bands"):
            parts = self.sub_bands.finish(self.source.mirrored, self.plane.moved_m)
            return materials.with_bands(found, self.sub_bands.bands, parts, optics, plane) if parts else found

    def examine(self, images: imaging.Images, plates: materials.Plates = ()) -> process.Findings:
        """Find plane and materials, and judge them; a verdict "no result" removes names and permittivities."""
        classifier = process.load_classifier(self.settings, self.rig)
        known = process.boxes_as_patches(self.settings, self.inputs, images.x_m, images.y_m)
        given, bands = self.inputs.reference, self.settings.bands
        plane = self.calibration.metal_plane(self.rig, given, known.metal is not None, bands)
        images = self.place_plane(images)
        if plane is not None:
            images = images.within(plane.valid_on(images.x_m, images.y_m))
            known = replace(known, metal=plane)
        found = self.find_materials(images, replace(known, plates=plates), classifier)
        verdict = process.judge(self.quality, found, self.plane, classifier, self.rig.check)
        shown = found if verdict.usable else found.without_result()
        return process.Findings(images, shown, verdict, self.plane, classifier, plates)

    def finish(self, out: Path, plates: materials.Plates = (), progress: Progress = no_progress) -> process.Products:
        """Write all products into `out`: images first, so that they stay if a later step fails."""
        images = self.form_images()
        process.save_images(out, process.imaged_scan(out, self.source, self.rig, images, self.quality))
        progress("point response")
        self.quality.note_imaging(self.images, images)
        progress("materials")
        findings = self.examine(images, plates)
        progress("figures and report")
        unnamed = process.why_unnamed(self.settings, self.rig)
        scan = process.processed_scan(out, self.source, self.rig, findings, self.quality, unnamed)
        return process.save_materials(out, scan, findings.found, unnamed)
