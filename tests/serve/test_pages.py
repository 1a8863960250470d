"""Result, probe, label, library and comparison in a real browser, at the widths of a desktop and of a phone."""

import json
import math
import re
import shutil
import struct
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from tests.support.page.asking import TOKEN
from tests.support.page.chromium import DESK, PHONE, Browser, find_axe
from tests.support.page.live_view import Served, open_control, serve_folder
from tests.support.paths import RIG_FILE
from tests.support.processes import HANG_S, wait_for
from tests.support.products import REASON, name_check_plate, write_judged_products
from tests.support.scenes import COPPER, PET

import polysight
from polysight.catalogue import PROGRAM_FOLDER, Notes, ProgramRecord, find_program, read_notes, write_notes
from polysight.doctor.checks import _format_finding
from polysight.materials import Library, read_labels
from polysight.products import ProcessedScan
from polysight.results import WARNING_SIGMAS
from polysight.serve import programs, reading
from polysight.serve.site import HIDDEN
from polysight_shared.config import CheckPlate
from polysight_shared.errors import DataError, ScanError
from polysight_shared.findings import Finding

# Condition for each page to be complete. Cards of the list have no text before they are painted (`content-visibility`
# in catalogue.css).
PAGES = {
    "/": "document.querySelectorAll('#list li').length == 2 && document.getElementById('list').innerText",
    "/scan?scan=one": "document.querySelector('#scale img')?.naturalWidth > 1",
    "/compare?a=one&b=two": "document.querySelector('#rows tr')",
    "/new": "document.querySelector('.time')",
    "/watch?scan=one": "document.querySelectorAll('.view img').length == 6",
    "/check": "document.querySelectorAll('#real circle').length == 2",
    "/surface?scan=one": "document.getElementById('facts')?.innerText.includes('4 points')",
}


# A box that is drawn has corners at whole pixels of the screen: it may differ from the wanted one by some of them.
DRAWING_TOLERANCE_MM = 1.5
# Permittivity of the check plate in each scan's rig file: the true one, and one that disagrees with every measurement.
KNOWN_PERMITTIVITY = {"one": (3.78, 0.7), "two": (9.0, 0.01)}


