"""Processing of many scans, each in a separate program.

As many programs run at a time as cores and memory allow, on this machine or on a Dask cluster. A scan that fails, or
whose program is killed because memory runs out, does not stop the others. Finished products have a mark file with
everything that they depend on; a later run skips them unless data, options, rig file or version have changed.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Event
from typing import Any, Literal

import msgspec

from polysight.calibration import load_scan_calibration
from polysight.jobs.output import exit_status
from polysight.jobs.process import process
from polysight.process import count_cores, is_given_images
from polysight.products import FINISHED, IMAGE, QUALITY, SCAN, ProcessedScan, write_json
from polysight.results import NoResult
from polysight.settings import Settings
from polysight.store import (
    COLLECTION,
    MANIFEST,
    SAMPLES,
    TRUTH,
    ScanFolder,
    dropped_rows,
    is_source,
    open_source,
    versions,
)
from polysight_shared.errors import ConfigError, ErrorCode, PolysightError
from polysight_shared.files import read_json

SUMMARY_FILE = "processed.json"
"""File of the outcomes of all scans, in the folder that holds their products."""
Status = Literal["done", "skipped", "failed", "stopped"]
# Files without which products do not count as finished, even if they have the mark.
_PRODUCTS = (IMAGE, QUALITY)
WORKER_COMMAND = (sys.executable, "-m", "polysight.jobs.batch")
"""Module that processes the job on its standard input."""
PARENT_PIPE_VARIABLE = "POLYSIGHT_PARENT_ALIVE"
"""Environment variable of the worker: number of the read end of a pipe that closes when the parent program ends."""
# A fifth of the free memory is left to the system (chosen): `memory_bytes` is an estimate, and other programs grow
# meanwhile.
SHARE_OF_FREE_MEMORY = 0.8
# Time between two looks at a running program and at the request to stop; chosen.
_POLL_S = 0.2


class Job(msgspec.Struct, frozen=True):
    """One scan to process, as plain data.

    `data` and `products` are absolute folders, `made_with` the dependencies that :func:`describe_dependencies` returns,
    `threads` the number of rows processed at a time.
    """

    data: str
    products: str
    settings: Settings
    made_with: dict[str, Any]
    threads: int = 1

    @property
    def out(self) -> Path:
        """Folder of its products."""
        return Path(self.products)

    @property
    def name(self) -> str:
        """Name of the scan's folder."""
        return self.out.name


@dataclass(frozen=True)
class Outcome:
    """Result of one scan, with the time and largest memory (GB) of its program; 0 if it did not run or is not known.

    `message` is the reason of a failure, else empty.
    """

    name: str
    status: Status
    seconds: float = 0.0
    memory_gb: float = 0.0
    message: str = ""

    @property
    def has_products(self) -> bool:
        """True if the scan is processed now, or was before."""
        return self.status in ("done", "skipped")


def find_scans(paths: Sequence[Path]) -> list[Path]:
    """Return the scans at paths: scan folders themselves, and the scans in other folders.

    A path without any scan is returned unchanged: the error comes from the program that processes it.
    """
    folders: list[Path] = []
    for path in paths:
        # The .npz files of products are not scans.
        if path.is_dir() and not _is_data(path) and not (path / SCAN).exists():
            scans_inside = sorted(p for p in path.iterdir() if _is_data(p))
        else:
            scans_inside = []
        folders += scans_inside or [path]
    return folders


def _is_data(path: Path) -> bool:
    """True for a scan of any layout, and for given images (H and V of another program, without raw data)."""
    return is_source(path) or is_given_images(path)


def make_jobs(scans: Sequence[tuple[Path, Settings]], out: Path) -> list[Job]:
    """Make a job for each scan and its settings; its products go to `out`/<name of the scan>.

    Raises
    ------
    ConfigError
        when two scans have the same name: their products would go into one folder.
    """
    jobs: dict[str, Job] = {}
    for folder, settings in scans:
        data = folder.absolute()
        if data.name in jobs:
            raise ConfigError(
                f"two scans are named {data.name}: {jobs[data.name].data} and {data}",
                "their products would go into one folder",
                "process them in two runs, each with its own --out",
                code=ErrorCode.NAME_TAKEN,
            )
        settings = settings.absolute()
        # A scan folder brings its own rig file.
        if (data / MANIFEST).exists():
            settings = msgspec.structs.replace(settings, config=None)
        jobs[data.name] = Job(
            str(data), str(out.absolute() / data.name), settings, describe_dependencies(data, settings)
        )
    return list(jobs.values())


