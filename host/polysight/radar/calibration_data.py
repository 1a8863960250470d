"""Save the results of a board's RF init to a file and restore them at its next starts.

Each power-up calibrates RX gains and filters slightly differently; restored values stay the same. There is one file for
each die (chip) and each set of settings. Only the calibrations that TI recommends are restored; clocks and synthesizers
calibrate at every start. "ICD 70" is page 70 of the document that `messages` names. Not run on hardware yet.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from polysight.radar import messages
from polysight.radar.commands import Command
from polysight.radar.link import Link
from polysight_shared.errors import ConfigError, DeviceError, ErrorCode
from polysight_shared.files import read_bounded

# The calibration data is read and written in parts (ICD 70).
PARTS = 3
PART_BYTES = 224
# Masks of calibrations. Restored: ADC offset, both filters, RX gain, I/Q, which TI recommends (ICD 72).
RESTORED_CALIBRATIONS = 0x14E0
# Calibrations of the RF init (ICD 63).
ALL_CALIBRATIONS = 0x1FF0
# Die ids that do not identify a board: zeros, and that of firmware that cannot report it.
NO_DIE = "-".join(["00000000"] * 4)
UNKNOWN_DIE = "unknown"
NO_DIES = (NO_DIE, UNKNOWN_DIE)
# A larger file is not ours: it has 1,344 hexadecimal digits and little else.
_MAX_FILE_BYTES = 2**16
# Offset of the temperature at the calibration in the data, int16 in degrees Celsius.
_TEMPERATURE_BYTE = 16
_REMEDY = "delete the file: the board then calibrates itself, and a new file is written"


@dataclass(frozen=True)
class InitCalibrations(Command):
    """Select the calibrations of the next RF init; the others must have been restored (ICD 63)."""

    ID = 0x0089
    mask: int = ALL_CALIBRATIONS

    def data(self) -> bytes:
        """Pack the mask, and two reserved words."""
        return struct.pack("<3I", self.mask, 0, 0)


@dataclass(frozen=True)
class SaveCalibration(Command):
    """Request one of three parts of the calibration data (ICD 70)."""

    ID = 0x00AB
    part: int

    def data(self) -> bytes:
        """Pack a reserved half word and the part's number."""
        return struct.pack("<2H", 0, self.part)


@dataclass(frozen=True)
class RestoreCalibration(Command):
    """Send one of three parts of the calibration data; event 0x1004 follows the last one (ICD 66)."""

    ID = 0x008B
    part: int
    content: bytes

    def __str__(self) -> str:
        return f"part {self.part} of its calibration data"

    def data(self) -> bytes:
        """Pack the part; TI's library sends the number of parts in a field that the ICD calls reserved."""
        return struct.pack("<2H", PARTS, self.part) + self.content


class CalibrationFiles:
    """A folder with one file for each die and each set of rig settings (a digest in the file's name)."""

    def __init__(self, folder: Path, settings: bytes) -> None:
        self._folder = folder
        self._digest = f"{zlib.crc32(settings):08x}"

    def path(self, die_id: str) -> Path:
        """Return the file of a die."""
        return self._folder / f"{die_id}-{self._digest}.json"

    def load(self, die_id: str) -> bytes | None:
        """Return a die's data; None if there is no file. Raises ConfigError if the file is damaged."""
        path = self.path(die_id)
        if not path.exists():
            return None
        try:
            content = json.loads(read_bounded(path, _MAX_FILE_BYTES))
            data = bytes.fromhex(content["data"])
            is_of_die = content["die_id"] == die_id and len(data) == PARTS * PART_BYTES
            is_sound = is_of_die and zlib.crc32(data) == content["crc32"]
        except (ValueError, KeyError, TypeError, RecursionError):
            is_sound = False
            data = b""
        if not is_sound:
            raise ConfigError(
                f"{path}: is not the calibration data of {die_id}",
                "it is damaged, or another board's",
                _REMEDY,
                code=ErrorCode.FILE_DAMAGED,
            )
        return data

    def save(self, die_id: str, data: bytes) -> None:
        """Write a die's file atomically. Raises ConfigError if it cannot be written."""
        path = self.path(die_id)
        temperature = _read_temperature_c(data)
        content = {"die_id": die_id, "temperature_c": temperature, "crc32": zlib.crc32(data), "data": data.hex()}
        part = path.with_suffix(".part")
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            part.write_text(json.dumps(content), encoding="utf-8")
            part.replace(path)
        except OSError as error:
            raise ConfigError(
                f"radar.calibration_dir: {path} cannot be written: {error.strerror}",
                "the path is wrong, a permission is missing, or the disk is full",
                "correct calibration_dir, or remove it",
                code=ErrorCode.FILE_UNWRITABLE,
            ) from None


def _read_temperature_c(data: bytes) -> int:
    """Return the temperature of the board at its calibration."""
    return struct.unpack_from("<h", data, _TEMPERATURE_BYTE)[0]


def read_calibration(link: Link, name: str) -> bytes:
    """Read the results of the board's last RF init, 672 bytes. Raises DeviceError."""
    data = b""
    for part in range(PARTS):
        blocks = link.call(SaveCalibration(part)).blocks
        # Four bytes come before the data: the number of parts, and that of this one.
        if not blocks or len(blocks[0].data) != PART_BYTES + 4:
            raise DeviceError(
                f"{name}: the answer has no calibration data",
                "unknown firmware",
                "remove calibration_dir",
                code=ErrorCode.MESSAGE_INVALID,
            )
        if struct.unpack_from("<2H", blocks[0].data) != (PARTS, part):
            raise DeviceError(
                f"{name}: the answer has not part {part} of the calibration",
                "unknown firmware",
                _REMEDY,
                code=ErrorCode.MESSAGE_INVALID,
            )
        data += blocks[0].data[4:]
    return data


def restore_calibration(
    link: Link, name: str, data: bytes, timeout_s: float, note: Callable[[messages.Event], None]
) -> str:
    """Send a board the calibration of an earlier start and exclude it from the next RF init; return a description.

    `note` is called with every event until the board has taken it over, for at most `timeout_s`. Raises DeviceError if
    the board does not accept it.
    """
    # The first two words select the calibrations to restore: only those that TI recommends.
    selected_data = struct.pack("<2I", RESTORED_CALIBRATIONS, RESTORED_CALIBRATIONS) + data[8:]
    for part in range(PARTS):
        link.call(RestoreCalibration(part, selected_data[PART_BYTES * part : PART_BYTES * (part + 1)]))
    event = link.wait_for((messages.RF_INIT_DONE,), timeout_s, note)
    passed = event.values.get("passed")
    if not isinstance(passed, int) or passed & RESTORED_CALIBRATIONS != RESTORED_CALIBRATIONS:
        raise DeviceError(
            f"{name}: does not accept its calibration data: {event}",
            "the firmware has changed since",
            _REMEDY,
            code=ErrorCode.REFUSED_BY_PEER,
        )
    link.call(InitCalibrations(ALL_CALIBRATIONS & ~RESTORED_CALIBRATIONS))
    return f"calibration restored, made at {_read_temperature_c(data)} C"
