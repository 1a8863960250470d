"""The launcher of the simulated rig: everything starts with its rig file, and everything ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from polysight.shared.config import load_instrument
from polysight.simulators.cards import bound_udp
from polysight.simulators.rig import card_groups
from tests.support.paths import RIG_FILE
from tests.support.rigs import published_rig
from tests.support.scenes import small_scene

SCENE = small_scene(10, 4)
Launch = Callable[..., subprocess.Popen[str]]


@pytest.fixture
def launch(tmp_path: Path) -> Iterator[Launch]:
    started: list[subprocess.Popen[str]] = []

    def begin(*arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "polysight.simulators.rig", "--config", str(RIG_FILE)]
        command += ["--dir", str(tmp_path / "rig"), *arguments]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        started.append(process)
        return process

    yield begin
    for process in started:
        process.kill()
        process.communicate()


def children(process: subprocess.Popen[str]) -> dict[str, int]:
    """Process ids below the rig, by module."""
    found = {}
    for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split():
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
        found[next((w for w in words if w.startswith("polysight.simulators.")), words[0])] = int(pid)
    return found


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_the_rig_starts_writes_its_rig_file_and_truth_and_ends_everything(launch: Launch, tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE)
    process = launch("--scene", str(scene), "--time-scale", "30")
    assert process.stdout is not None
    ready = process.stdout.readline()
    assert ready == f"ready {tmp_path / 'rig' / 'instrument.toml'}\n"
    rig = load_instrument(tmp_path / "rig" / "instrument.toml")
    assert (rig.grid.columns, rig.grid.rows) == (10, 4)
    assert rig.name.endswith("(simulated)")
    assert Path(rig.stage.port).exists()
    assert json.loads((tmp_path / "rig" / "truth.json").read_text())
    pids = children(process)
    assert len(pids) >= 3
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 0
    assert not any(alive(pid) for pid in pids.values())
    assert not Path(rig.stage.port).exists()
    assert not (tmp_path / "rig" / "wires.sock").exists()


def test_a_power_cycle_reaches_every_card_and_is_in_the_reports(launch: Launch, tmp_path: Path) -> None:
    process = launch("--pattern", "--fault", "boot_s=1000")
    assert process.stdout is not None
    assert process.stdout.readline().startswith("ready")
    rig = load_instrument(tmp_path / "rig" / "instrument.toml")
    process.send_signal(signal.SIGUSR1)
    for board in rig.boards:
        with bound_udp(board.host_address, board.command_port) as host:
            host.settimeout(1.0)
            limit = time.monotonic() + 60
            while time.monotonic() < limit:  # until it boots, which here takes for ever
                host.sendto(bytes.fromhex("5aa509000000aaee"), (board.card_address, board.command_port))
                try:
                    assert host.recv(100) == bytes.fromhex("5aa509000000aaee")
                except TimeoutError:
                    break
            else:
                pytest.fail(f"{board.name} was not switched off")
    process.send_signal(signal.SIGTERM)
    assert process.wait(10) == 0
    counts = {}
    for report in (tmp_path / "rig").glob("cards-*.json"):
        counts |= json.loads(report.read_text())["boards"]
    assert {name: c["power_cycles"] for name, c in counts.items()} == dict.fromkeys(("LS", "RH", "RV"), 1)


def test_a_process_that_dies_ends_the_rig_and_is_named(launch: Launch, tmp_path: Path) -> None:
    process = launch("--pattern")
    assert process.stdout is not None
    assert process.stderr is not None
    assert process.stdout.readline().startswith("ready")
    pids = children(process)
    os.kill(pids["polysight.simulators.wires"], signal.SIGKILL)
    assert process.wait(15) == 5
    message = process.stderr.read()
    assert "process ended with status" in message
    assert str(tmp_path / "rig" / "logs") in message
    assert "Traceback" not in message
    assert not any(alive(pid) for pid in pids.values())


def test_each_recorded_board_has_a_process_and_no_board_is_left_out() -> None:
    assert card_groups(published_rig()) == ["RH,LS", "RV"]
