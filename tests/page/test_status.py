"""The headline names the most serious problem first, always with a remedy."""

from dataclasses import replace
from pathlib import Path

import pytest
from msgspec.structs import replace as replace_struct
from tests.support.page.live_view import add_fact, begin_history
from tests.support.store.facts import load_facts

from polysight.acquisition import STATES
from polysight.acquisition.control import SignOfLife
from polysight.catalogue import Program
from polysight.page.history import PiState, make_fault_notice
from polysight.page.status import Inputs, LifeSigns, RowSync, ShownResults, judge, make_snapshot
from polysight.results import Verdict
from polysight_shared.faults import EXPLANATIONS, PiFault
from polysight_shared.findings import Finding
from polysight_shared.messages import Fault

FOLDER = Path("scans/one")
# The program and the Pi are alive: the last event of the Pi came 0.3 s ago, and 6 s are allowed. It is the year 2027.
LIVELY = LifeSigns(life=SignOfLife(), alive=True, killed=False, alive_s=0, pi_silent_s=0.3, pi_limit_s=6.0, now_s=1.8e9)
RUNNING = PiState(heard_s=1.0, state="running", row=1, take=1)
ROW = {"fact": "row_committed", "take": 2, "direction": 1, "pulses": 0, "boards": {}}
REJECTED = {"fact": "row_rejected", "row": 1, "take": 1, "reasons": ["RV: no data"], "boards": {}}
REJECTED["faults"] = [{"kind": "no_data", "board": "RV"}]
# Synchronisation of a good row: small residuals of phase
GOOD_SYNC = RowSync(object_rad=0.02, direct_rad=0.004, masked=0)


@pytest.fixture
def history(finished_scan):
    """The history of a scan of which one of three rows is committed."""
    facts = load_facts(finished_scan)
    history = begin_history(facts[0])
    add_fact(history, next(f for f in facts if f["fact"] == "row_committed"))
    return history


def judge_status(history, signs=LIVELY, heard=RUNNING, shown=ShownResults(), **more):  # noqa: B008
    return judge(Inputs(FOLDER, history, signs, heard, shown, **more))


def make_program(kind, started_utc, running=True, status=None):
    """A program of this kind, whose log is empty. `status` is its exit status."""
    return Program(kind, running=running, status=status, words=(), started_utc=started_utc, log="")


def make_signs(command, doing="rows"):
    """Signs of life of a program that has received a command and does `doing`."""
    return replace(LIVELY, life=SignOfLife(asked=command, asker="the page", doing=doing))


def test_all_is_well_needs_nothing_done(history):
    status = judge_status(history)
    assert (status.level, status.do) == ("good", "")
    assert "Row 1" in status.detail


def test_a_dead_program_outranks_everything_but_the_end(history):
    killed_signs = replace(make_signs("abort"), alive=False, killed=True, alive_s=1.7e9, pi_silent_s=99.0)
    status = judge_status(history, killed_signs, replace(RUNNING, state="fault"))
    assert (status.level, status.headline) == ("bad", "The scan program was killed")
    assert f"polysight resume {FOLDER}" in status.do
    assert "1 of 3 rows are safe" in status.detail
    add_fact(history, {"fact": "scan_ended", "exit_status": "abort", "reason": "stopped on request"})
    assert judge_status(history, killed_signs).headline == "Stopped on request"


def test_a_started_program_hangs_once_its_run_has_begun(history):
    """Before the program has written anything, the signs of life are those of the previous run."""
    lifeless = replace(LIVELY, alive=False)
    started = make_program("scan", "2000-01-01T00:00:00+00:00")
    assert judge_status(history, lifeless, program=started).key == "frozen"
    resumed = replace_struct(started, started_utc="2100-01-01T00:00:00+00:00")
    assert judge_status(history, lifeless, program=resumed).key == "resuming"
    add_fact(history, {"fact": "scan_resumed", "resumed_utc": "2100-01-01T00:00:01+00:00"})
    status = judge_status(history, lifeless, program=resumed)
    assert (status.key, status.press) == ("frozen", ("abort", "resume"))


