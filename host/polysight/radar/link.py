"""mmWaveLink over 16-bit words: send commands with timeouts and retries, receive answers and events.

Procedure: section 3 of the ICD, the document that `messages` names ("ICD 20": page 20; "ICD 4.4": a section). The host
sends commands; the device raises the *host interrupt* line when it has a message: an answer, or an event. After a
timeout the same message is sent again with the retry flag, so that the device answers without executing it twice; after
a NACK (the device could not read it) it is sent with a new sequence number. Every wait has a timeout, also with a
device that sends events without end. Not run on hardware yet.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

from polysight.radar import messages
from polysight.radar.commands import RF_POWER_UP, Command
from polysight.radar.usb import Clock, WordLink
from polysight_shared.errors import DeviceError, ErrorCode, ProtocolError
from polysight_shared.findings import Finding

# Timeout of one attempt, and the number of attempts (chosen).
RESPONSE_TIMEOUT_S = 1.0
ATTEMPTS = 3
# Time from the interrupt to the first word (ICD 20).
SETTLE_S = 30e-6
# Time from the falling interrupt to the first word read, as in TI's port of mmWaveLink to the USB chip.
DATA_DELAY_S = 1e-3
# Time between two polls (chosen).
_INTERVAL_S = 0.5e-3
# Time between two looks at the interrupt while the host waits for its fall (chosen).
_INTERRUPT_INTERVAL_S = 30e-6
# Time in which the interrupt falls after the host is ready to read (chosen).
_INTERRUPT_TIMEOUT_S = 0.1
# Time in which a power-up event arrives after a refusal (chosen).
_RESTART_EVENT_S = 0.1
# Messages that one poll reads, and its duration, at most (chosen): a device may send without end.
MAX_MESSAGES = 64
MAX_POLL_S = 0.25
# Warnings that are kept of a device (chosen); further ones are dropped.
_MAX_WARNINGS = 100
# Bytes in which the sync word is searched after the first four: the rest of a longest message, which has 256 bytes and
# may lie before it if its reading was interrupted.
_SYNC_SEARCH_BYTES = 252
# Bytes that are read after an invalid header, to resynchronise with the device (docs/spec/mmwavelink.md).
_FLUSH_BYTES = 244
_REMEDY = "check the board's power, the 60-pin connector and the USB cable, then `polysight resume SCAN`"


# Causes of a lost message, as errors name them.
_SILENT_CAUSE = "the board has no power, hangs, or its interrupt line is not connected"
_NO_CLOCK_CAUSE = "the board gets no SPI clock or chip select, or its interrupt line is stuck"
_NO_MISO_CAUSE = "the board's data line (MISO) is not connected, or SPI is disturbed"
_DISTURBED_CAUSE = "disturbed SPI lines: noise, a loose 60-pin connector, or a clock that is too fast"


class NotReportedError(DeviceError):
    """Timeout of an expected event; the link itself works."""


class UnexpectedRestartError(DeviceError):
    """A board has restarted by itself and lost its settings."""

    def __init__(self, name: str) -> None:
        super().__init__(
            f"{name}: it restarted without a command",
            "a supply that drops when the RF core starts, a loose 5 V plug, or its reset button or line",
            "measure the 5 V of the radar board while it starts; the operation is repeated after a reset",
            code=ErrorCode.RADAR_RESTARTED,
        )


class Link:
    """Message link to one board.

    Parameters
    ----------
    name
        Name of the board, for errors.
    words, clock
        Word link, and the clock of timeouts and pauses.
    on_sent
        Called with every message that is sent.

    Attributes
    ----------
    sequence
        Number of the next command, 0..15.
    may_start
        True if a power-up event is expected; an unexpected one raises UnexpectedRestartError.
    warnings
        Errors that did not end an operation, most of them corrected by a retry; at most 100.
    """

    def __init__(self, name: str, words: WordLink, clock: Clock, on_sent: Callable[[bytes], None]) -> None:
        self._name = name
        self._words = words
        self._clock = clock
        self._on_sent = on_sent
        self.sequence = 0
        self._events: deque[messages.Event] = deque()
        self.may_start = True
        self.warnings: list[str] = []

    def restart(self) -> None:
        """Start again after a reset of the device: sequence number zero, no pending events."""
        self.sequence = 0
        self._events.clear()
        self.may_start = True

    def call(self, command: Command, *, timeout_s: float = RESPONSE_TIMEOUT_S, remaining: int = 0) -> messages.Message:
        """Send a command, with retries, and return the device's answer; `remaining` chunks follow it.

        RF power-up is never sent twice (ICD 20).

        Raises DeviceError if the device does not answer or refuses the command.
        """
        problems: list[Finding] = []
        retry = False
        attempts = 1 if command is RF_POWER_UP else ATTEMPTS
        for _ in range(attempts):
            request = messages.command((command.block(),), sequence=self.sequence, retry=retry, remaining=remaining)
            self._write(messages.encode(request))
            answer, problem = self._await_answer(request, timeout_s)
            if answer is None:
                problems.append(problem)
                retry = True
                continue
            self.sequence = (self.sequence + 1) % 16
            if answer.kind is messages.Kind.NACK:
                problems.append(_make_problem("the device received a damaged message", _DISTURBED_CAUSE))
                retry = False
                continue
            if problems:
                self._warn(f"{command.name} (0x{command.ID:04X}) sent {len(problems) + 1} times: {problems[-1].what}")
            if answer.error is not None:
                self._detect_restart()
                raise DeviceError(
                    f"{self._name}: the radar refuses {command}: {messages.describe_refusal(*answer.error)}",
                    "the device does not support a setting, or it is in an unexpected state",
                    "correct [chirp], [burst] or [radar]; docs/spec/mmwavelink.md",
                    code=ErrorCode.REFUSED_BY_PEER,
                )
            return answer
        raise DeviceError(
            f"{self._name}: no valid answer to {command} after {len(problems)} attempts:"
            f" {'; '.join(dict.fromkeys(p.what for p in problems))}",
            "; ".join(dict.fromkeys(p.why for p in problems)),
            _REMEDY,
            code=ErrorCode.NO_ANSWER,
        )

    def _detect_restart(self) -> None:
        """Read messages after the refusal of a command: `_keep` raises UnexpectedRestartError for a power-up event."""
        deadline = self._clock.now() + _RESTART_EVENT_S
        while self._clock.now() < deadline:
            self._read_messages()
            self._clock.sleep(_INTERVAL_S)

    def poll(self) -> list[messages.Event]:
        """Read pending messages and return the new events. Raises DeviceError if the link is lost."""
        self._read_messages()
        events = list(self._events)
        self._events.clear()
        return events

    def wait_for(
        self, ids: Sequence[int], timeout_s: float, on_event: Callable[[messages.Event], None]
    ) -> messages.Event:
        """Wait for the first of these events and return it; call `on_event` with it and every other event that came.

        Raises NotReportedError after the timeout, DeviceError if the link is lost.
        """
        deadline = self._clock.now() + timeout_s
        lost_message: Finding | None = None
        while True:
            # Check the time before reading: a message that came while this program was paused still counts.
            is_over = self._clock.now() > deadline
            lost_message = self._read_messages() or lost_message
            events = list(self._events)
            self._events.clear()
            for event in events:
                on_event(event)
            for event in events:
                if event.id in ids:
                    return event
            if is_over:
                names = ", ".join(f"0x{i:04X}" for i in ids)
                problem = f"{self._name}: the radar did not report {names} within {timeout_s:g} s"
                cause = f"it was reset, or: {_SILENT_CAUSE}"
                if lost_message:
                    problem += f"; a message was lost meanwhile: {lost_message.what}"
                    cause = lost_message.why
                raise NotReportedError(problem, cause, _REMEDY, code=ErrorCode.NO_ANSWER)
            self._clock.sleep(_INTERVAL_S)

    def _read_messages(self) -> Finding | None:
        """Read pending messages, within limits, and keep their events; return the reason if one was lost, or None."""
        deadline = self._clock.now() + MAX_POLL_S
        for _ in range(MAX_MESSAGES):
            if not self._words.interrupt():
                return None
            message, problem = self._receive()
            if message is None:
                self._warn(problem.what)
                return problem
            self._keep(message)
            if self._clock.now() > deadline:
                break
        self._warn("it sends messages without a pause; the rest is read later")
        return None

    def _await_answer(self, request: messages.Message, timeout_s: float) -> tuple[messages.Message | None, Finding]:
        """Return the answer to the last message, or None and the reason; keep events that arrive before it."""
        deadline = self._clock.now() + timeout_s
        problem = _make_problem(f"no answer within {timeout_s:g} s", _SILENT_CAUSE)
        parts: list[messages.Message] = []
        is_over = False
        while not is_over:
            # Check the time before reading, as in `wait_for`.
            is_over = self._clock.now() > deadline
            if not self._words.interrupt():
                self._clock.sleep(_INTERVAL_S)
                continue
            message, reason = self._receive()
            if message is None:
                problem = reason
            elif message.kind is messages.Kind.EVENT:
                self._keep(message)
            elif not _is_answer(message, request):
                self._warn(f"late answer to an earlier message (sequence {message.sequence})")
            elif parts and message.remaining_chunks != parts[-1].remaining_chunks - 1:
                return None, _make_problem("parts of the answer are missing", _DISTURBED_CAUSE)
            else:
                parts.append(message)
                if message.remaining_chunks == 0:
                    return _join_chunks(parts), problem
        if parts:
            problem = _make_problem("parts of the answer are missing", _DISTURBED_CAUSE)
        return None, problem

    def _receive(self) -> tuple[messages.Message | None, Finding]:
        """Read one message while the interrupt is high; return None and the reason if it cannot be read."""
        self._clock.sleep(SETTLE_S)
        self._write(messages.READY_TO_READ)
        if not self._wait_for_low():
            self._write(messages.READY_TO_READ)
            if not self._wait_for_low():
                return None, _make_problem("the host interrupt stays high", _NO_CLOCK_CAUSE)
        self._clock.sleep(DATA_DELAY_S)
        head = self._read(messages.SYNC_BYTES)
        searched = 0
        while head[-messages.SYNC_BYTES :] != messages.DEVICE_SYNC:
            if searched >= _SYNC_SEARCH_BYTES:
                # A line that nothing drives gives the same byte again and again.
                is_constant = len(set(head)) == 1
                cause = _NO_MISO_CAUSE if is_constant else _DISTURBED_CAUSE
                return None, _make_problem(f"no sync word in {searched} bytes", cause)
            head += self._read(2)
            searched += 2
        head = head[-messages.SYNC_BYTES :] + self._read(messages.HEADER_BYTES)
        try:
            header = messages.decode_header(head)
        except ProtocolError as e:
            self._read(_FLUSH_BYTES)
            return None, _make_problem(e.what, _DISTURBED_CAUSE)
        body = self._read(header.body_bytes)
        try:
            return messages.decode(head + body), _make_problem("", "")
        except ProtocolError as e:
            return None, _make_problem(e.what, _DISTURBED_CAUSE)

    def _wait_for_low(self) -> bool:
        """Wait until the interrupt line is low; return False after the timeout."""
        deadline = self._clock.now() + _INTERRUPT_TIMEOUT_S
        while self._words.interrupt():
            if self._clock.now() > deadline:
                return False
            self._clock.sleep(_INTERRUPT_INTERVAL_S)
        return True

    def _keep(self, message: messages.Message) -> None:
        """Keep the events of a message for the next poll. Raises UnexpectedRestartError."""
        if message.kind is not messages.Kind.EVENT:
            self._warn(f"unexpected answer (sequence {message.sequence})")
            return
        for event in map(messages.decode_event, message.blocks):
            self._events.append(event)
            if event.id in messages.START_EVENTS:
                if not self.may_start:
                    self._warn(str(event))
                    raise UnexpectedRestartError(self._name)
                self.may_start = False

    def _write(self, raw: bytes) -> None:
        """Send bytes, as 16-bit words with the first byte low; their number is even."""
        self._on_sent(raw)
        self._words.write(struct.unpack(f"<{len(raw) // 2}H", raw))

    def _read(self, size: int) -> bytes:
        """Read `size` bytes; the second half of a last word is dropped."""
        words = self._words.read((size + 1) // 2)
        return struct.pack(f"<{len(words)}H", *words)[:size]

    def _warn(self, what: str) -> None:
        """Add a warning; after `_MAX_WARNINGS` of them drop it."""
        if len(self.warnings) < _MAX_WARNINGS:
            self.warnings.append(f"{self._name}: {what}")


def _make_problem(what: str, why: str) -> Finding:
    """Return the reason why a message was lost or unreadable: problem and likely cause."""
    return Finding("warning", what, why)


def _is_answer(message: messages.Message, request: messages.Message) -> bool:
    """Return True if a response or NACK belongs to a command, by its message id and sequence number.

    A refusal has message id 0 (ICD 4.4), and usually the sequence number of the command. The only refusal without a
    body that is known had the number 0, and it is not known whether its command had it, too. So a refusal without a
    body and with the number 0 is taken as the answer to whatever command is waiting.
    """
    if message.kind is messages.Kind.NACK:
        return True
    reply_direction = messages.Direction.MAIN_TO_HOST
    if request.direction is messages.Direction.HOST_TO_RF:
        reply_direction = messages.Direction.RF_TO_HOST
    is_from_device = message.direction in (messages.Direction.RF_TO_HOST, messages.Direction.MAIN_TO_HOST)
    # A refusal without a body.
    if message.error == (None, None) and message.sequence == 0 and is_from_device:
        return True
    if message.kind is not messages.Kind.RESPONSE or message.direction is not reply_direction:
        return False
    same_command = message.message_id == request.message_id or message.error is not None
    return same_command and message.sequence == request.sequence


def _join_chunks(parts: Sequence[messages.Message]) -> messages.Message:
    """Join the chunks of an answer (ICD 2.3.2, REMCHUNKS)."""
    return replace(parts[-1], blocks=tuple(block for part in parts for block in part.blocks))
