"""The scans under a folder: which there are, what state each is in, and where one is that is asked for by name.

A scan's line of the list comes from its manifest's bytes: rows are counted by a search, all other facts are read with
their CRC. Nothing is read again that has not changed, so that hundreds of scans are listed at once.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from polysight.host.acquisition import last_alive_s
from polysight.host.catalogue.notes import NOTES, Notes, is_plain, read_notes
from polysight.host.products import IMAGE, MATERIALS, QUALITY, SavedProducts
from polysight.host.store import MANIFEST, Fact, manifest
from polysight.shared.errors import DataError, PolysightError, no_such

PROGRAM = "program"
"""Folder of a scan in which programs that a page started keep their process number and log."""
_DEEP, _MOST = 4, 5000  # folders below the first, and scans, that are looked at
_LAPSE_S = 15.0
_GRACE_S = 20.0  # from a manifest's last line to the first sign of life
_ROW = re.compile(rb'"row":(\d+)')
_NOT_INSIDE = ("raw", "products", "samples", "calibration", "control", PROGRAM)
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
        (a folder in which a program was started and no scan is yet), `products` (no rows beside), `damaged`.
    rows, committed
        Of the plan, and those that count.
    verdict
        Level of its products' verdict, "" where it was not processed or not judged.
    processed
        Whether there is an image.
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
    materials: tuple[str, ...] = ()
    notes: str = ""
    tags: tuple[str, ...] = ()
    seconds: float = 0.0


class Scans:
    """The scans in a folder, or a single one.

    Parameters
    ----------
    root
        Folder to look under.
    only
        Name of the one scan in it that is shown; it need not be there yet. None: all.
    """

    def __init__(self, root: Path, only: str | None = None) -> None:
        self.root, self.only = root, only
        self._kept: dict[str, tuple[Stamp, Summary]] = {}

    def list(self) -> list[Summary]:
        """Every scan, the newest first; what has changed since the last call is read again."""
        names = [self.only] if self.only is not None else list(_names(self.root))
        found = {name: self._summary(name) for name in names}
        self._kept = {name: kept for name, kept in self._kept.items() if name in found}
        return sorted(found.values(), key=lambda s: (-s.seconds, s.name))

    def left_out(self) -> list[str]:
        """Names in the folder that hold a scan and are not listed: links, and names that cannot be shown; in ASCII."""
        if self.only is not None:
            return []
        with suppress(OSError), os.scandir(self.root) as entries:
            odd = [e for e in entries if not e.name.startswith(".") and (e.is_symlink() or not _is_name(e.name))]
            return sorted(ascii(e.name)[1:-1] for e in odd if _is_scan(Path(e.path)))
        return []

    def summary(self, name: str) -> Summary:
        """One of them. Raises DataError as :meth:`folder`."""
        self.folder(name)
        return self._summary(name)

    def folder(self, name: str, new: bool = False) -> Path:
        """The folder of a scan.

        Parameters
        ----------
        name
            As the list has it.
        new
            A scan to be made: it need not be there.

        Raises
        ------
        DataError
            when the name leads out of the folder, also by a link, or there is no such scan.
        """
        parts = name.split("/")
        good = bool(name) and len(name) <= 1000 and len(parts) <= _DEEP and all(map(_is_name, parts))
        if self.only is not None:
            good = good and name == self.only
        path = self.root / PurePosixPath(name) if good else self.root
        try:
            good = good and path.resolve() == self.root.resolve() / name  # no link on the way
            there = good and (new or name == self.only or _is_scan(path))
        except (OSError, ValueError):
            there = False
        if not good:
            raise DataError(
                f"no scan is called {name[:80]!r} here", "the name leads elsewhere, or is none", "see the list"
            )
        if not path.exists() and not there:
            raise no_such(path)
        if not there:
            raise DataError(f"{path}: no scan", "nothing was recorded there", "see the list")
        return path

    def _summary(self, name: str) -> Summary:
        folder = self.root / name
        stamp = _stamp(folder)
        kept = self._kept.get(name)
        if kept is None or kept[0] != stamp:
            kept = self._kept[name] = (stamp, summary_of(folder, name))
        return _as_of_now(folder, kept[1])


def folder_bytes(folder: Path) -> int:
    """Bytes of all files in a folder; links are not followed."""
    total = 0
    for where, _, files in os.walk(folder):
        for name in files:
            try:
                total += (Path(where) / name).lstat().st_size
            except OSError:
                continue  # it has just gone
    return total


def _names(root: Path, prefix: str = "", deep: int = 1) -> Iterator[str]:
    """Names of the scans below a folder. Links, hidden folders and the insides of scans are not looked at."""
    try:
        entries = sorted(os.scandir(root), key=lambda e: e.name)
    except OSError:
        return
    count = 0
    for entry in entries:
        if not _is_name(entry.name) or not entry.is_dir(follow_symlinks=False):
            continue
        name, path = f"{prefix}{entry.name}", Path(entry.path)
        if _is_scan(path):
            yield name
            count += 1
        elif deep < _DEEP:
            yield from _names(path, f"{name}/", deep + 1)
        if count >= _MOST:
            return


def _is_name(part: str) -> bool:
    return bool(part) and not part.startswith(".") and part.isprintable() and "\\" not in part and len(part) <= 200


def _is_scan(path: Path) -> bool:
    return any((path / name).exists() for name in (MANIFEST, IMAGE, PROGRAM))


def _stamp(folder: Path) -> Stamp:
    """What changes when anything of a summary does."""
    files = (MANIFEST, NOTES, f"products/{IMAGE}", f"products/{QUALITY}", IMAGE, QUALITY)
    out = []
    for name in files:
        try:
            status = (folder / name).stat()
            out.append((status.st_mtime_ns, status.st_size))
        except OSError:
            out.append((0, -1))
    return tuple(out)


def summary_of(folder: Path, name: str) -> Summary:
    """A scan's line, but for what time changes: a scan that has not ended is `lost` here."""
    try:
        notes = read_notes(folder)
    except DataError as e:
        notes = Notes(e.what)
    told: dict[str, Any] = {"name": name, "notes": notes.notes, "tags": notes.tags, **_processed(folder)}
    try:
        raw = (folder / MANIFEST).read_bytes() if is_plain(folder / MANIFEST) else None
    except OSError:
        raw = None
    if raw is None:
        return Summary(state="products" if told["processed"] else "begun", **{"seconds": _age(folder), **told})
    first, rows, last = _read(raw)
    if first is None:
        return Summary(state="damaged", **{"seconds": _age(folder), **told})
    plan, rig = first.get("plan", {}), first.get("instrument", {})
    started = str(first.get("started_utc", ""))
    told |= {
        "scan_id": str(first.get("scan_id", "")), "simulated": bool(first.get("simulated")), "started_utc": started,
        "rig": str(rig.get("name", "")) if isinstance(rig, dict) else "", "committed": len(rows),
        "rows": int(plan.get("rows", 0)) if isinstance(plan, dict) else 0, "seconds": _seconds(started) or _age(folder),
    }  # fmt: skip
    return Summary(state=_state(last, told), reason=str(last.get("reason", ""))[:300], **told)


