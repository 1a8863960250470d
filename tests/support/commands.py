"""Commands of the host, run in this process."""

from __future__ import annotations

import json
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from polysight.host.cli.main import main


def told_by(*arguments: object) -> str:
    """What a command of the host says; it must succeed."""
    said = StringIO()
    with redirect_stdout(said):
        assert main([str(word) for word in arguments]) == 0
    return said.getvalue()


def content(path: Path) -> dict[str, Any]:
    """Of a JSON file."""
    return json.loads(path.read_text(encoding="utf-8"))
