"""What a board's RF init found, kept in a file for its next starts, so that it starts as it was calibrated.

RX gains and filters are calibrated anew at each power-up and then differ a little; restored they are the same. One file
a die; only what TI recommends is restored, clocks and synthesizers calibrate at every start (ICD 70-74). Not run on
hardware yet.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

from polysight.host.radar import events as e
from polysight.host.radar.lab_commands import (
    ALL_CALIBRATIONS,
    CALIBRATION_PART_BYTES,
    CALIBRATION_PARTS,
    RESTORED_CALIBRATIONS,
    InitCalibrations,
    RestoreCalibration,
    SaveCalibration,
)
from polysight.host.radar.spi import Link
from polysight.shared.errors import ConfigError, DeviceError
from polysight.shared.files import read_bounded

_BYTES = CALIBRATION_PARTS * CALIBRATION_PART_BYTES
NO_DIE = "-".join(["00000000"] * 4)  # tells no boards apart
_LARGEST_BYTES = 2**16
_DO = "remove the file: the board then calibrates itself, and a new one is written"


class CalibrationFiles:
    """One file a die in a folder. What the rig's settings were is part of its name: other settings, other file."""

    def __init__(self, folder: Path, settings: bytes) -> None:
        self._folder, self._digest = folder, f"{zlib.crc32(settings):08x}"

    def path(self, die_id: str) -> Path:
        """Where a die's data is."""
        return self._folder / f"{die_id}-{self._digest}.json"

    def load(self, die_id: str) -> bytes | None:
        """A die's data; None when there is none. Raises ConfigError when the file is damaged."""
        path = self.path(die_id)
        if not path.exists():
            return None
        try:
            told = json.loads(read_bounded(path, _LARGEST_BYTES))
            data = bytes.fromhex(told["data"])
            sound = told["die_id"] == die_id and len(data) == _BYTES and zlib.crc32(data) == told["crc32"]
            passed = int.from_bytes(data[:4], "little")  # of the RF init that it was saved from (ICD 71)
        except (ValueError, KeyError, TypeError, RecursionError):
            sound, data, passed = False, b"", 0
        if sound and passed & RESTORED_CALIBRATIONS != RESTORED_CALIBRATIONS:
            raise ConfigError(
                f"{path}: is of a start whose RF init did not pass", "saved before that was looked at", _DO
            )
        if not sound:
            raise ConfigError(f"{path}: is not the calibration data of {die_id}", "damaged, or another board's", _DO)
        return data

    def save(self, die_id: str, data: bytes) -> Path:
        """Write a die's data; the file is whole or not there. Raises OSError."""
        path = self.path(die_id)
        self._folder.mkdir(parents=True, exist_ok=True)
        temperature = struct.unpack_from("<h", data, 16)[0]
        told = {"die_id": die_id, "temperature_c": temperature, "crc32": zlib.crc32(data), "data": data.hex()}
        part = path.with_suffix(".part")
        part.write_text(json.dumps(told), encoding="utf-8")
        part.replace(path)
        return path


def read_calibration(link: Link, name: str) -> bytes:
    """What the board's last RF init found, 672 bytes. Raises DeviceError."""
    data = b""
    for part in range(CALIBRATION_PARTS):
        blocks = link.call(SaveCalibration(part)).blocks
        if not blocks or len(blocks[0].data) != CALIBRATION_PART_BYTES + 4:
            raise DeviceError(
                f"{name}: no calibration data in its answer", "another firmware", "leave calibration_dir out"
            )
        if struct.unpack_from("<2H", blocks[0].data) != (CALIBRATION_PARTS, part):
            raise DeviceError(f"{name}: part {part} of its calibration is another", "another firmware", _DO)
        data += blocks[0].data[4:]
    return data


def restore_calibration(link: Link, name: str, data: bytes, limit_s: float, note: Callable[[e.Event], None]) -> str:
    """Give a board the calibration of an earlier start; its next RF init then runs the others only.

    Raises DeviceError when the board does not take it.
    """
    valid = struct.pack("<2I", RESTORED_CALIBRATIONS, RESTORED_CALIBRATIONS) + data[8:]
    for part in range(CALIBRATION_PARTS):
        link.call(RestoreCalibration(part, valid[CALIBRATION_PART_BYTES * part : CALIBRATION_PART_BYTES * (part + 1)]))
    told = link.wait_for((e.RF_INIT_DONE,), limit_s, note)
    passed = told.values.get("passed")
    if not isinstance(passed, int) or passed & RESTORED_CALIBRATIONS != RESTORED_CALIBRATIONS:
        raise DeviceError(f"{name}: does not take its calibration back: {told}", "another firmware than then", _DO)
    link.call(InitCalibrations(ALL_CALIBRATIONS & ~RESTORED_CALIBRATIONS))
    return f"calibrated at {struct.unpack_from('<h', data, 16)[0]} C before"
