"""What is watched while a row runs: limits of waiting, the host, the stage, the trigger wire.

All time is given: seconds of one monotonic clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable

HOST_MISSES = 4  # heartbeats of the host that may fail to come
SILENT_STATUSES = 2  # statuses of the stage without an edge between them
SILENT_POINTS = 2  # ... in which it passed so many points
RESTS = 3  # statuses at rest after which a `done` counts as lost


class Limit:
    """The one thing that is waited for, and what happens when it does not come."""

    def __init__(self) -> None:
        self._at_s = math.inf
        self._expired: Callable[[], None] | None = None

    def set(self, at_s: float, expired: Callable[[], None]) -> None:
        """Call `expired` at `at_s`, in place of what was waited for before."""
        self._at_s, self._expired = at_s, expired

    def clear(self) -> None:
        """Nothing is waited for."""
        self._at_s, self._expired = math.inf, None

    @property
    def at_s(self) -> float:
        """When; infinity when nothing is waited for."""
        return self._at_s

    def check(self, now_s: float) -> None:
        """Act when the time has come."""
        if now_s >= self._at_s and self._expired is not None:
            expired = self._expired
            self.clear()
            expired()


class HostWatch:
    """The host of the run: how often it promised to be heard, and when it was. `heard` may come from any thread."""

    def __init__(self) -> None:
        self._limit_s, self._heard_s = math.inf, 0.0

    def promise(self, heartbeat_ms: int, now_s: float) -> None:
        """A run begins; 0: the host promises nothing and is not watched."""
        self._limit_s = HOST_MISSES * heartbeat_ms / 1e3 if heartbeat_ms else math.inf
        self._heard_s = now_s

    def heard(self, now_s: float) -> None:
        """The host lives."""
        self._heard_s = max(self._heard_s, now_s)

    def lives(self, now_s: float) -> bool:
        """Whether it has kept its promise until now; False for one that promised nothing."""
        return self._limit_s < math.inf and now_s < self.lost_at_s

    @property
    def lost_at_s(self) -> float:
        """When it counts as lost, unless it is heard before."""
        return self._heard_s + self._limit_s

    @property
    def limit_s(self) -> float:
        """How long it may be silent."""
        return self._limit_s


class StatusWatch:
    """When to ask the stage for its status, and when it has been silent for too long."""

    def __init__(self, silence_s: float, now_s: float) -> None:
        self._silence_s, self._asked_s = silence_s, now_s
        self._unanswered_since_s: float | None = None
        self.interval_s = 0.0  # 0: it is not asked

    def is_due(self, now_s: float) -> bool:
        """Whether to ask now."""
        if not self.interval_s or now_s - self._asked_s < self.interval_s:
            return False
        self._asked_s = now_s
        if self._unanswered_since_s is None:
            self._unanswered_since_s = now_s
        return True

    def heard(self) -> None:
        """The stage has said something."""
        self._unanswered_since_s = None

    def silent_s(self, now_s: float) -> float:
        """For how long it has been silent; 0 as long as that is no longer than allowed."""
        if self._unanswered_since_s is None or now_s - self._unanswered_since_s <= self._silence_s:
            return 0.0
        return now_s - self._unanswered_since_s


class TriggerWatch:
    """Notices a stage that passes points of which no edge arrives: the trigger wire is off."""

    def __init__(self) -> None:
        self._edges, self._points, self._statuses = -1, 0, 0

    def is_silent(self, points: int, edges: int) -> bool:
        """With each status: points passed by the stage, edges seen. Whether the wire is silent."""
        if edges != self._edges:
            self._edges, self._points, self._statuses = edges, points, 0
            return False
        self._points = min(self._points, points)  # the stage counts anew in each row
        self._statuses += 1
        missing = points - max(edges, self._points)
        return self._statuses >= SILENT_STATUSES and missing >= SILENT_POINTS


class RestWatch:
    """Notices a stage that rests though a motion has not been told to have ended."""

    def __init__(self) -> None:
        self._rests = 0

    def is_overdue(self, waits: bool, rests: bool) -> bool:
        """With each status. True every third time in a row."""
        self._rests = self._rests + 1 if waits and rests else 0
        if self._rests < RESTS:
            return False
        self._rests = 0
        return True
