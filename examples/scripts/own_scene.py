# %% [markdown]
# # Your own scene
#
# Describes what lies on the plane (`examples/own-scene.toml`: copy and change it), simulates a scan of it with every
# disturbance of a real rig, and processes it to a report that shows the truth.

# %%
from pathlib import Path

from polysight.materials import read_truth
from polysight.pipeline import Pipeline
from polysight.store.scan_folder import ScanFolder
from polysight_shared.config import load_instrument
from polysight_simulators.scene import load_scene, simulate

ROOT = Path(__file__).parents[2]

# %%
rig = load_instrument(ROOT / "instrument.toml")
scene = load_scene(ROOT / "examples" / "own-scene.toml")
folder = simulate(rig, scene, Path("out/own-scene"))

# %%
pipeline = Pipeline(ScanFolder.load(folder))
for row in pipeline.source.rows():
    pipeline.add_row(row)
products = pipeline.finish(Path("out/own-products"), read_truth(folder / "truth.json"))
print(products.summary())
