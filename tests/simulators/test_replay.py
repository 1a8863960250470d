"""The card that replays recordings, and the byte sequences of public DCA1000 clients that record from it.

A small client sends these sequences, with their invalid bodies.
"""

from __future__ import annotations

import json
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from itertools import repeat
from pathlib import Path

import numpy as np
import pytest
from tests.support.processes import HANG_S
from tests.support.rigs import published_rig

from polysight_simulators import process, replay
from polysight_simulators.cards import MAC, CardEndpoint, Network, Pace, bound_udp
from polysight_simulators.faults import Faults
from polysight_simulators.loopback import move_to_free_subnet
from polysight_simulators.replay import Player, Recording, scan_rows

OK = {code: bytes.fromhex(f"5aa5{code:02x}000000aaee") for code in range(1, 15)}
START = "5aa505000000aaee"
STOP = "5aa506000000aaee"
ALIVE = "5aa509000000aaee"
VERSION = "5aa50e000000aaee"
# Requests before record start; all of them work with real cards.
CLIENTS = {
    "configuration body in both commands, packets of 1472": [
        *(ALIVE, VERSION, "5aa503000600c005350c0000aaee", "5aa50b000600c005350c0000aaee")
    ],
    "two lanes, packet configuration without its size": [
        *(ALIVE, "5aa503000600010201 02031eaaee", "5aa50b0004007102 0000aaee", VERSION)
    ],
    "reset first, four lanes, delay not in ticks": [
        *("5aa501000000aaee", "5aa502000000aaee", ALIVE, VERSION, "5aa503000600010101 02031eaaee"),
        "5aa50b000600c00537000000aaee",
    ],
    "packet configuration first, alive after the configuration": [
        *(ALIVE, VERSION, "5aa50b000600be0571020000aaee", "5aa503000600010201 02031eaaee", ALIVE)
    ],
    "no configuration at all": [],
}
Play = Callable[..., "Client"]


class Client:
    """Binds 4096 and 4098 at the host's address, as they all do."""

    def __init__(self, subnet: str, sockets: ExitStack, player: subprocess.Popen[str]) -> None:
        self.player = player
        self.card = (f"{subnet}.180", 4096)
        self.commands = sockets.enter_context(bound_udp(f"{subnet}.30", 4096))
        self.data = sockets.enter_context(bound_udp(f"{subnet}.30", 4098))
        self.data.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        for s in (self.commands, self.data):
            s.settimeout(HANG_S)

    def end(self) -> None:
        """End the card's program, which must succeed."""
        if self.player.poll() is None:
            self.player.send_signal(signal.SIGTERM)
        assert self.player.wait(HANG_S) == 0

    def send(self, request: str) -> bytes:
        self.commands.sendto(bytes.fromhex(request), self.card)
        return self.commands.recv(4096)

    def packets(self, payload_bytes: int) -> bytes:
        """Return this number of payload bytes, in order of arrival."""
        got = b""
        while len(got) < payload_bytes:
            packet, source = self.data.recvfrom(4096)
            sequence, low, high = struct.unpack_from("<IIH", packet)
            assert source == (self.card[0], 1024)
            assert low | high << 32 == len(got)
            assert sequence == len(got) // 1456 + 1
            got += packet[10:]
        return got


def free_subnet() -> str:
    """A free loopback subnet 127.x.y.*."""
    return move_to_free_subnet(published_rig()).boards[0].card_address.rpartition(".")[0]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "recording.bin"
    path.write_bytes(np.random.default_rng(3).integers(0, 256, 10 * 4096 + 18, dtype=np.uint8).tobytes())
    return path


@pytest.fixture
def play() -> Iterator[Play]:
    with ExitStack() as sockets:
        clients: list[Client] = []

        def begin(source: Path, *arguments: str) -> Client:
            subnet = free_subnet()
            addresses = ("--card-address", f"{subnet}.180", "--host-address", f"{subnet}.30")
            command = [sys.executable, "-m", "polysight_simulators.replay", str(source), *addresses, *arguments]
            player = sockets.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
            sockets.callback(player.kill)
            assert player.stdout is not None
            assert player.stdout.readline().startswith("ready")
            clients.append(Client(subnet, sockets, player))
            return clients[-1]

        yield begin
        for client in clients:
            client.end()


@pytest.mark.parametrize("requests", CLIENTS.values(), ids=CLIENTS.keys())
def test_clients_of_other_people_get_their_answers_and_their_data(
    play: Play, recording: Path, requests: list[str]
) -> None:
    client = play(recording, "--rate-mbit", "100", "--time-scale", "10")
    for request in requests:
        code = bytes.fromhex(request)[2]
        assert client.send(request) == (bytes.fromhex("5aa50e000204aaee") if code == 0x0E else OK[code])
    assert client.send(START) == OK[5]
    assert client.packets(recording.stat().st_size) == recording.read_bytes()
    assert client.commands.recv(100) == bytes.fromhex("5aa50a000001aaee")
    assert client.send(STOP) == OK[6]


def test_a_connected_socket_gets_no_replies_because_they_come_from_port_1024(play: Play, recording: Path) -> None:
    client = play(recording)
    client.commands.connect(client.card)
    client.commands.settimeout(0.3)
    client.commands.send(bytes.fromhex(ALIVE))
    with pytest.raises(TimeoutError):
        client.commands.recv(100)


