"""A short capture at rest: the cards record, the Pi sends a few bursts, and the frames are read back."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight.host.acquisition.capture_rig import CaptureRig
from polysight.host.acquisition.pi_client import PiClient
from polysight.host.capture.decode import row_words
from polysight.host.capture.receiver import RowCapture
from polysight.host.radar.backends import radar_control
from polysight.host.radar.interface import BoardState
from polysight.host.store.scan_folder import PART
from polysight.shared.config import Instrument
from polysight.shared.messages import Pulsed

_TAIL_S = 2.5  # a card sends its short last packet two seconds after the last data
_LOOK_S = 0.05


@dataclass(frozen=True)
class Captured:
    """One board's frames.

    Attributes
    ----------
    words
        int16 [frame, sample, 2, rx], I before Q.
    valid
        bool [frame]: received whole.
    row
        What the receiver counted.
    radar
        What the radar's backend says of it; None when nobody tells.
    """

    words: NDArray[np.int16]
    valid: NDArray[np.bool_]
    row: RowCapture
    radar: BoardState | None = None


def only(rig: Instrument, names: set[str]) -> Instrument:
    """The rig with only these boards recorded."""
    boards = tuple(msgspec.structs.replace(b, record=b.record and b.name in names) for b in rig.boards)
    return msgspec.structs.replace(rig, boards=boards)


def capture(rig: Instrument, pi: PiClient, bursts: int) -> tuple[dict[str, Captured], Pulsed]:
    """Record `bursts` bursts of every recorded board of the rig, at rest. Nothing moves, and nothing is kept.

    They are sent as one, so that no card takes the pause between two for the end of its record.

    Raises
    ------
    DeviceError, ScanError
        when a card, the disk or the Pi does not do its part; ConfigError when the radars cannot be reached as asked.
    """
    frames = bursts * rig.burst.pulses
    with (
        tempfile.TemporaryDirectory(prefix="polysight-doctor-") as folder,
        CaptureRig(rig) as cards,  # first: ports that a scan holds refuse before a radar is touched
        radar_control(rig) as radars,
    ):
        for board in rig.recorded:
            (Path(folder) / "raw" / board.name).mkdir(parents=True)
        cards.configure()
        radars.arm(frames)
        cards.begin_row(0, 1, bursts, Path(folder))
        radars.row_begins()
        sent = pi.pulse(frames, rig.burst.period_us, rig.burst.width_us)
        deadline = time.monotonic() + _TAIL_S + rig.limits.end_of_record_s
        while not cards.complete and time.monotonic() < deadline:
            cards.statuses()
            time.sleep(_LOOK_S)
        rows, states = cards.end_row(), radars.states()
        return {name: _read(rig, Path(folder), name, row, states.get(name), frames) for name, row in rows.items()}, sent


def _read(rig: Instrument, folder: Path, name: str, row: RowCapture, radar: BoardState | None, frames: int) -> Captured:
    payload = np.fromfile(folder / "raw" / name / f"0000{PART}", np.uint8)
    words, valid = row_words(payload, row.missing, frames, rig.chirp.samples, len(rig.antennas.rx_mm))
    return Captured(words, valid, row, radar)
