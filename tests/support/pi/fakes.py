"""Stand-ins for devices of the Pi: a stage at a serial port, the driver of a stage, and the trigger lines."""

import contextlib
import math
import os
import queue
import select
import termios
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path
from typing import Any

from polysight_pi.trigger import Edge, ReturnedPulses
from polysight_shared.errors import DeviceError, PolysightError, ProtocolError
from polysight_shared.faults import StageError
from polysight_shared.raster import Stage
from polysight_shared.stage_line import Command, Immediate, Reply
from polysight_shared.wires import WireClient, WireEdge
from tests.support.processes import HANG_S


class FakeDriver:
    """A driver of the stage that accepts every command, and records the immediate bytes that were sent."""

    def __init__(self) -> None:
        self.config = Stage("none")
        self.sent: list[Immediate] = []
        self.x_mm = self.y_mm = 0.0
        self.firmware = "fake"
        self.number = 0
        # It is its own link: the machine calls the same methods on it as on an open link.
        self.link = self

    def connect(self) -> None: ...
    def clear(self) -> None: ...
    def slow_down_polling(self) -> None: ...
    def repeat(self) -> None: ...
    def note_position(self, _: Reply) -> None: ...

    def send_byte(self, byte: Immediate) -> None:
        self.sent.append(byte)

    def home(self) -> int:
        self.number += 1
        return self.number

    def move(self, *_: Any) -> int:
        self.number += 1
        return self.number

    def row(self, *_: Any) -> int:
        self.number += 1
        return self.number


class FakeLines:
    """Trigger lines with their own clock `t` (ns), which only sleeps, edges and changes of the output advance.

    `late(n)` is the delay (ns) of the end of the n-th sleep, and `long(n)` the duration of the n-th change of the
    output.
    """

    name = "fake"
    is_real_time = True

    def __init__(self, late: Callable[[int], int] = lambda _: 0, long: Callable[[int], int] = lambda _: 0) -> None:
        self.t = 0
        self.late = late
        self.long = long
        self.check_width = True
        # Returns the number of pulses on the return wire for a number of sent ones. None: there is no return wire.
        self.seen: Callable[[int], int] | None = None
        self.sleeps = 0
        # Time and level of each change of the output.
        self.changes: list[tuple[int, bool]] = []
        self.level = False
        self.closed = False
        # Edges of the trigger line, in which tests put them. An exception in their place is raised.
        self.edges: queue.SimpleQueue[Edge | Exception] = queue.SimpleQueue()

    def now_ns(self) -> int:
        return self.t

    def sleep_until(self, t_ns: int) -> None:
        if t_ns > self.t:
            self.t = t_ns + self.late(self.sleeps)
            self.sleeps += 1

    def wait_edge(self, timeout_s: float) -> Edge | None:
        try:
            edge = self.edges.get(timeout=min(timeout_s, 0.01))
        except queue.Empty:
            return None
        if isinstance(edge, Exception):
            raise edge
        self.t = max(self.t, edge.t_ns)
        return edge

    def count_returned(self, sent: int) -> ReturnedPulses | None:
        return None if self.seen is None else ReturnedPulses(self.seen(sent))

    def pulse(self, width_ns: int) -> tuple[int, int]:
        rise = self.t
        self.set_output(True)
        self.sleep_until(rise + width_ns)
        self.set_output(False)
        return rise, self.t

    def set_output(self, active: bool) -> None:
        self.t += self.long(len(self.changes))
        self.changes.append((self.t, active))
        self.level = active

    def close(self) -> None:
        self.set_output(False)
        self.closed = True

    @property
    def rises(self) -> list[int]:
        """Times of the rising edges of the output."""
        return [t for t, active in self.changes if active]


def gone() -> DeviceError:
    """Return the error of trigger lines whose GPIO chip has disappeared."""
    return DeviceError("the chip vanished")


STEPS_PER_MM = 200
# Two joined lines of the hub of simulated wires. The stage changes the first one after its edges. When it sees that
# change on the second one, the hub has delivered the edges.
MARK_LINE = 1000
ECHO_LINE = 1001
# Acceleration, steps/s^2
ACCEL = 40000
# Immediate bytes are outside of ASCII.
FIRST_IMMEDIATE_BYTE = 0x80


def _find_rest_position(row: Command) -> tuple[int, int]:
    """Position in steps at which the stage rests after ROW (docs/spec/stage-line.md), without backlash."""
    x_start, dx, points, y, feed = row.args
    # Way in which the stage slows down after the last point
    run_out = math.ceil(feed**2 / (2 * ACCEL)) + abs(dx)
    last_x = x_start + (points - 1) * dx
    if dx > 0:
        return last_x + run_out, y
    return last_x - run_out, y


