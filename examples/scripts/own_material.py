# %% [markdown]
# # Your own material
#
# What a material of known permittivity should look like, what the scan of it gave (run `own_scene.py` first), and a
# library that knows it: `polysight process NEXT --library out/own-library.npz` then names it in the next scan. A
# library needs two scans at least, because a classifier is judged by leaving whole scans out.

# %%
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from polysight.jobs.train import train
from polysight.materials import Library
from polysight.polarimetry import fresnel
from polysight.products import read_products
from polysight_shared.config import load_instrument
from polysight_shared.geometry import incidence_deg
from polysight_simulators.scene import load_scene, simulate

ROOT = Path(__file__).parents[2]

# %%
rig = load_instrument(ROOT / "instrument.toml")
r_s, r_p = fresnel(6.0 - 0.3j, np.radians(incidence_deg(rig, rig.receivers[0])))
expected = r_s / r_p
print(f"expected: |P| {abs(expected):.2f}, phase of P {np.degrees(np.angle(expected)):.1f} degrees")

# %%
for patch in read_products(Path("out/own-products")).segments:
    print(patch.true_name, patch.p_abs_db, patch.p_phase_deg, patch.permittivity_real, patch.permittivity_real_std)

# %%
scene = load_scene(ROOT / "examples" / "own-scene.toml")
again = simulate(rig, replace(scene, name="own scene again", seed=5), Path("out/own-scene-again"))
train(None, [Path("out/own-scene"), again], ROOT / "instrument.toml", Path("out/own-library.npz"))
print(Library.load(Path("out/own-library.npz")).names)
