"""The report on a scan: an HTML page that loads no other files, shows all results and says if they are simulated."""

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
    """The tags of a page, the addresses from which a browser would load or to which it would link, and its text."""

    def __init__(self, html):
        super().__init__()
        self.sources = []
        self.text = []
        self.tags = []
        # Number of open tags whose text a browser does not show.
        self._hidden = 0
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self._hidden += tag in ("style", "script")
        for name, value in attrs:
            if name in ("src", "href", "srcset", "data", "poster", "action"):
                self.sources.append(value)

    def handle_endtag(self, tag):
        self._hidden -= tag in ("style", "script")

    def handle_data(self, data):
        if not self._hidden:
            self.text.append(data)

    @property
    def words(self):
        """The shown text with single spaces."""
        return " ".join(" ".join(self.text).split())


# Less than five screens of a phone, which is 844 pixels high.
MAX_HEIGHT_PX = 4000
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
TRUE_PLATES = (
    TruthPlate("copper", box_mm=(-50, -20, -10, 20), permittivity=None),
    TruthPlate("acrylic", box_mm=(10, -20, 50, 20), permittivity=4 - 0.4j),
    TruthPlate("cork", box_mm=(-10, 30, 10, 50), permittivity=10.6 - 0j),
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
    """Result of a scan of three plates: copper, acrylic that was named PET, and cork that was not found."""
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
        plates=TRUE_PLATES,
        expected_accuracy=0.96,
    )  # fmt: skip


@pytest.fixture(scope="module")
def page(scan, tmp_path_factory):
    """Folder of the report, and its HTML."""
    out = tmp_path_factory.mktemp("report")
    path = write_report(out, scan)
    return out, path.read_text(encoding="utf-8")


def test_a_phone_shows_verdict_picture_and_names_with_everything_else_folded_away(page, browser):
    """Images, tables and settings are shown when the reader opens them."""
    out, _ = page
    phone_width_px, *_ = PHONE
    browser.visit((out / "report.html").as_uri(), PHONE)
    browser.wait("document.readyState == 'complete'", "the report")
    assert browser.evaluate("document.documentElement.scrollHeight") <= MAX_HEIGHT_PX
    assert browser.evaluate("document.documentElement.scrollWidth") == phone_width_px
    assert browser.evaluate("document.querySelectorAll('details[open]').length") == 0


def test_the_report_on_nine_patches_and_seven_reasons_is_not_longer_on_a_phone(scan, browser, tmp_path):
    """Reports on disturbed scenes are as long as this one. Its figures are those of the scan of three plates."""
    reason = {
        "what": "plates are rough, wavy or bent: the phase of H scatters by 4 degrees, more than flat ones do",
        "why": "H and V see an uneven surface from different places; the errors are larger, and include this scatter",
        "do": "fit it as a layer (polysight permittivity --layer), or lay plates and metal flat and free of others",
    }
    quality = QUALITY | {"verdict": {"level": "care", "reasons": [reason] * 7}}
    copper, pet = MATERIALS
    cardboard = pet | {"name": "cardboard (rough, in two lines)"}
    patches = [copper, *(cardboard | {"label": number} for number in range(2, 10))]
    content = {"segments": patches, "library": "a library of nine materials from 16 scans. " * 10, "model": "knn"}
    long_scan = replace_results(scan, quality=ScanQuality.decode(quality), materials=ScanMaterials.decode(content))
    assert long_scan.verdict is not None
    write_report(tmp_path, long_scan)
    browser.visit((tmp_path / "report.html").as_uri(), PHONE)
    browser.wait("document.readyState == 'complete'", "the report")
    assert browser.evaluate("document.querySelectorAll('ol > li').length") == 7
    assert browser.evaluate("document.documentElement.scrollHeight") <= MAX_HEIGHT_PX


def test_the_report_loads_nothing_but_the_images_in_it(page):
    _, html = page
    without_images = re.sub(r"base64,[A-Za-z0-9+/=]+", "", html)
    address = r"(?:https?:)?//[a-z0-9]"
    assert not re.search(address, without_images, re.IGNORECASE)
    parsed = Page(html)
    assert parsed.sources
    for source in parsed.sources:
        assert source.startswith("data:image/png;base64,")
    assert not {"script", "link", "iframe", "object"} & set(parsed.tags)
    assert "@import" not in html
    assert "url(" not in html


def test_images_are_embedded_and_saved_in_the_folder_of_the_page(page):
    out, html = page
    embedded = []
    for source in Page(html).sources:
        _, _, encoded = source.partition(",")
        embedded.append(base64.b64decode(encoded))
    files = {path.name: path.read_bytes() for path in (out / "figures").iterdir()}
    assert len(files) == 9
    for content in files.values():
        assert content.startswith(PNG)
    assert sorted(embedded) == sorted(files.values())
    assert {
        "amplitude_h.png",
        "amplitude_v.png",
        "amplitude_p.png",
        "phase_p.png",
        "materials.png",
        "truth.png",
    } <= set(files)
    assert sorted(path.name for path in out.iterdir()) == ["figures", "report.html"]


