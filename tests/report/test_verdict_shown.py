"""The report shows the verdict on a scan, and no results if the verdict withholds them; its figures are readable.

A verdict says if results can be used (levels "good" and "care") or not ("none"). Regions of permittivity are ellipses.
"""

import itertools
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
from polysight.report.permittivity_plot import SHARES, compute_ellipse, region_matrix
from polysight.report.report import make_budget_table
from polysight.report.style import RIGHT_IN, MapLabel, fit_labels, make_figure, shorten_labels
from polysight.results import ErrorBudget, PermittivityFigures
from polysight.results.verdict import LEVELS

# The permittivity of the patch of PET and its standard error, as pages write them.
REAL = f"{PERMITTIVITY['real']:.2f}"
REAL_STD = f"{PERMITTIVITY['real_std']:.2f}"
# Texts that a page or figure has only if it shows results.
RESULTS = (*NAMES, REAL, f"± {REAL_STD}", "ε′ ±")


def load_result(folder, segments=None) -> ProcessedScan:
    """Load the products of a folder, with these patches instead of its own (default: those of a good scan).

    Names of pixels and a true plate are added.
    """
    saved = read_products(folder)
    interior = np.zeros(saved.h.shape, bool)
    interior[5:9, 12:16] = True
    content = json.loads((folder / "materials.json").read_text(encoding="utf-8"))
    content |= {
        "segments": segments or make_segments("good"),
        "library": "Of its materials 1 could not be judged: copper.",
        "pixel_accuracy": 0.5,
        "model": "knn",
    }
    true_plate = TruthPlate("acrylic", box_mm=(-10.0, -20.0, 15.0, 20.0), permittivity=3 - 0.3j)
    return make_result(
        saved.images,
        content=content,
        quality=json.loads((folder / "quality.json").read_text(encoding="utf-8")),
        # The interior of patch 2 has 16 pixels.
        pixel_names={2: (np.array(["PET"] * 16), interior)},
        plates=(true_plate,),
    )


def collect_texts(draw_figures) -> str:
    """All texts that `draw_figures()` writes into axes."""
    collected: list[str] = []
    original_text = Axes.text
    original_annotate = Axes.annotate

    def text(self, x, y, s, *arguments, **options):
        collected.append(str(s))
        return original_text(self, x, y, s, *arguments, **options)

    def annotate(self, s, *arguments, **options):
        collected.append(str(s))
        return original_annotate(self, s, *arguments, **options)

    with patch.object(Axes, "text", text), patch.object(Axes, "annotate", annotate):
        draw_figures()
    return "\n".join(collected)


def cut_head(page: str) -> str:
    """The first part of a page: title, verdict and its reasons."""
    after_beginning = page.split("<main>")[1]
    return after_beginning.split('<ul class="keys">')[0]


@pytest.mark.parametrize("level", LEVELS)
def test_the_page_begins_with_the_verdict_and_what_to_do(tmp_path, level):
    folder = write_judged_products(tmp_path, level)
    with skip_rendering():
        page = unescape(write_report(folder, load_result(folder)).read_text(encoding="utf-8"))
    head = cut_head(page)
    assert f'<span class="badge">{LEVELS[level]}</span>' in head
    for part in REASON.values():
        if level == "good":
            assert part not in head
        else:
            assert part in head
    # The error budget is on the page for every level.
    plane = BUDGET["plane"]
    incidence = BUDGET["incidence"]
    assert "estimated from the scene" in page
    assert f"{plane['offset_mm']:+.1f} mm ± {plane['offset_std_mm']:.1f} mm" in page
    assert f"{incidence['deg']:.2f}° ± {incidence['std_deg']:.2f}°" in page


def test_the_page_shows_three_reasons_and_the_others_when_a_section_is_opened(tmp_path):
    folder = write_judged_products(tmp_path, "care")
    reasons = [{**REASON, "what": f"reason {number}"} for number in range(1, 21)]
    verdict = {"level": "care", "reasons": reasons}
    for name in ("quality.json", "materials.json"):
        content = json.loads((folder / name).read_text(encoding="utf-8"))
        (folder / name).write_text(json.dumps({**content, "verdict": verdict}), encoding="utf-8")
    with skip_rendering():
        page = write_report(folder, load_result(folder)).read_text(encoding="utf-8")
    visible_part, _, folded_part = cut_head(page).partition("17 more")
    assert "reason 3<" in visible_part
    assert "reason 4<" not in visible_part
    assert '<ol start="4">' in folded_part
    assert "reason 20<" in folded_part


