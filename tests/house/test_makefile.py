"""The Makefile takes folders with spaces, and removes none that it did not make."""

import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
from tests.support.paths import REPO

PROJECTS = ("shared", "pi_controller", "simulators", "host", "papers", "worlds")


@pytest.fixture
def make(tmp_path: Path):
    """Runs `make` in a folder with a space in its name, with an environment; gives status and output."""
    folder = tmp_path / "my copy"
    folder.mkdir()
    shutil.copy(REPO / "Makefile", folder)
    # What an environment is made from, older than the environment.
    sources = [f"{project}/pyproject.toml" for project in PROJECTS]
    for name in (*sources, "pyproject.toml", "host/polysight/sync/build.py", "host/setup.py"):
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
def test_a_folder_for_results_may_have_spaces(make, target):
    status, output = make("-n", target, "OUT=my out", "HOST=pi@polysight")
    assert status == 0, output
    lines = [line for line in output.splitlines() if "my out" in line and "grep" not in line]
    assert lines
    for line in lines:
        words = shlex.split(line.rstrip("\\"), comments=True)
        # No word begins or ends within the name.
        assert not any(word in ("my", "out") or word.startswith("out/") for word in words), line


def test_an_environment_with_spaces_is_refused_before_anything_is_removed(make):
    for name in ("a", "b"):
        (make.folder / name).mkdir()
    status, output = make("clean", "VENV=a b")
    assert (status, "without spaces" in output) == (2, True)
    assert (make.folder / "a").is_dir()
    assert (make.folder / "b").is_dir()


def test_clean_removes_an_environment_and_no_other_folder(make):
    (make.folder / "results").mkdir()
    assert make("clean", "VENV=results")[0] == 0
    assert (make.folder / "results").is_dir()
    (make.folder / ".venv" / "pyvenv.cfg").touch()
    assert make("clean")[0] == 0
    assert not (make.folder / ".venv").exists()


def test_an_installation_on_no_pi_is_refused_before_the_tools_are_installed(make):
    (make.folder / ".venv" / "installed").unlink()
    status, output = make("pi-install")
    assert (status, "HOST=user@address" in output, "installing" in output) == (2, True, False)


def test_without_git_no_file_is_said_to_be_unchanged(make):
    output = make("-n", "quick", "GIT_DIR=none")[1]
    assert "without git none are checked" in output


@pytest.mark.parametrize("target", ["quick", "check"])
def test_an_environment_of_another_name_is_used_and_not_checked(make, target):
    (make.folder / ".venv").rename(make.folder / "env")
    output = make("-n", target, "VENV=env", "CHANGED=a.py")[1]
    for line in output.splitlines():
        words = shlex.split(line, comments=True)
        if words[:1] == ["env/bin/ruff"]:
            assert 'extend-exclude = ["build", "env"]' in words
        if "env/bin/pyright" in words:
            assert words[words.index("--pythonpath") + 1] == "env/bin/python"
    assert output.count("env/bin/ruff") == 2
    assert "env/bin/pyright" in output
