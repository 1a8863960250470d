"""Draw a scene and write its images: `python -m polysight_worlds --seed 1 --out scene.npz`.

Writes the arrays h, v, x_m, y_m, incidence_deg, simulated and a JSON file of the truth in the same folder. *Nuisances*
disturb the scan: noise, leakage, errors of position and others.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from polysight_worlds.images import ImagePair, simulate
from polysight_worlds.rig import load_rig, published_rig
from polysight_worlds.world import NUISANCES, draw_nuisances, draw_world


def save(images: ImagePair, file: Path) -> None:
    """Write `file` (.npz) and the truth beside it (.json)."""
    np.savez(
        file,
        h=images.h,
        v=images.v,
        x_m=images.x_m,
        y_m=images.y_m,
        incidence_deg=np.array(images.incidence_deg),
        simulated=np.array(True),
    )
    file.with_suffix(".json").write_text(json.dumps(images.truth(), indent=1), encoding="utf-8")


def main(arguments: list[str] | None = None) -> None:
    """Draw a world and its nuisances from the seed, scan it, and write images and truth."""
    parser = argparse.ArgumentParser(prog="python -m polysight_worlds", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True, help="file that ends in .npz")
    parser.add_argument("--nuisances", nargs="+", default=["none"], help=f"none, all, or of: {', '.join(NUISANCES)}")
    parser.add_argument("--strength", type=float, default=1.0, help="factor on the nuisances drawn")
    parser.add_argument("--half-spaces", action="store_true", help="plates are half spaces: none is thin")
    parser.add_argument("--table", action="store_true", help="a table behind the plates")
    parser.add_argument("--rig", type=Path, help="instrument.toml; without it, the published rig")
    options = parser.parse_args(arguments)
    if options.out.suffix != ".npz":
        parser.error(f"--out {options.out}: images are written as .npz; give a name that ends so")
    rng = np.random.default_rng(options.seed)
    rig = load_rig(options.rig) if options.rig else published_rig()
    centre_m = float(rig.centre_m[0]), float(rig.centre_m[1])
    world = draw_world(rng, centre_m, half_spaces=options.half_spaces, with_table=options.table)
    # "none" and "all" are words of their own, not names in a list.
    names = options.nuisances[0] if len(options.nuisances) == 1 else options.nuisances
    nuisances = draw_nuisances(rng, names, strength=options.strength)
    save(simulate(world, nuisances, rig), options.out)


if __name__ == "__main__":
    main()
