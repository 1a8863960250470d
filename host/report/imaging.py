"""The imaging table of a report: masked positions, and the point response beside theory."""

from __future__ import annotations

from typing import Any

_ROWS: tuple[tuple[str, str], ...] = (
    ("masked_positions", "Positions masked"),
    ("rows_without_data", "Rows without any data"),
    ("loss_db", "Loss of a point's sum by masked positions (dB)"),
    ("frequencies", "Frequency samples after the range gate"),
    ("point_width_mm", "Point response at half power, x × y (mm)"),
    ("point_limit_mm", "Geometry's limit without taper, x × y (mm)"),
    ("point_paper_mm", "The paper's r λ / L, x × y (mm)"),
    ("point_sidelobe_db", "Strongest sidelobe, x, y (dB)"),
)


def imaging_table(imaging: Any) -> dict[str, Any] | None:
    """Table of quality.json's `imaging`, a column for each board; None without it."""
    boards = {k: v for k, v in imaging.items() if isinstance(v, dict)} if isinstance(imaging, dict) else {}
    if not boards:
        return None
    rows = [
        {"cells": [text, *(_number(board.get(key), _between(key)) for board in boards.values())], "share": None}
        for key, text in _ROWS
        if any(key in board for board in boards.values())
    ]
    caption = "Imaging. The point response is computed for the middle of the image, with taper and mask as they are."
    for notice in imaging.get("notices", ()):
        caption += f" {notice}."
    return {"caption": caption, "head": ["Board", *map(str, boards)], "rows": rows}


def _between(key: str) -> str:
    return " × " if key.endswith("_mm") else ", "


def _number(value: Any, between: str = " × ") -> str:
    if value is None:
        return "–"
    if isinstance(value, list | tuple):
        return between.join(_number(v) for v in value)
    return f"{value:.3g}" if isinstance(value, float) else str(value)
