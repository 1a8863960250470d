"""Kept samples: images formed from them equal those from raw data; damaged or outdated samples are not used."""

import json
import shutil
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.support.pipelines import make_pipeline
from tests.support.processes import HANG_S
from tests.support.refusals import expect_refusal

from polysight.imaging import PLANE_REACH_M, Images
from polysight.jobs.process import image, process
from polysight.pipeline import Pipeline
from polysight.process import SampleUse, map_rows
from polysight.process.rows import KeptSamples
from polysight.store import RowData, ScanFolder
from polysight.store.manifest import encode_line
from polysight.store.source import split_pieces
from polysight_shared.errors import DataError, ErrorCode

# Arrays of `Images`
PIXELS = ("h", "v", "h_raw", "v_raw", "valid")
# Rows and RX of the scan `two_plates`
ROWS = 17
RX = 4


def process_scan(folder: Path, samples: SampleUse = "keep", **settings: Any) -> Pipeline:
    """Return the pipeline of a scan after all of its rows; it reads kept samples, or keeps those it makes."""
    return make_pipeline(ScanFolder.load(folder), samples=samples, **settings)


def are_same_images(first: Images, second: Images) -> bool:
    same_pixels = all(np.array_equal(getattr(first, name), getattr(second, name)) for name in PIXELS)
    return same_pixels and np.array_equal(first.illumination.footprints, second.illumination.footprints)


@pytest.fixture(scope="module")
def from_raw(two_plates: Path) -> Pipeline:
    """The scan, processed without samples."""
    return process_scan(two_plates, "none")


@pytest.fixture(scope="module")
def expected_images(from_raw: Pipeline) -> Images:
    """The images of that scan."""
    return from_raw.form_images()


@pytest.fixture
def scan(two_plates: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(two_plates, tmp_path / "scan"))


