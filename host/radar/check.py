"""`polysight radar check`: one board's bring-up step by step in plain words. Not run on hardware yet."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from polysight.host.radar.board import RadarBoard
from polysight.host.radar.bring_up import Step
from polysight.host.radar.spi import WordLink
from polysight.shared.errors import PolysightError

JUMPERS = """\
    SOP2      SOP1      SOP0          of the AWR2243BOOST, for control over SPI
   [ o o ]   [ o o ]   [ o=o ]        o=o  jumper set      o o  open
    open      open      set           (mmWave Studio wants SOP1 set too: a board from there does not start here)"""


class Row(NamedTuple):
    """One line of the check: what was done, what should have come, what came, and what to do when it did not."""

    step: str
    holds: bool
    expected: str
    came: str
    do: str = ""


def check_board(
    open_words: Callable[[], WordLink],
    make: Callable[[WordLink], RadarBoard],
    transmits: bool,
    tell: Callable[[Row], None],
) -> RadarBoard | None:
    """Walk a board's way from USB to one frame, telling each step; it ends at the first that fails.

    Parameters
    ----------
    open_words, make
        Open the board's USB chip, and make the board behind it.
    transmits
        Whether its one frame radiates.
    tell
        Told each step.

    Returns
    -------
    RadarBoard or None
        The board, whatever state it is in, for its report; None when its chip could not be opened.
    """
    opening = "four channels of the FT4232H on the capture card"
    try:
        words = open_words()
    except PolysightError as error:
        tell(Row("USB", False, opening, error.what, f"{error.why}; {error.remedy}"))
        return None
    tell(Row("USB", True, opening, "opened"))
    board = make(words)
    done: list[Step] = []

    def on_step(step: Step, came: str) -> None:
        done.append(step)
        tell(Row(step.name, True, step.expected, came))
        if step.name == "reset":
            tell(_power(board))

    try:
        board.configure(on_step)
    except PolysightError as error:
        tell(_failed(board.steps[len(done)] if len(done) < len(board.steps) else None, error))
        return board
    _frame_and_read_back(board, transmits, tell)
    return board


def _frame_and_read_back(board: RadarBoard, transmits: bool, tell: Callable[[Row], None]) -> None:
    expected = "frame end, 1 frame" + (" (this board transmits)" if transmits else "")
    try:
        tell(Row("one frame", True, expected, board.run_one_frame()))
    except PolysightError as error:
        tell(Row("one frame", False, expected, error.what, f"{error.why}; {error.remedy}"))
        return
    expected = "profile, chirp and frame as they were sent"
    try:
        found = board.read_back()
        do = (
            "compare the fields with docs/spec/mmwavelink.md; a reserved field that differs is harmless"
            if found
            else ""
        )
        tell(Row("read back", not found, expected, "; ".join(found) or "the same", do))
    except PolysightError as error:
        tell(Row("read back", False, expected, error.what, f"{error.why}; {error.remedy}"))


def _failed(step: Step | None, error: PolysightError) -> Row:
    name, expected, do = (step.name, step.expected, step.do) if step else ("bring-up", "", "")
    picture = f"\n{JUMPERS}" if name == "reset" else ""
    return Row(name, False, expected, error.what, f"{error.why}; {error.remedy or do}{picture}")


def _power(board: RadarBoard) -> Row:
    """What the board tells of its supplies: that its main core runs, and its own voltage monitor."""
    boot = board.facts.get("boot")
    errors = boot.get("boot_errors", 0) if isinstance(boot, dict) else 0
    monitor = bool(isinstance(errors, int) and errors >> 57 & 1)
    came = "the main core runs; " + ("its voltage monitor reports an error" if monitor else "nothing reported")
    do = "measure the RF supplies (1.3 V or 1.0 V), 1.8 V and 3.3 V; they are not measured otherwise" if monitor else ""
    return Row("power rails", not monitor, "core supplies good, no report of the voltage monitor", came, do)
