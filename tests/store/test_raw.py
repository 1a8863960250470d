"""Raw data is dropped only if saved products were made from it, and recorded in the manifest before."""

import io
import json
import shutil
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from tests.support.paths import POLYSIGHT, RIG_FILE
from tests.support.refusals import expect_refusal
from tests.support.scenes import write_small_scene
from tests.support.store.facts import load_facts
from tests.support.store.faulty_disk import FaultyDisk
from tests.support.store.plain_scan import list_errors

from polysight.cli.main import main
from polysight.jobs.live_scan import resume
from polysight.jobs.process import make_products, process, process_rows
from polysight.jobs.scans import drop_raw, find_processed_digests
from polysight.products import REPORT, replace_products, write_json
from polysight.results import NoResult
from polysight.settings import DEFAULT
from polysight.store import lock_samples
from polysight.store.logs import AppendFile
from polysight.store.raw import drop, find_droppable, require_raw
from polysight.store.scan_folder import MANIFEST, ScanFolder, dropped_files
from polysight.store.validation import find_damaged_rows
from polysight_shared.errors import ConfigError, DataError, ErrorCode, ScanError

ROWS = 4
BOARDS = 2
SCENE = write_small_scene(8, ROWS, metal=False)


def run_polysight(*words: object, typed: str = "") -> subprocess.CompletedProcess[str]:
    command = [POLYSIGHT, *map(str, words)]
    return subprocess.run(command, input=typed, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def processed_scan(tmp_path_factory) -> Path:
    """A simulated scan with its images."""
    folder = tmp_path_factory.mktemp("processed")
    (folder / "scene.toml").write_text(SCENE)
    simulate = [sys.executable, "-m", "polysight_simulators", "simulate", folder / "scene.toml"]
    config = ["--config", RIG_FILE, "--out", folder / "scan"]
    subprocess.run([*simulate, *config], check=True, capture_output=True)
    assert run_polysight("image", folder / "scan", "--out", folder / "scan" / "products").returncode == 0
    (folder / "scan" / "products" / REPORT).write_text("stands for the rest of the products")
    return folder / "scan"


@pytest.fixture
def scan(processed_scan, tmp_path) -> Path:
    """A copy of it, whose raw data may be dropped."""
    return Path(shutil.copytree(processed_scan, tmp_path / "scan"))


def list_payloads(scan: Path) -> set[Path]:
    return set(scan.glob("raw/*/*.bin"))


def read_contents(folder: Path) -> dict[str, bytes]:
    """Return the contents of the files of a folder, by name."""
    return {p.name: p.read_bytes() for p in folder.iterdir() if p.is_file()}


def test_dropped_rows_are_deleted_and_reported_by_every_command(scan, capsys):
    quality = scan / "products" / "quality.json"
    write_json(quality, {**json.loads(quality.read_text()), "key_of_a_later_release": 1})
    products = read_contents(scan / "products")
    digests = find_processed_digests(scan / "products")
    assert len(list_payloads(scan)) == ROWS * BOARDS
    process = run_polysight("drop-raw", scan, typed="drop\n")
    assert process.returncode == 0, process.stderr
    for board in ("RH", "RV"):
        assert f"to be removed: raw/{board}: rows 0-{ROWS - 1} ({ROWS} files)\n" in process.stdout
    assert not list_payloads(scan)

    # Of the products only one file has changed, by a mark.
    quality_before = json.loads(products.pop("quality.json"))
    products_after = read_contents(scan / "products")
    dropped = json.loads(products_after.pop("quality.json"))
    assert dropped.pop("raw_dropped")["scan_id"] == ScanFolder.load(scan).scan_id
    assert products_after == products
    assert dropped == quality_before
    products = read_contents(scan / "products")
    # Indices, with arrivals and gaps, are kept if there were any.
    assert len(list(scan.glob("raw/*/*.idx"))) in (0, ROWS * BOARDS)
    facts = load_facts(scan, "raw_dropped")
    assert [f["row"] for f in facts] == list(range(ROWS))
    dropped_digests = {(name, f["row"]): board["crc32"] for f in facts for name, board in f["boards"].items()}
    assert dropped_digests == {(name, row): crc for name, rows in digests.items() for row, crc in rows.items()}
    process = run_polysight("validate", scan)
    assert process.returncode == 0
    assert process.stdout.count("note: raw: ") == 1
    assert f"the raw data of {ROWS} rows was dropped after processing into products" in process.stdout
    with expect_refusal(ErrorCode.NO_DATA, ROWS):
        resume(scan, DEFAULT, keep_incomplete=False, process=True)
    assert read_contents(scan / "products") == products
    assert drop_raw(scan, None, yes=True) == 0
    assert "dropped already" in capsys.readouterr().out
    assert main(["process", str(scan), "--out", str(scan / "products")]) in (0, NoResult.exit_status)
    quality_again = json.loads((scan / "products" / "quality.json").read_text())
    assert quality_again["raw_dropped"] == json.loads(products["quality.json"])["raw_dropped"]
    assert quality_again["boards"] == dropped["boards"]


def test_products_that_are_replaced_after_a_drop_keep_its_mark(scan):
    """The mark is kept although the products were being made while the raw data was dropped."""
    pipeline = process_rows(ScanFolder.load(scan), scan)
    assert drop_raw(scan, None, yes=True) == 0
    make_products(pipeline, scan / "products", ())
    assert "raw_dropped" in json.loads((scan / "products" / "quality.json").read_text())


@pytest.mark.parametrize("what", ["image only", "being made", "being processed", "sample", "no samples", "settings"])
def test_nothing_is_dropped_unless_whole_products_and_samples_remain(scan, what):
    payloads_before = list_payloads(scan)
    samples = scan / "samples"
    with ExitStack() as other_items:
        code = ErrorCode.BUSY
        named = "products"
        if what == "image only":
            # As after a kill of `process`.
            (scan / "products" / REPORT).unlink()
            code = ErrorCode.FILE_MISSING
            named = REPORT
        elif what == "being made":
            other_items.enter_context(replace_products(scan / "products", ScanFolder.load(scan).scan_id))
        elif what == "being processed":
            other_items.enter_context(lock_samples(ScanFolder.load(scan)))
            named = "rows.jsonl"
        elif what == "sample":
            flip(samples / "RH.npy", row=2)
            code = ErrorCode.FILE_DAMAGED
            named = "samples/RH.npy"
        elif what == "no samples":
            shutil.rmtree(samples)
            code = ErrorCode.FILE_MISSING
            named = "rows.jsonl"
        else:
            head = samples / "samples.json"
            head.write_text(head.read_text().replace('"making": 1', '"making": 0'))
            code = ErrorCode.FILE_DAMAGED
            named = "samples.json"
        with expect_refusal(code, named):
            drop_raw(scan, None, yes=True)
    assert list_payloads(scan) == payloads_before
    assert not load_facts(scan, "raw_dropped")


def flip(path: Path, row: int) -> None:
    """Damage one byte of a row's record."""
    records = np.load(path, mmap_mode="r+")
    records.view(np.uint8).reshape(records.shape[0], -1)[row, 100] ^= 1
    records.flush()


def test_a_damaged_sample_of_a_dropped_row_is_named_and_only_that_row_is_lost(scan, tmp_path, caplog):
    whole_scan = tmp_path / "whole"
    assert drop_raw(scan, None, yes=True) == 0
    assert main(["image", str(scan), "--out", str(whole_scan)]) == 0
    flip(scan / "samples" / "RH.npy", row=2)
    errors = list_errors(scan)
    assert errors
    assert all("samples/RH.npy" in error and "row 2" in error for error in errors)
    assert main(["image", str(scan), "--out", str(tmp_path / "less")]) == 0
    assert "rows 2 are left out" in caplog.text
    coverage = json.loads((tmp_path / "less" / "quality.json").read_text())["coverage"]
    assert coverage["rows_absent"] == [2]
    contents_before = read_contents(scan / "products")
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA, "products"):
        process(scan, scan / "products")
    assert read_contents(scan / "products") == contents_before
    (scan / "samples" / "rows.jsonl").unlink()
    with expect_refusal(ErrorCode.NO_DATA, ROWS):
        process(scan, scan / "products")


