"""Constants in firmware, Python and the interface page agree; the sketch fits a board and is flashed onto it."""

import os
import re
import shutil
import subprocess
import threading
import tty
from pathlib import Path

import pytest
from tests.support.paths import REPO

from polysight_shared import stage_line
from polysight_shared.config import Stage
from polysight_shared.faults import EXPLANATIONS, StageError
from polysight_shared.stage_line import Immediate, Parameter, Reply
from polysight_simulators.stage import logic as stage_logic, motion as stage_motion, python_stage as stage_python

SKETCH = REPO / "arduino_stage"
PAGE = (REPO / "docs" / "spec" / "stage-line.md").read_text(encoding="utf-8")


def read_constants(name: str) -> dict[str, int]:
    """`constexpr` integers of a header."""
    text = (SKETCH / name).read_text(encoding="ascii")
    definitions = re.findall(r"\b([A-Z_][A-Z0-9_]+) = (-?\d+)", text)
    return {k: int(v) for k, v in definitions}


def read_pins(text: str) -> dict[str, int]:
    return {k: int(v) for k, v in re.findall(r"\b(?:PIN_)?([A-Z_]+) = (\d+)", text)}


def test_pins_of_sketch_and_emulated_board_are_those_of_the_published_rig_and_further_ones():
    published = {"TRIGGER": 2, "LEFT_PUL": 3, "LEFT_DIR": 8, "RIGHT_PUL": 4, "RIGHT_DIR": 9, "X_PUL": 5, "X_DIR": 10}
    board = read_pins("\n".join(re.findall(r"PIN_.*", (SKETCH / "board.h").read_text(encoding="ascii"))))
    assert published.items() <= board.items()
    assert len(set(board.values())) == len(board)
    emulator = (REPO / "simulators/polysight_simulators/uno/rig.c").read_text()
    (enumeration,) = re.findall(r"enum (\{ TRIGGER.*?\});", emulator, re.DOTALL)
    emulated = read_pins(enumeration)
    # Two pins have other names in the emulator than in the sketch.
    names_in_sketch = {"DRIVERS_OFF": "ENABLE", "EMERGENCY_STOP": "EMERGENCY"}
    assert {names_in_sketch.get(name, name): pin for name, pin in emulated.items()} == board


def test_numbers_of_parameters_and_immediate_bytes_are_those_of_the_sketch():
    text = (SKETCH / "stage.h").read_text(encoding="ascii")
    assert dict(re.findall(r"PARAMETER_([A-Z_]+) = (\d+)", text)) == {p.name: str(int(p)) for p in Parameter}
    assert dict(re.findall(r"immediate_([a-z]+) = (0x\w+)", text.lower())) == {
        i.name.lower(): f"0x{int(i):02x}" for i in Immediate
    }


def test_limits_of_the_stand_in_and_the_protocol_are_those_of_the_sketch():
    protocol = read_constants("protocol.h")
    board = read_constants("board.h")
    assert protocol["MAX_LINE_BYTES"] == stage_line.MAX_LINE_BYTES
    assert protocol["PROTOCOL_VERSION"] == stage_line.PROTOCOL_VERSION
    assert f'"{stage_python.FIRMWARE}"' in (SKETCH / "protocol.h").read_text(encoding="ascii")
    for name in (
        "MAX_TRAVEL",
        "MAX_POINTS",
        "MAX_BACKLASH",
        "HOME_RATE",
        "FIRST_RATE",
        "FIRST_LEG",
        "CREEP_RATE",
        "PULL_OFF",
        "MAX_RELEASE",
    ):
        assert board[name] == getattr(stage_logic, name)
    for name in ("MIN_RATE", "MAX_RATE", "TICK_HZ"):
        assert board[name] == getattr(stage_motion, name)


