"""The whole flow on one screen: recorded rows -> synchronised rows -> images -> plane -> materials -> verdict."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from polysight import calibration, imaging, materials, polarimetry, process, store, sync
from polysight.process import Progress, no_progress
from polysight.settings import DEFAULT, Settings


class Pipeline:
    """Processes a scan: add its rows, then call `finish`. If `live`, images of the rows so far can be formed, too."""

    def __init__(
        self,
        source: store.Source,
        settings: Settings = DEFAULT,
        inputs: process.Inputs = process.NO_INPUTS,
        *,
        live: bool = False,
        samples: process.SampleUse = "none",  # "read": use kept samples if there are any; "keep": and save the others
    ) -> None:
        self.source = source
        self.settings = settings
        self.inputs = inputs
        self.calibration = calibration.load_scan_calibration(source)
        rig = self.calibration.rig(source.instrument)
        filters = self.calibration.high_passes(rig)
        self.plane = imaging.UNKNOWN_PLANE
        self.synchroniser = sync.RowSynchroniser(source, rig, filters)
        self.quality = process.Quality(rig, source, self.calibration.list_sources())
        self.samples = process.KeptSamples(source, rig, filters, self.quality, settings, live=live, samples=samples)
        self.builder = self.samples.builder
        self.sub_bands = self.samples.sub_bands
        self.rig = self.builder.rig
        # Images of a mirrored scan are transposed, so that x runs from TX to RX: the rig follows them.
        if source.mirrored:
            self.rig = store.mirror_rig(self.rig)

    def add_row(self, row: int) -> None:
        """Add one row of every board to the images: from kept samples, or from raw data."""
        if not self.samples.restore(row):
            self.synchronise_row(row)
            self.samples.save(row)

    def synchronise_row(self, row: int) -> dict[str, sync.SyncedRow]:
        """Read, synchronise and reduce one row of every board for the images; return the synchronised rows."""
        return process.map_boards(self.quality.boards, lambda b: self._synchronise(b, row), parallel=self.builder.live)

    def _synchronise(self, board: str, row: int) -> sync.SyncedRow:
        with self.quality.measure_time("read and synchronise"):
            recorded = self.source.read_row(board, row)
            synced, frames_whole = self.synchroniser.synchronise(board, recorded)
        with self.quality.measure_time("reduce"):
            self.builder.add_row(board, row, synced)
            self.sub_bands.add_row(board, row, synced)
        self.quality.boards[board].add(row, recorded, frames_whole, synced)
        return synced

    def form_images(self, from_sums: bool = False) -> imaging.Images:
        """Form the images of H and V on the plane of the rig file; `from_sums`: from the sums of a live scan."""
        if self.settings.sparse and not from_sums:
            # The images are then formed from `samples.filled`, in which missing positions are reconstructed.
            self.sub_bands = self.samples.fill_missing()
        with self.quality.measure_time("image"):
            if from_sums:
                images = self.builder.current()
            else:
                images = self.quality.form_images(self.samples.filled, self.sub_bands.builders)
        self.quality.add_entries(**self.synchroniser.recording_facts())
        return images.transpose() if self.source.mirrored else images

    def place_plane(self, images: imaging.Images, move: bool = True) -> imaging.Images:
        """Estimate the plane of the plates; return the images on it (unchanged if `move` is False)."""
        with self.quality.measure_time("plane"):
            masks = materials.find_interiors(images)
            self.plane, images = imaging.move_to_plane(self.samples.filled, images, masks, self.source.mirrored, move)
        return images

    def find_materials(
        self,
        images: imaging.Images,
        known_scene: materials.KnownScene | None = None,
        classifier: materials.Classifier | None = None,
    ) -> materials.MaterialsResult:
        """Find patches (unless known), metal reference, permittivities and names; in sub-bands too, if imaged."""
        with self.quality.measure_time("materials"):
            rig = self.plane.apply_to_rig(self.rig)
            angle_std = self.plane.incidence_std_rad(self.rig)
            axes = images.x_m, images.y_m
            incidence = polarimetry.incidence_choice(rig, *axes, self.settings.incidence, images.raised_m)
            optics = materials.Optics.from_rig(self.rig, incidence, angle_std, self.synchroniser.direct_path_known)
            optics = replace(optics, phase_left_rad=self.quality.phase_left_rad)
            result = materials.analyse(images, optics, known_scene, classifier)
            # Gains of H and V at each pixel, if a metal plate was scanned separately.
            metal_gains = None if known_scene is None else known_scene.plane
            self.quality.add_materials(result, incidence, images.valid, metal_gains)
        with self.quality.measure_time("sub-bands"):
            band_images = self.sub_bands.finish(self.source.mirrored, self.plane.form_images)
            if band_images:
                result = materials.add_bands(result, self.sub_bands.bands, band_images, optics, metal_gains)
        return result

    def examine(self, images: imaging.Images, plates: materials.Plates = ()) -> process.Findings:
        """Find plane and materials, and judge them; `plates`: the true ones. Without a result there are no names."""
        classifier = process.load_classifier(self.settings, self.rig)
        scene = process.convert_boxes_to_patches(self.settings, self.inputs, images.x_m, images.y_m)
        has_metal = scene.metal is not None
        metal_gains = self.calibration.metal_plane(self.rig, self.inputs.reference, has_metal, self.settings.bands)
        images = self.place_plane(images)
        if metal_gains is not None:
            # Only pixels whose gain the scan of the metal plate has measured can be judged.
            images = images.limit_to_area(metal_gains.valid_on(images.x_m, images.y_m))
            scene = replace(scene, metal=metal_gains)
        result = self.find_materials(images, replace(scene, plates=plates), classifier)
        verdict = process.judge(self.quality, result, self.plane, classifier, self.rig.check)
        if not verdict.usable:
            result = result.without_result()
        return process.Findings(images, result, verdict, self.plane, classifier, plates)

    def finish(self, out: Path, plates: materials.Plates = (), progress: Progress = no_progress) -> process.Products:
        """Write all products into `out`: images first, so that they stay if a later step fails."""
        images = self.form_images()
        process.save_images(out, process.collect_imaged_scan(out, self.source, self.rig, images, self.quality))
        progress("point response")
        self.quality.note_imaging(self.builder, images)
        progress("materials")
        findings = self.examine(images, plates)
        progress("figures and report")
        why_unnamed = process.explain_unnamed(self.settings, self.rig)
        scan = process.collect_processed_scan(out, self.source, self.rig, findings, self.quality, why_unnamed)
        return process.save_materials(out, scan, findings.analysis, why_unnamed)
