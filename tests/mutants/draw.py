"""Draw random changes of the code.

A file is drawn with a probability proportional to its size, then an operator of cosmic-ray, and then one of the
operator's occurrences in the file: the expressions that it can change.
"""

from __future__ import annotations

import random
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from cosmic_ray.ast import get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

from tests.support.paths import REPO

# The folder of each project, and the package in it.
PACKAGES = {
    "host": "polysight",
    "shared": "polysight_shared",
    "pi_controller": "polysight_pi",
    "papers": "polysight_papers",
}
# Operators (parts of their names in cosmic-ray) whose mutants say nothing about the tests. `|` and `&` of this code are
# mostly in annotations, and its decorators are mostly `property`: such mutants behave the same or cannot be imported.
# `is None` and `== None` are the same. Operators on variables need the names of two variables as arguments.
UNUSED_OPERATORS = (
    "BitOr",
    "BitAnd",
    "BitXor",
    "RShift",
    "LShift",
    "Decorator",
    "ReplaceUnaryOperator_Delete",
    "Variable",
    "Is_Eq",
    "IsNot_NotEq",
)


@dataclass(frozen=True)
class Mutant:
    """One change: the `occurrence`-th expression of a file that an operator can change, counted from 0.

    `file` is relative to the root of the repository; `line` is that of the expression.
    """

    file: Path
    operator: str
    occurrence: int
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line} {self.operator.removeprefix('core/')} {self.occurrence}"

    @property
    def package(self) -> str:
        """Name of the package in `host/polysight`, such as `imaging`; elsewhere the folder of the project."""
        folders = self.file.parts[:-1]
        if folders[0] == "host" and len(folders) > 2:
            return folders[2]
        return folders[0]


def list_files() -> list[Path]:
    """Files that mutants may change, relative to the root of the repository."""
    files: list[Path] = []
    for project, package in PACKAGES.items():
        files.extend((REPO / project / package).rglob("*.py"))
    return sorted(f.relative_to(REPO) for f in files)


def draw_mutants(count: int, seed: int) -> list[Mutant]:
    """Draw `count` different mutants that Python can compile, sorted by file and line."""
    generator = random.Random(seed)
    files = list_files()
    sizes = [(REPO / f).stat().st_size for f in files]
    operators = [n for n in operator_names() if not any(word in n for word in UNUSED_OPERATORS)]
    mutants: set[Mutant] = set()
    while len(mutants) < count:
        (file,) = generator.choices(files, weights=sizes)
        operator = generator.choice(operators)
        lines = _find_lines(file, operator)
        if lines:
            occurrence = generator.randrange(len(lines))
            mutant = Mutant(file, operator, occurrence, lines[occurrence])
            if apply_mutation(mutant):
                mutants.add(mutant)
    return sorted(mutants, key=lambda m: (m.file, m.line, m.operator))


def apply_mutation(mutant: Mutant) -> str:
    """Return the text of the changed file; "" if nothing changes, or if Python rejects it or warns of its syntax."""
    original = (REPO / mutant.file).read_text(encoding="utf-8")
    mutated = mutate_code(original, get_operator(mutant.operator)(), mutant.occurrence)
    if mutated is None or mutated == original:
        return ""
    try:
        with warnings.catch_warnings():
            # Python warns of `is` with a text or a number: such a mutant would be noticed without any test.
            warnings.simplefilter("error", SyntaxWarning)
            compile(mutated, str(mutant.file), "exec")
    except SyntaxError:
        # The operator that replaces powers (`**`) also replaces the two stars before an unpacked dictionary.
        return ""
    return mutated


def _find_lines(file: Path, operator: str) -> list[int]:
    """Line of each expression in a file that an operator can change."""
    find_positions = get_operator(operator)().mutation_positions
    lines = []
    for node in _list_nodes(file):
        # A position is a start and an end, each a line and a column.
        lines.extend(start[0] for start, _ in find_positions(node))
    return lines


@cache
def _list_nodes(file: Path) -> list[Any]:
    """All nodes of a file's syntax tree."""
    return list(_walk(get_ast((REPO / file).read_text(encoding="utf-8"))))


def _walk(node: Any) -> Iterator[Any]:
    yield node
    for child in getattr(node, "children", ()):
        yield from _walk(child)
