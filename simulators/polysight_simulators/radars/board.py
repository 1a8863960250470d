"""A simulated AWR2243 board at its SPI lines: words, host interrupt, reset and sense lines, SYNC_IN pulses.

It has its own mmWaveLink codec, after TI's interface control document (ICD) and the observed behaviour of devices:
answers with a 16-bit CRC, refusals with message id 0, a harmless main core fault at power-up, an empty flash at first,
data 1 ms after the interrupt. The clock is a parameter; `RadarBoard.inject` sets faults. Real timing is not known.
"""

import struct
import zlib
from collections import deque
from collections.abc import Callable
from enum import Enum

from polysight_shared.errors import DeviceError, ErrorCode
from polysight_simulators.radars.cores import (
    ERASE_S,
    EVENT,
    FRAME_END,
    HOST_READY,
    NACK,
    RESPONSE,
    RF_FAULT,
    TO_DEVICE,
    Cores,
    compute_ones_sum,
    encode_message,
)

# Levels of the three sense-on-power lines for functional mode. The bits are in the order in which the USB chip's pins
# drive them (`control.py`): only the highest is set.
FUNCTIONAL_LEVELS = 4
# Delays of an answer, and of its data after the interrupt. Chosen: real timing is not known.
ANSWER_S = 1e-4
DATA_S = 1e-3


class Fault(Enum):
    """Fault of the next answer; `EVENT_BETWEEN` sends an event before it."""

    NACK = "reports a damaged command"
    REFUSE = "refuses the command"
    REFUSE_BARE = "refuses the command without a body"
    BAD_CRC = "one bit of the CRC behind the answer flips"
    BAD_CHECKSUM = "one bit of the checksum in the answer's header flips"
    BAD_SYNC = "words before the answer"
    LOST_INTERRUPT = "the interrupt does not come"
    NO_ANSWER = "does not answer"
    EVENT_BETWEEN = "an event comes first"


