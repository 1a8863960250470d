"""Faults of the simulated card: from a seed, independent of grouping, counted, and as configured."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st
from tests.support.refusals import expect_refusal

from polysight_shared.errors import ConfigError, ErrorCode
from polysight_simulators.cards.fault_draws import NetworkFaults, OverflowFaults, PulseFaults
from polysight_simulators.cards.sync_in import Pulse
from polysight_simulators.faults import Faults, read_faults

# Bytes of a packet, 10 of which are its header.
SIZE = 20
EVERYTHING = Faults(loss=0.1, duplicate=0.1, reorder=0.1, truncate=0.1, corrupt=0.2)


def make_packets(n: int) -> np.ndarray:
    """Return packets whose bytes all are their number."""
    return np.repeat(np.arange(n, dtype=np.uint8)[:, None], SIZE, axis=1)


def send_all(faults: Faults, sizes: list[int], seed: int = 1, board: str = "RH") -> list[bytes]:
    """Send packets in groups of these sizes; return what arrives."""
    network = NetworkFaults(faults, seed, board, Counter())
    data = make_packets(sum(sizes))
    first = 0
    received = []
    for size in sizes:
        received += [r.tobytes() for part in network.transmit(data[first : first + size]) for r in part]
        first += size
    # The sent packets are not changed.
    assert (data == make_packets(sum(sizes))).all()
    return received + [r.tobytes() for part in network.drain() for r in part]


@given(st.lists(st.integers(0, 60), min_size=1, max_size=4), st.integers(0, 99))
def test_faults_do_not_depend_on_how_packets_are_grouped(sizes: list[int], seed: int) -> None:
    assert send_all(EVERYTHING, sizes, seed) == send_all(EVERYTHING, [sum(sizes)], seed)


def test_the_same_seed_gives_the_same_faults_and_boards_differ() -> None:
    assert send_all(EVERYTHING, [200]) == send_all(EVERYTHING, [200])
    assert send_all(EVERYTHING, [200]) != send_all(EVERYTHING, [200], seed=2)
    assert send_all(EVERYTHING, [200]) != send_all(EVERYTHING, [200], board="RV")


@pytest.mark.parametrize(
    ("faults", "numbers"),
    [
        (Faults(loss=1.0), []),
        (Faults(duplicate=1.0), [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]),
    ],
)
def test_all_packets_are_lost_or_doubled_with_a_probability_of_one(faults: Faults, numbers: list[int]) -> None:
    assert send_all(faults, [6]) == [bytes([n] * SIZE) for n in numbers]


def test_reordered_packets_all_arrive() -> None:
    received = send_all(Faults(reorder=0.2), [200])
    assert received != [r.tobytes() for r in make_packets(200)]
    assert sorted(received) == sorted(r.tobytes() for r in make_packets(200))


def test_a_truncated_packet_has_half_of_its_bytes() -> None:
    assert send_all(Faults(truncate=1.0), [2]) == [bytes([n] * (SIZE // 2)) for n in (0, 1)]


def test_overflow_takes_the_second_half_of_single_frames() -> None:
    frames = np.arange(100 * 8, dtype=np.int16).reshape(100, 2, 4)
    runs = OverflowFaults(Faults(overflow=0.3), 5, "RH").split(frames)
    overflows = sum(run.lost_bytes > 0 for run in runs)
    # 30 of 100 are expected, with a standard deviation of sqrt(100 * 0.3 * 0.7) = 4.6.
    assert 10 < overflows < 60
    assert sum(run.lost_bytes for run in runs) == overflows * 8
    joined = np.concatenate([run.data.reshape(-1) for run in runs])
    assert len(joined) == 100 * 8 - overflows * 4
    # The numbers rise through all frames: the remaining ones are in order.
    assert np.all(np.diff(joined) > 0)


def test_a_corrupt_packet_has_one_bit_of_its_payload_turned() -> None:
    for clean, corrupt in zip(make_packets(60), send_all(Faults(corrupt=1.0), [60]), strict=True):
        flipped_bits = np.bitwise_xor(clean, np.frombuffer(corrupt, np.uint8))
        header, payload = flipped_bits[:10], flipped_bits[10:]
        assert np.unpackbits(header).sum() == 0
        assert np.unpackbits(payload).sum() == 1


def test_exactly_the_named_pulses_are_missed() -> None:
    pulses = [Pulse(i, 1000 * i) for i in range(10)]
    faults = PulseFaults(Faults(miss_pulses=(0, 4)), 0, "RH")
    pulses_seen = faults.select_seen(pulses[:5]) + faults.select_seen(pulses[5:])
    assert [p.number for p in pulses_seen] == [1, 2, 3, 5, 6, 7, 8, 9]
    assert faults.missed == 2


def test_faults_come_from_the_file_and_the_command_line(tmp_path: Path) -> None:
    path = tmp_path / "faults.toml"
    path.write_text("[faults]\nloss = 0.01\n[faults.RH]\nmute = true\n")
    faults = read_faults(path, ["loss=0.02", "RV.miss_pulses=[3, 4]"], ("LS", "RH", "RV"), {"reorder": 0.5})
    assert faults["LS"] == Faults(loss=0.02, reorder=0.5)
    assert faults["RH"] == Faults(loss=0.02, reorder=0.5, mute=True)
    assert faults["RV"] == Faults(loss=0.02, reorder=0.5, miss_pulses=(3, 4))


@pytest.mark.parametrize("setting", ["los=0.1", "loss=2", "XX.mute=true", "mute", "loss='a'"])
def test_a_fault_that_does_not_exist_is_refused(setting: str) -> None:
    with pytest.raises(ConfigError):
        read_faults(None, [setting], ("RH",))


@pytest.mark.parametrize(
    ("fault", "control"),
    [
        ("retrigger_fails=[1]", "line_server"),
        ("retrigger_resets=[0]", "line_server"),
        ("radar_fault_pulses=[7]", "native"),
    ],
)
def test_a_fault_that_cannot_happen_with_the_rigs_radars_is_refused(fault: str, control: str) -> None:
    assert read_faults(None, [fault], ("RH",), control=control)["RH"] != Faults()
    for foreign_control in {"endless", "line_server", "native"} - {control}:
        with expect_refusal(ErrorCode.VALUES_CONFLICT, fault.partition("=")[0], foreign_control):
            read_faults(None, [fault], ("RH",), control=foreign_control)
