"""A disturbed link: a command is executed once or not at all, and never as another one."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import example, given, settings
from hypothesis import strategies as st
from tests.support.radar.boards import BoardWords, VirtualClock, native_rig

from polysight.radar.board import RadarBoard, State
from polysight.radar.commands import LOW_POWER_OFF, Chirp, LdoBypass, program
from polysight.radar.link import Link
from polysight_shared.errors import DeviceError
from polysight_simulators.radars import Fault, make_image
from polysight_simulators.radars import RadarBoard as Simulated

RIG = native_rig()
LOST = st.sampled_from([Fault.NACK, Fault.BAD_CRC, Fault.BAD_CHECKSUM, Fault.LOST_INTERRUPT, Fault.NO_ANSWER])
HARMLESS = st.sampled_from([Fault.EVENT_BETWEEN, Fault.BAD_SYNC])
FRAMES = 8


class FlippingWords(BoardWords):
    """Flip one bit of one word, counted over both directions."""

    def __init__(self, board: Simulated, clock: VirtualClock, at: int, bit: int) -> None:
        super().__init__(board, clock)
        self.at = at
        self.bit = bit
        self.count = 0

    def _flip(self, word: int) -> int:
        self.count += 1
        return word ^ (1 << self.bit if self.count - 1 == self.at else 0)

    def write(self, words: Sequence[int]) -> None:
        super().write([self._flip(w) for w in words])

    def read(self, count: int) -> list[int]:
        return [self._flip(w) for w in super().read(count)]


def _faults_of_one_command() -> st.SearchStrategy[list[Fault]]:
    lost_words = st.lists(LOST, max_size=2)
    return st.one_of(lost_words, st.tuples(lost_words, HARMLESS).map(lambda t: [*t[0], t[1]]))


@settings(deadline=None)
@given(st.lists(_faults_of_one_command(), min_size=1, max_size=8))
def test_commands_are_executed_once_in_order_although_messages_are_lost(faults_of_each: list[list[Fault]]):
    """Twice only if the answer was lost and its retry was damaged, because a NACK requires a new sequence number."""
    clock = VirtualClock()
    board = Simulated(lambda: clock.time, flash=make_image())
    radar = RadarBoard("RH", BoardWords(board, clock), clock, program(RIG, RIG.by_name("RH")))
    radar.configure()
    board.executed.clear()
    link: Link = radar.link
    result = []
    for n, faults in enumerate(faults_of_each):
        sent = (LOW_POWER_OFF, LdoBypass(), Chirp(0))[n % 3]
        board.inject(*faults)
        link.call(sent)
        unheard = (Fault.NACK, Fault.NO_ANSWER)
        twice = len(faults) > 1 and faults[0] not in unheard and faults[1] is Fault.NACK
        result += [sent.ID] * (2 if twice else 1)
    assert board.executed == result


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 900), st.integers(0, 15))
@example(0, 0)
@example(7, 3)
def test_a_flipped_bit_never_changes_a_setting(at: int, bit: int):
    clock = VirtualClock()
    clean_board = Simulated(lambda: clock.time, flash=make_image())
    board = Simulated(lambda: clock.time, flash=make_image())
    clean = RadarBoard("LS", BoardWords(clean_board, clock), clock, program(RIG, RIG.by_name("LS")))
    clean.arm(FRAMES)
    radar = RadarBoard("LS", FlippingWords(board, clock, at, bit), clock, program(RIG, RIG.by_name("LS")))
    try:
        radar.arm(FRAMES)
    except DeviceError:
        assert radar.state is State.FAULT
        # Nothing flips any more
        radar.arm(FRAMES)
    assert radar.state is State.ARMED
    assert board.settings == clean_board.settings
