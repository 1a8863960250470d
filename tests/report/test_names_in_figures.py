"""Names of materials in any script: the report's figures draw them without warnings, and its page shows each in full.

A character that no font has is a question mark in figures; a list on the page then gives the full name.
"""

import warnings
from html import unescape

import numpy as np
import pytest
from tests.support.products import make_result

from polysight.imaging import Images
from polysight.materials import TruthPlate
from polysight.products import ProcessedScan
from polysight.report.report import render, write_report
from polysight.report.style import figure_label, is_drawable
from polysight.results import ScanFacts

NAMES = ["木板", "ガラス", "유리 3", "стекло", "Plexiglas®", "\U0001f9f1 brick", "tab\there", "a $b$ c_{", "زجاج"]
PERMITTIVITY = {"real": 3.9, "imag": -0.6, "real_p30_p70": [3.8, 4.0], "imag_p30_p70": [-0.7, -0.5]}


def make_patch(label: int, name: str) -> dict:
    """A patch of this name in materials.json; its true name is the same."""
    return {
        "label": label, "name": name, "confidence": 0.9, "metal_reference": False, "metal_like": False,
        "centre_mm": [0, 0], "box_mm": [-20, -20, 20, 20], "outline_mm": [], "permittivity": PERMITTIVITY,
        "ratio": {"real": 4.4, "imag": 0.6}, "interior_pixels": 9, "metal_distance": 1.0,
        "truth": {"name": name, "metal": False, "permittivity": {"real": 4.0, "imag": -0.4}},
    }  # fmt: skip


def make_result_of_names(names: list[str]) -> ProcessedScan:
    """Result of a scan with a patch and a true plate of each name, which are all in the title, too."""
    image = np.full((12, 12), 0.5 + 0.1j, np.complex64)
    axis_m = np.linspace(-0.05, 0.05, 12)
    plates = [TruthPlate(name, box_mm=(-20, -20, 20, 20), permittivity=4 - 0.4j) for name in names]
    return make_result(
        Images(h=image, v=image / 2, x_m=axis_m, y_m=axis_m, valid=np.ones((12, 12), bool), p=image * 2),
        content={"segments": [make_patch(label, name) for label, name in enumerate(names, 1)]},
        quality={},
        facts=ScanFacts(scan_id=" ".join(names), simulated=True),
        plates=tuple(plates),
    )


@pytest.fixture(autouse=True)
def turn_warnings_into_errors():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def test_a_report_with_names_in_many_scripts_is_made_without_warnings_and_shows_them_in_full(tmp_path):
    """One report has all names, because a report takes seconds."""
    html = unescape(write_report(tmp_path, make_result_of_names(NAMES)).read_text(encoding="utf-8"))
    for number, name in enumerate(NAMES, 1):
        assert name in html
        if not is_drawable(name):
            assert f"patch {number}: {figure_label(name, 'x').removeprefix('x: ')}" in html


def test_the_page_lists_names_whose_characters_no_font_has():
    # A character that is for private use, and a Chinese one.
    without_font = "\U0010fffd木"
    html = render(make_result_of_names([without_font, "PET"]), {})
    assert f"patch 1: ?? is {without_font}" in html
    assert f"plate 1: ?? is {without_font}" in html
    assert "is PET" not in html
    assert "fonts do not have" not in render(make_result_of_names(["PET"]), {})


@pytest.mark.parametrize(
    "name", ["\u05e0\u05d7\u05d5\u05e9\u05ea", "\u0646\u062d\u0627\u0633"], ids=["Hebrew", "Arabic"]
)
def test_a_name_that_runs_from_right_to_left_is_not_drawn_backwards(name):
    assert figure_label(name, "patch 3").startswith("patch 3: ")
