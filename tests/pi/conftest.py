"""A rig without hardware for the Pi's tests: a small stage behind a pty, a wire hub, and the host's sockets."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
import tomli_w

from polysight.pi_controller.service import Service
from polysight.shared.config import Instrument
from polysight.shared.tables import to_builtins
from tests.support.pi.fake_stage import FakeStage
from tests.support.pi.host_side import HostSide
from tests.support.pi.mini_hub import MiniHub
from tests.support.rigs import at_stage_port, published_rig


@pytest.fixture
def instrument(tmp_path: Path) -> Instrument:
    """The published rig with a small grid, on ephemeral loopback ports."""
    rig = published_rig()
    replace = msgspec.structs.replace
    return replace(
        rig,
        grid=replace(rig.grid, columns=8, rows=4),
        burst=replace(rig.burst, pulses=4),
        stage=replace(rig.stage, port=str(tmp_path / "no-stage"), heartbeat_ms=1000),  # patience on a busy machine
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
def write_config(tmp_path: Path) -> Callable[[Instrument], Path]:
    """Writes a rig file."""

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
    """A wire hub; gives its socket."""
    path = tmp_path / "w"
    hub = MiniHub(path)
    yield path
    hub.close()


@pytest.fixture
def stage(hub: Path, instrument: Instrument) -> Iterator[FakeStage]:
    """A stage behind a pty that drives the trigger line."""
    stage = FakeStage(hub, instrument.pi.trigger_in)
    yield stage
    stage.close()


class Running:
    """A service in a thread, and the host's end of its sockets."""

    def __init__(self, instrument: Instrument, wires: Path) -> None:
        self.service = Service(instrument, wires)
        self.thread = threading.Thread(target=self.service.serve)
        self.thread.start()
        server = self.service.server
        self.host = HostSide(server.command_address, server.event_address, instrument)

    def close(self) -> None:
        self.host.close()
        self.service.stop()
        self.thread.join(5)
        self.service.close()


@pytest.fixture
def pi(instrument: Instrument, stage: FakeStage, hub: Path) -> Iterator[Running]:
    """The whole Pi half in this process, over real sockets, a pty and simulated wires."""
    running = Running(at_stage_port(instrument, stage.port), hub)
    yield running
    running.close()