def test_defaults_are_those_of_the_rig_file():
    board = read_constants("board.h")
    stage = Stage(port="")
    steps_per_mm = stage.steps_per_mm
    assert board["STEPS_PER_MM"] == steps_per_mm
    assert board["DEFAULT_ACCEL"] == stage.accel_mm_s2 * steps_per_mm
    assert board["DEFAULT_HEARTBEAT_MS"] == stage.heartbeat_ms
    assert board["DEFAULT_TRIGGER_US"] == stage.trigger_width_us
    assert board["DEFAULT_TRAVEL_X"] == stage.travel_x_mm * steps_per_mm
    assert board["DEFAULT_TRAVEL_Y"] == stage.travel_y_mm * steps_per_mm
    assert board["DEFAULT_TRAVEL_RATE"] == stage.travel_speed_mm_s * steps_per_mm


def test_the_longest_status_fits_a_line():
    """Each value has its greatest number of characters. `encode` would refuse a line that is too long."""
    fields = {"state": "alarm", "x": "-1099999", "y": "-1099999", "points": "9999", "pulses": "9999"}
    Reply("status", fields={**fields, "alarm": "15", "limits": "7", "homed": "1"}).encode()


def test_the_page_lists_every_error():
    page = " ".join(PAGE.partition("## Errors and alarms")[2].split())
    for error in StageError:
        explanation = EXPLANATIONS[error]
        assert f"* **{int(error)}**: {explanation.problem} ({explanation.cause}): {explanation.remedy}" in page
    assert set(re.findall(r"\* \*\*(\d+)\*\*", page)) == {str(int(e)) for e in StageError}


def test_the_page_lists_parameters_bytes_and_verbs():
    for parameter in Parameter:
        assert re.search(rf"^\| {int(parameter)} +\| `{parameter.name}` ", PAGE, re.MULTILINE), parameter
    for byte in Immediate:
        assert re.search(rf"^\| `0x{int(byte):02x}` +\| {byte.name} ", PAGE, re.MULTILINE), byte
    for verb in stage_logic.ARGUMENTS:
        assert re.search(rf"^\| `{verb}\b", PAGE, re.MULTILINE), verb


def test_examples_of_the_page_are_valid_lines():
    examples = re.findall(r"^(?:->|<-) (\S.*\*[0-9A-F]{4})$", PAGE, re.MULTILINE)
    # The examples were found; the page has six.
    assert len(examples) >= 6
    for example in examples:
        stage_line.unseal(example.encode("ascii") + b"\n")


def test_sketch_fits_an_uno(built: tuple[Path, str]):
    _, output = built
    sizes = dict(re.findall(r"^(Program|Data): +(\d+) bytes", output, re.MULTILINE))
    # The flash has 32 KiB, of which the boot loader takes 512 bytes.
    assert int(sizes["Program"]) < 32 * 1024 - 512
    # Of the 2 KiB of memory a quarter is left for the stack.
    assert int(sizes["Data"]) < 0.75 * 2048


def test_the_sketch_has_no_floating_point(built: tuple[Path, str]):
    """No routine of the compiler's soft floating point is linked: it would be too slow between two steps."""
    folder, _ = built
    symbols = subprocess.run(
        ["avr-nm", folder / "arduino_stage.elf"], capture_output=True, text=True, check=True
    ).stdout
    # The interrupt of the steps is in the list, so that this is the list of the sketch's symbols.
    assert " __vector_11" in symbols
    assert not re.findall(r"\b__\w*(?:sf|fp|float)\w*", symbols)


def test_the_arduino_ide_makes_the_same_image(built: tuple[Path, str], tmp_path: Path):
    """The IDE's own builder compiles the same folder to the same image, byte for byte."""
    if shutil.which("arduino-builder") is None:
        pytest.skip("no IDE builder: `sudo apt-get install arduino-builder` runs this too")
    command = ["arduino-builder", "-compile", "-fqbn", "arduino:avr:uno", "-tools", "/usr/bin", "-hardware"]
    command += ["/usr/share/arduino/hardware", "-hardware", "/usr/share/arduino-builder", "-build-path", str(tmp_path)]
    # Debian's core 1.8.7 does not compile with Debian's avr-gcc 5.4 without this.
    command += ["-prefs", "compiler.cpp.extra_flags=-DDECIMAL_DIG=__DECIMAL_DIG__", str(SKETCH / "arduino_stage.ino")]
    compilation = subprocess.run(command, capture_output=True, text=True, check=False)
    assert compilation.returncode == 0, compilation.stderr
    folder, _ = built
    our_image = (folder / "arduino_stage.hex").read_bytes()
    assert (tmp_path / "arduino_stage.ino.hex").read_bytes() == our_image


