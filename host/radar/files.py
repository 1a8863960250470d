"""Files that others made, read within limits: firmware, traces, kept calibrations."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from polysight.shared.errors import ConfigError


def read_bounded(path: Path, most: int) -> bytes:
    """A regular file's bytes, `most` at most; devices, pipes and larger files are refused before they are read.

    Raises ConfigError, OSError.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe without a writer does not hang
    try:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            raise ConfigError(f"{path}: is no regular file", "a folder, a device or a pipe", "give a file")
        with os.fdopen(os.dup(descriptor), "rb") as file:
            data = file.read(most + 1) if found.st_size <= most else b""
    finally:
        os.close(descriptor)
    if found.st_size > most or len(data) > most:
        size = max(found.st_size, len(data))
        raise ConfigError(f"{path}: {size} bytes, {most} at most are read", "another file", "check which file it is")
    return data
