"""The suite on several cores: order of tests, their workers, folders that are made once for all workers, and costs.

A file's tests run in one worker, so that its fixtures are made once. pytest-xdist's own `--dist loadgroup` would do for
most of it, but it writes its groups into the names of tests, and since pytest 9.2 no scheduler reads them there: every
test is a group of its own, without a warning (https://github.com/pytest-dev/pytest-xdist/issues/1386).

Costs (`--costs`) are processor times of a test's own process and of all programs that it started, including those that
still run or were not awaited, such as a browser's. On a busy machine they change less than the clock.
"""

import fcntl
import os
import resource
import time
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from xdist.scheduler import LoadScopeScheduling

# A file whose tests share an expensive fixture with another file's (such as a worker's browser), and that other file:
# both run in the same worker.
WORKER_OF_FILE = {
    "tests/process/test_drawn_boxes.py": "tests/process/test_laws.py",
    "tests/process/test_products.py": "tests/process/test_samples.py",
    **dict.fromkeys(
        (
            "tests/pi/test_stage_page.py",
            "tests/report/test_report.py",
            "tests/serve/test_states.py",
            "tests/serve/test_watch_page.py",
        ),
        "tests/serve/test_pages.py",
    ),
}

# Folders with an expensive fixture for most of their files: each is run by one worker.
FOLDERS_OF_ONE_WORKER = ("tests/api", "tests/materials")

# Files and folders that take longest. They are started first, so that no worker ends long after the others.
LONGEST = (
    "tests/e2e/test_operator_page.py",
    "tests/materials",
    "tests/serve/test_pages.py",
    "tests/e2e/test_killed_processes.py",
    "tests/doctor/test_live_rig.py",
    "tests/api",
    "tests/surfaces/test_rejected_surfaces.py",
    "tests/process/test_laws.py",
    "tests/process/test_samples.py",
    "tests/process/test_given_images.py",
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
    "tests/process/test_verdicts.py",
    "tests/stage/test_uno_safety.py",
    "tests/benchmarks/test_runs.py",
    "tests/worlds/test_series.py",
    "tests/worlds/test_shape_scenes.py",
    "tests/surfaces/test_surface.py",
    "tests/process/test_metal_scans.py",
    "tests/jobs/test_train_on_labels.py",
    "tests/jobs/test_batch.py",
    "tests/serve/test_attack.py",
)


def find_worker_group(node_id: str) -> str:
    """Folder or file whose tests share a worker."""
    file = node_id.partition("::")[0]
    folder = file.rpartition("/")[0]
    return folder if folder in FOLDERS_OF_ONE_WORKER else WORKER_OF_FILE.get(file, file)


def sort_longest_first(items: list[pytest.Item]) -> None:
    """Sort tests in place: those of the longest files come first, and the others keep their order."""
    rank = {file: n for n, file in enumerate(LONGEST)}
    items.sort(key=lambda item: rank.get(find_worker_group(item.nodeid), len(rank)))


class ByFile(LoadScopeScheduling):
    """Distributes whole files to workers, in the order of collection."""

    def _split_scope(self, nodeid: str) -> str:
        return find_worker_group(nodeid)

    def schedule(self) -> None:
        """As the base class, without its sorting by number of tests."""
        self.config.option.loadscopereorder = False
        super().schedule()


