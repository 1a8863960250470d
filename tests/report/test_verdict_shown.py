"""The report with a verdict: withheld results, ellipses with the right share of points, readable labels."""

import json
from dataclasses import replace
from html import unescape
from unittest.mock import patch

import msgspec
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from tests.support.products import (
    BUDGET,
    NAMES,
    PERMITTIVITY,
    REASON,
    make_result,
    make_segments,
    replace_results,
    skip_rendering,
    write_judged_products,
)

from polysight import open_scan
from polysight.materials import TruthPlate
from polysight.products import ProcessedScan, read_products
from polysight.report import write_report
from polysight.report.figures import draw_materials, draw_permittivity_map, find_phase_limits_deg
from polysight.report.permittivity_plot import SHARES, fit_ellipse, region_matrix
from polysight.report.report import make_budget_table
from polysight.report.style import RIGHT_IN, MapLabel, fit_labels, make_figure, shorten_labels
from polysight.results import ErrorBudget, PermittivityFigures
from polysight.results.verdict import LEVELS

RESULTS = (*NAMES, "2.90", "± 0.20", "ε′ ±")


def write_products(folder, rows=None) -> ProcessedScan:
    """Input of the report: names in patches, pixels and truth, and quality.json."""
    saved = read_products(folder)
    interior = np.zeros(saved.h.shape, bool)
    interior[5:9, 12:16] = True
    content = json.loads((folder / "materials.json").read_text(encoding="utf-8"))
    content |= {"segments": rows or make_segments("good"), "library": "Of its materials 1 could not be judged: copper."}
    return make_result(
        saved.images,
        {**content, "pixel_accuracy": 0.5, "model": "knn"},
        json.loads((folder / "quality.json").read_text(encoding="utf-8")),
        pixel_names={2: (np.array(["PET"] * 16), interior)},
        plates=(TruthPlate("acrylic", (-10.0, -20.0, 15.0, 20.0), 3 - 0.3j),),
    )


def collect_texts(make) -> str:
    """All texts of a figure."""
    collected: list[str] = []
    plain = Axes.text
    noted = Axes.annotate

    def text(self, x, y, s, *a, **k):
        collected.append(str(s))
        return plain(self, x, y, s, *a, **k)

    def annotate(self, s, *a, **k):
        collected.append(str(s))
        return noted(self, s, *a, **k)

    with patch.object(Axes, "text", text), patch.object(Axes, "annotate", annotate):
        make()
    return "\n".join(collected)


@pytest.mark.parametrize("level", LEVELS)
def test_the_page_begins_with_the_verdict_and_what_to_do(tmp_path, level):
    folder = write_judged_products(tmp_path, level)
    with skip_rendering():
        page = unescape(write_report(folder, write_products(folder)).read_text(encoding="utf-8"))
    head = page[page.index("<main>") : page.index('<ul class="keys">')]
    assert f'<span class="badge">{LEVELS[level]}</span>' in head
    for part in REASON.values():
        assert (part in head) == (level != "good")
    assert "estimated from the scene" in page
    assert "+2.4 mm ± 0.3 mm" in page
    assert "54.60° ± 0.12°" in page


def test_reasons_of_less_weight_are_folded(tmp_path):
    """A phone shows three of twenty reasons before a section is opened."""
    folder = write_judged_products(tmp_path, "care")
    verdict = {"level": "care", "reasons": [{**REASON, "what": f"reason {number}"} for number in range(1, 21)]}
    for name in ("quality.json", "materials.json"):
        content = json.loads((folder / name).read_text(encoding="utf-8"))
        (folder / name).write_text(json.dumps({**content, "verdict": verdict}), encoding="utf-8")
    with skip_rendering():
        page = write_report(folder, write_products(folder)).read_text(encoding="utf-8")
    head = page[page.index("<main>") : page.index('<ul class="keys">')]
    visible_part, _, folded_part = head.partition("17 more")
    assert "reason 3<" in visible_part
    assert "reason 4<" not in visible_part
    assert '<ol start="4">' in folded_part
    assert "reason 20<" in folded_part


@pytest.mark.parametrize("keep_withheld", [False, True])
def test_without_a_result_page_and_figures_name_nothing_and_keep_the_images(tmp_path, keep_withheld):
    folder = write_judged_products(tmp_path, "none", keep_withheld=keep_withheld)
    with skip_rendering():
        text = collect_texts(lambda: write_report(folder, write_products(folder)))
    text += collect_texts(lambda: open_scan(folder).plot())
    page = unescape((folder / "report.html").read_text(encoding="utf-8"))
    for part in (text, page[page.index("<main>") :]):
        assert [word for word in RESULTS if word in part] == []
    figure_names = {path.stem for path in (folder / "figures").iterdir()}
    assert {"amplitude_h", "amplitude_v", "amplitude_p", "phase_p", "materials"} <= figure_names
    assert not {"permittivity", "permittivity_map", "truth"} & figure_names


def test_usable_results_are_shown_with_errors_and_where_they_come_from(tmp_path):
    folder = write_judged_products(tmp_path, "care")
    page = unescape(write_report(folder, write_products(folder)).read_text(encoding="utf-8"))
    assert "2.90 ± 0.20" in page
    assert "0.20 ± 0.10" in page
    assert "leakage (60 %)" in page
    assert PERMITTIVITY["do"] in page
    assert "not judged: noise: its pixels do not agree; look at the image" in page
    assert (folder / "figures" / "permittivity_map.png").exists()


def test_products_of_earlier_releases_have_no_verdict_and_no_budget(tmp_path):
    folder = write_judged_products(tmp_path, None)
    with skip_rendering():
        page = unescape(write_report(folder, write_products(folder, make_segments(None))).read_text(encoding="utf-8"))
    assert 'class="verdict' not in page
    assert "Error budget" not in page
    assert "2.90 ± 0.20" in page
    assert make_budget_table(ErrorBudget()) is None


