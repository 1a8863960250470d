"""From reset to configured: the steps of one board's bring-up, each with what came of it in words.

`RadarBoard.configure` runs them all, `polysight radar check` shows them one by one. What healthy boards report at
power-up, and how far it is passed over, is in docs/spec/mmwavelink.md ("Power-up"). Not run on hardware yet.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import NamedTuple

from polysight.host.radar import commands as c
from polysight.host.radar import events as e
from polysight.host.radar.calibration_data import NO_DIE, CalibrationFiles, read_calibration, restore_calibration
from polysight.host.radar.firmware import (
    TO_FLASH,
    TO_RAM,
    Image,
    describe_patch,
    require_family,
    require_rom,
    send_image,
)
from polysight.host.radar.lab_commands import ALL_CALIBRATIONS, RESTORED_CALIBRATIONS
from polysight.host.radar.messages import Message
from polysight.host.radar.program import Program
from polysight.host.radar.spi import Clock, Link, NotReportedError, StartedAnewError, WordLink
from polysight.shared.errors import DeviceError

POWER_UP_S = 5.0
_CALIBRATION_S = 5.0
_BOOTED_S = 5.0
_RESET_HELD_S = 0.1
_FIRMWARE = (
    "set radar.firmware to TI's image, or write it once: `polysight radar firmware` (docs/how-to/radar-bring-up.md)"
)
_JUMPERS = "SOP0 set, SOP1 and SOP2 open; see the picture in docs/how-to/radar-bring-up.md"


class Step(NamedTuple):
    """One step.

    Attributes
    ----------
    name, expected, do
        In plain words: what is done, what should come, what to do when it does not.
    run
        Does it and returns what came. Raises DeviceError, ConfigError.
    """

    name: str
    expected: str
    do: str
    run: Callable[[], str]


class BringUp:
    """One board's way up; made anew for each.

    Parameters
    ----------
    firmware
        Downloaded to RAM when the board does not hold it; None: what its flash holds.
    die_id
        The only board that is accepted; "" for any.
    calibration
        Where what an RF init found is kept; None: each start calibrates anew.
    facts
        Where what the board says of itself is kept.
    log
        Told every event, as text.
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
        self._passed_over: list[str] = []
        self._cure, self._had, self._damage, self._held = "", "", "", False

    def power_steps(self) -> list[Step]:
        """Until both cores run."""
        return [
            Step("reset", "the main core's power-up event within a second", f"power, reset, {_JUMPERS}", self._reset),
            Step("firmware", "the image is in RAM, or in the flash already", _FIRMWARE, self._load),
            Step("RF power-up", "the RF core's power-up event", "reset; power-cycle the board", self._rf_up),
        ]

    def rf_steps(self) -> list[Step]:
        """Until the RF core is calibrated."""
        return [
            Step("versions", "both cores with a patch", _FIRMWARE, self._versions),
            Step("settings", f"{len(self._program.basic)} acknowledgements", "compare with `plan`", self._basic),
            Step(
                "RF init",
                "calibrated, all that the board needs passed",
                "clock, RF supplies; power-cycle it",
                self._rf_init,
            ),
        ]

    def waveform_steps(self) -> list[Step]:
        """Until chirp and data path are set."""
        return [
            Step("chirp", f"{len(self._program.waveform)} acknowledgements", "compare with `plan`", self._waveform),
            Step("die id", "the board that the rig file names", "put the boards back, or correct die_id", self._die),
        ]

    def blame(self, error: DeviceError) -> DeviceError:
        """The same error; what was passed over before it stands behind its own cause."""
        if not self._passed_over:
            return error
        seen = "; ".join(dict.fromkeys(self._passed_over))
        return DeviceError(error.what, f"{error.why}; it had reported before: {seen}", error.remedy)

    def write_flash(self, image: Image, progress: Callable[[int, int], None]) -> str:
        """Write an image to the flash, start the board from it, and verify; for a board in any state.

        Raises
        ------
        DeviceError, ConfigError
            when a part is not taken, or the board does not start from its flash afterwards.
        """
        self._reset()
        before = self._same_rom(image)
        send_image(self._link, self._name, image, TO_FLASH, progress)
        self._passed_over.clear()
        self._reset()
        if self._cure == "firmware":
            raise DeviceError(
                f"{self._name}: starts, but not from its flash: {'; '.join(self._passed_over)}",
                "the flash does not hold what was sent: power lost meanwhile, or a worn flash",
                "download it again; radar.firmware starts it from RAM until then",
            )
        after = self._main_patch()
        self._verify(after, before, image)
        self._sound()
        if self._die_id:  # it can be asked only once the RF core runs, so only behind the writing
            self._rf_up()
            self._ask_die()
        return f"main core's patch {after} from flash (before: {before})"

    def _reset(self) -> str:
        self._words.reset(held=True)
        self._clock.sleep(_RESET_HELD_S)
        self._link.restart()
        self._words.reset(held=False)
        try:
            up = self._link.wait_for((e.MAIN_POWER_UP,), POWER_UP_S, self.note)
        except NotReportedError as error:
            raise NotReportedError(
                error.what,
                f"no power on the radar board, its jumpers are not in functional mode ({_JUMPERS}), or {error.why}",
                f"the power supply of the radar board (its own 5 V plug), the jumpers, then the reset; {error.remedy}",
            ) from None
        self._boot_status(up)
        return str(up)

    def _boot_status(self, event: e.Event) -> None:
        self._facts["boot"] = dict(event.values)
        self._cure = str(event.values.get("cure", ""))
        if event.detail:
            self._passed_over.append(str(event))
        if self._cure == "hardware":
            self._damage = str(event)

    def _sound(self) -> None:
        """Refuse a board that found a fault of its own in any of its starts; only a download may come before it.

        Raises DeviceError.
        """
        if self._damage:
            raise DeviceError(
                f"{self._name}: {self._damage}", "the device's own start-up test failed", "replace the board"
            )

    def _load(self) -> str:
        came = self._into_ram(self._firmware) if self._firmware is not None else "none asked for"
        if self._firmware is None and self._cure == "firmware":
            came = "the flash is empty or broken, and no image is given"
        self._sound()
        return came

    def _into_ram(self, image: Image) -> str:
        self._had = has = self._same_rom(image)
        if has == image.patches[0] and self._cure != "firmware":
            self._held = True
            return f"the flash holds the main core's patch {has} already; nothing is sent"
        send_image(self._link, self._name, image, TO_RAM)
        self._boot_from_ram(image)
        return f"{image.name} in RAM"

    def _boot_from_ram(self, image: Image) -> None:
        try:
            booted = self._booted()
        except NotReportedError as error:
            self._passed_over.append(f"no event 0x{e.BOOT_STATUS:04X} after the download")
            self._log(error.what)
            return
        self._passed_over.clear()
        self._boot_status(booted)
        if self._cure == "firmware":
            raise DeviceError(
                f"{self._name}: refuses {image.name}: {booted}", "an image for another device", "TI's image for AWR2243"
            )

    def _booted(self) -> e.Event:
        """The event that a download to RAM ends with (ICD 6.1); a power-up event alone is no start from RAM."""
        self._link.may_start = True
        came = self._link.wait_for((e.BOOT_STATUS, e.MAIN_POWER_UP), _BOOTED_S, self.note)
        if came.id == e.BOOT_STATUS:
            self._link.may_start = False
            return came
        try:
            return self._link.wait_for((e.BOOT_STATUS,), _BOOTED_S, self.note)
        except NotReportedError:
            raise StartedAnewError(self._name) from None

    def _same_rom(self, image: Image) -> str:
        """The main core's patch now, once its ROM is known to be the one that the image is for."""
        answer = data_of(self._name, self._link.call(c.GET_MAIN_VERSION), c.GET_MAIN_VERSION, 16)
        require_rom(self._name, answer, image)
        return _patch(answer)

    def _main_patch(self) -> str:
        return _patch(data_of(self._name, self._link.call(c.GET_MAIN_VERSION), c.GET_MAIN_VERSION, 16))

    def _verify(self, patch: str, before: str, image: Image) -> None:
        """A patch that is still the old one is an error. Where TI keeps it in the file is not documented, so another
        one than the file's is only told.
        """
        told = f"{self._name}: reports patch {patch} after the download, {image.name} holds {image.patches[0]}"
        if patch == image.patches[0]:
            return
        if patch in (before, _NO_PATCH):
            raise DeviceError(
                told, "it did not start from what was sent", "switch its power off and on, then `polysight radar check`"
            )
        self._link.warnings.append(told)

    def _verify_rf(self, patch: str, image: Image) -> None:
        """The RF core's patch is known only once that core runs: another one than the file's is told."""
        if patch != image.patches[1]:
            held = f"from its flash; `polysight radar firmware {self._name} {image.name} --flash` writes both cores'"
            self._link.warnings.append(
                f"{self._name}: its RF core reports patch {patch}, {image.name} holds {image.patches[1]}"
                + (f": it runs {held}" if self._held else "")
            )

    def _rf_up(self) -> str:
        self._link.call(c.DeviceConfiguration())
        self._link.call(c.RF_POWER_UP)
        up = self._link.wait_for((e.RF_POWER_UP_DONE,), POWER_UP_S, self.note)
        self._facts["rf_tests_passed"] = up.values.get("tests_passed", 0)
        if up.detail:
            self._passed_over.append(str(up))
        return str(up)

    def _versions(self) -> str:
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
                    "this board's flash holds no firmware, and none was downloaded",
                    _FIRMWARE,
                )
            if self._firmware is not None and core == "RF":
                self._verify_rf(_patch(v), self._firmware)
            elif self._firmware is not None:
                self._verify(_patch(v), self._had, self._firmware)
        if self._die_id:
            self._ask_die()  # before anything of another board is powered
        return f"RF {self._facts['rf_firmware']}, main {self._facts['main_firmware']}"

    def _basic(self) -> str:
        for command in self._program.basic:
            self._link.call(command)
        return "acknowledged"

    def _rf_init(self) -> str:
        die, kept, restored = "", None, ""
        if self._calibration is not None:
            die = self._ask_die()
            if die == NO_DIE:
                self._link.warnings.append(f"{self._name}: its die id is 0: no calibration is kept for it")
            else:
                kept = self._calibration.load(die)
        if kept is not None:
            restored = "; " + restore_calibration(self._link, self._name, kept, _CALIBRATION_S, self.note)
        self._link.call(c.RF_INIT)
        event = self._link.wait_for((e.RF_INIT_DONE,), _CALIBRATION_S, self.note)
        self._facts["calibration"] = dict(event.values)
        asked = ALL_CALIBRATIONS & ~RESTORED_CALIBRATIONS if restored else ALL_CALIBRATIONS
        if failed := e.failed_calibrations(event, self._program.transmits, asked):
            raise DeviceError(
                f"{self._name}: RF init did not pass: {', '.join(failed)} ({event})",
                "no reference clock, an RF supply out of range, or a damaged RF part",
                "measure the RF supplies; switch its power off and on; replace the board if it stays",
            )
        if self._calibration is not None and kept is None and die != NO_DIE:
            self._calibration.save(die, read_calibration(self._link, self._name))
        self._facts["calibration_restored"] = bool(restored)
        return str(event) + restored

    def _waveform(self) -> str:
        for command in self._program.waveform:
            self._link.call(command)
        return "acknowledged"

    def _die(self) -> str:
        came = self._ask_die()
        for event in self._link.poll():
            self.note(event)
        return came

    def _ask_die(self) -> str:
        try:
            data = data_of(self._name, self._link.call(c.GET_DIE_ID), c.GET_DIE_ID, 16)
        except DeviceError as error:
            if self._die_id or "refuses" not in error.what:
                raise
            self._log(error.what)  # a firmware that does not know the question
            return "not told"
        die = "-".join(f"{word:08x}" for word in struct.unpack_from("<4I", data))
        self._facts["die_id"] = die
        if self._die_id and die != self._die_id:
            raise DeviceError(
                f"{self._name}: the board there has die id {die}, the rig file names {self._die_id}",
                "two boards, or their USB cables, were exchanged",
                f"put them back, or correct radar.native.{self._name}.die_id",
            )
        return die

    def note(self, event: e.Event) -> None:
        """Keep an event; a fatal one ends what is being done, but for the main core's fault that healthy boards report.

        Raises DeviceError.
        """
        self._log(str(event))
        if event.id == e.MAIN_CPU_FAULT:
            if event.fatal:
                self._passed_over.append(str(event))
        elif event.fatal:
            raise DeviceError(
                f"{self._name}: {event}", "the radar stopped itself", "it is reset when the row is retaken"
            )


_NO_PATCH = describe_patch(0, 0, 0, 0)


def _patch(version: bytes) -> str:
    return describe_patch(version[10], version[11], version[15] >> 4, version[15] & 15)


def data_of(name: str, answer: Message, question: c.Command, least: int) -> bytes:
    """The sub-block of an answer that was asked for. Raises DeviceError when it is not there."""
    for block in answer.blocks:
        if block.id == question.ID and len(block.data) >= least:
            return block.data
    raise DeviceError(
        f"{name}: the answer to 0x{question.ID:04X} does not hold it",
        "another device or firmware",
        "check the firmware",
    )
