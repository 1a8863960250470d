"""One type for everything that is reported to people: results of checks, reasons of a verdict, warnings of a plan."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from polysight_shared.errors import ErrorCode, PolysightError

Level = Literal["ok", "note", "warning", "error"]
"""`ok`: checked and right. `note`: worth knowing. `warning`: usable with care. `error`: does not work, or no result."""
LEVELS: tuple[Level, ...] = ("ok", "note", "warning", "error")
"""From harmless to grave."""


class Finding(msgspec.Struct, frozen=True):
    """What was found, why it is so and what to do: one plain sentence each, without a full stop.

    Attributes
    ----------
    level
        How grave it is.
    what, why, do
        What was found, with the value and its unit; the likely cause; the remedy. `why` and `do` may be empty.
    where
        What it is about: a check, board, file, row, patch, or a hop (a device or link on the way to the data); "" for
        the whole.
    code
        Kind of fault, for programs.
    weight
        Importance among findings of one level, which are listed by falling weight.
    facts
        Numbers behind it, for programs.
    """

    level: Level
    what: str
    why: str = ""
    do: str = ""
    where: str = ""
    code: ErrorCode = ErrorCode.OTHER
    weight: float = 1.0
    # msgspec gives every finding an empty dict of its own.
    facts: dict[str, Any] = {}

    @classmethod
    def of_error(cls, error: PolysightError, where: str = "") -> Finding:
        """Return an error as a finding."""
        return cls("error", error.what, error.why, error.remedy, where, error.code)

    def __str__(self) -> str:
        prefix = f"{self.where}: " if self.where else ""
        lines = [f"{self.level}: {prefix}{self.what}"]
        if self.why:
            lines.append(f"why: {self.why}")
        if self.do:
            lines.append(f"do: {self.do}")
        return "\n  ".join(lines)
