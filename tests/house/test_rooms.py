"""Laws of the house: size of files and functions, public names of rooms, and the content of the host's root."""

import ast
import subprocess
import sys
from dataclasses import dataclass, field
from functools import cache
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


@dataclass
class FileFacts:
    """Facts of a file that the laws below use; it is parsed once for all of them.

    Each list has lines: of imports with the dots before a relative one, the module, and the names taken from it; of
    functions with their lines of code; of errors for people that lack one of their three parts.
    """

    imports: list[tuple[int, int, str, list[str]]] = field(default_factory=list)
    functions: list[tuple[str, int]] = field(default_factory=list)
    incomplete_errors: list[int] = field(default_factory=list)


@cache
def read_facts(file: Path) -> FileFacts:
    text = file.read_text(encoding="utf-8")
    lines = text.splitlines()
    facts = FileFacts()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom):
            facts.imports.append((node.lineno, node.level, node.module or "", [alias.name for alias in node.names]))
        elif isinstance(node, ast.Import):
            facts.imports += [(node.lineno, 0, alias.name, []) for alias in node.names]
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            facts.functions.append((node.name, count_code_lines(node, lines)))
        elif isinstance(node, ast.Call) and lacks_a_part(node):
            facts.incomplete_errors.append(node.lineno)
    return facts


def test_no_file_is_over_700_lines():
    sizes = {f: len(f.read_text(encoding="utf-8").splitlines()) for f in list_tracked(".py", *ALSO_SOURCE)}
    assert {str(f.relative_to(ROOT)): n for f, n in sizes.items() if n > LINES} == {}


def count_code_lines(function: ast.FunctionDef | ast.AsyncFunctionDef, lines: list[str]) -> int:
    """Number of lines of a function without its docstring, comments and empty lines, which are welcome."""
    head = function.body[0].lineno - function.lineno
    statements = function.body
    if ast.get_docstring(function) is not None:
        statements = statements[1:]
    if not statements:
        return head
    body = lines[statements[0].lineno - 1 : function.end_lineno]
    return head + sum(bool(line.strip()) and not line.lstrip().startswith("#") for line in body)


def test_no_function_is_over_60_lines_of_code():
    long = {
        f"{file.relative_to(ROOT)}:{name}": lines
        for file in list_tracked(".py")
        for name, lines in read_facts(file).functions
        if lines > FUNCTION_LINES
    }
    assert long == {}


PROGRAM_FOLDERS = ("host", "shared", "pi_controller", "papers")
ERRORS_FOR_PEOPLE = ("ConfigError", "DataError", "DeviceError", "ScanError")


def lacks_a_part(call: ast.Call) -> bool:
    """True for an error that is raised without a cause or an advice."""
    if not isinstance(call.func, ast.Name) or call.func.id not in ERRORS_FOR_PEOPLE:
        return False
    keywords = {keyword.arg for keyword in call.keywords}
    is_unpacked = any(isinstance(argument, ast.Starred) for argument in call.args)
    return len(call.args) + len(keywords & {"why", "remedy"}) < 3 and not is_unpacked


def test_every_error_gives_its_cause_and_a_remedy():
    files = [file for file in list_tracked(".py") if file.relative_to(ROOT).parts[0] in PROGRAM_FOLDERS]
    incomplete = {str(file.relative_to(ROOT)): read_facts(file).incomplete_errors for file in files}
    assert {name: lines for name, lines in incomplete.items() if lines} == {}


def test_the_root_of_host_is_the_flow_and_rooms():
    assert {p.name for p in HOST.glob("*.py")} == {"__init__.py", "__main__.py", "pipeline.py", "settings.py"}
    assert len((HOST / "pipeline.py").read_text(encoding="utf-8").splitlines()) <= 135


def list_rooms() -> list[Path]:
    return sorted(p.parent for p in HOST.glob("*/__init__.py") if p.parent.name != "data")


