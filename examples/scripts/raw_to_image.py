# %% [markdown]
# # From raw data to the image
#
# Takes a scan folder (here: `polysight simulate examples/point-targets.toml --out out/points`) and makes both images
# step by step, as `host/polysight/pipeline.py` does. Run it from the folder that holds `out/`.

# %%
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from polysight.capture.dca1000 import view_row_words
from polysight.imaging import ImageBuilder
from polysight.store.scan_folder import ScanFolder
from polysight.sync import BoardSetup, synchronise_row

# %%
scan = ScanFolder.load(Path("out/points"))
rig = scan.instrument
rx = len(rig.antennas.rx_mm)
builder = ImageBuilder(rig)
for board in rig.receivers:
    setup = BoardSetup.from_rig(rig, board)
    for row in scan.rows():
        raw = scan.read_row(board.name, row)
        frames, valid = view_row_words(raw.payload, raw.missing, raw.frames_expected, rig.chirp.samples, rx)
        builder.add_row(board.name, row, synchronise_row(frames, valid, setup))
images = builder.finish()

# %%
figure = Figure(layout="constrained")
axes = figure.subplots()
level_db = 20 * np.log10(np.abs(images.h_raw) / np.abs(images.h_raw).max())
mesh = axes.pcolormesh(1e3 * images.x_m, 1e3 * images.y_m, level_db, cmap="cividis", vmin=-30, vmax=0)
axes.set(xlabel="x (mm)", ylabel="y (mm)", title="H" + (", simulated" if scan.simulated else ""), aspect="equal")
figure.colorbar(mesh, label="dB")
figure.savefig("out/points-h.png")
