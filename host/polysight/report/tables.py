"""Numbers of a report from the content of quality.json and materials.json: headline figures and tables.

Tables are plain dicts (caption, head, rows) for the page's template.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.report.context import ReportContext
from polysight.results import percent
from polysight_shared.raster import RasterPlan

_IMAGING_ROWS: tuple[tuple[str, str], ...] = (
    ("masked_positions", "Positions masked"),
    ("rows_without_data", "Rows without any data"),
    ("loss_db", "Loss of a point's sum by masked positions (dB)"),
    ("frequencies", "Frequency samples after the range gate"),
    ("point_width_mm", "Point response at half power, x × y (mm)"),
    ("point_limit_mm", "Geometry's limit without taper, x × y (mm)"),
    ("point_paper_mm", "The paper's r λ / L, x × y (mm)"),
    ("point_sidelobe_db", "Strongest sidelobe, x, y (dB)"),
)
Table = dict[str, Any]
_NOT_LISTED = ("synchronisation", "raw_crc32", "masked_columns", "rows_recorded")
UNITS = {"hz": "Hz", "rad": "rad", "deg": "°", "s": "s", "db": "dB", "mm": "mm", "m": "m", "bytes": "bytes"}


def masked_positions(ctx: ReportContext) -> dict[str, npt.NDArray[np.bool_]]:
    """Return for each board bool [row, column]: masked or never recorded. Empty if plan or boards are not known."""
    boards = ctx.quality.get("boards")
    if ctx.plan is None or not isinstance(boards, dict):
        return {}
    return {name: _mask(board, ctx.plan) for name, board in boards.items() if "masked_columns" in board}


def _mask(board: dict[str, Any], plan: RasterPlan) -> npt.NDArray[np.bool_]:
    mask = np.zeros((plan.rows, plan.columns), np.bool_)
    for row, runs in board["masked_columns"].items():
        for start, stop in runs:
            mask[int(row), start:stop] = True
    recorded = {int(row) for row in board.get("rows_recorded", range(plan.rows))}
    mask[[row not in recorded for row in range(plan.rows)]] = True
    return mask


def coverage_sentence(masks: dict[str, npt.NDArray[np.bool_]]) -> str:
    """Say how many positions of each board are masked; "" if that is not known."""
    if not masks:
        return ""
    if not any(m.any() for m in masks.values()):
        return "Every position of every board has data."
    counts = [f"{name} {int(m.sum())} of {m.size} ({m.mean():.2%})" for name, m in masks.items()]
    return f"Positions without data, left out of the images: {', '.join(counts)}."


def imaging_table(imaging: Any) -> Table | None:
    """Return the table of `imaging` of quality.json, a column for each board; None without it."""
    boards = {k: v for k, v in imaging.items() if isinstance(v, dict)} if isinstance(imaging, dict) else {}
    if not boards:
        return None
    rows = [
        _cells(heading, *(_number(board.get(key), " × " if key.endswith("_mm") else ", ") for board in boards.values()))
        for key, heading in _IMAGING_ROWS
        if any(key in board for board in boards.values())
    ]
    caption = "Imaging. The point response is computed for the middle of the image, with taper and mask as they are."
    for notice in imaging.get("notices", ()):
        caption += f" {notice}."
    return {"caption": caption, "head": ["Board", *map(str, boards)], "rows": rows}


def _number(value: Any, between: str = " × ") -> str:
    if value is None:
        return "–"
    if isinstance(value, list | tuple):
        return between.join(_number(v) for v in value)
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def text(value: Any) -> str:
    """Format a value for reading: grouped thousands, few digits, yes and no, lists with commas."""
    if value is None:
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return f"{int(value):,}".replace(",", "\u202f") if abs(int(value)) >= 10000 else str(int(value))
    if isinstance(value, float | np.floating):
        v = float(value)
        if v == int(v) and abs(v) < 1e15:
            return text(int(v))
        return f"{v:.3g}" if abs(v) < 1000 else f"{v:,.0f}".replace(",", "\u202f")
    if isinstance(value, dict):
        return ", ".join(f"{k}: {text(v)}" for k, v in value.items()) or "–"
    if isinstance(value, list | tuple):
        return ", ".join(text(v) for v in value) or "none"
    return str(value)


def pretty(key: str) -> str:
    """Format a key as a heading: `RH if_hz` becomes `RH IF (Hz)`."""
    words = key.replace("_", " ").split()
    unit = UNITS.get(words[-1]) if len(words) > 1 else None
    if unit:
        words = words[:-1]
    out = " ".join({"if": "IF", "std": ""}.get(w, w) for w in words).replace("  ", " ").strip()
    return f"{out} ({unit})" if unit else out


def key_numbers(ctx: ReportContext, rows: list[dict[str, Any]]) -> list[dict[str, str]]:
    """Return the headline figures: value and text."""
    out: list[dict[str, str]] = []

    def add(value: str, what: str) -> None:
        out.append({"value": value, "text": what})

    if ctx.truth and any(m.get("name") for m in ctx.materials):
        right = sum(r["right"] and r["true_real"] != "metal" for r in rows)  # metal is the reference, not a result
        strange = sum(r["strange"] for r in rows)
        plates = sum(t["permittivity"] is not None for t in ctx.truth) - strange
        aside = f", {strange} recognised as not in the library" if strange else ""
        add(f"{right} of {plates}", f"plates named right{aside}")
    elif rows:
        add(str(len(rows)), "patches found")
    if ctx.pixel_accuracy is not None:
        expected = ctx.expected_accuracy
        aside = "" if expected is None else f"; their own confidence expects {100 * expected:.1f} %"
        add(f"{100 * ctx.pixel_accuracy:.1f} %", f"of interior pixels named right{aside}")
    errors = [abs(r["relative_error"]) for r in rows if r["relative_error"] is not None]
    if errors:
        add(f"{100 * float(np.median(errors)):.1f} %", f"median error of ε′, worst {100 * max(errors):.1f} %")
    for value, what in _received(ctx.quality):
        add(value, what)
    if seconds := ctx.quality.get("seconds_per_stage"):
        total = sum(map(float, seconds.values()))
        add(f"{total:.1f} s" if total < 100 else f"{total / 60:.1f} min", "of processing, all stages")
    return out


def _received(quality: dict[str, Any]) -> list[tuple[str, str]]:
    """Return shares of rows and frames received: of the plan, or of recorded rows in products without `coverage`."""
    coverage, boards = quality.get("coverage"), quality.get("boards")
    if coverage:
        rows, planned = coverage["rows_planned"], coverage["frames_planned"]
        share = percent(coverage["frames_received"], planned, 2)
        out = [(share, f"of {text(planned)} planned frames received")]
        recorded = (f"{coverage['rows_recorded']} of {rows}", "rows recorded")
        return [recorded, *out] if coverage["rows_absent"] else out
    if not isinstance(boards, dict) or not boards:
        return []
    expected = sum(int(b.get("frames_expected", 0)) for b in boards.values())
    received = sum(int(b.get("frames_received", 0)) for b in boards.values())
    return (
        [(percent(received, expected, 2), f"of {text(expected)} frames of recorded rows received")] if expected else []
    )


def quality_tables(quality: dict[str, Any]) -> list[Table]:
    """Return tables of the known parts of quality.json, then one of all other keys."""
    known = {"boards", "seconds_per_stage", "imaging", "verdict", "error_budget"}
    boards = quality.get("boards")
    parts = (
        _boards(boards),
        _residuals(boards),
        imaging_table(quality.get("imaging")),
        _seconds(quality.get("seconds_per_stage")),
    )
    out = [part for part in parts if part]
    if rest := {k: v for k, v in quality.items() if k not in known}:
        flat = _flatten(rest, nested=False)
        rows = [_cells(pretty(k), text(v)) for k, v in flat.items()]
        out.append({"caption": "Rows, masked data and other figures.", "head": [], "rows": rows})
    return out


_SOURCES = {
    "measured": "measured (rig file)",
    "prior and scene": "not measured; estimated from its prior and the scene",
    "scene": "estimated from the scene",
}


def budget_table(budget: Mapping[str, Any]) -> Table | None:
    """Return the table of the error budget: leakage, plane, angle, evidence for metal; None without any of them."""
    rows = [*_leakage_rows(budget.get("leakage")), *_plane_rows(budget.get("plane"), budget.get("incidence"))]
    metal = budget.get("metal") or {}
    if metal.get("score") is not None:
        evidence = f"score {_signed(metal['score'], 1)} from {metal.get('others', 0)} other patches"
        if metal.get("channel_ratio_db") is not None:
            evidence += f"; V over H {_signed(metal['channel_ratio_db'], 1)} dB relative to the direct path"
        rows.append(_cells("Evidence that the reference is metal", evidence))
    if not rows:
        return None
    caption = "What the errors of the permittivities were computed with. ± is a standard deviation."
    return {"caption": caption, "head": [], "rows": rows}


def _leakage_rows(leakage: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    if not leakage:
        return []
    source = str(leakage.get("source", ""))
    rows = [_cells("Leakage", _SOURCES.get(source, source))]
    for i, channel in enumerate("hv"):
        value = leakage.get(channel)
        if value is not None and None not in value:
            std = (leakage.get("std") or (None, None))[i]
            error = "" if std is None else f" ± {std:.3f}"
            sign = "+" if value[1] >= 0 else "−"
            number = f"{_signed(value[0], 3)} {sign} {abs(value[1]):.3f}i{error}"
            rows.append(_cells(f"Leakage of {channel.upper()}, relative to its own channel", number))
    return rows


def _plane_rows(plane: Mapping[str, Any] | None, incidence: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    rows = []
    if incidence and incidence.get("deg") is not None:
        std = incidence.get("std_deg")
        rows.append(_cells("Incidence angle", f"{incidence['deg']:.2f}°" + ("" if std is None else f" ± {std:.2f}°")))
    if plane and not plane.get("known"):
        rows.append(_cells("Plane of the plates", "not found; that of the rig file is used"))
    elif plane:
        std = plane.get("offset_std_mm")
        offset = f"{_signed(plane.get('offset_mm') or 0.0, 1)} mm" + ("" if std is None else f" ± {std:.1f} mm")
        rows.append(_cells("Plane of the plates, relative to the rig file", offset))
        tilt = plane.get("tilt_deg")
        if tilt and None not in tilt:
            rows.append(_cells("Tilt of the plane", f"{_signed(tilt[0], 2)}° in x, {_signed(tilt[1], 2)}° in y"))
        by, plates = plane.get("by"), plane.get("plates")
        if by:
            rows.append(_cells("Plane found by", f"{by}" + (f" of {plates} plates" if plates else "")))
    return rows


def _signed(value: float, digits: int) -> str:
    """Format a number with its sign, a true minus, and no negative zero."""
    return f"{round(float(value), digits) + 0.0:+.{digits}f}".replace("-", "−")


def _cells(*cells: str, share: float | None = None) -> dict[str, Any]:
    return {"cells": list(cells), "share": share}


def _boards(boards: Any) -> Table | None:
    """Return a table with a line for each figure and a column for each board: narrow enough for a phone."""
    if not isinstance(boards, dict) or not boards:
        return None
    flat = {name: _numbers_of(board) for name, board in boards.items()}
    keys = dict.fromkeys(k for board in flat.values() for k in board)
    rows = [_cells(pretty(k), *(text(board.get(k)) for board in flat.values())) for k in keys]
    caption = "Frames by board, of the recorded rows. Missing data are masked, never interpolated."
    return {"caption": caption, "head": ["Board", *map(str, boards)], "rows": rows}


def _numbers_of(board: dict[str, Any]) -> dict[str, Any]:
    """Flatten a board's figures: `direct_path_hz` {median} becomes `direct_path_median_hz`."""
    out: dict[str, Any] = {}
    for key, value in board.items():
        if key in _NOT_LISTED:
            continue
        stem, _, unit = key.rpartition("_")
        for part, number in value.items() if isinstance(value, dict) else ():
            out[f"{stem}_{part}_{unit}" if unit in UNITS else f"{key}_{part}"] = number
        if not isinstance(value, dict):
            out[key] = value
    return out


