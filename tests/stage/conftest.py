"""Fixtures: `stage` is a stage in virtual time with simulated wires, `talker` any kind of stage."""

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

_SANITIZE = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g", "-O1")


@pytest.fixture(scope="session")
def firmware_program() -> Path:
    """The sketch compiled for this machine."""
    gxx = sketch_compiler()
    if gxx is None:
        pytest.skip("no C++ compiler: `apt-get install g++` runs these tests too")
    return build_sketch(gxx)


@pytest.fixture(scope="session")
def sanitized_program() -> Path:
    """The same with address and undefined-behaviour sanitizers, whose findings end the program."""
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
    if lacking := [p for p in list_missing_packages() if p not in ("libsimavr-dev", "libelf-dev")]:
        pytest.skip(f"no firmware without {' '.join(lacking)}: `{ENABLING_COMMAND}` runs these tests too")
    folder = tmp_path_factory.mktemp("firmware")
    command = ["make", "-C", str(SKETCH_DIR), "firmware", f"AVR_B={folder}"]
    compilation = subprocess.run(command, capture_output=True, text=True, check=False)
    assert compilation.returncode == 0, compilation.stderr
    return folder, compilation.stdout


@pytest.fixture(scope="session")
def uno_programs() -> tuple[Path, Path]:
    """The emulator and the machine code."""
    if lacking := list_missing_packages():
        pytest.skip(f"no emulated UNO without {' '.join(lacking)}: `{ENABLING_COMMAND}` runs these tests too")
    return compile_emulator(), compile_firmware()


@pytest.fixture
def make_uno(uno_programs: tuple[Path, Path]) -> Iterator[Callable[..., EmulatedUno]]:
    """Makes emulated boards; takes the further arguments of EmulatedUno, and another image."""
    with ExitStack() as unos:

        def make(image: Path = uno_programs[1], **arguments: object) -> EmulatedUno:
            return unos.enter_context(closing(EmulatedUno(uno_programs[0], image, **arguments)))

        yield make


@pytest.fixture
def host(make_uno: Callable[..., EmulatedUno]) -> Host:
    """A host at the serial line of an emulated board; greeted, switched on and homed."""
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
        real = request.config.getoption("--stage-port")
        dialogue = request.node.callspec.params.get("path")
        if real:
            driver = PortDriver(real)
        elif request.config.getoption("--long") or (dialogue is not None and dialogue.stem in ("hold", "sequence")):
            # Three times real time, but the heartbeat counts wall time, however fast the motion runs.
            speed = 1.0 if dialogue is not None and dialogue.stem == "heartbeat" else 3.0
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
    """Makes the firmware and the stand-in side by side, with these steps per millimetre."""
    drivers: list[Driver] = []

    def make(steps_per_mm: float = 200.0) -> tuple[Driver, Driver]:
        drivers.extend([FirmwareDriver(firmware_program, steps_per_mm), PythonDriver(steps_per_mm)])
        return drivers[-2], drivers[-1]

    yield make
    for driver in drivers:
        driver.close()