@pytest.fixture(scope="module")
def processed_scan(two_plates: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = Path(shutil.copytree(two_plates, tmp_path_factory.mktemp("kept") / "scan"))
    process_scan(folder)
    return folder


@pytest.fixture
def scan_with_samples(processed_scan: Path, tmp_path: Path) -> Path:
    """A copy of the scan with its samples."""
    return Path(shutil.copytree(processed_scan, tmp_path / "scan"))


def remove_raw(folder: Path) -> Path:
    shutil.rmtree(folder / "raw")
    return folder


def test_images_and_quality_from_samples_are_bit_exact(
    from_raw: Pipeline, expected_images: Images, scan_with_samples: Path
) -> None:
    reprocessed = process_scan(remove_raw(scan_with_samples))
    assert are_same_images(reprocessed.form_images(), expected_images)
    for key in ("boards", "coverage"):
        assert getattr(reprocessed.quality.result(), key) == getattr(from_raw.quality.result(), key)


def test_rows_on_several_threads_make_the_same_products(
    from_raw: Pipeline, expected_images: Images, scan: Path
) -> None:
    threaded = Pipeline(ScanFolder.load(scan), samples="keep")
    rows = list(threaded.source.rows())
    assert list(map_rows(threaded.add_row, rows, threads=4)) == rows
    assert are_same_images(threaded.form_images(), expected_images)
    assert threaded.quality.result().boards == from_raw.quality.result().boards
    assert are_same_images(process_scan(remove_raw(scan)).form_images(), expected_images)


def test_the_first_error_stops_all_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """After the error of row 0 only rows that have begun are completed: one of each of two threads, perhaps a third.

    They wait here until the others were cancelled, so that a slow main thread changes nothing.
    """
    begun: list[int] = []
    stopped = threading.Event()
    shutdown = ThreadPoolExecutor.shutdown

    def stop(pool: ThreadPoolExecutor, wait: bool = True, *, cancel_futures: bool = False) -> None:
        shutdown(pool, wait=False, cancel_futures=cancel_futures)
        stopped.set()
        shutdown(pool, wait=wait)

    def add(row: int) -> None:
        begun.append(row)
        assert row == 0 or stopped.wait(HANG_S)
        raise DataError(f"row {row}", code=ErrorCode.NO_DATA)

    monkeypatch.setattr(ThreadPoolExecutor, "shutdown", stop)
    with expect_refusal(ErrorCode.NO_DATA, "row 0"):
        list(map_rows(add, range(1000), threads=2))
    assert len(begun) <= 2 + 1


def test_samples_with_sub_bands_can_be_used_without_them(expected_images: Images, scan: Path) -> None:
    with_raw = process_scan(scan, bands=3)
    from_samples = process_scan(remove_raw(scan), bands=3)
    for band_images, expected in zip(from_samples.sub_bands.finish(), with_raw.sub_bands.finish(), strict=True):
        assert are_same_images(band_images, expected)
    assert are_same_images(process_scan(scan).form_images(), expected_images)


def test_samples_without_the_requested_sub_bands_are_not_used(scan_with_samples: Path) -> None:
    processed_again = process_scan(scan_with_samples, bands=2)
    assert len(processed_again.sub_bands.finish()) == 2
    assert process_scan(remove_raw(scan_with_samples), bands=2).sub_bands.bands == processed_again.sub_bands.bands


@pytest.mark.parametrize(
    "view", [{"depth_mm": 8.0}, {"depth_mm": -12.0}, {"columns": 31, "rows": 24, "pixel_mm": 5.0}, {"pixel_mm": 2.0}]
)
def test_other_planes_and_grids_come_from_the_same_samples(
    two_plates: Path, scan_with_samples: Path, view: dict[str, Any]
) -> None:
    expected = process_scan(two_plates, "none", **view).form_images()
    reprocessed = process_scan(remove_raw(scan_with_samples), **view).form_images()
    np.testing.assert_array_equal(reprocessed.x_m, expected.x_m)
    pairs = [(reprocessed.h_raw, expected.h_raw), (reprocessed.v_raw, expected.v_raw)]
    pairs += zip(reprocessed.illumination.footprints, expected.illumination.footprints, strict=True)
    for from_samples, from_raw_data in pairs:
        # The ranges of paths that are kept differ, and with them the noise.
        assert np.abs(from_samples - from_raw_data).max() < 2e-3 * np.abs(from_raw_data).max()


def test_a_plane_beyond_what_was_kept_needs_raw_data(scan_with_samples: Path) -> None:
    depth_mm = 1e3 * PLANE_REACH_M + 200
    process_scan(scan_with_samples, depth_mm=depth_mm)
    with pytest.raises(DataError):
        process_scan(remove_raw(scan_with_samples), depth_mm=depth_mm)


def test_other_planes_do_not_change_the_kept_samples(scan_with_samples: Path) -> None:
    samples_before = {p.name: p.read_bytes() for p in (scan_with_samples / "samples").iterdir()}
    process_scan(scan_with_samples, depth_mm=300.0)
    process_scan(scan_with_samples, depth_range_mm=50.0)
    assert {p.name: p.read_bytes() for p in (scan_with_samples / "samples").iterdir()} == samples_before


@pytest.mark.parametrize("what", ["record", "torn line", "line", "head", "array gone", "array short"])
def test_damaged_samples_are_made_again(expected_images: Images, scan_with_samples: Path, what: str) -> None:
    folder = scan_with_samples / "samples"
    rows = folder / "rows.jsonl"
    array = folder / "RH.npy"
    # Each number of bytes lies within the last record or the last line.
    if what == "record":
        data = bytearray(array.read_bytes())
        data[-5000] ^= 1
        array.write_bytes(data)
    elif what == "torn line":
        rows.write_bytes(rows.read_bytes()[:-7])
    elif what == "line":
        rows.write_bytes(rows.read_bytes().replace(b'"row":3', b'"row":4', 1))
    elif what == "head":
        (folder / "samples.json").write_text("{", encoding="utf-8")
    elif what == "array gone":
        array.unlink()
    else:
        array.write_bytes(array.read_bytes()[:-3000])
    assert are_same_images(process_scan(scan_with_samples).form_images(), expected_images)
    assert are_same_images(process_scan(remove_raw(scan_with_samples)).form_images(), expected_images)


def test_rows_with_other_raw_data_are_synchronised_again(
    scan_with_samples: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a retake or a new placement of a row its digest in the manifest differs from that of its samples."""
    committed = ScanFolder.committed_rows

    def change_row(self: ScanFolder) -> dict:
        rows = committed(self)
        rows[2].boards["RV"] = msgspec.structs.replace(rows[2].boards["RV"], index_crc32="00000000")
        return rows

    monkeypatch.setattr(ScanFolder, "committed_rows", change_row)
    pipeline = Pipeline(ScanFolder.load(scan_with_samples), samples="read")
    assert [row for row in pipeline.source.rows() if not pipeline.samples.restore(row)] == [2]


def test_samples_of_another_calibration_are_not_used(scan_with_samples: Path) -> None:
    head = json.loads((scan_with_samples / "samples" / "samples.json").read_text())
    head["made_with"]["object_distance_mm"] += 1.0
    (scan_with_samples / "samples" / "samples.json").write_text(json.dumps(head))
    pipeline = Pipeline(ScanFolder.load(scan_with_samples), samples="read")
    assert not any(pipeline.samples.restore(row) for row in pipeline.source.rows())


def test_a_scan_is_processed_even_if_samples_cannot_be_written(
    expected_images: Images, scan: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (scan / "samples").write_text("a file is in the way")
    assert are_same_images(process_scan(scan).form_images(), expected_images)
    assert str(scan / "samples") in caplog.text


def test_samples_can_be_read_as_the_specification_says(from_raw: Pipeline, scan_with_samples: Path) -> None:
    """The lines of docs/spec/samples.md."""
    folder = scan_with_samples / "samples"
    head = json.loads((folder / "samples.json").read_text())
    records = np.load(folder / "RH.npy", mmap_mode="r")
    lines = [json.loads(line) for line in (folder / "rows.jsonl").read_text().splitlines()]
    # complex64 [row, rx, frequency, column]
    cube = records["samples"]
    assert cube.shape[:2] == (ROWS, RX)
    assert cube.shape[2] == len(head["frequencies_hz"]["samples"])
    assert [line["row"] for line in lines] == list(range(ROWS))
    np.testing.assert_array_equal(np.moveaxis(cube, 0, 2), from_raw.builder.boards["RH"]._cube)


@pytest.mark.parametrize(
    ("needed_m", "is_covered"),
    [((0.1, 1.0), True), ((0.2, 0.9), True), ((0.099, 0.9), False), ((0.2, 1.001), False), ((0.0, 2.0), False)],
)
def test_samples_are_kept_only_with_the_usual_range_of_paths(needed_m, is_covered) -> None:
    """Samples of an image that needs other paths would be of no use to the next one."""
    samples = SimpleNamespace(_head={}, _keep=True)
    usual_m = (0.1, 1.0)
    gate_m = KeptSamples._gate_m(samples, rig=None, needed_gate_m=needed_m, usual_gate_m=usual_m)
    assert gate_m == (usual_m if is_covered else needed_m)
    assert samples._keep is is_covered


# Keys that are missing, of another type, or have numbers that no scan has.
@pytest.mark.parametrize(
    "change_head",
    [
        lambda h: {k: v for k, v in h.items() if k != "made_with"},
        lambda h: {k: v for k, v in h.items() if k != "frequencies_hz"},
        lambda h: {**h, "frequencies_hz": {"samples": "many"}},
        lambda h: {**h, "gate_m": [0.1]},
        lambda h: {**h, "gate_m": [None, 1.0]},
        lambda h: {**h, "gate_m": [0.0, 10.0]},
        lambda h: {**h, "gate_m": [0.0, 1e12]},
        lambda h: {**h, "frequencies_hz": {"samples": [f + 1e6 for f in h["frequencies_hz"]["samples"]]}},
        lambda h: [h],
    ],
)
def test_an_invalid_head_is_ignored(expected_images: Images, scan_with_samples: Path, change_head) -> None:
    path = scan_with_samples / "samples" / "samples.json"
    path.write_text(json.dumps(change_head(json.loads(path.read_text()))))
    assert are_same_images(process_scan(scan_with_samples, "read").form_images(), expected_images)


@pytest.mark.parametrize(
    "change",
    [
        None,
        {"positions": None},
        {"masked_columns": "abc"},
        {"stages": [["x", None, "y", {}]]},
        {"positions_masked": -5},
    ],
)
def test_a_row_with_invalid_figures_is_made_again(
    expected_images: Images, scan_with_samples: Path, change: dict | None
) -> None:
    path = scan_with_samples / "samples" / "rows.jsonl"
    facts = [json.loads(line) for line in path.read_text().splitlines()]
    entry = facts[4]["boards"]["RH"]
    entry["figures"] = change if change is None else {**entry["figures"], **change}
    path.write_bytes(b"".join(encode_line({k: v for k, v in f.items() if k != "crc"}) for f in facts))
    assert are_same_images(process_scan(scan_with_samples).form_images(), expected_images)
    assert are_same_images(process_scan(remove_raw(scan_with_samples)).form_images(), expected_images)


def damage_raw(monkeypatch: pytest.MonkeyPatch, change: Callable[[str, np.ndarray], None]) -> None:
    """Change the words int16 [chirp and sample, 2 x RX] of every row that is read."""
    read_row = ScanFolder.read_row

    def change_row(self: ScanFolder, board: str, row: int) -> RowData:
        row_data = read_row(self, board, row)
        words = row_data.payload.view("<i2").reshape(-1, 8).copy()
        change(board, words)
        return RowData(split_pieces(words.view(np.uint8).ravel()), [], row_data.frames_expected, row_data.crc32)

    monkeypatch.setattr(ScanFolder, "read_row", change_row)


@pytest.mark.parametrize("dead", [("RH", "RV"), ("RV",)])
@pytest.mark.parametrize("command", ["image", "process"])
def test_an_image_without_a_valid_pixel_is_refused_with_the_name_of_the_board(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dead: tuple[str, ...], command: str
) -> None:
    def silence(board: str, words: np.ndarray) -> None:
        if board in dead:
            words[:] = 0

    damage_raw(monkeypatch, silence)
    with expect_refusal(ErrorCode.NO_DATA, " and ".join(dead)):
        if command == "image":
            image(scan, tmp_path / "out")
        else:
            process(scan, tmp_path / "out")
    assert (tmp_path / "out" / "image.npz").exists()


@pytest.mark.filterwarnings("ignore:invalid value encountered in divide:RuntimeWarning")
def test_rows_of_dead_receivers_are_kept(
    scan: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    # The words of a sample are those of four RX, twice: only the first RX is left.
    def keep_one_rx(_: str, words: np.ndarray) -> None:
        words[:, [1, 2, 3, 5, 6, 7]] = 0

    damage_raw(monkeypatch, keep_one_rx)
    first = process_scan(scan)
    assert not caplog.text
    processed_again = process_scan(remove_raw(scan))
    assert are_same_images(processed_again.form_images(), first.form_images())
    assert processed_again.quality.result().boards == first.quality.result().boards


@pytest.mark.parametrize("name", ["rows.jsonl", "RH.npy", "samples.json", ""])
def test_a_link_out_of_the_scan_is_not_written_through(scan: Path, tmp_path: Path, name: str) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "mine.txt").write_text("not to be lost")
    if name:
        (scan / "samples").mkdir()
        (scan / "samples" / name).symlink_to(elsewhere / "mine.txt")
    else:
        (scan / "samples").symlink_to(elsewhere)
    with pytest.raises(DataError):
        process_scan(scan)
    assert [p.name for p in elsewhere.iterdir()] == ["mine.txt"]
    assert (elsewhere / "mine.txt").read_text() == "not to be lost"
