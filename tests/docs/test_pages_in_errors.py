"""Pages that errors name exist, in the repository and in the installed package."""

import ast
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from polysight_shared.errors import DataError, expand_paths

REPO = Path(__file__).resolve().parents[2]
PAGE = re.compile(r"docs/[\w/-]+\.md")


def test_every_page_that_the_code_names_is_there():
    sources = [path for room in ("host", "shared", "simulators", "papers") for path in (REPO / room).rglob("*.py")]
    named = {page for path in sources for page in PAGE.findall(path.read_text(encoding="utf-8"))}
    assert named
    assert [page for page in sorted(named) if not (REPO / page).exists()] == []


def test_an_error_points_to_a_page_of_this_installation():
    text = str(DataError("x", "y", "see docs/how-to/install.md, or docs/spec/no-such-page.txt"))
    (page,) = re.findall(r"\S+\.md", text)
    assert Path(page).is_absolute()
    assert Path(page).exists()


@pytest.mark.parametrize("text", ["http://x/docs/how-to/install.md", "/a/docs/how-to/install.md"])
def test_whole_paths_and_addresses_are_not_changed(text):
    assert expand_paths(text) == text


def test_a_wheel_holds_the_pages(tmp_path, monkeypatch):
    """Only the function `copy_data` of setup.py is run: the rest of that file would build the wheel."""
    monkeypatch.chdir(REPO / "host")
    tree = ast.parse(Path("setup.py").read_text(encoding="utf-8"))
    function = next(node for node in tree.body if getattr(node, "name", "") == "copy_data")
    names: dict[str, Any] = {"Path": Path, "shutil": shutil, "TOP": Path("..")}
    exec(compile(ast.Module([function], []), "setup.py", "exec"), names)
    names["copy_data"](tmp_path)
    assert (tmp_path / "docs" / "how-to" / "install.md").exists()
    assert (tmp_path / "instrument.toml").exists()
