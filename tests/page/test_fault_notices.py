"""Notices of faults: their level, their cause and remedy, and how they begin."""

import pytest

from polysight.page.history import _find_cause, capitalise, make_fault_notice
from polysight.store import RowFault
from polysight_shared.faults import PiFault, explain
from polysight_shared.messages import Fault

# Faults that end one row only: of a burst, of counts, and of a silent host.
FAULTS_OF_ONE_ROW = (
    PiFault.EDGE_LOST,
    PiFault.EDGE_DURING_BURST,
    PiFault.PULSE_TOO_LONG,
    PiFault.PERIOD_TOO_SHORT,
    PiFault.HOST_LOST,
    PiFault.POINTS_MISMATCH,
)


def make_event(number: int, problem: str = "", **changes: str) -> Fault:
    return Fault(scan_id="a", seq=1, t_mono_ns=0, number=number, problem=problem or explain(number).problem, **changes)


@pytest.mark.parametrize("fault", list(PiFault))
def test_a_fault_that_ends_a_row_alone_is_a_warning_and_others_are_errors(fault):
    """An abort, which a person asked for, is only a note."""
    if fault == PiFault.ABORTED:
        expected = "note"
    elif fault in FAULTS_OF_ONE_ROW:
        expected = "warning"
    else:
        expected = "error"
    notice = make_fault_notice(make_event(fault))
    assert notice.level == expected
    assert notice.what == f"Fault {int(fault)} at the Pi: {explain(fault).problem}"
    assert notice.facts == {}
    assert not notice.why[:1].islower()


def test_a_notice_has_the_events_own_words_before_those_of_the_table():
    fault = PiFault.STAGE_LOST
    notice = make_fault_notice(make_event(fault, "port gone", cause="unplugged", remedy="plug it in"))
    assert (notice.why, notice.do, notice.facts) == ("Unplugged", "Plug it in", {"detail": "port gone"})
    notice = make_fault_notice(make_event(fault))
    assert (notice.why, notice.do) == (capitalise(explain(fault).cause), capitalise(explain(fault).remedy))


def test_a_sentence_begins_with_a_capital_letter_and_a_command_does_not():
    texts = ("the stage", "", "a", "polysight-pi home", "Already")
    assert [capitalise(text) for text in texts] == ["The stage", "", "A", "polysight-pi home", "Already"]


def test_the_cause_of_several_faults_is_that_of_the_first_known_one():
    silent = RowFault(kind="no_data", board="RH", number=0)
    stage = RowFault(kind="pi_fault", board="", number=int(PiFault.STAGE_LOST))
    unknown = RowFault(kind="of a later release", board="", number=0)
    without_number = RowFault(kind="pi_fault", board="", number=0)
    cause_of_stage = capitalise(explain(PiFault.STAGE_LOST).cause)
    cause, _ = _find_cause([stage, silent])
    assert cause == cause_of_stage
    cause_of_silence, _ = _find_cause([silent])
    assert cause_of_silence not in ("", cause_of_stage)
    cause, _ = _find_cause([unknown, without_number, silent, stage])
    assert cause == cause_of_silence
    no_cause_and_no_remedy = ("", "")
    assert _find_cause([unknown]) == no_cause_and_no_remedy
    assert _find_cause([]) == no_cause_and_no_remedy
