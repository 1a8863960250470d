"""The report is one file, loads no other files, and marks simulated data."""

import base64
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from tests.support.page.chromium import PHONE
from tests.support.products import make_result, replace_results, skip_rendering
from tests.support.rigs import load_rig_table

from polysight.imaging import Images
from polysight.materials import TruthPlate
from polysight.process.quality import find_masked_runs
from polysight.report import write_report
from polysight.report.figures import draw_coverage_figure, find_masked_positions
from polysight.report.report import format_value, make_imaging_table, make_quality_tables, render
from polysight.report.style import encode_png
from polysight.results import RxGain, ScanFacts, ScanMaterials, ScanQuality
from polysight_shared.raster import RasterPlan

PNG = b"\x89PNG\r\n\x1a\n"


class Page(HTMLParser):
    """Collects what a browser would load or show."""

    def __init__(self, html):
        super().__init__()
        self.sources = []
        self.text = []
        self.tags = []
        self._hidden = 0
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self._hidden += tag in ("style", "script")
        self.sources += [v for k, v in attrs if k in ("src", "href", "srcset", "data", "poster", "action")]

    def handle_endtag(self, tag):
        self._hidden -= tag in ("style", "script")

    def handle_data(self, data):
        if not self._hidden:
            self.text.append(data)

    @property
    def words(self):
        return " ".join(" ".join(self.text).split())


COMMON = {"votes": {}, "distance": 0.2, "pixels": 400, "interior_pixels": 100, "incidence_deg": 55.0}
MATERIALS = [
    {
        **COMMON, "label": 1, "name": "copper", "confidence": 1.0, "metal_reference": True, "metal_like": True,
        "box_mm": [-50, -20, -10, 20], "outline_mm": [[-50, -20], [-10, -20], [-10, 20]], "permittivity": None,
        "ratio": {"real": 1.0, "imag": 0.0}, "truth": {"name": "copper", "metal": True, "permittivity": None},
    },
    {
        **COMMON, "label": 2, "name": "PET <b>", "confidence": 0.62, "metal_reference": False, "metal_like": False,
        "box_mm": [10, -20, 50, 20], "outline_mm": [],
        "permittivity": {"real": 3.9, "imag": -0.6, "real_p30_p70": [3.8, 4.0], "imag_p30_p70": [-0.7, -0.5]},
        "ratio": {"real": 4.4, "imag": 0.6},
        "truth": {"name": "acrylic", "metal": False, "permittivity": {"real": 4.0, "imag": -0.4}},
    },
]  # fmt: skip
TRUTH = (
    TruthPlate("copper", (-50, -20, -10, 20), None),
    TruthPlate("acrylic", (10, -20, 50, 20), 4 - 0.4j),
    TruthPlate("cork", (-10, 30, 10, 50), 10.6 - 0j),
)
QUALITY = {
    "boards": {
        "RH": {
            "frames_expected": 1000,
            "frames_received": 998,
            "frames_masked": 2,
            "synchronisation": {"averaged": {"frequency_std_hz": 31.0, "phase_std_rad": 0.005}},
        }
    },
    "rows_retaken": 3,
    "seconds_per_stage": {"align": 2.0, "image": 0.5},
}


def draw_two_plates():
    """Images H, V and their ratio, complex64 [61, 61], of two plates in noise; int32 labels of their pixels."""
    rng = np.random.default_rng(0)
    h = 0.02 * (rng.standard_normal((61, 61)) + 1j * rng.standard_normal((61, 61)))
    v = 0.02 * (rng.standard_normal((61, 61)) + 1j * rng.standard_normal((61, 61)))
    segments = np.zeros((61, 61), np.int32)
    segments[20:40, 5:25] = 1
    segments[20:40, 35:55] = 2
    h[segments == 1] = 1
    v[segments == 1] = 1
    h[segments == 2] = 0.52
    v[segments == 2] = 0.12 - 0.02j
    v[0, 0] = 0
    with np.errstate(divide="ignore"):
        p = (h / v).astype(np.complex64)
    return h.astype(np.complex64), v.astype(np.complex64), p, segments


