"""Cuts the network connections when they take too much memory.

ZeroMQ bounds a frame, but neither a message of many frames nor how much a client may subscribe to, and it takes both in
while this program waits for it. The unit's own bound (MemoryMax) would end the program, and a row with it.
"""

from __future__ import annotations

import ctypes
import os
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

MOST_BYTES = 160 << 20  # the program takes 30 to 60 MB, a subscriber that stands still up to 50
SPARE_BYTES = 64 << 20  # above what a cut leaves, at least: freed memory does not all go back to the system
LOOK_S = 0.05
SETTLE_S = 0.5
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


def cut_connections(ports: set[int]) -> int:
    """Shut down this process's TCP connections at these local ports. Returns how many there were."""
    cut = 0
    for link in Path("/proc/self/fd").iterdir():
        with suppress(OSError):  # closed meanwhile, or nobody is connected
            if not str(link.readlink()).startswith("socket:"):
                continue
            with socket.socket(fileno=os.dup(int(link.name))) as connection:
                if connection.family in (socket.AF_INET, socket.AF_INET6) and connection.getsockname()[1] in ports:
                    connection.getpeername()
                    connection.shutdown(socket.SHUT_RDWR)
                    cut += 1
    return cut


class MemoryWatch(threading.Thread):
    """Looks at the memory in use, and cuts the connections at `ports` above a bound; clients connect again.

    `warn` takes a sentence for each time.
    """

    def __init__(self, ports: set[int], warn: Callable[[str], object]) -> None:
        super().__init__(name="memory", daemon=True)
        self._ports, self._warn = ports, warn
        self._ended = threading.Event()
        self._statm = os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)  # kept: descriptors may run out
        self._most_bytes = max(MOST_BYTES, self.resident_bytes() + SPARE_BYTES)

    def resident_bytes(self) -> int:
        """Memory that this process has in use."""
        return int(os.pread(self._statm, 100, 0).split()[1]) * _PAGE_BYTES

    def run(self) -> None:
        """Look until :meth:`stop`."""
        while not self._ended.wait(LOOK_S):
            held = self.resident_bytes()
            if held <= self._most_bytes:
                continue
            with suppress(OSError):  # no descriptor is left: again at the next look
                cut = cut_connections(self._ports)
                self._ended.wait(SETTLE_S)
                ctypes.CDLL(None).malloc_trim(0)
                left = self.resident_bytes()
                self._most_bytes = max(MOST_BYTES, left + SPARE_BYTES)
                self._warn(f"{held >> 20} MiB in memory: {cut} connections were cut, {left >> 20} MiB are left")

    def stop(self) -> None:
        """End it."""
        self._ended.set()
        self.join()
        os.close(self._statm)
