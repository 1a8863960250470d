"""Start and control the receiver process of one card; the messages between host and process; priority and cores.

Requests and answers are msgpack structs on an inherited connection. For each row: `BeginRow` with the file to write,
`Progress` during reception, `EndRow`, and a `RowCapture` with the result. The process itself is `receiver_process.py`.
A *take* is one attempt to record a row, counted from 1; a *frame* is what a radar records for one pulse.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec

from polysight.capture.dca1000 import LOST_BEFORE_PACKETS, Status
from polysight.capture.placement import Losses, PacketCounts
from polysight_shared.closing import Closing
from polysight_shared.config import Board
from polysight_shared.errors import DeviceError, ErrorCode

# Real-time priority: below the kernel's threads, and below the Pi's pulses if both run on one machine.
REAL_TIME = 5
# Nice value where real time is not permitted (chosen): before ordinary programs, which have 0.
NICE = -5
PRIORITY_REMEDY = (
    "`sudo host/rights.sh USER` (USER: the user who scans), then log out and in again, or restart the machine"
    " (docs/how-to/install.md); without it a busy machine may lose packets, which are counted and their row retaken"
)


class Core(NamedTuple):
    """A core for a receiver; `exclusive` if no other receiver shares it."""

    number: int
    exclusive: bool


def receiver_cores(receivers: int, cores: list[int] | None = None) -> list[Core | None]:
    """Choose a core for each receiver, from the last one down; the first is the host's.

    `cores` are the usable cores (default: those of this process). Receivers share cores if these are too few; all get
    None (any core) if there is only one.
    """
    if cores is None:
        cores = []
        if hasattr(os, "sched_getaffinity"):
            cores = sorted(os.sched_getaffinity(0))
    usable = cores[1:][::-1]
    if not usable:
        return [None] * receivers
    exclusive = len(usable) >= receivers
    return [Core(usable[k % len(usable)], exclusive) for k in range(receivers)]


def take_core(core: int | None, exclusive: bool = True, urgent: bool = True) -> tuple[int | None, str]:
    """Pin this process to a core; return the core (None: any) and a warning ("" if there is none).

    A core shared with other receivers (`exclusive` False) is used only with real-time priority (`urgent`): ordinary
    processes pinned to one core lose far more packets than processes that the kernel may move.
    """
    if core is None or not (exclusive or urgent):
        return None, ""
    try:
        os.sched_setaffinity(0, {core})
    except (AttributeError, OSError) as e:
        return None, f"not pinned to core {core}: {e}"
    return core, ""


def take_priority(real_time: int = REAL_TIME) -> tuple[str, str]:
    """Give this process real-time priority, otherwise a lower nice value; return the priority and the refusals.

    Real time (round robin) and negative nice values need CAP_SYS_NICE. A receiver sleeps for a millisecond between
    batches, so it never occupies a whole core.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(real_time))
    except (AttributeError, OSError) as e:
        # An AttributeError, where the system has no such call, has no `strerror`.
        refused = f"no real-time priority: {getattr(e, 'strerror', e)}"
    else:
        return f"real-time priority {real_time}", ""
    try:
        os.setpriority(os.PRIO_PROCESS, 0, NICE)
    except OSError as e:
        return f"nice {os.getpriority(os.PRIO_PROCESS, 0)}", f"{refused}; nice {NICE}: {e.strerror}"
    return f"nice {NICE}", refused


# Timeout of the first answer, before which the process has to start; chosen.
_START_TIMEOUT_S = 30.0
# Timeout of all other answers; chosen. The answer to the end of a row waits for the disk.
_ANSWER_TIMEOUT_S = 60.0


class _Message(msgspec.Struct, frozen=True, tag=True):
    """A request or answer; its class name is sent with it."""


class Open(_Message, frozen=True):
    """Bind the data socket of `board` to `host_address` and `data_port`. Answered with Opened or Failed.

    `buffer_bytes` is the receive buffer to request, `core` the core to run on (None: any), `own_core` False if other
    receivers share that core. Packets are taken from `card_address` only.
    """

    board: str
    host_address: str
    data_port: int
    card_address: str
    buffer_bytes: int
    core: int | None = None
    own_core: bool = True


class BeginRow(_Message, frozen=True):
    """Drop pending packets and receive a row into the file at `path`. Answered with Began or Failed.

    `expected_bytes` are those of the whole row, `frame_bytes` those of one frame.
    """

    row: int
    take: int
    expected_bytes: int
    frame_bytes: int
    path: str
    # The card was reset just before: its counters begin at zero again.
    after_reset: bool = False


class EndRow(_Message, frozen=True):
    """End the row: fetch pending packets, make the file durable. Answered with RowCapture or Failed.

    `card_status` has the bits that the card reported since record start; some report lost data. `not_before_ns` as in
    Report.
    """

    card_status: int = 0
    not_before_ns: int = 0


