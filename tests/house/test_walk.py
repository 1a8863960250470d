"""docs/architecture.md lists the files from a packet to a name: each exists, and a scan calls them in order."""

import ast
import re
import sys
from pathlib import Path
from types import FrameType

import pytest

ROOT = Path(__file__).parents[2]
ROW = re.compile(r"^\| (\d+) \| [^|]+ \| `([^`]+)` \| `([^`]+)` \|$")
PROCESSED_FROM = 6
"""The first file of the processing; those before it run in the processes of a scan, which tests/e2e covers."""


def read_stops() -> list[tuple[int, Path, str]]:
    lines = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").splitlines()
    return [(int(m[1]), ROOT / m[2], m[3]) for m in map(ROW.match, lines) if m]


def list_functions(file: Path) -> set[str]:
    """Names of functions, methods as `Class.method`."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    names = {n.name for n in tree.body if isinstance(n, ast.FunctionDef)}
    for c in (n for n in tree.body if isinstance(n, ast.ClassDef)):
        names |= {f"{c.name}.{n.name}" for n in c.body if isinstance(n, ast.FunctionDef)}
    return names


def test_there_are_at_most_twelve_and_they_are_numbered():
    assert [n for n, _, _ in read_stops()] == list(range(1, len(read_stops()) + 1))
    assert 1 < len(read_stops()) <= 12


@pytest.mark.parametrize(("file", "name"), [(f, n) for _, f, n in read_stops()], ids=lambda v: getattr(v, "name", v))
def test_every_stop_is_a_file_and_a_function(file, name):
    assert name in list_functions(file)


# Files of the host and of shared that one row passes from its raw bytes to a name; 51 in November 2026.
MAX_FILES = 30
ROW_TO_NAME = ("add_row", "form_images", "place_plane", "find_materials")


@pytest.fixture(scope="module")
def walk(tmp_path_factory) -> tuple[list[tuple[str, str]], set[str]]:
    """Functions (file, name) of the host in the order in which processing a small scan first calls them, and the files
    that are called in the pipeline's steps from raw row to name.
    """
    from polysight.jobs.process import process
    from polysight.materials import load_catalogue
    from polysight.pipeline import Pipeline
    from polysight_simulators.__main__ import main

    folder = tmp_path_factory.mktemp("walk")
    command = ["simulate", str(ROOT / "examples" / "own-scene.toml"), "--config", str(ROOT / "instrument.toml")]
    assert main([*command, "--out", str(folder / "scan")]) == 0
    load_catalogue()  # it is read once for all scans
    calls: dict[tuple[str, str], None] = {}
    files: set[str] = set()
    steps = {getattr(Pipeline, name).__code__: name for name in ROW_TO_NAME}
    open_steps: list[str] = []

    def look(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if code in steps:
            if event == "call":
                open_steps.append(steps[code])
            elif event == "return":
                open_steps.pop()
        if event == "call" and ("polysight" in code.co_filename):
            calls.setdefault((code.co_filename, code.co_name))
            if open_steps:
                files.add(code.co_filename)

    sys.setprofile(look)
    try:
        assert process(folder / "scan", folder / "out", threads=1) == 0
    finally:
        sys.setprofile(None)
    our_files = {f for f in files if "/host/polysight/" in f or "/polysight_shared/" in f}
    return list(calls), our_files


def test_a_scan_passes_the_stops_in_their_order(walk):
    calls, _ = walk
    stop_numbers = {(str(file), name.rpartition(".")[2]): n for n, file, name in read_stops() if n >= PROCESSED_FROM}
    passed = [stop_numbers[call] for call in calls if call in stop_numbers]
    assert passed == sorted(stop_numbers.values())


def test_from_raw_row_to_name_few_files_are_passed(walk):
    _, files = walk
    assert len(files) <= MAX_FILES, sorted(files)
