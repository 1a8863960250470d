"""The motion stage: its serial link, the driver in millimetres, and the blocking form for bring-up.

`StageLink` sends numbered lines, repeated until answered, and immediate bytes (one byte that acts during a motion). Its
reader thread separates answers to lines from unsolicited replies (done, alarm, status, banner) and asks for the stage's
status at an interval: this is the heartbeat without which a moving stage stops. Protocol: docs/spec/stage-line.md.
"""

from __future__ import annotations

import os
import queue
import termios
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Literal, NamedTuple

import msgspec
import serial

from polysight_pi.edges import RowMotion
from polysight_shared.errors import DeviceError, ErrorCode, ProtocolError
from polysight_shared.faults import PiFault, StageError, explain
from polysight_shared.raster import INVERTIBLE, Stage
from polysight_shared.stage_line import (
    END_OF_TIME_NS,
    HOMING_TIMEOUT_S,
    MAX_LINE_BYTES,
    MAX_SEQUENCE,
    PROTOCOL_VERSION,
    Command,
    Immediate,
    Parameter,
    Reply,
)
from polysight_shared.units import NS_PER_S

# A byte on the serial line, with start and stop bit.
BITS_PER_BYTE = 10
# The first opening of the port resets an UNO, whose boot loader takes up to 2 s; a second more is chosen.
BANNER_TIMEOUT_S = 3.0
# The longest line and its answer take 14 ms at 115200 baud. While an answer is lost the stage may move already, and a
# stop waits for this timeout; it is a fifth of the 0.5 s within which a stop has to be sent.
ANSWER_TIMEOUT_S = 0.1
# How often a line is sent before the stage counts as lost: for 2.1 s, because a busy machine may read late (chosen).
TRIES = 21
# How often a line is sent that arrives damaged (chosen): that answer comes immediately, and a stage that chatters may
# send any number of such answers.
DAMAGED_TRIES = 4
# Error numbers of answers that report a damaged line: it is sent again.
RETRIED_ERRORS = (StageError.BAD_CRC, StageError.LINE_TOO_LONG)
# Status requests to a moving stage per heartbeat, so that a lost one does not stop it.
STATUS_PER_HEARTBEAT = 4
# Timeout of a status request, in heartbeats. With the time until the next request and the read timeout, a silent stage
# is noticed before its own heartbeat stops it.
SILENT_HEARTBEATS = 0.5
# Timeout at rest: nothing has to be stopped, and a busy machine may answer late; chosen.
SILENT_AT_REST_S = 3.0
# Interval of status requests to a stage at rest; chosen.
IDLE_STATUS_S = 1.0
# Longest interval of status requests to a moving stage, for any heartbeat: shorter than at rest.
MOVING_STATUS_S = 0.5
# Longest time from STOP to standstill; chosen.
STOP_TIMEOUT_S = 3.0
# Between two attempts to clear an alarm of a stage that still moves; chosen.
CLEAR_RETRY_S = 0.05
# The thread that commands the stage counts as hung after so long without a turn: longer than a line and its retries
# take.
CALLER_LATE_S = 3.0
# Largest position in the messages; a reply with a larger one was damaged.
MAX_MM = 1e6
# Timeout of writing a line, and of the answer to a status byte while nothing moves; both chosen.
WRITE_TIMEOUT_S = 1.0
POSITION_TIMEOUT_S = 1.0
# Longest time for which `BenchStage` waits for the end of a motion: homing is the longest.
MOTION_TIMEOUT_S = HOMING_TIMEOUT_S


class StageLostError(DeviceError):
    """The stage does not answer, or its port is lost."""

    number = PiFault.STAGE_LOST


class StageRefusedError(DeviceError):
    """The stage answered a line with `error:<number>`."""

    def __init__(self, verb: str, number: int) -> None:
        explanation = explain(number)
        summary = f"stage refused {verb}: error {number}, {explanation.problem}"
        super().__init__(summary, explanation.cause, explanation.remedy, code=ErrorCode.REFUSED_BY_PEER)
        self.number = number


