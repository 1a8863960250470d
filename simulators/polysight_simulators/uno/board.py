"""The emulated board in lockstep with a Python program: time advances only by command.

Emulator and firmware are compiled on demand, once for the same sources; :func:`list_missing_packages` lists missing
packages.
"""

import os
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

from polysight_shared.errors import DeviceError
from polysight_simulators.builds import SKETCH_DIR, compile_once

# Where Debian's arduino-core-avr puts the Arduino core.
CORE_DIR = Path("/usr/share/arduino/hardware/arduino/avr/cores/arduino")
ENABLING_COMMAND = (
    "sudo apt-get install gcc make gcc-avr avr-libc binutils-avr arduino-core-avr libsimavr-dev libelf-dev"
)
_SOURCES = sorted(p for p in Path(__file__).parent.iterdir() if p.suffix in (".c", ".h"))
_CC = ("gcc", "-O2", "-Wall", "-Wextra")
_LIBRARIES = ("-lsimavr", "-lelf", "-lutil", "-lm")
# Cause and remedy in the message of a failed compilation.
_COMPILATION_ERROR = ("a package is missing, or the sources were changed", ENABLING_COMMAND)
# Clock of the UNO.
HZ = 16_000_000


class PinEdge(NamedTuple):
    """An edge of a watched pin, at an exact cycle of the 16 MHz clock."""

    cycle: int
    # Number of the pin on the Arduino; A0 is 14.
    pin: int
    value: int
    # Positions of the motors: steps from the limit switches, counted at the pins.
    x: int
    left: int
    right: int
    # Cycle of the last rising PUL edge.
    step_cycle: int


class Cost(NamedTuple):
    """Worst cases in cycles: of interrupts since the last :meth:`EmulatedUno.read_cost`, of pulses since power-on.

    Before the first pulse, the latter are the largest number of 64 bits.
    """

    # Cycles from entry to the end of reti, by vector number; those that did not occur are left out.
    interrupts: dict[int, int]
    # Shortest width of a step pulse.
    step_pulse: int
    # Shortest time from a change of DIR to PUL.
    direction_setup: int
    # Shortest time from PUL to a change of DIR.
    direction_hold: int


