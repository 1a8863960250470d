"""Measure curved and tilted surfaces in the rows of a scan: specular points, gains, analysis, names, and the files.

`polysight surface` uses these functions, and so does `polysight process` if a patch is neither flat nor level.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from polysight import surfaces
from polysight.calibration import SphereFile
from polysight.imaging import BoardSamples
from polysight.materials import STEEP_FINDING, Classifier, name_permittivity
from polysight.pipeline import Pipeline
from polysight.process import load_classifier
from polysight.products import QUALITY, read_products, write_json
from polysight_shared.config import Instrument
from polysight_shared.files import write_atomically

# Largest number of points of the metal sphere that the calibration file keeps; chosen.
KEPT_POINTS = 240
# Standard error of antenna places that were measured by hand; assumed.
PLACE_STD_M = 1e-3
# Standard error of antenna places that `calibrate direct-path` measured; assumed.
CALIBRATED_PLACE_STD_M = 3e-4


def take_samples(pipeline: Pipeline) -> tuple[surfaces.Samples, surfaces.Samples]:
    """Return the samples of H and V that a pipeline holds; their x axis points from TX to RX."""
    h, v = (take_board_samples(board, pipeline.source.mirrored) for board in pipeline.builder.boards.values())
    return h, v


def take_board_samples(board: BoardSamples, is_mirrored: bool) -> surfaces.Samples:
    """Return the samples of one board; a scan recorded by columns is held mirrored in x = y."""
    antennas = board.aperture.antennas
    used_rx = board.used_rx
    samples = surfaces.Samples(
        cube=board.calibrate_samples()[used_rx],
        valid=board.usable,
        offsets_m=board.aperture.offsets_m,
        frequencies_hz=board.aperture.frequencies_hz,
        tx_m=antennas.tx_m,
        rx_m=antennas.rx_m[used_rx],
        model=board.model,
        board_middle_m=antennas.rx_m.mean(axis=0),
    )
    if not is_mirrored:
        return samples
    # The pipeline holds x and y exchanged; z stays. The cube is [rx, frequency, row, column].
    swap = [1, 0, 2]
    return replace(
        samples,
        cube=np.swapaxes(samples.cube, 2, 3),
        valid=samples.valid.T,
        offsets_m=np.swapaxes(samples.offsets_m, 0, 1)[..., swap],
        tx_m=samples.tx_m[swap],
        rx_m=samples.rx_m[:, swap],
        board_middle_m=antennas.rx_m.mean(axis=0)[swap],
    )


def find_uncertainty(rig: Instrument, *, places_known: bool) -> surfaces.Uncertainty:
    """Return the standard errors of a rig: of its leakage, of the antennas' axes and of their places."""
    polarimetry = rig.polarimetry
    # The prior is the rms of |leakage|; the standard deviation of its real and of its imaginary part is smaller by
    # sqrt(2).
    leakage = polarimetry.leakage_prior / np.sqrt(2)
    if polarimetry.leakage_std is not None:
        leakage = polarimetry.leakage_std
    place_std_m = CALIBRATED_PLACE_STD_M if places_known else PLACE_STD_M
    return surfaces.Uncertainty(float(leakage), float(np.radians(polarimetry.axis_std_deg)), place_std_m)


def make_rig_optics(rig: Instrument) -> surfaces.Optics:
    """Return the antennas of a rig with its leakage, if measured."""
    polarimetry = rig.polarimetry
    if polarimetry.leakage_std is None:
        return surfaces.make_optics(rig)
    return surfaces.make_optics(rig, (complex(*polarimetry.leakage_h), complex(*polarimetry.leakage_v)))


def find_points_in_rows(pipeline: Pipeline, optics: surfaces.Optics) -> surfaces.SeenEchoes:
    """Find the specular points in the rows that a pipeline holds."""
    h, v = take_samples(pipeline)
    # The range gate of the images counts from the direct path, that of `see_points` from zero path.
    low, high = pipeline.builder.gate_m
    direct_m = float(h.direct_m.mean())
    return surfaces.see_points(h, v, optics, (low + direct_m, high + direct_m))


def make_reference(metal: surfaces.SeenEchoes) -> surfaces.Reference:
    """Return a function that computes the gains of both receivers from these points of metal and a rig's optics."""

    def learn(optics: surfaces.Optics) -> surfaces.Gains:
        return surfaces.learn_gains(surfaces.find_voltages(metal, optics), optics.wave_number)

    return learn


