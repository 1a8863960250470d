"""What host and receiver process say to each other: typed messages, msgpack, over a socket pair."""

from __future__ import annotations

from multiprocessing.connection import Connection
from typing import Any

import msgspec

from polysight.host.capture.dca1000 import LOST_BEFORE_PACKETS, Status
from polysight.shared.errors import DeviceError


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
    """

    card_status: int = 0


class Discard(_Words, frozen=True):
    """Forget the running row and remove its file. Answered with Discarded."""


class Report(_Words, frozen=True):
    """Answered with Progress."""


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
    :class:`polysight.host.capture.placed.PacketCounts`, bytes lost at the head, in gaps and at the tail as in
    :class:`polysight.host.capture.placed.Losses`. `card_status` is what the card reported by itself during the row. `holes`
    and `slipped` as in :class:`polysight.host.capture.placed.Placed`.
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
        """Whether the row is there to the last byte."""
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
_encoder = msgspec.msgpack.Encoder()
_requests: Any = msgspec.msgpack.Decoder(Request)
_answers: Any = msgspec.msgpack.Decoder(Answer)


def send(connection: Connection, words: Request | Answer) -> None:
    """Send one message. Raises DeviceError when the other side is gone."""
    try:
        connection.send_bytes(_encoder.encode(words))
    except OSError as e:
        raise DeviceError(f"the receiver's pipe broke: {e}", "the other process ended") from None


def next_request(connection: Connection) -> Request:
    """The next request. Raises EOFError when the host is gone."""
    return _requests.decode(connection.recv_bytes())


def next_answer(connection: Connection) -> Answer:
    """The next answer. Raises EOFError when the receiver is gone."""
    return _answers.decode(connection.recv_bytes())
