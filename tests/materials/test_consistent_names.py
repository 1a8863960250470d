"""Names, probabilities and refusals agree with each other."""

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.materials import SIMULATED_LIBRARY, UNKNOWN, Classifier, Library
from polysight.materials.result import pixel_features
from polysight_shared.errors import ErrorCode

ANGLE_DEG = 54.9


@pytest.fixture(scope="module")
def library() -> Library:
    return Library.load(SIMULATED_LIBRARY)


@pytest.mark.parametrize("ratio", [1.5, 1.5j, -2.0, 0.2 + 0.1j, 30.0])
@pytest.mark.parametrize("gain", [0.1, 0.7, 1.0, 3.0])
def test_an_unknown_patch_has_no_likelier_name(library, ratio, gain):
    """A patch is unknown for its distance or its probability; then "unknown" is the likeliest entry of the list."""
    rng = np.random.default_rng(5)
    h = 0.45 * gain * (1 + 0.006 * rng.standard_normal(60))
    p = ratio * (1 + 0.006 * rng.standard_normal(60))
    patch_name = Classifier(library, angles_deg=[ANGLE_DEG]).scan([pixel_features(h, np.abs(h / p), p)])[0].patch_name
    if patch_name.name == UNKNOWN:
        assert max(patch_name.probabilities, key=lambda n: patch_name.probabilities[n]) == UNKNOWN
        assert patch_name.confidence >= 0.5
    else:
        assert max(patch_name.probabilities, key=lambda n: patch_name.probabilities[n]) == patch_name.name


def test_one_angle_given_twice_is_refused(library):
    with expect_refusal(ErrorCode.VALUES_CONFLICT):
        Classifier(library, angles_deg=[ANGLE_DEG, ANGLE_DEG])
