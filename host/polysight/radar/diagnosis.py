"""Examine a board: check its bring-up step by step, log its traffic to a file (`TracedWords`), and replay such a file.

A *word* is the 16 bits that SPI shifts at a time; a *word link* shifts them through the capture card's USB chip, and
has the board's reset and interrupt lines. A trace has one JSON object a line; docs/spec/mmwavelink.md ("Traces") has
the format. A replay (`ReplayedWords`) replaces the board, so that a failure can be examined without it. Not run on
hardware yet.
"""

from __future__ import annotations

import itertools
import json
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec

from polysight.radar.board import RadarBoard, Step
from polysight.radar.usb import Clock, WordLink
from polysight_shared import __version__
from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError, DeviceError, ErrorCode, PolysightError
from polysight_shared.files import read_bounded

# Jumpers as they must be, printed if the reset fails.
JUMPERS = """\
    SOP2      SOP1      SOP0          of the AWR2243BOOST, for control over SPI
   [ o o ]   [ o o ]   [ o=o ]        o=o  jumper set      o o  open
    open      open      set           (mmWave Studio needs SOP1 set too: remove it here)"""

# Bit of the boot status (TI's mmWave Radar Interface Control Document, table 7.3): error of the voltage monitor.
VOLTAGE_MONITOR_BIT = 57


class StepResult(NamedTuple):
    """Printed result of one step.

    `passed`: True if the step succeeded; `outcome`: its result, or the error; `remedy`: empty after a success.
    """

    step: str
    passed: bool
    expected: str
    outcome: str
    remedy: str = ""


def check_board(
    open_words: Callable[[], WordLink],
    make_board: Callable[[WordLink], RadarBoard],
    transmits: bool,
    on_result: Callable[[StepResult], None],
) -> RadarBoard | None:
    """Bring up a board from USB to one frame; stop at the first step that fails.

    An error of the voltage monitor is reported, but does not stop the bring-up.

    Parameters
    ----------
    open_words, make_board
        Open the USB chip that leads to the board, and create the board with that link.
    transmits
        True if the board transmits.
    on_result
        Called with the result of each step.

    Returns
    -------
    RadarBoard or None
        The board in its current state, for its report; None if its chip could not be opened.
    """
    opening = "four channels of the FT4232H on the capture card"
    try:
        words = open_words()
    except PolysightError as error:
        on_result(
            StepResult("USB", passed=False, expected=opening, outcome=error.what, remedy=f"{error.why}; {error.remedy}")
        )
        return None
    on_result(StepResult("USB", passed=True, expected=opening, outcome="opened"))
    board = make_board(words)
    steps_done: list[Step] = []

    def on_step(step: Step, outcome: str) -> None:
        steps_done.append(step)
        on_result(StepResult(step.name, passed=True, expected=step.expected, outcome=outcome))
        if step.name == "reset":
            on_result(_judge_supplies(board))

    try:
        board.configure(on_step)
    except PolysightError as error:
        failed_step = None
        if len(steps_done) < len(board.steps):
            failed_step = board.steps[len(steps_done)]
        on_result(_describe_failure(failed_step, error))
        return board
    _check_frame(board, transmits, on_result)
    return board


def _check_frame(board: RadarBoard, transmits: bool, on_result: Callable[[StepResult], None]) -> None:
    """Run one frame of a configured board, then read back its settings; report both."""
    expected = "frame end, 1 frame"
    if transmits:
        expected += " (this board transmits)"
    try:
        on_result(StepResult("one frame", passed=True, expected=expected, outcome=board.run_one_frame()))
    except PolysightError as error:
        on_result(
            StepResult(
                "one frame", passed=False, expected=expected, outcome=error.what, remedy=f"{error.why}; {error.remedy}"
            )
        )
        return
    expected = "profile, chirp and frame as sent"
    try:
        differences = board.read_back()
        if differences:
            remedy = "compare the fields with docs/spec/mmwavelink.md; a reserved field that differs is harmless"
            on_result(
                StepResult("read back", passed=False, expected=expected, outcome="; ".join(differences), remedy=remedy)
            )
        else:
            on_result(StepResult("read back", passed=True, expected=expected, outcome="as sent"))
    except PolysightError as error:
        on_result(
            StepResult(
                "read back", passed=False, expected=expected, outcome=error.what, remedy=f"{error.why}; {error.remedy}"
            )
        )


