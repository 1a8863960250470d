"""User-mode Linux: built on demand, started with a program in it."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest
import tomli_w
from tests.support.paths import REPO
from tests.support.rigs import load_published_rig, time_by_the_program

from polysight_shared.config import Instrument
from polysight_shared.program import die_with_parent
from polysight_shared.tables import to_builtins
from polysight_simulators.uno import ENABLING_COMMAND, compile_emulator, compile_firmware, list_missing_packages

HERE = Path(__file__).parent
# Longest time of a guest, seconds. A published row takes 4 minutes of a core, and on a busy machine a guest has a fifth
# of a core: only a guest that hangs reaches the limit.
LIMIT_S = 3000


@pytest.fixture(scope="session")
def kernel(request: pytest.FixtureRequest) -> Path:
    """The kernel, with simulated GPIO chips."""
    if not request.config.getoption("--uml"):
        pytest.skip("not asked for: `make test-uml` builds a user-mode Linux (minutes, once) and runs these too")
    if lacking := list_missing_packages():
        pytest.skip(f"no emulated UNO without {' '.join(lacking)}: `{ENABLING_COMMAND}` runs these tests too")
    # Compiled here, because in the guest everything is read-only.
    compile_emulator()
    compile_firmware()
    built = subprocess.run([str(HERE / "build_kernel.sh")], stdout=subprocess.PIPE, text=True, check=False)
    assert built.returncode == 0, "the kernel was not built: see above"
    return Path(built.stdout.splitlines()[-1])


@pytest.fixture
def run_row(kernel: Path, tmp_path: Path) -> Callable[..., dict[str, Any]]:
    """Function that runs chain.py in the guest for a row of `points` positions, with options of the kernel."""

    def run(points: int, *options: str, real_time: bool = False, speed_mm_s: float = 20.0) -> dict[str, Any]:
        config = tmp_path / "instrument.toml"
        rig = _make_rig(points, one_shot=real_time, speed_mm_s=speed_mm_s)
        config.write_bytes(tomli_w.dumps(to_builtins(rig)).encode())
        program = [
            f"PYTHON={sys.executable}",
            f"PYTHONPATH={REPO}",
            f"PROGRAM={HERE / 'chain.py'}",
            f"ARGUMENT={config}",
        ]
        root = ["root=/dev/root", "rootfstype=hostfs", "rootflags=/", "ro", "mem=256M", f"init={HERE / 'init.sh'}"]
        console = ["con=null", "con0=null,fd:1", "quiet"]
        process = subprocess.run(
            [str(kernel), *root, *console, *options, *program],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=LIMIT_S,
            check=False,
            preexec_fn=partial(_prepare_guest, real_time),
        )
        results = [line.removeprefix("RESULT ") for line in process.stdout.splitlines() if line.startswith("RESULT ")]
        assert results, f"the guest says:\n{process.stdout[-3000:]}"
        return json.loads(results[0])

    return run


def _prepare_guest(real_time: bool) -> None:
    """Let the guest's process end with the tests, however they end.

    In real time it is also scheduled before other programs, where that is permitted: a Pi does not share its processor
    with a test suite.
    """
    die_with_parent(signal.SIGKILL)
    if real_time:
        with suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))


def _make_rig(points: int, one_shot: bool, speed_mm_s: float) -> Instrument:
    """The published rig with one row, near the home corner.

    In user-mode Linux a system call takes some 10 us of real time: without a one-shot pulses are too long there.
    """
    rig = time_by_the_program(load_published_rig())
    replace = msgspec.structs.replace
    width_mm = (points - 1) * rig.grid.step_x_mm
    return replace(
        rig,
        grid=replace(rig.grid, columns=points, rows=1),
        stage=replace(
            rig.stage, heartbeat_ms=5000, centre_x_mm=10 + width_mm / 2, centre_y_mm=5.0, speed_mm_s=speed_mm_s
        ),
        pi=replace(rig.pi, one_shot=one_shot, journal_dir="/run/journal", key_dir="/run/keys"),
    )
