"""UDP sockets for the capture cards, and diagnosis of the network path to a card that does not answer.

`bind_udp` and `enlarge_receive_buffer` make the socket; the kernel may grant a smaller buffer than requested.
`BatchReceiver` fetches many packets with one `recvmmsg` call into one block of memory, so that a packet costs one copy.
`find_silent_hop` finds the first hop that does not work (route, link, address, card), for `explain_silent_card`, which
returns the error for a card without replies; `explain_silent_radar` returns that for a card that replies but sends no
data.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import socket
import struct
import sys
import time
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.capture.dca1000 import MAX_PAYLOAD_BYTES, Status
from polysight.capture.receiver import RowCapture
from polysight_shared.config import Board
from polysight_shared.errors import DeviceError, ErrorCode
from polysight_shared.units import NS_PER_S

# Socket options of Linux (asm-generic/socket.h), which Python does not name.
# Request a buffer that may exceed net.core.rmem_max; this needs CAP_NET_ADMIN.
SO_RCVBUFFORCE = 33
# Read nine 32-bit words about the socket's memory.
SO_MEMINFO = 55
# Each packet comes with the time at which the kernel got it.
SO_TIMESTAMPNS = 35
# Bytes of a receive buffer that a full packet occupies (measured).
KERNEL_BYTES_A_PACKET = 2304
# Index of the dropped packets among the words of SO_MEMINFO.
_MEMINFO_DROPS = 8
_RMEM_MAX = Path("/proc/sys/net/core/rmem_max")
# A larger jump between two reads means that the clock was set: NTP moves it by far less.
_CLOCK_WAS_SET_NS = 1_000_000
# Readings of two clocks this close are of one time: a tenth of the 200 us that `acquisition/pulse_times.py` lets an
# arrival be early at most.
_CLOSE_READINGS_NS = 20_000
# Readings at most, of which the closest is used (chosen).
_CLOCK_READINGS = 5
# Least memory that the kernel counts for a packet besides its bytes: `struct sk_buff`, `skb_shared_info` of Linux 6.
_PACKET_OVERHEAD_BYTES = 512
# Memory of one packet, bytes: more than the largest of 1466, to detect longer ones.
_STRIDE = 1536
_MSG_DONTWAIT = getattr(socket, "MSG_DONTWAIT", 0x40)
# Flags in /proc/net/route.
_GATEWAY = 0x2
_UP = 0x1
# Flag in /proc/net/arp.
_ARP_COMPLETE = 0x2
_ROOT = Path("/")


class _IoVec(ctypes.Structure):
    """`struct iovec`: where the kernel writes a packet."""

    _fields_ = (("base", ctypes.c_size_t), ("length", ctypes.c_size_t))


class _Header(ctypes.Structure):
    """`struct msghdr`; addresses as integers, so that numpy can view an array of them."""

    _fields_ = (
        ("name", ctypes.c_size_t),
        ("name_length", ctypes.c_uint32),
        ("vector", ctypes.c_size_t),
        ("vector_length", ctypes.c_size_t),
        ("control", ctypes.c_size_t),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Message(ctypes.Structure):
    """`struct mmsghdr`."""

    _fields_ = (("header", _Header), ("received", ctypes.c_uint32))


def bind_udp(address: str, port: int, problem: str) -> socket.socket:
    """Return a bound, non-blocking, unconnected UDP socket; errors begin with `problem`.

    Raises
    ------
    DeviceError
        if the port is in use or the address is not this machine's.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setblocking(False)
    try:
        sock.bind((address, port))
    except OSError as e:
        sock.close()
        if e.errno == errno.EADDRINUSE:
            raise DeviceError(
                f"{problem}: {address}:{port} (UDP) is in use",
                "another program receives from this card, perhaps an earlier one that still runs",
                f"`ss -ulnp 'sport = :{port}'` shows it; stop it",
                code=ErrorCode.BUSY,
            ) from None
        if e.errno == errno.EADDRNOTAVAIL:
            raise DeviceError(
                f"{problem}: {address} is not an address of this machine",
                "the network interface to the cards is down or has another address",
                f"`ip address add {address}/24 dev <interface>`, or correct host_address in instrument.toml"
                " (for a scan to resume: `polysight resume SCAN --config instrument.toml`)",
                code=ErrorCode.VALUE_INVALID,
            ) from None
        raise DeviceError(
            f"{problem}: cannot bind {address}:{port} (UDP): {e.strerror}", "", "check host_address"
        ) from e
    return sock