def _describe_failure(step: Step | None, error: PolysightError) -> StepResult:
    """Return the result of the step that failed; None: all steps had passed when the error came."""
    if step is None:
        return StepResult(
            "bring-up", passed=False, expected="", outcome=error.what, remedy=f"{error.why}; {error.remedy}"
        )
    picture = ""
    if step.name == "reset":
        picture = f"\n{JUMPERS}"
    remedy = f"{error.why}; {error.remedy or step.remedy}{picture}"
    return StepResult(step.name, passed=False, expected=step.expected, outcome=error.what, remedy=remedy)


def _judge_supplies(board: RadarBoard) -> StepResult:
    """Judge the supplies by the main core's power-up and the report of its voltage monitor."""
    boot_errors = (board.facts.boot or {}).get("boot_errors", 0)
    expected = "the core runs, no error of the voltage monitor"
    if isinstance(boot_errors, int) and boot_errors >> VOLTAGE_MONITOR_BIT & 1:
        remedy = "measure the RF supplies (1.3 V or 1.0 V), 1.8 V and 3.3 V"
        return StepResult(
            "power rails",
            passed=False,
            expected=expected,
            outcome="the main core runs; its voltage monitor reports an error",
            remedy=remedy,
        )
    return StepResult("power rails", passed=True, expected=expected, outcome="the main core runs; no error reported")


# Version of the file format of traces.
TRACE_VERSION = 1
# Names in a trace of the board's two signals: host interrupt and reset (low: held in reset).
INTERRUPT = "HOST_INTR"
RESET = "NRST"
# Largest file that is read as a trace, bytes (chosen).
MAX_BYTES = 2**26
# Latest time in a trace, about four months: a line with a later one is damaged.
_MAX_S = 1e7


class TracedWords:
    """A word link (`usb.WordLink`) that logs its traffic.

    Parameters
    ----------
    words, clock
        The link, and the clock for the log.
    file
        Overwritten; each line is flushed immediately. A full disk ends only the log; `ended` then has the reason, and
        is empty before.
    facts
        Content of the first line, see `trace_words`.

    Raises
    ------
    OSError
        if the file cannot be opened for writing.
    """

    def __init__(self, words: WordLink, clock: Clock, file: Path, facts: dict[str, object]) -> None:
        self._words = words
        self._clock = clock
        self._began = clock.now()
        self._file = file.open("w", encoding="utf-8")
        # The interrupt's level in the log; None before the first query.
        self._level: bool | None = None
        # Queries of the interrupt since the last line, all with the same level.
        self._queries = 0
        self.file = file
        self.ended = ""
        self._write({"trace": TRACE_VERSION, **facts})

    def write(self, words: Sequence[int]) -> None:
        """Shift words out. Raises DeviceError."""
        self._log_action(out=_format_hex(words))
        with self._log_errors():
            self._words.write(words)

    def read(self, count: int) -> list[int]:
        """Shift words in. Raises DeviceError."""
        with self._log_errors():
            words = self._words.read(count)
        self._log_action(**{"in": _format_hex(words)})
        return words

    def interrupt(self) -> bool:
        """Return the host interrupt and log its changes. Raises DeviceError."""
        with self._log_errors():
            level = self._words.interrupt()
        if level is self._level:
            self._queries += 1
        else:
            self._level = level
            self._log_action(line=INTERRUPT, level=int(level), looks=self._queries)
        return level

    def reset(self, held: bool) -> None:
        """Set the reset line. Raises DeviceError."""
        self._log_action(line=RESET, level=int(not held))
        with self._log_errors():
            self._words.reset(held)

    def close(self) -> None:
        """Close link and file; may be called twice."""
        self._words.close()
        # Closing writes what is buffered, and fails on a full disk.
        with suppress(OSError):
            self._file.close()

    @contextmanager
    def _log_errors(self) -> Iterator[None]:
        """Log a DeviceError of the block before it is raised."""
        try:
            yield
        except DeviceError as e:
            self._log_action(error=e.what)
            raise

    def _log_action(self, **action: object) -> None:
        """Log one action with its time."""
        self._queries = 0
        self._write({"t": round(self._clock.now() - self._began, 6), **action})

    def _write(self, line: dict[str, object]) -> None:
        """Write a line, unless the log has ended."""
        if self.ended:
            return
        try:
            self._file.write(json.dumps(line) + "\n")
            self._file.flush()
        except OSError as e:
            self.ended = f"ended early: {e.strerror}"


