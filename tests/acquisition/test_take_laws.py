"""Each way in which the counts, the end or a board of a take differ from the plan is a fault of its own kind."""

import threading
from os import PRIO_PROCESS, getpriority

import msgspec
import numpy as np
import pytest
from tests.support.acquisition.takes import BYTES, PULSES, ROW, make_capture, make_end
from tests.support.rigs import load_published_rig

from polysight.acquisition.progress import NICE, ProcessingQueue
from polysight.acquisition.pulse_times import PlacedFrames, ReceivedCapture
from polysight.acquisition.ready import list_stage_differences
from polysight.acquisition.row import FaultKind, Take, TakeFault
from polysight.capture.placement import PacketCounts
from polysight.radar import BoardState, RadarState
from polysight_shared.faults import PiFault, explain
from polysight_shared.messages import Capture, HelloReply

ABORTED = TakeFault(FaultKind.RADAR_STOPPED, "the radar has stopped", "RV")


def list_kinds(take: Take) -> list[FaultKind]:
    return [fault.kind for fault in take.faults(PULSES)]


def test_a_whole_take_has_no_fault():
    assert list_kinds(Take(ROW, 1, finished=make_end(), captures={"RV": make_capture()})) == []


@pytest.mark.parametrize("counts", [{"points": 2}, {"points": 4}, {"pulses": 5}, {"pulses": 7}])
def test_a_point_or_pulse_too_few_or_too_many_is_a_fault(counts):
    (fault,) = Take(ROW, 1, finished=make_end(**counts)).faults(PULSES)
    assert fault.kind is FaultKind.COUNTS_DIFFER
    assert "3 and 6 planned" in fault.text


def test_without_a_report_the_hosts_own_reason_is_the_fault():
    assert list_kinds(Take(ROW, 1)) == [FaultKind.NO_END]
    assert Take(ROW, 1, aborted=ABORTED).faults(PULSES) == [ABORTED]


@pytest.mark.parametrize(
    ("status", "aborted", "kind"),
    [
        ("aborted", ABORTED, FaultKind.RADAR_STOPPED),
        ("aborted", None, FaultKind.PI_FAULT),
        ("fault", ABORTED, FaultKind.PI_FAULT),
    ],
)
def test_the_fault_of_a_row_that_the_host_aborted_is_the_reason_of_the_abort(status, aborted, kind):
    end = make_end(status=status, fault=int(PiFault.EDGE_LOST))
    (fault,) = Take(ROW, 1, finished=end, aborted=aborted).faults(PULSES)
    assert fault.kind is kind
    assert fault.number == (int(PiFault.EDGE_LOST) if kind is FaultKind.PI_FAULT else 0)


def test_the_text_of_a_fault_is_the_pi_s_reason_or_else_the_general_one_of_its_number():
    number = int(PiFault.EDGE_LOST)
    end_with_reason = make_end(status="fault", fault=number, reason="a wire is off")
    (fault,) = Take(ROW, 1, finished=end_with_reason).faults(PULSES)
    assert fault.text == "the row ended as fault: a wire is off"
    end_without_reason = make_end(status="fault", fault=number)
    (fault,) = Take(ROW, 1, finished=end_without_reason).faults(PULSES)
    assert fault.text == f"the row ended as fault: {explain(number).problem}"


def test_data_of_an_aborted_row_count_only_if_pulses_were_sent():
    no_data = make_capture(counts=PacketCounts(), bytes=0, missing=[(0, BYTES)], located=False, reason="no packet came")
    take = Take(ROW, 1, aborted=ABORTED, captures={"RH": no_data})
    assert list_kinds(take) == [FaultKind.RADAR_STOPPED]
    burst = Capture(
        scan_id="s", seq=1, t_mono_ns=1, row_index=0, take=1, point=0, column=0, pulses=PULSES,
        edge_ns=1, first_pulse_ns=2, last_pulse_ns=3, width_max_ns=1000, jitter_ns=0,
    )  # fmt: skip
    take.events.append(ReceivedCapture(burst, 3))
    assert list_kinds(take) == [FaultKind.RADAR_STOPPED, FaultKind.NO_DATA]
    assert list_kinds(Take(ROW, 1, finished=make_end(), captures={"RH": no_data})) == [FaultKind.NO_DATA]


@pytest.mark.parametrize(
    ("fields", "kind"),
    [
        ({"missing": [(0, 16)]}, FaultKind.LOST_ON_THE_WAY),
        ({"missing": [(0, 16)], "kernel_drops": 1}, FaultKind.LOST_BY_HOST),
        ({"missing": [(0, 16)], "counts": PacketCounts(placed=4, conflicting=1)}, FaultKind.CONFLICTING),
    ],
)
def test_missing_bytes_have_the_kind_of_their_cause(fields, kind):
    assert list_kinds(Take(ROW, 1, finished=make_end(), captures={"RV": make_capture(**fields)})) == [kind]


def test_packets_that_differ_but_were_masked_nowhere_are_no_fault():
    capture = make_capture(counts=PacketCounts(placed=4, conflicting=1))
    assert list_kinds(Take(ROW, 1, finished=make_end(), captures={"RV": capture})) == []


