"""Faults of a card at work: over real sockets, with a clock that the test moves; what is counted is what happened."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from polysight.shared.config import Instrument, load_instrument
from polysight.shared.errors import DeviceError
from polysight.simulators.cards import CardEndpoint, CardSender, Network, Pace, SimulatedCard, StageTrack, bound_udp
from polysight.simulators.faults import Faults, read_faults
from polysight.simulators.loopback import on_free_subnet
from polysight.simulators.scene import PatternSource, pattern_frames

ROOT = Path(__file__).parents[2]
FRAME, PERIOD_NS = 4096, 1_500_000
ALIVE, CONFIGURE, EEPROM, START, STOP = (
    (0x09, b""),
    (0x03, bytes.fromhex("01010102031e")),
    0x04,
    (0x05, b""),
    (0x06, b""),
)


class Bench:
    """One card and its host, in one process, on one clock."""

    def __init__(self, rig: Instrument, sockets: ExitStack, seed: int = 1, **faults: Any) -> None:
        self.now = 0.0
        self.board = rig.by_name("RH")
        self.index = rig.boards.index(self.board)
        self.commands = sockets.enter_context(bound_udp(self.board.host_address, self.board.command_port))
        self.data = sockets.enter_context(bound_udp(self.board.host_address, self.board.data_port))
        self.data.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        for s in (self.commands, self.data):
            s.setblocking(False)
        self.track = StageTrack(rig)
        settings = [f"{key}={value!r}" for key, value in faults.items()]  # as from the command line
        table = read_faults(None, settings, ("RH",))["RH"]
        self.card = SimulatedCard(rig, self.board, PatternSource(rig), table, seed, 1.0, lambda: self.now, Pace(False))
        sockets.callback(self.card.close)
        self.pulse = 0

    def request(self, code: int, body: bytes = b"") -> list[bytes]:
        """Send a request, and everything that the card has to say then."""
        datagram = struct.pack("<HHH", 0xA55A, code, len(body)) + body + b"\xaa\xee"
        network = self.card.card.network
        self.commands.sendto(datagram, (network.card_address, network.command_port))
        self.card.endpoint.serve_commands()
        return self.messages()

    def messages(self) -> list[bytes]:
        while self.card.endpoint.flush() is not None:
            if not self.card.endpoint.sender.queued_bytes:
                break
            self.now += 1e-3
        return [m[2:6] for m in self._all(self.commands)]

    def packets(self) -> list[bytes]:
        self.messages()
        return self._all(self.data)

    def _all(self, s: socket.socket) -> list[bytes]:
        got = []
        while True:
            try:
                got.append(s.recv(4096))
            except BlockingIOError:
                return got

    def pulses(self, n: int) -> None:
        """n pulses 1.5 ms apart, in calls of different sizes."""
        while n:
            some = min(n, 1 + self.pulse % 7)
            self.card.pulses([(self.pulse + i) * PERIOD_NS for i in range(some)], self.track)
            self.pulse, n = self.pulse + some, n - some

    def end(self) -> None:
        self.now += 2.001
        self.card.tick(False)

    def pattern(self, first: int, n: int) -> bytes:
        return pattern_frames(self.index, first, n, 256).tobytes()

    @property
    def counts(self) -> dict[str, int | None]:
        return self.card.report()


def reply(code: int, status: int = 0) -> bytes:
    return struct.pack("<HH", code, status)


def payload(packets: list[bytes]) -> bytes:
    return b"".join(p[10:] for p in packets)


@pytest.fixture
def sockets() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def rig() -> Instrument:
    return on_free_subnet(load_instrument(ROOT / "instrument.toml"))


@pytest.mark.parametrize("bit", range(12))
def test_every_status_bit_comes_on_demand(rig: Instrument, sockets: ExitStack, bit: int) -> None:
    bench = Bench(rig, sockets, pulse_status=[[5, bit]], command_status=[[0x02, bit]])
    assert bench.request(0x02) == [reply(0x02), reply(0x0A, 1 << bit)]
    bench.request(*START)
    bench.pulses(5)
    assert bench.messages() == []
    bench.pulses(1)
    assert bench.messages() == [reply(0x0A, 1 << bit)]


def test_a_refused_command_is_not_carried_out(rig: Instrument, sockets: ExitStack) -> None:
    bench = Bench(rig, sockets, refuse=[5])
    assert bench.request(*START) == [reply(5, 1)]
    bench.pulses(3)
    assert bench.packets() == []
    assert bench.counts["frames_not_recorded"] == 3


def test_replies_come_late_and_not_while_the_card_is_busy_with_its_configuration(
    rig: Instrument, sockets: ExitStack
) -> None:
    bench = Bench(rig, sockets, reply_delay_ms=300.0, deaf_ms=500.0)
    assert bench.request(*ALIVE) == []
    bench.now += 0.299
    assert bench.messages() == []
    bench.now += 0.002
    assert bench.messages() == [reply(9)]
    bench.request(*CONFIGURE)
    bench.now += 0.4
    assert bench.request(*ALIVE) == [reply(3)]
    bench.now += 0.4
    assert bench.messages() == []
    bench.request(*ALIVE)
    bench.now += 0.301
    assert bench.messages() == [reply(9)]
    assert bench.counts["requests_unheard"] == 1


def test_lost_requests_are_not_carried_out_and_lost_replies_are(rig: Instrument, sockets: ExitStack) -> None:
    bench = Bench(rig, sockets, request_loss=0.3, reply_loss=0.3)
    answered = sum(bool(bench.request(*ALIVE)) for _ in range(100))
    counts = bench.counts
    assert counts["replies"] == answered
    assert counts["requests"] == 100
    assert answered + int(counts["requests_lost"] or 0) + int(counts["replies_lost"] or 0) == 100
    assert 10 < int(counts["replies_lost"] or 0) < 40


def test_the_same_seed_gives_the_same_bytes_and_the_counts_are_the_truth(rig: Instrument) -> None:
    faults = {"loss": 0.05, "duplicate": 0.05, "reorder": 0.05, "truncate": 0.05, "corrupt": 0.05, "overflow": 0.05}

    def run(seed: int) -> tuple[list[bytes], dict[str, int | None]]:
        with ExitStack() as stack:
            bench = Bench(rig, stack, seed, **faults)
            bench.request(*START)
            bench.pulses(100)
            bench.end()
            return bench.packets(), bench.counts

    packets, counts = run(4)
    assert run(4) == (packets, counts)
    assert run(5)[0] != packets

    def count(key: str) -> int:
        return int(counts.get(key) or 0)

    assert min(count(k) for k in ("lost", "duplicated", "reordered", "truncated", "corrupted", "overflows")) > 0
    assert len(packets) == count("packets_made") - count("lost") + count("duplicated") == count("packets_sent")
    places = {p[4:10] for p in packets}
    assert len(places) == count("packets_made") - count("lost")
    arrived = sum(len(p) - 10 for p in packets)
    assert arrived == count("bytes_sent")
    lost = count("lost_bytes") + count("truncated_bytes")
    extra = sum(len(p) - 10 for i, p in enumerate(packets) if p in packets[:i])
    assert arrived == count("bytes_made") - lost + extra
    assert count("bytes_made") == 100 * FRAME - count("overflow_bytes")
    assert count("overflow_bytes") == count("overflows") * FRAME // 2
    statuses = count("statuses") - 1
    assert statuses == count("overflows")


def test_a_turned_bit_is_one_bit_of_the_payload_or_of_the_header(rig: Instrument) -> None:
    def run(**faults: float) -> list[bytes]:
        with ExitStack() as stack:
            bench = Bench(rig, stack, **faults)
            bench.request(*START)
            bench.pulses(40)
            bench.end()
            return bench.packets()

    clean = run()
    for key, at in (("corrupt", slice(10, None)), ("corrupt_header", slice(0, 10))):
        dirty = run(**{key: 1.0})
        assert len(dirty) == len(clean)
        for a, b in zip(clean, dirty, strict=True):
            turned = np.bitwise_xor(np.frombuffer(a, np.uint8), np.frombuffer(b, np.uint8))
            assert np.unpackbits(turned).sum() == 1
            assert np.unpackbits(turned[at]).sum() == 1


def test_the_ddr_overflow_is_told_by_its_own_bit_and_leaves_no_gap_in_the_sequence(
    rig: Instrument, sockets: ExitStack
) -> None:
    bench = Bench(rig, sockets, ddr_full=0.2)
    bench.request(*START)
    bench.pulses(50)
    bench.end()
    told = bench.messages()
    packets = bench.packets()
    lost = int(bench.counts["overflows"] or 0)
    assert lost > 0
    assert told == [reply(0x0A, 1 << 7)] * lost + [reply(0x0A, 1 << 8)]
    assert [struct.unpack_from("<I", p)[0] for p in packets] == list(range(1, len(packets) + 1))
    assert len(payload(packets)) == 50 * FRAME - lost * FRAME // 2


def test_the_link_is_down_for_a_time(rig: Instrument, sockets: ExitStack) -> None:
    bench = Bench(rig, sockets, link_down=[[10, 0.015]])  # ten pulses
    bench.request(*START)
    bench.pulses(15)
    assert bench.request(*ALIVE) == []
    bench.pulses(15)
    bench.now += 0.015
    assert bench.request(*ALIVE) == [reply(9)]
    bench.end()
    packets, counts = bench.packets(), bench.counts
    whole = bench.pattern(0, 30)
    for p in packets:
        at = int.from_bytes(p[4:10], "little")
        assert p[10:] == whole[at : at + len(p) - 10]
    assert len(payload(packets)) == len(whole) - int(counts["link_down_bytes"] or 0)
    # Packets leave when they are full: the one that began before and was filled while the link was down is lost too.
    assert counts["link_down_packets"] == 20 * FRAME // 1456 - 10 * FRAME // 1456
    assert counts["requests_unheard"] == 1


def test_a_link_that_is_down_does_not_shift_other_faults(rig: Instrument) -> None:
    def run(**faults: Any) -> set[bytes]:
        with ExitStack() as stack:
            bench = Bench(rig, stack, loss=0.3, corrupt=0.3, **faults)
            bench.request(*START)
            bench.pulses(40)
            bench.end()
            return set(bench.packets())

    whole, broken = run(), run(link_down=[[10, 0.015]])
    assert broken < whole
    assert {p[4:10] for p in whole - broken} <= {n.to_bytes(6, "little") for n in range(9 * FRAME, 20 * FRAME)}


def test_the_end_of_a_record_is_lost_with_the_link(rig: Instrument, sockets: ExitStack) -> None:
    bench = Bench(rig, sockets, link_down=[[8, 5.0]])
    bench.request(*START)
    bench.pulses(10)
    bench.end()
    assert bench.messages() == []
    assert len(bench.packets()) == 8 * FRAME // 1456
    assert bench.counts["link_down_statuses"] == 1


@pytest.mark.parametrize("key", ["reset_pulses", "power_cycle_pulses"])
def test_a_card_that_resets_in_a_record_loses_the_rest_and_counts_afresh(
    rig: Instrument, sockets: ExitStack, key: str
) -> None:
    bench = Bench(rig, sockets, **{key: [10]})
    bench.request(*START)
    bench.pulses(20)
    bench.end()
    assert bench.messages() == []
    packets = bench.packets()
    assert payload(packets) == bench.pattern(0, 10)[: 10 * FRAME // 1456 * 1456]
    bench.request(*START)
    bench.pulses(4)
    bench.end()
    packets = bench.packets()
    assert struct.unpack_from("<IIH", packets[0]) == (1, 0, 0)
    assert payload(packets) == bench.pattern(20, 4)


def test_a_card_that_boots_answers_nothing(rig: Instrument, sockets: ExitStack) -> None:
    bench = Bench(rig, sockets, power_cycle_pulses=[0], boot_s=2.0)
    assert bench.request(*ALIVE) == [reply(9)]
    bench.pulses(1)
    assert bench.request(*ALIVE) == []
    bench.now += 2.0
    assert bench.request(*ALIVE) == [reply(9)]


def test_a_record_that_ends_early_ends_whole(rig: Instrument, sockets: ExitStack) -> None:
    bench = Bench(rig, sockets, end_pulses=[7])
    bench.request(*START)
    bench.pulses(12)
    assert bench.messages() == [reply(0x0A, 1 << 8)]
    assert payload(bench.packets()) == bench.pattern(0, 7)
    assert (bench.counts["frames"], bench.counts["frames_not_recorded"]) == (7, 5)


def test_the_eeproms_addresses_are_taken_over_the_network_after_a_power_cycle(
    rig: Instrument, sockets: ExitStack
) -> None:
    bench = Bench(rig, sockets)
    subnet = bench.board.card_address.rpartition(".")[0]
    old, new = bench.board.card_address, f"{subnet}.199"
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
        pass  # the old address is free again


def test_single_packets_leave_no_faster_than_their_delay_and_one_by_one(rig: Instrument, sockets: ExitStack) -> None:
    board, now, sent = rig.boards[0], [0.0], list[float]()
    receiver = sockets.enter_context(bound_udp(board.host_address, board.data_port))
    sender = CardSender(
        (board.card_address, 1024), (board.host_address, 1), (board.host_address, board.data_port), Pace(False, True)
    )
    sockets.callback(sender.close)
    receiver.setblocking(False)

    def clock() -> float:
        now[0] += 1e-6
        try:
            receiver.recv(2000)
        except BlockingIOError:
            return now[0]
        sent.append(now[0])
        return now[0]

    sender.put_packets(np.zeros((60, 1466), np.uint8))
    while sender.flush(clock, 25e-6) is not None:
        pass
    clock()
    gaps = np.diff(sent)
    assert len(sent) == 60
    assert 59 * 25e-6 - 2e-6 < sent[-1] - sent[0] < 59 * 27e-6
    assert gaps.min() > 24e-6


def test_packets_in_calls_of_many_keep_the_delay_as_a_mean_also_after_a_pause(
    rig: Instrument, sockets: ExitStack
) -> None:
    board, now = rig.boards[0], [0.0]
    sender = CardSender((board.card_address, 1024), (board.host_address, 1), (board.host_address, 9), Pace(False))
    sockets.callback(sender.close)
    for pause in (0.0, 1.0, 0.003):
        now[0] += pause
        began = now[0]
        sender.put_packets(np.zeros((1000, 1466), np.uint8))
        while (wait := sender.flush(lambda: now[0], 25e-6)) is not None:
            now[0] += wait + 1e-4  # woken a little late
        assert 956 * 25e-6 <= now[0] - began <= 1000 * 25e-6 + 0.01


def test_every_fault_of_the_table_can_be_written_in_toml(tmp_path: Path) -> None:
    path = tmp_path / "faults.toml"
    path.write_text(
        "[faults]\nloss = 0.1\nlink_down = [[3, 1.5]]\npulse_status = [[0, 9]]\ncommand_status = [[4, 2]]\n"
        "refuse = [4]\n"
        "[faults.RH]\nreset_pulses = [5]\npower_cycle_pulses = [6]\nend_pulses = [7]\nboot_s = 1\nreply_delay_ms = 20\n"
    )
    faults = read_faults(path, ["RH.deaf_ms=3"], ("RH", "RV"))
    common = Faults(
        loss=0.1, link_down=((3, 1.5),), pulse_status=((0, 9),), command_status=((4, 2),), refuse=(4,)
    )  # fmt: skip
    assert faults["RV"] == common
    assert (faults["RH"].reset_pulses, faults["RH"].boot_s, faults["RH"].deaf_ms) == ((5,), 1.0, 3.0)


def test_an_endpoint_says_which_address_is_not_its_own() -> None:
    network = Network("127.0.0.30", "203.0.113.5", bytes(6), 4096, 4098)
    with pytest.raises(DeviceError, match=r"203\.0\.113\.5:4096"):
        CardEndpoint("RH", network, Faults(), 0, 1.0, lambda: 0.0, Pace())
