"""A card on the network: its addresses, and the pace of its packets."""

from __future__ import annotations

import struct
from contextlib import ExitStack

import numpy as np
from tests.simulators.card_bench import ALIVE, EEPROM, START, Bench, reply
from tests.support.refusals import refused

from polysight_shared.config import Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_simulators.cards import CardEndpoint, CardSender, Network, Pace, bound_udp
from polysight_simulators.faults import Faults


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


def test_an_address_of_another_machine_is_an_error() -> None:
    network = Network("127.0.0.30", "203.0.113.5", bytes(6), 4096, 4098)
    with refused(ErrorCode.BUSY, "203.0.113.5:4096"):
        CardEndpoint("RH", network, Faults(), 0, 1.0, lambda: 0.0, Pace())
