"""Each program starts as a process of its own, and behaves like the forked process that other tests use instead.

Other tests fork programs from a process that has loaded their modules, which takes less time.
"""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from tests.support.paths import BIN
from tests.support.processes import list_processes_naming, wait_for

MODULE = (sys.executable, "-m")
PROGRAMS = [
    (BIN / "polysight", "--help"),
    (BIN / "polysight", "process", "nowhere"),
    (BIN / "polysight-pi", "--help"),
    (*MODULE, "polysight", "validate", "nowhere"),
    (*MODULE, "polysight_pi", "check", "--config", "nowhere.toml"),
    *((*MODULE, f"polysight.{name}") for name in ("capture.receiver_process", "jobs.batch")),
    (*MODULE, "polysight_simulators", "simulate", "--help"),
    *(
        (*MODULE, f"polysight_simulators.{name}", "--help")
        for name in ("cards", "radars", "rig", "stage", "uno", "wires")
    ),
]
# Tests fork commands that begin with the name of a program. A command that begins with `env` is really started.
REAL = ("env",)


@pytest.mark.parametrize("command", PROGRAMS, ids=lambda command: " ".join(map(str, command[1:])))
def test_a_forked_program_has_the_output_and_the_status_of_one_that_is_started(
    tmp_path: Path, command: tuple[str | Path, ...]
):
    forked = subprocess.run(command, cwd=tmp_path, input="", capture_output=True, text=True, check=False)
    real = subprocess.run([*REAL, *command], cwd=tmp_path, input="", capture_output=True, text=True, check=False)
    assert forked.returncode == real.returncode
    assert forked.stdout == real.stdout
    # A traceback of the forked program has more lines, but the last one is the same.
    assert forked.stderr.splitlines()[-1:] == real.stderr.splitlines()[-1:]


def test_a_forked_program_has_the_command_line_parent_session_and_end_of_a_started_one(tmp_path: Path):
    command = [*MODULE, "polysight_simulators.wires", "--socket", tmp_path / "wires"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as program:
        assert program.stdout is not None
        assert program.stdout.readline().startswith(b"ready")
        command_line = " ".join(map(str, command))
        processes = list_processes_naming(str(tmp_path))
        assert list(processes) == [program.pid]
        assert processes[program.pid].rstrip() == command_line
        assert os.getsid(program.pid) == os.getpgid(program.pid) == program.pid
        status = Path(f"/proc/{program.pid}/status").read_text()
        assert f"PPid:\t{os.getpid()}\n" in status
        os.killpg(program.pid, signal.SIGKILL)
    assert program.returncode == -signal.SIGKILL
    wait_for(lambda: not list_processes_naming(str(tmp_path)), "the end of all its processes")
