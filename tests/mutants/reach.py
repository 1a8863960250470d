"""Find the tests that run a changed line of the code: one run of the suite against a copy with a mark at each line.

A mark is an added statement before the one that a mutant changes. When it runs, it writes its number and the name of
the running test to a file; programs that the test has started know its name from their environment. A constant of a
module or class is evaluated at its import, so that it is marked where it is used.
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

# Packages (rooms) whose tests lie in a folder of another name.
TESTS_OF_ROOM = {"pi_controller": "pi", "planning": "plan", "results": "verdict"}
FLAGS = "tests/house/test_flags.py"
PROJECTS = ("shared", "pi_controller", "simulators", "host", "papers", "worlds")
MARKS_MODULE = "marks_of_mutants"
# `os.environ[...]` decodes the whole value at each call, and marks stand in inner loops.
MARKS_SOURCE = """
import os
_NAMES = os.environ._data
_seen = set()
def pass_by(number):
    test = _NAMES.get(b"PYTEST_CURRENT_TEST", b"")
    if (number, test) in _seen:
        return
    _seen.add((number, test))
    file = os.open(FILE, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(file, b"%d %s\\n" % (number, test))
    os.close(file)
"""


@dataclass
class Reach:
    """What the suite's run on the marked copy has shown.

    `tests[mark]` are the tests that came by, `files[mark]` the files with a fixture that did. `seconds` is the duration
    of each test, `failed` are those that fail without a mutant: they judge none.
    """

    tests: dict[str, list[str]] = field(default_factory=dict)
    files: dict[str, list[str]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)

    def select(self, mutant: Mutant, limit_s: float) -> list[str]:
        """Tests that may notice a mutant, those of its room first, then the quickest, until `limit_s` are full."""
        tests = set(self.tests.get(str(mutant), ()))
        files = set(self.files.get(str(mutant), ()))
        tests |= {test for test in self.seconds if _cut_file(test) in files}
        tests -= set(self.failed)

        folder = TESTS_OF_ROOM.get(mutant.room, mutant.room)

        def order(test: str) -> tuple[bool, float]:
            return not test.startswith(f"tests/{folder}/"), self.seconds.get(test, 0.0)

        # An exchanged True and False may be the argument of a struct or a default, which only the tests that read the
        # code notice: these run for each such mutant, also if no test runs its line.
        selected = [FLAGS] if "True" in mutant.operator else []
        spent_s = 0.0
        for test in sorted(tests, key=order):
            spent_s += self.seconds.get(test, 0.0)
            if spent_s <= limit_s:
                selected.append(test)
        return selected


def find_reach(mutants: Sequence[Mutant], copy: Path, selection: Sequence[str], workers: int) -> Reach:
    """Mark the places of mutants in a copy of the repository, and run tests of it."""
    log = copy / "marks.log"
    junit = copy / "marks.xml"
    originals = {file: (copy / file).read_text(encoding="utf-8") for file in list_files()}
    try:
        mark(mutants, log, copy)
        options = ["-n", str(workers), f"--junitxml={junit}", "-o", "junit_family=xunit1", *selection]
        run_tests(copy, options, timeout_s=None)
    finally:
        for file, text in originals.items():
            (copy / file).write_text(text, encoding="utf-8")
    return read_marks(mutants, log, [junit])


def run_tests(copy: Path, options: Sequence[str], timeout_s: float | None) -> subprocess.CompletedProcess[str]:
    """Run tests of a copy of the repository with its own packages."""
    command = [sys.executable, "-m", "pytest", "-q", "--no-header", "-p", "no:cacheprovider", *options]
    environment = {**os.environ, **find_environment(copy)}
    return subprocess.run(
        command, cwd=copy, env=environment, capture_output=True, text=True, timeout=timeout_s, check=False
    )  # fmt: skip


def find_environment(copy: Path) -> dict[str, str]:
    """Variables with which programs import the packages of a copy."""
    return {"PYTHONPATH": os.pathsep.join(str(copy / top) for top in PROJECTS)}


def _cut_file(test: str) -> str:
    return test.partition("::")[0]


def mark(mutants: Sequence[Mutant], log: Path, copy: Path) -> None:
    """Mark the places of mutants in a copy of the repository; marks note in `log` who came by."""
    log.unlink(missing_ok=True)
    source = f"FILE = {str(log)!r}\n{MARKS_SOURCE}"
    (copy / "shared" / f"{MARKS_MODULE}.py").write_text(source, encoding="utf-8")
    marks: dict[Path, dict[int, set[int]]] = defaultdict(lambda: defaultdict(set))
    for number, mutant in enumerate(mutants):
        for file, line in find_marks(mutant):
            marks[file][line].add(number)
    for file, numbers_at in marks.items():
        lines = (REPO / file).read_text(encoding="utf-8").splitlines()
        for line in sorted(numbers_at, reverse=True):
            marked_line = lines[line - 1]
            indent = " " * (len(marked_line) - len(marked_line.lstrip()))
            calls = [f"__import__('{MARKS_MODULE}').pass_by({n})" for n in sorted(numbers_at[line])]
            lines.insert(line - 1, indent + "; ".join(calls))
        (copy / file).write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_marks(mutants: Sequence[Mutant], log: Path, reports: Iterable[Path]) -> Reach:
    """Read what the marks noted, and the durations of the tests."""
    reach = Reach()
    cases = [case for report in reports for case in ElementTree.parse(report).getroot().iter("testcase")]
    for case in cases:
        test = f"{case.get('file')}::{case.get('name')}"
        if case.get("file") is None:
            continue
        # A class stands between the file and the name, but not in the attribute `name`.
        module = str(case.get("file")).removesuffix(".py").replace("/", ".")
        group = str(case.get("classname")).removeprefix(module).strip(".").replace(".", "::")
        if group:
            test = f"{case.get('file')}::{group}::{case.get('name')}"
        reach.seconds[test] = float(case.get("time", 0.0))
        if case.find("failure") is not None or case.find("error") is not None:
            reach.failed.append(test)
    tests: dict[str, set[str]] = defaultdict(set)
    files: dict[str, set[str]] = defaultdict(set)
    for line in set(log.read_text(encoding="utf-8").splitlines()):
        number, _, current = line.partition(" ")
        test, _, phase = current.rpartition(" ")
        if not test:
            continue
        name = str(mutants[int(number)])
        if phase == "(call)":
            tests[name].add(test)
        else:
            files[name].add(_cut_file(test))
    reach.tests = {name: sorted(values) for name, values in tests.items()}
    reach.files = {name: sorted(values) for name, values in files.items()}
    return reach


def save(reach: Reach, file: Path) -> None:
    file.write_text(json.dumps(vars(reach), indent=0), encoding="utf-8")


def load(file: Path) -> Reach:
    return Reach(**json.loads(file.read_text(encoding="utf-8")))


def find_marks(mutant: Mutant) -> list[tuple[Path, int]]:
    """Files and lines to be marked for a mutant.

    In a function this is the mutant's own statement. A constant of a module or class is marked where its name is used;
    if it is used nowhere, each function of its file is marked.
    """
    tree = _parse(mutant.file)
    function = _find_innermost(tree, mutant.line, (ast.FunctionDef, ast.AsyncFunctionDef))
    if function is not None:
        return [(mutant.file, _find_statement_line(function, mutant.line))]
    class_of = _find_innermost(tree, mutant.line, (ast.ClassDef,))
    statement = _find_innermost(tree, mutant.line, (ast.Assign, ast.AnnAssign))
    names = {_find_name(target) for target in _list_targets(statement)}
    marks = {mark for name in names for mark in _find_users(mutant.file, name, in_class=class_of is not None)}
    if class_of is not None:
        # The default of a field matters where an object of the class is made.
        marks |= set(_find_users(mutant.file, class_of.name, in_class=False))
    if not marks:
        functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
        marks = {(mutant.file, _find_first_line(f)) for f in functions}
    return sorted(marks)


@cache
def _parse(file: Path) -> ast.Module:
    return ast.parse((REPO / file).read_text(encoding="utf-8"))


def _find_innermost(tree: ast.AST, line: int, kinds: tuple[type, ...]) -> Any:
    nodes: list[Any] = [n for n in ast.walk(tree) if isinstance(n, kinds)]
    nodes = [n for n in nodes if n.lineno <= line <= n.end_lineno]
    return max(nodes, key=lambda n: n.lineno, default=None)


def _list_targets(statement: ast.AST | None) -> Iterable[ast.expr]:
    if isinstance(statement, ast.Assign):
        return statement.targets
    if isinstance(statement, ast.AnnAssign):
        return [statement.target]
    return []


def _find_name(target: ast.expr) -> str:
    return target.id if isinstance(target, ast.Name) else ""


def _find_users(file: Path, name: str, in_class: bool) -> Iterator[tuple[Path, int]]:
    """Statements in functions that use a name of `file`: there and where it is imported by the name alone, or anywhere
    as an attribute (`module.NAME`, `self.name`). `in_class`: the name is a class's, so that only attributes count.
    """
    if not name:
        return
    for importing_file in list_files():
        text = (REPO / importing_file).read_text(encoding="utf-8")
        if name not in text:
            continue
        tree = _parse(importing_file)
        is_imported = importing_file == file or any(
            alias.name == name for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) for alias in n.names
        )
        for node in ast.walk(tree):
            by_itself = isinstance(node, ast.Name) and node.id == name and is_imported and not in_class
            as_attribute = isinstance(node, ast.Attribute) and node.attr == name
            if by_itself or as_attribute:
                function = _find_innermost(tree, node.lineno, (ast.FunctionDef, ast.AsyncFunctionDef))
                if function is not None:
                    yield importing_file, _find_statement_line(function, node.lineno)


def _find_first_line(function: Any) -> int:
    """Line of a function's first statement after its docstring."""
    body = function.body
    has_text = isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant)
    statement = body[1] if has_text and len(body) > 1 else body[0]
    return _start(statement)


def _start(statement: Any) -> int:
    decorators = getattr(statement, "decorator_list", [])
    return min([statement.lineno, *(d.lineno for d in decorators)])


def _find_statement_line(function: Any, line: int) -> int:
    """Line of the innermost statement of a function that contains `line`; a mark may stand before it."""
    mark_line = _find_first_line(function)
    blocks = [function.body]
    while blocks:
        for statement in blocks.pop():
            if _start(statement) <= line <= statement.end_lineno:
                mark_line = max(mark_line, _start(statement))
                blocks += _list_blocks(statement)
    return mark_line


def _list_blocks(statement: Any) -> list[list[ast.stmt]]:
    """Blocks of statements within a statement."""
    blocks = [getattr(statement, name, []) for name in ("body", "finalbody")]
    blocks += [handler.body for handler in getattr(statement, "handlers", [])]
    blocks += [case.body for case in getattr(statement, "cases", [])]
    otherwise = getattr(statement, "orelse", [])
    is_elif = len(otherwise) == 1 and otherwise[0].col_offset == statement.col_offset
    # Nothing can stand between the branches of `elif`, only in them.
    return blocks + (_list_blocks(otherwise[0]) if is_elif else [otherwise])
