"""The process of the simulated cards; the test is host and Pi, over real sockets and the real hub."""

from __future__ import annotations

import re
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from tests.simulators.card_bench import ALIVE, EEPROM, FRAME, PERIOD_NS, START, Bench, payload, reply
from tests.support.processes import HANG_S
from tests.support.refusals import refused

from polysight_shared.config import Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.tables import to_builtins
from polysight_shared.wires import WireClient, WireEdge, WireMotion
from polysight_simulators.cards import CardEndpoint, CardSender, Network, bound_udp
from polysight_simulators.cards.card import ReceiveQueue
from polysight_simulators.faults import Faults
from polysight_simulators.loopback import is_free, move_to_subnet
from polysight_simulators.scene import pattern_frames

TIME_SCALE = 20.0
# pi.sync_out of the shipped rig file
SYNC = 22
CONFIGURE = bytes.fromhex("01010102031e")
PACKET = bytes.fromhex("be05350c0000")
COMPLETED = bytes.fromhex("5aa50a000001aaee")


class HostSide:
    """The host's two sockets for one board."""

    def __init__(self, rig: Instrument, name: str, sockets: ExitStack) -> None:
        self.board = rig.by_name(name)
        self.index = rig.boards.index(self.board)
        self.commands = sockets.enter_context(bound_udp(self.board.host_address, self.board.command_port))
        self.data = sockets.enter_context(bound_udp(self.board.host_address, self.board.data_port))
        for s in (self.commands, self.data):
            s.settimeout(HANG_S)
        self.data.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)

    def request(self, code: int, body: bytes = b"") -> bytes:
        datagram = struct.pack("<HHH", 0xA55A, code, len(body)) + body + b"\xaa\xee"
        self.commands.sendto(datagram, (self.board.card_address, self.board.command_port))
        return self.message()

    def message(self) -> bytes:
        reply, source = self.commands.recvfrom(100)
        assert source == (self.board.card_address, 1024)
        return reply

    def start(self) -> None:
        for code, body in ((0x03, CONFIGURE), (0x0B, PACKET), (0x05, b"")):
            assert self.request(code, body) == struct.pack("<HHHH", 0xA55A, code, 0, 0xEEAA)

    def record(self) -> list[bytes]:
        """All data packets until the record-completed status, which comes after the last of them."""
        assert self.message() == COMPLETED
        got = []
        self.data.setblocking(False)
        while True:
            try:
                packet, source = self.data.recvfrom(2000)
            except BlockingIOError:
                self.data.settimeout(HANG_S)
                return got
            assert source == (self.board.card_address, 1024)
            got.append(packet)

    def pattern(self, first: int, n: int) -> bytes:
        return pattern_frames(self.index, first, n, 256).tobytes()


def sequences(packets: list[bytes]) -> list[int]:
    return [struct.unpack_from("<I", p)[0] for p in packets]


Start = Callable[..., dict[str, HostSide]]


