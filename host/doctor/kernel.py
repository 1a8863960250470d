"""What this machine's kernel says of its clock, its network interfaces and its disk."""

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

_STA_UNSYNC = 0x40
_SIOCETHTOOL, _ETHTOOL_GRINGPARAM = 0x8946, 0x10
_LOST = ("rx_missed_errors", "rx_fifo_errors", "rx_dropped")
_PROBE_BYTES, _PROBE_S = 64 << 20, 2.0


def clock_is_synchronised() -> bool | None:
    """Whether the kernel calls its wall clock synchronised (adjtimex(2)); None where it does not tell."""
    timex = ctypes.create_string_buffer(512)  # struct timex, with room; modes = 0 only reads
    adjtimex = getattr(ctypes.CDLL(None, use_errno=True), "adjtimex", None)
    if adjtimex is None or adjtimex(timex) < 0:
        return None
    *_, status = struct.unpack_from("@illlli", timex.raw)  # modes, offset, freq, maxerror, esterror, status
    return not status & _STA_UNSYNC


@dataclass(frozen=True)
class Nic:
    """A network interface. What cannot be read is None; `lost` counts packets dropped since it came up."""

    name: str
    mtu: int | None = None
    speed_mbit: int | None = None
    ring: int | None = None
    ring_max: int | None = None
    lost: int = 0


def nic(name: str, root: Path = Path("/")) -> Nic:
    """What the kernel says of an interface. The ring (ethtool) is asked for only on the machine itself."""
    folder = root / "sys/class/net" / name

    def number(file: str) -> int | None:
        try:
            value = int((folder / file).read_text(encoding="ascii"))
        except (OSError, ValueError):
            return None
        return value if value >= 0 else None

    ring = _ring(name) if root == Path("/") else None
    return Nic(
        name,
        number("mtu"),
        number("speed"),
        *(ring or (None, None)),
        sum(number(f"statistics/{counter}") or 0 for counter in _LOST),
    )


def _ring(name: str) -> tuple[int, int] | None:
    """Receive descriptors in use and possible (ethtool -g); None where the driver does not tell."""
    words = array.array("I", [_ETHTOOL_GRINGPARAM] + 8 * [0])
    request = struct.pack("16sP16x", name.encode()[:15], words.buffer_info()[0])
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            fcntl.ioctl(sock, _SIOCETHTOOL, request)
    except OSError:
        return None
    return words[5], words[1]


def write_speed(folder: Path) -> float:
    """Bytes a second that this folder's disk takes durably: a file that is written, synced and removed again.

    64 MiB, or what two seconds take. Raises OSError.
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
