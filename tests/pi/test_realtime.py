"""Real-time rights: taken where they are given, told where they are not."""

from __future__ import annotations

import ctypes
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import pytest

from polysight.pi_controller.system import OTHERS_PRIORITY, PRIORITY
from polysight.simulators import gpio
from tests.support.paths import REPO
from tests.support.pi.program import PROGRAM, Process
from tests.support.rigs import timed_by_the_program

pytest.importorskip("gpiod", reason="libgpiod bindings are not installed: pip install 'gpiod>=2.1'")
if lacking := gpio.missing():
    pytest.skip(f"no stand-in chip without {' '.join(lacking)}: {gpio.ENABLING_COMMAND}", allow_module_level=True)

PR_CAPBSET_DROP, CAP_IPC_LOCK, CAP_SYS_NICE = 24, 14, 23


@pytest.fixture
def instrument(instrument):
    """With SYNC_IN on a GPIO line."""
    return timed_by_the_program(instrument)


@pytest.fixture
def arguments(instrument, write_config, stage, tmp_path):
    pi = msgspec.structs.replace(instrument.pi, gpio_chip=str(tmp_path / "chip"))
    rig = msgspec.structs.replace(instrument, pi=pi)
    return (write_config(rig), "--stage-port", stage.port), gpio.environment(tmp_path / "chip")


def may_schedule():
    code = "import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


def priorities(pid):
    """Of the threads of a process that are in real time."""
    tasks = [int(t.name) for t in Path(f"/proc/{pid}/task").iterdir()]
    return [os.sched_getparam(t).sched_priority for t in tasks if os.sched_getscheduler(t) == os.SCHED_FIFO]


def test_all_threads_are_scheduled_and_the_trigger_thread_first(arguments):
    """They share the interpreter's lock: a thread that holds it must not be kept from the processor by others."""
    if not may_schedule():
        pytest.skip("SCHED_FIFO is not permitted here: run as root, or with RLIMIT_RTPRIO")
    args, environment = arguments
    with Process(*args, **environment) as p:
        assert p.ready, p.popen.communicate()
        deadline = time.monotonic() + 60
        while PRIORITY not in (found := priorities(p.popen.pid)):  # `ready` comes before the threads
            assert time.monotonic() < deadline, found
            time.sleep(0.02)
        assert found.count(PRIORITY) == 1
        assert found.count(OTHERS_PRIORITY) >= 3  # main, stage, executor
        _, _, err = p.end()
        assert "real-time" not in err


def test_what_is_not_permitted_is_said_and_the_program_runs(arguments):
    def without_rights():
        libc = ctypes.CDLL(None)
        for capability in (CAP_SYS_NICE, CAP_IPC_LOCK):
            libc.prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)  # root's; others have none
        for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK):
            resource.setrlimit(limit, (0, 0))

    args, environment = arguments
    command = [*PROGRAM, "run", "--config", *map(str, args)]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=REPO, preexec_fn=without_rights,
        env={**os.environ, **environment},
    )  # fmt: skip
    try:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready")
        process.terminate()
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 0
    assert err.count("no real-time scheduling") == 1
    assert "LimitRTPRIO=99" in err
    assert err.count("memory is not locked") == 1
    assert "LimitMEMLOCK=infinity" in err
