"""The frames of a row are stored at their pulses or masked, never shifted, after any fault of radar, card and network.

A pulse on SYNC_IN starts a frame of the radar. A *slot* is the number of a frame's pulse in its row, -1 if it is
unknown. `find_frames` compares the times at which packets arrived with those of the pulses.
"""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from tests.support.acquisition.arrival_model import FRAME_NS, MS, PAYLOAD, US, Load, draw_pulse_times, receive
from tests.support.capture.records import make_mask
from tests.support.rigs import load_published_rig

from polysight.acquisition.pulse_times import (
    PlacedFrames,
    ReceivedCapture,
    describe,
    find_frames,
    place_frames,
    rewrite_row,
    time_before_first_pulse_ns,
)
from polysight.capture.receiver import RowCapture
from polysight.capture.row_files import read_index, write_index
from polysight_shared.messages import Capture
from polysight_shared.raster import Row

# Bytes of a frame, and the bursts and pulses of a row.
FRAME = 4096
BURSTS = 20
PULSES = 16
ALL = BURSTS * PULSES
# Stalls of card and network a second, and their mean length in ms, which delay packets.
QUIET = Load()
LOADS = [QUIET, Load(5, 3), Load(20, 3), Load(200, 2), Load(30, 15)]
# Relative differences between the clocks of Pi and host: 50 ppm is common for crystals of computers.
DRIFTS = [0.0, 50e-6, -50e-6]


def place(pulses, answer, arrivals, frame: int = FRAME) -> PlacedFrames:
    return place_frames(pulses, answer, arrivals, frame_bytes=frame, payload_bytes=PAYLOAD, frame_ns=FRAME_NS)


def place_missed(missed: list[int], seed: int, load: Load = QUIET, drift: float = 0.0, lost=frozenset()):
    """Place a row whose radar missed these pulses; check that no frame is at a wrong one."""
    pulses = draw_pulse_times(BURSTS)
    truth = np.delete(np.arange(ALL), missed)
    arrivals, answer = receive(
        edges_ns=pulses.reshape(-1)[truth],
        pulses_ns=pulses,
        frame_bytes=FRAME,
        rng=np.random.default_rng(seed),
        load=load,
        lost=lost,
        drift=drift,
    )
    result = place(pulses, answer, arrivals)
    is_placed = result.slots >= 0
    np.testing.assert_array_equal(result.slots[is_placed], truth[: result.slots.size][is_placed])
    assert set(result.missed) <= {*missed, *truth[result.slots.size :].tolist()}
    return result


