"""Signal sources: what a radar puts on its LVDS lanes for each frame, and a counting pattern for bit-exact tests."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from polysight.shared.config import Instrument


class SignalSource(Protocol):
    """Where the frames come from."""

    def chirps(
        self, board_name: str, x_mm: NDArray[np.float64], y_mm: NDArray[np.float64], first_pulse: int | None = None
    ) -> NDArray[np.int16]:
        """Frames of one chirp each, int16 [n, samples, 8], for stage offsets x_mm [n], y_mm [n].

        `first_pulse` numbers the first one's SYNC_IN pulse since power-up. The eight values of a sample are I of
        RX1..RX4, then Q of RX1..RX4.
        """
        ...


def pattern_frames(board: int, first: int, n: int, samples: int) -> NDArray[np.int16]:
    """Frames `first` .. `first + n - 1` of the pattern, int16 [n, samples, 8].

    Every 32-bit word is `board << 28 | word count since the first frame`, little-endian: any byte that is lost, doubled
    or misplaced shows, in 1 GiB per board.
    """
    words = samples * 4
    count = np.arange(n * words, dtype="<u4")
    count += np.uint32(first * words % (1 << 28))  # may wrap at 32 bits, which 28 bits do not notice
    count &= np.uint32((1 << 28) - 1)
    count |= np.uint32(board << 28)
    return count.view("<i2").reshape(n, samples, 8)


class PatternSource:
    """Sends :func:`pattern_frames`, wherever the stage is: frame k comes from SYNC_IN pulse k."""

    def __init__(self, rig: Instrument) -> None:
        self._samples = rig.chirp.samples
        self._board = {b.name: i for i, b in enumerate(rig.boards)}
        self._next = dict.fromkeys(self._board, 0)

    def chirps(
        self, board_name: str, x_mm: NDArray[np.float64], y_mm: NDArray[np.float64], first_pulse: int | None = None
    ) -> NDArray[np.int16]:
        """The frames of len(x_mm) pulses from `first_pulse` on; None goes on from this board's last call."""
        del y_mm
        first = self._next[board_name] if first_pulse is None else first_pulse
        self._next[board_name] = first + len(x_mm)
        return pattern_frames(self._board[board_name], first, len(x_mm), self._samples)
