"""Scan folders and files from elsewhere: no path leads out of the folder, and no small file takes much memory."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from polysight.host.capture import read_packets
from polysight.host.capture.packet_file import PACKETS, RUN
from polysight.host.materials.library import Library
from polysight.host.materials.patch_files import read_patches
from polysight.host.products.files import read_image
from polysight.host.store.raw import drop, droppable
from polysight.host.store.scan_folder import ScanFolder
from polysight.host.store.validation import validate
from polysight.shared.config import load_instrument
from polysight.shared.errors import ConfigError, DataError, PolysightError
from tests.support.paths import RIG_FILE

OUTSIDE = ["../victim.bin", "/etc/passwd", "raw/../../victim.bin", "raw/a\0b.bin", "", ".", "manifest.jsonl"]


@pytest.fixture
def scan(undisturbed, tmp_path) -> ScanFolder:
    return ScanFolder.load(undisturbed.copy(tmp_path / "copy").path)


def committed_as(scan: ScanFolder, file: str) -> None:
    """Commit the first row once more, with its first board's payload in this file."""
    fact = next(f for f in scan.facts("row_committed") if f["row"] == 0)
    name = next(iter(fact["boards"]))
    boards = {**fact["boards"], name: {**fact["boards"][name], "file": file}}
    with scan.writer() as writer:
        writer.append({k: v for k, v in fact.items() if k not in ("crc", "count", "previous")} | {"boards": boards})
    scan.reload()


@pytest.mark.parametrize("file", OUTSIDE)
def test_a_row_outside_the_scan_is_refused_by_whatever_reads_it(scan, file):
    victim = scan.path.parent / "victim.bin"
    victim.write_bytes(b"mine")
    committed_as(scan, file)
    for use in (scan.committed, lambda: list(scan.rows()), lambda: droppable(scan, {})):
        with pytest.raises(DataError, match="outside"):
            use()
    assert any(f.severity == "error" for f in validate(scan.path))
    assert victim.read_bytes() == b"mine"


def test_a_link_out_of_the_scan_is_refused(scan, tmp_path):
    name = next(iter(scan.committed()[0].boards))
    elsewhere = tmp_path / "elsewhere"
    (scan.path / "raw" / name).rename(elsewhere)
    (scan.path / "raw" / name).symlink_to(elsewhere)
    with pytest.raises(DataError, match="outside"):
        ScanFolder.load(scan.path).committed()


@pytest.mark.parametrize("name", ["../a", "a/b", "", ".", "..", ".hidden", "a\0b", "a" * 65])
def test_a_board_whose_name_is_a_path_is_refused(name, tmp_path):
    text = RIG_FILE.read_text().replace('name = "RH"', f"name = {json.dumps(name)}", 1)
    assert text != RIG_FILE.read_text()
    (tmp_path / "rig.toml").write_text(text)
    with pytest.raises(ConfigError, match="name"):
        load_instrument(tmp_path / "rig.toml")


def test_only_bytes_that_were_committed_are_dropped(scan):
    row = scan.committed()[0]
    name, board = next(iter(row.boards.items()))
    other_board = next(n for n in row.boards if n != name)
    other = bytes(board.bytes)
    (scan.path / board.file).write_bytes(other)
    processed = {n: {r.row: r.boards[n].crc32 for r in scan.committed().values()} for n in row.boards}
    kept = droppable(scan, processed).kept
    assert [line for line in kept if board.file in line]
    drop(scan, processed, scan.path)
    assert (scan.path / board.file).read_bytes() == other
    assert not (scan.path / row.boards[other_board].file).exists()


def bomb(path: Path, size: int = 6 << 30) -> Path:
    """An archive of 64 KB with an array of 6 GB, by what its directory and its header say."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": (size,)})
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as z:
        for name in ("h", "meta"):
            z.writestr(f"{name}.npy", header.getvalue() + bytes(64 << 20))
        z.filelist[0].file_size = size
    return path


@pytest.mark.parametrize("read", [read_image, read_patches, Library.load], ids=["image", "patches", "library"])
def test_an_archive_that_claims_too_much_is_refused_by_its_size(read, tmp_path):
    with pytest.raises(DataError, match="bytes"):
        read(bomb(tmp_path / "big.npz"))


@pytest.mark.parametrize("change", [{"packets": 0xFFFFFFFF, "size": 0}, {"packets": 0xFFFFFFFF}])
def test_a_packet_log_that_claims_too_much_is_refused_by_its_size(scan, change):

    board = next(iter(scan.committed()[0].boards.values()))
    path = (scan.path / board.file).with_suffix(PACKETS)
    line, _, tail = path.read_bytes().partition(b"\n")
    head = json.loads(line)
    at = 16 * head["batches"]
    runs = np.frombuffer(tail[at : at + RUN.itemsize * head["runs"]], dtype=RUN).copy()
    for key, value in change.items():
        runs[key] = value
    path.write_bytes(line + b"\n" + tail[:at] + runs.tobytes() + tail[at + runs.nbytes :])
    with pytest.raises(DataError):
        read_packets(path, np.fromfile(scan.path / board.file, dtype=np.uint8))


def test_a_row_that_claims_to_be_larger_than_its_file_is_refused(scan):
    board = next(iter(scan.committed()[0].boards.values()))
    path = (scan.path / board.file).with_suffix(PACKETS)
    line, _, tail = path.read_bytes().partition(b"\n")
    head = json.loads(line)
    head["evidence"]["expected"] = 1 << 45
    path.write_bytes(json.dumps(head).encode() + b"\n" + tail)
    with pytest.raises(PolysightError):
        read_packets(path, np.fromfile(scan.path / board.file, dtype=np.uint8))
