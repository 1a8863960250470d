"""The processing of a live scan beside the capture: `python -m benchmarks.processing RIG ROW_FILE`.

Decodes and synchronises the first published row (350 points of 16 chirps) of a recorded file, again and again, for the
receiving boards in turn, and answers every line on its standard input with the rows done so far and its CPU seconds.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from pathlib import Path

import numpy as np

from polysight.capture.decode import decode_row
from polysight.sync.chain import BoardSetup, synchronise_row
from polysight_shared.config import load_instrument


def main(argv: list[str]) -> int:
    """Process until the standard input ends."""
    rig, path = load_instrument(Path(argv[1])), Path(argv[2])
    setups = [BoardSetup.of(rig, board) for board in rig.receivers]
    size = np.fromfile(path, dtype=np.uint8, count=350 * rig.burst.pulses * rig.frame_bytes).size
    frames = size // rig.frame_bytes // rig.burst.pulses * rig.burst.pulses
    done, ended = 0, threading.Event()

    def answer() -> None:
        for _ in sys.stdin:
            sys.stdout.write(json.dumps({"rows": done, "cpu_s": time.process_time(), "frames": frames}) + "\n")
            sys.stdout.flush()
        ended.set()

    threading.Thread(target=answer, daemon=True).start()
    while not ended.is_set():
        payload = np.fromfile(path, dtype=np.uint8, count=frames * rig.frame_bytes)
        synchronise_row(*decode_row(payload, (), frames, rig.chirp.samples), setups[done % len(setups)])
        done += 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv))
