"""One line of the list of scans, from a scan folder's manifest, products, notes and program."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from polysight.acquisition import last_alive_s
from polysight.catalogue.notes import NOTES, Notes, is_plain, printable, read_notes
from polysight.products import IMAGE, MATERIALS, QUALITY, SavedProducts
from polysight.store import MANIFEST, manifest
from polysight_shared.errors import DataError, PolysightError

PROGRAM = "program"
"""Folder of a scan in which programs that a page started keep their process number and log."""
_TAIL_BYTES = 16384
_CONTROL_SEQUENCE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
_LAPSE_S = 15.0
_GRACE_S = 20.0  # from a manifest's last line to the first sign of life
Stamp = tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Summary:
    """One line of the list.

    Attributes
    ----------
    name
        Its path below the folder that is listed, with `/`.
    state
        `running`, `paused`, `finished`, `stopped`, `failed`, `lost` (no program writes it, and none said why), `begun`
        (a folder in which a program was started and no scan is yet), `products` (no rows beside), `damaged`, `silent`
        (its folder does not answer: a network drive that is gone).
    rows, committed
        Of the plan, and those that count.
    verdict
        Level of its products' verdict, "" where it was not processed or not judged.
    processed
        True if there are materials.
    images_only
        True if there are images without materials: by `polysight image`, or before processing has ended.
    seconds
        When it began, since 1970; 0 where nothing says.
    """

    name: str
    state: str
    scan_id: str = ""
    rig: str = ""
    simulated: bool | None = None
    started_utc: str = ""
    rows: int = 0
    committed: int = 0
    reason: str = ""
    verdict: str = ""
    processed: bool = False
    images_only: bool = False
    materials: tuple[str, ...] = ()
    notes: str = ""
    tags: tuple[str, ...] = ()
    seconds: float = 0.0


def stamp_of(folder: Path) -> Stamp:
    """Times and sizes of the files that a summary is made from."""
    files = (MANIFEST, NOTES, f"products/{IMAGE}", f"products/{QUALITY}", IMAGE, QUALITY, f"{PROGRAM}/scan.status")
    out = []
    for name in files:
        try:
            status = (folder / name).stat()
            out.append((status.st_mtime_ns, status.st_size))
        except OSError:
            out.append((0, -1))
    return tuple(out)


def summary_of(folder: Path, name: str) -> Summary:
    """Summarise a scan without signs of life: a scan that has not ended is `lost` here, see :func:`as_of_now`."""
    try:
        notes = read_notes(folder)
    except DataError as e:
        notes = Notes(e.what)
    facts: dict[str, Any] = {"name": name, "notes": notes.notes, "tags": notes.tags, **_processed(folder)}
    try:
        content = manifest.read(folder / MANIFEST) if is_plain(folder / MANIFEST) else None
    except DataError:
        content = None
    if content is None:
        products = facts["processed"] or facts.get("images_only", False)
        reason = "" if products else _start_failure(folder)
        state = "products" if products else "failed" if reason else "begun"
        return Summary(state=state, reason=reason, **{"seconds": _age(folder), **facts})
    started, ended = content.started, content.ended
    if started is None:
        return Summary(state="damaged", **{"seconds": _age(folder), **facts})
    facts |= {
        "scan_id": started.scan_id, "simulated": started.simulated, "started_utc": started.started_utc,
        "rig": str(started.instrument.get("name", "")), "committed": len(content.rows), "rows": started.plan.rows,
        "seconds": _seconds(started.started_utc) or _age(folder),
    }  # fmt: skip
    state = "lost" if content.state == "open" else content.state  # `as_of_now` asks if its program lives
    return Summary(state=state, reason="" if ended is None else ended.reason[:300], **facts)


def _start_failure(folder: Path) -> str:
    """Why the program of a scan ended before its first row, from its log; "" if it runs, or was killed."""
    status = folder / PROGRAM / "scan.status"
    try:
        if not is_plain(status) or status.read_text(encoding="ascii")[:8].strip() in ("", "0"):
            return ""
    except (OSError, ValueError):
        return ""
    lines = log_tail(folder / PROGRAM / "scan.log").splitlines()
    errors = [line.partition(": ")[2] for line in lines if line.startswith(("polysight scan: ", "polysight resume: "))]
    return (errors or lines or ["its program ended without a message"])[-1][:300]


def log_tail(path: Path) -> str:
    """The end of a program's log since its last start, without control sequences; "" if there is none."""
    if not is_plain(path):
        return ""
    try:
        with path.open("rb") as f:
            f.seek(max(0, f.seek(0, 2) - _TAIL_BYTES))
            text = f.read().decode("utf-8", errors="replace")
    except OSError:
        return ""
    lines = text.replace("\r\n", "\n").split("\n")
    starts = [k for k, line in enumerate(lines) if line.startswith("--- ")]
    text = "\n".join(lines[starts[-1] + 1 :] if starts else lines)
    return printable(_CONTROL_SEQUENCE.sub("", text), keep="\n\t").strip()


def as_of_now(folder: Path, s: Summary) -> Summary:
    """The summary with the present state, from the signs of life of the scan's program."""
    if s.state not in ("lost", "paused"):
        return s
    life, now = last_alive_s(folder), time.time()
    if life is None:
        try:
            alive = now - (folder / MANIFEST).stat().st_mtime < _GRACE_S
        except OSError:
            alive = False
    else:
        alive = now - life < _LAPSE_S
    state = s.state if alive and s.state == "paused" else "running" if alive else "lost"
    return replace(s, state=state)


def _processed(folder: Path) -> dict[str, Any]:
    """Verdict and names of the products."""
    where = next((f for f in (folder / "products", folder) if (f / IMAGE).exists()), None)
    if where is None:
        return {"processed": False}
    complete = (where / MATERIALS).exists()
    found: dict[str, Any] = {"processed": complete, "images_only": not complete}
    try:
        products = SavedProducts(where)
        if complete:
            verdict = products.verdict
            found["verdict"] = "" if verdict is None else verdict.level
            names = [str(s["name"]) for s in products.segments if s.get("name")]
            found["materials"] = tuple(dict.fromkeys(names))[:12]
        if where == folder:
            found |= {"scan_id": products.scan_id, "simulated": products.simulated}
    except (PolysightError, TypeError, KeyError, AttributeError):  # the page of the scan says what is wrong
        found["verdict"] = "damaged"
    return found


def _age(folder: Path) -> float:
    try:
        return folder.stat().st_mtime
    except OSError:
        return 0.0


def _seconds(utc: str) -> float:
    try:
        return datetime.fromisoformat(utc).timestamp()
    except ValueError:
        return 0.0
