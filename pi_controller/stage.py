"""The stage in millimetres: connects, sets it up, homes, runs rows, stops. And the same by hand, for bring-up."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from polysight.pi_controller.stage_link import (
    STATUS_PER_HEARTBEAT,
    StageLink,
    StageLost,
    StageLostError,
    StageNews,
    StageRefusedError,
)
from polysight.shared.config import Stage
from polysight.shared.errors import DeviceError, ProtocolError
from polysight.shared.faults import StageError, explain
from polysight.shared.raster import Row
from polysight.shared.stage_line import HOMING_TIMEOUT_S, Immediate, Parameter, Reply

IDLE_STATUS_S = 1.0
STOP_LIMIT_S = 3.0  # from STOP to standstill
CLEAR_RETRY_S = 0.05
MOST_MM = 1e6  # of a place on the wire
MOTION_LIMIT_S = HOMING_TIMEOUT_S  # no motion takes longer than homing


class StageDriver:
    """The stage of the [stage] table, used by one thread; `news` as of :class:`StageLink`."""

    def __init__(self, config: Stage, news: Callable[[StageNews], None]) -> None:
        self.config, self.port, self._news = config, config.port, news
        self._open: StageLink | None = None
        self.x_mm = self.y_mm = 0.0
        self.firmware = ""

    def connect(self) -> None:
        """Open the port, if it is not open and alive, and greet.

        Raises StageLostError when nobody answers, or the stage counts other steps than the rig file.
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
            )
        self.firmware = link.firmware
        link.ask_status_every(IDLE_STATUS_S)

    @property
    def link(self) -> StageLink:
        """The open link. Raises StageLostError when there is none."""
        if self._open is None:
            raise StageLostError(f"stage at {self.port} is not connected", "its port was lost", "polysight-pi home")
        return self._open

    def clear(self, stop: bool = False) -> None:
        """Clear a latched alarm, once the stage rests; with `stop`, stop it meanwhile.

        Raises StageRefusedError when its cause stays, or the position is not known.
        """
        deadline = time.monotonic() + STOP_LIMIT_S
        while True:
            try:
                self.link.request("CLEAR")
                return
            except StageRefusedError as e:
                if e.number != StageError.BUSY or time.monotonic() > deadline:
                    raise
            if stop:
                self.link.send_byte(Immediate.STOP)
            time.sleep(CLEAR_RETRY_S)  # it still moves: told to by a program before this one, or slowing down

    def home(self) -> int:
        """Stop, clear, set up, switch the motors on, start homing; returns the sequence number of its `done`."""
        try:
            self.clear(stop=True)
        except StageRefusedError as e:
            if e.number != StageError.NOT_HOMED:  # that is what homing is for
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
        """Start a row; returns the sequence number of its `done`."""
        return self._start("ROW", *row_in_steps(row, self.config, speed_mm_s))

    def move(self, x_mm: float, y_mm: float, speed_mm_s: float) -> int:
        """Start a move to a position; returns the sequence number of its `done`."""
        k = self.config.steps_per_mm
        return self._start("MOVE", round(x_mm * k), round(y_mm * k), round(speed_mm_s * k))

    def at_rest(self) -> None:
        """No motion any more: the status is asked for less often."""
        if self._open is not None:
            self._open.ask_status_every(IDLE_STATUS_S)

    def note_position(self, reply: Reply) -> None:
        """Take x and y out of a status or done reply, when they are there, and possible."""
        try:
            x_mm, y_mm = (reply.integer(axis) / self.config.steps_per_mm for axis in "xy")
        except ProtocolError:
            return
        if max(abs(x_mm), abs(y_mm)) <= MOST_MM:
            self.x_mm, self.y_mm = x_mm, y_mm

    def close(self) -> None:
        """Close the port."""
        if self._open is not None:
            link, self._open = self._open, None
            link.close()

    def _start(self, verb: str, *args: int) -> int:
        # The heartbeat begins before the motion does.
        self.link.ask_status_every(self.config.heartbeat_ms / 1e3 / STATUS_PER_HEARTBEAT)
        try:
            sequence = self.link.request(verb, *args).sequence
        except StageRefusedError:
            self.at_rest()
            raise
        return -1 if sequence is None else sequence


def row_in_steps(row: Row, stage: Stage, speed_mm_s: float) -> tuple[int, int, int, int, int]:
    """Arguments of the stage's ROW: first point, signed step, points, y (all in steps), speed in steps/s."""
    k = stage.steps_per_mm
    x0, y = (stage.centre_x_mm + row.x_start_mm) * k, (stage.centre_y_mm + row.y_mm) * k
    return round(x0), round(row.step_mm * k), row.points, round(y), round(speed_mm_s * k)


class Position(NamedTuple):
    """Where the stage is, stage millimetres."""

    x_mm: float
    y_mm: float


class BenchStage:
    """A connected stage driven by hand: every motion is waited for, SIGINT stops it.

    Every method returns the position; raises DeviceError, for example when not homed.
    """

    def __init__(self, driver: StageDriver, news: queue.SimpleQueue[StageNews]) -> None:
        self._driver, self._news = driver, news
        self.firmware = driver.firmware

    def home(self) -> Position:
        """Home."""
        return self._moved(self._driver.home())

    def jog(self, dx_mm: float, dy_mm: float, speed_mm_s: float) -> Position:
        """Move by (dx, dy)."""
        here = self.position()
        return self._moved(self._driver.move(here.x_mm + dx_mm, here.y_mm + dy_mm, speed_mm_s))

    def position(self) -> Position:
        """Ask where the stage is."""
        self._driver.link.send_byte(Immediate.STATUS)
        silent = StageLostError("the stage does not answer the status byte", "wrong firmware", "flash this release")
        return self._until(lambda reply: reply.kind == "status", 1.0, silent)

    def _moved(self, sequence: int) -> Position:
        late = StageLostError(f"the motion has not ended after {MOTION_LIMIT_S:.0f} s", "the motors stall", "look")
        try:
            return self._until(lambda r: r.kind == "done" and r.sequence == sequence, MOTION_LIMIT_S, late)
        except KeyboardInterrupt:
            self._driver.link.send_byte(Immediate.STOP)
            raise

    def _until(self, wanted: Callable[[Reply], bool], limit_s: float, late: StageLostError) -> Position:
        deadline = time.monotonic() + limit_s
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
        raise late


@contextmanager
def bench_stage(config: Stage) -> Iterator[BenchStage]:
    """A connected stage, closed at the end."""
    news: queue.SimpleQueue[StageNews] = queue.SimpleQueue()
    driver = StageDriver(config, news.put)
    try:
        driver.connect()
        yield BenchStage(driver, news)
    finally:
        driver.close()
