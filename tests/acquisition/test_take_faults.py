"""Faults of takes in the manifest: a kind and a board for programs, and reasons for people."""

import re

import pytest
from tests.support.paths import REPO
from tests.support.store.facts import load_facts

from polysight.acquisition.control import StopRequest
from polysight.acquisition.row import ON_REQUEST, FaultKind, Take, TakeFault
from polysight.acquisition.scan import run_scan
from polysight.capture.dca1000 import Status
from polysight.page.history import CAUSES, make_rejection_notice
from polysight.store import RowFault
from polysight_shared.faults import PiFault, explain
from polysight_shared.messages import RowFinished
from polysight_shared.raster import Row

SPEC = REPO / "docs/spec/scan-folder.md"
# The Pi's remark on a row during which the stage was held.
HELD = "held on the way: some positions were passed below full speed"


# Row 0 and its first take (takes count from 1), for which the following functions cause a fault.
SPOILED_TAKE = (0, 1)


def lose_a_packet_on_the_way(rig) -> None:
    rig.cards["RV"].drop[SPOILED_TAKE] = {3}


def send_no_data(rig) -> None:
    rig.cards["RV"].missing_end_bytes[SPOILED_TAKE] = rig.instrument.row_bytes


def drop_frame(rig) -> None:
    rig.cards["RV"].missing_end_bytes[SPOILED_TAKE] = rig.instrument.frame_bytes


def hold_row(rig) -> None:
    drop_frame(rig)
    rig.pi.notes[SPOILED_TAKE] = HELD


def make_unlocated(rig) -> None:
    """The first packet is lost, and the record ends too early, within a packet."""
    two_frames_and_a_half = 5 * rig.instrument.frame_bytes // 2
    rig.cards["RV"].drop[SPOILED_TAKE] = {0}
    rig.cards["RV"].missing_end_bytes[SPOILED_TAKE] = two_frames_and_a_half


def lose_edge(rig) -> None:
    rig.pi.fail_rows[SPOILED_TAKE] = int(PiFault.EDGE_LOST)


@pytest.mark.parametrize(("status", "all_sent"), [(None, False), ("done", True), ("fault", False), ("aborted", False)])
def test_only_a_row_that_is_done_has_all_its_pulses_and_a_remark(status, all_sent):
    finished = None
    if status is not None:
        counts = {"points": 3, "edges": 3, "bursts": 3, "pulses": 6}
        finished = RowFinished(
            scan_id="s", seq=1, t_mono_ns=1, row_index=0, take=1, status=status, reason=HELD, **counts
        )
    row = Row(index=0, y_mm=0.0, x_start_mm=0.0, step_mm=2.0, points=3)
    take = Take(row, number=1, finished=finished)
    assert take.all_pulses_sent is all_sent
    assert take.note == (HELD if all_sent else "")


@pytest.mark.parametrize(
    ("spoil", "fault"),
    [
        (lose_a_packet_on_the_way, {"kind": "lost_on_the_way", "board": "RV"}),
        (send_no_data, {"kind": "no_data", "board": "RV"}),
        (drop_frame, {"kind": "frames_missing", "board": "RV"}),
        (hold_row, {"kind": "held", "board": "RV"}),
        (make_unlocated, {"kind": "unlocated", "board": "RV"}),
        (lose_edge, {"kind": "pi_fault", "number": int(PiFault.EDGE_LOST)}),
    ],
    ids=lambda x: x.__name__ if callable(x) else "",
)
def test_a_rejected_take_has_the_kind_and_board_of_its_fault(rig, tmp_path, spoil, fault):
    spoil(rig)
    result = run_scan(rig.instrument, tmp_path / "s")
    assert (result.exit_status, result.retakes) == ("success", 1)
    (fact,) = load_facts(result.folder, "row_rejected")
    assert fact["faults"] == [fault]
    assert len(fact["reasons"]) == 1
    # The reason names the board if the fault is one of a board.
    assert fact["reasons"][0].startswith("RV: ") == ("board" in fault)


