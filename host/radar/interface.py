"""The one interface to radars that start a frame at each SYNC_IN pulse.

A row uses it like this (docs/spec/row.md): `arm` before its cards record, `states` while it runs and at its end. A
backend says only what it knows. Over a control line that never answers a board stays `UNKNOWN`, and whether it was
armed shows by its data alone: an armed radar sends nothing before its first pulse, so no card can tell it from one that
is not.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import Enum
from types import TracebackType
from typing import NamedTuple


class RadarState(Enum):
    """What is known of one radar."""

    UNKNOWN = "nobody tells"
    ARMED = "waits for pulses, or makes frames"
    DONE = "has made all the frames it was armed for"
    FAULT = "has stopped by itself"


class BoardState(NamedTuple):
    """A radar's state, and what its backend can say about it."""

    state: RadarState
    detail: str = ""


class RadarControl(ABC):
    """The radars of a rig. A context manager; leaving it lets go of them."""

    @abstractmethod
    def arm(self, frames: int) -> None:
        """Make every board start a frame at each of the next `frames` pulses.

        What it proves when it returns is told by :meth:`states`: `ARMED` where the radar said so itself.

        Raises
        ------
        DeviceError
            when a board, or what controls it, does not do its part.
        """

    @abstractmethod
    def states(self) -> dict[str, BoardState]:
        """How each board is, by name, without waiting; boards of which nothing can be said may be left out."""

    def row_begins(self) -> None:  # noqa: B027 - not every backend tells waiting from running
        """Pulses may come from now on."""

    def wait_done(self, limit_s: float) -> list[str]:
        """After the row's last pulse: boards that do not say within the limit that all their frames ended."""
        del limit_s
        return []

    def report(self) -> dict[str, object]:
        """What the manifest keeps of the radars, since the last report; empty when there is nothing."""
        return {}

    def close(self) -> None:  # noqa: B027 - not every backend holds something
        """Let go of the radars. Twice is once."""

    def __enter__(self) -> RadarControl:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
