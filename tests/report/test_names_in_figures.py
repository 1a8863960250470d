"""Names in any script: figures draw them without warnings, and the page shows each in full."""

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


def make_row(label: int, name: str, truth: str) -> dict:
    return {
        "label": label, "name": name, "confidence": 0.9, "metal_reference": False, "metal_like": False,
        "centre_mm": [0, 0], "box_mm": [-20, -20, 20, 20], "outline_mm": [], "permittivity": PERMITTIVITY,
        "ratio": {"real": 4.4, "imag": 0.6}, "interior_pixels": 9, "metal_distance": 1.0,
        "truth": {"name": truth, "metal": False, "permittivity": {"real": 4.0, "imag": -0.4}},
    }  # fmt: skip


def make_result_of_names(names: list[str]) -> ProcessedScan:
    image = np.full((12, 12), 0.5 + 0.1j, np.complex64)
    axis = np.linspace(-0.05, 0.05, 12)
    return make_result(
        Images(image, image / 2, axis, axis, np.ones((12, 12), bool), image * 2),
        {"segments": [make_row(k, name, name) for k, name in enumerate(names, 1)]},
        {},
        facts=ScanFacts(scan_id=" ".join(names), simulated=True),
        plates=tuple(TruthPlate(name, (-20, -20, 20, 20), 4 - 0.4j) for name in names),
    )


@pytest.fixture(autouse=True)
def make_warnings_errors():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def test_figures_and_page_of_names_are_made_without_warnings(tmp_path):
    """All names in one report, because a report takes seconds; all of them in its title."""
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
