"""The files of a committed row get their final names; those of a rejected row are deleted."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.support.acquisition.takes import PULSES, ROW, make_capture, make_end
from tests.support.refusals import expect_refusal
from tests.support.rigs import make_rig_with

from polysight.acquisition.pulse_times import PlacedFrames
from polysight.acquisition.row import FaultKind, Take, TakeFault, commit_row, explain_incomplete_row, reject_row
from polysight.capture import PACKETS_SUFFIX
from polysight.radar import BoardState, RadarState
from polysight.store import PART_SUFFIX, LogDigest
from polysight_shared.errors import ErrorCode
from polysight_shared.faults import PiFault, explain

RIG = make_rig_with(burst={"pulses": PULSES})
DIGEST = LogDigest(0, "00000000")
LOST = TakeFault(FaultKind.LOST_ON_THE_WAY, "9 bytes are missing", "RV")
ALL_PULSES = ROW.points * PULSES


@pytest.fixture
def scan(tmp_path):
    """A scan folder with the files of a take of row 0 of two boards; `facts` are those of its manifest."""
    for name in ("RH", "RV"):
        (tmp_path / name).mkdir()
        for suffix in (PART_SUFFIX, ".idx", PACKETS_SUFFIX):
            (tmp_path / name / "0000").with_suffix(suffix).write_bytes(b"row")
    facts: list[Any] = []

    def row_path(board: str, row: int) -> Path:
        return tmp_path / board / f"{row:04d}.bin"

    return SimpleNamespace(path=tmp_path, instrument=RIG, row_path=row_path, facts=facts, append=facts.append)


def make_take(frames: PlacedFrames | None, **fields: Any) -> Take:
    take = Take(ROW, 1, finished=make_end(), captures={"RV": make_capture(**fields)})
    if frames is not None:
        take.frames["RV"] = frames
    return take


def commit(scan: Any, take: Take) -> Any:
    """Commit a take; return the fact's part of RV."""
    commit_row(scan, scan, take, [], DIGEST)
    return scan.facts[-1].boards["RV"]


@pytest.mark.parametrize(
    ("frames", "untimed"),
    [
        (None, ALL_PULSES),
        (PlacedFrames(np.full(ALL_PULSES, -1), [], ALL_PULSES, reason="no pause"), ALL_PULSES),
        (PlacedFrames(np.arange(ALL_PULSES), [], ALL_PULSES), 0),
    ],
    ids=["not compared", "without times", "timed"],
)
def test_frames_of_a_located_row_are_untimed_unless_their_times_agree(scan, frames, untimed):
    board = commit(scan, make_take(frames))
    assert (board.frames_untimed, board.frames_expected, board.pulses_missed) == (untimed, ALL_PULSES, None)


def test_frames_of_a_row_that_is_not_located_are_not_called_untimed(scan):
    assert commit(scan, make_take(None, located=False, reason="lost")).frames_untimed == 0


def test_a_slipped_row_has_the_number_of_pulses_that_were_missed(scan):
    slots = np.full(ALL_PULSES - 2, -1)
    frames = PlacedFrames(slots, [], ALL_PULSES, reason="no pause")
    assert commit(scan, make_take(frames, located=False, slipped=True)).pulses_missed == 2


def test_a_committed_row_has_its_final_name_and_the_pulses_that_were_sent(scan):
    commit(scan, make_take(None))
    assert (scan.path / "RV" / "0000.bin").read_bytes() == b"row"
    assert not (scan.path / "RV" / "0000.part").exists()
    assert (scan.facts[0].pulses, scan.facts[0].direction) == (ALL_PULSES, 1)


def test_a_row_that_cannot_get_its_final_name_is_an_error_of_the_disk(scan):
    (scan.path / "RV" / "0000.part").unlink()
    with expect_refusal(ErrorCode.FILE_UNWRITABLE, "0000.bin"):
        commit(scan, make_take(None))
    assert scan.facts == []


def test_a_rejected_row_leaves_no_file_of_its_boards_and_says_why(scan):
    take = Take(ROW, 1, captures={"RV": make_capture(missing=[(0, 9)])})
    (scan.path / "RV" / "0000.idx").unlink()
    reject_row(scan, scan, take, [LOST])
    assert list((scan.path / "RV").iterdir()) == []
    assert len(list((scan.path / "RH").iterdir())) == 3
    (fact,) = scan.facts
    assert (fact.row, fact.take, fact.reasons, fact.faults) == (0, 1, [str(LOST)], [LOST.to_row_fault()])
    assert list(fact.boards) == ["RV"]


def test_a_row_that_stays_incomplete_has_the_cause_and_remedy_of_the_pis_fault(scan):
    number = int(PiFault.EDGE_LOST)
    by_pi = explain_incomplete_row(Take(ROW, 3, finished=make_end(status="fault", fault=number)), [LOST], scan, 3)
    assert by_pi.what == "row 0 is not complete after 3 takes: RV: 9 bytes are missing"
    assert by_pi.why == explain(number).cause
    assert by_pi.remedy.startswith(explain(number).remedy)
    for take in (make_take(None), Take(ROW, 3)):
        assert explain_incomplete_row(take, [LOST], scan, 3).why.startswith("packets are lost on the network")
    stopped = Take(ROW, 3, radars={"RV": BoardState(RadarState.FAULT)})
    assert explain_incomplete_row(stopped, [LOST], scan, 3).why.startswith("a radar has stopped")
