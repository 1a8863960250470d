"""The host's handle of one receiving process."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import TypeVar

from polysight.host.capture import receiver_words as words
from polysight.host.capture.dca1000 import Status
from polysight.host.capture.receiver_words import Progress, RowCapture
from polysight.shared.config import Board
from polysight.shared.errors import DeviceError

_START_LIMIT_S = 30.0
_ANSWER_LIMIT_S = 60.0  # ending a row waits for the disk
A = TypeVar("A", bound=words.Answer)


class ReceiverProcess:
    """One card's receiving process: `begin_row`, then `poll` until complete or given up, then `end_row`.

    Parameters
    ----------
    board
        Whose data to receive; addresses and ports are its.
    buffer_bytes
        Receive buffer to ask the kernel for.
    core
        Core to pin it to, as :func:`polysight.host.capture.scheduling.receiver_cores` chooses them; None leaves it free.

    Attributes
    ----------
    granted_bytes
        Receive buffer the kernel gave.
    scheduling, warnings
        Where and how urgently the process runs, and what of that the system did not permit.

    Raises
    ------
    DeviceError
        when the process does not start, or its address and port cannot be bound.
    """

    def __init__(self, board: Board, buffer_bytes: int, core: int | None = None) -> None:
        self.board = board
        self._progress = Progress(-1, 0, 0, False, 0)
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "polysight.host.capture.receiver_process", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C in the terminal is the host's to handle
            )
        self._connection = Connection(ours.detach())
        try:
            request = words.Open(
                board.name, board.host_address, board.data_port, board.card_address, buffer_bytes, core
            )
            opened = self._ask(request, words.Opened, _START_LIMIT_S)
        except DeviceError:
            self.close()
            raise
        self.granted_bytes = opened.granted_bytes
        self.scheduling, self.warnings = opened.scheduling, [f"{board.name}: {w}" for w in opened.warnings]

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def fileno(self) -> int:
        """Descriptor that becomes readable when the process has something to say."""
        return self._connection.fileno()

    def begin_row(self, row: int, take: int, expected_bytes: int, frame_bytes: int, path: Path) -> int:
        """Receive a row into the file at `path` (its index beside it); returns how many stray packets were dropped.

        Raises DeviceError when the file cannot be made.
        """
        request = words.BeginRow(row, take, expected_bytes, frame_bytes, str(path))
        stale = self._ask(request, words.Began, _ANSWER_LIMIT_S).stale
        self._progress = Progress(row, take, 0, expected_bytes == 0, 0)
        return stale

    def poll(self) -> Progress:
        """How far the row is, without waiting: only what the process said unasked."""
        while self._connection.poll():
            self._take(self._next())
        return self._progress

    def report(self) -> Progress:
        """How far the row is, asked for."""
        return self._ask(words.Report(), Progress, _ANSWER_LIMIT_S)

    def end_row(self, card_status: Status | None = None) -> RowCapture:
        """End the row: its file is durable when this returns. Raises DeviceError.

        `card_status` is what the card reported by itself since record start. With bits 7 or 9 in it the card dropped
        data before numbering it: the row is masked as a whole, and the reason says so.
        """
        return self._ask(words.EndRow(int(card_status or 0)), RowCapture, _ANSWER_LIMIT_S)

    def discard(self) -> None:
        """Forget the running row and remove its file."""
        self._ask(words.Discard(), words.Discarded, _ANSWER_LIMIT_S)

    def close(self) -> None:
        """End the process. Twice is once."""
        self._connection.close()
        try:
            self._process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def __enter__(self) -> ReceiverProcess:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _take(self, answer: words.Answer) -> None:
        if isinstance(answer, Progress):
            self._progress = answer
        elif isinstance(answer, words.Failed):
            raise DeviceError(answer.what, answer.why, answer.remedy)

    def _next(self) -> words.Answer:
        try:
            return words.next_answer(self._connection)
        except (EOFError, OSError):
            raise DeviceError(
                f"{self.board.name}: the receiving process ended with status {self._process.poll()}",
                "it was killed, or it failed; its message is above",
                "`dmesg` tells whether the kernel ended it, for want of memory",
            ) from None

    def _ask(self, request: words.Request, kind: type[A], limit_s: float) -> A:
        words.send(self._connection, request)
        deadline = time.monotonic() + limit_s
        while self._connection.poll(max(0.0, deadline - time.monotonic())):
            answer = self._next()
            self._take(answer)
            if isinstance(answer, kind):
                return answer
        raise DeviceError(
            f"{self.board.name}: the receiving process did not answer {type(request).__name__} within {limit_s:g} s",
            "the machine or its disk is overloaded",
            "look at the load of the machine and its disk",
        )
