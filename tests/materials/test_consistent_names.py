"""Names, probabilities and refusals agree with each other."""

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.materials import SIMULATED_LIBRARY, UNKNOWN, Classifier, Library
from polysight.materials.result import pixel_features
from polysight_shared.errors import ErrorCode

# The published rig's 55 degrees, not exactly: a measured angle is not that of the library.
ANGLE_DEG = 54.9


@pytest.fixture(scope="module")
def library() -> Library:
    return Library.load(SIMULATED_LIBRARY)


# Ratios H / V and brightnesses of which most belong to no material of the library.
@pytest.mark.parametrize("ratio", [1.5, 1.5j, -2.0, 0.2 + 0.1j, 30.0])
@pytest.mark.parametrize("gain", [0.1, 0.7, 1.0, 3.0])
def test_the_name_of_a_patch_is_the_likeliest_of_its_list(library, ratio, gain):
    """This holds for "unknown" too, whether a patch is unknown for its distance or for its probabilities."""
    rng = np.random.default_rng(5)
    # 0.45 is a usual |H| of a plate; the pixels scatter by 0.6 %.
    h = 0.45 * gain * (1 + 0.006 * rng.standard_normal(60))
    p = ratio * (1 + 0.006 * rng.standard_normal(60))
    features = pixel_features(h, np.abs(h / p), p)
    (named,) = Classifier(library, angles_deg=[ANGLE_DEG]).scan([features])
    patch_name = named.patch_name
    likeliest = max(patch_name.probabilities, key=lambda name: patch_name.probabilities[name])
    assert patch_name.name == likeliest
    # The least probable "unknown" of these cases has 0.52.
    if patch_name.name == UNKNOWN:
        assert patch_name.confidence >= 0.5


def test_one_angle_given_twice_is_refused(library):
    with expect_refusal(ErrorCode.VALUES_CONFLICT):
        Classifier(library, angles_deg=[ANGLE_DEG, ANGLE_DEG])
