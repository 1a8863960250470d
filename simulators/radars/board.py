"""A simulated AWR2243 board as its SPI lines show it: words in and out, host interrupt, reset and sense lines, pulses.

It speaks mmWaveLink of its own (nothing is shared with the host's codec), as TI's interface control document says and
as real devices were seen to: it answers with a 16-bit CRC, refuses with message id 0, reports a main core fault at
power-up and then works, comes with an empty flash, and has its data 1 ms after the interrupt. Time is a clock that is
passed in. What goes wrong is asked for with :meth:`RadarBoard.inject`. A stand-in: how a real device times things is
not known here.
"""

from __future__ import annotations

import struct
import zlib
from collections import deque
from collections.abc import Callable
from enum import Enum

from polysight.shared.errors import DeviceError
from polysight.simulators.radars.cores import ERASE_S, FRAME_END, RF_FAULT, Cores
from polysight.simulators.radars.wire import EVENT, NACK, READY, RESPONSE, TO_DEVICE, frame, ones_sum

FUNCTIONAL = 4  # sense-on-power mode
ANSWER_S, DATA_S = 1e-4, 1e-3


class Fault(Enum):
    """What goes wrong, once, with the next answer; `EVENT_BETWEEN` sends an event before it."""

    NACK = "says that the command came damaged"
    REFUSE = "refuses the command"
    REFUSE_BARE = "refuses the command without a body"
    BAD_CRC = "one bit of the answer's body flips"
    BAD_CHECKSUM = "one bit of the answer's header flips"
    BAD_SYNC = "words before the answer"
    LOST_INTERRUPT = "the interrupt does not come"
    NO_ANSWER = "hears nothing"
    EVENT_BETWEEN = "an event comes first"


