"""One radar board: its steps from reset to configured (`BringUp`), then arming and frames (`RadarBoard`).

A board is `ARMED` only after the radar reported that it waits for triggers, and `DONE` only after it reported the end
of its frames. A fatal event leads to `FAULT`, which only a reset leaves. docs/spec/mmwavelink.md ("Power-up") lists the
errors that healthy boards report at power-up and that are ignored. Not run on hardware yet.

In this file `c` is the module of commands, `e` that of messages, which has the events and names TI's document ("ICD").
A *die* is the radar chip, with an id of its own; a *patch* is the part of the firmware that extends the ROM.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import Enum
from functools import partial
from typing import Any, NamedTuple

import msgspec

from polysight.radar import calibration_data, commands as c, messages as e
from polysight.radar.commands import Program
from polysight.radar.firmware import TO_FLASH, TO_RAM, Image, describe_patch, require_family, require_rom, send_image
from polysight.radar.link import Link, NotReportedError, UnexpectedRestartError
from polysight.radar.usb import Clock, WordLink
from polysight_shared.errors import DeviceError, ErrorCode, PolysightError

# Timeouts are chosen: a healthy board reports its power-up within a second.
POWER_UP_TIMEOUT_S = 5.0
_CALIBRATION_TIMEOUT_S = 5.0
_BOOT_TIMEOUT_S = 5.0
# For how long the reset line is held (chosen).
_RESET_S = 0.1
# Time in which the device reports that it is ready for triggers, or that its frame has ended (chosen).
_READY_TIMEOUT_S = 1.0
# Events that are kept of a board; a faulty one could report without end; chosen.
_MAX_EVENTS = 1000
# Temperature sensors in the order of the device's answer.
_SENSORS = ("rx1", "rx2", "rx3", "rx4", "tx1", "tx2", "tx3", "pm", "digital")
# Remedies for missing firmware and for a board that does not start.
_FIRMWARE_REMEDY = (
    "set radar.firmware to TI's image, or write it once: `polysight radar firmware` (docs/how-to/radar-bring-up.md)"
)
_JUMPERS_REMEDY = "SOP0 set, SOP1 and SOP2 open; see docs/how-to/radar-bring-up.md"


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


class BoardFacts(msgspec.Struct, omit_defaults=True):
    """Reports of a board on its own state since its last bring-up began: the keys of its entry in the manifest.

    `boot` and `calibration` are values of events (`messages.Event`), `rf_tests_passed` bits of event 0x5001; `hardware`
    and firmware are versions. Temperatures are by sensor, read at `device_ms` of the device's own clock.
    """

    boot: Mapping[str, object] | None = None
    rf_tests_passed: object = None
    hardware: str = ""
    rf_firmware: str = ""
    main_firmware: str = ""
    die_id: str = ""
    calibration: Mapping[str, object] | None = None
    calibration_restored: bool | None = None
    temperatures_c: dict[str, int] | None = None
    device_ms: int | None = None


class Step(NamedTuple):
    """One step. `run` executes it and returns its outcome; it raises DeviceError or ConfigError.

    A person sees `name`, the outcome `expected`, and `remedy` if it fails; then the board is in `state_after`.
    """

    name: str
    expected: str
    remedy: str
    run: Callable[[], str]
    state_after: State


class BringUp:
    """One bring-up of a board: its steps, and what they report. Results go to the board's `facts`."""

    def __init__(self, board: RadarBoard) -> None:
        self._board = board
        self._link = board.link
        # Reported errors that are ignored, because healthy boards report them, too.
        self._ignored: list[str] = []
        # Remedy for the last boot status: "firmware" (the flash has none), "hardware" (replace the board), "" (none).
        self._cure = ""
        # The main core's patch before anything was downloaded.
        self._flash_patch = ""
        # The boot status that reported a hardware fault, as text.
        self._damage = ""
        # True if the board already runs the rig file's image from its flash.
        self._from_flash = False

    def steps(self) -> list[Step]:
        """Return the steps in order: both cores run, the RF core is calibrated, chirp and data path are configured."""
        program = self._board.program
        waits = "the main core's power-up event within a second"
        image_in_place = "the image is in RAM, or already in the flash"
        basic = f"{len(program.basic)} acknowledgements"
        calibrated = "every calibration that the board needs passed"
        waveform = f"{len(program.waveform)} acknowledgements"
        exchange = "exchange the boards, or correct die_id"
        return [
            Step("reset", waits, f"power, reset, {_JUMPERS_REMEDY}", self._reset, State.OFF),
            Step("firmware", image_in_place, _FIRMWARE_REMEDY, self._load_firmware, State.OFF),
            Step(
                "RF power-up",
                "the RF core's power-up event",
                "reset; power-cycle the board",
                self._power_up_rf,
                State.POWERED,
            ),
            Step("versions", "both cores with a patch", _FIRMWARE_REMEDY, self._check_versions, State.POWERED),
            Step("settings", basic, "compare with `plan`", partial(self._send, program.basic), State.POWERED),
            Step("RF init", calibrated, "clock, RF supplies; power-cycle it", self._calibrate_rf, State.RF_READY),
            Step("chirp", waveform, "compare with `plan`", partial(self._send, program.waveform), State.RF_READY),
            Step("die id", "the board of the rig file", exchange, self._check_die, State.CONFIGURED),
        ]

    def add_ignored_errors(self, error: DeviceError) -> DeviceError:
        """Return the error with the ignored errors of this bring-up added to its cause."""
        if not self._ignored:
            return error
        ignored = "; ".join(dict.fromkeys(self._ignored))
        return DeviceError(error.what, f"{error.why}; earlier reports: {ignored}", error.remedy, code=error.code)

    def write_flash(self, image: Image, progress: Callable[[int, int], None]) -> str:
        """Write an image to the flash, start the board from it, and verify it, from any state of the board.

        Raises DeviceError or ConfigError if a part is refused, or the board does not start from its flash afterwards.
        """
        self._reset()
        patch_before = self._find_patch(image)
        send_image(self._link, self._board.name, image, TO_FLASH, progress)
        self._ignored.clear()
        self._reset()
        if self._cure == "firmware":
            raise DeviceError(
                f"{self._board.name}: starts, but not from its flash: {'; '.join(self._ignored)}",
                "the flash does not contain the image: a power failure during the download, or a worn flash",
                "download it again; until then radar.firmware starts the board from RAM",
                code=ErrorCode.RADAR_NO_FIRMWARE,
            )
        patch_after = _format_patch(self._board.ask(c.GET_MAIN_VERSION, 16))
        self._verify(patch_after, patch_before, image)
        self._refuse_damaged()
        # The die id is only readable after the RF power-up.
        if self._board.die_id:
            self._power_up_rf()
            self._read_die()
        return f"main core's patch {patch_after} from flash (before: {patch_before})"

    def _reset(self) -> str:
        """Reset the board and wait until its main core is up; return that event as text."""
        self._board.words.reset(held=True)
        self._board.clock.sleep(_RESET_S)
        self._link.restart()
        self._board.words.reset(held=False)
        try:
            up = self._link.wait_for((e.MAIN_POWER_UP,), POWER_UP_TIMEOUT_S, self.note)
        except NotReportedError as error:
            raise NotReportedError(
                error.what,
                f"no power on the radar board, jumpers not in functional mode ({_JUMPERS_REMEDY}), or {error.why}",
                f"check the 5 V supply of the radar board, the jumpers, then the reset; {error.remedy}",
                code=error.code,
            ) from None
        self._read_boot_status(up)
        return str(up)

    def _read_boot_status(self, event: e.Event) -> None:
        """Keep what a start reports: the facts, what it calls for, and its errors, which may be ignored."""
        self._board.facts.boot = dict(event.values)
        self._cure = str(event.values.get("cure", ""))
        if event.detail:
            self._ignored.append(str(event))
        if self._cure == "hardware":
            self._damage = str(event)

    def _refuse_damaged(self) -> None:
        """Raise DeviceError if the board reported a hardware fault at any start of this bring-up."""
        if self._damage:
            raise fault_error(
                self._board.name, self._damage, "the start-up self-test of the device failed", "replace the board"
            )

    def _load_firmware(self) -> str:
        """Download the rig file's image to RAM if there is one and the flash has not the same; return what was done."""
        if self._board.firmware is not None:
            outcome = self._load_into_ram(self._board.firmware)
        elif self._cure == "firmware":
            outcome = "the flash is empty or damaged, and radar.firmware is not set"
        else:
            outcome = "none configured"
        self._refuse_damaged()
        return outcome

    def _load_into_ram(self, image: Image) -> str:
        self._flash_patch = patch = self._find_patch(image)
        if patch == image.patches[0] and self._cure != "firmware":
            self._from_flash = True
            return f"the flash already contains the main core's patch {patch}; nothing is sent"
        send_image(self._link, self._board.name, image, TO_RAM)
        self._boot_from_ram(image)
        return f"{image.name} in RAM"

    def _boot_from_ram(self, image: Image) -> None:
        """Wait for the start from RAM. Without its report continue: the versions show later if the image runs."""
        try:
            booted = self._wait_for_boot()
        except NotReportedError as error:
            self._ignored.append(f"no event 0x{e.BOOT_STATUS:04X} after the download")
            self._board.log_event(error.what)
            return
        self._ignored.clear()
        self._read_boot_status(booted)
        if self._cure == "firmware":
            raise DeviceError(
                f"{self._board.name}: refuses {image.name}: {booted}",
                "an image for another device",
                "use TI's image for AWR2243",
                code=ErrorCode.REFUSED_BY_PEER,
            )

    def _wait_for_boot(self) -> e.Event:
        """Wait for the event at the end of a download to RAM (ICD 6.1); a power-up event alone is another start."""
        self._link.may_start = True
        event = self._link.wait_for((e.BOOT_STATUS, e.MAIN_POWER_UP), _BOOT_TIMEOUT_S, self.note)
        if event.id == e.BOOT_STATUS:
            self._link.may_start = False
            return event
        try:
            return self._link.wait_for((e.BOOT_STATUS,), _BOOT_TIMEOUT_S, self.note)
        except NotReportedError:
            raise UnexpectedRestartError(self._board.name) from None

    def _find_patch(self, image: Image) -> str:
        """Return the main core's patch. Raises ConfigError if the image is for another ROM."""
        answer = self._board.ask(c.GET_MAIN_VERSION, 16)
        require_rom(self._board.name, answer, image)
        return _format_patch(answer)

    def _verify(self, patch: str, patch_before: str, image: Image) -> None:
        """Raise DeviceError if the patch is still the old one; warn if it is not the file's.

        Its place in the file is not documented by TI, so the latter is not an error.
        """
        mismatch = (
            f"{self._board.name}: reports patch {patch} after the download, {image.name} contains {image.patches[0]}"
        )
        if patch == image.patches[0]:
            return
        if patch in (patch_before, _NO_PATCH):
            raise DeviceError(
                mismatch,
                "it did not start from the download",
                "power-cycle the board, then `polysight radar check`",
                code=ErrorCode.MISMATCH,
            )
        self._link.warnings.append(mismatch)

    def _verify_rf(self, patch: str, image: Image) -> None:
        """Warn if the RF core's patch, which is known only when that core runs, is not the file's."""
        if patch != image.patches[1]:
            update = f"`polysight radar firmware {self._board.name} {image.name} --flash` writes both cores"
            warning = f"{self._board.name}: its RF core reports patch {patch}, {image.name} contains {image.patches[1]}"
            if self._from_flash:
                warning += f": it runs from the flash; {update}"
            self._link.warnings.append(warning)

    def _power_up_rf(self) -> str:
        """Start the RF core and wait for its report; return that event as text."""
        self._link.call(c.DEVICE_CONFIGURATION)
        self._link.call(c.RF_POWER_UP)
        up = self._link.wait_for((e.RF_POWER_UP_DONE,), POWER_UP_TIMEOUT_S, self.note)
        self._board.facts.rf_tests_passed = up.values.get("tests_passed", 0)
        if up.detail:
            self._ignored.append(str(up))
        return str(up)

    def _check_versions(self) -> str:
        """Read the versions of both cores; refuse another device, missing or wrong firmware, and a wrong board."""
        facts = self._board.facts
        for core, question in (("RF", c.GET_RF_VERSION), ("main", c.GET_MAIN_VERSION)):
            answer = self._board.ask(question, 16)
            # Layout of the answer: ICD tables 5.66 and 5.157; `release` is the version of the ROM.
            hardware = answer[:3]
            release = answer[3:7]
            patch = (*answer[10:12], answer[15] >> 4, answer[15] & 15)
            version = ".".join(map(str, release)) + " patch " + ".".join(map(str, patch))
            facts.hardware = ".".join(map(str, hardware))
            if core == "RF":
                facts.rf_firmware = version
            else:
                facts.main_firmware = version
            require_family(self._board.name, core, answer)
            if not any(patch):
                raise DeviceError(
                    f"{self._board.name}: its {core} firmware has no patch (version {version})",
                    "the flash of this board contains no firmware, and none was downloaded",
                    _FIRMWARE_REMEDY,
                    code=ErrorCode.RADAR_NO_FIRMWARE,
                )
            if self._board.firmware is not None and core == "RF":
                self._verify_rf(_format_patch(answer), self._board.firmware)
            elif self._board.firmware is not None:
                self._verify(_format_patch(answer), self._flash_patch, self._board.firmware)
        if self._board.die_id:
            # A wrong board is refused before its RF part is configured.
            self._read_die()
        return f"RF {facts.rf_firmware}, main {facts.main_firmware}"

    def _send(self, commands: Sequence[c.Command]) -> str:
        for command in commands:
            self._link.call(command)
        return "acknowledged"

    def _calibrate_rf(self) -> str:
        """Run the RF init, with restored calibration data if there is a file of it; otherwise save what it found."""
        die = ""
        saved = None
        restored = ""
        if self._board.calibration is not None:
            die = self._read_die()
            if die in calibration_data.NO_DIES:
                self._link.warnings.append(f"{self._board.name}: its die id is {die}: its calibration is not saved")
            else:
                saved = self._board.calibration.load(die)
        if saved is not None:
            restored = "; " + calibration_data.restore_calibration(
                self._link, self._board.name, saved, _CALIBRATION_TIMEOUT_S, self.note
            )
        self._link.call(c.RF_INIT)
        event = self._link.wait_for((e.RF_INIT_DONE,), _CALIBRATION_TIMEOUT_S, self.note)
        self._board.facts.calibration = dict(event.values)
        requested = calibration_data.ALL_CALIBRATIONS
        if restored:
            requested = calibration_data.ALL_CALIBRATIONS & ~calibration_data.RESTORED_CALIBRATIONS
        if failed := e.list_failed_calibrations(event, self._board.program.transmits, requested):
            raise DeviceError(
                f"{self._board.name}: RF init failed: {', '.join(failed)} ({event})",
                "no reference clock, an RF supply out of range, or a damaged RF part",
                "measure the RF supplies; power-cycle the board; replace it if the fault remains",
                code=ErrorCode.RADAR_FAULT,
            )
        if self._board.calibration is not None and saved is None and die not in calibration_data.NO_DIES:
            self._board.calibration.save(die, calibration_data.read_calibration(self._link, self._board.name))
        self._board.facts.calibration_restored = bool(restored)
        return str(event) + restored

    def _check_die(self) -> str:
        die = self._read_die()
        # Fatal events since the last step raise here: the board counts as configured afterwards.
        for event in self._link.poll():
            self.note(event)
        return die

    def _read_die(self) -> str:
        """Return the die id, UNKNOWN_DIE if the firmware has none. Raises DeviceError if the rig file has another."""
        try:
            data = self._board.ask(c.GET_DIE_ID, 16)
        except DeviceError as error:
            if self._board.die_id or error.code is not ErrorCode.REFUSED_BY_PEER:
                raise
            # This firmware does not have the command.
            self._board.log_event(error.what)
            return calibration_data.UNKNOWN_DIE
        die = "-".join(f"{word:08x}" for word in struct.unpack_from("<4I", data))
        self._board.facts.die_id = die
        if self._board.die_id and die != self._board.die_id:
            raise DeviceError(
                f"{self._board.name}: this board has die id {die}, the rig file {self._board.die_id}",
                "two boards or their USB cables were exchanged",
                f"exchange them again, or correct radar.native.{self._board.name}.die_id",
                code=ErrorCode.MISMATCH,
            )
        return die

    def note(self, event: e.Event) -> None:
        """Log an event. Raises DeviceError for a fatal one, except the main core fault that healthy boards report."""
        self._board.log_event(str(event))
        if event.id == e.MAIN_CPU_FAULT:
            if event.fatal:
                self._ignored.append(str(event))
        elif event.fatal:
            raise fault_error(self._board.name, str(event))


