"""A rig under native control, virtual time, and simulated boards that are reached by words."""

from collections.abc import Sequence

import msgspec

from polysight_shared.config import Instrument, NativeRadar, Radar
from polysight_simulators.radars import FUNCTIONAL_LEVELS, RadarBoard
from tests.support.rigs import load_published_rig


class VirtualClock:
    """Virtual time, advanced by `sleep` and slightly by `now`."""

    def __init__(self) -> None:
        self.time = 0.0

    def now(self) -> float:
        self.time += 1e-6
        return self.time

    def sleep(self, seconds: float) -> None:
        self.time += seconds


class BoardWords:
    """The word link of a simulated board, without USB."""

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
    """Interrupt the board's supply for a moment after `after` commands of its host."""

    def __init__(self, board: RadarBoard, clock: VirtualClock, after: int) -> None:
        super().__init__(board, clock)
        # Commands until the restart, and commands after it.
        self.left = after
        self.later = 0

    def write(self, words: Sequence[int]) -> None:
        super().write(words)
        # A command begins with this word.
        if words[0] == 0x1234:
            self.left -= 1
            self.later += self.left < 0
            if self.left == 0:
                self.board.switch_power(False)
                self.board.switch_power(True)


def make_native_rig() -> Instrument:
    """Return the published rig under native control, with the direct path in the middle of each receiver's IF band."""
    rig = load_published_rig()
    boards = tuple(b if b.role == "transmit" else msgspec.structs.replace(b, start_offset_hz=790e3) for b in rig.boards)
    radar = Radar(control="native", native={b.name: NativeRadar(usb_serial=f"FT{b.name}") for b in boards})
    return msgspec.structs.replace(rig, boards=boards, radar=radar)


def change_radar_table(rig: Instrument, **values: object) -> Instrument:
    """Return the rig with other values in its table [radar]."""
    return msgspec.structs.replace(rig, radar=msgspec.structs.replace(rig.radar, **values))
