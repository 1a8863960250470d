"""`python -m tests.mutants --count 100`: change the code at random places, and count how many changes tests notice.

A mutant is a scratch copy of the repository with one change, made by an operator of cosmic-ray: another comparison,
number, arithmetic sign or condition. First the suite without its slow tests runs once, to find the tests that execute
each statement to be changed. These tests then run against the mutant, those of its own package first. A mutant is
killed if a test fails or hangs. If it survives, either the change has no effect or no test states the law that it
breaks: read it, and write that test. 100 mutants take an hour or two.
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

from tests.mutants.coverage import measure_coverage
from tests.mutants.draw import draw_mutants
from tests.mutants.judge import KILLED, judge
from tests.support.paths import REPO

# More workers than cores, because tests spend much of their time waiting.
WORKERS = 2 + (os.cpu_count() or 1)
# Tests run against a mutant until their durations, measured without mutants, add up to this.
TESTS_S = 300.0
# The tests of a mutant count as hanging after this many times their measured duration, to which the time is added in
# which a process with all its imports starts on a busy machine.
HANG_FACTOR = 10.0
START_S = 120.0
# Exit status 0 needs at least this share of killed mutants.
REQUIRED_SHARE = 0.9


def main(argv: Sequence[str] | None = None) -> int:
    """Draw and judge mutants; print survivors and the killed ones of each package. 1 if less than 90 % are killed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1, help="another number draws other changes (default: 1)")
    args = parser.parse_args(argv)
    mutants = draw_mutants(args.count, args.seed)
    killed: Counter[str] = Counter()
    judged: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="polysight-mutants-") as folder:
        copy = Path(folder, "repository")
        ignored = shutil.ignore_patterns(".venv", Path(sys.prefix).name, ".git", "out", "__pycache__")
        shutil.copytree(REPO, copy, symlinks=True, ignore=ignored)
        sys.stdout.write(f"which tests execute the statements of {len(mutants)} mutants?\n")
        sys.stdout.flush()
        coverage = measure_coverage(mutants, copy, selection=["-m", "not slow"], workers=WORKERS)
        for number, mutant in enumerate(mutants, 1):
            tests = coverage.select_tests(mutant, TESTS_S)
            expected_s = sum(coverage.seconds[test] for test in tests)
            outcome = judge(mutant, tests, copy, timeout_s=START_S + HANG_FACTOR * expected_s)
            judged[mutant.package] += 1
            if outcome.startswith(KILLED):
                killed[mutant.package] += 1
            sys.stdout.write(f"{number}/{args.count} {outcome}: {mutant}\n")
            sys.stdout.flush()
    for package, count in sorted(judged.items()):
        sys.stdout.write(f"{package}: {killed[package]} of {count}\n")
    killed_share = killed.total() / max(1, judged.total())
    sys.stdout.write(f"{killed.total()} of {judged.total()} mutants killed ({100 * killed_share:.0f} %)\n")
    return 0 if killed_share >= REQUIRED_SHARE else 1


if __name__ == "__main__":
    sys.exit(main())
