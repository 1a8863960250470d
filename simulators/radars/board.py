"""A simulated AWR2243 board as its SPI lines show it: words in and out, host interrupt, reset and sense lines, pulses.

It speaks mmWaveLink of its own (nothing is shared with the host's codec) as TI's interface control document says, and
keeps time by a clock that is passed in. What goes wrong is asked for with :meth:`RadarBoard.inject`. A stand-in: how a
real device times things is not known here.
"""

from __future__ import annotations

import binascii
import struct
import zlib
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

from polysight.shared.errors import DeviceError

TO_DEVICE, READY, FROM_DEVICE = bytes.fromhex("34122143"), bytes.fromhex("78566587"), bytes.fromhex("badccdab")
FUNCTIONAL = 4  # sense-on-power mode
RESPONSE, NACK, EVENT = 1, 2, 3
BOOT_S, RF_UP_S, RF_INIT_S, ERASE_S, READY_S, ANSWER_S = 0.05, 0.02, 0.3, 4.0, 1e-3, 1e-4
_UP_MAIN, _UP_RF, _CALIBRATED, _TRIGGER_READY, _FRAME_END, _CPU_FAULT = 0x5000, 0x5001, 0x1004, 0x100B, 0x100F, 0x1002
_SIZES = {  # data bytes of each sub-block
    0x0080: 8, 0x0082: 8, 0x0083: 4, 0x0085: 4, 0x0086: 12, 0x008D: 16, 0x00C0: 0, 0x0100: 44, 0x0101: 20, 0x0102: 24,
    0x0140: 4, 0x0220: 0, 0x02CC: 4, 0x02EA: 0, 0x4000: 0, 0x4041: 12, 0x4042: 8, 0x4043: 4, 0x4044: 4, 0x4045: 4,
    0x404C: 12, 0x40C0: 8, 0x40E0: 0,
}  # fmt: skip
_BEFORE_FRAMES = (0x0080, 0x0082, 0x0086, 0x00C0, 0x0100, 0x0101, 0x4041, 0x4042, 0x4043, 0x4044, 0x4045, 0x40C0)


class Fault(Enum):
    """What goes wrong, once, with the next answer; `EVENT_BETWEEN` sends an event before it."""

    NACK = "says that the command came damaged"
    REFUSE = "refuses the command"
    BAD_CRC = "one bit of the answer's body flips"
    BAD_CHECKSUM = "one bit of the answer's header flips"
    BAD_SYNC = "words before the answer"
    LOST_INTERRUPT = "the interrupt does not come"
    NO_ANSWER = "hears nothing"
    EVENT_BETWEEN = "an event comes first"


