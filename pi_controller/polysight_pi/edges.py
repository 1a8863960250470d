"""Judges the times of a row's trigger edges: a lost and a spurious edge keep the count, but not the intervals.

At constant speed each interval is the step divided by the speed. A hold slows the stage down with the acceleration of
[stage], lets it wait, and speeds it up again, so its intervals are known but for the place of the stop and the wait.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from polysight_shared.raster import Row, Stage

# Of the interval at constant speed. The resonator of an UNO is within 0.5 % of its frequency.
TOLERANCE = 0.01
# Of the search for the place of a stop and the lowest speed: a grid, then a finer one around its best point.
LEVELS = 7
PLACES = 64
SPEEDS = 16


class EdgeTimes:
    """The edges of one row. `holds`: number of holds commanded so far."""

    def __init__(self, row: Row, stage: Stage, speed_mm_s: float) -> None:
        self._step_mm = abs(row.step_mm)
        self._speed_mm_s = round(speed_mm_s * stage.steps_per_mm) / stage.steps_per_mm
        self._accel_mm_s2 = stage.accel_mm_s2
        self._nominal_s = self._step_mm / self._speed_mm_s
        self._edges_ns: list[int] = []
        self._counts = (0, 0)  # edges at the status before the last one, and at the last one
        self.holds = 0

    def note(self, edge_ns: int) -> str:
        """Add an edge; return what is wrong with it, or ""."""
        self._edges_ns.append(edge_ns)
        if len(self._edges_ns) < 2:
            return ""
        interval_s = (edge_ns - self._edges_ns[-2]) * 1e-9
        ratio = interval_s / self._nominal_s
        if ratio < 1 - TOLERANCE:
            kind = "a spurious or early edge"
        elif ratio <= 1 + TOLERANCE or self.holds:
            return ""
        elif abs(ratio - round(ratio)) <= TOLERANCE * ratio:
            kind = f"{round(ratio) - 1} edges lost"
        else:
            kind = "a late edge, or lost ones beside a spurious one"
        return f"{kind} at point {len(self._edges_ns) - 1}: {self._compare(interval_s)}"

    def note_status(self, points: int) -> str:
        """Compare the stage's points with the edges of two statuses ago; return what is wrong, or ""."""
        before, last = self._counts
        self._counts = (last, len(self._edges_ns))
        return f"a spurious edge: {before} edges came and later {points} points were passed" if before > points else ""

    def judge_holds(self) -> str:
        """Judge the intervals of a whole row that was held; return what is wrong, or ""."""
        intervals_s = [(b - a) * 1e-9 for a, b in pairwise(self._edges_ns)]
        longest_s = self._nominal_s * (1 + TOLERANCE)
        stretched = [i for i, interval_s in enumerate(intervals_s) if interval_s > longest_s]
        stops = self._group(stretched)
        if len(stops) > self.holds:
            return f"late or lost edges at points {[first + 1 for first, _ in stops]}, {self.holds} holds"
        for first, last in stops:
            # One more interval on either side: the slowing down may begin or end in it.
            begin = max(0, first - 1)
            if not self._is_hold(intervals_s[begin : last + 2]):
                return f"late or lost edges at points {first + 1} to {last + 1}, not those of a hold"
        return ""

    def _group(self, stretched: Sequence[int]) -> list[tuple[int, int]]:
        """Return the first and last interval of each stop: intervals that one stop can touch belong together."""
        reach = math.ceil(self._speed_mm_s**2 / self._accel_mm_s2 / self._step_mm) + 1
        stops: list[tuple[int, int]] = []
        for i in stretched:
            if stops and i - stops[-1][0] <= reach:
                stops[-1] = (stops[-1][0], i)
            else:
                stops.append((i, i))
        return stops

    def _is_hold(self, intervals_s: Sequence[float]) -> bool:
        """True if a hold somewhere among these intervals, or beside them, explains each of them.

        Searches the place of the slowest moment and its speed (0 unless the motion was resumed before the stop).
        """
        margin_mm = self._speed_mm_s**2 / (2 * self._accel_mm_s2)
        length_mm = len(intervals_s) * self._step_mm
        for slowest_mm_s in (0.0, self._speed_mm_s / 2):
            middle_mm = length_mm / 2
            width_mm = length_mm + 2 * margin_mm
            width_mm_s = 2 * slowest_mm_s
            for _ in range(LEVELS):
                speeds = [0.0]
                if width_mm_s:
                    speeds = [slowest_mm_s + width_mm_s * (k / SPEEDS - 0.5) for k in range(SPEEDS + 1)]
                    speeds = [min(max(speed, 0.0), 0.999 * self._speed_mm_s) for speed in speeds]
                places = [middle_mm + width_mm * (k / PLACES - 0.5) for k in range(PLACES + 1)]
                error, middle_mm, slowest_mm_s = min(
                    (self._misfit(intervals_s, place, speed), place, speed) for place in places for speed in speeds
                )
                if error <= TOLERANCE:
                    return True
                width_mm /= PLACES / 16
                width_mm_s /= SPEEDS / 6
        return False

    def _misfit(self, intervals_s: Sequence[float], stop_mm: float, slowest_mm_s: float) -> float:
        """Return the largest deviation, relative to the interval at constant speed."""
        worst = 0.0
        for i, interval_s in enumerate(intervals_s):
            before_mm = stop_mm - i * self._step_mm
            after_mm = before_mm - self._step_mm
            expected_s = abs(self._time_s(abs(before_mm), slowest_mm_s) - self._time_s(abs(after_mm), slowest_mm_s))
            holds_stop = before_mm >= 0 >= after_mm
            if holds_stop:
                expected_s = self._time_s(before_mm, slowest_mm_s) + self._time_s(-after_mm, slowest_mm_s)
            error_s = interval_s - expected_s
            if holds_stop and slowest_mm_s == 0:
                error_s = min(error_s, 0.0)  # it waits there
            worst = max(worst, abs(error_s) / max(self._nominal_s, expected_s))
        return worst

    def _time_s(self, distance_mm: float, slowest_mm_s: float) -> float:
        """Return the time from the slowest moment to this distance from it."""
        accel = self._accel_mm_s2
        ramp_mm = (self._speed_mm_s**2 - slowest_mm_s**2) / (2 * accel)
        on_ramp_mm = min(distance_mm, ramp_mm)
        on_ramp_s = (math.sqrt(slowest_mm_s**2 + 2 * accel * on_ramp_mm) - slowest_mm_s) / accel
        return on_ramp_s + (distance_mm - on_ramp_mm) / self._speed_mm_s

    def _compare(self, interval_s: float) -> str:
        return f"{interval_s * 1e3:.2f} ms after the one before, {self._nominal_s * 1e3:.2f} ms at this speed"