class StageLost(NamedTuple):
    """The link is lost; `reason` says how, for people."""

    reason: str


# Reports of a link's reader thread.
StageNews = Reply | StageLost


class StatusWatch:
    """Schedules status requests and detects a silent stage. All times are those of one clock, in seconds."""

    def __init__(self, heartbeat_s: float, now_s: float) -> None:
        # Timeout of a request to a moving stage.
        self._silence_s = SILENT_HEARTBEATS * heartbeat_s
        # Time of the newest request.
        self._asked_s = now_s
        # Time of the oldest request without an answer; None: all are answered.
        self._unanswered_since_s: float | None = None
        # Time of the last call of `silent_s`.
        self._looked_s = now_s
        # The reader calls `is_due` and `silent_s` at this interval: twice per request; 0.05 s is chosen.
        self.look_s = min(0.05, heartbeat_s / STATUS_PER_HEARTBEAT / 2)
        # Time between status requests; 0: there are none.
        self.interval_s = 0.0

    def ask_every(self, interval_s: float, now_s: float) -> None:
        """Request the status at this interval from now on, 0: never; an open request's timeout begins again."""
        self.interval_s = interval_s
        if self._unanswered_since_s is not None:
            self._unanswered_since_s = now_s

    @property
    def is_at_rest(self) -> bool:
        """True if the interval is that of a stage at rest."""
        return self.interval_s >= IDLE_STATUS_S

    def is_due(self, now_s: float) -> bool:
        """Return True, once per interval, if the status is to be requested now."""
        if not self.interval_s or now_s - self._asked_s < self.interval_s:
            return False
        self._asked_s = now_s
        if self._unanswered_since_s is None:
            self._unanswered_since_s = now_s
        return True

    def note_answer(self) -> None:
        """Note that the stage has answered a status request."""
        self._unanswered_since_s = None

    def silent_s(self, now_s: float) -> float:
        """Return how long the stage has been silent; 0 while that is within the timeout.

        Time in which the caller itself was late does not count.
        """
        # Up to one interval more between two calls is usual.
        late_s = now_s - self._looked_s - 2 * self.look_s
        self._looked_s = now_s
        if self._unanswered_since_s is not None and late_s > 0:
            self._unanswered_since_s += late_s
        timeout_s = self._silence_s
        if self.is_at_rest:
            timeout_s = max(timeout_s, SILENT_AT_REST_S)
        if self._unanswered_since_s is None or now_s - self._unanswered_since_s <= timeout_s:
            return 0.0
        return now_s - self._unanswered_since_s


