"""`make flash` with the real avrdude and a stand-in for the boot loader: it writes the image and reads it back."""

from __future__ import annotations

import os
import shutil
import subprocess
import threading
import tty
from pathlib import Path

import pytest
from tests.support.paths import REPO

SKETCH = REPO / "arduino_stage"
SIGNATURE = bytes([0x1E, 0x95, 0x0F])  # ATmega328P
IN_SYNC, OK, END = b"\x14", b"\x10", b"\x20"


class BootLoader:
    """The boot loader of an UNO (STK500 version 1, Atmel AVR061) at the far end of a pseudo terminal."""

    def __init__(self) -> None:
        self._far, near = os.openpty()
        tty.setraw(near)
        self.port, self._near = os.ttyname(near), near
        self.flash = bytearray(b"\xff" * 32_768)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _take(self, n: int) -> bytes:
        data = b""
        while len(data) < n:
            data += os.read(self._far, n - len(data))
        return data

    def _serve(self) -> None:
        address = 0
        while (command := self._take(1)) != b"\x00":
            answer = b""
            if command == b"A":  # get parameter
                self._take(1)
                answer = b"\x03"
            elif command == b"B":  # set device
                self._take(20)
            elif command == b"E":  # set extended parameters
                self._take(self._take(1)[0] - 1)
            elif command == b"U":  # load address, in words
                address = 2 * int.from_bytes(self._take(2), "little")
            elif command == b"V":  # universal
                self._take(4)
                answer = b"\x00"
            elif command == b"u":  # read signature
                answer = SIGNATURE
            elif command in (b"d", b"t"):  # program page, read page
                size = int.from_bytes(self._take(3)[:2], "big")
                page = slice(address, address + size)
                if command == b"d":
                    self.flash[page] = self._take(size)
                else:
                    answer = bytes(self.flash[page])
            self._take(len(END))
            os.write(self._far, IN_SYNC + answer + OK)

    def close(self) -> None:
        os.write(self._near, b"\x00")
        self._thread.join(10)
        os.close(self._near)
        os.close(self._far)


def image_of(path: Path) -> bytes:
    """The bytes of an Intel hex file without gaps."""
    records = [bytes.fromhex(line[1:]) for line in path.read_text(encoding="ascii").split()]
    return b"".join(r[4:-1] for r in records if r[3] == 0)


def flash(folder: Path, port: str) -> subprocess.CompletedProcess[str]:
    command = ["make", "-C", str(SKETCH), "flash", f"AVR_B={folder}", f"PORT={port}"]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_flash(built: tuple[Path, str]):
    if shutil.which("avrdude") is None:
        pytest.skip("no avrdude: `sudo apt-get install avrdude` runs this too")
    board = BootLoader()
    try:
        done = flash(built[0], board.port)
    finally:
        board.close()
    assert done.returncode == 0, done.stderr
    image = image_of(built[0] / "arduino_stage.hex")
    assert board.flash.startswith(image)
    assert "verified" in done.stderr


def test_flash_asks_for_a_port(built: tuple[Path, str]):
    done = flash(built[0], "")
    assert done.returncode != 0
    assert "make flash PORT=/dev/ttyACM0" in done.stdout
