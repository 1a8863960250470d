"""Smoothing of a picture (total variation) and its outlines, compared with scikit-image.

The program has its own form: scikit-image would load scipy.stats and scipy.signal, which takes long.
"""

import subprocess
import sys

import numpy as np
import pytest
from skimage.measure import approximate_polygon, find_contours
from skimage.restoration import denoise_tv_chambolle

from polysight.materials.segment import drop_corners, reduce_variation


@pytest.mark.parametrize("weight", [0.1, 3.0, 12.0])
def test_the_smoothed_level_is_that_of_scikit_image(weight):
    rng = np.random.default_rng(7)
    # Levels in dB: a plate 22 dB above a background of speckle
    level = rng.normal(0, 2.0, (60, 45)) - 30
    level[20:40, 10:30] += 22
    expected = denoise_tv_chambolle(level, weight=weight, max_num_iter=100)
    np.testing.assert_allclose(reduce_variation(level, weight), expected, atol=1e-9)


def test_a_constant_level_is_not_changed():
    level = np.full((5, 4), -12.0)
    np.testing.assert_array_equal(reduce_variation(level, 3.0), level)


@pytest.mark.parametrize("tolerance", [0.5, 0.8, 3.0])
def test_outlines_are_those_of_scikit_image(tolerance):
    y, x = np.indices((50, 60))
    disc = np.hypot(y - 25, x - 30) < 17.3
    rectangle = (abs(y - 24) < 11) & (abs(x - 31) < 14)
    diagonal_strip = (abs(y - x) < 6) & (x < 40)
    for shape in (disc, rectangle, diagonal_strip):
        outline = max(find_contours(np.pad(shape, 1).astype(float), 0.5), key=len)
        np.testing.assert_allclose(drop_corners(outline, tolerance), approximate_polygon(outline, tolerance))


def test_segmentation_loads_neither_statistics_nor_signal_processing():
    code = (
        "import sys, numpy as np; from polysight.materials.segment import segment;"
        "h = np.full((60, 60), 0.02 + 0j); h[20:45, 20:45] = 1; at = np.arange(60) * 2e-3;"
        "assert len(segment(h, h, at, at, np.ones(h.shape, bool)).patches) == 1;"
        "print(sorted({'scipy.stats', 'scipy.signal'} & set(sys.modules)))"
    )
    process = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert process.stdout.strip() == "[]"
