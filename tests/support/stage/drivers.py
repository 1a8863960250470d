"""The same interface for stages of all kinds.

A stage is the Arduino sketch compiled for this machine, its stand-in in Python, the machine code of the sketch on an
emulated Arduino UNO, or a real stage at a serial port. The same tests run on all of them.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import serial

from polysight_shared.errors import ProtocolError
from polysight_shared.stage_line import Command, Immediate, Parameter, Reply
from polysight_shared.wires import WireEdge, WireMessage, WireMotion, parse
from polysight_simulators.stage import NS_PER_TICK, TICK_HZ, PythonStage, Rig
from polysight_simulators.uno import HZ, EmulatedUno, PinEdge
from tests.support.processes import HANG_S, LIMIT_S, read_idle_s

# A stage must come to rest within 10 minutes.
LIMIT_TICKS = 10 * 60 * TICK_HZ
TICKS_PER_MS = TICK_HZ // 1000


def list_edges(wires: list[WireMessage]) -> list[WireEdge]:
    return [w for w in wires if isinstance(w, WireEdge)]


def list_motions(wires: list[WireMessage]) -> list[WireMotion]:
    return [w for w in wires if isinstance(w, WireMotion)]


class Driver:
    """Sends lines to a stage, advances its time, and collects its replies.

    Each kind of stage has `send` (bytes to the stage), `run` (for a number of ticks), `run_until_rest`, `press`
    (switches, as a bit mask), `slip` (the motors lose steps in x and y) and `reset`.
    """

    def __init__(self) -> None:
        self.wires: list[WireMessage] = []
        self.received = b""
        self.t_ns = 0
        self.sequence = 0

    def close(self) -> None:
        return

    def wait_until(self, is_met: Callable[[], bool]) -> None:
        """Wait until a condition holds for the received bytes. In virtual time no further bytes can come."""
        assert is_met(), f"received {self.received!r}"

    def collect_late_bytes(self) -> None:
        """Wait for bytes that have been sent but not received. In virtual time there are none."""

    def has_stood_still(self) -> bool:
        """True if nothing has moved and no trigger was sent since the last call."""
        has_stood_still = not self.wires
        self.wires.clear()
        return has_stood_still

    def run_ms(self, ms: float) -> None:
        self.run(round(ms * TICKS_PER_MS))

    def read_replies(self) -> list[Reply]:
        """Everything received since the last call."""
        lines = self.received.splitlines(keepends=True)
        self.received = b""
        return [Reply.decode(line) for line in lines]

    def encode_command(self, verb: str, *args: int) -> bytes:
        """The bytes of the next command."""
        self.sequence = (self.sequence + 1) % 65536
        return Command(self.sequence, verb, args).encode()

    def send_command(self, verb: str, *args: int) -> Reply:
        """Send the next command, to which the stage must send exactly one reply; return it."""
        self.send(self.encode_command(verb, *args))
        (reply,) = self.read_replies()
        assert reply.sequence == self.sequence
        return reply

    def run_motion(self, verb: str, *args: int) -> tuple[Reply, list[WireMessage]]:
        """Send a motion command, which must be accepted, and wait for its end.

        Returns the last reply, and the edges and motions on the wires.
        """
        self.wires.clear()
        reply = self.send_command(verb, *args)
        assert reply.kind == "ok", reply
        self.run_until_rest()
        *_, last = self.read_replies()
        return last, list(self.wires)

    def ask_status(self) -> Reply:
        """Request the status and return it; everything else that was received is kept for later."""
        messages_before = self.received
        self.received = b""
        self.send(bytes([Immediate.STATUS]))
        self.wait_until(lambda: b"status " in self.received)
        status = next(line for line in self.received.splitlines(keepends=True) if line.startswith(b"status "))
        self.received = messages_before + self.received.replace(status, b"", 1)
        return Reply.decode(status)

    def resynchronise(self) -> None:
        """Send HELLO, and drop everything that was received before its reply."""
        hello = self.encode_command("HELLO")
        answer = b"ok N%d " % self.sequence
        self.send(b"\n" + hello)
        self.wait_until(lambda: answer in self.received)
        *_, self.received = self.received.partition(answer)[2].partition(b"\n")

    def prepare(self, heartbeat_ms: int = 60_000) -> Driver:
        """Send HELLO, set the heartbeat timeout, switch the motors on and home the stage.

        By default the timeout is a minute of the stage's time, so that tests need not send heartbeats.
        """
        self.read_replies()
        answers = [
            self.send_command("HELLO"),
            self.send_command("SET", int(Parameter.HEARTBEAT), heartbeat_ms),
            self.send_command("ENABLE", 1),
        ]
        assert [r.kind for r in answers] == ["ok"] * 3
        last, _ = self.run_motion("HOME")
        assert last.kind == "done"
        return self


class FirmwareDriver(Driver):
    """The sketch's own C++ compiled for this machine, in virtual time."""

    def __init__(self, program: Path, steps_per_mm: float = 200.0, environment: dict[str, str] | None = None) -> None:
        super().__init__()
        arguments = [str(program), "--lockstep", "--steps-per-mm", repr(steps_per_mm)]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(arguments, stdin=pipe, stdout=pipe, text=True, env=environment)
        self._collect()

    def _collect(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            tag, _, rest = line.strip().partition(" ")
            if tag == "R":
                self.t_ns = int(rest)
                return
            if tag == "T":
                self.received += bytes.fromhex(rest)
            else:
                self.wires.append(parse(line))
        raise ProtocolError(f"the stage program ended with status {self._process.wait(HANG_S)}")

    def _do(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        self._collect()

    def send(self, data: bytes) -> None:
        for i in range(0, len(data), 1024):
            self._do(f"rx {data[i : i + 1024].hex()}")

    def run(self, ticks: int) -> None:
        self._do(f"run {ticks}")

    def run_until_rest(self, limit_ticks: int = LIMIT_TICKS) -> None:
        self._do(f"rest {limit_ticks}")

    def press(self, mask: int) -> None:
        self._do(f"inputs {mask}")

    def slip(self, dx: int, dy: int) -> None:
        self._do(f"slip {dx} {dy}")

    def reset(self) -> None:
        self._do("reset")

    def close(self) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        status = self._process.wait(HANG_S)
        self._process.stdout.close()
        assert status == 0, "a sanitizer has found something, or the program crashed: see its standard error"


class PythonDriver(Driver):
    """The Python stand-in, in virtual time."""

    def __init__(self, steps_per_mm: float = 200.0) -> None:
        super().__init__()
        self._stage = PythonStage(Rig(steps_per_mm))
        self.reset()

    def _collect(self) -> None:
        self.wires += self._stage.wires
        self._stage.wires.clear()
        self.received += bytes(self._stage.replies)
        self._stage.replies.clear()
        self.t_ns = self._stage.tick * NS_PER_TICK

    def send(self, data: bytes) -> None:
        self._stage.receive(data)
        self._collect()

    def run(self, ticks: int) -> None:
        self._run(ticks, until_rest=False)

    def run_until_rest(self, limit_ticks: int = LIMIT_TICKS) -> None:
        self._run(limit_ticks, until_rest=True)

    def _run(self, ticks: int, until_rest: bool) -> None:
        end = self._stage.tick + ticks
        while self._stage.tick < end and not (until_rest and self._stage.at_rest):
            tick = min(self._stage.tick + TICKS_PER_MS, end)
            self._stage.advance(tick, tick // TICKS_PER_MS)
        self._collect()

    def press(self, mask: int) -> None:
        self._stage.press(mask)

    def slip(self, dx: int, dy: int) -> None:
        self._stage.slip(dx, dy)

    def reset(self) -> None:
        self._stage.reset(self._stage.tick // TICKS_PER_MS)
        self._collect()


class UnoDriver(Driver):
    """The compiled sketch on an emulated UNO in its own time, with a pseudo terminal as the serial line."""

    def __init__(self, program: Path, image: Path, folder: Path) -> None:
        super().__init__()
        link = folder / "ttyUNO"
        self.uno = EmulatedUno(program, image, pty=link)
        self._port = serial.Serial(str(link), 115200, timeout=HANG_S)
        # Bytes to and from the port so far.
        self._written = 0
        self._read = 0
        # Position of the motors at the last call of `has_stood_still`.
        self._last_motors = self.uno.motors
        self._collect()

    def _collect(self) -> None:
        self.uno.settle(self._written)
        data = self._port.read(self.uno.sent - self._read)
        self._read += len(data)
        assert self._read == self.uno.sent, "bytes got lost in the pseudo terminal"
        assert not [t for t in self.uno.troubles if t != "reset"], self.uno.troubles
        self.received += data
        # A cycle of the 16 MHz clock takes 62.5 ns.
        self.t_ns = self.uno.cycle * 125 // 2

    def send(self, data: bytes) -> None:
        for i in range(0, len(data), 1024):
            self._written += self._port.write(data[i : i + 1024]) or 0
            self._collect()

    def run(self, ticks: int) -> None:
        self.uno.run(ticks * HZ // TICK_HZ)
        self._collect()

    def run_until_rest(self, limit_ticks: int = LIMIT_TICKS) -> None:
        self.uno.run_until_rest(limit_ticks / TICK_HZ)
        self._collect()

    def press(self, mask: int) -> None:
        self.uno.press(mask)

    def slip(self, dx: int, dy: int) -> None:
        self.uno.slip(dx, dy)

    def reset(self) -> None:
        self.uno.reset()
        self._collect()

    def has_stood_still(self) -> bool:
        has_stood_still = not self.uno.edges and self.uno.motors == self._last_motors
        self.uno.edges.clear()
        self._last_motors = self.uno.motors
        return has_stood_still

    def close(self) -> None:
        self._port.close()
        self.uno.close()


class PortDriver(Driver):
    """A stage behind a real serial port, in its own time.

    `speed` is the rate of the stage's time relative to the clock; 1 for a real stage. Tests that press switches or stop
    the motors by hand are skipped.
    """

    def __init__(self, port: str, speed: float = 1.0) -> None:
        super().__init__()
        self._speed = speed
        self._port = serial.Serial(port, 115200, timeout=0.02)
        # Lines that were received or sent without their end so far
        self._partial = b""
        self._unfinished = b""
        self._listen_for_banner()

    def _listen(self, seconds: float = 0.0) -> None:
        limit = time.monotonic() + seconds
        while True:
            self._partial += self._port.read(256)
            complete, newline, self._partial = self._partial.rpartition(b"\n")
            self.received += complete + newline
            if time.monotonic() >= limit:
                return

    def _listen_for_banner(self) -> None:
        """Wait for the banner: opening the port resets the board. Bytes before it are dropped."""
        self.wait_until(lambda: b"polysight-stage" in self.received)
        self.received = self.received[self.received.index(b"polysight-stage") :]

    def wait_until(self, is_met: Callable[[], bool]) -> None:
        limit = read_idle_s() + LIMIT_S
        while not is_met():
            if read_idle_s() > limit:
                raise ProtocolError(f"not within {LIMIT_S:g} s; received {self.received!r}")
            self._listen()

    def collect_late_bytes(self) -> None:
        self._listen(0.2)

    def send(self, data: bytes) -> None:
        """Send bytes and wait for the answers: one for each line and one for a single STATUS byte."""
        *lines, self._unfinished = (self._unfinished + data).split(b"\n")
        # Immediate bytes may come within a line, and are no part of it. Empty lines have no answer.
        lines_without_immediate_bytes = [line.translate(None, bytes(Immediate)) for line in lines]
        answers = len([line for line in lines_without_immediate_bytes if line])
        if data == bytes([Immediate.STATUS]):
            answers += 1
        complete = self.received.count(b"\n")
        self._port.write(data)
        self.wait_until(lambda: self.received.count(b"\n") >= complete + answers)

    def run(self, ticks: int) -> None:
        self._listen(ticks / TICK_HZ / self._speed)

    def run_until_rest(self, limit_ticks: int = LIMIT_TICKS) -> None:
        """Request the status until the stage rests; these answers are not kept."""
        limit = read_idle_s() + max(limit_ticks / TICK_HZ / self._speed, LIMIT_S)
        while read_idle_s() < limit:
            if self.ask_status().fields["state"] in ("idle", "alarm", "hold"):
                return
            self._listen(0.1 / self._speed)
        raise ProtocolError("the stage does not come to rest")

    def press(self, mask: int) -> None:
        pytest.skip(f"a hand on the switches is needed (mask {mask})")

    def slip(self, dx: int, dy: int) -> None:
        pytest.skip(f"a hand on the motors is needed ({dx}, {dy} steps)")

    def reset(self) -> None:
        """Open the port again: that resets a board by the line DTR, and a simulated stage at a pseudo terminal."""
        self._port.close()
        self.received = b""
        self._partial = b""
        self._unfinished = b""
        self._port.open()
        self._listen_for_banner()

    def close(self) -> None:
        self._port.close()


class Host(Driver):
    """A host that shares the time of an emulated UNO, at its serial line; `uno` records the edges of watched pins."""

    def __init__(self, uno: EmulatedUno) -> None:
        super().__init__()
        self.uno = uno
        self.zero = (0, 0)

    def send(self, data: bytes) -> None:
        self.uno.feed(data)

    def run_until_rest(self) -> None:
        self.uno.run_until_rest()

    def read_replies(self) -> list[Reply]:
        self.uno.settle()
        self.received = bytes(self.uno.received)
        self.uno.received.clear()
        return super().read_replies()

    def ask_status(self) -> Reply:
        self.send(bytes([Immediate.STATUS]))
        (*_, last) = self.read_replies()
        assert last.kind == "status"
        return last

    def must_obey(self, verb: str, *args: int) -> None:
        """Send a command, which the stage must accept."""
        assert self.send_command(verb, *args).kind == "ok"

    def set(self, parameter: Parameter, value: int) -> None:
        self.must_obey("SET", int(parameter), value)

    def run_motion(self, verb: str, *args: int) -> Reply:
        self.uno.edges.clear()
        done, _ = super().run_motion(verb, *args)
        assert (done.kind, done.sequence) == ("done", self.sequence), done
        return done

    def prepare(self) -> Host:
        assert [r.kind for r in self.read_replies()] == ["banner"]
        self.must_obey("HELLO")
        self.set(Parameter.HEARTBEAT, 60_000)
        self.must_obey("ENABLE", 1)
        self.run_motion("HOME")
        x, left_motor, right = self.uno.motors
        assert left_motor == right
        self.zero = (x, left_motor)
        return self

    def find_position(self, edge: PinEdge) -> tuple[int, int]:
        """Return the position of the motors at an edge, in the firmware's coordinates."""
        assert edge.left == edge.right
        return edge.x - self.zero[0], edge.left - self.zero[1]
