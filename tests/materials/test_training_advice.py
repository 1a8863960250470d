"""`train` reports if confidences are too high, the cause, and the number of specimens that a library needs."""

import numpy as np
import pytest
from tests.materials.test_specimens import KINDS, draw_pixels

from polysight.materials import Library, describe_accuracy
from polysight.materials.train import fit_samples
from polysight.materials.training_advice import FREEDOM_NEEDED

MANY_SCANS = 12
# Acrylic and resin are nearer to each other than two specimens of one material.
CLOSE = {"acrylic": 4.0 - 0.4j, "resin": 4.03 - 0.405j, "rubber": 5.06 - 1.11j}


@pytest.fixture(scope="module")
def fit_of_many_specimens():
    return fit_samples(draw_pixels(spread=(0.03, 0.2), scans=MANY_SCANS, seed=2))


def advise(fit) -> str:
    """Return the text about a library with this fit."""
    return "\n".join(describe_accuracy(Library((), {"angles": {"60": fit}})))


def test_scans_without_names_of_their_specimens_make_an_underconfident_library():
    """The specimens differ by 12 %: without their names that is an error of placement of all materials.

    The advice is to scan more specimens.
    """
    text = advise(fit_samples(draw_pixels(spread=(0.12, 0.6), scans=6, seed=1, labelled=False)))
    assert "underconfident" in text
    assert "no second specimen of a material is named" in text
    assert f"scan {FREEDOM_NEEDED} more" in text


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"scans": 3}, "known from 3 scans only"),
        ({"specimen_freedom": 2}, "differ more from those learnt"),
        ({}, "a scan may be disturbed, or a label may be wrong"),
    ],
)
def test_overconfident_names_are_reported_with_the_likeliest_cause(fit_of_many_specimens, change, cause):
    # Of 200 names the mean confidence is 0.97, and 0.8 are right.
    text = advise(fit_of_many_specimens | {"named": 200, "said": 0.97, "right": 0.8} | change)
    assert "overconfident: names have a mean confidence of 97 %, and 80 % are right" in text
    assert cause in text


def test_a_library_of_many_specimens_needs_none_and_is_neither_over_nor_underconfident(fit_of_many_specimens):
    text = advise(fit_of_many_specimens)
    assert "confident" not in text
    assert "needed" not in text


def test_materials_that_more_specimens_cannot_separate_are_reported():
    text = advise(fit_samples(draw_pixels(spread=(0.03, 0.2), scans=8, seed=3, kinds=CLOSE)))
    assert "acrylic and resin lie" in text
    names_before_lie = text.split("lie")[0].splitlines()[-1]
    assert "rubber" not in names_before_lie


def test_the_freedom_of_specimens_is_counted_over_the_materials(fit_of_many_specimens):
    """Each material has one specimen in each scan, and one degree of freedom is spent on its mean."""
    few_scans = 3
    fit_of_few = fit_samples(draw_pixels(spread=(0.03, 0.2), scans=few_scans, seed=4))
    for scans, fit in ((few_scans, fit_of_few), (MANY_SCANS, fit_of_many_specimens)):
        assert fit["specimen_freedom"] == len(KINDS) * (scans - 1)
        assert np.isfinite([fit["said"], fit["right"]]).all()
