"""Firmware images for simulated boards: TI's outer form around nothing that could run.

The form is that of TI's `xwr22xx_metaImage.bin` (7,940 bytes) as public copies show it: `MSTR`, length of all but the
CRC at byte 20, `MEND`, an `RPRC` part at byte 128 for the main core and one behind it for the RF core, CRC-32 at the
end. Each part holds the ROM version it patches 56 bytes from its begin, and the patch's 72 bytes from it: major, minor,
build, debug, year, month, day.
"""

from __future__ import annotations

import struct
import zlib

METAHEADER_NOT_FOUND, METAHEADER_CRC_FAILURE, MSSIMAGE_NOT_FOUND = 1 << 6, 1 << 30, 1 << 28  # ICD table 7.3
_ROM = bytes((2, 2, 1, 7, 20, 3, 17))
_MAIN_PATCH, _RF_PATCH = bytes((2, 2, 2, 0, 20, 7, 29)), bytes((2, 2, 4, 0, 22, 7, 6))
_MAIN_AT, _RF_AT = 0x80, 0x880


def make_image(size: int = 7940, *, rom: bytes = _ROM) -> bytes:
    """An image of so many bytes that a board boots from."""
    filler = bytes(n * 7 % 251 for n in range(size - 4))
    image = bytearray(filler)
    image[:0x80] = struct.pack("<4s5I", b"MSTR", 2, 0x37, 0, 0, size - 4).ljust(0x5C, b"\0") + b"MEND".ljust(
        0x24, b"\0"
    )
    for at, patch in ((_MAIN_AT, _MAIN_PATCH), (_RF_AT, _RF_PATCH)):
        image[at : at + 0x60] = b"RPRC".ljust(0x38, b"\0") + rom.ljust(0x10, b"\0") + patch.ljust(0x18, b"\0")
    return bytes(image) + zlib.crc32(image).to_bytes(4, "little")


def boot_errors(image: bytes) -> int:
    """Status bits of a device that boots from this (ICD table 7.3); 0 when it does."""
    if image[:4] != b"MSTR":
        return METAHEADER_NOT_FOUND | MSSIMAGE_NOT_FOUND
    length = int.from_bytes(image[20:24], "little")
    if len(image) < length + 4 or zlib.crc32(image[:length]) != int.from_bytes(image[length : length + 4], "little"):
        return METAHEADER_CRC_FAILURE
    return 0


def patch_of(image: bytes, main: bool) -> bytes:
    """The last six bytes of a version answer (ICD tables 5.66, 5.157): major, minor, date, build and debug."""
    at = (_MAIN_AT if main else _RF_AT) + 0x48
    major, minor, build, debug, *date = image[at : at + 7]
    return bytes((major, minor, *date, build << 4 | debug))
