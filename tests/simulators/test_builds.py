"""Folders of compiled programs, with and without the repository."""

from __future__ import annotations

from pathlib import Path

import pytest

from polysight_shared.errors import DeviceError
from polysight_simulators import builds
from polysight_simulators.uno import board


def _compile(source: Path) -> Path:
    return builds.compile_once("copy.txt", [source], ["cp", str(source), "{folder}/copy.txt"], ("", ""))


@pytest.fixture
def source(tmp_path: Path) -> Path:
    (tmp_path / "source.txt").write_text("content")
    return tmp_path / "source.txt"


def test_without_the_repository_programs_are_compiled_into_the_users_cache(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(builds, "FOLDER", tmp_path / "site-packages" / "arduino_stage" / "build")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    result = _compile(source)
    assert result.parent == tmp_path / "cache" / "polysight" / "build"
    assert result.read_text() == "content"
    assert not (tmp_path / "site-packages").exists()


def test_without_a_writable_home_the_temporary_folder_serves(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(builds, "FOLDER", tmp_path / "site-packages" / "arduino_stage" / "build")
    # A file
    monkeypatch.setenv("XDG_CACHE_HOME", str(source))
    monkeypatch.setattr(builds.tempfile, "tempdir", str(tmp_path))
    assert _compile(source).parent.parent == tmp_path


def test_without_the_sketch_the_stage_is_the_python_one_and_the_firmware_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (builds, board):
        monkeypatch.setattr(module, "SKETCH_DIR", tmp_path / "arduino_stage")
    assert builds.sketch_compiler() is None
    with pytest.raises(DeviceError):
        board.firmware()
