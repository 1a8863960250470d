"""The firmware image as commands: parts of 232 bytes, the first with type and length before it (ICD 20, 302).

The image is TI's file with the CRC at its end, which is not part of this project. Not run on hardware yet.
"""

from __future__ import annotations

import struct

from polysight.host.radar.commands import FileChunk
from polysight.host.radar.messages import BODY_LIMIT

TO_RAM = 0  # lost at power-off
TO_FLASH = 4  # the first of four places in the board's serial flash
ERASE_TIMEOUT_S = 10.0  # the first part is acknowledged when the flash is erased


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