def test_every_output_is_labelled_as_simulated(page):
    _, html = page
    words = Page(html).words
    assert words.startswith("SIMULATED: Scan of two")
    # The title, the banner and the footer say so, and each figure and each table.
    assert words.count("SIMULATED") >= 3 + html.count("<figure") + html.count("<caption")
    for alt in re.findall(r'alt="([^"]*)"', html):
        assert "simulated" in alt


def test_measured_data_is_not_called_simulated(scan, tmp_path):
    measured_scan = replace_results(scan, facts=ScanFacts(simulated=False))
    with skip_rendering():
        html = write_report(tmp_path, measured_scan).read_text(encoding="utf-8")
    assert "simulated" not in Page(html).words.lower()


def test_results_are_shown_with_the_truth(page):
    _, html = page
    words = Page(html).words
    # Copper is not counted: it is the reference, not a result.
    assert "0 of 2 plates named right" in words
    assert "50.0 % of interior pixels named right; their own confidence expects 96.0 %" in words
    assert "✗ acrylic" in words
    assert "✓ copper" in words
    assert "Not found: cork" in words
    # Error of the real part: 3.9 for 4.0.
    assert "-2.5 %" in words
    assert "(3.80 … 4.00)" in words
    assert "metal-like" in words
    # 998 of 1000.
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


def test_a_result_without_materials_and_quality_has_a_report_on_its_images(scan, tmp_path):
    images_only = make_result(scan.images, content=None, quality={})
    words = Page(write_report(tmp_path, images_only).read_text(encoding="utf-8")).words
    assert "Images" in words
    assert "Materials" not in words
    assert "Quality" not in words


def test_images_of_zeros_without_a_valid_pixel_have_a_report(scan, tmp_path):
    zeros = np.zeros_like(scan.h)
    no_pixel_is_valid = np.zeros(zeros.shape, bool)
    not_a_number = zeros * np.complex64(np.nan)
    images = Images(h=zeros, v=zeros, x_m=scan.x_m, y_m=scan.y_m, valid=no_pixel_is_valid, p=not_a_number)
    assert write_report(tmp_path, make_result(images, content={}, quality={})).exists()


ROWS = 4
COLUMNS = 6


def replace_boards(scan, boards):
    """The result with these contents of quality.json for a scan of 4 rows of 6 positions."""
    plan = RasterPlan(columns=COLUMNS, rows=ROWS, step_x_mm=10.0, step_y_mm=5.0)
    return replace_results(scan, plan=plan, quality=ScanQuality.decode({"boards": boards}))


def test_positions_are_masked_in_runs_of_columns_and_in_rows_that_were_not_recorded(scan):
    # Row 2 is masked in columns 0 and 1, and in column 5; row 3 was not recorded.
    boards = {"RH": {"masked_columns": {"2": [[0, 2], [5, 6]]}, "rows_recorded": [0, 1, 2]}}
    expected_mask = np.zeros((ROWS, COLUMNS), bool)
    expected_mask[2, [0, 1, 5]] = True
    expected_mask[3] = True
    mask = find_masked_positions(replace_boards(scan, boards))["RH"]
    np.testing.assert_array_equal(mask, expected_mask)


def test_a_mask_is_the_same_after_it_was_stored_as_runs_of_columns(scan):
    rng = np.random.default_rng(5)
    for masked_share in (0.0, 0.3, 1.0):
        mask = rng.uniform(size=(ROWS, COLUMNS)) < masked_share
        runs = {str(row): find_masked_runs(mask[row]) for row in range(ROWS) if mask[row].any()}
        boards = {"RH": {"masked_columns": runs, "rows_recorded": list(range(ROWS))}}
        restored = find_masked_positions(replace_boards(scan, boards))["RH"]
        np.testing.assert_array_equal(restored, mask)


def test_the_report_has_the_masked_positions_the_gains_and_the_whole_rig_file(scan):
    boards = {"RH": {"masked_columns": {"2": [[0, 3]]}, "rows_recorded": [0, 1, 2, 3], "raw_crc32": {"0": "deadbeef"}}}
    gains = {"RH": [RxGain(0.0, 0.0), RxGain(1.25, -8.1)]}
    rig = load_rig_table() | {"name": "a <rig>"}
    facts = ScanFacts(simulated=True, rx_gains=gains, instrument=rig)
    scan_of_plan = replace_results(replace_boards(scan, boards), facts=facts)
    picture = encode_png(draw_coverage_figure(scan_of_plan, find_masked_positions(scan_of_plan)))
    page = Page(render(scan_of_plan, {"coverage": picture}))
    first_picture, *_ = page.sources
    assert base64.b64encode(picture).decode() in first_picture
    assert f"RH 3 of {ROWS * COLUMNS} (12.50%)" in page.words
    assert "+1.25 dB" in page.words
    assert "-8.1°" in page.words
    assert 'name = "a <rig>"' in page.words
    # Checksums of the rows are for programs.
    assert "deadbeef" not in page.words


