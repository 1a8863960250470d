"""The level at the ADC: not clipped, and not asleep."""

from __future__ import annotations

import numpy as np

from polysight.host.calibration.direct_signal import FULL_SCALE
from polysight.host.doctor.bench import Bench
from polysight.host.doctor.finding import Finding, error, not_checked, ok, warning
from polysight.shared.config import Board

CLIPPED = 0.01  # part of the chirps that may be clipped
WEAK = 4.0  # counts


def check_level(bench: Bench, board: Board) -> Finding:
    """Chirps with a sample at full scale are useless to synchronisation; a level of a few counts drowns in steps."""
    got = bench.captured.get(board.name)
    if got is None or not got.valid.any():
        return not_checked("no whole frame was captured")
    words = got.words[got.valid]
    high = (words >= FULL_SCALE) | (words <= -FULL_SCALE)
    clipped = int(high.any(axis=(1, 2, 3)).sum())
    rms = np.sqrt(np.mean(words.astype(np.float64) ** 2, axis=(0, 1, 2)) * 2)  # I and Q together, of each RX
    peak = int(np.abs(words.astype(np.int32)).max())
    told = f"rms {rms.min():.0f}..{rms.max():.0f} counts over the RX, peak {peak} of {FULL_SCALE}"
    facts = {"clipped_chirps": clipped, "chirps": len(words), "rms": [round(float(r), 1) for r in rms], "peak": peak}
    if clipped:
        told += f"; {clipped} of {len(words)} chirps are clipped"
        found = error if clipped > CLIPPED * len(words) else warning
        return found(
            told,
            "something reflects straight into the receiver, or its gain is too high",
            "lower the RX gain (radar.rx_gain_db, or the profile in mmWave Studio), or move the reflector away",
            **facts,
        )
    if rms.min() < WEAK:
        return error(
            told,
            "an RX is off, or the radar sends zeros",
            "check the RX mask of the profile; `polysight card reset --radar`, and arm it again",
            **facts,
        )
    return ok(told, **facts)