def test_nothing_is_dropped_unconfirmed_or_unprocessed(scan, tmp_path, monkeypatch, capsys):
    payloads_before = list_payloads(scan)
    for typed in ("", "yes\n"):
        monkeypatch.setattr(sys, "stdin", io.StringIO(typed))
        with pytest.raises(ConfigError):
            drop_raw(scan, None, yes=False)
    with expect_refusal(ErrorCode.FILE_MISSING):
        drop_raw(scan, tmp_path / "none", yes=True)
    quality = scan / "products" / "quality.json"
    # Products of other data.
    content = json.loads(quality.read_text())
    for board in content["boards"].values():
        board["raw_crc32"] = dict.fromkeys(board["raw_crc32"], "00000000")
    quality.write_text(json.dumps(content))
    capsys.readouterr()
    with pytest.raises(DataError):
        drop_raw(scan, None, yes=True)
    assert capsys.readouterr().out.count("differs from the data of the products") == ROWS * BOARDS
    quality.write_text("{}")
    with pytest.raises(DataError):
        drop_raw(scan, None, yes=True)
    (scan / "products" / "image.npz").write_bytes(b"half of it")
    with expect_refusal(ErrorCode.FILE_DAMAGED):
        drop_raw(scan, None, yes=True)
    assert list_payloads(scan) == payloads_before
    assert not load_facts(scan, "raw_dropped")


