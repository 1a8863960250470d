"""`python -m tests.mutants --count 100`: change the code at random places, and report if a test notices.

Each mutant is one change by an operator of cosmic-ray (a comparison, a number, an arithmetic sign, a condition) in a
scratch copy of the repository. The tests of its room run against it, then, if all pass, the whole suite but its slowest
tests; it is killed when one fails or hangs. A survivor shows a law that no test states, or a change without effect:
read it, and write the law. A test that is unrelated to the mutant it killed fails by chance. 100 mutants take some
hours.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

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
TESTS_OF_PACKAGE = {"polysight_shared": "shared", "polysight_pi": "pi", "polysight_papers": "papers"}
TESTS_OF_ROOM = {"planning": "plan", "results": "verdict"}
TIMEOUT_S = 900
# `|` and `&` stand in annotations, decorators are properties: their mutants are equivalent or do not import.
# Operators on variables need the names of two.
UNUSED_OPERATORS = (
    "BitOr",
    "BitAnd",
    "BitXor",
    "RShift",
    "LShift",
    "Decorator",
    "ReplaceUnaryOperator_Delete",
    "Variable",
)


@dataclass(frozen=True)
class Mutant:
    """A change of one place: the file from the root, and the name and number of the operator's occurrence in it."""

    file: Path
    operator: str
    occurrence: int

    @property
    def tests(self) -> Path:
        """Folder of the tests of its room, from the root."""
        package = self.file.parts[1]
        room = self.file.parts[2].removesuffix(".py")
        folder = Path("tests", TESTS_OF_PACKAGE.get(package) or TESTS_OF_ROOM.get(room, room))
        return folder if (REPO / folder).is_dir() else Path("tests", "process")


def draw_mutants(count: int, seed: int) -> list[Mutant]:
    """Draw places at random: a file by its size, then an operator that fits, then one of its places."""
    generator = random.Random(seed)
    files = [f for top, package in PACKAGES.items() for f in sorted((REPO / top / package).rglob("*.py"))]
    sizes = [f.stat().st_size for f in files]
    operators = [n for n in operator_names() if not any(word in n for word in UNUSED_OPERATORS)]
    mutants: set[Mutant] = set()
    while len(mutants) < count:
        file = generator.choices(files, sizes)[0]
        name = generator.choice(operators)
        places = sum(1 for node in _walk(get_ast(file.read_text(encoding="utf-8"))) for _ in _positions(name, node))
        if places:
            mutants.add(Mutant(file.relative_to(REPO), name, generator.randrange(places)))
    return sorted(mutants, key=lambda m: (str(m.tests), str(m.file), m.operator, m.occurrence))


def _walk(node):
    yield node
    for child in getattr(node, "children", ()):
        yield from _walk(child)


def _positions(operator: str, node):
    return get_operator(operator)().mutation_positions(node)


def judge(mutant: Mutant, copy: Path) -> str:
    """Return `survived`, `invalid` (no change, no Python) or `killed by TEST`, tried in a copy of the repository."""
    path = copy / mutant.file
    original = path.read_text(encoding="utf-8")
    mutated = mutate_code(original, get_operator(mutant.operator)(), mutant.occurrence)
    if mutated is None or mutated == original:
        return "invalid"
    try:
        compile(mutated, path, "exec")
    except SyntaxError:
        # Two stars before a dictionary are not a power, but the operator takes them for one.
        return "invalid"
    path.write_text(mutated, encoding="utf-8")
    try:
        failed = find_failure(copy, [str(mutant.tests)]) or find_failure(copy, ["-m", "not slow"])
        return f"killed by {failed}" if failed else "survived"
    finally:
        path.write_text(original, encoding="utf-8")


def find_failure(copy: Path, selection: Sequence[str]) -> str:
    """Run tests of a copy of the repository; return the name of one that fails, or that they hang; "" if all pass."""
    paths = os.pathsep.join(str(copy / top) for top in ("shared", "pi_controller", "simulators", "host", "papers"))
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "4", "--no-header", *selection]
    environment = {**os.environ, "PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        process = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return "a timeout"
    if process.returncode == 0:
        return ""
    failures = [line for line in process.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return failures[0].split()[1] if failures else "an import"


def main(argv: Sequence[str] | None = None) -> int:
    """Draw mutants, judge each, and print survivors and the share of killed ones; 1 if it is below 90 %."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1, help="other places (default: 1)")
    args = parser.parse_args(argv)
    outcomes: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="polysight-mutants-") as folder:
        copy = Path(folder, "repository")
        shutil.copytree(REPO, copy, ignore=shutil.ignore_patterns(".venv", ".git", "out", "__pycache__"))
        for number, mutant in enumerate(draw_mutants(args.count, args.seed), 1):
            outcome = judge(mutant, copy)
            outcomes[outcome.partition(" ")[0]] += 1
            place = f"{mutant.file} {mutant.operator} {mutant.occurrence}"
            sys.stdout.write(f"{number}/{args.count} {outcome}: {place}\n")
            sys.stdout.flush()
    judged = outcomes["killed"] + outcomes["survived"]
    share = outcomes["killed"] / max(1, judged)
    sys.stdout.write(f"{outcomes['killed']} of {judged} mutants killed ({100 * share:.0f} %)\n")
    return 0 if share >= 0.9 else 1


if __name__ == "__main__":
    sys.exit(main())
