"""Single steps for bring-up: `pulse`, `jog`, `home`, without the service and without a host."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from polysight.pi_controller.burst import BurstRecord, BurstSpec, send_burst
from polysight.pi_controller.stage_driver import StageDriver
from polysight.pi_controller.stage_link import StageLost, StageLostError, StageNews
from polysight.pi_controller.trigger_lines import TriggerLines
from polysight.shared.config import Stage
from polysight.shared.errors import DeviceError
from polysight.shared.faults import explain
from polysight.shared.stage_line import HOMING_LIMIT_S, Immediate

MOTION_LIMIT_S = HOMING_LIMIT_S  # no motion takes longer than homing


class Position(NamedTuple):
    """Where the stage is, stage millimetres."""

    x_mm: float
    y_mm: float


class BenchStage:
    """A stage driven by hand: every motion is waited for. SIGINT stops it."""

    def __init__(self, config: Stage, port: str) -> None:
        self._news: queue.SimpleQueue[StageNews] = queue.SimpleQueue()
        self._driver = StageDriver(config, port, self._news.put)

    def home(self) -> Position:
        """Home, and return the position. Raises DeviceError."""
        return self._until_done(self._driver.home())

    def jog(self, dx_mm: float, dy_mm: float, speed_mm_s: float) -> Position:
        """Move by (dx, dy), and return the position. Raises DeviceError, for example when not homed."""
        here = self.position()
        return self._until_done(self._driver.move(here.x_mm + dx_mm, here.y_mm + dy_mm, speed_mm_s))

    def position(self, limit_s: float = 1.0) -> Position:
        """Ask where the stage is. Raises StageLostError."""
        self._driver.send(Immediate.STATUS)
        deadline = time.monotonic() + limit_s
        while (left := deadline - time.monotonic()) > 0:
            try:
                news = self._news.get(timeout=left)
            except queue.Empty:
                break
            if isinstance(news, StageLost):
                raise StageLostError(news.reason, "cable unplugged", "check the USB cable")
            if news.kind == "status":
                self._driver.note_position(news)
                return Position(self._driver.x_mm, self._driver.y_mm)
        raise StageLostError("the stage does not answer the status byte", "wrong firmware", "flash this release")

    def _until_done(self, sequence: int) -> Position:
        deadline = time.monotonic() + MOTION_LIMIT_S
        try:
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
                if news.kind == "done" and news.sequence == sequence:
                    return Position(self._driver.x_mm, self._driver.y_mm)
        except KeyboardInterrupt:
            self._driver.send(Immediate.STOP)
            raise
        raise StageLostError(f"the motion has not ended after {MOTION_LIMIT_S:.0f} s", "the motors stall", "look")

    def open(self) -> str:
        """Connect; returns the firmware's version. Raises StageLostError."""
        self._driver.connect()
        return self._driver.firmware

    def close(self) -> None:
        """Close the port."""
        self._driver.close()


@contextmanager
def bench_stage(config: Stage, port: str) -> Iterator[BenchStage]:
    """A connected stage, closed at the end."""
    stage = BenchStage(config, port)
    try:
        stage.open()
        yield stage
    finally:
        stage.close()


def pulse(lines: TriggerLines, spec: BurstSpec, bursts: int, pause_ns: int) -> list[BurstRecord]:
    """Send bursts without a stage, `pause_ns` after one another; the records tell width and jitter."""
    sent: list[BurstRecord] = []
    for _ in range(bursts):
        start = sent[-1].end_ns + pause_ns if sent else lines.now_ns() + pause_ns
        sent.append(send_burst(lines, spec, start))
    return sent
