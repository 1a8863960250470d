"""Boxes drawn by hand may touch each other, and may lie outside the valid pixels."""

import numpy as np
import pytest

from polysight.imaging import Images
from polysight.materials.analyse import KnownScene, Optics, analyse, smooth_inside
from polysight.materials.labels import make_patches_from_labels, make_patches_from_plates
from polysight.materials.segment import TruthPlate
from polysight.polarimetry import fresnel

X_M = np.arange(60) * 2e-3
Y_M = np.arange(40) * 2e-3
THETA = np.radians(55.0)
# Permittivities of the plates
LEFT = 4 - 0.4j
RIGHT = 9 - 2j


def _make_scene():
    """Return H, V, the segmentation by boxes, and name to patch number.

    Metal fills the rows up to 20; above it two plates lie side by side. The box "nowhere" is at the right edge.
    """
    h = np.full((40, 60), -1, np.complex64)
    v = np.full((40, 60), -1, np.complex64)
    for eps, columns in ((LEFT, slice(0, 30)), (RIGHT, slice(30, 60))):
        h[20:, columns], v[20:, columns] = fresnel(eps, THETA)
    boxes = {"metal": (0, 0, 60, 18), "left": (2, 20, 30, 40), "right": (30, 20, 58, 40), "nowhere": (58, 20, 60, 40)}
    segmentation, names = make_patches_from_labels(boxes, X_M, Y_M, unit="pixel")
    return h, v, segmentation, {name: label for label, name in names.items()}


def test_the_filter_against_speckle_does_not_mix_boxes_that_touch():
    h, _, segmentation, labels = _make_scene()
    smoothed = smooth_inside(h, segmentation, sigma_px=2.0)
    for name, eps in (("left", LEFT), ("right", RIGHT)):
        interior = next(p for p in segmentation.patches if p.label == labels[name]).interior
        np.testing.assert_allclose(smoothed[interior], fresnel(eps, THETA)[0], atol=1e-6)
    is_outside = ~np.logical_or.reduce([p.interior for p in segmentation.patches])
    assert np.isnan(smoothed[is_outside]).all()


def test_pixels_that_are_not_valid_are_not_measured_and_a_box_of_them_has_no_results():
    h, v, segmentation, labels = _make_scene()
    valid = np.ones(h.shape, bool)
    # A third of the left plate, and the whole box "nowhere"
    valid[:, :12] = False
    valid[:, 58:] = False
    # Images are 0 where they are not valid.
    h[~valid] = 0
    v[~valid] = 0
    pair = Images(h, v, X_M, Y_M, valid)
    optics = Optics(THETA, smooth_px=1.0)
    result = analyse(pair, optics, KnownScene(segmentation, labels["metal"]))
    rows = {r.label: r for r in result.rows()}
    left_row = rows[labels["left"]]
    nowhere = rows[labels["nowhere"]]
    r_s, _ = fresnel(LEFT, THETA)
    # Amplitudes are rounded to six digits.
    assert left_row.amplitude_h == pytest.approx(abs(complex(r_s)), abs=1e-6)
    # There is no noise: the error is a third of the one that is stated.
    assert abs(left_row.permittivity.value - LEFT) < 0.5 * left_row.permittivity.real_std
    assert nowhere.interior_pixels == 0
    assert not nowhere.metal_like
    assert nowhere.permittivity is None


def test_two_plates_of_the_same_name_are_two_patches():
    plates = [TruthPlate("acrylic", box, 4 - 0.4j) for box in ((-50, -30, -20, 0), (10, -30, 40, 0))]
    segmentation, names = make_patches_from_plates(plates, X_M, Y_M, margin_mm=0.0)
    assert list(names.values()) == ["acrylic", "acrylic"]
    assert [p.label for p in segmentation.patches] == list(names)
    assert not (segmentation.patches[0].mask & segmentation.patches[1].mask).any()
