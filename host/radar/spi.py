"""mmWaveLink over 16-bit words: commands and their answers, events between them, and what to do when one is lost.

Procedure: ICD section 3. A time-out sends the same message again with the retry flag, which the device answers without
obeying twice; a NACK sends it with a new sequence number. Every wait has a limit, and a device that never stops sending
events is read for a moment only. Not run on hardware yet.
"""

from __future__ import annotations

import struct
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

from polysight.host.radar.commands import RF_POWER_UP, Command
from polysight.host.radar.events import STARTED_ANEW, Event, decode_event, describe_refusal
from polysight.host.radar.messages import (
    DEVICE_SYNC,
    HEADER_BYTES,
    READY_TO_READ,
    SYNC_BYTES,
    Direction,
    Kind,
    Message,
    command,
    decode,
    decode_header,
    encode,
)
from polysight.shared.errors import DeviceError, ProtocolError

RESPONSE_S = 1.0
ATTEMPTS = 3
SETTLE_S = 30e-6  # from the interrupt to the first word (ICD 20)
DATA_S = 1e-3  # from the interrupt's fall to the first word read, as TI's port waits
_LOOK_S = 0.5e-3
_INTERRUPT_LOW_S = 0.1
_LINGER_S = 0.1  # a device's power-up event comes within; only looked for when a command was refused
MESSAGES_A_POLL = 64  # read in one look at most, or
POLL_S = 0.25  # for so long, when events follow each other without end
_MOST_WARNINGS = 100
_SYNC_SEARCH_BYTES = 252
_FLUSH_BYTES = 244  # of a message whose header is not to be believed: so many bytes bring the device back in step
_DO = "check the board's power, the 60-pin connector and the USB cable, then `polysight resume SCAN`"


class Problem(NamedTuple):
    """Why a message could not be had: what was seen, and the likely cause."""

    what: str
    why: str


_SILENT = "the board has no power, hangs, or its interrupt line is not connected"
_NOT_CLOCKED = "the board does not hear its SPI clock or chip select, or its interrupt line is stuck"
_NOT_HEARD = "the board's data line (MISO) is not connected, or SPI is disturbed"
_DISTURBED = "the SPI lines are disturbed: noise, a loose 60-pin connector, or a clock that is too fast"


class NotReportedError(DeviceError):
    """An event that was waited for did not come; the link itself works."""


class StartedAnewError(DeviceError):
    """A board has reset itself, and nothing that it was told holds any more."""

    def __init__(self, name: str) -> None:
        super().__init__(
            f"{name}: it has started anew by itself: its supply failed for a moment, or somebody pressed reset",
            "a supply that sags when the RF core starts, a loose 5 V plug, or the reset line",
            "measure the radar board's 5 V while it starts; what was being done begins again with a reset",
        )


class WordLink(Protocol):
    """What carries 16-bit words to one board, its interrupt line back, and its reset and sense lines."""

    def write(self, words: Sequence[int]) -> None:
        """Shift words out, each with chip select of its own. Raises DeviceError when the link is gone."""
        ...

    def read(self, count: int) -> list[int]:
        """Shift words in. Raises DeviceError when the link is gone."""
        ...

    def interrupt(self) -> bool:
        """Whether the board's host interrupt is high. Raises DeviceError when the link is gone."""
        ...

    def reset(self, held: bool) -> None:
        """Hold the board in reset, or release it in functional mode (sense-on-power mode 4)."""
        ...

    def close(self) -> None:
        """Let go of it. Twice is once."""
        ...


class Clock(Protocol):
    """Time, as a link needs it."""

    def now(self) -> float:
        """Seconds."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait."""
        ...


