"""Constants in firmware, Python and the interface page agree."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from tests.support.paths import REPO

from polysight_shared import stage_line
from polysight_shared.config import Stage
from polysight_shared.faults import EXPLANATIONS, StageError, c_header
from polysight_shared.stage_line import Immediate, Parameter, Reply
from polysight_simulators.stage import logic as stage_logic
from polysight_simulators.stage import motion as stage_motion
from polysight_simulators.stage import python_stage as stage_python

SKETCH = REPO / "arduino_stage"
PAGE = (REPO / "docs" / "spec" / "stage-line.md").read_text(encoding="utf-8")


def constants(name: str) -> dict[str, int]:
    """`constexpr` integers of a header."""
    text = (SKETCH / name).read_text(encoding="ascii")
    found = re.findall(r"\b([A-Z_][A-Z0-9_]+) = (-?\d+)", text)
    return {k: int(v) for k, v in found}


def pins(text: str) -> dict[str, int]:
    return {k: int(v) for k, v in re.findall(r"\b(?:PIN_)?([A-Z_]+) = (\d+)", text)}


def test_pinout():
    """Pins are the published rig's and further ones; the emulated board has the same."""
    published = {"TRIGGER": 2, "LEFT_PUL": 3, "LEFT_DIR": 8, "RIGHT_PUL": 4, "RIGHT_DIR": 9, "X_PUL": 5, "X_DIR": 10}
    board = pins("\n".join(re.findall(r"PIN_.*", (SKETCH / "board.h").read_text(encoding="ascii"))))
    assert published.items() <= board.items()
    assert len(set(board.values())) == len(board)
    emulated = pins(
        re.findall(
            r"enum (\{ TRIGGER.*?\});", (REPO / "simulators/polysight_simulators/uno/rig.c").read_text(), re.DOTALL
        )[0]
    )
    names = {"DRIVERS_OFF": "ENABLE", "EMERGENCY_STOP": "EMERGENCY"}
    assert {names.get(k, k): v for k, v in emulated.items()} == board


def test_pins_ratios_and_limits_are_in_board_h_alone():
    """Only board.h has pins and numbers that another rig would change."""
    for source in [
        *SKETCH.glob("*.cpp"),
        *SKETCH.glob("*.ino"),
        *(p for p in SKETCH.glob("*.h") if p.name != "board.h"),
    ]:
        text = source.read_text(encoding="ascii")
        assert not re.search(r"\b(?:digitalWrite|digitalRead|pinMode)\((?:\d|A\d)", text), source.name
        assert not re.search(r"\bwrite<\d|\bread<\d|constexpr \w+ PIN_", text), source.name


def test_error_header_is_generated():
    assert (SKETCH / "stage_errors.h").read_text(encoding="ascii") == c_header()


def test_parameters_and_bytes():
    text = (SKETCH / "stage.h").read_text(encoding="ascii")
    assert dict(re.findall(r"PARAMETER_([A-Z_]+) = (\d+)", text)) == {p.name: str(int(p)) for p in Parameter}
    assert dict(re.findall(r"immediate_([a-z]+) = (0x\w+)", text.lower())) == {
        i.name.lower(): f"0x{int(i):02x}" for i in Immediate
    }


def test_limits():
    protocol, board = constants("protocol.h"), constants("board.h")
    assert protocol["MAX_LINE_BYTES"] == stage_line.MAX_LINE_BYTES
    assert protocol["PROTOCOL_VERSION"] == stage_line.PROTOCOL_VERSION
    assert f'"{stage_python.FIRMWARE}"' in (SKETCH / "protocol.h").read_text(encoding="ascii")
    for name in ("MAX_TRAVEL", "MAX_POINTS", "MAX_BACKLASH", "HOME_RATE", "CREEP_RATE", "PULL_OFF", "MAX_RELEASE"):
        assert board[name] == getattr(stage_logic, name)
    for name in ("MIN_RATE", "MAX_RATE", "TICK_HZ"):
        assert board[name] == getattr(stage_motion, name)


def test_defaults_are_those_of_the_rig_file():
    board, stage = constants("board.h"), Stage(port="")
    k = stage.steps_per_mm
    assert board["STEPS_PER_MM"] == k
    assert board["DEFAULT_ACCEL"] == stage.accel_mm_s2 * k
    assert board["DEFAULT_HEARTBEAT_MS"] == stage.heartbeat_ms
    assert board["DEFAULT_TRIGGER_US"] == stage.trigger_width_us
    assert (board["DEFAULT_TRAVEL_X"], board["DEFAULT_TRAVEL_Y"]) == (stage.travel_x_mm * k, stage.travel_y_mm * k)
    assert board["DEFAULT_TRAVEL_RATE"] == stage.travel_speed_mm_s * k