@pytest.mark.parametrize("keep_withheld", [False, True])
def test_if_results_are_withheld_page_and_figures_show_images_without_names_and_permittivities(tmp_path, keep_withheld):
    """With `keep_withheld` the files contain the results nevertheless, as a faulty program could write them."""
    folder = write_judged_products(tmp_path, "none", keep_withheld=keep_withheld)
    with skip_rendering():
        texts_in_figures = collect_texts(lambda: write_report(folder, load_result(folder)))
    texts_in_figures += collect_texts(lambda: open_scan(folder).plot())
    page = unescape((folder / "report.html").read_text(encoding="utf-8"))
    _, shown_page = page.split("<main>")
    for result in RESULTS:
        assert result not in texts_in_figures
        assert result not in shown_page
    figure_names = {path.stem for path in (folder / "figures").iterdir()}
    assert {"amplitude_h", "amplitude_v", "amplitude_p", "phase_p", "materials"} <= figure_names
    assert not {"permittivity", "permittivity_map", "truth"} & figure_names


def test_usable_results_are_shown_with_their_errors_and_the_largest_source_of_error(tmp_path):
    folder = write_judged_products(tmp_path, "care")
    page = unescape(write_report(folder, load_result(folder)).read_text(encoding="utf-8"))
    assert f"{REAL} ± {REAL_STD}" in page
    # The loss is minus the imaginary part of the permittivity.
    assert f"{-PERMITTIVITY['imag']:.2f} ± {PERMITTIVITY['imag_std']:.2f}" in page
    assert f"leakage ({PERMITTIVITY['shares']['leakage']:.0%})".replace("%", " %") in page
    assert PERMITTIVITY["do"] in page
    assert "not judged: noise: its pixels do not agree; look at the image" in page
    assert (folder / "figures" / "permittivity_map.png").exists()


def test_products_of_earlier_releases_have_no_verdict_and_no_budget(tmp_path):
    folder = write_judged_products(tmp_path, level=None)
    segments_of_earlier_releases = make_segments(level=None)
    with skip_rendering():
        report = write_report(folder, load_result(folder, segments_of_earlier_releases))
    page = unescape(report.read_text(encoding="utf-8"))
    assert 'class="verdict' not in page
    assert "Error budget" not in page
    assert f"{REAL} ± {REAL_STD}" in page
    assert make_budget_table(ErrorBudget()) is None


def test_the_68_percent_region_has_the_given_half_widths_and_the_correlation_of_the_covariance():
    std_real = 0.2
    std_loss = 0.1
    covariance_of_parts = 0.012
    covariance = [[std_real**2, covariance_of_parts], [covariance_of_parts, std_loss**2]]
    figures = PermittivityFigures(real=2.9, imag=-0.2, covariance=covariance, half_widths_68=(0.1, 0.08))
    inner = region_matrix(figures, 0.68)
    np.testing.assert_allclose(np.sqrt(np.diag(inner)), (0.1, 0.08))
    # The loss is minus the imaginary part: the covariance changes its sign.
    np.testing.assert_allclose(inner[0, 1] / (0.1 * 0.08), -covariance_of_parts / (std_real * std_loss))
    np.testing.assert_array_equal(region_matrix(figures, 0.95), figures.spread.matrix)
    # Files of earlier releases have no half widths.
    without_half_widths = msgspec.structs.replace(figures, half_widths_68=None)
    np.testing.assert_array_equal(region_matrix(without_half_widths, 0.68), figures.spread.matrix)


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("correlation", [0.0, 0.9, -0.7])
def test_an_ellipse_contains_its_share_of_a_normal_distribution(share, correlation):
    std = np.array([0.3, 0.05])
    matrix = np.outer(std, std) * np.array([[1, correlation], [correlation, 1]])
    width, height, angle_deg = compute_ellipse(matrix, share)
    x, y = np.random.default_rng(5).multivariate_normal([0, 0], matrix, 100_000).T
    # Coordinates along the axes of the ellipse.
    angle = np.radians(angle_deg)
    along = x * np.cos(angle) + y * np.sin(angle)
    across = y * np.cos(angle) - x * np.sin(angle)
    is_inside = (along / (width / 2)) ** 2 + (across / (height / 2)) ** 2 <= 1
    # The standard error of a share of 100,000 numbers is 0.0015 at most.
    assert is_inside.mean() == pytest.approx(share, abs=0.005)


