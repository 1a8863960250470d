"""The manifest of a scan: one JSON line per fact, each with its CRC-32, only ever appended to.

A line counts when it is complete and its CRC is right. The last line may be torn by a kill or power cut: reading stops
before it and says so, and appending cuts it off first. Lines form a chain: each carries its count and a digest of the
line before, so that a line that is gone is noticed. Lines of earlier releases have no chain and are read all the same.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from polysight.host.store.append_only import AppendFile
from polysight.shared.errors import DataError, DeviceError, PolysightError, no_such
from polysight.shared.files import MOST_JSON_BYTES, read_bounded

Fact = dict[str, Any]


@dataclass(frozen=True)
class ManifestFault:
    """A line that is damaged, or a place where lines are missing, replaced or out of order.

    Attributes
    ----------
    line
        Number of the line in the file, from 1.
    what
        What is wrong there.
    lost
        Facts that are lost with it.
    """

    line: int
    what: str
    lost: int = 0

    def __str__(self) -> str:
        return f"manifest.jsonl line {self.line}: {self.what}"


@dataclass
class Manifest:
    """What a manifest holds.

    Attributes
    ----------
    facts
        The facts in order, without CRC and chain.
    numbers
        Of each fact, the number of its line (from 1).
    length
        Bytes up to the end of the last whole line.
    torn
        Whether bytes follow that are not a whole line.
    damaged
        Line numbers (from 1) before the end whose CRC or form is wrong; they are not among the facts.
    faults
        The same, and every place where the chain is broken.
    count, digest
        Count of the next line, and the digest that it has to carry.
    """

    facts: list[Fact] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    length: int = 0
    torn: bool = False
    damaged: list[int] = field(default_factory=list)
    faults: list[ManifestFault] = field(default_factory=list)
    count: int = 0
    digest: str = ""


def crc_of(fact: Fact) -> str:
    """CRC-32 (hex) of a fact without its `crc`: JSON, keys sorted, compact separators."""
    body = json.dumps(fact, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return f"{zlib.crc32(body.encode('ascii')):08x}"


def encode_line(fact: Fact) -> bytes:
    """A fact as its line, CRC and line end included."""
    line = json.dumps({**fact, "crc": crc_of(fact)}, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return line.encode("ascii") + b"\n"


def digest_of(line: bytes) -> str:
    """What the next line carries of this one: 16 hex digits of the SHA-256 of its bytes without the line end."""
    return hashlib.sha256(line).hexdigest()[:16]


def decode_line(line: bytes) -> Fact | None:
    """A line's fact without its CRC; None if the line is not one or its CRC is wrong."""
    try:
        fact = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(fact, dict) or not isinstance(fact.get("fact"), str):
        return None
    crc = fact.pop("crc", None)
    try:
        return fact if crc == crc_of(fact) else None
    except ValueError:
        return None


def parse(raw: bytes) -> Manifest:
    """Read a manifest's bytes."""
    lines = raw.split(b"\n")
    tail = lines.pop()  # what follows the last line end
    found, due = Manifest(torn=bool(tail)), 0  # due: one more than the last count that was read
    for number, line in enumerate(lines, 1):
        fact = decode_line(line)
        if fact is None and number == len(lines) and not tail:
            found.torn = True
            break
        if fact is None:
            found.damaged.append(number)
            found.faults.append(ManifestFault(number, "damaged: its CRC is wrong", 1))
            found.count += 1
        else:
            link = _take_link(fact)
            if link is not None:
                _compare(link, found, due, number)
                found.count = link[0]
            found.count = due = found.count + 1
            found.facts.append(fact)
            found.numbers.append(number)
        found.digest = digest_of(line)
        found.length += len(line) + 1
    return found


def _take_link(fact: Fact) -> tuple[int, str] | None:
    """Take count and digest of the line before out of a fact; None for a line without chain."""
    if not isinstance(fact.get("count"), int) or not isinstance(fact.get("previous"), str):
        return None
    return fact.pop("count"), fact.pop("previous")


def _compare(link: tuple[int, str], found: Manifest, due: int, number: int) -> None:
    """Compare a line's link with what was read before it, and add what is wrong to the faults."""
    count, previous = link
    missing, damaged = count - found.count, due < found.count  # damaged: the line before is
    if missing > 0 and damaged:  # a damaged line end makes one line of two
        last = found.faults.pop()
        found.faults.append(ManifestFault(last.line, last.what, last.lost + missing))
    elif missing > 0:
        what = f"{missing} lines before it are missing" if missing > 1 else "a line before it is missing"
        found.faults.append(ManifestFault(number, f"{what} (count {count}, {found.count} was due)", missing))
    elif count < due:
        what = f"repeated or out of order (count {count}, {due} was due)"
        found.faults.append(ManifestFault(number, what))
    elif not damaged and previous != found.digest:
        what = "the line before is not the one that it was written after: replaced"
        found.faults.append(ManifestFault(number, what, 1))


def read(path: Path) -> Manifest:
    """Read a manifest. Raises DataError if the file is absent or unreadable."""
    try:
        return parse(read_bounded(path, MOST_JSON_BYTES))
    except OSError as e:
        if not path.parent.exists():
            raise no_such(path.parent) from None
        raise DataError(
            f"{path}: cannot be read: {e.strerror}", f"{path.parent} is not a scan folder", "give the folder of a scan"
        ) from None


class ManifestWriter:
    """Appends facts durably; holds a lock, so that two programs never write one scan. A torn last line is cut off.

    Raises
    ------
    DeviceError
        if another program holds the scan, or the file cannot be written.
    """

    def __init__(self, path: Path, create: bool) -> None:
        if create == path.exists():
            raise DeviceError(
                f"{path}: cannot be {'created: it exists' if create else 'opened: it does not exist'}",
                f"{path.parent} holds a scan already" if create else f"{path.parent} is no scan folder",
                f"choose another folder, or `polysight resume {path.parent}` to go on with it"
                if create
                else "give the folder of a scan",
            )
        self._file = AppendFile(path, create)
        if not self._file.lock():
            self._file.close()
            raise DeviceError(
                f"{path}: another program is writing this scan", "a scan runs", "wait for it, or stop it first"
            )
        try:
            found = read(path)
            self._count, self._digest = found.count, found.digest
            self._file.cut(found.length)
        except PolysightError:
            self._file.close()
            raise

    def append(self, fact: Fact) -> None:
        """Write one fact; it is durable when this returns. Raises DeviceError, and then it is not there."""
        line = encode_line({**fact, "count": self._count, "previous": self._digest})
        self._file.append(line)
        self._count, self._digest = self._count + 1, digest_of(line[:-1])

    def close(self) -> None:
        """Release the scan. Twice is once."""
        self._file.close()

    def __enter__(self) -> ManifestWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
