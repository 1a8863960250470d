"""The history of a scan, read from its files."""

import pytest
from msgspec import structs
from tests.support.page.live_view import add_fact, begin_history
from tests.support.store.facts import load_facts

from polysight.page.history import parse_seconds
from polysight.page.status import estimate_time_left
from polysight.store.logs import read_events
from polysight.store.scan_folder import EVENTS, ScanFolder
from polysight_shared.faults import PiFault
from polysight_shared.messages import Capture, Fault


def make_utc(minute, second=0):
    """A time after two o'clock on the day of the scan."""
    return f"2026-05-01T02:{minute:02d}:{second:02d}.000+00:00"


def make_history(facts):
    history = begin_history(facts[0])
    for fact in facts[1:]:
        add_fact(history, fact)
    return history


@pytest.fixture
def begun(finished_scan):
    """A history, and the fact of the scan's last row, which is not in it.

    The scan began at 02:00, and committed rows 0 and 1 at 02:01 and 02:02.
    """
    facts = load_facts(finished_scan)
    rows = [f for f in facts if f["fact"] == "row_committed"]
    history = begin_history(facts[0] | {"started_utc": make_utc(0), "simulated": False})
    for minute, row in enumerate(rows[:2], 1):
        add_fact(history, row | {"committed_utc": make_utc(minute)})
    return history, rows[2]


def test_counts_are_those_of_the_scan_folder(finished_scan):
    history = make_history(load_facts(finished_scan))
    scan = ScanFolder.load(finished_scan)
    rows = scan.committed_rows()
    assert history.takes == {row: r.take for row, r in rows.items()}
    assert history.ended is not None
    for board in history.boards:
        board_rows = [r.boards[board.name] for r in rows.values()]
        assert board.frames_expected == sum(b.frames_expected for b in board_rows)
        assert board.frames_received == sum(b.frames_received for b in board_rows)


def test_lost_shares_are_percent_of_the_bytes_of_each_row(finished_scan):
    history = make_history(load_facts(finished_scan))
    row = history.content.rows[1]
    # RV lacks an eighth of its bytes in row 1.
    rv = row.boards["RV"]
    rv_with_loss = structs.replace(rv, missing_bytes=rv.bytes // 8)
    history.content.rows[1] = structs.replace(row, boards={**row.boards, "RV": rv_with_loss})
    no_losses = dict.fromkeys(sorted(history.content.rows), 0.0)
    assert history.lost_shares == {"RH": no_losses, "RV": no_losses | {1: 12.5}}


def test_trigger_health_is_the_worst_of_all_bursts(finished_scan):
    history = make_history(load_facts(finished_scan))
    events = read_events(finished_scan / EVENTS).events
    history.add_events(events)
    captures = [e for e in events if isinstance(e, Capture)]
    assert history.trigger.width_max_ns == max(c.width_max_ns for c in captures)
    assert history.trigger.jitter_max_ns == max(c.jitter_ns for c in captures)


def test_a_fault_reported_twice_is_shown_once(finished_scan):
    history = make_history(load_facts(finished_scan))
    fault = Fault(scan_id="s", seq=9, t_mono_ns=1, number=PiFault.EDGE_LOST, problem="a trigger edge was lost")
    history.add_events([fault])
    history.add_events([fault])
    assert [n.level for n in history.notices] == ["warning"]
    assert str(int(PiFault.EDGE_LOST)) in history.notices[0].what
    assert history.notices[0].do


def test_time_left_is_estimated_from_the_duration_of_earlier_rows(begun):
    """A row takes 60 s. The third one began at 02:02, and 20 s later it has 40 s left."""
    history, last = begun
    now = parse_seconds(make_utc(2, 20))
    assert estimate_time_left(history, now) == (40, "measured")
    add_fact(history, last | {"committed_utc": make_utc(3)})
    assert estimate_time_left(history, parse_seconds(make_utc(9))) == (0, "measured")


def test_a_pause_does_not_count_as_time_of_a_row(begun):
    history, last = begun
    add_fact(history, {"fact": "scan_paused", "paused_utc": make_utc(2)})
    assert history.paused
    assert estimate_time_left(history, parse_seconds(make_utc(30))) == (60, "measured")
    add_fact(history, {"fact": "scan_continued", "continued_utc": make_utc(40)})
    assert not history.paused
    add_fact(history, last | {"committed_utc": make_utc(41)})
    assert history.row_seconds == (60.0, "measured")


def test_time_left_after_one_row_is_estimated_from_that_row(finished_scan):
    facts = load_facts(finished_scan)
    first_row, second_row, *_ = (fact for fact in facts if fact["fact"] == "row_committed")
    history = begin_history(facts[0] | {"started_utc": make_utc(0), "simulated": False})
    add_fact(history, first_row | {"committed_utc": make_utc(1, 30)})
    assert history.row_seconds == (90.0, "first row")
    add_fact(history, second_row | {"committed_utc": make_utc(2, 30)})
    assert history.row_seconds == (60.0, "measured")


def test_before_the_first_row_a_real_scan_s_time_is_planned_and_a_simulated_one_s_unknown(finished_scan):
    started = load_facts(finished_scan)[0]
    real = begin_history(started | {"simulated": False})
    simulated = begin_history(started | {"simulated": True})
    assert real.row_seconds is not None
    seconds, source = real.row_seconds
    assert source == "plan"
    # Two steps between the three positions of a row at full speed; the stage also speeds up and slows down.
    assert seconds > 2 * real.plan.step_x_mm / real.instrument.stage.speed_mm_s
    assert simulated.row_seconds is None


def test_a_row_that_was_rejected_and_then_committed_leaves_a_warning(begun):
    history, last = begun
    add_fact(history, {"fact": "row_rejected", "row": 2, "take": 1, "reasons": ["RV: no data"], "boards": {},
         "faults": [{"kind": "no_data", "board": "RV"}], "rejected_utc": make_utc(2, 30)})  # fmt: skip
    assert history.marks[2] == "rejected"
    assert {board.name: board.retaken for board in history.boards} == {"RV": 1, "RH": 0}
    assert "polysight card" in history.notices[-1].do
    add_fact(history, last)
    assert history.marks[2] == "committed"
    assert len(history.notices) == 1


def test_rejections_of_earlier_releases_are_shown_without_a_cause(begun):
    history, _ = begun
    add_fact(history, {"fact": "row_rejected", "row": 2, "take": 1, "reasons": ["RV: no data"], "boards": {}})
    notice = history.notices[-1]
    assert history.marks[2] == "rejected"
    assert (notice.facts["detail"], notice.why) == ("RV: no data", "")
    assert [board.retaken for board in history.boards if board.name == "RV"] == [1]


def test_a_withdrawn_row_is_missing_until_it_is_taken_again(begun):
    history, _ = begun
    add_fact(history, {"fact": "row_withdrawn", "row": 1, "take": 1, "reasons": ["short"]})
    assert set(history.takes) == {0}
    assert 1 not in history.marks


def test_a_scan_that_was_resumed_has_not_ended(finished_scan):
    history = make_history(load_facts(finished_scan))
    add_fact(history, {"fact": "scan_resumed", "resumed_utc": make_utc(5), "rows_missing": 0})
    assert history.ended is None


def test_facts_of_newer_releases_are_ignored(begun):
    history, _ = begun
    values_before = dict(vars(history))
    for name in ("takes", "boards", "rows", "ended", "something_new"):
        add_fact(history, {"fact": name})
    assert vars(history) == values_before
