"""A folder of products is replaced atomically: after any failure it holds the old products or the new ones."""

import errno
import fcntl
import os
import shutil
from contextlib import suppress
from pathlib import Path

import pytest
from tests.support.refusals import expect_refusal

from polysight.products import folder as products_folder, write_json
from polysight.products.folder import check_products_folder, replace_products
from polysight_shared.errors import DataError, DeviceError, ErrorCode

OLD = {"image.npz": b"old", "report.html": b"old page", "figures/h.png": b"old h", "figures/p.png": b"old p"}
NEW = {"image.npz": b"new", "quality.json": b"{}", "figures/h.png": b"new h"}
SCAN_ID = "s"


def write(folder: Path, files: dict[str, bytes]) -> None:
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def read(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def replace(out: Path) -> None:
    with replace_products(out, SCAN_ID) as new:
        write(new, NEW)


@pytest.fixture
def out(tmp_path) -> Path:
    write(tmp_path / "one", OLD)
    return tmp_path / "one"


@pytest.fixture(params=["one step", "two steps"])
def exchange(request, monkeypatch):
    """How two folders are swapped: in one atomic step, or in two on file systems without it."""
    if request.param == "two steps":
        monkeypatch.setattr(products_folder, "_exchange", lambda *_: False)
    return request.param


@pytest.mark.usefixtures("exchange")
def test_new_products_replace_all_old_files(out):
    replace(out)
    assert read(out) == NEW
    assert list(out.parent.iterdir()) == [out]
    replace(out.parent / "deeper" / "two")
    assert read(out.parent / "deeper" / "two") == NEW


@pytest.mark.parametrize(
    "error", [DataError("x"), OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()]
)
def test_an_error_leaves_the_old_products(out, error):
    def fail(new: Path) -> None:
        write(new, NEW)
        raise error

    with pytest.raises(type(error)), replace_products(out, SCAN_ID) as new:
        fail(new)
    assert read(out) == OLD
    assert list(out.parent.iterdir()) == [out]


class Killed(BaseException):
    """Raised in place of the program's end."""


# An exchange has fewer than 20 steps: in the last cases nothing is killed.
@pytest.mark.parametrize("step", range(20))
def test_after_a_kill_at_any_step_the_next_run_finds_old_or_new_products(out, exchange, step, monkeypatch):
    """With an atomic swap the folder holds old or new products at every moment, otherwise from the next run on."""
    steps_done = 0

    def count_step(call):
        """The same function; each call is a step, and the program is killed once `step` of them were done."""

        def call_or_die(*args, **kwargs):
            nonlocal steps_done
            if steps_done == step:
                raise Killed
            steps_done += 1
            return call(*args, **kwargs)

        return call_or_die

    with monkeypatch.context() as patched, suppress(Killed):
        for owner, name in (
            (Path, "mkdir"), (Path, "rename"), (Path, "write_bytes"), (Path, "unlink"), (shutil, "rmtree"),
            (products_folder, "_exchange"), (products_folder, "sync_folder"), (fcntl, "flock"),
        ):  # fmt: skip
            patched.setattr(owner, name, count_step(getattr(owner, name)))
        replace(out)
    if exchange == "one step":
        assert read(out) in (OLD, NEW)
    # The next run only looks at the folder. It ends with an error, so that it replaces nothing.
    found_by_next_run = {}
    with suppress(DataError), replace_products(out, SCAN_ID):
        found_by_next_run = read(out)
        raise DataError("only looked")
    assert found_by_next_run in (OLD, NEW)
    replace(out)
    assert read(out) == NEW
    assert list(out.parent.iterdir()) == [out]


@pytest.mark.usefixtures("exchange")
def test_hidden_files_of_other_programs_are_kept(out):
    """The settings of the old products (.finished.json) and a half-written file (.part) are not of other programs."""
    write(out, {".gitignore": b"*", ".finished.json": b"{}", ".image.npz.part": b"torn"})
    replace(out)
    assert read(out) == {**NEW, ".gitignore": b"*"}


def test_a_second_program_is_refused(out):
    with replace_products(out, SCAN_ID) as new:
        write(new, NEW)
        with expect_refusal(ErrorCode.BUSY, out):
            replace(out)
    assert read(out) == NEW


def test_a_link_stays_a_link(out):
    link = out.with_name("latest")
    link.symlink_to("one")
    replace(link)
    assert link.is_symlink()
    assert read(out) == NEW


def test_a_folder_that_must_not_be_replaced_is_refused(out, monkeypatch):
    write(out.parent / "thesis", {"thesis.tex": b"precious"})
    with expect_refusal(ErrorCode.FILE_EXISTS, "thesis.tex"):
        check_products_folder(out.parent / "thesis", SCAN_ID)
    for path in (out / "image.npz", out / "image.npz" / "deeper"):
        with expect_refusal(ErrorCode.FILE_UNREADABLE, path):
            check_products_folder(path, SCAN_ID)
    with monkeypatch.context() as mounted:
        mounted.setattr(Path, "is_mount", lambda path: path == out)
        with expect_refusal(ErrorCode.VALUE_INVALID, out):
            check_products_folder(out, SCAN_ID)
    monkeypatch.chdir(out)
    with expect_refusal(ErrorCode.VALUE_INVALID):
        check_products_folder(Path(), SCAN_ID)


def test_products_of_a_scan_whose_raw_data_was_deleted_are_not_replaced_by_those_of_another(out):
    """Such products cannot be made again: `raw_dropped` says when the raw data of which scan was deleted."""
    write_json(out / "quality.json", {"raw_dropped": {"scan_id": "first", "dropped_utc": "2026-01-02T03:04:05"}})
    contents_before = read(out)
    with expect_refusal(ErrorCode.NAME_TAKEN, "first", "2026-01-02"), replace_products(out, "second"):
        pytest.fail("it began")
    assert read(out) == contents_before
    # The same scan, processed from a copy that has its raw rows, may replace them.
    with replace_products(out, "first") as new:
        write(new, NEW)
    assert read(out) == NEW


def test_products_that_cannot_replace_the_old_ones_are_kept_and_named(out, monkeypatch):
    def fail_as_busy(*_):
        raise OSError(errno.EBUSY, os.strerror(errno.EBUSY))

    monkeypatch.setattr(products_folder, "_exchange", fail_as_busy)
    with pytest.raises(DeviceError) as caught:
        replace(out)
    unfinished_folder = out.with_name(".one.new")
    assert str(unfinished_folder) in caught.value.remedy
    assert (read(unfinished_folder), read(out)) == (NEW, OLD)
