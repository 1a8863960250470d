"""Draw random changes of the code: a file by its size, an operator of cosmic-ray, one place where it applies."""

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

PACKAGES = {
    "host": "polysight",
    "shared": "polysight_shared",
    "pi_controller": "polysight_pi",
    "papers": "polysight_papers",
}
# `|` and `&` stand in annotations, decorators are properties: their mutants are equivalent or do not import. What is
# None is equal to None. Operators on variables need the names of two.
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
    """A change of one place: the file from the root, and the name and number of the operator's occurrence in it."""

    file: Path
    operator: str
    occurrence: int
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line} {self.operator.removeprefix('core/')} {self.occurrence}"

    @property
    def room(self) -> str:
        """Room of `host`, or the name of another package."""
        is_module_of_host = self.file.parts[0] == "host" and len(self.file.parts) > 3
        return self.file.parts[2] if is_module_of_host else self.file.parts[0]


def list_files() -> list[Path]:
    """Files that are changed, from the root."""
    files = [f for top, package in PACKAGES.items() for f in (REPO / top / package).rglob("*.py")]
    return sorted(f.relative_to(REPO) for f in files)


def draw_mutants(count: int, seed: int) -> list[Mutant]:
    """Draw `count` different mutants that are Python, sorted by file."""
    generator = random.Random(seed)
    files = list_files()
    sizes = [(REPO / f).stat().st_size for f in files]
    operators = [n for n in operator_names() if not any(word in n for word in UNUSED_OPERATORS)]
    mutants: set[Mutant] = set()
    while len(mutants) < count:
        file = generator.choices(files, sizes)[0]
        operator = generator.choice(operators)
        lines = _find_lines(file, operator)
        if lines:
            occurrence = generator.randrange(len(lines))
            mutant = Mutant(file, operator, occurrence, lines[occurrence])
            if apply_mutation(mutant):
                mutants.add(mutant)
    return sorted(mutants, key=lambda m: (m.file, m.line, m.operator))


def apply_mutation(mutant: Mutant) -> str:
    """Return the changed file's text; empty if it is not changed, or no Python without a warning."""
    original = (REPO / mutant.file).read_text(encoding="utf-8")
    mutated = mutate_code(original, get_operator(mutant.operator)(), mutant.occurrence)
    if mutated is None or mutated == original:
        return ""
    try:
        with warnings.catch_warnings():
            # Python itself warns of an identity with a text or number.
            warnings.simplefilter("error", SyntaxWarning)
            compile(mutated, str(mutant.file), "exec")
    except SyntaxError:
        # Two stars before a dictionary are not a power, but the operator takes them for one.
        return ""
    return mutated


def _find_lines(file: Path, operator: str) -> list[int]:
    """Line of each occurrence of an operator in a file."""
    find_positions = get_operator(operator)().mutation_positions
    return [start[0] for node in _list_nodes(file) for start, _ in find_positions(node)]


@cache
def _list_nodes(file: Path) -> list[Any]:
    return list(_walk(get_ast((REPO / file).read_text(encoding="utf-8"))))


def _walk(node: Any) -> Iterator[Any]:
    yield node
    for child in getattr(node, "children", ()):
        yield from _walk(child)
