"""Untrusted scan folders and files: no path leads out of the folder, and no small file needs much memory."""

import io
import json
import os
import pickle
import zipfile
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
import pytest
from tests.support.paths import RIG_FILE
from tests.support.refusals import expect_refusal
from tests.support.store.facts import load_facts

from polysight.calibration import load_scan_calibration
from polysight.capture import read_index, read_packets
from polysight.capture.row_files import PACKETS_SUFFIX, RUN, write_durably
from polysight.cli.main import main
from polysight.materials.labels import read_labels, read_truth
from polysight.materials.library import Library
from polysight.materials.patch_files import read_patches
from polysight.materials.train import read_material
from polysight.products import ProcessedScan
from polysight.products.exports import read_netcdf
from polysight.products.folder import replace_products
from polysight.products.processed import read_image
from polysight.store import manifest
from polysight.store.published_rig import read_json as read_settings_json
from polysight.store.raw import drop, find_droppable
from polysight.store.scan_folder import ScanFolder
from polysight.store.validation import validate
from polysight_shared.config import load_instrument
from polysight_shared.errors import ConfigError, DataError, DeviceError, ErrorCode, PolysightError
from polysight_shared.files import write_atomically

# Names that lead out of the scan folder, or to no file of a row.
OUTSIDE = ["../victim.bin", "/etc/passwd", "raw/../../victim.bin", "raw/a\0b.bin", "", ".", "manifest.jsonl"]


@pytest.fixture
def scan(undisturbed_scan, tmp_path) -> ScanFolder:
    return ScanFolder.load(undisturbed_scan.copy(tmp_path / "copy").path)


def commit_first_row_as(scan: ScanFolder, file: str) -> None:
    """Commit the first row once more, with its first board's payload in this file."""
    fact = next(f for f in load_facts(scan, "row_committed") if f["row"] == 0)
    name = next(iter(fact["boards"]))
    boards = {**fact["boards"], name: {**fact["boards"][name], "file": file}}
    with scan.writer() as writer:
        writer.append({k: v for k, v in fact.items() if k not in ("crc", "count", "previous")} | {"boards": boards})
    scan.reload()


@pytest.mark.parametrize("file", OUTSIDE)
def test_a_row_whose_file_is_outside_the_scan_is_refused_by_every_reader(scan, file):
    victim = scan.path.parent / "victim.bin"
    victim.write_bytes(b"mine")
    commit_first_row_as(scan, file)
    for use in (scan.committed_rows, lambda: list(scan.rows()), lambda: find_droppable(scan, {})):
        with expect_refusal(ErrorCode.PATH_OUTSIDE):
            use()
    assert any(f.level == "error" for f in validate(scan.path))
    assert victim.read_bytes() == b"mine"


def test_a_link_out_of_the_scan_is_refused(scan, tmp_path):
    name = next(iter(scan.committed_rows()[0].boards))
    elsewhere = tmp_path / "elsewhere"
    (scan.path / "raw" / name).rename(elsewhere)
    (scan.path / "raw" / name).symlink_to(elsewhere)
    with expect_refusal(ErrorCode.PATH_OUTSIDE):
        ScanFolder.load(scan.path)


@pytest.mark.parametrize("name", ["../a", "a/b", "", ".", "..", ".hidden", "a\0b", "a" * 65])
def test_a_board_whose_name_is_a_path_is_refused(name, tmp_path):
    text = RIG_FILE.read_text().replace('name = "RH"', f"name = {json.dumps(name)}", 1)
    assert text != RIG_FILE.read_text()
    (tmp_path / "rig.toml").write_text(text)
    with pytest.raises(ConfigError):
        load_instrument(tmp_path / "rig.toml")


def test_only_bytes_that_were_committed_are_dropped(scan):
    row = scan.committed_rows()[0]
    name, board = next(iter(row.boards.items()))
    other_board = next(n for n in row.boards if n != name)
    zeros = bytes(board.bytes)
    (scan.path / board.file).write_bytes(zeros)
    processed = {n: {r.row: r.boards[n].crc32 for r in scan.committed_rows().values()} for n in row.boards}
    kept_files = find_droppable(scan, processed).kept_files
    assert [line for line in kept_files if board.file in line]
    drop(scan, processed, scan.path)
    assert (scan.path / board.file).read_bytes() == zeros
    assert not (scan.path / row.boards[other_board].file).exists()


