"""Every state of the table in a real browser: its text, colour and buttons, and no text of other states."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from tests.support.page.asking import TOKEN
from tests.support.page.chromium import DESK, PHONE, Browser, find_axe
from tests.support.page.live_view import Served, begin_history
from tests.support.paths import RIG_FILE
from tests.support.products import REASON
from tests.support.store.facts import load_facts

from polysight.acquisition import STATES
from polysight.acquisition.control import SignOfLife
from polysight.catalogue import Scans
from polysight.page.history import ScanHistory
from polysight.page.status import Inputs, LifeSigns, Motion, ShownResults, make_snapshot, make_status
from polysight.page.watch import Versioned
from polysight.results import Verdict
from polysight.results.verdict import LEVELS, reason
from polysight.serve import site as serve_site
from polysight.serve.guard import Access
from polysight.serve.programs import Programs
from polysight.serve.site import Site, Watches

# States of the table in which the facts of the scan are not known, and states that only the page itself finds out.
WITHOUT_SCAN = ("empty", "starting", "start_failed", "unreadable", "folder_gone")
OF_THE_PAGE = ("offline", "server_frozen")
# Values for the names in braces of the table's texts.
WORDS: dict[str, Any] = {
    "folder": "scans/one", "safe": "1 of 3 rows are safe.", "asker": "the page", "row": 1, "take": 2,
    "what": "RV: no data.", "why": "The cable is out", "do": "Put it in", "now": "Row 1 is being scanned.",
    "all_safe": "Every row is safe.",
}  # fmt: skip


class StillWatch:
    """A live view in place of `Watch`: it shows the state that a test sets."""

    def __init__(self, folder: Path, history: ScanHistory) -> None:
        self.folder = folder
        self.shown = ShownResults()
        self.state = Versioned(0, b"{}")
        self.motion = Versioned(0, b"{}").publish(Motion(now_s=1_800_000_000))
        self._history = history

    def show(self, key: str, **words: str) -> None:
        """Publish a state of the table; `words` replace some of `WORDS`."""
        signs = LifeSigns(
            life=SignOfLife(), alive=True, killed=False, alive_s=0.0, pi_silent_s=0.1, pi_limit_s=6.0, now_s=1.8e9
        )
        history = None if key in WITHOUT_SCAN else self._history
        snapshot = make_snapshot(Inputs(self.folder, history, signs, control=True))
        verdict = None
        if key.startswith("result_"):
            verdict = Verdict(key.removeprefix("result_"), (reason("care", **REASON),))  # type: ignore[arg-type]
        status = replace(make_status(key, **(WORDS | words)), since_s=1.79e9)
        self.state = self.state.publish(replace(snapshot, status=status, verdict=verdict))

    def close(self) -> None:
        """Nothing is to be closed: no program runs."""


@pytest.fixture
def still(finished_scan: Path, tmp_path: Path) -> Iterator[tuple[StillWatch, Served]]:
    watch = StillWatch(tmp_path / "one", begin_history(load_facts(finished_scan)[0]))
    watch.show("rows")
    watches = Watches(True, {"one": watch})  # type: ignore[dict-item]
    site = Site(Scans(tmp_path, "one"), watches, Programs(), RIG_FILE)
    served = Served(site, Access(TOKEN, control=True))
    try:
        yield watch, served
    finally:
        served.close()
        site.close()


@pytest.mark.parametrize(("size", "scheme"), [(DESK, "light"), (PHONE, "dark")], ids=["desk", "phone"])
def test_every_state_shows_the_text_of_the_table(browser: Browser, still, size, scheme, request):
    """axe-core finds no faults in any state."""
    axe = find_axe()
    watch, view = still
    request.addfinalizer(lambda: browser.set_scheme("light"))
    browser.set_scheme(scheme)
    browser.visit(f"{view.address}/watch#token={TOKEN}", size)
    for key, state in STATES.items():
        if key in OF_THE_PAGE:
            continue
        watch.show(key)
        version = watch.state.version
        headline = state.headline.format(**WORDS)
        browser.wait(
            f"document.getElementById('headline')?.innerText == {headline!r}"
            f" && document.getElementById('status')?.dataset.level == {state.level!r}",
            f"{key}, version {version}",
        )
        pressed = browser.evaluate("[...document.getElementById('buttons').children].map(b => b.id).join()")
        assert set(filter(None, pressed.split(","))) == set(state.press), key
        page_text = browser.evaluate("document.body.innerText")
        assert not [phrase for phrase in state.never if phrase.casefold() in page_text.casefold()], (key, page_text)
        assert browser.evaluate("document.documentElement.scrollWidth <= innerWidth"), key
        if state.do:
            assert browser.read_text("do"), key
        if key.startswith("result_"):
            assert browser.read_text("result-level") == LEVELS[key.removeprefix("result_")], key
            assert all(part in browser.read_text("reasons") for part in REASON.values()), key
        assert axe is None or browser.find_violations(axe) == [], key
    assert browser.errors == []


@pytest.mark.parametrize(
    ("advice", "shown_advice"),
    [
        ("Put it in, then `polysight resume scans/one`", "Put it in, then Try again"),
        ("Put it in (for a scan to resume: `polysight resume SCAN --config a.toml`)", "Put it in; then Try again"),
        ("At the Pi: `systemctl status`", "At the Pi: systemctl status (commands: in a shell); then Try again"),
        ("", "Try again"),
    ],
)
def test_advice_next_to_try_again_ends_with_the_button(browser: Browser, still, advice, shown_advice):
    """A scan that could not start cannot be resumed."""
    watch, view = still
    browser.visit(f"{view.address}/watch#token={TOKEN}", DESK)
    watch.show("start_failed", do=advice)
    browser.wait("document.getElementById('again')", "the button")
    assert browser.read_text("do") == shown_advice


@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_a_page_without_a_server_reports_it_and_how_to_abort(browser: Browser, still, monkeypatch, size, request):
    _, view = still
    axe = find_axe()
    monkeypatch.setattr(serve_site, "ALIVE_INTERVAL_S", 1e9)
    browser.visit(f"{view.address}/watch#token={TOKEN}", size)
    for key in ("server_frozen", "offline"):
        state = STATES[key]
        if key == "offline":
            view.close()
        # The state is read only once, because the page may reconnect immediately.
        browser.wait(
            f"document.getElementById('headline')?.innerText == {state.headline!r}"
            f" && document.getElementById('status').dataset.level == {state.level!r}"
            " && document.documentElement.scrollWidth <= innerWidth"
            " && document.body.innerText.includes('polysight ask')"
            f" && !{list(state.never)!r}.some(phrase => document.body.innerText.includes(phrase))",
            key,
        )
        if axe is not None and request.config.getoption("--long"):
            assert browser.find_violations(axe) == [], key