class StageLink:
    """An open serial link to the stage at `port`.

    The constructor and all methods that send raise StageLostError if the stage does not answer or the port is lost.

    Parameters
    ----------
    news
        Called by the reader thread with every unsolicited reply, every `ok` (it separates replies before a command from
        those after it), and one :class:`StageLost` when the link is lost. Must return immediately.
    heartbeat_s
        The stage's heartbeat; a moving stage is lost if a status request is not answered within half of it.
    banner_timeout_s
        Timeout for the banner of a stage that was reset by opening the port; a stage without one is greeted anyway.
    caller_late_s
        Returns for how long the thread that commands the stage has not completed a turn. A stage in motion is stopped
        if that and the time since its last command exceed `CALLER_LATE_S`, or the heartbeat would keep a stage moving
        that no program controls.
    bound_now_ns
        Returns the earliest and the latest time that it can be now on the clock of the trigger edges, for the times of
        each reply.
    """

    def __init__(
        self,
        port: str,
        baud: int,
        news: Callable[[StageNews], None],
        heartbeat_s: float = 2.0,
        banner_timeout_s: float = BANNER_TIMEOUT_S,
        caller_late_s: Callable[[], float] = lambda: 0.0,
        bound_now_ns: Callable[[], tuple[int, int]] = lambda: (0, END_OF_TIME_NS),
    ) -> None:
        self.port = port
        self._news = news
        self._caller_late_s = caller_late_s
        self._bound_now_ns = bound_now_ns
        # Earliest times of the last two status requests without an answer. A moving stage that leaves more open is
        # lost; outside of rows the times are not used.
        self._asked_ns: deque[int] = deque(maxlen=2)
        # Time of the last line that was sent.
        self._commanded_s = time.monotonic()
        self._watch = StatusWatch(heartbeat_s, time.monotonic())
        try:
            self._serial = serial.Serial(
                port, baud, timeout=self._watch.look_s, write_timeout=WRITE_TIMEOUT_S, exclusive=True
            )
            # Keep DTR up when the port is closed: its next rise would reset an UNO, which would lose its position.
            # Element 2 of the settings has the control flags.
            settings = termios.tcgetattr(self._serial.fileno())
            settings[2] &= ~termios.HUPCL
            termios.tcsetattr(self._serial.fileno(), termios.TCSANOW, settings)
        except (OSError, ValueError, termios.error) as e:
            # SerialException is an OSError, too, but may have no number.
            reason = os.strerror(e.errno) if isinstance(e, OSError) and e.errno else str(e)
            raise StageLostError(
                f"stage port {port} cannot be opened: {reason}",
                "cable unplugged, wrong port, no permission (group dialout), or another program uses it",
                "check stage.port in instrument.toml and `ls -l /dev/ttyACM* /dev/ttyUSB*`",
                code=ErrorCode.FILE_UNREADABLE,
            ) from None
        self._write_lock = threading.Lock()
        # Replies `ok` and `error`, from the reader; None: the link is lost.
        self._answers: queue.SimpleQueue[Reply | None] = queue.SimpleQueue()
        self._banner: Reply | None = None
        self._banner_seen = threading.Event()
        # True once the stage has answered HELLO; before that nothing is reported to `news`.
        self._greeted = False
        self._closing = False
        # Number of the next line.
        self._sequence = 0
        # Number of received lines that could not be read.
        self.bad_lines = 0
        self._last_line = b""
        # Why the link was lost; "" while it is not.
        self.lost = ""
        self._reader = threading.Thread(target=self._read, name="stage", daemon=True)
        self._reader.start()
        try:
            self._greet(banner_timeout_s)
        except DeviceError:
            self.close()
            raise

    def _greet(self, banner_timeout_s: float) -> None:
        """Wait for the banner of a reset stage, send HELLO, and store release and steps per mm of the firmware.

        Raises StageLostError without an answer or for another version of the protocol.
        """
        self._banner_seen.wait(banner_timeout_s)
        # The line end completes a partial line that was sent earlier.
        self._write(b"\n")
        hello = self.request("HELLO")
        fields = {**(self._banner.fields if self._banner else {}), **hello.fields}
        self.firmware = fields.get("fw", "")
        self.steps_per_mm = fields.get("steps", "")
        if fields.get("proto", str(PROTOCOL_VERSION)) != str(PROTOCOL_VERSION):
            raise StageLostError(
                f"stage at {self.port} speaks protocol {fields['proto']}, this program speaks {PROTOCOL_VERSION}",
                "firmware and Pi program are of different releases",
                "flash the sketch of this release",
                code=ErrorCode.VERSION_UNSUPPORTED,
            )
        self._greeted = True

    def request(self, verb: str, *args: int) -> Reply:
        """Send a line and return the answer; retry with the same number if it is lost or damaged.

        Raises StageRefusedError if the stage refuses the line, StageLostError if it does not answer.
        """
        answer = self._exchange(verb, args)
        # The stage has missed a line, or was reset: after HELLO it takes any number for the next one.
        if answer.number == StageError.SEQUENCE and verb != "HELLO":
            self._exchange("HELLO", ())
            answer = self._exchange(verb, args)
        if answer.kind == "error":
            raise StageRefusedError(verb, answer.number)
        return answer

    def _exchange(self, verb: str, args: tuple[int, ...]) -> Reply:
        """Send a line with the next number until it is answered; return the answer, which may be an error.

        Raises StageLostError.
        """
        sequence = self._sequence
        self._sequence = (sequence + 1) % (MAX_SEQUENCE + 1)
        self._last_line = Command(sequence, verb, args).encode()
        while not self._answers.empty():
            self._answers.get()
        damaged = 0
        for _ in range(TRIES):
            self._commanded_s = time.monotonic()
            self._write(self._last_line)
            answer = self._answer(sequence)
            if answer is None:
                continue
            if answer.number not in RETRIED_ERRORS:
                return answer
            damaged += 1
            if damaged == DAMAGED_TRIES:
                raise StageLostError(
                    f"stage at {self.port} received {verb} damaged {damaged} times, or its answers are",
                    "the USB cable is disturbed or too long, or stage.baud differs from the sketch's",
                    "use a short shielded USB cable, and check stage.baud",
                    code=ErrorCode.NO_ANSWER,
                )
        raise StageLostError(
            f"stage at {self.port} does not answer {verb} {self.lost}".rstrip(),
            "cable unplugged, board without the sketch, or wrong port",
            "check the USB cable, stage.port and stage.baud; `make flash` puts the sketch on the board",
            code=ErrorCode.NO_ANSWER,
        )

    def _answer(self, sequence: int) -> Reply | None:
        """Return the answer to this line, or an error for one that could not be read; None: timeout, or link lost."""
        deadline = time.monotonic() + ANSWER_TIMEOUT_S
        while (left_s := deadline - time.monotonic()) > 0:
            try:
                answer = self._answers.get(timeout=left_s)
            except queue.Empty:
                return None
            if answer is None or answer.sequence == sequence or (answer.kind == "error" and answer.sequence is None):
                return answer
        return None

    def send_byte(self, byte: Immediate) -> None:
        """Send an immediate byte."""
        self._write(byte.sent)

    def repeat(self) -> None:
        """Send the last line again: the stage repeats its answer and the end of its motion, without moving."""
        self._write(self._last_line)

    def ask_status_every(self, interval_s: float) -> None:
        """Request the status at this interval: the heartbeat of a moving stage. 0 stops the requests."""
        self._watch.ask_every(interval_s, time.monotonic())

    def close(self) -> None:
        """Close the port and end the reader."""
        self._closing = True
        if self._serial.is_open:
            self._serial.cancel_read()
        if threading.current_thread() is not self._reader:
            self._reader.join(1.0)
        self._serial.close()

    def _write(self, data: bytes) -> None:
        """Send bytes, from any thread. Raises StageLostError."""
        if self.lost:
            raise StageLostError(f"stage at {self.port} is lost: {self.lost}", "see above", "polysight-pi home")
        try:
            with self._write_lock:
                self._serial.write(data)
        except OSError as e:
            self._lose(f"writing failed: {e}")
            unplugged = "cable unplugged, or the board lost power"
            raise StageLostError(f"stage at {self.port} is lost: {e}", unplugged, "check the USB cable") from None

    def _lose(self, reason: str) -> None:
        """Note and report, once, that the link is lost; end a wait for an answer."""
        if self.lost or self._closing:
            return
        self.lost = reason
        self._answers.put(None)
        if self._greeted:
            self._news(StageLost(f"stage at {self.port}: {reason}"))

    def _read(self) -> None:
        """The reader thread: distribute received lines, request the status when it is due, detect a silent stage."""
        buffer = b""
        while not self._closing and not self.lost:
            try:
                data = self._serial.read(1)
                data += self._serial.read(self._serial.in_waiting)
            except (OSError, TypeError) as e:
                # Pyserial raises TypeError when the port is closed under a read.
                self._lose(f"reading failed: {e}")
                return
            *lines, buffer = (buffer + data).split(b"\n")
            for line in lines:
                self._take(line + b"\n")
            buffer = buffer[-MAX_LINE_BYTES:]
            now = time.monotonic()
            if silent_s := self._watch.silent_s(now):
                self._lose(f"silent for {silent_s:.1f} s: no valid line")
                self._stop_unheard()
                return
            if self._watch.is_due(now):
                try:
                    self._ask_status(now)
                except StageLostError:
                    return

    def _stop_unheard(self) -> None:
        """Stop a moving stage whose answers are lost: it may hear, and its own heartbeat would act only later."""
        if not self._watch.is_at_rest:
            with self._write_lock, suppress(OSError):
                self._serial.write(Immediate.STOP.sent)

    def _ask_status(self, now: float) -> None:
        """Request the status at `now`, in seconds; stop a moving stage instead if the commanding thread hangs.

        Raises StageLostError.
        """
        hung_s = min(self._caller_late_s(), now - self._commanded_s)
        if hung_s < CALLER_LATE_S or self._watch.is_at_rest:
            self._asked_ns.append(self._bound_now_ns()[0])
            self._write(bytes([Immediate.STATUS]))
        else:
            self._write(Immediate.STOP.sent)
            self._lose(f"this program has sent it no command for {hung_s:.1f} s: it was stopped")

    def _take(self, line: bytes) -> None:
        """Distribute a received line: answers to the thread that waits for them, and all but errors to `news`."""
        try:
            reply = Reply.decode(line.replace(b"\r\n", b"\n"))
        except ProtocolError:
            # If it was an answer, its line is retried.
            self.bad_lines += 1
            return
        # Only the answer to the request is a sign of life; a serial line can chatter without end, and repeat itself.
        asked_ns = 0
        if reply.kind == "status":
            self._watch.note_answer()
            if self._asked_ns:
                asked_ns = self._asked_ns.popleft()
        # Its last byte came now; the stage wrote the line before its first one.
        written_ns = self._bound_now_ns()[1] - len(line) * BITS_PER_BYTE * NS_PER_S // self._serial.baudrate
        reply = msgspec.structs.replace(reply, asked_ns=asked_ns, written_ns=written_ns)
        if reply.kind in ("ok", "error"):
            self._answers.put(reply)
        elif reply.kind == "banner" and not self._greeted:
            self._banner = reply
            self._banner_seen.set()
        if self._greeted and reply.kind != "error":
            self._news(reply)


