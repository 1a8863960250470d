"""Exceptions with three sentences for people (what happened, the likely cause, what to do) and a code for programs."""

from __future__ import annotations

import errno
import re
import shlex
from collections.abc import Iterable
from difflib import get_close_matches
from importlib.util import find_spec
from pathlib import Path

from polysight_shared.error_codes import ErrorCode as ErrorCode


class PolysightError(Exception):
    """Base class of all errors that this project raises.

    Parameters
    ----------
    what
        What happened, with the file, address, line or value.
    why
        The likely cause.
    remedy
        What to do next.
    code
        Kind of error, for programs and tests.
    """

    exit_status = 1

    def __init__(self, what: str, why: str = "", remedy: str = "", *, code: ErrorCode = ErrorCode.OTHER) -> None:
        super().__init__(what)
        self.what = what
        self.why = why
        self.remedy = remedy
        self.code = code

    def __str__(self) -> str:
        parts = [self.what]
        if self.why:
            parts.append(f"why: {self.why}")
        if self.remedy:
            parts.append(f"do: {self.remedy}")
        return expand_paths("\n  ".join(parts))


def expand_paths(text: str) -> str:
    """Return a text with pages of the documentation, such as docs/how-to/install.md, as paths of this installation.

    The pages come with the package `polysight`: as its folder `data` where it was installed, in the repository two
    folders above it. Where it is not installed, as on a Raspberry Pi, the text is not changed.
    """
    if "docs/" not in text:
        return text
    package = find_spec("polysight")
    if package is None or package.origin is None:
        return text
    package_folder = Path(package.origin).parent
    candidates = (package_folder / "data", package_folder.parents[1])
    folder = next((candidate for candidate in candidates if (candidate / "docs").is_dir()), None)
    if folder is None:
        return text
    return re.sub(r"(?<![\w/])docs/[\w/-]+\.md", lambda page: str(folder / page[0]), text)


def quote(path: Path | str) -> str:
    """Return a path as a word of a shell's line: with quotes if it needs them, and never like an option."""
    text = str(path)
    if text.startswith("-"):
        text = f"./{text}"
    return shlex.quote(text)


def join_advice(*parts: str) -> str:
    """Join the parts of a remedy that are not empty."""
    return "; ".join(part for part in parts if part)


def suggest_word(word: str, known_words: Iterable[str]) -> str:
    """Return `did you mean 'step_mm'?` with the most similar known word; "" if none is similar."""
    similar = get_close_matches(word, list(known_words), n=1, cutoff=0.7)
    if not similar:
        return ""
    return f"did you mean {similar[0]!r}?"


class ConfigError(PolysightError):
    """A configuration file has a wrong, missing or unknown key."""

    exit_status = 2


class DataError(PolysightError):
    """A file or folder is missing, damaged, or of another kind than expected."""

    exit_status = 3


def make_missing_path_error(path: Path) -> DataError:
    """Return the error for a path at which there is nothing, or a file where a folder is needed."""
    if path.is_file():
        problem = f"{path}: is a file"
        return DataError(problem, "a folder is needed here", "give a folder", code=ErrorCode.FILE_FOREIGN)
    try:
        names_beside = [p.name for p in path.parent.iterdir()]
        cause = "the path is wrong"
    except OSError:
        names_beside = []
        cause = f"the path is wrong: {path.parent} does not exist either"
    remedy = suggest_word(path.name, names_beside) or "give the path of an existing file or folder"
    return DataError(f"{path}: does not exist", cause, remedy, code=ErrorCode.FILE_MISSING)


class ProtocolError(PolysightError):
    """A message that breaks its protocol."""

    exit_status = 4


class VersionError(ProtocolError):
    """The peer uses another major version of the protocol."""


class DeviceError(PolysightError):
    """A device, peer or network hop failed."""

    exit_status = 5


def convert_os_error(
    e: OSError,
    cause: str = "the disk is full, a path is wrong, or you may not write there",
    remedy: str = "check the path, its permissions and the free space (df -h)",
) -> DeviceError:
    """Turn an OSError into a DeviceError with cause and remedy, so that a command ends without a traceback."""
    summary = e.strerror or str(e)
    if e.filename:
        summary = f"{e.filename}: {summary}"
    if e.errno == errno.ENOENT:
        # A folder that was renamed does not mean a full disk.
        cause = "it was moved, renamed or deleted"
    if e.errno in (errno.ENOTDIR, errno.EEXIST):
        cause = "a file has the name of a folder that is needed here"
        remedy = "give another path"
    if e.errno == errno.EISDIR:
        cause = "a file is needed here"
        remedy = "give the path of a file"
    code = ErrorCode.OTHER
    if e.errno in (errno.ENOSPC, errno.EDQUOT):
        code = ErrorCode.DISK_FULL
    # Whoever raised the error may have added advice as notes (`add_note`).
    notes = getattr(e, "__notes__", ())
    return DeviceError(summary, cause, join_advice(remedy, *notes), code=code)


class ScanError(PolysightError):
    """A scan failed, or was refused."""

    exit_status = 6