def write_bomb(path: Path, size: int = 6 << 30) -> Path:
    """Write an archive of 64 KB that claims to have an array of 6 GB, in its directory and in the array's header."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": (size,)})
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as z:
        for name in ("h", "meta"):
            z.writestr(f"{name}.npy", header.getvalue() + bytes(64 << 20))
        z.filelist[0].file_size = size
    return path


@pytest.mark.parametrize("read", [read_image, read_patches, Library.load], ids=["image", "patches", "library"])
def test_an_archive_that_claims_too_much_is_refused_by_its_size(read, tmp_path):
    with expect_refusal(ErrorCode.FILE_TOO_LARGE):
        read(write_bomb(tmp_path / "big.npz"))


# Changes of a packet log: each takes the head and the runs of equal packets, and returns the runs.


def enlarge_row(head, runs):
    head["evidence"]["expected"] = 1 << 45
    return runs


def claim_overflow(head, _runs):
    head["runs"] = 1 << 16
    # 2**63 bytes in all, which is a negative number in 64 bits.
    return claim_runs(1 << 16, 0xFFFFFFFF, 0x8000)


def claim_runs(runs: int, packets: int, size: int) -> np.ndarray:
    return np.array([(0, 0, packets, size, 0)] * runs, RUN)


@pytest.mark.parametrize(
    "change",
    [
        enlarge_row,
        claim_overflow,
        lambda _, runs: claim_runs(len(runs), 0xFFFFFFFF, 0),
        lambda _, runs: claim_runs(len(runs), 0xFFFFFFFF, 1456),
    ],
    ids=["row", "overflow", "empty packets", "many packets"],
)
def test_a_packet_log_that_claims_too_much_is_refused(scan, change):
    board = next(iter(scan.committed_rows()[0].boards.values()))
    path = (scan.path / board.file).with_suffix(PACKETS_SUFFIX)
    line, _, tail = path.read_bytes().partition(b"\n")
    head = json.loads(line)
    batches_end = 16 * head["batches"]
    end = 16 * head["batches"] + RUN.itemsize * head["runs"]
    runs = change(head, np.frombuffer(tail[batches_end:end], RUN))
    path.write_bytes(json.dumps(head).encode() + b"\n" + tail[:batches_end] + runs.tobytes() + tail[end:])
    with expect_refusal(ErrorCode.FILE_DAMAGED):
        read_packets(path, np.fromfile(scan.path / board.file, dtype=np.uint8))


LINKS = ["manifest.jsonl", "events.msgpack", "raw/RH/0000.bin", "raw/RH/9999.idx", "samples", ".products.new", "x.part"]


@pytest.mark.parametrize("name", LINKS)
def test_a_scan_with_a_link_out_of_it_is_refused_before_anything_is_read_or_written(scan, tmp_path, name):
    victim = tmp_path / "victim"
    link = scan.path / name
    victim.mkdir()
    (victim / "mine.txt").write_text("mine")
    target = victim
    if link.exists() and link.is_file():
        target = link.rename(victim / "theirs")
    contents_before = {p: p.read_bytes() for p in victim.iterdir()}
    link.symlink_to(target)
    out = ["--out", str(tmp_path / "out")]
    for command in (["resume"], ["process", *out], ["drop-raw", "--yes"], ["validate", "--replace"], ["focus", *out]):
        assert main([command[0], str(scan.path), *command[1:]]) != 0
    assert {p: p.read_bytes() for p in victim.iterdir()} == contents_before


def test_links_within_a_scan_and_of_its_products_folder_are_allowed(scan, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (scan.path / "products").symlink_to(tmp_path / "elsewhere")
    (scan.path / "note").symlink_to("manifest.jsonl")
    assert ScanFolder.load(scan.path).committed_rows()


def test_a_pipe_in_a_scan_is_refused(scan):
    os.mkfifo(scan.path / "raw" / "pipe")
    with expect_refusal(ErrorCode.FILE_FOREIGN, "raw/pipe"):
        ScanFolder.load(scan.path)


def test_the_target_of_a_link_is_not_emptied_for_new_products(tmp_path):
    victim = tmp_path / "victim"
    out = tmp_path / "products"
    (victim / "folder").mkdir(parents=True)
    (tmp_path / ".products.new").symlink_to(victim)
    with pytest.raises(PolysightError), replace_products(out, "scan"):
        pass
    assert (victim / "folder").is_dir()


@pytest.mark.parametrize("write", [write_atomically, write_durably], ids=["products", "rows"])
def test_nothing_is_written_through_a_link(write, tmp_path):
    victim = tmp_path / "victim"
    victim.write_bytes(b"mine")
    (tmp_path / "there").symlink_to(victim)
    (tmp_path / ".there.part").symlink_to(victim)
    # It is an error, or the link itself is replaced.
    with suppress(OSError, DeviceError):
        write(tmp_path / "there", b"theirs")
    assert victim.read_bytes() == b"mine"


def rewrite_first_line(scan: ScanFolder, **answer: object) -> Path:
    """Change fields of the first line of the manifest; return the scan's folder."""
    first, *rest = (scan.path / "manifest.jsonl").read_bytes().splitlines(keepends=True)
    fact = {**manifest.decode_line(first.rstrip()), **answer}
    (scan.path / "manifest.jsonl").write_bytes(manifest.encode_line(fact) + b"".join(rest))
    return scan.path