def trace_words(words: WordLink, clock: Clock, file: Path, rig: Instrument, board: str) -> TracedWords:
    """Log a board's link to `file`.

    Its first line has the board, its USB chip as the rig file gives it (serial number or path), the rig's name, the
    version of this program and the Unix time.
    """
    usb_chip = rig.radar.native[board].place
    now = round(time.time(), 3)
    facts: dict[str, object] = {
        "board": board,
        "place": usb_chip,
        "rig": rig.name,
        "polysight": __version__,
        "unix_s": now,
    }
    return TracedWords(words, clock, file, facts)


def new_trace(folder: Path, board: str) -> Path:
    """Return an unused path for a new trace: BOARD-TIME.jsonl (UTC), with a number if it exists."""
    name = f"{board}-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"
    ends = itertools.chain([""], (f"-{n}" for n in itertools.count(2)))
    names = (folder / f"{name}{end}.jsonl" for end in ends)
    return next(path for path in names if not path.exists())


# Words of 16 bits as hexadecimal digits, the low byte of each first.
Words = Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{4})*$")]


class TraceLine(msgspec.Struct, omit_defaults=True):
    """One line of a trace, `t` seconds after its beginning.

    It has exactly one of these: `line` and its `level`, words written (`out`), words read (`in`), or an `error`.
    """

    t: Annotated[float, msgspec.Meta(ge=0, le=_MAX_S)]
    # Signal of the board that was set or has changed.
    line: Literal["HOST_INTR", "NRST"] | None = None
    level: Literal[0, 1] | None = None
    # Queries of the interrupt with the former level, since the line before.
    looks: Annotated[int, msgspec.Meta(ge=0)] | None = None
    out: Words | None = None
    read: Words | None = msgspec.field(default=None, name="in")
    error: str | None = None

    def __post_init__(self) -> None:
        """Raise ValueError unless the line has exactly one content, and a level if it is a signal's."""
        contents = [value for value in (self.line, self.out, self.read, self.error) if value is not None]
        if len(contents) != 1 or (self.line is None) != (self.level is None):
            raise ValueError("a line of a trace has one content")


