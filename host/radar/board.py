"""One radar board's states, from off to frames ended, and what brings it from one to the next.

`ARMED` only when the radar has said that it waits for triggers, `DONE` only when it has said that its frames have
ended. A fatal event is `FAULT`, which only a reset leaves. Not run on hardware yet.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any

from polysight.host.radar import commands as c
from polysight.host.radar import events as e
from polysight.host.radar import lab_commands as lab
from polysight.host.radar.bring_up import BringUp, Step, data_of
from polysight.host.radar.calibration_data import CalibrationFiles
from polysight.host.radar.firmware import Image
from polysight.host.radar.program import Program
from polysight.host.radar.spi import Clock, Link, WordLink
from polysight.shared.errors import DeviceError, PolysightError

_READY_S = 1.0
_MOST_EVENTS = 1000
_SENSORS = ("rx1", "rx2", "rx3", "rx4", "tx1", "tx2", "tx3", "pm", "digital")


class State(Enum):
    """Where a board is."""

    OFF = "off"
    POWERED = "powered: main and RF core are up"
    RF_READY = "calibrated"
    CONFIGURED = "chirp and data path are set"
    ARMED = "waits for pulses"
    RUNNING = "pulses have begun"
    DONE = "frames ended"
    FAULT = "has failed, needs a reset"


TRANSITIONS: Mapping[State, frozenset[State]] = {
    State.OFF: frozenset({State.POWERED, State.FAULT}),
    State.POWERED: frozenset({State.RF_READY, State.FAULT, State.OFF}),
    State.RF_READY: frozenset({State.CONFIGURED, State.FAULT, State.OFF}),
    State.CONFIGURED: frozenset({State.ARMED, State.FAULT, State.OFF}),
    State.ARMED: frozenset({State.RUNNING, State.DONE, State.CONFIGURED, State.FAULT, State.OFF}),
    State.RUNNING: frozenset({State.DONE, State.CONFIGURED, State.FAULT, State.OFF}),
    State.DONE: frozenset({State.ARMED, State.FAULT, State.OFF}),
    State.FAULT: frozenset({State.OFF}),
}


class RadarBoard:
    """One board behind a word link.

    Parameters
    ----------
    firmware
        Downloaded to the device's RAM at each start; None: what its flash holds.
    die_id
        The only board that is accepted; "" for any.
    calibration
        Where what its RF init found is kept for its next starts; None: it calibrates anew each time.

    Attributes
    ----------
    reason
        Why it is in `FAULT`.
    facts
        What it said of itself: versions, die id, temperatures, calibration.
    steps
        Of its last bring-up, in order.
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
        """Where the board is, as far as it was read."""
        return self._state

    @property
    def warnings(self) -> list[str]:
        """What went wrong on the link and was mended, since the last report."""
        return self._link.warnings[:]

    def configure(self, on_step: Callable[[Step, str], None] | None = None) -> None:
        """From wherever it is, by a reset, to `CONFIGURED`; `on_step` is told each step and what came of it.

        Raises
        ------
        DeviceError, ConfigError
            naming the step that failed; the board is then in `FAULT`.
        """
        with _Failing(self):
            up = self._begin()
            stages = (
                (up.power_steps(), State.POWERED),
                (up.rf_steps(), State.RF_READY),
                (up.waveform_steps(), State.CONFIGURED),
            )
            self.steps = [step for steps, _ in stages for step in steps]
            for steps, then in stages:
                for step in steps:
                    try:
                        came = step.run()
                    except DeviceError as error:
                        raise up.blame(error) from None
                    if on_step is not None:
                        on_step(step, came)
                self._to(then)

    def write_flash(self, image: Image, progress: Callable[[int, int], None]) -> str:
        """Write firmware to the board's flash, start from it and verify; returns what it holds now.

        `progress` is told parts sent and in all. The board is `OFF` afterwards. Raises DeviceError, ConfigError.
        """
        with _Failing(self):
            up = self._begin()
            try:
                told = up.write_flash(image, progress)
            except DeviceError as error:
                raise up.blame(error) from None
        return told

    def _begin(self) -> BringUp:
        if self._state is not State.OFF:
            self._to(State.OFF)
        self.reason, self._frames = "", 0
        self.facts.clear()
        return BringUp(
            self.name, self._link, self._words, self._clock, self._program, self._firmware, self._die_id,
            self._calibration, self.facts, self._keep,
        )  # fmt: skip

    def arm(self, frames: int) -> None:
        """Count out frames and start them, until the radar has said that it waits for their triggers.

        A board that failed, or was never configured, is configured first; frames still awaited from before are
        stopped.

        Raises
        ------
        DeviceError
            when it does not get there; the board is then in `FAULT`.
        """
        self.poll()
        if self._state in (State.OFF, State.FAULT):
            self.configure()
        with _Failing(self):
            if self._state in (State.ARMED, State.RUNNING):
                self._stop()
            if self._state is State.FAULT:
                raise DeviceError(
                    f"{self.name}: {self.reason}", "a fatal event while it was stopped", "resume the scan"
                )
            self.read_temperatures()
            if frames != self._frames:
                self._frames = 0
                self._set_frames(frames, c.HARDWARE_TRIGGER)
                self._frames = frames
            self._link.call(c.FrameControl(c.START))
            self._wait(e.TRIGGER_READY, _READY_S)
            if self._state is State.DONE:
                raise DeviceError(
                    f"{self.name}: says that its frames ended as soon as it was armed, before any pulse was sent",
                    "pulses on SYNC_IN from elsewhere (DCA1000 through R62, noise), or a late report of earlier ones",
                    "look at SYNC_IN while nothing is sent (docs/how-to/wiring.md); the row is taken again",
                )
            if self._state is not State.ARMED:
                raise DeviceError(f"{self.name}: {self.reason}", "a fatal event while it was armed", "resume the scan")

    def run_one_frame(self) -> str:
        """One frame, started by software and not by a pulse, for a configured board; what came of it.

        Raises DeviceError.
        """
        with _Failing(self):
            self._frames = 0
            self._set_frames(1, c.SOFTWARE_TRIGGER)
            self._link.call(c.FrameControl(c.START))
            return str(self._wait(e.FRAME_END, _READY_S + self._program.frame_period_us * 1e-6))

    def _set_frames(self, frames: int, trigger: int) -> None:
        self._sent_frames = self._program.frames(frames, trigger)
        for command in self._sent_frames:
            self._link.call(command)

    def read_back(self) -> list[str]:
        """Profile, chirp and frame as the board has them, where they differ from what it was sent. Raises DeviceError.

        For a configured board whose frames were set.
        """
        sent = {one.ID: one.block().data for one in (*self._program.waveform, *self._sent_frames)}
        differences = []
        for question, of in ((lab.ReadProfile(), 0x0100), (lab.ReadChirp(), 0x0101), (lab.ReadFrame(), 0x0102)):
            blocks = self._link.call(question).blocks
            found = blocks[0].data if blocks else b""
            if found != sent[of]:
                differences.append(f"0x{of:04X}: sent {sent[of].hex()}, read back {found.hex()}")
        return differences

    def stream_tone(self, tone: lab.StreamTone, on: bool) -> None:
        """Begin or end continuous streaming of one frequency, for tests of the RF; frames must not run.

        It leaves the board without its chirp: configure it before the next row. Raises DeviceError.
        """
        with _Failing(self):
            if on:
                self._link.call(tone)
            self._link.call(lab.StreamData(on))
            self._link.call(lab.StreamEnable(on))

    def reconnect(self, words: WordLink) -> None:
        """Go on over another link, the one before being gone; the next `arm` resets and configures the board."""
        warnings = self._link.warnings
        self._words, self._link = words, Link(self.name, words, self._clock, self._sent.append)
        self._link.warnings += warnings
        self.fail("its link was opened anew")

    def pulses_begin(self) -> None:
        """The host knows that pulses come from now on; the radar does not say so."""
        if self._state is State.ARMED:
            self._to(State.RUNNING)

    def poll(self) -> State:
        """Read what the board has to say, and return where it is. A link that is gone is a fault."""
        if self._state not in (State.OFF, State.FAULT):
            try:
                for event in self._link.poll():
                    self._on_event(event)
            except DeviceError as error:
                self.fail(error.what)
        return self._state

    def read_temperatures(self) -> None:
        """Ask for the temperatures. Raises DeviceError."""
        answer = self._link.call(c.GET_TEMPERATURES)
        data = data_of(self.name, answer, c.GET_TEMPERATURES, 24)
        stamp, *degrees = struct.unpack_from("<I9h", data)
        self.facts["temperatures_c"] = dict(zip(_SENSORS, degrees, strict=True))
        self.facts["device_ms"] = stamp

    def report(self) -> dict[str, Any]:
        """What happened since the last report: facts, every byte sent, events, warnings. For the manifest."""
        told: dict[str, Any] = {
            "state": self._state.name.lower(),
            **self.facts,
            "sent": [raw.hex() for raw in self._sent],
            "events": self._log[:],
            "warnings": self._link.warnings[:],
        }
        if self.reason:
            told["reason"] = self.reason
        self._sent.clear()
        self._log.clear()
        self._link.warnings.clear()
        return told

    def close(self) -> None:
        """Stop frames that are awaited, as far as the board listens, and let go of it."""
        try:
            if self.poll() in (State.ARMED, State.RUNNING):
                self._stop()
        except DeviceError:
            pass  # it is let go of either way, and hardware that is gone makes no frames for long
        finally:
            self._words.close()

    def fail(self, reason: str) -> None:
        """Into `FAULT`; the first reason stays."""
        if self._state is not State.FAULT:
            self.reason = reason
            self._to(State.FAULT)

    def _stop(self) -> None:
        """Stop frames that wait for triggers. The stop is forbidden within a frame: one frame period passes first."""
        self._clock.sleep(self._program.frame_period_us * 1e-6)
        self.poll()
        if self._state in (State.ARMED, State.RUNNING):
            self._link.call(c.FrameControl(c.STOP_WHILE_WAITING))
            self._link.wait_for((e.FRAME_END,), _READY_S, self._note)
            self._to(State.CONFIGURED)

    def _wait(self, wanted: int, limit_s: float) -> e.Event:
        return self._link.wait_for((wanted,), limit_s, self._on_event)

    def _note(self, event: e.Event) -> None:
        """Keep an event for the report; a fatal one ends what is being done."""
        self._keep(str(event))
        if event.fatal:
            self.fail(str(event))
            raise DeviceError(
                f"{self.name}: {event}", "the radar stopped itself", "it is reset when the row is retaken"
            )

    def _keep(self, line: str) -> None:
        """For the report; of events without end the first ones."""
        if len(self._log) < _MOST_EVENTS:
            self._log.append(line)

    def _on_event(self, event: e.Event) -> None:
        self._keep(str(event))
        if event.fatal:
            self.fail(str(event))
        elif event.id == e.FRAME_END and self._state in (State.ARMED, State.RUNNING):
            self._to(State.DONE)
        elif event.id == e.TRIGGER_READY and self._state in (State.CONFIGURED, State.DONE):
            self._to(State.ARMED)

    def _to(self, then: State) -> None:
        if then not in TRANSITIONS[self._state]:
            raise DeviceError(
                f"{self.name}: {self._state.value}, cannot become: {then.value}", "out of order", "resume"
            )
        self._state = then


class _Failing:
    """An error that leaves this block puts the board into `FAULT` with what it says."""

    def __init__(self, board: RadarBoard) -> None:
        self._board = board

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        if error is not None:
            self._board.fail(error.what if isinstance(error, PolysightError) else str(error))