class Report(_Message, frozen=True):
    """Request Progress. `not_before_ns` is a time before the first pulse (monotonic clock), 0 if unknown.

    Packets that came before it are not of the row.
    """

    not_before_ns: int = 0


class Opened(_Message, frozen=True):
    """The socket is bound to `data_port`, with a receive buffer of `granted_bytes`.

    `scheduling` has core and priority as text, `warnings` the refusals of the system.
    """

    granted_bytes: int
    data_port: int
    scheduling: str = ""
    warnings: list[str] = []


class Began(_Message, frozen=True):
    """Ready for the row; `stale` packets from between rows were dropped."""

    stale: int


class Progress(_Message, frozen=True):
    """Progress of the row; also sent without a request when every byte has arrived, and on the short last packet.

    `received` are the bytes in place; `complete` if all are and the record ends where it should.
    """

    # -1 before the first row.
    row: int
    take: int
    received: int
    complete: bool
    # On the monotonic clock; 0 before the first packet.
    last_arrival_ns: int
    # The furthest packet is short, as only the last one of a record is.
    ended: bool = False


class RowCapture(_Message, frozen=True):
    """Reception of one row of one board.

    `expected` are the bytes of the whole row, `bytes` counts placed ones, `missing` are the other byte ranges (the
    whole row if `located` is False, for which `reason` says why), `losses` their sizes by place. `holes` are the
    missing ranges before the furthest byte that came; `slipped` if nothing but missing whole frames keeps the row from
    being located. Arrival times are of the host's monotonic clock, 0 without packets.

    `counts` are the packets by result. Not of the row are `strangers` (packets from another address than the card's),
    `stale` (packets from between rows) and `kernel_drops` (dropped by the kernel during the row).

    `card_status` are the bits the card reported during the row. The three CRC-32 are of the row's files: payload,
    index, packets.
    """

    row: int
    take: int
    expected: int
    bytes: int
    missing: list[tuple[int, int]]
    located: bool
    reason: str
    counts: PacketCounts
    losses: Losses
    strangers: int
    stale: int
    kernel_drops: int
    first_arrival_ns: int
    last_arrival_ns: int
    crc32: int
    index_crc32: int
    card_status: int = 0
    holes: list[tuple[int, int]] = []
    slipped: bool = False
    packets_crc32: int = 0
    # It is unknown where the card's next record begins: the card must be reset.
    start_lost: bool = False
    # MAC address of the card; "" if unknown.
    card_mac: str = ""

    @property
    def missing_bytes(self) -> int:
        """Number of missing or uncertain bytes."""
        return sum(stop - start for start, stop in self.missing)

    @property
    def lost_before_packets(self) -> Status:
        """The status bits that report data dropped by the card before numbering; 0 if none."""
        return Status(self.card_status) & LOST_BEFORE_PACKETS

    @property
    def complete(self) -> bool:
        """True if every byte of the row is there."""
        return self.located and not self.missing


class Failed(_Message, frozen=True):
    """The request failed; fields as of a PolysightError: problem, cause, remedy, and code."""

    what: str
    why: str = ""
    remedy: str = ""
    code: str = ErrorCode.OTHER


# Messages of the host, and of the process.
Request = Open | BeginRow | EndRow | Report
Answer = Opened | Began | Progress | RowCapture | Failed
A = TypeVar("A", bound=Answer)
_encoder = msgspec.msgpack.Encoder()
_requests: Any = msgspec.msgpack.Decoder(Request)
_answers: Any = msgspec.msgpack.Decoder(Answer)


def send(connection: Connection, message: Request | Answer) -> None:
    """Send one message. Raises DeviceError if the connection is closed."""
    try:
        connection.send_bytes(_encoder.encode(message))
    except OSError as e:
        problem = f"the receiver's pipe broke: {e}"
        cause = "the other process ended"
        raise DeviceError(problem, cause, "start the scan again", code=ErrorCode.NO_ANSWER) from None


def next_request(connection: Connection) -> Request:
    """Receive a request. Raises EOFError if the host has closed the connection."""
    return _requests.decode(connection.recv_bytes())