def test_sketch_folder_is_what_the_arduino_ide_wants():
    """The .ino has its folder's name and its sources in the same folder: of subfolders the IDE compiles only src/."""
    assert [p.name for p in SKETCH.glob("*.ino")] == [f"{SKETCH.name}.ino"]
    assert not (SKETCH / "src").exists()
    for source in [*SKETCH.glob("*.cpp"), *SKETCH.glob("*.h"), *SKETCH.glob("*.ino")]:
        for included in re.findall(r'#include "(.+)"', source.read_text(encoding="ascii")):
            assert (SKETCH / included).is_file(), f"{source.name} includes {included}"


# Signature of the ATmega328P, by its data sheet.
SIGNATURE = bytes([0x1E, 0x95, 0x0F])
# Bytes of STK500 (Atmel AVR061): a reply begins with IN_SYNC and ends with OK; a command ends with END.
IN_SYNC = b"\x14"
OK = b"\x10"
END = b"\x20"


class BootLoader:
    """The boot loader of an UNO (STK500 version 1, Atmel AVR061) at the far end of a pseudo terminal."""

    def __init__(self) -> None:
        self._far, near = os.openpty()
        tty.setraw(near)
        self.port = os.ttyname(near)
        self._near = near
        self.flash = bytearray(b"\xff" * 32_768)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _take(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            data += os.read(self._far, size - len(data))
        return data

    def _serve(self) -> None:
        address = 0
        while (command := self._take(1)) != b"\x00":
            answer = b""
            if command == b"A":
                # Get parameter
                self._take(1)
                answer = b"\x03"
            elif command == b"B":
                # Set device
                self._take(20)
            elif command == b"E":
                # Set extended parameters: their number, which counts itself, and the others
                (size,) = self._take(1)
                self._take(size - 1)
            elif command == b"U":
                # Load address, in words
                address = 2 * int.from_bytes(self._take(2), "little")
            elif command == b"V":
                # Universal
                self._take(4)
                answer = b"\x00"
            elif command == b"u":
                # Read signature
                answer = SIGNATURE
            elif command in (b"d", b"t"):
                # Program page, read page
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
        self._thread.join()
        os.close(self._near)
        os.close(self._far)


def read_hex(path: Path) -> bytes:
    """The bytes of an Intel hex file without gaps.

    A record has its length, two bytes of address, its kind (0: data), the data, and a checksum.
    """
    records = [bytes.fromhex(line[1:]) for line in path.read_text(encoding="ascii").split()]
    return b"".join(record[4:-1] for record in records if record[3] == 0)


def flash(folder: Path, port: str) -> subprocess.CompletedProcess[str]:
    command = ["make", "-C", str(SKETCH), "flash", f"AVR_B={folder}", f"PORT={port}"]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_make_flash_writes_the_image_to_the_board_and_verifies_it(built: tuple[Path, str]):
    if shutil.which("avrdude") is None:
        pytest.skip("no avrdude: `sudo apt-get install avrdude` runs this too")
    folder, _ = built
    board = BootLoader()
    try:
        process = flash(folder, board.port)
    finally:
        board.close()
    assert process.returncode == 0, process.stderr
    image = read_hex(folder / "arduino_stage.hex")
    assert board.flash.startswith(image)
    assert "verified" in process.stderr


def test_make_flash_without_a_port_asks_for_one(built: tuple[Path, str]):
    folder, _ = built
    process = flash(folder, port="")
    assert process.returncode != 0
    assert "make flash PORT=/dev/ttyACM0" in process.stdout