@dataclass
class RadarBoard:
    """One board.

    Attributes
    ----------
    now
        Seconds.
    patch
        Whether firmware is in the board's flash.
    supply_v
        Of the RF supplies; LDO bypass at 1.3 V destroys the board.
    dead_s
        From a frame's pulse to the next one it bears; the frame period when None.
    fault_pulses
        Pulses since the start, from 0, at which the RF core faults.
    executed
        Numbers of the sub-blocks obeyed, in order.
    settings
        Data of the last sub-block of each number.
    """

    now: Callable[[], float]
    patch: bool = True
    supply_v: float = 1.3
    erase_s: float = ERASE_S
    dead_s: float | None = None
    fault_pulses: tuple[int, ...] = ()
    executed: list[int] = field(default_factory=list)
    settings: dict[int, bytes] = field(default_factory=dict)
    destroyed: bool = False
    plugged: bool = True
    armings: int = 0

    def __post_init__(self) -> None:
        self._faults: deque[Fault] = deque()
        self._pulses_seen = 0
        self._held, self._mode = True, 0
        self._forget()

    def _forget(self) -> None:
        self._in, self._out = bytearray(), bytearray()
        self._waiting: deque[bytes] = deque()  # messages that the host has not asked for yet
        self._later: list[tuple[float, bytes]] = []
        self._offered = False
        self._last: tuple[int, bytes] = (-1, b"")
        self._main_up = self._rf_up = self._calibrated = False
        self._crc32_events = False
        self._frames_left, self._armed, self._frame_ends, self._pulse_s = 0, False, -1.0, float("-inf")
        self._file_left, self._busy_until = 0, -1.0
        self.settings.clear()

    def inject(self, *faults: Fault) -> None:
        """Let these happen to the next answers, one each, instead of what is left of earlier ones."""
        self._faults = deque(faults)

    # lines

    def sense(self, mode: int) -> None:
        """Set the sense-on-power lines, read when the reset is released."""
        self._mode = mode

    def reset(self, held: bool) -> None:
        """Drive the reset line."""
        if held:
            self._forget()
        elif self._held and self._mode == FUNCTIONAL and not self.destroyed:
            self._main_up = True
            self._event(_UP_MAIN, struct.pack("<IQQ", 1000, 0, 0), BOOT_S)
        self._held = held

    @property
    def interrupt(self) -> bool:
        """The host interrupt line. Raises DeviceError when unplugged."""
        self._check()
        self._due()
        return self._offered

    @property
    def ready_for_triggers(self) -> bool:
        """Whether a pulse starts a frame now."""
        self._due()
        return self._armed and self._frames_left != 0

    def trigger(self, pulse_s: float | None = None) -> bool:
        """A rising edge on SYNC_IN, now or at a time of the pulses' own clock; whether it starts a frame.

        One that comes too soon is a fault, and the board hears no pulse any more. A time that jumps back by more than
        that is another clock.
        """
        self._pulses_seen += 1
        if not self.ready_for_triggers:
            return False
        at = self.now() if pulse_s is None else pulse_s
        period = struct.unpack_from("<I", self.settings[0x0102], 12)[0] * 5e-9
        too_soon = abs(at - self._pulse_s) < (period if self.dead_s is None else self.dead_s) - 1e-9
        if too_soon or self._pulses_seen - 1 in self.fault_pulses:
            self._armed = False
            self._event(_CPU_FAULT, struct.pack("<BBH", 3, 1, 4711) + bytes(28), 0.0)
            return False
        self._pulse_s, self._frame_ends = at, self.now() + period
        self._frames_left -= 1
        if self._frames_left == 0:
            self._armed = False
            self._event(_FRAME_END, b"", period)
        return True

    def say(self, number: int, data: bytes = b"") -> None:
        """Send an event now."""
        self._event(number, data, 0.0)

    # words

    def write_word(self, word: int) -> None:
        """A word from the host, chip select toggled. Raises DeviceError when unplugged."""
        self._check()
        self._due()
        self._in += word.to_bytes(2, "little")
        while len(self._in) >= 4 and self._in[:4] not in (TO_DEVICE, READY):
            del self._in[:2]
        if self._in[:4] == READY and len(self._in) >= 16:
            del self._in[:16]
            self._offered = False
            if self._waiting:
                self._out = bytearray(self._waiting.popleft())
        elif self._in[:4] == TO_DEVICE and len(self._in) >= 16:
            length = int.from_bytes(self._in[6:8], "little")
            if _sum(bytes(self._in[4:16])) != 0xFFFF:
                self._in.clear()  # no response at all; the host times out
            elif len(self._in) >= 4 + length:
                raw = bytes(self._in[4 : 4 + length])
                del self._in[: 4 + length]
                self._message(raw)

    def read_word(self) -> int:
        """A word to the host; all ones when there is none. Raises DeviceError when unplugged."""
        self._check()
        self._due()
        if not self._out:
            return 0xFFFF
        word = int.from_bytes(self._out[:2], "little")
        del self._out[:2]
        return word

    # inside

    def _check(self) -> None:
        if not self.plugged:
            raise DeviceError("the simulated radar is unplugged", "it was asked to be", "plug it in")

    def _due(self) -> None:
        for at, raw in sorted(self._later, key=lambda p: p[0]):
            if at <= self.now():
                self._later.remove((at, raw))
                self._waiting.append(raw)
        if self._waiting and not self._out:
            self._offered = True

    def _send(self, raw: bytes, delay_s: float) -> None:
        self._later.append((self.now() + delay_s, raw))

    def _event(self, number: int, data: bytes, delay_s: float) -> None:
        main = number >= 0x4000
        wide = self._crc32_events if main else True
        block = struct.pack("<HH", number, len(data) + 4) + data
        self._send(_frame(6 if main else 2, EVENT, number // 32, block, 1, 0, wide), delay_s)

    def _message(self, raw: bytes) -> None:
        opcode, length, flags, remaining, count = struct.unpack_from("<5H", raw)
        fault = self._faults.popleft() if self._faults else None
        if fault is Fault.NO_ANSWER or self.destroyed or self.now() < self._busy_until:
            return
        direction, number, sequence = (opcode & 15) + 1, opcode >> 6, flags >> 12
        if fault is Fault.NACK or zlib.crc32(raw[: length - 4]) != int.from_bytes(raw[length - 4 :], "little"):
            self._send(_frame(direction, NACK, number, b"", 0, sequence, True), 0.0)
            return
        if flags & 3 == 3 and self._last[0] == sequence and self._last[1]:
            self._send(self._last[1], 0.0)  # the answer was lost: it is given again, nothing is done twice
            return
        delay = ANSWER_S
        body, blocks = raw[12 : length - 4], b""
        for _ in range(count):
            block, size = struct.unpack_from("<HH", body)
            error, data, extra = (6, b"", 0.0) if fault is Fault.REFUSE else self._obey(block, body[4:size], remaining)
            if error:
                blocks = struct.pack("<4H", 0, 8, error, block)
                break
            delay += extra
            blocks += struct.pack("<HH", block, len(data) + 4) + data if data else b""
            body = body[size:]
        self._busy_until = self.now() + delay
        answer = _frame(direction, RESPONSE, number, blocks, 1 if blocks else 0, sequence, True)
        self._last = (sequence, answer)
        self._answer(answer, fault, delay)

    def _answer(self, answer: bytes, fault: Fault | None, delay_s: float) -> None:
        if fault is Fault.EVENT_BETWEEN:
            self._event(0x1012, bytes(20), 0.0)
        elif fault is Fault.BAD_CRC:
            answer = answer[:-1] + bytes((answer[-1] ^ 1,))
        elif fault is Fault.BAD_CHECKSUM:
            answer = answer[:14] + bytes((answer[14] ^ 1,)) + answer[15:]
        elif fault is Fault.BAD_SYNC:
            answer = b"\xff\xff\x00\x00" + answer
        if fault is not Fault.LOST_INTERRUPT:
            self._send(answer, delay_s)

    def _obey(self, number: int, data: bytes, remaining: int) -> tuple[int, bytes, float]:
        """Error number (0: none), data of the answer, and how much longer it takes."""
        if number == 0x4080:
            return self._file(data, remaining)
        if number not in _SIZES:
            return 3, b"", 0.0
        if len(data) != _SIZES[number]:
            return 4, b"", 0.0
        if not self._main_up or (number < 0x4000 and not self._rf_up):
            return 6, b"", 0.0
        if number == 0x0140:
            error = self._start_or_stop(struct.unpack_from("<H", data)[0])
        elif number == 0x0102 and self._armed:
            error = 83
        else:
            error = 0
        if error:
            return error, b"", 0.0
        self.executed.append(number)
        self.settings[number] = data
        return 0, self._effect(number, data), 0.0

    def _effect(self, number: int, data: bytes) -> bytes:
        if number == 0x404C:
            self._crc32_events = data[0] == 1
        elif number == 0x4000:
            self._rf_up = True
            self._event(_UP_RF, struct.pack("<4I", 0x07FFFFFF, 2000, 0, 0), RF_UP_S)
        elif number == 0x00C0:
            self._calibrated = True
            self._event(_CALIBRATED, struct.pack("<IIhHII", 0x1FFE, 0x1FFE, 41, 0, 500, 0), RF_INIT_S)
        elif number == 0x02CC and data[0] & 1 and self.supply_v > 1.1:
            self.destroyed = True
        elif number in (0x0220, 0x40E0):
            patch = (2, 1, 22, 6, 3, 0x11) if self.patch else (0,) * 6
            return bytes((1, 2, 0, 2, 2, 3, 1, 19, 8, 1, *patch))
        elif number == 0x02EA:
            return struct.pack("<I10h", int(self.now() * 1e3) & 0xFFFFFFFF, 41, 41, 42, 42, 45, 46, 45, 40, 43, 0)
        return b""

    def _start_or_stop(self, what: int) -> int:
        if what == 1:
            if self._armed:
                return 20
            if not self._calibrated or any(n not in self.settings for n in _BEFORE_FRAMES):
                return 22
            frames = struct.unpack_from("<H", self.settings[0x0102], 8)[0]
            self._frames_left, self._armed, self._frame_ends = frames or -1, True, -1.0
            self.armings += 1
            self._event(_TRIGGER_READY, b"", READY_S)
            return 0
        if what not in (0, 4):
            return 23
        if not self._armed:
            return 21
        if what == 4 and self.now() < self._frame_ends:
            self._event(_CPU_FAULT, struct.pack("<BBH", 3, 2, 815) + bytes(28), 0.0)
        self._armed = False
        self._event(_FRAME_END, b"", READY_S)
        return 0

    def _file(self, data: bytes, remaining: int) -> tuple[int, bytes, float]:
        if not self._main_up:
            return 6, b"", 0.0
        first = self._file_left == 0
        if first:
            kind, self._file_left = struct.unpack_from("<II", data)
            data = data[8:]
            if kind not in (0, 4):
                return 8, b"", 0.0
        self._file_left -= len(data)
        if (self._file_left == 0) != (remaining == 0):
            return 7, b"", 0.0
        if self._file_left == 0:
            self.patch = True
        self.executed.append(0x4080)
        return 0, b"", self.erase_s if first else 0.0


def _sum(head: bytes) -> int:
    """Ones-complement sum of 16-bit words; 0xFFFF over a header with its checksum."""
    total = sum(struct.unpack(f"<{len(head) // 2}H", head))
    while total > 0xFFFF:
        total = (total & 0xFFFF) + (total >> 16)
    return total


def _frame(direction: int, kind: int, number: int, body: bytes, count: int, sequence: int, wide: bool) -> bytes:
    """A message's bytes, sync word first, with a CRC of 32 or 16 bits."""
    flags = sequence << 12 | (1 if wide else 0) << 10
    head = struct.pack("<5H", direction | kind << 4 | number << 6, 12 + len(body) + (4 if wide else 2), flags, 0, count)
    head += struct.pack("<H", 0xFFFF - _sum(head))
    crc = zlib.crc32(head + body).to_bytes(4, "little")
    if not wide:
        crc = binascii.crc_hqx(head + body, 0xFFFF).to_bytes(2, "little")
    return FROM_DEVICE + head + body + crc
