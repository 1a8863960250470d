"""Errors of files name the file."""

import errno
import os
import re
from pathlib import Path

import pytest

from polysight_shared.files import name_in_errors, read_json, write_atomically


@pytest.mark.parametrize(("path_of_error", "shown_path"), [(None, "ours"), ("theirs", "theirs")])
def test_an_error_without_a_path_gets_one_and_one_with_a_path_keeps_it(tmp_path, path_of_error, shown_path):
    path = None if path_of_error is None else str(tmp_path / path_of_error)
    with pytest.raises(OSError, match="No space left") as caught, name_in_errors(tmp_path / "ours"):
        raise OSError(errno.ENOSPC, "No space left on device", path)
    assert caught.value.filename == str(tmp_path / shown_path)


def test_an_error_names_the_file_that_stands_where_a_folder_is_needed(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=re.escape(str(tmp_path / "file"))):
        write_atomically(tmp_path / "file" / "new", b"")
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


@pytest.mark.parametrize("place", [".", "..", "/", "folder", "link"])
def test_an_error_names_the_folder_that_stands_where_a_file_is_written(tmp_path, monkeypatch, place):
    """A file is first written under a temporary name next to the path. `.` and `/` have no name to make one from."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to("folder")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(IsADirectoryError) as caught:
        write_atomically(Path(place), b"new")
    assert caught.value.filename == place
    assert {path.name for path in tmp_path.iterdir()} == {"folder", "link"}


def test_a_pipe_is_not_replaced_by_a_file(tmp_path):
    """The same check protects /dev/null from a user who has the right to replace it."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="a device or a pipe"):
        write_atomically(tmp_path / "pipe", b"new")
    assert [path.name for path in tmp_path.iterdir()] == ["pipe"]
    assert (tmp_path / "pipe").is_fifo()


def test_errors_name_the_file_and_not_its_temporary_copy(tmp_path, monkeypatch):
    def fail(part: Path, path: Path) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted", str(part), None, str(path))

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(PermissionError) as caught:
        write_atomically(tmp_path / "mine", b"new")
    assert (caught.value.filename, caught.value.filename2) == (str(tmp_path / "mine"), None)


def test_json_that_begins_with_a_byte_order_mark_is_read(tmp_path):
    """Editors of Windows write one; Python's name of the encoding is utf-8-sig."""
    (tmp_path / "labels.json").write_text('{"a": 1}', encoding="utf-8-sig")
    assert read_json(tmp_path / "labels.json") == {"a": 1}
