"""For checks of `polysight doctor` on a running rig: the simulated rig as processes, and a fake Pi."""

import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import msgpack
import msgspec
import tomli_w
import zmq

from polysight.acquisition.pi_client import PiClient
from polysight.doctor.checks import run_checks
from polysight.doctor.context import CheckContext, DoctorOptions, System
from polysight_shared import messages as m
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.findings import Finding
from polysight_shared.tables import to_builtins
from tests.support.doctor.case import QUICK
from tests.support.processes import HANG_S, list_processes_naming, wait_for
from tests.support.rigs import make_programmed_rig

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


def make_impatient_rig() -> Instrument:
    """A rig with the direct path in the middle of the band and short timeouts, which needs little space on the disk."""
    return make_programmed_rig(limits={"command_timeout_s": 6.0, "end_of_record_s": 1.0, "free_disk_bytes": 1 << 20})


@dataclass
class LiveRig:
    """A running simulated rig."""

    folder: Path
    config: Path

    @property
    def instrument(self) -> Instrument:
        return load_instrument(self.config)

    def write_variant(self, change: Callable[[dict], None]) -> Path:
        """Write a changed copy of the rig file; return its path."""
        table = to_builtins(self.instrument)
        change(table)
        path = self.folder / "variant.toml"
        path.write_text(tomli_w.dumps(table))
        return path

    def run_doctor(
        self,
        config: Path | None = None,
        system: System = QUICK,
        move: bool = False,
        pulse: bool = False,
    ) -> dict[str, Finding]:
        """Run the checks; return the findings by name, in order."""
        with CheckContext(DoctorOptions(config or self.config, self.folder, move, pulse), system) as context:
            return {f.where: f for f in run_checks(context)}

    @contextmanager
    def connect_to_pi(self) -> Iterator[PiClient]:
        """Connect to the Pi."""
        context: zmq.Context = zmq.Context()
        try:
            with PiClient(context, self.instrument) as client:
                yield client
        finally:
            context.destroy(linger=0)

    @contextmanager
    def stop_process(self, word: str) -> Iterator[None]:
        """Stop (SIGSTOP) the rig's only process with this word in its command line, as if it hung."""
        pid = self._pid(word)
        os.kill(pid, signal.SIGSTOP)
        try:
            yield
        finally:
            os.kill(pid, signal.SIGCONT)

    @contextmanager
    def cut(self, line: int) -> Iterator[None]:
        """Cut the wire of a GPIO line for a block: `X LINE 1` on the simulated wires, and `X LINE 0` joins it again."""
        with socket.socket(socket.AF_UNIX) as wires:
            wires.connect(str(self.folder / "rig" / "wires.sock"))
            wires.settimeout(HANG_S)
            wires.sendall(f"X {line} 1\n".encode())
            assert wires.recv(8) == b"K\n"
            try:
                yield
            finally:
                wires.sendall(f"X {line} 0\n".encode())
                assert wires.recv(8) == b"K\n"

    def home(self) -> None:
        """Home the stage, which clears a fault."""
        with self.connect_to_pi() as pi:
            pi.home()
            wait_for(lambda: pi.status().state == "homed", "homed")

    def _pid(self, word: str) -> int:
        lines = list_processes_naming(str(self.folder))
        pids = [pid for pid, line in lines.items() if word in line and "polysight_simulators.rig" not in line]
        assert len(pids) == 1, (word, pids)
        return pids[0]


@contextmanager
def answer_as_pi(rig: Instrument, hello: m.HelloReply, version: str = m.WIRE_VERSION) -> Iterator[None]:
    """Run a fake Pi that answers `hello`, and reports to every other request that it is at rest.

    `version` is that of the wire protocol in its replies.
    """
    resting = m.StatusReply(
        state=hello.state, homed=True, x_mm=0, y_mm=0, scan_id="", row_index=-1, take=0, points=0, pulses=0,
        last_seq=0, fault=0, reason="",
    )  # fmt: skip
    context: zmq.Context = zmq.Context()
    replies = context.socket(zmq.REP)
    stop = threading.Event()
    replies.bind(rig.pi.command_address)

    def serve() -> None:
        while not stop.is_set():
            if replies.poll(20):
                command = m.unpack_command(replies.recv())
                reply = hello if isinstance(command, m.Hello) else resting
                replies.send(msgpack.packb({**msgspec.to_builtins(reply), "version": version}))

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        context.destroy(linger=0)
