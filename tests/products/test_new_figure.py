"""A figure of a patch is declared once: tables, exports, datasets and the report show it without further code."""

import csv
from typing import Annotated

import msgspec
import pytest
import scipy.io
from tests.support.products import make_result, replace_results, write_judged_products

from polysight.products import patch_dataset, read_products
from polysight.products.exports import pack_csv, pack_mat
from polysight.report.report import render
from polysight.results import PatchFigures, ScanMaterials, to_plain
from polysight.results.materials import Column


class RoughPatch(PatchFigures, frozen=True, kw_only=True):
    """A patch with one figure more."""

    roughness_mm: Annotated[
        float | None, Column("roughness_mm", "roughness of the surface", "mm", title="roughness", digits=2)
    ] = None


@pytest.fixture
def scan(tmp_path):
    saved = read_products(write_judged_products(tmp_path, "good"))
    scan = make_result(saved.images, {"segments": []}, {})
    patches = [
        RoughPatch(**{name: getattr(patch, name) for name in patch.__struct_fields__}, roughness_mm=0.25)
        for patch in saved.segments
    ]
    return replace_results(scan, materials=ScanMaterials(segments=patches))


def test_a_declared_figure_is_a_column_of_the_tables(scan, tmp_path):
    (tmp_path / "materials.csv").write_bytes(pack_csv(scan))
    with (tmp_path / "materials.csv").open(newline="", encoding="utf-8") as f:
        assert [row["roughness_mm"] for row in csv.DictReader(f)] == ["0.25"] * 3
    (tmp_path / "image.mat").write_bytes(pack_mat(scan))
    table = scipy.io.loadmat(tmp_path / "image.mat", simplify_cells=True)["materials"]
    assert table["roughness_mm"].tolist() == [0.25] * 3


def test_a_declared_figure_is_a_variable_of_the_dataset(scan):
    roughness = patch_dataset(scan)["roughness_mm"]
    assert roughness.values.tolist() == pytest.approx([0.25] * 3)
    assert roughness.attrs == {"units": "mm", "long_name": "roughness of the surface"}


def test_a_declared_figure_stands_in_the_report(scan):
    page = render(scan, {})
    assert '<th class="n">roughness</th>' in page
    assert page.count("0.25 mm") == 3


def test_a_declared_figure_is_in_the_file_and_is_read_back(scan):
    content = to_plain(scan.materials)
    assert [segment["roughness_mm"] for segment in content["segments"]] == [0.25] * 3
    assert msgspec.convert(content["segments"][0], RoughPatch).roughness_mm == 0.25
