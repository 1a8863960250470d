"""The verdict: the level of trust in a result, and its reasons in order of weight; `rules` finds them.

In files and messages a verdict is `{"level": ..., "reasons": [{"what", "why", "do"}]}`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal, TypeGuard

import msgspec
import numpy as np

from polysight.results.json_files import to_plain
from polysight_shared.errors import PolysightError
from polysight_shared.findings import Finding, Level as FindingLevel

Level = Literal["good", "care", "none"]
LEVELS: dict[Level, str] = {"good": "good", "care": "usable with care", "none": "no result"}
"""Level to its text."""
_FINDING_LEVELS: dict[Level, FindingLevel] = {"good": "note", "care": "warning", "none": "error"}
_ORDER: tuple[FindingLevel, ...] = ("error", "warning", "note")


class NoResult(PolysightError):  # noqa: N818 (a result that ends a command like an error)
    """The data do not support any material or permittivity; images are kept. Sets the exit status of commands."""

    exit_status = 7


def is_known(value: float | None) -> TypeGuard[float]:
    """True for a finite number. Numbers that are nan or inf count as unknown, and are never shown."""
    return value is not None and bool(np.isfinite(value))


def reason(level: Level, what: str, why: str, do: str, weight: float = 1.0) -> Finding:
    """Return a finding that allows at most this level; reasons of one level are listed by falling weight."""
    return Finding(_FINDING_LEVELS[level], what, why, do, weight=weight)


class Verdict(msgspec.Struct, frozen=True):
    """Level of trust in a result, and its reasons."""

    level: Level
    reasons: tuple[Finding, ...] = ()

    @property
    def text(self) -> str:
        """`good`, `usable with care` or `no result`."""
        return LEVELS[self.level]

    @property
    def usable(self) -> bool:
        """True if names and permittivities may be shown."""
        return self.level != "none"

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as files and messages hold it."""
        return to_plain(self)

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def lines(self, max_reasons: int | None = None) -> list[str]:
        """Return text for a terminal: the level, then each reason and remedy; at most `max_reasons` reasons."""
        shown_reasons = self.reasons[:max_reasons]
        lines = [f"verdict:  {self.text}"]
        for reason in shown_reasons:
            cause = ""
            if reason.why:
                cause = f": {reason.why}"
            lines.append(f"  - {reason.what}{cause}")
            if reason.do:
                lines.append(f"    do: {reason.do}")
        if len(shown_reasons) < len(self.reasons):
            lines.append(f"  - and {len(self.reasons) - len(shown_reasons)} more, see the report")
        return lines

    def error(self, kept_products: str = "") -> NoResult:
        """Return the error that ends a command without a result; `kept_products` says where the images are."""
        if self.reasons:
            first = self.reasons[0]
        else:
            first = reason("none", "no result", "", "")
        remedy = "; ".join(part for part in (first.do, kept_products) if part)
        return NoResult(f"no result: {first.what}", first.why, remedy)


def join_reasons(reasons: Iterable[Finding]) -> Verdict:
    """Join reasons to a verdict; its level is the worst of theirs, `good` without reasons."""
    ordered = tuple(sorted(reasons, key=lambda r: (_ORDER.index(r.level), -r.weight)))
    if not ordered:
        return Verdict("good")
    levels: list[Level] = [level for level in LEVELS if _FINDING_LEVELS[level] == ordered[0].level]
    return Verdict(levels[0], ordered)


def read_verdict(content: Mapping[str, Any]) -> Verdict | None:
    """Read the verdict in the content of quality.json or materials.json; None without one of a known level.

    Files do not hold the level of each reason: all get that of the verdict.
    """
    raw = content.get("verdict")
    if not isinstance(raw, Mapping):
        return None
    levels: list[Level] = [level for level in LEVELS if level == raw.get("level")]
    if not levels:
        return None
    level = levels[0]
    entries = raw.get("reasons")
    if not isinstance(entries, list):
        return Verdict(level)
    reasons = [
        reason(level, str(entry.get("what", "")), str(entry.get("why", "")), str(entry.get("do", "")))
        for entry in entries
        if isinstance(entry, Mapping)
    ]
    return Verdict(level, tuple(reasons))


def percent(part: int, whole: int, digits: int) -> str:
    """Format a share; "100 %" only if nothing is missing."""
    if part >= whole:
        return "100 %"
    return f"{min(100 * part / whole, 100 - 10**-digits):.{digits}f} %"


class Coverage(msgspec.Struct, frozen=True):
    """Recorded rows, positions and frames and those of the plan, and the faults of the manifest.

    `rows_absent`: numbers of the rows without data; their frames and positions count as not received.
    """

    rows_planned: int
    rows_recorded: int
    frames_planned: int
    frames_received: int
    manifest: tuple[str, ...] = ()
    rows_absent: tuple[int, ...] = ()
    positions_planned: int = 0
    positions_absent: int = 0

    @property
    def damage(self) -> str:
        """The faults of the manifest as a sentence; "" without any."""
        if not self.manifest:
            return ""
        return f"The manifest is damaged: {'; '.join(self.manifest)}. `polysight validate` lists the losses."

    def lines(self) -> tuple[str, ...]:
        """Return text for a terminal: rows and frames and those of the plan, and faults of the manifest."""
        rows = f"rows: {self.rows_recorded} of {self.rows_planned} recorded"
        if self.positions_absent:
            rows += f" ({100 * self.positions_absent / self.positions_planned:.1f} % of positions absent)"
        received = f"{rows}; frames: {percent(self.frames_received, self.frames_planned, 1)}"
        counts = f"{received} of {self.frames_planned} planned"
        if self.damage:
            return counts, self.damage
        return (counts,)
