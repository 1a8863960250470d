"""What tests cost: the plugin of `--costs`, which lists the most expensive tests and rooms at the end.

Processor time is that of the test's own process and of the programs that it started and awaited. On a busy machine it
changes less than the clock.
"""

from __future__ import annotations

import resource
import time
from collections import Counter
from collections.abc import Generator

import pytest

_SHOWN = 10
_NAME = "costs"


def _now_s() -> tuple[float, float]:
    """Processor time and the clock."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
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
        before_s, self._last_s = self._last_s, _now_s()
        spent_s = [now - before for now, before in zip(self._last_s, before_s, strict=True)]
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
        rooms_cpu_s, rooms_wall_s = (_by_room(of) for of in (self._cpu_s, self._wall_s))
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
