"""Names, probabilities and refusals agree with each other."""

from __future__ import annotations

import numpy as np
import pytest

from polysight.host.materials import SIMULATED_LIBRARY, UNKNOWN, Classifier, Layer, Library
from polysight.host.materials.label_checks import clean_name
from polysight.host.materials.layer_fit import check_range
from polysight.host.materials.layers import check_stack
from polysight.shared.error_codes import ErrorCode
from polysight.shared.errors import DataError
from tests.support.refusals import refused

ANGLE_DEG = 54.9


@pytest.fixture(scope="module")
def library() -> Library:
    return Library.load(SIMULATED_LIBRARY)


@pytest.mark.parametrize("ratio", [1.5, 1.5j, -2.0, 0.2 + 0.1j, 30.0])
@pytest.mark.parametrize("gain", [0.1, 0.7, 1.0, 3.0])
def test_an_unknown_patch_has_no_likelier_name(library, ratio, gain):
    """For its distance or by its probability: unknown is then the likeliest of all that is listed."""
    rng = np.random.default_rng(5)
    h = 0.45 * gain * (1 + 0.006 * rng.standard_normal(60))
    p = ratio * (1 + 0.006 * rng.standard_normal(60))
    found = Classifier(library, angles_deg=[ANGLE_DEG]).patch(h, np.abs(h / p), p)
    if found.name == UNKNOWN:
        assert max(found.probabilities, key=lambda n: found.probabilities[n]) == UNKNOWN
        assert found.confidence >= 0.5
    else:
        assert max(found.probabilities, key=lambda n: found.probabilities[n]) == found.name


def test_one_angle_given_twice_is_refused(library):
    with refused(ErrorCode.VALUES_CONFLICT):
        Classifier(library, angles_deg=[ANGLE_DEG, ANGLE_DEG])


@pytest.mark.parametrize("eps", [0.5 + 0j, 4 + 0.5j, 1e9 + 0j, 4 - 1e9j])
def test_a_known_layer_that_no_passive_material_is(eps):
    with refused(ErrorCode.VALUE_INVALID):
        check_stack([Layer("a", eps, 1e-3), Layer("b")])


def test_a_range_of_thickness_that_nothing_can_tell_apart():
    check_range((0.5e-3, 20e-3))
    with refused(ErrorCode.VALUE_INVALID, "1000 mm"):
        check_range((0.5e-3, 1.0))


@pytest.mark.parametrize("mark", ["\u200b", "\u00ad", "\u2060", "\ufeff"])
def test_marks_that_show_nothing_are_no_part_of_a_name(mark):
    with pytest.raises(DataError):
        clean_name(f"rubber{mark}")
