"""Read and check TI's firmware image, and download it to a board.

An image goes to the device's RAM, which the next reset clears, or to the serial flash; decision 11 has the reasons
(docs/decisions/0011-firmware-of-radars.md). The file format is that of public copies of TI's `xwr22xx_metaImage.bin`;
TI documents only magic and CRC. "ICD 302" is page 302 of the document that `messages` names. Not run on hardware yet.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from polysight.radar.commands import FileChunk
from polysight.radar.link import Link
from polysight.radar.messages import BODY_LIMIT
from polysight_shared.errors import ConfigError, DeviceError, ErrorCode
from polysight_shared.files import read_bounded

# File types of a download (ICD 302): the RAM, which the next reset clears, and the first of four flash areas.
TO_RAM = 0
TO_FLASH = 4
# TI's limit for each part; the first one is acknowledged after erasing the flash.
CHUNK_TIMEOUT_S = 10.0
# Size of a flash area, more than any image of TI.
MAX_BYTES = 2**20
# Major ROM version of AWR2243.
GENERATION = 2
# Device family by major ROM version.
FAMILIES = {
    1: "AWR1243 or another of the first generation",
    GENERATION: "AWR2243",
    6: "xWR6243, 57..64 GHz",
}
# An image has one program part for each core, in this order.
_CORES = ("main", "RF")

# An image is a header of 128 bytes, the program parts, and a CRC-32 of all before it. The header begins with a magic
# word, has the length without the CRC at byte 20, and a closing word; each part begins with its own magic word.
_MAGIC = b"MSTR"
_END = b"MEND"
_PART = b"RPRC"
_LENGTH_AT = 20
_HEADER_BYTES = 128
# Offsets in a program part of two versions, each of four bytes (followed by a date): ROM and patch.
_ROM_AT = 0x38
_PATCH_AT = 0x48
_VERSION_BYTES = 4
# Offset of the ROM's version in the answer to a version request (ICD tables 5.66 and 5.157).
_ROM_IN_ANSWER = 3
_REMEDY = "copy xwr22xx_metaImage.bin from TI's mmWave DFP 2.2 again, and compare its size with TI's"


@dataclass(frozen=True)
class Image:
    """A checked image.

    Attributes
    ----------
    name
        File name.
    data
        The whole file with its CRC.
    rom
        Version of the main core's ROM to which the patch applies: major, minor, build, debug.
    patches
        Version of each part's patch, main core first, in the form of `describe_patch`.
    """

    name: str
    data: bytes
    rom: tuple[int, ...]
    patches: tuple[str, ...]


def describe_patch(major: int, minor: int, build: int, debug: int) -> str:
    """Return a patch's version as text."""
    return f"{major}.{minor}.{build}.{debug}"


def read_image(path: Path) -> Image:
    """Read and check an image file.

    Raises
    ------
    OSError
        if it cannot be read.
    DataError
        if it is larger than `MAX_BYTES`, or not a regular file.
    ConfigError
        if it is not a complete, undamaged image for an AWR2243.
    """
    return check_image(read_bounded(path, MAX_BYTES), path.name)


def check_image(data: bytes, name: str) -> Image:
    """Check the bytes of a file. Raises ConfigError if they are not a complete, undamaged image for an AWR2243."""
    if data[:4] != _MAGIC:
        beginning = "nothing"
        if data:
            beginning = data[:12].decode("latin-1")
        raise _file_error(
            name, f"begins with {beginning!r} instead of {_MAGIC.decode()!r}", "another file, or an empty one"
        )
    if len(data) < _HEADER_BYTES:
        raise _file_error(name, f"{len(data)} bytes are too few for its header", "an interrupted copy")
    length = int.from_bytes(data[_LENGTH_AT : _LENGTH_AT + 4], "little")
    if len(data) == length:
        raise _file_error(name, "its CRC is missing", "made from TI's .h file, which has no CRC")
    if len(data) != length + 4 or len(data) > MAX_BYTES:
        raise _file_error(
            name, f"{len(data)} bytes, its header has {length + 4}", "an interrupted copy, or another format"
        )
    actual = zlib.crc32(data[:-4])
    expected = int.from_bytes(data[-4:], "little")
    if actual != expected:
        raise _file_error(name, f"CRC-32 {actual:08x} instead of {expected:08x}", "damaged during the copy")
    # Parts are aligned to four bytes; one that begins too late to hold its versions and the CRC is not a patch.
    last_offset = len(data) - 4 - _VERSION_BYTES - _PATCH_AT
    part_offsets = [
        offset for offset in range(_HEADER_BYTES, last_offset, 4) if data[offset : offset + len(_PART)] == _PART
    ]
    if _END not in data[:_HEADER_BYTES] or not part_offsets or part_offsets[0] != _HEADER_BYTES:
        raise _file_error(name, "no program part after its header", "an image of another kind")
    if len(part_offsets) != len(_CORES):
        raise _file_error(
            name, f"{len(part_offsets)} program parts, an AWR2243 has two cores", "an image of another kind"
        )
    roms = [_read_version(data, offset + _ROM_AT) for offset in part_offsets]
    foreign_generations = [rom[0] for rom in roms if rom[0] != GENERATION]
    if foreign_generations:
        generation = foreign_generations[0]
        raise _file_error(
            name,
            f"for devices of generation {generation} ({_name_family(generation)});"
            f" an AWR2243 has generation {GENERATION}",
            "an image for another device",
        )
    patches = tuple(describe_patch(*_read_version(data, offset + _PATCH_AT)) for offset in part_offsets)
    foreign_patches = [p for p in patches if not p.startswith(f"{GENERATION}.")]
    if foreign_patches:
        raise _file_error(
            name, f"its patches are {', '.join(foreign_patches)}, those of an AWR2243 2.x", "an image for xWR6243"
        )
    return Image(name, data, roms[0], patches)


