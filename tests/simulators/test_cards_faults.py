"""Faults of a simulated card over real sockets, with the test's own clock; the counts are the truth."""

from __future__ import annotations

import struct
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.simulators.card_bench import ALIVE, CONFIGURE, FRAME, START, Bench, payload, reply

from polysight_shared.config import Instrument
from polysight_simulators.faults import Faults, read_faults


def packets_of_40_pulses(rig: Instrument, **faults: Any) -> list[bytes]:
    with ExitStack() as stack:
        bench = Bench(rig, stack, **faults)
        bench.record(40)
        return bench.packets()


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
            bench.record(100)
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
    lost_bytes = count("lost_bytes") + count("truncated_bytes")
    extra = sum(len(p) - 10 for i, p in enumerate(packets) if p in packets[:i])
    assert arrived == count("bytes_made") - lost_bytes + extra
    assert count("bytes_made") == 100 * FRAME - count("overflow_bytes")
    assert count("overflow_bytes") == count("overflows") * FRAME // 2
    statuses = count("statuses") - 1
    assert statuses == count("overflows")


def test_a_turned_bit_is_one_bit_of_the_payload_or_of_the_header(rig: Instrument) -> None:
    clean = packets_of_40_pulses(rig)
    for key, part in (("corrupt", slice(10, None)), ("corrupt_header", slice(0, 10))):
        dirty = packets_of_40_pulses(rig, **{key: 1.0})
        assert len(dirty) == len(clean)
        for a, b in zip(clean, dirty, strict=True):
            turned = np.bitwise_xor(np.frombuffer(a, np.uint8), np.frombuffer(b, np.uint8))
            assert np.unpackbits(turned).sum() == 1
            assert np.unpackbits(turned[part]).sum() == 1


def test_the_ddr_overflow_has_its_own_bit_and_leaves_no_gap_in_the_sequence(
    rig: Instrument, sockets: ExitStack
) -> None:
    bench = Bench(rig, sockets, ddr_full=0.2)
    bench.record(50)
    answer = bench.messages()
    packets = bench.packets()
    lost_frames = int(bench.counts["overflows"] or 0)
    assert lost_frames > 0
    assert answer == [reply(0x0A, 1 << 7)] * lost_frames + [reply(0x0A, 1 << 8)]
    assert [struct.unpack_from("<I", p)[0] for p in packets] == list(range(1, len(packets) + 1))
    assert len(payload(packets)) == 50 * FRAME - lost_frames * FRAME // 2


def test_the_link_is_down_for_a_time(rig: Instrument, sockets: ExitStack) -> None:
    # Ten pulses
    bench = Bench(rig, sockets, link_down=[[10, 0.015]])
    bench.request(*START)
    bench.pulses(15)
    assert bench.request(*ALIVE) == []
    bench.pulses(15)
    bench.now += 0.015
    assert bench.request(*ALIVE) == [reply(9)]
    bench.end()
    packets = bench.packets()
    counts = bench.counts
    all_packets = bench.pattern(0, 30)
    for p in packets:
        byte_count = int.from_bytes(p[4:10], "little")
        assert p[10:] == all_packets[byte_count : byte_count + len(p) - 10]
    assert len(payload(packets)) == len(all_packets) - int(counts["link_down_bytes"] or 0)
    # Packets leave when they are full: the one that began before and was filled while the link was down is lost too.
    assert counts["link_down_packets"] == 20 * FRAME // 1456 - 10 * FRAME // 1456
    assert counts["requests_unheard"] == 1


def test_a_link_that_is_down_does_not_shift_other_faults(rig: Instrument) -> None:
    other_items = {"loss": 0.3, "corrupt": 0.3}
    all_packets = set(packets_of_40_pulses(rig, **other_items))
    broken = set(packets_of_40_pulses(rig, **other_items, link_down=[[10, 0.015]]))
    assert broken < all_packets
    assert {p[4:10] for p in all_packets - broken} <= {n.to_bytes(6, "little") for n in range(9 * FRAME, 20 * FRAME)}


def test_the_end_of_a_record_is_lost_with_the_link(rig: Instrument, sockets: ExitStack) -> None:
    bench = Bench(rig, sockets, link_down=[[8, 5.0]])
    bench.record(10)
    assert bench.messages() == []
    assert len(bench.packets()) == 8 * FRAME // 1456
    assert bench.counts["link_down_statuses"] == 1


@pytest.mark.parametrize("key", ["reset_pulses", "power_cycle_pulses"])
def test_a_card_that_resets_in_a_record_loses_the_rest_and_counts_afresh(
    rig: Instrument, sockets: ExitStack, key: str
) -> None:
    bench = Bench(rig, sockets, **{key: [10]})
    bench.record(20)
    assert bench.messages() == []
    packets = bench.packets()
    assert payload(packets) == bench.pattern(0, 10)[: 10 * FRAME // 1456 * 1456]
    bench.record(4)
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