@pytest.mark.parametrize("bit", [Status.DDR_FULL, Status.LVDS_BUFFER_FULL])
def test_data_that_the_card_dropped_rejects_the_row_and_its_status_is_kept(rig, tmp_path, bit):
    """Every expected byte comes without a gap in the counters: only the status shows the loss."""
    card = rig.cards["RV"]
    send_row = rig.cards["RV"].send_row

    def report_overflow_and_send(row: int, take: int) -> None:
        if (row, take) == SPOILED_TAKE:
            card.report_status(bit)
        send_row(row, take)

    card.send_row = report_overflow_and_send
    result = run_scan(rig.instrument, tmp_path / "s")
    assert (result.exit_status, result.retakes) == ("success", 1)
    (fact,) = load_facts(result.folder, "row_rejected")
    assert fact["faults"] == [{"kind": "card_dropped", "board": "RV"}]
    assert not fact["boards"]["RH"]["card_status"] & bit
    assert fact["boards"]["RV"]["card_status"] & bit


def test_a_take_that_was_stopped_on_request_has_no_other_fault(rig, tmp_path):
    """Two requests stop a scan within its row. The missing data is not a fault of the rig."""
    rig.pi.hang_at = {0}
    stop = StopRequest()

    def progress(p) -> None:
        if p.state == "running":
            stop.request()
            stop.request()

    result = run_scan(rig.instrument, tmp_path / "s", stop=stop, progress=progress)
    (fact,) = load_facts(result.folder, "row_rejected")
    assert fact["reasons"] == [str(ON_REQUEST)]
    assert fact["faults"] == [{"kind": "on_request"}]
    assert result.exit_status == "abort"
    assert list(result.folder.committed_rows()) == []
    assert not list((tmp_path / "s" / "raw").rglob("*.part"))


def test_every_kind_of_fault_has_a_cause_a_remedy_and_a_line_in_the_specification():
    # The kind is in the first of two columns.
    table = SPEC.read_text(encoding="utf-8").split("| kind | what is wrong |")[1].split("\n\n")[0]
    assert set(re.findall(r"`([a-z_]+)`(?=[^|\n]*\|[^|\n]*\|$)", table, re.MULTILINE)) >= set(FaultKind)
    for kind in FaultKind:
        number = int(PiFault.EDGE_LOST) if kind is FaultKind.PI_FAULT else 0
        fault = TakeFault(kind, "text", board="RV", number=number)
        notice = make_rejection_notice(0, 1, [str(fault)], [fault.to_row_fault()], "")
        assert notice.why
        assert notice.do
    assert set(CAUSES) == set(FaultKind) - {FaultKind.PI_FAULT}


def test_the_shown_cause_depends_on_the_kind_of_the_fault_and_not_on_the_text_of_the_reason():
    reason = "RV: no data, the radar has stopped, held, pulse, dropped by this machine"
    for kind, (cause, do) in CAUSES.items():
        notice = make_rejection_notice(0, 1, [reason], [TakeFault(kind, reason, "RV").to_row_fault()], "")
        assert (notice.why, notice.do) == (cause, do)
    pulse_too_long = TakeFault(FaultKind.PI_FAULT, "a pulse was too long", number=int(PiFault.PULSE_TOO_LONG))
    notice = make_rejection_notice(0, 1, [str(pulse_too_long)], [pulse_too_long.to_row_fault()], "")
    assert notice.why.lower() == explain(PiFault.PULSE_TOO_LONG).cause.lower()
    # A fault of a later release has no known cause.
    for unknown in ([], [RowFault("of_a_newer_release", "RV")]):
        notice = make_rejection_notice(0, 1, [reason], unknown, "")
        assert (notice.why, notice.facts["detail"]) == ("", reason)
        assert notice.do
