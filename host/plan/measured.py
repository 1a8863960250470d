"""Noise and standstill between rows, from a scan that was made."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from polysight.host.capture.decode import row_words
from polysight.host.plan.forecast import Noise
from polysight.host.plan.timing import row_motion_s, tail_s, turn_s
from polysight.host.report.sync_report import SyncReport
from polysight.host.store.events import read_events
from polysight.host.store.scan_folder import EVENTS, ScanFolder
from polysight.host.store.sources.source import ScanSource
from polysight.host.sync import BoardSetup, synchronise_row
from polysight.shared.errors import DataError
from polysight.shared.messages import Capture

_ROWS = 5  # that the noise is taken from


def noise_of(source: ScanSource) -> Noise:
    """Direct path over noise of a scan's weaker receiver, from a few of its rows.

    Raises
    ------
    DataError
        when no row tells: bursts of one chirp, or nothing recorded.
    """
    rig = source.instrument
    rows = list(source.rows())
    chosen = [rows[i] for i in sorted({*np.linspace(0, len(rows) - 1, _ROWS).astype(int)})] if rows else []
    found = []
    for board in rig.receivers:
        setup = BoardSetup.of(rig, board)
        report = SyncReport(rig.chirp.sample_rate_hz, rig.chirp.linear_samples, len(rig.antennas.rx_mm))
        for row in chosen:
            data = source.read_row(board.name, row)
            words, valid = row_words(data.payload, data.missing, data.frames_expected, rig.chirp.samples)
            report.add(synchronise_row(words, valid, setup))
        found.append(report.snr)
    if not np.isfinite(found).all():
        raise DataError(
            f"scan {source.scan_id}: its noise cannot be told",
            "it has no rows, or bursts of a single chirp",
            "give another scan to --like, or the ratio itself to --snr-db",
        )
    kind = "simulated scan" if source.simulated else "scan"
    return Noise(float(10 * np.log10(min(found))), f"measured on {kind} {source.scan_id}")


def row_overhead_of(folder: Path) -> float | None:
    """Standstill between rows, seconds: median time from a row's last trigger to the next one's first, less motion.

    On the clock of the triggers. None where the Pi's events do not tell: fewer than two rows in a sequence, or data
    that was made without a Pi.
    """
    scan = ScanFolder.load(folder)
    if not scan.facts("scan_started")[0].get("pi"):
        return None
    rig, ends = scan.instrument, {}
    for event in read_events(folder / EVENTS).events:
        if isinstance(event, Capture):
            first, _ = ends.setdefault((event.row_index, event.take), (event.edge_ns, event.edge_ns))
            ends[event.row_index, event.take] = (first, event.edge_ns)
    measuring = (rig.grid.columns - 1) * rig.grid.step_x_mm / rig.stage.speed_mm_s
    known = row_motion_s(rig.grid, rig.stage) - measuring + turn_s(rig.grid, rig.stage) + tail_s(rig)
    gaps = [
        (later[0] - earlier[1]) / 1e9
        for (row, earlier), (next_row, later) in pairwise((row, t) for (row, _), t in ends.items())
        if next_row == row + 1
    ]
    return max(0.0, float(np.median(gaps)) - known) if gaps else None
