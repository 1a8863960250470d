"""Firmware images for simulated boards: TI's file format without a program.

The format is that of public copies of TI's `xwr22xx_metaImage.bin` (7,940 bytes): `MSTR`, length without the CRC at
byte 20, `MEND`, an `RPRC` part for the main core at byte 128 and one for the RF core after it, CRC-32 at the end. A
part has its ROM version at offset 56 and the patch version at 72: major, minor, build, debug, year, month, day.
"""

from __future__ import annotations

import struct
import zlib

METAHEADER_NOT_FOUND, METAHEADER_CRC_FAILURE, MSSIMAGE_NOT_FOUND = 1 << 6, 1 << 30, 1 << 28  # ICD table 7.3
_ROM = bytes((2, 2, 1, 7, 20, 3, 17))
_MAIN_PATCH, _RF_PATCH = bytes((2, 2, 2, 0, 20, 7, 29)), bytes((2, 2, 4, 0, 22, 7, 6))
_MAIN_AT, _RF_AT = 0x80, 0x880


def make_image(size: int = 7940, *, rom: bytes = _ROM) -> bytes:
    """Make an image of `size` bytes from which a simulated board boots."""
    filler = bytes(n * 7 % 251 for n in range(size - 4))
    image = bytearray(filler)
    image[:0x80] = struct.pack("<4s5I", b"MSTR", 2, 0x37, 0, 0, size - 4).ljust(0x5C, b"\0") + b"MEND".ljust(
        0x24, b"\0"
    )
    for at, patch in ((_MAIN_AT, _MAIN_PATCH), (_RF_AT, _RF_PATCH)):
        image[at : at + 0x60] = b"RPRC".ljust(0x38, b"\0") + rom.ljust(0x10, b"\0") + patch.ljust(0x18, b"\0")
    return bytes(image) + zlib.crc32(image).to_bytes(4, "little")


def boot_errors(image: bytes) -> int:
    """Return the status bits of a boot from this image (ICD table 7.3); 0 if it succeeds."""
    if image[:4] != b"MSTR":
        return METAHEADER_NOT_FOUND | MSSIMAGE_NOT_FOUND
    length = int.from_bytes(image[20:24], "little")
    if len(image) < length + 4 or zlib.crc32(image[:length]) != int.from_bytes(image[length : length + 4], "little"):
        return METAHEADER_CRC_FAILURE
    return 0


def patch_of(image: bytes, main: bool) -> bytes:
    """Return the last six bytes of a version answer (ICD tables 5.66, 5.157): major, minor, date, build and debug."""
    at = (_MAIN_AT if main else _RF_AT) + 0x48
    major, minor, build, debug, *date = image[at : at + 7]
    return bytes((major, minor, *date, build << 4 | debug))
