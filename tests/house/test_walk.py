"""docs/architecture.md is the way from a packet to a name: every stop exists, and a scan passes them in order."""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path
from types import FrameType

import pytest

ROOT = Path(__file__).parents[2]
ROW = re.compile(r"^\| (\d+) \| [^|]+ \| `([^`]+)` \| `([^`]+)` \|$")
PROCESSED_FROM = 6
"""The first stop of processing; before it come the processes of a scan, which tests/e2e runs."""


def stops() -> list[tuple[int, Path, str]]:
    lines = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").splitlines()
    return [(int(m[1]), ROOT / m[2], m[3]) for m in map(ROW.match, lines) if m]


def functions(file: Path) -> set[str]:
    """Names of functions, methods as `Class.method`."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    found = {n.name for n in tree.body if isinstance(n, ast.FunctionDef)}
    for c in (n for n in tree.body if isinstance(n, ast.ClassDef)):
        found |= {f"{c.name}.{n.name}" for n in c.body if isinstance(n, ast.FunctionDef)}
    return found


def test_there_are_at_most_twelve_and_they_are_numbered():
    assert [n for n, _, _ in stops()] == list(range(1, len(stops()) + 1))
    assert 1 < len(stops()) <= 12


@pytest.mark.parametrize(("file", "name"), [(f, n) for _, f, n in stops()], ids=lambda v: getattr(v, "name", v))
def test_every_stop_is_a_file_and_a_function(file, name):
    assert name in functions(file)


def test_a_scan_passes_the_stops_in_their_order(tmp_path):
    from polysight.jobs.process import process
    from polysight_simulators.__main__ import main

    scan = tmp_path / "scan"
    command = ["simulate", str(ROOT / "examples" / "own-scene.toml"), "--config", str(ROOT / "instrument.toml")]
    assert main([*command, "--out", str(scan)]) == 0
    wanted = {(str(file), name.rpartition(".")[2]): n for n, file, name in stops() if n >= PROCESSED_FROM}
    passed: list[int] = []

    def look(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            code = frame.f_code
            stop = wanted.get((str(Path(code.co_filename).resolve()), code.co_name)) if code.co_name in names else None
            if stop is not None and stop not in passed:
                passed.append(stop)

    names = {name for _, name in wanted}
    sys.setprofile(look)
    try:
        assert process(scan, tmp_path / "out", threads=1) == 0
    finally:
        sys.setprofile(None)
    assert passed == sorted(wanted.values())
