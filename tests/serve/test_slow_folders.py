"""A folder that does not answer, such as a disconnected network drive, does not block reads of others."""

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from tests.support.page.asking import TOKEN, ask, post
from tests.support.page.live_view import Served, serve_folder
from tests.support.processes import wait_for
from tests.support.products import write_judged_products

from polysight.catalogue import Scans, scans
from polysight.serve import reading, site
from polysight_shared.errors import ErrorCode

# Time limit of a read in these tests, instead of 30 s. It is short because each test waits for its end.
LIMIT_S = 0.4


class DeadFolder:
    """The folder named `dead`: functions that `stop` names do not return for it until `back` is set."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.back = threading.Event()
        self._patch = monkeypatch

    def stop(self, module: Any, name: str) -> None:
        real: Callable[..., Any] = getattr(module, name)

        def hang(folder: Path, *arguments: Any) -> Any:
            if "dead" in Path(folder).parts:
                self.back.wait()
            return real(folder, *arguments)

        self._patch.setattr(module, name, hang)


@pytest.fixture
def dead(monkeypatch: pytest.MonkeyPatch) -> Iterator[DeadFolder]:
    monkeypatch.setattr(site, "READ_S", LIMIT_S)
    monkeypatch.setattr(scans, "READ_S", LIMIT_S)
    dead_folder = DeadFolder(monkeypatch)
    yield dead_folder
    dead_folder.back.set()


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name in ("alive", "dead", "other"):
        write_judged_products(tmp_path / name / "products", "care")
        (tmp_path / name / "program").mkdir()
    return tmp_path


@pytest.fixture
def view(root: Path) -> Iterator[Served]:
    with serve_folder(root, TOKEN) as served:
        yield served


def wait_until_answered(view: Served, address: str) -> None:
    """Ask until the answer is good: on a busy machine a read may exceed the limit, and its folder is refused then."""
    wait_for(lambda: ask(view, address)[0] == 200, address)


def test_other_scans_are_read_while_one_folder_hangs(dead, view):
    dead.stop(reading.catalogue, "read_result")
    answers: list[tuple[int, bytes, dict[str, str]]] = []

    def ask_for_dead_scan() -> None:
        answers.append(ask(view, "/api/result?scan=dead"))

    requests = [threading.Thread(target=ask_for_dead_scan) for _ in range(20)]
    for request in requests:
        request.start()
    wait_until_answered(view, "/api/result?scan=alive")
    wait_until_answered(view, "/api/scans")
    for request in requests:
        request.join()
    assert {status for status, _, _ in answers} == {503}
    assert len(answers) == 20
    assert all(ErrorCode.NO_ANSWER.encode() in body for _, body, _ in answers)
    dead.back.set()
    wait_until_answered(view, "/api/result?scan=dead")


def test_notes_and_names_of_an_unreachable_folder_delay_no_client(dead, view):
    dead.stop(scans, "is_scan")
    assert ask(view, "/api/scan?scan=dead")[0] == 503
    assert post(view, "/api/notes?scan=dead", {"notes": "x"})[0] == 503
    assert ask(view, "/api/thumbnail?scan=dead")[0] == 503
    wait_until_answered(view, "/api/scan?scan=alive")


def test_a_list_still_shows_a_folder_that_does_not_answer(dead, root):
    scan_list = Scans(root)
    scans_before = scan_list.list()
    dead.stop(scans, "is_scan")
    assert [s.name for s in scan_list.list()] == [s.name for s in scans_before]
    assert {s.name: s.state for s in scan_list.list()}["dead"] == "silent"
    listed = Scans(root)
    threads = threading.active_count()
    silent = {"alive": "products", "dead": "silent", "other": "products"}
    for _ in range(3):
        wait_for(lambda: {s.name: s.state for s in listed.list()} == silent, "that only one folder is silent")
    # However often the list is made, only one read of the hanging folder waits.
    wait_for(lambda: threading.active_count() - threads <= 1, "that one thread is left")
    dead.back.set()
    wait_for(lambda: {s.state for s in listed.list()} == {"products"}, "that the folder is listed again")


def test_a_dead_folder_stops_no_other_live_view(dead, view):
    dead.stop(site, "Watch")
    assert ask(view, "/api/state?scan=dead")[0] == 503
    wait_until_answered(view, "/api/state?scan=alive")


@pytest.mark.parametrize("address", ["/api/program/doctor", "/api/probe?scan=dead&x=0&y=0"])
def test_programs_and_libraries_of_an_unreachable_drive_delay_no_client(dead, view, monkeypatch, address):
    def hang(*_: object) -> None:
        dead.back.wait()

    monkeypatch.setattr(reading.catalogue, "find_program", hang)
    monkeypatch.setattr(site.Site, "libraries", hang)
    with ThreadPoolExecutor() as pool:
        waiting = pool.submit(ask, view, address)
        try:
            wait_until_answered(view, "/api/result?scan=alive")
            assert waiting.result()[0] == 503
        finally:
            dead.back.set()


def test_the_size_of_a_dead_folder_is_not_waited_for(dead, root, monkeypatch):
    monkeypatch.setattr(site, "SIZE_S", LIMIT_S)
    dead.stop(site.catalogue, "folder_bytes")
    sizes = site.Sizes()
    assert sizes.read_size(root / "dead") is None
    wait_for(lambda: sizes.read_size(root / "alive") is not None, "the size of another folder")


def test_the_size_of_a_growing_folder_is_counted_again_sooner(root, monkeypatch):
    """A count of 10 s ago is still shown for a finished scan (20 s), but not for a running one (4 s)."""
    now_s = 100.0
    monkeypatch.setattr(site, "time", SimpleNamespace(monotonic=lambda: now_s))
    sizes = site.Sizes()
    folder = root / "alive"
    wait_for(lambda: sizes.read_size(folder) is not None, "the first count")
    first_size = sizes.read_size(folder)
    (folder / "more").write_bytes(bytes(1000))
    now_s += 10.0
    assert sizes.read_size(folder) == first_size
    wait_for(lambda: sizes.read_size(folder, site.GROWING_SIZE_AGE_S) == first_size + 1000, "the second count")


def test_the_times_of_folders_are_read_only_by_threads_that_may_hang(root, monkeypatch):
    """Even reading the time of a folder hangs on a disconnected drive."""
    read_modified_s = scans._read_modified_s
    asking: set[threading.Thread] = set()

    def record(path: Path) -> float:
        asking.add(threading.current_thread())
        return read_modified_s(path)

    monkeypatch.setattr(scans, "_read_modified_s", record)
    Scans(root).list()
    assert asking
    assert threading.current_thread() not in asking
