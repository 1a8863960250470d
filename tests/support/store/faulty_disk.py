"""A disk that fails, or a program that is killed, at the n-th operation on files in one folder.

Operations of Python in this process are counted: every write, fsync, reservation and truncation, and every file or
folder that is made, renamed or removed. So a test can count them in a first run, and let each of them fail in another.
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
# Functions of `os` that are replaced, to count their calls
COUNTED_FUNCTIONS = ("open", "pwrite", "fsync", "mkdir", "rename", "replace", "unlink", "ftruncate", "posix_fallocate")
# The real functions of `io` and `os`
REAL_OPEN = io.open
REAL = SimpleNamespace(**{name: getattr(os, name) for name in COUNTED_FUNCTIONS})
# Smaller than the 512 bytes of a real disk, because the files of the tests are small.
SECTOR_BYTES = 64
# Operations that need space on the disk
NEED_SPACE = ("write", "pwrite", "posix_fallocate", "create", "mkdir", "rename", "fsync")


class Killed(BaseException):
    """The program was killed here. No code of the program catches this; later operations do not reach the disk."""


class FaultyDisk:
    """A disk on which the operation number `at` in `folder` (counted from 1) has a fault.

    full
        This and all later operations that need space fail with ENOSPC, until :meth:`free_space`.
    short
        As `full`, but the failing write first writes half of its bytes, as on a disk with a last free block.
    killed, killed within
        The program is killed before the operation, or in the middle of it.
    power cut
        As `killed within`, and changes that were not synced may be lost. A file may have its old or its new size. Each
        of its sectors may be old or new, or zero after the old end. A file or folder that was made, renamed or removed
        may be as before. Bytes that were synced and not written again remain.
    worst power cut
        As `killed within`, and all changes that were not synced are lost.
    """

    def __init__(self, folder: Path, fault: Fault | None = None, at: int = 0, seed: int = 0) -> None:
        self._folder = str(folder)
        self._fault = fault
        self.at = at
        self._random = random.Random(seed)
        self._is_killed = False
        # True after `free_space`
        self._has_space = False
        # Operations so far, with the names of their files
        self.done: list[str] = []
        # Synced content of files that were changed since
        self._synced: dict[Path, bytes] = {}
        # Files and folders that were made, renamed or removed since their folder was synced: this folder, and a
        # function that undoes it.
        self._undo: list[tuple[Path, Callable[[], object]]] = []

    def free_space(self) -> None:
        """Make space on the disk, so that writes succeed again."""
        self._has_space = True

    def _count(self, operation: str, path: Path, do_half: Callable[[], object] = lambda: None) -> None:
        """Count an operation before it is executed, and raise an error if it has the fault.

        `do_half` executes the first half of the operation.
        """
        if not str(path).startswith(self._folder):
            return
        if self._is_killed:
            raise Killed
        self.done.append(f"{operation} {path.name}")
        number = len(self.done)
        if self._fault in ("full", "short"):
            is_full = number >= self.at and not self._has_space
            if is_full and operation in NEED_SPACE:
                if number == self.at and self._fault == "short":
                    do_half()
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        elif self._fault is not None and number == self.at:
            if self._fault != "killed":
                do_half()
            self._is_killed = True
            raise Killed

    # --- what remains after a power cut ---

    def _record_synced_content(self, path: Path) -> None:
        """Record the content of a file before its first change since it was synced."""
        if str(path).startswith(self._folder):
            self._synced.setdefault(path, path.read_bytes() if path.exists() else b"")

    def _sync(self, path: Path) -> None:
        """Record that the content of a file, or the names in a folder, are safe on the disk."""
        if path.is_dir():
            self._undo = [(folder, undo) for folder, undo in self._undo if folder != path]
        elif path in self._synced:
            del self._synced[path]

    def lose_power(self) -> None:
        """Draw which changes remain of those that were not synced.

        File systems keep the order in which names change, so the latest ones are lost.
        """
        is_worst = self._fault == "worst power cut"
        for path, synced in self._synced.items():
            if path.exists():
                written = path.read_bytes()
                path.write_bytes(synced if is_worst else self._draw_content(synced, written))
        changes_left = 0 if is_worst else self._random.randint(0, len(self._undo))
        for _, undo in reversed(self._undo[changes_left:]):
            undo()

    def _draw_content(self, synced: bytes, written: bytes) -> bytes:
        """Draw what remains of a file: old, new, old with zeros, new up to some byte, or each sector old or new."""
        length = len(written)
        position = self._random.randint(0, length)
        with_zeros = synced + bytes(max(0, length - len(synced)))
        sectors = []
        for start in range(0, length, SECTOR_BYTES):
            content = written if self._random.random() < 0.5 else with_zeros[:length]
            sectors.append(content[start : start + SECTOR_BYTES])
        up_to_position = written[:position] + synced[position:]
        return self._random.choice([synced, written, with_zeros, up_to_position, b"".join(sectors)])

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
            # After `Killed` has left the block, nothing changes files any more: now the power cut can be simulated.
            if self._is_killed and self._fault in ("power cut", "worst power cut"):
                self.lose_power()

    def _opened(self, file: Any, mode: str = "r", buffering: int = -1, *more: Any, **named: Any) -> Any:
        """Replace `io.open`, and count a file in the folder that is opened for writing."""
        path = Path(str(file))
        is_in_folder = not isinstance(file, int) and str(path).startswith(self._folder)
        is_for_writing = bool(set(mode) & set("wxa+"))
        if not is_in_folder or not is_for_writing:
            return REAL_OPEN(file, mode, buffering, *more, **named)
        is_new = not path.exists()
        if is_new:
            self._count("create", path)
        self._record_synced_content(path)
        raw = _CountedFile(self, str(path), mode.replace("b", ""))
        if is_new:
            self._undo.append((path.parent, lambda: path.unlink(missing_ok=True)))
        if buffering == 0:
            return raw
        return io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)

    def _os_open(self, path: Any, flags: int, *more: Any, **named: Any) -> int:
        is_new = flags & os.O_CREAT and not Path(path).exists()
        if is_new:
            self._count("create", Path(path))
        fd = REAL.open(path, flags, *more, **named)
        if is_new and str(path).startswith(self._folder):
            self._synced.setdefault(Path(path), b"")
            self._undo.append((Path(path).parent, lambda: Path(path).unlink(missing_ok=True)))
        return fd

    def _pwrite(self, fd: int, data: Any, offset: int) -> int:
        path = _read_descriptor_path(fd)
        self._record_synced_content(path)
        self._count("pwrite", path, lambda: REAL.pwrite(fd, bytes(data)[: len(data) // 2], offset))
        return REAL.pwrite(fd, data, offset)

    def _on_file(self, name: str, fd: int, *more: Any) -> Any:
        self._record_synced_content(_read_descriptor_path(fd))
        self._count(name, _read_descriptor_path(fd))
        return getattr(REAL, name)(fd, *more)

    def _fsync(self, fd: int) -> None:
        self._count("fsync", _read_descriptor_path(fd))
        # The real function is not called: it would only take time.
        self._sync(_read_descriptor_path(fd))

    def _mkdir(self, path: Any, *more: Any, **named: Any) -> None:
        self._count("mkdir", Path(path))
        REAL.mkdir(path, *more, **named)
        if str(path).startswith(self._folder):
            self._undo.append((Path(path).parent, Path(path).rmdir))

    def _rename(self, old: Any, new: Any, **named: Any) -> None:
        """Rename a file. Until its folder is synced a power cut may undo that."""
        old = Path(old)
        new = Path(new)
        self._count("rename", new)
        content_before = new.read_bytes() if new.exists() else None
        REAL.rename(old, new, **named)
        self._synced.pop(new, None)
        if old in self._synced:
            self._synced[new] = self._synced.pop(old)

        def undo_rename() -> None:
            if new.exists():
                REAL.rename(new, old)
            if content_before is not None:
                new.write_bytes(content_before)

        self._undo.append((new.parent, undo_rename))

    def _unlink(self, path: Any, **named: Any) -> None:
        """Remove a file; until its folder is synced a power cut may bring it back."""
        path = Path(path)
        is_tracked = str(path).startswith(self._folder) and path.exists()
        self._count("unlink", path)
        content = self._synced.pop(path, path.read_bytes()) if is_tracked else b""
        REAL.unlink(path, **named)
        if is_tracked:
            self._undo.append((path.parent, lambda: path.write_bytes(content)))


class _CountedFile(io.FileIO):
    """A file whose writes the disk counts."""

    def __init__(self, disk: FaultyDisk, path: str, mode: str) -> None:
        self._disk = disk
        super().__init__(path, mode)

    def write(self, data: Any) -> int:
        path = Path(str(self.name))
        start = self.tell()
        self._disk._record_synced_content(path)
        self._disk._count("write", path, lambda: REAL.pwrite(self.fileno(), bytes(data)[: len(data) // 2], start))
        return super().write(data)

    def truncate(self, size: int | None = None) -> int:
        self._disk._record_synced_content(Path(str(self.name)))
        self._disk._count("truncate", Path(str(self.name)))
        return super().truncate(size)


def _read_descriptor_path(fd: int) -> Path:
    """The path of an open descriptor."""
    return Path(f"/proc/self/fd/{fd}").readlink()