@pytest.fixture(scope="module")
def scan():
    """Two plates, one of them named wrong, and a third that was not found."""
    h, v, p, segments = draw_two_plates()
    x = np.linspace(-0.06, 0.06, 61)
    interior = np.zeros((61, 61), bool)
    interior[25:35, 40:50] = True
    return make_result(
        Images(h, v, x, x + 0.1, np.ones((61, 61), bool), p),
        {
            "segments": MATERIALS, "pixel_accuracy": 0.5, "library": "a library.", "model": "knn",
            "metal_reference": {"how": "given as patch 1"},
        },
        QUALITY,
        facts=ScanFacts(scan_id="of two <plates> & more", simulated=True, processed_utc="2026-11-23T10:00:00+00:00"),
        labels=segments,
        pixel_names={2: (np.array(["PET <b>", "unknown"] * 50), interior)},
        plates=TRUTH,
        expected_accuracy=0.96,
    )  # fmt: skip


@pytest.fixture(scope="module")
def page(scan, tmp_path_factory):
    out = tmp_path_factory.mktemp("report")
    path = write_report(out, scan)
    return out, path.read_text(encoding="utf-8")


def test_a_phone_shows_the_result_before_anything_is_opened(page, browser):
    """Two screens of verdict and picture, then the names: not the images, tables and settings."""
    browser.visit((page[0] / "report.html").as_uri(), PHONE)
    browser.wait("document.readyState == 'complete'", "the report")
    assert browser.evaluate("document.documentElement.scrollHeight") <= 4000
    assert browser.evaluate("document.documentElement.scrollWidth") == PHONE[0]
    assert browser.evaluate("document.querySelectorAll('details[open]').length") == 0


def test_a_phone_shows_nine_patches_and_many_reasons_in_as_much(scan, browser, tmp_path):
    """A report as long as those of disturbed scenes; its figures are of the scan of two plates."""
    texts = {
        "what": "plates are rough, wavy or bent: the phase of H scatters by 4 degrees, more than flat ones do",
        "why": "an uneven surface is seen from other places by H and V; errors are larger, counted by the scatter",
        "do": "fit it as a layer (polysight permittivity --layer), or lay plates and metal flat and free of others",
    }
    quality = QUALITY | {"verdict": {"level": "care", "reasons": [texts] * 7}}
    plate = MATERIALS[1] | {"name": "cardboard (rough, in two lines)"}
    patches = [MATERIALS[0], *(plate | {"label": number} for number in range(2, 10))]
    content = {"segments": patches, "library": "a library of nine materials from 16 scans. " * 10, "model": "knn"}
    busy = replace_results(scan, quality=ScanQuality.decode(quality), materials=ScanMaterials.decode(content))
    assert busy.verdict is not None
    write_report(tmp_path, busy)
    browser.visit((tmp_path / "report.html").as_uri(), PHONE)
    browser.wait("document.readyState == 'complete'", "the report")
    assert browser.evaluate("document.querySelectorAll('ol > li').length") == 7
    assert browser.evaluate("document.documentElement.scrollHeight") <= 4000


def test_nothing_is_loaded_from_elsewhere(page):
    _, html = page
    assert not re.search(r"(?:https?:)?//[a-z0-9]", re.sub(r"base64,[A-Za-z0-9+/=]+", "", html), re.IGNORECASE)
    parsed = Page(html)
    assert parsed.sources
    assert all(s.startswith("data:image/png;base64,") for s in parsed.sources)
    assert not {"script", "link", "iframe", "object"} & set(parsed.tags)
    assert "@import" not in html
    assert "url(" not in html


def test_images_are_embedded_and_saved_in_the_folder_of_the_page(page):
    out, html = page
    inline = [base64.b64decode(s.partition(",")[2]) for s in Page(html).sources]
    files = {p.name: p.read_bytes() for p in (out / "figures").iterdir()}
    assert len(files) == 9
    assert all(data.startswith(PNG) for data in files.values())
    assert sorted(inline) == sorted(files.values())
    assert {
        "amplitude_h.png",
        "amplitude_v.png",
        "amplitude_p.png",
        "phase_p.png",
        "materials.png",
        "truth.png",
    } <= set(files)
    assert sorted(p.name for p in out.iterdir()) == ["figures", "report.html"]


