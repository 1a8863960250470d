"""The stage in millimetres: connects, sets it up, homes, runs rows, stops. And the same by hand, for bring-up."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from polysight.pi_controller.rows import StageRow
from polysight.pi_controller.stage_link import StageLink, StageLost, StageLostError, StageNews, StageRefusedError
from polysight.shared.config import Stage
from polysight.shared.errors import DeviceError, ProtocolError
from polysight.shared.faults import StageError, explain
from polysight.shared.stage_line import HOMING_LIMIT_S, Immediate, Parameter, Reply

IDLE_STATUS_S = 1.0
STATUS_PER_HEARTBEAT = 4  # while moving
STOP_LIMIT_S = 3.0  # from STOP to standstill
ASK_AGAIN_S = 0.05
# A status unanswered for so much of a heartbeat: the stage is lost. With the time to the next question and a look at
# the port, a stage that falls silent is noticed before its own heartbeat stops it.
SILENT_HEARTBEATS = 0.5
MOST_MM = 1e6  # of a place on the wire
MOTION_LIMIT_S = HOMING_LIMIT_S  # no motion takes longer than homing


def read_slice_s(heartbeat_s: float) -> float:
    """How often the link looks whether a status is due, or overdue."""
    return min(0.05, heartbeat_s / STATUS_PER_HEARTBEAT / 2)


class StageDriver:
    """One stage, used by one thread.

    Parameters
    ----------
    config, port
        The [stage] table; serial device.
    news
        Takes what the stage tells by itself, from the link's thread.
    """

    def __init__(self, config: Stage, port: str, news: Callable[[StageNews], None]) -> None:
        self.config, self.port = config, port
        self._news = news
        self._link: StageLink | None = None
        self.x_mm = self.y_mm = 0.0
        self.firmware = ""

    def connect(self) -> None:
        """Open the port, if it is not open and alive, and greet.

        Raises StageLostError when nobody answers, or the stage counts other steps than the rig file.
        """
        if self._link is not None and not self._link.lost:
            return
        self.close()
        heartbeat_s = self.config.heartbeat_ms / 1e3
        silence_s, slice_s = SILENT_HEARTBEATS * heartbeat_s, read_slice_s(heartbeat_s)
        self._link = link = StageLink(self.port, self.config.baud, self._news, silence_s, slice_s)
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

    def clear(self, stop: bool = False) -> None:
        """Clear a latched alarm, once the stage rests; with `stop`, stop it meanwhile.

        Raises StageRefusedError when its cause stays, or the position is not known.
        """
        deadline = time.monotonic() + STOP_LIMIT_S
        while True:
            try:
                self._alive().request("CLEAR")
                return
            except StageRefusedError as e:
                if e.number != StageError.BUSY or time.monotonic() > deadline:
                    raise
            if stop:
                self.send(Immediate.STOP)
            time.sleep(ASK_AGAIN_S)  # it still moves: told to by a program before this one, or slowing down

    def home(self) -> int:
        """Stop, clear, set up, switch the motors on, start homing; returns the sequence number of its `done`."""
        try:
            self.clear(stop=True)
        except StageRefusedError as e:
            if e.number != StageError.NOT_HOMED:  # that is what homing is for
                raise
        c = self.config
        for parameter, value in (
            (Parameter.ACCEL, c.accel_mm_s2 * c.steps_per_mm),
            (Parameter.HEARTBEAT, c.heartbeat_ms),
            (Parameter.TRIGGER, c.trigger_width_us),
            (Parameter.TRAVEL_X, c.travel_x_mm * c.steps_per_mm),
            (Parameter.TRAVEL_Y, c.travel_y_mm * c.steps_per_mm),
            (Parameter.TRAVEL_SPEED, c.travel_speed_mm_s * c.steps_per_mm),
            (Parameter.BACKLASH, c.backlash_mm * c.steps_per_mm),
        ):
            self._alive().request("SET", int(parameter), round(value))
        self._alive().request("ENABLE", 1)
        return self._start("HOME")

    def row(self, row: StageRow) -> int:
        """Start a row; returns the sequence number of its `done`."""
        return self._start("ROW", *row)

    def move(self, x_mm: float, y_mm: float, speed_mm_s: float) -> int:
        """Start a move to a position; returns the sequence number of its `done`."""
        k = self.config.steps_per_mm
        return self._start("MOVE", round(x_mm * k), round(y_mm * k), round(speed_mm_s * k))

    def send(self, byte: Immediate) -> None:
        """Send an immediate byte. Raises StageLostError."""
        self._alive().send_byte(byte)

    def ask_how_it_ended(self) -> None:
        """The stage rests, and its `done` or alarm did not arrive: have it repeated. Raises StageLostError."""
        self._alive().repeat()

    def at_rest(self) -> None:
        """No motion any more: the status is asked for less often."""
        if self._link is not None:
            self._link.ask_status_every(IDLE_STATUS_S)

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
        if self._link is not None:
            link, self._link = self._link, None
            link.close()

    def _start(self, verb: str, *args: int) -> int:
        # The heartbeat begins before the motion does.
        self._alive().ask_status_every(self.config.heartbeat_ms / 1e3 / STATUS_PER_HEARTBEAT)
        try:
            sequence = self._alive().request(verb, *args).sequence
        except StageRefusedError:
            self.at_rest()
            raise
        return -1 if sequence is None else sequence

    def _alive(self) -> StageLink:
        if self._link is None:
            raise StageLostError(f"stage at {self.port} is not connected", "its port was lost", "polysight-pi home")
        return self._link


class Position(NamedTuple):
    """Where the stage is, stage millimetres."""

    x_mm: float
    y_mm: float


class BenchStage:
    """A stage driven by hand: every motion is waited for. SIGINT stops it."""

    def __init__(self, driver: StageDriver, news: queue.SimpleQueue[StageNews]) -> None:
        self._driver, self._news = driver, news
        self.firmware = driver.firmware

    def home(self) -> Position:
        """Home, and return the position. Raises DeviceError."""
        return self._moved(self._driver.home())

    def jog(self, dx_mm: float, dy_mm: float, speed_mm_s: float) -> Position:
        """Move by (dx, dy), and return the position. Raises DeviceError, for example when not homed."""
        here = self.position()
        return self._moved(self._driver.move(here.x_mm + dx_mm, here.y_mm + dy_mm, speed_mm_s))

    def position(self) -> Position:
        """Ask where the stage is. Raises StageLostError."""
        self._driver.send(Immediate.STATUS)
        silent = StageLostError("the stage does not answer the status byte", "wrong firmware", "flash this release")
        return self._until(lambda reply: reply.kind == "status", 1.0, silent)

    def _moved(self, sequence: int) -> Position:
        late = StageLostError(f"the motion has not ended after {MOTION_LIMIT_S:.0f} s", "the motors stall", "look")
        try:
            return self._until(lambda r: r.kind == "done" and r.sequence == sequence, MOTION_LIMIT_S, late)
        except KeyboardInterrupt:
            self._driver.send(Immediate.STOP)
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
def bench_stage(config: Stage, port: str) -> Iterator[BenchStage]:
    """A connected stage, closed at the end."""
    news: queue.SimpleQueue[StageNews] = queue.SimpleQueue()
    driver = StageDriver(config, port, news.put)
    try:
        driver.connect()
        yield BenchStage(driver, news)
    finally:
        driver.close()