def test_nothing_may_be_pressed_before_the_program_takes_commands(finished_scan):
    """The program writes its first sign of life when it begins."""
    started = make_program("scan", "2000-01-01T00:00:00+00:00")
    facts = load_facts(finished_scan)
    history = begin_history(facts[0])
    quiet = replace(LIVELY, life=None)
    between_rows = replace(RUNNING, row=-1)
    status = judge_status(history, quiet, between_rows, program=started)
    assert (status.key, status.press) == ("starting", ())
    add_fact(history, next(f for f in facts if f["fact"] == "row_committed"))
    assert judge_status(history, quiet, between_rows, program=started).key == "rows"
    add_fact(history, {"fact": "scan_resumed", "resumed_utc": "2090-01-01T00:00:01+00:00"})
    assert judge_status(history, quiet, between_rows, program=started).key == "resuming"
    assert judge_status(history, quiet, program=started).key == "rows"
    assert judge_status(history, LIVELY, between_rows, program=started).key == "rows"


@pytest.mark.parametrize(
    ("signs", "heard", "word"),
    [
        (replace(LIVELY, pi_silent_s=7.0), RUNNING, "Pi is silent"),
        (LIVELY, replace(RUNNING, state="fault"), "stopped with a fault"),
        (LIVELY, replace(RUNNING, state="held"), "held"),
        (replace(LIVELY, now_s=4e9), replace(RUNNING, row=-1), "No row has ended"),
    ],
)
def test_a_problem_is_shown_with_its_cause_and_remedy(history, signs, heard, word):
    add_fact(history, ROW | {"row": 0, "committed_utc": "2026-01-01T00:00:00Z"})
    history._row_seconds = [20.0]
    status = judge_status(history, signs, heard)
    assert word in status.headline
    assert status.level in ("warn", "bad")
    assert status.why
    assert status.do


@pytest.mark.parametrize("number", sorted(EXPLANATIONS))
def test_every_fault_of_the_pi_has_words(history, number):
    notice = make_fault_notice(
        Fault(scan_id="s", seq=1, t_mono_ns=1, number=number, problem=EXPLANATIONS[number].problem)
    )
    assert notice.what
    assert notice.why
    assert notice.do
    lasting = (PiFault.STAGE_LOST, PiFault.STAGE_ALARM, PiFault.TRIGGER_LINE_LOST, PiFault.JOURNAL_FULL)
    if number in lasting:
        assert notice.level == "error"
    status = judge_status(history, heard=replace(RUNNING, state="fault", faults=(notice,)))
    assert (status.level, status.why, status.do) == ("bad", notice.why, notice.do)


def test_a_row_taken_again_is_a_warning_until_three_rows_are_committed(history):
    add_fact(history, REJECTED)
    status = judge_status(history, heard=replace(RUNNING, take=2))
    assert status.level == "warn"
    assert "Row 1 is retaken" in status.headline
    assert "polysight card" in status.do
    for row, level in ((1, "warn"), (0, "warn"), (1, "good")):
        add_fact(history, ROW | {"row": row})
        assert judge_status(history).level == level


def test_an_rx_without_a_signal_is_reported(history):
    row_without_rx3 = GOOD_SYNC._replace(dead_rx=(3,))
    status = judge_status(history, shown=ShownResults(sync={"RH": {0: row_without_rx3}}))
    assert status.level == "warn"
    assert "RX3 of RH gives no signal" in status.headline + status.detail


@pytest.mark.parametrize(("direct_rad", "masked", "level"), [(0.004, 0, "good"), (0.3, 0, "warn"), (0.004, 2, "warn")])
def test_a_row_with_a_noisy_or_missing_direct_path_is_a_warning(history, direct_rad, masked, level):
    row = GOOD_SYNC._replace(direct_rad=direct_rad, masked=masked)
    status = judge_status(history, shown=ShownResults(sync={"RH": {0: row}}))
    assert status.level == level
    assert bool(status.do) == (level == "warn")


def test_requests_are_shown_with_their_sender_until_they_are_carried_out(history):
    status = judge_status(history, make_signs("pause"))
    assert (status.headline, status.press) == ("Pausing after this row", ("continue", "stop", "abort"))
    assert "the page" in status.detail
    add_fact(history, {"fact": "scan_paused", "paused_utc": "2026-01-01T00:00:00Z"})
    assert judge_status(history, make_signs("pause")).headline == "Paused"
    assert judge_status(history, make_signs("stop")).press == ("abort",)
    assert judge_status(history, make_signs("abort")).headline == "Stopping now"


