"""What a page is told, as plain data: the whole state, and the little that changes while the stage moves."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from polysight.host.acquisition import ScanCommand, time_left
from polysight.host.page.images import Shown
from polysight.host.page.listener import Heard
from polysight.host.page.story import Notice, Story
from polysight.host.page.verdict import Signs, judge, no_scan, sync_notices, unreadable
from polysight.host.verdict import Verdict
from polysight.shared.raster import WIDTH_US

PAPER_PHASE_RAD = 0.022
"""Phase residual after all stages, paper section 9.1."""

_NOTICES = 30
_MARKS = {"committed": "c", "kept": "k", "rejected": "r"}


@dataclass(frozen=True)
class Content:
    """Everything a snapshot is made of."""

    folder: Path
    story: Story | None
    signs: Signs
    heard: Heard
    shown: Shown
    asked: ScanCommand | None
    control: bool
    problem: str
    verdict: Verdict | None = None


def make_snapshot(c: Content) -> dict[str, Any]:
    """The whole state of a scan."""
    if c.story is None:
        status = no_scan(c.folder) if not c.problem else unreadable(c.folder, c.problem)
        wishes = _control(c, running=False)
        return {"scan": None, "status": asdict(status), "control": wishes, "notices": _notices(c)}
    story = c.story
    marks = "".join(_MARKS.get(story.marks.get(row, ""), ".") for row in range(story.plan.rows))
    return {
        "scan": _scan(c, story),
        "status": asdict(judge(story, c.folder, c.signs, c.heard, c.shown, c.asked)),
        "control": _control(c, running=story.ended is None and c.signs.alive),
        "progress": {"rows": story.plan.rows, "committed": len(story.takes)},
        "marks": marks,
        "boards": _boards(story, c.shown),
        "trigger": _trigger(story),
        "pictures": _pictures(story, c.shown),
        "profile": _profile(c.shown),
        "sync": _sync(c.shown),
        "notices": _notices(c),
        "verdict": _verdict(c),
    }


def make_motion(c: Content) -> dict[str, Any]:
    """What changes from moment to moment: the stage, and the time left."""
    if c.story is None:
        return {"now_s": int(c.signs.now_s)}
    h, story = c.heard, c.story
    moving = h.x_mm is not None and h.y_mm is not None
    left_s, basis = remaining(story, c.signs.now_s) if c.signs.alive else (None, "")
    return {
        "now_s": int(c.signs.now_s),
        "left_s": left_s,
        "left_from": basis,
        "stage": {"x_mm": round(h.x_mm or 0, 1), "y_mm": round(h.y_mm or 0, 1)} if moving else None,
        "row": h.row,
        "take": h.take,
        "point": h.point,
        "state": h.state,
    }


def _verdict(c: Content) -> dict[str, Any] | None:
    """How far the results may be trusted, when the scan has ended and was processed."""
    if c.verdict is None or c.story is None or c.story.ended is None:
        return None
    return {**c.verdict.to_dict(), "text": c.verdict.text}


def remaining(story: Story, now_s: float) -> tuple[int | None, str]:
    """Seconds to the scan's end and what they are known from (`measured`, `first row`, `plan`); None: not known."""
    left, known = story.plan.rows - len(story.takes), story.row_seconds
    if story.ended is not None or known is None:
        return (0, "measured") if left == 0 else (None, "")
    row_s, basis = known
    since = max(story.last_commit_s, story.run_started_s)
    return round(time_left(left, row_s, 0.0 if story.paused else now_s - since)), basis


def _scan(c: Content, story: Story) -> dict[str, Any]:
    plan = story.plan
    return {
        "id": story.scan_id,
        "folder": str(c.folder),
        "rig": story.instrument.name,
        "simulated": story.simulated,
        "started_utc": story.started.get("started_utc", ""),
        "columns": plan.columns,
        "rows": plan.rows,
        "step_x_mm": plan.step_x_mm,
        "step_y_mm": plan.step_y_mm,
        "receivers": [board.name for board in story.instrument.receivers],
    }


def _control(c: Content, running: bool) -> dict[str, Any]:
    paused = c.story is not None and c.story.paused
    return {"enabled": c.control, "running": running, "paused": paused, "asked": c.asked}


def _boards(story: Story, shown: Shown) -> list[dict[str, Any]]:
    found = []
    for name, b in story.boards.items():
        lost = b.frames_expected - b.frames_received
        sync = shown.sync.get(name, {})
        found.append(
            {
                "name": name,
                "role": story.instrument.by_name(name).role,
                "frames_expected": b.frames_expected,
                "frames_lost": lost,
                "missing_bytes": b.missing_bytes,
                "retaken": b.retaken,
                "masked": sum(masked for _, _, masked in sync.values()),
                "counts": b.counts,
            }
        )
    return found


def _trigger(story: Story) -> dict[str, Any] | None:
    if not story.trigger:
        return None
    health = story.trigger.values()
    return {
        "width_max_us": max(h.width_max_ns for h in health) / 1e3,
        "jitter_max_us": max(h.jitter_max_ns for h in health) / 1e3,
        "width_limit_us": WIDTH_US[1],
        "pulses": len(story.takes) * story.plan.columns * story.instrument.burst.pulses,
    }


def _pictures(story: Story, shown: Shown) -> dict[str, Any]:
    items = {name: {"low": p.low, "high": p.high, "unit": p.unit} for name, p in shown.pictures.items()}
    return {
        "revision": shown.revision,
        "rows": len(shown.rows),
        "waiting": max(0, len(story.takes) - len(shown.rows)),
        "width_mm": story.instrument.image.columns * story.instrument.image.pixel_mm,
        "height_mm": story.instrument.image.rows * story.instrument.image.pixel_mm,
        "items": items,
    }


def _profile(shown: Shown) -> dict[str, Any] | None:
    if not shown.profile:
        return None
    return {
        "row": shown.profile["row"],
        "excess_m": [round(float(d), 4) for d in shown.profile["excess_m"]],
        "boards": {n: [round(float(v), 1) for v in level] for n, level in shown.profile["boards"].items()},
        "scene_m": [round(d, 3) for d in shown.profile["scene_m"]],
    }


def _sync(shown: Shown) -> dict[str, Any]:
    def degrees(rad: float) -> float | None:
        return None if math.isnan(rad) else round(math.degrees(rad), 3)

    boards = {
        name: {"rows": list(rows), "object_deg": [degrees(o) for o, _, _ in rows.values()],
               "direct_deg": [degrees(d) for _, d, _ in rows.values()]}
        for name, rows in shown.sync.items()
    }  # fmt: skip
    return {"paper_deg": round(math.degrees(PAPER_PHASE_RAD), 2), "boards": boards}


def _notices(c: Content) -> list[dict[str, Any]]:
    """The newest first."""
    found: list[Notice] = []
    if c.problem:
        found.append(
            Notice(
                "warn",
                c.problem,
                "It was written by another release, or is damaged",
                f"`polysight validate {c.folder}`",
            )
        )
    if c.story is not None:
        if c.heard.deaf is not None and c.story.ended is None:
            found.append(c.heard.deaf)
        if c.shown.problem is not None:
            found.append(c.shown.problem)
        found += sync_notices(c.shown, c.story.plan.columns)
        found += c.heard.faults
        found += reversed(c.story.notices[-_NOTICES:])
    return [asdict(n) for n in dict.fromkeys(found)]
