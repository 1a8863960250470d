"""Errors that a person can act on: what happened, the likely cause, and what to do."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path

from polysight.shared.error_codes import ErrorCode


class PolysightError(Exception):
    """Base of every error this project raises on purpose.

    Parameters
    ----------
    what
        What happened, naming the file, address, line or value.
    why
        The likely cause.
    remedy
        What to do next.
    code
        The kind of error, for programs and tests; people read the sentences.
    """

    exit_status = 1

    def __init__(self, what: str, why: str = "", remedy: str = "", *, code: ErrorCode = ErrorCode.OTHER) -> None:
        super().__init__(what)
        self.what, self.why, self.remedy, self.code = what, why, remedy, code

    def __str__(self) -> str:
        parts = [self.what]
        if self.why:
            parts.append(f"why: {self.why}")
        if self.remedy:
            parts.append(f"do: {self.remedy}")
        return "\n  ".join(parts)


def advice(*parts: str) -> str:
    """What to do, as one sentence: the parts that say something."""
    return "; ".join(part for part in parts if part)


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """`did you mean 'step_mm'?`, of what is known; "" when nothing is like the word."""
    near = get_close_matches(word, list(known), n=1, cutoff=0.7)
    return f"did you mean {near[0]!r}?" if near else ""


class ConfigError(PolysightError):
    """A configuration file has a wrong, missing or unknown key."""

    exit_status = 2


class DataError(PolysightError):
    """A file or folder is not what it claims to be, or is damaged."""

    exit_status = 3


def no_such(path: Path) -> DataError:
    """The error for a path at which there is nothing."""
    try:
        near = did_you_mean(path.name, [p.name for p in path.parent.iterdir()])
    except OSError:
        near = f"{path.parent} is not there either"
    return DataError(
        f"{path}: does not exist",
        "the path is wrong",
        near or "give the path of what was recorded or made",
        code=ErrorCode.FILE_MISSING,
    )


class ProtocolError(PolysightError):
    """Bytes that do not follow one of the protocols."""

    exit_status = 4


class VersionError(ProtocolError):
    """The peer speaks another major version."""


class DeviceError(PolysightError):
    """A device, peer or network hop does not do what it should."""

    exit_status = 5


def os_error(
    e: OSError,
    why: str = "the disk is full, a path is wrong, or you may not write there",
    remedy: str = "check the path, its permissions and the free space (df -h)",
) -> DeviceError:
    """What the operating system refused and nobody caught, for a person: commands end with it instead of a trace."""
    where = f"{e.filename}: " if e.filename else ""
    return DeviceError(f"{where}{e.strerror or e}", why, advice(remedy, *getattr(e, "__notes__", ())))


class ScanError(PolysightError):
    """A scan could not be carried out as planned."""

    exit_status = 6
