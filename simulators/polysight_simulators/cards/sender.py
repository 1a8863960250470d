"""UDP sender of a simulated card: many packets per call, never more at once than the receiver's buffer holds."""

from __future__ import annotations

import os
import socket
import struct
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DeviceError
from polysight_simulators.cards.dca1000 import DATA_HEADER_BYTES

Rows = NDArray[np.uint8]
_UDP_SEGMENT = 103  # linux/udp.h: the kernel cuts one buffer into equal datagrams
_CALL_BYTES = 65_000  # below the largest UDP datagram
_CALL_SEGMENTS = 44
_UNREAD_BYTES = 128 << 10  # unread at the receiver, below which the next 44 packets (about 100 kB) are sent
_POLL_S = 0.001
_WAIT_TIMEOUT_S = 2.0  # for a receiver that does not read; then its packets are lost, as with a real card
_MAX_QUEUED_BYTES = 64 << 20
_CATCH_UP_S = 0.01  # largest delay that is made up for when sending many packets per call
_MAX_SPIN_S = 0.02  # in one call: commands wait in the meantime
_SPIN_S = 0.001  # waits below this spin, because a process cannot reliably sleep that short


class ReceiveQueue:
    """Unread data of a UDP socket of this machine, from the kernel's table of sockets."""

    def __init__(self, address: str, port: int, table: Path = Path("/proc/net/udp")) -> None:
        own = struct.unpack("=I", socket.inet_aton(address))[0]
        self._keys = tuple(f"{a:08X}:{port:04X}".encode() for a in (own, 0))
        try:
            self._table: int | None = os.open(table, os.O_RDONLY)
        except OSError:
            self._table = None

    def look(self) -> tuple[int, int] | None:
        """Return unread bytes and dropped datagrams; None if the socket is not on this machine."""
        if self._table is None:
            return None
        text = os.pread(self._table, 1 << 20, 0)
        for key in self._keys:
            at = text.find(b" " + key + b" ")
            if at >= 0:
                fields = text[at : text.find(b"\n", at)].split()
                return int(fields[3].partition(b":")[2], 16), int(fields[-1])
        return None

    def close(self) -> None:
        """Close the table."""
        if self._table is not None:
            os.close(self._table)
            self._table = None


class Pace(NamedTuple):
    """Pacing of packets: not faster than the receiver reads, and in calls of 44 or (as a real card) one by one."""

    wait_for_receiver: bool = True
    single: bool = False