def test_every_output_is_labelled_as_simulated(page):
    _, html = page
    words = Page(html).words
    assert words.startswith("SIMULATED: Scan of two")
    assert words.count("SIMULATED") >= 3 + html.count("<figure") + html.count("<caption")
    for alt in re.findall(r'alt="([^"]*)"', html):
        assert "simulated" in alt


def test_measured_data_is_not_called_simulated(scan, tmp_path):
    with skip_rendering():
        html = write_report(tmp_path, replace_results(scan, facts=ScanFacts(simulated=False))).read_text(
            encoding="utf-8"
        )
    assert "simulated" not in Page(html).words.lower()


def test_results_are_shown_with_the_truth(page):
    _, html = page
    words = Page(html).words
    assert "0 of 2 plates named right" in words  # the metal is a reference, not a result
    assert "50.0 % of interior pixels named right; their own confidence expects 96.0 %" in words
    assert "✗ acrylic" in words
    assert "✓ copper" in words
    assert "Not found: cork" in words
    assert "-2.5 %" in words
    assert "(3.80 … 4.00)" in words
    assert "metal-like" in words
    assert "99.80 % of 1000 frames of recorded rows received" in words
    assert "RH phase (rad)" in words
    assert "frames masked 2" in words
    assert "averaged 31 0.005" in words
    assert "rows retaken" in words
    assert "Nothing of this instrument has run on hardware yet." in words


def test_names_cannot_break_the_page(page):
    _, html = page
    assert "PET <b>" not in html
    assert "PET &lt;b&gt;" in html
    assert "two &lt;plates&gt; &amp; more" in html


def test_bare_images_make_a_report_too(scan, tmp_path):
    bare = make_result(scan.images, None, {})
    words = Page(write_report(tmp_path, bare).read_text(encoding="utf-8")).words
    assert "Images" in words
    assert "Materials" not in words
    assert "Quality" not in words


def test_dark_and_invalid_images_do_not_fail(scan, tmp_path):
    zero = np.zeros_like(scan.h)
    dark = Images(zero, zero, scan.x_m, scan.y_m, np.zeros(zero.shape, bool), zero * np.complex64(np.nan))
    assert write_report(tmp_path, make_result(dark, {}, {})).exists()


def replace_boards(scan, boards):
    return replace_results(scan, plan=RasterPlan(6, 4, 10.0, 5.0), quality=ScanQuality.decode({"boards": boards}))


def test_masked_positions_come_out_of_runs_and_of_rows_that_are_absent(scan):
    boards = {"RH": {"masked_columns": {"2": [[0, 2], [5, 6]]}, "rows_recorded": [0, 1, 2]}}
    mask = find_masked_positions(replace_boards(scan, boards))["RH"]
    assert np.argwhere(mask).tolist() == [[2, 0], [2, 1], [2, 5], *([3, c] for c in range(6))]


def test_runs_and_their_mask_are_the_same(scan):
    rng = np.random.default_rng(5)
    for share in (0.0, 0.3, 1.0):
        rows = rng.uniform(size=(4, 6)) < share
        runs = {str(i): find_masked_runs(row) for i, row in enumerate(rows) if row.any()}
        masks = find_masked_positions(
            replace_boards(scan, {"RH": {"masked_columns": runs, "rows_recorded": [0, 1, 2, 3]}})
        )
        assert (masks["RH"] == rows).all()


def test_the_report_has_the_masked_data_the_gains_and_the_whole_rig_file(scan):
    boards = {"RH": {"masked_columns": {"2": [[0, 3]]}, "rows_recorded": [0, 1, 2, 3], "raw_crc32": {"0": "deadbeef"}}}
    gains = {"RH": [RxGain(0.0, 0.0), RxGain(1.25, -8.1)]}
    rig = load_rig_table() | {"name": "a <rig>"}
    answer = replace_results(
        replace_boards(scan, boards), facts=ScanFacts(simulated=True, rx_gains=gains, instrument=rig)
    )
    picture = encode_png(draw_coverage_figure(answer, find_masked_positions(answer)))
    page = Page(render(answer, {"coverage": picture}))
    assert base64.b64encode(picture).decode() in page.sources[0]
    assert "RH 3 of 24 (12.50%)" in page.words
    assert "+1.25 dB" in page.words
    assert "-8.1°" in page.words
    assert 'name = "a <rig>"' in page.words
    assert "deadbeef" not in page.words


