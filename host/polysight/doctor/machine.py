"""Measurements of this machine: clock, network interfaces, disk, and receivers over loopback with every core busy."""

from __future__ import annotations

import array
import ctypes
import fcntl
import os
import random
import socket
import struct
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import msgspec

from polysight.capture import CARD_SOURCE_PORT, MAX_PAYLOAD_BYTES, ReceiverProcess, receiver_cores
from polysight_shared.config import Instrument

_STA_UNSYNC = 0x40  # struct timex, adjtimex(2)
_SIOCETHTOOL = 0x8946
_ETHTOOL_GRINGPARAM = 0x10
_DROP_COUNTERS = ("rx_missed_errors", "rx_fifo_errors", "rx_dropped")
_PROBE_BYTES = 64 << 20
_PROBE_S = 2.0


def clock_is_synchronised() -> bool | None:
    """Return the kernel's synchronisation flag (adjtimex(2)); None if the system does not provide it."""
    timex = ctypes.create_string_buffer(512)  # larger than struct timex; modes = 0 only reads
    adjtimex = getattr(ctypes.CDLL(None, use_errno=True), "adjtimex", None)
    if adjtimex is None or adjtimex(timex) < 0:
        return None
    *_, status = struct.unpack_from("@illlli", timex.raw)  # modes, offset, freq, maxerror, esterror, status
    return not status & _STA_UNSYNC


@dataclass(frozen=True)
class NetworkInterface:
    """Settings and drop count of a network interface. None: unknown. `lost`: packets dropped since it came up."""

    name: str
    mtu: int | None = None
    speed_mbit: int | None = None
    ring: int | None = None
    ring_max: int | None = None
    lost: int = 0


def read_interface(name: str, root: Path = Path("/")) -> NetworkInterface:
    """Read an interface's settings from sysfs under `root`; the receive ring only for the running system."""
    folder = root / "sys/class/net" / name

    def number(file: str) -> int | None:
        try:
            value = int((folder / file).read_text(encoding="ascii"))
        except (OSError, ValueError):
            return None
        return value if value >= 0 else None

    ring, ring_max = _receive_ring(name) if root == Path("/") else (None, None)
    lost = sum(number(f"statistics/{counter}") or 0 for counter in _DROP_COUNTERS)
    return NetworkInterface(name, number("mtu"), number("speed"), ring, ring_max, lost)


def _receive_ring(name: str) -> tuple[int, int] | tuple[None, None]:
    """Receive descriptors in use and their maximum (ethtool -g)."""
    words = array.array("I", [_ETHTOOL_GRINGPARAM] + 8 * [0])
    request = struct.pack("16sP16x", name.encode()[:15], words.buffer_info()[0])
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            fcntl.ioctl(sock, _SIOCETHTOOL, request)
    except OSError:
        return None, None
    return words[5], words[1]


def write_speed(folder: Path) -> float:
    """Measure the durable write speed of this folder's disk, bytes/s, with a temporary file of 64 MiB or two seconds.

    Raises OSError.
    """
    block = os.urandom(1 << 20)
    with tempfile.TemporaryFile(dir=folder) as file:
        began = time.perf_counter()
        written = 0
        while written < _PROBE_BYTES and time.perf_counter() - began < _PROBE_S:
            file.write(block)
            file.flush()
            os.fsync(file.fileno())
            written += len(block)
        return written / (time.perf_counter() - began)


# Time of a packet beyond its configured delay: delays of 5, 10, 25, 50 us give 706, 545, 325, 193 Mbit/s (TI).
PACKET_TIME_US = 11.0
_RATE_S = 1.5  # duration of each rate
_DRAIN_S = 5.0
_SENDER = Path(__file__).with_name("send_packets.py")
_BUSY_LOOP = "while True: sum(range(100_000))"


@dataclass(frozen=True)
class LoadResult:
    """Result at one rate: packets/s of a card requested (`wanted`) and reached; packets sent and lost by all cards."""

    wanted: float
    reached: float
    sent: int
    lost: int

    @property
    def mbit_s(self) -> float:
        """Payload rate of one card, Mbit/s."""
        return self.reached * MAX_PAYLOAD_BYTES * 8e-6


def card_rates(rig: Instrument) -> list[float]:
    """Packet rates of a card, packets/s, ascending: during bursts, while emptying its memory, and its maximum."""
    burst = rig.frame_bytes / MAX_PAYLOAD_BYTES / (rig.burst.period_us * 1e-6)
    return sorted({burst, *(1e6 / (delay_us + PACKET_TIME_US) for delay_us in (rig.card.packet_delay_us, 5.0))})


def measure_receivers(rig: Instrument, rates: list[float], seconds: float = _RATE_S) -> tuple[list[LoadResult], str]:
    """Send packets at each rate (packets/s) to the receivers of all recorded boards, with a busy process on each core.

    Returns the result for each rate and the receivers' scheduling. Raises DeviceError if a receiver does not start.
    """
    subnet = f"127.{random.randint(2, 250)}.{random.randint(1, 250)}"
    boards = [
        msgspec.structs.replace(b, card_address=f"{subnet}.{100 + k}", host_address=f"{subnet}.30")
        for k, b in enumerate(rig.recorded)
    ]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="polysight-receivers-")))
        receivers = [
            stack.enter_context(ReceiverProcess(b, rig.card.receive_buffer_bytes, core))
            for b, core in zip(boards, receiver_cores(len(boards)), strict=True)
        ]
        for _ in range(os.cpu_count() or 1):
            busy = stack.enter_context(subprocess.Popen([sys.executable, "-c", _BUSY_LOOP], start_new_session=True))
            stack.callback(busy.kill)
        results = []
        sent = 0
        for rate in rates:
            packets = max(2, round(rate * seconds))
            results.append(_measure_rate(rate, sent, packets, receivers, folder))
            sent += packets
        return results, receivers[0].scheduling


def _measure_rate(rate: float, first: int, packets: int, receivers: list[ReceiverProcess], folder: Path) -> LoadResult:
    """Send `packets` packets to each receiver; like a card, the counters continue from record to record (`first`)."""
    for r in receivers:
        r.begin_row(0, 1, packets * MAX_PAYLOAD_BYTES, 1, folder / f"{r.board.name}.part")
    senders = []
    for r in receivers:
        card = (r.board.card_address, CARD_SOURCE_PORT)
        host = (r.board.host_address, r.board.data_port)
        words = map(str, (*card, *host, first, packets, rate, MAX_PAYLOAD_BYTES))
        command = [sys.executable, "-I", str(_SENDER), *words]
        senders.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
    took_s = [float(sender.communicate()[0] or "inf") for sender in senders]
    deadline = time.monotonic() + _DRAIN_S
    while not all(r.poll().complete for r in receivers) and time.monotonic() < deadline:
        before = [r.report().received for r in receivers]
        time.sleep(0.2)
        if [r.report().received for r in receivers] == before:
            break
    lost = sum(packets - r.end_row().packets for r in receivers)
    return LoadResult(rate, packets / max(took_s), packets * len(receivers), lost)
