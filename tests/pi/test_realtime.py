"""Real-time rights: used if granted, reported if not."""

from __future__ import annotations

import ctypes
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tests.support.pi.program import require_stand_in_chip

from polysight_pi.system import OTHERS_PRIORITY, PRIORITY
from polysight_simulators import gpio

require_stand_in_chip()

PR_CAPBSET_DROP, CAP_IPC_LOCK, CAP_SYS_NICE = 24, 14, 23


def may_schedule():
    code = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


def priorities(pid):
    """Of the threads of a process that are in real time."""
    tasks = [int(t.name) for t in Path(f"/proc/{pid}/task").iterdir()]
    return [os.sched_getparam(t).sched_priority for t in tasks if os.sched_getscheduler(t) == os.SCHED_FIFO]


def test_all_threads_are_scheduled_and_the_trigger_thread_first(start, gpio_rig):
    """They share the interpreter's lock: a thread that holds it must not be preempted by other programs."""
    if not may_schedule():
        pytest.skip("SCHED_FIFO is not permitted here: run as root, or with RLIMIT_RTPRIO")
    program, _ = start(gpio_rig, **gpio.environment(gpio_rig.pi.gpio_chip))
    deadline = time.monotonic() + 60
    while PRIORITY not in (found := priorities(program.popen.pid)):  # `ready` comes before the threads
        assert time.monotonic() < deadline, found
        time.sleep(0.02)
    assert found.count(PRIORITY) == 1
    assert found.count(OTHERS_PRIORITY) >= 3  # main, stage, executor
    assert "real-time" not in program.end()[2]


def test_rights_that_are_missing_are_reported_once_and_the_program_runs(start, gpio_rig):
    def without_rights():
        libc = ctypes.CDLL(None)
        for capability in (CAP_SYS_NICE, CAP_IPC_LOCK):
            libc.prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)  # root's; others have none
        for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK):
            resource.setrlimit(limit, (0, 0))

    program, _ = start(gpio_rig, preexec_fn=without_rights, **gpio.environment(gpio_rig.pi.gpio_chip))
    status, _, err = program.end()
    assert status == 0
    for text in ("no real-time scheduling", "LimitRTPRIO=99", "memory is not locked", "LimitMEMLOCK=infinity"):
        assert err.count(text) == 1, text