@pytest.mark.parametrize("room", list_rooms(), ids=lambda p: p.name)
def test_the_front_of_each_room_describes_it(room):
    tree = ast.parse((room / "__init__.py").read_text(encoding="utf-8"))
    docstring = ast.get_docstring(tree) or ""
    assert 2 <= len(docstring.splitlines()) <= 14, (
        f"{room.name}/__init__.py: what it takes and gives, in about ten lines"
    )


def list_imports(file: Path) -> list[tuple[int, str]]:
    return [(line, module) for line, _, module, _ in read_facts(file).imports if module]


def find_room(file: Path) -> str:
    """The room of the host that a file stands in; "" elsewhere."""
    if file.is_relative_to(HOST):
        return file.relative_to(HOST).parts[0]
    return ""


def test_neighbours_import_only_from_a_rooms_front():
    past = []
    for file in (f for top in (HOST, PAPERS) for f in top.rglob("*.py")):
        for line, module in list_imports(file):
            parts = module.split(".")
            inside = (find_room(file), *ENTERED_BY_MODULE)
            if parts[0] == "polysight" and len(parts) > 2 and parts[1] not in inside and file != HOST / "__init__.py":
                past.append(f"{file.relative_to(ROOT)}:{line} {module}")
    assert past == []


def test_no_module_is_imported_past_the_front_of_its_room():
    """Not `from polysight.sync import tone` either, unless the front names it; nor relative imports."""
    past = []
    for file in (f for top in (HOST, PAPERS) for f in top.rglob("*.py")):
        for line, level, module, names in read_facts(file).imports:
            parts = module.split(".")
            if level:
                past.append(f"{file.relative_to(ROOT)}:{line} a relative import")
            elif parts[0] == "polysight" and len(parts) == 2 and parts[1] not in (find_room(file), *ENTERED_BY_MODULE):
                room = HOST / parts[1]
                # A module at the root, such as pipeline.py, is not a room.
                if not room.is_dir():
                    continue
                named = {name for *_, taken in read_facts(room / "__init__.py").imports for name in taken}
                modules = [name for name in names if (room / f"{name}.py").exists() and name not in named]
                past += [f"{file.relative_to(ROOT)}:{line} {name}" for name in modules]
    assert past == []


def test_only_simulators_use_simulators():
    """Also at run time in a wheel: the demo starts them as programs."""
    files = [f for top in ("host", "papers", "pi_controller", "shared") for f in (ROOT / top).rglob("*.py")]
    forbidden_imports = [
        f"{f.relative_to(ROOT)}:{line} {module}"
        for f in files
        for line, module in list_imports(f)
        if module.startswith("polysight_simulators")
    ]
    assert forbidden_imports == []


def test_worlds_know_nothing_of_ours():
    """Simulators judge the instrument, so they share no code and no assumption with it."""
    files = (ROOT / "worlds").rglob("*.py")
    used = {module.split(".")[0] for file in files for _, module in list_imports(file)}
    assert used - set(sys.stdlib_module_names) == {"numpy", "scipy", "polysight_worlds"}


def test_every_folder_of_modules_is_a_package():
    tops = [ROOT / top / package for top, package in PROJECTS.items()]
    folders = {f.parent for top in tops for f in top.rglob("*.py") if "build" not in f.parts}
    assert [str(f.relative_to(ROOT)) for f in folders if not (f / "__init__.py").exists()] == []


def test_the_pi_half_needs_only_what_its_wheel_brings():
    allowed = {*sys.stdlib_module_names, "polysight_pi", "polysight_shared", "gpiod", "msgpack", "msgspec", "serial"}
    allowed.add("zmq")
    files = [f for top in ("shared", "pi_controller") for f in (ROOT / top / PROJECTS[top]).glob("*.py")]
    foreign_imports = {f"{f.name}: {m}" for f in files for _, m in list_imports(f) if m.split(".")[0] not in allowed}
    assert foreign_imports == set()
