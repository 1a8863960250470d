"""Names of materials that are not in the library: plates, dishes, thin sheets, in scenes of the independent generator.

The library holds Table 2. Foreign plates are 30 common materials with values rounded from open tables near 100 GHz
(Lamb, Int. J. Infrared Millim. Waves 17, 1996; Jepsen, Cooke and Koch, Laser Photonics Rev. 5, 2011; ITU-R P.2040;
tables of woods, rocks and solvents in the open literature), each piece drawn with a spread of 3 % in the real part and
20 % in the loss. Dishes show liquids behind 3 mm of glass; sheets are 1 to 5 mm of real part 2 to 5 before air. All is
simulated. For each kind of piece: names of the library said at 0.8 and at 0.9 (each is wrong), names of the literature
said at 0.5, how many of them are of values within 15 % of the truth, possible layers, and pieces with a permittivity
whose 99 % region misses while it claims to be known within 10 % (95 %).
"""

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from benchmarks.worlds import FOREIGN, analyse_world, draw_piece, table_2_classifier
from polysight.materials import find_material
from polysight_worlds import draw_nuisances, draw_world, published_rig, simulate
from polysight_worlds.media import Stack
from polysight_worlds.world import World, dish

# Permittivities eps' - j eps'' of liquids, rounded.
LIQUIDS: dict[str, complex] = {
    "olive oil": 2.30 - 0.10j,
    "isopropanol": 3.00 - 0.60j,
    "glycerol": 3.40 - 1.10j,
    "ethanol": 3.40 - 0.95j,
    "water": 8.70 - 15.6j,
    "sugar water": 7.50 - 12.0j,
}
KINDS = ("plates", "dishes", "sheets")
# Squared distance within which a normal distribution in two dimensions holds 99 %.
CHI2_99 = 9.21
# A permittivity whose relative half width (95 %) is below this claims to be known; chosen.
NARROW = 0.10
# Diameter of a dish; chosen: as wide as a plate.
DISH_M = 0.046
# Relative distance from the truth within which a name of the literature counts as alike; chosen.
ALIKE = 0.15


@dataclass(frozen=True)
class Piece:
    """One judged piece."""

    # What it is.
    material: str
    # The name that it was given, "library" or "literature" (None: neither), and its probability.
    name: str
    source: str | None
    confidence: float
    # True if one of its names of the literature has about the true permittivity.
    alike: bool
    # True if it was refused as a possible layer.
    thin: bool
    # True if the 99 % region of its permittivity misses the truth, and the half width is below `NARROW`.
    misled: bool


def draw_scene(rng: np.random.Generator, kind: str, first: int) -> World:
    """Draw copper and eight pieces of a kind; plates are of eight of the nine materials from number `first` on."""
    centre = tuple(published_rig().centre_m)
    stacks: dict[str, complex | Stack]
    if kind == "plates":
        names = [list(FOREIGN)[(first + k) % len(FOREIGN)] for k in range(9)]
        stacks = {name: Stack(below=draw_piece(rng, FOREIGN[name])) for name in names}
    elif kind == "sheets":
        real = rng.uniform(2, 5, 9)
        tangent = rng.uniform(0.002, 0.05, 9)
        thickness_m = rng.uniform(1e-3, 5e-3, 9)
        stacks = {f"sheet {k}": Stack(((real[k] * (1 - 1j * tangent[k]), thickness_m[k]),), 1.0) for k in range(9)}
    else:
        stacks = {name: Stack(below=draw_piece(rng, eps)) for name, eps in LIQUIDS.items()}
    world = draw_world(rng, centre, materials=stacks, half_spaces=True)
    if kind != "dishes":
        return world
    plates = []
    for plate in world.plates:
        if plate.stack.is_metal:
            plates.append(plate)
        else:
            plates.append(dish(plate.name, plate.centre_m, DISH_M, plate.stack.below, wall_m=3e-3))
    return replace(world, plates=tuple(plates))


