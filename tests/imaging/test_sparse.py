"""Reconstruction of sparse scans removes aliases and keeps weak reflectors."""

import numpy as np
import pytest

from polysight.imaging import ImageBuilder, image_grid
from polysight.imaging.sparse import reconstruct

AT = [(6, 8), (20, 30), (33, 12)]
AMPLITUDES = np.array([1.0, 0.6j, -0.8])


@pytest.fixture
def board(make_rig, points_rows):
    """A board's samples of three points on pixels; positions outside `kept` [row, column] are left out."""

    def make(kept, amplitudes=AMPLITUDES):
        rig = make_rig(60, 40, 6.0, 6.0, pixels=(40, 40), pixel=3.0)
        grid = image_grid(rig)
        points = [np.array([grid.x_m[i], grid.y_m[j], grid.z_m]) for j, i in AT]
        builder = ImageBuilder(rig, taper="boxcar")
        for index, row in points_rows(rig, rig.receivers[0], points, amplitudes, noise=0.05):
            row.valid[:] = kept[index][:: 1 if index % 2 == 0 else -1]
            if row.valid.any():
                builder.add_row("RH", index, row)
        return builder.boards["RH"]

    return make


def _kept(name):
    kept = np.zeros((40, 60), bool)
    if name == "every second row":
        kept[::2] = True
    elif name == "every second column":
        kept[:, ::2] = True
    else:
        kept = np.random.default_rng(0).uniform(size=kept.shape) < 0.25
    return kept


@pytest.mark.parametrize("name", ["every second row", "every second column", "a random quarter"])
def test_points_of_a_sparse_scan_are_reconstructed_without_aliases(board, name):
    samples = board(_kept(name))
    found = reconstruct(samples, iterations=40, strength=0.03)
    truth = np.zeros((40, 40), complex)
    truth[tuple(np.transpose(AT))] = AMPLITUDES
    matched = samples.image()[0]

    def outside(image):  # strongest pixel away from the points
        away = np.ones(image.shape, bool)
        for j, i in AT:
            away[j - 3 : j + 4, i - 3 : i + 4] = False
        return np.abs(image[away]).max()

    assert outside(found.image) < 0.25 * outside(matched)
    sums = np.array([found.image[j - 1 : j + 2, i - 1 : i + 2].sum() for j, i in AT])
    np.testing.assert_allclose(sums, AMPLITUDES, atol=0.15)
    assert np.linalg.norm(found.image - truth) < 0.5 * np.linalg.norm(matched - truth)
    assert found.residual[-1] < 0.25 < found.residual[0]


def test_weak_reflectors_beside_a_strong_one_are_kept(board):
    """Thin wood has 0.42 of the amplitude of metal in H and 0.035 in V."""
    amplitudes = np.array([1.0, 0.035j, -0.42])
    found = reconstruct(board(_kept("every second column"), amplitudes), iterations=25)
    sums = np.array([found.image[j - 1 : j + 2, i - 1 : i + 2].sum() for j, i in AT])
    np.testing.assert_allclose(sums / amplitudes, 1, atol=0.2)


def test_no_data_gives_an_empty_image(make_rig):
    found = reconstruct(ImageBuilder(make_rig(5, 5, pixels=(6, 6))).boards["RH"], iterations=2)
    assert not found.image.any()