def test_the_inner_region_has_the_half_widths_that_hold_68_percent():
    covariance = [[0.04, 0.012], [0.012, 0.01]]
    figures = PermittivityFigures(real=2.9, imag=-0.2, covariance=covariance, half_widths_68=(0.1, 0.08))
    of_old_products = msgspec.structs.replace(figures, half_widths_68=None)
    inner = region_matrix(figures, 0.68)
    np.testing.assert_allclose(np.sqrt(np.diag(inner)), (0.1, 0.08))
    np.testing.assert_allclose(inner[0, 1] / (0.1 * 0.08), -0.012 / (0.2 * 0.1))
    np.testing.assert_array_equal(region_matrix(figures, 0.95), figures.spread.matrix)
    np.testing.assert_array_equal(region_matrix(of_old_products, 0.68), figures.spread.matrix)


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("mixed", [0.0, 0.9, -0.7])
def test_an_ellipse_holds_its_share_of_draws(share, mixed):
    std = np.array([0.3, 0.05])
    matrix = np.outer(std, std) * np.array([[1, mixed], [mixed, 1]])
    width, height, angle = fit_ellipse(matrix, share)
    draws = np.random.default_rng(5).multivariate_normal([0, 0], matrix, 100_000)
    turn = np.radians(angle)
    along = draws @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    inside = (along[:, 0] / (width / 2)) ** 2 + (along[:, 1] / (height / 2)) ** 2 <= 1
    assert inside.mean() == pytest.approx(share, abs=0.005)


def test_long_names_of_close_patches_become_numbers_that_do_not_touch(tmp_path):
    rows = [
        {**make_segments("good")[1], "label": 3 * i + k + 1, "name": f"polyethylene, high density, sheet {i} {k}",
         "box_mm": [16 * k - 24, 16 * i - 24, 16 * k - 10, 16 * i - 10]}
        for i in range(3) for k in range(3)
    ]  # fmt: skip
    scan = replace_results(write_products(write_judged_products(tmp_path, "good"), rows), pixel_names={}, plates=())
    fig = Figure(figsize=(4.6, 4.6), dpi=160, layout="constrained")
    FigureCanvasAgg(fig)
    labels = draw_materials(fig.add_subplot(), scan)
    assert shorten_labels(fig, labels) == labels
    fig.draw_without_rendering()
    boxes = [label.text.get_window_extent() for label in labels]
    assert not any(Bbox.intersection(a, b) for i, a in enumerate(boxes) for b in boxes[:i])
    assert draw_permittivity_map(scan) is not None


@pytest.mark.parametrize(("out_px", "replaced"), [(-20, 0), (0.9, 0), (1.1, 1)])
@pytest.mark.parametrize("side", ["left", "right"])
def test_a_name_may_leave_the_frame_by_a_pixel(side, out_px, replaced):
    fig = Figure(dpi=100)
    FigureCanvasAgg(fig)
    text = fig.text(0, 0.5, "acrylic", ha=side)
    inside = 1 if side == "left" else -1
    x_px = (0.0 if side == "left" else fig.bbox.x1) - inside * out_px
    text.set_x(x_px / fig.bbox.x1)
    edge = text.get_window_extent()
    # Text starts at whole pixels of its own: put its drawn edge where it is meant to be.
    drawn_px = edge.x0 if side == "left" else edge.x1
    text.set_x((2 * x_px - drawn_px) / fig.bbox.x1)
    assert len(shorten_labels(fig, [MapLabel(text, "1", "acrylic", "red")])) == replaced


@pytest.mark.parametrize("names", [1, 2, 3, 8, 30])
def test_a_legend_takes_just_the_room_below_the_axes(names):
    """The figure grows by the legend's height; the axes stay as large."""
    fig = make_figure(5, 4, RIGHT_IN)
    ax = fig.add_subplot()
    ax.set_xlabel("x, mm")
    height_px = ax.get_window_extent().height
    labels = [MapLabel(ax.text(0.9, 0.0, "polyethylene sheet"), "1", "polyethylene", "red") for _ in range(names)]
    fit_labels(fig, labels, RIGHT_IN)
    fig.draw_without_rendering()
    (legend,) = fig.legends
    free_px = ax.get_tightbbox().y0 - legend.get_window_extent().y1
    assert 0 <= free_px < 0.2 * fig.dpi
    assert ax.get_window_extent().height == pytest.approx(height_px)


def test_the_phase_of_p_has_the_range_of_the_patches_across_180_degrees(tmp_path):
    scan = write_products(write_judged_products(tmp_path, "good"))
    p = np.exp(1j * np.radians(np.where(np.arange(30) % 2, 170.0, -170.0)))[None, :] * np.ones((20, 1))
    limits = find_phase_limits_deg(replace_results(scan, images=replace(scan.images, p=p)))
    assert limits is not None
    low, high = limits
    assert high - low < 40
    assert any(low <= 170 + turn <= high and low <= 190 + turn <= high for turn in (-360, 0))
    assert find_phase_limits_deg(replace_results(scan, materials=None)) is None
    random = np.exp(2j * np.pi * np.random.default_rng(1).uniform(size=p.shape))
    assert find_phase_limits_deg(replace_results(scan, images=replace(scan.images, p=random))) is None


@pytest.mark.parametrize("key", BUDGET)
def test_an_error_budget_with_a_part_alone_is_shown(key):
    assert make_budget_table(msgspec.convert({key: BUDGET[key]}, ErrorBudget))
    assert make_budget_table(msgspec.convert({"plane": {"known": False}}, ErrorBudget))
