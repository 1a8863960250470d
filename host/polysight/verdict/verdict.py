"""Structure of a verdict: a level, and reasons in order of weight."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from polysight_shared.errors import PolysightError

Level = Literal["good", "care", "none"]
LEVELS: dict[Level, str] = {"good": "good", "care": "usable with care", "none": "no result"}
"""Level to its text."""
_ORDER: tuple[Level, ...] = ("none", "care", "good")


class NoResult(PolysightError):  # noqa: N818 (a result that ends a command like an error)
    """The data do not support any material or permittivity; images are kept. Sets the exit status of commands."""

    exit_status = 7


@dataclass(frozen=True)
class Reason:
    """One finding that limits the trust in a result: what was found, why it matters, what to do.

    Attributes
    ----------
    level
        Best possible level of a result with this reason.
    what, why, do
        One plain sentence each, without a full stop.
    weight
        Reasons of one level are sorted by falling weight.
    """

    level: Level
    what: str
    why: str
    do: str
    weight: float = 1.0

    def to_dict(self) -> dict[str, str]:
        """Return the dict for JSON."""
        return {"what": self.what, "why": self.why, "do": self.do}


@dataclass(frozen=True)
class Verdict:
    """Level of trust in a result, and its reasons."""

    level: Level
    reasons: tuple[Reason, ...] = ()

    @property
    def text(self) -> str:
        """`good`, `usable with care` or `no result`."""
        return LEVELS[self.level]

    @property
    def usable(self) -> bool:
        """True if names and permittivities may be shown."""
        return self.level != "none"

    def to_dict(self) -> dict[str, Any]:
        """Return `{"level": ..., "reasons": [{"what", "why", "do"}, ...]}` for JSON."""
        return {"level": self.level, "reasons": [r.to_dict() for r in self.reasons]}

    def lines(self, most: int | None = None) -> list[str]:
        """Return text for a terminal: the level, then each reason and remedy; at most `most` reasons."""
        shown = self.reasons[:most]
        out = [f"verdict:  {self.text}"]
        for r in shown:
            out.append(f"  - {r.what}: {r.why}" if r.why else f"  - {r.what}")
            if r.do:
                out.append(f"    do: {r.do}")
        if len(shown) < len(self.reasons):
            out.append(f"  - and {len(self.reasons) - len(shown)} more, see the report")
        return out

    def error(self, kept: str = "") -> NoResult:
        """Return the error that ends a command without a result; `kept` says where the images are."""
        first = self.reasons[0] if self.reasons else Reason("none", "no result", "", "")
        remedy = "; ".join(part for part in (first.do, kept) if part)
        return NoResult(f"no result: {first.what}", first.why, remedy)


def verdict_of(reasons: Iterable[Reason]) -> Verdict:
    """Join reasons to a verdict; its level is the worst of theirs, `good` without reasons."""
    ordered = sorted(reasons, key=lambda r: (_ORDER.index(r.level), -r.weight))
    return Verdict(ordered[0].level if ordered else "good", tuple(ordered))


def read_verdict(content: Mapping[str, Any]) -> Verdict | None:
    """Read the verdict in the content of quality.json or materials.json; None without one of a known level."""
    raw = content.get("verdict")
    if not isinstance(raw, Mapping):
        return None
    levels: list[Level] = [level for level in LEVELS if level == raw.get("level")]
    if not levels:
        return None
    listed = raw.get("reasons")
    reasons = [
        Reason(levels[0], str(r.get("what", "")), str(r.get("why", "")), str(r.get("do", "")))
        for r in (listed if isinstance(listed, list) else [])
        if isinstance(r, Mapping)
    ]
    return Verdict(levels[0], tuple(reasons))
