"""The notebooks run from their first cell to their last, in an empty folder, and carry no outputs."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

import nbformat
import pytest

import polysight

REPO = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((REPO / "examples" / "notebooks").glob("*.ipynb"))


def run(notebook: Path) -> dict[str, Any]:
    """Run the code cells in the current folder; the value of each cell's last line is shown as a notebook would."""
    names: dict[str, Any] = {"__name__": "__main__"}
    for cell in nbformat.read(notebook, as_version=4).cells:
        if cell.cell_type != "code":
            continue
        tree = ast.parse(cell.source, f"{notebook.name}, {cell.id}")
        last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, f"{notebook.name}, {cell.id}", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), f"{notebook.name}, {cell.id}", "eval"), names)
            show = getattr(value, "_repr_png_", None) or getattr(value, "_repr_html_", None) or value.__repr__
            assert show()
    return names


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebooks_are_valid_and_stripped(notebook):
    content = nbformat.read(notebook, as_version=4)
    nbformat.validate(content)
    assert content.cells[0].cell_type == "markdown"
    assert "Simulated: no hardware" in content.cells[0].source
    for cell in content.cells:
        if cell.cell_type == "code":
            assert (cell.outputs, cell.execution_count) == ([], None)
            assert not [line for line in cell.source.splitlines() if "import _" in line or "._" in line]


def test_simulate_and_image(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = run(REPO / "examples" / "notebooks" / "simulate-and-image.ipynb")
    assert abs(complex(names["dielectric"]["permittivity"]) - (6 - 0.3j)) < 0.6
    assert polysight.read_netcdf(tmp_path / "out" / "own-scene.nc").attrs["simulated"] is True
    assert "expected from Fresnel" in capsys.readouterr().out


def test_own_material(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run(REPO / "examples" / "notebooks" / "own-material.ipynb")
    assert list(names["materials"]["name"].values) == ["", "my material"]


def test_every_notebook_is_run():
    assert {p.stem for p in NOTEBOOKS} == {"simulate-and-image", "own-material"}
