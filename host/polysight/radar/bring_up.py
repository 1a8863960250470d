"""Steps of a board's bring-up, from reset to configured.

`RadarBoard.configure` runs all steps; `polysight radar check` also prints them. docs/spec/mmwavelink.md ("Power-up")
lists the errors that healthy boards report at power-up and that are ignored. Not run on hardware yet.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import NamedTuple

from polysight.radar import commands as c
from polysight.radar import events as e
from polysight.radar.calibration_data import (
    ALL,
    NO_DIE,
    RESTORED,
    CalibrationFiles,
    read_calibration,
    restore_calibration,
)
from polysight.radar.firmware import (
    TO_FLASH,
    TO_RAM,
    Image,
    describe_patch,
    require_family,
    require_rom,
    send_image,
)
from polysight.radar.messages import Message
from polysight.radar.program import Program
from polysight.radar.spi import Clock, Link, NotReportedError, UnexpectedRestartError, WordLink
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DeviceError

POWER_UP_TIMEOUT_S = 5.0
_CALIBRATION_TIMEOUT_S = 5.0
_BOOT_TIMEOUT_S = 5.0
_RESET_S = 0.1
_FIRMWARE = (
    "set radar.firmware to TI's image, or write it once: `polysight radar firmware` (docs/how-to/radar-bring-up.md)"
)
_JUMPERS = "SOP0 set, SOP1 and SOP2 open; see docs/how-to/radar-bring-up.md"


class Step(NamedTuple):
    """One step. `run` executes it and returns its outcome; it raises DeviceError or ConfigError."""

    name: str
    expected: str
    remedy: str
    run: Callable[[], str]


class BringUp:
    """State of one bring-up of a board.

    Parameters
    ----------
    firmware
        Image for RAM, if the board's flash does not contain it; None: use the flash.
    die_id
        Required die id; "" accepts any board.
    calibration
        Files of RF init results; None: calibrate at each start.
    facts
        Receives versions, die id and results of the board.
    log
        Called with each event as text.
    """

    def __init__(
        self,
        name: str,
        link: Link,
        words: WordLink,
        clock: Clock,
        program: Program,
        firmware: Image | None,
        die_id: str,
        calibration: CalibrationFiles | None,
        facts: dict[str, object],
        log: Callable[[str], None],
    ) -> None:
        self._name, self._link, self._words, self._clock, self._program = name, link, words, clock, program
        self._firmware, self._die_id, self._facts, self._log = firmware, die_id, facts, log
        self._calibration = calibration
        self._ignored: list[str] = []  # errors that healthy boards report, too
        self._cure, self._flash_patch, self._damage, self._from_flash = "", "", "", False

    def power_steps(self) -> list[Step]:
        """Return the steps until both cores run."""
        return [
            Step("reset", "the main core's power-up event within a second", f"power, reset, {_JUMPERS}", self._reset),
            Step("firmware", "the image is in RAM, or already in the flash", _FIRMWARE, self._load_firmware),
            Step("RF power-up", "the RF core's power-up event", "reset; power-cycle the board", self._rf_up),
        ]

    def rf_steps(self) -> list[Step]:
        """Return the steps until the RF core is calibrated."""
        return [
            Step("versions", "both cores with a patch", _FIRMWARE, self._check_versions),
            Step("settings", f"{len(self._program.basic)} acknowledgements", "compare with `plan`", self._send_basic),
            Step(
                "RF init",
                "every calibration that the board needs passed",
                "clock, RF supplies; power-cycle it",
                self._rf_init,
            ),
        ]

    def waveform_steps(self) -> list[Step]:
        """Return the steps until chirp and data path are configured."""
        return [
            Step(
                "chirp", f"{len(self._program.waveform)} acknowledgements", "compare with `plan`", self._send_waveform
            ),
            Step("die id", "the board of the rig file", "exchange the boards, or correct die_id", self._check_die),
        ]

    def with_ignored(self, error: DeviceError) -> DeviceError:
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
        before = self._same_rom(image)
        send_image(self._link, self._name, image, TO_FLASH, progress)
        self._ignored.clear()
        self._reset()
        if self._cure == "firmware":
            raise DeviceError(
                f"{self._name}: starts, but not from its flash: {'; '.join(self._ignored)}",
                "the flash does not contain the image: a power failure during the download, or a worn flash",
                "download it again; until then radar.firmware starts the board from RAM",
                code=ErrorCode.RADAR_NO_FIRMWARE,
            )
        after = self._main_patch()
        self._verify(after, before, image)
        self._refuse_damaged()
        if self._die_id:  # only readable after the RF power-up
            self._rf_up()
            self._read_die()
        return f"main core's patch {after} from flash (before: {before})"

    def _reset(self) -> str:
        self._words.reset(held=True)
        self._clock.sleep(_RESET_S)
        self._link.restart()
        self._words.reset(held=False)
        try:
            up = self._link.wait_for((e.MAIN_POWER_UP,), POWER_UP_TIMEOUT_S, self.note)
        except NotReportedError as error:
            raise NotReportedError(
                error.what,
                f"no power on the radar board, jumpers not in functional mode ({_JUMPERS}), or {error.why}",
                f"check the 5 V supply of the radar board, the jumpers, then the reset; {error.remedy}",
                code=error.code,
            ) from None
        self._boot_status(up)
        return str(up)

    def _boot_status(self, event: e.Event) -> None:
        self._facts["boot"] = dict(event.values)
        self._cure = str(event.values.get("cure", ""))
        if event.detail:
            self._ignored.append(str(event))
        if self._cure == "hardware":
            self._damage = str(event)

    def _refuse_damaged(self) -> None:
        """Raise DeviceError if the board reported a hardware fault at any start of this bring-up."""
        if self._damage:
            raise DeviceError(
                f"{self._name}: {self._damage}",
                "the start-up self-test of the device failed",
                "replace the board",
                code=ErrorCode.RADAR_FAULT,
            )

    def _load_firmware(self) -> str:
        outcome = self._load_into_ram(self._firmware) if self._firmware is not None else "none configured"
        if self._firmware is None and self._cure == "firmware":
            outcome = "the flash is empty or damaged, and radar.firmware is not set"
        self._refuse_damaged()
        return outcome

    def _load_into_ram(self, image: Image) -> str:
        self._flash_patch = patch = self._same_rom(image)
        if patch == image.patches[0] and self._cure != "firmware":
            self._from_flash = True
            return f"the flash already contains the main core's patch {patch}; nothing is sent"
        send_image(self._link, self._name, image, TO_RAM)
        self._boot_from_ram(image)
        return f"{image.name} in RAM"

    def _boot_from_ram(self, image: Image) -> None:
        try:
            booted = self._booted()
        except NotReportedError as error:
            self._ignored.append(f"no event 0x{e.BOOT_STATUS:04X} after the download")
            self._log(error.what)
            return
        self._ignored.clear()
        self._boot_status(booted)
        if self._cure == "firmware":
            raise DeviceError(
                f"{self._name}: refuses {image.name}: {booted}",
                "an image for another device",
                "use TI's image for AWR2243",
                code=ErrorCode.REFUSED_BY_PEER,
            )

    def _booted(self) -> e.Event:
        """Wait for the event at the end of a download to RAM (ICD 6.1); a power-up event alone is another start."""
        self._link.may_start = True
        event = self._link.wait_for((e.BOOT_STATUS, e.MAIN_POWER_UP), _BOOT_TIMEOUT_S, self.note)
        if event.id == e.BOOT_STATUS:
            self._link.may_start = False
            return event
        try:
            return self._link.wait_for((e.BOOT_STATUS,), _BOOT_TIMEOUT_S, self.note)
        except NotReportedError:
            raise UnexpectedRestartError(self._name) from None

    def _same_rom(self, image: Image) -> str:
        """Return the main core's patch. Raises ConfigError if the image is for another ROM."""
        answer = data_of(self._name, self._link.call(c.GET_MAIN_VERSION), c.GET_MAIN_VERSION, 16)
        require_rom(self._name, answer, image)
        return _patch(answer)

    def _main_patch(self) -> str:
        return _patch(data_of(self._name, self._link.call(c.GET_MAIN_VERSION), c.GET_MAIN_VERSION, 16))

    def _verify(self, patch: str, before: str, image: Image) -> None:
        """Raise DeviceError if the patch is still the old one; warn if it is not the file's.

        Its place in the file is not documented by TI, so the latter is no error.
        """
        what = f"{self._name}: reports patch {patch} after the download, {image.name} contains {image.patches[0]}"
        if patch == image.patches[0]:
            return
        if patch in (before, _NO_PATCH):
            raise DeviceError(
                what,
                "it did not start from the download",
                "power-cycle the board, then `polysight radar check`",
                code=ErrorCode.MISMATCH,
            )
        self._link.warnings.append(what)

    def _verify_rf(self, patch: str, image: Image) -> None:
        """Warn if the RF core's patch, which is known only when that core runs, is not the file's."""
        if patch != image.patches[1]:
            update = f"`polysight radar firmware {self._name} {image.name} --flash` writes both cores"
            self._link.warnings.append(
                f"{self._name}: its RF core reports patch {patch}, {image.name} contains {image.patches[1]}"
                + (f": it runs from the flash; {update}" if self._from_flash else "")
            )

    def _rf_up(self) -> str:
        self._link.call(c.DEVICE_CONFIGURATION)
        self._link.call(c.RF_POWER_UP)
        up = self._link.wait_for((e.RF_POWER_UP_DONE,), POWER_UP_TIMEOUT_S, self.note)
        self._facts["rf_tests_passed"] = up.values.get("tests_passed", 0)
        if up.detail:
            self._ignored.append(str(up))
        return str(up)

    def _check_versions(self) -> str:
        for core, key, question in (
            ("RF", "rf_firmware", c.GET_RF_VERSION),
            ("main", "main_firmware", c.GET_MAIN_VERSION),
        ):
            v = data_of(self._name, self._link.call(question), question, 16)
            hardware, release, patch = v[:3], v[3:7], (*v[10:12], v[15] >> 4, v[15] & 15)
            self._facts[key] = ".".join(map(str, release)) + " patch " + ".".join(map(str, patch))
            self._facts["hardware"] = ".".join(map(str, hardware))
            require_family(self._name, core, v)
            if not any(patch):
                raise DeviceError(
                    f"{self._name}: its {key.replace('_', ' ')} has no patch (version {self._facts[key]})",
                    "the flash of this board contains no firmware, and none was downloaded",
                    _FIRMWARE,
                    code=ErrorCode.RADAR_NO_FIRMWARE,
                )
            if self._firmware is not None and core == "RF":
                self._verify_rf(_patch(v), self._firmware)
            elif self._firmware is not None:
                self._verify(_patch(v), self._flash_patch, self._firmware)
        if self._die_id:
            self._read_die()  # before the RF part of a wrong board is powered
        return f"RF {self._facts['rf_firmware']}, main {self._facts['main_firmware']}"

    def _send_basic(self) -> str:
        for command in self._program.basic:
            self._link.call(command)
        return "acknowledged"

    def _rf_init(self) -> str:
        die, saved, restored = "", None, ""
        if self._calibration is not None:
            die = self._read_die()
            if die == NO_DIE:
                self._link.warnings.append(f"{self._name}: its die id is 0, so its calibration is not saved")
            else:
                saved = self._calibration.load(die)
        if saved is not None:
            restored = "; " + restore_calibration(self._link, self._name, saved, _CALIBRATION_TIMEOUT_S, self.note)
        self._link.call(c.RF_INIT)
        event = self._link.wait_for((e.RF_INIT_DONE,), _CALIBRATION_TIMEOUT_S, self.note)
        self._facts["calibration"] = dict(event.values)
        asked = ALL & ~RESTORED if restored else ALL
        if failed := e.failed_calibrations(event, self._program.transmits, asked):
            raise DeviceError(
                f"{self._name}: RF init failed: {', '.join(failed)} ({event})",
                "no reference clock, an RF supply out of range, or a damaged RF part",
                "measure the RF supplies; power-cycle the board; replace it if the fault remains",
                code=ErrorCode.RADAR_FAULT,
            )
        if self._calibration is not None and saved is None and die != NO_DIE:
            self._calibration.save(die, read_calibration(self._link, self._name))
        self._facts["calibration_restored"] = bool(restored)
        return str(event) + restored

    def _send_waveform(self) -> str:
        for command in self._program.waveform:
            self._link.call(command)
        return "acknowledged"

    def _check_die(self) -> str:
        die = self._read_die()
        for event in self._link.poll():
            self.note(event)
        return die

    def _read_die(self) -> str:
        try:
            data = data_of(self._name, self._link.call(c.GET_DIE_ID), c.GET_DIE_ID, 16)
        except DeviceError as error:
            if self._die_id or error.code is not ErrorCode.REFUSED_BY_PEER:
                raise
            self._log(error.what)  # a firmware without this command
            return "unknown"
        die = "-".join(f"{word:08x}" for word in struct.unpack_from("<4I", data))
        self._facts["die_id"] = die
        if self._die_id and die != self._die_id:
            raise DeviceError(
                f"{self._name}: this board has die id {die}, the rig file {self._die_id}",
                "two boards or their USB cables were exchanged",
                f"exchange them again, or correct radar.native.{self._name}.die_id",
                code=ErrorCode.MISMATCH,
            )
        return die

    def note(self, event: e.Event) -> None:
        """Log an event. Raises DeviceError for a fatal one, except the main core fault that healthy boards report."""
        self._log(str(event))
        if event.id == e.MAIN_CPU_FAULT:
            if event.fatal:
                self._ignored.append(str(event))
        elif event.fatal:
            raise DeviceError(
                f"{self._name}: {event}",
                "the radar stopped with a fault",
                "the retake of the row resets it",
                code=ErrorCode.RADAR_FAULT,
            )


_NO_PATCH = describe_patch(0, 0, 0, 0)


def _patch(version: bytes) -> str:
    return describe_patch(version[10], version[11], version[15] >> 4, version[15] & 15)


def data_of(name: str, answer: Message, question: c.Command, min_bytes: int) -> bytes:
    """Return the requested sub-block of an answer. Raises DeviceError if it is missing."""
    for block in answer.blocks:
        if block.id == question.ID and len(block.data) >= min_bytes:
            return block.data
    raise DeviceError(
        f"{name}: the answer to 0x{question.ID:04X} has no such data",
        "unknown device or firmware",
        "check the firmware",
        code=ErrorCode.MESSAGE_INVALID,
    )