def _read_version(data: bytes, offset: int) -> tuple[int, ...]:
    """Return the four numbers of a version: major, minor, build, debug."""
    return tuple(data[offset : offset + _VERSION_BYTES])


def _name_family(generation: int) -> str:
    """Return the device family with this major ROM version."""
    return FAMILIES.get(generation, "an unknown device")


def _format_rom(rom: tuple[int, ...]) -> str:
    return ".".join(map(str, rom))


def require_family(board_name: str, core: str, answer: bytes) -> None:
    """Raise ConfigError if a core's answer to a version request is not that of an AWR2243.

    `core` is "main" or "RF", `answer` the body of the answer. The settings would not apply to another device.
    """
    rom = _read_version(answer, _ROM_IN_ANSWER)
    generation = rom[0]
    if generation == GENERATION:
        return
    cause = "the board has another device"
    remedy = "use an AWR2243 board; docs/spec/mmwavelink.md, Other boards"
    # All zeros or all ones come from a line that nothing drives.
    if set(rom) in ({0x00}, {0xFF}):
        cause = "the board's data line is stuck"
        remedy = "check the 60-pin connector"
    raise ConfigError(
        f"{board_name}: its {core} core's ROM is {_format_rom(rom)}, generation {generation}"
        f" ({_name_family(generation)});"
        " only AWR2243 is supported",
        cause,
        remedy,
        code=ErrorCode.MISMATCH,
    )


def require_rom(board_name: str, answer: bytes, image: Image) -> None:
    """Raise ConfigError if the image is for another ROM than the main core's answer to a version request names."""
    require_family(board_name, "main", answer)
    rom = _read_version(answer, _ROM_IN_ANSWER)
    if rom != image.rom:
        raise ConfigError(
            f"{board_name}: its main core's ROM is {_format_rom(rom)}, {image.name} is for ROM"
            f" {_format_rom(image.rom)}; nothing was sent",
            "another version of the device, or an image for another one",
            "use the image of this device's DFP",
            code=ErrorCode.MISMATCH,
        )


def split_into_chunks(image: bytes, file_type: int = TO_FLASH) -> list[tuple[FileChunk, int]]:
    """Return the commands that download an image, each with the number of commands after it.

    `file_type` is `TO_RAM` or `TO_FLASH`; it and the image's length precede the image. Raises ValueError if the image
    is empty.
    """
    if not image:
        raise ValueError("the firmware image is empty")
    content = struct.pack("<II", file_type, len(image)) + image
    parts = [content[start : start + BODY_LIMIT] for start in range(0, len(content), BODY_LIMIT)]
    return [(FileChunk(part), len(parts) - 1 - n) for n, part in enumerate(parts)]


def send_image(
    link: Link,
    board_name: str,
    image: Image,
    file_type: int,
    progress: Callable[[int, int], None] = lambda _sent, _total: None,
) -> None:
    """Download an image to the RAM or the flash; call `progress` with the chunks sent and their total.

    Raises DeviceError for the chunk that failed. The destination is then incomplete; the board still accepts a
    download.
    """
    chunks = split_into_chunks(image.data, file_type)
    progress(0, len(chunks))
    for number, (chunk, remaining) in enumerate(chunks, start=1):
        try:
            link.call(chunk, timeout_s=CHUNK_TIMEOUT_S, remaining=remaining)
        except DeviceError as e:
            cause = e.why
            if file_type == TO_FLASH:
                cause = f"its flash has no complete image now; {cause}"
            raise DeviceError(
                f"{board_name}: part {number} of {len(chunks)} of {image.name} was not accepted: {e.what}",
                cause,
                "remove the cause and download it again: a board without firmware still accepts a download",
                code=e.code,
            ) from None
        progress(number, len(chunks))


def _file_error(name: str, what: str, why: str) -> ConfigError:
    """Return the error for a file that is not an image, or not one for an AWR2243."""
    return ConfigError(
        f"{name} is not firmware for an AWR2243: {what}; nothing was sent", why, _REMEDY, code=ErrorCode.FILE_FOREIGN
    )
