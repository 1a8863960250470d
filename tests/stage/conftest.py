"""Fixtures: stages to talk to. `stage` is one in virtual time with simulated wires, `talker` any of them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import ModuleType

import pytest

from polysight.shared.errors import DeviceError
from polysight.shared.wires import WireEdge, WireMessage, WireMotion
from polysight.simulators.builds import SKETCH_DIR, build_sketch, sketch_compiler
from polysight.simulators.uno import ENABLING_COMMAND, EmulatedUno, emulator, firmware, missing
from tests.support.paths import REPO, RIG_FILE
from tests.support.stage import conversation as conversations
from tests.support.stage.drivers import Driver, FirmwareDriver, PortDriver, PythonDriver, UnoDriver
from tests.support.stage.uno_host import Host

_SANITIZE = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g", "-O1")


def edges(wires: list[WireMessage]) -> list[WireEdge]:
    return [w for w in wires if isinstance(w, WireEdge)]


def motions(wires: list[WireMessage]) -> list[WireMotion]:
    return [w for w in wires if isinstance(w, WireMotion)]


@pytest.fixture(scope="session")
def firmware_program() -> Path:
    """The sketch compiled for this machine."""
    gxx = sketch_compiler()
    if gxx is None:
        pytest.skip("no C++ compiler: `apt-get install g++` runs these tests too")
    return build_sketch(gxx)


@pytest.fixture(scope="session")
def sanitized_program() -> Path:
    """The same with address and undefined-behaviour sanitizers; whatever they find ends the program."""
    gxx = sketch_compiler()
    if gxx is None:
        pytest.skip("no C++ compiler: `apt-get install g++` runs these tests too")
    try:
        return build_sketch(gxx, ("-std=gnu++11", "-Wall", "-Wextra", "-fno-exceptions", *_SANITIZE))
    except DeviceError as e:
        if "san" in str(e) and "cannot find" in str(e):
            pytest.skip(
                "no sanitizer libraries: `apt-get install libgcc-12-dev` (or that of your g++) runs these tests too"
            )
        raise


@pytest.fixture(scope="session")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """`make firmware` in a folder, and what it said."""
    if lacking := [p for p in missing() if p not in ("libsimavr-dev", "libelf-dev")]:
        pytest.skip(f"no firmware without {' '.join(lacking)}: `{ENABLING_COMMAND}` runs these tests too")
    folder = tmp_path_factory.mktemp("firmware")
    command = ["make", "-C", str(SKETCH_DIR), "firmware", f"AVR_B={folder}"]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    return folder, made.stdout


@pytest.fixture(scope="session")
def uno_programs() -> tuple[Path, Path]:
    """The emulator and the machine code."""
    if lacking := missing():
        pytest.skip(f"no emulated UNO without {' '.join(lacking)}: `{ENABLING_COMMAND}` runs these tests too")
    return emulator(), firmware()


@pytest.fixture
def make_uno(uno_programs: tuple[Path, Path]) -> Iterator[Callable[..., EmulatedUno]]:
    """Makes emulated boards; takes the further arguments of EmulatedUno, and another image."""
    made: list[EmulatedUno] = []

    def make(image: Path = uno_programs[1], **arguments: object) -> EmulatedUno:
        made.append(EmulatedUno(uno_programs[0], image, **arguments))
        return made[-1]

    yield make
    for uno in made:
        uno.close()


@pytest.fixture
def host(make_uno: Callable[..., EmulatedUno]) -> Host:
    """A host at the serial line of an emulated board; greeted, switched on and homed."""
    return Host(make_uno(start=(300, 250))).ready()


@pytest.fixture
def conversation() -> ModuleType:
    """Plays dialogue files."""
    return conversations


@pytest.fixture
def port_driver() -> type[Driver]:
    """What talks to a stage through a serial port, as --stage-port does."""
    return PortDriver


@pytest.fixture(params=["pc", "sanitized", "python", "uno", "port"])
def talker(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Driver]:
    """Any stage, just switched on."""
    kind = request.param
    if kind == "pc":
        driver = FirmwareDriver(request.getfixturevalue("firmware_program"))
    elif kind == "sanitized":
        environment = {**os.environ, "ASAN_OPTIONS": "detect_leaks=0"}
        driver = FirmwareDriver(request.getfixturevalue("sanitized_program"), environment=environment)
    elif kind == "python":
        driver = PythonDriver()
    elif kind == "uno":
        driver = UnoDriver(*request.getfixturevalue("uno_programs"), tmp_path)
    else:
        real, dialogue = request.config.getoption("--stage-port"), request.node.callspec.params.get("path")
        if real:
            driver = PortDriver(real)
        elif dialogue is not None or request.config.getoption("--long"):
            # Three times real time, but a heartbeat is one of the wall clock, however fast the motion runs.
            speed = 1.0 if dialogue is not None and dialogue.stem == "heartbeat" else 3.0
            driver = PortDriver(request.getfixturevalue("simulated_port")(speed), speed)
        else:
            pytest.skip("minutes at a port: --long, or a real stage: --stage-port /dev/ttyACM0 (it homes and moves)")
    yield driver
    driver.close()


@pytest.fixture
def simulated_port(tmp_path: Path) -> Iterator[Callable[[float], str]]:
    """Starts a simulated stage at so many times real time; its serial port."""
    with ExitStack() as started:

        def start(time_scale: float) -> str:
            port = str(tmp_path / "ttySTAGE")
            command = [sys.executable, "-m", "polysight.simulators.stage", "--config", str(RIG_FILE)]
            command += ["--link", port, "--time-scale", repr(time_scale)]
            stage = started.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=REPO))
            started.callback(stage.terminate)
            assert stage.stdout is not None
            assert stage.stdout.readline().startswith("ready")
            return port

        yield start


@pytest.fixture(params=["firmware", "python"])
def stage(request: pytest.FixtureRequest) -> Iterator[Driver]:
    """A stage just switched on."""
    if request.param == "firmware":
        driver: Driver = FirmwareDriver(request.getfixturevalue("firmware_program"))
    else:
        driver = PythonDriver()
    yield driver
    driver.close()


@pytest.fixture
def both(firmware_program: Path) -> Iterator[tuple[Driver, Driver]]:
    """The firmware and the stand-in side by side."""
    drivers = FirmwareDriver(firmware_program), PythonDriver()
    yield drivers
    for driver in drivers:
        driver.close()


@pytest.fixture
def driver_pair(firmware_program: Path) -> Iterator[Callable[[float], tuple[Driver, Driver]]]:
    """Makes the two with other steps per millimetre."""
    made: list[Driver] = []

    def make(steps_per_mm: float) -> tuple[Driver, Driver]:
        made.extend([FirmwareDriver(firmware_program, steps_per_mm), PythonDriver(steps_per_mm)])
        return made[-2], made[-1]

    yield make
    for driver in made:
        driver.close()


@pytest.fixture
def only_edges() -> object:
    """Picks the S lines."""
    return edges


@pytest.fixture
def only_motions() -> object:
    """Picks the M lines."""
    return motions
