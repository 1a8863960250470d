"""The state of a scan as plain data for pages: all of it, and the part that changes while the stage moves."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from polysight.acquisition import ScanCommand, time_left
from polysight.page.history import Notice, ScanHistory
from polysight.page.images import Shown
from polysight.page.listener import PiState
from polysight.page.status import LifeSigns, judge, no_scan, sync_notices, unreadable
from polysight.results import Verdict
from polysight_shared.raster import WIDTH_US

PAPER_PHASE_RAD = 0.022
"""Phase residual after all stages, paper section 9.1."""

_NOTICES = 30
_MARKS = {"committed": "c", "kept": "k", "rejected": "r"}


@dataclass(frozen=True)
class Content:
    """Inputs of a snapshot."""

    folder: Path
    history: ScanHistory | None
    signs: LifeSigns
    heard: PiState
    shown: Shown
    asked: ScanCommand | None
    control: bool
    problem: str
    verdict: Verdict | None = None


def make_snapshot(c: Content) -> dict[str, Any]:
    """The whole state of a scan."""
    if c.history is None:
        status = no_scan(c.folder) if not c.problem else unreadable(c.folder, c.problem)
        control = _control(c, running=False)
        return {"scan": None, "status": asdict(status), "control": control, "notices": _notices(c)}
    history = c.history
    marks = "".join(_MARKS.get(history.marks.get(row, ""), ".") for row in range(history.plan.rows))
    return {
        "scan": _scan(c, history),
        "status": asdict(judge(history, c.folder, c.signs, c.heard, c.shown, c.asked)),
        "control": _control(c, running=history.ended is None and c.signs.alive),
        "progress": {"rows": history.plan.rows, "committed": len(history.takes)},
        "marks": marks,
        "boards": _boards(history, c.shown),
        "trigger": _trigger(history),
        "pictures": _pictures(history, c.shown),
        "profile": _profile(c.shown),
        "sync": _sync(c.shown),
        "notices": _notices(c),
        "verdict": _verdict(c),
    }


def make_motion(c: Content) -> dict[str, Any]:
    """The fast-changing part: position of the stage, and time left."""
    if c.history is None:
        return {"now_s": int(c.signs.now_s)}
    h, history = c.heard, c.history
    moving = h.x_mm is not None and h.y_mm is not None
    left_s, basis = remaining(history, c.signs.now_s) if c.signs.alive else (None, "")
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
    """The verdict of the results, once the scan has ended and was processed."""
    if c.verdict is None or c.history is None or c.history.ended is None:
        return None
    return {**c.verdict.to_dict(), "text": c.verdict.text}


def remaining(history: ScanHistory, now_s: float) -> tuple[int | None, str]:
    """Seconds to the scan's end and their origin (`measured`, `first row`, `plan`); None: not known."""
    left, known = history.plan.rows - len(history.takes), history.row_seconds
    if history.ended is not None or known is None:
        return (0, "measured") if left == 0 else (None, "")
    row_s, basis = known
    since = max(history.last_commit_s, history.run_started_s)
    return round(time_left(left, row_s, 0.0 if history.paused else now_s - since)), basis


def _scan(c: Content, history: ScanHistory) -> dict[str, Any]:
    plan = history.plan
    return {
        "id": history.scan_id,
        "folder": str(c.folder),
        "rig": history.instrument.name,
        "simulated": history.simulated,
        "started_utc": history.started.started_utc,
        "columns": plan.columns,
        "rows": plan.rows,
        "step_x_mm": plan.step_x_mm,
        "step_y_mm": plan.step_y_mm,
        "receivers": [board.name for board in history.instrument.receivers],
    }


def _control(c: Content, running: bool) -> dict[str, Any]:
    paused = c.history is not None and c.history.paused
    return {"enabled": c.control, "running": running, "paused": paused, "asked": c.asked}


def _boards(history: ScanHistory, shown: Shown) -> list[dict[str, Any]]:
    found = []
    for name, b in history.boards.items():
        lost = b.frames_expected - b.frames_received
        sync = shown.sync.get(name, {})
        found.append(
            {
                "name": name,
                "role": history.instrument.by_name(name).role,
                "frames_expected": b.frames_expected,
                "frames_lost": lost,
                "missing_bytes": b.missing_bytes,
                "retaken": b.retaken,
                "masked": sum(masked for _, _, masked in sync.values()),
                "counts": b.counts,
            }
        )
    return found


def _trigger(history: ScanHistory) -> dict[str, Any] | None:
    if not history.trigger:
        return None
    health = history.trigger.values()
    return {
        "width_max_us": max(h.width_max_ns for h in health) / 1e3,
        "jitter_max_us": max(h.jitter_max_ns for h in health) / 1e3,
        "width_limit_us": WIDTH_US[1],
        "pulses": len(history.takes) * history.plan.columns * history.instrument.burst.pulses,
    }


def _pictures(history: ScanHistory, shown: Shown) -> dict[str, Any]:
    items = {name: {"low": p.low, "high": p.high, "unit": p.unit} for name, p in shown.pictures.items()}
    return {
        "revision": shown.revision,
        "rows": len(shown.rows),
        "waiting": max(0, len(history.takes) - len(shown.rows)),
        "width_mm": history.instrument.image.columns * history.instrument.image.pixel_mm,
        "height_mm": history.instrument.image.rows * history.instrument.image.pixel_mm,
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
    """All notices, the newest first."""
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
    if c.history is not None:
        if c.heard.deaf is not None and c.history.ended is None:
            found.append(c.heard.deaf)
        if c.shown.problem is not None:
            found.append(c.shown.problem)
        found += sync_notices(c.shown, c.history.plan.columns)
        found += c.heard.faults
        found += reversed(c.history.notices[-_NOTICES:])
    return [asdict(n) for n in dict.fromkeys(found)]
