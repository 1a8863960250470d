"""What a scan's files say about it."""

from __future__ import annotations

import pytest

from polysight.host.page.snapshot import remaining
from polysight.host.page.story import Story, seconds
from polysight.host.store import manifest
from polysight.host.store.events import read_events
from polysight.host.store.scan_folder import EVENTS, MANIFEST, ScanFolder
from polysight.shared.messages import Capture, Fault

UTC = "2026-05-01T02:{:02d}:{:02d}.000+00:00"


def facts_of(folder):
    return manifest.read(folder / MANIFEST).facts


def told(facts):
    story = Story(facts[0])
    for fact in facts[1:]:
        story.add_fact(fact)
    return story


@pytest.fixture
def begun(finished):
    """A story whose scan began at 02:00 and has committed rows 0 and 1 at 02:01 and 02:02."""
    facts = facts_of(finished)
    rows = [f for f in facts if f["fact"] == "row_committed"]
    story = Story(facts[0] | {"started_utc": UTC.format(0, 0), "simulated": False})
    for minute, row in enumerate(rows[:2], 1):
        story.add_fact(row | {"committed_utc": UTC.format(minute, 0)})
    return story, rows[2]


def test_counts_are_those_of_the_scan_folder(finished):
    story, scan = told(facts_of(finished)), ScanFolder.load(finished)
    rows = scan.committed()
    assert story.takes == {row: r.take for row, r in rows.items()}
    assert story.ended is not None
    for name, board in story.boards.items():
        each = [r.boards[name] for r in rows.values()]
        assert board.frames_expected == sum(b.frames_expected for b in each)
        assert board.frames_received == sum(b.frames_received for b in each)
        assert board.missing_bytes == sum(b.missing_bytes for b in each)


def test_trigger_health_is_the_worst_of_each_row(finished):
    story, events = told(facts_of(finished)), read_events(finished / EVENTS).events
    story.add_events(events)
    captures = [e for e in events if isinstance(e, Capture)]
    for row, health in story.trigger.items():
        assert health.width_max_ns == max(c.width_max_ns for c in captures if c.row_index == row)
    assert set(story.trigger) == {c.row_index for c in captures}


def test_a_fault_told_twice_is_one(finished):
    story = told(facts_of(finished))
    fault = Fault(scan_id="s", seq=9, t_mono_ns=1, number=103, what="a trigger edge was lost")
    story.add_events([fault])
    story.add_events([fault])
    assert [n.level for n in story.notices] == ["warn"]
    assert "103" in story.notices[0].what
    assert story.notices[0].do


def test_time_left_is_what_rows_took(begun):
    story, last = begun
    now = seconds(UTC.format(2, 20))
    assert remaining(story, now) == (40, "measured")
    story.add_fact(last | {"committed_utc": UTC.format(3, 0)})
    assert remaining(story, seconds(UTC.format(9, 0))) == (0, "measured")


def test_a_pause_is_no_time_of_a_row(begun):
    story, last = begun
    story.add_fact({"fact": "scan_paused", "paused_utc": UTC.format(2, 0)})
    assert story.paused
    assert remaining(story, seconds(UTC.format(30, 0))) == (60, "measured")
    story.add_fact({"fact": "scan_continued", "continued_utc": UTC.format(40, 0)})
    assert not story.paused
    story.add_fact(last | {"committed_utc": UTC.format(41, 0)})
    assert story.row_seconds == (60.0, "measured")


def test_time_left_before_the_first_row_is_the_plan_s(finished):
    started = facts_of(finished)[0]
    real, simulated = Story(started | {"simulated": False}), Story(started | {"simulated": True})
    row_s = real.row_seconds
    assert row_s is not None
    assert row_s[1] == "plan"
    assert row_s[0] > 2 * real.plan.step_x_mm / real.instrument.stage.speed_mm_s
    assert simulated.row_seconds is None


def test_rejected_then_committed_leaves_a_warning(begun):
    story, last = begun
    story.add_fact(
        {"fact": "row_rejected", "row": 2, "take": 1, "reasons": ["RV: no data"], "boards": {},
         "faults": [{"kind": "no_data", "board": "RV"}], "rejected_utc": UTC.format(2, 30)}
    )  # fmt: skip
    assert story.marks[2] == "rejected"
    assert story.boards["RV"].retaken == 1
    assert story.boards["RH"].retaken == 0
    assert "polysight card" in story.notices[-1].do
    story.add_fact(last)
    assert story.marks[2] == "committed"
    assert len(story.notices) == 1


def test_rejections_of_earlier_releases_are_told_without_a_cause(begun):
    story, _ = begun
    story.add_fact({"fact": "row_rejected", "row": 2, "take": 1, "reasons": ["RV: no data"], "boards": {}})
    assert (story.marks[2], story.notices[-1].detail) == ("rejected", "RV: no data")
    assert (story.notices[-1].why, story.boards["RV"].retaken) == ("", 1)


def test_withdrawn_is_missing_until_taken_again(begun):
    story, _ = begun
    story.add_fact({"fact": "row_withdrawn", "row": 1, "take": 1, "reasons": ["short"]})
    assert (set(story.takes), 1 in story.marks) == ({0}, False)


def test_resumed_is_not_ended(finished):
    story = told(facts_of(finished))
    story.add_fact({"fact": "scan_resumed", "resumed_utc": UTC.format(5, 0), "rows_missing": 0})
    assert story.ended is None


def test_facts_of_newer_releases_are_passed_over(begun):
    story, _ = begun
    before = dict(vars(story))
    for name in ("takes", "boards", "rows", "ended", "something_new"):
        story.add_fact({"fact": name})
    assert vars(story) == before
