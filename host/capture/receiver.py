"""The host's handle of one receiving process, and the messages between the two.

Requests and answers are msgpack structs on a connection that the process inherits. A row is one round: `BeginRow` with
the file to write, `Progress` while packets come, `EndRow`, and a `RowCapture` that says what was received. The process
itself is `receiver_process.py`.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import msgspec

from polysight.host.capture.dca1000 import LOST_BEFORE_PACKETS, Status
from polysight.host.capture.scheduling import Core
from polysight.shared.config import Board
from polysight.shared.errors import DeviceError

_START_LIMIT_S = 30.0
_ANSWER_LIMIT_S = 60.0  # ending a row waits for the disk


class _Words(msgspec.Struct, frozen=True, tag=True):
    pass


class Open(_Words, frozen=True):
    """Bind the data socket. Answered with Opened or Failed."""

    board: str
    host_address: str
    data_port: int
    card_address: str
    buffer_bytes: int
    core: int | None = None
    own_core: bool = True


class BeginRow(_Words, frozen=True):
    """Drop what is waiting, and place what comes from now on into the file at `path`. Answered with Began or Failed."""

    row: int
    take: int
    expected_bytes: int
    frame_bytes: int
    path: str


class EndRow(_Words, frozen=True):
    """The row has ended: fetch what still waits, make the file durable. Answered with RowCapture or Failed.

    `card_status` holds the bits the card reported since record start: some say that it lost data itself.
    `not_before_ns`: as in Report.
    """

    card_status: int = 0
    not_before_ns: int = 0


class Discard(_Words, frozen=True):
    """Forget the running row and remove its file. Answered with Discarded."""


class Report(_Words, frozen=True):
    """Answered with Progress. No pulse of the row was sent before `not_before_ns` (monotonic clock; 0: not known)."""

    not_before_ns: int = 0


class Opened(_Words, frozen=True):
    """The socket is bound. `scheduling` says where and how urgently the process runs, `warnings` what it may not."""

    granted_bytes: int
    data_port: int
    scheduling: str = ""
    warnings: list[str] = []


class Began(_Words, frozen=True):
    """Ready for the row; `stale` packets that came between rows were dropped."""

    stale: int


class Progress(_Words, frozen=True):
    """How far the row is. Sent unasked when every expected byte is there, and when the short last packet came.

    `ended`: the furthest packet is a short one, which only the last of a record is.
    """

    row: int
    take: int
    received: int
    complete: bool
    last_arrival_ns: int  # monotonic clock; 0 before the first packet
    ended: bool = False


class RowCapture(_Words, frozen=True):
    """What one board's receiver got of one row.

    `bytes` is what was placed, `missing` the byte ranges that are not (the whole row when `located` is false).
    Arrival times are the host's monotonic clock, 0 when no packet came. Counts of packets as in
    :class:`polysight.host.capture.packet_counts.PacketCounts`, bytes lost at the head, in gaps and at the tail as in
    :class:`polysight.host.capture.placement.Losses`. `card_status` is what the card reported by itself during the row.
    `holes` and `slipped` as in :class:`polysight.host.capture.placement.Placed`.
    """

    row: int
    take: int
    expected: int
    bytes: int
    missing: list[tuple[int, int]]
    located: bool
    reason: str
    packets: int
    duplicates: int
    late: int
    outside: int
    disagreeing: int
    malformed: int
    short: int
    strangers: int
    stale: int
    kernel_drops: int
    first_arrival_ns: int
    last_arrival_ns: int
    crc32: int
    index_crc32: int
    leftover: int = 0
    late_by_bytes: int = 0
    head_bytes: int = 0
    gaps: int = 0
    gap_bytes: int = 0
    tail_bytes: int = 0
    card_status: int = 0
    holes: list[tuple[int, int]] = []
    slipped: bool = False
    conflicting: int = 0
    restarted: int = 0
    before_pulses: int = 0
    clock_jumps: int = 0
    packets_crc32: int = 0

    @property
    def missing_bytes(self) -> int:
        """Bytes of the row that are not there for certain."""
        return sum(stop - start for start, stop in self.missing)

    @property
    def lost_before_packets(self) -> Status:
        """The status bits by which the card said that it dropped data before numbering it; 0 when it did not."""
        return Status(self.card_status) & LOST_BEFORE_PACKETS

    @property
    def complete(self) -> bool:
        """True if the row is there to the last byte."""
        return self.located and not self.missing


class Discarded(_Words, frozen=True):
    """The row is forgotten."""


class Failed(_Words, frozen=True):
    """What was asked could not be done."""

    what: str
    why: str = ""
    remedy: str = ""


Request = Open | BeginRow | EndRow | Discard | Report
Answer = Opened | Began | Progress | RowCapture | Discarded | Failed
A = TypeVar("A", bound=Answer)
_encoder = msgspec.msgpack.Encoder()
_requests: Any = msgspec.msgpack.Decoder(Request)
_answers: Any = msgspec.msgpack.Decoder(Answer)


def send(connection: Connection, words: Request | Answer) -> None:
    """Send one message. Raises DeviceError if the other side is gone."""
    try:
        connection.send_bytes(_encoder.encode(words))
    except OSError as e:
        raise DeviceError(f"the receiver's pipe broke: {e}", "the other process ended") from None


def next_request(connection: Connection) -> Request:
    """The next request. Raises EOFError if the host is gone."""
    return _requests.decode(connection.recv_bytes())


def next_answer(connection: Connection) -> Answer:
    """The next answer. Raises EOFError if the receiver is gone."""
    return _answers.decode(connection.recv_bytes())


class ReceiverProcess:
    """One card's receiving process: `begin_row`, then `poll` until complete or given up, then `end_row`.

    Parameters
    ----------
    board
        Whose data to receive; addresses and ports are its.
    buffer_bytes
        Receive buffer to ask the kernel for.
    core
        Core to pin it to, as :func:`polysight.host.capture.scheduling.receiver_cores` chooses them; None: any. A core
        that it shares is taken with real-time priority only.

    Attributes
    ----------
    granted_bytes
        Receive buffer the kernel gave.
    scheduling, warnings
        Where and how urgently the process runs, and what of that the system did not permit.

    Raises
    ------
    DeviceError
        if the process does not start, or its address and port cannot be bound.
    """

    def __init__(self, board: Board, buffer_bytes: int, core: Core | None = None) -> None:
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
            number, own = core or (None, True)
            request = Open(
                board.name, board.host_address, board.data_port, board.card_address, buffer_bytes, number, own
            )
            opened = self._ask(request, Opened, _START_LIMIT_S)
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

        Raises DeviceError if the file cannot be made.
        """
        request = BeginRow(row, take, expected_bytes, frame_bytes, str(path))
        stale = self._ask(request, Began, _ANSWER_LIMIT_S).stale
        self._progress = Progress(row, take, 0, expected_bytes == 0, 0)
        return stale

    def poll(self) -> Progress:
        """How far the row is, without waiting: only what the process said unasked."""
        while self._connection.poll():
            self._take(self._next())
        return self._progress

    def report(self, not_before_ns: int = 0) -> Progress:
        """How far the row is, asked for. No pulse of it was sent before `not_before_ns`, if that is given."""
        return self._ask(Report(not_before_ns), Progress, _ANSWER_LIMIT_S)

    def end_row(self, card_status: Status | None = None, not_before_ns: int = 0) -> RowCapture:
        """End the row: its file is durable when this returns. Raises DeviceError.

        No pulse of the row was sent before `not_before_ns` (monotonic clock): packets that came earlier are left over.
        `card_status` is what the card reported by itself since record start. With bits 7 or 9 in it the card dropped
        data before numbering it: the row is masked as a whole, and the reason says so.
        """
        return self._ask(EndRow(int(card_status or 0), not_before_ns), RowCapture, _ANSWER_LIMIT_S)

    def discard(self) -> None:
        """Forget the running row and remove its file."""
        self._ask(Discard(), Discarded, _ANSWER_LIMIT_S)

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

    def _take(self, answer: Answer) -> None:
        if isinstance(answer, Progress):
            self._progress = answer
        elif isinstance(answer, Failed):
            raise DeviceError(answer.what, answer.why, answer.remedy)

    def _next(self) -> Answer:
        try:
            return next_answer(self._connection)
        except (EOFError, OSError):
            raise self._ended() from None

    def _ended(self) -> DeviceError:
        return DeviceError(
            f"{self.board.name}: the receiving process ended with status {self._process.poll()}",
            "it was killed, or it failed; its message is above",
            "`dmesg` tells whether the kernel ended it, for want of memory",
        )

    def _ask(self, request: Request, kind: type[A], limit_s: float) -> A:
        try:
            send(self._connection, request)
        except DeviceError:
            raise self._ended() from None
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