class ReplayedWords:
    """Replay of a trace: a word link and a clock in virtual time. `facts` has the trace's first line.

    The host must repeat its actions of the trace; the first difference raises a DeviceError with both. The constructor
    raises the errors of `read_trace`.
    """

    def __init__(self, file: Path) -> None:
        self.facts, self._lines = read_trace(file)
        # Index of the next line of the trace.
        self._next_line = 0
        self._time = 0.0
        self._level = False
        # Queries of the interrupt since the last replayed line.
        self._queries = 0

    def now(self) -> float:
        """Return the trace's time, seconds; each query advances it by 1 us, so that a loop with a deadline ends."""
        self._time += 1e-6
        return self._time

    def sleep(self, seconds: float) -> None:
        """Advance the time."""
        self._time += seconds

    @property
    def done(self) -> bool:
        """True if the whole trace was replayed."""
        return self._next_line >= len(self._lines)

    def write(self, words: Sequence[int]) -> None:
        """Compare the words with those of the trace. Raises DeviceError."""
        written = _format_hex(words)
        self._replay_action(f"out {written}", lambda line: line.out == written)

    def read(self, count: int) -> list[int]:
        """Return the board's words in the trace. Raises DeviceError."""
        # Each word is four digits.
        line = self._replay_action(
            f"reads {count} words", lambda line: line.read is not None and len(line.read) == 4 * count
        )
        words = line.read or ""
        return list(struct.unpack(f"<{count}H", bytes.fromhex(words)))

    def interrupt(self) -> bool:
        """Return the level at this query or, if the trace does not count them, at this time. Raises DeviceError."""
        self._queries += 1
        while self._is_interrupt():
            line = self._lines[self._next_line]
            if line.looks is None:
                is_later = line.t > self.now()
            else:
                is_later = line.looks >= self._queries
            if is_later:
                break
            self._play_level()
            # A counted change is what this query saw; changes by time may be several since the query before.
            if line.looks is not None:
                break
        self._raise_error()
        return self._level

    def reset(self, held: bool) -> None:
        """Compare the reset with that of the trace. Raises DeviceError."""
        level = int(not held)
        self._replay_action(f"level {level}", lambda line: line.level == level)

    def close(self) -> None:
        """Do nothing."""

    def _is_interrupt(self) -> bool:
        return not self.done and self._lines[self._next_line].line == INTERRUPT

    def _play_level(self) -> None:
        """Take over the interrupt's level of the next line."""
        self._level = bool(self._lines[self._next_line].level)
        self._advance()

    def _advance(self) -> TraceLine:
        """Return the next line, and move to the one after it; the clock advances to its time."""
        line = self._lines[self._next_line]
        self._time = max(self._time, line.t)
        self._next_line += 1
        self._queries = 0
        return line

    def _raise_error(self) -> None:
        """Raise the error that the next line has, if it has one."""
        if not self.done and self._lines[self._next_line].error is not None:
            line = self._advance()
            raise DeviceError(line.error or "", "as in the trace", "see the error of the traced run")

    def _replay_action(self, action: str, agrees: Callable[[TraceLine], bool]) -> TraceLine:
        """Replay up to the next line that is not a change of the interrupt, and return it.

        Raises DeviceError if `agrees` is False for that line, or the trace ends before it, and errors of the trace.
        """
        while self._is_interrupt():
            self._play_level()
        self._raise_error()
        if self.done:
            raise DeviceError("the trace ends here", "the traced run ended or was killed", "")
        if not agrees(self._lines[self._next_line]):
            raise self._difference_error(action)
        line = self._advance()
        self._raise_error()
        return line

    def _difference_error(self, action: str) -> DeviceError:
        """Return the error for an action that the trace's next line does not have."""
        recorded = msgspec.json.encode(self._lines[self._next_line]).decode()
        return DeviceError(
            # Lines count from 1, and the first has the facts.
            f"line {self._next_line + 2} of the trace: the host does {action}, the trace has {recorded}",
            "another version of this program, another rig file or board, or another trace",
            "replay it with the rig file and the version of the traced run",
        )


def read_trace(file: Path) -> tuple[dict[str, Any], list[TraceLine]]:
    """Read a trace: its first line, and the others without empty ones and an incomplete last one.

    Raises ConfigError for another file, DataError if it is too large or no regular file, and OSError.
    """
    lines = read_bounded(file, MAX_BYTES).split(b"\n")
    facts: dict[str, Any] | None = None
    records: list[TraceLine] = []
    for number, line in enumerate(lines, 1):
        try:
            value = None
            if line:
                value = msgspec.json.decode(line)
        except (ValueError, RecursionError):
            # The last line of a killed program is incomplete.
            if number < len(lines):
                raise _invalid_error(file, f"line {number} is not JSON") from None
            continue
        if facts is None:
            if not isinstance(value, dict) or value.get("trace") != TRACE_VERSION:
                raise _invalid_error(file, f"its first line is not that of a trace, version {TRACE_VERSION}")
            facts = value
        elif value is not None:
            records.append(_parse_trace_line(file, number, value))
            if len(records) > 1 and records[-1].t < records[-2].t:
                raise _invalid_error(file, f"line {number} has an earlier time than the one before")
    if facts is None:
        raise _invalid_error(file, f"its first line is not that of a trace, version {TRACE_VERSION}")
    return facts, records


def _parse_trace_line(file: Path, number: int, value: object) -> TraceLine:
    """Return a line of a trace from its decoded JSON. Raises ConfigError if it is not one."""
    try:
        return msgspec.convert(value, TraceLine)
    except ValueError:
        raise _invalid_error(file, f"line {number} is not a line of a trace") from None


def _invalid_error(file: Path, what: str) -> ConfigError:
    return ConfigError(
        f"{file}: {what}",
        "another file",
        "give a file of `polysight radar check BOARD --trace FILE`",
        code=ErrorCode.FILE_FOREIGN,
    )


def _format_hex(words: Sequence[int]) -> str:
    """Return 16-bit words as hexadecimal digits, as the type `Words` describes."""
    return struct.pack(f"<{len(words)}H", *words).hex()