def test_each_record_plays_it_again_and_stop_ends_a_loop(play: Play, recording: Path) -> None:
    client = play(recording, "--loop", "--rate-mbit", "80")
    all_bytes = recording.read_bytes() * 3
    assert client.send(START) == OK[5]
    n = (2 * len(recording.read_bytes())) // 1456 * 1456
    assert client.packets(n) == all_bytes[:n]
    assert client.send(STOP) == OK[6]
    assert client.commands.recv(100) == bytes.fromhex("5aa50a000001aaee")


def test_frames_end_the_record_and_faults_are_counted(play: Play, recording: Path, tmp_path: Path) -> None:
    report = tmp_path / "report.json"
    arguments = ("--frames", "4", "--time-scale", "10", "--fault", "lose_packets=[1, 2]", "--report", str(report))
    client = play(recording, *arguments)
    assert client.send(START) == OK[5]
    sizes = [len(client.data.recv(4096)) - 10 for _ in range(10)]
    assert sum(sizes) == 4 * 4096 - 2 * 1456
    assert client.commands.recv(100) == bytes.fromhex("5aa50a000001aaee")
    assert client.send(STOP) == OK[6]
    client.end()
    counts = json.loads(report.read_text())["boards"]["card"]
    assert (counts["packets_made"], counts["packets_sent"], counts["lost"], counts["lost_bytes"]) == (12, 10, 2, 2912)


@pytest.mark.parametrize("bytes_per_s", [1e5, 7e6])
def test_it_replays_at_the_given_rate(recording: Path, bytes_per_s: float) -> None:
    """With a virtual clock."""
    now_s = 50.0
    subnet = free_subnet()
    network = Network(f"{subnet}.30", f"{subnet}.180", MAC, 4096, 4098)
    with closing(
        CardEndpoint(
            name="card",
            network=network,
            faults=Faults(),
            seed=0,
            time_scale=1.0,
            clock_s=lambda: now_s,
            pace=Pace(),
            lanes=None,
        )
    ) as endpoint:
        player = Player(endpoint, repeat(Recording(recording, loop=True)), bytes_per_s, lambda: now_s)
        endpoint.card.command(bytes.fromhex(START), now_s)
        player.turn()
        for k in range(1, 41):
            now_s = 50.0 + 0.01 * k
            player.turn()
            assert abs(endpoint.counts["lvds_bytes"] - 0.01 * k * bytes_per_s) <= 2


def test_a_recording_is_read_completely_looped_or_cut(recording: Path) -> None:
    data = recording.read_bytes()

    def read_all(source: Recording, most: int) -> bytes:
        got = b""
        while len(got) < most and not source.ended:
            got += source.read(1000).tobytes()
        return got

    assert read_all(Recording(recording), 10**9) == data
    assert read_all(Recording(recording, 5000), 10**9) == data[:5000]
    assert read_all(Recording(recording, 10**9), 10**9) == data
    assert read_all(Recording(recording, 100_000, loop=True), 10**9) == (data * 3)[:100_000]
    assert read_all(Recording(recording, loop=True), 200_000)[:200_000] == (data * 5)[:200_000]


def test_rows_of_a_scan_folder_are_those_committed_last(tmp_path: Path) -> None:
    facts = [
        {"fact": "scan_started"},
        {"fact": "row_committed", "row": 1, "boards": {"RH": {"file": "raw/RH/0001.bin"}}},
        {"fact": "row_committed", "row": 0, "boards": {"RH": {"file": "raw/RH/0000.bin"}}},
        {"fact": "row_committed", "row": 1, "boards": {"RH": {"file": "raw/RH/0001-2.bin"}}},
    ]
    (tmp_path / "manifest.jsonl").write_text("\n".join(map(json.dumps, facts)) + '\n{"fact": "row_comm')
    assert scan_rows(tmp_path, "RH", None) == [tmp_path / "raw/RH/0000.bin", tmp_path / "raw/RH/0001-2.bin"]
    assert scan_rows(tmp_path, "RH", 0) == [tmp_path / "raw/RH/0000.bin"]


@pytest.mark.parametrize(
    ("arguments", "named", "status"),
    [
        (["nowhere.bin"], "nowhere.bin", 3),
        (["{folder}"], "--board", 2),
        (["{folder}", "--board", "RH"], "manifest.jsonl", 3),
        (["{file}", "--row", "3"], "--row", 2),
        (["{file}", "--rate-mbit", "0"], "--rate-mbit 0", 2),
        (["{file}", "--fault", "overflow=0.1"], "overflow", 2),
        (["{file}", "--fault", "radar_fault_pulses=[1]"], "radar_fault_pulses", 2),
        (["{file}", "--card-address", "203.0.113.9"], "203.0.113.9", 5),
    ],
)
def test_invalid_arguments_are_refused(
    recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], arguments: list[str],
    named: str, status: int,
) -> None:  # fmt: skip
    monkeypatch.setattr(process, "die_with_parent", lambda: None)
    monkeypatch.setattr(process, "stop_requested", threading.Event)
    assert replay.main([a.format(folder=recording.parent, file=recording) for a in arguments]) == status
    assert named in capsys.readouterr().err
