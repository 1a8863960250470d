"""Home and jog of the stage from the web page: the Pi decides if the stage may move.

The commands run in the web server's process, each in a thread of its own, and therefore a request to stop never waits
for requests that read scans. If the web server ends during a jog, the Pi stops the stage. While a scan runs, the Pi
refuses these commands.
"""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import msgspec
import zmq

from polysight.acquisition import PiClient
from polysight.serve.commands import Body
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.errors import ErrorCode, ScanError
from polysight_shared.messages import MAX_JOG_MM, Axis


class JogRequest(Body, frozen=True):
    """Move one axis by a distance, at the rig file's speed of a row."""

    axis: Axis
    distance_mm: Annotated[float, msgspec.Meta(ge=-MAX_JOG_MM, le=MAX_JOG_MM)]


class StagePlace(msgspec.Struct, frozen=True):
    """Position of the stage; its limits are 0 and `travel_x_mm`, `travel_y_mm`.

    `state`, the running scan `scan_id`, and the `reason` of the state come from the Pi.
    """

    state: str
    homed: bool
    scan_id: str
    reason: str
    x_mm: float
    y_mm: float
    travel_x_mm: float
    travel_y_mm: float


class StageControl:
    """The stage of a rig file, for the page."""

    def __init__(self, config: Path) -> None:
        self._config = config
        # The Pi knows by this text whose jog it is, and lets only this client stop it. All browsers of one server share
        # the text, so that each can stop the jog of another.
        self._owner = secrets.token_hex(16)
        self._jogging = threading.Lock()

    def read_position(self) -> StagePlace:
        """Return the position of the stage. Raises PolysightError, as the other commands do."""
        return self._run_on_pi(lambda _pi, _rig: None)

    def home(self) -> StagePlace:
        """Start homing."""
        return self._run_on_pi(lambda pi, _: pi.home())

    def stop(self) -> StagePlace:
        """Stop homing or a jog."""
        return self._run_on_pi(lambda pi, _: pi.abort("stopped on the page"))

    def jog(self, request: JogRequest) -> StagePlace:
        """Move, and wait for the end. Refused while another jog of this server moves."""
        if not self._jogging.acquire(blocking=False):
            raise ScanError(
                "the stage is already moving",
                "another jog has not ended",
                "wait for it, or stop it",
                code=ErrorCode.BUSY,
            )
        try:
            return self._run_on_pi(lambda pi, rig: pi.jog(request.axis, request.distance_mm, rig.stage.speed_mm_s))
        finally:
            self._jogging.release()

    def _run_on_pi(self, work: Callable[[PiClient, Instrument], object]) -> StagePlace:
        """Execute `work` with a connection to the Pi, and return the position of the stage after it."""
        rig = load_instrument(self._config)
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        try:
            with PiClient(context, rig, self._owner) as pi:
                work(pi, rig)
                status = pi.status()
        finally:
            context.destroy(linger=0)
        return StagePlace(
            state=status.state,
            homed=status.homed,
            scan_id=status.scan_id,
            reason=status.reason,
            x_mm=status.x_mm,
            y_mm=status.y_mm,
            travel_x_mm=rig.stage.travel_x_mm,
            travel_y_mm=rig.stage.travel_y_mm,
        )
