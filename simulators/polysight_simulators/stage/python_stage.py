"""The stage in Python, for machines without a C++ compiler: the dialogue and the motion of arduino_stage/.

The tests run it and the firmware's own code and compare them line by line and tick by tick.
"""

import math
import re
from typing import NamedTuple

from polysight_shared.errors import ProtocolError
from polysight_shared.faults import StageError
from polysight_shared.stage_line import MAX_LINE_BYTES, PROTOCOL_VERSION, Command, Parameter, Reply, crc16
from polysight_shared.wires import WireEdge, WireMessage, WireMotion
from polysight_simulators.stage.logic import MOTION_VERBS, Event, RefusedCommand, StageLogic
from polysight_simulators.stage.motion import NS_PER_TICK, SWITCH_X, SWITCH_Y, TICK_HZ, StepEngine

FIRMWARE = "0.1.0"
# Interval of motion messages while the speed changes: 10 ms; chosen.
REPORT_TICKS = TICK_HZ // 100
# Check field at the end of a line: `*` and the CRC-16 in four hexadecimal digits.
_CHECK_FIELD = re.compile(rb"\*([^*]{4})")


class Rig(NamedTuple):
    """Properties of the rig, and the stage's position at power-on: steps from its switches, chosen as 10 and 7.5 mm."""

    steps_per_mm: float = 200.0
    trigger_line: int = 26
    x: int = 2000
    y: int = 1500


