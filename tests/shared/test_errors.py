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
    """A shell would not find the scan `my scans/one` by the command `polysight resume my scans/one`.

    The sources are searched for commands with a value in braces that is not quoted; names of commands need no quotes.
    """
    command_without_quotes = re.compile(r"polysight (?:[a-z-]+)(?: --out)? \{(?!quote\(|name|kind)[^}]*\}")
    # Its texts are templates: page/status.py fills in paths that it has quoted.
    templates = Path("acquisition/states.py")
    package = Path(polysight.__file__).parent
    sources = [path for path in package.rglob("*.py") if path.relative_to(package) != templates]
    # The package was found: it has more than a hundred files.
    assert len(sources) > 100
    unquoted = [
        f"{path.name}: {match[0]}" for path in sources for match in command_without_quotes.finditer(path.read_text())
    ]
    assert not unquoted
