"""How everything here is measured: one core, jobs in turn, medians, and the machine named."""

from __future__ import annotations

import importlib.util
import os
import platform
import statistics
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_LOOK_S = 0.02


def one_thread_each() -> None:
    """Libraries start no threads of their own; to be called before NumPy is imported."""
    os.environ.update(dict.fromkeys(THREADS, "1"))


@contextmanager
def one_core() -> Iterator[None]:
    """This process and its children run on one core, whatever they would like."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(allowed)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, allowed)


@dataclass
class Seconds:
    """Repeated timings of one job.

    CPU seconds are compared, not wall seconds: on one core they are the same when nothing else runs, and other work on
    the machine counts less in them.
    """

    cpu: list[float] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Time a block, and append it."""
        wall, cpu = time.perf_counter(), time.process_time()
        yield
        self.cpu.append(time.process_time() - cpu)
        self.wall.append(time.perf_counter() - wall)

    @property
    def median(self) -> float:
        """Median CPU seconds."""
        return statistics.median(self.cpu)

    @property
    def median_wall(self) -> float:
        """Median wall seconds."""
        return statistics.median(self.wall)


def alternate(jobs: dict[str, Callable[[], Any]], repeats: int) -> dict[str, Seconds]:
    """Run the jobs in turn, `repeats` rounds after one that warms caches and is not counted."""
    found = {name: Seconds() for name in jobs}
    for turn in range(repeats + 1):
        for name, job in jobs.items():
            with (found[name] if turn else Seconds()).timed():
                job()
    return found


class AnonymousMemory:
    """Highest anonymous resident memory (RssAnon) of a process, watched from outside: file pages are not in it."""

    def __init__(self, pid: int) -> None:
        self.peak_bytes = 0
        self._path = Path(f"/proc/{pid}/status")
        self._ended = threading.Event()
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        self._watcher.start()

    def _watch(self) -> None:
        while not self._ended.wait(_LOOK_S):
            try:
                text = self._path.read_text(encoding="ascii")
            except (FileNotFoundError, ProcessLookupError):
                return
            line = next((row for row in text.splitlines() if row.startswith("RssAnon:")), None)
            if line is not None:
                self.peak_bytes = max(self.peak_bytes, int(line.split()[1]) * 1024)

    def close(self) -> int:
        """Stop watching; returns the highest value seen, bytes."""
        self._ended.set()
        self._watcher.join()
        return self.peak_bytes


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    info = Path("/proc/cpuinfo")
    models = [row.split(":")[1] for row in info.read_text().splitlines() if row.startswith("model name")]
    packages = {p: version(p) for p in ("numpy", "scipy", "numba", "fastsar") if importlib.util.find_spec(p)}
    return {
        "cpu": models[0].strip() if models else platform.processor(),
        "cores": os.cpu_count(),
        "cores_used": len(os.sched_getaffinity(0)),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "load_average": [round(x, 1) for x in os.getloadavg()],
        "python": platform.python_version(),
        **packages,
    }
