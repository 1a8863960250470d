"""Style and structure of the source: sizes of files and functions, and which module may import which.

A room is a folder of `host/polysight`, such as `imaging` or `sync`; its front is its `__init__.py`, which imports the
names that other rooms may use (docs/decisions/0008-rooms.md).
"""

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
MAX_FILE_LINES = 700
MAX_FUNCTION_LINES = 60
# The pipeline shows the whole processing, so it must stay short enough to be read in one go.
MAX_PIPELINE_LINES = 135
# Rooms whose modules are imported one by one instead of from the front, so that a command loads no more than it needs.
ROOMS_WITHOUT_FRONT = ("cli", "jobs")
OTHER_SOURCE_SUFFIXES = (".cpp", ".c", ".h", ".js")


def list_source_files(*suffixes: str) -> list[Path]:
    """Files with these suffixes that git tracks, or would add; no symbolic links."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("not a git checkout: the files of the project are not known")
    files = [ROOT / name for name in listed.stdout.splitlines()]
    return [f for f in files if f.suffix in suffixes and f.is_file() and not f.is_symlink()]


@dataclass
class FileFacts:
    """Facts of a Python file that the tests below use, so that it is parsed once for all of them."""

    # Of each import: its line, the number of dots of a relative one, the module, and the names imported from it.
    imports: list[tuple[int, int, str, list[str]]] = field(default_factory=list)
    # Name of each function, and the number of its lines of code.
    functions: list[tuple[str, int]] = field(default_factory=list)
    # Lines that raise an error for users without one of its three parts: what happened, why, and what to do.
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
    too_long = {}
    for file in list_source_files(".py", *OTHER_SOURCE_SUFFIXES):
        lines = len(file.read_text(encoding="utf-8").splitlines())
        if lines > MAX_FILE_LINES:
            too_long[str(file.relative_to(ROOT))] = lines
    assert too_long == {}


def count_code_lines(function: ast.FunctionDef | ast.AsyncFunctionDef, lines: list[str]) -> int:
    """Number of lines of a function without its docstring, comments and empty lines."""
    signature_lines = function.body[0].lineno - function.lineno
    statements = function.body
    if ast.get_docstring(function) is not None:
        statements = statements[1:]
    if not statements:
        return signature_lines
    # `lineno` counts from 1, and `end_lineno` is the last line.
    body = lines[statements[0].lineno - 1 : function.end_lineno]
    code_lines = [line for line in body if line.strip() and not line.lstrip().startswith("#")]
    return signature_lines + len(code_lines)


def test_no_function_is_over_60_lines_of_code():
    too_long = {}
    for file in list_source_files(".py"):
        for name, lines in read_facts(file).functions:
            if lines > MAX_FUNCTION_LINES:
                too_long[f"{file.relative_to(ROOT)}:{name}"] = lines
    assert too_long == {}


PROGRAM_FOLDERS = ("host", "shared", "pi_controller", "papers")
ERRORS_FOR_USERS = ("ConfigError", "DataError", "DeviceError", "ScanError")


def lacks_a_part(call: ast.Call) -> bool:
    """True for an error for users that is made without its cause (`why`) or its remedy."""
    if not isinstance(call.func, ast.Name) or call.func.id not in ERRORS_FOR_USERS:
        return False
    # The three parts may be in an unpacked tuple: `DataError(*parts)`.
    if any(isinstance(argument, ast.Starred) for argument in call.args):
        return False
    keywords = {keyword.arg for keyword in call.keywords}
    parts = len(call.args) + len(keywords & {"why", "remedy"})
    return parts < 3


def test_every_error_gives_its_cause_and_a_remedy():
    files = [file for file in list_source_files(".py") if file.relative_to(ROOT).parts[0] in PROGRAM_FOLDERS]
    incomplete = {str(file.relative_to(ROOT)): read_facts(file).incomplete_errors for file in files}
    assert {name: lines for name, lines in incomplete.items() if lines} == {}


def test_the_host_s_own_folder_has_the_pipeline_and_its_settings_only():
    assert {p.name for p in HOST.glob("*.py")} == {"__init__.py", "__main__.py", "pipeline.py", "settings.py"}
    pipeline_lines = (HOST / "pipeline.py").read_text(encoding="utf-8").splitlines()
    assert len(pipeline_lines) <= MAX_PIPELINE_LINES


def list_rooms() -> list[Path]:
    """Folders of the rooms. `data` is none: it contains the rig file and the scenes of an installed package."""
    folders = {file.parent for file in HOST.glob("*/__init__.py")}
    return sorted(folders - {HOST / "data"})


@pytest.mark.parametrize("room", list_rooms(), ids=lambda p: p.name)
def test_the_front_of_each_room_describes_it_in_two_to_fourteen_lines(room):
    """A title alone does not say what a room takes and returns; a longer text belongs on a page in docs."""
    tree = ast.parse((room / "__init__.py").read_text(encoding="utf-8"))
    docstring = ast.get_docstring(tree) or ""
    assert 2 <= len(docstring.splitlines()) <= 14, (
        f"{room.name}/__init__.py: describe in about ten lines what the room takes and returns"
    )


def list_imports(file: Path) -> list[tuple[int, str]]:
    """Line and module of each import that is not `from . import name`."""
    return [(line, module) for line, _, module, _ in read_facts(file).imports if module]


def find_room(file: Path) -> str:
    """The room of the host that a file stands in; "" elsewhere."""
    if file.is_relative_to(HOST):
        return file.relative_to(HOST).parts[0]
    return ""


def list_host_and_papers() -> list[Path]:
    return [*HOST.rglob("*.py"), *PAPERS.rglob("*.py")]


def test_other_rooms_import_names_from_the_front_of_a_room_and_not_from_its_modules():
    """For example, other rooms may write `from polysight.sync import find_tone`.

    They may not write `from polysight.sync.tone import find_tone`.
    """
    forbidden_imports = []
    for file in list_host_and_papers():
        # The public interface `polysight` loads a module when one of its names is used.
        if file == HOST / "__init__.py":
            continue
        allowed_rooms = (find_room(file), *ROOMS_WITHOUT_FRONT)
        for line, module in list_imports(file):
            package, *folders_and_module = module.split(".")
            is_inside_a_room = package == "polysight" and len(folders_and_module) > 1
            if is_inside_a_room and folders_and_module[0] not in allowed_rooms:
                forbidden_imports.append(f"{file.relative_to(ROOT)}:{line} {module}")
    assert forbidden_imports == []


def test_other_rooms_import_a_module_of_a_room_only_if_its_front_imports_it_too():
    """For example, another room may write `from polysight.sync import tone` only if `sync/__init__.py` imports `tone`.

    Relative imports are forbidden, because this test could not tell which room they name.
    """
    forbidden_imports = []
    for file in list_host_and_papers():
        for line, dots, module, names in read_facts(file).imports:
            if dots:
                forbidden_imports.append(f"{file.relative_to(ROOT)}:{line} a relative import")
                continue
            package, _, room = module.partition(".")
            is_room = package == "polysight" and bool(room) and "." not in room and (HOST / room).is_dir()
            if not is_room or room in (find_room(file), *ROOMS_WITHOUT_FRONT):
                continue
            offered: set[str] = set()
            for *_, names_in_front in read_facts(HOST / room / "__init__.py").imports:
                offered.update(names_in_front)
            for name in names:
                is_module = (HOST / room / f"{name}.py").exists()
                if is_module and name not in offered:
                    forbidden_imports.append(f"{file.relative_to(ROOT)}:{line} {name}")
    assert forbidden_imports == []


def test_no_program_of_the_instrument_imports_the_simulators():
    """A wheel of the host can be installed without the simulators. The demo starts them as programs."""
    forbidden_imports = []
    for project in ("host", "papers", "pi_controller", "shared"):
        for file in (ROOT / project).rglob("*.py"):
            for line, module in list_imports(file):
                if module.startswith("polysight_simulators"):
                    forbidden_imports.append(f"{file.relative_to(ROOT)}:{line} {module}")
    assert forbidden_imports == []


def test_the_simulators_in_worlds_import_nothing_of_the_instrument():
    """They judge the instrument: with its code they would share its assumptions, and miss its errors."""
    files = (ROOT / "worlds").rglob("*.py")
    used = {module.split(".")[0] for file in files for _, module in list_imports(file)}
    assert used - set(sys.stdlib_module_names) == {"numpy", "scipy", "polysight_worlds"}


def test_every_folder_of_modules_is_a_package():
    folders: set[Path] = set()
    for project, package in PROJECTS.items():
        folders |= {file.parent for file in (ROOT / project / package).rglob("*.py")}
    assert [str(folder.relative_to(ROOT)) for folder in folders if not (folder / "__init__.py").exists()] == []


def test_the_pi_s_program_imports_only_the_dependencies_of_its_wheel():
    dependencies = {"polysight_pi", "polysight_shared", "gpiod", "msgpack", "msgspec", "serial", "zmq"}
    allowed = {*sys.stdlib_module_names, *dependencies}
    forbidden_imports = []
    for project in ("shared", "pi_controller"):
        for file in (ROOT / project / PROJECTS[project]).glob("*.py"):
            for line, module in list_imports(file):
                if module.split(".")[0] not in allowed:
                    forbidden_imports.append(f"{file.relative_to(ROOT)}:{line} {module}")
    assert forbidden_imports == []
