"""The simulated rig as processes, once for a module; fake Pis for what a real one cannot be."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import pytest
import tomli_w
import zmq

from polysight.host.acquisition.pi_client import PiClient
from polysight.host.doctor.bench import Bench, Finding, System, Wanted
from polysight.host.doctor.walk import walk
from polysight.shared import messages as m
from polysight.shared.config import Instrument, load_instrument
from polysight.shared.tables import decode, to_builtins
from polysight.simulators.loopback import on_free_subnet

sys.path.insert(0, str(Path(__file__).parent))  # for doctor_case.py

REPO = Path(__file__).resolve().parents[2]
LIMIT_S = 60.0
SCENE = """name = "doctor"
seed = 3
[grid]
columns = 12
rows = 6
step_x_mm = 10.0
step_y_mm = 10.0
[[points]]
position_mm = [0.0, 0.0]
amplitude = [0.4, 0.0]
[disturbances]
if_offset_hz = 0.0
"""
QUICK = System(write_speed=lambda _folder: 200e6)


def programmed() -> Instrument:
    """The published rig with start frequencies that put the direct path mid-band, and little patience."""
    table = to_builtins(load_instrument(REPO / "instrument.toml"))
    for board in table["boards"]:
        if board["role"] != "transmit":
            board["start_offset_hz"] = 790e3
    table["limits"] |= {"command_timeout_s": 1.5, "end_of_record_s": 1.0, "free_disk_bytes": 1 << 20}
    return decode(table, Instrument, "test")


def wait_for(condition: Callable[[], bool], what: str) -> None:
    """Return when the condition holds; fail after a minute."""
    deadline = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < deadline, f"not within {LIMIT_S} s: {what}"
        time.sleep(0.02)


def verdicts(findings: list[Finding]) -> dict[str, str]:
    return {f.check: f.verdict for f in findings}


@dataclass
class LiveRig:
    """A simulated rig that runs; `table` is its rig file as plain values."""

    folder: Path
    config: Path

    @property
    def instrument(self) -> Instrument:
        return load_instrument(self.config)

    def variant(self, change: Callable[[dict], None]) -> Path:
        """Another rig file for the same rig."""
        table = to_builtins(self.instrument)
        change(table)
        path = self.folder / "variant.toml"
        path.write_text(tomli_w.dumps(table))
        return path

    def doctor(
        self,
        config: Path | None = None,
        system: System = QUICK,
        move: bool = False,
        pulse: bool = False,
    ) -> dict[str, Finding]:
        """Every finding by its check's name, in order."""
        with Bench(Wanted(config or self.config, self.folder, move, pulse), system) as bench:
            return {f.check: f for f in walk(bench)}

    @contextmanager
    def pi(self) -> Iterator[PiClient]:
        """A host's link to the Pi."""
        context: zmq.Context = zmq.Context()
        try:
            with PiClient(context, self.instrument) as client:
                yield client
        finally:
            context.destroy(linger=0)

    @contextmanager
    def stopped(self, word: str) -> Iterator[None]:
        """The rig's process with this word in its command line stands still, as a program that hangs."""
        pid = self._pid(word)
        os.kill(pid, signal.SIGSTOP)
        try:
            yield
        finally:
            os.kill(pid, signal.SIGCONT)

    @contextmanager
    def cut(self, line: int) -> Iterator[None]:
        """A GPIO wire is cut."""
        import socket

        with socket.socket(socket.AF_UNIX) as wires:
            wires.connect(str(self.folder / "rig" / "wires.sock"))
            wires.settimeout(LIMIT_S)
            wires.sendall(f"X {line} 1\n".encode())
            assert wires.recv(8) == b"K\n"
            try:
                yield
            finally:
                wires.sendall(f"X {line} 0\n".encode())
                assert wires.recv(8) == b"K\n"

    def home(self) -> None:
        """Home the stage, out of whatever fault it is in."""
        with self.pi() as pi:
            pi.home()
            wait_for(lambda: pi.status().state == "homed", "homed")

    def _pid(self, word: str) -> int:
        found = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                with suppress(OSError):
                    line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
                    if str(self.folder) in line and word in line and "polysight.simulators.rig" not in line:
                        found.append(int(entry.name))
        assert len(found) == 1, (word, found)
        return found[0]


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveRig]:
    folder = tmp_path_factory.mktemp("d")
    (folder / "base.toml").write_text(tomli_w.dumps(to_builtins(programmed())))
    (folder / "scene.toml").write_text(SCENE)
    command = [sys.executable, "-m", "polysight.simulators.rig", "--config", str(folder / "base.toml"), "--with-pi"]
    command += ["--scene", str(folder / "scene.toml"), "--dir", str(folder / "rig"), "--time-scale", "40"]
    log = folder / "rig.log"
    with log.open("wb") as out:
        rig = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, start_new_session=True)

    def ready() -> bool:
        assert rig.poll() is None, log.read_text()
        return "ready " in log.read_text()

    try:
        wait_for(ready, "the simulated rig")
        yield LiveRig(folder, folder / "rig" / "instrument.toml")
    finally:
        rig.terminate()
        rig.wait(LIMIT_S)


@pytest.fixture
def lonely(tmp_path: Path) -> LiveRig:
    """A rig file on a free subnet where nobody answers."""
    path = tmp_path / "instrument.toml"
    path.write_text(tomli_w.dumps(to_builtins(on_free_subnet(programmed()))))
    return LiveRig(tmp_path, path)


@contextmanager
def answering(rig: Instrument, hello: m.HelloReply, version: str = m.WIRE_VERSION) -> Iterator[None]:
    """A Pi that says `hello` and stands at rest, whatever it is asked."""
    import msgpack
    import msgspec

    rest = m.StatusReply(
        state=hello.state, homed=True, x_mm=0, y_mm=0, scan_id="", row_index=-1, take=0, points=0, pulses=0,
        last_seq=0, fault=0, reason="",
    )  # fmt: skip
    context: zmq.Context = zmq.Context()
    socket, stop = context.socket(zmq.REP), threading.Event()
    socket.bind(rig.pi.command_address)

    def serve() -> None:
        while not stop.is_set():
            if socket.poll(20):
                asked = m.unpack_command(socket.recv())
                reply = hello if isinstance(asked, m.Hello) else rest
                socket.send(msgpack.packb({**msgspec.to_builtins(reply), "version": version}))

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        context.destroy(linger=0)


@pytest.fixture
def fake_pi() -> Callable[..., object]:
    return answering
