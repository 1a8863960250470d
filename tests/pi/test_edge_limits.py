"""The check of trigger edges at its tolerances, on a row whose motion is computed by hand."""

from itertools import pairwise

import pytest

from polysight_pi.edges import EdgeTimes, RowMotion, slowest_feed

# Four points 400 steps (2 mm) apart, at 4,000 steps/s (20 mm/s): from one point to the next the stage takes 100 ms.
MOTION = RowMotion(x_start=10_000, step=400, points=4, y=500, feed=4000, accel=40_000, backlash=0)
MS = 1_000_000
BEGIN_NS = 5_000 * MS


def note_edges(*intervals_ms: float, motion: RowMotion = MOTION) -> tuple[EdgeTimes, list[str]]:
    """Give edges at these intervals to a check; return the check, and the problem that it reports for each edge."""
    check = EdgeTimes(motion)
    edge_ns = BEGIN_NS
    problems = [check.note_edge(edge_ns)]
    for interval_ms in intervals_ms:
        edge_ns += round(interval_ms * MS)
        problems.append(check.note_edge(edge_ns))
    return check, problems


def test_lengths_of_a_row_are_its_ramp_and_its_points():
    """The run-up at each end is a ramp of v^2 / 2a = 4000^2 / (2 x 40000) = 200 steps, and 400 steps at full speed."""
    assert MOTION.ramp == 200
    assert MOTION.run_up == 600
    assert MOTION.length == 3 * 400 + 2 * 600
    assert MOTION.end == (10_000 + 3 * 400 + 600, 500)
    assert MOTION.distance(10_000) == 600
    assert MOTION.distance(10_050) == 650

    backwards = MOTION._replace(step=-400)
    assert backwards.direction == -1
    assert backwards.length == MOTION.length
    assert backwards.end == (10_000 - 3 * 400 - 600, 500)
    assert backwards.distance(9_950) == 650

    # Play longer than a step lengthens the run-up, and a ramp of 200.1 steps is rounded up.
    assert MOTION._replace(backlash=1000).run_up == 1200
    assert MOTION._replace(feed=4001).ramp == 201


@pytest.mark.parametrize(("accel", "feed"), [(40_000, 141), (200, 31), (1921, 31), (2048, 32)])
def test_a_speed_with_which_the_stage_may_start_needs_no_ramp(accel, feed):
    """From rest the first step takes sqrt(2 / accel) seconds, so that speed is sqrt(accel / 2), rounded down.

    The firmware has no lower speed than 31 steps/s: 1921 / 2 is the last below 31^2, and 2048 / 2 is 32^2.
    """
    assert slowest_feed(accel) == feed
    assert MOTION._replace(accel=accel, feed=feed).ramp == 0
    assert MOTION._replace(accel=accel, feed=feed + 1).ramp > 0


def test_points_of_a_row_pass_at_its_speed_between_two_ramps():
    points_s, end_s = MOTION.time_points([])
    assert [later_s - earlier_s for earlier_s, later_s in pairwise(points_s)] == pytest.approx([0.1] * 3)
    # From rest to the first point: the ramp takes v / a = 0.1 s, and 400 steps at full speed 0.1 s. The firmware's ramp
    # is made of whole steps, and so takes not exactly v / a: hence the tolerances below.
    assert points_s[0] == pytest.approx(0.1 + 0.1, rel=0.05)
    assert end_s - points_s[-1] == pytest.approx(points_s[0], rel=0.02)

    # A stop between the second and third point costs two ramps. Each takes v / a = 0.1 s; at full speed the same way
    # takes half of that.
    stopped_s, stopped_end_s = MOTION.time_points([600 + 600])
    assert stopped_s[:2] == pytest.approx(points_s[:2], rel=0.03)
    assert stopped_end_s - end_s == pytest.approx(0.1, rel=0.1)


@pytest.mark.parametrize(
    ("interval_ms", "problem"),
    [
        # One percent of an interval is 1 ms. If edges are lost, two or three intervals come together: their limit is
        # 2 ms or 3 ms.
        (100.0, ""), (100.9, ""), (99.1, ""), (101.1, "a late edge, or lost edges"), (98.9, "a spurious or early edge"),
        (200.0, "1 edges lost"), (201.9, "1 edges lost"), (198.1, "1 edges lost"),
        (202.1, "a late edge, or lost edges"),
        (300.0, "2 edges lost"), (302.9, "2 edges lost"), (303.1, "a late edge, or lost edges"),
        (250.0, "a late edge, or lost edges"), (50.0, "a spurious or early edge"),
    ],
)  # fmt: skip
def test_an_interval_is_that_of_the_speed_within_one_percent(interval_ms, problem):
    _, (first, second) = note_edges(interval_ms)
    assert first == ""
    if problem == "":
        assert second == ""
    else:
        assert second.startswith(problem)
        assert f"at point 1: {interval_ms:.2f} ms after the one before, not 100.00 ms" in second


