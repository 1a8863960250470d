"""The suite on several cores: who runs what and when, what is made once for all workers, and what tests cost.

A file's tests run in one worker, so that its fixtures are made once. pytest-xdist's own `--dist loadgroup` would do for
most of it, but it writes its groups into the names of tests, and since pytest 9.2 nothing reads them there: every test
is a group of its own, without a word (https://github.com/pytest-dev/pytest-xdist/issues/1386).

Costs (`--costs`) are processor times of a test's own process and of the programs that it started and awaited. On a busy
machine they change less than the clock.
"""

from __future__ import annotations

import fcntl
import os
import resource
import time
from collections import Counter
from collections.abc import Callable, Generator
from pathlib import Path

import pytest
from xdist.scheduler import LoadScopeScheduling

TOGETHER = {
    "tests/process/test_drawn_boxes.py": "tests/process/test_laws.py",
    "tests/process/test_products.py": "tests/process/test_samples.py",
}
"""Files whose tests share an expensive fixture with another file's."""

ROOMS = ("tests/api", "tests/materials")
"""Folders with an expensive fixture for most of their files: one worker runs them."""

FIRST = (
    "tests/e2e/test_operator_page.py",
    "tests/materials",
    "tests/e2e/test_killed_processes.py",
    "tests/doctor/test_live_rig.py",
    "tests/serve/test_pages.py",
    "tests/api",
    "tests/process/test_laws.py",
    "tests/process/test_samples.py",
    "tests/papers/test_reproduce.py",
    "tests/store/test_cut_anywhere.py",
    "tests/stage/test_dialogues.py",
    "tests/papers/test_patches.py",
    "tests/e2e/test_kill_and_resume.py",
    "tests/e2e/test_demo.py",
    "tests/e2e/test_radar_backends.py",
    "tests/e2e/test_wrong_input.py",
    "tests/imaging/test_focus.py",
    "tests/stage/test_uno.py",
    "tests/store/test_killed_anywhere.py",
    "tests/e2e/test_live_view.py",
    "tests/process/test_verdicts.py",
    "tests/stage/test_uno_safety.py",
    "tests/benchmarks/test_runs.py",
)
"""Files and folders that take longest: begun first, so that no worker ends long after the others."""


def worker_group(node_id: str) -> str:
    """Folder or file whose tests share a worker."""
    file = node_id.partition("::")[0]
    room = file.rpartition("/")[0]
    return room if room in ROOMS else TOGETHER.get(file, file)


def longest_first(items: list[pytest.Item]) -> None:
    """Sort tests in place: those of the longest files first, the others as they were."""
    place = {file: n for n, file in enumerate(FIRST)}
    items.sort(key=lambda item: place.get(worker_group(item.nodeid), len(place)))


class ByFile(LoadScopeScheduling):
    """Hands out whole files, in the order of collection."""

    def _split_scope(self, nodeid: str) -> str:
        return worker_group(nodeid)

    def schedule(self) -> None:
        """As the base class, without its sorting by number of tests."""
        self.config.option.loadscopereorder = False
        super().schedule()


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Folder `name` of this run. The first worker that asks for it has `make` fill it; nobody may change it."""
    base = factory.getbasetemp()
    shared = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "once"
    shared.mkdir(exist_ok=True)
    folder = shared / name
    complete_copy = shared / f"{name}.whole"
    with (shared / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not complete_copy.exists():
            folder.mkdir()
            make(folder)
            complete_copy.touch()
    return folder


_SHOWN = 10
_NAME = "costs"


def _now_s() -> tuple[float, float]:
    """Processor time and the clock."""
    used = [resource.getrusage(process_kind) for process_kind in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used), time.monotonic()


class Costs:
    """Workers measure the phases of each test; the main process adds them up."""

    def __init__(self) -> None:
        self._last_s = _now_s()
        self._cpu_s: Counter[str] = Counter()
        self._wall_s: Counter[str] = Counter()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Add what passed since the last report to this one."""
        report = yield
        before_s = self._last_s
        self._last_s = _now_s()
        spent_s = [now - time_before for now, time_before in zip(self._last_s, before_s, strict=True)]
        report.user_properties = [*(p for p in report.user_properties if p[0] != _NAME), (_NAME, spent_s)]
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add a phase to its test."""
        for name, spent_s in report.user_properties:
            if name == _NAME:
                cpu_s, wall_s = spent_s  # type: ignore[misc]
                self._cpu_s[report.nodeid] += cpu_s
                self._wall_s[report.nodeid] += wall_s

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """The table: processor and clock seconds."""
        rooms_cpu_s, rooms_wall_s = (_by_room(room_times) for room_times in (self._cpu_s, self._wall_s))
        write = terminalreporter.write_line
        terminalreporter.section("costs")
        write(f"{self._cpu_s.total() / 60:.1f} CPU minutes, {self._wall_s.total() / 60:.1f} worker minutes")
        for title, cpu_s, wall_s in (
            ("rooms", rooms_cpu_s, rooms_wall_s),
            ("most processor time", self._cpu_s, self._wall_s),
        ):
            write(f"{'CPU s':>8} {'wall s':>8}  {title}")
            for name, spent_s in cpu_s.most_common(None if cpu_s is rooms_cpu_s else _SHOWN):
                write(f"{spent_s:8.1f} {wall_s[name]:8.1f}  {name}")


def _by_room(tests: Counter[str]) -> Counter[str]:
    rooms: Counter[str] = Counter()
    for name, spent_s in tests.items():
        rooms["/".join(name.partition("::")[0].split("/")[:2])] += spent_s
    return rooms
