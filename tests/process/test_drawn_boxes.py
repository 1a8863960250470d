"""Boxes drawn by hand instead of segmented patches."""

import json

import numpy as np
import pytest

from polysight.materials import SIMULATED_LIBRARY, Classifier, Library
from polysight.materials.labels import read_labels
from polysight.process import Inputs, convert_boxes_to_patches
from polysight.settings import DEFAULT


def analyse_with_labels(scan, path):
    """Return the materials of a scan with the boxes of a label file as patches, and patch number to name."""
    inputs = Inputs(labels=read_labels(path))
    scene = convert_boxes_to_patches(DEFAULT, inputs, scan.images.x_m, scan.images.y_m)
    classifier = Classifier(Library.load(SIMULATED_LIBRARY))
    return scan.pipeline.find_materials(scan.images, scene, classifier), scene.names


def test_drawn_boxes_are_the_patches_and_copper_is_the_reference(image_scene, tmp_path):
    """Two boxes give two patches; the one named copper is the metal reference, with a ratio of 1."""
    scan = image_scene("nine-materials")
    copper = next(p for p in scan.plates if p.metal)
    other_plate = next(p for p in scan.plates if not p.metal)
    # Axes from the middle of the image, as the truth has them.
    x_mm = scan.images.x_m * 1e3
    y_mm = scan.images.y_m * 1e3
    x_mm = x_mm - (x_mm[0] + x_mm[-1]) / 2
    y_mm = y_mm - (y_mm[0] + y_mm[-1]) / 2

    def convert_to_pixels(box_mm, rim_mm=8):
        """Return the corners in pixels of a box without its rim; the last ones are the first pixels outside."""
        x0, y0, x1, y1 = box_mm
        columns = np.flatnonzero((x_mm >= x0 + rim_mm) & (x_mm <= x1 - rim_mm))
        rows = np.flatnonzero((y_mm >= y0 + rim_mm) & (y_mm <= y1 - rim_mm))
        return [int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1]

    path = tmp_path / "drawn.json"
    boxes = {"mine": convert_to_pixels(other_plate.box_mm), "copper foil": convert_to_pixels(copper.box_mm)}
    path.write_text(json.dumps({"labels": boxes}))
    result, names = analyse_with_labels(scan, path)
    assert names == {1: "mine", 2: "copper foil"}
    assert result.metal.label == 2
    # The scan has noise: the median over the metal is 0.9996.
    assert np.nanmedian(np.abs(result.p[result.metal.mask])) == pytest.approx(1, abs=0.02)
    assert result.patches[0].permittivity.value.real == pytest.approx(other_plate.permittivity.real, rel=0.1)
