"""docs/architecture.md lists the stops of a scan's data, from a radar packet to a material's name.

A stop is a file and one function in it. Each must exist, and processing a scan must call them in the listed order.
"""

import ast
import re
import sys
from pathlib import Path
from types import FrameType
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]
# A line of the table: number of the stop, what happens, file and function.
STOP_PATTERN = re.compile(r"^\| (\d+) \| [^|]+ \| `([^`]+)` \| `([^`]+)` \|$")
# More stops would be no overview.
MAX_STOPS = 12
# The first stop in the processing of a recorded scan. Earlier stops are called only while a scan is recorded, and not
# by the tests of this file.
FIRST_STOP_OF_PROCESSING = 6
# A reader who follows one row from its raw bytes to a material's name must open at most this many files.
MAX_FILES_OF_A_ROW = 30
# Methods of Pipeline that process a row, in their order.
STEPS_OF_A_ROW = ("add_row", "form_images", "place_plane", "find_materials")


class Stop(NamedTuple):
    number: int
    file: Path
    function: str


class Walk(NamedTuple):
    """Calls of the instrument's functions while a small scan is processed."""

    # File and name of each function, in the order of their first calls.
    calls: list[tuple[str, str]]
    # Files of the functions that were called within the steps of a row.
    files_of_a_row: set[str]


def read_stops() -> list[Stop]:
    lines = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").splitlines()
    matches = [match for match in map(STOP_PATTERN.match, lines) if match]
    return [Stop(number=int(m[1]), file=ROOT / m[2], function=m[3]) for m in matches]


def list_functions(file: Path) -> set[str]:
    """Names of the functions in a file; methods are named `Class.method`."""
    names = set()
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef):
            names.add(node.name)
        elif isinstance(node, ast.ClassDef):
            names |= {f"{node.name}.{method.name}" for method in node.body if isinstance(method, ast.FunctionDef)}
    return names


def test_the_stops_are_numbered_and_at_most_twelve():
    numbers = [stop.number for stop in read_stops()]
    assert numbers == list(range(1, len(numbers) + 1))
    assert 1 < len(numbers) <= MAX_STOPS


@pytest.mark.parametrize("stop", read_stops(), ids=lambda stop: f"{stop.file.name}-{stop.function}")
def test_every_stop_is_a_function_in_its_file(stop):
    assert stop.function in list_functions(stop.file)


@pytest.fixture(scope="module")
def walk(tmp_path_factory) -> Walk:
    """The calls that processing a small simulated scan makes."""
    from polysight.jobs.process import process
    from polysight.materials import load_catalogue
    from polysight.pipeline import Pipeline
    from polysight_simulators.__main__ import main

    folder = tmp_path_factory.mktemp("walk")
    command = ["simulate", str(ROOT / "examples" / "own-scene.toml"), "--config", str(ROOT / "instrument.toml")]
    assert main([*command, "--out", str(folder / "scan")]) == 0
    # The catalogue of materials is read once for all scans, so it is not a part of the walk.
    load_catalogue()
    # A dictionary without values keeps the order of the first calls.
    calls: dict[tuple[str, str], None] = {}
    files: set[str] = set()
    steps = {getattr(Pipeline, name).__code__: name for name in STEPS_OF_A_ROW}
    running_steps: list[str] = []

    def record_call(frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if code in steps:
            if event == "call":
                running_steps.append(steps[code])
            elif event == "return":
                running_steps.pop()
        if event == "call" and ("polysight" in code.co_filename):
            calls.setdefault((code.co_filename, code.co_name))
            if running_steps:
                files.add(code.co_filename)

    sys.setprofile(record_call)
    try:
        assert process(folder / "scan", folder / "out", threads=1) == 0
    finally:
        sys.setprofile(None)
    our_files = {f for f in files if "/host/polysight/" in f or "/polysight_shared/" in f}
    return Walk(calls=list(calls), files_of_a_row=our_files)


def test_processing_a_scan_calls_the_stops_in_their_order(walk):
    stop_numbers = {}
    for stop in read_stops():
        if stop.number >= FIRST_STOP_OF_PROCESSING:
            # A call has the bare name of a method.
            method = stop.function.rpartition(".")[2]
            stop_numbers[str(stop.file), method] = stop.number
    called_stops = [stop_numbers[call] for call in walk.calls if call in stop_numbers]
    assert called_stops == sorted(stop_numbers.values())


def test_few_files_process_a_row_from_its_bytes_to_a_name(walk):
    assert len(walk.files_of_a_row) <= MAX_FILES_OF_A_ROW, sorted(walk.files_of_a_row)
