"""How everything here is measured: one core, jobs in turn, medians, the machine named; helper processes; the tables."""

import argparse
import importlib.util
import json
import os
import platform
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

# Environment variables that limit the threads of numerical libraries.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
# Time between two readings of a process's memory (chosen).
_LOOK_S = 0.02
ROOT = Path(__file__).parents[1]
# Unit of CPU times in /proc.
TICK_S = 1 / os.sysconf("SC_CLK_TCK")


def limit_threads() -> None:
    """Keep libraries from starting threads of their own. Call it before NumPy is imported."""
    os.environ.update(dict.fromkeys(THREADS, "1"))


@contextmanager
def keep_on_one_core() -> Iterator[None]:
    """Keep this thread, and all that it starts in the block, on one core; running threads are not moved."""
    allowed = os.sched_getaffinity(0)
    # Which one does not matter.
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
    def time_block(self) -> Iterator[None]:
        """Time a block, and append it."""
        wall = time.perf_counter()
        cpu = time.process_time()
        yield
        self.cpu.append(time.process_time() - cpu)
        self.wall.append(time.perf_counter() - wall)

    @property
    def median(self) -> float:
        """Median of the CPU seconds."""
        return statistics.median(self.cpu)

    @property
    def median_wall(self) -> float:
        return statistics.median(self.wall)


def count_repeats(quick: bool, usual: int) -> int:
    """Return the number of repeats of a measurement: a quick trial only shows that it runs."""
    if quick:
        return 1
    return usual


class AnonymousMemory:
    """Highest anonymous resident memory (RssAnon) of a process, watched from outside: file pages are not in it."""

    def __init__(self, pid: int) -> None:
        self.peak_bytes = 0
        self._path = Path(f"/proc/{pid}/status")
        self._ended = threading.Event()
        self._watcher = threading.Thread(target=self._watch, daemon=True)
        self._watcher.start()

    def _watch(self) -> None:
        """Read the memory again and again until the process or the measurement ends."""
        while not self._ended.wait(_LOOK_S):
            try:
                text = self._path.read_text(encoding="ascii")
            except (FileNotFoundError, ProcessLookupError):
                return
            line = next((row for row in text.splitlines() if row.startswith("RssAnon:")), None)
            if line is not None:
                self.peak_bytes = max(self.peak_bytes, int(line.split()[1]) * 1024)

    def close(self) -> int:
        """Stop watching; return the highest value seen, bytes."""
        self._ended.set()
        self._watcher.join()
        return self.peak_bytes


def machine() -> dict[str, Any]:
    """Return the facts of the machine on which the figures were measured."""
    info = Path("/proc/cpuinfo")
    models = [row.split(":")[1] for row in info.read_text().splitlines() if row.startswith("model name")]
    packages = {p: version(p) for p in ("numpy", "scipy", "numba") if importlib.util.find_spec(p)}
    return {
        "cpu": models[0].strip() if models else platform.processor(),
        "cores": os.cpu_count(),
        "cores_used": len(os.sched_getaffinity(0)),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "load_average": [round(x, 1) for x in os.getloadavg()],
        "python": platform.python_version(),
        **packages,
    }


class Child:
    """A helper process, `python -m MODULE WORDS`, that answers lines with lines of JSON."""

    def __init__(self, module: str, *words: object) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *map(str, words)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env=os.environ | dict.fromkeys(THREADS, "1"),
        )

    def say(self, *words: object) -> None:
        """Send a line."""
        if self._process.stdin is not None:
            self._process.stdin.write(" ".join(map(str, words)) + "\n")
            self._process.stdin.flush()

    def hear(self) -> Any:
        """Wait for an answer and return it, `ready` as text. Raises RuntimeError if the process has ended."""
        line = ""
        if self._process.stdout is not None:
            line = self._process.stdout.readline()
        if not line:
            raise RuntimeError(f"helper ended with status {self._process.wait()}")
        if line == "ready\n":
            return line.strip()
        return json.loads(line)

    def close(self) -> None:
        """End the helper's input and wait until it ends."""
        self._process.communicate()


