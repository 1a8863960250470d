"""Receiver processes without their start, and those that this test's scan has started, by board.

They are forked from a process that has imported everything: a scan starts two, and imports are most of what they cost.
"""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
from collections.abc import Sequence
from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import Any

import pytest

from polysight.capture import receiver, receiver_process

_FORKS = multiprocessing.get_context("forkserver")
_FORKS.set_forkserver_preload([__name__])
_started: list[_Forked] = []


def _run(connection: Connection) -> None:
    os.setsid()
    sys.exit(receiver_process.main(["", str(os.dup(connection.fileno()))]))


class _Forked:
    """Stands for the `Popen` of a receiver process."""

    def __init__(self, command: Sequence[str], pass_fds: Sequence[int], **_options: Any) -> None:
        assert command[-2] == receiver_process.__name__, command
        with Connection(os.dup(pass_fds[0])) as theirs:
            self._process = _FORKS.Process(target=_run, args=(theirs,))
            self._process.start()
        self.pid = self._process.pid
        self.kill = self._process.kill
        _started.append(self)

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        status = self._process.exitcode
        if status is None:
            raise subprocess.TimeoutExpired("receiver", timeout or 0.0)
        return status


def fork_receivers(patch: pytest.MonkeyPatch) -> None:
    """From now on they are forked."""
    stands = {"Popen": _Forked, "DEVNULL": subprocess.DEVNULL, "TimeoutExpired": subprocess.TimeoutExpired}
    patch.setattr(receiver, "subprocess", SimpleNamespace(**stands))
    _started.clear()


def receivers() -> list[int]:
    """Process ids of the receivers of this test's scan, in the order of the recorded boards."""
    return sorted(process.pid for process in _started if process.pid is not None and process.poll() is None)


def find_receiver(board: str) -> int:
    """Process id of the receiver of RH or RV."""
    return receivers()[["RH", "RV"].index(board)]