@pytest.fixture
def config(rig: Instrument, tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    path.write_text(tomli_w.dumps(to_builtins(rig)))
    return path


@pytest.fixture
def start(rig: Instrument, config: Path, tmp_path: Path) -> Iterator[Start]:
    """Starts hub and cards with the given arguments; host sockets per board."""
    running: list[subprocess.Popen[str]] = []
    with ExitStack() as sockets:

        def launch(*arguments: str) -> subprocess.Popen[str]:
            process = sockets.enter_context(
                subprocess.Popen([sys.executable, "-m", *arguments], stdout=subprocess.PIPE, text=True)
            )
            sockets.callback(process.kill)  # without effect on one that has ended
            running.append(process)
            assert process.stdout is not None
            assert process.stdout.readline().startswith("ready")
            return process

        def begin(*arguments: str, boards: str = "RH,RV") -> dict[str, HostSide]:
            launch("polysight_simulators.wires", "--socket", str(tmp_path / "w.sock"))
            common = ("--config", str(config), "--wires", str(tmp_path / "w.sock"), "--boards", boards, "--pattern")
            launch("polysight_simulators.cards", *common, "--time-scale", str(TIME_SCALE), *arguments)
            return {name: HostSide(rig, name, sockets) for name in boards.split(",")}

        yield begin
        for process in reversed(running):
            process.send_signal(signal.SIGTERM)
            assert process.wait(HANG_S) == 0


@pytest.fixture
def pulse(start: Start, tmp_path: Path) -> Iterator[Callable[..., None]]:
    """Sends n SYNC_IN pulses from pulse number `first` on, 1.5 ms apart; returns when the hub has passed them on."""
    del start
    clients: list[WireClient] = []

    def send(first: int, n: int, line: int = SYNC) -> None:
        if not clients:
            clients.append(WireClient(tmp_path / "w.sock"))
            # Joined last, and so is told last
            clients.append(WireClient(tmp_path / "w.sock", (SYNC, 23)))
        edges = []
        for k in range(first, first + n):
            edges += [WireEdge(k * PERIOD_NS, line, 1), WireEdge(k * PERIOD_NS + 1000, line, 0)]
        clients[0].send(*edges)
        while clients[1].receive(HANG_S) != edges[-1]:
            pass

    yield send
    for client in clients:
        client.close()


def test_two_records_of_two_boards_arrive_bit_for_bit(start: Start, pulse: Callable[..., None]) -> None:
    hosts = start()
    last = dict.fromkeys(hosts, 0)
    for first, frames in ((0, 48), (48, 33)):
        for host in hosts.values():
            host.start()
        began = time.monotonic()
        pulse(first, frames)
        for name, host in hosts.items():
            packets = host.record()
            assert payload(packets) == host.pattern(first, frames)
            assert [len(p) for p in packets[:-1]] == [1466] * (len(packets) - 1)
            assert len(packets[-1]) == 10 + frames * FRAME % 1456
            assert sequences(packets) == list(range(last[name] + 1, last[name] + len(packets) + 1))
            last[name] += len(packets)
        assert time.monotonic() - began >= 2.0 / TIME_SCALE


def test_a_record_goes_on_while_the_stage_moves_or_owes_a_burst(
    start: Start, pulse: Callable[..., None], tmp_path: Path
) -> None:
    host = start(boards="RH")["RH"]
    host.start()
    stage = WireClient(tmp_path / "w.sock")
    stage.send(WireMotion(0, 0, 0, 20_000), WireEdge(0, 26, 1))
    pulse(1, 2)
    # Four times the 2 s of wire time after which the record would be over
    host.commands.settimeout(0.4)
    with pytest.raises(TimeoutError):
        host.message()
    stage.send(WireEdge(10 * PERIOD_NS, 26, 1), WireMotion(20 * PERIOD_NS, 0, 0, 0))
    with pytest.raises(TimeoutError):
        host.message()
    host.commands.settimeout(HANG_S)
    pulse(11, 2)
    assert payload(host.record()) == host.pattern(0, 4)
    stage.close()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--pattern", "--boards", "XX"], "no such board"),
        (["--boards", "RH"], "neither --scene nor --pattern"),
    ],
)
def test_wrong_arguments_are_one_message(config: Path, tmp_path: Path, arguments: list[str], words: str) -> None:
    command = [sys.executable, "-m", "polysight_simulators.cards", "--config", config, "--wires", tmp_path / "w.sock"]
    done = subprocess.run([*command, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr


def test_a_rig_on_its_own_subnet_keeps_ports_and_last_bytes(rig: Instrument) -> None:
    moved = move_to_subnet(rig, "127.1.2")
    assert [b.card_address for b in moved.boards] == ["127.1.2.180", "127.1.2.181", "127.1.2.182"]
    assert {b.host_address for b in moved.boards} == {"127.1.2.30"}
    assert [b.command_port for b in moved.boards] == [b.command_port for b in rig.boards]
    assert is_free(rig)
    board = rig.boards[1]
    with bound_udp(board.card_address, board.command_port):
        assert not is_free(rig)


def test_the_receivers_queue_is_seen(rig: Instrument) -> None:
    board = rig.boards[0]
    queue = ReceiveQueue(board.host_address, board.data_port)
    if not Path("/proc/net/udp").exists():
        pytest.skip("this system does not show its sockets in /proc/net/udp")
    assert queue.look() is None
    with bound_udp(board.host_address, board.data_port) as receiver, bound_udp(board.card_address, 1024) as sender:
        assert queue.look() == (0, 0)
        sender.sendto(bytes(1000), (board.host_address, board.data_port))
        queue_state = queue.look()
        assert queue_state is not None
        assert queue_state[0] >= 1000
        receiver.recv(2000)
        assert queue.look() == (0, 0)
    queue.close()
    assert re.fullmatch(r"127\.\d+\.\d+\.30", board.host_address)


def test_the_eeproms_addresses_are_taken_over_the_network_after_a_power_cycle(
    rig: Instrument, sockets: ExitStack
) -> None:
    bench = Bench(rig, sockets)
    subnet = bench.board.card_address.rpartition(".")[0]
    old = bench.board.card_address
    new = f"{subnet}.199"
    swapped = [bytes(map(int, a.split(".")))[::-1] for a in (bench.board.host_address, new)]
    ports = struct.pack("<HH", bench.board.command_port, bench.board.data_port)
    body = b"".join(swapped) + bytes.fromhex("129078563412") + ports
    assert bench.request(EEPROM, body) == [reply(4)]
    assert bench.request(*ALIVE) == [reply(9)]
    bench.card.endpoint.power_cycle()
    assert bench.card.card.network.card_address == new
    bench.request(*START)
    bench.pulses(2)
    bench.card.endpoint.flush()
    _, source = bench.data.recvfrom(4096)
    assert source == (new, 1024)
    with bound_udp(old, bench.board.command_port):
        # The old address is free again
        pass


def test_packets_in_calls_of_many_keep_the_delay_as_a_mean_also_after_a_pause(
    rig: Instrument, sockets: ExitStack
) -> None:
    board = rig.boards[0]
    now = [0.0]
    sender = CardSender((board.card_address, 1024), (board.host_address, 1), (board.host_address, 9), False)
    sockets.callback(sender.close)
    for pause in (0.0, 1.0, 0.003):
        now[0] += pause
        began = now[0]
        sender.put_packets(np.zeros((1000, 1466), np.uint8))
        while (wait := sender.flush(lambda: now[0], 25e-6)) is not None:
            # Woken a little late
            now[0] += wait + 1e-4
        assert 956 * 25e-6 <= now[0] - began <= 1000 * 25e-6 + 0.01


def test_an_address_of_another_machine_is_an_error() -> None:
    network = Network("127.0.0.30", "203.0.113.5", bytes(6), 4096, 4098)
    with refused(ErrorCode.BUSY, "203.0.113.5:4096"):
        CardEndpoint(name="RH", network=network, faults=Faults(), seed=0, time_scale=1.0, clock_s=lambda: 0.0)