# Increased by each release that makes other products from the same data.
PRODUCTS_VERSION = 4
# Files that the products of a scan folder, or of published data, are made from.
_OWN_FILES = (MANIFEST, TRUTH, "raw/*/*.bin", "raw/*/*.idx")
_PUBLISHED_FILES = ("*_cfg.json", TRUTH, "*/*.bin", "*/*_log.csv", "*_synced.npy")


def describe_dependencies(data: Path, settings: Settings) -> dict[str, Any]:
    """Return what products depend on: releases, options, and a digest of the data files' sizes and times.

    An option that names a file is represented by a digest of the file's content, and one that names a folder by a
    digest of sizes and times, as the data.
    """
    config = settings.path("config")
    options = settings.choices()
    for name, path in settings.files().items():
        if path.is_file():
            options[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        else:
            options[name] = _digest_scan(path, config)
    return {
        "versions": versions(),
        "products": PRODUCTS_VERSION,
        "options": options,
        "data": _digest_scan(data, config),
    }


def _digest_scan(folder: Path, config: Path | None) -> str:
    """Return a digest of the sizes and times of a scan's :func:`data_files`."""
    listing = []
    for path in data_files(folder, config):
        status = path.stat()
        listing.append(f"{os.path.relpath(path, folder)} {status.st_size} {status.st_mtime_ns}")
    return hashlib.sha256("\n".join(listing).encode()).hexdigest()


def data_files(folder: Path, config: Path | None = None) -> list[Path]:
    """Return the files that products of a scan are made from: manifest, rows, calibration and truth.

    `config` is the rig file of scans without one. Stored samples count only if raw data was dropped: otherwise they are
    made again from the raw data. Notes, labels, exports, programs and products in the folder are not data.
    """
    if is_given_images(folder) and folder.is_file():
        return [folder]
    if is_given_images(folder):
        return sorted([*folder.glob("*.npy"), *folder.glob("*.json")])
    patterns = _OWN_FILES if (folder / MANIFEST).exists() else _PUBLISHED_FILES
    files: list[Path] = []
    # Errors are left to the program that processes the scan: its message is the result.
    with suppress(PolysightError):
        # `dropped`: a scan whose raw data was deleted is opened, too.
        source = open_source(folder, config, dropped=True)
        if isinstance(source, ScanFolder) and dropped_rows(source):
            patterns = (*patterns, f"{SAMPLES}/*")
        files += (load_scan_calibration(source).paths or {}).values()
    for pattern in patterns:
        files += folder.glob(pattern)
    return sorted({file for file in files if file.is_file()})


def is_finished(job: Job) -> bool:
    """True if images and quality exist, and the mark file has exactly the dependencies of this job."""
    try:
        mark = read_json(job.out / FINISHED)
    except (OSError, ValueError, PolysightError):
        return False
    # Compared as JSON, in which tuples are lists.
    has_same_settings = isinstance(mark, dict) and mark.get("made_with") == json.loads(json.dumps(job.made_with))
    return has_same_settings and all((job.out / name).exists() for name in _PRODUCTS)


def run_scan(job: Job, stop: Event | None = None) -> Outcome:
    """Process one scan in a child program, whose output goes to `<out>.log`; a failure is returned as an outcome.

    The child ends when this program does, also if this is killed, or when `stop` is set. `stop` is None on a Dask
    worker, where nothing sets it. A scan whose products have the mark is not processed again: a Dask worker may have
    been killed after it wrote the mark and before it reported the outcome.
    """
    if is_finished(job):
        return _end_outcome(job)
    started_s = time.monotonic()
    log = job.out.with_name(job.name + ".log")
    log.parent.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    # Nothing is written to the pipe: that it closes shows the child that this program has ended.
    child_end, parent_end = os.pipe()
    try:
        environment[PARENT_PIPE_VARIABLE] = str(child_end)
        with log.open("wb") as output:
            child = subprocess.Popen(
                WORKER_COMMAND,
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=output,
                env=environment,
                pass_fds=(child_end,),
            )
            _follow(child, job, stop)
    finally:
        os.close(child_end)
        os.close(parent_end)
    seconds = time.monotonic() - started_s
    # The child may have been killed after it wrote the mark.
    if child.returncode == 0 or is_finished(job):
        return _end_outcome(job, seconds)
    if stop is not None and stop.is_set():
        return Outcome(job.name, "stopped", seconds)
    return Outcome(job.name, "failed", seconds, message=_read_failure(log, child.returncode, on_dask=stop is None))


def _follow(child: subprocess.Popen[bytes], job: Job, stop: Event | None) -> None:
    """Send a program its job and wait for its end; terminate it if `stop` is set."""
    if child.stdin is not None:
        # The child may end before it reads; its log says why.
        with suppress(BrokenPipeError):
            child.stdin.write(msgspec.msgpack.encode(job))
            child.stdin.close()
    while child.poll() is None:
        if stop is not None and stop.wait(_POLL_S):
            child.terminate()
            child.wait()
        elif stop is None:
            child.wait()


def _end_outcome(job: Job, seconds: float = 0.0) -> Outcome:
    """Return the outcome of a finished scan; without `seconds` its time is taken from the mark file."""
    mark = read_json(job.out / FINISHED)
    return Outcome(job.name, "done", seconds or float(mark.get("seconds", 0.0)), float(mark["memory_gb"]))


def _read_failure(log: Path, status: int, on_dask: bool) -> str:
    """Return the last message in a program's log, or the signal that killed it."""
    if status < 0:
        what_to_do = "start fewer workers on one machine" if on_dask else "give --jobs 1"
        return f"killed by signal {-status}; signal 9 is usually the system running out of memory: {what_to_do}"
    lines = [x.strip() for x in log.read_text(encoding="utf-8", errors="replace").splitlines() if x.strip()]
    messages = [x for x in lines if not x.startswith(("why:", "do:"))]
    if not messages:
        return f"exit status {status}"
    return messages[-1]


def run_here(jobs: Sequence[Job], at_once: int) -> Iterator[Outcome]:
    """Yield outcomes as they come, `at_once` programs at a time; terminate the programs if stopped early."""
    stop = Event()
    with ThreadPoolExecutor(at_once) as pool:
        try:
            pending = [pool.submit(run_scan, job, stop) for job in jobs]
            for future in as_completed(pending):
                yield future.result()
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


def run_on_dask(jobs: Sequence[Job], address: str, timeout: str = "30s") -> Iterator[Outcome]:
    """Yield outcomes as they come from a Dask cluster whose workers see the same folders.

    Raises
    ------
    ConfigError
        when Dask is not installed, or nothing answers at the address.
    """
    try:
        from dask.distributed import Client, as_completed  # type: ignore[import-not-found]
    except ImportError:
        raise ConfigError(
            "Dask is not installed here",
            "it is needed for --dask alone, and not installed with the rest",
            "pip install distributed, here and on the workers",
            code=ErrorCode.PACKAGE_MISSING,
        ) from None
    try:
        client = Client(address, timeout=timeout)
    except (OSError, ValueError) as e:
        raise ConfigError(
            f"no Dask scheduler at {address}: {e}",
            "the scheduler is not running, or a firewall blocks it",
            "start one with `dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`",
            code=ErrorCode.NO_ANSWER,
        ) from None
    with client:
        jobs_by_name = {job.name: job for job in jobs}
        name_of_future = {client.submit(run_scan, job, pure=False): job.name for job in jobs}
        for future in as_completed(list(name_of_future)):
            if future.status == "finished":
                yield future.result()
            elif is_finished(jobs_by_name[name_of_future[future]]):
                # The worker was lost after it wrote the mark.
                yield _end_outcome(jobs_by_name[name_of_future[future]])
            else:
                yield Outcome(name_of_future[future], "failed", message=f"its workers were lost: {future.exception()}")


def memory_bytes(positions: int) -> int:
    """Estimate the memory of processing one scan from its positions (measured, docs/how-to/authors-data.md)."""
    return 400_000_000 + 6_000 * positions


def fit_scans(positions: int, cores: int, free_bytes: int) -> int:
    """Return the number of scans of this size for which there are cores and free memory; at least one."""
    return max(1, min(cores, int(SHARE_OF_FREE_MEMORY * free_bytes / memory_bytes(positions))))


def free_memory_bytes() -> int:
    """Return the memory that is available without swapping (Linux), or the whole memory (macOS); 0 on Windows."""
    try:
        for line in Path("/proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    if not hasattr(os, "sysconf"):
        # Windows does not report it. With zero, one scan is processed at a time.
        return 0
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def process_many(
    jobs: Sequence[Job], out: Path, jobs_at_once: int, dask: str | None = None, again: bool = False
) -> list[Outcome]:
    """Process unfinished scans (with `again` all); report each on stderr and update `processed.json` after each.

    `dask` is the address of a scheduler; None: here, `jobs_at_once` programs at a time. The outcomes have the order of
    the jobs.

    Raises
    ------
    ConfigError
        when `dask` is given and Dask is not installed, or nothing answers there.
    """
    skipped = [j for j in jobs if not again and is_finished(j)]
    todo = [j for j in jobs if j not in skipped]
    outcomes = {j.name: Outcome(j.name, "skipped") for j in skipped}
    if dask:
        workers_text = f"on the cluster at {dask}"
    else:
        workers_text = f"{jobs_at_once} at a time"
    sys.stderr.write(f"{len(jobs)} scans: {len(skipped)} finished before, {len(todo)} to process, {workers_text}\n")
    out.mkdir(parents=True, exist_ok=True)
    for job in todo:
        # Remove old marks, so that each mark found later was written by this run.
        (job.out / FINISHED).unlink(missing_ok=True)
    if not todo:
        results = iter(())
    elif dask:
        results = run_on_dask(todo, dask)
    else:
        results = run_here(todo, jobs_at_once)
    for n, outcome in enumerate(results, 1):
        outcomes[outcome.name] = outcome
        line = f"[{n}/{len(todo)}] {outcome.name}: {outcome.status}, {outcome.seconds:.0f} s"
        if outcome.message:
            line += f": {outcome.message}"
        sys.stderr.write(f"{line}\n")
        write_json(out / SUMMARY_FILE, {"scans": [asdict(outcomes[j.name]) for j in jobs if j.name in outcomes]})
    return [outcomes[j.name] for j in jobs]


def process_several(
    scans: Sequence[tuple[Path, Settings]], out: Path, at_a_time: int | None, dask: str | None, again: bool
) -> int:
    """Process several scans, `at_a_time` (None: as many as fit); print their table and return the exit status.

    With `again` finished scans are processed, too; `dask` is the address of a scheduler to use instead of this machine.

    Raises
    ------
    PolysightError
        when none can be begun.
    """
    if out.exists() and not out.is_dir():
        raise ConfigError(f"{out} is a file", "several scans need a folder", "give another --out")
    jobs = make_jobs(scans, out)
    positions = max((_count_positions(folder) for folder, _ in scans), default=0)
    jobs_at_once = at_a_time or fit_scans(positions, count_cores(), free_memory_bytes())
    jobs_at_once = min(jobs_at_once, len(jobs))
    if dask is None:
        threads = max(1, count_cores() // jobs_at_once)
        jobs = [msgspec.structs.replace(job, threads=threads) for job in jobs]
    outcomes = process_many(jobs, out, jobs_at_once, dask, again)
    sys.stdout.write(format_table(outcomes, out))
    return exit_status(all(o.has_products for o in outcomes))


def _count_positions(data: Path) -> int:
    """Return the number of positions of a scan; of the published grid if it cannot be read quickly."""
    try:
        if (data / COLLECTION).exists():
            settings = read_json(data / COLLECTION)
            return int(settings["total_x"]) * int(settings["total_y"])
        return ScanFolder.load(data).plan.positions
    except (PolysightError, OSError, ValueError, KeyError, TypeError):
        # The program that processes the scan will report the problem.
        return 350 * 200


def format_table(outcomes: Sequence[Outcome], out: Path) -> str:
    """Format a table of the results of all scans, and their counts."""
    rows = [("scan", "result", "seconds", "memory", "masked", "patches", "")]
    for outcome in outcomes:
        masked = ""
        patches = ""
        verdict = ""
        if outcome.has_products:
            masked, patches, verdict = _read_results(out / outcome.name)
        seconds = ""
        if outcome.seconds:
            seconds = f"{outcome.seconds:.0f}"
        memory = ""
        if outcome.memory_gb:
            memory = f"{outcome.memory_gb:.1f} GB"
        rows.append((outcome.name, outcome.status, seconds, memory, masked, patches, outcome.message or verdict))
    # There are two columns of words, four of numbers, and a last one that needs no padding.
    widths = [max(len(row[column]) for row in rows) for column in range(6)]
    lines = []
    for row in rows:
        words = [cell.ljust(width) for cell, width in zip(row[:2], widths[:2], strict=True)]
        numbers = [cell.rjust(width) for cell, width in zip(row[2:6], widths[2:], strict=True)]
        *_, text = row
        lines.append("  ".join([*words, *numbers, text]).rstrip())
    statuses = [outcome.status for outcome in outcomes]
    counts = ", ".join(f"{statuses.count(s)} {s}" for s in ("done", "skipped", "failed", "stopped") if s in statuses)
    end = f"{len(outcomes)} scans: {counts}; products in {out}/<scan>/, this list in {out / SUMMARY_FILE}"
    return "\n".join([*lines, end, ""])


def _read_results(products: Path) -> tuple[str, str, str]:
    """Return the share of masked or missing positions, the number of patches, and the verdict unless it is `good`.

    Values that are not known are "".
    """
    saved = ProcessedScan(products)
    try:
        boards = saved.quality.boards.values()
        if not boards or saved.materials is None:
            return "", "", ""
        # Absent positions count for each board.
        absent = 0
        if saved.quality.coverage:
            absent = saved.quality.coverage.positions_absent
        unused = sum((board.positions_masked or 0) + absent for board in boards)
        share = unused / max(1, sum((board.positions or 0) + absent for board in boards))
        masked = f"{100 * share:.2g} %"
        patches = str(len(saved.segments))
        verdict = saved.verdict
    except PolysightError:
        return "", "", ""
    if verdict is None or verdict.level == "good":
        return masked, patches, ""
    text = verdict.text
    if verdict.reasons:
        text += f": {verdict.reasons[0].what}"
    return masked, patches, text


# --- the program of one scan: `python -m polysight.jobs.batch` ---


def exit_with_parent(pipe: str | None) -> None:
    """Exit when the other end of a pipe closes, so that no process continues after the parent was killed.

    `pipe` is the number of this end, as text; None: no parent waits for this program.
    """
    if pipe is None:
        return

    def wait() -> None:
        os.read(int(pipe), 1)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def main() -> int:
    """Process one job; returns the exit status. Output goes to stdout and stderr."""
    exit_with_parent(os.environ.get(PARENT_PIPE_VARIABLE))
    job = msgspec.msgpack.decode(sys.stdin.buffer.read(), type=Job)
    started_s = time.monotonic()
    try:
        (job.out / FINISHED).unlink(missing_ok=True)
        status = process(Path(job.data), job.out, job.settings, job.threads)
    except PolysightError as e:
        sys.stderr.write(f"{e}\n")
        return e.exit_status
    except OSError as e:
        sys.stderr.write(f"{e.filename or job.out}: {e.strerror or e}\n")
        return 1
    if status == NoResult.exit_status:
        # The scan is processed: its products say that nothing can be named.
        status = 0
    if status == 0:
        seconds = round(time.monotonic() - started_s, 1)
        mark = {"made_with": job.made_with, "seconds": seconds, "memory_gb": peak_memory_bytes() / 1e9}
        write_json(job.out / FINISHED, mark)
    return status


def peak_memory_bytes() -> int:
    """Return the largest memory of this process until now; 0 if the system does not report it."""
    try:
        import resource
    except ModuleNotFoundError:
        return 0
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # The unit is a byte on macOS, a kilobyte on Linux.
    if sys.platform == "darwin":
        return peak
    return 1024 * peak


if __name__ == "__main__":
    sys.exit(main())