class RadarBoard:
    """One board.

    Parameters
    ----------
    now
        Seconds.
    flash
        What is in the serial flash; empty on the first day. `make_image()` is an image that it boots from.
    dead_s
        From a frame's pulse to the next one it bears; the frame period when None.
    fault_pulses
        Pulses since the start, from 0, at which the RF core faults.
    die
        Tells boards apart: part of the die id.
    supply_v
        Of the RF supplies; LDO bypass at 1.3 V destroys the board.
    erase_s
        How long the flash takes to be erased.
    fault_at
        When the main core reports its harmless fault: "power-up", "download" or "never".
    functional_jumpers
        SOP0 set, SOP1 and SOP2 open. Without them the sense lines do not reach functional mode.
    first_generation
        Boots and refuses as an AWR1243 was seen to.
    answers_32_bit
        Answers with a CRC of 32 bits. Reports have one where the host asked for it.

    Attributes
    ----------
    cores
        What the device knows: settings, flash, what it obeyed.
    """

    def __init__(
        self,
        now: Callable[[], float],
        *,
        flash: bytes = b"",
        dead_s: float | None = None,
        fault_pulses: tuple[int, ...] = (),
        die: int = 1,
        supply_v: float = 1.3,
        erase_s: float = ERASE_S,
        fault_at: str = "power-up",
        functional_jumpers: bool = True,
        first_generation: bool = False,
        answers_32_bit: bool = False,
    ) -> None:
        self.now, self._dead_s, self._fault_pulses = now, dead_s, fault_pulses
        self.functional_jumpers, self._answers_32_bit = functional_jumpers, answers_32_bit
        self.cores = Cores(
            now, self._event, flash, die=die, supply_v=supply_v, erase_s=erase_s, fault_at=fault_at,
            first_generation=first_generation,
        )  # fmt: skip
        self.plugged = True
        self.powered = True
        self._faults: deque[Fault] = deque()
        self._pulses_seen = 0
        self._held, self._mode = True, 0
        self._forget()

    @property
    def executed(self) -> list[int]:
        """Numbers of the sub-blocks obeyed, in order."""
        return self.cores.executed

    @property
    def settings(self) -> dict[int, bytes]:
        """Data of the last sub-block of each number."""
        return self.cores.settings

    @property
    def armings(self) -> int:
        """How often frames were started."""
        return self.cores.armings

    @property
    def destroyed(self) -> bool:
        """Whether its supplies have destroyed it."""
        return self.cores.destroyed

    def _forget(self) -> None:
        self._in, self._out = bytearray(), bytearray()
        self._waiting: deque[bytes] = deque()  # messages that the host has not asked for yet
        self._later: list[tuple[float, bytes]] = []
        self._offered, self._ready_at = False, 0.0
        self._last: tuple[int, bytes] = (-1, b"")
        self._pulse_s, self._busy_until = float("-inf"), -1.0
        self.cores.forget()

    def inject(self, *faults: Fault) -> None:
        """Let these happen to the next answers, one each, instead of what is left of earlier ones."""
        self._faults = deque(faults)

    # lines

    def power(self, on: bool) -> None:
        """Switch the board's supply; its USB chip has one of its own. What is in the flash stays, finished or not."""
        self._forget()
        self.powered = on
        if on and not self._held:
            self._boot()

    def sense(self, mode: int) -> None:
        """Set the sense-on-power lines, read when the reset is released."""
        self._mode = mode

    def reset(self, held: bool) -> None:
        """Drive the reset line."""
        if held:
            self._forget()
        elif self._held:
            self._boot()
        self._held = held

    def _boot(self) -> None:
        if self._mode == FUNCTIONAL and self.functional_jumpers and self.powered and not self.destroyed:
            self.cores.boot()

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
        return self.cores.armed and self.cores.frames_left != 0

    def trigger(self, pulse_s: float | None = None) -> bool:
        """A rising edge on SYNC_IN, now or at a time of the pulses' own clock; whether it starts a frame.

        One that comes too soon is a fault, and the board hears no pulse any more. A time that jumps back by more than
        that is another clock.
        """
        self._pulses_seen += 1
        if not self.ready_for_triggers:
            return False
        cores, at = self.cores, self.now() if pulse_s is None else pulse_s
        period = cores.period_s()
        too_soon = abs(at - self._pulse_s) < (period if self._dead_s is None else self._dead_s) - 1e-9
        if too_soon or self._pulses_seen - 1 in self._fault_pulses:
            cores.armed = False
            self._event(RF_FAULT, struct.pack("<BBH", 3, 1, 4711) + bytes(28), 0.0)
            return False
        self._pulse_s, cores.frame_ends = at, self.now() + period
        cores.frames_left -= 1
        if cores.frames_left == 0:
            cores.armed = False
            self._event(FRAME_END, b"", period)
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
                self._out, self._ready_at = bytearray(self._waiting.popleft()), self.now() + DATA_S
        elif self._in[:4] == TO_DEVICE and len(self._in) >= 16:
            length = int.from_bytes(self._in[6:8], "little")
            if ones_sum(bytes(self._in[4:16])) != 0xFFFF:
                self._in.clear()  # no response at all; the host times out
            elif len(self._in) >= 4 + length:
                raw = bytes(self._in[4 : 4 + length])
                del self._in[: 4 + length]
                self._message(raw)

    def read_word(self) -> int:
        """A word to the host; all ones when there is none, or it is not ready. Raises DeviceError when unplugged."""
        self._check()
        self._due()
        if not self._out or self.now() < self._ready_at - 1e-9:
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
        wide = self.cores.crc32_events if main else not self.cores.first_generation
        block = struct.pack("<HH", number, len(data) + 4) + data
        self._send(frame(6 if main else 2, EVENT, number // 32, block, 1, 0, wide), delay_s)

    def _message(self, raw: bytes) -> None:
        opcode, length, flags, remaining, count = struct.unpack_from("<5H", raw)
        fault = self._faults.popleft() if self._faults else None
        if fault is Fault.NO_ANSWER or self.destroyed or not self.powered or self.now() < self._busy_until:
            return
        direction, number, sequence, wide = (opcode & 15) + 1, opcode >> 6, flags >> 12, self._answers_32_bit
        if fault is Fault.NACK or zlib.crc32(raw[: length - 4]) != int.from_bytes(raw[length - 4 :], "little"):
            self._send(frame(direction, NACK, number, b"", 0, sequence, wide), 0.0)
            return
        if flags & 3 == 3 and self._last[0] == sequence and self._last[1]:
            self._send(self._last[1], 0.0)  # the answer was lost: it is given again, nothing is done twice
            return
        delay, error = ANSWER_S, 0
        body, blocks, block = raw[12 : length - 4], b"", 0
        for _ in range(count):
            block, size = struct.unpack_from("<HH", body)
            refused = fault in (Fault.REFUSE, Fault.REFUSE_BARE)
            error, data, extra = (6, b"", 0.0) if refused else self.cores.obey(block, body[4:size], remaining)
            if error:
                break
            delay += extra
            blocks += struct.pack("<HH", block, len(data) + 4) + data if data else b""
            body = body[size:]
        self._busy_until = self.now() + delay
        if error and (self.cores.first_generation or fault is Fault.REFUSE_BARE):
            answer = frame(direction, RESPONSE, 0, b"", 1, sequence, wide)  # as an AWR1243 was seen to
        elif error:
            answer = frame(direction, RESPONSE, 0, struct.pack("<4H", 0, 8, error, block), 1, sequence, wide)  # ICD 4.4
        else:
            answer = frame(direction, RESPONSE, number, blocks, 1 if blocks else 0, sequence, wide)
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
