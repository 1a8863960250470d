"""The page in a real browser, at the widths of a desktop and of a phone."""

import time

import pytest
from tests.support.page.chromium import DESK, PHONE, Browser
from tests.support.page.live_view import GrowingScan, open_control, serve_view
from tests.support.processes import wait_for
from tests.support.rigs import load_published_rig

from polysight.acquisition import STATES
from polysight_simulators.loopback import move_to_free_subnet

TOKEN = "0123456789"
PICTURES = "[...document.querySelectorAll('.view img')]"


def open_page(browser: Browser, view, size=DESK, token: str = "") -> None:
    """Open the page and wait for its first state. Without a token the browser has never visited the page."""
    if not token:
        browser.forget(view.address)
    browser.visit(view.address + (f"/#token={token}" if token else "/"), size)
    browser.wait("document.title.length > 9", "the first state")


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_the_live_view_of_a_finished_scan_shows_state_and_pictures(browser, finished_scan, watching, tmp_path, size):
    watch = watching(finished_scan)
    watch.wait_for(lambda s: s["pictures"]["rows"] == 3)
    with serve_view(watch) as view:
        open_page(browser, view, size)
        browser.wait(f"{PICTURES}.length == 6 && {PICTURES}.every(i => i.naturalWidth == 12)", "six pictures")
        assert browser.read_text("headline") == "The scan is finished"
        assert browser.read_text("count") == "3 of 3 rows"
        assert "✓ whole" in browser.read_text("board-table")
        assert browser.read_text("p_note") == "not referenced to metal: not processed"
        assert "direct path" in browser.read_text("profile") or browser.evaluate(
            "document.getElementById('profile').textContent.includes('direct path')"
        )
        assert browser.evaluate("document.querySelectorAll('#sync path').length") == 2
        assert browser.evaluate("getComputedStyle(document.getElementById('buttons')).display") == "none"
        # The headline is on the first screen.
        assert browser.evaluate("document.getElementById('progress').getBoundingClientRect().bottom < innerHeight / 2")
        browser.save_screenshot(tmp_path / "page.png")
        assert (tmp_path / "page.png").stat().st_size > 20_000
        browser.check_whole(view.address)


def test_new_rows_are_shown_without_reloading_the_page(browser, growing: GrowingScan, watching):
    watch = watching(growing.path, lapse_s=1e6)
    with serve_view(watch) as view:
        open_page(browser, view)
        assert browser.read_text("headline") == "No scan here yet"
        growing.touch_alive()
        for row in range(3):
            growing.grow_until("row_committed")
            browser.wait(f"document.getElementById('count').innerText == '{row + 1} of 3 rows'", "the row's count")
            browser.wait(f"document.getElementById('images-note').innerText.match(/^{row + 1} rows? in/)", "its image")
            browser.wait(f"{PICTURES}.every(i => i.complete && i.naturalWidth == 12)", "the pictures")
        assert browser.errors == []


def test_buttons_reach_the_scan(browser, growing, watching):
    growing.grow_until("row_committed")
    with open_control(growing.path) as stop, serve_view(watching(growing.path, control=True), TOKEN) as view:
        open_page(browser, view, token=TOKEN)
        browser.click("#pause")
        assert TOKEN not in browser.evaluate("location.href")
        wait_for(lambda: stop.paused, "the pause")
        browser.wait("document.getElementById('headline').innerText == 'Pausing after this row'", "that it is said")
        browser.click("#continue")
        wait_for(lambda: not stop.paused, "the end of the pause")
        browser.click("#abort")
        assert browser.evaluate("document.getElementById('confirm').open")
        browser.click("#confirm button[value=no]")
        browser.wait("!document.getElementById('confirm').open", "the question is gone")
        assert not stop.after_row
        browser.click("#abort")
        browser.click("#confirm button[value=yes]")
        wait_for(lambda: stop.now, "the abort")
        assert browser.errors == []


def test_a_page_reconnects_to_a_view_that_was_restarted(browser, finished_scan, watching):
    """The view has an address of its own: a free port of 127.0.0.1 may be taken by another program meanwhile."""
    rig = move_to_free_subnet(load_published_rig())
    host, _, port = rig.pi.command_address.removeprefix("tcp://").rpartition(":")
    watch = watching(finished_scan)
    with serve_view(watch, host=host, port=int(port)) as view:
        open_page(browser, view)
    browser.wait("document.body.classList.contains('lost')", "that the view is gone is said")
    assert browser.read_text("headline") == STATES["offline"].headline
    # Meanwhile some attempts to reconnect fail.
    time.sleep(0.5)
    with serve_view(watch, host=host, port=int(port)):
        browser.wait("!document.body.classList.contains('lost')", "the way back")
        browser.wait("document.getElementById('headline').innerText == 'The scan is finished'", "the state")
