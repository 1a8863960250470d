"""The report's table of the error budget: sources of error of a scan's permittivities, and how large each one is.

Known values have a sign and a standard deviation; unknown values have no line.
"""

import pytest

from polysight.report.report import _format_with_sign, make_budget_table
from polysight.results.materials import ErrorBudget, IncidenceError, LeakageError, MetalScore, PlaneError

LEAKAGE_OF_H = "Leakage of H, relative to its own channel"
LEAKAGE_OF_V = "Leakage of V, relative to its own channel"
PLANE = "Plane of the plates, relative to the rig file"


def list_cells(**parts) -> list[list[str]]:
    """The cells of each line in the table of an error budget with these parts; none if there is no table."""
    table = make_budget_table(ErrorBudget(**parts))
    if table is None:
        return []
    return [row["cells"] for row in table["rows"]]


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [(1.25, 1, "+1.2"), (-1.26, 1, "−1.3"), (-0.04, 1, "+0.0"), (0.0, 2, "+0.00"), (-0.04, 2, "−0.04")],
)
def test_a_number_is_written_with_its_sign_and_zero_with_a_plus(value, digits, text):
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
def test_the_table_says_how_the_leakage_was_found(source, text):
    assert list_cells(leakage=LeakageError(source=source)) == [["Leakage", text]]


def test_leakages_are_complex_numbers_with_their_errors():
    leakage = LeakageError(h=(0.0123, -0.0456), v=(-0.02, 0.0), std=(0.001, None), source="scene")
    _, *lines = list_cells(leakage=leakage)
    assert lines == [
        [LEAKAGE_OF_H, "+0.012 − 0.046i ± 0.001"],
        [LEAKAGE_OF_V, "−0.020 + 0.000i"],
    ]


def test_a_leakage_of_which_one_part_is_unknown_has_no_line():
    leakage = LeakageError(h=(None, 0.1), v=(0.1, None), source="scene")
    assert list_cells(leakage=leakage) == [["Leakage", "estimated from the scene"]]
    # The second error is that of V.
    leakage = LeakageError(v=(0.1, 0.2), std=(0.5, 0.25), source="scene")
    _, *lines = list_cells(leakage=leakage)
    assert lines == [[LEAKAGE_OF_V, "+0.100 + 0.200i ± 0.250"]]


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
def test_lines_on_the_plane_of_the_plates_have_known_values_only(plane, cells):
    assert list_cells(plane=plane) == cells


def test_evidence_for_metal_is_a_score_and_the_ratio_of_the_channels():
    assert list_cells(metal=MetalScore(others=3)) == []
    heading = "Evidence that the reference is metal"
    assert list_cells(metal=MetalScore(score=-2.04, others=3)) == [[heading, "score −2.0 from 3 other patches"]]
    with_ratio = MetalScore(score=2.0, others=1, channel_ratio_db=-0.5)
    text = "score +2.0 from 1 other patches; V over H −0.5 dB relative to the direct path"
    assert list_cells(metal=with_ratio) == [[heading, text]]
