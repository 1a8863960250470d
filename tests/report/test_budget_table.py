"""Lines of the error budget: what is known is written, with signs and errors, and what is not known is left out."""

import pytest

from polysight.report.report import _format_with_sign, make_budget_table
from polysight.results.materials import ErrorBudget, IncidenceError, LeakageError, MetalScore, PlaneError

LEAKAGE_OF_H = "Leakage of H, relative to its own channel"
LEAKAGE_OF_V = "Leakage of V, relative to its own channel"
PLANE = "Plane of the plates, relative to the rig file"


def list_cells(**parts) -> list[list[str]]:
    """The cells of each line of the table of a budget with these parts."""
    table = make_budget_table(ErrorBudget(**parts))
    return [] if table is None else [row["cells"] for row in table["rows"]]


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(1.25, 1, "+1.2"), (-1.26, 1, "−1.3"), (-0.04, 1, "+0.0"), (0.0, 2, "+0.00"), (-0.04, 2, "−0.04")],
)
def test_a_number_has_its_sign_and_zero_a_plus(value, digits, text):
    assert _format_with_sign(value, digits) == text


def test_without_a_budget_there_is_no_table():
    assert list_cells() == []


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("measured", "measured (rig file)"), ("scene", "estimated from the scene"), ("other", "other"),
        ("prior and scene", "not measured; estimated from its prior and the scene"),
    ],
)  # fmt: skip
def test_the_source_of_a_leakage_is_said(source, text):
    assert list_cells(leakage=LeakageError(source=source)) == [["Leakage", text]]


def test_leakages_are_complex_numbers_with_their_errors():
    leakage = LeakageError(h=(0.0123, -0.0456), v=(-0.02, 0.0), std=(0.001, None), source="scene")
    assert list_cells(leakage=leakage)[1:] == [
        [LEAKAGE_OF_H, "+0.012 − 0.046i ± 0.001"],
        [LEAKAGE_OF_V, "−0.020 + 0.000i"],
    ]
    # A number of which a part is not known is left out: the line of the source is left.
    leakage = LeakageError(h=(None, 0.1), v=(0.1, None), source="scene")
    assert len(list_cells(leakage=leakage)) == 1
    leakage = LeakageError(v=(0.1, 0.2), std=(0.5, 0.25), source="scene")
    assert list_cells(leakage=leakage)[1:] == [[LEAKAGE_OF_V, "+0.100 + 0.200i ± 0.250"]]


@pytest.mark.parametrize(
    ("incidence", "cells"),
    [
        (IncidenceError(), []),
        (IncidenceError(deg=44.126), [["Incidence angle", "44.13°"]]),
        (IncidenceError(deg=44.126, std_deg=0.25), [["Incidence angle", "44.13° ± 0.25°"]]),
    ],
)
def test_an_angle_of_incidence_has_two_digits(incidence, cells):
    assert list_cells(incidence=incidence) == cells


@pytest.mark.parametrize(
    ("plane", "cells"),
    [
        (PlaneError(), [["Plane of the plates", "not found; that of the rig file is used"]]),
        (PlaneError(known=True, offset_mm=-1.26), [[PLANE, "−1.3 mm"]]),
        (PlaneError(known=True, offset_mm=2.0, offset_std_mm=0.34), [[PLANE, "+2.0 mm ± 0.3 mm"]]),
        (PlaneError(known=True), [[PLANE, "+0.0 mm"]]),
        (PlaneError(known=True, by="phase", plates=5), [[PLANE, "+0.0 mm"], ["Plane found by", "phase of 5 plates"]]),
        (PlaneError(known=True, by="range"), [[PLANE, "+0.0 mm"], ["Plane found by", "range"]]),
        (PlaneError(known=True, tilt_deg=(0.126, -0.5)),
         [[PLANE, "+0.0 mm"], ["Tilt of the plane", "+0.13° in x, −0.50° in y"]]),
        (PlaneError(known=True, tilt_deg=(None, -0.5)), [[PLANE, "+0.0 mm"]]),
        (PlaneError(known=True, tilt_deg=(0.5, None)), [[PLANE, "+0.0 mm"]]),
    ],
)  # fmt: skip
def test_a_plane_is_written_with_what_is_known_of_it(plane, cells):
    assert list_cells(plane=plane) == cells


def test_evidence_for_metal_is_a_score_and_the_ratio_of_the_channels():
    assert list_cells(metal=MetalScore(others=3)) == []
    text = "Evidence that the reference is metal"
    assert list_cells(metal=MetalScore(score=-2.04, others=3)) == [[text, "score −2.0 from 3 other patches"]]
    with_ratio = MetalScore(score=2.0, others=1, channel_ratio_db=-0.5)
    (cells,) = list_cells(metal=with_ratio)
    assert cells[1] == "score +2.0 from 1 other patches; V over H −0.5 dB relative to the direct path"
