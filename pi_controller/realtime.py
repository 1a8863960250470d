"""What an ordinary process can ask of Linux to be on time, and what it was given."""

from __future__ import annotations

import ctypes
import gc
import os
import socket
import sys
from contextlib import suppress

_PR_SET_PDEATHSIG, _PR_SET_TIMERSLACK = 1, 29
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
# Of the trigger thread, and of the others: they share the interpreter's lock with it, so none may be kept from the
# processor by other programs while it holds that lock.
PRIORITY, OTHERS_PRIORITY = 50, 40
SWITCH_INTERVAL_S = 100e-6


def prepare_process() -> list[str]:
    """Lock memory, freeze the garbage collector's heap, let threads take over quickly, ask for real-time scheduling.

    Returns what was not permitted, one sentence each, with what to do.
    """
    gc.freeze()
    # A thread that computes gives way after 5 ms by default: three pulse periods.
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