class CardSender:
    """Sends what one card emits, from its own source port, in order.

    On a real network a card at 25 us a packet never outruns a host. A simulated one at many times real time does, when
    the host's process gets no CPU for a moment; such losses say nothing about the instrument. So before every call the
    sender looks at the receiver's queue, and waits while it is filled. `wait_for_receiver=False` leaves that out.

    The packet delay is kept as a mean: packets leave 44 at a time. With `single` each leaves when it is due and never
    sooner after the last one, for which this process spins.

    Raises
    ------
    DeviceError
        if the card's address cannot be taken.
    """

    def __init__(
        self,
        source: tuple[str, int],
        command_to: tuple[str, int],
        data_to: tuple[str, int],
        pace: Pace = Pace(),  # noqa: B008 - immutable
    ) -> None:
        self._command_to, self._data_to = command_to, data_to
        self._socket = bound_udp(*source)
        self._segmented = _can_segment(self._socket)
        self._receiver = ReceiveQueue(*data_to)
        self._pace = pace
        self._replies: deque[tuple[float, bytes]] = deque()
        self._queue: deque[bytes | Rows] = deque()
        self._queued_bytes = 0
        self._not_before_s = 0.0
        self._was_idle = True
        self._waiting_since_s: float | None = None
        self.packets = 0
        self.payload_bytes = 0
        self.waits = 0

    @property
    def full(self) -> bool:
        """True if the queue is full."""
        return self._queued_bytes > _MAX_QUEUED_BYTES

    @property
    def queued_bytes(self) -> int:
        """Bytes of data packets not sent yet."""
        return self._queued_bytes

    @property
    def idle(self) -> bool:
        """True if everything was sent."""
        return not self._queue and not self._replies

    def counts(self) -> dict[str, int]:
        """Return the numbers of data packets and payload bytes sent, and of waits for the receiver."""
        return {"packets_sent": self.packets, "bytes_sent": self.payload_bytes, "waits": self.waits}

    def dropped_by_receiver(self) -> int | None:
        """Return the number of datagrams dropped by the receiving socket; None if it is not on this machine."""
        seen = self._receiver.look()
        return None if seen is None else seen[1]

    def reply(self, message: bytes, due_s: float | None = None) -> None:
        """Send a command's reply at once, or at `due_s` of the clock given to :meth:`flush`."""
        if due_s is None:
            self._send_to(message, self._command_to)
        else:
            self._replies.append((due_s, message))

    def put_status(self, message: bytes) -> None:
        """Send an asynchronous status after the data queued before it."""
        self._queue.append(message)

    def put_packets(self, rows: Rows) -> None:
        """Send data packets, uint8 [n, size]."""
        self._queue.append(rows)
        self._queued_bytes += rows.size

    def flush(self, clock_s: Callable[[], float], packet_interval_s: float) -> float | None:
        """Send data that is due; return the seconds until more is due, None if all is sent.

        `clock_s` is the wall clock; `packet_interval_s` the shortest mean time between packets, wall time.
        """
        wait = self._flush_queue(clock_s, packet_interval_s)
        while self._replies:
            rest_s = self._replies[0][0] - clock_s()
            if rest_s > 0:
                return rest_s if wait is None else min(wait, rest_s)
            self._send_to(self._replies.popleft()[1], self._command_to)
        return wait

    def _flush_queue(self, clock_s: Callable[[], float], packet_interval_s: float) -> float | None:
        until_s = clock_s() + _MAX_SPIN_S
        while self._queue:
            item = self._queue[0]
            if isinstance(item, bytes):
                self._send_to(item, self._command_to)
                self._queue.popleft()
                continue
            now = clock_s()
            if now < self._not_before_s:
                if not self._pace.single or self._not_before_s - now > _SPIN_S or now > until_s:
                    return self._not_before_s - now
                continue
            if not self._may_send(now):
                return _POLL_S
            n = 1 if self._pace.single else min(len(item), _CALL_SEGMENTS, max(1, _CALL_BYTES // item.shape[1]))
            self._send(item[:n])
            self._queued_bytes -= n * item.shape[1]
            catch_up_s = 0.0 if self._pace.single or self._was_idle else _CATCH_UP_S
            self._was_idle = False
            self._not_before_s = max(self._not_before_s, now - catch_up_s) + n * packet_interval_s
            if n == len(item):
                self._queue.popleft()
            else:
                self._queue[0] = item[n:]
        self._was_idle = True
        return None

    def send_now(self) -> None:
        """Send everything queued at once, before the sockets are closed."""
        for item in self._queue:
            if isinstance(item, bytes):
                self._send_to(item, self._command_to)
            else:
                for at in range(0, len(item), _CALL_SEGMENTS):
                    self._send(item[at : at + _CALL_SEGMENTS])
        self._queue.clear()
        self._queued_bytes = 0

    def _may_send(self, now_s: float) -> bool:
        if not self._pace.wait_for_receiver:
            return True
        seen = self._receiver.look()
        if seen is None or seen[0] <= _UNREAD_BYTES:
            self._waiting_since_s = None
            return True
        if self._waiting_since_s is None:
            self._waiting_since_s = now_s
            self.waits += 1
        return now_s - self._waiting_since_s > _WAIT_TIMEOUT_S

    def _send(self, rows: Rows) -> None:
        size = rows.shape[1]
        self.packets += len(rows)
        self.payload_bytes += len(rows) * max(0, size - DATA_HEADER_BYTES)
        if self._segmented and len(rows) > 1:
            segment = [(socket.IPPROTO_UDP, _UDP_SEGMENT, struct.pack("=H", size))]
            self._send_to(np.ascontiguousarray(rows).data, self._data_to, segment)
            return
        for row in rows:
            self._send_to(row.data, self._data_to)

    def _send_to(
        self, data: bytes | memoryview, address: tuple[str, int], how: list[tuple[int, int, bytes]] | None = None
    ) -> None:
        try:
            self._socket.sendmsg([data], how or [], 0, address)
        except OSError as e:
            raise DeviceError(
                f"simulated card: cannot send to {address[0]}:{address[1]}: {e.strerror}",
                "that address cannot be reached from the card's address",
                "give card and host addresses of one network: both on loopback, or both of one interface",
            ) from None

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
        self._receiver.close()


def bound_udp(address: str, port: int) -> socket.socket:
    """Return a UDP socket bound to an address of this machine. Raises DeviceError."""
    s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        s.bind((address, port))
    except OSError as e:
        s.close()
        raise DeviceError(
            f"simulated card: cannot bind {address}:{port}: {e.strerror}",
            "another simulated rig uses this address, or it is not an address of this machine (loopback is 127.x.y.z)",
            "start the rig with `python -m polysight_simulators.rig`, which chooses free loopback addresses",
            code=ErrorCode.BUSY,
        ) from None
    return s


def _can_segment(s: socket.socket) -> bool:
    """True if this kernel cuts large buffers into datagrams (UDP_SEGMENT, Linux 4.18 and later)."""
    try:
        s.setsockopt(socket.IPPROTO_UDP, _UDP_SEGMENT, 0)
    except OSError:
        return False
    return True
