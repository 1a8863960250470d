"""In the guest: emulated UNO -> pseudo terminal and trigger wire -> gpio-sim -> the Pi's program, as a Pi runs it.

Executes the only row of the rig file that is its argument, and prints `RESULT {...}`: the Pi's events, and the changes
of the lines recorded by the kernel. conftest.py passes PYTHONPATH, with the repository, on the kernel's command line.
"""

import fcntl
import json
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from tests.support.pi.host_side import HostSide
from tests.uml.gpio_sim import Change, SimChip

from polysight_shared import messages as m
from polysight_shared.config import load_instrument
from polysight_shared.wires import WireEdge, parse

# GPIO lines of a Raspberry Pi's header.
LINES = 28
# Longest time of a row or of a program's end, and attempts to home on a busy machine
LIMIT_S = 600.0
HOMINGS = 5
WIRES = Path("/run/wires")
PORT = Path("/run/ttySTAGE")
# Request that sets the flags of a network interface, and its flag "up" (netdevice(7)).
SIOCSIFFLAGS = 0x8914
IFF_UP = 1


def raise_loopback() -> None:
    """Switch the loopback interface on, as `ip link set lo up` does."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        fcntl.ioctl(s, SIOCSIFFLAGS, struct.pack("16sH14x", b"lo", IFF_UP))


class TriggerWire(threading.Thread):
    """The wire from the board's trigger pin to the chip: every edge is driven into the input.

    `late_ns`: the largest difference between an interval on the board and the same interval at the input. A wire of
    copper has none; this one is a thread, which a busy machine keeps waiting.
    """

    def __init__(self, listener: socket.socket, chip: SimChip) -> None:
        super().__init__(daemon=True)
        self.late_ns = 0
        self._listener = listener
        self._chip = chip
        self.start()

    def run(self) -> None:
        peer, _ = self._listener.accept()
        last_delay_ns = None
        with peer, peer.makefile("r", encoding="ascii") as lines:
            for line in lines:
                message = parse(line)
                if not isinstance(message, WireEdge):
                    continue
                self._chip.pull(message.line, bool(message.value))
                if not message.value:
                    continue
                delay_ns = time.monotonic_ns() - message.t_ns
                if last_delay_ns is not None:
                    self.late_ns = max(self.late_ns, abs(delay_ns - last_delay_ns))
                last_delay_ns = delay_ns


def start(*command: str) -> subprocess.Popen[str]:
    """A process of the chain, once it has said that it is ready."""
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    first = process.stdout.readline()
    assert first.startswith("ready"), f"{command[0]}: {first!r}"
    return process


def home(host: HostSide) -> int:
    """Home the stage; return the number of attempts: the Pi stops it if a busy machine keeps its threads waiting."""
    for homings in range(1, HOMINGS + 1):
        host.must_accept(m.Home())
        if host.wait_for_state("ready", "fault").state == "ready":
            return homings
    raise AssertionError(host.ask(m.Status()))


def run_one_row(config: Path, chip: SimChip) -> dict[str, Any]:
    """Home, run the row, end the Pi's program; return its events."""
    rig = load_instrument(config)
    python = [sys.executable, "-m"]
    options = ("--config", str(config), "--wires", str(WIRES), "--link", str(PORT))
    uno = start(*python, "polysight_simulators.uno", *options)
    pi = start(*python, "polysight_pi", "run", "--config", str(config), "--stage-port", str(PORT))
    host = HostSide(rig.pi.command_address, rig.pi.event_address, rig)
    host.must_accept(host.make_begin())
    homings = home(host)
    # Changes of the lines until now are read and dropped: they are not part of the row.
    list(chip.changes())
    host.must_accept(m.RunRow(scan_id="scan", row_index=0, take=1))
    finished = host.wait_for_event(m.RowFinished, limit_s=LIMIT_S)
    captures = [e for e in host.events if isinstance(e, m.Capture)]
    pi.send_signal(signal.SIGTERM)
    status = pi.wait(LIMIT_S)
    uno.send_signal(signal.SIGTERM)
    uno.wait(LIMIT_S)
    host.close()
    return {
        "homings": homings,
        "finished": [finished.points, finished.fault, finished.reason],
        "captures": [
            [e.point, e.column, e.pulses, e.edge_ns, e.first_pulse_ns, e.last_pulse_ns, e.width_max_ns, e.jitter_ns]
            for e in captures
        ],
        "pi_status": status,
        "left_high": chip.value(rig.pi.sync_out[0]),
    }


def main() -> None:
    """Print the result."""
    config = Path(sys.argv[1])
    rig = load_instrument(config)
    raise_loopback()
    chip = SimChip(rig.pi.gpio_chip, LINES)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(str(WIRES))
    listener.listen()
    wire = TriggerWire(listener, chip)
    result = run_one_row(config, chip)
    result["late_ns"] = wire.late_ns
    changes: list[Change] = list(chip.changes())
    result["changes"] = [[c.t_ns, c.line, c.value] for c in changes]
    print("RESULT", json.dumps(result, separators=(",", ":")), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
