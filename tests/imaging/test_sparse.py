"""Reconstruction of sparse scans removes aliases and keeps weak reflectors."""

import numpy as np
import pytest

from polysight.imaging import ImageBuilder, fill_missing, image_grid
from polysight.imaging.sparse import find_added_steps, reconstruct
from polysight_shared.errors import ConfigError

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


def _select_kept(name):
    is_kept = np.zeros((40, 60), bool)
    if name == "every second row":
        is_kept[::2] = True
    elif name == "every second column":
        is_kept[:, ::2] = True
    else:
        is_kept = np.random.default_rng(0).uniform(size=is_kept.shape) < 0.25
    return is_kept


@pytest.mark.parametrize("name", ["every second row", "every second column", "a random quarter"])
def test_points_of_a_sparse_scan_are_reconstructed_without_aliases(board, name):
    samples = board(_select_kept(name))
    reconstruction = reconstruct(samples, iterations=40, strength=0.03)
    truth = np.zeros((40, 40), complex)
    truth[tuple(np.transpose(AT))] = AMPLITUDES
    matched = samples.image()[0]

    # Strongest pixel away from the points
    def outside(image):
        is_away = np.ones(image.shape, bool)
        for j, i in AT:
            is_away[j - 3 : j + 4, i - 3 : i + 4] = False
        return np.abs(image[is_away]).max()

    assert outside(reconstruction.image) < 0.25 * outside(matched)
    sums = np.array([reconstruction.image[j - 1 : j + 2, i - 1 : i + 2].sum() for j, i in AT])
    np.testing.assert_allclose(sums, AMPLITUDES, atol=0.15)
    assert np.linalg.norm(reconstruction.image - truth) < 0.5 * np.linalg.norm(matched - truth)
    assert reconstruction.residual[-1] < 0.25 < reconstruction.residual[0]


def test_weak_reflectors_near_a_strong_one_are_kept(board):
    """Thin wood has 0.42 of the amplitude of metal in H and 0.035 in V."""
    amplitudes = np.array([1.0, 0.035j, -0.42])
    reconstruction = reconstruct(board(_select_kept("every second column"), amplitudes), iterations=25)
    sums = np.array([reconstruction.image[j - 1 : j + 2, i - 1 : i + 2].sum() for j, i in AT])
    np.testing.assert_allclose(sums / amplitudes, 1, atol=0.2)


def test_no_data_gives_an_empty_image(make_rig):
    reconstruction = reconstruct(ImageBuilder(make_rig(5, 5, pixels=(6, 6))).boards["RH"], iterations=2)
    assert not reconstruction.image.any()


# --- missing positions are filled ---


@pytest.fixture
def scan(make_rig, points_rows):
    """`scan(kept)`: a builder with three points; positions outside `kept` [row, column] are left out."""

    def make(kept, step_y_mm=5.0):
        rig = make_rig(60, len(kept), 5.0, step_y_mm, pixels=(40, 40), pixel=5.0)
        grid = image_grid(rig)
        points = [np.array([grid.x_m[i], grid.y_m[j], grid.z_m]) for j, i in AT]
        builder = ImageBuilder(rig)
        for board in rig.receivers:
            for index, row in points_rows(rig, board, points, AMPLITUDES, noise=0.02):
                row.valid[:] = kept[index][:: 1 if index % 2 == 0 else -1]
                if row.valid.any():
                    builder.add_row(board.name, index, row)
        return builder

    return make


def image_error(images, complete_images):
    factor = np.vdot(images.h_raw, complete_images.h_raw) / np.vdot(images.h_raw, images.h_raw)
    return np.linalg.norm(factor * images.h_raw - complete_images.h_raw) / np.linalg.norm(complete_images.h_raw)


# Columns twice as far apart make no ghosts in this image, so that there is little to remove.
@pytest.mark.parametrize(
    ("name", "factor"), [("every second row", 10), ("every second column", 1.2), ("a random quarter", 10)]
)
def test_the_image_with_filled_positions_is_nearer_to_that_of_the_whole_scan(scan, name, factor):
    full_image = scan(np.ones((40, 60), bool)).finish()
    thin = scan(_select_kept(name))
    filled, errors = fill_missing(thin)
    error = image_error(filled.finish(), full_image)
    assert error < image_error(thin.finish(), full_image) / factor
    assert errors["RH"].missing_share == pytest.approx(1 - _select_kept(name).mean())
    assert error < 2 * errors["RH"].image_error


def test_the_first_step_already_reduces_the_residual(scan):
    _, errors = fill_missing(scan(_select_kept("a random quarter")[:10]), iterations=1)
    assert 0 < errors["RH"].residual < 0.9


def test_a_whole_scan_does_not_change(scan):
    builder = scan(np.ones((40, 60), bool))
    filled, errors = fill_missing(builder)
    assert not errors
    np.testing.assert_array_equal(filled.finish().h_raw, builder.finish().h_raw)
    np.testing.assert_array_equal(filled.finish().illumination.footprints, builder.finish().illumination.footprints)


def test_steps_too_wide_for_the_image_are_divided(scan):
    coarse = scan(np.ones((20, 60), bool), step_y_mm=10.0)
    assert find_added_steps(coarse.rig)[0] > 1
    filled, _ = fill_missing(coarse)
    assert filled.rig.grid.rows == find_added_steps(coarse.rig)[0] * 19 + 1
    is_away = np.ones((40, 40), bool)
    for j, i in AT:
        is_away[j - 4 : j + 5, i - 4 : i + 5] = False
    ghosts = [np.abs(builder.finish().h_raw[is_away]).max() for builder in (coarse, filled)]
    assert ghosts[1] < 0.5 * ghosts[0]


def test_an_aperture_that_needs_the_direct_sum_is_refused_immediately(scan):
    """Rows 6 mm apart and pixels of 5 mm: each of a hundred images would take seconds."""
    is_kept = np.ones((10, 60), bool)
    is_kept[4] = False
    with pytest.raises(ConfigError):
        fill_missing(scan(is_kept, step_y_mm=6.0))
