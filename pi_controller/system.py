"""What this program asks of Linux: to be on time, to be watched by systemd, and not to run out of memory."""

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

_PR_SET_PDEATHSIG, _PR_SET_TIMERSLACK = 1, 29
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
# Of the trigger thread, and of the others: they share the interpreter's lock with it, so none may be kept from the
# processor by other programs while it holds that lock.
PRIORITY, OTHERS_PRIORITY = 50, 40
SWITCH_INTERVAL_S = 100e-6  # a thread that computes gives way after 5 ms by default: three pulse periods
MOST_BYTES = 160 << 20  # the program takes 30 to 60 MB, a subscriber that stands still up to 50
SPARE_BYTES = 64 << 20  # above what a cut leaves, at least: freed memory does not all go back to the system
LOOK_S = 0.05
SETTLE_S = 0.5


def prepare_process() -> list[str]:
    """Lock memory, freeze the garbage collector's heap, let threads take over quickly, ask for real-time scheduling.

    Returns what was not permitted, one sentence each, with what to do.
    """
    gc.freeze()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    refused = _schedule(OTHERS_PRIORITY)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        refused.append(
            f"memory is not locked ({os.strerror(ctypes.get_errno())}): a page fault can delay a pulse; "
            "set LimitMEMLOCK=infinity in the service"
        )
    return refused


def prepare_thread(priority: int = PRIORITY) -> list[str]:
    """The trigger thread's priority and the shortest timer slack. Returns what was not permitted, as above."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0) != 0:
        return ["timer slack stays at 50 us: pulses may be that late", *_schedule(priority)]
    return _schedule(priority)


def _schedule(priority: int) -> list[str]:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as e:
        remedy = "set LimitRTPRIO=99 in the service"
        return [f"no real-time scheduling ({e.strerror}): other programs can delay a pulse; {remedy}"]
    return []


def notify_systemd(state: str) -> None:
    """Tell the service manager, if there is one (sd_notify(3)): `READY=1`, or `WATCHDOG=1` to be left alive."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if address:
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as s:
            s.sendto(state.encode("ascii"), "\0" + address[1:] if address.startswith("@") else address)


def die_with_parent(signal_number: int) -> None:
    """Ask the kernel to send this signal when the parent ends: a simulated rig leaves no processes behind."""
    parent = os.getppid()
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal_number, 0, 0, 0)
    if os.getppid() != parent:
        os.kill(os.getpid(), signal_number)


class MemoryWatch(threading.Thread):
    """Cuts the network connections at `ports` when they take too much memory; clients connect again.

    ZeroMQ bounds a frame, but neither a message of many frames nor how much a client may subscribe to, and it takes
    both in while this program waits for it. The unit's own bound (MemoryMax) would end the program, and a row with it.
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
        return int(os.pread(self._statm, 100, 0).split()[1]) * os.sysconf("SC_PAGE_SIZE")

    def run(self) -> None:
        """Look until :meth:`stop`."""
        while not self._ended.wait(LOOK_S):
            held = self.resident_bytes()
            if held <= self._most_bytes:
                continue
            with suppress(OSError):  # no descriptor is left: again at the next look
                cut = self._cut_connections()
                self._ended.wait(SETTLE_S)
                ctypes.CDLL(None).malloc_trim(0)
                left = self.resident_bytes()
                self._most_bytes = max(MOST_BYTES, left + SPARE_BYTES)
                self._warn(f"{held >> 20} MiB in memory: {cut} connections were cut, {left >> 20} MiB are left")

    def _cut_connections(self) -> int:
        """Shut this process's TCP connections at the ports down: closing them is ZeroMQ's. Returns how many."""
        cut = 0
        for link in Path("/proc/self/fd").iterdir():
            with suppress(OSError):  # closed meanwhile, or nobody is connected
                if not str(link.readlink()).startswith("socket:"):
                    continue
                with socket.socket(fileno=os.dup(int(link.name))) as s:
                    if s.family in (socket.AF_INET, socket.AF_INET6) and s.getsockname()[1] in self._ports:
                        s.getpeername()
                        s.shutdown(socket.SHUT_RDWR)
                        cut += 1
        return cut

    def stop(self) -> None:
        """End it."""
        self._ended.set()
        self.join()
        os.close(self._statm)