def make_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Return a temporary folder that all workers of this run share.

    The first worker that needs it fills it by `make`, while others wait; tests must not change it.
    """
    base = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        # Each worker has its own folder in the one of the run.
        base = base.parent
    shared = base / "once"
    shared.mkdir(exist_ok=True)
    folder = shared / name
    filled_marker = shared / f"{name}.whole"
    with (shared / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not filled_marker.exists():
            folder.mkdir()
            make(folder)
            filled_marker.touch()
    return folder


# Each table of costs shows the most expensive folders, files or tests only.
_TABLE_LINES = 60
# Key of the costs in the reports that workers send.
_COSTS_KEY = "costs"
# Unit of the times in /proc.
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")


class ProcessTimes:
    """Processor time of this process and of all programs that it started, directly or through others.

    A program that was seen once is followed even after its parent has ended, because most processes of a browser are
    such orphans. The system adds the time of an ended program to that of the parent which waits for it. An orphan has
    no such parent: it counts with the time that was read last.
    """

    def __init__(self) -> None:
        # The process id of the parent and the ticks used so far. The key has the process id and the time of start,
        # because ids are reused.
        self._followed: dict[tuple[int, str], tuple[int, int]] = {}
        # Ticks of the orphans that have ended.
        self._orphans_ticks = 0

    def read_s(self) -> float:
        """Seconds of processor time used so far."""
        # The fields of proc_pid_stat(5) after the program's name, by process id. The list begins with the third field
        # of the manual: its 4 (parent) has index 1, its 14 to 17 (times) have 11 to 14, its 22 (time of start) has 19.
        table = {}
        for folder in filter(str.isdigit, os.listdir("/proc")):  # noqa: PTH208
            with suppress(OSError):
                line = Path(f"/proc/{folder}/stat").read_text(errors="replace")
                table[int(folder)] = line.rpartition(") ")[2].split()
        our_pids = {pid for pid, fields in table.items() if (pid, fields[19]) in self._followed}
        children: dict[int, list[int]] = {}
        for pid, fields in table.items():
            children.setdefault(int(fields[1]), []).append(pid)
        # Add the children of all our processes, their children, and so on.
        parents_to_visit = [os.getpid(), *our_pids]
        while parents_to_visit:
            new_pids = set(children.get(parents_to_visit.pop(), ())) - our_pids
            our_pids |= new_pids
            parents_to_visit.extend(new_pids)
        self._orphans_ticks += self._count_orphans_ticks({os.getpid(), *our_pids})
        self._followed = {}
        for pid in our_pids:
            fields = table[pid]
            parent = int(fields[1])
            used_ticks = sum(map(int, fields[11:15]))
            start_time = fields[19]
            self._followed[pid, start_time] = (parent, used_ticks)
        ticks = self._orphans_ticks + sum(used for _, used in self._followed.values())
        usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return ticks / _TICKS_PER_S + sum(usage.ru_utime + usage.ru_stime for usage in usages)

    def _count_orphans_ticks(self, running: set[int]) -> int:
        """Ticks of the processes that have ended since the last call, and for which no running process waited."""
        ended = {pid: values for (pid, _), values in self._followed.items() if pid not in running}
        orphans_ticks = 0
        for parent, used_ticks in ended.values():
            # If the parent has ended, too, its own parent may have waited for both, and so on.
            while parent in ended:
                parent, _ = ended[parent]
            if parent not in running:
                orphans_ticks += used_ticks
        return orphans_ticks


class Costs:
    """Workers measure each test with its fixtures; the main process adds them up."""

    def __init__(self) -> None:
        self._times = ProcessTimes()
        self._last_s = self._now_s()
        self._cpu_s: Counter[str] = Counter()
        self._wall_s: Counter[str] = Counter()

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """Record the costs of importing and collecting the tests, which every worker does before the first test."""
        before_s = self._last_s
        self._last_s = self._now_s()
        collected_s = [now - time_before for now, time_before in zip(self._last_s, before_s, strict=True)]
        output = getattr(session.config, "workeroutput", None)
        if output is None:
            self._add("collection", collected_s)
        else:
            output[_COSTS_KEY] = collected_s

    def pytest_testnodedown(self, node: Any) -> None:
        """Add the costs of a worker's collection when the worker ends."""
        self._add("collection", node.workeroutput.get(_COSTS_KEY, (0.0, 0.0)))

    def _add(self, name: str, spent_s: Any) -> None:
        self._cpu_s[name] += spent_s[0]
        self._wall_s[name] += spent_s[1]

    def _now_s(self) -> tuple[float, float]:
        """Processor time and the clock."""
        return self._times.read_s(), time.monotonic()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        """Add a test's times to the report of its last phase."""
        report = yield
        if call.when != "teardown":
            return report
        before_s = self._last_s
        self._last_s = self._now_s()
        spent_s = [max(0.0, now - time_before) for now, time_before in zip(self._last_s, before_s, strict=True)]
        report.user_properties.append((_COSTS_KEY, spent_s))
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add a test's times to the sums."""
        for name, spent_s in report.user_properties:
            if name == _COSTS_KEY:
                self._add(report.nodeid, spent_s)

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Print tables of processor seconds and seconds by the clock."""
        write = terminalreporter.write_line
        terminalreporter.section("costs")
        write(f"{self._cpu_s.total() / 60:.1f} CPU minutes, {self._wall_s.total() / 60:.1f} worker minutes")
        for title, cpu_s, wall_s in (
            ("folders", _sum_by(_get_folder, self._cpu_s), _sum_by(_get_folder, self._wall_s)),
            ("files", _sum_by(_get_file, self._cpu_s), _sum_by(_get_file, self._wall_s)),
            ("tests", self._cpu_s, self._wall_s),
        ):
            write(f"{'CPU s':>8} {'wall s':>8}  {title}")
            for name, spent_s in cpu_s.most_common(_TABLE_LINES):
                write(f"{spent_s:8.1f} {wall_s[name]:8.1f}  {name}")


def _get_file(test: str) -> str:
    """File of a test, whose name is `FILE::FUNCTION`."""
    return test.partition("::")[0]


def _get_folder(test: str) -> str:
    """Folder in `tests`, such as `tests/imaging`."""
    return "/".join(_get_file(test).split("/")[:2])


def _sum_by(get_part: Callable[[str], str], seconds_by_test: Counter[str]) -> Counter[str]:
    """Seconds of all tests of a file or a folder."""
    sums: Counter[str] = Counter()
    for test, spent_s in seconds_by_test.items():
        sums[get_part(test)] += spent_s
    return sums