IMAGING_OF_RH = {
    "masked_positions": 12,
    "rows_without_data": 0,
    "loss_db": 0.0437,
    "frequencies": 10,
    "point_width_mm": [7.512, 5.1],
    "point_limit_mm": [5.4, 3.6],
    "point_paper_mm": [2.8, None],
}


def test_the_imaging_table_has_a_column_for_each_board_and_a_dash_for_unknown_values():
    imaging_of_rv = {"masked_positions": 70000}
    table = make_imaging_table({"RH": IMAGING_OF_RH, "RV": imaging_of_rv, "notices": ["RV: imaging by direct sum"]})
    assert table["head"] == ["Board", "RH", "RV"]
    values = {}
    for row in table["rows"]:
        heading, *values_of_boards = row["cells"]
        values[heading] = values_of_boards
    assert values["Positions masked"] == ["12", "70000"]
    assert values["Point response at half power, x × y (mm)"] == ["7.51 × 5.1", "–"]
    assert values["The paper's r λ / L, x × y (mm)"] == ["2.8 × –", "–"]
    assert "direct sum" in table["caption"]


def replace_floats(content, value):
    """The content with each floating-point number replaced by the value."""
    if isinstance(content, float):
        return value
    if isinstance(content, list):
        return [replace_floats(item, value) for item in content]
    if isinstance(content, dict):
        replaced = {}
        for key, item in content.items():
            # A permittivity and a ratio are always finite, or they are absent.
            if key in ("permittivity", "ratio", "seconds_per_stage"):
                replaced[key] = item
            else:
                replaced[key] = replace_floats(item, value)
        return replaced
    return content


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_nan_and_infinity_are_shown_as_not_known(scan, value):
    """A result that was just computed may contain them; in its files they are null."""
    materials = {
        "segments": replace_floats(MATERIALS, value),
        "pixel_accuracy": value,
        "library": "",
        "model": "knn",
        "metal_reference": {"how": "given"},
    }
    changed_scan = replace_results(
        scan,
        materials=ScanMaterials.decode(materials),
        quality=ScanQuality.decode(replace_floats(QUALITY, value)),
        expected_accuracy=value,
    )
    with skip_rendering():
        html = render(changed_scan, {})
    words = re.findall(r"[\w.]+", Page(html).words.lower())
    assert not {"nan", "inf", "infinity"} & set(words)
    assert format_value(value) == "–"


@pytest.mark.parametrize(
    ("name", "in_library", "text"),
    [
        ("unknown", False, "acrylic"),
        ("unknown", True, "✗ acrylic"),
        ("PET", False, "✗ acrylic"),
        ("acrylic", True, "✓ acrylic"),
    ],
)
def test_unknown_is_neither_right_nor_wrong_for_a_material_that_is_not_in_the_library(scan, name, in_library, text):
    """The plate is acrylic. The mark in front of the true name says whether the name that it was given is right."""
    copper, pet = MATERIALS
    plate = pet | {"name": name, "truth": pet["truth"] | {"in_library": in_library}}
    content = {
        "segments": [copper, plate],
        "library": "",
        "model": "knn",
        "pixel_accuracy": 0.5,
        "metal_reference": {"how": "given"},
    }
    # As read from a file.
    materials = ScanMaterials.decode(json.loads(json.dumps(content)))
    with skip_rendering():
        words = Page(render(replace_results(scan, materials=materials), {})).words
    assert text in words
    assert ("✗ acrylic" in words) is (text == "✗ acrylic")
    assert ("✓ acrylic" in words) is (text == "✓ acrylic")
    assert ("not in the library" in words) is (text == "acrylic")


def test_a_value_and_its_standard_deviation_have_rows_of_their_own():
    boards = {"RH": {"stage_backlash_mm": {"shift": 0.12, "std": 0.01}}}
    (table,) = make_quality_tables({"boards": boards})
    cells = [row["cells"] for row in table["rows"]]
    assert cells == [["stage backlash shift (mm)", "0.12"], ["stage backlash std (mm)", "0.01"]]


def test_a_scene_with_metal_alone_has_no_count_of_plates_named_right(scan):
    """Metal is the reference, so that there is no plate to name."""
    assert scan.named_plates is not None
    metal_plates = [plate for plate in scan.plates if plate.permittivity is None]
    assert replace_results(scan, plates=metal_plates).named_plates is None
