"""Run notebooks without Jupyter: the code cells from the first to the last, and the output of the last line of each."""

from __future__ import annotations

import ast
import base64
import contextlib
import html
import io
from pathlib import Path
from typing import Any

import nbformat


def run_notebook(path: Path) -> tuple[dict[str, Any], list[str]]:
    """Run a notebook in the current folder; return its names, and the output of each cell as HTML."""
    names: dict[str, Any] = {"__name__": "__main__"}
    outputs = []
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type != "code":
            outputs.append("")
            continue
        place = f"{path.name}, {cell.id}"
        tree = ast.parse(cell.source, place)
        last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(tree, place, "exec"), names)
            value = None
            if isinstance(last, ast.Expr):
                value = eval(compile(ast.Expression(last.value), place, "eval"), names)
        outputs.append(f"<pre>{html.escape(printed.getvalue())}</pre>" * bool(printed.getvalue()) + show(value))
    return names, outputs


def show(value: Any) -> str:
    """Return a value as a notebook shows it: its picture, its HTML, or its text."""
    if value is None:
        return ""
    if hasattr(value, "_repr_png_"):
        return f'<img alt="" src="data:image/png;base64,{base64.b64encode(value._repr_png_()).decode("ascii")}">'
    if hasattr(value, "_repr_html_"):
        return value._repr_html_()
    return f"<pre>{html.escape(repr(value))}</pre>"
