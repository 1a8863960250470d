"""Laws of the roof: six projects, each a folder with its package inside; no links, one import name for each class."""

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


def test_the_repository_has_no_links():
    listed = subprocess.run(["git", "ls-files", "-s"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout: the files of the project are not known")
    assert [line for line in listed.stdout.splitlines() if line.startswith("120000")] == []


@pytest.mark.parametrize(("folder", "package"), PROJECTS.items())
def test_a_project_holds_its_one_package(folder, package):
    packages = {p.parent.name for p in (ROOT / folder).glob("*/__init__.py")}
    assert packages == {package}
    # setup.py
    assert not list((ROOT / folder).glob("*.py")) or folder == "host"


@pytest.mark.parametrize("folder", PROJECTS)
def test_all_projects_have_one_version(folder):
    project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["version"] == __version__
    our_dependencies = [d for d in project["dependencies"] if d.startswith("polysight")]
    assert all(d.endswith(f"=={__version__}") for d in our_dependencies)


@pytest.mark.parametrize("folder", PROJECTS)
def test_every_program_and_entry_point_of_a_project_exists(folder):
    """The names are text, so that only this test notices a renamed function."""
    project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    targets = list(project.get("scripts", {}).values())
    for group in project.get("entry-points", {}).values():
        targets.extend(group.values())
    for target in targets:
        module, _, function = target.partition(":")
        assert callable(getattr(importlib.import_module(module), function, None)), target


def test_an_editable_installation_is_a_path_that_editors_follow():
    """No import hook: type checkers do not run hooks."""
    for folder in PROJECTS:
        name = tomllib.loads((ROOT / folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]["name"]
        try:
            files: list[PackagePath] = distribution(name).files or []
        except PackageNotFoundError:
            files = []
        pth = [f for f in files if f.suffix == ".pth"]
        if not pth:
            pytest.skip("the projects are not installed in place: `make test` does that")
        assert Path(pth[0].read_text(encoding="utf-8").strip()).resolve() == ROOT / folder


def test_an_error_is_one_class_wherever_it_is_imported_from():
    import polysight
    from polysight.store import ScanFolder
    from polysight_shared.errors import PolysightError

    with pytest.raises(PolysightError):
        ScanFolder.load(Path("/no/such/scan"))
    assert polysight.__version__ == __version__
