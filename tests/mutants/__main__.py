"""`python -m tests.mutants --count 100`: change the code at random places, and see whether a test notices.

Each mutant is one change by an operator of cosmic-ray (a comparison, a number, an arithmetic sign, a condition) in a
scratch copy of the repository. First the suite but its slowest tests runs once, to see which tests come to each place.
Then these run against the mutant, those of its room first; it is killed when one fails or hangs. A survivor is a law
that no test states, or a change without effect: read it, and write the law. 100 mutants take an hour or two.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from tests.mutants.draw import draw_mutants
from tests.mutants.judge import judge
from tests.mutants.reach import find_reach
from tests.support.paths import REPO

# Tests wait a good part of their time.
WORKERS = 2 + (os.cpu_count() or 1)
# Of the tests that come to a mutant, as many as take this long by themselves
TESTS_S = 300.0
# A test that takes this many times longer beside other work hangs; a start takes some seconds, or a minute.
PATIENCE = 10.0
START_S = 120.0


def main(argv: Sequence[str] | None = None) -> int:
    """Draw mutants, judge each, and print survivors and the share of killed ones by room; 1 if it is below 90 %."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1, help="other places (default: 1)")
    args = parser.parse_args(argv)
    mutants = draw_mutants(args.count, args.seed)
    killed: Counter[str] = Counter()
    judged: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="polysight-mutants-") as folder:
        copy = Path(folder, "repository")
        ignored = shutil.ignore_patterns(".venv", Path(sys.prefix).name, ".git", "out", "__pycache__")
        shutil.copytree(REPO, copy, symlinks=True, ignore=ignored)
        sys.stdout.write(f"which tests come to the places of {len(mutants)} mutants?\n")
        sys.stdout.flush()
        reach = find_reach(mutants, copy, ["-m", "not slow"], WORKERS)
        for number, mutant in enumerate(mutants, 1):
            tests = reach.select(mutant, TESTS_S)
            expected_s = sum(reach.seconds[test] for test in tests)
            outcome = judge(mutant, tests, copy, START_S + PATIENCE * expected_s)
            judged[mutant.room] += 1
            killed[mutant.room] += outcome.startswith("killed")
            sys.stdout.write(f"{number}/{args.count} {outcome}: {mutant}\n")
            sys.stdout.flush()
    for room, count in sorted(judged.items()):
        sys.stdout.write(f"{room}: {killed[room]} of {count}\n")
    share = killed.total() / max(1, judged.total())
    sys.stdout.write(f"{killed.total()} of {judged.total()} mutants killed ({100 * share:.0f} %)\n")
    return 0 if share >= 0.9 else 1


if __name__ == "__main__":
    sys.exit(main())