class PythonStage:
    """Board, motors and switches in virtual time, counted in ticks of 500 ns.

    `wires` collects what goes to the hub, in time order; `replies` the bytes for the host. The caller empties both.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self.wires: list[WireMessage] = []
        self.replies = bytearray()
        self.tick = 0
        self._now_ms = 0
        # Inputs pressed by an injected fault.
        self._pressed = 0
        # Tick of the last motion message.
        self._reported = 0
        # Tick of the next step, if `_armed`.
        self._next = 0
        self._armed = False
        # Tick at which the trigger pulse ends; None without a pulse.
        self._fall: int | None = None
        # True place of the motors, steps from the switches; the engine counts from the zero of the last homing.
        self._x = rig.x
        self._y = rig.y
        self._zero_x = 0
        self._zero_y = 0
        self._power_on()

    def _power_on(self) -> None:
        """Forget all that the board forgets at a reset: engine, dialogue, alarms, homing."""
        self._engine = StepEngine()
        self._logic = StageLogic(self._engine, self._arm, self._read_inputs)
        self._armed = False
        self._was_homed = False
        self._line = bytearray()
        # True if HELLO was accepted since the reset.
        self._greeted = False
        # True if HELLO was the last line: any sequence number may follow it.
        self._fresh = False
        # The last answered line: its repetition gets the same answer.
        self._last: Command | None = None
        self._last_answer = b""
        self._last_is_motion = False
        # Sequence number of the last motion command.
        self._motion_sequence = 0
        # Its `done` or alarm line; empty while it runs.
        self._outcome = b""

    @property
    def stepping(self) -> bool:
        """True while steps are due."""
        return self._armed

    @property
    def at_rest(self) -> bool:
        """True if neither a step nor the end of a trigger pulse is due."""
        return not self._armed and self._fall is None

    def press(self, inputs: int) -> None:
        """Inject a fault: these inputs are pressed besides the modelled switches."""
        self._pressed = inputs

    def slip(self, dx: int, dy: int) -> None:
        """Inject a fault: the motors lose steps."""
        self._x += dx
        self._y += dy

    def reset(self, now_ms: int) -> None:
        """Reset the board. The motors keep their position."""
        self._now_ms = now_ms
        had_moved = self._armed
        self._power_on()
        if self._fall is not None:
            self._send_edge(self.tick, 0)
        if had_moved:
            self._report_motion()
        self._send(Reply("banner", fields={"fw": FIRMWARE, "proto": str(PROTOCOL_VERSION)}).encode())

    def receive(self, data: bytes) -> None:
        """Process bytes from the host."""
        for byte in data:
            # HOLD, RESUME, STATUS and STOP are single bytes, which act immediately, even within a line.
            if not self._logic.immediate(byte):
                self._take(byte)
            self._settle()

    def advance(self, tick: int, now_ms: int) -> None:
        """Advance the time, with every step and edge that is due."""
        self._now_ms = now_ms
        self._settle()
        while self._armed and self._next <= tick:
            self._end_trigger(self._next)
            self.tick = self._next
            self._take_steps(tick)
        self._end_trigger(tick)
        self.tick = tick
        self._settle()

    def _take_steps(self, until: int) -> None:
        """Make the step that is due now, or all steps without an event up to `until`."""
        engine = self._engine
        if self._fall is None:
            end = until
        else:
            # Before the end of the trigger pulse, so that the messages of `wires` stay in the order of time.
            end = min(until, self._fall - 1)
        n = 0
        dx = 0
        dy = 0
        ticks = 0
        if end > self.tick and not self._read_inputs():
            # At most as many steps as leave each axis one step from its switch.
            n, dx, dy, ticks = engine.skip(end - self.tick, abs(self._x) - 1, abs(self._y) - 1)
        if n:
            self._x += dx
            self._y += dy
            self._next += ticks
            # The last of the steps was one interval before the next one.
            self.tick = self._next - engine.ticks
            return
        cruised = engine.cruise
        dx, dy, trigger = engine.step(self._read_inputs())
        self._x += dx
        self._y += dy
        if trigger:
            self._report_motion()
            if self._fall is None:
                self._send_edge(self.tick, 1)
                # The width is in us, a tick 500 ns.
                self._fall = self.tick + 2 * self._logic.parameters[Parameter.TRIGGER]
                engine.pulses += 1
        ticks = engine.interval()
        if ticks == 0:
            self._armed = False
            self._report_motion()
            self._settle()
            return
        self._next = self.tick + ticks
        if engine.cruise != cruised or (not cruised and self.tick - self._reported >= REPORT_TICKS):
            self._report_motion()

    def _settle(self) -> None:
        """Run the logic until nothing more follows without a step; send its replies; take over the zero of a homing."""
        while True:
            event = self._logic.service(self._now_ms)
            if event is Event.DONE:
                self._outcome = self._format_done()
                self._send(self._outcome)
            elif event is Event.ALARM:
                alarm = Reply("alarm", number=int(self._logic.alarm or 0)).encode()
                # If there were several alarms, the first one ended the motion.
                self._outcome = self._outcome or alarm
                self._send(alarm)
            if self._logic.status_requested:
                self._logic.status_requested = False
                self._send(self._format_status())
            if not (self._logic.busy and self._engine.finished):
                break
        if self._logic.homed and not self._was_homed:
            self._zero_x = self._x - self._engine.x
            self._zero_y = self._y - self._engine.y
            self._report_motion()
        self._was_homed = self._logic.homed

    def _arm(self, ticks: int) -> None:
        """Schedule the next step `ticks` from now; 0: there is none."""
        if ticks:
            self._next = self.tick + ticks
            self._armed = True
            # A motion without a ramp has its full speed immediately, which no later step would report.
            if self._engine.cruise:
                self._report_motion()

    def _read_inputs(self) -> int:
        """Return the pressed switches as bits: those at the ends of the axes, and those of an injected fault."""
        inputs = self._pressed
        if self._x <= 0:
            inputs |= SWITCH_X
        if self._y <= 0:
            inputs |= SWITCH_Y
        return inputs

    def _send_edge(self, tick: int, value: int) -> None:
        """Queue an edge of the trigger line for the hub."""
        self._fall = self._fall if value else None
        self.wires.append(WireEdge(tick * NS_PER_TICK, self._rig.trigger_line, value))

    def _end_trigger(self, until: int) -> None:
        """End the trigger pulse if it is due by tick `until`."""
        if self._fall is not None and self._fall <= until:
            self._send_edge(self._fall, 0)

    def _report_motion(self) -> None:
        """Queue a motion message: position in um from the zero, and the speed of x in um/s, rounded half up."""
        self._reported = self.tick
        um = 1000 / self._rig.steps_per_mm
        values = (self._x - self._zero_x, self._y - self._zero_y, self._engine.x_rate)
        self.wires.append(WireMotion(self.tick * NS_PER_TICK, *(math.floor(v * um + 0.5) for v in values)))

    def _send(self, line: bytes) -> None:
        self.replies += line

    def _take(self, byte: int) -> None:
        """Collect a byte of a line; execute the line at its end."""
        if byte != 0x0A:
            self._line.append(byte)
            return
        line = bytes(self._line)
        self._line = bytearray()
        if len(line) >= MAX_LINE_BYTES:
            self._refuse(StageError.LINE_TOO_LONG)
        elif line:
            self._take_line(line)

    def _take_line(self, line: bytes) -> None:
        """Check a line and execute it; a damaged one gets an error without a sequence number."""
        tail = _CHECK_FIELD.fullmatch(line[-5:])
        if tail is None:
            return self._refuse(StageError.MALFORMED)
        if tail[1] != b"%04X" % crc16(line[:-5]):
            return self._refuse(StageError.BAD_CRC)
        try:
            command = Command.decode(line + b"\n")
        except ProtocolError:
            return self._refuse(StageError.MALFORMED)
        self._logic.heard = True
        self._answer(command)

    def _refuse(self, number: StageError, sequence: int | None = None) -> None:
        self._send(Reply("error", sequence, int(number)).encode())

    def _answer(self, command: Command) -> None:
        """Execute a command and answer it; a repeated line gets its first answer again, and is not executed twice."""
        hello = command.verb == "HELLO"
        if not hello:
            if not self._greeted or self._last is None:
                return self._refuse(StageError.SEQUENCE, command.sequence)
            if not self._fresh and command == self._last:
                self._send(self._last_answer)
                if self._last_is_motion:
                    self._send(self._outcome)
                return
            if not self._fresh and command.sequence != (self._last.sequence + 1) % 65536:
                return self._refuse(StageError.SEQUENCE, command.sequence)
        fields: dict[str, str] = {}
        if hello:
            steps = round(self._rig.steps_per_mm)
            fields = {"fw": FIRMWARE, "proto": str(PROTOCOL_VERSION), "steps": str(steps)}
        self._last = command
        accepted = True
        try:
            self._logic.execute(command.verb, command.args)
            answer = Reply("ok", command.sequence, fields=fields)
        except RefusedCommand as e:
            answer = Reply("error", command.sequence, int(e.number))
            accepted = False
        self._fresh = hello and accepted
        self._greeted = self._greeted or self._fresh
        self._last_is_motion = accepted and command.verb in MOTION_VERBS
        if self._last_is_motion:
            self._motion_sequence = command.sequence
            self._outcome = b""
        self._last_answer = answer.encode()
        self._send(self._last_answer)

    def _format_done(self) -> bytes:
        """Encode the `done` line of the motion command that has ended (docs/spec/stage-line.md)."""
        engine = self._engine
        logic = self._logic
        fields = {}
        if logic.row_command:
            fields = {"points": engine.points, "pulses": engine.pulses}
        fields |= {"x": engine.x, "y": engine.y}
        if logic.row_command:
            fields["held"] = int(logic.held)
        if logic.homing_command:
            fields |= {"lostx": logic.lost_x, "losty": logic.lost_y}
        return Reply("done", self._motion_sequence, fields={k: str(v) for k, v in fields.items()}).encode()

    def _format_status(self) -> bytes:
        """Encode a status reply (docs/spec/stage-line.md)."""
        engine = self._engine
        logic = self._logic
        fields: dict[str, object] = {"state": logic.state, "x": engine.x, "y": engine.y}
        fields |= {"points": engine.points, "pulses": engine.pulses, "alarm": int(logic.alarm or 0)}
        fields |= {"limits": self._read_inputs(), "homed": int(logic.homed)}
        return Reply("status", fields={k: str(v) for k, v in fields.items()}).encode()