def ask(beside: Child | None) -> dict[str, Any]:
    """Ask a process that processes rows while something else is measured for its progress (`rows`, `cpu_s`).

    Without such a process both are 0.
    """
    if beside is None:
        return {"rows": 0, "cpu_s": 0.0}
    beside.say()
    return beside.hear()


def cpu_s(pid: int) -> float:
    """Return the CPU seconds of a process so far, without those of its children."""
    # Fields of proc(5) after the name, which is in brackets and may hold spaces: ticks in user and in system mode.
    words = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
    return (int(words[11]) + int(words[12])) * TICK_S


@dataclass(frozen=True)
class Line:
    """One quantity of the table.

    Attributes
    ----------
    quantity
        The measured quantity.
    ours, theirs
        The two figures as text with their units; `theirs` may be empty.
    value
        The judged value: a ratio or an amount.
    at_least, aim
        Required and desired limits: the least that is allowed, or the most if lower is better.
    higher_is_better
        Whether a larger `value` is better: of ratios of speed it is, of times, memory and errors it is not.
    note
        How it was measured, when that is not plain.
    """

    quantity: str
    ours: str
    theirs: str
    value: float
    at_least: float | None = None
    aim: float | None = None
    higher_is_better: bool = True
    note: str = ""

    @property
    def verdict(self) -> str:
        """Say if the value reaches a limit; "" for a line without limits."""
        if self.at_least is None or self.aim is None:
            return ""
        if self._reaches(self.aim):
            return "aim"
        if self._reaches(self.at_least):
            return "holds"
        return "DOES NOT HOLD"

    def _reaches(self, limit: float) -> bool:
        if self.higher_is_better:
            return self.value >= limit
        return self.value <= limit

    def cells(self) -> list[str]:
        """Return the texts of the table's columns (HEAD)."""

        def number(x: float | None) -> str:
            if x is None:
                return ""
            if self.higher_is_better:
                return f"{x:.0f}x"
            return f"{x:.3g}"

        value = f"{self.value:.1f}x" if self.higher_is_better else f"{self.value:.3g}"
        return [self.quantity, self.ours, self.theirs, value, number(self.at_least), number(self.aim), self.verdict]


def line_at_most(
    quantity: str, value: float, unit: str, limit: float, aim: float | None = None, note: str = ""
) -> Line:
    """Return the line of an amount that must not exceed the limit, and should not exceed the aim (default: the limit).

    There is no other program to compare with.
    """
    if aim is None:
        aim = limit
    return Line(quantity, f"{value:.3g} {unit}", "", value, limit, aim, higher_is_better=False, note=note)


HEAD = ["quantity (simulated data)", "ours", "beside it", "value", "at least", "aim", ""]


def show(title: str, lines: list[Line], quick: bool = False) -> None:
    """Print a table, its notes below; after a quick trial without verdicts, which would mean nothing."""
    rows = [HEAD, *(line.cells()[: -1 if quick else None] for line in lines)]
    width = [max(len(row[i]) for row in rows if i < len(row)) for i in range(len(HEAD))]
    this_machine = machine()
    print(f"\n{title}{'; a quick trial, not a measurement' if quick else ''}")
    load = this_machine["load_average"][0]
    where = f"{this_machine['cpu']}, {this_machine['cores']} cores, load {load}"
    print(f"{where}; seconds are CPU seconds unless a line says otherwise")
    for row in rows:
        print("  ".join(cell.ljust(width[i]) if i < 3 else cell.rjust(width[i]) for i, cell in enumerate(row)))
    for line in lines:
        if line.note:
            print(f"  {line.quantity}: {line.note}")
    print(flush=True)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of every benchmark that prints such a table."""
    parser.add_argument("--folder", type=Path, default=None, help="where data is made (default: a temporary folder)")
    parser.add_argument("--quick", action="store_true", help="a tiny grid, once: shows that it runs, nothing else")
    parser.add_argument("--json", type=Path, default=None, help="also write the figures and the machine to this file")


def write(path: Path | None, name: str, lines: list[Line], **more: Any) -> None:
    """Write the figures and the machine they were measured on as JSON; `more`: further keys. None: write nothing."""
    if path is None:
        return
    content = {
        "benchmark": name,
        "simulated": True,
        "measured_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "machine": machine(),
        "lines": [{**asdict(line), "verdict": line.verdict} for line in lines],
        **more,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