NOT_LOCATED = {"located": False, "slipped": True, "reason": "a frame is missing"}
HELD = "; the row was held, and a card ends its record after 2 s without data"


@pytest.mark.parametrize(
    ("slots", "note", "kind"),
    [
        (np.arange(5), "", FaultKind.PULSES_MISSED),
        (np.full(6, -1), "", FaultKind.SLIPPED),
        (np.arange(5), "held", FaultKind.HELD),
    ],
)
def test_frames_at_other_pulses_are_missed_pulses_only_if_there_are_fewer(slots, note, kind):
    frames = {"RV": PlacedFrames(slots, [], 6, contradicted=slots.size == 6)}
    end = make_end(reason=note)
    (fault,) = Take(ROW, 1, finished=end, captures={"RV": make_capture(**NOT_LOCATED)}, frames=frames).faults(PULSES)
    assert fault.kind is kind
    assert fault.text.endswith(HELD) == bool(note)


@pytest.mark.parametrize("is_timed", [True, False])
def test_only_frames_with_times_are_displaced(is_timed):
    frames = PlacedFrames(np.arange(5), [], 6, reason="" if is_timed else "no pause")
    take = Take(ROW, 1, finished=make_end(), captures={"RV": make_capture(**NOT_LOCATED)}, frames={"RV": frames})
    assert take.find_displaced("RV") is (frames if is_timed else None)


@pytest.mark.parametrize(
    ("frames", "text"),
    [
        ({}, ""),
        ({"RV": PlacedFrames(np.arange(5), [], 6, reason="no pause")}, "; missed pulses cannot be located: no pause"),
    ],
)
@pytest.mark.parametrize(
    ("state", "note", "kind", "more"),
    [
        (RadarState.UNKNOWN, "", FaultKind.FRAMES_MISSING, ""),
        (RadarState.ARMED, "", FaultKind.RADAR_WAITS, "; the radar still waits for pulses"),
        (RadarState.UNKNOWN, "held", FaultKind.HELD, HELD),
    ],
)
def test_a_board_that_is_not_located_says_all_that_is_known(frames, text, state, note, kind, more):
    take = Take(
        ROW, 1, finished=make_end(reason=note), captures={"RV": make_capture(**NOT_LOCATED)}, frames=frames,
        radars={"RV": BoardState(state)},
    )  # fmt: skip
    assert take.faults(PULSES) == [TakeFault(kind, "a frame is missing" + text + more, "RV")]


@pytest.mark.parametrize("change", [-0.5, 0.5])
def test_a_setting_that_places_rows_differs_if_it_is_smaller_or_larger_on_the_pi(change):
    stage = load_published_rig().stage
    same = HelloReply(
        pi_release="1", firmware="1", backend="WIRES", state="idle", scan_id="", last_seq=0,
        stage=stage.placement_settings,
    )  # fmt: skip
    assert list_stage_differences(stage, same) == []
    other = msgspec.structs.replace(same, stage=same.stage | {"centre_x_mm": stage.centre_x_mm + change})
    (difference,) = list_stage_differences(stage, other)
    assert difference.startswith("stage.centre_x_mm is ")
    assert list_stage_differences(stage, msgspec.structs.replace(same, stage={})) == []


def test_rows_wait_for_processing_only_beyond_the_limit():
    may_process = threading.Event()
    queue = ProcessingQueue(lambda _: may_process.wait(), limit=2)
    queue.add_earlier([0])
    waiting = []
    for row in (1, 2, 3):
        queue.add(row)
        waiting.append(queue.over_limit)
    assert (waiting, queue.rows_left) == ([0, 0, 3], 4)
    may_process.set()
    assert queue.close(now=False) is None
    assert (queue.over_limit, queue.rows_left) == (0, 0)


def test_the_first_error_of_processing_is_kept_until_the_end():
    def fail_from_row_1(row: int) -> None:
        if row:
            raise ValueError(row)

    queue = ProcessingQueue(fail_from_row_1, limit=9)
    for row in range(3):
        queue.add(row)
    error = queue.close(now=False)
    assert isinstance(error, ValueError)
    assert error.args == (1,)


def test_rows_are_processed_below_the_priority_of_the_program():
    nice_values = []
    queue = ProcessingQueue(lambda _: nice_values.append(getpriority(PRIO_PROCESS, threading.get_native_id())), limit=1)
    queue.add(0)
    assert queue.close(now=False) is None
    # 19 is the system's largest value.
    assert nice_values == [min(19, getpriority(PRIO_PROCESS, threading.get_native_id()) + NICE)]


def test_a_scan_that_stops_now_waits_for_the_row_in_hand_and_processes_no_other():
    has_begun = threading.Event()
    may_end = threading.Event()
    processed = []
    errors = []

    def process(row: int) -> None:
        has_begun.set()
        may_end.wait()
        processed.append(row)

    queue = ProcessingQueue(process, limit=9)
    for row in range(3):
        queue.add(row)
    has_begun.wait()
    closing = threading.Thread(target=lambda: errors.append(queue.close(now=True)))
    closing.start()
    # The other rows are given up immediately.
    while queue.rows_left > 1:
        closing.join(0.001)
    closing.join(0.03)
    assert closing.is_alive()
    may_end.set()
    closing.join()
    assert (processed, errors) == ([0], [None])
