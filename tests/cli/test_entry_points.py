"""Each of our programs starts as a real process, and the forked process of other tests behaves like it."""

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
# The arguments after `env` are the same, and `env` is not a program of ours.
REAL = ("env",)


@pytest.mark.parametrize("command", PROGRAMS, ids=lambda command: " ".join(map(str, command[1:])))
def test_a_fork_is_as_the_program_started_for_real(tmp_path: Path, command: tuple[str | Path, ...]):
    forked = subprocess.run(command, cwd=tmp_path, input="", capture_output=True, text=True, check=False)
    real = subprocess.run([*REAL, *command], cwd=tmp_path, input="", capture_output=True, text=True, check=False)
    assert (forked.returncode, forked.stdout) == (real.returncode, real.stdout)
    # Of a traceback the last line: the fork's has more.
    assert forked.stderr.splitlines()[-1:] == real.stderr.splitlines()[-1:]


def test_a_fork_has_its_own_words_parent_session_and_end(tmp_path: Path):
    command = [*MODULE, "polysight_simulators.wires", "--socket", tmp_path / "wires"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, start_new_session=True) as program:
        assert program.stdout is not None
        assert program.stdout.readline().startswith(b"ready")
        words = " ".join(map(str, command))
        assert {pid: line.rstrip() for pid, line in list_processes_naming(str(tmp_path)).items()} == {
            program.pid: words
        }
        assert os.getsid(program.pid) == os.getpgid(program.pid) == program.pid
        status = Path(f"/proc/{program.pid}/status").read_text()
        assert f"PPid:\t{os.getpid()}\n" in status
        os.killpg(program.pid, signal.SIGKILL)
    assert program.returncode == -signal.SIGKILL
    wait_for(lambda: not list_processes_naming(str(tmp_path)), "that nothing of it is left")
