"""Helper processes of a benchmark: commands in lines, answers in lines of JSON."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
TICK_S = 1 / os.sysconf("SC_CLK_TCK")


class Child:
    """A helper process that answers lines with lines of JSON."""

    def __init__(self, module: str, *words: object) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *map(str, words)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )

    def say(self, *words: object) -> None:
        """Send one line."""
        if self._process.stdin is not None:
            self._process.stdin.write(" ".join(map(str, words)) + "\n")
            self._process.stdin.flush()

    def hear(self) -> Any:
        """The next line it says."""
        line = self._process.stdout.readline() if self._process.stdout is not None else ""
        if not line:
            raise RuntimeError(f"helper ended with status {self._process.wait()}")
        return line.strip() if line == "ready\n" else json.loads(line)

    def close(self) -> None:
        """End it."""
        self._process.communicate()


def ask(beside: Child | None) -> dict[str, Any]:
    """Progress of the processing beside."""
    if beside is None:
        return {"rows": 0, "cpu_s": 0.0}
    beside.say()
    return beside.hear()


def cpu_s(pid: int) -> float:
    """CPU seconds of a process so far."""
    words = Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rsplit(")", 1)[1].split()
    return (int(words[11]) + int(words[12])) * TICK_S