@pytest.mark.parametrize("file", ["../hpf.toml", "/etc/passwd"])
def test_calibration_outside_the_scan_is_not_read(scan, file):
    answer = {"hpf": {"file": file, "crc32": "0", "copied_from": ""}}
    with expect_refusal(ErrorCode.PATH_OUTSIDE):
        load_scan_calibration(ScanFolder.load(rewrite_first_line(scan, calibration=answer)))


def test_a_rig_file_in_a_manifest_names_no_calibration_elsewhere(scan):
    rig = load_facts(scan)[0]["instrument"]
    with expect_refusal(ErrorCode.PATH_OUTSIDE):
        load_scan_calibration(
            ScanFolder.load(
                rewrite_first_line(scan, instrument={**rig, "calibration": {"hpf": "/etc/passwd"}}, calibration=None)
            )
        )


@pytest.mark.parametrize("answer", ["text", ["a"], {"hpf": "a"}, {"hpf": {"file": 3}}])
def test_a_manifest_with_another_form_of_calibration_is_refused(scan, answer):
    with expect_refusal(ErrorCode.FILE_DAMAGED, "manifest.jsonl"):
        load_scan_calibration(ScanFolder.load(rewrite_first_line(scan, calibration=answer)))


def test_a_row_that_is_larger_than_was_committed_is_refused_by_its_size(scan):
    name, board = next(iter(scan.committed_rows()[0].boards.items()))
    # A sparse file of 4 TB, which takes no space on the disk.
    os.truncate(scan.path / board.file, 1 << 42)
    with expect_refusal(ErrorCode.FILE_DAMAGED, 1 << 42):
        _ = scan.read_row(name, 0).payload
    assert board.file in str(find_droppable(scan, {name: {0: board.crc32}}).kept_files)


@pytest.mark.parametrize("file", ["manifest.jsonl", "raw/{board}/0000.idx", "raw/{board}/0000.pkt"])
def test_files_of_any_size_are_refused_before_they_are_read(scan, file):
    board = next(iter(scan.committed_rows()[0].boards))
    path = scan.path / file.format(board=board)
    os.truncate(path, 1 << 42)
    for use in (manifest.read, read_index, lambda path: read_packets(path, np.zeros(8, np.uint8))):
        with pytest.raises(DataError):
            use(path)


# Text that a recursive decoder cannot read.
DEEP = "[" * 100_000


@pytest.mark.parametrize(
    "read", [read_index, read_truth, read_labels, read_settings_json, lambda p: ProcessedScan(p.parent).quality]
)
def test_json_that_is_nested_too_deeply_is_refused(read, tmp_path):
    (tmp_path / "quality.json").write_text(DEEP)
    with pytest.raises(DataError):
        read(tmp_path / "quality.json")
    assert manifest.decode_line(DEEP.encode()) is None


def test_toml_that_is_nested_too_deeply_is_refused(tmp_path):
    (tmp_path / "rig.toml").write_text(f"a = {DEEP}")
    with pytest.raises(ConfigError):
        load_instrument(tmp_path / "rig.toml")


def test_a_netcdf_file_that_claims_too_much_is_refused_by_its_size(tmp_path):
    with h5py.File(tmp_path / "big.nc", "w") as f:
        f.create_dataset("h_real", shape=(1 << 20, 1 << 20), dtype="f4", chunks=(1024, 1024), compression="gzip")
    assert (tmp_path / "big.nc").stat().st_size < 1 << 20
    with expect_refusal(ErrorCode.FILE_TOO_LARGE):
        read_netcdf(tmp_path / "big.nc")


def link_external(f: h5py.File) -> None:
    f.create_dataset("h", (4,), "u1", external=[("/etc/passwd", 0, 4)])


def link_folder(f: h5py.File) -> None:
    f["h"] = h5py.ExternalLink("/etc/other.h5", "/h")


@pytest.mark.parametrize("make", [link_external, link_folder])
def test_a_netcdf_file_with_arrays_in_other_files_is_refused(make, tmp_path):
    with h5py.File(tmp_path / "a.nc", "w") as f:
        make(f)
    with expect_refusal(ErrorCode.PATH_OUTSIDE):
        read_netcdf(tmp_path / "a.nc")


def test_a_pickle_whose_lists_are_one_list_is_refused_by_its_size(tmp_path):
    row = [1.0] * 1000
    shared_list = [np.ones(1, np.complex64)] * 3
    content = {"values": [[row] * 1000] * 3, "ref_values": shared_list, "name": "a", "incident_angle": 55.0}
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({**content, "collection_name": "s", "ref_name": "m"}))
    with pytest.raises(DataError):
        read_material(tmp_path / "a.pkl")
