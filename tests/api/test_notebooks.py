"""The notebooks run from their first cell to their last, in an empty folder, and carry no outputs."""

from pathlib import Path
from typing import Any

import nbformat
import pytest
from docs.notebooks import run_notebook

import polysight

REPO = Path(__file__).resolve().parents[2]
NOTEBOOKS = sorted((REPO / "examples" / "notebooks").glob("*.ipynb"))


def run(notebook: Path) -> dict[str, Any]:
    """Run a notebook in the current folder; return the values of its names."""
    names, _ = run_notebook(notebook)
    return names


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebooks_are_valid_and_stripped(notebook):
    content: Any = nbformat.read(notebook, as_version=4)
    nbformat.validate(content)
    assert content.cells[0].cell_type == "markdown"
    assert "Simulated: no hardware" in content.cells[0].source
    for cell in content.cells:
        if cell.cell_type == "code":
            assert (cell.outputs, cell.execution_count) == ([], None)
            assert not [line for line in cell.source.splitlines() if "import _" in line or "._" in line]


def test_simulate_and_image_finds_the_plate_s_permittivity(tmp_path, monkeypatch):
    """The plate of examples/own-scene.toml has 6 - 0.3j; the limit of a tenth is chosen."""
    monkeypatch.chdir(tmp_path)
    names, outputs = run_notebook(REPO / "examples" / "notebooks" / "simulate-and-image.ipynb")
    assert abs(complex(names["dielectric"]["permittivity"]) - (6 - 0.3j)) < 0.6
    assert polysight.read_netcdf(tmp_path / "out" / "own-scene.nc").attrs["simulated"] is True
    assert "expected from Fresnel" in "".join(outputs)


def test_own_material_names_the_added_material(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run(REPO / "examples" / "notebooks" / "own-material.ipynb")
    assert list(names["materials"]["name"].values) == ["", "my material"]


def test_liquids_finds_water_and_the_share_of_a_mixture(tmp_path, monkeypatch):
    """Water has 9.37 - 18j, and the mixture a share of 0.1; both limits are chosen."""
    monkeypatch.chdir(tmp_path)
    names = run(REPO / "examples" / "notebooks" / "liquids.ipynb")
    true_water = 9.37 - 18j
    water = complex(names["at"](names["CENTRES_MM"][0])["permittivity"])
    assert abs(water - true_water) < 0.06 * abs(true_water)
    assert abs(names["share"] - 0.1) < 0.03


def test_own_images_finds_the_patch_s_permittivity(tmp_path, monkeypatch):
    """Its given images have a patch of 3.8 - 0.7j; the limit is chosen."""
    monkeypatch.chdir(tmp_path)
    names = run(REPO / "examples" / "notebooks" / "own-images.ipynb")
    value = complex(names["scan"].permittivity()["permittivity"].isel(patch=1))
    assert abs(value - (3.8 - 0.7j)) < 0.3


def test_every_notebook_is_run():
    assert {p.stem for p in NOTEBOOKS} == {"simulate-and-image", "own-material", "liquids", "own-images"}
