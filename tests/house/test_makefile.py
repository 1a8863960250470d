"""The Makefile accepts folders with spaces in their names, and removes no folder that it has not made."""

import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
from tests.support.paths import REPO

# Exit status of GNU make after a failed command
MAKE_FAILED = 2
PROJECTS = ("shared", "pi_controller", "simulators", "host", "papers", "worlds")


@pytest.fixture
def make(tmp_path: Path):
    """A function that runs `make` in a folder with a space in its name (`make.folder`), which has an environment.

    It returns make's exit status and its output. With the option `-n` make only prints the commands.
    """
    folder = tmp_path / "my copy"
    folder.mkdir()
    shutil.copy(REPO / "Makefile", folder)
    # The files from which make builds the environment are older than it, so that it is up to date.
    project_files = [f"{project}/pyproject.toml" for project in PROJECTS]
    for name in (*project_files, "pyproject.toml", "host/polysight/sync/build.py", "host/setup.py"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    (folder / ".venv").mkdir()
    (folder / ".venv" / "installed").touch()

    def make(*words: str) -> tuple[int, str]:
        run = subprocess.run(["make", *words], cwd=folder, capture_output=True, text=True, check=False)
        return run.returncode, run.stdout + run.stderr

    make.folder = folder
    return make


@pytest.mark.parametrize("target", ["demo", "bench", "reproduce", "docs", "wheels", "clean", "pi-install"])
def test_an_output_folder_may_have_a_space_in_its_name(make, target):
    status, output = make("-n", target, "OUT=my out", "HOST=pi@polysight")
    assert status == 0, output
    commands = [line for line in output.splitlines() if "my out" in line and "grep" not in line]
    assert commands
    for command in commands:
        words = shlex.split(command.rstrip("\\"), comments=True)
        # The shell must not split the name into two words.
        assert not any(word in ("my", "out") or word.startswith("out/") for word in words), command


def test_an_environment_with_a_space_in_its_name_is_refused_and_nothing_is_removed(make):
    for name in ("a", "b"):
        (make.folder / name).mkdir()
    status, output = make("clean", "VENV=a b")
    assert status == MAKE_FAILED
    assert "without spaces" in output
    assert (make.folder / "a").is_dir()
    assert (make.folder / "b").is_dir()


def test_clean_removes_an_environment_and_no_other_folder(make):
    (make.folder / "results").mkdir()
    status, _ = make("clean", "VENV=results")
    assert status == 0
    assert (make.folder / "results").is_dir()
    # This file shows that the folder is an environment of Python.
    (make.folder / ".venv" / "pyvenv.cfg").touch()
    status, _ = make("clean")
    assert status == 0
    assert not (make.folder / ".venv").exists()


def test_pi_install_without_a_host_is_refused_before_anything_is_installed(make):
    # Without this file make would install the environment first.
    (make.folder / ".venv" / "installed").unlink()
    status, output = make("pi-install")
    assert status == MAKE_FAILED
    assert "HOST=user@address" in output
    assert "installing" not in output


def test_quick_without_git_reports_that_no_types_are_checked(make):
    _, output = make("-n", "quick", "GIT_DIR=none")
    assert "without git none are checked" in output


@pytest.mark.parametrize("target", ["quick", "check"])
def test_checks_run_with_an_environment_of_another_name_and_exclude_its_files(make, target):
    (make.folder / ".venv").rename(make.folder / "env")
    _, output = make("-n", target, "VENV=env", "CHANGED=a.py")
    for line in output.splitlines():
        words = shlex.split(line, comments=True)
        if words[:1] == ["env/bin/ruff"]:
            assert 'extend-exclude = ["build", "env"]' in words
        if "env/bin/pyright" in words:
            assert words[words.index("--pythonpath") + 1] == "env/bin/python"
    # `ruff check` and `ruff format`
    assert output.count("env/bin/ruff") == 2
    assert "env/bin/pyright" in output
