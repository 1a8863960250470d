"""Interface of the backends to radars that start a frame at each SYNC_IN pulse.

Each row calls `arm` before its cards record, and `states` during the row and at its end (docs/spec/row.md). A backend
reports only what it knows: a board behind a control line without replies stays `UNKNOWN`, and only its data shows that
it was armed, because an armed radar sends nothing before its first pulse.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import Enum
from types import TracebackType
from typing import NamedTuple


class RadarState(Enum):
    """Known state of one radar."""

    UNKNOWN = "not reported"
    ARMED = "waits for pulses, or sends frames"
    DONE = "all its frames have ended"
    FAULT = "has stopped with a fault"


class BoardState(NamedTuple):
    """A radar's state with a description."""

    state: RadarState
    detail: str = ""


class RadarControl(ABC):
    """The radars of a rig; a context manager that closes the connections."""

    @abstractmethod
    def arm(self, frames: int) -> None:
        """Arm every board for a frame at each of the next `frames` pulses.

        Afterwards `states` returns `ARMED` for boards that confirmed it. Raises DeviceError if a board or its control
        server fails.
        """

    @abstractmethod
    def states(self) -> dict[str, BoardState]:
        """Return the states by board name, without waiting; boards without any information may be missing."""

    def row_begins(self) -> None:  # noqa: B027 - optional
        """Note that pulses may come from now on."""

    def wait_done(self, timeout_s: float) -> list[str]:
        """Wait after the row's last pulse; return the boards whose frames did not end within the timeout, seconds."""
        del timeout_s
        return []

    def report(self) -> dict[str, object]:
        """Return the radars' report for the manifest since the last call; empty if there is none."""
        return {}

    def close(self) -> None:  # noqa: B027 - optional
        """Close the connections; may be called twice."""

    def __enter__(self) -> RadarControl:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
