"""Where and how urgently the receiving processes run, so that processing in the host never starves them."""

from __future__ import annotations

import os
from typing import NamedTuple

REAL_TIME = 5  # below the kernel's own threads and the Pi's pulses (where both run on one machine)
NICE = -5
PRIORITY_REMEDY = (
    "`sudo host/rights.sh USER` (USER: who scans), then log out and in again, or restart the machine (docs/how-to/"
    "install.md); without it a busy machine may lose packets, which are counted and their row taken again"
)


class Core(NamedTuple):
    """A core for a receiver, and whether it has it to itself among the receivers."""

    number: int
    own: bool


def receiver_cores(receivers: int, cores: list[int] | None = None) -> list[Core | None]:
    """A core for each receiver, from the last one down; the first is left to the host. None where there is only one.

    Parameters
    ----------
    receivers
        How many will run.
    cores
        What this process may use; asked for when None.
    """
    if cores is None:
        cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    usable = cores[1:][::-1]
    own = len(usable) >= receivers
    return [Core(usable[k % len(usable)], own) if usable else None for k in range(receivers)]


def take_core(core: int | None, own: bool = True, urgent: bool = True) -> tuple[int | None, str]:
    """Pin this process to a core. Returns the core it is on (None: any), and what could not be done ("" when all).

    Not on a core that it shares with other receivers (`own` false), unless it is `urgent`, of real-time priority:
    ordinary processes pinned to one core lose far more packets than where the kernel may move them.
    """
    if core is None or not (own or urgent):
        return None, ""
    try:
        os.sched_setaffinity(0, {core})
    except (AttributeError, OSError) as e:
        return None, f"not pinned to core {core}: {e}"
    return core, ""


def take_priority(real_time: int = REAL_TIME, nice: int = NICE) -> tuple[str, str]:
    """Run before all ordinary processes, or at least before most. Returns what is in force, and what was not permitted.

    Real time (round robin) needs CAP_SYS_NICE, and so does a negative nice value. A receiver sleeps for a millisecond
    between batches, so it never takes the whole of a core.
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
