"""The manifest of a scan: one JSON line per fact, each with its CRC-32, only ever appended to.

A line counts when it is complete and its CRC is right. The last line may be torn by a kill or power cut: reading stops
before it and says so, and appending cuts it off first.
"""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from polysight.host.store.append_only import AppendFile
from polysight.shared.errors import DataError, DeviceError, PolysightError

Fact = dict[str, Any]


@dataclass
class Manifest:
    """What a manifest holds.

    Attributes
    ----------
    facts
        The facts in order, without their CRC.
    length
        Bytes up to the end of the last whole line.
    torn
        Whether bytes follow that are not a whole line.
    damaged
        Line numbers (from 1) before the end whose CRC or form is wrong; they are not among the facts.
    """

    facts: list[Fact] = field(default_factory=list)
    length: int = 0
    torn: bool = False
    damaged: list[int] = field(default_factory=list)


def crc_of(fact: Fact) -> str:
    """CRC-32 (hex) of a fact without its `crc`: JSON, keys sorted, compact separators."""
    body = json.dumps(fact, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return f"{zlib.crc32(body.encode('ascii')):08x}"


def encode_line(fact: Fact) -> bytes:
    """A fact as its line, CRC and line end included."""
    line = json.dumps({**fact, "crc": crc_of(fact)}, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return line.encode("ascii") + b"\n"


def decode_line(line: bytes) -> Fact | None:
    """A line's fact without its CRC; None when the line is not one or its CRC is wrong."""
    try:
        fact = json.loads(line)
    except ValueError:
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
    found = Manifest(torn=bool(tail))
    position = 0
    for number, line in enumerate(lines, 1):
        fact = decode_line(line)
        if fact is None and number == len(lines) and not tail:
            found.torn = True
            break
        if fact is None:
            found.damaged.append(number)
        else:
            found.facts.append(fact)
        position += len(line) + 1
        found.length = position
    return found


def read(path: Path) -> Manifest:
    """Read a manifest. Raises DataError when the file is absent or unreadable."""
    try:
        return parse(path.read_bytes())
    except OSError as e:
        raise DataError(
            f"{path}: cannot be read: {e.strerror}", f"{path.parent} is not a scan folder", "give the folder of a scan"
        ) from None


class ManifestWriter:
    """Appends facts durably; holds a lock, so that two programs never write one scan. A torn last line is cut off.

    Raises
    ------
    DeviceError
        when another program holds the scan, or the file cannot be written.
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
            self._file.cut(read(path).length)
        except PolysightError:
            self._file.close()
            raise

    def append(self, fact: Fact) -> None:
        """Write one fact; it is durable when this returns. Raises DeviceError, and then it is not there."""
        self._file.append(encode_line(fact))

    def close(self) -> None:
        """Release the scan. Twice is once."""
        self._file.close()

    def __enter__(self) -> ManifestWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