def _residuals(boards: Any) -> Table | None:
    """Return a table of `synchronisation` of all boards: a line for each stage, a column for each quantity."""
    flat: dict[str, dict[str, Any]] = {}
    for name, board in boards.items() if isinstance(boards, dict) else ():
        for stage, quantities in (board.get("synchronisation") or {}).items():
            flat.setdefault(stage, {}).update(_flatten({name: quantities}))
    if not flat:
        return None
    keys = list(dict.fromkeys(k for v in flat.values() for k in v))
    rows = [_cells(pretty(stage), *(text(v.get(k)) for k in keys)) for stage, v in flat.items()]
    head = ["After stage", *map(pretty, keys)]
    caption = (
        "Residual (standard deviation) after each stage of synchronisation: of one chirp as received and aligned, of"
        " the direct path in a position's average, and of the object referenced to it; amplitude relative to its mean."
    )
    return {"caption": caption, "head": head, "rows": rows}


def _flatten(value: dict[str, Any], prefix: str = "", nested: bool = True) -> dict[str, Any]:
    """Return path to value for nested dicts; only one level deep if `nested` is false."""
    out: dict[str, Any] = {}
    for k, v in value.items():
        name = f"{prefix} {k}".strip()
        deeper = isinstance(v, dict) and v and (nested or not prefix)
        out.update(_flatten(v, name, nested) if deeper else {name: v})
    return out


def _seconds(seconds: Mapping[str, float] | None) -> Table | None:
    if not seconds:
        return None
    longest = max([*seconds.values(), 1e-9])
    rows = [_cells(pretty(k), f"{v:.2f} s", share=round(100 * v / longest, 1)) for k, v in seconds.items()]
    return {"caption": "Time by stage.", "head": [], "rows": rows}
