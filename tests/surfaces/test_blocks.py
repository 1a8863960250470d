"""Sums of the errors of points that are correlated: near points are one block, and far ones are separate blocks."""

import numpy as np
import pytest

from polysight.surfaces.gains import number_blocks
from polysight.surfaces.permittivity import _sum_over_blocks

BLOCK_M = 0.02


def test_blocks_are_squares_of_the_stage():
    places = np.array([[0.001, 0.001], [0.019, 0.019], [0.021, 0.001], [0.001, -0.001], [0.0, 0.0]])
    numbers = number_blocks(places, (0.0, 0.0), BLOCK_M)
    assert numbers[0] == numbers[1] == numbers[4]
    assert len({numbers[0], numbers[2], numbers[3]}) == 3
    # The borders of the blocks are moved by half of a block along x.
    moved = number_blocks(places, (0.5, 0.0), BLOCK_M)
    assert moved[1] == moved[2]
    assert moved[0] != moved[1]


@pytest.mark.parametrize(
    ("x_m", "y_m"), [(0.0, 0.0), (0.005, 0.0), (0.0, 0.015), (0.01, 0.01), (0.021, 0.0), (0.5, 0.5)]
)
def test_a_pair_of_points_counts_by_its_distance(x_m, y_m):
    """Two points that are x and y apart lie in one block with the probability (1 - x / block) (1 - y / block).

    If they do, their terms are added before they are squared. Averaged over 12 x 12 places of the pair in its block.
    """
    terms = np.array([[2.0, -1.0], [1.0, 3.0]])
    influence = np.ones((2, 2), complex)
    evenly_m = (np.arange(12) + 0.5) / 12 * BLOCK_M
    covariances = []
    block_counts = []
    for first_m in np.stack(np.meshgrid(evenly_m, evenly_m), axis=-1).reshape(-1, 2):
        places_m = first_m + np.array([[0.0, 0.0], [x_m, y_m]])
        covariance, blocks = _sum_over_blocks(terms, influence, places_m, BLOCK_M)
        covariances.append(covariance)
        block_counts.append(blocks)
    in_one_block = max(0.0, 1 - x_m / BLOCK_M) * max(0.0, 1 - y_m / BLOCK_M)
    squares = terms.T @ terms
    products = np.outer(terms[0], terms[1]) + np.outer(terms[1], terms[0])
    # Places are tried in steps of a twelfth of a block: the average is not exact.
    np.testing.assert_allclose(np.mean(covariances, axis=0), squares + in_one_block * products, atol=0.4)
    # In two blocks they count as two, in one as one.
    assert np.mean(block_counts) == pytest.approx(2 - in_one_block, abs=0.07)


def test_blocks_of_more_influence_count_more():
    """Two points a metre apart with influences of 3 and 1 count as (3^2 + 1^2)^2 / (3^4 + 1^4) blocks."""
    terms = np.ones((2, 2))
    influence = np.array([[3.0, 1j]])
    places_m = np.array([[0.0, 0.0], [1.0, 0.0]])
    _, blocks = _sum_over_blocks(terms, influence, places_m, BLOCK_M)
    assert blocks == pytest.approx(100 / 82)
