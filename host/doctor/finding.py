"""What one check found: how it is, what was seen, the likely cause, and what to do."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from polysight.shared.errors import PolysightError

Verdict = Literal["ok", "warning", "error", "not checked"]


@dataclass(frozen=True)
class Finding:
    """One line of the doctor. `check` is filled in by the walk; `facts` are the numbers behind it, for programs."""

    verdict: Verdict
    found: str
    why: str = ""
    remedy: str = ""
    facts: dict[str, Any] = field(default_factory=dict)
    check: str = ""


def ok(found: str, **facts: Any) -> Finding:
    """As it should be."""
    return Finding("ok", found, facts=facts)


def warning(found: str, why: str, remedy: str, **facts: Any) -> Finding:
    """Good enough to scan."""
    return Finding("warning", found, why, remedy, facts)


def error(found: str, why: str, remedy: str, **facts: Any) -> Finding:
    """A scan would fail, or be worth nothing."""
    return Finding("error", found, why, remedy, facts)


def not_checked(found: str, remedy: str = "") -> Finding:
    """Left out, by choice or because what it needs is not there."""
    return Finding("not checked", found, remedy=remedy)


def of_error(e: PolysightError) -> Finding:
    """What an error says."""
    return error(e.what, e.why, e.remedy)