def fault_error(
    name: str,
    what: str,
    why: str = "the radar stopped with a fault",
    remedy: str = "the retake of the row resets it",
) -> DeviceError:
    """Return the error of a board that reported a fault."""
    return DeviceError(f"{name}: {what}", why, remedy, code=ErrorCode.RADAR_FAULT)


_NO_PATCH = describe_patch(0, 0, 0, 0)


def _format_patch(version: bytes) -> str:
    """Return the patch in the answer to a version request as text."""
    return describe_patch(version[10], version[11], version[15] >> 4, version[15] & 15)


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
        calibration: calibration_data.CalibrationFiles | None = None,
    ) -> None:
        self.name = name
        self.words = words
        self.clock = clock
        self.program = program
        self.firmware = firmware
        self.die_id = die_id
        self.calibration = calibration
        # Bytes sent since the last report.
        self._sent: list[bytes] = []
        self.link = Link(name, words, clock, self._sent.append)
        self._state = State.OFF
        # Frames that the board is set for; 0: none.
        self._frames = 0
        self.reason = ""
        self.facts = BoardFacts()
        self.steps: list[Step] = []
        # The commands that set frames and trigger, as sent last.
        self._sent_frames: tuple[c.Command, ...] = ()
        self._log: list[str] = []

    @property
    def state(self) -> State:
        """Last known state."""
        return self._state

    @property
    def warnings(self) -> list[str]:
        """Errors since the last report that did not end an operation."""
        return self.link.warnings[:]

    def configure(self, on_step: Callable[[Step, str], None] | None = None) -> None:
        """Reset and configure the board, from any state; call `on_step` with each step that passed and its outcome.

        Raises DeviceError or ConfigError for the step that failed; the board is then in `FAULT`.
        """
        with self._fault_on_error():
            up = self._begin()
            self.steps = up.steps()
            for step in self.steps:
                try:
                    outcome = step.run()
                except DeviceError as error:
                    raise up.add_ignored_errors(error) from None
                if on_step is not None:
                    on_step(step, outcome)
                self._state = step.state_after

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
                raise up.add_ignored_errors(error) from None

    def _begin(self) -> BringUp:
        """Forget what is known of the board and return a new bring-up."""
        self._state = State.OFF
        self.reason = ""
        self._frames = 0
        self.facts = BoardFacts()
        return BringUp(self)

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
                raise fault_error(self.name, self.reason, "a fatal event while it was stopped", "resume the scan")
            self.read_temperatures()
            if frames != self._frames:
                self._frames = 0
                self._set_frames(frames, c.HARDWARE_TRIGGER)
                self._frames = frames
            self.link.call(c.FrameControl(c.START))
            self._wait(e.TRIGGER_READY, _READY_TIMEOUT_S)
            if self._state is State.DONE:
                raise DeviceError(
                    f"{self.name}: reported the end of its frames right after it was armed, before any pulse",
                    "pulses on SYNC_IN from another source (DCA1000 through R62, noise), or a late report",
                    "measure SYNC_IN while no pulse is sent (docs/how-to/wiring.md); the row is retaken",
                )
            if self._state is not State.ARMED:
                raise fault_error(self.name, self.reason, "a fatal event while it was armed", "resume the scan")

    def run_one_frame(self) -> str:
        """Run one frame of a configured board with a software trigger; return its end event. Raises DeviceError."""
        with self._fault_on_error():
            self._frames = 0
            self._set_frames(1, c.SOFTWARE_TRIGGER)
            self.link.call(c.FrameControl(c.START))
            return str(self._wait(e.FRAME_END, _READY_TIMEOUT_S + self.program.frame_period_us * 1e-6))

    def _set_frames(self, frames: int, trigger: int) -> None:
        self._sent_frames = self.program.make_frame_commands(frames, trigger)
        for command in self._sent_frames:
            self.link.call(command)

    def read_back(self) -> list[str]:
        """Read back profile, chirp and frame, after frames were set; return the differences. Raises DeviceError."""
        commands = (*self.program.waveform, *self._sent_frames)
        sent_blocks = {command.ID: command.block().data for command in commands}
        differences = []
        for question, setting in ((c.READ_PROFILE, c.Profile), (c.READ_CHIRP, c.Chirp), (c.READ_FRAME, c.Frame)):
            blocks = self.link.call(question).blocks
            read = b""
            if blocks:
                read = blocks[0].data
            sent_data = sent_blocks[setting.ID]
            if read != sent_data:
                differences.append(f"0x{setting.ID:04X}: sent {sent_data.hex()}, read back {read.hex()}")
        return differences

    def reconnect(self, words: WordLink) -> None:
        """Replace a lost link; the next `arm` resets and configures the board."""
        warnings = self.link.warnings
        self.words = words
        self.link = Link(self.name, words, self.clock, self._sent.append)
        self.link.warnings += warnings
        self.fail("its link was reopened")

    def note_pulses(self) -> None:
        """Note that pulses may come from now on, which the radar does not report."""
        if self._state is State.ARMED:
            self._state = State.RUNNING

    def poll(self) -> State:
        """Read the board's events and return its state; a lost link is a fault."""
        if self._state not in (State.OFF, State.FAULT):
            try:
                for event in self.link.poll():
                    self._on_event(event)
            except DeviceError as error:
                self.fail(error.what)
        return self._state

    def ask(self, question: c.Command, min_bytes: int) -> bytes:
        """Return the sub-block of the answer to a question. Raises DeviceError, also if it is missing or shorter."""
        for block in self.link.call(question).blocks:
            if block.id == question.ID and len(block.data) >= min_bytes:
                return block.data
        raise DeviceError(
            f"{self.name}: the answer to 0x{question.ID:04X} has no such data",
            "unknown device or firmware",
            "check the firmware",
            code=ErrorCode.MESSAGE_INVALID,
        )

    def read_temperatures(self) -> None:
        """Read the temperatures into `facts`. Raises DeviceError."""
        # A tenth sensor follows, which is left out.
        stamp, *degrees = struct.unpack_from("<I9h", self.ask(c.GET_TEMPERATURES, 24))
        self.facts.temperatures_c = dict(zip(_SENSORS, degrees, strict=True))
        self.facts.device_ms = stamp

    def report(self) -> dict[str, Any]:
        """Return facts, bytes sent, events and warnings since the last report, for the manifest."""
        report: dict[str, Any] = {
            "state": self._state.name.lower(),
            **msgspec.to_builtins(self.facts),
            "sent": [raw.hex() for raw in self._sent],
            "events": self._log[:],
            "warnings": self.link.warnings[:],
        }
        if self.reason:
            report["reason"] = self.reason
        self._sent.clear()
        self._log.clear()
        self.link.warnings.clear()
        return report

    def close(self) -> None:
        """Stop frames that wait for triggers, if the board still answers, and close the link."""
        try:
            if self.poll() in (State.ARMED, State.RUNNING):
                self._stop()
        except DeviceError:
            # The board does not answer any more; its link is closed in any case.
            pass
        finally:
            self.words.close()

    def fail(self, reason: str) -> None:
        """Enter `FAULT`; the first reason is kept."""
        if self._state is not State.FAULT:
            self.reason = reason
            self._state = State.FAULT

    def _stop(self) -> None:
        """Stop frames that wait for triggers, after one frame period, because a stop is forbidden during a frame."""
        self.clock.sleep(self.program.frame_period_us * 1e-6)
        self.poll()
        if self._state in (State.ARMED, State.RUNNING):
            self.link.call(c.FrameControl(c.STOP_WHILE_WAITING))
            self.link.wait_for((e.FRAME_END,), _READY_TIMEOUT_S, self._note)
            self._state = State.CONFIGURED

    def _wait(self, event_id: int, timeout_s: float) -> e.Event:
        return self.link.wait_for((event_id,), timeout_s, self._on_event)

    def _note(self, event: e.Event) -> None:
        """Log an event. Raises DeviceError for a fatal one."""
        self.log_event(str(event))
        if event.fatal:
            self.fail(str(event))
            raise fault_error(self.name, str(event))

    def log_event(self, line: str) -> None:
        """Log an event for the report, up to `_MAX_EVENTS`."""
        if len(self._log) < _MAX_EVENTS:
            self._log.append(line)

    def _on_event(self, event: e.Event) -> None:
        """Log an event and change the state by it."""
        self.log_event(str(event))
        if event.fatal:
            self.fail(str(event))
        elif event.id == e.FRAME_END and self._state in (State.ARMED, State.RUNNING):
            self._state = State.DONE
        elif event.id == e.TRIGGER_READY and self._state in (State.CONFIGURED, State.DONE):
            self._state = State.ARMED

    @contextmanager
    def _fault_on_error(self) -> Iterator[None]:
        """Enter `FAULT` if the block raises anything."""
        try:
            yield
        except BaseException as error:
            reason = str(error)
            if isinstance(error, PolysightError):
                reason = error.what
            self.fail(reason)
            raise