class StageDriver:
    """The stage of the [stage] table, in millimetres. Used by one thread.

    `news` and `of_link` are arguments of :class:`StageLink`. `x_mm` and `y_mm` are the position of the last status or
    end of a motion, in stage coordinates (zero = where homing ends); `firmware` is the release of the sketch. Methods
    that send raise StageLostError, or StageRefusedError if the stage refuses the command.
    """

    def __init__(self, config: Stage, news: Callable[[StageNews], None], **of_link: Any) -> None:
        self.config = config
        self._of_link = of_link
        self.port = config.port
        self._news = news
        # The link; None before `connect`.
        self._open_link: StageLink | None = None
        self.x_mm = 0.0
        self.y_mm = 0.0
        self.firmware = ""

    def connect(self) -> None:
        """Open the port and greet the stage, unless the link is open already.

        Raises StageLostError if there is no answer, or if the stage's steps per mm differ from the rig file's.
        """
        if self._open_link is not None and not self._open_link.lost:
            return
        self.close()
        self._open_link = link = StageLink(
            self.port,
            self.config.baud,
            self._news,
            self.config.heartbeat_ms / 1e3,
            **self._of_link,
        )
        if link.steps_per_mm not in ("", f"{self.config.steps_per_mm:g}"):
            self.close()
            raise StageLostError(
                f"stage at {self.port} makes {link.steps_per_mm} steps per mm,"
                f" the rig file says {self.config.steps_per_mm:g}",
                "board.h of the sketch and stage.steps_per_mm in instrument.toml differ",
                "correct the wrong one",
                code=ErrorCode.MISMATCH,
            )
        self.firmware = link.firmware
        link.ask_status_every(IDLE_STATUS_S)

    @property
    def link(self) -> StageLink:
        """The open link. Raises StageLostError if there is none."""
        if self._open_link is None:
            raise StageLostError(f"stage at {self.port} is not connected", "its port was lost", "polysight-pi home")
        return self._open_link

    def clear(self, stop: bool = False) -> None:
        """Clear a latched alarm once the stage is at rest; with `stop`, send STOP until it is.

        Raises StageRefusedError if the cause of the alarm is still there, or the position is unknown.
        """
        deadline = time.monotonic() + STOP_TIMEOUT_S
        while True:
            try:
                self.link.request("CLEAR")
                return
            except StageRefusedError as e:
                if e.number != StageError.BUSY or time.monotonic() > deadline:
                    raise
            if stop:
                self.link.send_byte(Immediate.STOP)
            # The stage still moves: an earlier program started it, or it slows down.
            time.sleep(CLEAR_RETRY_S)

    def home(self) -> int:
        """Stop, clear alarms, send the settings, switch the motors on and start homing.

        Returns the sequence number of its `done`.
        """
        self._switch_on()
        return self._start("HOME")

    def buzz(self, axis: Literal["x", "y"]) -> int:
        """Move an axis by 1 mm each way, slowly, homed or not; return the sequence number of its `done`."""
        self._switch_on()
        return self._start("BUZZ", "xy".index(axis))

    def _switch_on(self) -> None:
        """Stop the stage, clear alarms, send the settings of [stage] in the units of the line, switch the motors on."""
        try:
            self.clear(stop=True)
        except StageRefusedError as e:
            # Homing is the remedy of this error.
            if e.number != StageError.NOT_HOMED:
                raise
        config = self.config
        settings = {
            Parameter.ACCEL: config.accel_mm_s2 * config.steps_per_mm,
            Parameter.HEARTBEAT: config.heartbeat_ms,
            Parameter.TRIGGER: config.trigger_width_us,
            Parameter.TRAVEL_X: config.travel_x_mm * config.steps_per_mm,
            Parameter.TRAVEL_Y: config.travel_y_mm * config.steps_per_mm,
            Parameter.TRAVEL_SPEED: config.travel_speed_mm_s * config.steps_per_mm,
            Parameter.BACKLASH: config.backlash_mm * config.steps_per_mm,
            # A bit for each pin with the other level than in board.h.
            Parameter.PINS: sum(1 << INVERTIBLE.index(pin) for pin in config.inverted),
        }
        for parameter, value in settings.items():
            try:
                self.link.request("SET", int(parameter), round(value))
            except StageRefusedError as e:
                if parameter == Parameter.PINS:
                    e.why = "the sketch is older than this program and does not know stage.inverted"
                    e.remedy = "flash the sketch of this release"
                raise
        self.link.request("ENABLE", 1)

    def row(self, motion: RowMotion) -> int:
        """Start a row; return the sequence number of its `done`."""
        return self._start("ROW", *motion.line)

    def move(self, x_mm: float, y_mm: float, speed_mm_s: float) -> int:
        """Start a move to a position in stage coordinates; return the sequence number of its `done`."""
        k = self.config.steps_per_mm
        return self._start("MOVE", round(x_mm * k), round(y_mm * k), round(speed_mm_s * k))

    def slow_down_polling(self) -> None:
        """Ask for the status less often: the stage does not move."""
        if self._open_link is not None:
            self._open_link.ask_status_every(IDLE_STATUS_S)

    def note_position(self, reply: Reply) -> None:
        """Store x and y of a status or done reply; a missing or impossible position is ignored."""
        try:
            x_mm = reply.integer("x") / self.config.steps_per_mm
            y_mm = reply.integer("y") / self.config.steps_per_mm
        except ProtocolError:
            return
        if max(abs(x_mm), abs(y_mm)) <= MAX_MM:
            self.x_mm = x_mm
            self.y_mm = y_mm

    def close(self) -> None:
        """Close the port."""
        link = self._open_link
        self._open_link = None
        if link is not None:
            link.close()

    def _start(self, verb: str, *args: int) -> int:
        """Begin the heartbeat of a moving stage and send a motion command; return its sequence number."""
        # The heartbeat has to begin before the motion does.
        self.link.ask_status_every(min(self.config.heartbeat_ms / 1e3 / STATUS_PER_HEARTBEAT, MOVING_STATUS_S))
        try:
            answer = self.link.request(verb, *args)
        except StageRefusedError:
            self.slow_down_polling()
            raise
        # -1: no `done` has this number.
        return -1 if answer.sequence is None else answer.sequence