class FakeStage:
    """A stage at a pseudo terminal that speaks the stage's protocol, and raises the trigger on simulated wires.

    Attributes
    ----------
    deaf
        The stage answers nothing.
    lose, damage, lose_end
        Number of received lines that it ignores, of replies that it sends with a wrong byte, and of reports of a
        motion's end (done or alarm) that it does not send.
    skip
        Points of a row at which it raises no trigger.
    stays_after
        A row stops after this number of points until the attribute changes.
    alarm_at
        Number of the alarm that stops a row at a point, by point.
    lost
        Lost steps in x and y that it reports after homing.
    row_end
        Position at which a row ends, if it is not the right one.
    pace_s
        Time from point to point by the clock.
    """

    def __init__(self, hub: Path | None, trigger: int = 26) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave, termios.TCSANOW)
        self.port = os.ttyname(slave)
        os.close(slave)
        self.wire = WireClient(hub, listen=(ECHO_LINE,), join=(MARK_LINE, ECHO_LINE)) if hub else None
        self.trigger = trigger
        self.banner = True
        self.deaf = False
        self.steps = "200"
        self.lose = 0
        self.damage = 0
        self.lose_end = 0
        self.skip: set[int] = set()
        self.stays_after: int | None = None
        self.lost = (0, 0)
        self.alarm_at: dict[int, int] = {}
        self.pace_s = 0.0
        self.homed = False
        self.moving = False
        self.held = False
        self.alarm = 0
        self.x = 0
        self.y = 0
        self.points = 0
        self.t_ns = 1_000_000_000
        self.seen: list[Command] = []
        self.bytes_seen: list[int] = []
        self.rows_run = 0
        self.row_end: tuple[int, int] | None = None
        # The last command's number with the answer to it, and with the report of its motion's end
        self._last: tuple[int, Reply] | None = None
        self._end: tuple[int, Reply] | None = None
        self._stopping = threading.Event()
        self._closed = threading.Event()
        self._write_lock = threading.Lock()
        self._motion: threading.Thread | None = None
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def unplug(self) -> None:
        """Unplug the cable: the port reports an error."""
        self._closed.set()
        self._stopping.set()
        self._thread.join()
        if self._motion:
            self._motion.join()
        if self.master >= 0:
            os.close(self.master)
        self.master = -1

    def close(self) -> None:
        self.unplug()
        if self.wire:
            self.wire.close()

    def say(self, reply: Reply) -> None:
        """Send a reply; with a wrong byte if it is an answer to a command and `damage` is not 0."""
        raw = reply.encode()
        if self.damage and reply.kind in ("ok", "error"):
            self.damage -= 1
            # One bit of the fourth byte is wrong.
            raw = raw[:3] + bytes([raw[3] ^ 1]) + raw[4:]
        self.say_raw(raw)

    def say_raw(self, raw: bytes) -> None:
        if self.deaf or self._closed.is_set():
            return
        with self._write_lock, contextlib.suppress(OSError):
            os.write(self.master, raw)

    def _serve(self) -> None:
        open_before = False
        buffer = b""
        poller = select.poll()
        poller.register(self.master, select.POLLIN)
        while not self._closed.is_set():
            events = dict(poller.poll(20)).get(self.master, 0)
            is_open = not events & select.POLLHUP
            if is_open and not open_before:
                self.moving = False
                if self.banner:
                    # A board boots before it greets, and the host's port is flushed when it is opened.
                    time.sleep(0.05)
                    self.say(Reply("banner", fields={"fw": "fake", "proto": "2"}))
            open_before = is_open
            if not is_open:
                time.sleep(0.005)
                continue
            if not events & select.POLLIN:
                continue
            for byte in os.read(self.master, 4096):
                if byte >= FIRST_IMMEDIATE_BYTE:
                    self._immediate(byte)
                elif byte == ord("\n"):
                    self._line(buffer + b"\n")
                    buffer = b""
                else:
                    buffer += bytes([byte])

    def _immediate(self, byte: int) -> None:
        """Execute an immediate byte."""
        self.bytes_seen.append(byte)
        if byte == Immediate.STATUS:
            if self.held:
                state = "hold"
            elif self.moving:
                state = "row"
            elif self.alarm:
                state = "alarm"
            else:
                state = "idle"
            fields = {"state": state, "x": self.x, "y": self.y, "points": self.points, "pulses": self.points}
            self.say(Reply("status", fields={k: str(v) for k, v in fields.items()} | {"alarm": str(self.alarm)}))
        elif byte == Immediate.HOLD:
            self.held = True
        elif byte == Immediate.RESUME:
            self.held = False
        elif byte == Immediate.STOP:
            self._stopping.set()

    def _line(self, line: bytes) -> None:
        """Answer a line as the firmware does, and start its motion."""
        if line == b"\n":
            return
        if self.lose:
            self.lose -= 1
            return
        try:
            command = Command.decode(line)
        except ProtocolError:
            self.say(Reply("error", None, StageError.BAD_CRC))
            return
        # A repeated command has the number of the last one: it gets the same answers, and is not executed again.
        last_number, last_answer = self._last or (None, None)
        if last_answer is not None and last_number == command.sequence and command.verb != "HELLO":
            self.say(last_answer)
            number_of_motion, end_of_motion = self._end or (None, None)
            if end_of_motion is not None and number_of_motion == command.sequence:
                self.say(end_of_motion)
            return
        self.seen.append(command)
        number = self._refusal(command)
        fields = {"steps": self.steps} if command.verb == "HELLO" else {}
        if number:
            reply = Reply("error", command.sequence, number)
        else:
            reply = Reply("ok", command.sequence, fields=fields)
        self._last = (command.sequence, reply)
        self.say(reply)
        if not number:
            self._carry_out(command)

    def _refusal(self, command: Command) -> int:
        """Number of the error with which a command is refused; 0: it is accepted."""
        if command.verb in ("HOME", "MOVE", "ROW", "BUZZ", "SET") and self.moving:
            return StageError.BUSY
        if command.verb in ("HOME", "MOVE", "ROW") and self.alarm:
            return StageError.IN_ALARM
        if command.verb in ("MOVE", "ROW") and not self.homed:
            return StageError.NOT_HOMED
        return 0

    def _carry_out(self, command: Command) -> None:
        """Clear an alarm, or start a motion after the previous one has ended."""
        if command.verb == "CLEAR":
            self.alarm = 0
        elif command.verb in ("HOME", "MOVE", "ROW", "BUZZ"):
            if self._motion:
                self._motion.join()
            self.moving = True
            self._stopping.clear()
            self._motion = threading.Thread(target=self._move, args=(command,))
            self._motion.start()

    def _move(self, command: Command) -> None:
        """Run a motion in a thread of its own, and report its end, unless `lose_end` is not 0."""
        try:
            number = self._run_row(command) if command.verb == "ROW" else self._run_other_motion(command)
        except PolysightError:
            # The hub of the simulated wires was closed.
            return
        self.moving = False
        self.held = False
        if self._closed.is_set():
            return
        position = {"points": self.points, "pulses": self.points, "x": self.x, "y": self.y}
        if number:
            self.alarm = number
            end = Reply("alarm", number=number)
        else:
            lost_steps = {"lostx": self.lost[0], "losty": self.lost[1]} if command.verb == "HOME" else {}
            end = Reply("done", command.sequence, fields={k: str(v) for k, v in (position | lost_steps).items()})
        self._end = (command.sequence, end)
        if self.lose_end:
            self.lose_end -= 1
        else:
            self.say(end)

    def _run_other_motion(self, command: Command) -> int:
        if self._stopping.wait(self.pace_s):
            return StageError.STOPPED
        if command.verb != "BUZZ":
            self.homed = True
            self.x, self.y = command.args[:2] if command.verb == "MOVE" else (0, 0)
        return 0

    def _run_row(self, command: Command) -> int:
        """Move along the points of a row, with the faults that the test has set; return an alarm's number or 0."""
        x_start, dx, points, self.y, feed = command.args
        self.rows_run += 1
        step_ns = abs(dx) * 10**9 // feed
        self.points = 0
        for i in range(points):
            self.t_ns += step_ns
            if self._stopping.wait(self.pace_s):
                return StageError.STOPPED
            while self.held or self.stays_after == self.points:
                if self._stopping.wait(0.005):
                    return StageError.STOPPED
            if i in self.alarm_at:
                return self.alarm_at.pop(i)
            self.x = x_start + i * dx
            self.points += 1
            if i not in self.skip:
                self._edge(self.t_ns)
        while self.stays_after == self.points:
            if self._stopping.wait(0.005):
                return StageError.STOPPED
        # The stage passes the last point and slows down.
        if self._stopping.wait(2 * self.pace_s):
            return StageError.STOPPED
        self.x, self.y = self.row_end or _find_rest_position(command)
        return 0

    def _edge(self, t_ns: int) -> None:
        """Raise the trigger for 20 microseconds of the wires' time."""
        if self.wire:
            rising = WireEdge(t_ns, self.trigger, 1)
            falling = WireEdge(t_ns + 20_000, self.trigger, 0)
            self.wire.send(rising, falling, WireEdge(t_ns, MARK_LINE, 1))
            # Wait until the hub has delivered the edges: a wire has no delay, so they must come before the next line.
            self.wire.receive(HANG_S)
