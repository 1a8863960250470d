"""Residuals of synchronisation on many simulated chirps of one scene that stands still: the paper's Fig. 15.

`python -m benchmarks.static_chirps --out DIR` simulates 640,000 chirps (40,000 positions of 16) of a metal plate, the
stage at rest, row by row in memory, and writes the report of `polysight sync-report`. Everything else is disturbed as
on the published rig, at the noise that the paper's figures imply: 138 Hz and 0.022 rad are the Cramer-Rao bounds of one
tone of 192 samples at 7.2 dB.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from polysight.report.sync_report import SyncReport, write_sync_report
from polysight.sync import BoardSetup, synchronise_row
from polysight_shared.config import load_instrument
from polysight_simulators.scene import SimulatedRig, decode_scene

SNR_DB = 7.2
SCENE = {
    "name": "metal reflector at rest",
    "grid": {"columns": 9, "rows": 9, "step_x_mm": 2.0, "step_y_mm": 2.0},
    "plates": [{"name": "metal", "centre_mm": [0.0, 0.0], "size_mm": [45.0, 45.0], "metal": True}],
    "disturbances": {"direct_snr_db": SNR_DB, "burst_motion": False},
}


def run(out: Path, positions: int, board_name: str, snr_db: float = SNR_DB) -> str:
    """Simulate, synchronise and report; returns the text."""
    rig = load_instrument(Path(__file__).parents[1] / "instrument.toml")
    radar = SimulatedRig(rig, decode_scene(SCENE, "static_chirps").with_disturbances(direct_snr_db=snr_db))
    board = radar.rig.by_name(board_name)
    chirp = radar.rig.chirp
    row = 350
    setup = replace(BoardSetup.from_rig(radar.rig, board), examined=row)
    report = SyncReport(chirp.sample_rate_hz, chirp.linear_samples, len(setup.path.beam))
    for row_start in range(0, positions, row):
        still = np.zeros(min(row, positions - row_start) * radar.rig.burst.pulses)
        words = radar.chirps(board_name, still, still).reshape(len(still), chirp.samples, 2, -1)
        report.add(synchronise_row(words, np.ones(len(still), bool), setup))
    return write_sync_report(out, {board_name: report}, f"{positions * radar.rig.burst.pulses:,} chirps at rest", True)


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.static_chirps", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument("--positions", type=int, default=40_000, help="of 16 chirps each")
    parser.add_argument("--board", default="RH", help="receiving board")
    parser.add_argument("--snr-db", type=float, default=SNR_DB, help="direct path over noise, a channel of a chirp")
    args = parser.parse_args(argv)
    sys.stdout.write(run(args.out, args.positions, args.board, args.snr_db))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