def _read(raw: bytes) -> tuple[Fact | None, set[int], Fact]:
    """First fact, rows that count, and the last fact that says how the scan stands."""
    rows: set[int] = set()
    first: Fact | None = None
    last: Fact = {}
    for line in raw.split(b"\n"):
        if b'"fact":"row_committed"' in line:  # most lines: their digits are enough for a list
            found = _ROW.search(line, line.find(b'"pulses"'))
            if found is not None:
                rows.add(int(found[1]))
            continue
        fact = manifest.decode_line(line) if line else None
        if fact is None:
            continue
        if fact["fact"] == "scan_started":
            first = first or fact
        elif fact["fact"] == "row_withdrawn":
            rows.discard(int(fact.get("row", -1)))
        elif fact["fact"] in ("scan_ended", "scan_resumed", "scan_paused", "scan_continued"):
            last = fact
    return first, rows, last


def _state(last: Fact, told: dict[str, Any]) -> str:
    if last.get("fact") == "scan_paused":
        return "paused"  # if its program lives
    if last.get("fact") != "scan_ended":
        return "lost"
    if last.get("exit_status") == "success" and told["committed"] >= told["rows"]:
        return "finished"
    return "stopped" if last.get("exit_status") == "abort" else "failed"


def _as_of_now(folder: Path, s: Summary) -> Summary:
    """With the signs of life of its program."""
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
    return Summary(**{**s.__dict__, "state": state})


def _processed(folder: Path) -> dict[str, Any]:
    """Verdict and names of the products."""
    where = next((f for f in (folder / "products", folder) if (f / IMAGE).exists()), None)
    if where is None:
        return {"processed": False}
    told: dict[str, Any] = {"processed": True}
    try:
        products = SavedProducts(where)
        verdict = products.verdict
        told["verdict"] = "" if verdict is None else verdict.level
        if (where / MATERIALS).exists():
            names = [str(s["name"]) for s in products.segments if s.get("name")]
            told["materials"] = tuple(dict.fromkeys(names))[:12]
        if where == folder:
            told |= {"scan_id": products.scan_id, "simulated": products.simulated}
    except (PolysightError, TypeError, KeyError, AttributeError):  # the page of the scan says what is wrong
        told["verdict"] = "damaged"
    return told


def _age(folder: Path) -> float:
    try:
        return folder.stat().st_mtime
    except OSError:
        return 0.0


def _seconds(utc: str) -> float:
    from datetime import datetime

    try:
        return datetime.fromisoformat(utc).timestamp()
    except ValueError:
        return 0.0
