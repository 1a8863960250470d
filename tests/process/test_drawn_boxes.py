"""Boxes drawn by hand instead of patches that are found."""

import json
from dataclasses import replace

import numpy as np
import pytest

from polysight.materials import SIMULATED_LIBRARY, Classifier, KnownScene, Library
from polysight.materials.labels import pack_labels, read_labels
from polysight.materials.result import make_labels
from polysight.process import Inputs, boxes_as_patches
from polysight.settings import DEFAULT


@pytest.fixture
def drawn_result(image_scene):
    scan = image_scene("nine-materials")
    return scan.pipeline.find_materials(
        scan.images, known_scene=KnownScene(plates=scan.plates), classifier=Classifier(Library.load(SIMULATED_LIBRARY))
    )


def again(scan, path, plates=()):
    inputs = Inputs(labels=read_labels(path))
    scene = replace(boxes_as_patches(DEFAULT, inputs, scan.images.x_m, scan.images.y_m), plates=plates)
    classifier = Classifier(Library.load(SIMULATED_LIBRARY))
    return scan.pipeline.find_materials(scan.images, scene, classifier), scene.names


def test_labels_of_products_give_the_same_materials_again(image_scene, drawn_result, tmp_path):
    scan = image_scene("nine-materials")
    (tmp_path / "labels.json").write_bytes(pack_labels(make_labels(drawn_result)))
    boxes = read_labels(tmp_path / "labels.json")
    assert len(boxes.boxes) == len(drawn_result.patches) == 9
    second, names = again(scan, tmp_path / "labels.json", scan.plates)
    assert names[second.metal.label] == "metal"
    assert [p.truth.name for p in second.patches] == [p.truth.name for p in drawn_result.patches]
    for p in second.patches:
        assert p.patch.label == second.metal.label or p.verdict.name == p.truth.name


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
    result, names = again(scan, path)
    assert names == {1: "mine", 2: "copper foil"}
    assert result.metal.label == 2
    assert np.nanmedian(np.abs(result.p[result.metal.mask])) == pytest.approx(1, abs=0.02)
    assert result.patches[0].permittivity.value.real == pytest.approx(other_plate.permittivity.real, rel=0.1)