def test_long_names_of_close_patches_become_numbers_that_do_not_touch(tmp_path):
    """Nine patches of 14 mm, 2 mm apart."""
    _, pet, _ = make_segments("good")
    segments = []
    for row in range(3):
        for column in range(3):
            left = 16 * column - 24
            bottom = 16 * row - 24
            segment = pet | {
                "label": 3 * row + column + 1,
                "name": f"polyethylene, high density, sheet {row} {column}",
                "box_mm": [left, bottom, left + 14, bottom + 14],
            }
            segments.append(segment)
    result = load_result(write_judged_products(tmp_path, "good"), segments)
    scan = replace_results(result, pixel_names={}, plates=())
    fig = Figure(figsize=(4.6, 4.6), dpi=160, layout="constrained")
    FigureCanvasAgg(fig)
    labels = draw_materials(fig.add_subplot(), scan)
    assert shorten_labels(fig, labels) == labels
    fig.draw_without_rendering()
    boxes = [label.text.get_window_extent() for label in labels]
    for box, other_box in itertools.combinations(boxes, 2):
        assert not Bbox.intersection(box, other_box)
    assert draw_permittivity_map(scan) is not None


@pytest.mark.parametrize(("px_outside", "names_replaced"), [(-20, 0), (0.9, 0), (1.1, 1)])
@pytest.mark.parametrize("side", ["left", "right"])
def test_a_name_that_leaves_the_frame_by_more_than_a_pixel_is_replaced_by_a_number(side, px_outside, names_replaced):
    fig = Figure(dpi=100)
    FigureCanvasAgg(fig)
    text = fig.text(0, 0.5, "acrylic", ha=side)
    if side == "left":
        edge_px = -px_outside
    else:
        edge_px = fig.bbox.x1 + px_outside
    text.set_x(edge_px / fig.bbox.x1)
    # Text is drawn at whole pixels: shift it back by the distance of its drawn edge from the intended one.
    drawn_box = text.get_window_extent()
    drawn_edge_px = drawn_box.x0 if side == "left" else drawn_box.x1
    rounding_px = drawn_edge_px - edge_px
    text.set_x((edge_px - rounding_px) / fig.bbox.x1)
    label = MapLabel(text, number="1", name="acrylic", colour="red")
    assert len(shorten_labels(fig, [label])) == names_replaced


@pytest.mark.parametrize("names", [1, 2, 3, 8, 30])
def test_a_legend_enlarges_the_figure_by_its_height_and_leaves_the_axes_as_large(names):
    fig = make_figure(5, 4, RIGHT_IN)
    ax = fig.add_subplot()
    ax.set_xlabel("x, mm")
    height_px = ax.get_window_extent().height
    labels = []
    for _ in range(names):
        text = ax.text(0.9, 0.0, "polyethylene sheet")
        labels.append(MapLabel(text, number="1", name="polyethylene", colour="red"))
    fit_labels(fig, labels, RIGHT_IN)
    fig.draw_without_rendering()
    (legend,) = fig.legends
    gap_px = ax.get_tightbbox().y0 - legend.get_window_extent().y1
    # A line of the legend is about 0.2 inches high: the gap has no room for another line.
    line_px = 0.2 * fig.dpi
    assert 0 <= gap_px < line_px
    assert ax.get_window_extent().height == pytest.approx(height_px)


def test_phases_on_both_sides_of_180_degrees_have_a_narrow_range_of_colours(tmp_path):
    scan = load_result(write_judged_products(tmp_path, "good"))
    # 170 and -170 degrees in alternate columns.
    phases_deg = np.full(scan.p.shape, -170.0)
    phases_deg[:, 1::2] = 170.0
    images = replace(scan.images, p=np.exp(1j * np.radians(phases_deg)))
    limits = find_phase_limits_deg(replace_results(scan, images=images))
    assert limits is not None
    low, high = limits
    # On either side there is a margin of 15 %, and the limit is rounded away to a multiple of 5 degrees.
    span_deg = 190 - 170
    most_added_deg = 0.15 * span_deg + 5
    assert high - low <= span_deg + 2 * most_added_deg
    # The limits may be 360 degrees lower.
    assert (low <= 170 and high >= 190) or (low <= 170 - 360 and high >= 190 - 360)


def test_phases_without_patches_or_around_the_whole_circle_have_no_range_of_colours(tmp_path):
    scan = load_result(write_judged_products(tmp_path, "good"))
    assert find_phase_limits_deg(replace_results(scan, materials=None)) is None
    random_p = np.exp(2j * np.pi * np.random.default_rng(1).uniform(size=scan.p.shape))
    assert find_phase_limits_deg(replace_results(scan, images=replace(scan.images, p=random_p))) is None


@pytest.mark.parametrize("key", BUDGET)
def test_an_error_budget_with_a_single_part_is_shown(key):
    assert make_budget_table(msgspec.convert({key: BUDGET[key]}, ErrorBudget))


def test_an_error_budget_says_that_the_plane_is_not_known():
    assert make_budget_table(msgspec.convert({"plane": {"known": False}}, ErrorBudget))
