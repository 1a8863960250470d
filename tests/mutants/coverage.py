"""Find the tests that execute the statement which a mutant changes, by one run of the suite on a copy with probes.

A probe is a call that is inserted before a statement. When it is executed, it writes its number and the name of the
running test to a log. Programs that the test has started do so, too: pytest keeps the name of the running test in an
environment variable, which they inherit. The value of a constant of a module or a class is computed while the module is
imported, so its probes stand where the constant is used.
"""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from tests.mutants.draw import Mutant, list_files
from tests.support.paths import REPO

# The packages whose tests are in a folder of another name.
TEST_FOLDERS = {"pi_controller": "pi", "planning": "plan", "results": "verdict"}
# The test that reads the flags of all calls in the source: it executes none of them.
FLAGS_TEST = "tests/house/test_flags.py"
PROJECTS = ("shared", "pi_controller", "simulators", "host", "papers", "worlds")
# Module that all probes call; a line with the path of the log comes before its source.
PROBES_MODULE = "probes_of_mutants"
# `os.environ[...]` decodes the whole value in each call, which is too slow for probes in inner loops.
PROBES_SOURCE = """
import os
_ENVIRONMENT = os.environ._data
_recorded = set()
def record(number):
    test = _ENVIRONMENT.get(b"PYTEST_CURRENT_TEST", b"")
    if (number, test) in _recorded:
        return
    _recorded.add((number, test))
    file = os.open(LOG, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(file, b"%d %s\\n" % (number, test))
    os.close(file)
"""


@dataclass
class Coverage:
    """Result of the suite's run on the copy with probes. Mutants are named by their text (`str`).

    `tests[mutant]` are the tests that executed its statement, and `files[mutant]` the test files of which a fixture
    did. `seconds` has the duration of every test. `failed` are tests that fail without any mutant, and judge none.
    """

    tests: dict[str, list[str]] = field(default_factory=dict)
    files: dict[str, list[str]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)

    def select_tests(self, mutant: Mutant, limit_s: float) -> list[str]:
        """Tests that may notice a mutant, whose durations add up to at most `limit_s`.

        Those of the mutant's own package come first, and among them and the others the quickest.
        """
        tests = set(self.tests.get(str(mutant), ()))
        # A fixture may be shared by all tests of its file.
        files = set(self.files.get(str(mutant), ()))
        tests |= {test for test in self.seconds if _get_file(test) in files}
        tests -= set(self.failed)

        folder = TEST_FOLDERS.get(mutant.package, mutant.package)

        def order(test: str) -> tuple[bool, float]:
            is_of_another_package = not test.startswith(f"tests/{folder}/")
            return is_of_another_package, self.seconds.get(test, 0.0)

        # `True` or `False` may be an argument of a class statement or a default value, which is computed at import.
        # Therefore the test that reads the source is selected even if no test executes the statement.
        selected = [FLAGS_TEST] if "True" in mutant.operator else []
        total_s = 0.0
        for test in sorted(tests, key=order):
            total_s += self.seconds.get(test, 0.0)
            if total_s <= limit_s:
                selected.append(test)
        return selected


def measure_coverage(mutants: Sequence[Mutant], copy: Path, selection: Sequence[str], workers: int) -> Coverage:
    """Insert the probes of mutants into a copy of the repository, and run its tests; pytest's options select them."""
    log = copy / "probes.log"
    junit = copy / "probes.xml"
    originals = {file: (copy / file).read_text(encoding="utf-8") for file in list_files()}
    try:
        insert_probes(mutants, log, copy)
        options = ["-n", str(workers), f"--junitxml={junit}", "-o", "junit_family=xunit1", *selection]
        run_tests(copy, options, timeout_s=None)
    finally:
        for file, text in originals.items():
            (copy / file).write_text(text, encoding="utf-8")
    return read_coverage(mutants, log, [junit])


def run_tests(copy: Path, options: Sequence[str], timeout_s: float | None) -> subprocess.CompletedProcess[str]:
    """Run tests of a copy of the repository with its own packages."""
    command = [sys.executable, "-m", "pytest", "-q", "--no-header", "-p", "no:cacheprovider", *options]
    environment = {**os.environ, **make_environment(copy)}
    return subprocess.run(
        command, cwd=copy, env=environment, capture_output=True, text=True, timeout=timeout_s, check=False
    )  # fmt: skip


