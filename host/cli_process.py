"""`polysight process`: one scan, or many at once; the options for many, and the table at their end."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from polysight.host.cli_numbers import count
from polysight.shared.errors import ConfigError, PolysightError

if TYPE_CHECKING:
    from polysight.host.jobs.batch import Job, Outcome


def add_data_arguments(sub: argparse.ArgumentParser, several: bool) -> None:
    """What `process` and `image` work on; with `several` also the options that matter when more than one is given."""
    sub.add_argument(
        "data",
        type=Path,
        nargs="+" if several else None,
        metavar="DATA",
        help="scan folder, or the authors' unsynced/<scan> or raw/<scan>"
        + ("; several, or a folder of scans, are processed at once" if several else ""),
    )
    sub.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for the products; earlier ones are replaced"
    )
    sub.add_argument(
        "--config",
        type=Path,
        default=None,
        metavar="FILE",
        help="rig file for the authors' data; scan folders bring their own (default: instrument.toml beside the data,"
        " or here)",
    )
    if not several:
        return
    many = sub.add_argument_group("several scans", "their products go to DIR/<scan>/, what each says to DIR/<scan>.log")
    many.add_argument(
        "--jobs", type=count, metavar="N", help="scans at a time (default: one a core, as far as memory goes)"
    )
    many.add_argument("--again", action="store_true", help="process scans again that are finished")
    many.add_argument(
        "--dask", metavar="ADDRESS", help="on a Dask cluster, e.g. tcp://host:8786, whose workers see the same folders"
    )


def process_scans(
    args: argparse.Namespace,
    process_one: Callable[[argparse.Namespace], int],
    rig_file: Callable[[argparse.Namespace], Path | None],
) -> int:
    """One scan as ever; several, or a folder of scans, at once. Returns the exit status.

    Raises
    ------
    PolysightError
        as processing one scan does; with several only when none can be begun.
    """
    from polysight.host.jobs.batch import at_once, cores, free_memory_bytes, jobs_of, process_many, scans_of

    scans = scans_of(args.data)
    one = argparse.Namespace(**{k: v for k, v in vars(args).items() if k not in ("jobs", "again", "dask")})
    if len(args.data) == 1 and scans == args.data and args.dask is None:
        one.data = args.data[0]
        return process_one(one)
    if args.out.exists() and not args.out.is_dir():
        raise ConfigError(f"{args.out} is a file", "several scans need a folder", "give another --out")

    def rig_of_scan(data: Path) -> Path | None:
        return rig_file(argparse.Namespace(**{**vars(one), "data": data}))

    jobs = jobs_of(scans, args.out, one, rig_of_scan)
    positions = max((_positions(data) for data in scans), default=0)
    n = args.jobs or at_once(positions, cores(), free_memory_bytes())
    outcomes = process_many(jobs, args.out, min(n, len(jobs)), args.dask, args.again)
    sys.stdout.write(table(outcomes, args.out))
    return 0 if all(o.status in ("done", "skipped") for o in outcomes) else 1


def _positions(data: Path) -> int:
    """Positions of a scan, or of the published grid where its files do not say it at a glance."""
    from polysight.host.store.scan_folder import ScanFolder
    from polysight.host.store.sources.published_settings import COLLECTION

    try:
        if (data / COLLECTION).exists():
            s = json.loads((data / COLLECTION).read_text(encoding="utf-8"))
            return int(s["total_x"]) * int(s["total_y"])
        return ScanFolder.load(data).plan.positions
    except (PolysightError, OSError, ValueError, KeyError, TypeError):  # its own program will say what is wrong
        return 350 * 200


def table(outcomes: Sequence[Outcome], out: Path) -> str:
    """What became of every scan, and the counts."""
    from polysight.host.jobs.batch import SUMMARY

    rows = [("scan", "result", "seconds", "memory", "masked", "patches", "")]
    for o in outcomes:
        masked, patches = _found(out / o.name) if o.status in ("done", "skipped") else ("", "")
        seconds = f"{o.seconds:.0f}" if o.seconds else ""
        memory = f"{o.memory_gb:.1f} GB" if o.memory_gb else ""
        rows.append((o.name, o.status, seconds, memory, masked, patches, o.message))
    widths = [max(len(row[k]) for row in rows) for k in range(6)]
    lines = []
    for row in rows:
        words = [cell.ljust(w) for cell, w in zip(row[:2], widths[:2], strict=True)]
        numbers = [cell.rjust(w) for cell, w in zip(row[2:6], widths[2:], strict=True)]
        lines.append("  ".join([*words, *numbers, row[6]]).rstrip())
    count = {status: sum(o.status == status for o in outcomes) for status in ("done", "skipped", "failed", "stopped")}
    told = ", ".join(f"{n} {status}" for status, n in count.items() if n)
    end = f"{len(outcomes)} scans: {told}; products in {out}/<scan>/, all of this in {out / SUMMARY}"
    return "\n".join([*lines, end, ""])


def _found(products: Path) -> tuple[str, str]:
    """Share of positions that are masked, and number of patches, as the products say."""
    from polysight.host.products.files import SavedProducts

    saved = SavedProducts(products)
    try:
        boards = saved.quality["boards"].values()
        share = sum(b["positions_masked"] for b in boards) / max(1, sum(b["positions"] for b in boards))
        return f"{100 * share:.2g} %", str(len(saved.materials["segments"]))
    except (PolysightError, AttributeError, KeyError, TypeError):
        return "", ""


def main() -> int:
    """Process the job on standard input, and mark it as finished; returns the exit status."""
    import pickle
    import resource

    from polysight.host.cli import process_one
    from polysight.host.products.files import FINISHED
    from polysight.host.report import write_json

    job: Job = pickle.loads(sys.stdin.buffer.read())  # from the program that started this one

    began = time.monotonic()
    try:
        (job.out / FINISHED).unlink(missing_ok=True)
        status = process_one(argparse.Namespace(data=job.data, out=job.out, **job.options))
    except PolysightError as e:
        sys.stderr.write(f"{e}\n")
        return e.exit_status
    except OSError as e:
        sys.stderr.write(f"{e.filename or job.out}: {e.strerror or e}\n")
        return 1
    if status == 0:
        used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
        seconds = round(time.monotonic() - began, 1)
        write_json(job.out / FINISHED, {"made_with": job.made_with, "seconds": seconds, "memory_gb": used / 1e9})
    return status


if __name__ == "__main__":
    sys.exit(main())
