"""`polysight process` and `image`: images are written first and stay; old products stay until new ones are complete."""

import json
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.support.pipelines import make_pipeline
from tests.support.processes import read_output
from tests.support.refusals import expect_refusal
from tests.support.scenes import COPPER, PET, make_scene

from polysight.cli.main import main
from polysight.jobs import process
from polysight.jobs.process import LiveProcessing, make_products, process_rows, publish_images
from polysight.materials import STEEP_FINDING
from polysight.pipeline import Pipeline
from polysight.products import QUALITY, folder, lock_products, read_products, replace_products
from polysight.products.processed import FINISHED
from polysight.settings import Settings
from polysight.store import MANIFEST, ScanFolder
from polysight.store.manifest import ManifestWriter
from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.files import read_json


@pytest.fixture(scope="module")
def scan(two_plates: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = Path(shutil.copytree(two_plates, tmp_path_factory.mktemp("first") / "scan"))
    process_rows(ScanFolder.load(folder), folder)
    return folder


def test_the_image_is_written_before_anything_is_derived_from_it(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    image_was_written: list[bool] = []
    finish = Pipeline.finish

    def finish_scan(self: Pipeline, *words: object) -> object:
        image_was_written.append(read_products(tmp_path / "out").valid.any())
        return finish(self, *words)  # type: ignore[arg-type]

    monkeypatch.setattr(Pipeline, "finish", finish_scan)
    assert main(["process", str(scan), "--out", str(tmp_path / "out")]) == 0
    assert image_was_written == [True]
    assert str(tmp_path / "out" / "image.npz") in capsys.readouterr().err
    assert (tmp_path / "out" / "report.html").exists()


def test_an_image_appears_with_its_whole_quality(scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A later write would be without the folder's lock, and could change products of another program."""
    quality_at_first: list[object] = []

    @contextmanager
    def replace_and_read(out: Path, scan_id: str) -> Iterator[Path]:
        with replace_products(out, scan_id) as new_folder:
            yield new_folder
        quality_at_first.append(read_json(out / QUALITY))

    monkeypatch.setattr(process, "replace_products", replace_and_read)
    assert main(["image", str(scan), "--out", str(tmp_path)]) == 0
    assert quality_at_first == [read_json(tmp_path / QUALITY)]


def test_images_published_during_a_scan_are_those_of_all_rows_together(scan: Path, tmp_path: Path) -> None:
    pipeline = make_pipeline(ScanFolder.load(scan), live=True)
    publish_images(pipeline, tmp_path)
    published = read_products(tmp_path)
    images = pipeline.form_images()
    # All pixels agree here.
    assert (published.valid == images.valid).mean() > 0.999
    valid_in_both = published.valid & images.valid
    for published_image, image in ((published.h, images.h), (published.v, images.v)):
        difference = np.abs(published_image - image)[valid_in_both]
        # Sums in single precision
        assert difference.max() < 1e-5 * np.abs(image[valid_in_both]).max()


def test_published_images_are_kept_if_a_later_step_fails(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise DataError("no metal", code=ErrorCode.NO_DATA)

    pipeline = process_rows(ScanFolder.load(scan), scan)
    out = tmp_path / "out"
    publish_images(pipeline, out)
    monkeypatch.setattr(Pipeline, "examine", fail)
    with expect_refusal(ErrorCode.NO_DATA):
        make_products(pipeline, out, ())
    assert read_products(out).valid.any()


def test_a_scan_waits_at_its_end_for_a_program_that_is_writing_its_products(
    make_scan: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """`process` may have begun before the scan was resumed."""
    scan = make_scan(tmp_path / "scan", make_scene(COPPER, PET, columns=10, rows=11))
    out = scan / "products"
    running = LiveProcessing(scan, Settings(model="none"))
    waited_s = []

    # No time passes. The other program ends after a little more than two minutes of waiting.
    def wait(pause_s: float) -> None:
        waited_s.append(pause_s)
        if sum(waited_s) > 130:
            other_process.close()

    with ExitStack() as other_process:
        other_process.enter_context(lock_products(out))
        for row in range(11):
            running.add_row(row)
        assert not out.exists()
        monkeypatch.setattr(folder.time, "sleep", wait)
        running.finish()
    err = capsys.readouterr().err
    assert err.count(f"waiting: another program is writing products in {out}\n") == 1
    # Once a minute it says what it still waits for.
    assert re.findall(r"still waiting: .* in (.*) \((\d) min\); Ctrl-C", err) == [(str(out), "1"), (str(out), "2")]
    assert read_products(out).quality.coverage.rows_recorded == 11


def test_products_that_lack_rows_recorded_in_the_meantime_do_not_replace_those_of_the_scan(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    resumed = Path(shutil.copytree(scan, tmp_path / "scan"))
    manifest = (resumed / MANIFEST).read_bytes()
    # Without its last three lines the manifest lacks at least one committed row.
    lines = manifest.splitlines(keepends=True)
    unfinished = b"".join(lines[:-3])
    assert unfinished.count(b"row_committed") < manifest.count(b"row_committed")
    (resumed / MANIFEST).write_bytes(unfinished)
    add_rows = process.add_rows

    def add_rows_and_resume(*words: object) -> None:
        add_rows(*words)  # type: ignore[arg-type]
        (resumed / MANIFEST).write_bytes(manifest)

    monkeypatch.setattr(process, "add_rows", add_rows_and_resume)
    with expect_refusal(ErrorCode.BUSY, f"polysight process {resumed} --out {resumed / 'products'}"):
        process.process(resumed, resumed / "products")
    assert not (resumed / "products").exists()
    # In another folder they are written: a user asked for them.
    (resumed / MANIFEST).write_bytes(unfinished)
    process.process(resumed, tmp_path / "out")
    assert read_products(tmp_path / "out").quality.coverage.rows_absent


def test_products_in_the_folder_of_a_scan_that_was_resumed_are_refused(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    resumed = Path(shutil.copytree(scan, tmp_path / "scan"))
    add_rows = process.add_rows
    with ExitStack() as running:

        def add_rows_and_resume(*words: object) -> None:
            add_rows(*words)  # type: ignore[arg-type]
            running.enter_context(ManifestWriter(resumed / MANIFEST, create=False))

        monkeypatch.setattr(process, "add_rows", add_rows_and_resume)
        with expect_refusal(ErrorCode.BUSY, "polysight preview"):
            process.process(resumed, resumed / "products")
    assert not (resumed / "products").exists()


@pytest.mark.parametrize("is_steep", [True, False])
def test_surfaces_are_measured_if_a_patch_is_too_steep(
    make_scan: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_steep: bool
) -> None:
    scan = make_scan(tmp_path / "scan", make_scene(COPPER, PET, columns=10, rows=11))
    examine = Pipeline.examine

    def examine_tilted(self: Pipeline, *words: object) -> object:
        findings = examine(self, *words)  # type: ignore[arg-type]
        first_patch, *other_patches = findings.analysis.patches
        patches = (replace(first_patch, refused=STEEP_FINDING if is_steep else None), *other_patches)
        return replace(findings, analysis=replace(findings.analysis, patches=patches))

    monkeypatch.setattr(Pipeline, "examine", examine_tilted)
    out = tmp_path / "out"
    make_products(process_rows(ScanFolder.load(scan), scan, Settings(model="none")), out, ())
    assert (out / "surface.npz").exists() == is_steep
    assert ("surfaces" in read_products(out).quality.seconds_per_stage) == is_steep
    assert (b"Surfaces from three sides" in (out / "report.html").read_bytes()) == is_steep


def test_the_command_forms_images_at_another_distance_and_on_another_grid(scan: Path, tmp_path: Path) -> None:
    scan_folder = tmp_path / "scan"
    shutil.copytree(scan, scan_folder)
    # The kept samples are enough; raw data are not needed.
    shutil.rmtree(scan_folder / "raw")
    options = ("--out", tmp_path / "out", "--depth", "4", "--grid", "60x30@2.5")
    read_output("image", scan_folder, *options)
    products = read_products(tmp_path / "out")
    assert products.h.shape == (30, 60)
    np.testing.assert_allclose(np.diff(products.x_m), 2.5e-3)
    distance = ScanFolder.load(scan).instrument.geometry.object_distance_mm
    assert products.facts.instrument["geometry"]["object_distance_mm"] == distance + 4


@pytest.mark.parametrize(
    "grid", ["60", "60x30", "0x30@2", "60x30@0", "60x30@two", "60x30@2@3", "9999x9999@1", "60x30@9999", "60x30@0.001"]
)
def test_an_invalid_grid_is_refused(grid: str) -> None:
    with pytest.raises(SystemExit):
        main(["image", "scan", "--out", "out", "--grid", grid])


# A box inside the copper: centre and size in millimetres.
METAL = "-40,10,30,30"


def rename_pet(scan: Path, name: str) -> None:
    truth = read_json(scan / "truth.json")
    truth["plates"][1]["name"] = name
    (scan / "truth.json").write_text(json.dumps(truth))


def test_right_names_are_counted_and_the_mark_of_an_earlier_run_is_removed(two_plates: Path, tmp_path: Path) -> None:
    scan = shutil.copytree(two_plates, tmp_path / "scan")
    out = tmp_path / "out"
    rename_pet(scan, "no such material")
    output = read_output("process", scan, "--out", out, "--metal", METAL)
    segments = read_json(out / "materials.json")["segments"]
    for value in (f"{len(segments)} patches", "0 of 1 plates", out / "report.html", f"{out}/"):
        assert str(value) in output
    assert read_json(out / "quality.json")["verdict"]["level"] == "care"

    (out / FINISHED).write_text("{}")
    (pet,) = (s for s in segments if s["truth"] and s["truth"]["name"] == "no such material")
    rename_pet(scan, pet["name"])
    assert "1 of 1 plates" in read_output("process", scan, "--out", out, "--metal", METAL)
    assert not (out / FINISHED).exists()