def make_environment(copy: Path) -> dict[str, str]:
    """Environment variables with which programs import the packages of a copy."""
    return {"PYTHONPATH": os.pathsep.join(str(copy / project) for project in PROJECTS)}


def _get_file(test: str) -> str:
    """File of a test, whose name is `FILE::FUNCTION` or `FILE::CLASS::FUNCTION`."""
    return test.partition("::")[0]


def insert_probes(mutants: Sequence[Mutant], log: Path, copy: Path) -> None:
    """Insert the probes of mutants into a copy of the repository. A probe's number is its mutant's index."""
    log.unlink(missing_ok=True)
    source = f"LOG = {str(log)!r}\n{PROBES_SOURCE}"
    (copy / "shared" / f"{PROBES_MODULE}.py").write_text(source, encoding="utf-8")
    # Numbers of the probes before each line, by file and line
    numbers_by_file: dict[Path, dict[int, set[int]]] = defaultdict(lambda: defaultdict(set))
    for number, mutant in enumerate(mutants):
        for file, line in list_probe_lines(mutant):
            numbers_by_file[file][line].add(number)
    for file, numbers_by_line in numbers_by_file.items():
        lines = (REPO / file).read_text(encoding="utf-8").splitlines()
        # From the last line to the first one, so that an inserted line moves none that is still to be probed.
        for line in sorted(numbers_by_line, reverse=True):
            # Lines count from 1.
            statement = lines[line - 1]
            indent_width = len(statement) - len(statement.lstrip())
            calls = [f"__import__('{PROBES_MODULE}').record({n})" for n in sorted(numbers_by_line[line])]
            lines.insert(line - 1, " " * indent_width + "; ".join(calls))
        (copy / file).write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_coverage(mutants: Sequence[Mutant], log: Path, reports: Iterable[Path]) -> Coverage:
    """Read the log of the probes, and the tests' durations and failures from pytest's reports (JUnit XML)."""
    coverage = Coverage()
    for report in reports:
        for case in ElementTree.parse(report).getroot().iter("testcase"):
            test = _read_test_name(case)
            if test is None:
                continue
            coverage.seconds[test] = float(case.get("time", 0.0))
            if case.find("failure") is not None or case.find("error") is not None:
                coverage.failed.append(test)
    tests: dict[str, set[str]] = defaultdict(set)
    files: dict[str, set[str]] = defaultdict(set)
    for line in set(log.read_text(encoding="utf-8").splitlines()):
        # A number, a test and its phase in brackets: `12 tests/plan/test_size.py::test_width (call)`.
        number, _, test_and_phase = line.partition(" ")
        test, _, phase = test_and_phase.rpartition(" ")
        is_outside_of_tests = not test
        if is_outside_of_tests:
            continue
        mutant = str(mutants[int(number)])
        if phase == "(call)":
            tests[mutant].add(test)
        else:
            # The phases `(setup)` and `(teardown)` run fixtures.
            files[mutant].add(_get_file(test))
    coverage.tests = {mutant: sorted(names) for mutant, names in tests.items()}
    coverage.files = {mutant: sorted(names) for mutant, names in files.items()}
    return coverage


def _read_test_name(case: ElementTree.Element) -> str | None:
    """Name of a test in a JUnit report, as pytest takes it on its command line; None without a file."""
    file = case.get("file")
    if file is None:
        return None
    # The attribute `classname` is the module, and after it the class, if the test has one.
    module = file.removesuffix(".py").replace("/", ".")
    group = str(case.get("classname")).removeprefix(module).strip(".").replace(".", "::")
    if group:
        return f"{file}::{group}::{case.get('name')}"
    return f"{file}::{case.get('name')}"


def save(coverage: Coverage, file: Path) -> None:
    file.write_text(json.dumps(vars(coverage), indent=0), encoding="utf-8")


def load(file: Path) -> Coverage:
    return Coverage(**json.loads(file.read_text(encoding="utf-8")))


