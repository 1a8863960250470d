"""Run tests against a mutant: in a fork of a process that has loaded the libraries, for most tests take less than that.

Nothing of the repository stays loaded in the fork: it reads all from a copy in which the mutant's file is changed. So
do the programs that the tests start.
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import pytest

from tests.mutants.draw import Mutant, apply_mutation
from tests.mutants.reach import PROJECTS, find_environment
from tests.support.preloaded import LIBRARIES, PACKAGES

OWN_PACKAGES = (*PACKAGES, "polysight_worlds", "tests", "benchmarks")
PYTEST_OPTIONS = (
    "-q", "-x", "--no-header", "-p", "no:cacheprovider", "--tb=no",
    # Libraries that were loaded before pytest began.
    "-W", "ignore:Module already imported:pytest.PytestAssertRewriteWarning",
)  # fmt: skip


def judge(mutant: Mutant, tests: Sequence[str], copy: Path, timeout_s: float) -> str:
    """Return `survived` or `killed by TEST`; "unreached" if no test comes to its place."""
    if not tests:
        return "unreached"
    path = copy / mutant.file
    original = path.read_text(encoding="utf-8")
    path.write_text(apply_mutation(mutant), encoding="utf-8")
    try:
        failed = find_failure(copy, tests, timeout_s)
        return f"killed by {failed}" if failed else "survived"
    finally:
        path.write_text(original, encoding="utf-8")


def find_failure(copy: Path, tests: Sequence[str], timeout_s: float) -> str:
    """Run tests of a copy of the repository; return the first that fails, or that they hang; "" if all pass."""
    for library in LIBRARIES:
        importlib.import_module(library)
    output = copy / "judged.txt"
    selection = copy / "selection.txt"
    selection.write_text("\n".join(tests), encoding="utf-8")
    sys.stdout.flush()
    child = os.fork()
    if not child:
        try:
            _run_in_fork(copy, output, [*PYTEST_OPTIONS, f"@{selection}"])
        finally:
            os._exit(99)
    status = _wait(child, time.monotonic() + timeout_s)
    if status is None:
        return "a timeout"
    # Also 5: none of the selected tests is found where an import of theirs fails.
    if os.waitstatus_to_exitcode(status) == 0:
        return ""
    lines = output.read_text(encoding="utf-8", errors="replace").splitlines()
    failures = [line for line in lines if line.startswith(("FAILED ", "ERROR "))]
    return failures[0].split()[1] if failures else "an import"


def _wait(child: int, deadline_s: float) -> int | None:
    """Exit status of a fork; None, and it is killed with its programs, if it takes longer."""
    while time.monotonic() < deadline_s:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return status
        time.sleep(0.05)
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def _run_in_fork(copy: Path, output: Path, options: Sequence[str]) -> None:
    """Become a process that has started with pytest in the copy. Does not return."""
    os.setsid()
    file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for number in (1, 2):
        os.dup2(file, number)
    os.chdir(copy)
    os.environ.update(find_environment(copy))
    for name in list(sys.modules):
        if name.partition(".")[0] in OWN_PACKAGES:
            del sys.modules[name]
    sys.path[:0] = [str(copy), *(str(copy / top) for top in PROJECTS)]
    importlib.invalidate_caches()
    status = pytest.main(list(options))
    sys.stdout.flush()
    os._exit(int(status))