def test_an_abort_is_not_a_fault(history):
    """Notices of the row that it ends, of the Pi, and of the ended scan do not call it a fault."""
    aborted = REJECTED | {"faults": [{"kind": "on_request"}]}
    add_fact(history, aborted)
    fault = make_fault_notice(Fault(scan_id="s", seq=1, t_mono_ns=1, number=PiFault.ABORTED, problem="aborted"))
    history.notices.append(fault)
    stopped = replace(RUNNING, state="fault", faults=(fault,))
    assert judge_status(history, make_signs("abort"), stopped).key == "aborting"
    assert [notice.level for notice in history.notices] == ["note", "note"]
    end = {"fact": "scan_ended", "exit_status": "abort", "reason": "stopped on request", "asked": "abort"}
    add_fact(history, end | {"asker": "the page"})
    status = judge_status(history, replace(LIVELY, alive=False, life=None))
    assert (status.key, status.press) == ("aborted", ("resume", "repeat"))
    assert "the page" in status.detail
    # The program's last message, which is that of an error.
    failure = Finding("error", "scans/one: stopped on request, 2 of 3 rows are missing")
    snapshot = make_snapshot(Inputs(FOLDER, history, replace(LIVELY, alive=False, life=None), failure=failure))
    assert [notice.level for notice in snapshot.notices] == ["note", "note"]


def test_there_is_no_result_before_materials(history):
    for row in (1, 2):
        add_fact(history, ROW | {"row": row})
    assert judge_status(history, heard=replace(RUNNING, state="homing")).key == "homing_again"
    assert judge_status(history, heard=replace(RUNNING, row=-1)).key == "finishing"
    add_fact(history, {"fact": "scan_ended", "exit_status": "success", "reason": ""})
    good_verdict = Verdict("good")
    # The program of the scan still runs, and has not reported that it computes materials.
    assert judge_status(history).key == "finishing"
    assert judge_status(history, make_signs("", "materials"), verdict=good_verdict).key == "materials"
    assert make_snapshot(Inputs(FOLDER, history, make_signs("", "materials"), verdict=good_verdict)).verdict is None
    for level in ("good", "care", "none"):
        assert judge_status(history, replace(LIVELY, life=None), verdict=Verdict(level)).key == f"result_{level}"
    running = make_program("process", "2026-01-01T00:00:00")
    assert judge_status(history, replace(LIVELY, life=None), verdict=good_verdict, program=running).key == "processing"
    killed = replace(make_signs("", "materials"), alive=False, killed=True)
    assert "killed" in judge_status(history, killed).detail


def test_a_failed_start_is_shown_with_its_cause_and_offered_again():
    failure = Finding("error", "no Pi answers", "it is off", "switch it on")
    failed = make_program("scan", "2026-01-01T00:00:00", running=False, status=4)
    status = judge_status(None, program=failed, failure=failure)
    assert (status.detail, status.why, status.do, status.press) == (
        "no Pi answers.",
        "it is off",
        "switch it on",
        ("again",),
    )
    assert make_snapshot(Inputs(FOLDER, None, LIVELY, program=failed, failure=failure)).notices == [failure]
    assert judge_status(None, program=replace_struct(failed, running=True)).key == "starting"


def test_no_state_shows_text_of_another_state():
    for state in STATES.values():
        words = " ".join((state.headline, state.detail, state.why, state.do))
        assert not [phrase for phrase in state.never if phrase in words], state.key
        assert bool(state.why or "{" in state.detail) or state.level not in ("bad", "warn"), state.key


def test_each_end_of_a_scan_is_described(history):
    ended = {"fact": "scan_ended", "exit_status": "fail", "reason": "the Pi did not answer"}
    add_fact(history, ended | {"why": "it is off", "remedy": "switch it on"})
    status = judge_status(history)
    assert (status.level, status.why, status.do) == ("bad", "It is off", "Switch it on")
    assert status.detail == "The Pi did not answer. 1 of 3 rows are safe."
    add_fact(history, ended)
    assert f"polysight resume {FOLDER}" in judge_status(history).do
    for row in (1, 2):
        add_fact(history, ROW | {"row": row})
    add_fact(history, ended | {"exit_status": "success", "reason": "every row is committed"})
    status = judge_status(history, replace(LIVELY, life=None))
    assert (status.level, status.do) == ("done", "")


def test_without_a_scan_the_page_explains_how_to_begin_one():
    assert f"polysight scan --out {FOLDER}" in judge_status(None).do


def test_a_renamed_folder_is_reported_as_missing(history):
    assert judge_status(history, gone=True).headline == "The scan's folder no longer exists"
