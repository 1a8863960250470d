"""Reconstruction of sparse scans removes aliases and keeps weak reflectors."""

import numpy as np
import pytest

from polysight.imaging import ImageBuilder, fill_missing, image_grid
from polysight.imaging.sparse import find_step_divisors, reconstruct
from polysight_shared.errors import ConfigError

# Pixels (row, column) of three points, and their amplitudes
POINTS_PX = [(6, 8), (20, 30), (33, 12)]
AMPLITUDES = np.array([1.0, 0.6j, -0.8])


def _put_in_scan_order(kept, index):
    """Row `index` of `kept`: odd rows are scanned from the last column to the first."""
    if index % 2 == 0:
        return kept[index]
    return kept[index][::-1]


@pytest.fixture
def board(make_rig, points_rows):
    """`board(kept)`: samples of RH of three points on pixels; positions outside `kept` [row, column] are missing."""

    def make(kept, amplitudes=AMPLITUDES):
        rig = make_rig(columns=60, rows=40, step_x=6.0, step_y=6.0, pixels=(40, 40), pixel=3.0)
        grid = image_grid(rig)
        points = [np.array([grid.x_m[i], grid.y_m[j], grid.z_m]) for j, i in POINTS_PX]
        builder = ImageBuilder(rig, taper="boxcar")
        for index, row in points_rows(rig, rig.receivers[0], points, amplitudes, noise=0.05):
            row.valid[:] = _put_in_scan_order(kept, index)
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


def _sum_at_points(image):
    """Sum over the 3 x 3 pixels of each point, among which the reconstruction divides its amplitude."""
    return np.array([image[j - 1 : j + 2, i - 1 : i + 2].sum() for j, i in POINTS_PX])


@pytest.mark.parametrize("name", ["every second row", "every second column", "a random quarter"])
def test_points_of_a_sparse_scan_are_reconstructed_without_aliases(board, name):
    samples = board(_select_kept(name))
    reconstruction = reconstruct(samples, iterations=40, strength=0.03)
    truth = np.zeros((40, 40), complex)
    truth[tuple(np.transpose(POINTS_PX))] = AMPLITUDES
    matched_filter = samples.image()[0]

    def find_strongest_alias(image):
        """Amplitude of the strongest pixel that is more than three pixels away from all points."""
        is_away = np.ones(image.shape, bool)
        for j, i in POINTS_PX:
            is_away[j - 3 : j + 4, i - 3 : i + 4] = False
        return np.abs(image[is_away]).max()

    # Measured: an alias is 0.009 instead of 0.2
    assert find_strongest_alias(reconstruction.image) < 0.25 * find_strongest_alias(matched_filter)
    # Differences of up to 0.023 are measured.
    np.testing.assert_allclose(_sum_at_points(reconstruction.image), AMPLITUDES, atol=0.15)
    # Measured: 1.0 instead of 4.1
    assert np.linalg.norm(reconstruction.image - truth) < 0.5 * np.linalg.norm(matched_filter - truth)
    # The residual is the fraction of the samples that the image does not explain: 1 before, 0.06 at the end (measured).
    assert reconstruction.residual[0] > 0.25
    assert reconstruction.residual[-1] < 0.25


def test_weak_reflectors_near_a_strong_one_are_kept(board):
    """Thin wood has 0.42 of the amplitude of metal in H and 0.035 in V."""
    amplitudes = np.array([1.0, 0.035j, -0.42])
    reconstruction = reconstruct(board(_select_kept("every second column"), amplitudes), iterations=25)
    # Differences of up to 14 % are measured.
    np.testing.assert_allclose(_sum_at_points(reconstruction.image) / amplitudes, 1, atol=0.2)


def test_no_data_gives_an_empty_image(make_rig):
    reconstruction = reconstruct(ImageBuilder(make_rig(columns=5, rows=5, pixels=(6, 6))).boards["RH"], iterations=2)
    assert not reconstruction.image.any()


# --- missing positions are filled ---


@pytest.fixture
def scan(make_rig, points_rows):
    """`scan(kept)`: a builder with three points; positions outside `kept` [row, column] are left out."""

    def make(kept, step_y_mm=5.0):
        rig = make_rig(columns=60, rows=len(kept), step_x=5.0, step_y=step_y_mm, pixels=(40, 40), pixel=5.0)
        grid = image_grid(rig)
        points = [np.array([grid.x_m[i], grid.y_m[j], grid.z_m]) for j, i in POINTS_PX]
        builder = ImageBuilder(rig)
        for board in rig.receivers:
            for index, row in points_rows(rig, board, points, AMPLITUDES, noise=0.02):
                row.valid[:] = _put_in_scan_order(kept, index)
                if row.valid.any():
                    builder.add_row(board.name, index, row)
        return builder

    return make


def image_error(images, complete_images):
    """Difference of two images of H over the norm of the second; a common complex factor does not count."""
    factor = np.vdot(images.h_raw, complete_images.h_raw) / np.vdot(images.h_raw, images.h_raw)
    return np.linalg.norm(factor * images.h_raw - complete_images.h_raw) / np.linalg.norm(complete_images.h_raw)


# `factor`: the error of the image is reduced at least by this. Columns twice as far apart make no ghosts in this image,
# so that filling them hardly changes it.
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
    # The reported error may be too small by a factor of 2 at most.
    assert error < 2 * errors["RH"].image_error


def test_the_first_step_already_reduces_the_residual(scan):
    _, errors = fill_missing(scan(_select_kept("a random quarter")[:10]), iterations=1)
    # Without a step it is 1; 0.6 is measured.
    assert 0 < errors["RH"].residual < 0.9


def test_a_whole_scan_does_not_change(scan):
    builder = scan(np.ones((40, 60), bool))
    filled, errors = fill_missing(builder)
    assert not errors
    np.testing.assert_array_equal(filled.finish().h_raw, builder.finish().h_raw)
    np.testing.assert_array_equal(filled.finish().illumination.footprints, builder.finish().illumination.footprints)


def test_steps_too_wide_for_the_image_are_divided(scan):
    coarse = scan(np.ones((20, 60), bool), step_y_mm=10.0)
    divisor_of_y_steps = find_step_divisors(coarse.rig)[0]
    assert divisor_of_y_steps > 1
    filled, _ = fill_missing(coarse)
    # 20 rows have 19 steps.
    assert filled.rig.grid.rows == divisor_of_y_steps * 19 + 1
    is_away = np.ones((40, 40), bool)
    for j, i in POINTS_PX:
        is_away[j - 4 : j + 5, i - 4 : i + 5] = False
    ghost_of_coarse = np.abs(coarse.finish().h_raw[is_away]).max()
    ghost_of_filled = np.abs(filled.finish().h_raw[is_away]).max()
    # Measured: 0.05 instead of 0.9
    assert ghost_of_filled < 0.5 * ghost_of_coarse


def test_an_aperture_that_needs_the_direct_sum_is_refused_immediately(scan):
    """Rows 6 mm apart and pixels of 5 mm: each of a hundred images would take seconds."""
    is_kept = np.ones((10, 60), bool)
    is_kept[4] = False
    with pytest.raises(ConfigError):
        fill_missing(scan(is_kept, step_y_mm=6.0))