class ReceiverProcess(Closing):
    """The receiver process of one card: `begin_row`, then `poll` until complete or timeout, then `end_row`.

    Attributes `granted_bytes`, `scheduling` and `warnings` as in :class:`Opened`.

    Parameters
    ----------
    board
        Board with the addresses and ports.
    buffer_bytes
        Requested receive buffer.
    core
        Core to pin the process to, as chosen by :func:`receiver_cores`; None: any. A shared core is used only with
        real-time priority.

    Raises
    ------
    DeviceError
        if the process does not start, or its address and port cannot be bound.
    """

    def __init__(self, board: Board, buffer_bytes: int, core: Core | None = None) -> None:
        self.board = board
        self._progress = Progress(row=-1, take=0, received=0, complete=False, last_arrival_ns=0)
        host_socket, receiver_socket = socket.socketpair()
        with receiver_socket:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "polysight.capture.receiver_process", str(receiver_socket.fileno())],
                pass_fds=[receiver_socket.fileno()],
                stdin=subprocess.DEVNULL,
                # Only the host handles Ctrl-C.
                start_new_session=True,
            )
        self._connection = Connection(host_socket.detach())
        try:
            # Without a core of its own the receiver may run on any.
            core_number = None
            exclusive = True
            if core is not None:
                core_number, exclusive = core
            request = Open(
                board=board.name,
                host_address=board.host_address,
                data_port=board.data_port,
                card_address=board.card_address,
                buffer_bytes=buffer_bytes,
                core=core_number,
                own_core=exclusive,
            )
            opened = self._ask(request, Opened, _START_TIMEOUT_S)
        except DeviceError:
            self.close()
            raise
        self.granted_bytes = opened.granted_bytes
        self.scheduling = opened.scheduling
        self.warnings = [f"{board.name}: {w}" for w in opened.warnings]

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when the process has sent a message."""
        return self._connection.fileno()

    def begin_row(
        self, row: int, take: int, expected_bytes: int, frame_bytes: int, path: Path, after_reset: bool = False
    ) -> int:
        """Receive a row into the file at `path` and its index; return the number of dropped stray packets.

        `after_reset`: the card was reset since its last record. Raises DeviceError if the file cannot be made.
        """
        request = BeginRow(row, take, expected_bytes, frame_bytes, str(path), after_reset)
        stale = self._ask(request, Began, _ANSWER_TIMEOUT_S).stale
        self._progress = Progress(row, take, received=0, complete=expected_bytes == 0, last_arrival_ns=0)
        return stale

    def poll(self) -> Progress:
        """Return the latest progress that the process has sent, without waiting."""
        while self._connection.poll():
            self._note_answer(self._receive_answer())
        return self._progress

    def report(self, not_before_ns: int = 0) -> Progress:
        """Request the progress; `not_before_ns` as in :class:`Report`."""
        return self._ask(Report(not_before_ns), Progress, _ANSWER_TIMEOUT_S)

    def end_row(self, card_status: Status | None = None, not_before_ns: int = 0) -> RowCapture:
        """End the row; its file is durable on return. Raises DeviceError.

        Packets from before `not_before_ns` (monotonic clock), a time before the first pulse, count as left over from
        before the row. With DDR_FULL or LVDS_BUFFER_FULL in `card_status`, the card dropped data before numbering it,
        and the row is masked as a whole.
        """
        return self._ask(EndRow(int(card_status or 0), not_before_ns), RowCapture, _ANSWER_TIMEOUT_S)

    def close(self) -> None:
        """End the process. Safe to repeat."""
        self._connection.close()
        try:
            self._process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _note_answer(self, answer: Answer) -> None:
        """Remember progress; raise a failure as DeviceError."""
        if isinstance(answer, Progress):
            self._progress = answer
        elif isinstance(answer, Failed):
            raise DeviceError(answer.what, answer.why, answer.remedy, code=ErrorCode(answer.code))

    def _receive_answer(self) -> Answer:
        """Wait for the next answer. Raises DeviceError if the process has ended."""
        try:
            return _answers.decode(self._connection.recv_bytes())
        except (EOFError, OSError):
            raise self._process_error() from None

    def _process_error(self) -> DeviceError:
        """Return the error for a process that has ended by itself."""
        return DeviceError(
            f"{self.board.name}: the receiver process ended with status {self._process.poll()}",
            "it was killed, or it failed; its message is above",
            "check with `dmesg` if the kernel ended it for lack of memory",
            code=ErrorCode.NO_ANSWER,
        )

    def _ask(self, request: Request, kind: type[A], timeout_s: float) -> A:
        """Send a request and return its answer, a `kind`; note other answers. Raises DeviceError after `timeout_s`."""
        try:
            send(self._connection, request)
        except DeviceError:
            raise self._process_error() from None
        deadline = time.monotonic() + timeout_s
        while self._connection.poll(max(0.0, deadline - time.monotonic())):
            answer = self._receive_answer()
            self._note_answer(answer)
            if isinstance(answer, kind):
                return answer
        raise DeviceError(
            f"{self.board.name}: the receiver process did not answer {type(request).__name__} within {timeout_s:g} s",
            "the machine or its disk is overloaded",
            "check the load of the machine and its disk",
            code=ErrorCode.NO_ANSWER,
        )
