"""Layout of the repository: six projects with one version, each a folder with one package; no symbolic links."""

import importlib
import subprocess
import tomllib
from importlib.metadata import PackageNotFoundError, PackagePath, distribution
from pathlib import Path

import pytest

from polysight_shared import __version__

ROOT = Path(__file__).parents[2]
PROJECTS = {
    "shared": "polysight_shared",
    "pi_controller": "polysight_pi",
    "simulators": "polysight_simulators",
    "host": "polysight",
    "papers": "polysight_papers",
    "worlds": "polysight_worlds",
}


# File mode of a symbolic link in git's index
LINK_MODE = "120000"


def test_the_repository_has_no_symbolic_links():
    listed = subprocess.run(["git", "ls-files", "-s"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout: the files of the project are not known")
    assert [line for line in listed.stdout.splitlines() if line.startswith(LINK_MODE)] == []


@pytest.mark.parametrize(("folder", "package"), PROJECTS.items())
def test_a_project_has_one_package(folder, package):
    packages = {p.parent.name for p in (ROOT / folder).glob("*/__init__.py")}
    assert packages == {package}
    # The host's setup.py compiles its loops in C; other projects have no module outside of the package.
    if folder != "host":
        assert not list((ROOT / folder).glob("*.py"))


@pytest.mark.parametrize("folder", PROJECTS)
def test_all_projects_have_one_version(folder):
    project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["version"] == __version__
    our_dependencies = [d for d in project["dependencies"] if d.startswith("polysight")]
    assert all(d.endswith(f"=={__version__}") for d in our_dependencies)


@pytest.mark.parametrize("folder", PROJECTS)
def test_every_command_and_entry_point_of_a_project_names_a_function(folder):
    """The names are text in pyproject.toml, so that only this test notices when a function is renamed."""
    project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    targets = list(project.get("scripts", {}).values())
    for group in project.get("entry-points", {}).values():
        targets.extend(group.values())
    for target in targets:
        module, _, function = target.partition(":")
        assert callable(getattr(importlib.import_module(module), function, None)), target


def test_an_editable_installation_is_a_path_file():
    """Type checkers and editors read path files, but run no import hooks: with a hook they would find no package."""
    for folder in PROJECTS:
        name = tomllib.loads((ROOT / folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]["name"]
        try:
            files: list[PackagePath] = distribution(name).files or []
        except PackageNotFoundError:
            files = []
        path_files = [f for f in files if f.suffix == ".pth"]
        if not path_files:
            pytest.skip("the projects are not installed in place: `make test` does that")
        path = path_files[0].read_text(encoding="utf-8").strip()
        assert Path(path).resolve() == ROOT / folder


def test_the_host_raises_the_error_class_of_the_shared_package():
    """If a second copy of the shared package were imported, `except PolysightError` would miss the host's errors."""
    import polysight
    from polysight.store import ScanFolder
    from polysight_shared.errors import PolysightError

    with pytest.raises(PolysightError):
        ScanFolder.load(Path("/no/such/scan"))
    assert polysight.__version__ == __version__
