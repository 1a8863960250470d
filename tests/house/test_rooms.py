"""Laws of the house: files and functions have a size, rooms a front door, the root of host nothing but the flow."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LINES, FUNCTION_LINES = 400, 60
ENTERED_BY_MODULE = ("cli", "jobs")
"""Rooms whose modules are loaded one at a time, so that a command loads no more than it needs."""
ALSO_SOURCE = (".cpp", ".c", ".h", ".js")


def tracked(*suffixes: str) -> list[Path]:
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode:
        pytest.skip("not a git checkout: the files of the project are not known")
    files = [ROOT / name for name in listed.stdout.splitlines()]
    return [f for f in files if f.suffix in suffixes and f.is_file() and not f.is_symlink()]


def test_no_file_is_over_400_lines():
    sizes = {f: len(f.read_text(encoding="utf-8").splitlines()) for f in tracked(".py", *ALSO_SOURCE)}
    assert {str(f.relative_to(ROOT)): n for f, n in sizes.items() if n > LINES} == {}


def test_no_function_is_over_60_lines():
    long = {}
    for file in tracked(".py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or node.lineno) - node.lineno + 1
                if lines > FUNCTION_LINES:
                    long[f"{file.relative_to(ROOT)}:{node.name}"] = lines
    assert long == {}


def test_the_root_of_host_is_the_flow_and_rooms():
    assert {p.name for p in (ROOT / "host").glob("*.py")} == {"__init__.py", "__main__.py", "pipeline.py"}
    assert len((ROOT / "host" / "pipeline.py").read_text(encoding="utf-8").splitlines()) <= 115


def rooms() -> list[Path]:
    return sorted(p.parent for p in (ROOT / "host").glob("*/__init__.py"))


@pytest.mark.parametrize("room", rooms(), ids=lambda p: p.name)
def test_a_room_says_what_it_is(room):
    tree = ast.parse((room / "__init__.py").read_text(encoding="utf-8"))
    said = ast.get_docstring(tree) or ""
    assert 2 <= len(said.splitlines()) <= 14, f"{room.name}/__init__.py: what it takes and gives, in about ten lines"


def imports(file: Path) -> list[tuple[int, str]]:
    found = []
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            found.append((node.lineno, node.module))
        elif isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
    return found


def test_neighbours_import_only_from_a_rooms_front():
    past = []
    for file in (f for top in ("host", "papers") for f in (ROOT / top).rglob("*.py")):
        own = file.relative_to(ROOT).parts[1] if file.is_relative_to(ROOT / "host") else ""
        for line, module in imports(file):
            parts = module.split(".")
            if parts[:2] != ["polysight", "host"] or len(parts) < 4:
                continue
            if parts[2] != own and parts[2] not in ENTERED_BY_MODULE:
                past.append(f"{file.relative_to(ROOT)}:{line} {module}")
    assert past == []


def test_no_module_is_taken_from_behind_a_front():
    """Not `from polysight.host.sync import tone` either, unless the front names it; nor relative imports."""
    past = []
    for file in (f for top in ("host", "papers", "polysight") for f in (ROOT / top).rglob("*.py")):
        own = file.relative_to(ROOT).parts[1] if file.is_relative_to(ROOT / "host") else ""
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ImportFrom):
                continue
            parts = (node.module or "").split(".")
            if node.level:
                past.append(f"{file.relative_to(ROOT)}:{node.lineno} a relative import")
            elif parts[:2] == ["polysight", "host"] and len(parts) == 3 and parts[2] not in (own, *ENTERED_BY_MODULE):
                room = ROOT / "host" / parts[2]
                if not room.is_dir():  # pipeline.py
                    continue
                front = (room / "__init__.py").read_text(encoding="utf-8")
                modules = [
                    a.name for a in node.names if (room / f"{a.name}.py").exists() and f'"{a.name}"' not in front
                ]
                past += [f"{file.relative_to(ROOT)}:{node.lineno} {m}" for m in modules]
    assert past == []


def test_the_package_has_one_name_and_does_without_simulators():
    """Folders are imported as `polysight.x`, also at run time in a wheel; only tests and simulators use simulators."""
    tops, wrong = ("host", "papers", "pi_controller", "shared", "simulators"), []
    for file in (f for top in (*tops, "polysight") for f in (ROOT / top).rglob("*.py") if not f.is_symlink()):
        for line, module in imports(file):
            uses_simulators = module.startswith("polysight.simulators") and "simulators" not in file.parts
            if module.split(".")[0] in tops or uses_simulators:
                wrong.append(f"{file.relative_to(ROOT)}:{line} {module}")
    assert wrong == []


def test_every_folder_of_modules_is_a_package():
    tops = [ROOT / top for top in ("host", "papers", "pi_controller", "shared", "simulators")]
    folders = {f.parent for top in tops for f in top.rglob("*.py") if "build" not in f.parts}
    assert [str(f.relative_to(ROOT)) for f in folders if not (f / "__init__.py").exists()] == []


def test_the_pi_half_needs_only_what_its_wheel_brings():
    allowed = {*sys.stdlib_module_names, "polysight", "gpiod", "msgpack", "msgspec", "serial", "zmq"}
    files = [f for top in ("shared", "pi_controller") for f in (ROOT / top).glob("*.py")]
    more = {f"{f.name}: {m}" for f in files for _, m in imports(f) if m.split(".")[0] not in allowed}
    assert more == set()


def test_the_names_of_the_folders_are_the_names_of_the_package():
    """`import host.imaging` from the root of a checkout gives the functions of `polysight.host.imaging`."""
    code = (
        "import host.imaging, host.polarimetry, polysight.host.imaging as i, polysight.host.polarimetry as p\n"
        "assert host.imaging.backproject is i.backproject and host.polarimetry.fresnel is p.fresnel"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
