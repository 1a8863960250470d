"""Time the authors' own GPU imager: a program of its own, since their package has the name of ours.

`python benchmarks/authors_gpu.py CHECKOUT SETTINGS.json IMAGE.npy` prints the wall seconds of each round as JSON, the
first with compilation of kernels, and writes the last image, [ny, nx].
"""

import importlib
import json
import sys
import time
from pathlib import Path

import numpy as np

# The first compiles kernels; chosen so that a median of seven remains.
ROUNDS = 8


def main(checkout: str, settings_path: str, image_path: str) -> int:
    """Form a board's image from its synchronised cube on disk, as their notebook does; return 0."""
    sys.path.insert(0, checkout)
    sar_eval = importlib.import_module("polysight.dsp.sar").sar_eval
    settings = json.loads(Path(settings_path).read_text(encoding="utf-8"))
    seconds = []
    image = np.empty(0)
    for _ in range(ROUNDS):
        started_s = time.perf_counter()
        # "RH" is their name of the board that receives H. Images come back as a NumPy array [RX, ny, nx], so the time
        # includes the GPU's work and the copy; the mean over the RX is the board's image.
        image = sar_eval(settings, "RH", sum_bins=True).mean(axis=0)
        seconds.append(time.perf_counter() - started_s)
    np.save(image_path, image)
    print(json.dumps(seconds))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:4]))
