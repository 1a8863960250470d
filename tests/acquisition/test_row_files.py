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
# The event log is empty.
DIGEST = LogDigest(bytes=0, crc32="00000000")
# Files of a row that is not yet committed.
ROW_SUFFIXES = (PART_SUFFIX, ".idx", PACKETS_SUFFIX)
LOST = TakeFault(FaultKind.LOST_ON_THE_WAY, "9 bytes are missing", "RV")
ALL_PULSES = ROW.points * PULSES


@pytest.fixture
def scan(tmp_path):
    """A scan folder in which two boards have each just recorded row 0; `facts` is the list of facts in its manifest.

    It stands for the manifest's writer, too: it has `append`.
    """
    for name in ("RH", "RV"):
        (tmp_path / name).mkdir()
        for suffix in ROW_SUFFIXES:
            (tmp_path / name / "0000").with_suffix(suffix).write_bytes(b"row")
    facts: list[Any] = []

    def row_path(board: str, row: int) -> Path:
        return tmp_path / board / f"{row:04d}.bin"

    return SimpleNamespace(path=tmp_path, instrument=RIG, row_path=row_path, facts=facts, append=facts.append)


def make_take(frames: PlacedFrames | None, **fields: Any) -> Take:
    """A take that only the board RV has recorded; `fields` replace those of its capture."""
    take = Take(ROW, number=1, finished=make_end(), captures={"RV": make_capture(**fields)})
    if frames is not None:
        take.frames["RV"] = frames
    return take


def commit(scan: Any, take: Take) -> Any:
    """Commit a take; return what the manifest then says about the row of the board RV."""
    commit_row(scan, writer=scan, take=take, faults=[], events=DIGEST)
    return scan.facts[-1].boards["RV"]


def place_frames(pulse_numbers: np.ndarray, reason: str = "") -> PlacedFrames:
    """Frames at these pulses (-1: unknown); no pulse is known to be missed. `reason`: why there are no usable times."""
    return PlacedFrames(pulse_numbers, missed=[], pulses=ALL_PULSES, reason=reason)


# Frames are untimed if their pulses are known from their numbers alone, and not from their arrival times.
@pytest.mark.parametrize(
    ("frames", "untimed"),
    [
        (None, ALL_PULSES),
        (place_frames(np.full(ALL_PULSES, -1), reason="no pause"), ALL_PULSES),
        (place_frames(np.arange(ALL_PULSES)), 0),
    ],
    ids=["not compared", "without times", "timed"],
)
def test_frames_are_untimed_unless_their_arrival_times_show_their_pulses(scan, frames, untimed):
    board = commit(scan, make_take(frames))
    assert (board.frames_untimed, board.frames_expected, board.pulses_missed) == (untimed, ALL_PULSES, None)


def test_frames_are_not_called_untimed_if_their_place_in_the_row_is_not_known(scan):
    assert commit(scan, make_take(None, located=False, reason="lost")).frames_untimed == 0


def test_the_manifest_has_the_number_of_pulses_for_which_no_frame_came(scan):
    """The row has slipped: frames are missing, and it is not known at which pulses."""
    missed_count = 2
    frames = place_frames(np.full(ALL_PULSES - missed_count, -1), reason="no pause")
    assert commit(scan, make_take(frames, located=False, slipped=True)).pulses_missed == missed_count


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
    """The take has data of the board RV alone: the files of RH are not its own, and stay."""
    files_of_rh = sorted((scan.path / "RH").iterdir())
    take = Take(ROW, number=1, captures={"RV": make_capture(missing=[(0, 9)])})
    (scan.path / "RV" / "0000.idx").unlink()
    reject_row(scan, writer=scan, take=take, faults=[LOST])
    assert list((scan.path / "RV").iterdir()) == []
    assert len(files_of_rh) == len(ROW_SUFFIXES)
    assert sorted((scan.path / "RH").iterdir()) == files_of_rh
    (fact,) = scan.facts
    assert (fact.row, fact.take, fact.reasons, fact.faults) == (0, 1, [str(LOST)], [LOST.to_row_fault()])
    assert list(fact.boards) == ["RV"]


def test_a_row_that_stays_incomplete_has_the_cause_and_remedy_of_the_pis_fault(scan):
    pi_fault = int(PiFault.EDGE_LOST)
    take = Take(ROW, number=3, finished=make_end(status="fault", fault=pi_fault))
    error = explain_incomplete_row(take, [LOST], scan, takes=3)
    assert error.what == "row 0 is not complete after 3 takes: RV: 9 bytes are missing"
    assert error.why == explain(pi_fault).cause
    assert error.remedy.startswith(explain(pi_fault).remedy)


def test_a_row_that_stays_incomplete_without_a_fault_of_the_pi_has_the_likeliest_cause(scan):
    for take in (make_take(None), Take(ROW, number=3)):
        error = explain_incomplete_row(take, [LOST], scan, takes=3)
        assert error.why.startswith("packets are lost on the network")
    take = Take(ROW, number=3, radars={"RV": BoardState(RadarState.FAULT)})
    error = explain_incomplete_row(take, [LOST], scan, takes=3)
    assert error.why.startswith("a radar has stopped")
