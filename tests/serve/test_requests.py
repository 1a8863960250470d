"""POST requests without a browser: values just inside and outside of limits, and the command line of each."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.support.page.asking import TOKEN, post
from tests.support.page.live_view import serve_folder
from tests.support.paths import RIG_FILE
from tests.support.products import write_judged_products
from tests.support.refusals import expect_refusal

from polysight.cli.main import build_parser
from polysight.cli.options import join_negative_values
from polysight.materials import Layer
from polysight.serve.commands import (
    MAX_POSITIONS,
    ExportRequest,
    LabelRequest,
    NotesRequest,
    PlanRequest,
    StartRequest,
    TrainRequest,
)
from polysight.serve.programs import Programs
from polysight_shared.errors import ErrorCode
from polysight_shared.tables import decode

BOX = (0.0, 0.0, 10.0, 10.0)


@pytest.mark.parametrize(
    ("kind", "inside", "outside"),
    [
        (PlanRequest, {"columns": 1}, {"columns": 0}),
        (PlanRequest, {"rows": MAX_POSITIONS}, {"rows": MAX_POSITIONS + 1}),
        (PlanRequest, {"step_x_mm": 1e-3}, {"step_x_mm": 0.0}),
        (PlanRequest, {"speed_mm_s": 1e5}, {"speed_mm_s": 100001.0}),
        (PlanRequest, {"pulses": 1}, {"pulses": 0}),
        (PlanRequest, {"pulses": 65535}, {"pulses": 65536}),
        (StartRequest, {"name": 200 * "a"}, {"name": 201 * "a"}),
        (StartRequest, {"metal": (-1e6, 0.0, 1e6, 1.0)}, {"metal": (-1000001.0, 0.0, 1.0, 1.0)}),
        (StartRequest, {"notes": 10_000 * "a"}, {"notes": 10_001 * "a"}),
        (StartRequest, {"tags": 20 * ["a"]}, {"tags": 21 * ["a"]}),
        (LabelRequest, {"boxes": {f"{k}": BOX for k in range(200)}}, {"boxes": {f"{k}": BOX for k in range(201)}}),
        (LabelRequest, {"boxes": {200 * "a": BOX}}, {"boxes": {201 * "a": BOX}}),
        (LabelRequest, {"boxes": {}, "specimens": {f"{k}": "" for k in range(200)}},
         {"boxes": {}, "specimens": {f"{k}": "" for k in range(201)}}),
        (NotesRequest, {"notes": 20_000 * "a"}, {"notes": 20_001 * "a"}),
        (NotesRequest, {"tags": 100 * ["a"]}, {"tags": 101 * ["a"]}),
        (NotesRequest, {"tags": [1000 * "a"]}, {"tags": [1001 * "a"]}),
        (TrainRequest, {"name": "a", "scans": ["s"]}, {"name": "a", "scans": []}),
        (TrainRequest, {"name": "a", "scans": 500 * ["s"]}, {"name": "a", "scans": 501 * ["s"]}),
        (TrainRequest, {"name": 61 * "a", "scans": ["s"]}, {"name": 62 * "a", "scans": ["s"]}),
        (TrainRequest, {"name": "a.b -c", "scans": ["s"]}, {"name": "a/b", "scans": ["s"]}),
        (TrainRequest, {"name": "a", "scans": ["s"]}, {"name": ".a", "scans": ["s"]}),
        (ExportRequest, {"formats": ["csv"]}, {"formats": []}),
    ],
)  # fmt: skip
def test_values_at_a_limit_are_accepted_and_those_just_beyond_it_refused(kind, inside, outside):
    """The limits are those of `serve/commands.py`, which gives their reasons."""
    decode(inside, kind, "the request")
    with expect_refusal(ErrorCode.VALUE_INVALID):
        decode(outside, kind, "the request")


def test_a_plan_with_a_new_step_has_no_more_positions_than_a_request_may_have():
    """A smaller step makes more positions in the same area, 698 mm: 698 / 0.35 + 1 = 1995, 698 / 0.3491 + 1 = 2000."""
    within = PlanRequest(step_x_mm=0.35, speed_mm_s=5.0).apply(RIG_FILE)
    assert within.grid.columns == 1995
    largest = PlanRequest(step_x_mm=0.3491, speed_mm_s=5.0).apply(RIG_FILE)
    assert largest.grid.columns == MAX_POSITIONS
    with expect_refusal(ErrorCode.VALUE_INVALID, MAX_POSITIONS):
        PlanRequest(step_x_mm=0.348, speed_mm_s=5.0).apply(RIG_FILE)


@pytest.fixture
def root(tmp_path) -> Path:
    folder = tmp_path / "scans"
    write_judged_products(folder / "one", "good")
    (folder / "libraries").mkdir()
    (folder / "libraries" / "mine.npz").touch()
    return folder


@pytest.fixture
def start_program(root, monkeypatch) -> Iterator[tuple[Any, list[list[str]]]]:
    """A server, and the list of command lines of the programs that it would start."""
    command_lines: list[list[str]] = []

    def start(_self: Programs, _folder: Path, _kind: str, words: list[str | Path]) -> None:
        command_lines.append([str(word) for word in words])

    monkeypatch.setattr(Programs, "start", start)
    with serve_folder(root, TOKEN, config=RIG_FILE) as view:
        yield view, command_lines


def to_plain(value: Any, root: Path) -> Any:
    """Write paths as text, with `%` for the folder of scans."""
    if isinstance(value, list):
        return [to_plain(item, root) for item in value]
    if isinstance(value, str | Path):
        return str(value).replace(str(root), "%")
    return value


@pytest.mark.parametrize(
    ("path", "body", "values"),
    [
        ("doctor", {}, {"config": RIG_FILE, "out": "%"}),
        ("start", {"name": "new", "keep_incomplete": True, "metal": [-30, -10, 10, 40], "library": "mine"},
         {"out": "%/new", "config": RIG_FILE, "keep_incomplete": True, "metal": (-30, -10, 10, 40),
          "library": "%/libraries/mine.npz"}),
        ("start", {"name": "new"}, {"out": "%/new", "keep_incomplete": False, "metal": None, "library": None}),
        ("start", {"name": "new", "plan": {"rows": 3}}, {"config": "%/new/program/instrument.toml"}),
        ("resume?scan=one", {"keep_incomplete": True, "library": "mine"},
         {"folder": "%/one", "keep_incomplete": True, "library": "%/libraries/mine.npz"}),
        ("resume?scan=one", {}, {"folder": "%/one", "keep_incomplete": False, "library": None}),
        ("process?scan=one", {"metal": [0, 0, 5, 8]}, {"out": "%/one/products", "metal": (0, 0, 5, 8), "labels": None}),
        ("process?scan=one", {"bands": 4}, {"bands": 4, "sparse": False}),
        ("process?scan=one", {"sparse": True}, {"bands": 1, "sparse": True}),
        ("layers?scan=one", {"patch": 2, "layers": ["glass, 5.5, 0.05, 3", "liquid, ?"]},
         {"products": "%/one", "patch": 2, "layer": [Layer("glass", 5.5 - 0.05j, 3e-3), Layer("liquid")]}),
        ("concentration", {"library": "mine"}, {"data": "%/libraries/mine.npz"}),
        ("train", {"name": "own", "scans": ["one"]}, {"data": ["%/one"], "out": "%/libraries/own.npz"}),
        ("export?scan=one", {"formats": ["csv", "netcdf"]},
         {"products": "%/one", "csv": True, "netcdf": True, "mat": False, "out": "%/one/export"}),
    ],
)  # fmt: skip
def test_a_request_becomes_a_command_line_that_the_parser_accepts(start_program, root, path, body, values):
    view, command_lines = start_program
    status, answer = post(view, f"/api/{path}", body)
    assert status == 200, answer
    (words,) = command_lines
    # Two commands have another name on the page.
    expected_command = path.partition("?")[0].replace("start", "scan").replace("layers", "permittivity")
    assert words[0] == expected_command
    options = vars(build_parser(words[0]).parse_args(join_negative_values(words)))

    arguments_shown = {name: to_plain(options[name], root) for name in values}
    assert arguments_shown == {name: to_plain(value, root) for name, value in values.items()}


def test_boxes_drawn_on_the_page_are_used_when_it_processes(start_program, root):
    view, command_lines = start_program
    status, saved = post(view, "/api/labels?scan=one", {"boxes": {"oak": [0, 0, 10, 10]}, "specimens": {"oak": "7"}})
    assert status == 200, saved
    assert post(view, "/api/process?scan=one", {"labels": True})[0] == 200
    assert command_lines[0][-2:] == ["--labels", saved["file"]]
    assert Path(saved["file"]).is_relative_to(root / "one")