def list_probe_lines(mutant: Mutant) -> list[tuple[Path, int]]:
    """Files and lines that get a probe for a mutant.

    In a function this is the changed statement. A constant of a module or a class has a probe in each function that
    uses its name; if none does, in each function of its file.
    """
    tree = _parse(mutant.file)
    function = _find_innermost(tree, mutant.line, (ast.FunctionDef, ast.AsyncFunctionDef))
    if function is not None:
        return [(mutant.file, _find_statement_line(function, mutant.line))]
    class_statement = _find_innermost(tree, mutant.line, (ast.ClassDef,))
    assignment = _find_innermost(tree, mutant.line, (ast.Assign, ast.AnnAssign))
    probe_lines: set[tuple[Path, int]] = set()
    for name in _list_assigned_names(assignment):
        probe_lines |= set(_find_uses(mutant.file, name, is_of_class=class_statement is not None))
    if class_statement is not None:
        # The default of a field matters where an object of the class is made.
        probe_lines |= set(_find_uses(mutant.file, class_statement.name, is_of_class=False))
    if not probe_lines:
        functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
        probe_lines = {(mutant.file, _find_first_line(f)) for f in functions}
    return sorted(probe_lines)


@cache
def _parse(file: Path) -> ast.Module:
    return ast.parse((REPO / file).read_text(encoding="utf-8"))


def _find_innermost(tree: ast.AST, line: int, kinds: tuple[type, ...]) -> Any:
    """The innermost node of these kinds that contains a line; None without one."""
    nodes: list[Any] = [n for n in ast.walk(tree) if isinstance(n, kinds)]
    nodes = [n for n in nodes if n.lineno <= line <= n.end_lineno]
    return max(nodes, key=lambda n: n.lineno, default=None)


def _list_assigned_names(assignment: ast.Assign | ast.AnnAssign | None) -> set[str]:
    """Plain names to which a statement assigns: not attributes, subscripts or tuples."""
    if assignment is None:
        return set()
    targets = assignment.targets if isinstance(assignment, ast.Assign) else [assignment.target]
    return {target.id for target in targets if isinstance(target, ast.Name)}


def _find_uses(file: Path, name: str, is_of_class: bool) -> Iterator[tuple[Path, int]]:
    """Statements in functions that use a name of `file`.

    Its name alone counts in `file` and in files that import it; as an attribute (`module.NAME`, `self.name`) it counts
    in every file. A name of a class (`is_of_class`) counts as an attribute only.
    """
    for using_file in list_files():
        text = (REPO / using_file).read_text(encoding="utf-8")
        if name not in text:
            continue
        tree = _parse(using_file)
        is_known = using_file == file or _imports_name(tree, name)
        for node in ast.walk(tree):
            is_plain_use = isinstance(node, ast.Name) and node.id == name and is_known and not is_of_class
            is_attribute = isinstance(node, ast.Attribute) and node.attr == name
            if is_plain_use or is_attribute:
                function = _find_innermost(tree, node.lineno, (ast.FunctionDef, ast.AsyncFunctionDef))
                if function is not None:
                    yield using_file, _find_statement_line(function, node.lineno)


def _imports_name(tree: ast.Module, name: str) -> bool:
    """True for a module with `from ... import NAME`."""
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    return any(alias.name == name for node in imports for alias in node.names)


def _find_first_line(function: Any) -> int:
    """Line of a function's first statement after its docstring."""
    body = function.body
    has_docstring = isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant)
    statement = body[1] if has_docstring and len(body) > 1 else body[0]
    return _find_start(statement)


def _find_start(statement: Any) -> int:
    """First line of a statement, with its decorators."""
    decorators = getattr(statement, "decorator_list", [])
    return min([statement.lineno, *(d.lineno for d in decorators)])


def _find_statement_line(function: Any, line: int) -> int:
    """First line of the innermost statement of a function that contains `line`, where a probe can stand before it."""
    probe_line = _find_first_line(function)
    blocks = [function.body]
    while blocks:
        for statement in blocks.pop():
            if _find_start(statement) <= line <= statement.end_lineno:
                probe_line = max(probe_line, _find_start(statement))
                blocks += _list_blocks(statement)
    return probe_line


def _list_blocks(statement: Any) -> list[list[ast.stmt]]:
    """Blocks of statements in a statement such as `if`, `try` or `match`."""
    blocks = [getattr(statement, name, []) for name in ("body", "finalbody")]
    blocks += [handler.body for handler in getattr(statement, "handlers", [])]
    blocks += [case.body for case in getattr(statement, "cases", [])]
    else_block = getattr(statement, "orelse", [])
    # The syntax tree has `elif` as an `if` alone in the block of `else`, in the same column as the first `if`. No probe
    # can stand before `elif`, only in its own blocks.
    is_elif = len(else_block) == 1 and else_block[0].col_offset == statement.col_offset
    if is_elif:
        return blocks + _list_blocks(else_block[0])
    return [*blocks, else_block]