class Position(NamedTuple):
    """Position of the stage, millimetres in stage coordinates."""

    x_mm: float
    y_mm: float


class BenchStage:
    """The stage without the service: every method waits for the motion's end, and SIGINT stops the stage.

    A context manager that connects and closes the port. Methods raise DeviceError, for example when not homed.
    """

    def __init__(self, config: Stage) -> None:
        self._news: queue.SimpleQueue[StageNews] = queue.SimpleQueue()
        self._driver = StageDriver(config, self._news.put)

    def __enter__(self) -> BenchStage:
        self._driver.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self._driver.close()

    @property
    def firmware(self) -> str:
        """Release of the sketch."""
        return self._driver.firmware

    def home(self) -> Position:
        """Home the stage; return its position."""
        return self._finish(self._driver.home())

    def buzz(self, axis: Literal["x", "y"]) -> Position:
        """Move an axis by 1 mm each way; return the position, which is that of before."""
        return self._finish(self._driver.buzz(axis))

    def jog(self, dx_mm: float, dy_mm: float, speed_mm_s: float) -> Position:
        """Move by (dx, dy); return the new position."""
        position = self.position()
        return self._finish(self._driver.move(position.x_mm + dx_mm, position.y_mm + dy_mm, speed_mm_s))

    def position(self) -> Position:
        """Ask the stage for its position."""
        self._driver.link.send_byte(Immediate.STATUS)
        silent = StageLostError("the stage does not answer the status byte", "wrong firmware", "flash this release")
        return self._wait(lambda reply: reply.kind == "status", POSITION_TIMEOUT_S, silent)

    def _finish(self, sequence: int) -> Position:
        """Wait for the end of the motion with this sequence number; return the position."""
        timeout_error = StageLostError(
            f"the motion has not ended after {MOTION_TIMEOUT_S:.0f} s", "the motors stall", "look"
        )
        try:
            return self._wait(lambda r: r.kind == "done" and r.sequence == sequence, MOTION_TIMEOUT_S, timeout_error)
        except KeyboardInterrupt:
            self._driver.link.send_byte(Immediate.STOP)
            raise

    def _wait(self, matches: Callable[[Reply], bool], timeout_s: float, timeout: StageLostError) -> Position:
        """Wait for a reply that matches; return the position then. Raises `timeout`, or DeviceError after an alarm."""
        deadline = time.monotonic() + timeout_s
        while (left_s := deadline - time.monotonic()) > 0:
            try:
                news = self._news.get(timeout=left_s)
            except queue.Empty:
                break
            if isinstance(news, StageLost):
                raise StageLostError(news.reason, "cable unplugged", "check the USB cable")
            if news.kind == "alarm":
                explanation = explain(news.number)
                raise DeviceError(
                    f"stage alarm {news.number}: {explanation.problem}", explanation.cause, explanation.remedy
                )
            self._driver.note_position(news)
            if matches(news):
                return Position(self._driver.x_mm, self._driver.y_mm)
        raise timeout
