"""Query the Linux kernel and the disk: clock synchronisation, network interface, durable write speed."""

from __future__ import annotations

import array
import ctypes
import fcntl
import os
import socket
import struct
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

_STA_UNSYNC = 0x40  # struct timex, adjtimex(2)
_SIOCETHTOOL, _ETHTOOL_GRINGPARAM = 0x8946, 0x10
_DROP_COUNTERS = ("rx_missed_errors", "rx_fifo_errors", "rx_dropped")
_PROBE_BYTES, _PROBE_S = 64 << 20, 2.0


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
        began, written = time.perf_counter(), 0
        while written < _PROBE_BYTES and time.perf_counter() - began < _PROBE_S:
            file.write(block)
            file.flush()
            os.fsync(file.fileno())
            written += len(block)
        return written / (time.perf_counter() - began)
