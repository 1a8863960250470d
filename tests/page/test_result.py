"""The live view shows the verdict of a scan that has ended and was processed, and none before."""

from __future__ import annotations

import json
import shutil

from tests.support.page.chromium import DESK, PHONE
from tests.support.page.live_view import GrowingScan, served
from tests.support.processes import LIMIT_S
from tests.support.products import REASON, judged_products

from polysight.page.watch import ProductsTail


def test_the_verdict_follows_the_products(tmp_path):
    tail = ProductsTail(tmp_path)
    assert tail.look() is None
    for level in ("care", "none", None, "good"):
        shutil.rmtree(tmp_path / "products", ignore_errors=True)
        judged_products(tmp_path / "products", level)
        found = tail.look()
        assert (found.level if found else None) == level
    (tmp_path / "products" / "materials.json").write_text("{", encoding="utf-8")
    assert tail.look() is None


def test_it_is_shown_when_the_scan_has_ended(growing: GrowingScan, watching):
    growing.grow_to("row_committed")
    judged_products(growing.path / "products", "care")
    watch = watching(growing.path)
    assert watch.wait_for(lambda s: s["scan"] is not None, LIMIT_S)
    assert json.loads(watch.state.data)["verdict"] is None  # of an earlier run of the scan
    growing.grow_to("scan_ended")
    assert watch.wait_for(lambda s: s["verdict"] is not None, LIMIT_S)
    answer = json.loads(watch.state.data)["verdict"]
    assert answer["level"] == "care"
    assert [{key: r[key] for key in REASON} for r in answer["reasons"]] == [REASON]


def test_the_page_shows_it(browser, finished, watching, tmp_path):
    scan = shutil.copytree(finished, tmp_path / "scan")
    judged_products(scan / "products", "none")
    watch = watching(scan)
    assert watch.wait_for(lambda s: bool(s.get("verdict")), LIMIT_S)
    with served(watch) as view:
        for size in (DESK, PHONE):
            browser.visit(view.address + "/", size)
            browser.wait("document.getElementById('result-level')?.textContent.length > 0", "the verdict")
            assert browser.text("result-level") == "no result"
            assert REASON["do"] in browser.text("reasons")
            browser.check_whole(view.address)
