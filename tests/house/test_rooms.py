"""Laws of the house: files and functions have a size, rooms a front door, the root of host nothing but the flow."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from tests.house.test_roof import PROJECTS

ROOT = Path(__file__).parents[2]
HOST = ROOT / "host" / "polysight"
PAPERS = ROOT / "papers" / "polysight_papers"
LINES = 700
FUNCTION_LINES = 60
ENTERED_BY_MODULE = ("cli", "jobs")
"""Rooms whose modules are loaded one at a time, so that a command loads no more than it needs."""
ALSO_SOURCE = (".cpp", ".c", ".h", ".js")


def list_tracked(*suffixes: str) -> list[Path]:
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("not a git checkout: the files of the project are not known")
    files = [ROOT / name for name in listed.stdout.splitlines()]
    return [f for f in files if f.suffix in suffixes and f.is_file() and not f.is_symlink()]


def test_no_file_is_over_700_lines():
    sizes = {f: len(f.read_text(encoding="utf-8").splitlines()) for f in list_tracked(".py", *ALSO_SOURCE)}
    assert {str(f.relative_to(ROOT)): n for f, n in sizes.items() if n > LINES} == {}


def count_code_lines(function: ast.FunctionDef | ast.AsyncFunctionDef, lines: list[str]) -> int:
    """Lines of a function without its docstring, comments and empty lines, of which a reader wants more."""
    head = function.body[0].lineno - function.lineno
    statements = function.body
    if ast.get_docstring(function) is not None:
        statements = statements[1:]
    if not statements:
        return head
    body = lines[statements[0].lineno - 1 : function.end_lineno]
    return head + sum(bool(line.strip()) and not line.lstrip().startswith("#") for line in body)


def test_no_function_is_over_60_lines_of_code():
    long = {}
    for file in list_tracked(".py"):
        text = file.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = count_code_lines(node, text.splitlines())
                if lines > FUNCTION_LINES:
                    long[f"{file.relative_to(ROOT)}:{node.name}"] = lines
    assert long == {}


PROGRAM_FOLDERS = ("host", "shared", "pi_controller", "papers")
ERRORS_FOR_PEOPLE = ("ConfigError", "DataError", "DeviceError", "ScanError")


def errors_without_three_parts(file: Path) -> list[int]:
    """Lines of errors that are raised without a cause or an advice."""
    lines = []
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
            continue
        keywords = {keyword.arg for keyword in node.keywords}
        parts = len(node.args) + len(keywords & {"why", "remedy"})
        is_unpacked = any(isinstance(argument, ast.Starred) for argument in node.args)
        if node.func.id in ERRORS_FOR_PEOPLE and parts < 3 and not is_unpacked:
            lines.append(node.lineno)
    return lines


def test_every_error_says_what_why_and_what_to_do():
    files = [file for file in list_tracked(".py") if file.relative_to(ROOT).parts[0] in PROGRAM_FOLDERS]
    incomplete = {str(file.relative_to(ROOT)): errors_without_three_parts(file) for file in files}
    assert {name: lines for name, lines in incomplete.items() if lines} == {}


def test_the_root_of_host_is_the_flow_and_rooms():
    assert {p.name for p in HOST.glob("*.py")} == {"__init__.py", "__main__.py", "pipeline.py", "settings.py"}
    assert len((HOST / "pipeline.py").read_text(encoding="utf-8").splitlines()) <= 135


def rooms() -> list[Path]:
    return sorted(p.parent for p in HOST.glob("*/__init__.py") if p.parent.name != "data")


@pytest.mark.parametrize("room", rooms(), ids=lambda p: p.name)
def test_a_room_says_what_it_is(room):
    tree = ast.parse((room / "__init__.py").read_text(encoding="utf-8"))
    said = ast.get_docstring(tree) or ""
    assert 2 <= len(said.splitlines()) <= 14, f"{room.name}/__init__.py: what it takes and gives, in about ten lines"


def imports(file: Path) -> list[tuple[int, str]]:
    collected = []
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            collected.append((node.lineno, node.module))
        elif isinstance(node, ast.Import):
            collected += [(node.lineno, alias.name) for alias in node.names]
    return collected


def imported_names(tree: ast.Module) -> set[str]:
    statements = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    return {alias.name for node in statements for alias in node.names}


def find_room(file: Path) -> str:
    """The room of the host that a file stands in; "" elsewhere."""
    if file.is_relative_to(HOST):
        return file.relative_to(HOST).parts[0]
    return ""


def test_neighbours_import_only_from_a_rooms_front():
    past = []
    for file in (f for top in (HOST, PAPERS) for f in top.rglob("*.py")):
        for line, module in imports(file):
            parts = module.split(".")
            inside = (find_room(file), *ENTERED_BY_MODULE)
            if parts[0] == "polysight" and len(parts) > 2 and parts[1] not in inside and file != HOST / "__init__.py":
                past.append(f"{file.relative_to(ROOT)}:{line} {module}")
    assert past == []


def test_no_module_is_taken_from_behind_a_front():
    """Not `from polysight.sync import tone` either, unless the front names it; nor relative imports."""
    past = []
    for file in (f for top in (HOST, PAPERS) for f in top.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ImportFrom):
                continue
            parts = (node.module or "").split(".")
            if node.level:
                past.append(f"{file.relative_to(ROOT)}:{node.lineno} a relative import")
            elif parts[0] == "polysight" and len(parts) == 2 and parts[1] not in (find_room(file), *ENTERED_BY_MODULE):
                room = HOST / parts[1]
                # A module at the root, such as pipeline.py, is no room.
                if not room.is_dir():
                    continue
                front = (room / "__init__.py").read_text(encoding="utf-8")
                named = imported_names(ast.parse(front))
                modules = [a.name for a in node.names if (room / f"{a.name}.py").exists() and a.name not in named]
                past += [f"{file.relative_to(ROOT)}:{node.lineno} {m}" for m in modules]
    assert past == []


def test_only_simulators_use_simulators():
    """Also at run time in a wheel: the demo starts them as programs."""
    files = [f for top in ("host", "papers", "pi_controller", "shared") for f in (ROOT / top).rglob("*.py")]
    wrong = [
        f"{f.relative_to(ROOT)}:{line} {module}"
        for f in files
        for line, module in imports(f)
        if module.startswith("polysight_simulators")
    ]
    assert wrong == []


def test_worlds_know_nothing_of_ours():
    """They judge the instrument: no code and no belief is shared."""
    files = (ROOT / "worlds").rglob("*.py")
    used = {module.split(".")[0] for file in files for _, module in imports(file)}
    assert used - set(sys.stdlib_module_names) == {"numpy", "scipy", "polysight_worlds"}


def test_every_folder_of_modules_is_a_package():
    tops = [ROOT / top / package for top, package in PROJECTS.items()]
    folders = {f.parent for top in tops for f in top.rglob("*.py") if "build" not in f.parts}
    assert [str(f.relative_to(ROOT)) for f in folders if not (f / "__init__.py").exists()] == []


def test_the_pi_half_needs_only_what_its_wheel_brings():
    allowed = {*sys.stdlib_module_names, "polysight_pi", "polysight_shared", "gpiod", "msgpack", "msgspec", "serial"}
    allowed.add("zmq")
    files = [f for top in ("shared", "pi_controller") for f in (ROOT / top / PROJECTS[top]).glob("*.py")]
    foreign_imports = {f"{f.name}: {m}" for f in files for _, m in imports(f) if m.split(".")[0] not in allowed}
    assert foreign_imports == set()
