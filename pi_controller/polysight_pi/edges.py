"""Check the trigger edges of a row: a lost edge and a spurious one keep the count right; only their times show them.

The edges are compared with three reports of the stage:

* the row's motion: at constant speed each interval is step / speed. A hold slows the stage down to the place that its
  status names, and from there it speeds up again, so those intervals are known too, except for the time at rest;
* the number of points in each status: at most as many edges before the status was requested, and at least as many by
  the time when it was written;
* the end: after the last point the stage runs on and slows down, so its `done` follows after a known time.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from itertools import pairwise
from typing import NamedTuple

from polysight_shared.raster import Row, Stage

# Lowest speed of the stage's firmware, steps/s (arduino_stage/board.h, MIN_RATE).
MIN_FEED = 31
# Clock of the step timer in the stage's firmware (board.h, TICK_HZ).
TICK_HZ = 2_000_000
# Relative tolerance of the interval at constant speed: twice the 0.5 % by which the resonator of an UNO may be off.
TOLERANCE = 0.01
# Share of the same interval by which an edge may be stamped after a status that counts its point was written (chosen):
# a simulated trigger wire is later than a simulated serial line.
STATUS_TOLERANCE = 0.2


class RowMotion(NamedTuple):
    """A row as it is sent to the stage, and the motion that follows (docs/spec/stage-line.md, "A row").

    Lengths are in motor steps: `x_start` and `y` of the first point, in stage coordinates; `step` from point to point,
    below zero towards -x; `backlash`, the play that the run-up takes up. `feed` is the speed at the points in steps/s,
    `accel` the acceleration in steps/s^2, `points` the number of trigger points.
    """

    x_start: int
    step: int
    points: int
    y: int
    feed: int
    accel: int
    backlash: int

    @staticmethod
    def plan(row: Row, stage: Stage, speed_mm_s: float) -> RowMotion:
        """Return the motion of a row of the plan on this stage, at `speed_mm_s`."""
        k = stage.steps_per_mm
        return RowMotion(
            x_start=round((stage.centre_x_mm + row.x_start_mm) * k),
            step=round(row.step_mm * k),
            points=row.points,
            y=round((stage.centre_y_mm + row.y_mm) * k),
            feed=round(speed_mm_s * k),
            accel=round(stage.accel_mm_s2 * k),
            backlash=round(stage.backlash_mm * k),
        )

    @property
    def line(self) -> tuple[int, int, int, int, int]:
        """Arguments of the stage command ROW."""
        return self.x_start, self.step, self.points, self.y, self.feed

    @property
    def direction(self) -> int:
        """+1 towards larger x, else -1."""
        return int(math.copysign(1, self.step))

    @property
    def ramp(self) -> int:
        """Steps from rest to full speed, v^2 / 2a rounded up; 0 for a speed that needs no ramp."""
        if self.feed <= slowest_feed(self.accel):
            return 0
        return -(-(self.feed**2) // (2 * self.accel))

    @property
    def run_up(self) -> int:
        """Steps from rest to the first point, and from the last one to rest: the ramp and a stretch at full speed."""
        return self.ramp + max(abs(self.step), self.backlash)

    @property
    def length(self) -> int:
        """Steps from rest to rest."""
        return (self.points - 1) * abs(self.step) + 2 * self.run_up

    @property
    def end(self) -> tuple[int, int]:
        """X and y where the stage rests after the row."""
        return self.x_start + (self.points - 1) * self.step + self.direction * self.run_up, self.y

    def distance(self, x: int) -> int:
        """Return the steps from the beginning of the row to `x`, a stage coordinate in steps."""
        return self.direction * (x - self.x_start) + self.run_up

    def time_points(self, stops: list[int]) -> tuple[list[float], float]:
        """Return the time of each point and that of the row's end, seconds, if the stage rests at the `stops`.

        `stops` are steps from the beginning of the row, ascending. The time at rest is not included, because no one
        knows it: an interval in which a stop lies is a lower limit.
        """
        # Steps from the beginning of the row to each point.
        distances = [self.run_up + point * abs(self.step) for point in range(self.points)]
        times: list[float] = []
        begin_s = 0.0
        for begin, end in pairwise([0, *stops, self.length]):
            leg = _Leg.plan(end - begin, self)
            # The points of this leg are the first ones that have no time yet.
            while len(times) < self.points and distances[len(times)] <= end:
                times.append(begin_s + leg.time_s(distances[len(times)] - begin))
            begin_s += leg.time_s(end - begin)
        return times, begin_s


class _Leg(NamedTuple):
    """A motion from rest to rest, in the arithmetic of the sketch (motion_step.h)."""

    # Steps from rest to rest.
    distance: int
    # Time from rest until each number of steps is made while the stage speeds up, seconds; the first is 0.
    up_s: list[float]
    # Duration of a step at constant speed, seconds.
    cruise_s: float
    # Time from full speed until each number of steps is made while the stage slows down, seconds; the first is 0.
    down_s: list[float]

    @staticmethod
    def plan(distance: int, motion: RowMotion) -> _Leg:
        """Return the leg over `distance` steps with speed and acceleration of `motion`.

        On a leg that is too short for full speed, the stage speeds up over half of the distance and slows down over the
        other half.
        """
        ramp = min(motion.ramp, distance // 2)
        slowest = slowest_feed(motion.accel)
        speed = slowest
        step_s = 0.0
        up_s = [0.0]
        for _ in range(ramp):
            speed = min(speed + motion.accel * step_s, motion.feed)
            step_s = _step_s(speed)
            up_s.append(up_s[-1] + step_s)
        cruise_s = step_s
        if ramp == motion.ramp:
            speed = motion.feed
            cruise_s = 1 / motion.feed
        step_s = cruise_s
        down_s = [0.0]
        for _ in range(ramp):
            speed = max(speed - motion.accel * step_s, slowest)
            step_s = _step_s(speed)
            down_s.append(down_s[-1] + step_s)
        return _Leg(distance, up_s, cruise_s, down_s)

    def time_s(self, steps: int) -> float:
        """Return the time from rest until `steps` steps are made, seconds."""
        ramp = len(self.up_s) - 1
        if steps <= ramp:
            return self.up_s[steps]
        # The steps after the ramp are made at constant speed, and the last ones while the stage slows down.
        cruised = min(steps, self.distance - ramp) - ramp
        slowed = steps - ramp - cruised
        return self.up_s[ramp] + cruised * self.cruise_s + self.down_s[slowed]


def _step_s(speed: float) -> float:
    """Return the duration in seconds of a step at `speed` steps/s on a ramp: whole ticks of the timer."""
    return TICK_HZ // int(speed) / TICK_HZ


def slowest_feed(accel: int) -> int:
    """Return the speed with which the stage starts and stops, steps/s: its first step takes sqrt(2 / accel) seconds."""
    return max(math.isqrt(accel // 2), MIN_FEED)


class EdgeTimes:
    """The edges of one row, compared with the stage's reports.

    Times of edges and statuses are on one clock, nanoseconds. `points` is the stage's count of passed points.
    """

    def __init__(self, motion: RowMotion) -> None:
        self._motion = motion
        self._interval_s = abs(motion.step) / motion.feed
        self._edges_ns: list[int] = []
        # Number of points of each status, and the latest time at which it was written.
        self._statuses: list[tuple[int, int]] = []
        # Distances at which the stage rested in a hold.
        self._stops: list[int] = []
        # Distances of holds before the first point: in the row, or in the travel to it.
        self._early_stops: list[int] = []
        self._is_held = False

    def note_hold(self) -> None:
        """Note that a hold is commanded: from now on intervals may be longer; `judge` checks them at the row's end."""
        self._is_held = True

    def note_stop(self, x: int, points: int) -> None:
        """Note that the stage rests at `x` (steps) in a hold, after this many points."""
        distance = self._motion.distance(x)
        stops = self._stops if points else self._early_stops
        if 0 < distance < self._motion.length and distance not in stops:
            stops.append(distance)

    def note_edge(self, edge_ns: int) -> str:
        """Add an edge; return its problem, or ""."""
        self._edges_ns.append(edge_ns)
        if len(self._edges_ns) < 2:
            return ""
        interval_s = (edge_ns - self._edges_ns[-2]) * 1e-9
        if self._is_held and interval_s > self._interval_s:
            return ""
        return self._compare(len(self._edges_ns) - 1, interval_s, self._interval_s)

    def note_status(self, points: int, asked_ns: int, written_ns: int) -> str:
        """Compare a status with the edges: it was requested after `asked_ns` and written by `written_ns`.

        Return what is wrong, or "".
        """
        self._statuses.append((points, written_ns))
        edges = bisect_right(self._edges_ns, asked_ns)
        if edges <= points:
            return ""
        return f"a spurious edge: {edges} edges came before {points} points were passed"

    def judge(self, was_held: bool, done_ns: int) -> str:
        """Judge a row whose counts are right, with its `done` written by `done_ns`; return the problem, or "".

        `was_held`: the stage says in its `done` that it was held.
        """
        for points, written_ns in self._statuses:
            latest_ns = written_ns + round(STATUS_TOLERANCE * self._interval_s * 1e9)
            edges = bisect_right(self._edges_ns, latest_ns)
            if edges < points:
                return f"a lost or late edge: {points} points were passed when {edges} edges had come"
        if not was_held:
            return self._judge_motion([], done_ns)
        stops = sorted(self._stops)
        # A hold before the first point was either in the travel to the row, without effect on the row's motion, or in
        # the run-up. Its report does not say which, so the edges may agree with either.
        fault = self._judge_motion(stops, done_ns)
        if fault and self._early_stops:
            fault = self._judge_motion(sorted(self._early_stops) + stops, done_ns)
        return fault

    def _judge_motion(self, stops: list[int], done_ns: int) -> str:
        """Compare all intervals with a motion that rests at these distances; return the problem, or ""."""
        points_s, end_s = self._motion.time_points(stops)
        for point in range(1, self._motion.points):
            interval_s = (self._edges_ns[point] - self._edges_ns[point - 1]) * 1e-9
            steps_from_start = self._motion.run_up + point * abs(self._motion.step)
            steps_before = steps_from_start - abs(self._motion.step)
            # The stage rested in this interval, for an unknown time: its duration is a lower limit.
            waited = any(steps_before <= stop < steps_from_start for stop in stops)
            expected_s = points_s[point] - points_s[point - 1]
            if waited and interval_s > expected_s:
                continue
            fault = self._compare(point, interval_s, expected_s)
            if fault:
                return fault
        run_out_s = (done_ns - self._edges_ns[-1]) * 1e-9
        expected_s = end_s - points_s[-1]
        if run_out_s < (1 - TOLERANCE) * expected_s:
            return (
                f"a spurious or late edge: the row ended {run_out_s * 1e3:.1f} ms after the last edge, "
                f"from the last point it takes {expected_s * 1e3:.1f} ms"
            )
        return ""

    def _compare(self, point: int, interval_s: float, expected_s: float) -> str:
        """Compare the interval before the edge of `point` with the expected one; return the problem, or ""."""
        tolerance_s = TOLERANCE * max(self._interval_s, expected_s)
        late_s = interval_s - expected_s
        lost_edges = round(late_s / self._interval_s)
        if abs(late_s) <= tolerance_s:
            return ""
        if late_s < 0:
            kind = "a spurious or early edge"
        # Edges are lost if the interval is as long as several together, each with its tolerance.
        elif lost_edges and abs(late_s - lost_edges * self._interval_s) <= (lost_edges + 1) * tolerance_s:
            kind = f"{lost_edges} edges lost"
        else:
            kind = "a late edge, or lost edges and a spurious one"
        return f"{kind} at point {point}: {interval_s * 1e3:.2f} ms after the one before, not {expected_s * 1e3:.2f} ms"
