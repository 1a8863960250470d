"""Simulated radar boards under native control: the host itself programs them over USB, without TI's mmWave Studio.

The tests have virtual time, and exchange 16-bit words with a board without a USB bus between them.
"""

from collections.abc import Sequence

import msgspec

from polysight_shared.config import Instrument, NativeRadar, Radar
from polysight_simulators.radars import FUNCTIONAL_LEVELS, RadarBoard
from tests.support.rigs import MID_BAND_OFFSET_HZ, load_published_rig

FIRST_WORD_OF_COMMAND = 0x1234


class VirtualClock:
    """Virtual time in seconds. `sleep` advances it, and each call of `now` by a microsecond."""

    def __init__(self) -> None:
        self.time = 0.0

    def now(self) -> float:
        self.time += 1e-6
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += seconds


class BoardWords:
    """Link to a simulated board that transfers words without USB; a word takes 2 microseconds."""

    def __init__(self, board: RadarBoard, clock: VirtualClock) -> None:
        self.board = board
        self.clock = clock
        self.closed = False

    def write(self, words: Sequence[int]) -> None:
        for word in words:
            self.clock.sleep(2e-6)
            self.board.write_word(word)

    def read(self, count: int) -> list[int]:
        self.clock.sleep(2e-6 * count)
        return [self.board.read_word() for _ in range(count)]

    def interrupt(self) -> bool:
        return self.board.interrupt

    def reset(self, held: bool) -> None:
        self.board.set_sense_lines(FUNCTIONAL_LEVELS)
        self.board.reset(held)

    def close(self) -> None:
        self.closed = True


class Restarts(BoardWords):
    """Link to a board whose power fails for a moment after the command number `after` (counted from 1)."""

    def __init__(self, board: RadarBoard, clock: VirtualClock, after: int) -> None:
        super().__init__(board, clock)
        # Commands until the power fails, and commands after that.
        self.left = after
        self.later = 0

    def write(self, words: Sequence[int]) -> None:
        super().write(words)
        if words[0] == FIRST_WORD_OF_COMMAND:
            self.left -= 1
            if self.left < 0:
                self.later += 1
            elif self.left == 0:
                self.board.switch_power(False)
                self.board.switch_power(True)


def make_native_rig() -> Instrument:
    """Return the published rig under native control, with the direct path in the middle of each receiver's IF band."""
    rig = load_published_rig()
    boards = []
    for board in rig.boards:
        if board.role == "transmit":
            boards.append(board)
        else:
            boards.append(msgspec.structs.replace(board, start_offset_hz=MID_BAND_OFFSET_HZ))
    radars = {board.name: NativeRadar(usb_serial=f"FT{board.name}") for board in boards}
    return msgspec.structs.replace(rig, boards=tuple(boards), radar=Radar(control="native", native=radars))


def change_radar_table(rig: Instrument, **values: object) -> Instrument:
    """Return the rig with other values in the table [radar] of its file."""
    return msgspec.structs.replace(rig, radar=msgspec.structs.replace(rig.radar, **values))