class EmulatedUno:
    """A board with its motors and switches, just switched on.

    Parameters
    ----------
    program, image
        From :func:`polysight_simulators.uno.compile_emulator` and :func:`polysight_simulators.uno.compile_firmware`.
    start
        Position at power-on: steps from the switches.
    watch
        Pins whose edges are stored in `edges`; 2 is the trigger.
    pty
        Path of a pseudo terminal to make for the serial line; None: use :meth:`feed` and `received`.
    """

    def __init__(
        self,
        program: Path,
        image: Path,
        start: tuple[int, int] = (2000, 1500),
        watch: tuple[int, ...] = (2,),
        pty: Path | None = None,
    ) -> None:
        self.edges: list[PinEdge] = []
        self.received = bytearray()
        # Descriptions of resets, lost bytes and crashes.
        self.troubles: list[str] = []
        self.cycle = 0
        # Positions of the motors: x, left y, right y.
        self.motors = (start[0], start[1], start[1])
        # Number of bytes sent to the pseudo terminal.
        self.sent = 0
        self._counted: dict[int, int] = {}
        self._pulse_cycles = (0, 0, 0)
        command = [str(program), "--parent", str(os.getpid()), "--start", f"{start[0]},{start[1]}"]
        command += ["--watch", ",".join(map(str, watch)), *(["--pty", str(pty)] if pty else []), str(image)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._collect()

    def _collect(self) -> None:
        """Read the emulator's lines up to the end of an answer, and update the attributes. Raises DeviceError.

        A line has a letter and numbers. E: an edge, as `PinEdge`. T: cycle, and byte sent by the board (hexadecimal).
        C: vector, count and longest time of an interrupt. W: widths and times of motor pulses. X: cycle and trouble. R,
        the last one: cycle, motors, and bytes sent to the pseudo terminal.
        """
        output = self._process.stdout
        if output is None:
            raise DeviceError("the UNO emulator has no output", "a bug", "report it")
        for line in output:
            tag, *values = line.split()
            if tag == "E":
                self.edges.append(PinEdge(*map(int, values)))
            elif tag == "T":
                self.received.append(int(values[1], 16))
            elif tag == "R":
                self.cycle, *motors, self.sent = map(int, values)
                self.motors = (motors[0], motors[1], motors[2])
                return
            elif tag == "C":
                self._counted[int(values[0])] = int(values[2])
            elif tag == "W":
                pulse, setup, hold = map(int, values)
                self._pulse_cycles = (pulse, setup, hold)
            else:
                self.troubles.append(" ".join(values[1:]))
        raise DeviceError("the UNO emulator ended", "it crashed; its last output is on standard error", "report it")

    def _apply_action(self, line: str) -> None:
        """Send a command to the emulator, and read its answer. Raises DeviceError."""
        if self._process.stdin is None:
            raise DeviceError("the UNO emulator has no input", "a bug", "report it")
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        self._collect()

    def feed(self, data: bytes) -> None:
        """Put bytes on the serial line; they arrive as time advances."""
        self._apply_action(f"feed {data.hex()}")

    def run(self, cycles: int) -> None:
        """Advance the time by CPU cycles."""
        self._apply_action(f"run {max(1, cycles)}")

    def run_ms(self, ms: float) -> None:
        """Advance the time by milliseconds."""
        self.run(round(ms * HZ / 1000))

    def settle(self, pty_bytes: int = 0) -> None:
        """Run until the serial line was idle for 4 ms; at most 2 s longer than the bytes now queued on it take.

        `pty_bytes`: total number of bytes that were written to the pseudo terminal, which are waited for first.
        """
        self._apply_action(f"settle {pty_bytes}")

    def run_until_rest(self, limit_s: float = 600.0) -> None:
        """Run until no motor has stepped for 50 ms and the serial line is idle, at most `limit_s` by its clock."""
        self._apply_action(f"rest {round(limit_s * HZ)}")

    def press(self, mask: int) -> None:
        """Hold the switches of this sum, and let go of all others: 1 x, 2 y, 4 emergency stop."""
        self._apply_action(f"inputs {mask}")

    def slip(self, dx: int, dy: int) -> None:
        """Move the motors of x and y by steps that the board does not know of."""
        self._apply_action(f"slip {dx} {dy}")

    def reset(self) -> None:
        """Press the reset button."""
        self._apply_action("reset")

    def hang(self) -> None:
        """Stop the main program until the next reset; interrupts continue."""
        self._apply_action("hang")

    def watch(self, *pins: int) -> None:
        """Store the edges of these pins from now on."""
        self._apply_action("watch " + ",".join(map(str, pins)))

    def read_cost(self) -> Cost:
        """Return the worst cases, and start again with those of interrupts."""
        self._counted = {}
        self._apply_action("cost")
        return Cost(self._counted, *self._pulse_cycles)

    def close(self) -> None:
        """End the emulator."""
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()
        self._process.wait(10)


def list_missing_packages() -> list[str]:
    """Return the missing Debian packages that compiling firmware and emulator needs."""
    lacking = {
        "gcc": shutil.which("gcc") is None,
        "make": shutil.which("make") is None,
        "gcc-avr": shutil.which("avr-g++") is None,
        "avr-libc": not any(Path(p).is_file() for p in ("/usr/lib/avr/include/avr/io.h", "/usr/avr/include/avr/io.h")),
        "arduino-core-avr": not CORE_DIR.is_dir(),
        "libsimavr-dev": not Path("/usr/include/simavr/sim_avr.h").is_file(),
        "libelf-dev": not Path("/usr/include/libelf.h").is_file(),
    }
    return [package for package, lacks in lacking.items() if lacks]


def compile_emulator() -> Path:
    """Compile the emulator; return its path. Raises DeviceError if it does not compile."""
    code = [str(p) for p in _SOURCES if p.suffix == ".c"]
    return compile_once("unosim", _SOURCES, [*_CC, "-o", "{folder}/unosim", *code, *_LIBRARIES], _COMPILATION_ERROR)


def compile_firmware(compiler: Path | None = None) -> Path:
    """Compile the image that `make flash` puts on a board; return the .hex file.

    Parameters
    ----------
    compiler
        Folder of another avr-gcc and its tools; None: those on the path.

    Raises
    ------
    DeviceError
        if it does not compile, or its sources are missing.
    """
    if not SKETCH_DIR.is_dir():
        raise DeviceError(
            f"{SKETCH_DIR}: no such folder",
            "polysight is installed without its repository, which contains the sketch",
            "run from a clone of the repository, or use the stage without the emulated board",
        )
    sources = [p for p in SKETCH_DIR.iterdir() if p.suffix in (".cpp", ".h", ".ino", ".mk")]
    command = ["make", "-s", "-C", str(SKETCH_DIR), "firmware", "AVR_B={folder}"]
    if compiler:
        command += [f"AVR={compiler}/avr-"]
    return compile_once("arduino_stage.hex", sources, command, _COMPILATION_ERROR)
