"""Files that others made, read within limits: no device or pipe keeps a program waiting, no size fills its memory."""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, BinaryIO

from polysight.shared.errors import DataError

MOST_JSON_BYTES = 256 << 20
"""Of a JSON file: a hundred times the manifest of a scan of ten thousand rows."""


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file to be read; a pipe without a writer hangs nobody.

    Raises
    ------
    DataError
        when it is a folder, a device or a pipe.
    OSError
        when it cannot be opened.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise DataError(f"{path}: is no regular file", "a folder, a device or a pipe", "give a file")
        return os.fdopen(os.dup(descriptor), "rb")
    finally:
        os.close(descriptor)


def read_bounded(path: Path, most: int) -> bytes:
    """A regular file's bytes, `most` at most; devices, pipes and larger files are refused before they are read.

    Raises
    ------
    DataError
        when it is none, or larger.
    OSError
        when it cannot be read.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(most + 1) if size <= most else b""
    if size > most or len(data) > most:
        size = max(size, len(data))
        raise DataError(f"{path}: {size} bytes, {most} at most are read", "another file", "check which file it is")
    return data


def read_json(path: Path, most: int = MOST_JSON_BYTES) -> Any:
    """What a JSON file holds.

    Raises
    ------
    ValueError
        when it is not JSON in UTF-8, or lists in it are nested too deeply to be read.
    DataError, OSError
        as :func:`read_bounded`.
    """
    return parse_json(read_bounded(path, most))


def parse_json(raw: bytes) -> Any:
    """What JSON in UTF-8 says. Raises ValueError, also where lists are nested too deeply to be read."""
    try:
        return json.loads(raw.decode("utf-8"))
    except RecursionError:
        raise ValueError("nested too deeply") from None


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Within the block, an OSError that names no file (a full disk, while bytes are written) names this one."""
    try:
        yield
    except OSError as e:
        if e.filename is None:
            e.filename = str(path)
        raise


def open_to_write(path: Path, mode: str = "wb", buffering: int = -1) -> IO[Any]:
    """Open a file to be written; a link in its place is refused, never written through. Raises OSError."""
    if path.is_symlink():
        raise OSError(errno.ELOOP, "it is a link, and files elsewhere are not written to", str(path))
    return path.open(mode, buffering)
