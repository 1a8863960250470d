"""TI's firmware image: checked as a file before a byte of it is sent, downloaded, and verified afterwards.

An image goes to the device's RAM, where it is gone at the next reset, or to the serial flash, where it stays; which one
when is decision 11 (docs/decisions/0011-firmware-of-radars.md). The form of the file is that of TI's
`xwr22xx_metaImage.bin` as public copies show it; TI documents only magic and CRC. Not run on hardware yet.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from polysight.host.radar.commands import FileChunk
from polysight.host.radar.messages import BODY_LIMIT
from polysight.host.radar.spi import Link
from polysight.shared.errors import ConfigError, DeviceError

TO_RAM = 0  # lost at the next reset (ICD 302)
TO_FLASH = 4  # the first of four places in the board's serial flash
CHUNK_S = 10.0  # TI's limit for each part; the first one is acknowledged when the flash is erased
LARGEST_BYTES = 2**20  # of one of the flash's four places, more than any image of TI's
GENERATION = 2  # major version of the ROM in AWR2243, which the image must patch

_MAGIC, _END, _PART = b"MSTR", b"MEND", b"RPRC"
_LENGTH_AT, _HEADER_BYTES = 20, 128
_ROM_AT, _PATCH_AT = 0x38, 0x48  # from the begin of a part: version, then year, month, day
_DO = "take xwr22xx_metaImage.bin of TI's mmWave DFP 2.2 again, the .bin file, and compare its size with TI's"


@dataclass(frozen=True)
class Image:
    """A checked image.

    Attributes
    ----------
    name
        File name, for people.
    data
        All of it, CRC included.
    rom
        Version of the ROM that it patches: major, minor, build, debug.
    patches
        Version of each part's patch, main core first, as a version answer tells it (`describe_patch`).
    """

    name: str
    data: bytes
    rom: tuple[int, ...]
    patches: tuple[str, ...]

    def chunks(self, to: int) -> list[tuple[FileChunk, int]]:
        """Commands that download it, each with the number of those that follow it."""
        return file_chunks(self.data, to)


def describe_patch(major: int, minor: int, build: int, debug: int) -> str:
    """A patch's version as it is shown and compared."""
    return f"{major}.{minor}.{build}.{debug}"


def read_image(path: Path) -> Image:
    """Read and check an image file. Raises ConfigError, which names what is wrong with it; OSError."""
    return check_image(path.read_bytes(), path.name)


def check_image(data: bytes, name: str) -> Image:
    """An image from a file's bytes.

    Raises
    ------
    ConfigError
        when the file is not a whole, undamaged image for an AWR2243; it must then never be sent to a board.
    """
    if data[:4] != _MAGIC:
        begin = data[:12].decode("latin-1") if data else "nothing"
        raise _refused(
            name, f"begins with {begin!r}, an image with {_MAGIC.decode()!r}", "another file, or an empty one"
        )
    if len(data) < _HEADER_BYTES:
        raise _refused(name, f"{len(data)} bytes are too few for its header", "an interrupted copy")
    told = int.from_bytes(data[_LENGTH_AT : _LENGTH_AT + 4], "little")
    if len(data) == told:
        raise _refused(name, "its CRC is missing", "made from TI's .h file, which leaves the CRC out")
    if len(data) != told + 4 or len(data) > LARGEST_BYTES:
        raise _refused(name, f"{len(data)} bytes, its header says {told + 4}", "an interrupted copy, or another format")
    found, expected = zlib.crc32(data[:-4]), int.from_bytes(data[-4:], "little")
    if found != expected:
        raise _refused(name, f"CRC-32 {found:08x} instead of {expected:08x}", "damaged on its way here")
    begins = [at for at in range(_HEADER_BYTES, len(data) - _PATCH_AT - 8, 4) if data[at : at + 4] == _PART]
    if _END not in data[:_HEADER_BYTES] or not begins or begins[0] != _HEADER_BYTES:
        raise _refused(name, "no program part behind its header", "an image of another kind")
    rom = tuple(data[_HEADER_BYTES + _ROM_AT : _HEADER_BYTES + _ROM_AT + 4])
    if rom[0] != GENERATION:
        raise _refused(
            name,
            f"for devices of generation {rom[0]}, an AWR2243 is of {GENERATION}",
            "an image for AWR1243 or another",
        )
    patches = tuple(describe_patch(*data[at + _PATCH_AT : at + _PATCH_AT + 4]) for at in begins)
    if others := [p for p in patches if not p.startswith(f"{GENERATION}.")]:
        raise _refused(name, f"its patches are {', '.join(others)}, those of an AWR2243 2.x", "an image for xWR6243")
    return Image(name, data, rom, patches)


def file_chunks(image: bytes, file_type: int = TO_FLASH) -> list[tuple[FileChunk, int]]:
    """Commands that download an image, each with the number of those that follow it.

    Raises
    ------
    ValueError
        when the image is empty.
    """
    if not image:
        raise ValueError("the firmware image is empty")
    whole = struct.pack("<II", file_type, len(image)) + image
    parts = [whole[at : at + BODY_LIMIT] for at in range(0, len(whole), BODY_LIMIT)]
    return [(FileChunk(part), len(parts) - 1 - n) for n, part in enumerate(parts)]


def unseen(sent: int, of: int) -> None:
    """Progress that nobody looks at."""
    del sent, of


def send_image(link: Link, name: str, image: Image, to: int, progress: Callable[[int, int], None] = unseen) -> None:
    """Send every part of an image; `progress` is told parts sent and in all.

    Raises
    ------
    DeviceError
        naming the part that failed. A flash is then half written: the board still starts, and takes the download again.
    """
    parts = image.chunks(to)
    for n, (part, remaining) in enumerate(parts):
        try:
            link.call(part, timeout_s=CHUNK_S, remaining=remaining)
        except DeviceError as e:
            rest = "its flash holds no whole image now; " if to == TO_FLASH else ""
            raise DeviceError(
                f"{name}: part {n + 1} of {len(parts)} of {image.name} was not taken: {e.what}",
                f"{rest}{e.why}",
                "mend the cause and download it again: a board without firmware still takes a download",
            ) from None
        progress(n + 1, len(parts))


def _refused(name: str, what: str, why: str) -> ConfigError:
    return ConfigError(f"{name} is no firmware for an AWR2243: {what}; nothing was sent", why, _DO)