class RadarBoard:
    """One simulated board: its lines, its words and its executed commands (`cores`).

    Parameters
    ----------
    now
        Clock, seconds.
    flash
        Content of the serial flash; empty in a new board. An image that it boots from is made by `cores.make_image`.
    dead_s
        Minimum time from a frame's pulse to the next; default: the frame period.
    fault_pulses
        Numbers, from 0, of the pulses at which the RF core faults; all pulses since the board was made are counted.
    die_number
        Part of the die id, which identifies the board.
    supply_v
        Voltage of the RF supplies; LDO bypass at 1.3 V destroys the board.
    erase_s
        Duration of erasing the flash.
    fault_at
        Time of the main core's harmless fault: "power-up", "download" or "never".
    functional_jumpers
        SOP0 set, SOP1 and SOP2 open, which functional mode requires.
    first_generation
        Boots and refuses like an AWR1243.
    answers_32_bit
        Answers with a CRC of 32 bits; the main core's events have one if the host requested it.

    Attributes
    ----------
    cores
        Settings, flash and executed commands.
    """

    def __init__(
        self,
        now: Callable[[], float],
        *,
        flash: bytes = b"",
        dead_s: float | None = None,
        fault_pulses: tuple[int, ...] = (),
        die_number: int = 1,
        supply_v: float = 1.3,
        erase_s: float = ERASE_S,
        fault_at: str = "power-up",
        functional_jumpers: bool = True,
        first_generation: bool = False,
        answers_32_bit: bool = False,
    ) -> None:
        self.now = now
        self._dead_s = dead_s
        self._fault_pulses = fault_pulses
        self.functional_jumpers = functional_jumpers
        self._answers_32_bit = answers_32_bit
        self.cores = Cores(
            now, self._send_event, flash, die_number=die_number, supply_v=supply_v, erase_s=erase_s, fault_at=fault_at,
            first_generation=first_generation,
        )  # fmt: skip
        self.plugged = True
        self.powered = True
        self._faults: deque[Fault] = deque()
        self._pulses_seen = 0
        # Level of the reset line (True: in reset), and levels of the sense-on-power lines as the bits of a number
        self._is_in_reset = True
        self._sense_lines = 0
        self._forget()

    @property
    def executed(self) -> list[int]:
        """Numbers of the executed sub-blocks, in order."""
        return self.cores.executed

    @property
    def settings(self) -> dict[int, bytes]:
        """Data of the last sub-block of each number."""
        return self.cores.settings

    @property
    def armings(self) -> int:
        """Number of frame starts."""
        return self.cores.armings

    @property
    def destroyed(self) -> bool:
        """True if LDO bypass has destroyed it."""
        return self.cores.destroyed

    def _forget(self) -> None:
        """Reset: drop messages, the last pulse's time and the state of the cores; the flash stays."""
        self._in = bytearray()
        self._out = bytearray()
        # Messages not read by the host yet
        self._waiting: deque[bytes] = deque()
        # Messages that are sent later, with their times
        self._later: list[tuple[float, bytes]] = []
        # True while the host interrupt is raised for a message
        self._interrupt_raised = False
        # Time from which the words of `_out` can be read
        self._readable_from = 0.0
        # Sequence number of the last command, and its answer, for a retry
        self._last_answer: tuple[int, bytes] = (-1, b"")
        # Time of the pulse that started the last frame
        self._pulse_s = float("-inf")
        # Commands that come before this time are ignored
        self._busy_until = -1.0
        self.cores.reset()

    def inject(self, *faults: Fault) -> None:
        """Set the faults of the next answers, one each; earlier ones are discarded."""
        self._faults = deque(faults)

    # --- lines: supply, reset, sense-on-power, host interrupt, SYNC_IN ------------------------------------------------

    def switch_power(self, on: bool) -> None:
        """Switch the board's supply, not that of its USB chip; the flash keeps its content."""
        self._forget()
        self.powered = on
        if on and not self._is_in_reset:
            self._boot()

    def set_sense_lines(self, mode: int) -> None:
        """Set the sense-on-power lines, which are read at the release of the reset."""
        self._sense_lines = mode

    def reset(self, held: bool) -> None:
        """Drive the reset line."""
        if held:
            self._forget()
        elif self._is_in_reset:
            self._boot()
        self._is_in_reset = held

    def _boot(self) -> None:
        """Boot if supply, jumpers and sense lines allow it."""
        if self._sense_lines == FUNCTIONAL_LEVELS and self.functional_jumpers and self.powered and not self.destroyed:
            self.cores.boot()

    @property
    def interrupt(self) -> bool:
        """Level of the host interrupt line. Raises DeviceError if unplugged."""
        self._check_plugged()
        self._deliver()
        return self._interrupt_raised

    @property
    def ready_for_triggers(self) -> bool:
        """True if a pulse would start a frame now."""
        self._deliver()
        # Negative: frames without end.
        return self.cores.armed and self.cores.frames_left != 0

    def trigger(self, pulse_s: float | None = None) -> bool:
        """Receive a rising edge on SYNC_IN, now or at a time of the pulses' clock; return True if it starts a frame.

        An edge that follows the edge of the last frame by less than `dead_s` causes a fault, after which pulses are
        ignored. So does one that is earlier by less than that; a time still earlier is taken for one of another clock.
        """
        self._pulses_seen += 1
        if not self.ready_for_triggers:
            return False
        cores = self.cores
        if pulse_s is None:
            time_s = self.now()
        else:
            time_s = pulse_s
        period = cores.period_s()
        # 1 ns for the rounding of times.
        shortest_s = period if self._dead_s is None else self._dead_s
        too_soon = abs(time_s - self._pulse_s) < shortest_s - 1e-9
        if too_soon or self._pulses_seen - 1 in self._fault_pulses:
            cores.armed = False
            # Type (firmware error), code (not triggered by a pulse), line of the firmware (made up), reserved bytes.
            self._send_event(RF_FAULT, struct.pack("<BBH", 3, 1, 4711) + bytes(28), delay_s=0.0)
            return False
        self._pulse_s = time_s
        cores.frame_ends = self.now() + period
        cores.frames_left -= 1
        if cores.frames_left == 0:
            cores.armed = False
            self._send_event(FRAME_END, b"", period)
        return True

    def send_event(self, number: int, data: bytes = b"") -> None:
        """Send an event now."""
        self._send_event(number, data, delay_s=0.0)

    # --- words --------------------------------------------------------------------------------------------------------
    # A message is a sync word (4 bytes), a header (12: opcode, length without the sync word, flags, remaining
    # messages, number of sub-blocks, checksum), sub-blocks (number, length with these 4 bytes, data) and a CRC.

    def write_word(self, word: int) -> None:
        """Receive a word from the host. Raises DeviceError if unplugged."""
        self._check_plugged()
        self._deliver()
        self._in += word.to_bytes(2, "little")
        while len(self._in) >= 4 and self._in[:4] not in (TO_DEVICE, HOST_READY):
            del self._in[:2]
        # HOST_READY: the host asks for the message that the interrupt announced.
        if self._in[:4] == HOST_READY and len(self._in) >= 16:
            del self._in[:16]
            self._interrupt_raised = False
            if self._waiting:
                self._out = bytearray(self._waiting.popleft())
                self._readable_from = self.now() + DATA_S
        elif self._in[:4] == TO_DEVICE and len(self._in) >= 16:
            length = int.from_bytes(self._in[6:8], "little")
            if compute_ones_sum(bytes(self._in[4:16])) != 0xFFFF:
                # There is no response: the host has a timeout.
                self._in.clear()
            elif len(self._in) >= 4 + length:
                raw = bytes(self._in[4 : 4 + length])
                del self._in[: 4 + length]
                self._execute_message(raw)

    def read_word(self) -> int:
        """Send a word to the host; all ones if there is none yet. Raises DeviceError if unplugged."""
        self._check_plugged()
        self._deliver()
        if not self._out or self.now() < self._readable_from - 1e-9:
            return 0xFFFF
        word = int.from_bytes(self._out[:2], "little")
        del self._out[:2]
        return word

    # --- messages -----------------------------------------------------------------------------------------------------

    def _check_plugged(self) -> None:
        """Raise DeviceError if the USB cable is unplugged."""
        if not self.plugged:
            raise DeviceError(
                "the simulated radar is unplugged", "a test unplugged it", "plug it in", code=ErrorCode.NO_ANSWER
            )

    def _deliver(self) -> None:
        """Make messages readable that are due now, and raise the host interrupt for the first."""
        for due_s, raw in sorted(self._later, key=lambda p: p[0]):
            if due_s <= self.now():
                self._later.remove((due_s, raw))
                self._waiting.append(raw)
        if self._waiting and not self._out:
            self._interrupt_raised = True

    def _send(self, raw: bytes, delay_s: float) -> None:
        self._later.append((self.now() + delay_s, raw))

    def _send_event(self, number: int, data: bytes, delay_s: float) -> None:
        """Send an event after a delay; numbers from 0x4000 on are the main core's, others the RF core's."""
        is_from_main_core = number >= 0x4000
        # Wide: with a CRC of 32 bits.
        if is_from_main_core:
            wide = self.cores.crc32_events
        else:
            wide = not self.cores.first_generation
        block = struct.pack("<HH", number, len(data) + 4) + data
        # Directions (ICD table 2.2): 6 from the main core to the host, 2 from the RF core. A sub-block's number is that
        # of its message times 32, and its own.
        self._send(
            encode_message(
                direction=6 if is_from_main_core else 2,
                kind=EVENT,
                number=number // 32,
                body=block,
                count=1,
                sequence=0,
                wide=wide,
            ),
            delay_s,
        )

    def _execute_message(self, raw: bytes) -> None:
        """Execute a message of the host (`raw`, without the sync word) and send the answer, with the next fault."""
        opcode, length, flags, remaining, count = struct.unpack_from("<5H", raw)
        fault = None
        if self._faults:
            fault = self._faults.popleft()
        if fault is Fault.NO_ANSWER or self.destroyed or not self.powered or self.now() < self._busy_until:
            return
        # The direction of the answer is the command's plus 1; the message's number lies above direction and kind. The
        # flags have the sequence number in bits 12 to 15, and in a retry 3 in the lowest two.
        direction = (opcode & 15) + 1
        number = opcode >> 6
        sequence = flags >> 12
        wide = self._answers_32_bit
        if fault is Fault.NACK or zlib.crc32(raw[: length - 4]) != int.from_bytes(raw[length - 4 :], "little"):
            refusal = encode_message(
                direction=direction, kind=NACK, number=number, body=b"", count=0, sequence=sequence, wide=wide
            )
            self._send(refusal, delay_s=0.0)
            return
        is_retry = flags & 3 == 3
        if is_retry and self._last_answer[0] == sequence and self._last_answer[1]:
            # Repeat the answer, without executing the command again
            self._send(self._last_answer[1], delay_s=0.0)
            return
        delay_s = ANSWER_S
        error = 0
        body = raw[12 : length - 4]
        blocks = b""
        block = 0
        for _ in range(count):
            block, size = struct.unpack_from("<HH", body)
            refused = fault in (Fault.REFUSE, Fault.REFUSE_BARE)
            if refused:
                # "Error while processing the command".
                error = 6
                data = b""
                extra_s = 0.0
            else:
                error, data, extra_s = self.cores.execute(block, body[4:size], remaining)
            if error:
                break
            delay_s += extra_s
            if data:
                blocks += struct.pack("<HH", block, len(data) + 4) + data
            body = body[size:]
        self._busy_until = self.now() + delay_s
        # A message of the host asks for one sub-block at most (docs/spec/mmwavelink.md, "Answers").
        sub_blocks = int(bool(blocks))
        if error:
            number = 0
            sub_blocks = 1
            # ICD 4.4: the sub-block of a refusal names the error and the command.
            blocks = struct.pack("<4H", 0, 8, error, block)
        if error and (self.cores.first_generation or fault is Fault.REFUSE_BARE):
            # An AWR1243 announces this sub-block, but does not send it.
            blocks = b""
        answer = encode_message(
            direction=direction,
            kind=RESPONSE,
            number=number,
            body=blocks,
            count=sub_blocks,
            sequence=sequence,
            wide=wide,
        )
        self._last_answer = (sequence, answer)
        self._answer(answer, fault, delay_s)

    def _answer(self, answer: bytes, fault: Fault | None, delay_s: float) -> None:
        """Send an answer after a delay, damaged by the fault."""
        if fault is Fault.EVENT_BETWEEN:
            # The report of a run-time calibration: harmless.
            self._send_event(0x1012, bytes(20), delay_s=0.0)
        elif fault is Fault.BAD_CRC:
            answer = answer[:-1] + bytes((answer[-1] ^ 1,))
        elif fault is Fault.BAD_CHECKSUM:
            answer = answer[:14] + bytes((answer[14] ^ 1,)) + answer[15:]
        elif fault is Fault.BAD_SYNC:
            answer = b"\xff\xff\x00\x00" + answer
        if fault is not Fault.LOST_INTERRUPT:
            self._send(answer, delay_s)
