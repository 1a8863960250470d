"""Errors of files name the file."""

import errno
import os
import re
from pathlib import Path

import pytest

from polysight_shared.files import name_in_errors, read_json, write_atomically


@pytest.mark.parametrize(("known_path", "shown_path"), [(None, "mine"), ("theirs", "theirs")])
def test_an_error_without_a_path_gets_one_and_keeps_its_own(tmp_path, known_path, shown_path):
    with pytest.raises(OSError, match="No space left") as caught, name_in_errors(tmp_path / "mine"):
        raise OSError(errno.ENOSPC, "No space left on device", known_path and str(tmp_path / known_path))
    assert caught.value.filename == str(tmp_path / shown_path)


def test_a_file_in_the_place_of_a_folder_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=re.escape(str(tmp_path / "file"))):
        write_atomically(tmp_path / "file" / "new", b"")
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


@pytest.mark.parametrize("place", [".", "..", "/", "folder", "link"])
def test_a_folder_in_the_place_of_a_file_is_named(tmp_path, monkeypatch, place):
    """`.` and `/` have no name that a file beside them could have."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to("folder")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(IsADirectoryError) as caught:
        write_atomically(Path(place), b"new")
    assert caught.value.filename == place
    assert {path.name for path in tmp_path.iterdir()} == {"folder", "link"}


def test_a_pipe_is_not_replaced_by_a_file(tmp_path):
    """Nor is /dev/null, by a user who may."""
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


def test_json_of_an_editor_that_marks_the_order_of_bytes_is_read(tmp_path):
    (tmp_path / "labels.json").write_text('{"a": 1}', encoding="utf-8-sig")
    assert read_json(tmp_path / "labels.json") == {"a": 1}
