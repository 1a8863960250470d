"""Pages of the documentation that error messages name exist, in the repository and in the installed package."""

import ast
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from polysight_shared.errors import DataError, expand_paths

REPO = Path(__file__).resolve().parents[2]
PAGE = re.compile(r"docs/[\w/-]+\.md")


def test_every_page_that_the_code_names_exists():
    named_pages = set()
    for package in ("host", "shared", "simulators", "papers"):
        for path in (REPO / package).rglob("*.py"):
            named_pages |= set(PAGE.findall(path.read_text(encoding="utf-8")))
    assert named_pages
    for page in sorted(named_pages):
        assert (REPO / page).exists(), page


def test_an_error_points_to_a_page_of_this_installation():
    text = str(DataError("x", "y", "see docs/how-to/install.md, or docs/spec/no-such-page.txt"))
    (page,) = re.findall(r"\S+\.md", text)
    assert Path(page).is_absolute()
    assert Path(page).exists()


@pytest.mark.parametrize("text", ["http://x/docs/how-to/install.md", "/a/docs/how-to/install.md"])
def test_a_page_in_a_web_address_or_in_an_absolute_path_is_not_changed(text):
    assert expand_paths(text) == text


def test_the_installed_package_contains_the_pages(tmp_path, monkeypatch):
    """Of setup.py only the function `copy_data` is run: the other lines would build the package."""
    monkeypatch.chdir(REPO / "host")
    tree = ast.parse(Path("setup.py").read_text(encoding="utf-8"))
    (function,) = [node for node in tree.body if getattr(node, "name", "") == "copy_data"]
    variables: dict[str, Any] = {"Path": Path, "shutil": shutil, "TOP": Path("..")}
    code = compile(ast.Module([function], type_ignores=[]), "setup.py", "exec")
    exec(code, variables)
    variables["copy_data"](tmp_path)
    assert (tmp_path / "docs" / "how-to" / "install.md").exists()
    assert (tmp_path / "instrument.toml").exists()
