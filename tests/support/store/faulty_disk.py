"""A disk that fails, or a program that is killed, at the n-th operation on one folder.

Only Python's operations in this process are counted: every write, fsync, reservation, truncation, and every name made,
moved or removed below the folder. So a test can count them once and then fail each of them.
"""

from __future__ import annotations

import errno
import io
import os
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import pytest

Fault = Literal["full", "short", "killed", "killed within", "power cut", "worst power cut"]
# Operations that are counted.
SEEN = ("open", "pwrite", "fsync", "mkdir", "rename", "replace", "unlink", "ftruncate", "posix_fallocate")
# The real functions, while those of `os` and `io` are replaced.
REAL_OPEN = io.open
REAL = SimpleNamespace(**{name: getattr(os, name) for name in SEEN})
# Smaller than the 512 bytes of a real disk, because the files of the tests are small.
SECTOR_BYTES = 64
# Operations that need space on the disk.
GROWS = ("write", "pwrite", "posix_fallocate", "create", "mkdir", "rename", "fsync")


class Killed(BaseException):
    """The program ends here: nothing catches this, and later operations do not reach the disk."""


class FaultyDisk:
    """Counts operations below `folder`; a fault hits the `at`-th of them (from 1).

    full
        This and all later operations that need space fail with ENOSPC, until :meth:`free_space`.
    short
        As full, but the failing write writes half of its bytes first, as on a disk whose last block is used.
    killed, killed within
        The program ends before the operation, or in the middle of it.
    power cut
        The same, and unsynced data may be lost: a file may have its old size or its new one, and each of its
        sectors may be old, new or, beyond the old end, zero; names made, moved or removed may be as before. Bytes that
        were synced and not written again are always there.
    worst power cut
        The same, and all that was not synced is lost.
    """

    def __init__(self, folder: Path, fault: Fault | None = None, at: int = 0, seed: int = 0) -> None:
        self._folder = str(folder)
        self._fault = fault
        self.at = at
        self._random = random.Random(seed)
        # True once the program was killed.
        self._dead = False
        # True once there is space again.
        self._space = False
        # Operations so far, with the name of the file.
        self.done: list[str] = []
        # Content of a touched file that is on the disk for certain.
        self._durable: dict[Path, bytes] = {}
        # Names that are not synced yet: their folder, and how to lose them.
        self._undo: list[tuple[Path, Callable[[], object]]] = []

    def free_space(self) -> None:
        """The disk accepts writes again."""
        self._space = True

    def _hit(self, what: str, path: Path, half: Callable[[], object] = lambda: None) -> None:
        """Count one operation, and fail it if its number is `at`."""
        if not str(path).startswith(self._folder):
            return
        if self._dead:
            raise Killed
        self.done.append(f"{what} {path.name}")
        n = len(self.done)
        if self._fault in ("full", "short") and n >= self.at and not self._space and what in GROWS:
            if n == self.at and self._fault == "short":
                half()
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        if self._fault in ("killed", "killed within", "power cut", "worst power cut") and n == self.at:
            if self._fault != "killed":
                half()
            self._dead = True
            raise Killed

    # --- what a power cut leaves ---

    def _touch(self, path: Path) -> None:
        """Note the content of a file before its first change since it was synced."""
        if str(path).startswith(self._folder):
            self._durable.setdefault(path, path.read_bytes() if path.exists() else b"")

    def _sync(self, path: Path) -> None:
        """Note that a file's content, or the names in a folder, are on the disk."""
        if path.is_dir():
            self._undo = [(folder, back) for folder, back in self._undo if folder != path]
        elif path in self._durable:
            del self._durable[path]

    def lose_power(self) -> None:
        """Draw which unsynced changes remain. Names are lost from the newest on: file systems keep their order."""
        worst = self._fault == "worst power cut"
        for path, durable in self._durable.items():
            if path.exists():
                now = path.read_bytes()
                path.write_bytes(durable if worst else self._draw_content(durable, now))
        names_left = 0 if worst else self._random.randint(0, len(self._undo))
        for _, back in reversed(self._undo[names_left:]):
            back()

    def _draw_content(self, durable: bytes, now: bytes) -> bytes:
        """Draw the remaining content of a file: old, new, new up to some byte, or each sector old or new."""
        written = self._random.randint(0, len(now))
        content_before = durable + bytes(max(0, len(now) - len(durable)))
        sectors = (slice(k, k + SECTOR_BYTES) for k in range(0, len(now), SECTOR_BYTES))
        mixed = b"".join(
            (now if self._random.random() < 0.5 else content_before[: len(now)])[sector] for sector in sectors
        )
        return self._random.choice([durable, now, content_before, now[:written] + durable[written:], mixed])

    # --- the operations ---

    @contextmanager
    def __call__(self) -> Iterator[FaultyDisk]:
        """Redirect all disk operations of the block to this object."""
        calls = {"open": self._os_open, "pwrite": self._pwrite, "fsync": self._fsync, "mkdir": self._mkdir}
        calls |= {"rename": self._rename, "replace": self._rename, "unlink": self._unlink}
        calls |= {name: partial(self._on_file, name) for name in ("ftruncate", "posix_fallocate")}
        try:
            with pytest.MonkeyPatch.context() as patch:
                for name, call in calls.items():
                    patch.setattr(os, name, call)
                patch.setattr(io, "open", self._opened)
                yield self
        finally:
            # `Killed` passes through here: now the power cut destroys unsynced data.
            if self._dead and self._fault in ("power cut", "worst power cut"):
                self.lose_power()

    def _opened(self, file: Any, mode: str = "r", buffering: int = -1, *more: Any, **named: Any) -> Any:
        """Replace `io.open`: a file below the folder that is opened for writing is counted."""
        path = Path(str(file))
        if isinstance(file, int) or not str(path).startswith(self._folder) or not set(mode) & set("wxa+"):
            return REAL_OPEN(file, mode, buffering, *more, **named)
        new = not path.exists()
        if new:
            self._hit("create", path)
        self._touch(path)
        raw = _SeenFile(self, str(path), mode.replace("b", ""))
        if new:
            self._undo.append((path.parent, lambda: path.unlink(missing_ok=True)))
        if buffering == 0:
            return raw
        return io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)

    def _os_open(self, path: Any, flags: int, *more: Any, **named: Any) -> int:
        new = flags & os.O_CREAT and not Path(path).exists()
        if new:
            self._hit("create", Path(path))
        fd = REAL.open(path, flags, *more, **named)
        if new and str(path).startswith(self._folder):
            self._durable.setdefault(Path(path), b"")
            self._undo.append((Path(path).parent, lambda: Path(path).unlink(missing_ok=True)))
        return fd

    def _pwrite(self, fd: int, data: Any, offset: int) -> int:
        path = _read_descriptor_path(fd)
        self._touch(path)
        self._hit("pwrite", path, lambda: REAL.pwrite(fd, bytes(data)[: len(data) // 2], offset))
        return REAL.pwrite(fd, data, offset)

    def _on_file(self, name: str, fd: int, *more: Any) -> Any:
        self._touch(_read_descriptor_path(fd))
        self._hit(name, _read_descriptor_path(fd))
        return getattr(REAL, name)(fd, *more)

    def _fsync(self, fd: int) -> None:
        self._hit("fsync", _read_descriptor_path(fd))
        # The real sync would only cost time.
        self._sync(_read_descriptor_path(fd))

    def _mkdir(self, path: Any, *more: Any, **named: Any) -> None:
        self._hit("mkdir", Path(path))
        REAL.mkdir(path, *more, **named)
        if str(path).startswith(self._folder):
            self._undo.append((Path(path).parent, Path(path).rmdir))

    def _rename(self, a: Any, b: Any, **named: Any) -> None:
        """Rename a file; until its folder is synced a power cut may undo that."""
        a = Path(a)
        b = Path(b)
        self._hit("rename", b)
        content_before = b.read_bytes() if b.exists() else None
        REAL.rename(a, b, **named)
        self._durable.pop(b, None)
        if a in self._durable:
            self._durable[b] = self._durable.pop(a)

        def back() -> None:
            if b.exists():
                REAL.rename(b, a)
            if content_before is not None:
                b.write_bytes(content_before)

        self._undo.append((b.parent, back))

    def _unlink(self, path: Any, **named: Any) -> None:
        """Remove a file; until its folder is synced a power cut may bring it back."""
        path = Path(path)
        is_tracked = str(path).startswith(self._folder) and path.exists()
        self._hit("unlink", path)
        content = self._durable.pop(path, path.read_bytes()) if is_tracked else b""
        REAL.unlink(path, **named)
        if is_tracked:
            self._undo.append((path.parent, lambda: path.write_bytes(content)))


class _SeenFile(io.FileIO):
    """A file whose writes the disk counts."""

    def __init__(self, disk: FaultyDisk, path: str, mode: str) -> None:
        self._disk = disk
        super().__init__(path, mode)

    def write(self, data: Any) -> int:
        path = Path(str(self.name))
        start = self.tell()
        self._disk._touch(path)
        self._disk._hit("write", path, lambda: REAL.pwrite(self.fileno(), bytes(data)[: len(data) // 2], start))
        return super().write(data)

    def truncate(self, size: int | None = None) -> int:
        self._disk._touch(Path(str(self.name)))
        self._disk._hit("truncate", Path(str(self.name)))
        return super().truncate(size)


def _read_descriptor_path(fd: int) -> Path:
    """The path of an open descriptor."""
    return Path(f"/proc/self/fd/{fd}").readlink()
