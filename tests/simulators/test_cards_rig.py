"""The launcher of the simulated rig: everything starts with its rig file, and everything ends."""

from __future__ import annotations

import json
import os
import signal
import socket
from contextlib import closing
from pathlib import Path

import pytest
from tests.support.paths import RIG_FILE
from tests.support.processes import Bench, Program, wait_for
from tests.support.rigs import published_rig
from tests.support.scenes import small_scene
from tests.support.stage.processes import runs

from polysight_shared.config import Board, load_instrument
from polysight_simulators.cards import bound_udp
from polysight_simulators.rig import card_groups

SCENE = small_scene(10, 4)


@pytest.fixture
def launch(tmp_path):
    """Starts the simulated rig in `tmp_path`/rig."""
    with closing(Bench(tmp_path)) as bench:
        rig = ("python", "-m", "polysight_simulators.rig", "--config", RIG_FILE, "--dir", tmp_path / "rig")
        yield lambda *arguments: bench.start(*rig, *arguments)


def children(program: Program) -> dict[str, int]:
    """Process ids below the rig, by module."""
    collected = {}
    pid = program.process.pid
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        words = Path(f"/proc/{child}/cmdline").read_bytes().decode().split("\0")
        collected[next((w for w in words if w.startswith("polysight_simulators.")), words[0])] = int(child)
    return collected


def test_the_rig_starts_writes_its_rig_file_and_truth_and_ends_everything(launch, tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE)
    process = launch("--scene", str(scene), "--time-scale", "30")
    assert process.wait_ready() == str(tmp_path / "rig" / "instrument.toml")
    rig = load_instrument(tmp_path / "rig" / "instrument.toml")
    assert (rig.grid.columns, rig.grid.rows) == (10, 4)
    assert rig.name.endswith("(simulated)")
    assert Path(rig.stage.port).exists()
    assert json.loads((tmp_path / "rig" / "truth.json").read_text())
    pids = children(process)
    assert len(pids) >= 3
    process.end()
    assert process.process.returncode == 0
    assert not any(runs(pid) for pid in pids.values())
    assert not Path(rig.stage.port).exists()
    assert not (tmp_path / "rig" / "wires.sock").exists()


def test_a_power_cycle_reaches_every_card_and_is_in_the_reports(launch, tmp_path):
    process = launch("--pattern", "--fault", "boot_s=1000")
    process.wait_ready()
    rig = load_instrument(tmp_path / "rig" / "instrument.toml")
    process.process.send_signal(signal.SIGUSR1)
    for board in rig.boards:
        with bound_udp(board.host_address, board.command_port) as host:
            host.settimeout(1.0)

            def is_silent(host: socket.socket = host, board: Board = board) -> bool:
                """Until it boots, which here takes for ever."""
                host.sendto(bytes.fromhex("5aa509000000aaee"), (board.card_address, board.command_port))
                try:
                    return host.recv(100) != bytes.fromhex("5aa509000000aaee")
                except TimeoutError:
                    return True

            wait_for(is_silent, f"that {board.name} is switched off")
    process.end()
    assert process.process.returncode == 0
    counts = {}
    for report in (tmp_path / "rig").glob("cards-*.json"):
        counts |= json.loads(report.read_text())["boards"]
    assert {name: c["power_cycles"] for name, c in counts.items()} == dict.fromkeys(("LS", "RH", "RV"), 1)


def test_a_process_that_dies_ends_the_rig_and_is_named(launch, tmp_path):
    process = launch("--pattern")
    process.wait_ready()
    pids = children(process)
    os.kill(pids["polysight_simulators.wires"], signal.SIGKILL)
    ended = process.wait()
    assert ended.status == 5
    assert "process ended with status" in ended.err
    assert str(tmp_path / "rig" / "logs") in ended.err
    assert "Traceback" not in ended.err
    assert not any(runs(pid) for pid in pids.values())


def test_each_recorded_board_has_a_process_and_no_board_is_left_out() -> None:
    assert card_groups(published_rig()) == ["RH,LS", "RV"]
