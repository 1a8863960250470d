"""Answers of the server without a browser: errors with codes, names of scans, the icon, comparisons."""

import errno
import http.client
import itertools
import json
import os
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path

import msgspec
import pytest
from tests.support.page.asking import TOKEN, ask, get, post
from tests.support.page.live_view import Served, open_control, serve_folder
from tests.support.paths import RIG_FILE
from tests.support.processes import wait_for
from tests.support.products import name_check_plate, write_judged_products

from polysight.acquisition.control import ALIVE_FILE, CONTROL_FOLDER, SignOfLife, read_start_ticks
from polysight.products import SCAN, write_json
from polysight.products.folder import replace_products
from polysight.results import ScanFacts, to_plain
from polysight.serve import commands, site
from polysight.serve.guard import TOKEN_HEADER
from polysight_shared.config import CheckPlate, load_instrument
from polysight_shared.errors import ErrorCode


@pytest.fixture
def scans(tmp_path: Path) -> Path:
    """A folder of two processed scans; their verdict is "care", that is usable with a warning."""
    for name in ("one", "two"):
        write_judged_products(tmp_path / name / "products", "care")
        (tmp_path / name / "program").mkdir()
    return tmp_path


@pytest.fixture
def view(scans: Path) -> Iterator[Served]:
    with serve_folder(scans, TOKEN, config=RIG_FILE) as served:
        yield served


@pytest.mark.parametrize(
    ("path", "body", "code", "values"),
    [
        ("/api/start", {"nmae": "x"}, ErrorCode.KEY_UNKNOWN, ("nmae", "did you mean 'name'")),
        (
            "/api/start",
            {"name": "x", "plan": {"rows": "three"}},
            ErrorCode.TYPE_WRONG,
            ("rows", "three", "whole number"),
        ),
        ("/api/start", {"plan": {"rows": 0}}, ErrorCode.VALUE_INVALID, ("rows", "0", "1")),
        ("/api/train", {"scans": ["one"]}, ErrorCode.KEY_MISSING, ("name",)),
        ("/api/notes?scan=one", {"tags": "oak"}, ErrorCode.TYPE_WRONG, ("tags", "a list")),
        ("/api/notes?scan=one", b"{", ErrorCode.MESSAGE_INVALID, ()),
        ("/api/notes?scan=one", b"[]", ErrorCode.TYPE_WRONG, ()),
        ("/api/process?scan=one", {"labels": True}, ErrorCode.FILE_MISSING, ()),
        ("/api/export?scan=one", {"formats": ["pdf"]}, ErrorCode.VALUE_INVALID, ("pdf",)),
        ("/api/process?scan=one", {"library": "mine"}, ErrorCode.FILE_MISSING, ("mine",)),
        ("/api/concentration", {"library": "mine"}, ErrorCode.FILE_MISSING, ("mine",)),
        ("/api/layers?scan=one", {"patch": 1, "layers": ["glass"]}, ErrorCode.VALUE_INVALID, ("glass", "NAME,?,MM")),
    ],
)
def test_a_wrong_request_is_refused_in_plain_words(view, path, body, code, values):
    status, answer = post(view, path, body)
    assert (status, answer["code"]) == (400, code), answer
    text = " ".join(answer[part] for part in ("what", "why", "do"))
    assert all(value in text for value in values), text
    assert all(answer[part] for part in ("what", "why", "do"))
    # Words of the decoder's own messages, such as "Expected `int` - at `$.plan.rows`".
    assert not any(word in text for word in ("Expected", "Object", "`", "array", "null", "$."))


@pytest.mark.parametrize(
    ("path", "status", "code"),
    [
        ("/api/scan?scan=onee", 404, ErrorCode.FILE_MISSING),
        ("/api/scan?scan=../one", 404, ErrorCode.PATH_OUTSIDE),
        ("/api/scan", 400, ErrorCode.KEY_MISSING),
        ("/api/map/nothing?scan=one", 404, ErrorCode.VALUE_INVALID),
        ("/api/nothing", 404, ErrorCode.OTHER),
    ],
)
def test_errors_carry_their_code(view, path, status, code):
    answer_status, body, _ = ask(view, path)
    assert (answer_status, json.loads(body)["code"]) == (status, code)


def test_a_folder_inside_a_scan_is_not_a_scan(view, scans):
    for path in ("scan", "result", "thumbnail", "map/h_amplitude"):
        assert ask(view, f"/api/{path}?scan=one/products")[0] == 404, path
    assert post(view, "/api/notes?scan=one/products", {"notes": "x"})[0] == 404
    assert post(view, "/api/start", {"name": "one/inside"})[0] == 404
    assert sorted(p.name for p in (scans / "one").iterdir()) == ["products", "program"]


