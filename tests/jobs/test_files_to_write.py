"""Files that a command is asked to write: a name that cannot be used is refused before the work, not after it."""

from pathlib import Path

import pytest

from polysight.cli.main import main
from polysight.jobs import recordings, scans, train
from polysight.store import MANIFEST
from polysight_shared.errors import ConfigError, DataError, DeviceError


class WorkedError(Exception):
    """Raised in place of the work of a command."""


# Commands up to the option that names a file to write; tests add the name.
COMMANDS = {
    "train": ["train", "--simulate", "examples/library", "--out"],
    "train --authors": ["train", "--authors", "authors", "--out"],
    "compare": ["compare", "one", "two", "--png"],
    "check": ["check", "one", "--chart"],
    "inspect": ["inspect", "0000.bin", "--plot"],
    "doctor": ["doctor", "--config", "none.toml", "--bundle"],
}
# Those whose file is a picture
PICTURE_COMMANDS = ("compare", "check", "inspect")
# Exit statuses with which these commands refuse a file: wrong usage, wrong data, or an error of the system
REFUSALS = (ConfigError.exit_status, DataError.exit_status, DeviceError.exit_status)


@pytest.fixture(autouse=True)
def replace_work(monkeypatch) -> None:
    """Let the work of each command raise WorkedError."""

    def work(*_: object, **__: object) -> None:
        raise WorkedError

    for module, name in (
        (train, "check_scenes"),
        (train, "load_training_scan"),
        (scans, "compare"),
        (scans, "check_scans"),
        (recordings, "inspect_bin"),
    ):
        monkeypatch.setattr(module, name, work)
    monkeypatch.setattr("polysight_papers.sensys2026.dataset.read_authors", work)
    monkeypatch.setattr("polysight.doctor.checks.run_checks", work)


@pytest.fixture(autouse=True)
def make_paths_in_the_way(tmp_path: Path) -> None:
    """Make a folder with the name of a picture, and a file in which no other file can be."""
    (tmp_path / "folder.png").mkdir()
    (tmp_path / "file").touch()


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(("name", "name_in_the_way"), [("folder.png", "folder.png"), ("file/x.png", "file")])
def test_a_file_that_cannot_be_written_is_refused_before_the_work(tmp_path, capsys, command, name, name_in_the_way):
    assert main([*COMMANDS[command], str(tmp_path / name)]) in REFUSALS
    assert name_in_the_way in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder.png"]


@pytest.mark.parametrize(
    "command",
    [
        "sync-report nowhere",
        "focus nowhere",
        "surface nowhere",
        "calibrate hpf nowhere",
        "calibrate metal nowhere",
        "calibrate sphere nowhere --radius 100",
        "calibrate start-frequency nowhere",
        "calibrate direct-path nowhere --target nowhere.toml",
    ],
)
@pytest.mark.parametrize("name", ["file", "file/x"])
def test_a_folder_that_cannot_be_made_is_refused_before_the_data_are_read(tmp_path, capsys, command, name):
    assert main([*command.split(), "--out", str(tmp_path / name)]) == DeviceError.exit_status
    message = capsys.readouterr().err
    assert f"{tmp_path / 'file'}: Not a directory" in message
    assert "a file has the name of a folder" in message


@pytest.mark.parametrize("command", PICTURE_COMMANDS)
@pytest.mark.parametrize("name", ["x.jpg", "x.pdf", "x", "x.png.txt"])
def test_a_picture_whose_name_does_not_end_in_png_is_refused(tmp_path, capsys, command, name):
    with pytest.raises(SystemExit) as ended:
        main([*COMMANDS[command], str(tmp_path / name)])
    assert ended.value.code == ConfigError.exit_status
    assert "does not end in .png" in capsys.readouterr().err


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("name", ["new.png", "NEW.PNG", "file.png"])
def test_a_file_that_can_be_written_lets_the_work_begin(tmp_path, command, name):
    (tmp_path / "file.png").touch()
    with pytest.raises(WorkedError):
        main([*COMMANDS[command], str(tmp_path / name)])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "file.png", "folder.png"]


@pytest.mark.parametrize("command", ["surface", "focus", "sync-report"])
def test_results_are_not_written_among_recorded_rows(tmp_path, capsys, command):
    scan = tmp_path / "scan"
    scan.mkdir()
    (scan / MANIFEST).touch()
    assert main([command, str(scan), "--out", str(scan)]) == ConfigError.exit_status
    assert "recorded rows" in capsys.readouterr().err
    assert [path.name for path in scan.iterdir()] == [MANIFEST]
