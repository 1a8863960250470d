"""Simulated stages as processes, whose trigger edges are recorded by the test or sent to a hub of simulated wires."""

import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from polysight_shared.wires import WireEdge, WireMessage, WireMotion, parse
from tests.support.paths import REPO, RIG_FILE
from tests.support.processes import HANG_S, LIMIT_S, read_idle_s

# The commands of a stage: the sketch for this machine, its Python stand-in, machine code on an emulated UNO.
COMMANDS = {"pc": ("stage",), "python": ("stage", "--python"), "uno": ("uno",)}


class StageProcess:
    """`python -m polysight_simulators.stage` or `.uno` at the port `link`.

    Without a `hub` the wires end here: `messages` has the messages on them.
    """

    def __init__(
        self, folder: Path, kind: str, time_scale: float = 1.0, hub: Path | None = None, config: Path = RIG_FILE
    ) -> None:
        self.link = folder / "ttySTAGE"
        self.messages: list[WireMessage] = []
        module, *options = COMMANDS[kind]
        command = [sys.executable, "-m", f"polysight_simulators.{module}", "--config", config, *options]
        wires = ("--wires", hub or folder / "wires")
        command += [*wires, "--boot-ms", 50, "--link", self.link, "--time-scale", time_scale]
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
            listener.bind(str(folder / "wires"))
            listener.listen()
            listener.settimeout(HANG_S)
            pipe = subprocess.PIPE
            self.process = subprocess.Popen(list(map(str, command)), stdout=pipe, stderr=pipe, text=True, cwd=REPO)
            self._listener = threading.Thread(target=self._listen, daemon=True)
            if hub is None:
                self.wires, _ = listener.accept()
                self._listener.start()
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == f"ready {self.link}\n"

    def _listen(self) -> None:
        with self.wires, self.wires.makefile("r", encoding="ascii") as lines:
            for line in lines:
                self.messages.append(parse(line))

    @property
    def rising(self) -> list[WireEdge]:
        return [e for e in self.messages if isinstance(e, WireEdge) and e.value]

    @property
    def motions(self) -> list[WireMotion]:
        return [m for m in self.messages if isinstance(m, WireMotion)]

    def end(self, number: int = signal.SIGTERM) -> list[WireMessage]:
        """End the stage with a signal; return all messages that were on its wires."""
        self.process.send_signal(number)
        assert self.process.wait(HANG_S) == 0
        self._listener.join(HANG_S)
        assert not self.link.is_symlink()
        return self.messages

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
        if self._listener.ident:
            self._listener.join(HANG_S)


# A program that runs a command, prints the process id of that child, and waits to be killed. Its first argument is the
# input of the child, and the others are the command. It waits for a line of the child, because the child learns who
# its parent is while it starts.
PARENT = """
import subprocess, sys, time
child = subprocess.Popen(sys.argv[2:], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
child.stdout.readline()
child.stdin.write(sys.argv[1].encode())
child.stdin.flush()
print(child.pid, flush=True)
time.sleep(600)
"""


def outlives_its_parent(command: Sequence[str | Path], standard_input: str = "") -> bool:
    """Start a command in another process, kill that process, and return True if the command continues."""
    arguments = [sys.executable, "-c", PARENT, standard_input, *map(str, command)]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True, cwd=REPO) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        parent.kill()
    deadline = read_idle_s() + LIMIT_S
    while runs(child):
        if read_idle_s() > deadline:
            return True
        time.sleep(0.02)
    return False


def runs(pid: int) -> bool:
    """True if there is a process with this id that has not ended."""
    try:
        # In proc_pid_stat(5) the state comes after the name in brackets. Z is a process that has ended.
        fields_after_name = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        return fields_after_name[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False