@pytest.mark.parametrize("path", ["/surfaces", "/label", "/scan/one", "/../x"])
def test_a_mistyped_address_is_a_page_in_a_browser_and_json_for_a_program(view, path):
    status, body, headers = ask(view, path, Accept="text/html,application/xhtml+xml,*/*;q=0.8")
    assert (status, headers["content-type"]) == (404, "text/html; charset=utf-8")
    assert b'<a href="/">' in body
    status, body, _ = ask(view, path)
    assert (status, json.loads(body)["code"]) == (404, ErrorCode.OTHER)


@pytest.mark.parametrize("page", ["/scan", "/watch", "/surface", "/scan?scan="])
def test_pages_of_a_scan_without_a_name_lead_to_the_list(view, page):
    status, _, headers = ask(view, page)
    assert (status, headers["location"]) == (307, "/")


def test_a_pair_is_compared_once_for_all_its_maps(view, scans, monkeypatch):
    compared_pairs: list[tuple[Path, Path]] = []
    compare = site.catalogue.compare

    def record_and_compare(a: Path, b: Path) -> object:
        compared_pairs.append((a, b))
        return compare(a, b)

    monkeypatch.setattr(site.catalogue, "compare", record_and_compare)
    for path in ("compare", "compare/sigmas", "compare/p", "compare/loss"):
        assert ask(view, f"/api/{path}?a=one&b=two")[0] == 200, path
    assert len(compared_pairs) == 1

    # The pair in the other order is another one, and so is a pair with new products.
    assert ask(view, "/api/compare?a=two&b=one")[0] == 200
    shutil.rmtree(scans / "one" / "products")
    write_judged_products(scans / "one" / "products", "care")
    assert ask(view, "/api/compare/p?a=one&b=two")[0] == 200
    assert len(compared_pairs) == 3


@pytest.mark.parametrize(("damaged", "other"), [("one", "two"), ("two", "one")])
def test_a_damaged_scan_does_not_hide_the_other_check_plates(view, scans, damaged, other):
    plate = CheckPlate(name="PET", permittivity=(2.9, 0.2), place_mm=(0.0, 0.0))
    for name in ("one", "two"):
        facts = ScanFacts(scan_id="s", simulated=True, instrument=to_plain(load_instrument(RIG_FILE)))
        write_json(scans / name / "products" / SCAN, facts)
        name_check_plate(scans / name / "products", plate)
    chart = get(view, "/api/check")
    assert [(scan["name"], scan["check"]["level"]) for scan in chart["scans"]] == [("one", "good"), ("two", "good")]
    (scans / damaged / "products" / "materials.json").write_text("{")
    chart = get(view, "/api/check")
    assert [scan["name"] for scan in chart["scans"]] == [other]
    # The level of the damaged scan is not shown any more: it belongs to the products before the damage.
    assert chart["unreadable"] == [damaged]


