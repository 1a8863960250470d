"""Commands in errors can be pasted into a shell."""

import re
import shlex
from pathlib import Path

import pytest

import polysight
from polysight_shared.errors import quote


@pytest.mark.parametrize("path", ["one", "sp ace/one", "it's", "a$b`c`", "~", "x;rm", "", "-one", "\u00fcn\u00ef"])
def test_a_quoted_path_is_one_word_of_a_shell_and_no_option(path):
    expected = f"./{path}" if path.startswith("-") else path
    assert shlex.split(f"polysight validate {quote(path)}") == ["polysight", "validate", expected]


def test_a_path_in_a_command_that_is_advised_is_quoted():
    """A scan in `my scans/one`: `polysight resume my scans/one` would not find it."""
    command = re.compile(r"polysight (?:[a-z-]+)(?: --out)? \{(?!quote\(|name|kind)[^}]*\}")
    table = Path("acquisition/states.py")  # filled in by page/status.py
    package = Path(polysight.__file__).parent
    sources = [path for path in package.rglob("*.py") if path.relative_to(package) != table]
    assert len(sources) > 100
    unquoted = [f"{path.name}: {match[0]}" for path in sources for match in command.finditer(path.read_text())]
    assert not unquoted
