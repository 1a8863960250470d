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
from polysight.shared.files import read_bounded

TO_RAM = 0  # lost at the next reset (ICD 302)
TO_FLASH = 4  # the first of four places in the board's serial flash
CHUNK_S = 10.0  # TI's limit for each part; the first one is acknowledged when the flash is erased
LARGEST_BYTES = 2**20  # of one of the flash's four places, more than any image of TI's
GENERATION = 2  # major version of the ROM in AWR2243, which the image must patch
FAMILIES = {  # major version of a ROM: devices
    1: "AWR1243 or another of the first generation",
    GENERATION: "AWR2243",
    6: "xWR6243, 57..64 GHz",
}
_CORES = ("main", "RF")  # in an image, a part for each

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
        Version of the main core's ROM that it patches: major, minor, build, debug.
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
    return check_image(read_bounded(path, LARGEST_BYTES), path.name)


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
    if len(begins) != len(_CORES):
        raise _refused(name, f"{len(begins)} program parts, an AWR2243 has two cores", "an image of another kind")
    roms = [tuple(data[at + _ROM_AT : at + _ROM_AT + 4]) for at in begins]
    if others := [rom[0] for rom in roms if rom[0] != GENERATION]:
        raise _refused(
            name,
            f"for devices of generation {others[0]} ({_family(others[0])}), an AWR2243 is of {GENERATION}",
            "an image for another device",
        )
    patches = tuple(describe_patch(*data[at + _PATCH_AT : at + _PATCH_AT + 4]) for at in begins)
    if others := [p for p in patches if not p.startswith(f"{GENERATION}.")]:
        raise _refused(name, f"its patches are {', '.join(others)}, those of an AWR2243 2.x", "an image for xWR6243")
    return Image(name, data, roms[0], patches)


def _family(generation: int) -> str:
    return FAMILIES.get(generation, "no device that is known here")


def require_family(name: str, core: str, version: bytes) -> None:
    """Refuse a device that is no AWR2243, by its version answer; its frequencies and settings would mean other things.

    Raises ConfigError in plain words.
    """
    release = version[3:7]
    if release[0] == GENERATION:
        return
    told = ".".join(map(str, release))
    wired = set(release) in ({0x00}, {0xFF})
    raise ConfigError(
        f"{name}: its {core} core's ROM is {told}, of generation {release[0]} ({_family(release[0])});"
        " only AWR2243 is configured here",
        "the board's data line is stuck" if wired else "another device than the rig file's",
        "check the 60-pin connector" if wired else "put an AWR2243 there; docs/spec/mmwavelink.md, Other boards",
    )


def require_rom(name: str, version: bytes, image: Image) -> None:
    """Refuse an image that was made for another ROM than the device's, by its version answer. Raises ConfigError."""
    require_family(name, _CORES[0], version)
    if tuple(version[3:7]) != image.rom:
        there, wanted = (".".join(map(str, rom)) for rom in (version[3:7], image.rom))
        raise ConfigError(
            f"{name}: its main core's ROM is {there}, {image.name} patches ROM {wanted}; nothing was sent",
            "another version of the device, or an image for another",
            "take the image of this device's DFP",
        )


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
    progress(0, len(parts))
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