class Page:
    """A page of a served folder, in a browser."""

    def __init__(self, browser: Browser, view: Served) -> None:
        self.browser = browser
        self.view = view

    def open(self, path: str, size: tuple[int, int, bool] = DESK, token: str = TOKEN) -> None:
        """Open the page, and wait until it has content. With token "" the browser has never visited the page."""
        if not token:
            self.browser.forget(self.view.address)
        self.browser.visit(f"{self.view.address}{path}{f'#token={token}' if token else ''}", size)
        self.browser.wait(PAGES.get(path, "document.querySelector('.bar')"), path)

    def press(self, *keys: str) -> None:
        """Press keys, with the present focus."""
        for key in keys:
            if key == "Enter":
                text = {"text": "\r"}
            elif len(key) == 1:
                text = {"text": key}
            else:
                text = {}
            self.browser.call("Input.dispatchKeyEvent", type="keyDown", key=key, code=key, **CODES.get(key, {}), **text)
            self.browser.call("Input.dispatchKeyEvent", type="keyUp", key=key, code=key, **CODES.get(key, {}))

    def drag(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Draw over the image, from one place in mm to another."""
        points = self.browser.evaluate(
            "(() => { const c = document.querySelector('canvas.imageview'); c.scrollIntoView({block: 'center'});"
            " const b = c.getBoundingClientRect(), w = b.width - 62, h = b.height - 46;"
            " const e = window.extent; const at = (x, y) => [b.left + 46 + (x - e[0]) / (e[1] - e[0]) * w,"
            f" b.top + 8 + (e[3] - y) / (e[3] - e[2]) * h]; return [at({x0}, {y0}), at({x1}, {y1})]; }})()"
        )
        (ax, ay), (bx, by) = points
        for kind, x, y in (
            ("mousePressed", ax, ay),
            ("mouseMoved", (ax + bx) / 2, by),
            ("mouseMoved", bx, by),
            ("mouseReleased", bx, by),
        ):
            self.browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def check_whole(self) -> None:
        """Check that the page fits, and that everything in it comes from its server."""
        self.browser.check_whole(self.view.address)


CODES: dict[str, dict[str, Any]] = {
    key: {"windowsVirtualKeyCode": code}
    for key, code in {"Tab": 9, "Enter": 13, "ArrowLeft": 37, "ArrowUp": 38, "ArrowRight": 39, "ArrowDown": 40}.items()
}


PLY_HEAD = """ply
format binary_little_endian 1.0
comment simulated scan small, millimetres
element vertex 4
"""
PLY_COLUMNS = ("x", "y", "z", "nx", "ny", "nz", "permittivity", "loss", "permittivity_std", "incidence_deg")


def write_points(path: Path, permittivities: tuple[float, ...] = (2.5, 3.0, 3.5, math.nan)) -> None:
    """Write four points of a surface, the last of which has no permittivity unless all are given."""
    properties = "".join(f"property float {name}\n" for name in PLY_COLUMNS)
    rows = []
    for x, permittivity in enumerate(permittivities):
        if math.isfinite(permittivity):
            loss = 0.1
            error = 0.2
        else:
            loss = math.nan
            error = math.nan
        rows.append(struct.pack("<10fi", x, 2 * x, -x, 0, 0, -1, permittivity, loss, error, 55, 1))
    head = f"{PLY_HEAD}{properties}property int segment\nend_header\n"
    path.write_bytes(head.encode() + b"".join(rows))


@pytest.fixture
def scans(processed_scans: Path, tmp_path: Path) -> Path:
    shutil.copytree(processed_scans, tmp_path / "scans")
    write_points(tmp_path / "scans" / "one" / "products" / "surface.ply")
    x_mm, y_mm = PET["centre_mm"]
    for name, permittivity in KNOWN_PERMITTIVITY.items():
        plate = CheckPlate(name="PET", permittivity=permittivity, place_mm=(x_mm, y_mm))
        name_check_plate(tmp_path / "scans" / name / "products", plate)
    return tmp_path / "scans"


@pytest.fixture
def page(browser: Browser, scans: Path) -> Iterator[Page]:
    with serve_folder(scans, TOKEN, config=RIG_FILE) as view:
        yield Page(browser, view)


CONTRAST = """(() => {
  const parse = (c) => {
    const m = c.match(/[\\d.]+/g).map(Number), wide = c.startsWith('color(');
    return [...m.slice(0, 3).map((v) => (wide ? v * 255 : v)), m[3] ?? 1];
  };
  const over = (a, b) => a.slice(0, 3).map((v, i) => v * a[3] + b[i] * (1 - a[3]));
  const linear = (v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
  const light = (c) => c.reduce((sum, v, i) => sum + [0.2126, 0.7152, 0.0722][i] * linear(v / 255), 0);
  const behind = (n) => {
    const stack = [];
    for (; n; n = n.parentElement) stack.push(parse(getComputedStyle(n).backgroundColor));
    return stack.reverse().reduce((ground, c) => over(c, ground), [255, 255, 255]);
  };
  const bad = [];
  for (const n of document.querySelectorAll('body *')) {
    const own = [...n.childNodes].some((c) => c.nodeType === 3 && c.textContent.trim());
    if (!own || !n.checkVisibility() || n.closest('svg, noscript, option, .view, .skip, :disabled')) continue;
    const s = getComputedStyle(n), ground = behind(n), size = parseFloat(s.fontSize);
    const [a, b] = [light(over(parse(s.color), ground)), light(ground)].sort((x, y) => y - x);
    const least = size >= 24 || (size >= 18.66 && +s.fontWeight >= 700) ? 3 : 4.5;
    if ((a + 0.05) / (b + 0.05) < least) bad.push([n.tagName, n.textContent.trim().slice(0, 30), a, b]);
  }
  return bad;
})()"""
"""Texts whose contrast is below AA of WCAG 2.1 (1.4.3)."""

NAMELESS = """[...document.querySelectorAll('button, a[href], input, select, textarea')]
  .filter((n) => n.checkVisibility() && !(n.getAttribute('aria-label') || n.textContent.trim() || n.labels?.length))
  .map((n) => n.outerHTML.slice(0, 80))"""
"""Controls without an accessible name."""


def test_axe_core_is_installed():
    """Without axe-core the rules of accessibility are not checked; everything else is."""
    if find_axe() is None:
        pytest.skip("no axe-core here: npm install --no-save axe-core")


@pytest.mark.parametrize("path", PAGES)
def test_every_page_fits_can_be_read_and_has_the_abort_of_the_running_scan(page, scans, path, request):
    """Both sizes and both colour schemes, with all sections open; axe: https://github.com/dequelabs/axe-core."""
    axe = find_axe()
    browser = page.browser
    request.addfinalizer(lambda: browser.set_scheme("light"))
    with open_control(scans / "two"):
        page.open(path, PHONE)
        for size in (PHONE, DESK):
            browser.set_size(*size)
            browser.wait(f"innerWidth == {size[0]}", "the other size")
            browser.wait("document.querySelector('#running button.danger')?.checkVisibility()", "the abort")
            # There is no Pi: the page reports it, and the console shows the refused request.
            browser.errors[:] = [error for error in browser.errors if not error.endswith("/api/stage/look")]
            page.check_whole()
            # A table's last columns, too.
            assert browser.evaluate(
                "[...document.querySelectorAll('.wide')].every((t) => t.scrollWidth <= t.clientWidth)"
            )
            assert browser.evaluate("document.querySelectorAll('h1').length") == 1
            if size == PHONE:
                for button in ("#label-open", "#process-open", "#layers-open"):
                    browser.evaluate(f"document.querySelector('{button}')?.click()")
            browser.evaluate("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
            # WCAG AA. A scheme changes colours alone, so that axe reads the page in one of them.
            assert browser.evaluate(NAMELESS) == []
            assert axe is None or browser.find_violations(axe) == []
            for scheme in ("light", "dark"):
                browser.set_scheme(scheme)
                assert browser.evaluate(CONTRAST) == []


def test_axe_finds_nothing_in_a_report(page, scans):
    axe = find_axe()
    page.browser.visit((scans / "one" / "products" / "report.html").as_uri(), DESK)
    page.browser.wait("document.querySelector('details')", "the report")
    for size in (DESK, PHONE):
        page.browser.set_size(*size)
        assert axe is None or page.browser.find_violations(axe) == []


def test_the_points_of_surfaces_turn_and_are_coloured(page):
    page.open("/surface?scan=one")
    picture = "document.getElementById('points').toDataURL()"
    page.browser.wait(
        "document.getElementById('scale').innerText.includes('2.50 (dark) to 3.50 (bright)')", "the scale"
    )
    drawn = [page.browser.evaluate(picture)]
    page.browser.evaluate("document.getElementById('points').focus()")
    page.press("ArrowRight")
    drawn.append(page.browser.evaluate(picture))
    page.browser.evaluate("document.getElementById('colour').value = 'incidence_deg'")
    page.browser.evaluate("document.getElementById('colour').dispatchEvent(new Event('change'))")
    page.browser.wait("document.getElementById('scale').innerText.includes('55.00')", "the other scale")
    drawn.append(page.browser.evaluate(picture))
    assert len(set(drawn)) == len(drawn)
    page.check_whole()


def test_surfaces_without_permittivity_begin_with_a_figure_that_they_have(page, scans):
    write_points(scans / "one" / "products" / "surface.ply", (math.nan,) * 4)
    page.open("/surface?scan=one")
    page.browser.wait("document.getElementById('scale').innerText.includes('incidence')", "the scale")
    page.open("/surface?scan=two")
    page.browser.wait("document.getElementById('told').innerText.includes('no surfaces were measured')", "the reason")
    assert "polysight surface" in page.browser.read_text("told")
    # The browser itself reports the missing file.
    page.browser.errors.clear()


def test_the_control_chart_has_a_link_to_each_scan_at_its_place(page, scans):
    page.open("/check")
    assert "1 good" in page.browser.read_text("told")
    assert "1 action" in page.browser.read_text("told")
    assert f"± {WARNING_SIGMAS} standard deviations" in page.browser.read_text("limits")
    for name in KNOWN_PERMITTIVITY:
        measured = polysight.check(scans / name)["permittivity"].item().real
        # The tick's place gives the scale of the axis.
        drawn = page.browser.evaluate(
            "(() => { const t = [...document.querySelectorAll('#real text[text-anchor=end]')].slice(0, 2)"
            ".map((n) => [+n.textContent, +n.getAttribute('y') - 4]);"
            f" const c = document.querySelector('#real a[href$=\"{name}\"] circle');"
            " const slope = (t[1][0] - t[0][0]) / (t[1][1] - t[0][1]);"
            " return t[0][0] + slope * (c.getAttribute('cy') - t[0][1]); })()"
        )
        assert drawn == pytest.approx(measured, abs=1e-6), name
    levels = page.browser.evaluate("[...document.querySelectorAll('#real a')].map((n) => n.dataset.level)")
    assert levels == ["good", "bad"]
    page.browser.evaluate("document.querySelector('#real a').dispatchEvent(new MouseEvent('click', { bubbles: true }))")
    page.browser.wait("location.pathname == '/scan'", "the scan's page")


def test_the_control_chart_names_missing_data_and_follows_new_products(page, scans):
    elsewhere = CheckPlate(name="PET", permittivity=(3.78, 0.7), place_mm=(200.0, 0.0))
    name_check_plate(scans / "one" / "products", elsewhere)
    name_check_plate(scans / "two" / "products", CheckPlate())
    # Without the condition of PAGES: one of the scans has no plate.
    page.open("/check?")
    page.browser.wait("document.getElementById('told').innerText.includes('1 missing')", "the level")
    assert "no patch at x 200" in page.browser.read_text("rows")
    shutil.rmtree(scans / "one" / "products")
    page.open("/check?plate=none")
    page.browser.wait("document.getElementById('told').innerText.includes('No processed scan')", "the advice")


def test_the_new_page_lists_the_checks_as_the_doctor_prints_them(page, scans):
    findings = [
        Finding("ok", "the rig file is right", where="config"),
        Finding("warning", "it is weak", "far away", "turn it", where="direct path north-east"),
        Finding("note", "`direct path north-east` has a fault", where="trigger skew"),
        Finding("error", "no echo", "no power", "switch it on", where="radar south west 12"),
    ]
    record = ProgramRecord(pid=1, ticks=0, words=["polysight", "doctor"], started_utc="2026-01-01T00:00:00+00:00")
    folder = scans / HIDDEN / PROGRAM_FOLDER
    folder.mkdir(parents=True)
    (folder / "doctor.json").write_bytes(msgspec.json.encode(record))
    (folder / "doctor.log").write_text("".join(map(_format_finding, findings)) + "1 ok\n", encoding="utf-8")
    page.open("/new")
    page.browser.wait("document.querySelectorAll('#findings li').length == 4", "the findings")
    shown_findings = page.browser.evaluate(
        "[...document.querySelectorAll('#findings li')].map((n) => [n.querySelector('b').textContent,"
        " n.querySelector('b').parentNode.textContent, n.querySelectorAll('.more').length])"
    )
    for (name, text, more), finding in zip(shown_findings, findings, strict=True):
        assert name == f"{finding.where}: "
        assert text == name + finding.what.replace("`", "")
        assert more == bool(finding.why) + bool(finding.do)


def test_an_abort_does_not_wait_for_pictures_that_hang(page, scans, monkeypatch):
    """A browser has six connections to a server, and pictures on a disconnected drive occupy all of them."""
    released = threading.Event()

    def hang(*_: object) -> None:
        released.wait(HANG_S)
        raise DataError("no picture", "the drive is gone", "none")

    monkeypatch.setattr(reading, "draw_map", hang)
    for k in range(8):
        shutil.copytree(scans / "one", scans / f"more{k}")
    try:
        with open_control(scans / "one") as stop:
            page.browser.visit(f"{page.view.address}/#token={TOKEN}", DESK)
            page.browser.wait("document.querySelectorAll('#list li').length == 10", "the list")
            page.browser.click("#running .danger")
            page.browser.click("#confirm .danger")
            wait_for(lambda: stop.now, "the abort")
    finally:
        released.set()


def test_long_names_and_tags_fit(page, scans):
    long = "n" * 200
    shutil.copytree(scans / "one", scans / long)
    write_notes(scans / long, Notes("", ("t" * 40,)))
    for path in ("/", "/compare?a=one&b=two", f"/scan?scan={long}"):
        page.browser.visit(f"{page.view.address}{path}#token={TOKEN}", PHONE)
        if path == "/":
            ready = "document.querySelectorAll('#list li').length == 3"
        elif path.startswith("/compare"):
            ready = PAGES["/compare?a=one&b=two"]
        else:
            ready = PAGES["/scan?scan=one"]
        page.browser.wait(ready, path)
        assert page.browser.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0, path


def test_the_page_of_a_scan_that_does_not_exist_shows_only_the_error(page):
    page.browser.errors.clear()
    page.open("/scan?scan=nowhere")
    page.browser.wait("document.getElementById('told').innerText.includes('nowhere')", "the error")
    sections = "[...document.querySelectorAll('main section, #side')].filter(s => s.checkVisibility()).map(s => s.id)"
    assert page.browser.evaluate(sections) == ["head"]
    assert not page.browser.evaluate(
        "[...document.querySelectorAll('#links > *')].some(link => link.checkVisibility())"
    )
    assert "choose a scan from the list" in page.browser.read_text("told")


def test_the_live_view_of_a_scan_that_does_not_exist_does_not_report_a_lost_server(page):
    page.open("/watch?scan=nowhere")
    page.browser.wait("document.title.length > 9 && document.body.classList.contains('lost')", "the status")
    assert page.browser.read_text("headline") == "No scan of this name"
    assert "nowhere" in page.browser.read_text("detail")
    assert "choose a scan from the list" in page.browser.read_text("do")


def test_scans_are_searched_in_the_list_and_two_are_compared(page):
    page.open("/")
    page.browser.fill("#find", "tw")
    page.browser.wait("document.querySelectorAll('#list li').length == 1", "the search")
    page.browser.fill("#find", "")
    page.browser.wait("document.querySelectorAll('#list li').length == 2", "all of them")
    for number in (0, 1):
        page.browser.evaluate(f"document.querySelectorAll('#list input')[{number}].click()")
    page.browser.click("#compare")
    page.browser.wait(
        "location.pathname == '/compare' && document.querySelector('#rows tr')",
        "the comparison",
    )
    for mode in ("pair", "difference", "swipe"):
        page.browser.click(f"button[value={mode}]")
        page.browser.wait("document.querySelector('#scale img')?.naturalWidth > 1", mode)
        page.check_whole()
    assert "% of" in page.browser.read_text("share")


def test_a_place_is_probed_by_keyboard_alone(page):
    page.open("/scan?scan=one")
    # The page has fewer than 60 controls before the image.
    for _ in range(60):
        if page.browser.evaluate("document.activeElement?.className == 'imageview'"):
            break
        page.press("Tab")
    assert page.browser.evaluate("document.activeElement.className") == "imageview"
    # The place begins in the middle of the image, and an arrow key moves it by 2 mm.
    x_mm, y_mm = PET["centre_mm"]
    for _ in range(int(x_mm / 2)):
        page.press("ArrowRight")
    for _ in range(int(y_mm / 2)):
        page.press("ArrowUp")
    page.press("Enter")
    page.browser.wait("document.querySelectorAll('#probe-facts dt').length > 5", "the probe")
    shown_text = page.browser.read_text("probe-facts")
    assert "± " in shown_text
    assert "PET" in shown_text
    assert page.browser.evaluate("document.querySelectorAll('#profile path').length") == 2
    page.press("+", "+")
    page.browser.wait("document.querySelector('tr.here')", "its row in the table")
    page.check_whole()


def test_markup_in_names_and_notes_is_shown_as_text(page, scans):
    evil = "<img src=x onerror=\"document.title='broken'\">"
    products = scans / "one" / "products"
    answer = json.loads((products / "materials.json").read_text())
    for segment in answer["segments"]:
        segment["name"] = evil
        segment["why"] = evil
    answer["metal_reference"]["how"] = evil
    (products / "materials.json").write_text(json.dumps(answer))
    (scans / "one" / "operator.json").write_text(json.dumps({"notes": evil, "tags": [evil[:40]]}))
    shutil.move(scans / "two", scans / "<b onclick=x>two")
    page.open("/")
    page.check_whole()
    assert evil in page.browser.read_text("list")
    page.open("/scan?scan=one")
    page.check_whole()
    assert page.browser.evaluate("document.querySelectorAll('[onerror], [onclick]').length") == 0
    assert "broken" not in page.browser.evaluate("document.title")
    page.open("/compare?a=one&b=%3Cb+onclick%3Dx%3Etwo")
    page.browser.wait("document.querySelector('#rows tr')", "the comparison")
    page.check_whole()


def test_notes_are_stored_in_the_folder_of_the_scan(page, scans):
    page.open("/scan?scan=one")
    page.browser.fill("#notes-text", "Eiche, zweites Brett")
    page.browser.fill("#tags", "oak, 木")
    page.browser.click("#save-notes")
    page.browser.wait("document.getElementById('notes-told').innerText == 'Saved.'", "that it is saved")
    assert read_notes(scans / "one").tags == ("oak", "木")
    page.open("/")
    page.browser.fill("#find", "brett")
    page.browser.wait("document.querySelectorAll('#list li').length == 1", "the search finds it")


def test_a_plan_is_repeated_and_waits_in_the_queue(page, scans, monkeypatch):
    monkeypatch.setattr(programs, "LOOK_S", 1e6)
    with serve_folder(scans, TOKEN, config=RIG_FILE) as view:
        reloaded_page = Page(page.browser, view)
        reloaded_page.open("/new?from=one", PHONE)
        reloaded_page.browser.wait(
            "document.querySelector('.time') && document.getElementById('rows').value == 17", "the plan"
        )
        # Start is on the first screen of a phone.
        start = "document.getElementById('start').getBoundingClientRect()"
        assert reloaded_page.browser.evaluate(f"{start}.bottom <= innerHeight && {start}.top > 0")
        reloaded_page.browser.fill("#name", "over-night")
        reloaded_page.browser.click("#enqueue")
        reloaded_page.browser.wait("document.querySelectorAll('#waiting li').length == 1", "that it waits")
        reloaded_page.check_whole()
        reloaded_page.browser.click("#waiting button")
        reloaded_page.browser.wait("document.querySelectorAll('#waiting li').length == 0", "that it is out")


def test_a_wrong_number_is_reported_with_the_labels_of_the_page(page):
    page.open("/new")
    page.browser.fill("#columns", "0")
    page.browser.wait("document.getElementById('plan-wrong')?.innerText.length > 0", "the refusal")
    shown_text = page.browser.read_text("plan-wrong")
    assert "Positions in a row" in shown_text
    assert "columns" not in shown_text
    assert page.browser.evaluate("document.getElementById('start').disabled")
    page.browser.fill("#columns", "900")
    page.browser.wait("document.getElementById('plan-wrong')?.innerText.includes('900')", "the refusal")
    shown_text = page.browser.read_text("plan-wrong")
    assert "does not fit the stage" in shown_text
    assert not re.search(r"\w_\w|stage\.|grid\.|changed|rule of its format", shown_text), shown_text
    invalid_fields = "[...document.querySelectorAll('[aria-invalid=true]')].map((field) => field.id).join()"
    assert page.browser.evaluate(invalid_fields) == "columns,step_x_mm,speed_mm_s"
    # The browser itself reports the refused requests.
    page.browser.errors.clear()


def test_a_scan_that_was_stopped_on_request_has_not_failed(page, scans):
    """The program of such a scan ends with the exit status of an incomplete scan."""
    record = ProgramRecord(pid=1, ticks=0, words=["polysight", "scan"], started_utc="2026-01-01T00:00:00+00:00")
    folder = scans / "one" / PROGRAM_FOLDER
    folder.mkdir()
    (folder / "scan.json").write_bytes(msgspec.json.encode(record))
    (folder / "scan.status").write_text(f"{ScanError.exit_status}\n", encoding="utf-8")
    for end, shown_text in (
        ("stopped on request, 2 of 3 rows are missing", "was stopped on request"),
        ("", "has failed"),
    ):
        (folder / "scan.log").write_text(f"1 of 3 rows, 0:40 left\nend: {end}\n", encoding="utf-8")
        page.open("/scan?scan=one")
        page.browser.wait(f"document.getElementById('program-title').innerText.includes('{shown_text}')", shown_text)


def test_metal_is_drawn_for_processing_again(page):
    page.open("/scan?scan=one")
    extent = page.browser.evaluate("fetch('/api/result?scan=one').then(r => r.json()).then(r => r.extent_mm)")
    page.browser.evaluate(f"window.extent = {json.dumps(extent)}")
    page.browser.click("#process-open")
    page.browser.click("#draw-metal")
    x, y = COPPER["centre_mm"]
    page.drag(x - 12, y - 12, x + 12, y + 12)
    page.browser.wait("/mm$/.test(document.getElementById('draw-metal').innerText)", "the box")
    # "...: x0, y0, x1, y1 mm", with typographic minus signs
    _, _, numbers = page.browser.read_text("draw-metal").partition(": ")
    sides = numbers.replace("\u2212", "-").removesuffix(" mm").split(", ")
    assert [float(side) for side in sides] == pytest.approx([x - 12, y - 12, x + 12, y + 12], abs=DRAWING_TOLERANCE_MM)
    page.check_whole()


def test_the_page_follows_products_that_another_program_has_made(page, scans):
    page.open("/scan?scan=one")
    judged = "document.getElementById('badges').innerText"
    assert "no result" not in page.browser.evaluate(judged)
    shutil.move(scans / "one" / "products", scans / "old")
    write_judged_products(scans / "one" / "products", "none")
    page.browser.wait(f"{judged}.includes('no result')", "the new verdict")
    assert REASON["what"] in page.browser.read_text("reasons")
    page.browser.errors.clear()


def test_a_long_list_is_shown_while_it_is_read(browser, tmp_path, monkeypatch):
    """Each answer of this server has one scan more; the page asks again until it has all, and shows that meanwhile."""
    monkeypatch.setattr(reading, "LIST_S", 0.0)
    scans = 6
    for k in range(scans):
        write_judged_products(tmp_path / "scans" / f"scan-{k}", "care")
    with serve_folder(tmp_path / "scans") as view:
        page = Page(browser, view)
        page.open("/?all", token="")
        browser.wait(f"document.querySelectorAll('#list li').length == {scans}", "all scans")
        browser.wait("!document.getElementById('count').innerText.includes('reading')", "that nothing is being read")
        requests = [url for url in browser.requests if "/api/scans" in url]
        assert len(requests) >= scans


def test_without_the_token_nothing_is_changed_and_the_page_asks_for_it(page, scans):
    page.browser.forget(page.view.address)
    page.open("/scan?scan=one", token="wrong")
    page.browser.wait("document.getElementById('token-bar')", "that it asks")
    page.browser.fill("#notes-text", "not mine")
    page.browser.click("#save-notes")
    page.browser.wait("document.getElementById('notes-told').innerText.includes('token')", "the refusal")
    assert read_notes(scans / "one").notes == ""
    page.browser.fill("#token-field", f"http://127.0.0.1/#token={TOKEN}")
    page.browser.evaluate("document.querySelector('#token-bar button').click()")
    page.browser.wait(
        "!document.getElementById('token-bar') && document.getElementById('name')?.innerText", "the page again"
    )
    page.browser.fill("#notes-text", "mine")
    page.browser.click("#save-notes")
    wait_for(lambda: read_notes(scans / "one").notes == "mine", "the notes")


def test_a_read_only_view_has_no_buttons_that_change_anything(browser, scans):
    with serve_folder(scans) as view:
        page = Page(browser, view)
        for path in ("/", "/scan?scan=one"):
            page.open(path, token="")
            page.check_whole()
            buttons = "[...document.querySelectorAll('button')].filter(b => b.checkVisibility()).map(b => b.innerText)"
            changing = {"Label", "Process again", "Resume", "Save", "Write", "Make a library", "Start the scan"}
            assert not changing & set(browser.evaluate(buttons))


def test_a_token_of_the_server_that_had_the_port_before_is_forgotten(browser, scans):
    """Tests share one browser, and ports are reused."""
    with serve_folder(scans) as view:
        page = Page(browser, view)
        page.open("/", token="of another server")
        page.open("/", token="")
        assert browser.evaluate("localStorage.length") == 0
        page.check_whole()


def test_advice_with_an_option_of_a_command_is_shown_in_the_words_of_the_page(page):
    """Texts on materials name options of commands. Pages show them in other words, as no page has options."""
    texts = []
    for name in ("results/verdict.py", "results/rules.py", "materials/analyse.py", "materials/labels.py",
                 "materials/sub_bands.py", "materials/training_advice.py"):  # fmt: skip
        source = (Path(polysight.__file__).parent / name).read_text(encoding="utf-8")
        texts += re.findall(r'"([^"\n]*--[a-z][^"\n]*)"', re.sub(r"\{[^}]*\}", "5", source))
    # Texts that name an option were found.
    assert len(texts) > 9
    page.open("/")
    shown_texts = page.browser.evaluate(
        "import('/common.js').then((common) => "
        f"{json.dumps(texts)}.map((text) => common.rich(text).map((node) => node.textContent).join('')))"
    )
    assert [text for text in shown_texts if "--" in text] == []


@pytest.mark.slow
def test_boxes_are_drawn_saved_processed_and_learnt(page, scans):
    """Label both scans, process one with its boxes, train on both, and name with that library."""
    for name in ("one", "two"):
        page.open(f"/scan?scan={name}")
        page.browser.wait("document.querySelector('#scale img')?.naturalWidth > 1", "the image")
        extent = page.browser.evaluate(f"fetch('/api/result?scan={name}').then(r => r.json()).then(r => r.extent_mm)")
        page.browser.evaluate(f"window.extent = {json.dumps(extent)}")
        page.browser.click("#label-open")
        for k, (plate, called) in enumerate(((COPPER, "copper"), (PET, "my plastic"))):
            x, y = plate["centre_mm"]
            page.drag(x - 12, y - 12, x + 12, y + 12)
            page.browser.wait(f"document.querySelectorAll('#boxes li').length == {k + 1}", "the box")
            page.browser.fill("#boxes li:last-child input", called)
        page.browser.evaluate("document.querySelector('#boxes input[type=radio]').click()")
        page.browser.click("#save-labels")
        page.browser.wait(
            "document.getElementById('label-told').innerText.startsWith('Saved')",
            "that it is saved",
        )
        labels = read_labels(scans / name / "labels.json")
        assert labels.metal == "copper"
        x, y = PET["centre_mm"]
        assert labels.boxes["my plastic"] == pytest.approx([x - 12, y - 12, x + 12, y + 12], abs=DRAWING_TOLERANCE_MM)
        page.check_whole()
    offered_names = "[...document.getElementById('known').options].map((option) => option.value)"
    page.browser.wait(
        f"{offered_names}.join() == 'copper,my plastic'", "names of the first scan, offered in the second"
    )
    page.open("/")
    assert page.browser.read_text("list").count("labelled: copper, my plastic") == 2
    page.browser.evaluate("document.querySelectorAll('#list input').forEach(i => i.click())")
    page.browser.click("#train-open")
    page.browser.fill("#train-name", "mine")
    page.browser.click("#train button")
    page.browser.wait(
        "document.getElementById('train-told').innerText.startsWith('The library is saved')",
        "the library",
    )
    assert Library.load(scans / "libraries" / "mine.npz").names == ("copper", "my plastic")
    page.open("/scan?scan=one")
    page.browser.click("#process-open")
    page.browser.evaluate("document.getElementById('library').value = 'mine'")
    page.browser.click("#process button:not([type=button])")
    page.browser.wait("document.getElementById('rows').innerText.includes('my plastic')", "the new name")
    program = find_program(scans / "one", "process")
    assert program is not None
    assert "--labels" in program.words
    named = [s.name for s in ProcessedScan(scans / "one" / "products").segments if not s.metal_reference]
    assert named == ["my plastic"]
    page.browser.click("#layers-open")
    page.browser.fill("#layers-text", "plate, ?")
    page.browser.click("#layers button.main")
    page.browser.wait("document.getElementById('layers-told').innerText.startsWith('In the stack: ')", "the fit")
    page.check_whole()


def test_two_hundred_scans_are_shown_together(browser, tmp_path, monkeypatch):
    # A list that comes in parts shows other scans at its top with each, and their pictures.
    monkeypatch.setattr(reading, "LIST_S", math.inf)
    write_judged_products(tmp_path / "made", "care")
    for k in range(200):
        shutil.copytree(tmp_path / "made", tmp_path / "scans" / f"week-{k % 10}" / f"scan-{k:03d}")
    with serve_folder(tmp_path / "scans") as view:
        page = Page(browser, view)
        page.open("/?all", token="")
        browser.wait("document.querySelectorAll('#list li').length == 200", "all of them")
        page.check_whole()
        drawn = [url for url in browser.requests if "thumbnail" in url]
        # Pictures are loaded when they are scrolled to.
        assert len(drawn) < 100
