"""Images are written as soon as the rows are in; nothing that follows may keep them back, or take a report away."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from polysight.host.cli.main import main
from polysight.host.jobs.process import all_rows, make_products, publish_images
from polysight.host.pipeline import Pipeline
from polysight.host.process import Options
from polysight.host.products import read_products
from polysight.host.store import ScanFolder
from polysight.shared.errors import DataError
from tests.support.commands import told_by


@pytest.fixture(scope="module")
def scan(two_plates: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = Path(shutil.copytree(two_plates, tmp_path_factory.mktemp("first") / "scan"))
    all_rows(ScanFolder.load(folder), folder)
    return folder


def test_the_image_is_there_before_anything_is_made_of_it(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: list[bool] = []
    finish = Pipeline.finish

    def finished(self: Pipeline, *words: object) -> object:
        seen.append(read_products(tmp_path / "out").valid.any())
        return finish(self, *words)  # type: ignore[arg-type]

    monkeypatch.setattr(Pipeline, "finish", finished)
    assert main(["process", str(scan), "--out", str(tmp_path / "out")]) in (0, 5)
    assert seen == [True]
    assert f"image: {tmp_path / 'out' / 'image.npz'}" in capsys.readouterr().err
    assert (tmp_path / "out" / "report.html").exists()


def test_images_published_beside_a_scan_are_those_of_all_rows_at_once(scan: Path, tmp_path: Path) -> None:
    source = ScanFolder.load(scan)
    pipeline = Pipeline(source, live=True)
    for row in source.rows():
        pipeline.add_row(row)
    publish_images(pipeline, tmp_path)
    first, whole = read_products(tmp_path), pipeline.form_images()
    assert (first.valid == whole.valid).mean() > 0.999
    at = first.valid & whole.valid
    for one, other in ((first.h, whole.h), (first.v, whole.v)):
        assert np.abs(one - other)[at].max() < 1e-5 * np.abs(other[at]).max()


def test_an_earlier_report_stays_until_the_new_one_is_whole(scan: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "report.html").write_text("earlier")
    publish_images(all_rows(ScanFolder.load(scan), scan), out)
    assert [p.name for p in out.iterdir()] == ["report.html"]


def test_the_images_stay_when_what_follows_fails(scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise DataError("no metal")

    pipeline, out = all_rows(ScanFolder.load(scan), scan), tmp_path / "out"
    publish_images(pipeline, out)
    monkeypatch.setattr(Pipeline, "examine", fails)
    with pytest.raises(DataError, match="no metal"):
        make_products(pipeline, out, Options(), ())
    assert read_products(out).valid.any()


def test_each_step_is_told_before_it_begins(scan: Path, tmp_path: Path) -> None:
    told: list[str] = []
    all_rows(ScanFolder.load(scan), scan).finish(tmp_path, Options(model="none"), (), told.append)
    assert told == ["point response", "materials", "figures and report"]


def test_another_plane_and_grid_from_the_command_line(scan: Path, tmp_path: Path) -> None:
    there = tmp_path / "scan"
    shutil.copytree(scan, there)
    shutil.rmtree(there / "raw")  # the samples are enough
    told_by("image", there, "--out", tmp_path / "out", "--depth", "4", "--grid", "60x30@2.5")
    products = read_products(tmp_path / "out")
    assert products.h.shape == (30, 60)
    np.testing.assert_allclose(np.diff(products.x_m), 2.5e-3)
    distance = ScanFolder.load(scan).instrument.geometry.object_distance_mm
    assert products.scan["instrument"]["geometry"]["object_distance_mm"] == distance + 4


@pytest.mark.parametrize("grid", ["60", "60x30", "0x30@2", "60x30@0", "60x30@two", "60x30@2@3"])
def test_a_grid_that_is_none_is_refused_in_words(grid: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["image", "scan", "--out", "out", "--grid", grid])
    assert "COLUMNSxROWS@MM" in capsys.readouterr().err
