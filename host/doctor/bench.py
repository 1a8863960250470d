"""What the checks share: the rig file once it is read, the link to the Pi, what the cards and the capture told.

Clock, disk and kernel are passed in, so that every fault can be tried without having it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import zmq

from polysight.host.acquisition.pi_client import PiClient
from polysight.host.capture.survey import CardSurvey, survey_cards
from polysight.host.doctor.kernel import clock_is_synchronised, write_speed
from polysight.shared.config import Board, Instrument
from polysight.shared.messages import HelloReply

if TYPE_CHECKING:  # they load numpy and numba, which most checks do not need
    from polysight.host.calibration.direct_signal import DirectSignal
    from polysight.host.doctor.capture import Captured

BURSTS = 4


@dataclass(frozen=True)
class Wanted:
    """What the user asked for."""

    config: Path
    out: Path = Path()
    move: bool = False
    pulse: bool = True
    bursts: int = BURSTS


@dataclass(frozen=True)
class System:
    """What the checks ask of this machine."""

    wall_ns: Callable[[], int] = time.time_ns
    clock_is_synchronised: Callable[[], bool | None] = clock_is_synchronised
    write_speed: Callable[[Path], float] = write_speed
    root: Path = Path("/")


@dataclass
class Bench:
    """One run of the doctor. Use as a context manager.

    Attributes
    ----------
    given
        The rig, once `config` found it good. Checks that need it come after.
    hello, hello_at_ns
        What the Pi said of itself, and this machine's wall clock in the middle of asking.
    captured
        Frames of each board that was captured.
    signals
        What was found in them of the direct path.
    """

    wanted: Wanted
    system: System = System()
    given: Instrument | None = None
    hello: HelloReply | None = None
    hello_at_ns: int = 0
    hello_took_ns: int = 0
    sound: set[str] = field(default_factory=set)  # boards whose card can be used
    captured: dict[str, Captured] = field(default_factory=dict)
    signals: dict[str, DirectSignal] = field(default_factory=dict)
    _stack: ExitStack = field(default_factory=ExitStack)

    @property
    def rig(self) -> Instrument:
        """The rig. Raises RuntimeError before it was read: a check that needs it names `config` among its needs."""
        if self.given is None:
            raise RuntimeError("this check needs the rig file, and does not say so")
        return self.given

    @property
    def boards(self) -> tuple[Board, ...]:
        """Boards that are recorded."""
        return () if self.given is None else self.given.recorded

    @cached_property
    def pi(self) -> PiClient:
        """The link to the Pi, made when it is first needed. Raises ConfigError without keys it needs."""
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._stack.callback(context.destroy, linger=0)
        return self._stack.enter_context(PiClient(context, self.rig))

    @cached_property
    def surveys(self) -> dict[str, CardSurvey]:
        """Every card of the rig file, asked once, all at the same time."""
        return {survey.board.name: survey for survey in survey_cards(self.rig)}

    def __enter__(self) -> Bench:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._stack.close()
