"""Fixtures: `stage` is a stage in virtual time with simulated wires, `talker` any kind of stage.

Kinds of stage: the sketch compiled for this machine ("pc"), the same with sanitizers, its Python stand-in, its machine
code on an emulated Arduino UNO, and any stage at a serial port.
"""

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from tests.support.stage.drivers import Driver, FirmwareDriver, Host, PortDriver, PythonDriver, UnoDriver
from tests.support.stage.processes import StageProcess

from polysight_shared.errors import DeviceError
from polysight_simulators.builds import SKETCH_DIR, build_sketch, sketch_compiler
from polysight_simulators.uno import (
    ENABLING_COMMAND,
    EmulatedUno,
    compile_emulator,
    compile_firmware,
    list_missing_packages,
)

# Whatever a sanitizer finds ends the program. The manuals of the sanitizers advise this level of optimisation.
_SANITIZE = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g", "-O1")
# These packages are for the emulator only.
_EMULATOR_PACKAGES = ("libsimavr-dev", "libelf-dev")


@pytest.fixture(scope="session")
def firmware_program() -> Path:
    """The sketch compiled for this machine."""
    gxx = sketch_compiler()
    if gxx is None:
        pytest.skip("no C++ compiler: `apt-get install g++` runs these tests too")
    return build_sketch(gxx)


@pytest.fixture(scope="session")
def sanitized_program() -> Path:
    """The sketch compiled for this machine with address and undefined-behaviour sanitizers."""
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
    """Output folder and stdout of `make firmware`."""
    missing_packages = [package for package in list_missing_packages() if package not in _EMULATOR_PACKAGES]
    if missing_packages:
        pytest.skip(f"no firmware without {' '.join(missing_packages)}: `{ENABLING_COMMAND}` runs these tests too")
    folder = tmp_path_factory.mktemp("firmware")
    command = ["make", "-C", str(SKETCH_DIR), "firmware", f"AVR_B={folder}"]
    compilation = subprocess.run(command, capture_output=True, text=True, check=False)
    assert compilation.returncode == 0, compilation.stderr
    return folder, compilation.stdout


@pytest.fixture(scope="session")
def uno_programs() -> tuple[Path, Path]:
    """Paths of the emulator and of the sketch's machine code."""
    missing_packages = list_missing_packages()
    if missing_packages:
        pytest.skip(f"no emulated UNO without {' '.join(missing_packages)}: `{ENABLING_COMMAND}` runs these tests too")
    return compile_emulator(), compile_firmware()


@pytest.fixture
def make_uno(uno_programs: tuple[Path, Path]) -> Iterator[Callable[..., EmulatedUno]]:
    """Function that makes emulated boards. It takes the arguments of EmulatedUno after the image, and another image."""
    with ExitStack() as unos:

        def make(image: Path = uno_programs[1], **arguments: object) -> EmulatedUno:
            return unos.enter_context(closing(EmulatedUno(uno_programs[0], image, **arguments)))

        yield make


@pytest.fixture
def host(make_uno: Callable[..., EmulatedUno]) -> Host:
    """A host at the serial line of an emulated board, which was greeted, switched on and homed."""
    return Host(make_uno(start=(300, 250))).prepare()


@pytest.fixture(params=["pc", "sanitized", "python", "uno", "port"])
def talker(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Driver]:
    """Any stage, just switched on."""
    kind = request.param
    closed = ExitStack()
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
        port_of_real_stage = request.config.getoption("--stage-port")
        path = request.node.callspec.params.get("path")
        dialogue = None if path is None else path.stem
        # Two dialogues are so short that they are always held at a port, too.
        is_short = dialogue in ("hold", "sequence")
        if port_of_real_stage:
            driver = PortDriver(port_of_real_stage)
        elif request.config.getoption("--long") or is_short:
            # Three times real time, which a busy machine can simulate. The heartbeat counts wall time, however fast
            # the motion runs.
            speed = 1.0 if dialogue == "heartbeat" else 3.0
            process = closed.enter_context(closing(StageProcess(tmp_path, "pc", speed)))
            driver = PortDriver(str(process.link), speed)
        else:
            pytest.skip("minutes at a port: --long, or a real stage: --stage-port /dev/ttyACM0 (it homes and moves)")
    yield driver
    driver.close()
    closed.close()


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
def both(firmware_program: Path) -> Iterator[Callable[..., tuple[Driver, Driver]]]:
    """Makes two stages with these steps per millimetre: the firmware, and its stand-in in Python."""
    drivers: list[Driver] = []

    def make(steps_per_mm: float = 200.0) -> tuple[Driver, Driver]:
        drivers.extend([FirmwareDriver(firmware_program, steps_per_mm), PythonDriver(steps_per_mm)])
        return drivers[-2], drivers[-1]

    yield make
    for driver in drivers:
        driver.close()
