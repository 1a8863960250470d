"""Many scans at once: one program each, as many at a time as cores and memory allow, here or on a Dask cluster.

A scan that fails, or is killed for want of memory, takes no other with it. What is finished carries a mark that says
what it was made with; a later run passes over it unless data, options, rig file or version have changed since.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Event
from typing import Any, Literal

from polysight.host.products.files import FINISHED
from polysight.host.report import write_json
from polysight.host.store.scan_folder import MANIFEST, versions
from polysight.host.store.sources.published_settings import COLLECTION
from polysight.shared.errors import ConfigError

SUMMARY = "processed.json"
Status = Literal["done", "skipped", "failed", "stopped"]
_PRODUCTS = ("image.npz", "quality.json")
_CLI = ("data", "out", "run", "command", "jobs", "dask", "again")  # what does not change what comes out
PROGRAM = (sys.executable, "-m", "polysight.host.cli_process")
"""Processes the one job on its standard input."""
_FREE = 0.8  # of the free memory is used
_POLL_S = 0.2


@dataclass(frozen=True)
class Job:
    """One scan to process: where it is, where its products go, the command's options, and what that amounts to."""

    data: Path
    out: Path
    options: Mapping[str, Any]
    made_with: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Of the scan's folder."""
        return self.out.name


@dataclass(frozen=True)
class Outcome:
    """What became of a scan; seconds and the largest memory of its program (GB) where it ran."""

    name: str
    status: Status
    seconds: float = 0.0
    memory_gb: float = 0.0
    message: str = ""


def scans_of(paths: Sequence[Path]) -> list[Path]:
    """The scans behind paths: a scan folder is itself, any other folder the scans in it, if it holds any."""
    out: list[Path] = []
    for path in paths:
        inside = [] if is_scan(path) or not path.is_dir() else sorted(p for p in path.iterdir() if is_scan(p))
        out += inside or [path]
    return out


def is_scan(path: Path) -> bool:
    """Whether a folder is a scan folder, or `unsynced/<scan>` or `raw/<scan>` of the published data."""
    known = (MANIFEST, COLLECTION)
    return path.is_dir() and (any((path / name).exists() for name in known) or any(path.glob("*_synced.npy")))


def jobs_of(
    scans: Sequence[Path], out: Path, args: argparse.Namespace, rig_file: Callable[[Path], Path | None]
) -> list[Job]:
    """A job for each scan, into `out`/<its name>.

    Raises
    ------
    ConfigError
        when two scans have one name.
    """
    options = {key: _absolute(value) for key, value in vars(args).items() if key not in _CLI}
    jobs: dict[str, Job] = {}
    for data in (p.absolute() for p in scans):
        if data.name in jobs:
            raise ConfigError(
                f"two scans are named {data.name}: {jobs[data.name].data} and {data}",
                "their products would go into one folder",
                "process them in two runs, each with its own --out",
            )
        config = None if (data / MANIFEST).exists() else rig_file(data)
        chosen = {**options, "config": None if config is None else config.absolute()}
        jobs[data.name] = Job(data, out.absolute() / data.name, chosen, made_with(data, chosen))
    return list(jobs.values())


def _absolute(value: Any) -> Any:
    return value.absolute() if isinstance(value, Path) else value


_MEANING = 2  # counts changes of what products of the same data hold
NOT_DATA = ("products", ".products.new", ".products.old", "products-export", "control")  # folders of a scan


def made_with(data: Path, options: Mapping[str, Any]) -> dict[str, Any]:
    """What products depend on: releases, options (files by their digest), and the data's files by size and time."""
    told = {key: _told(value) for key, value in sorted(options.items())}
    files = sorted(p for p in data.rglob("*") if p.is_file() and p.relative_to(data).parts[0] not in NOT_DATA)
    listing = [f"{p.relative_to(data)} {s.st_size} {s.st_mtime_ns}" for p in files for s in (p.stat(),)]
    digest = hashlib.sha256("\n".join(listing).encode()).hexdigest()
    return {"versions": versions(), "products": _MEANING, "options": told, "data": digest}


def _told(value: Any) -> Any:
    if isinstance(value, Path) and value.is_file():
        return hashlib.sha256(value.read_bytes()).hexdigest()
    if isinstance(value, Path) and value.is_dir():  # products of another scan, such as a metal reference
        return [f"{p.name} {p.stat().st_size} {p.stat().st_mtime_ns}" for p in sorted(value.iterdir()) if p.is_file()]
    return value if isinstance(value, int | float | None) else str(value)