class SystemClock:
    """The machine's monotonic time."""

    def now(self) -> float:
        """Seconds since some moment."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)


class Link:
    """One board's messages.

    Parameters
    ----------
    name
        The board, for errors.
    words
        What carries them.
    on_sent
        Told every message as it is written.

    Attributes
    ----------
    sequence
        Number of the next command, 0..15.
    may_start
        Whether the device's next power-up event is awaited; any other ends what is being done with StartedAnewError.
    warnings
        What went wrong and was mended, at most 100 lines.
    """

    def __init__(self, name: str, words: WordLink, clock: Clock, on_sent: Callable[[bytes], None]) -> None:
        self._name, self._words, self._clock, self._on_sent = name, words, clock, on_sent
        self.sequence = 0
        self._events: deque[Event] = deque()
        self.may_start = True
        self.warnings: list[str] = []

    def restart(self) -> None:
        """The device was reset: it counts from zero again, and what it had said is void."""
        self.sequence = 0
        self._events.clear()
        self.may_start = True

    def call(self, sent: Command, *, timeout_s: float = RESPONSE_S, remaining: int = 0) -> Message:
        """Send a command and return the device's answer, its chunks joined.

        Raises
        ------
        DeviceError
            when the device does not answer, or refuses the command; RF power-up is never sent twice.
        """
        problems: list[Problem] = []
        retry = False
        for _ in range(1 if sent is RF_POWER_UP else ATTEMPTS):
            asked = command((sent.block(),), sequence=self.sequence, retry=retry, remaining=remaining)
            self._write(encode(asked))
            answer, problem = self._answer(asked, timeout_s)
            if answer is None:
                problems.append(problem)
                retry = True
                continue
            self.sequence = (self.sequence + 1) % 16
            if answer.kind is Kind.NACK:
                problems.append(Problem("the device received it damaged", _DISTURBED))
                retry = False
                continue
            if problems:
                self._warn(
                    f"{type(sent).__name__} (0x{sent.ID:04X}) sent {len(problems) + 1} times: {problems[-1].what}"
                )
            if answer.error is not None:
                self._linger()
                raise DeviceError(
                    f"{self._name}: the radar refuses {sent}: {describe_refusal(*answer.error)}",
                    "the rig file asks for what this device cannot do, or it was in another state than thought",
                    "correct [chirp], [burst] or [radar]; docs/spec/mmwavelink.md",
                )
            return answer
        raise DeviceError(
            f"{self._name}: no valid answer to {sent} after {len(problems)} tries:"
            f" {'; '.join(dict.fromkeys(p.what for p in problems))}",
            "; ".join(dict.fromkeys(p.why for p in problems)),
            _DO,
        )

    def _linger(self) -> None:
        """A device that has just started anew refuses, too, and says why a moment later. Raises StartedAnewError."""
        until = self._clock.now() + _LINGER_S
        while self._clock.now() < until:
            self._look()
            self._clock.sleep(_LOOK_S)

    def poll(self) -> list[Event]:
        """Events since the last look; reads what waits, within limits. Raises DeviceError without a link."""
        self._look()
        events = list(self._events)
        self._events.clear()
        return events

    def wait_for(self, ids: Sequence[int], limit_s: float, on_event: Callable[[Event], None]) -> Event:
        """The first of these events; `on_event` is told each one on the way, this one too.

        Raises
        ------
        DeviceError
            when it does not come.
        """
        deadline = self._clock.now() + limit_s
        lost: Problem | None = None
        while True:
            lost = self._look() or lost
            events = list(self._events)
            self._events.clear()
            for event in events:
                on_event(event)
            for event in events:
                if event.id in ids:
                    return event
            if self._clock.now() > deadline:
                wanted = ", ".join(f"0x{i:04X}" for i in ids)
                raise NotReportedError(
                    f"{self._name}: the radar did not report {wanted} within {limit_s:g} s"
                    + (f"; a message was lost meanwhile: {lost.what}" if lost else ""),
                    lost.why if lost else f"it was reset, or: {_SILENT}",
                    _DO,
                )
            self._clock.sleep(_LOOK_S)

    def _look(self) -> Problem | None:
        """Read what waits in the device and keep its events; what could not be read."""
        deadline = self._clock.now() + POLL_S
        for _ in range(MESSAGES_A_POLL):
            if not self._words.interrupt():
                return None
            message, problem = self._receive()
            if message is None:
                self._warn(problem.what)
                return problem
            self._keep(message)
            if self._clock.now() > deadline:
                break
        self._warn("it sends one message after the other without a pause; the rest is read later")
        return None

    def _answer(self, asked: Message, timeout_s: float) -> tuple[Message | None, Problem]:
        """The response to the message just sent, or None and why; events on the way are kept."""
        deadline = self._clock.now() + timeout_s
        problem = Problem(f"no answer within {timeout_s:g} s", _SILENT)
        parts: list[Message] = []
        while self._clock.now() <= deadline:
            if not self._words.interrupt():
                self._clock.sleep(_LOOK_S)
                continue
            message, found = self._receive()
            if message is None:
                problem = found
            elif message.kind is Kind.EVENT:
                self._keep(message)
            elif not _answers(message, asked):
                self._warn(f"an answer to an earlier message came late (sequence {message.sequence})")
            elif parts and message.remaining_chunks != parts[-1].remaining_chunks - 1:
                return None, Problem("parts of the answer are missing", _DISTURBED)
            else:
                parts.append(message)
                if message.remaining_chunks == 0:
                    return _joined(parts), problem
        return None, Problem("parts of the answer are missing", _DISTURBED) if parts else problem

    def _receive(self) -> tuple[Message | None, Problem]:
        """One message, now that the interrupt is high; None and why when it cannot be read."""
        self._clock.sleep(SETTLE_S)
        self._write(READY_TO_READ)
        if not self._wait_low():
            self._write(READY_TO_READ)
            if not self._wait_low():
                return None, Problem("the host interrupt stays high", _NOT_CLOCKED)
        self._clock.sleep(DATA_S)
        head = self._read(SYNC_BYTES)
        searched = 0
        while head[-SYNC_BYTES:] != DEVICE_SYNC:
            if searched >= _SYNC_SEARCH_BYTES:
                same = len(set(head)) == 1
                return None, Problem(f"no sync word in {searched} bytes", _NOT_HEARD if same else _DISTURBED)
            head += self._read(2)
            searched += 2
        head = head[-SYNC_BYTES:] + self._read(HEADER_BYTES)
        try:
            header = decode_header(head)
        except ProtocolError as e:
            self._read(_FLUSH_BYTES)
            return None, Problem(e.what, _DISTURBED)
        body = self._read(header.body_bytes)
        try:
            return decode(head + body), Problem("", "")
        except ProtocolError as e:
            return None, Problem(e.what, _DISTURBED)

    def _wait_low(self) -> bool:
        deadline = self._clock.now() + _INTERRUPT_LOW_S
        while self._words.interrupt():
            if self._clock.now() > deadline:
                return False
            self._clock.sleep(SETTLE_S)
        return True

    def _keep(self, message: Message) -> None:
        """Keep events for whoever looks next. Raises StartedAnewError."""
        if message.kind is not Kind.EVENT:
            self._warn(f"an answer that nobody waits for (sequence {message.sequence})")
            return
        for event in map(decode_event, message.blocks):
            self._events.append(event)
            if event.id in STARTED_ANEW:
                if not self.may_start:
                    self._warn(str(event))
                    raise StartedAnewError(self._name)
                self.may_start = False

    def _write(self, raw: bytes) -> None:
        self._on_sent(raw)
        self._words.write(struct.unpack(f"<{len(raw) // 2}H", raw))

    def _read(self, size: int) -> bytes:
        words = self._words.read((size + 1) // 2)
        return struct.pack(f"<{len(words)}H", *words)[:size]

    def _warn(self, what: str) -> None:
        if len(self.warnings) < _MOST_WARNINGS:
            self.warnings.append(f"{self._name}: {what}")


def _answers(message: Message, asked: Message) -> bool:
    """Whether a response or NACK belongs to a command: its id, or the id 0 of a refusal (ICD 4.4), and its number.

    The one refusal without a body that is known has the number 0; whether such a device repeats a command's number is
    not. One with that number is taken as meant: it ends the command, and never lets anything pass.
    """
    if message.kind is Kind.NACK:
        return True
    back = {Direction.HOST_TO_RF: Direction.RF_TO_HOST}.get(asked.direction, Direction.MAIN_TO_HOST)
    of_device = message.direction in (Direction.RF_TO_HOST, Direction.MAIN_TO_HOST)
    if message.error == (None, None) and message.sequence == 0 and of_device:
        return True
    if message.kind is not Kind.RESPONSE or message.direction is not back:
        return False
    known = message.message_id == asked.message_id or message.error is not None
    return known and message.sequence == asked.sequence


def _joined(parts: Sequence[Message]) -> Message:
    """One answer from its chunks (ICD 2.3.2, REMCHUNKS): the sub-blocks of all."""
    return parts[0] if len(parts) == 1 else replace(parts[-1], blocks=tuple(b for p in parts for b in p.blocks))
