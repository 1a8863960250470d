"""`train` reports if confidences are too high, the cause, and the number of specimens that a library needs."""

import numpy as np
import pytest
from tests.materials.test_specimens import KINDS, draw_pixels

from polysight.materials import Library, describe_accuracy
from polysight.materials.train import fit_samples
from polysight.materials.training_advice import FREEDOM_NEEDED

MANY_SCANS = 12
CLOSE = {"acrylic": 4.0 - 0.4j, "resin": 4.03 - 0.405j, "rubber": 5.06 - 1.11j}


@pytest.fixture(scope="module")
def fit_of_many_specimens():
    return fit_samples(draw_pixels((0.03, 0.2), MANY_SCANS, seed=2))


def advise(fit) -> str:
    return "\n".join(describe_accuracy(Library((), {"angles": {"60": fit}})))


def test_unnamed_pieces_make_an_underconfident_library_that_asks_for_specimens():
    """They differ by 12 %, which counts as an error of placement for all materials alike."""
    text = advise(fit_samples(draw_pixels((0.12, 0.6), 6, seed=1, labelled=False)))
    assert "underconfident" in text
    assert "each material has one specimen" in text
    assert f"scan {FREEDOM_NEEDED} more" in text


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({"scans": 3}, "known from 3 scans only"),
        ({"specimen_freedom": 2}, "differ more from those learnt"),
        ({}, "a scan may be disturbed, or a label wrong"),
    ],
)
def test_overconfident_names_are_reported_with_the_likeliest_cause(fit_of_many_specimens, change, cause):
    text = advise(fit_of_many_specimens | {"named": 200, "said": 0.97, "right": 0.8} | change)
    assert "overconfident: names are said with 97 % and 80 % are right" in text
    assert cause in text


def test_a_library_of_many_specimens_needs_none_and_is_neither_over_nor_underconfident(fit_of_many_specimens):
    text = advise(fit_of_many_specimens)
    assert "confident" not in text
    assert "needed" not in text


def test_materials_that_more_specimens_cannot_separate_are_reported():
    text = advise(fit_samples(draw_pixels((0.03, 0.2), 8, seed=3, kinds=CLOSE)))
    assert "acrylic and resin lie" in text
    assert "rubber" not in text.split("lie")[0].splitlines()[-1]


def test_the_freedom_of_specimens_is_counted_over_the_materials(fit_of_many_specimens):
    few_scans = 3
    fit_of_few = fit_samples(draw_pixels((0.03, 0.2), few_scans, seed=4))
    for scans, fit in ((few_scans, fit_of_few), (MANY_SCANS, fit_of_many_specimens)):
        assert fit["specimen_freedom"] == len(KINDS) * (scans - 1)
        assert np.isfinite([fit["said"], fit["right"]]).all()