def test_longest_status_fits_a_line():
    fields = {"state": "alarm", "x": "-1099999", "y": "-1099999", "points": "9999", "pulses": "9999"}
    Reply("status", fields={**fields, "alarm": "15", "limits": "7", "homed": "1"}).encode()


def test_page_lists_every_error():
    page = " ".join(PAGE.partition("## Errors and alarms")[2].split())
    for error in StageError:
        e = EXPLANATIONS[error]
        assert f"* **{int(error)}**: {e.what} ({e.why}): {e.remedy}" in page
    assert set(re.findall(r"\* \*\*(\d+)\*\*", page)) == {str(int(e)) for e in StageError}


def test_page_lists_parameters_bytes_and_verbs():
    for parameter in Parameter:
        assert re.search(rf"^\| {int(parameter)} +\| `{parameter.name}` ", PAGE, re.MULTILINE), parameter
    for byte in Immediate:
        assert re.search(rf"^\| `0x{int(byte):02x}` +\| {byte.name} ", PAGE, re.MULTILINE), byte
    for verb in stage_logic.ARGUMENTS:
        assert re.search(rf"^\| `{verb}\b", PAGE, re.MULTILINE), verb


def test_examples_of_the_page_are_valid_lines():
    examples = re.findall(r"^(?:->|<-) (\S.*\*[0-9A-F]{4})$", PAGE, re.MULTILINE)
    assert len(examples) >= 6
    for example in examples:
        stage_line.unseal(example.encode("ascii") + b"\n")


def test_immediate_bytes_differ_from_all_others_in_two_bits_and_resume_in_three():
    used_in_lines = b"0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ-* \n"
    for byte in Immediate:
        others = {*used_in_lines, *range(0x20, 0x7F)} if byte != Immediate.RESUME else {*used_in_lines}
        nearest = min((byte ^ other).bit_count() for other in others | set(Immediate) - {byte})
        assert nearest >= (3 if byte == Immediate.RESUME else 2)


def test_sketch_fits_an_uno(built: tuple[Path, str]):
    sizes = dict(re.findall(r"^(Program|Data): +(\d+) bytes", built[1], re.MULTILINE))
    assert int(sizes["Program"]) < 32_256  # flash without the boot loader
    assert int(sizes["Data"]) < 1_536  # a quarter of the memory is left for the stack


def test_no_floating_point_anywhere(built: tuple[Path, str]):
    """No routine of the compiler's soft floating point is linked."""
    elf = str(built[0] / "arduino_stage.elf")
    symbols = subprocess.run(["avr-nm", elf], capture_output=True, text=True, check=True).stdout
    assert " __vector_11" in symbols  # the step interrupt: these are the right symbols
    assert not re.findall(r"\b__\w*(?:sf|fp|float)\w*", symbols)


def test_the_arduino_ide_makes_the_same_image(built: tuple[Path, str], tmp_path: Path):
    """The IDE's own builder opens the folder as it is, and its image is ours byte for byte."""
    if shutil.which("arduino-builder") is None:
        pytest.skip("no IDE builder: `sudo apt-get install arduino-builder` runs this too")
    command = ["arduino-builder", "-compile", "-fqbn", "arduino:avr:uno", "-tools", "/usr/bin", "-hardware"]
    command += ["/usr/share/arduino/hardware", "-hardware", "/usr/share/arduino-builder", "-build-path", str(tmp_path)]
    # Debian's core 1.8.7 does not compile with Debian's avr-gcc 5.4 without this.
    command += ["-prefs", "compiler.cpp.extra_flags=-DDECIMAL_DIG=__DECIMAL_DIG__", str(SKETCH / "arduino_stage.ino")]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    ours = (built[0] / "arduino_stage.hex").read_bytes()
    assert (tmp_path / "arduino_stage.ino.hex").read_bytes() == ours


def test_sketch_folder_is_what_the_arduino_ide_wants():
    """The .ino has its folder's name and its sources beside it: of subfolders the IDE compiles only src/."""
    assert [p.name for p in SKETCH.glob("*.ino")] == [f"{SKETCH.name}.ino"]
    assert not (SKETCH / "src").exists()
    for source in [*SKETCH.glob("*.cpp"), *SKETCH.glob("*.h"), *SKETCH.glob("*.ino")]:
        for included in re.findall(r'#include "(.+)"', source.read_text(encoding="ascii")):
            assert (SKETCH / included).is_file(), f"{source.name} includes {included}"