def finished(job: Job) -> bool:
    """Whether the products are there and were made with just this."""
    try:
        mark = json.loads((job.out / FINISHED).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    same = isinstance(mark, dict) and mark.get("made_with") == json.loads(json.dumps(job.made_with))
    return same and all((job.out / name).exists() for name in _PRODUCTS)


def run_scan(job: Job, stop: Event | None = None) -> Outcome:
    """Process one scan in a program of its own; what it says goes to `<out>.log`. Never raises for what it does."""
    began = time.monotonic()
    log = job.out.with_name(job.name + ".log")
    log.parent.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    with log.open("wb") as said:
        child = subprocess.Popen(PROGRAM, stdin=subprocess.PIPE, stdout=said, stderr=said, env=environment)
        if child.stdin is not None:
            child.stdin.write(pickle.dumps(job))
            child.stdin.close()
        while child.poll() is None:
            if stop is not None and stop.wait(_POLL_S):
                child.terminate()
                child.wait()
            elif stop is None:
                child.wait()
    seconds = time.monotonic() - began
    if stop is not None and stop.is_set() and child.returncode:
        return Outcome(job.name, "stopped", seconds)
    if child.returncode:
        return Outcome(job.name, "failed", seconds, message=_why(log, child.returncode))
    mark = json.loads((job.out / FINISHED).read_text(encoding="utf-8"))
    return Outcome(job.name, "done", seconds, float(mark["memory_gb"]))


def _why(log: Path, status: int) -> str:
    if status < 0:
        return f"killed by signal {-status}; signal 9 is usually the system running out of memory: give --jobs 1"
    lines = [x.strip() for x in log.read_text(encoding="utf-8", errors="replace").splitlines() if x.strip()]
    told = [x for x in lines if not x.startswith(("why:", "do:"))]
    return told[-1] if told else f"exit status {status}"


def run_here(jobs: Sequence[Job], at_once: int) -> Iterator[Outcome]:
    """Outcomes as they come, `at_once` programs at a time. Ended early, the programs are ended too."""
    stop = Event()
    with ThreadPoolExecutor(at_once) as pool:
        try:
            pending = [pool.submit(run_scan, job, stop) for job in jobs]
            for done in as_completed(pending):
                yield done.result()
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


def run_on_dask(jobs: Sequence[Job], address: str, timeout: str = "30s") -> Iterator[Outcome]:
    """Outcomes as they come from a Dask cluster whose workers see the same folders.

    Raises
    ------
    ConfigError
        when Dask is not installed, or nothing answers at the address.
    """
    try:
        from dask.distributed import Client, as_completed  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ConfigError(
            "Dask is not installed here",
            "it is needed for --dask alone, and not installed with the rest",
            "pip install 'polysight[dask]' here and on the workers (in the repository: '.[dask]')",
        ) from None
    try:
        client = Client(address, timeout=timeout)
    except (OSError, TimeoutError, ValueError) as e:
        raise ConfigError(
            f"no Dask scheduler at {address}: {e}",
            "it is not running, or a firewall is between",
            "start one with `dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`",
        ) from None
    with client:
        named = {client.submit(run_scan, job, pure=False): job.name for job in jobs}
        for future in as_completed(list(named)):
            if future.status == "finished":
                yield future.result()
            else:
                yield Outcome(named[future], "failed", message=f"its worker was lost: {future.exception()}")


def memory_bytes(positions: int) -> int:
    """Memory that processing one scan takes, by its number of positions: measured, see docs/how-to/authors-data.md."""
    return 400_000_000 + 6_000 * positions


def at_once(positions: int, cores: int, free_bytes: int) -> int:
    """How many scans fit cores and free memory; at least one."""
    return max(1, min(cores, int(_FREE * free_bytes / memory_bytes(positions))))


def free_memory_bytes() -> int:
    """Memory that programs can have without swapping."""
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def cores() -> int:
    """Cores that this program may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def process_many(
    jobs: Sequence[Job], out: Path, jobs_at_once: int, dask: str | None = None, again: bool = False
) -> list[Outcome]:
    """Process what is not finished; says what becomes of each on stderr, and writes `processed.json` as it goes.

    Raises
    ------
    ConfigError
        when there is no Dask, or no cluster, where it is asked for.
    """
    passed_over = [] if again else [j for j in jobs if finished(j)]
    todo = [j for j in jobs if j not in passed_over]
    outcomes = {j.name: Outcome(j.name, "skipped") for j in passed_over}
    where = f"on the cluster at {dask}" if dask else f"{jobs_at_once} at a time"
    sys.stderr.write(f"{len(jobs)} scans: {len(passed_over)} finished before, {len(todo)} to process, {where}\n")
    out.mkdir(parents=True, exist_ok=True)
    results = run_on_dask(todo, dask) if dask else run_here(todo, jobs_at_once)
    for n, outcome in enumerate(results if todo else (), 1):
        outcomes[outcome.name] = outcome
        tail = f": {outcome.message}" if outcome.message else ""
        sys.stderr.write(f"[{n}/{len(todo)}] {outcome.name}: {outcome.status}, {outcome.seconds:.0f} s{tail}\n")
        write_json(out / SUMMARY, {"scans": [asdict(outcomes[j.name]) for j in jobs if j.name in outcomes]})
    return [outcomes[j.name] for j in jobs]