def enlarge_receive_buffer(sock: socket.socket, wanted_bytes: int) -> int:
    """Request a receive buffer; return the granted size, bytes."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, wanted_bytes)
    if read_granted_bytes(sock) < wanted_bytes and sys.platform == "linux":
        with contextlib.suppress(PermissionError):
            sock.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, wanted_bytes)
    return read_granted_bytes(sock)


def read_granted_bytes(sock: socket.socket) -> int:
    """Return the size of the receive buffer; Linux reports twice the request, for its overhead."""
    size = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    if sys.platform == "linux":
        return size // 2
    return size


def count_kernel_drops(sock: socket.socket) -> int:
    """Return the number of packets that the kernel dropped at this socket; 0 if the system does not report it."""
    try:
        return struct.unpack("9I", sock.getsockopt(socket.SOL_SOCKET, SO_MEMINFO, 36))[_MEMINFO_DROPS]
    except (OSError, struct.error):
        return 0


class BatchReceiver:
    """Receives up to `batch` packets at a time into one preallocated block.

    Attributes
    ----------
    packets, lengths, times_ns
        Of the last :meth:`receive`: uint8 [batch, stride]; bytes of each packet with header; arrival of each at this
        machine by its kernel, int64, monotonic clock.
    strangers
        Packets from another address than the card's.
    is_drained
        True if the last :meth:`receive` left no packet behind.
    """

    def __init__(self, sock: socket.socket, source_address: str, batch: int = 256) -> None:
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._socket = sock
        self._source = int.from_bytes(socket.inet_aton(source_address), sys.byteorder)
        self.packets: NDArray[np.uint8] = np.zeros((batch, _STRIDE), dtype=np.uint8)
        self.lengths: NDArray[np.uint32] = np.zeros(batch, dtype=np.uint32)
        self.times_ns: NDArray[np.int64] = np.zeros(batch, dtype=np.int64)
        self.strangers = 0
        self.is_drained = True
        # Memory of the last packets in the kernel, from any sender: at least this many bytes.
        self._kernel_bytes = 0
        # Wall clock minus monotonic clock at the last reception: a jump means that the wall clock was set.
        self._clocks_differ_ns = measure_clock_difference()
        # `struct sockaddr_in` of each packet, 16 bytes; bytes 4 to 7 are its address.
        self._names = np.zeros((batch, 16), dtype=np.uint8)
        self._sources = self._names[:, 4:8].view(np.uint32)[:, 0]
        # `struct cmsghdr` of 16 bytes, then `struct timespec`: seconds and nanoseconds of the arrival.
        self._control = np.zeros((batch, 4), dtype=np.int64)
        self._vectors = (_IoVec * batch)()
        self._messages = (_Message * batch)()
        for i in range(batch):
            self._vectors[i] = _IoVec(self.packets.ctypes.data + i * _STRIDE, _STRIDE)
            header = self._messages[i].header
            header.name = self._names.ctypes.data + 16 * i
            header.vector = ctypes.addressof(self._vectors[i])
            header.vector_length = 1
            header.control = self._control[i].ctypes.data
        view: Any = np.frombuffer(memoryview(self._messages), dtype=np.dtype(_Message))
        self._received = view["received"]
        self._name_lengths = view["header"]["name_length"]
        self._control_lengths = view["header"]["control_length"]
        self._recvmmsg = ctypes.CDLL(None, use_errno=True).recvmmsg

    def receive(self) -> int:
        """Fetch the pending packets, at most `batch`; return the number from the card, which come first.

        Packets from elsewhere are counted and removed. Raises DeviceError if the interface went down.
        """
        self._name_lengths[:] = 16
        self._control_lengths[:] = self._control[0].nbytes
        n = self._recvmmsg(self._socket.fileno(), self._messages, len(self._messages), _MSG_DONTWAIT, None)
        self.is_drained = n < len(self._messages)
        if n < 0:
            number = ctypes.get_errno()
            if number in (errno.EAGAIN, errno.EINTR):
                return 0
            problem = f"receiving from the capture card failed: {os.strerror(number)}"
            raise DeviceError(
                problem, "the network interface went down", "`polysight doctor` shows which connection fails"
            )
        self.lengths[:n] = self._received[:n]
        self.times_ns[:n] = self._read_times(n)
        self._kernel_bytes = int(self._received[:n].sum()) + n * _PACKET_OVERHEAD_BYTES
        is_from_card = self._sources[:n] == self._source
        if not is_from_card.all():
            self.strangers += int((~is_from_card).sum())
            keep = np.flatnonzero(is_from_card)
            self.packets[: keep.size] = self.packets[keep]
            self.lengths[: keep.size] = self.lengths[keep]
            self.times_ns[: keep.size] = self.times_ns[keep]
            n = int(keep.size)
        return n

    def receive_all(self) -> Iterator[int]:
        """Fetch every packet that came before this call, in batches; yield the number in each, as :meth:`receive`."""
        # Packets may come without end. They come in order, so that after as many bytes as the buffer holds, all that
        # waited are fetched. The times of arrival would be a less certain criterion: they are wrong after the wall
        # clock was set, and by the error of its reading.
        buffer_bytes = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        self.is_drained = False
        while not self.is_drained and buffer_bytes >= 0:
            yield self.receive()
            buffer_bytes -= self._kernel_bytes

    def _read_times(self, n: int) -> NDArray[np.int64]:
        """Return the arrival times of the last `n` packets on the monotonic clock, int64 [n], ns.

        The kernel gives them on the wall clock. If that clock was set since the last call, all packets get the present
        time. Times do not decrease and do not lie in the future.
        """
        differ_ns = measure_clock_difference()
        now_ns = time.monotonic_ns()
        was_set = abs(differ_ns - self._clocks_differ_ns) > _CLOCK_WAS_SET_NS
        self._clocks_differ_ns = differ_ns
        seconds = self._control[:n, 2]
        nanoseconds = self._control[:n, 3]
        times = seconds * NS_PER_S + nanoseconds - differ_ns
        if was_set:
            times[:] = now_ns
        return np.maximum.accumulate(np.minimum(times, now_ns))


def measure_clock_difference() -> int:
    """Return the wall clock minus the monotonic clock, ns.

    A process that the kernel suspends between the two readings measures the pause too. So the wall clock is read
    between two readings of the other, several times, until these are close together; the closest pair is used.
    """
    narrowest_ns = 1 << 62
    difference_ns = 0
    for _ in range(_CLOCK_READINGS):
        before_ns = time.monotonic_ns()
        wall_clock_ns = time.time_ns()
        width_ns = time.monotonic_ns() - before_ns
        if width_ns < narrowest_ns:
            narrowest_ns = width_ns
            difference_ns = wall_clock_ns - before_ns - width_ns // 2
        if narrowest_ns < _CLOSE_READINGS_NS:
            break
    return difference_ns


def usable_packets(buffer_bytes: int) -> int:
    """Return the number of full packets that fit a receive buffer; Linux has twice the granted `buffer_bytes`."""
    return 2 * buffer_bytes // KERNEL_BYTES_A_PACKET


def check_receive_buffer(
    name: str, granted: int, needed_bytes: int, burst_bytes: int, rmem_max: Path = _RMEM_MAX
) -> str:
    """Return a warning if the kernel granted a smaller receive buffer than requested, otherwise "".

    Parameters
    ----------
    name
        Board, for the message.
    granted, needed_bytes
        Granted and requested bytes of the receive buffer.
    burst_bytes
        Data of one burst; the buffer must hold two, to bridge a pause of the receiver.
    rmem_max
        File with the kernel's limit.

    Raises
    ------
    DeviceError
        if the buffer holds less than two bursts; the remedy is the command that raises the limit.
    """
    # Two bursts and two packets, with the kernel's memory for each; Linux grants twice the requested bytes.
    enough = max(needed_bytes, (2 * burst_bytes // MAX_PAYLOAD_BYTES + 2) * KERNEL_BYTES_A_PACKET // 2)
    remedy = f"`sysctl -w net.core.rmem_max={enough}`, and the same in /etc/sysctl.d/ to keep it"
    try:
        limit = f"net.core.rmem_max is {int(rmem_max.read_text(encoding='ascii'))}"
    except (OSError, ValueError):
        limit = "net.core.rmem_max limits it"
    if usable_packets(granted) * MAX_PAYLOAD_BYTES < 2 * burst_bytes:
        problem = (
            f"{name}: the kernel grants a receive buffer of {granted} bytes, less than two bursts of {burst_bytes}"
        )
        cause = limit
        if granted >= needed_bytes:
            cause = "card.receive_buffer_bytes requests no more"
            remedy = f"card.receive_buffer_bytes = {enough} in instrument.toml; {remedy}"
        raise DeviceError(problem, cause, remedy, code=ErrorCode.VALUE_INVALID)
    if granted < needed_bytes:
        return f"{name}: receive buffer of {granted} bytes granted, {needed_bytes} requested ({limit}); {remedy}"
    return ""


class Hop(Enum):
    """Reason why a card does not answer: the first hop that does not work, from this machine on."""

    # No interface of this machine is in the card's subnet.
    ROUTE = "no route"
    # The interface has no carrier.
    LINK = "no link"
    # No device answers for the card's address (ARP).
    NEIGHBOUR = "no device at the address"
    # A device has the address but does not answer commands.
    CARD = "the card is mute"
    # The system's tables do not contain it, as on loopback.
    UNKNOWN = "unknown"


def find_silent_hop(card_address: str, root: Path = _ROOT) -> Hop:
    """Find the first hop to a card (IPv4 address) that does not work.

    `root` is the folder with `proc/net/route`, `proc/net/arp` and `sys/class/net`; a hop whose file cannot be read is
    passed over.
    """
    if card_address.startswith("127."):
        # Loopback is in none of these tables.
        return Hop.UNKNOWN
    interface = route_interface(card_address, root)
    if interface == "":
        return Hop.ROUTE
    if interface is not None and has_link(interface, root) is False:
        return Hop.LINK
    mac = neighbour_mac(card_address, root)
    if mac is None:
        return Hop.UNKNOWN
    if mac:
        return Hop.CARD
    return Hop.NEIGHBOUR


def route_interface(address: str, root: Path = _ROOT) -> str | None:
    """Return the interface in whose subnet the address lies, "" if there is none, None if unknown.

    Routes over a gateway do not count: capture cards are not reached through a router.
    """
    try:
        lines = (root / "proc/net/route").read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return None
    target = struct.unpack("=I", socket.inet_aton(address))[0]
    longest_mask = -1
    interface = ""
    for line in lines:
        words = line.split()
        if len(words) < 8:
            continue
        destination = int(words[1], 16)
        flags = int(words[3], 16)
        mask = int(words[7], 16)
        length = mask.bit_count()
        if flags & _UP and target & mask == destination and length > longest_mask:
            longest_mask = length
            interface = ""
            if not flags & _GATEWAY:
                interface = words[0]
    return interface


def has_link(interface: str, root: Path = _ROOT) -> bool | None:
    """True if the interface has a carrier, i.e. a cable with a device at its other end; None if unknown."""
    folder = root / "sys/class/net" / interface
    try:
        return (folder / "carrier").read_text(encoding="ascii").strip() == "1"
    except OSError:
        # `carrier` of an interface that is down is not readable.
        pass
    try:
        if (folder / "operstate").read_text(encoding="ascii").strip() == "down":
            return False
        return None
    except OSError:
        return None


def neighbour_mac(address: str, root: Path = _ROOT) -> str | None:
    """Return the MAC address that the kernel has for an address on the local network.

    "" if no device answered there; None if the kernel does not know.
    """
    try:
        lines = (root / "proc/net/arp").read_text(encoding="ascii").splitlines()[1:]
    except OSError:
        return None
    for line in lines:
        words = line.split()
        if len(words) >= 4 and words[0] == address:
            return words[3] if int(words[2], 16) & _ARP_COMPLETE else ""
    return None


def explain_silent_card(board: Board, problem: str, root: Path = _ROOT) -> DeviceError:
    """Return the error for a card that does not answer: the `problem`, and the hop that does not work, if known."""
    hop = find_silent_hop(board.card_address, root)
    interface = route_interface(board.card_address, root)
    if hop is Hop.ROUTE:
        return explain_missing_route(board, problem)
    cause = "the card is off, or listens at another address or port"
    remedy = (
        f"the card answers to the host address and ports in its EEPROM: it must send to {board.host_address}"
        f" port {board.command_port}; `ss -ulnp` shows other programs that listen there"
    )
    if hop is Hop.LINK:
        cause = f"no link: network interface {interface} has no carrier, the cable is out or the card has no power"
        remedy = f"check the card's power, the cable and the LEDs; `ip link show {interface}` must contain LOWER_UP"
    elif hop is Hop.NEIGHBOUR:
        cause = (
            f"the link is up, but no device has the address {board.card_address}: another card is on this cable, or "
            "its EEPROM contains another address"
        )
        remedy = (
            "check card_address in instrument.toml (for a scan to resume: `polysight resume SCAN --config"
            " instrument.toml`); with the card's EEPROM switch off it has its default address"
        )
    elif hop is Hop.CARD:
        cause = (
            "the card is mute: a device has its address, but its program does not answer; wrong command port, or its"
            " replies go to another host address"
        )
    return DeviceError(problem, cause, remedy, code=ErrorCode.NO_ANSWER)


def explain_missing_route(board: Board, problem: str) -> DeviceError:
    """Return the error for a card that is in no subnet of this machine."""
    return DeviceError(
        problem,
        f"no route: no network interface of this machine is in the subnet of {board.card_address}",
        f"`ip address add {board.host_address}/24 dev <interface>`; `ip route get {board.card_address}` shows the"
        " present route",
        code=ErrorCode.NO_ANSWER,
    )


def explain_silent_radar(board: Board, row: RowCapture | None = None) -> DeviceError:
    """Return the error for a card that replies but sends no data, with the likeliest cause from the capture `row`."""
    problem = f"no data from {board.name} (card {board.card_address} to {board.host_address}:{board.data_port})"
    remedy = "arm the radar, check the SYNC_IN wire (`polysight doctor` sends pulses), the data port in the EEPROM"
    status = Status(0)
    if row is not None:
        status = Status(row.card_status)
    if row is not None and row.strangers:
        cause = f"{row.strangers} packets came from another address than {board.card_address}"
        remedy = (
            "two boards may have each other's ports; check card_address and data_port in instrument.toml, then"
            " `polysight resume SCAN --config instrument.toml`"
        )
    elif Status.NO_LVDS_DATA in status:
        cause = "the card replies, and reports that the radar sends nothing over LVDS: it is not streaming"
    elif Status.NO_HEADER in status:
        cause = "the card replies, and reports LVDS data without a header: it is set to another mode"
    else:
        cause = (
            "the card replies, but the radar is not streaming (not armed, or SYNC_IN does not reach it), or the card"
            " sends its data to another address or port"
        )
    return DeviceError(problem, cause, remedy, code=ErrorCode.NO_DATA)