BOARD = {
    "masked_positions": 12,
    "rows_without_data": 0,
    "loss_db": 0.0437,
    "frequencies": 10,
    "point_width_mm": [7.512, 5.1],
    "point_limit_mm": [5.4, 3.6],
    "point_paper_mm": [2.8, None],
}


def test_the_imaging_table_has_a_column_for_each_board_and_marks_unknown_values():
    table = make_imaging_table(
        {"RH": BOARD, "RV": {"masked_positions": 70000}, "notices": ["RV: imaging by direct sum"]}
    )
    assert table["head"] == ["Board", "RH", "RV"]
    cells = {row["cells"][0]: row["cells"][1:] for row in table["rows"]}
    assert cells["Positions masked"] == ["12", "70000"]
    assert cells["Point response at half power, x × y (mm)"] == ["7.51 × 5.1", "–"]
    assert cells["The paper's r λ / L, x × y (mm)"] == ["2.8 × –", "–"]
    assert "direct sum" in table["caption"]


def replace_every_number(content, value):
    """The content with each number that is not a count replaced."""
    if isinstance(content, dict):
        # A result of a value that is not a number has no permittivity and no ratio.
        required = ("permittivity", "ratio", "seconds_per_stage")
        return {key: item if key in required else replace_every_number(item, value) for key, item in content.items()}
    if isinstance(content, list):
        return [replace_every_number(item, value) for item in content]
    return value if isinstance(content, float) else content


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_none_are_shown_as_not_known(scan, value):
    """New results may contain NaN or infinity; products have null instead."""
    figures = replace_every_number({"segments": MATERIALS, "quality": QUALITY}, value)
    changed_scan = replace_results(
        scan,
        materials=ScanMaterials.decode(
            {"segments": figures["segments"], "pixel_accuracy": value, "library": "", "model": "knn",
             "metal_reference": {"how": "given"}}
        ),
        quality=ScanQuality.decode(figures["quality"]),
        expected_accuracy=value,
    )  # fmt: skip
    with skip_rendering():
        html = render(changed_scan, {})
    words = re.findall(r"[\w.]+", Page(html).words.lower())
    assert not {"nan", "inf", "infinity"} & set(words), [w for w in words if w in ("nan", "inf")]
    assert format_value(value) == "–"


@pytest.mark.parametrize(
    ("name", "in_library", "text"),
    [
        ("unknown", False, "acrylic"), ("unknown", True, "✗ acrylic"),
        ("PET", False, "✗ acrylic"), ("acrylic", True, "✓ acrylic"),
    ],
)  # fmt: skip
def test_a_foreign_material_that_is_called_unknown_is_neither_right_nor_wrong(scan, name, in_library, text):
    foreign = MATERIALS[1] | {"name": name, "truth": MATERIALS[1]["truth"] | {"in_library": in_library}}
    # As read from a file.
    figures = json.loads(json.dumps({"segments": [MATERIALS[0], foreign], "library": "", "model": "knn"}))
    figures |= {"pixel_accuracy": 0.5, "metal_reference": {"how": "given"}}
    with skip_rendering():
        words = Page(render(replace_results(scan, materials=ScanMaterials.decode(figures)), {})).words
    assert text in words
    assert ("✗ acrylic" in words) is (text == "✗ acrylic")
    assert ("✓ acrylic" in words) is (text == "✓ acrylic")
    assert ("not in the library" in words) is (text == "acrylic")


def test_a_standard_deviation_is_not_shown_as_the_value():
    boards = {"RH": {"stage_backlash_mm": {"shift": 0.12, "std": 0.01}}}
    (table,) = make_quality_tables({"boards": boards})
    cells = [row["cells"] for row in table["rows"]]
    assert cells == [["stage backlash shift (mm)", "0.12"], ["stage backlash std (mm)", "0.01"]]


def test_a_scene_without_plates_to_name_has_no_count_of_them(scan):
    """Such as a metal plate alone, processed with itself as the reference."""
    assert scan.named_plates is not None
    metal = [plate for plate in scan.plates if plate.permittivity is None]
    assert replace_results(scan, plates=metal).named_plates is None