def test_one_of_two_simultaneous_starts_is_refused(view, scans, monkeypatch):
    """Checking that the rig is free and starting are one step: the second request sees the first one's program."""
    # The barrier would let both requests pass the check before either starts its program. As check and start are one
    # step, only one request reaches the barrier, which breaks after 3 s.
    both_have_checked = threading.Barrier(2, timeout=3.0)
    check_free = commands._check_free

    def check_free_and_wait(site: object) -> None:
        check_free(site)
        with suppress(threading.BrokenBarrierError):
            both_have_checked.wait()

    monkeypatch.setattr(commands, "_check_free", check_free_and_wait)
    statuses: list[int] = []

    def start_scan(name: str) -> None:
        status, _ = post(view, "/api/start", {"name": name})
        statuses.append(status)

    threads = [threading.Thread(target=start_scan, args=(name,)) for name in ("first", "second")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(statuses) == [200, 409]
    assert sum((scans / name).exists() for name in ("first", "second")) == 1


def test_open_live_views_do_not_prevent_pausing_and_stopping(view, scans):
    """A command needs no live view, so that it is accepted although no further live view may be opened."""
    for k in range(site.MAX_WATCHES):
        (scans / f"view{k}" / "program").mkdir(parents=True)
    with ExitStack() as pages, open_control(scans / "one") as stop:
        for k in range(site.MAX_WATCHES):
            page = http.client.HTTPConnection("127.0.0.1", view.port)
            pages.callback(page.close)
            page.request("GET", f"/api/events?scan=view{k}")
            assert page.getresponse().readline().startswith(b"event: ")
        # One view more is refused.
        assert ask(view, "/api/state?scan=one")[0] == 409
        assert post(view, "/api/control/pause?scan=one")[0] == 200
        assert stop.paused
        assert post(view, "/api/control/stop?scan=one")[0] == 200
        assert stop.after_row
        assert post(view, "/api/control/abort?scan=one")[0] == 200
        assert stop.now


def test_of_two_live_views_of_a_scan_that_are_opened_together_one_is_closed(tmp_path, monkeypatch):
    """A view is made without a lock, since that reads the folder: another request may make one meanwhile."""
    views = []
    views_of_other_request = []

    class Watch:
        """A live view; while the first one is being made, another request opens a view of the same scan."""

        def __init__(self, folder: Path, _control: bool) -> None:
            self.calls = []
            views.append(self)
            if len(views) == 1:
                views_of_other_request.append(watches.open("one", folder))

        def start(self) -> None:
            self.calls.append("start")

        def close(self) -> None:
            self.calls.append("close")

    monkeypatch.setattr(site, "Watch", Watch)
    watches = site.Watches(control=True)
    opened = watches.open("one", tmp_path)
    outer, inner = views
    assert views_of_other_request == [inner]
    assert opened is inner
    assert watches.open("one", tmp_path) is inner
    assert (outer.calls, inner.calls) == (["close"], ["start"])


@pytest.mark.parametrize(
    ("is_alive", "age_s", "state"),
    [
        (True, 0, "running"),
        # The process exists, but has not renewed its sign of life for a minute.
        (True, 60, "frozen"),
        # The process was killed just now, or more than a day ago, which pages do not report any more.
        (False, 0, "lost"),
        (False, 1e5, None),
    ],
)
def test_every_page_shows_whether_a_scan_runs_was_killed_or_hangs(view, scans, is_alive, age_s, state):
    alive_file = scans / "one" / CONTROL_FOLDER / ALIVE_FILE
    alive_file.parent.mkdir()
    # A process is its number and its start time: process 1 did not start together with this one.
    pid = os.getpid() if is_alive else 1
    start_ticks = read_start_ticks(os.getpid()) or 0
    alive_file.write_bytes(msgspec.json.encode(SignOfLife(pid, start_ticks, socket.gethostname())))
    renewed_at = time.time() - age_s
    os.utime(alive_file, (renewed_at, renewed_at))
    running = get(view, "/api/running")
    assert [scan["state"] for scan in running] == ([state] if state else [])


def test_a_scan_is_archived_or_deleted_only_if_its_name_is_typed(view, scans):
    for path in ("archive", "delete"):
        status, answer = post(view, f"/api/{path}?scan=one", {"name": "two"})
        assert (status, answer["code"]) == (400, ErrorCode.MISMATCH)
    assert post(view, "/api/archive?scan=one", {"name": "one"})[0] == 200
    assert [s["name"] for s in get(view, "/api/scans")["scans"]] == ["two"]
    archived = list((scans / ".polysight" / "archive").glob("*/one/products/image.npz"))
    assert len(archived) == 1
    assert post(view, "/api/delete?scan=two", {"name": "two"})[0] == 200
    wait_for(lambda: not list((scans / ".polysight").glob("*/*/two")), "that its files are gone")


def test_a_request_can_be_repeated_and_is_checked_again(view, scans):
    plan = {"rows": 5, "columns": 7}
    (scans / "one" / "program" / "request.json").write_text(json.dumps({"name": "other", "plan": plan}))
    request = get(view, "/api/request?scan=one")
    assert (request["name"], request["plan"]["rows"], request["plan"]["columns"]) == ("one", 5, 7)
    # The scan has products, so it did start: only one that could not start is started again.
    assert post(view, "/api/again?scan=one")[0] == 400
    (scans / "one" / "program" / "request.json").write_text('{"plan": {"rows": 0}}')
    assert post(view, "/api/again?scan=one")[0] == 400
    assert ask(view, "/api/request?scan=two")[0] == 404


def test_a_page_gets_products_of_one_generation(view, scans):
    """The answer belongs to the products that the page shows, or reports that they were replaced."""
    generation = get(view, "/api/result?scan=one")["generation"]
    assert get(view, "/api/scan?scan=one")["generation"] == generation
    assert ask(view, f"/api/map/h_amplitude?scan=one&generation={generation}")[0] == 200
    shutil.move(scans / "one" / "products", scans / "old")
    write_judged_products(scans / "one" / "products", "none")
    status, body, _ = ask(view, f"/api/map/h_amplitude?scan=one&generation={generation}")
    assert (status, json.loads(body)["code"]) == (409, ErrorCode.MISMATCH)
    result = get(view, "/api/result?scan=one")
    assert result["generation"] != generation
    assert result["verdict"]["level"] == "none"


def test_a_result_that_is_polled_while_products_are_replaced_is_never_a_mixture(view, scans):
    """Otherwise results of one verdict would be shown with the reasons of another."""
    out = scans / "one" / "products"
    generations = itertools.count()
    ended = threading.Event()

    def process_again() -> None:
        while not ended.is_set():
            with replace_products(out, "s") as new:
                write_judged_products(new, "none" if next(generations) % 2 else "good")

    worker = threading.Thread(target=process_again)
    worker.start()
    levels: list[str] = []
    try:
        # Until both verdicts were seen, and at least 20 answers
        while len(set(levels)) < 2 or len(levels) < 20:
            status, body, _ = ask(view, "/api/result?scan=one")
            # 409: the products were replaced while they were being read.
            assert status in (200, 409)
            if status == 200:
                result = json.loads(body)
                levels.append(result["verdict"]["level"])
                # Only products without a result ("none") have no named patch.
                assert any(patch["name"] for patch in result["patches"]) is (levels[-1] != "none")
    finally:
        ended.set()
        worker.join()


def test_exports_stay_in_the_scan(view, scans, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (scans / "one" / "export").symlink_to(tmp_path / "elsewhere")
    status, body = post(view, "/api/export?scan=one", {"formats": ["csv"]})
    assert (status, body["code"]) == (404, ErrorCode.PATH_OUTSIDE)
    assert not list((tmp_path / "elsewhere").iterdir())


@pytest.mark.parametrize(("base", "saved"), [(None, 40), ({"notes": "", "tags": []}, 1)])
def test_notes_that_somebody_else_has_changed_are_not_overwritten(view, scans, base, saved):
    """A request may state on which notes it is based.

    Of 40 requests that are based on empty notes one is saved, as the notes are not empty any more for the others. Of 40
    requests that state nothing all are saved.
    """
    with ThreadPoolExecutor(2) as pool:
        requests = ({"notes": f"{k}", "base": base} for k in range(40))
        answers = list(pool.map(lambda body: post(view, "/api/notes?scan=one", body), requests))
    assert [status for status, _ in answers].count(200) == saved
    assert {(status, body.get("code")) for status, body in answers} <= {(200, None), (409, ErrorCode.MISMATCH)}
    assert [p.name for p in (scans / "one").glob(".*.part")] == []


@pytest.mark.parametrize(("number", "code"), [(errno.ENOSPC, ErrorCode.DISK_FULL), (errno.EROFS, ErrorCode.OTHER)])
def test_a_full_or_read_only_disk_is_reported_with_the_unwritten_file(view, scans, monkeypatch, number, code):
    def fail(_: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "fsync", fail)
    status, body = post(view, "/api/notes?scan=one", {"notes": "n"})
    assert (status, body["code"]) == (409, code)
    assert str(scans / "one" / "operator.json") in body["what"]
    assert not list((scans / "one").glob("*operator.json*"))


def test_a_client_that_disconnects_in_its_request_causes_no_traceback(view, capfd):
    head = f"POST /api/notes?scan=one HTTP/1.1\r\nHost: 127.0.0.1\r\n{TOKEN_HEADER}: {TOKEN}\r\n"
    for _ in range(3):
        with socket.create_connection(("127.0.0.1", view.port)) as s:
            # The head announces a body of 90 bytes, of which one is sent.
            s.sendall(f"{head}Content-Length: 90\r\n\r\n{{".encode())
    assert get(view, "/api/scans")
    # The traceback would come after the answer of the next request.
    time.sleep(0.2)
    assert "Traceback" not in capfd.readouterr().err


def test_the_last_box_can_be_removed(view):
    extent = get(view, "/api/result?scan=one")["extent_mm"]
    # A box from the corner with the smallest x and y to the middle of the image.
    x_min, _, y_min, _ = extent
    box = [x_min, y_min, 0.0, 0.0]
    # There are no labels yet that could be removed.
    assert post(view, "/api/labels?scan=one", {"boxes": {}})[0] == 404
    status, saved = post(view, "/api/labels?scan=one", {"boxes": {"oak": box}})
    assert status == 200, saved
    assert Path(saved["file"]).exists()
    labelled = {scan["name"]: scan["labelled"] for scan in get(view, "/api/scans")["scans"]}
    assert labelled == {"one": ["oak"], "two": []}
    assert post(view, "/api/labels?scan=one", {"boxes": {}})[1]["file"] == ""
    assert not Path(saved["file"]).exists()
    assert not get(view, "/api/result?scan=one")["labels"]
    assert not any(scan["labelled"] for scan in get(view, "/api/scans")["scans"])
