"""Linux services: real-time scheduling, systemd notifications, and a limit on memory."""

from __future__ import annotations

import ctypes
import gc
import os
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

# <linux/prctl.h>, <linux/mman.h>
_PR_SET_TIMERSLACK = 29
_MCL_CURRENT_FUTURE_ONFAULT = 1 | 2 | 4
# Real-time priorities of the trigger thread and of the others. All share the interpreter's lock, so a thread that
# holds it must not be preempted by other programs.
TRIGGER_PRIORITY = 50
OTHERS_PRIORITY = 40
# Longest time for which a thread keeps the interpreter while others wait. Python's default of 5 ms would delay the
# trigger thread by three pulses of a burst, which come 1.5 ms apart.
SWITCH_INTERVAL_S = 100e-6
# Memory above which connections are cut. The program itself needs 30 to 60 MB. A subscriber that stops reading costs up
# to 50 MB more, for the events that wait for it.
MAX_BYTES = 160 << 20
# After connections were cut, memory stays in use because not all that was freed returns to the system. The limit is
# then raised to so much above it, or the next check would cut connections again. Chosen.
SPARE_BYTES = 64 << 20
# Time between two checks of the memory, and time in which connections are cut after too much was used; chosen.
CHECK_INTERVAL_S = 0.05
CUTTING_TIME_S = 0.5


def prepare_process() -> list[str]:
    """Lock memory, exempt present objects from garbage collection, shorten thread switching, request real time.

    Returns one sentence for each right that was not granted, with the remedy.
    """
    gc.freeze()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    refused = _request_real_time(OTHERS_PRIORITY)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT_FUTURE_ONFAULT) != 0:
        refused.append(
            f"memory is not locked ({os.strerror(ctypes.get_errno())}): a page fault can delay a pulse; "
            "set LimitMEMLOCK=infinity in the service"
        )
    return refused


def prepare_thread() -> list[str]:
    """Give the calling thread (the trigger thread) its priority and the shortest timer slack.

    Returns as :func:`prepare_process`.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0) != 0:
        return ["timer slack stays at 50 us: pulses may be that late", *_request_real_time(TRIGGER_PRIORITY)]
    return _request_real_time(TRIGGER_PRIORITY)


def _request_real_time(priority: int) -> list[str]:
    """Give this thread a real-time priority; return a sentence with the remedy if that is not allowed."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as e:
        remedy = "set LimitRTPRIO=99 in the service"
        return [f"no real-time scheduling ({e.strerror}): other programs can delay a pulse; {remedy}"]
    return []


def notify_systemd(state: str) -> None:
    """Notify the service manager, if there is one (sd_notify(3)): `READY=1`, or `WATCHDOG=1` to feed the watchdog."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if address:
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as notify_socket:
            # "@" stands for the zero byte that begins the name of an abstract socket.
            if address.startswith("@"):
                address = "\0" + address[1:]
            notify_socket.sendto(state.encode("ascii"), address)


class MemoryWatch(threading.Thread):
    """Cuts the network connections at `ports` when they use too much memory; clients connect again.

    ZeroMQ limits the size of a frame, but neither the frames of a message nor the subscriptions of a client. The unit's
    own limit (MemoryMax) would end the program in the middle of a scan. Each cut is reported to `warn`.
    """

    def __init__(self, ports: set[int], warn: Callable[[str], object]) -> None:
        super().__init__(name="memory", daemon=True)
        self._ports = ports
        self._warn = warn
        self._ended = threading.Event()
        # The file stays open: later there may be no free descriptor to open it.
        self._statm = os.open("/proc/self/statm", os.O_RDONLY | os.O_CLOEXEC)
        self._limit_bytes = max(MAX_BYTES, self.resident_bytes() + SPARE_BYTES)

    def resident_bytes(self) -> int:
        """Return the memory in use by this process."""
        return int(os.pread(self._statm, 100, 0).split()[1]) * os.sysconf("SC_PAGE_SIZE")

    def run(self) -> None:
        """Check the memory regularly until :meth:`stop`."""
        while not self._ended.wait(CHECK_INTERVAL_S):
            used_bytes = self.resident_bytes()
            if used_bytes <= self._limit_bytes:
                continue
            # If there is no free descriptor, the next check tries again.
            with suppress(OSError):
                cut = self._cut_connections()
                # A client that connects again and continues to flood would fill the memory before the next check.
                for _ in range(round(CUTTING_TIME_S / CHECK_INTERVAL_S)):
                    self._ended.wait(CHECK_INTERVAL_S)
                    cut += self._cut_connections()
                ctypes.CDLL(None).malloc_trim(0)
                left_bytes = self.resident_bytes()
                self._limit_bytes = max(MAX_BYTES, left_bytes + SPARE_BYTES)
                used_mib = used_bytes >> 20
                self._warn(f"{used_mib} MiB in memory: {cut} connections were cut, {left_bytes >> 20} MiB are left")

    def _cut_connections(self) -> int:
        """Shut down the TCP connections at the ports (ZeroMQ closes them). Return their number."""
        cut = 0
        for link in Path("/proc/self/fd").iterdir():
            # OSError: the socket was closed meanwhile, or is not connected.
            with suppress(OSError):
                if not str(link.readlink()).startswith("socket:"):
                    continue
                with socket.socket(fileno=os.dup(int(link.name))) as connection:
                    if (
                        connection.family in (socket.AF_INET, socket.AF_INET6)
                        and connection.getsockname()[1] in self._ports
                    ):
                        # Raises OSError for a socket without a peer: the one that listens must stay open.
                        connection.getpeername()
                        connection.shutdown(socket.SHUT_RDWR)
                        cut += 1
        return cut

    def stop(self) -> None:
        """End the thread."""
        self._ended.set()
        self.join()
        os.close(self._statm)