def test_after_a_hold_is_commanded_only_shorter_intervals_are_wrong_before_the_end():
    """The time for which the stage rests is not known, so that a longer interval is judged at the end of the row."""
    check, _ = note_edges(100.0)
    check.note_hold()
    assert check.note_edge(BEGIN_NS + 900 * MS) == ""
    assert "spurious" in check.note_edge(BEGIN_NS + 950 * MS)


@pytest.mark.parametrize(
    ("asked_ms", "points", "is_spurious"),
    [(0, 1, False), (0, 0, True), (-1, 0, False), (100, 2, False), (100, 1, True)],
)
def test_more_edges_before_a_status_request_than_its_points_are_spurious(asked_ms, points, is_spurious):
    # Edges at 0, 100 and 200 ms.
    check, _ = note_edges(100.0, 100.0)
    problem = check.note_status(points, BEGIN_NS + asked_ms * MS, BEGIN_NS + 10_000 * MS)
    assert ("spurious" in problem) == is_spurious


@pytest.mark.parametrize(("written_ms", "is_late"), [(100, False), (81, False), (79, True)])
def test_an_edge_may_follow_the_status_that_counts_its_point_by_a_fifth_of_an_interval(written_ms, is_late):
    """The second edge is at 100 ms, and a status counts two points 20 ms before it, or earlier (`STATUS_TOLERANCE`)."""
    check, _ = note_edges(100.0, 100.0, 100.0)
    check.note_status(points=2, asked_ns=BEGIN_NS - 1, written_ns=BEGIN_NS + written_ms * MS)
    problem = check.judge(was_held=False, done_ns=BEGIN_NS + 1000 * MS)
    assert ("1 edges had come" in problem) == is_late
    assert (problem == "") != is_late


def test_a_row_that_ends_too_soon_after_its_last_edge_is_a_fault():
    """After its last edge the stage needs the time of its run-out, within one percent.

    The report of the end may come later, since it is sent again if it was lost.
    """
    points_s, end_s = MOTION.time_points([])
    run_out_ms = 1e3 * (end_s - points_s[-1])
    for share, is_wrong in ((1.0, False), (0.991, False), (0.989, True), (5.0, False)):
        check, _ = note_edges(100.0, 100.0, 100.0)
        problem = check.judge(was_held=False, done_ns=BEGIN_NS + round((300 + share * run_out_ms) * MS))
        assert ("a spurious or late edge" in problem) == is_wrong


@pytest.mark.parametrize(
    ("x", "points", "waits"),
    [
        # Points, counted from 0, are at x of 10,000, 10,400, 10,800 and 11,200. The stage rests between points 1 and 2.
        (10_600, 2, {2}),
        # It rests at a point: then the interval after that point is longer.
        (10_400, 2, {2}),
        (10_800, 2, {3}),
        # It rests outside the row, or at one of its two ends.
        (20_000, 2, set()),
        (10_000 - 600, 2, set()),
        (10_000 + 3 * 400 + 600, 4, set()),
    ],
)
def test_a_hold_lengthens_the_interval_in_which_the_stage_rests_and_no_other(x, points, waits):
    """`waits` are the points before which the stage may have waited. It waits 7 s in each interval in turn.

    The row is sound exactly if the wait is in an interval in which the stage rested.
    """
    for waiting_point in (1, 2, 3):
        check, _ = note_edges()
        check.note_hold()
        check.note_stop(x, points)
        stops = [MOTION.distance(x)] if waits else []
        points_s, end_s = MOTION.time_points(stops)
        wait_s = 7.0
        for point in (1, 2, 3):
            after_first_s = points_s[point] - points_s[0]
            if point >= waiting_point:
                after_first_s += wait_s
            check.note_edge(BEGIN_NS + round(after_first_s * 1e9))
        done_ns = BEGIN_NS + round((end_s - points_s[0] + wait_s) * 1e9)
        is_sound = check.judge(was_held=True, done_ns=done_ns) == ""
        assert is_sound == (waiting_point in waits)
