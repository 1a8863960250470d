"""Residuals of synchronisation on many simulated chirps of one scene that stands still: Fig. 15 of the POLySIGHT paper.

`python -m benchmarks.static_chirps --out DIR` simulates 640,000 chirps (40,000 positions of 16) of a metal plate, the
stage at rest, row by row in memory, and writes the report of `polysight sync-report`. Everything else is disturbed as
on the published rig, at the noise that the paper's figures imply: errors of 138 Hz and 0.022 rad in a chirp's frequency
and phase are the Cramer-Rao bounds of one tone of 192 samples, at the rig file's sample rate, at 7.2 dB.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from polysight.report.sync_report import SyncReport, write_sync_report
from polysight.sync import BoardSetup, synchronise_row
from polysight_shared.config import load_instrument
from polysight_simulators.scene import SimulatedRig, decode_scene

# Positions of a row of the published scans.
ROW_POSITIONS = 350
SNR_DB = 7.2
# The grid only has to be small: all chirps are taken at its middle, where the stage rests.
SCENE = {
    "name": "metal reflector at rest",
    "grid": {"columns": 9, "rows": 9, "step_x_mm": 2.0, "step_y_mm": 2.0},
    "plates": [{"name": "metal", "centre_mm": [0.0, 0.0], "size_mm": [45.0, 45.0], "metal": True}],
    "disturbances": {"direct_snr_db": SNR_DB, "burst_motion": False},
}


def run(out: Path, positions: int, board_name: str, snr_db: float = SNR_DB) -> str:
    """Simulate and synchronise the positions, write the report into `out`, and return its text."""
    rig = load_instrument(Path(__file__).parents[1] / "instrument.toml")
    scene = decode_scene(SCENE, "static_chirps").with_disturbances(direct_snr_db=snr_db)
    radar = SimulatedRig(rig, scene)
    board = radar.rig.by_name(board_name)
    chirp = radar.rig.chirp
    pulses = radar.rig.burst.pulses
    # Residuals of all positions, not of some of each row. The weights `beam` are one for each RX.
    setup = replace(BoardSetup.from_rig(radar.rig, board), examined=ROW_POSITIONS)
    report = SyncReport(chirp.sample_rate_hz, chirp.linear_samples, len(setup.path.beam))
    for row_start in range(0, positions, ROW_POSITIONS):
        chirp_count = min(ROW_POSITIONS, positions - row_start) * pulses
        x_mm = np.zeros(chirp_count)
        y_mm = np.zeros(chirp_count)
        # int16 [chirp, sample, (I, Q), rx].
        words = radar.chirps(board_name, x_mm, y_mm).reshape(chirp_count, chirp.samples, 2, -1)
        is_valid = np.ones(chirp_count, bool)
        report.add(synchronise_row(words, is_valid, setup))
    title = f"{positions * pulses:,} chirps at rest"
    return write_sync_report(out, {board_name: report}, title, simulated=True)


def main(argv: list[str]) -> int:
    """Write the report and print its text; return 0."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.static_chirps", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument("--positions", type=int, default=40_000, help="number of positions, of 16 chirps each")
    parser.add_argument("--board", default="RH", help="receiving board")
    parser.add_argument("--snr-db", type=float, default=SNR_DB, help="direct path over noise in one chirp")
    args = parser.parse_args(argv)
    sys.stdout.write(run(args.out, args.positions, args.board, args.snr_db))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
