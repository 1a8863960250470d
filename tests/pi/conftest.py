"""A rig without hardware for the Pi's tests: a small stage behind a pty, a wire hub, and the host's sockets."""

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import msgspec
import pytest
import tomli_w
from tests.support.pi.fakes import FakeStage
from tests.support.pi.host_side import HostSide, Running
from tests.support.pi.program import Process
from tests.support.rigs import load_published_rig, set_stage_port, time_by_the_program

from polysight_shared import messages as m
from polysight_shared.config import Instrument
from polysight_shared.tables import to_builtins
from polysight_simulators.wires import WireHub


@pytest.fixture
def instrument(tmp_path: Path) -> Instrument:
    """The published rig with a small grid, on ephemeral loopback ports."""
    rig = load_published_rig()
    replace = msgspec.structs.replace
    return replace(
        rig,
        grid=replace(rig.grid, columns=8, rows=4),
        burst=replace(rig.burst, pulses=4),
        # A long heartbeat: this process may be delayed, and the stage must not stop for that.
        stage=replace(rig.stage, port=str(tmp_path / "no-stage"), heartbeat_ms=20_000),
        pi=replace(
            rig.pi,
            command_address="tcp://127.0.0.1:*",
            event_address="tcp://127.0.0.1:*",
            journal_dir=str(tmp_path / "journal"),
            key_dir=str(tmp_path / "keys"),
            heartbeat_ms=50,
        ),
    )


@pytest.fixture
def gpio_rig(instrument: Instrument, tmp_path: Path) -> Instrument:
    """The rig with SYNC_IN on a GPIO line of the stand-in chip (polysight_simulators/gpio), the file `chip`."""
    rig = time_by_the_program(instrument)
    return msgspec.structs.replace(rig, pi=msgspec.structs.replace(rig.pi, gpio_chip=str(tmp_path / "chip")))


@pytest.fixture
def write_config(tmp_path: Path) -> Callable[[Instrument], Path]:
    """Function that writes a rig file and returns its path."""

    def write(instrument: Instrument) -> Path:
        path = tmp_path / "rig.toml"
        path.write_text(tomli_w.dumps(to_builtins(instrument)))
        return path

    return write


@pytest.fixture
def config(instrument: Instrument, write_config: Callable[[Instrument], Path]) -> Path:
    """The rig file of `instrument`."""
    return write_config(instrument)


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Path]:
    """A wire hub; yields its socket."""
    path = tmp_path / "w"
    stop = threading.Event()
    with closing(WireHub(path, lambda _: None)) as hub:
        thread = threading.Thread(target=hub.serve, args=(stop, 0.02))
        thread.start()
        yield path
        stop.set()
        thread.join()


@pytest.fixture
def stage(hub: Path, instrument: Instrument) -> Iterator[FakeStage]:
    """A stage behind a pty that drives the trigger line."""
    stage = FakeStage(hub, instrument.pi.trigger_in)
    yield stage
    stage.close()


@pytest.fixture
def start(
    write_config: Callable[[Instrument], Path], request: pytest.FixtureRequest
) -> Iterator[Callable[..., tuple[Process, HostSide]]]:
    """Function that starts `polysight-pi run` with these arguments and this environment; returns process and host.

    The stage is `stage`, unless the rig has a port of its own.
    """
    with ExitStack() as started:

        def start(rig: Instrument, *args: object, **environment: Any) -> tuple[Process, HostSide]:
            if not Path(rig.stage.port).exists():
                rig = set_stage_port(rig, request.getfixturevalue("stage").port)
            program = Process(write_config(rig), *args, **environment)
            started.enter_context(program)
            assert program.ready_line, program.popen.communicate()
            host = HostSide(program.ready_line[1], program.events_line[1], rig)
            started.callback(host.close)
            return program, host

        yield start


@pytest.fixture
def pi(instrument: Instrument, stage: FakeStage, hub: Path) -> Iterator[Running]:
    """The whole Pi half in this process, over real sockets, a pty and simulated wires."""
    running = Running(set_stage_port(instrument, stage.port), hub)
    yield running
    running.close()


@pytest.fixture
def host(pi: Running) -> HostSide:
    """The host of `pi`: a run is begun and the stage is homed."""
    pi.host.must_accept(pi.host.make_begin())
    pi.host.home()
    return pi.host


@pytest.fixture
def host_in_row(host: HostSide, stage: FakeStage) -> HostSide:
    """The host of `pi` during row 0; the stage stops after its second point until `stage.stays_after` changes."""
    stage.stays_after = 2
    host.start_row()
    host.wait_for_event(m.Capture)
    return host
