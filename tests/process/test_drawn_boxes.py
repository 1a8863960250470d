"""Boxes drawn by hand instead of segmented patches."""

import json

import numpy as np
import pytest

from polysight.materials import SIMULATED_LIBRARY, Classifier, Library
from polysight.materials.labels import read_labels
from polysight.process import Inputs, convert_boxes_to_patches
from polysight.settings import DEFAULT


def analyse_again(scan, path):
    inputs = Inputs(labels=read_labels(path))
    scene = convert_boxes_to_patches(DEFAULT, inputs, scan.images.x_m, scan.images.y_m)
    classifier = Classifier(Library.load(SIMULATED_LIBRARY))
    return scan.pipeline.find_materials(scan.images, scene, classifier), scene.names


def test_drawn_boxes_are_the_patches_and_copper_is_the_reference(image_scene, tmp_path):
    """Two boxes give two patches; the one named copper is the metal reference, with a ratio of 1."""
    scan = image_scene("nine-materials")
    copper = next(p for p in scan.plates if p.metal)
    other_plate = next(p for p in scan.plates if not p.metal)
    x = scan.images.x_m * 1e3
    y = scan.images.y_m * 1e3
    x = x - (x[0] + x[-1]) / 2
    y = y - (y[0] + y[-1]) / 2

    def pixels(box_mm):
        x0, y0, x1, y1 = box_mm
        inside = [np.flatnonzero((a >= low + 8) & (a <= high - 8)) for a, low, high in ((x, x0, x1), (y, y0, y1))]
        return [int(inside[0][0]), int(inside[1][0]), int(inside[0][-1]) + 1, int(inside[1][-1]) + 1]

    path = tmp_path / "drawn.json"
    path.write_text(json.dumps({"labels": {"mine": pixels(other_plate.box_mm), "copper foil": pixels(copper.box_mm)}}))
    result, names = analyse_again(scan, path)
    assert names == {1: "mine", 2: "copper foil"}
    assert result.metal.label == 2
    assert np.nanmedian(np.abs(result.p[result.metal.mask])) == pytest.approx(1, abs=0.02)
    assert result.patches[0].permittivity.value.real == pytest.approx(other_plate.permittivity.real, rel=0.1)
