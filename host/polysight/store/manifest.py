"""The manifest of a scan: an append-only log with one JSON line per fact, each with its CRC-32.

A line is valid if it is complete and its CRC is right. A last line torn by a kill or power cut is reported by readers
and cut off before appending. Lines form a chain: each has its count and a digest of the line before, so that missing
lines are found. Lines of earlier releases have no chain and are still read.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from polysight.store.append_only import AppendFile
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError, DeviceError, PolysightError, no_such
from polysight_shared.files import MAX_JSON_BYTES, read_bounded

Fact = dict[str, Any]


@dataclass(frozen=True)
class ManifestFault:
    """A damaged line, or a place where lines are missing, replaced or out of order."""

    line: int  # number in the file, from 1
    what: str
    lost: int = 0  # number of facts lost

    def __str__(self) -> str:
        return f"manifest.jsonl line {self.line}: {self.what}"


@dataclass
class Manifest:
    """Content of a manifest."""

    facts: list[Fact] = field(default_factory=list)  # in order, without CRC and chain
    numbers: list[int] = field(default_factory=list)  # line number (from 1) of each fact
    length: int = 0  # bytes up to the end of the last complete line
    torn: bool = False  # an incomplete line follows
    faults: list[ManifestFault] = field(default_factory=list)  # damaged lines and breaks in the chain
    count: int = 0  # of the next line
    digest: str = ""  # that the next line must have


def crc_of(fact: Fact) -> str:
    """CRC-32 (hex) of a fact without its `crc`: JSON, keys sorted, compact separators."""
    body = json.dumps(fact, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return f"{zlib.crc32(body.encode('ascii')):08x}"


def encode_line(fact: Fact) -> bytes:
    """Encode a fact as a line with CRC and line end."""
    line = json.dumps({**fact, "crc": crc_of(fact)}, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return line.encode("ascii") + b"\n"


def digest_of(line: bytes) -> str:
    """Return the digest that the next line stores: 16 hex digits of the SHA-256 of the line without its end."""
    return hashlib.sha256(line).hexdigest()[:16]


def decode_line(line: bytes) -> Fact | None:
    """Decode a line to its fact without CRC; None if the line is malformed or its CRC is wrong."""
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
    tail = lines.pop()  # an incomplete last line
    found, due = Manifest(torn=bool(tail)), 0  # due: one more than the last count that was read
    for number, line in enumerate(lines, 1):
        fact = decode_line(line)
        if fact is None and number == len(lines) and not tail:
            found.torn = True
            break
        if fact is None:
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
    """Remove and return a fact's count and its digest of the line before; None for a line without chain."""
    if not isinstance(fact.get("count"), int) or not isinstance(fact.get("previous"), str):
        return None
    return fact.pop("count"), fact.pop("previous")


def _compare(link: tuple[int, str], found: Manifest, due: int, number: int) -> None:
    """Compare a line's link with the lines before it, and add faults."""
    count, previous = link
    missing, damaged = count - found.count, due < found.count  # damaged: the line before
    if missing > 0 and damaged:  # a damaged line end joins two lines
        last = found.faults.pop()
        found.faults.append(ManifestFault(last.line, last.what, last.lost + missing))
    elif missing > 0:
        what = f"{missing} lines before it are missing" if missing > 1 else "a line before it is missing"
        found.faults.append(ManifestFault(number, f"{what} (count {count}, {found.count} expected)", missing))
    elif count < due:
        what = f"repeated or out of order (count {count}, {due} expected)"
        found.faults.append(ManifestFault(number, what))
    elif not damaged and previous != found.digest:
        what = "the line before it was replaced"
        found.faults.append(ManifestFault(number, what, 1))


def read(path: Path) -> Manifest:
    """Read a manifest. Raises DataError if the file is absent or unreadable."""
    try:
        return parse(read_bounded(path, MAX_JSON_BYTES))
    except OSError as e:
        if not path.parent.exists():
            raise no_such(path.parent) from None
        raise DataError(
            f"{path}: cannot be read: {e.strerror}",
            f"{path.parent} is not a scan folder",
            "give the folder of a scan",
            code=ErrorCode.FILE_MISSING if isinstance(e, FileNotFoundError) else ErrorCode.FILE_UNREADABLE,
        ) from None


class ManifestWriter:
    """Appends facts durably and locks the scan against other programs. A torn last line is cut off.

    Raises
    ------
    DeviceError
        if another program holds the scan, or the file cannot be written.
    """

    def __init__(self, path: Path, create: bool) -> None:
        if create == path.exists():
            if create:
                raise DeviceError(
                    f"{path}: exists already",
                    f"{path.parent} holds a scan",
                    f"choose another folder, or `polysight resume {path.parent}`",
                    code=ErrorCode.FILE_EXISTS,
                )
            what, why = f"{path}: does not exist", f"{path.parent} is no scan folder"
            raise DeviceError(what, why, "give the folder of a scan", code=ErrorCode.FILE_MISSING)
        self._file = AppendFile(path, create)
        if not self._file.lock():
            self._file.close()
            what = f"{path}: another program is writing this scan"
            raise DeviceError(what, "a scan runs", "wait for it, or stop it first", code=ErrorCode.BUSY)
        try:
            found = read(path)
            self._count, self._digest = found.count, found.digest
            self._file.cut(found.length)
        except PolysightError:
            self._file.close()
            raise

    def append(self, fact: Fact) -> None:
        """Append one fact durably. After a DeviceError the manifest does not contain it."""
        line = encode_line({**fact, "count": self._count, "previous": self._digest})
        self._file.append(line)
        self._count, self._digest = self._count + 1, digest_of(line[:-1])

    def close(self) -> None:
        """Close the file and release the lock. Safe to repeat."""
        self._file.close()

    def __enter__(self) -> ManifestWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