@settings(max_examples=100, derandomize=True)
@given(
    st.one_of(
        st.sets(st.integers(0, ALL - 1), min_size=1, max_size=6),
        st.builds(lambda a, n: set(range(a, min(a + n, ALL))), st.integers(0, ALL - 1), st.integers(1, 40)),
        st.builds(lambda share: set(range(0, round(share * ALL), PULSES)), st.floats(0.1, 1)),
    ),
    st.sampled_from(LOADS),
    st.integers(0, 2**32),
    st.sampled_from(DRIFTS),
    st.sets(st.integers(0, ALL * FRAME // PAYLOAD), max_size=8),
)
def test_every_frame_of_a_short_row_is_at_its_pulse_or_masked(missed, load, seed, drift, lost):
    """Single pulses are missed, a run of them, or the first of many bursts; packets are lost, too."""
    place_missed(sorted(missed), seed, load, drift, frozenset(lost))


# The first pulse of burst 5.
BURST_5 = 5 * PULSES


# A pulse within a burst, the first and the last of the row, the two around a pause, and a whole burst.
@pytest.mark.parametrize(
    "missed", [[BURST_5 + 7], [0], [ALL - 1], [BURST_5 - 1, BURST_5], [*range(BURST_5, BURST_5 + PULSES)]]
)
def test_frames_are_kept_up_to_where_frames_and_packets_last_began_together(missed):
    """They begin together at every 91st frame. Nearer to missed pulses it is unknown which bytes the card dropped."""
    frames_between_common_beginnings = math.lcm(FRAME, PAYLOAD) // FRAME
    results = [place_missed(missed, seed) for seed in range(5)]
    assert np.median([result.uncertain for result in results]) <= 2 * frames_between_common_beginnings
    assert all("SYNC_IN" in describe(result, PULSES) for result in results)


@pytest.mark.parametrize("bursts", [1, 2])
def test_a_whole_row_of_too_few_bursts_is_not_contradicted(bursts):
    pulses = draw_pulse_times(bursts)
    arrivals, answer = receive(pulses.reshape(-1), pulses, FRAME, rng=np.random.default_rng(1))
    placed = place(pulses, answer, arrivals)
    assert not placed.is_timed
    assert not placed.contradicted
    assert "fewer than 3 bursts" in placed.reason


def test_frames_whose_pulse_cannot_be_determined_are_masked_with_the_reason():
    pulses = draw_pulse_times(BURSTS)
    rng = np.random.default_rng(1)
    arrivals, answer = receive(np.delete(pulses.reshape(-1), 9), pulses, FRAME, rng)
    # All packets have the time of the last one, as after a sleep of the machine.
    simultaneous_arrivals = arrivals.copy()
    simultaneous_arrivals[:, 0] = arrivals[-1, 0]
    # The events of all bursts but the first come 100 ms late.
    late_events = answer.copy()
    late_events[1:] += 100 * MS
    results = [
        # Simulated time, which passes faster than that of the arrivals.
        place(pulses * 40, answer, arrivals),
        # Several frames in a packet.
        place(pulses, answer, arrivals, frame=1024),
        # No pause between bursts.
        place(draw_pulse_times(BURSTS, between_ms=25), answer, arrivals),
        place(pulses, late_events, arrivals),
        # A single burst.
        place(pulses[:1], answer[:1], arrivals[:20]),
        # More frames than pulses.
        place(pulses[:6], answer[:6], arrivals),
        # No frame.
        place(pulses, answer, arrivals[:0]),
    ]
    for result in results:
        assert (result.slots == -1).all()
        assert not result.contradicted
        assert not result.is_timed
        assert result.reason
    # Two of the cases may have the same reason.
    assert len({result.reason for result in results}) >= len(results) - 1
    of_simulated_time = results[0]
    assert "simulated time, 40 times as fast" in of_simulated_time.reason
    no_events = find_frames(Path("0000.part"), Row(0, 0.0, 0.0, 2.0, 3), [], load_published_rig())
    assert not no_events.is_timed
    assert no_events.reason == "capture events of the row are missing"
    simultaneous_frames = place(pulses, answer, simultaneous_arrivals)
    assert simultaneous_frames.contradicted
    assert simultaneous_frames.reason in describe(simultaneous_frames, PULSES)


@settings(max_examples=40)
@given(
    st.sets(st.integers(0, 29), max_size=8),
    st.sets(st.integers(0, 29), max_size=5),
    st.lists(st.integers(0, 30 * 64), min_size=0, max_size=6, unique=True),
)
def test_the_rewritten_row_holds_each_byte_at_its_pulse_or_masks_it(tmp_path_factory, missed, unsure, cuts):
    """Expected bytes are computed independently: received, not in a hole, of a frame that was placed."""
    frame = 64
    path = tmp_path_factory.mktemp("r") / "0000.part"
    slots = np.delete(np.arange(30), sorted(missed))
    # Each two of the drawn places are the begin and end of a hole in the received bytes.
    pairs = sorted(cuts)[: len(cuts) // 2 * 2]
    extent = slots.size * frame
    holes = [(a, min(b, extent)) for a, b in zip(pairs[::2], pairs[1::2], strict=True) if a < extent]
    received = np.zeros(30 * frame, dtype=np.uint8)
    received[:extent] = np.random.default_rng(1).integers(1, 256, extent)
    for a, b in holes:
        received[a:b] = 0
    expected = np.zeros(30 * frame, dtype=np.uint8)
    for k, slot in enumerate(slots):
        if slot not in unsure:
            expected[slot * frame : (slot + 1) * frame] = received[k * frame : (k + 1) * frame]
    received.tofile(path)
    write_index(path.with_suffix(".idx"), {"missing": [[0, 30 * frame]]}, np.array([[1, extent]], dtype=np.int64))
    frames = PlacedFrames(np.where(np.isin(slots, list(unsure)), -1, slots), sorted(missed), 30)
    none = dict.fromkeys(RowCapture.__struct_fields__, 0)
    row = {"expected": 30 * frame, "missing": [(0, 30 * frame)], "located": False, "reason": "", "holes": holes}
    capture = rewrite_row(path, RowCapture(**{**none, **row}), frames, frame)
    stored_bytes = np.fromfile(path, dtype=np.uint8)
    np.testing.assert_array_equal(stored_bytes, expected)
    np.testing.assert_array_equal(make_mask(stored_bytes.size, capture.missing), expected == 0)
    facts, arrivals = read_index(path.with_suffix(".idx"))
    assert [tuple(x) for x in facts["missing"]] == capture.missing
    assert facts["pulses_missed"] == sorted(missed)
    assert (facts["located"], facts["reason"]) == (True, "")
    assert arrivals.tolist() == [[1, extent]]
    assert capture.located
    assert capture.bytes + capture.missing_bytes == capture.expected


@settings(max_examples=60, derandomize=True)
@given(st.sampled_from(LOADS), st.integers(0, 2**32), st.sampled_from(DRIFTS), st.sampled_from([1456, 4096]))
def test_a_complete_row_is_never_reported_as_one_with_missed_pulses(load, seed, drift, frame):
    pulses = draw_pulse_times(BURSTS)
    arrivals, answer = receive(pulses.reshape(-1), pulses, frame, np.random.default_rng(seed), load, drift=drift)
    result = place(pulses, answer, arrivals, frame)
    assert not result.contradicted
    if load == QUIET:
        assert (result.reason, result.uncertain) == ("", 0)


@pytest.mark.parametrize(("astray", "contradicted"), [(0, True), (28, True), (36, False)])
def test_one_early_frame_contradicts_a_whole_row_only_if_its_times_are_sharp(astray, contradicted):
    """A spurious edge in the pause before a burst, and a missed pulse: one frame comes at the pulse before its own.

    `astray` frames of later bursts come between two pulses. The times of a row are sharp if that holds for at most a
    tenth of its frames, here 32.
    """
    pulses = draw_pulse_times(BURSTS)
    edges = pulses.copy()
    first_pulse_of_burst_1 = pulses[1, 0]
    edges[1, 0] = first_pulse_of_burst_1 - 40 * MS
    edges[1, 1] = first_pulse_of_burst_1
    candidates = [(burst, pulse) for burst in range(3, BURSTS) for pulse in range(2, 14, 2)]
    for burst, pulse in candidates[:astray]:
        # The next pulse comes 1.5 ms later.
        edges[burst, pulse] += 900 * US
    arrivals, answer = receive(edges.reshape(-1), pulses, PAYLOAD, np.random.default_rng(2))
    placed = place(pulses, answer, arrivals, PAYLOAD)
    assert placed.contradicted == contradicted
    if not contradicted:
        # The early frame itself, the second of burst 1, is masked.
        early_frame = PULSES + 1
        assert placed.slots[early_frame] == -1


def make_bursts(first_point: int, bursts: int = 8) -> tuple[list[ReceivedCapture], int]:
    """Capture events of a row from a position on, read by the host 2 ms after each burst; and the first pulse's time.

    The clocks of Pi and host differ by 5 s.
    """
    pulses = draw_pulse_times(bursts)
    host_ns = 5_000 * MS
    events = []
    for burst, times_ns in enumerate(pulses.tolist()):
        event = Capture(
            scan_id="s", seq=burst + 1, t_mono_ns=1, row_index=0, take=1, point=first_point + burst, column=burst,
            pulses=len(times_ns), edge_ns=times_ns[0], first_pulse_ns=times_ns[0], last_pulse_ns=times_ns[-1],
            width_max_ns=1000, jitter_ns=0,
        )  # fmt: skip
        events.append(ReceivedCapture(event, times_ns[-1] + host_ns + 2 * MS))
    return events, int(pulses[0, 0]) + host_ns


def test_the_time_before_a_row_lies_in_the_pause_before_its_first_burst():
    events, first_pulse_ns = make_bursts(first_point=0)
    # Events may come in any order.
    before_ns = time_before_first_pulse_ns(events[::-1])
    assert before_ns is not None
    assert first_pulse_ns - 100 * MS < before_ns < first_pulse_ns


def test_the_time_before_a_row_is_unknown_without_its_first_burst():
    assert time_before_first_pulse_ns([]) is None
    events_without_first, _ = make_bursts(first_point=1)
    assert time_before_first_pulse_ns(events_without_first) is None
