"""Run tests against a mutant, in a fork of a process that has imported the libraries: most tests take less than that.

The fork forgets every module of this repository, and imports the modules of a copy in which the mutant's file is
changed. The programs that the tests start import that copy, too.
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

from tests.mutants.coverage import PROJECTS, make_environment
from tests.mutants.draw import Mutant, apply_mutation
from tests.support.preloaded import LIBRARIES, PACKAGES

# First word of the outcome of a mutant that a test has noticed.
KILLED = "killed"
OWN_PACKAGES = (*PACKAGES, "polysight_worlds", "tests", "benchmarks")
# Exit status of a fork in which pytest did not run to its end; unlike any of pytest's own.
NO_RESULT = 99
PYTEST_OPTIONS = (
    "-q", "-x", "--no-header", "-p", "no:cacheprovider", "--tb=no",
    # Pytest warns of modules whose assertions it cannot rewrite: this process has already imported the libraries.
    "-W", "ignore:Module already imported:pytest.PytestAssertRewriteWarning",
)  # fmt: skip


def judge(mutant: Mutant, tests: Sequence[str], copy: Path, timeout_s: float) -> str:
    """Return "survived", "killed by TEST", or "unreached" if no test executes the changed statement."""
    if not tests:
        return "unreached"
    path = copy / mutant.file
    original = path.read_text(encoding="utf-8")
    path.write_text(apply_mutation(mutant), encoding="utf-8")
    try:
        failure = find_failure(copy, tests, timeout_s)
        return f"{KILLED} by {failure}" if failure else "survived"
    finally:
        path.write_text(original, encoding="utf-8")


def find_failure(copy: Path, tests: Sequence[str], timeout_s: float) -> str:
    """Run tests of a copy of the repository. Return the first one that fails, or "a timeout"; "" if all pass."""
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
            os._exit(NO_RESULT)
    status = _wait(child, time.monotonic() + timeout_s)
    if status is None:
        return "a timeout"
    if os.waitstatus_to_exitcode(status) == 0:
        return ""
    lines = output.read_text(encoding="utf-8", errors="replace").splitlines()
    failures = [line for line in lines if line.startswith(("FAILED ", "ERROR "))]
    if not failures:
        # An import failed, so that pytest found none of the selected tests.
        return "an import"
    # A line is `FAILED TEST` and perhaps a message.
    return failures[0].split()[1]


def _wait(child: int, deadline_s: float) -> int | None:
    """Wait status of a fork. After the deadline the fork and the programs it started are killed: None."""
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
    """Turn this fork into a process that runs pytest in the copy, and exit with pytest's status."""
    os.setsid()
    file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    # Standard output and standard error
    for descriptor in (1, 2):
        os.dup2(file, descriptor)
    os.chdir(copy)
    os.environ.update(make_environment(copy))
    for name in list(sys.modules):
        if name.partition(".")[0] in OWN_PACKAGES:
            del sys.modules[name]
    sys.path[:0] = [str(copy), *(str(copy / top) for top in PROJECTS)]
    importlib.invalidate_caches()
    status = pytest.main(list(options))
    sys.stdout.flush()
    os._exit(int(status))