def load_sphere_points(file: SphereFile) -> surfaces.SeenEchoes:
    """Return the points of a metal sphere from its calibration file."""
    h = _parse_echoes(np.array(file.points["h"]))
    v = _parse_echoes(np.array(file.points["v"]))
    # All points are of one segment, the sphere.
    return surfaces.SeenEchoes(h, v, segment=np.zeros(len(h), int))


def _parse_echoes(rows: np.ndarray) -> surfaces.Echoes:
    """Return the echoes of a calibration file.

    Columns: position (3), path, slope (2), bend (xx, xy, yy), amplitude (real, imaginary), error of the amplitude, and
    ln of the amplitude in the upper half of the band over that in the lower half.
    """
    count = len(rows)
    # Second derivatives [n, 2, 2] of the path by the stage offset.
    bend = np.stack([rows[:, [6, 7]], rows[:, [7, 8]]], axis=1)
    # Files of older versions have no column for the rise over the band, which is then assumed to be 0.
    band_rise = np.zeros(count)
    if rows.shape[1] > 12:
        band_rise = rows[:, 12]
    return surfaces.Echoes(
        at_m=rows[:, :3],
        path_m=rows[:, 3],
        slope=rows[:, 4:6],
        bend=bend,
        amplitude=rows[:, 9] + 1j * rows[:, 10],
        amplitude_std=rows[:, 11],
        # The file does not contain the next three, on which the gains do not depend.
        path_std_m=np.zeros(count),
        slope_std=np.zeros((count, 2)),
        share=np.zeros(count),
        band_rise=band_rise,
    )


def thin_out(metal: surfaces.SeenEchoes) -> surfaces.SeenEchoes:
    """Return at most `KEPT_POINTS` points of metal, evenly spaced: neighbours see overlapping parts of the surface."""
    index = np.linspace(0, len(metal) - 1, min(KEPT_POINTS, len(metal))).round().astype(int)
    return metal[index]


def analyse_points(
    pipeline: Pipeline,
    optics: surfaces.Optics,
    points: surfaces.SeenEchoes,
    reference: surfaces.Reference | None = None,
) -> surfaces.Surface:
    """Return the named surfaces of a scan's points; without a metal `reference` the calibration's sphere is used."""
    calibration = pipeline.calibration
    if reference is None and calibration.sphere is not None:
        reference = make_reference(load_sphere_points(calibration.sphere))
    surface = surfaces.analyse_surface(
        points,
        optics,
        reference,
        uncertainty=find_uncertainty(pipeline.rig, places_known=calibration.places is not None),
        scan_id=pipeline.source.scan_id,
        simulated=pipeline.source.simulated,
    )
    classifier = load_classifier(pipeline.settings, pipeline.rig)
    if classifier is None:
        return surface
    return replace(surface, segments=tuple(name_segment(segment, classifier) for segment in surface.segments))


def name_segment(segment: surfaces.Segment, classifier: Classifier) -> surfaces.Segment:
    """Name a segment by its permittivity, with the library that names flat patches; others are not changed."""
    if segment.permittivity is None or segment.covariance is None:
        return segment
    named = name_permittivity(segment.permittivity, np.array(segment.covariance), classifier)
    return replace(segment, name=named.name, confidence=named.confidence)


def save_surface(out: Path, surface: surfaces.Surface) -> None:
    """Write surface.npz, surface.ply and surface.png into a folder."""
    from polysight.report import surface_figure

    surfaces.write_surface(out, surface)
    write_atomically(out / "surface.png", surface_figure(surface))


def has_steep_patch(products: Path) -> bool:
    """True if a patch of the products got no permittivity because it is neither flat nor level."""
    segments = read_products(products).segments
    return any(segment.refused is not None and segment.refused.what == STEEP_FINDING.what for segment in segments)


def add_surfaces(pipeline: Pipeline, products: Path) -> None:
    """Measure the surfaces of a processed scan, write them into its products, and write the report again with them.

    The range gate is that of the images, so that only what lies near the object plane is seen. `quality.json` is
    written again with the time that this takes.
    """
    from polysight.report import write_report

    with pipeline.quality.measure_time("surfaces"):
        optics = make_rig_optics(pipeline.rig)
        points = find_points_in_rows(pipeline, optics)
        if len(points):
            save_surface(products, analyse_points(pipeline, optics, points))
    quality = read_products(products).quality
    timed = msgspec.structs.replace(quality, seconds_per_stage=pipeline.quality.seconds_per_stage)
    write_json(products / QUALITY, timed)
    write_report(products, read_products(products))