def judge_scene(kind: str, seed: int, nuisance: str = "none") -> list[Piece]:
    """Draw, scan and judge one scene."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    rig = published_rig()
    world = draw_scene(rng, kind, 9 * seed)
    pair = simulate(world, draw_nuisances(rng, nuisance), rig)
    analysis, plates = analyse_world(pair, classifier=table_2_classifier(float(np.radians(pair.incidence_deg))))
    out = []
    for patch in analysis.patches:
        stack = plates[patch.patch.label].stack
        if stack.is_metal:
            continue
        patch_name = patch.patch_name
        e = patch.permittivity
        if stack.layers:
            true = stack.layers[0][0]
        else:
            true = stack.below
        misled = False
        if patch.refused is None and e.value is not None and e.covariance is not None:
            deviation = np.array([(e.value - true).real, (e.value - true).imag])
            half_width = 1.96 * float(np.sqrt(np.trace(e.covariance) / 2)) / abs(e.value)
            misled = float(deviation @ np.linalg.solve(e.covariance, deviation)) > CHI2_99 and half_width < NARROW
        thin = patch.refused is not None and patch.refused.what == "possible layer"
        name = "not judged"
        source = None
        confidence = 0.0
        alike = False
        if patch_name is not None:
            name = patch_name.name
            source = patch_name.source
            confidence = patch_name.confidence
            alike = any(_is_alike(literature_name, true) for literature_name in patch_name.literature)
        out.append(
            Piece(
                material=plates[patch.patch.label].name,
                name=name,
                source=source,
                confidence=confidence,
                alike=alike,
                thin=thin,
                misled=misled,
            )
        )
    return out


def _is_alike(name: str, true: complex) -> bool:
    """True if the literature's material of this name has about the permittivity `true`."""
    material = find_material(name)
    return material is not None and abs(material.permittivity - true) < ALIKE * abs(true)


def format_line(title: str, pieces: Sequence[Piece]) -> str:
    """Return one line of the table; its columns are those that the module's docstring lists."""
    library = [p.confidence for p in pieces if p.source == "library"]
    literature = [p.alike for p in pieces if p.source == "literature" and p.confidence >= 0.5]
    figures = (
        len(pieces), sum(c >= 0.8 for c in library), sum(c >= 0.9 for c in library), len(literature), sum(literature),
        sum(p.thin or p.name == "possible layer" for p in pieces), sum(p.misled for p in pieces),
    )  # fmt: skip
    return f"{title:<22}" + "".join(f"{figure:>12}" for figure in figures)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument(
        "--scenes", type=int, default=4, help="scenes of each kind; four hold most of the 30 materials of plates"
    )
    parser.add_argument("--first", type=int, default=0, help="seed of the first scene")
    parser.add_argument("--nuisances", default="none,all", help="separated by commas")
    parser.add_argument("--jobs", type=int, default=2, help="processes")


def run(args: argparse.Namespace) -> int:
    """Judge the scenes; print the table. Return 0."""
    seeds = range(args.first, args.first + args.scenes)
    print(__doc__)
    titles = ("pieces", "library .8", "library .9", "literature", "alike", "layers", "misled")
    print(f"{'':<22}" + "".join(f"{title:>12}" for title in titles))
    with ProcessPoolExecutor(args.jobs) as pool:
        for nuisance in args.nuisances.split(","):
            for kind in KINDS:
                scenes = pool.map(partial(judge_scene, kind, nuisance=nuisance), seeds)
                pieces = [p for scene in scenes for p in scene]
                print(format_line(f"{kind}, {nuisance}", pieces), flush=True)
                for p in pieces:
                    if (p.source == "library" and p.confidence >= 0.8) or p.misled:
                        remark = ""
                        if p.misled:
                            remark = ", value misled"
                        print(f"  {p.material}: {p.name} {p.confidence:.2f}{remark}")
    return 0
