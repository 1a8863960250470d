"""`polysight radar check`: run and print one board's bring-up step by step. Not run on hardware yet."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from polysight.radar.board import RadarBoard
from polysight.radar.bring_up import Step
from polysight.radar.spi import WordLink
from polysight_shared.errors import PolysightError

JUMPERS = """\
    SOP2      SOP1      SOP0          of the AWR2243BOOST, for control over SPI
   [ o o ]   [ o o ]   [ o=o ]        o=o  jumper set      o o  open
    open      open      set           (mmWave Studio needs SOP1 set too: remove it here)"""


class Row(NamedTuple):
    """Result of one step: success (`holds`), expected and actual outcome (`came`), remedy after a failure (`do`)."""

    step: str
    holds: bool
    expected: str
    came: str
    do: str = ""


def check_board(
    open_words: Callable[[], WordLink],
    make_board: Callable[[WordLink], RadarBoard],
    transmits: bool,
    on_row: Callable[[Row], None],
) -> RadarBoard | None:
    """Bring up a board from USB to one frame; stop at the first step that fails.

    Parameters
    ----------
    open_words, make_board
        Open the board's USB chip, and create the board with it.
    transmits
        True if the board transmits.
    on_row
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
        on_row(Row("USB", False, opening, error.what, f"{error.why}; {error.remedy}"))
        return None
    on_row(Row("USB", True, opening, "opened"))
    board = make_board(words)
    done: list[Step] = []

    def on_step(step: Step, found: str) -> None:
        done.append(step)
        on_row(Row(step.name, True, step.expected, found))
        if step.name == "reset":
            on_row(_power(board))

    try:
        board.configure(on_step)
    except PolysightError as error:
        on_row(_failed(board.steps[len(done)] if len(done) < len(board.steps) else None, error))
        return board
    _frame_and_read_back(board, transmits, on_row)
    return board


def _frame_and_read_back(board: RadarBoard, transmits: bool, on_row: Callable[[Row], None]) -> None:
    expected = "frame end, 1 frame" + (" (this board transmits)" if transmits else "")
    try:
        on_row(Row("one frame", True, expected, board.run_one_frame()))
    except PolysightError as error:
        on_row(Row("one frame", False, expected, error.what, f"{error.why}; {error.remedy}"))
        return
    expected = "profile, chirp and frame as sent"
    try:
        found = board.read_back()
        remedy = (
            "compare the fields with docs/spec/mmwavelink.md; a reserved field that differs is harmless"
            if found
            else ""
        )
        on_row(Row("read back", not found, expected, "; ".join(found) or "as sent", remedy))
    except PolysightError as error:
        on_row(Row("read back", False, expected, error.what, f"{error.why}; {error.remedy}"))


def _failed(step: Step | None, error: PolysightError) -> Row:
    name, expected, remedy = (step.name, step.expected, step.remedy) if step else ("bring-up", "", "")
    picture = f"\n{JUMPERS}" if name == "reset" else ""
    return Row(name, False, expected, error.what, f"{error.why}; {error.remedy or remedy}{picture}")


def _power(board: RadarBoard) -> Row:
    """Judge the supplies by the main core's power-up and the report of its voltage monitor."""
    boot = board.facts.get("boot")
    errors = boot.get("boot_errors", 0) if isinstance(boot, dict) else 0
    monitor = bool(isinstance(errors, int) and errors >> 57 & 1)
    found = "the main core runs; " + ("its voltage monitor reports an error" if monitor else "no error reported")
    remedy = "measure the RF supplies (1.3 V or 1.0 V), 1.8 V and 3.3 V" if monitor else ""
    return Row("power rails", not monitor, "the core runs, no error of the voltage monitor", found, remedy)
