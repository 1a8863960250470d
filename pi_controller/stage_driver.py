"""The stage in millimetres: connects, sets it up, homes, runs rows, stops. Used by the executor's thread alone."""

from __future__ import annotations

import time
from collections.abc import Callable

from polysight.pi_controller.rows import StageRow
from polysight.pi_controller.stage_link import StageLink, StageLostError, StageNews, StageRefusedError
from polysight.shared.config import Stage
from polysight.shared.errors import ProtocolError
from polysight.shared.faults import StageError
from polysight.shared.stage_line import Immediate, Parameter, Reply

IDLE_STATUS_S = 1.0
STATUS_PER_HEARTBEAT = 4  # while moving
STOP_LIMIT_S = 3.0  # from STOP to standstill
ASK_AGAIN_S = 0.05
# A status unanswered for so much of a heartbeat: the stage is lost. With the time to the next question and a look at
# the port, a stage that falls silent is noticed before its own heartbeat stops it.
SILENT_HEARTBEATS = 0.5


def read_slice_s(heartbeat_s: float) -> float:
    """How often the link looks whether a status is due, or overdue."""
    return min(0.05, heartbeat_s / STATUS_PER_HEARTBEAT / 2)


class StageDriver:
    """One stage.

    Parameters
    ----------
    config
        The [stage] table.
    port
        Serial device.
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

        Raises
        ------
        StageLostError
            when nobody answers, or the stage counts other steps than the rig file.
        """
        if self._link is not None:
            if not self._link.lost:
                return
            self.close()
        heartbeat_s = self.config.heartbeat_ms / 1e3
        self._link = StageLink(
            self.port,
            self.config.baud,
            self._news,
            silence_s=SILENT_HEARTBEATS * heartbeat_s,
            read_slice_s=read_slice_s(heartbeat_s),
        )
        steps = self._link.steps_per_mm
        if steps not in ("", f"{self.config.steps_per_mm:g}"):
            self.close()
            raise StageLostError(
                f"stage at {self.port} makes {steps} steps per mm, the rig file says {self.config.steps_per_mm:g}",
                "board.h of the sketch and stage.steps_per_mm in instrument.toml differ",
                "correct the wrong one",
            )
        self.firmware = self._link.firmware
        self._link.ask_status_every(IDLE_STATUS_S)

    def set_up(self) -> None:
        """Send every parameter of the rig file. Raises StageRefusedError, StageLostError."""
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
            self._request("SET", int(parameter), round(value))

    def clear(self) -> None:
        """Clear a latched alarm. Raises StageRefusedError when its cause stays, or the position is not known."""
        self._request("CLEAR")

    def home(self) -> int:
        """Stop, clear, set up, switch the motors on, start homing; returns the sequence number of its `done`."""
        deadline = time.monotonic() + STOP_LIMIT_S
        while True:
            try:
                self.clear()
                break
            except StageRefusedError as e:
                if e.number == StageError.NOT_HOMED:  # that is what homing is for
                    break
                if e.number != StageError.BUSY or time.monotonic() > deadline:
                    raise
            # It still carries out what a program before this one told it.
            self.send(Immediate.STOP)
            time.sleep(ASK_AGAIN_S)
        self.set_up()
        self._request("ENABLE", 1)
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
        """Take x and y out of a status or done reply, when they are there."""
        try:
            self.x_mm = reply.integer("x") / self.config.steps_per_mm
            self.y_mm = reply.integer("y") / self.config.steps_per_mm
        except ProtocolError:
            return

    def close(self) -> None:
        """Close the port."""
        if self._link is not None:
            link, self._link = self._link, None
            link.close()

    def _start(self, verb: str, *args: int) -> int:
        # The heartbeat begins before the motion does.
        self._alive().ask_status_every(self.config.heartbeat_ms / 1e3 / STATUS_PER_HEARTBEAT)
        try:
            sequence = self._request(verb, *args).sequence
        except StageRefusedError:
            self.at_rest()
            raise
        return -1 if sequence is None else sequence

    def _request(self, verb: str, *args: int) -> Reply:
        return self._alive().request(verb, *args)

    def _alive(self) -> StageLink:
        if self._link is None:
            raise StageLostError(f"stage at {self.port} is not connected", "its port was lost", "polysight-pi home")
        return self._link
