"""Errors of files name the file."""

import errno
import re

import pytest

from polysight_shared.files import name_in_errors, write_atomically


@pytest.mark.parametrize(("known", "shown"), [(None, "mine"), ("theirs", "theirs")])
def test_an_error_without_a_path_gets_one_and_keeps_its_own(tmp_path, known, shown):
    with pytest.raises(OSError, match="No space left") as caught, name_in_errors(tmp_path / "mine"):
        raise OSError(errno.ENOSPC, "No space left on device", known and str(tmp_path / known))
    assert caught.value.filename == str(tmp_path / shown)


def test_a_file_in_the_place_of_a_folder_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match=re.escape(str(tmp_path / "file"))):
        write_atomically(tmp_path / "file" / "new", b"")
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]
