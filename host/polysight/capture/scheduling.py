"""Priority and cores of the receiver processes, so that processing in the host does not delay them."""

from __future__ import annotations

import os
from typing import NamedTuple

REAL_TIME = 5  # below the kernel's threads, and below the Pi's pulses if both run on one machine
NICE = -5
PRIORITY_REMEDY = (
    "`sudo host/rights.sh USER` (USER: the user who scans), then log out and in again, or restart the machine"
    " (docs/how-to/install.md); without it a busy machine may lose packets, which are counted and their row retaken"
)


class Core(NamedTuple):
    """A core for a receiver; `own` if no other receiver shares it."""

    number: int
    own: bool


def receiver_cores(receivers: int, cores: list[int] | None = None) -> list[Core | None]:
    """Choose a core for each receiver, from the last one down; the first is the host's. None if there is only one.

    `cores` are the usable cores (default: those of this process).
    """
    if cores is None:
        cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    usable = cores[1:][::-1]
    own = len(usable) >= receivers
    return [Core(usable[k % len(usable)], own) if usable else None for k in range(receivers)]


def take_core(core: int | None, own: bool = True, urgent: bool = True) -> tuple[int | None, str]:
    """Pin this process to a core; return the core (None: any) and a warning ("" if there is none).

    A core shared with other receivers (`own` False) is used only with real-time priority (`urgent`): ordinary processes
    pinned to one core lose far more packets than processes that the kernel may move.
    """
    if core is None or not (own or urgent):
        return None, ""
    try:
        os.sched_setaffinity(0, {core})
    except (AttributeError, OSError) as e:
        return None, f"not pinned to core {core}: {e}"
    return core, ""


def take_priority(real_time: int = REAL_TIME, nice: int = NICE) -> tuple[str, str]:
    """Give this process real-time priority, or else a lower nice value; return the priority and what was not permitted.

    Real time (round robin) and negative nice values need CAP_SYS_NICE. A receiver sleeps for a millisecond between
    batches, so it never occupies a whole core.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(real_time))
    except (AttributeError, OSError) as e:
        refused = f"no real-time priority: {e.strerror if isinstance(e, OSError) else e}"
    else:
        return f"real-time priority {real_time}", ""
    try:
        os.setpriority(os.PRIO_PROCESS, 0, nice)
    except OSError as e:
        return f"nice {os.getpriority(os.PRIO_PROCESS, 0)}", f"{refused}; nice {nice}: {e.strerror}"
    return f"nice {nice}", refused
