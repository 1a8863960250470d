"""State machine of one radar board, from off to frames ended.

A board is `ARMED` only after the radar reported that it waits for triggers, and `DONE` only after it reported the end
of its frames. A fatal event leads to `FAULT`, which only a reset leaves. Not run on hardware yet.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum
from typing import Any

from polysight.radar import commands as c
from polysight.radar import events as e
from polysight.radar.bring_up import BringUp, Step, data_of
from polysight.radar.calibration_data import CalibrationFiles
from polysight.radar.firmware import Image
from polysight.radar.program import Program
from polysight.radar.spi import Clock, Link, WordLink
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DeviceError, PolysightError

_READY_TIMEOUT_S = 1.0
_MAX_EVENTS = 1000
_SENSORS = ("rx1", "rx2", "rx3", "rx4", "tx1", "tx2", "tx3", "pm", "digital")


class State(Enum):
    """State of a board."""

    OFF = "off"
    POWERED = "powered: main and RF core are up"
    RF_READY = "calibrated"
    CONFIGURED = "chirp and data path are set"
    ARMED = "waits for pulses"
    RUNNING = "pulses have begun"
    DONE = "frames ended"
    FAULT = "has failed, needs a reset"


class RadarBoard:
    """One board, reached through a word link.

    Parameters
    ----------
    firmware
        Image that is downloaded to RAM at each start; None: use the flash.
    die_id
        Required die id; "" accepts any board.
    calibration
        Files of RF init results for later starts; None: calibrate at each start.

    Attributes
    ----------
    reason
        Cause of the state `FAULT`.
    facts
        Versions, die id, temperatures and calibration, as reported by the board.
    steps
        Steps of the last bring-up, in order.
    """

    def __init__(
        self,
        name: str,
        words: WordLink,
        clock: Clock,
        program: Program,
        firmware: Image | None = None,
        die_id: str = "",
        calibration: CalibrationFiles | None = None,
    ) -> None:
        self.name, self._words, self._clock, self._program = name, words, clock, program
        self._firmware, self._die_id, self._calibration = firmware, die_id, calibration
        self._sent: list[bytes] = []
        self._link = Link(name, words, clock, self._sent.append)
        self._state, self._frames = State.OFF, 0
        self.reason = ""
        self.facts: dict[str, object] = {}
        self.steps: list[Step] = []
        self._sent_frames: tuple[c.Command, ...] = ()
        self._log: list[str] = []

    @property
    def state(self) -> State:
        """Last known state."""
        return self._state

    @property
    def warnings(self) -> list[str]:
        """Errors of the link that a retry corrected, since the last report."""
        return self._link.warnings[:]

    def configure(self, on_step: Callable[[Step, str], None] | None = None) -> None:
        """Reset and configure the board, from any state; call `on_step` with each step and its outcome.

        Raises DeviceError or ConfigError for the step that failed; the board is then in `FAULT`.
        """
        with self._fault_on_error():
            up = self._begin()
            stages = (
                (up.power_steps(), State.POWERED),
                (up.rf_steps(), State.RF_READY),
                (up.waveform_steps(), State.CONFIGURED),
            )
            self.steps = [step for steps, _ in stages for step in steps]
            for steps, state in stages:
                for step in steps:
                    try:
                        outcome = step.run()
                    except DeviceError as error:
                        raise up.with_ignored(error) from None
                    if on_step is not None:
                        on_step(step, outcome)
                self._state = state

    def write_flash(self, image: Image, progress: Callable[[int, int], None]) -> str:
        """Write firmware to the board's flash, start from it and verify; return a description of the flash.

        `progress` is called with the parts sent and their total. The board is `OFF` afterwards. Raises DeviceError,
        ConfigError.
        """
        with self._fault_on_error():
            up = self._begin()
            try:
                return up.write_flash(image, progress)
            except DeviceError as error:
                raise up.with_ignored(error) from None

    def _begin(self) -> BringUp:
        self._state, self.reason, self._frames = State.OFF, "", 0
        self.facts.clear()
        return BringUp(
            self.name, self._link, self._words, self._clock, self._program, self._firmware, self._die_id,
            self._calibration, self.facts, self._keep,
        )  # fmt: skip

    def arm(self, frames: int) -> None:
        """Start `frames` frames and wait until the radar reports that it waits for their triggers.

        A failed or unconfigured board is configured first; frames that still wait for triggers are stopped. Raises
        DeviceError; the board is then in `FAULT`.
        """
        self.poll()
        if self._state in (State.OFF, State.FAULT):
            self.configure()
        with self._fault_on_error():
            if self._state in (State.ARMED, State.RUNNING):
                self._stop()
            if self._state is State.FAULT:
                raise DeviceError(
                    f"{self.name}: {self.reason}",
                    "a fatal event while it was stopped",
                    "resume the scan",
                    code=ErrorCode.RADAR_FAULT,
                )
            self.read_temperatures()
            if frames != self._frames:
                self._frames = 0
                self._set_frames(frames, c.HARDWARE_TRIGGER)
                self._frames = frames
            self._link.call(c.FrameControl(c.START))
            self._wait(e.TRIGGER_READY, _READY_TIMEOUT_S)
            if self._state is State.DONE:
                raise DeviceError(
                    f"{self.name}: reported the end of its frames right after it was armed, before any pulse",
                    "pulses on SYNC_IN from another source (DCA1000 through R62, noise), or a late report",
                    "measure SYNC_IN while no pulse is sent (docs/how-to/wiring.md); the row is retaken",
                )
            if self._state is not State.ARMED:
                raise DeviceError(
                    f"{self.name}: {self.reason}",
                    "a fatal event while it was armed",
                    "resume the scan",
                    code=ErrorCode.RADAR_FAULT,
                )

    def run_one_frame(self) -> str:
        """Run one frame of a configured board with a software trigger; return its end event. Raises DeviceError."""
        with self._fault_on_error():
            self._frames = 0
            self._set_frames(1, c.SOFTWARE_TRIGGER)
            self._link.call(c.FrameControl(c.START))
            return str(self._wait(e.FRAME_END, _READY_TIMEOUT_S + self._program.frame_period_us * 1e-6))

    def _set_frames(self, frames: int, trigger: int) -> None:
        self._sent_frames = self._program.frames(frames, trigger)
        for command in self._sent_frames:
            self._link.call(command)

    def read_back(self) -> list[str]:
        """Read back profile, chirp and frame of a board that was armed; return the differences. Raises DeviceError."""
        sent = {one.ID: one.block().data for one in (*self._program.waveform, *self._sent_frames)}
        differences = []
        for question, of in ((c.READ_PROFILE, 0x0100), (c.READ_CHIRP, 0x0101), (c.READ_FRAME, 0x0102)):
            blocks = self._link.call(question).blocks
            found = blocks[0].data if blocks else b""
            if found != sent[of]:
                differences.append(f"0x{of:04X}: sent {sent[of].hex()}, read back {found.hex()}")
        return differences

    def reconnect(self, words: WordLink) -> None:
        """Replace a lost link; the next `arm` resets and configures the board."""
        warnings = self._link.warnings
        self._words, self._link = words, Link(self.name, words, self._clock, self._sent.append)
        self._link.warnings += warnings
        self.fail("its link was reopened")

    def pulses_begin(self) -> None:
        """Note that pulses may come from now on, which the radar does not report."""
        if self._state is State.ARMED:
            self._state = State.RUNNING

    def poll(self) -> State:
        """Read the board's events and return its state; a lost link is a fault."""
        if self._state not in (State.OFF, State.FAULT):
            try:
                for event in self._link.poll():
                    self._on_event(event)
            except DeviceError as error:
                self.fail(error.what)
        return self._state

    def read_temperatures(self) -> None:
        """Read the temperatures into `facts`. Raises DeviceError."""
        answer = self._link.call(c.GET_TEMPERATURES)
        data = data_of(self.name, answer, c.GET_TEMPERATURES, 24)
        stamp, *degrees = struct.unpack_from("<I9h", data)
        self.facts["temperatures_c"] = dict(zip(_SENSORS, degrees, strict=True))
        self.facts["device_ms"] = stamp

    def report(self) -> dict[str, Any]:
        """Return facts, bytes sent, events and warnings since the last report, for the manifest."""
        report: dict[str, Any] = {
            "state": self._state.name.lower(),
            **self.facts,
            "sent": [raw.hex() for raw in self._sent],
            "events": self._log[:],
            "warnings": self._link.warnings[:],
        }
        if self.reason:
            report["reason"] = self.reason
        self._sent.clear()
        self._log.clear()
        self._link.warnings.clear()
        return report

    def close(self) -> None:
        """Stop frames that wait for triggers, if the board still answers, and close the link."""
        try:
            if self.poll() in (State.ARMED, State.RUNNING):
                self._stop()
        except DeviceError:
            pass  # the link is closed in any case
        finally:
            self._words.close()

    def fail(self, reason: str) -> None:
        """Enter `FAULT`; the first reason is kept."""
        if self._state is not State.FAULT:
            self.reason = reason
            self._state = State.FAULT

    def _stop(self) -> None:
        """Stop frames that wait for triggers, after one frame period, because a stop is forbidden during a frame."""
        self._clock.sleep(self._program.frame_period_us * 1e-6)
        self.poll()
        if self._state in (State.ARMED, State.RUNNING):
            self._link.call(c.FrameControl(c.STOP_WHILE_WAITING))
            self._link.wait_for((e.FRAME_END,), _READY_TIMEOUT_S, self._note)
            self._state = State.CONFIGURED

    def _wait(self, event_id: int, timeout_s: float) -> e.Event:
        return self._link.wait_for((event_id,), timeout_s, self._on_event)

    def _note(self, event: e.Event) -> None:
        """Log an event. Raises DeviceError for a fatal one."""
        self._keep(str(event))
        if event.fatal:
            self.fail(str(event))
            raise DeviceError(
                f"{self.name}: {event}",
                "the radar stopped with a fault",
                "the retake of the row resets it",
                code=ErrorCode.RADAR_FAULT,
            )

    def _keep(self, line: str) -> None:
        """Log an event for the report, up to `_MAX_EVENTS`."""
        if len(self._log) < _MAX_EVENTS:
            self._log.append(line)

    def _on_event(self, event: e.Event) -> None:
        self._keep(str(event))
        if event.fatal:
            self.fail(str(event))
        elif event.id == e.FRAME_END and self._state in (State.ARMED, State.RUNNING):
            self._state = State.DONE
        elif event.id == e.TRIGGER_READY and self._state in (State.CONFIGURED, State.DONE):
            self._state = State.ARMED

    @contextmanager
    def _fault_on_error(self) -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            self.fail(error.what if isinstance(error, PolysightError) else str(error))
            raise