def test_only_rows_in_the_products_are_dropped(scan):
    digests = find_processed_digests(scan / "products")
    board = next(iter(digests))
    del digests[board][2]
    drop(ScanFolder.load(scan), digests, scan / "products")
    assert list_payloads(scan) == {scan / "raw" / board / "0002.bin"}
    assert list_errors(scan) == []
    undropped_file = scan / "raw" / board / "0002.bin"
    undropped_file.write_bytes(b"damaged")
    assert any("0002.bin" in e for e in list_errors(scan))


def test_an_unfinished_scan_keeps_its_rows(scan):
    path = scan / MANIFEST
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join(line for line in lines if b'"row":3' not in line))
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA, "1 of 4", "polysight resume"):
        find_droppable(ScanFolder.load(scan), find_processed_digests(scan / "products"))
    with pytest.raises(ScanError):
        drop(ScanFolder.load(scan), find_processed_digests(scan / "products"), scan / "products")


def test_a_scan_in_use_keeps_its_rows(scan):
    with ScanFolder.load(scan).writer(), expect_refusal(ErrorCode.BUSY):
        drop(ScanFolder.load(scan), find_processed_digests(scan / "products"), scan / "products")
    assert len(list_payloads(scan)) == ROWS * BOARDS


class PowerCut(BaseException):
    """Raised in place of the program's end."""


@pytest.mark.parametrize("cut_after", range(ROWS * (BOARDS + 1)))
def test_a_drop_that_was_interrupted_leaves_a_valid_folder_and_the_next_one_ends_it(scan, monkeypatch, cut_after):
    """The steps are a line in the manifest and a removal for each board, row after row.

    The program ends before each step.
    """
    digests = find_processed_digests(scan / "products")
    steps = iter(range(ROWS * (BOARDS + 1)))
    unlink = Path.unlink
    append = AppendFile.append

    def fail_before(step):
        def call(*args, **kwargs):
            if next(steps) == cut_after:
                raise PowerCut
            return step(*args, **kwargs)

        return call

    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", fail_before(unlink))
        patched.setattr(AppendFile, "append", fail_before(append))
        with pytest.raises(PowerCut):
            drop(ScanFolder.load(scan), digests, scan / "products")
    remaining = ScanFolder.load(scan)
    missing_files = {str(b.file) for row in remaining.committed_rows().values() for b in row.boards.values()} - {
        str(path.relative_to(scan)) for path in list_payloads(scan)
    }
    assert missing_files <= set(dropped_files(remaining))
    assert list_errors(scan) == []
    assert find_damaged_rows(remaining) == {}
    drop(ScanFolder.load(scan), digests, scan / "products")
    assert not list_payloads(scan)
    assert list_errors(scan) == []
    assert [f["row"] for f in load_facts(scan, "raw_dropped")] == list(range(ROWS))


def test_samples_and_products_are_on_the_disk_before_raw_data_is_deleted(scan):
    """Samples are written without waiting for the disk: a power cut must not destroy both them and the raw data."""
    disk = FaultyDisk(scan)
    with disk():
        drop(ScanFolder.load(scan), find_processed_digests(scan / "products"), scan / "products")
    first = next(
        position
        for position, description in enumerate(disk.done)
        if description.startswith("unlink") and description.endswith(".bin")
    )
    synced = {
        description.removeprefix("fsync ") for description in disk.done[:first] if description.startswith("fsync ")
    }
    remains = {file.name for name in ("samples", "products") for file in (scan / name).iterdir() if file.is_file()}
    assert {"rows.jsonl", "RH.npy", "image.npz"} < remains
    assert remains | {"samples", "products"} <= synced


def test_a_line_torn_anywhere_drops_nothing(scan):
    """The last line is torn by a power cut: its files were not touched yet, and the row is as if never dropped."""
    copy = scan.with_name("copy")
    shutil.copytree(scan, copy)
    drop(ScanFolder.load(copy), find_processed_digests(copy / "products"), copy / "products")
    raw = (copy / MANIFEST).read_bytes()
    line = raw.splitlines(keepends=True)[-1]
    # Raw data of the rows before the last is deleted.
    for name in ("0000.bin", "0001.bin", "0002.bin"):
        for board in ("RH", "RV"):
            (scan / "raw" / board / name).unlink()
    for length in range(0, len(line), 7):
        (scan / MANIFEST).write_bytes(raw[: len(raw) - len(line) + length])
        assert list_errors(scan) == []
    assert len(list_payloads(scan)) == BOARDS


def test_a_row_that_was_retaken_after_the_drop_does_not_count_as_dropped(scan):
    drop(ScanFolder.load(scan), find_processed_digests(scan / "products"), scan / "products")
    folder = ScanFolder.load(scan)
    committed = load_facts(folder, "row_committed")[1]
    with folder.writer() as writer:
        writer.append({**committed, "take": 2})
    folder.reload()
    assert {Path(file).name for file in dropped_files(folder)} == {"0000.bin", "0002.bin", "0003.bin"}
    assert sum("0001.bin" in e for e in list_errors(scan)) == BOARDS
    with expect_refusal(ErrorCode.NO_DATA, "3 rows"):
        require_raw(folder)
