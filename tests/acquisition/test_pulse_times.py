"""Frames of a row with missed pulses are placed where they belong or masked, never shifted."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support.acquisition.arrival_model import MS, PAYLOAD, US, Load, pulse_times, receive, receive_edges

from polysight.acquisition.pulse_times import PlacedFrames, describe, place_frames, rewrite_row
from polysight.capture.row_files import read_index, write_index

FRAME = 4096
BURSTS, PULSES = 12, 16
ALL = BURSTS * PULSES
QUIET = Load()
loads = st.sampled_from([QUIET, Load(5, 3), Load(20, 3), Load(200, 2), Load(30, 15)])
missed_sets = st.one_of(
    st.sets(st.integers(0, ALL - 1), min_size=1, max_size=6),  # here and there
    st.builds(lambda a, n: set(range(a, min(a + n, ALL))), st.integers(0, ALL - 1), st.integers(1, 40)),  # a run
    st.builds(lambda b: set(range(16 * b, 16 * b + 16)), st.integers(0, BURSTS - 1)),  # a whole burst
)


def placed(missed: set[int], load: Load, seed: int, drift: float = 0.0, **more) -> tuple[PlacedFrames, np.ndarray]:
    pulses = pulse_times(BURSTS)
    rng = np.random.default_rng(seed)
    arrivals, answer = receive(pulses, sorted(missed), FRAME, rng, load, drift, **more)
    return place_frames(pulses, answer, arrivals, FRAME, PAYLOAD), np.delete(np.arange(ALL), sorted(missed))


def check(result: PlacedFrames, truth: np.ndarray, missed: set[int]) -> None:
    sure = result.slots >= 0
    np.testing.assert_array_equal(result.slots[sure], truth[: result.slots.size][sure])
    assert set(result.missed) <= missed | set(truth[result.slots.size :].tolist())


@settings(max_examples=120, derandomize=True)
@given(missed_sets, loads, st.integers(0, 2**32), st.sampled_from([0.0, 50e-6, -50e-6]))
def test_every_frame_is_at_its_pulse_or_masked(missed, load, seed, drift):
    result, truth = placed(missed, load, seed, drift)
    check(result, truth, missed)


@settings(max_examples=40, derandomize=True)
@given(missed_sets, loads, st.integers(0, 2**32), st.sets(st.integers(0, ALL * FRAME // PAYLOAD), max_size=8))
def test_lost_packets_beside_missed_pulses_shift_nothing(missed, load, seed, lost):
    result, truth = placed(missed, load, seed, lost=frozenset(lost))
    check(result, truth, missed)


CASES = {
    "middle of a burst": {5 * 16 + 7},
    "first of the row": {0},
    "last of the row": {ALL - 1},
    "last of a burst and first of the next": {79, 80},
    "several": {3, 40, 41, 150},
    "a whole burst": set(range(80, 96)),
    "the first burst": set(range(16)),
    "the last burst": set(range(ALL - 16, ALL)),
}


@pytest.mark.parametrize("case", CASES)
def test_on_a_quiet_machine_only_the_missed_pulses_are_masked(case):
    """And the two frames beside each, one of which may be mixed; besides these at most one frame in two rows."""
    results = [placed(CASES[case], QUIET, seed) for seed in range(20)]
    for result, truth in results:
        check(result, truth, CASES[case])
        assert result.slots.size == ALL - len(CASES[case])
        assert result.uncertain <= 2 * len(CASES[case]) + 1
    exact = [r for r, _ in results if r.missed == sorted(CASES[case])]
    if 0 not in CASES[case]:
        assert len(exact) >= (10 if case != "several" else 5)
        assert "position" in describe(exact[0], PULSES)


def test_a_busy_machine_costs_no_more_than_two_bursts():
    results = [placed({87}, Load(5, 3), seed)[0] for seed in range(20)]
    assert all(r.reason == "" and r.uncertain < 2 * PULSES for r in results)


def undecided(pulses, answer, arrivals, frame=FRAME) -> str:
    result = place_frames(pulses, answer, arrivals, frame, PAYLOAD)
    assert (result.slots == -1).all()
    assert result.missed == [] or result.reason == ""
    return result.reason


def test_undetermined_frames_are_masked_each_for_its_own_reason():
    pulses, rng = pulse_times(BURSTS), np.random.default_rng(1)
    arrivals, answer = receive(pulses, [9], FRAME, rng, QUIET)
    merged = arrivals.copy()
    merged[:, 0] = arrivals[-1, 0]  # the machine slept through the row
    reasons = [
        undecided(pulses * 40, answer, arrivals),  # simulated time
        undecided(pulses, answer, arrivals, frame=1024),  # several frames in a packet
        undecided(pulse_times(BURSTS, between_ms=25), answer, arrivals),  # no pause between bursts
        undecided(pulses, answer + (np.arange(BURSTS) > 0) * 100 * MS, arrivals),  # late events
        undecided(pulses[:1], answer[:1], arrivals[:20]),  # a single burst
        undecided(pulses[:6], answer[:6], arrivals),  # more frames than pulses
        undecided(pulses, answer, arrivals[:0]),  # no frame
    ]
    assert len(set(reasons)) >= len(reasons) - 1
    assert all([*reasons, undecided(pulses, answer, merged)])


@settings(max_examples=60)
@given(
    st.sets(st.integers(0, 29), max_size=8),
    st.sets(st.integers(0, 29), max_size=5),
    st.lists(st.integers(0, 30 * 64), min_size=0, max_size=6, unique=True),
)
def test_the_rewritten_row_holds_each_byte_at_its_pulse_or_masks_it(tmp_path_factory, missed, unsure, cuts):
    """Expected bytes are computed independently: received, not in a hole, of a frame that was placed."""
    frame, path = 64, tmp_path_factory.mktemp("r") / "0000.part"
    slots = np.delete(np.arange(30), sorted(missed))
    pairs = sorted(cuts)[: len(cuts) // 2 * 2]
    extent = slots.size * frame
    holes = [(a, min(b, extent)) for a, b in zip(pairs[::2], pairs[1::2], strict=True) if a < extent]
    received = np.zeros(30 * frame, dtype=np.uint8)
    received[:extent] = np.random.default_rng(1).integers(1, 256, extent)
    for a, b in holes:
        received[a:b] = 0
    want = np.zeros(30 * frame, dtype=np.uint8)
    for k, slot in enumerate(slots):
        if slot not in unsure:
            want[slot * frame : (slot + 1) * frame] = received[k * frame : (k + 1) * frame]
    received.tofile(path)
    write_index(path.with_suffix(".idx"), {"missing": [[0, 30 * frame]]}, np.array([[1, extent]], dtype=np.int64))
    where = PlacedFrames(np.where(np.isin(slots, list(unsure)), -1, slots), sorted(missed), 30)
    capture = rewrite_row(path, _capture(30 * frame, holes), where, frame)
    got = np.fromfile(path, dtype=np.uint8)
    np.testing.assert_array_equal(got, want)
    mask = np.zeros(got.size, dtype=bool)
    for a, b in capture.missing:
        mask[a:b] = True
    np.testing.assert_array_equal(mask, want == 0)
    facts, arrivals = read_index(path.with_suffix(".idx"))
    assert [tuple(x) for x in facts["missing"]] == capture.missing
    assert facts["pulses_missed"] == sorted(missed)
    assert arrivals.tolist() == [[1, extent]]
    assert capture.located
    assert capture.bytes + capture.missing_bytes == capture.expected


def _capture(expected, holes):
    from polysight.capture.receiver import RowCapture

    zeros = dict.fromkeys(RowCapture.__struct_fields__, 0)
    return RowCapture(
        **{**zeros, "expected": expected, "missing": [(0, expected)], "located": False, "reason": "", "holes": holes},
    )


def arrivals_of(edges: np.ndarray, pulses: np.ndarray, load: Load, seed: int, drift: float = 0.0):
    """Arrivals and event times of a row whose radar takes these edges (int64, Pi's clock) for its pulses."""
    counted = edges[: pulses.size].reshape(pulses.shape)
    rng = np.random.default_rng(seed)
    arrivals, _ = receive(counted, [], FRAME, rng, load, drift)
    rng = np.random.default_rng(seed)  # the same offset
    _, answer = receive(pulses, [], FRAME, rng, load, drift)
    return arrivals, answer


@settings(max_examples=40, derandomize=True)
@given(loads, st.integers(0, 2**32), st.sampled_from([0.0, 50e-6, -50e-6]))
def test_whole_row_is_never_taken_for_a_slipped_one(load, seed, drift):
    pulses = pulse_times(BURSTS)
    arrivals, answer = arrivals_of(pulses.reshape(-1), pulses, load, seed, drift)
    result = place_frames(pulses, answer, arrivals, FRAME, PAYLOAD)
    assert not result.contradicted
    assert set(result.slots - np.arange(ALL)) <= {0, *(-1 - np.arange(ALL))}


@settings(max_examples=40, derandomize=True)
@given(
    st.integers(0, BURSTS - 3), st.integers(2, 60), st.integers(0, 2**32), st.sampled_from([0.0, 50e-6, -50e-6]),
    st.booleans(),
)  # fmt: skip
def test_one_edge_too_many_is_found_and_frames_are_at_their_pulses_or_masked(burst, ms, seed, drift, missed):
    """In a burst or the pause behind it; alone, or after a pulse that was missed two bursts before."""
    pulses = pulse_times(BURSTS)
    extra = pulses[burst, 0] + ms * MS + 300 * US
    edges = pulses.reshape(-1)
    truth = np.arange(ALL)
    if missed and burst >= 3:
        gone = (burst - 3) * PULSES + 5
        edges, truth = np.delete(edges, gone), np.delete(truth, gone)
    at = int(np.searchsorted(edges, extra))
    edges, truth = np.insert(edges, at, extra)[:ALL], np.insert(truth, at, -2)[:ALL]
    arrivals, answer = arrivals_of(edges, pulses, QUIET, seed, drift)
    result = place_frames(pulses, answer, arrivals, FRAME, PAYLOAD)
    assert result.contradicted
    sure = result.slots >= 0
    np.testing.assert_array_equal(result.slots[sure], truth[sure])
    assert result.uncertain <= 3 * PULSES + 3
    assert "SYNC_IN" in describe(result, PULSES)


FAULTS = ("missed", "spurious", "lost", "stalled", "endless")


def troubled(seed: int, bursts: int, count: int, frame: int, faults: tuple[str, ...]):
    """A row with faults drawn from a seed: pulses, times of the events, arrivals, pulse of each frame (-2: of none)."""
    rng = np.random.default_rng(seed)
    pulses = pulse_times(bursts, count)
    planned = pulses.reshape(-1)
    edges, truth = planned, np.arange(pulses.size)
    if "missed" in faults:
        gone = rng.choice(edges.size, rng.integers(1, 4), replace=False)
        edges, truth = np.delete(edges, gone), np.delete(truth, gone)
    if "spurious" in faults:
        for _ in range(rng.integers(1, 3)):
            at_ns = int(rng.integers(pulses[0, 0], pulses[-1, -1]))
            at = int(np.searchsorted(edges, at_ns))
            # An edge within a frame or just behind it starts none, and one at a missed pulse makes that pulse's frame.
            if np.abs(np.append(edges, planned) - at_ns).min() > 600 * US:
                edges, truth = np.insert(edges, at, at_ns), np.insert(truth, at, -2)
    if "endless" not in faults:
        edges, truth = edges[: pulses.size], truth[: pulses.size]
    packets = edges.size * frame // PAYLOAD
    lost = frozenset(rng.choice(packets, 2).tolist()) if "lost" in faults else frozenset()
    load = Load(20, 3) if "stalled" in faults else QUIET
    arrivals, answer = receive_edges(edges, pulses, frame, rng, load, lost)
    return pulses, answer, arrivals, truth, holes_of(lost, edges.size * frame)


def holes_of(lost: frozenset[int], end: int) -> list[tuple[int, int]]:
    return [(k * PAYLOAD, min((k + 1) * PAYLOAD, end)) for k in sorted(lost)]


def check_troubled(seed: int, bursts: int, count: int, frame: int, faults: tuple[str, ...]) -> PlacedFrames:
    pulses, answer, arrivals, truth, holes = troubled(seed, bursts, count, frame, faults)
    result = place_frames(pulses, answer, arrivals, frame, PAYLOAD, holes)
    sure = np.flatnonzero(result.slots >= 0)
    if truth.size <= pulses.size:
        wrong = sure[result.slots[sure] != truth[sure]]
        assert not wrong.size, (seed, bursts, count, frame, faults, wrong[:5], result.slots[wrong[:5]])
    return result


def test_whatever_happens_no_frame_is_at_a_wrong_pulse(request):
    """Bursts of one pulse to sixteen, frames below and above a packet, faults of radar, wires, network and host."""
    chance = np.random.default_rng(7)
    for seed in range(20_000 if request.config.getoption("--long") else 400):
        many = int(chance.integers(1, 4))
        faults = tuple(chance.choice(FAULTS, many, replace=False).tolist())
        bursts, count = [(12, 16), (30, 1), (7, 13), (7, 12), (40, 2)][chance.integers(5)]
        check_troubled(seed, bursts, count, int(chance.choice([512, 1456, 4096])), faults)


@pytest.mark.parametrize("count", [1, 16])
@pytest.mark.parametrize("frame", [512, 1456, 4096])
def test_every_frame_of_a_perfect_row_is_seen_at_its_pulse(count, frame):
    """Of frames below a packet, those that fill one."""
    for seed in range(10):
        result = check_troubled(seed, 20, count, frame, ())
        assert not result.contradicted
        seen = 20 * count if frame >= PAYLOAD else 20 * count * frame // PAYLOAD
        assert result.slots.size - result.uncertain >= seen - 1


def test_a_missed_and_a_spurious_edge_in_bursts_of_one_pulse_are_seen():
    seen = [check_troubled(seed, 30, 1, FRAME, ("missed", "spurious")) for seed in range(40)]
    assert all(r.contradicted or r.uncertain > 1 or r.slots.size < 30 for r in seen)


@pytest.mark.parametrize("at", range(8, 84, 5))
def test_frames_below_a_packet_beside_a_spurious_edge_are_masked(at):
    """Most bursts are then a pulse early, so that the times of the others seem late."""
    frame, pulses = 1440, pulse_times(13, 7)
    edges = np.insert(pulses.reshape(-1), at, pulses.reshape(-1)[at] - 700 * US)[: pulses.size]
    truth = np.insert(np.arange(pulses.size), at, -2)[: pulses.size]
    arrivals, answer = receive_edges(edges, pulses, frame, np.random.default_rng(at), QUIET)
    result = place_frames(pulses, answer, arrivals, frame, PAYLOAD)
    sure = result.slots >= 0
    assert result.contradicted
    np.testing.assert_array_equal(result.slots[sure], truth[sure])


@pytest.mark.parametrize("bursts", [3, 8, 30])
@pytest.mark.parametrize("share", [0.5, 0.7, 1.0])
def test_the_first_pulse_missed_in_many_bursts_shifts_nothing(bursts, share):
    """Then the bursts' first frames come a period late, all alike: only whole bursts tell when frames come."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        pulses = pulse_times(bursts)
        many = max(1, round(share * bursts))
        missed = sorted((PULSES * rng.choice(bursts, many, replace=False)).tolist())
        arrivals, answer = receive(pulses, missed, FRAME, rng, QUIET)
        result = place_frames(pulses, answer, arrivals, FRAME, PAYLOAD)
        check(result, np.delete(np.arange(pulses.size), missed), set(missed))


@pytest.mark.parametrize("seed", range(5))
def test_frames_below_a_packet_that_are_all_a_pulse_off_are_seen(seed):
    """The first pulse was missed, and an edge behind the last one was taken for a pulse: their times agree."""
    pulses = pulse_times(40, 4)
    edges = np.append(pulses.reshape(-1)[1:], pulses[-1, -1] + 200 * MS)
    arrivals, answer = receive_edges(edges, pulses, 512, np.random.default_rng(seed), QUIET)
    result = place_frames(pulses, answer, arrivals, 512, PAYLOAD)
    assert result.contradicted or result.uncertain == pulses.size
