"""The stage in millimetres: connect, set up, home, run rows, stop. `BenchStage` is the blocking form for bring-up."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from typing import NamedTuple

from polysight_pi.stage_link import (
    STATUS_PER_HEARTBEAT,
    StageLink,
    StageLost,
    StageLostError,
    StageNews,
    StageRefusedError,
)
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DeviceError, ProtocolError
from polysight_shared.faults import StageError, explain
from polysight_shared.raster import Row, Stage
from polysight_shared.stage_line import HOMING_TIMEOUT_S, Immediate, Parameter, Reply

IDLE_STATUS_S = 1.0
STOP_TIMEOUT_S = 3.0  # from STOP to standstill
CLEAR_RETRY_S = 0.05
MAX_MM = 1e6  # limit of a position in the messages
MOTION_TIMEOUT_S = HOMING_TIMEOUT_S  # no motion takes longer than homing


class StageDriver:
    """The stage of the [stage] table, used by one thread; `news` as in :class:`StageLink`."""

    def __init__(self, config: Stage, news: Callable[[StageNews], None]) -> None:
        self.config, self.port, self._news = config, config.port, news
        self._open: StageLink | None = None
        self.x_mm = self.y_mm = 0.0
        self.firmware = ""

    def connect(self) -> None:
        """Open the port and greet the stage, unless the link is open already.

        Raises StageLostError if there is no answer, or if the stage's steps per mm differ from the rig file's.
        """
        if self._open is not None and not self._open.lost:
            return
        self.close()
        self._open = link = StageLink(self.port, self.config.baud, self._news, self.config.heartbeat_ms / 1e3)
        if link.steps_per_mm not in ("", f"{self.config.steps_per_mm:g}"):
            self.close()
            raise StageLostError(
                f"stage at {self.port} makes {link.steps_per_mm} steps per mm,"
                f" the rig file says {self.config.steps_per_mm:g}",
                "board.h of the sketch and stage.steps_per_mm in instrument.toml differ",
                "correct the wrong one",
                code=ErrorCode.MISMATCH,
            )
        self.firmware = link.firmware
        link.ask_status_every(IDLE_STATUS_S)

    @property
    def link(self) -> StageLink:
        """The open link. Raises StageLostError if there is none."""
        if self._open is None:
            raise StageLostError(f"stage at {self.port} is not connected", "its port was lost", "polysight-pi home")
        return self._open

    def clear(self, stop: bool = False) -> None:
        """Clear a latched alarm once the stage is at rest; with `stop`, send STOP until it is.

        Raises StageRefusedError if the cause of the alarm is still there, or the position is unknown.
        """
        deadline = time.monotonic() + STOP_TIMEOUT_S
        while True:
            try:
                self.link.request("CLEAR")
                return
            except StageRefusedError as e:
                if e.number != StageError.BUSY or time.monotonic() > deadline:
                    raise
            if stop:
                self.link.send_byte(Immediate.STOP)
            time.sleep(CLEAR_RETRY_S)  # still moving: started by an earlier program, or slowing down

    def home(self) -> int:
        """Stop, clear alarms, send the settings, switch the motors on and start homing.

        Returns the sequence number of its `done`.
        """
        try:
            self.clear(stop=True)
        except StageRefusedError as e:
            if e.number != StageError.NOT_HOMED:  # homing is the remedy
                raise
        c, k = self.config, self.config.steps_per_mm
        for parameter, value in (
            (Parameter.ACCEL, c.accel_mm_s2 * k),
            (Parameter.HEARTBEAT, c.heartbeat_ms),
            (Parameter.TRIGGER, c.trigger_width_us),
            (Parameter.TRAVEL_X, c.travel_x_mm * k),
            (Parameter.TRAVEL_Y, c.travel_y_mm * k),
            (Parameter.TRAVEL_SPEED, c.travel_speed_mm_s * k),
            (Parameter.BACKLASH, c.backlash_mm * k),
        ):
            self.link.request("SET", int(parameter), round(value))
        self.link.request("ENABLE", 1)
        return self._start("HOME")

    def row(self, row: Row, speed_mm_s: float) -> int:
        """Start a row; return the sequence number of its `done`."""
        return self._start("ROW", *row_in_steps(row, self.config, speed_mm_s))

    def move(self, x_mm: float, y_mm: float, speed_mm_s: float) -> int:
        """Start a move to a position; return the sequence number of its `done`."""
        k = self.config.steps_per_mm
        return self._start("MOVE", round(x_mm * k), round(y_mm * k), round(speed_mm_s * k))

    def at_rest(self) -> None:
        """Ask for the status less often: the stage does not move."""
        if self._open is not None:
            self._open.ask_status_every(IDLE_STATUS_S)

    def note_position(self, reply: Reply) -> None:
        """Store x and y of a status or done reply; a missing or impossible position is ignored."""
        try:
            x_mm, y_mm = (reply.integer(axis) / self.config.steps_per_mm for axis in "xy")
        except ProtocolError:
            return
        if max(abs(x_mm), abs(y_mm)) <= MAX_MM:
            self.x_mm, self.y_mm = x_mm, y_mm

    def close(self) -> None:
        """Close the port."""
        if self._open is not None:
            link, self._open = self._open, None
            link.close()

    def _start(self, verb: str, *args: int) -> int:
        # The heartbeat has to begin before the motion does.
        self.link.ask_status_every(self.config.heartbeat_ms / 1e3 / STATUS_PER_HEARTBEAT)
        try:
            sequence = self.link.request(verb, *args).sequence
        except StageRefusedError:
            self.at_rest()
            raise
        return -1 if sequence is None else sequence


def row_in_steps(row: Row, stage: Stage, speed_mm_s: float) -> tuple[int, int, int, int, int]:
    """Return the arguments of ROW: first point, signed step, points, y (all in steps), speed in steps/s."""
    k = stage.steps_per_mm
    x0, y = (stage.centre_x_mm + row.x_start_mm) * k, (stage.centre_y_mm + row.y_mm) * k
    return round(x0), round(row.step_mm * k), row.points, round(y), round(speed_mm_s * k)


class Position(NamedTuple):
    """Position of the stage, millimetres."""

    x_mm: float
    y_mm: float


class BenchStage:
    """The stage without the service: every method waits for the motion's end, and SIGINT stops the stage.

    A context manager that connects and closes the port. Methods raise DeviceError, for example when not homed.
    """

    def __init__(self, config: Stage) -> None:
        self._news: queue.SimpleQueue[StageNews] = queue.SimpleQueue()
        self._driver = StageDriver(config, self._news.put)

    def __enter__(self) -> BenchStage:
        self._driver.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self._driver.close()

    @property
    def firmware(self) -> str:
        """Release of the sketch."""
        return self._driver.firmware

    def home(self) -> Position:
        """Home the stage; return its position."""
        return self._finish(self._driver.home())

    def jog(self, dx_mm: float, dy_mm: float, speed_mm_s: float) -> Position:
        """Move by (dx, dy); return the new position."""
        here = self.position()
        return self._finish(self._driver.move(here.x_mm + dx_mm, here.y_mm + dy_mm, speed_mm_s))

    def position(self) -> Position:
        """Ask the stage for its position."""
        self._driver.link.send_byte(Immediate.STATUS)
        silent = StageLostError("the stage does not answer the status byte", "wrong firmware", "flash this release")
        return self._wait(lambda reply: reply.kind == "status", 1.0, silent)

    def _finish(self, sequence: int) -> Position:
        late = StageLostError(f"the motion has not ended after {MOTION_TIMEOUT_S:.0f} s", "the motors stall", "look")
        try:
            return self._wait(lambda r: r.kind == "done" and r.sequence == sequence, MOTION_TIMEOUT_S, late)
        except KeyboardInterrupt:
            self._driver.link.send_byte(Immediate.STOP)
            raise

    def _wait(self, wanted: Callable[[Reply], bool], timeout_s: float, timeout: StageLostError) -> Position:
        deadline = time.monotonic() + timeout_s
        while (left := deadline - time.monotonic()) > 0:
            try:
                news = self._news.get(timeout=left)
            except queue.Empty:
                break
            if isinstance(news, StageLost):
                raise StageLostError(news.reason, "cable unplugged", "check the USB cable")
            if news.kind == "alarm":
                e = explain(news.number)
                raise DeviceError(f"stage alarm {news.number}: {e.what}", e.why, e.remedy)
            self._driver.note_position(news)
            if wanted(news):
                return Position(self._driver.x_mm, self._driver.y_mm)
        raise timeout
